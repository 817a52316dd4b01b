import math

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import PointVisibility, VisibilitySettings, view_points
from sceneloom.geometry.rigid import RigidTransform

PINHOLE = Camera("pinhole", 640, 480, 400.0, 400.0, 319.5, 239.5)
BARREL = Camera("brown_conrady", 640, 480, 400.0, 400.0, 319.5, 239.5, (-0.3, 0.0))
WIDE = Camera("fisheye", 640, 640, 150.0, 150.0, 319.5, 319.5)
POSE = RigidTransform.from_quaternion(np.array([4.0, -2.0, 1.5]), np.array([0.1, -0.7, 0.2, 0.4]))


def observations_of(points_camera, camera, *, enabled=True):
    rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
    view = view_points(
        np.where(
            np.isfinite(points_camera), POSE.apply(np.nan_to_num(points_camera, posinf=0)), points_camera
        ),
        camera,
        POSE,
        rgb,
        camera_id="c",
        timestamp_ns=0,
        visibility=VisibilitySettings(enabled=enabled),
    )
    return view, view.observations


def at_angle(degrees, distance=10.0):
    return distance * math.sin(math.radians(degrees)), 0.0, distance * math.cos(math.radians(degrees))


@pytest.mark.parametrize(
    ("camera", "points", "expected"),
    [
        (PINHOLE, [(0, 0, 5), (9, 0, 5), (0, 0, -5), (0, 0, 0)], "VISIBLE OUTSIDE BEHIND BEHIND"),
        # The polynomial of this camera model folds where 1 - 0.9 r² is 0: 46.5 degrees off the axis.
        (BARREL, [at_angle(45), (0, 9, 9), at_angle(48), at_angle(100)], "VISIBLE OUTSIDE BEHIND BEHIND"),
        # 320 px from the centre are 122 degrees; the camera model has pixels for all directions.
        (
            WIDE,
            [at_angle(60), at_angle(110), at_angle(130), at_angle(179)],
            "VISIBLE VISIBLE OUTSIDE OUTSIDE",
        ),
        (PINHOLE, [(math.nan, 0, 5), (0, math.inf, 5), (0, 0, 3)], "BEHIND BEHIND VISIBLE"),
        (PINHOLE, [], ""),
    ],
)
def test_each_point_is_distinguished_from_what_the_camera_model_can_see(camera, points, expected):
    _, observations = observations_of(np.array(points, float).reshape(-1, 3), camera)
    assert observations.dtype == np.uint8
    assert [PointVisibility(visibility).name for visibility in observations] == expected.split()


def test_what_stands_behind_a_nearer_wall_is_hidden():
    across = np.mgrid[-0.5:0.5:0.02, -0.5:0.5:0.02].reshape(2, -1).T
    near, far = np.column_stack([across * 5, np.full(len(across), 5.0)]), [(0.01, 0.01, 30.0)]
    _, observations = observations_of(np.concatenate([near, far]), PINHOLE)
    assert observations[-1] == PointVisibility.HIDDEN
    assert (observations[:-1] != PointVisibility.HIDDEN).all()


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize("camera", [PINHOLE, BARREL, WIDE], ids=lambda camera: camera.model)
def test_observations_agree_with_the_points_in_the_image(camera, enabled):
    points = np.random.default_rng(3).normal(size=(20_000, 3)) * [5, 5, 5]
    view, observations = observations_of(points, camera, enabled=enabled)
    np.testing.assert_array_equal(np.flatnonzero(observations <= PointVisibility.HIDDEN), view.point_ids)
    np.testing.assert_array_equal(
        np.flatnonzero(observations == PointVisibility.VISIBLE), view.point_ids[view.visible]
    )
    assert len(np.unique(observations)) == (3 if camera is WIDE else 4)
