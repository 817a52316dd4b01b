"""Trajectories come back from a file as they went into it."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sceneloom import read_trajectory, write_trajectory
from sceneloom.formats.trajectories.table import read_trajectory_file
from sceneloom.formats.trajectories.trajectory_file import TrajectoryFile
from sceneloom.geometry.rigid import angle_between, normalise_quaternion
from sceneloom.scene import GnssSensor, Trajectory

COORDINATES = st.floats(-1e9, 1e9, allow_nan=False)
TIMESTAMPS = st.lists(st.integers(-(9 * 10**18), 9 * 10**18), min_size=1, max_size=6, unique=True).map(sorted)
EXACT_FORMS = ["tum", "euroc", "csv", "jsonl"]


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    """Any poses at any times of int64, of today's epoch or not."""
    timestamps = draw(TIMESTAMPS)
    positions = draw(arrays(np.float64, (len(timestamps), 3), elements=COORDINATES))
    raw = draw(arrays(np.float64, (len(timestamps), 4), elements=st.floats(0.1, 1.0)))
    signs = draw(arrays(np.float64, (len(timestamps), 4), elements=st.sampled_from([-1.0, 1.0])))
    return Trajectory("trajectory", np.array(timestamps, np.int64), positions, normalise_quaternion(raw * signs))


@pytest.mark.parametrize("form", EXACT_FORMS)
@given(trajectory=trajectories(), optical=st.booleans())
def test_times_and_poses_come_back_number_for_number(form: str, trajectory: Trajectory, optical: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "trajectory.txt")
        assert len(write_trajectory(trajectory, path, form=form, optical=optical)) == 0
        back = read_trajectory(path, form=form, optical=optical)
    assert np.array_equal(back.timestamps_ns, trajectory.timestamps_ns)
    assert np.array_equal(back.positions, trajectory.positions)
    assert back.quaternions_xyzw is not None
    assert np.array_equal(back.quaternions_xyzw, trajectory.quaternions_xyzw)


@given(trajectory=trajectories())
def test_rotations_of_kitti_come_back_within_rounding(trajectory: Trajectory) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_trajectory(trajectory, Path(folder, "trajectory.kitti"))
        back = read_trajectory(Path(folder, "trajectory.kitti"))
    assert np.array_equal(back.timestamps_ns, trajectory.timestamps_ns)
    assert np.array_equal(back.positions, trajectory.positions)
    # a matrix of float64 and back: a few units in the last location of numbers up to 1
    assert angle_between(back.quaternions_xyzw, trajectory.quaternions_xyzw).max() < 1e-14


@given(timestamps=TIMESTAMPS, data=st.data(), given_accuracy=st.booleans())
def test_fixes_come_back_number_for_number(timestamps: list[int], data: st.DataObject, given_accuracy: bool) -> None:
    count = len(timestamps)
    bounds = ((-90, 90), (-180, 180), (-1e4, 1e5))
    locations = [data.draw(arrays(np.float64, count, elements=st.floats(low, high))) for low, high in bounds]
    accuracies = data.draw(arrays(np.float64, count, elements=st.floats(0.0, 1e3) | st.just(np.nan)))
    unknown = np.full(count, np.nan)
    fixes = GnssSensor(
        "gnss",
        np.array(timestamps, np.int64),
        np.stack(locations, axis=1),
        accuracies if given_accuracy else unknown,
        unknown,
    )
    content = TrajectoryFile(
        Trajectory("gnss", fixes.timestamps_ns, np.zeros((count, 3))), fixes=fixes, origin_lla=np.zeros(3)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "fixes.csv")
        assert len(write_trajectory(content, path, form="gnss")) == 0
        back = read_trajectory_file(path).fixes
    assert back is not None
    for name in ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies"):
        assert np.array_equal(getattr(back, name), getattr(fixes, name), equal_nan=True)
