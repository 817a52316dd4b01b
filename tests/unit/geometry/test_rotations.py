"""Rotations against scipy, against hand-written truths, and where digits are easily lost."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sceneloom.errors import ArrayError, CalibrationError
from sceneloom.geometry.rigid import (
    angle_between,
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_vector_from_quaternion,
    slerp,
)

ROUNDING = 1e-14  # some tens of operations on numbers of size 1, each rounded by 1e-16
QUARTER_ROTATION_LEFT = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))


@pytest.fixture(scope="module")
def quaternions() -> np.ndarray:
    """Random rotations, and rotates by half a circle or nearly none, where formulas lose their digits."""
    axes = np.vstack([np.eye(3), np.random.default_rng(1).normal(size=(20, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = [0.0, 1e-12, 1e-6, 1.0, np.pi - 1e-8, np.pi]
    special = [np.append(axis * np.sin(a / 2), np.cos(a / 2)) for axis in axes for a in angles]
    return np.vstack([np.random.default_rng(0).normal(size=(300, 4)), special])


def same_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Largest difference of components, whichever of q and -q was chosen."""
    return np.minimum(np.abs(a - b).max(axis=-1), np.abs(a + b).max(axis=-1))


def test_a_quarter_rotation_left_takes_forward_to_left():
    forward, left = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    assert np.allclose(rotate_vectors(QUARTER_ROTATION_LEFT, forward), left, atol=ROUNDING)
    assert np.allclose(matrix_from_quaternion(QUARTER_ROTATION_LEFT) @ forward, left, atol=ROUNDING)


def test_matrices_are_those_of_scipy(quaternions):
    expected = Rotation.from_quat(quaternions).as_matrix()
    assert np.abs(matrix_from_quaternion(quaternions) - expected).max() < ROUNDING


def test_matrices_give_their_quaternion_back_with_positive_w(quaternions):
    unit = Rotation.from_quat(quaternions).as_quat()
    found = quaternion_from_matrix(Rotation.from_quat(quaternions).as_matrix())
    assert same_rotation(found, unit).max() < ROUNDING
    assert (found[:, 3] >= 0).all()


def test_rotating_vectors_agrees_with_scipy_for_quaternions_of_any_length(quaternions):
    vectors = np.random.default_rng(2).normal(size=(len(quaternions), 3))
    expected = Rotation.from_quat(quaternions).apply(vectors)
    assert np.abs(rotate_vectors(quaternions, vectors) - expected).max() < ROUNDING


def test_one_quaternion_rotates_many_vectors_and_many_rotate_one():
    vectors = np.random.default_rng(3).normal(size=(5, 3))
    rotations = np.random.default_rng(4).normal(size=(5, 4))
    assert np.allclose(
        rotate_vectors(QUARTER_ROTATION_LEFT, vectors)[3], rotate_vectors(QUARTER_ROTATION_LEFT, vectors[3])
    )
    assert np.allclose(rotate_vectors(rotations, vectors[0])[4], rotate_vectors(rotations[4], vectors[0]))


def test_products_are_those_of_scipy(quaternions):
    a, b = Rotation.from_quat(quaternions), Rotation.from_quat(quaternions[::-1])
    found = multiply_quaternions(a.as_quat(), b.as_quat())
    assert same_rotation(found, (a * b).as_quat()).max() < ROUNDING


def test_conjugates_are_the_inverses_of_scipy(quaternions):
    rotations = Rotation.from_quat(quaternions)
    assert same_rotation(conjugate_quaternion(rotations.as_quat()), rotations.inv().as_quat()).max() < ROUNDING


def test_rotation_vectors_are_those_of_scipy(quaternions):
    rotations = Rotation.from_quat(quaternions)
    expected, found = rotations.as_rotvec(), rotation_vector_from_quaternion(quaternions)
    half_rotations = np.abs(np.linalg.norm(expected, axis=1) - np.pi) < 1e-7  # there v and -v are one rotation
    assert np.abs(found - expected)[~half_rotations].max() < ROUNDING
    back = quaternion_from_rotation_vector(found)
    assert same_rotation(back, rotations.as_quat()).max() < ROUNDING


def test_tiny_rotation_vectors_keep_all_their_digits():
    vector = np.array([3e-200, -4e-200, 0.0])
    assert np.allclose(rotation_vector_from_quaternion(quaternion_from_rotation_vector(vector)), vector, rtol=1e-14)


def test_slerp_is_that_of_scipy_inside_and_beyond_both_ends(quaternions):
    a, b = quaternions[:150], quaternions[150:300]
    for fraction in (0.0, 1e-9, 0.3, 0.999, 1.0):
        expected = [Slerp([0, 1], Rotation.from_quat([p, q]))(fraction).as_quat() for p, q in zip(a, b, strict=True)]
        # scipy goes through rotation vectors, which cost it some digits for rotates of nearly half a circle
        assert angle_between(slerp(a, b, fraction), np.array(expected)).max() < 1e-12
    beyond = slerp([0, 0, 0, 1], QUARTER_ROTATION_LEFT, [-1.0, 2.0])
    expected = Rotation.from_euler("z", [[-90], [180]], degrees=True).as_quat()
    assert same_rotation(beyond, expected).max() < ROUNDING


def test_slerp_takes_the_shorter_arc_whatever_the_signs():
    near = np.array([0.0, 0.0, np.sin(0.1), np.cos(0.1)])
    halfway = np.array([0.0, 0.0, np.sin(0.05), np.cos(0.05)])
    for sign in (1, -1):
        assert same_rotation(slerp([0, 0, 0, 1], sign * near, 0.5), halfway) < ROUNDING


@pytest.mark.parametrize("angle", [0.0, 1e-100, 1e-12, np.pi - 1e-12, np.pi])
def test_slerp_rotates_at_constant_speed_near_no_rotation_and_near_half_a_rotation(angle):
    start, stop = quaternion_from_rotation_vector([[0.0, 0, 0], [0, angle, 0]])
    rotated = angle_between(start, slerp(start, stop, np.linspace(0, 1, 11)))
    assert np.allclose(rotated, np.linspace(0, angle, 11), rtol=1e-12, atol=ROUNDING * angle)


def test_angles_between_rotations_keep_their_digits_where_the_arc_cosine_does_not():
    start, stop = quaternion_from_rotation_vector([[0.0, 0, 0], [1e-12, 0, 0]])
    assert angle_between(start, stop) == pytest.approx(1e-12, rel=1e-3)  # the quaternion's own rounding
    assert angle_between(start, -start) == 0.0


def test_a_rounded_rotation_is_brought_back_and_its_error_reported():
    rotation = Rotation.from_euler("xyz", [0.1, -0.4, 2.0]).as_matrix()
    rounded = np.round(rotation, 3)
    found, error = nearest_rotation(rounded)
    assert np.abs(found @ found.T - np.eye(3)).max() < ROUNDING
    assert np.linalg.det(found) == pytest.approx(1.0)
    assert error == pytest.approx(np.abs(rounded @ rounded.T - np.eye(3)).max())
    assert np.abs(found - rotation).max() < 1e-3  # no farther from the truth than the rounding took it


def test_the_nearest_rotation_is_nearer_than_its_neighbours():
    matrix = Rotation.from_rotvec([0.3, 0.2, -1]).as_matrix() + 0.05 * np.random.default_rng(5).normal(size=(3, 3))
    found, _ = nearest_rotation(matrix)
    for step in np.vstack([np.eye(3), -np.eye(3)]) * 1e-4:
        neighbour = found @ Rotation.from_rotvec(step).as_matrix()
        assert np.linalg.norm(matrix - found) < np.linalg.norm(matrix - neighbour)


def test_a_mirror_is_no_rotation_however_orthonormal_it_is():
    found, error = nearest_rotation(np.diag([1.0, 1.0, -1.0]))
    assert error == np.inf
    assert np.linalg.det(found) == pytest.approx(1.0)


@pytest.mark.parametrize("matrix", [np.full((3, 3), np.nan), np.eye(4), [[1, 2], [3, 4]]])
def test_what_is_no_matrix_of_finite_numbers_is_refused(matrix):
    with pytest.raises(CalibrationError, match="expected 3x3 finite numbers"):
        nearest_rotation(matrix)


@pytest.mark.parametrize("function", [matrix_from_quaternion, rotation_vector_from_quaternion])
def test_a_zero_quaternion_is_refused(function):
    with pytest.raises(ArrayError, match="expected a rotation"):
        function([[0, 0, 0, 1], [0, 0, 0, 0]])


def test_a_quaternion_of_three_numbers_is_refused():
    with pytest.raises(ArrayError, match=r"expected \(\.\.\., 4\)"):
        matrix_from_quaternion([0, 0, 1])


def test_missing_rotations_stay_missing_without_a_warning():
    missing = np.full((2, 4), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(rotate_vectors(missing, [1.0, 2, 3])).all()
        assert np.isnan(multiply_quaternions(missing, QUARTER_ROTATION_LEFT)).all()
        assert np.isnan(slerp(missing, QUARTER_ROTATION_LEFT, 0.5)).all()


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_quaternions_of_extreme_length_are_normalised(scale):
    quaternion = scale * np.array(QUARTER_ROTATION_LEFT)
    assert np.allclose(matrix_from_quaternion(quaternion), matrix_from_quaternion(QUARTER_ROTATION_LEFT), atol=ROUNDING)
