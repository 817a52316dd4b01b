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
    pixels = rows[:, :2].copy()
    # The camera looks along x of the world, its x to the right: -y.
    pose = RigidTransform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
    return FusedView(
        camera_id, Camera("pinhole", width, height, 100.0, 100.0, (width - 1) / 2, (height - 1) / 2), 12_345_678_901,
        pose, np.full((height, width, 3), level, np.uint8), np.arange(len(rows), dtype=np.int64), pixels,
        pixel_numbers(pixels, width, height), rows[:, 2].copy(), visible, depth_image, np.zeros((len(rows), 3)),
    )  # fmt: skip


@pytest.fixture(scope="session")
def make_view():
    """Makes views."""
    return _make_view
