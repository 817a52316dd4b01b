"""Detection fusion by projection, on scenes whose answer is known."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.detections import DetectionPair
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import NO_BOX
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D, Boxes3D

CAMERA = Camera("pinhole", 1000, 600, 500.0, 500.0, 499.5, 299.5)
CAMERA_FROM_LIDAR = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3)
)
CAR = (4.0, 2.0, 1.6)


def boxes_3d(*rows, labels=None, **more):
    """Boxes of cars that head along x: x, y, z and score of each."""
    numbers = np.array(rows, np.float64).reshape(-1, 4)
    count = len(numbers)
    return Boxes3D(
        7,
        numbers[:, :3],
        np.tile(CAR, (count, 1)),
        np.zeros(count),
        numbers[:, 3],
        labels or ("Car",) * count,
        **more,
    )


def boxes_2d(*rows, labels=None):
    """Boxes in the picture: left, top, right, bottom and score of each."""
    numbers = np.array(rows, np.float64).reshape(-1, 5)
    return Boxes2D(9, numbers[:, :4], numbers[:, 4], labels or ("car",) * len(numbers))


def outline(x, y, z):
    """What a pinhole shows of a car that heads along x: the nearer face bounds it, or the farther one on its side."""
    corners = np.array(
        [[x + i * 2.0, y + j * 1.0, z + k * 0.8] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
    )
    u = 500.0 - 500.0 * corners[:, 1] / corners[:, 0]
    v = 300.0 - 500.0 * corners[:, 2] / corners[:, 0]
    return u.min(), v.min(), u.max(), v.max()


def fused(three, two):
    return fuse_by_projection(DetectionPair(three, two, CAMERA, CAMERA_FROM_LIDAR))


def test_boxes_of_both_detectors_become_one_object_whose_existence_multiplies_the_odds():
    three = boxes_3d((20, 3, -1, 0.6), (30, -5, -1, 0.7))
    two = boxes_2d((*outline(30, -5, -1), 0.8), (*outline(20, 3, -1), 0.5))
    result = fused(three, two)
    assert result.rows_3d.tolist() == [0, 1]
    assert result.rows_2d.tolist() == [1, 0]
    assert np.array_equal(result.corners_xyxy, two.corners_xyxy[[1, 0]])
    odds = np.array([0.6 / 0.4 * 1.0, 0.7 / 0.3 * 0.8 / 0.2]) / (0.1 / 0.9)
    assert np.allclose(result.scores, odds / (1 + odds), rtol=1e-12)


@pytest.mark.parametrize("count_3d", [0, 2])
@pytest.mark.parametrize("count_2d", [0, 2])
def test_missing_boxes_on_either_side_are_no_fault(count_3d, count_2d):
    three = boxes_3d(*[(20, 3, -1, 0.6), (30, -5, -1, 0.7)][:count_3d])
    two = boxes_2d(*[(10, 10, 60, 60, 0.5), (900, 10, 990, 90, 0.5)][:count_2d])
    result = fused(three, two)
    assert len(result) == count_3d + count_2d
    assert np.count_nonzero(result.rows_3d == NO_BOX) == count_2d
    assert np.count_nonzero(result.rows_2d == NO_BOX) == count_3d
    assert len(set(result.ids.tolist())) == len(result)


def test_a_box_behind_the_camera_is_kept_as_it_is():
    result = fused(boxes_3d((-20, 3, -1, 0.6)), boxes_2d())
    assert result.scores[0] == pytest.approx(0.6, rel=1e-12)
    assert not result.corners_xyxy.any()
