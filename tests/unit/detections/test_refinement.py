"""Boxes sharpened by their partners, against Kalman's update in the form with inverses and OpenCV's slopes."""

import cv2
import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.detections.projection import project_outlines, refine
from sceneloom.detections.results import NO_BOX
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform

CAMERA_MODEL = (-0.12, 0.03, 5e-4, -3e-4, -2e-3)
CAMERA = Camera("brown_conrady", 1242, 375, 720.0, 721.0, 610.0, 173.0, CAMERA_MODEL)
CAMERA_FROM_LIDAR = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.05, -0.1, -0.3])
)
MIDDLE_SIGMAS, HEIGHT_SIGMAS = (2.0, 0.03), (2.0, 0.06)
SIGMAS = np.tile([*MIDDLE_SIGMAS, *MIDDLE_SIGMAS, *HEIGHT_SIGMAS], (2, 1))
CENTER, SIZE, YAW = np.array([30.0, 4.0, -0.8]), np.array([4.2, 1.8, 1.5]), 0.5
COVARIANCE = np.diag([0.3, 0.25, 0.2, 0.3, 0.15, 0.12]) ** 2


def bounds(state, yaw=YAW):
    """Left, top, right and bottom of the corners of a box, by OpenCV."""
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    corners = state[:3] + (CORNER_SIGNS * state[3:] / 2) @ rotation.T
    points = corners @ CAMERA_FROM_LIDAR.rotation.T + CAMERA_FROM_LIDAR.translation
    pixels = (
        cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(CAMERA_MODEL))[0][:, 0]
        + 0.5
    )
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def reported(box_xyxy):
    left, top, right, bottom = box_xyxy
    return np.array([(left + right) / 2, (top + bottom) / 2, bottom - top])


def sharpened(center, partner, covariance=COVARIANCE):
    """A box after its update, the second of two boxes whose first has no partner."""
    boxes = np.tile(np.hstack([center, SIZE, YAW]), (2, 1))
    covariances = np.array([COVARIANCE, covariance])
    outlines = project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes)
    partners = np.array([NO_BOX, 0])
    refine(CAMERA, CAMERA_FROM_LIDAR, outlines, boxes, covariances, partners, partner[None].copy(), SIGMAS)
    np.testing.assert_array_equal(boxes[0], np.hstack([center, SIZE, YAW]))
    np.testing.assert_array_equal(covariances[0], COVARIANCE)
    assert boxes[1, 6] == YAW
    return boxes[1, :6], covariances[1]


def test_the_update_is_that_of_the_information_form():
    before = np.concatenate([CENTER, SIZE])
    partner = bounds(before) + np.array([1.5, -0.8, 2.4, 0.9])
    step = 1e-4
    slopes = np.column_stack(
        [
            (reported(bounds(before + step * e)) - reported(bounds(before - step * e))) / (2 * step)
            for e in np.eye(6)
        ]
    )
    wide, high = partner[2:] - partner[:2]
    noise = np.array(
        [
            MIDDLE_SIGMAS[0] + MIDDLE_SIGMAS[1] * wide,
            MIDDLE_SIGMAS[0] + MIDDLE_SIGMAS[1] * high,
            HEIGHT_SIGMAS[0] + HEIGHT_SIGMAS[1] * high,
        ]
    )
    information = np.linalg.inv(COVARIANCE) + slopes.T @ np.diag(noise**-2) @ slopes
    expected = np.linalg.inv(information)
    residual = reported(partner) - reported(bounds(before))
    state, covariance = sharpened(CENTER, partner)
    # slopes by differences of OpenCV's pixels are good to six digits
    np.testing.assert_allclose(covariance, expected, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(state, before + expected @ slopes.T @ np.diag(noise**-2) @ residual, rtol=1e-6)


def test_a_partner_that_is_elsewhere_changes_nothing():
    partner = bounds(np.concatenate([CENTER, SIZE])) + np.array([60.0, 40.0, 60.0, 80.0])
    state, covariance = sharpened(CENTER, partner)
    np.testing.assert_array_equal(state, np.concatenate([CENTER, SIZE]))
    np.testing.assert_array_equal(covariance, COVARIANCE)


def test_what_the_border_cuts_reports_only_of_the_other_direction():
    # the left side of this car is out of the image
    center = np.array([20.0, 17.5, -0.8])
    partner = np.array([0.0, *bounds(np.concatenate([center, SIZE]))[1:]])
    assert partner[2] > 10.0
    _, covariance = sharpened(center, partner)
    ahead, aside, up = np.diagonal(COVARIANCE)[:3] - np.diagonal(covariance)[:3]
    assert up > 0.3 * COVARIANCE[2, 2]
    assert aside < 0.05 * COVARIANCE[1, 1]
    assert ahead < 0.05 * COVARIANCE[0, 0]


def test_a_box_that_reaches_behind_the_camera_stays_as_it_is():
    center = np.array([0.5, 2.5, -0.8])
    state, covariance = sharpened(center, np.array([100.0, 100.0, 300.0, 300.0]))
    np.testing.assert_array_equal(state[:3], center)
    np.testing.assert_array_equal(covariance, COVARIANCE)


def test_errors_are_as_large_as_the_covariance_says():
    generator = np.random.default_rng(4)
    truth = np.concatenate([CENTER, SIZE])
    box = bounds(truth)
    wide, high = box[2:] - box[:2]
    squares = []
    for _ in range(400):
        start = generator.multivariate_normal(truth, COVARIANCE)[:3]
        # errors of the middle of the image's box, none of its size: sizes are right to begin with
        shift = generator.normal(size=2) * (MIDDLE_SIGMAS[0] + MIDDLE_SIGMAS[1] * np.array([wide, high]))
        state, covariance = sharpened(start, box + np.tile(shift, 2))
        error = state[:3] - CENTER
        squares.append(error @ np.linalg.solve(covariance[:3, :3], error))
    # three degrees of freedom; sizes without error make it smaller
    assert np.mean(squares) == pytest.approx(3.0, abs=0.6)
