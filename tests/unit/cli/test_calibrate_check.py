"""`sceneloom calibrate --check`: its result for people and machines, its pictures and its exit codes."""

import json


def test_a_drive_that_shows_too_little_cannot_tell(call, recording, tmp_path):
    outcome = call("calibrate", recording, "--check", "--pictures", tmp_path / "look")
    # eight beams and a picture of 96 pixels tell nothing of a quarter of a degree
    assert outcome.code == 5
    assert "cannot tell" in outcome.out
    assert min(path.name for path in (tmp_path / "look").iterdir()) == "edges_000000.png"


def test_machines_get_all_parts_with_reasons(call, recording):
    outcome = call("calibrate", recording, "--json")
    health = json.loads(outcome.out)
    names = ["rotation", "translation", "focal_length", "principal_point", "time_offset"]
    assert [item["name"] for item in health["items"]] == names
    assert all(item["reason"] for item in health["items"])


def test_unknown_sensors_and_full_folders_are_refused_at_once(call, recording, tmp_path):
    unknown = call("calibrate", recording, "--camera", "left")
    assert (unknown.code, "camera0" in unknown.err) == (2, True)
    (tmp_path / "notes.txt").write_text("kept")
    full = call("calibrate", recording, "--pictures", tmp_path)
    assert (full.code, "exists already" in full.err) == (1, True)
