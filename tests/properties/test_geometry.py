"""The axioms of rotations, rigid transforms and interpolated paths hold for whatever numbers come."""

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sceneloom.geometry import rigid

ROUNDING = 1e-14
components = st.floats(-1, 1, allow_subnormal=False)


@st.composite
def quaternions(draw):
    """Unit quaternions, also with components of very different sizes."""
    raw = draw(arrays(np.float64, 4, elements=components))
    assume(np.abs(raw).max() > 1e-100)
    return rigid.normalise_quaternion(raw)


@st.composite
def transforms(draw):
    position = draw(arrays(np.float64, 3, elements=st.floats(-1000, 1000)))
    return rigid.RigidTransform.from_quaternion(position, draw(quaternions()))


vectors = arrays(np.float64, (4, 3), elements=st.floats(-1000, 1000))


@given(quaternions(), quaternions(), quaternions(), vectors)
def test_products_rotate_like_their_factors_are_associative_and_cancel_with_the_conjugate(a, b, c, points):
    both = rigid.multiply_quaternions(a, b)
    rotated = rigid.rotate_vectors(a, rigid.rotate_vectors(b, points))
    assert np.allclose(rigid.rotate_vectors(both, points), rotated, atol=1000 * ROUNDING)
    right = rigid.multiply_quaternions(a, rigid.multiply_quaternions(b, c))
    assert np.allclose(rigid.multiply_quaternions(both, c), right, atol=ROUNDING)
    assert np.allclose(rigid.multiply_quaternions(a, rigid.conjugate_quaternion(a)), [0, 0, 0, 1], atol=ROUNDING)


@given(quaternions(), vectors)
def test_rotations_keep_lengths_and_come_back_from_matrices_and_rotation_vectors(a, points):
    rotated, matrix = rigid.rotate_vectors(a, points), rigid.matrix_from_quaternion(a)
    assert np.allclose(np.linalg.norm(rotated, axis=1), np.linalg.norm(points, axis=1), atol=1000 * ROUNDING)
    assert np.allclose(rotated, points @ matrix.T, atol=1000 * ROUNDING)
    for again in (
        rigid.quaternion_from_matrix(matrix),
        rigid.quaternion_from_rotation_vector(rigid.rotation_vector_from_quaternion(a)),
    ):
        assert rigid.angle_between(again, a) < 10 * ROUNDING
    found, error = rigid.nearest_rotation(matrix)
    assert np.abs(found - matrix).max() < ROUNDING
    assert error < ROUNDING


@given(transforms(), transforms(), vectors, st.floats(0, 1))
def test_rigid_transforms_form_a_group_and_slerp_shares_their_angle_in_the_given_proportion(a, b, points, fraction):
    size = 1e4 * ROUNDING  # coordinates of some thousand metres
    assert np.allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=size)
    assert np.allclose((a @ b).inverse().apply(points), (b.inverse() @ a.inverse()).apply(points), atol=size)
    assert np.allclose(a.inverse().apply(a.apply(points)), points, atol=size)
    assert np.allclose((a @ rigid.RigidTransform.identity()).matrix, a.matrix, atol=size)
    start, stop = a.quaternion_xyzw, b.quaternion_xyzw
    whole, part = rigid.angle_between(start, stop), rigid.slerp(start, stop, fraction)
    assume(whole < np.pi - 1e-6)  # at half a rotation there are two shortest ways
    assert abs(rigid.angle_between(start, part) - fraction * whole) < 10 * ROUNDING
    assert abs(rigid.angle_between(part, stop) - (1 - fraction) * whole) < 10 * ROUNDING


@st.composite
def paths(draw, *, rotation=1.5):
    """Paths of 1 to 40 poses, steps of 1 ns to 2 s, near zero or at today's epoch."""
    steps = draw(st.lists(st.integers(1, 2_000_000_000), min_size=0, max_size=39))
    start = draw(st.sampled_from([-5, 0, 1_700_000_000_000_000_000]))
    times = start + np.cumsum([0, *steps], dtype=np.int64)
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    size = draw(st.sampled_from([0.0, 0.001, 50.0]))
    positions = rng.uniform(-size, size, (len(times), 3))
    vectors = np.cumsum(rng.uniform(-rotation, rotation, (len(times), 3)) / np.sqrt(3), axis=0)
    return times, positions, rigid.quaternion_from_rotation_vector(vectors)


@given(paths(), st.integers(1, 10**9))
def test_paths_pass_through_their_poses_and_beyond_an_end_the_velocity_of_its_segment_goes_on(path, ahead_ns):
    times, positions, _ = path
    found, quaternions, coverage = rigid.interpolate_poses(*path, times)
    assert np.allclose(found, positions, atol=1e-13)
    assert rigid.angle_between(quaternions, path[2]).max() < 1e-14
    assert (coverage == 0).all()
    found, _, _ = rigid.interpolate_poses(*path, np.array([times[-1], times[-1] + ahead_ns]), reach_ns=10**9)
    expected = np.zeros(3)
    if len(times) > 1:
        expected = (positions[-1] - positions[-2]) / int(times[-1] - times[-2]) * ahead_ns
    assert np.allclose(found[1] - found[0], expected, rtol=1e-9, atol=1e-9 * (1 + np.abs(expected).max()))


@given(paths(), st.integers(-1000, 1000), st.floats(0, 1))
def test_between_two_poses_the_path_stays_on_the_straight_and_shortest_trajectory(path, location, along):
    times, positions, quaternions = path
    k = location % len(times)
    last = min(k + 1, len(times) - 1)
    query = times[k] + round(along * int(times[last] - times[k]))
    between, rotated, _ = rigid.interpolate_poses(*path, np.array([query]))
    ends, rotations = positions[[k, last]], quaternions[[k, last]]
    detour = np.linalg.norm(between[0] - ends, axis=1).sum() - np.linalg.norm(ends[1] - ends[0])
    assert abs(detour) < 1e-12  # 1e-16 of 50 m, some operations
    assert abs(rigid.angle_between(rotated[0], rotations).sum() - rigid.angle_between(*rotations)) < 1e-13


@given(paths(), st.integers(0, 10**9), st.integers(-(2**62), 2**62))
def test_coverage_says_where_a_time_lies(path, reach_ns, query):
    times = path[0]
    positions, quaternions, coverage = rigid.interpolate_poses(*path, np.array([query]), reach_ns=reach_ns)
    outside = max(int(times[0]) - query, query - int(times[-1]), 0)
    assert coverage[0] == (0 if outside == 0 else 1 if outside <= reach_ns else 2)
    assert np.isnan(positions).all() == np.isnan(quaternions).all() == (coverage[0] == 2)


@settings(max_examples=60)
@given(paths(rotation=0.01), st.lists(st.integers(0, 40_000_000_000), max_size=6))
def test_thinned_paths_stay_within_the_tolerances_at_every_pose(path, ahead_ns):
    times, positions, quaternions = path
    required = times[0] + np.array(ahead_ns, np.int64)
    extra = rigid.thin_poses(*path, required)
    knots_ns = np.union1d(required if len(required) else times[[0, -1]], times[extra])
    knots = rigid.interpolate_poses(*path, knots_ns, reach_ns=2**62)[:2]
    judged = (times >= knots_ns[0]) & (times <= knots_ns[-1])
    found, rotated, _ = rigid.interpolate_poses(knots_ns, *knots, times[judged])
    assert (np.linalg.norm(found - positions[judged], axis=1) <= 1e-3 + 1e-9).all()
    assert (rigid.angle_between(rotated, quaternions[judged]) <= np.radians(0.01) + 1e-9).all()
