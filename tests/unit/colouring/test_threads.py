"""What comes out is the same, whoever does the work."""

import math

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import LidarTrajectory, ViewRequest, VisibilitySettings, fuse_by_projection
from sceneloom.geometry.rigid import RigidTransform

CAMERA = Camera("brown_conrady", 320, 200, 200.0, 200.0, 159.5, 99.5, (-0.1, 0.02, 5e-4, -3e-4, 1e-3, 0.05))
COUNT = 30_000  # enough for threads to share them


def cloud():
    """Two walls behind each other, rough, the nearer one with holes; some points behind the camera, some nowhere."""
    random = np.random.default_rng(5)
    x, y = random.uniform(-8, 8, (2, COUNT))
    z = np.where(random.random(COUNT) < 0.5, 20.0, 9.0) + random.normal(scale=0.02, size=COUNT)
    points = np.stack([x, y, z], axis=1)
    points[::50] *= -1
    points[::77] = math.nan
    return points


def request(number):
    rotated = RigidTransform.from_quaternion(
        np.array([0.1 * number, 0, 0]), np.array([0, math.sin(number / 20), 0, math.cos(number / 20)])
    )
    rgb = np.random.default_rng(number).integers(0, 255, (200, 320, 3), np.uint8)
    return ViewRequest(
        camera_id=f"camera {number}",
        camera_index=number,
        camera=CAMERA,
        timestamp_ns=0,
        world_from_camera=rotated,
        rgb=rgb,
    )


@pytest.mark.parametrize("images", [1, 2, 5])
@pytest.mark.parametrize("threads", [2, 3])
@pytest.mark.parametrize("known_trajectory", [False, True])
@pytest.mark.parametrize("enabled", [False, True])
def test_fusion_gives_the_same_to_the_bit_with_any_number_of_threads(
    images, threads, known_trajectory, enabled
):
    points = cloud()
    trajectory = LidarTrajectory(
        np.array([[0, -0.8, 0], [0.2, -0.8, 0.1]]), np.linspace(0, 1, COUNT, dtype=np.float32)
    )
    alone, shared = (
        fuse_by_projection(
            points,
            [request(number) for number in range(images)],
            VisibilitySettings(enabled=enabled, threads=size),
            trajectory=trajectory if known_trajectory else None,
        )
        for size in (1, threads)
    )
    np.testing.assert_array_equal(shared.colors, alone.colors)
    np.testing.assert_array_equal(shared.camera_index, alone.camera_index)
    for one, other in zip(shared.views, alone.views, strict=True):
        assert one.camera_id == other.camera_id
        for name in ("point_ids", "pixels", "depths", "visible", "depth_image"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    hidden = np.mean([1 - view.visible.mean() for view in alone.views])
    assert 0.05 < hidden < 0.95
