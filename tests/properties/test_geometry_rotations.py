"""The axioms of rotations and rigid transforms hold for whatever numbers come."""

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sceneloom.geometry.boxes import box_corners, points_in_box
from sceneloom.geometry.euler import ORDERS, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import (
    RigidTransform,
    angle_between,
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
    normalise_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_vector_from_quaternion,
    slerp,
)

ROUNDING = 1e-14
components = st.floats(-1, 1, allow_subnormal=False)


@st.composite
def quaternions(draw: st.DrawFn) -> np.ndarray:
    """Unit quaternions, also with components of very different sizes."""
    raw = draw(arrays(np.float64, 4, elements=components))
    assume(np.abs(raw).max() > 1e-100)
    return normalise_quaternion(raw)


@st.composite
def transforms(draw: st.DrawFn) -> RigidTransform:
    position = draw(arrays(np.float64, 3, elements=st.floats(-1000, 1000)))
    return RigidTransform.from_quaternion(position, draw(quaternions()))


vectors = arrays(np.float64, (4, 3), elements=st.floats(-1000, 1000))


@given(quaternions(), quaternions(), vectors)
def test_a_product_rotates_like_its_factors_one_after_the_other(a, b, points):
    both = rotate_vectors(multiply_quaternions(a, b), points)
    assert np.allclose(both, rotate_vectors(a, rotate_vectors(b, points)), atol=1000 * ROUNDING)


@given(quaternions(), quaternions(), quaternions())
def test_products_are_associative(a, b, c):
    left = multiply_quaternions(multiply_quaternions(a, b), c)
    assert np.allclose(left, multiply_quaternions(a, multiply_quaternions(b, c)), atol=ROUNDING)


@given(quaternions())
def test_a_rotation_and_its_conjugate_cancel(a):
    assert np.allclose(multiply_quaternions(a, conjugate_quaternion(a)), [0, 0, 0, 1], atol=ROUNDING)


@given(quaternions(), vectors)
def test_rotations_keep_lengths_and_agree_with_their_matrices(a, points):
    rotated = rotate_vectors(a, points)
    assert np.allclose(np.linalg.norm(rotated, axis=1), np.linalg.norm(points, axis=1), atol=1000 * ROUNDING)
    assert np.allclose(rotated, points @ matrix_from_quaternion(a).T, atol=1000 * ROUNDING)


@given(quaternions())
def test_matrices_and_rotation_vectors_give_the_rotation_back(a):
    assert angle_between(quaternion_from_matrix(matrix_from_quaternion(a)), a) < 10 * ROUNDING
    assert angle_between(quaternion_from_rotation_vector(rotation_vector_from_quaternion(a)), a) < 10 * ROUNDING


@given(quaternions())
def test_a_rotation_is_its_own_nearest_rotation(a):
    matrix = matrix_from_quaternion(a)
    found, error = nearest_rotation(matrix)
    assert np.abs(found - matrix).max() < ROUNDING
    assert error < ROUNDING


@given(quaternions(), quaternions(), st.floats(0, 1))
def test_slerp_shares_the_angle_in_the_given_proportion(a, b, fraction):
    whole, part = angle_between(a, b), slerp(a, b, fraction)
    assume(whole < np.pi - 1e-6)  # at half a rotation there are two shortest ways
    assert abs(angle_between(a, part) - fraction * whole) < 10 * ROUNDING
    assert abs(angle_between(part, b) - (1 - fraction) * whole) < 10 * ROUNDING


@given(transforms(), transforms(), vectors)
def test_rigid_transforms_form_a_group(a, b, points):
    size = 1e4 * ROUNDING  # coordinates of some thousand metres
    assert np.allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=size)
    assert np.allclose((a @ b).inverse().apply(points), (b.inverse() @ a.inverse()).apply(points), atol=size)
    assert np.allclose(a.inverse().apply(a.apply(points)), points, atol=size)
    assert np.allclose((a @ RigidTransform.identity()).matrix, a.matrix, atol=size)


@given(quaternions(), st.sampled_from(ORDERS), st.sampled_from(["degrees", "radians"]))
def test_cuboid_angles_give_the_rotation_back(a, order, unit):
    matrix = matrix_from_quaternion(a)
    angles = cuboid_angles_from_rotation(matrix, unit=unit, order=order)
    assert np.allclose(rotation_from_cuboid_angles(angles, unit=unit, order=order), matrix, atol=ROUNDING)


@given(transforms(), arrays(np.float64, 3, elements=st.floats(0.1, 30)))
def test_boxes_hold_points_towards_their_corners_and_none_beyond_them(pose, size):
    corners = box_corners(pose.translation, size, pose.quaternion_xyzw)
    inside, outside = (pose.translation + s * (corners - pose.translation) for s in (0.999, 1.001))
    assert points_in_box(inside, pose.translation, size, pose.quaternion_xyzw).all()
    assert not points_in_box(outside, pose.translation, size, pose.quaternion_xyzw).any()


@settings(max_examples=50)
@given(
    arrays(np.float64, 3, elements=st.floats(-5e4, 5e4)),
    st.tuples(st.floats(-90, 90), st.floats(-180, 180), st.floats(-400, 9000)),
)
def test_offsets_east_north_and_up_give_their_location_back(enu, origin):
    # Degrees of 1e-14 relative rounding are 1e-8 m on the ground; longitudes lose nothing near the poles, since
    # there a wrong longitude is a small distance.
    assert np.abs(enu_from_geodetic(geodetic_from_enu(enu, origin), origin) - enu).max() < 3e-8
