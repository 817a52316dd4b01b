"""Trajectories come back from a file as they went into it."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sceneloom import read_trajectory, write_trajectory
from sceneloom.formats.trajectories.content import TrajectoryFile
from sceneloom.formats.trajectories.table import read_trajectory_file
from sceneloom.geometry.rotations import angle_between, normalise_quaternion
from sceneloom.scene import GnssSensor, Trajectory

COORDINATES = st.floats(-1e9, 1e9, allow_nan=False)
STAMPS = st.lists(st.integers(-(9 * 10**18), 9 * 10**18), min_size=1, max_size=6, unique=True).map(sorted)
EXACT_FORMS = ["tum", "euroc", "csv", "jsonl"]


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    """Any poses at any times of int64, of today's epoch or not."""
    stamps = draw(STAMPS)
    positions = draw(arrays(np.float64, (len(stamps), 3), elements=COORDINATES))
    raw = draw(arrays(np.float64, (len(stamps), 4), elements=st.floats(0.1, 1.0)))
    signs = draw(arrays(np.float64, (len(stamps), 4), elements=st.sampled_from([-1.0, 1.0])))
    return Trajectory("way", np.array(stamps, np.int64), positions, normalise_quaternion(raw * signs))


@pytest.mark.parametrize("form", EXACT_FORMS)
@given(way=trajectories(), optical=st.booleans())
def test_times_and_poses_come_back_number_for_number(form: str, way: Trajectory, optical: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "way.txt")
        assert len(write_trajectory(way, path, form=form, optical=optical)) == 0
        back = read_trajectory(path, form=form, optical=optical)
    assert np.array_equal(back.timestamps_ns, way.timestamps_ns)
    assert np.array_equal(back.positions, way.positions)
    assert back.quaternions_xyzw is not None
    assert np.array_equal(back.quaternions_xyzw, way.quaternions_xyzw)


@given(way=trajectories())
def test_rotations_of_kitti_come_back_within_rounding(way: Trajectory) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_trajectory(way, Path(folder, "way.kitti"))
        back = read_trajectory(Path(folder, "way.kitti"))
    assert np.array_equal(back.timestamps_ns, way.timestamps_ns)
    assert np.array_equal(back.positions, way.positions)
    # a matrix of float64 and back: a few units in the last place of numbers up to 1
    assert angle_between(back.quaternions_xyzw, way.quaternions_xyzw).max() < 1e-14


@given(
    stamps=STAMPS,
    data=st.data(),
    given_accuracy=st.booleans(),
)
def test_fixes_come_back_number_for_number(
    stamps: list[int], data: st.DataObject, given_accuracy: bool
) -> None:
    count = len(stamps)
    bounds = ((-90, 90), (-180, 180), (-1e4, 1e5))
    places = [data.draw(arrays(np.float64, count, elements=st.floats(low, high))) for low, high in bounds]
    accuracies = data.draw(arrays(np.float64, count, elements=st.floats(0.0, 1e3) | st.just(np.nan)))
    unknown = np.full(count, np.nan)
    fixes = GnssSensor(
        "gnss",
        np.array(stamps, np.int64),
        np.stack(places, axis=1),
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
