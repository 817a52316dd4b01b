"""Interpolated paths pass through their poses, never leave the span between them, and thin as promised."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneloom.geometry.rigid import angle_between, interpolate_poses, quaternion_from_rotation_vector, thin_poses

Path = tuple[np.ndarray, np.ndarray, np.ndarray]


@st.composite
def paths(draw: st.DrawFn, *, rotation: float = 1.5) -> Path:
    """Paths of 1 to 40 poses, steps of 1 ns to 2 s, near zero or at today's epoch."""
    steps = draw(st.lists(st.integers(1, 2_000_000_000), min_size=0, max_size=39))
    start = draw(st.sampled_from([-5, 0, 1_700_000_000_000_000_000]))
    times = start + np.cumsum([0, *steps], dtype=np.int64)
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    size = draw(st.sampled_from([0.0, 0.001, 50.0]))
    positions = rng.uniform(-size, size, (len(times), 3))
    vectors = np.cumsum(rng.uniform(-rotation, rotation, (len(times), 3)) / np.sqrt(3), axis=0)
    return times, positions, quaternion_from_rotation_vector(vectors)


@given(paths())
def test_paths_pass_through_their_poses(path):
    positions, quaternions, coverage = interpolate_poses(*path, path[0])
    assert np.allclose(positions, path[1], atol=1e-13)
    assert angle_between(quaternions, path[2]).max() < 1e-14
    assert (coverage == 0).all()


@given(paths(), st.integers(-1000, 1000), st.floats(0, 1))
def test_between_two_poses_the_path_stays_on_the_straight_and_shortest_trajectory(path, location, along):
    times, positions, quaternions = path
    k = location % len(times)
    last = min(k + 1, len(times) - 1)
    query = times[k] + round(along * int(times[last] - times[k]))
    between, rotated, _ = interpolate_poses(*path, np.array([query]))
    ends, rotations = positions[[k, last]], quaternions[[k, last]]
    detour = np.linalg.norm(between[0] - ends, axis=1).sum() - np.linalg.norm(ends[1] - ends[0])
    assert abs(detour) < 1e-12  # 1e-16 of 50 m, some operations
    assert abs(angle_between(rotated[0], rotations).sum() - angle_between(*rotations)) < 1e-13


@given(paths(), st.integers(0, 10**9), st.integers(-(2**62), 2**62))
def test_coverage_says_where_a_time_lies(path, reach_ns, query):
    times = path[0]
    positions, quaternions, coverage = interpolate_poses(*path, np.array([query]), reach_ns=reach_ns)
    outside = max(int(times[0]) - query, query - int(times[-1]), 0)
    assert coverage[0] == (0 if outside == 0 else 1 if outside <= reach_ns else 2)
    assert np.isnan(positions).all() == np.isnan(quaternions).all() == (coverage[0] == 2)


@given(paths(), st.integers(1, 10**9))
def test_beyond_an_end_the_velocity_of_its_segment_goes_on(path, ahead_ns):
    times, positions, _ = path
    query = np.array([times[-1], times[-1] + ahead_ns])
    found, _, _ = interpolate_poses(*path, query, reach_ns=10**9)
    if len(times) == 1:
        expected = np.zeros(3)
    else:
        expected = (positions[-1] - positions[-2]) / int(times[-1] - times[-2]) * ahead_ns
    assert np.allclose(found[1] - found[0], expected, rtol=1e-9, atol=1e-9 * (1 + np.abs(expected).max()))


@settings(max_examples=60, deadline=None)
@given(paths(rotation=0.01), st.lists(st.integers(0, 40_000_000_000), max_size=6))
def test_thinned_paths_stay_within_the_tolerances_at_every_pose(path, ahead_ns):
    times, positions, quaternions = path
    required = times[0] + np.array(ahead_ns, np.int64)
    extra = thin_poses(*path, required)
    knots_ns = np.union1d(required if len(required) else times[[0, -1]], times[extra])
    knots = interpolate_poses(*path, knots_ns, reach_ns=2**62)[:2]
    judged = (times >= knots_ns[0]) & (times <= knots_ns[-1])
    found, rotated, _ = interpolate_poses(knots_ns, *knots, times[judged])
    assert (np.linalg.norm(found - positions[judged], axis=1) <= 1e-3 + 1e-9).all()
    assert (angle_between(rotated, quaternions[judged]) <= np.radians(0.01) + 1e-9).all()
