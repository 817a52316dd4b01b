"""Outlines of boxes, against OpenCV's projection of many points on them."""

import cv2
import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.detections.projection import boxes_with_area, boxes_with_position, project_outlines
from sceneloom.geometry.rigid import RigidTransform

CAMERA_MODEL = (-0.12, 0.03, 5e-4, -3e-4, -2e-3)
CAMERA = Camera("brown_conrady", 1242, 375, 720.0, 721.0, 610.0, 173.0, CAMERA_MODEL)
CAMERA_FROM_LIDAR = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.05, -0.1, -0.3])
)


def boxes_of(centers, sizes, yaws):
    return np.column_stack([np.asarray(v, np.float64) for v in (centers, sizes, yaws)])


def surface(center, size, yaw):
    """Points on the faces of a box, lidar frame."""
    along = np.linspace(-0.5, 0.5, 41)
    a, b = (grid.ravel() for grid in np.meshgrid(along, along))
    faces = [
        np.roll(np.column_stack([np.full(a.size, s), a, b]), k, axis=1) for s in (-0.5, 0.5) for k in range(3)
    ]
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return np.vstack(faces) * size @ rotation.T + center


def cv2_outline(points_lidar):
    points = points_lidar @ CAMERA_FROM_LIDAR.rotation.T + CAMERA_FROM_LIDAR.translation
    pixels = (
        cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(CAMERA_MODEL))[0][:, 0]
        + 0.5
    )
    seen = pixels[((pixels >= 0) & (pixels <= (CAMERA.width, CAMERA.height))).all(axis=1)]
    return np.concatenate([seen.min(axis=0), seen.max(axis=0)]) if len(seen) else np.zeros(4)


def test_outlines_bound_what_opencv_projects():
    generator = np.random.default_rng(1)
    centers = generator.uniform([9, -9, -1.5], [60, 9, 0.5], (60, 3))
    sizes, yaws = generator.uniform([1, 0.5, 1], [5, 2, 2], (60, 3)), generator.uniform(-3, 3, 60)
    found = project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes_of(centers, sizes, yaws)).corners_xyxy
    expected = [cv2_outline(surface(*box)) for box in zip(centers, sizes, yaws, strict=True)]
    whole = np.all((np.array(expected)[:, :2] > 2) & (np.array(expected)[:, 2:] < (1240, 373)), axis=1)
    assert whole.sum() > 30
    # edges are followed coarsely
    np.testing.assert_allclose(found[whole], np.array(expected)[whole], atol=0.3)
    # of what the border cuts, the points of the surface lie up to a grid's step within it
    np.testing.assert_allclose(found[~whole], np.array(expected)[~whole], atol=12.0)


def test_boxes_behind_or_around_the_camera_have_no_outline():
    outlines = project_outlines(
        CAMERA, CAMERA_FROM_LIDAR, boxes_of([[-20, 0, 0], [0.3, 0, 0]], [[4, 2, 1.5]] * 2, [0.3, 0.0])
    )
    assert not outlines.corners_xyxy.any()
    assert not outlines.seen_shares.any()


def test_a_box_that_reaches_behind_the_camera_is_cut_at_the_image():
    # a wall 2 m to the left, from 30 m behind to 30 m ahead: 720 / 29.7 px a metre at its far end
    outlines = project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes_of([[0, 2.5, 0]], [[60, 1, 2]], [0.0]))
    left, top, right, bottom = outlines.corners_xyxy[0]
    assert (left, bottom) == (0.0, pytest.approx(375.0))
    assert top == pytest.approx(0.0, abs=1e-6)
    assert right == pytest.approx(610.5 - 720 * 1.95 / 29.7, abs=0.3)  # the camera model bends it by less


def test_what_stands_behind_a_nearer_box_is_seen_less():
    # the same location in the image, twice as far and half covered: 1 m wide at 10 m hides 2 m at 20 m
    centers, sizes = [[10.3, 0.5, 0], [20.5, 0, 0]], [[0.001, 1, 4], [0.001, 2, 1]]
    boxes = boxes_of(centers, sizes, [0.0, 0.0])
    shares = project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes).seen_shares
    assert shares[1] == pytest.approx(0.5, abs=0.05)  # the camera model is 5 cm to the side
    doubtful = project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes, likely=np.array([0.4, 1.0])).seen_shares
    assert doubtful[1] == pytest.approx(0.8, abs=0.02)
    twice = boxes_of([[20.3, 0.5, 0], [20.5, 0, 0]], sizes, [0.0, 0.0])
    assert project_outlines(CAMERA, CAMERA_FROM_LIDAR, twice).seen_shares[1] == 1.0


ODD = (0.0, -1.0, np.nan, np.inf, -np.inf)


def test_boxes_have_a_location_where_all_numbers_are_finite_and_sizes_above_0():
    numbers = np.ones((1 + 7 * len(ODD), 7))
    for k, (column, value) in enumerate((column, value) for column in range(7) for value in ODD):
        numbers[k + 1, column] = value
    expected = np.isfinite(numbers).all(axis=1) & (numbers[:, 3:6] > 0).all(axis=1)
    parts = (np.ascontiguousarray(numbers[:, part]) for part in (slice(0, 3), slice(3, 6), 6))
    boxes, rows = boxes_with_position(*parts)
    np.testing.assert_array_equal(rows, np.flatnonzero(expected))
    np.testing.assert_array_equal(boxes, numbers[expected])
    assert 0 < expected.sum() < len(expected)


def test_boxes_have_an_area_where_all_edges_are_finite_and_in_order():
    corners = np.tile([10.0, 20, 30, 40], (1 + 4 * 6, 1))
    for k, (column, value) in enumerate((column, value) for column in range(4) for value in (*ODD, 30.0)):
        corners[k + 1, column] = value
    expected = np.isfinite(corners).all(axis=1) & (corners[:, 2:] > corners[:, :2]).all(axis=1)
    boxes, rows = boxes_with_area(corners)
    np.testing.assert_array_equal(rows, np.flatnonzero(expected))
    np.testing.assert_array_equal(boxes, corners[expected])
    assert 0 < expected.sum() < len(expected)
