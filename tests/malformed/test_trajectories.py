"""Files of trajectories cut anywhere and with bytes changed: a trajectory, or an error of ours."""

import itertools
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneloom.errors import SceneloomError
from sceneloom.formats.trajectories.table import TRAJECTORY_FORMS, read_trajectory_file, write_trajectory
from sceneloom.scene import Trajectory

FORMS = sorted(TRAJECTORY_FORMS)


def written(form: str) -> bytes:
    timestamps = np.arange(3, dtype=np.int64) * 100_000_000
    half = np.sqrt(0.5)
    rotations = np.array([[0.0, 0, 0, 1], [0, 0, half, half], [0.5, -0.5, 0.5, -0.5]])
    trajectory = Trajectory("trajectory", timestamps, np.arange(9.0).reshape(3, 3) / 7, rotations)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "trajectory.txt")
        write_trajectory(trajectory, path, form=form, origin_lla=(49.0, 8.0, 100.0))
        return path.read_bytes()


def read_or_refuse(content: bytes, form: str | None, suffix: str, *, lenient: bool) -> None:
    """Read a file; what is read is fit to be computed with."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"trajectory{suffix}")
        path.write_bytes(content)
        try:
            trajectory = read_trajectory_file(path, form=form, rate_hz=10.0, lenient=lenient).trajectory
        except SceneloomError:
            return
    assert (np.diff(trajectory.timestamps_ns) > 0).all()
    assert np.isfinite(trajectory.positions).all()
    if trajectory.quaternions_xyzw is not None:
        assert (np.abs(np.linalg.norm(trajectory.quaternions_xyzw, axis=1) - 1) <= 0.011).all()


@pytest.mark.parametrize("form", FORMS)
def test_a_file_cut_anywhere_or_with_a_first_number_that_is_none_is_read_or_refused(form: str) -> None:
    whole = written(form)
    for length in range(0, len(whole), 3):
        read_or_refuse(whole[:length], form, ".txt", lenient=False)
    for number, count, delimiter in itertools.product(("nan", "inf", "-inf", "1e400"), (4, 8, 12, 17), ", "):
        row = delimiter.join([number, *["1"] * (count - 1)])  # the first number is none
        read_or_refuse(f"{row}\n".encode(), None, ".txt", lenient=False)


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=60)
@given(data=st.data())
@pytest.mark.few(2)
def test_a_file_with_other_bytes_or_any_bytes_at_all_is_read_or_refused(form: str, data: st.DataObject) -> None:
    content = bytearray(written(form))
    for _ in range(data.draw(st.integers(1, 4))):
        location = data.draw(st.integers(0, len(content) - 1))
        content[location] = data.draw(st.integers(0, 255) | st.sampled_from(b' ,;\n"eE-.{}[]#9'))
    if data.draw(st.integers(0, 4)) == 0:
        content = data.draw(st.binary(max_size=200))
    named = data.draw(st.booleans())
    suffix = data.draw(st.sampled_from([".txt", ".csv", ".jsonl", ".tum", ".kitti"]))
    read_or_refuse(bytes(content), form if named else None, suffix, lenient=data.draw(st.booleans()))
