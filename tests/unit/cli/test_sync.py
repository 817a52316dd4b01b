"""`sceneloom sync`: its results for people and for machines."""

import json
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


def test_sync_prints_a_table(succeeds, late):
    outcome = succeeds("sync", late)
    assert "1 stream off, against imu" in outcome.out
    row = next(line for line in outcome.out.splitlines() if "groundTruth" in line)
    assert row.split()[1:3] == ["imu", "rotation"]
    assert row.endswith("off")


def test_sync_reports_machines(call, late):
    outcome = call("sync", late, "--json", "--reference", "groundTruth")
    report = json.loads(outcome.out)
    estimate = report["comparisons"][0]["estimate"]
    assert (report["off"], estimate["verdict"]) == (["imu"], "off")
    assert abs(estimate["offset_ns"] + 3e7) < 2e6


def test_sync_apply_writes_a_drive_in_step(call, succeeds, late, tmp_path):
    outcome = succeeds("sync", late, "--apply", tmp_path / "right")
    assert "corrected: groundTruth: -" in outcome.out
    again = json.loads(call("sync", tmp_path / "right", "--json").out)
    assert again["off"] == []


def test_sync_never_replaces_unasked_and_knows_its_streams(call, late, tmp_path):
    (tmp_path / "there").mkdir()
    assert call("sync", late, "--apply", tmp_path / "there").code == 1
    wrong = call("sync", late, "--streams", "imu,sonar")
    assert (wrong.code, "sonar" in wrong.err, "groundTruth" in wrong.err) == (2, True, True)


def test_sync_of_a_part_says_what_cannot_be_known(call, late):
    outcome = call("sync", late, "--start", "3", "--stop", "3.5")
    assert outcome.code in {0, 2}


@pytest.mark.parametrize("reach", ["-1", "0", "nan", "inf", "far"])
def test_sync_refuses_to_reach_nowhere_or_everywhere(call, late, reach):
    outcome = call("sync", late, "--reach", reach)
    assert outcome.code == 2
    assert "--reach" in outcome.err


def test_sync_refuses_an_antenna_at_no_distance(call, late):
    assert call("sync", late, "--lever", "nan").code == 2
