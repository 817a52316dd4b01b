"""A calibration that is wrong, reported by boxes that are made up."""

from dataclasses import replace

import cv2
import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.detections import DetectionPair
from sceneloom.detections.residuals import BoxResiduals
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D, Boxes3D

CAMERA_MODEL = (-0.12, 0.03, 5e-4, -3e-4, -2e-3)
CAMERA = Camera("brown_conrady", 1242, 375, 720.0, 721.0, 610.0, 173.0, CAMERA_MODEL)
LOOKING = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CAMERA_FROM_LIDAR = RigidTransform(LOOKING, np.array([0.05, -0.1, -0.3]))
SIZE = np.array([4.2, 1.8, 1.5])


def shown(center):
    """The corners of a car that heads along x, bounded, by OpenCV."""
    points = CAMERA_FROM_LIDAR.apply(center + CORNER_SIGNS * SIZE / 2)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(CAMERA_MODEL))[0][:, 0] + 0.5
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def pairs(rotation_deg, *, count=40, seed=3):
    """Images of cars whose sweeps are taken with a camera that is rotated from where it is stated to be."""
    generator = np.random.default_rng(seed)
    rotation = RigidTransform(cv2.Rodrigues(np.radians(rotation_deg))[0], np.zeros(3))
    for _ in range(count):
        ahead = generator.uniform(12.0, 40.0, 5)
        centers = np.column_stack([ahead, ahead * generator.uniform(-0.6, 0.6, 5), generator.uniform(-1, 0, 5)])
        noisy = centers + 0.1 * generator.normal(size=(5, 3))
        corners = np.array([shown(center) for center in centers]) + generator.normal(size=(5, 4))
        # a false box in each, and one car that the camera does not find
        corners[0] = [700.0, 150.0, 790.0, 200.0]
        three = Boxes3D(0, noisy, np.tile(SIZE, (5, 1)), np.zeros(5), np.ones(5), ("Car",) * 5)
        two = Boxes2D(0, corners, np.ones(5), ("car",) * 5)
        yield DetectionPair(three, two, CAMERA, rotation @ CAMERA_FROM_LIDAR)


def reported(rotation_deg, **more):
    residuals = BoxResiduals()
    for pair in pairs(np.array(rotation_deg, np.float64), **more):
        residuals.add(pair)
    return residuals


def test_a_rotation_is_found_and_reported_and_a_right_calibration_is_not():
    for rotation in [(2.0, 0, 0), (0, -2.0, 0), (0, 0, 2.5), (1.2, 1.2, -1.2)]:
        residuals = reported(rotation)
        # 200 cars, each known to a pixel or a tenth of a degree; about the axis of visibility ten times worse
        np.testing.assert_allclose(np.degrees(residuals.rotation().rotation), -np.array(rotation), atol=0.3)
        (warning,) = residuals.warnings("front")
        assert warning.location == "front"
    for rotation in [(0, 0, 0), (0.3, -0.3, 0)]:
        residuals = reported(rotation)
        assert np.degrees(np.linalg.norm(residuals.rotation().rotation)) < 0.8
        assert residuals.warnings("front") == []


def test_what_is_stated_for_its_uncertainty_is_how_rotates_scatter():
    rotations = [reported((0.5, -0.5, 1.0), count=20, seed=seed).rotation() for seed in range(12)]
    injected = -np.radians([0.5, -0.5, 1.0])
    errors = np.array([found.rotation - injected for found in rotations])
    # what bounded boxes have in common is not chance, and not in the covariance
    errors -= errors.mean(axis=0)
    stated = np.sqrt(np.mean([np.diag(found.covariance) for found in rotations], axis=0))
    # twelve drives report a deviation to a fifth, and twenty blocks another fifth
    assert (np.abs(np.log(errors.std(axis=0) / stated)) < np.log(2.0)).all()
    assert all(found.agreeing > 5 * found.by_chance and found.images == 20 for found in rotations)


def test_boxes_that_are_few_or_of_other_objects_state_nothing():
    assert reported((2.0, 0, 0), count=2).warnings("front") == []
    residuals = BoxResiduals()
    for pair in pairs(np.zeros(3), count=3):
        two = pair.boxes_2d
        residuals.add(replace(pair, boxes_2d=Boxes2D.empty(0)))
        residuals.add(replace(pair, boxes_2d=replace(two, labels=("pedestrian",) * len(two))))
    assert residuals.rotation() is None
    residuals, shown = BoxResiduals(), list(pairs(np.zeros(3)))
    for pair, other in zip(shown, shown[20:] + shown[:20], strict=True):
        residuals.add(replace(pair, boxes_2d=other.boxes_2d))
    found = residuals.rotation()
    assert found is None or found.agreeing < max(40, 2 * found.by_chance)
