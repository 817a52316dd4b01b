"""Whatever becomes of a recording's files: `validate` gives a report, and nothing else."""

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sceneloom.checks import ValidationReport, validate

ROWS = [[1.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.75], [0.0, 0.0, 0.0, 1.0]]
CAMERA_MODEL = {
    "model": "pinhole",
    "focalLengthX": 9.0,
    "focalLengthY": 9.0,
    "principalPointX": 3.5,
    "principalPointY": 3.5,
    "imageWidth": 8,
    "imageHeight": 8,
}
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000080000000808020000004b6d29dc0000000e49444154789c63601805a301000000c80001"
    "a48d4c620000000049454e44ae426082"
)
ODD = [None, True, -1, 0, 2**70, 1e308, -1e308, 1e-320, "", "x", [], [[]], {}, [0, 0, 0], {"x": 1}]


def make_lines() -> list[dict[str, Any]]:
    """Two seconds of every kind of line."""
    random = np.random.default_rng(0)
    lines: list[dict[str, Any]] = []
    for k in range(40):
        time = 0.05 * k
        for name, mean, width in (("accelerometer", 5.7, 3), ("gyroscope", 0.1, 3), ("magnetometer", 30, 3)):
            values = (mean + 0.1 * random.normal(size=width)).tolist()
            lines.append({"sensor": {"type": name, "values": values}, "time": time})
        if k % 4:
            continue
        position = {"x": 2.0 * time, "y": 0.5, "z": 0.0}
        rotation = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        lines += [
            {"groundTruth": {"position": position, "orientation": rotation}, "time": time},
            {"arcore": {"position": position, "orientation": rotation}, "status": "TRACKING", "time": time},
            {"gps": {"latitude": 60.0, "longitude": 25.0, "altitude": 10.0, "accuracy": 4.0}, "time": time},
            {"barometer": {"pressureHectopascals": 1013.25}, "time": time},
            {"sensor": {"type": "imuTemperature", "values": [300.0]}, "time": time},
        ]
    for k in range(2):
        lines.append({"frames": [{"cameraInd": 0, "imuToCamera": ROWS}], "number": k, "time": 2.0 + k})
        lines.append({"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": f"{k}.bin"}, "time": 2.0 + k})
    return lines


LINES = make_lines()
TEXTS = [json.dumps(line, separators=(",", ":")) for line in LINES]
CALIBRATION = {"cameras": [CAMERA_MODEL | {"imuToCamera": ROWS}], "lidars": [{"imuToLidar": ROWS}]}
WITH_POINTS = struct.pack("<fffBHd", 1, 2, 3, 4, 5, 2.5) * 3


def write(folder: Path, texts: list[str], calibration: str | None = None) -> Path:
    """A recording with these lines."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "frames1").mkdir(parents=True)
    (folder / "data.jsonl").write_text("\n".join(texts) + "\n")
    (folder / "calibration.json").write_text(json.dumps(CALIBRATION) if calibration is None else calibration)
    for k in range(2):
        (folder / f"{k}.bin").write_bytes(WITH_POINTS)
        (folder / "frames1" / f"{k:08d}.png").write_bytes(PNG)
    return folder


def test_the_recording_itself_is_read(tmp_path):
    report = validate(write(tmp_path / "drive", TEXTS))
    assert report.profile == "recording"
    assert not [finding for finding in report.findings if finding.rule in {"file-readable", "broken-lines"}]


def locations_of(node: Any, location: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """All locations of a line or of the calibration."""
    if not isinstance(node, dict | list):
        return []
    items = node.items() if isinstance(node, dict) else enumerate(node)
    return [below for key, value in items for below in [(*location, key), *locations_of(value, (*location, key))]]


def with_odd_value(draw: Any, content: Any) -> str:
    """The JSON of a content in which one location holds something odd, or nothing."""
    changed = json.loads(json.dumps(content))
    *above, last = draw(st.sampled_from(locations_of(content)))
    node = changed
    for key in above:
        node = node[key]
    if draw(st.booleans()):
        node[last] = draw(st.sampled_from(ODD) | st.floats(allow_nan=False) | st.integers())
    else:
        del node[last]
    return json.dumps(changed)


@st.composite
def mutated_lines(draw: Any) -> list[str]:
    """The lines with some of them changed, gone, doubled, exchanged, cut, or at another time."""
    texts = list(TEXTS)
    for _ in range(draw(st.integers(1, 12))):
        row = draw(st.integers(0, len(texts) - 1))
        match draw(st.sampled_from(["value", "value", "drop", "double", "move", "cut", "byte", "time"])):
            case "value":
                texts[row] = with_odd_value(draw, LINES[draw(st.integers(0, len(LINES) - 1))])
            case "drop" if len(texts) > 1:
                del texts[row]
            case "double":
                texts.insert(row, texts[row])
            case "move":
                texts.insert(draw(st.integers(0, len(texts) - 1)), texts.pop(row))
            case "cut":
                texts[row] = texts[row][: draw(st.integers(0, len(texts[row])))]
            case "byte" if texts[row]:
                at = draw(st.integers(0, len(texts[row]) - 1))
                texts[row] = texts[row][:at] + draw(st.sampled_from('{}[]",:0-eE.\\x\x00é')) + texts[row][at + 1 :]
            case _:
                time = draw(st.sampled_from([0.0, -5.0, 1e9, 9.2e9, 9.3e9, 1e-9, 1.7e9, -1e308]))
                texts[row] = json.dumps({**draw(st.sampled_from(LINES)), "time": time})
    return texts


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(texts=mutated_lines())
def test_changed_lines_give_a_report(tmp_path, texts):
    assert isinstance(validate(write(tmp_path / "drive", texts), locations=None), ValidationReport)


@st.composite
def scaled_streams(draw: Any) -> list[str]:
    """All values of a stream odd at once, and all its times."""
    name = draw(st.sampled_from(["sensor", "gps", "groundTruth", "barometer", "frames"]))
    factor, shift = (draw(st.sampled_from([0.0, 1e-300, -1.0, 1e9, 1e308])), draw(st.sampled_from([0, 1e-10, 1e8])))
    slowness = draw(st.sampled_from([0.0, 1e-12, 1.0, -1.0, 1e6]))

    def scaled(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: scaled(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [scaled(inner) for inner in value]
        return value * factor if isinstance(value, float) and abs(value * factor) < 1.7e308 else value

    return [
        json.dumps({**line, name: scaled(line[name]), "time": slowness * line["time"] + shift})
        if name in line
        else json.dumps(line)
        for line in LINES
    ]


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(texts=scaled_streams())
def test_streams_of_absurd_numbers_give_a_report(tmp_path, texts):
    assert isinstance(validate(write(tmp_path / "drive", texts), locations=None), ValidationReport)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(data=st.data())
def test_a_changed_calibration_gives_a_report(tmp_path, data):
    changed = with_odd_value(data.draw, CALIBRATION)
    text = changed[: data.draw(st.integers(0, len(changed)))] if data.draw(st.booleans()) else changed
    assert isinstance(validate(write(tmp_path / "drive", TEXTS, text), locations=None), ValidationReport)


@pytest.mark.parametrize("name", ["data.jsonl", "calibration.json", "0.bin", "frames1", "frames1/00000000.png"])
@pytest.mark.parametrize("content", [None, b"", b"\xff\x00{", b"\n" * 9, b"[]\n"])
def test_any_file_may_be_missing_or_hold_anything(tmp_path, name, content):
    folder = write(tmp_path / "drive", TEXTS)
    path = folder / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    if content is not None:
        path.write_bytes(content)
    # without the log it is no recording, but may be named as one
    report = validate(folder / "data.jsonl" if name == "data.jsonl" and content else folder, format="recording")
    assert isinstance(report, ValidationReport)
    assert report.findings


def test_a_clock_that_runs_for_centuries_and_an_image_without_width_give_a_report(tmp_path):
    late = [json.dumps({**line, "time": 9.2e9}) for line in LINES if "groundTruth" in line][:1]
    flat = json.dumps({"cameras": [{**CAMERA_MODEL, "imageWidth": 0, "imuToCamera": ROWS}]})
    assert validate(write(tmp_path / "drive", [*TEXTS, *late], flat)).findings
