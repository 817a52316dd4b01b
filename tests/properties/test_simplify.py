"""What is left out of a path is known by what stays, within the tolerances, for whatever path."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation, Slerp

from sceneloom.editing import simplify_scene
from sceneloom.geometry.thinning import thin_greedily
from sceneloom.scene import CuboidAnnotation, CuboidPath, OdometrySensor, PointPath, PointsAnnotation, Poses, Scene

STEPS = st.lists(st.integers(1, 10**9), min_size=1, max_size=40)
ARITHMETIC = 1e-6
"""Share of a tolerance: scipy counts times in float64, and the sums are in another order."""


@st.composite
def paths(draw, columns):
    timestamps = np.cumsum(draw(STEPS)).astype(np.int64)
    smooth = np.sin(timestamps[:, None] * draw(st.floats(1e-11, 1e-8)) + np.arange(columns))
    rough = draw(arrays(np.float64, (len(timestamps), columns), elements=st.floats(-1.0, 1.0, width=32)))
    return timestamps, draw(st.sampled_from([0.1, 3.0, 50.0])) * smooth + draw(
        st.sampled_from([0.0, 0.01, 1.0])
    ) * rough


def straight(timestamps, values, times):
    return np.column_stack([np.interp(times.astype(float), timestamps.astype(float), column) for column in values.T])


@given(paths(9), st.sampled_from([0.001, 0.05, 1.0]), st.sampled_from([0.01, 1.0, 20.0]))
def test_timestamps_left_out_of_a_cuboid_are_reported_by_scipy_within_the_tolerances(path, metres, degrees):
    timestamps, values = path
    values[:, 6:] *= 40.0
    cuboid = CuboidAnnotation("a", CuboidPath(timestamps, values))
    (simple,) = simplify_scene(Scene((), (cuboid,)), tolerance_m=metres, tolerance_deg=degrees).annotations
    kept = np.isin(timestamps, simple.path.timestamps_ns)
    np.testing.assert_array_equal(simple.path.values, values[kept])
    assert kept[[0, -1]].all()
    between = straight(simple.path.timestamps_ns, simple.path.values[:, :6], timestamps)
    for part in (slice(0, 3), slice(3, 6)):
        away = np.linalg.norm(between[:, part] - values[:, part], axis=1)
        assert away.max() <= metres * (1 + ARITHMETIC) + 1e-12
    if len(simple.path.timestamps_ns) > 1:
        rotations = Rotation.from_euler("XYZ", values[:, 6:], degrees=True)
        reported = Slerp(simple.path.timestamps_ns.astype(float), rotations[kept])(timestamps.astype(float))
        assert np.degrees((reported.inv() * rotations).magnitude()).max() <= degrees * (1 + ARITHMETIC) + 1e-6


@given(paths(3), st.sampled_from([0.0, 0.001, 0.1]))
def test_timestamps_left_out_of_a_keypoint_are_reported_within_the_tolerance(path, metres):
    timestamps, values = path
    points = PointsAnnotation("a", (PointPath(timestamps, values),))
    (simple,) = simplify_scene(Scene((), (points,)), tolerance_m=metres).annotations
    between = straight(simple.paths[0].timestamps_ns, simple.paths[0].values, timestamps)
    assert np.linalg.norm(between - values, axis=1).max() <= metres * (1 + ARITHMETIC) + 1e-12


@given(paths(7), st.sampled_from([0.01, 1.0]))
def test_poses_left_out_of_a_trajectory_are_reported_within_the_tolerances(path, metres):
    timestamps, values = path
    quaternions = values[:, 3:] + [0.0, 0.0, 0.0, 200.0]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    poses = Poses(timestamps, values[:, :3].copy(), quaternions)
    (simple,) = simplify_scene(Scene((OdometrySensor("ego", poses),)), tolerance_m=metres).sensors
    reported = simple.poses.interpolate(timestamps)
    assert (reported.coverage == 0).all()
    assert np.linalg.norm(reported.positions - poses.positions, axis=1).max() <= metres * (1 + ARITHMETIC)
    away = Rotation.from_quat(reported.quaternions_xyzw).inv() * Rotation.from_quat(quaternions)
    assert np.degrees(away.magnitude()).max() <= 0.1 * (1 + ARITHMETIC) + 1e-6


@given(arrays(np.float64, st.integers(0, 60), elements=st.integers(0, 3)))
def test_every_step_of_a_thinned_curve_fits_and_the_ends_stay(values):
    def misfits(a, b):
        line = np.interp(np.arange(a + 1, b), [a, b], values[[a, b]])
        return np.abs(line - values[a + 1 : b])

    kept = thin_greedily(len(values), misfits)
    assert (np.diff(kept) > 0).all()
    assert len(values) == 0 or (kept[0], kept[-1]) == (0, len(values) - 1)
    for a, b in pairwise(kept.tolist()):
        assert (misfits(a, b) <= 1.0).all()
