"""`sceneloom edit`: its results for people and for machines."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import sceneloom

Call = Callable[..., Any]


def test_edit_deskew_writes_the_drive_with_sweeps_of_one_moment(
    call: Call, recording: Path, tmp_path: Path
) -> None:
    outcome = call("edit", "deskew", recording, "-o", tmp_path / "drive", "--at", "end", "--lidar", "lidar")
    assert outcome.code == 0
    assert "deskewed 3 of 3 sweeps by trajectory groundTruth to the end of each" in outcome.out
    assert "m on average" in outcome.out
    assert "lost: sensors[lidar].frames[].points.measured_timestamps_ns" in outcome.err
    with sceneloom.open(tmp_path / "drive") as scene:
        assert all(np.ptp(frame.points.timestamps_ns) == 0 for frame in scene.lidars[0].frames)


def test_edit_deskew_by_the_imu_is_reported_to_machines(call: Call, recording: Path, tmp_path: Path) -> None:
    outcome = call("edit", "deskew", recording, "-o", tmp_path / "d.sfs", "--trajectory", "imu", "--json")
    assert outcome.code == 0
    report = json.loads(outcome.out)
    assert (report["trajectory"], report["deskewed"], report["at"]) == ("imu", 3, "middle")
    assert "rotation-only" in [warning["code"] for warning in report["warnings"]]


def test_edit_deskew_never_replaces_unasked_and_knows_its_lidars(
    call: Call, recording: Path, tmp_path: Path
) -> None:
    (tmp_path / "d.sfs").touch()
    again = call("edit", "deskew", recording, "-o", tmp_path / "d.sfs")
    assert (again.code, "--overwrite" in again.err) == (1, True)
    strange = call("edit", "deskew", recording, "-o", tmp_path / "e.sfs", "--lidar", "lidar9")
    assert (strange.code, "no sensor 'lidar9'" in strange.err) == (2, True)
    assert call("fuse", recording, "-o", tmp_path / "e.sfs", "--trajectory", "imu").code == 1
