"""Visibility on analytic streets, by the words of its rule, and the measured spacings of scan lines."""

import math

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import LidarTrajectory
from sceneloom.colouring import visibility as vis
from sceneloom.colouring.algorithms import view_points
from sceneloom.colouring.visibility import VisibilitySettings, find_visible, look_around, measure_extent
from sceneloom.errors import ArrayError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import LidarFrame, LidarPoints, Poses
from sceneloom.scene.poses import PoseSource

KITTI = Camera("pinhole", 1242, 375, 720.0, 720.0, 620.5, 187.0)
TELE = Camera("pinhole", 1920, 1080, 1970.0, 1970.0, 959.5, 539.5)
WIDE = Camera("pinhole", 1280, 720, 500.0, 500.0, 639.5, 359.5)
BARREL = Camera("brown_conrady", 1280, 720, 640.0, 640.0, 639.5, 359.5, (-0.2, 0.03))
FISHEYE = Camera("fisheye", 960, 720, 300.0, 300.0, 479.5, 359.5, (0.02, -0.003, 0.0, 0.0))

# where the lidar is from the camera (forward, left, up)
BESIDE, BEHIND = {"lidar_above": (0.0, 0.8, 0.1)}, {"lidar_above": (-1.0, 0.2, 1.0)}
SET_UPS = {
    "lidar above": (KITTI, {}),
    "lidar a little above": (KITTI, {"lidar_above": (-0.3, 0.0, 0.3)}),
    "lidar behind and above": (KITTI, BEHIND),
    "lidar beside": (KITTI, BESIDE),
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
    "16 beams beside": (KITTI, {"beams": 16, "pitch_deg": 2.0, "top_deg": 5.0, "lidar_above": (0.0, 0.8, 0.1)}),
    "32 beams, long camera model": (TELE, {"beams": 32, "pitch_deg": 1.25, "top_deg": 5.0}),
    "32 beams beside": (BARREL, {"beams": 32, "pitch_deg": 1.25, "top_deg": 5.0, "lidar_above": (0.0, 0.8, 0.1)}),
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


def trajectory_of(street_view, *ends):
    """A lidar that goes from one end to the other, or stands where it measured."""
    count = len(street_view.points_world)
    if not ends:
        return LidarTrajectory(np.tile(street_view.lidar_world, (2, 1)), np.zeros(count, np.float32))
    return LidarTrajectory(np.stack(ends), np.ones(count, np.float32))


def view(street_view, settings=None, *, known_trajectory=False):
    camera = street_view.camera
    return view_points(
        street_view.points_world, camera, street_view.world_from_camera,
        np.zeros((camera.height, camera.width, 3), np.uint8), camera_id="front", timestamp_ns=0, visibility=settings,
        trajectory=trajectory_of(street_view) if known_trajectory else None,
    )  # fmt: skip


def shares(street_view, fused, *, some_hidden=True):
    """Share of the hidden points that pass for visible, and of the visible ones that pass for hidden."""
    assert len(fused.point_ids) == len(street_view.points_world)
    hidden, seen = ~street_view.seen & street_view.counted, street_view.seen & street_view.counted
    assert hidden.sum() > 200 or not some_hidden
    return fused.visible[hidden].mean() if some_hidden else 0.0, 1 - fused.visible[seen].mean()


@pytest.mark.parametrize("name", SET_UPS)
@pytest.mark.few(6)
def test_hidden_points_are_found_and_visible_ones_kept(street, name):
    camera, kwargs = SET_UPS[name]
    street_view = street(camera, **kwargs)
    assert max(shares(street_view, view(street_view))) < 0.03


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


def test_the_position_of_the_lidar_at_the_time_of_each_point_says_what_it_saw_beside_an_edge(street):
    street_view = street(KITTI, lidar_above=(0.0, 0.0, 0.02))
    assert street_view.seen[street_view.counted].mean() > 0.999
    settings = VisibilitySettings(surface_distance=1.2)
    unknown, known = (
        shares(street_view, view(street_view, settings, known_trajectory=known), some_hidden=False)[1]
        for known in (False, True)
    )
    # What opposite neighbours hide does not ask the lidar.
    assert known < 0.5 * unknown
    street_view = street(KITTI, **BESIDE)
    away, at_home = street_view.lidar_world - (0, 1.6, 0), street_view.lidar_world
    wide, matrix = VisibilitySettings(near_deg=0.5), street_view.world_from_camera.inverse().matrix
    points, ids = street_view.points_world, np.arange(len(street_view.points_world))
    found = [
        find_visible(points, ids, matrix, wide, trajectory=trajectory_of(street_view, *ends))
        for ends in ((away, at_home), (at_home, at_home), (at_home, away))
    ]
    np.testing.assert_array_equal(found[0], found[1])
    assert (found[0] != found[2]).any()
    of_others = LidarTrajectory(np.zeros((2, 3)), np.zeros(3, np.float32))
    with pytest.raises(ArrayError, match=r"trajectory\.fractions"):
        find_visible(points, ids, np.eye(4), VisibilitySettings(), trajectory=of_others)


def test_given_windows_are_followed_and_one_alone_leaves_the_other_to_be_measured(street):
    street_view = street(KITTI, beams=32, pitch_deg=1.0, top_deg=5.0)
    narrow, wide, near_alone, window_alone = (
        shares(street_view, view(street_view, VisibilitySettings(**given)))[0]
        for given in (
            {"window_deg": 0.5, "near_deg": 0.16}, {"window_deg": 1.2, "near_deg": 0.3}, {"near_deg": 0.16},
            {"window_deg": 0.5},
        )
    )  # fmt: skip
    assert narrow > 0.4  # the window does not reach the next scan line
    assert wide < 0.1
    assert max(near_alone, window_alone) < 0.2 * narrow


def test_the_road_has_no_holes_depths_are_drawn_of_what_is_not_hidden_wherever_the_world_begins(street):
    street_view = street(KITTI)
    fused, counted = view(street_view), street_view.counted
    road = (street_view.points_world[:, 2] < 0.05) & street_view.seen & counted
    assert fused.visible[road].mean() > 0.99
    columns, rows = np.floor(fused.pixels + 0.5).astype(int).T
    drawn = fused.depth_image[rows, columns] == fused.depths
    assert (drawn & ~street_view.seen & counted).sum() < 0.03 * (~street_view.seen & counted).sum()
    assert not (drawn & ~fused.visible).any()
    # a plain z-buffer finds almost nothing, and a larger margin hides less
    assert shares(street_view, view(street_view, VisibilitySettings(enabled=False)))[0] > 0.8
    counts = [view(street_view, VisibilitySettings(margin=margin)).visible.sum() for margin in (0.05, 0.5, 5.0)]
    assert counts[0] < counts[1] < counts[2]
    settings, ids = VisibilitySettings(), np.arange(len(street_view.points_world))
    matrix, shift = street_view.world_from_camera.inverse().matrix, np.array([4096.0, -2048.0, 64.0])
    moved = matrix.copy()
    moved[:3, 3] -= matrix[:3, :3] @ shift
    here = find_visible(street_view.points_world, ids, matrix, settings)
    there = find_visible(street_view.points_world + shift, ids, moved, settings)
    # The coordinates are rounded elsewhere; a decision in ten thousand may hang on that.
    assert (here == there).mean() > 0.9999


def test_settings_that_cannot_be_followed_are_refused():
    wrong = {"margin": (-0.1, math.nan), "surface_distance": (0.0, -1.0), "margin_share": (math.inf,)}
    wrong |= {"window_deg": (0.0, 46.0), "near_deg": (-1.0, math.nan)}
    for field, value in ((field, value) for field, values in wrong.items() for value in values):
        with pytest.raises(OptionError, match=f"{field} {value}"):
            VisibilitySettings(**{field: value})


def scan_lines(across_deg, along_deg, angle_deg=0.0, jitter=0.02):
    """Directions on parallel lines; at angle 0 the lines run to the right."""
    random = np.random.default_rng(0)
    right, down = np.meshgrid(np.arange(-15, 15, along_deg), np.arange(-12, 12, across_deg))
    right, rotation = right + random.normal(scale=jitter, size=right.shape), np.radians(angle_deg)
    rotated = (right * np.cos(rotation) - down * np.sin(rotation), right * np.sin(rotation) + down * np.cos(rotation))
    return np.radians([axis.ravel() for axis in rotated]).astype(np.float32)


def spacings_deg(directions, inverse_ranges=None):
    inverse = np.full(directions.shape[1], 0.1, np.float32) if inverse_ranges is None else inverse_ranges
    return np.degrees(vis.measure_spacings(look_around(directions, inverse)))


def test_spacings_of_scan_lines_and_distances_of_surfaces_are_found_if_there_are_points_enough():
    for across_deg, along_deg in [(0.42, 0.17), (1.0, 0.2), (2.0, 0.4), (0.6, 0.35)]:
        for angle_deg, along_axis in [(0, 0), (45, 1), (90, 2), (135, 3)]:
            spacings = spacings_deg(scan_lines(across_deg, along_deg, angle_deg))
            # Half a cell of resolution, and the neighbour across may lie a little to the side.
            assert spacings[along_axis] == pytest.approx(along_deg, abs=0.05)
            assert spacings[(along_axis + 2) % 4] == pytest.approx(across_deg, abs=0.05 + 0.1 * across_deg)
    lines, others = scan_lines(0.42, 0.17), scan_lines(0.29, 0.87)
    both, inverse = np.column_stack([others, lines]), np.repeat([0.0, 0.1], [others.shape[1], lines.shape[1]])
    assert spacings_deg(both, inverse.astype(np.float32))[2] == pytest.approx(0.42, abs=0.1)
    for count in (0, 1, 5, 100):
        assert np.isnan(spacings_deg(lines[:, :count].copy())).all()
    along, _, across, _ = spacings_deg(scan_lines(4.0, 0.2))
    assert np.isnan(across)
    assert along == pytest.approx(0.2, abs=0.05)
    for height, exact, most in [(0.3, 0.24, 0.26), (0.8, 0.64, 0.7), (1.65, 1.32, 1.4), (3.0, 1.5, None)]:
        for spacing_deg in (0.2, 0.4, 2.0):
            measured = surface_distance(*ground_and_wall(height, spacing_deg=spacing_deg, noise=0.0), 0.075, 0.005)
            # The ground is met at up to 25 degrees in the image, whose cosine is 0.91; directions are float32.
            assert 0.99 * exact < measured < exact / 0.9
        if most is not None:  # noise makes surfaces steeper, never flatter
            assert 0.4 * most < surface_distance(*ground_and_wall(height), 0.075, 0.005) < most
    directions = scan_lines(0.42, 0.17)
    ranges = np.random.default_rng(0).uniform(2, 80, directions.shape[1]).astype(np.float32)
    for some, inverse in ((directions, 1 / ranges), (directions, 0 * ranges), (directions[:, :0].copy(), ranges[:0])):
        assert surface_distance(some, inverse, 0.0, 0.0) == 0.5


def test_the_reach_follows_the_scan_lines():
    for spacings_deg, window_deg, across_deg, along_deg, angle_deg in [
        ((0.2, 0.45, 0.4, 0.45), 0.46, 0.3, 0.18, 90),
        ((0.4, 0.45, 0.2, 0.45), 0.46, 0.3, 0.18, 0),
        ((0.45, 0.2, 0.45, 0.4), 0.46, 0.3, 0.18, 135),
        ((0.1, 0.11, 0.1, 0.1), 0.3, 0.1, 0.1, 45),
        ((0.2, 2.1, 2.4, 2.1), 2.76, 2.2, 2.76 / 6, 90),  # what is near reaches one cell
        ((0.2, math.nan, 1.0, math.nan), 1.15, 0.87, 1.15 / 6, 90),
        ((0.2, 0.3, math.nan, math.nan), 0.5, 0.16, 0.16, 0),
        ((math.nan,) * 4, 0.5, 0.16, 0.16, 0),
    ]:
        reach = vis.fit_reach(vis.find_lines(np.radians(spacings_deg)))
        found = np.degrees([reach.window, reach.across, reach.along, reach.angle])
        assert found == pytest.approx([window_deg, across_deg, along_deg, angle_deg], abs=1e-3)
        # the ellipse has its axes across and along the lines
        xx, xy, yy = reach.hiding(np.zeros(0, np.float32))[3:]
        for length, angle in ((reach.across, reach.angle), (reach.along, reach.angle + math.pi / 2)):
            x, y = length * math.cos(angle), length * math.sin(angle)
            assert xx * x * x + xy * x * y + yy * y * y == pytest.approx(1)


def ground_and_wall(height, *, spacing_deg=0.4, wall_at=40.0, noise=0.02):
    """A cloud of a flat ground, that many metres below the camera, and of a wall ahead."""
    random = np.random.default_rng(0)
    across, along = np.meshgrid(np.radians(np.arange(-12, 25, spacing_deg)), np.radians(np.arange(-30, 30, 0.2)))
    rays = np.stack([np.sin(along) * np.cos(across), np.sin(across), np.cos(along) * np.cos(across)], axis=-1)
    rays = rays.reshape(-1, 3)
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 1] > 0, height / rays[:, 1], np.inf)
    ranges = np.minimum(to_ground, wall_at / rays[:, 2]) + random.normal(scale=noise, size=len(rays))
    directions = rays[:, :2].T * np.sqrt(2 / (1 + rays[:, 2]))
    return np.ascontiguousarray(directions, np.float32), (1 / ranges).astype(np.float32)


def surface_distance(directions, inverse_ranges, *margins):
    return vis.measure_surface_distance(look_around(directions, inverse_ranges), directions, inverse_ranges, *margins)


UNKNOWN = vis.ScanLines(0.01, 0.01, 0.0)
FINE = np.arange(-4.0, 4.0, 0.25)
COARSE = np.concatenate([np.arange(-14.0, -4.0, 1.0), FINE, np.arange(4.0, 14.0, 1.0)])


def lines_at(across_deg, angle_deg=90.0, along_deg=0.2):
    """Directions (2, M) on lines at locations across them, shuffled, and unit inverse ranges."""
    across, along = np.meshgrid(np.radians(across_deg), np.radians(np.arange(-20, 20, along_deg)))
    along = along + np.radians(0.07) * np.arange(len(across_deg))
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    u, t = across.ravel(), along.ravel()
    directions = np.stack([c * u - s * t, s * u + c * t])
    order = np.random.default_rng(0).permutation(len(u))
    return np.ascontiguousarray(directions[:, order], np.float32), np.ones(len(u), np.float32), u[order]


@pytest.mark.parametrize("angle_deg", [90.0, 0.0, 45.0])
def test_parts_have_the_spacing_and_the_axis_of_their_lines(angle_deg):
    directions, ones, across = lines_at(COARSE, angle_deg)
    assert vis.are_uneven(look_around(directions, ones))
    parts, off = vis.split_by_spacing(directions, ones, UNKNOWN), np.abs(np.degrees(across))
    assert np.sum([members for _, members in parts], axis=0).tolist() == [1] * len(ones)
    for spacing_deg, inside in ((0.25, off < 3), (1.0, off > 5.5)):
        lines, members = max(parts, key=lambda part: part[1][inside].mean())
        # In tiles at the corners of the view too few points are drawn to report.
        assert members[inside].mean() > 0.75
        # Cells of 0.1 degrees, and neighbours up to 45 degrees aside.
        assert math.degrees(lines.across) == pytest.approx(spacing_deg, abs=0.25)
        assert math.degrees(lines.along) == pytest.approx(0.2, abs=0.1)
        assert math.degrees(lines.angle) == pytest.approx(angle_deg)


def test_lines_that_lie_alike_and_few_points_are_not_uneven_and_make_one_part():
    for spacing_deg in [0.25, 0.6, 1.2, 2.0]:
        directions, ones, _ = lines_at(np.arange(-14, 14, spacing_deg))
        assert not vis.are_uneven(look_around(directions, ones))
    directions, ones = np.random.default_rng(1).uniform(-0.3, 0.3, (2, 20)).astype(np.float32), np.ones(20, np.float32)
    assert not vis.are_uneven(look_around(directions, ones))
    assert not vis.are_uneven(look_around(directions[:, :0].copy(), ones[:0]))
    ((lines, members),) = vis.split_by_spacing(directions, ones, UNKNOWN)
    assert members.all()
    assert math.degrees(lines.across) == pytest.approx(2.5)


AHEAD = Poses(np.array([0, 1000], np.int64), np.array([[0.0, 0, 0], [10, 0, 0]]), np.array([[0.0, 0, 0, 1]] * 2))
MOUNT = RigidTransform(np.eye(3), np.array([0.0, 1.0, 2.0]))


def test_the_ends_are_the_lidars_locations_at_the_first_and_the_last_point():
    for times, count, ends, fractions in [
        ([300, 500, 350], 3, (3, 5), [0, 1, 0.25]),
        (None, 3, (4, 4), [0, 0, 0]),  # all were measured at the timestamp of their frame
        ([], 0, (4, 4), []),
        ([900, 1000, 1001], 3, None, None),  # beyond the poses
    ]:
        timestamps = None if times is None else np.array(times, np.int64)
        frame = LidarFrame(400, LidarPoints(np.zeros((count, 3), np.float32), timestamps_ns=timestamps))
        trajectory = LidarTrajectory.of(frame, PoseSource(AHEAD, MOUNT))
        assert (trajectory is None) == (ends is None)
        if ends is not None:
            np.testing.assert_allclose(trajectory.ends_world, [[x, 1, 2] for x in ends])
            np.testing.assert_allclose(trajectory.fractions, fractions)
    for wrong in ((np.zeros((3, 3)), np.zeros(2, np.float32)), (np.zeros((2, 3)), np.zeros((2, 1), np.float32))):
        with pytest.raises(ArrayError, match="trajectory"):
            LidarTrajectory(*wrong)


CELL, WINDOW = math.radians(0.16), math.radians(0.5)
MARGIN, SHARE, SLOPE, NEARING = 0.15, 0.01, 2.0, 0.85


def ellipse(across_deg=0.38, along_deg=0.24, angle=math.pi / 2):
    p, r, c, s = math.radians(across_deg) ** -2, math.radians(along_deg) ** -2, math.cos(angle), math.sin(angle)
    return p * c * c + r * s * s, 2 * (p - r) * c * s, p * s * s + r * c * c


def marked(directions, inverse_ranges, *, cell=CELL, window=WINDOW, near=None, slope=SLOPE, eyes=None, hiding=None):
    """The kernel's answer; point i has row i of the fractions, which rise from 0 to 1."""
    count, visible = len(inverse_ranges), np.zeros(len(inverse_ranges), bool)
    locations, nearness = (np.ascontiguousarray(rows, np.float32) for rows in (directions, inverse_ranges))
    hiding = vis.Hiding(
        nearness if hiding is None else np.ascontiguousarray(hiding, np.float32), cell, window, *(near or ellipse())
    )
    vis.mark_unhidden(
        locations, nearness, [hiding], measure_extent(locations, nearness), slope, MARGIN, SHARE,
        np.zeros((0, 3)) if eyes is None else eyes, np.arange(count), np.linspace(0, 1, count, dtype=np.float32),
        NEARING, visible,
    )  # fmt: skip
    return visible


def in_map(points):
    """Lambert's map of points (N, 3) around the z axis, (2, N)."""
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return rays[:, :2].T * np.sqrt(2 / (1 + rays[:, 2]))


def shift_by_small_step(direction, eye):
    """How a point 1 m away in a direction shifts in the map, to first order, when the eye comes from `eye`."""
    x, y = direction.astype(np.float64)
    half = math.sqrt(1 - 0.25 * (x * x + y * y))
    ray, step = np.array([[x * half, y * half, 1 - 0.5 * (x * x + y * y)]]), 1e-6
    return ((in_map(ray + step * eye) - in_map(ray - step * eye)) / (2 * step))[:, 0]


def hidden_one_by_one(directions, inverse_ranges, *, cell, window, near, slope, strictness, eyes=None):
    """The rule by its words: every point against the nearest point of every cell, no bounds, no windows of cells.

    `strictness` above 1 makes hiding harder: what is hidden even then is surely hidden.
    """
    per_cell = np.float32(1 / cell)
    steps, nearest = (directions * per_cell + np.float32(2.1) * per_cell).astype(np.int64), {}
    for j, (location, inverse) in enumerate(zip(map(tuple, steps.T), inverse_ranges, strict=True)):
        if inverse > 0 and (location not in nearest or inverse > inverse_ranges[nearest[location]]):
            nearest[location] = j
    holders, hidden = np.array(list(nearest.values()), np.int64), np.zeros(len(inverse_ranges), bool)
    for i, inverse in enumerate(inverse_ranges.astype(np.float64)):
        x, y = directions[:, holders].astype(np.float64) - directions[:, i : i + 1]
        flattening = math.sqrt(1 - 0.25 * float((directions[:, i].astype(np.float64) ** 2).sum()))
        needed = slope / flattening * np.hypot(x, y) * strictness
        excess = inverse_ranges[holders] - inverse - strictness * (MARGIN * inverse**2 + SHARE * inverse)
        hides = excess > needed
        beside = near[0] * x * x + near[1] * x * y + near[2] * y * y <= 1 / strictness
        if eyes is not None:
            eye = eyes[0] + i / max(len(inverse_ranges) - 1, 1) * (eyes[1] - eyes[0])
            gained = inverse_ranges[holders] - inverse
            # What the eye comes from, seen from there: the nearer thing has not yet made its larger shift.
            before = np.stack([x, y]) - gained * shift_by_small_step(directions[:, i], eye)[:, None]
            beside &= x * before[0] + y * before[1] <= NEARING / strictness * (before**2).sum(axis=0)
        rotation_of_vector = np.floor(np.arctan2(y, x) / (math.pi / 2)).astype(int) % 4
        quadrants = set(rotation_of_vector[hides & (np.hypot(x, y) <= window / strictness)])
        hidden[i] = (hides & beside).any() or {0, 2} <= quadrants or {1, 3} <= quadrants
    return hidden


def random_cloud(seed, count, spread_deg, *, layers=(1 / 30, 1 / 8)):
    """Two noisy surfaces behind each other, the nearer one with holes; and some points anywhere."""
    random = np.random.default_rng(seed)
    directions = np.radians(random.uniform(-spread_deg, spread_deg, (2, count))).astype(np.float32)
    inverse = np.where(random.random(count) < 0.5, *layers) + random.normal(scale=2e-3, size=count)
    inverse = inverse + 0.1 * directions[1]
    inverse[::17] = random.uniform(0.005, 0.5, len(inverse[::17]))
    return directions, np.maximum(inverse, 1e-3).astype(np.float32)


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"window": math.radians(1.15), "cell": math.radians(0.19), "near": ellipse(0.9, 0.24)},
        {"near": ellipse(0.5, 0.15, math.pi / 4), "slope": 0.8},
        {"near": ellipse(0.1, 0.1), "window": math.radians(0.3)},
        {"near": ellipse(1.2, 1.2), "window": math.radians(0.2), "cell": math.radians(0.3)},
        {"near": ellipse(0.5, 0.4), "eyes": np.array([[0.02, -0.06, -0.1], [-0.05, 0.01, 0.05]])},
        {"near": ellipse(1.2, 0.9), "eyes": np.array([[0.3, -0.6, -0.3], [0.3, -0.6, 0.4]])},
    ],
    ids=["usual", "sparse lidar", "tilted", "dense lidar", "window smaller than near", "lidar beside", "lidar above"],
)
@pytest.mark.parametrize(("count", "spread_deg"), [(600, 1.5), (1500, 8.0), (700, 40.0)])
@pytest.mark.few(6)
def test_decisions_are_those_of_the_rule_applied_point_by_point(kwargs, count, spread_deg):
    settings = {"cell": CELL, "window": WINDOW, "near": ellipse(), "slope": SLOPE, **kwargs}
    directions, inverse_ranges = random_cloud(count, count, spread_deg)
    visible = marked(directions, inverse_ranges, **settings)
    # Float32 decides within 1e-4 of a limit as it likes; beyond that there is one answer.
    surely_hidden = hidden_one_by_one(directions, inverse_ranges, **settings, strictness=1 + 1e-3)
    perhaps_hidden = hidden_one_by_one(directions, inverse_ranges, **settings, strictness=1 - 1e-3)
    assert not visible[surely_hidden].any()
    assert visible[~perhaps_hidden].all()
    assert (surely_hidden == perhaps_hidden).mean() > 0.99
    if spread_deg < 10:
        assert surely_hidden.any()


@pytest.mark.parametrize("seed", range(20))
def test_a_plane_that_passes_the_camera_at_the_surface_distance_or_farther_never_hides_itself(seed):
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    rays = random.normal(size=(40_000, 3)) * [0.6, 0.6, 0.1] + [0, 0, 1]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    inverse_ranges = rays @ normal / random.uniform(1 / SLOPE, 3)
    rays, inverse_ranges = rays[inverse_ranges > 0.005], inverse_ranges[inverse_ranges > 0.005]
    directions = rays[:, :2].T * np.sqrt(2 / (1 + rays[:, 2]))
    assert marked(directions, inverse_ranges, near=ellipse(0.8, 0.8)).all()


def test_points_without_range_or_outside_the_map_or_that_shall_not_hide_others_hide_nothing():
    for direction, inverse in [
        *(((0, 0), inverse) for inverse in (0.0, -1.0, math.nan, math.inf)),
        *((direction, 0.5) for direction in ((math.nan, 0), (0, math.inf), (3, 0), (0, -1e30))),
    ]:
        visible = marked(np.column_stack([(0, 0), direction, (0, 0)]), np.array([0.1, inverse, 0.1]))
        assert visible.tolist() == [True, False, True]
    assert marked(np.zeros((2, 0)), np.zeros(0)).tolist() == []
    assert marked(np.array([[1.9], [-0.5]]), np.array([1e-3])).tolist() == [True]
    distances, neighbours = found(np.zeros((2, 0), np.float32), np.zeros(0, np.float32), 3)
    assert np.isnan(distances).all()
    assert (neighbours == -1).all()
    rng = np.random.default_rng(8)
    directions, inverse = rng.uniform(-0.1, 0.1, (2, 3000)), rng.uniform(0.02, 0.5, 3000)
    hides = rng.random(3000) < 0.3
    partly = marked(directions, inverse, hiding=np.where(hides, inverse, 0.0))
    # As if the others were asked one at a time, each among those that hide.
    alone = marked(directions[:, hides], inverse[hides])
    np.testing.assert_array_equal(partly[hides], alone)
    for i in np.flatnonzero(~hides)[:40]:
        rows = np.append(np.flatnonzero(hides), i)
        # Where it takes the position of a hiding one in the grid, the answer may not be compared.
        in_cell = np.abs(directions[:, hides] - directions[:, [i]]).max(axis=0) < CELL
        if not in_cell.any():
            assert partly[i] == marked(directions[:, rows], inverse[rows])[-1]
    assert not marked(directions, inverse, hiding=np.zeros(3000))[inverse == 0].any()
    assert marked(directions, inverse, hiding=np.zeros(3000)).all()


SPACING_CELL = 0.002
STEPS = [(dx, dy) for dx in range(-6, 7) for dy in range(-6, 7) if 0 < dx * dx + dy * dy <= 36]
RIGHT, DOWN = np.array(sorted(STEPS, key=lambda step: (math.hypot(*step), step)), np.int64).T.copy()
SECTORS, DISTANCES = (RIGHT > 0) + 2 * (DOWN > 0), np.hypot(RIGHT, DOWN)


def found(directions, inverse_ranges, samples):
    distances, neighbours = np.zeros((samples, 4)), np.zeros((samples, 4), np.int64)
    vis.find_neighbours(
        directions, inverse_ranges, measure_extent(directions, inverse_ranges), SPACING_CELL, RIGHT, DOWN,
        SECTORS.astype(np.int64), DISTANCES, distances, neighbours,
    )  # fmt: skip
    return distances, neighbours


def cells_of(directions):
    """Column and row of each point's cell, (M, 2)."""
    per_cell = np.float32(1 / SPACING_CELL)
    return (directions * per_cell + np.float32(2.1) * per_cell).astype(np.int64).T


def found_one_by_one(directions, inverse_ranges, samples):
    """Every sampled cell against every other cell that holds a point."""
    cells = cells_of(directions)
    taking_part = (inverse_ranges > 0) & (np.abs(directions) <= 2.1).all(axis=0)
    occupied, rows = {tuple(cell) for cell in cells[taking_part].tolist()}, []
    for s in range(samples):
        nearest, count = [math.nan] * 4, len(inverse_ranges)
        i = s * count // min(samples, count) if s < min(samples, count) else None
        for x, y in occupied if i is not None and taking_part[i] else ():
            dx, dy = x - int(cells[i, 0]), y - int(cells[i, 1])
            if 0 < math.hypot(dx, dy) <= 6:
                sector = (dx > 0) + 2 * (dy > 0)
                nearest[sector] = min(math.hypot(dx, dy), nearest[sector], key=lambda d: math.inf if d != d else d)
        rows.append(nearest)
    return np.array(rows)


@pytest.mark.parametrize("count", [1, 7, 300, 1500])
@pytest.mark.parametrize("samples", [1, 50])
def test_the_next_occupied_cell_of_each_sector_is_found(count, samples):
    random = np.random.default_rng(count)
    directions = random.uniform(-0.06, 0.06, (2, count)).astype(np.float32)
    inverse_ranges = np.where(random.random(count) < 0.8, 0.1, 0).astype(np.float32)
    expected = found_one_by_one(directions, inverse_ranges, samples)
    distances, neighbours = found(directions, inverse_ranges, samples)
    np.testing.assert_allclose(distances, expected)
    np.testing.assert_array_equal(neighbours < 0, np.isnan(expected))
    cells, drawn = cells_of(directions), min(samples, count)
    own = cells[np.arange(drawn) * count // drawn]
    dx, dy = np.moveaxis(cells[neighbours[:drawn]] - own[:, None], 2, 0)
    known = neighbours[:drawn] >= 0
    np.testing.assert_allclose(np.hypot(dx, dy)[known], distances[:drawn][known])
    np.testing.assert_array_equal(((dx > 0) + 2 * (dy > 0))[known], np.nonzero(known)[1])
    assert (inverse_ranges[neighbours[:drawn][known]] > 0).all()
