"""What a recording's lines state beside their samples stays with these when clocks are corrected."""

import json

from sceneloom.editing.retime import ClockCorrection, retimed_scene
from sceneloom.formats import open_scene, write_scene
from sceneloom.scene.types import key_of


def sample(seconds, **beside):
    return {"sensor": {"type": "gyroscope", "values": [0.0, 0.5, seconds]} | beside, "time": seconds}


def pose(seconds, **beside):
    return {"groundTruth": {"position": {"x": seconds, "y": 0.0, "z": 0.0}} | beside, "time": seconds}


def fix(seconds, **beside):
    return {"gps": {"latitude": 60.0, "longitude": 25.0, "altitude": seconds} | beside, "time": seconds}


def test_further_keys_move_with_their_samples(tmp_path):
    (tmp_path / "drive").mkdir()
    lines = [
        sample(0.5, temperature=20.0),
        sample(0.5, temperature=21.0),
        pose(1.0, status="TRACKING"),
        fix(1.125, satellites=7),
        sample(1.5),
        sample(2.5, temperature=22.0),
    ]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (tmp_path / "drive" / "data.jsonl").write_text(text)
    with open_scene(tmp_path / "drive") as scene:
        late, early = ClockCorrection(250_000_000), ClockCorrection(-500_000_000)
        moved = retimed_scene(scene, sensors={key_of("imu"): late}, trajectories={"groundTruth": early})
        write_scene(moved, tmp_path / "again")
    shifts = {"sensor": -0.25, "groundTruth": 0.5, "gps": 0.0}
    expected = [{**line, "time": line["time"] + shifts[next(iter(line))]} for line in lines]
    found = [json.loads(line) for line in (tmp_path / "again" / "data.jsonl").read_text().splitlines()]
    assert found == sorted(expected, key=lambda line: line["time"])


def test_a_line_of_two_records_is_two_lines_when_one_of_them_moves(tmp_path):
    (tmp_path / "drive").mkdir()
    line = {**sample(0.5), **fix(0.5)}
    (tmp_path / "drive" / "data.jsonl").write_text(json.dumps(line) + "\n")
    with open_scene(tmp_path / "drive") as scene:
        moved = retimed_scene(scene, sensors={key_of("imu"): ClockCorrection(250_000_000)})
        write_scene(moved, tmp_path / "again")
    found = [json.loads(line) for line in (tmp_path / "again" / "data.jsonl").read_text().splitlines()]
    assert found == [{**sample(0.5), "time": 0.25}, fix(0.5)]
