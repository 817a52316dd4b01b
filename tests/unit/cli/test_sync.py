"""`sceneloom sync`: its results for people and for machines."""

from dataclasses import replace

import pytest

import sceneloom
from sceneloom.simulate import LidarSpec, simulate_street


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    """A recording of twenty seconds whose trajectory is 30 ms late."""
    folder = tmp_path_factory.mktemp("clocks") / "late"
    blind = LidarSpec(beams=1, steps=4, elevations_deg=(-1.0, 1.0))
    scene = simulate_street(4, frames=200, lidar=blind, cameras=()).scene
    trajectory = scene.trajectories["groundTruth"]
    moved = replace(trajectory, timestamps_ns=trajectory.timestamps_ns + 30_000_000)
    sensors = tuple(s for s in scene.sensors if s.id == "imu")
    sceneloom.write(replace(scene, sensors=sensors, annotations=(), trajectories={"groundTruth": moved}), folder)
    return folder


def test_sync_reports_and_writes_a_drive_in_step(succeeds, reported, late, tmp_path, call, refuses):
    outcome = succeeds("sync", late)
    assert "1 stream off, against imu" in outcome.out
    row = next(line for line in outcome.out.splitlines() if "groundTruth" in line).split()
    assert (*row[1:3], row[-1]) == ("imu", "rotation", "off")
    report = reported("sync", late, "--reference", "groundTruth")
    estimate = report["comparisons"][0]["estimate"]
    assert (report["off"], estimate["verdict"]) == (["imu"], "off")
    assert abs(estimate["offset_ns"] + 3e7) < 2e6
    assert "corrected: groundTruth: -" in succeeds("sync", late, "--apply", tmp_path / "right").out
    assert reported("sync", tmp_path / "right")["off"] == []
    (tmp_path / "there").mkdir()
    refuses(1, "", "sync", late, "--apply", tmp_path / "there")
    assert "groundTruth" in refuses(2, "sonar", "sync", late, "--streams", "imu,sonar").err
    refuses(2, "", "sync", late, "--lever", "nan")
    for reach in ("-1", "0", "nan", "inf", "far"):
        refuses(2, "--reach", "sync", late, "--reach", reach)
    assert call("sync", late, "--start", "3", "--stop", "3.5").code in {0, 2}, "of so little nothing may be known"
