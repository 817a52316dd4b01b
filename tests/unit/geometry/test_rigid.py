"""Rigid transforms: frames chain as their names state, and what is not rigid is refused."""

import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import CalibrationError
from sceneloom.geometry.rigid import RigidTransform

ROTATION = Rotation.from_rotvec([0.3, -0.2, 1.0])
WORLD_FROM_EGO = RigidTransform(ROTATION.as_matrix(), np.array([10.0, 20.0, 0.5]))
EGO_FROM_LIDAR = RigidTransform.from_quaternion(np.array([0.0, 0, 2]), np.array([0.0, 0, 0.1, 1]))
POINTS = np.random.default_rng(0).normal(size=(7, 3))


def test_points_are_rotated_then_moved():
    expected = np.add(ROTATION.apply(POINTS), [10, 20, 0.5])
    assert np.allclose(WORLD_FROM_EGO.apply(POINTS), expected, atol=1e-14)


def test_directions_are_rotated_only():
    assert np.allclose(WORLD_FROM_EGO.rotate(POINTS), ROTATION.apply(POINTS), atol=1e-14)


def test_frames_chain_as_their_names_state():
    world_from_lidar = WORLD_FROM_EGO @ EGO_FROM_LIDAR
    assert np.allclose(world_from_lidar.apply(POINTS), WORLD_FROM_EGO.apply(EGO_FROM_LIDAR.apply(POINTS)))
    assert np.allclose(world_from_lidar.matrix, WORLD_FROM_EGO.matrix @ EGO_FROM_LIDAR.matrix)


def test_the_inverse_undoes():
    assert np.allclose((WORLD_FROM_EGO.inverse() @ WORLD_FROM_EGO).matrix, np.eye(4), atol=1e-14)
    np.testing.assert_array_equal(WORLD_FROM_EGO.inverse_matrix, WORLD_FROM_EGO.inverse().matrix)


def test_the_identity_changes_nothing():
    assert np.array_equal(RigidTransform.identity().apply(POINTS), POINTS)


def test_position_and_quaternion_give_it_back():
    again = RigidTransform.from_quaternion(WORLD_FROM_EGO.translation, WORLD_FROM_EGO.quaternion_xyzw)
    assert np.allclose(again.matrix, WORLD_FROM_EGO.matrix, atol=1e-14)


def test_a_rounded_matrix_becomes_rigid_and_its_error_is_reported():
    rounded = np.round(WORLD_FROM_EGO.matrix, 4)
    found, error = RigidTransform.nearest(rounded)
    assert 1e-6 < error < 1e-3
    assert np.abs(found.matrix - WORLD_FROM_EGO.matrix).max() < 1e-4  # half a unit of the fourth decimal, some
    assert np.array_equal(found.translation, rounded[:3, 3])


def test_three_rows_are_enough():
    found, error = RigidTransform.nearest(WORLD_FROM_EGO.matrix[:3])
    assert np.allclose(found.matrix, WORLD_FROM_EGO.matrix, atol=1e-14)
    assert error < 1e-14


def test_a_mirrored_matrix_has_an_infinite_error():
    assert RigidTransform.nearest(np.diag([1.0, -1, 1, 1]))[1] == np.inf


@pytest.mark.parametrize(
    ("matrix", "message"),
    [(np.eye(3), "4x4 or 3x4"), (np.full((4, 4), np.inf), "finite"), (WORLD_FROM_EGO.matrix.T, "last row")],
)
def test_what_cannot_be_read_as_a_rigid_matrix_is_refused(matrix, message):
    with pytest.raises(CalibrationError, match=message):
        RigidTransform.nearest(matrix)


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [
        (1.00001 * np.eye(3), np.zeros(3)),
        (np.diag([1.0, 1, -1]), np.zeros(3)),
        (np.full((3, 3), np.nan), np.zeros(3)),
        (np.eye(3), np.array([0, np.nan, 0])),
    ],
)
def test_what_is_not_rigid_is_refused(rotation, translation):
    with pytest.raises(CalibrationError, match="orthonormal right-handed"):
        RigidTransform(rotation, translation)


def test_its_numbers_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        WORLD_FROM_EGO.translation[0] = 1.0


def test_it_travels_between_processes():
    assert np.array_equal(pickle.loads(pickle.dumps(WORLD_FROM_EGO)).matrix, WORLD_FROM_EGO.matrix)
