"""`sceneloom validate`: what it prints, what it writes, how it exits."""

import json

import numpy as np
import pytest

POSE = [0, 0, 0, 0, 0, 0, 1]


@pytest.fixture
def faulty(tmp_path, encode_sfs):
    """A file with a quaternion that is too long."""
    poses = {"timestamps": [0, 100_000], "values": [POSE, [0, 0, 0, 0, 0, 0, 2]]}
    frames = [{"timestamp": 0, "points": {"positions": np.ones((2, 3), np.float32)}}]
    lidar = {"id": "top", "type": "lidar", "poses": poses, "frames": frames}
    path = tmp_path / "faulty.sfs"
    path.write_bytes(encode_sfs({"version": "1.0", "sensors": [lidar]}))
    return path


def test_findings_stand_under_their_rule_with_the_remedy_once_or_as_json(call, succeeds, faulty):
    done = call("validate", faulty)
    assert done.code == 1
    lines = done.out.splitlines()
    assert lines[0].startswith(f"{faulty}: sfs, profile sfs: not passed, 1 error")
    start = lines.index("errors")
    assert lines[start + 1] == "  quaternion-norm: 1 time, --fix repairs it"
    assert lines[start + 2].startswith("    sensors[0].poses.values[1]: a quaternion of norm 2; expected 1")
    assert lines[start + 3].startswith("    → Normalise")
    done = call("validate", faulty, "--json", "--rule", "quaternion-norm")
    report = json.loads(done.out)
    assert (done.code, report["counts"]) == (1, {"error": 1, "warning": 0, "hint": 0})
    finding = report["findings"][0]
    assert (finding["path"], finding["fixable"]) == ("sensors[0].poses.values[1]", True)
    hints = ("validate", faulty, "--rule", "reading-assumed")
    assert ["reading-assumed" in call(*hints, *words).out for words in ((), ("--quiet",))] == [True, False]
    assert "quaternion-norm (error, fix)\n" in succeeds("validate --rules").out
    rows = json.loads(call("validate --rules --json").out)
    assert {"id", "severity", "summary", "remedy", "fixable", "only_in"} == set(rows[0])


def test_fixing_writes_and_passes_or_says_why_nothing_was_written(call, refuses, succeeds, faulty, tmp_path):
    target = tmp_path / "repaired.sfs"
    done = succeeds("validate", faulty, "--fix", target)
    assert "fixed\n  quaternion-norm: sensors[0].poses.values[1]" in done.out
    assert f"wrote {target}, " in done.out
    succeeds("validate", target)
    assert call("validate", faulty, "--fix", target).code == 1
    succeeds("validate", faulty, "--fix", target, "--overwrite")
    (tmp_path / "torn.sfs").write_bytes(b'{"version": ')
    refuses(1, "nothing was written", "validate", tmp_path / "torn.sfs", "--fix", tmp_path / "again.sfs")
    (drive := tmp_path / "drive").mkdir()
    (drive / "data.jsonl").write_text('[{"groundTruth":{"position":{"x":0,"y":0,"z":0}},"time":0}\n')
    done = refuses(1, "nothing was written: ", "validate", drive, "--fix", tmp_path / "again")
    assert "broken-lines: 1 time\n    data.jsonl: line 1: " in done.out
    assert not (tmp_path / "again").exists()


def test_strict_lets_warnings_fail_and_bad_usage_is_refused(call, succeeds, recording, refuses, faulty, tmp_path):
    succeeds("validate", recording, "--quick")
    without_trajectory = call("validate", recording, "--strict", "--ignore", "image-plain")
    assert without_trajectory.code in (0, 1)
    assert without_trajectory.code == ("warning" in without_trajectory.out.splitlines()[0])
    refuses(2, "", "validate")
    refuses(2, "", "validate", "x.sfs", "--profile", "bs5")
    refuses(2, "--rules", "validate", faulty, "--rule", "no-such")
    stated = "repaired.xyz: suffix '.xyz' belongs to no format; expected one of: sfs (.sfs)"
    for source in (recording, faulty):
        refuses(2, stated, "validate", source, "--fix", tmp_path / "repaired.xyz")
        assert not (tmp_path / "repaired.xyz").exists()


def test_what_is_written_is_not_called_by_the_form_that_it_was_made_from_nor_lost_what_is_kept_aside(
    call, recording, tmp_path
):
    repaired = call("validate", recording, "--fix", tmp_path / "repaired.sfs").out
    assert repaired.startswith(f"{tmp_path / 'repaired.sfs'}: profile sfs: passed")
    lost, _, aside = repaired.partition("\nkept aside\n")
    assert "trajectories[]: " not in lost
    assert "  trajectories[]: the format knows odometry sensors only; it is in metadata.sceneloom." in aside
    back = call("validate", tmp_path / "repaired.sfs", "--fix", tmp_path / "back")
    assert back.out.startswith(f"{tmp_path / 'back'}: recording: passed")
