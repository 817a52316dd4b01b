"""Trajectories come back from a file as they went into it."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.properties.strategies import floats, timestamps

from sceneloom import read_trajectory, write_trajectory
from sceneloom.formats.trajectories.table import read_trajectory_file
from sceneloom.formats.trajectories.trajectory_file import TrajectoryFile
from sceneloom.geometry.rigid import angle_between, normalise_quaternion
from sceneloom.scene import GnssSensor, Trajectory

TIMESTAMPS = timestamps(-(9 * 10**18), 9 * 10**18, most=6)


@st.composite
def trajectories(draw):
    """Any poses at any times of int64, of today's epoch or not."""
    times = draw(TIMESTAMPS)
    raw = draw(arrays(np.float64, (len(times), 4), elements=st.floats(0.1, 1.0)))
    signs = draw(arrays(np.float64, (len(times), 4), elements=st.sampled_from([-1.0, 1.0])))
    return Trajectory("trajectory", times, draw(floats(len(times), 3)), normalise_quaternion(raw * signs))


@pytest.mark.parametrize("form", ["tum", "euroc", "csv", "jsonl", "kitti"])
@given(trajectory=trajectories(), optical=st.booleans())
def test_times_and_poses_come_back_number_for_number(form, trajectory, optical):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "trajectory.txt")
        assert form == "kitti" or len(write_trajectory(trajectory, path, form=form, optical=optical)) == 0
        if form == "kitti":
            write_trajectory(trajectory, path, form=form)
            optical = False
        back = read_trajectory(path, form=form, optical=optical)
    assert np.array_equal(back.timestamps_ns, trajectory.timestamps_ns)
    assert np.array_equal(back.positions, trajectory.positions)
    # a matrix of float64 and back: a few units in the last location of numbers up to 1
    off = angle_between(back.quaternions_xyzw, trajectory.quaternions_xyzw).max()
    assert off < 1e-14 if form == "kitti" else np.array_equal(back.quaternions_xyzw, trajectory.quaternions_xyzw)


@given(times=TIMESTAMPS, data=st.data(), given_accuracy=st.booleans())
def test_fixes_come_back_number_for_number(times, data, given_accuracy):
    count = len(times)
    bounds = ((-90, 90), (-180, 180), (-1e4, 1e5))
    locations = [data.draw(arrays(np.float64, count, elements=st.floats(low, high))) for low, high in bounds]
    accuracies = data.draw(arrays(np.float64, count, elements=st.floats(0.0, 1e3) | st.just(np.nan)))
    unknown = np.full(count, np.nan)
    located = np.stack(locations, axis=1)
    fixes = GnssSensor("gnss", times, located, accuracies if given_accuracy else unknown, unknown)
    content = TrajectoryFile(Trajectory("gnss", times, np.zeros((count, 3))), fixes=fixes, origin_lla=np.zeros(3))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "fixes.csv")
        assert len(write_trajectory(content, path, form="gnss")) == 0
        back = read_trajectory_file(path).fixes
    for name in ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies"):
        assert np.array_equal(getattr(back, name), getattr(fixes, name), equal_nan=True)
