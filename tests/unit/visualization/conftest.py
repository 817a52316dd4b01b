"""Views with points at known pixels and depths."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring.results import FusedView
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.projection import pixel_numbers

Points = Sequence[tuple[float, float, float, bool]]
MakeView = Callable[..., FusedView]


def _make_view(points, *, width=200, height=120, camera_id="front", level=100):
    """A view of points (u, v, depth, visible) over a plain grey image."""
    rows = np.array([point[:3] for point in points], np.float32).reshape(-1, 3)
    visible = np.array([point[3] for point in points], np.bool_)
    depth_image = np.zeros((height, width), np.float32)
    for u, v, depth in rows[visible]:
        depth_image[round(float(v)), round(float(u))] = depth
    return FusedView(
        camera_id=camera_id,
        camera=Camera("pinhole", width, height, 100.0, 100.0, (width - 1) / 2, (height - 1) / 2),
        timestamp_ns=12_345_678_901,
        # The camera looks along x of the world, its x to the right: -y.
        world_from_camera=RigidTransform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3)),
        rgb=np.full((height, width, 3), level, np.uint8),
        point_ids=np.arange(len(rows), dtype=np.int64),
        pixels=rows[:, :2].copy(),
        pixel_numbers=pixel_numbers(np.ascontiguousarray(rows[:, :2]), width, height),
        depths=rows[:, 2].copy(),
        visible=visible,
        depth_image=depth_image,
        points_world=np.zeros((len(rows), 3)),
    )


@pytest.fixture(scope="session")
def make_view():
    """Makes views."""
    return _make_view
