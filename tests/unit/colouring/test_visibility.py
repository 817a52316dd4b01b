import math

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import LidarTrajectory
from sceneloom.colouring.algorithms import view_points
from sceneloom.colouring.visibility import VisibilitySettings, find_visible
from sceneloom.errors import ArrayError, OptionError

KITTI = Camera("pinhole", 1242, 375, 720.0, 720.0, 620.5, 187.0)
TELE = Camera("pinhole", 1920, 1080, 1970.0, 1970.0, 959.5, 539.5)
WIDE = Camera("pinhole", 1280, 720, 500.0, 500.0, 639.5, 359.5)
BARREL = Camera("brown_conrady", 1280, 720, 640.0, 640.0, 639.5, 359.5, (-0.2, 0.03))
FISHEYE = Camera("fisheye", 960, 720, 300.0, 300.0, 479.5, 359.5, (0.02, -0.003, 0.0, 0.0))

SET_UPS = {
    "lidar above": (KITTI, {}),
    "lidar a little above": (KITTI, {"lidar_above": (-0.3, 0.0, 0.3)}),
    "lidar behind and above": (KITTI, {"lidar_above": (-1.0, 0.2, 1.0)}),
    "lidar beside": (KITTI, {"lidar_above": (0.0, 0.8, 0.1)}),
    "lidar below": (KITTI, {"lidar_above": (1.5, 0.0, -1.0), "top_deg": 13.0}),
    "camera rolled": (KITTI, {"roll": 0.4}),
    "camera on its side": (Camera("pinhole", 600, 600, 500.0, 500.0, 299.5, 299.5), {"roll": math.pi / 2}),
    "low camera": (KITTI, {"height": 0.8, "lidar_above": (-1.2, 0.0, 1.0)}),
    "other street": (KITTI, {"seed": 3}),
    "128 beams": (KITTI, {"beams": 128, "pitch_deg": 0.2}),
    "32 beams": (KITTI, {"beams": 32, "pitch_deg": 1.0, "top_deg": 5.0}),
    "coarse azimuths": (KITTI, {"azimuth_deg": 0.35}),
    "noisy ranges": (KITTI, {"noise": 0.04}),
    "long camera model": (TELE, {}),
    "wide camera model": (WIDE, {}),
    "distorting camera model": (BARREL, {}),
    "fisheye camera model": (FISHEYE, {}),
}


SPARSE = {
    "16 beams": (KITTI, {"beams": 16, "pitch_deg": 2.0, "top_deg": 5.0, "azimuth_deg": 0.12}),
    "16 beams beside": (
        KITTI,
        {"beams": 16, "pitch_deg": 2.0, "top_deg": 5.0, "lidar_above": (0.0, 0.8, 0.1)},
    ),
    "32 beams, long camera model": (TELE, {"beams": 32, "pitch_deg": 1.25, "top_deg": 5.0}),
    "32 beams beside": (
        BARREL,
        {"beams": 32, "pitch_deg": 1.25, "top_deg": 5.0, "lidar_above": (0.0, 0.8, 0.1)},
    ),
}
"""Lidars that leave so much open that it takes their location to report what is hidden."""


FINE_IN_THE_MIDDLE = (
    *np.arange(15.0, 2.0, -1.0),
    *np.arange(2.0, -6.0, -1 / 6),
    *np.arange(-6.0, -14.0, -1.0),
    *np.arange(-14.0, -26.0, -4.0),
)
"""Elevations of a lidar of 72 lines [deg]."""

UNEVEN = {
    "lidar above": (WIDE, {"lidar_above": (-0.3, 0.0, 1.2)}),
    "lidar behind and above": (BARREL, {"lidar_above": (-1.4, 0.2, 0.8)}),
    "lidar beside": (WIDE, {"lidar_above": (0.0, 1.2, 0.1)}),
    "camera on its side": (Camera("pinhole", 900, 900, 500.0, 500.0, 449.5, 449.5), {"roll": math.pi / 2}),
}


def view(street_view, settings=None, *, known_trajectory=False):
    count = len(street_view.points_world)
    trajectory = LidarTrajectory(np.tile(street_view.lidar_world, (2, 1)), np.zeros(count, np.float32))
    camera = street_view.camera
    rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
    return view_points(
        street_view.points_world,
        camera,
        street_view.world_from_camera,
        rgb,
        camera_id="front",
        timestamp_ns=0,
        visibility=settings,
        trajectory=trajectory if known_trajectory else None,
    )


def shares(street_view, fused):
    """Share of the hidden points that pass for visible, and of the visible ones that pass for hidden."""
    assert len(fused.point_ids) == len(street_view.points_world)
    hidden, seen = ~street_view.seen & street_view.counted, street_view.seen & street_view.counted
    assert hidden.sum() > 200
    return fused.visible[hidden].mean(), 1 - fused.visible[seen].mean()


def shares_lost(street_view, fused):
    """Share of the visible points that pass for hidden."""
    seen = street_view.seen & street_view.counted
    return 1 - fused.visible[seen].mean()


@pytest.mark.parametrize("name", SET_UPS)
@pytest.mark.few(6)
def test_hidden_points_are_found_and_visible_ones_kept(street, name):
    camera, kwargs = SET_UPS[name]
    street_view = street(camera, **kwargs)
    hidden_passed, visible_lost = shares(street_view, view(street_view))
    assert hidden_passed < 0.03
    assert visible_lost < 0.03


@pytest.mark.parametrize("name", [*SET_UPS, *SPARSE])
def test_knowing_from_where_the_lidar_measured_helps_sparse_lidars_as_well(street, name):
    camera, kwargs = (SET_UPS | SPARSE)[name]
    street_view = street(camera, **kwargs)
    hidden_passed, visible_lost = shares(street_view, view(street_view, known_trajectory=True))
    assert hidden_passed < 0.03
    # Beside every edge a spacing of the scan lines is in doubt: of 16 or 32 lines that is more of all that is seen.
    assert visible_lost < (0.05 if name in SPARSE else 0.03)


@pytest.mark.parametrize("name", UNEVEN)
def test_where_lines_lie_far_apart_points_hide_with_a_longer_reach(street, name):
    camera, kwargs = UNEVEN[name]
    street_view = street(camera, elevations_deg=FINE_IN_THE_MIDDLE, azimuth_deg=0.2, **kwargs)
    hidden_passed, visible_lost = shares(street_view, view(street_view, known_trajectory=True))
    assert hidden_passed < 0.03
    # Lines 1 and 4 degrees apart leave open where things end, as those of sparse lidars do.
    assert visible_lost < 0.05
    # One reach for all would be that of the dense lines, which most points lie on.
    of_dense = VisibilitySettings(window_deg=0.33, near_deg=0.19)
    assert shares(street_view, view(street_view, of_dense, known_trajectory=True))[0] > 5 * hidden_passed
    of_sparse = VisibilitySettings(window_deg=1.35, near_deg=1.05)
    assert shares(street_view, view(street_view, of_sparse, known_trajectory=True))[1] > 2 * visible_lost


def test_what_the_lidar_saw_as_near_to_an_edge_as_the_camera_does_is_not_hidden(street):
    street_view = street(KITTI, lidar_above=(0.0, 0.0, 0.02))
    assert street_view.seen[street_view.counted].mean() > 0.999
    settings = VisibilitySettings(surface_distance=1.2)
    lost = [
        shares_lost(street_view, view(street_view, settings, known_trajectory=known_trajectory))
        for known_trajectory in (False, True)
    ]
    # What opposite neighbours hide does not ask the lidar.
    assert lost[1] < 0.5 * lost[0]


def test_the_position_of_the_lidar_is_taken_at_the_time_of_each_point(street):
    street_view = street(KITTI, lidar_above=(0.0, 0.8, 0.1))
    count = len(street_view.points_world)
    away, at_home = street_view.lidar_world - (0, 1.6, 0), street_view.lidar_world
    wide, fractions = VisibilitySettings(near_deg=0.5), np.ones(count, np.float32)
    matrix, ids = street_view.world_from_camera.inverse().matrix, np.arange(count)
    found = [
        find_visible(street_view.points_world, ids, matrix, wide, trajectory=LidarTrajectory(ends, fractions))
        for ends in (np.stack([away, at_home]), np.stack([at_home, at_home]), np.stack([at_home, away]))
    ]
    np.testing.assert_array_equal(found[0], found[1])
    assert (found[0] != found[2]).any()


def test_a_way_of_another_cloud_is_refused(street):
    street_view = street(KITTI)
    trajectory = LidarTrajectory(np.zeros((2, 3)), np.zeros(3, np.float32))
    ids = np.arange(len(street_view.points_world))
    with pytest.raises(ArrayError, match=r"trajectory\.fractions"):
        find_visible(street_view.points_world, ids, np.eye(4), VisibilitySettings(), trajectory=trajectory)


def test_a_plain_z_buffer_finds_almost_nothing(street):
    street_view = street(*SET_UPS["lidar above"][:1])
    hidden_passed, _ = shares(street_view, view(street_view, VisibilitySettings(enabled=False)))
    assert hidden_passed > 0.8


def test_the_road_ahead_has_no_holes(street):
    street_view = street(KITTI)
    fused = view(street_view)
    road = (street_view.points_world[:, 2] < 0.05) & street_view.seen & street_view.counted
    assert fused.visible[road].mean() > 0.99


def test_depths_in_the_image_are_those_of_points_that_are_not_hidden(street):
    street_view = street(KITTI)
    fused = view(street_view)
    columns, rows = np.floor(fused.pixels + 0.5).astype(int).T
    drawn = fused.depth_image[rows, columns] == fused.depths
    wrongly_drawn = drawn & ~street_view.seen & street_view.counted
    assert wrongly_drawn.sum() < 0.03 * (~street_view.seen & street_view.counted).sum()
    assert not (drawn & ~fused.visible).any()


def test_given_windows_are_followed(street):
    street_view = street(KITTI, beams=32, pitch_deg=1.0, top_deg=5.0)
    narrow = view(street_view, VisibilitySettings(window_deg=0.5, near_deg=0.16))
    assert shares(street_view, narrow)[0] > 0.4  # the window does not reach the next scan line
    wide = view(street_view, VisibilitySettings(window_deg=1.2, near_deg=0.3))
    assert shares(street_view, wide)[0] < 0.1


def test_one_given_reach_leaves_the_other_to_be_measured(street):
    street_view = street(KITTI, beams=32, pitch_deg=1.0, top_deg=5.0)
    both = shares(street_view, view(street_view, VisibilitySettings(window_deg=0.5, near_deg=0.16)))[0]
    assert shares(street_view, view(street_view, VisibilitySettings(near_deg=0.16)))[0] < 0.2 * both
    assert shares(street_view, view(street_view, VisibilitySettings(window_deg=0.5)))[0] < 0.2 * both


def test_a_larger_margin_hides_less(street):
    street_view = street(KITTI)
    counts = [
        view(street_view, VisibilitySettings(margin=margin)).visible.sum() for margin in (0.05, 0.5, 5.0)
    ]
    assert counts[0] < counts[1] < counts[2]


def test_decisions_do_not_depend_on_where_the_world_begins(street):
    street_view = street(KITTI)
    settings, ids = VisibilitySettings(), np.arange(len(street_view.points_world))
    matrix = street_view.world_from_camera.inverse().matrix
    shift = np.array([4096.0, -2048.0, 64.0])
    moved = matrix.copy()
    moved[:3, 3] -= matrix[:3, :3] @ shift
    here = find_visible(street_view.points_world, ids, matrix, settings)
    there = find_visible(street_view.points_world + shift, ids, moved, settings)
    # The coordinates are rounded elsewhere; a decision in ten thousand may hang on that.
    assert (here == there).mean() > 0.9999


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("margin", -0.1),
        ("margin", math.nan),
        ("margin_share", math.inf),
        ("surface_distance", 0.0),
        ("surface_distance", -1.0),
        ("window_deg", 0.0),
        ("window_deg", 46.0),
        ("near_deg", -1.0),
        ("near_deg", math.nan),
    ],
)
def test_settings_that_cannot_be_followed_are_refused(field, value):
    with pytest.raises(OptionError, match=f"{field} {value}"):
        VisibilitySettings(**{field: value})
