"""Every kind of fault that the reader of recordings distinguishes has its rule."""

import ast
import json
from pathlib import Path

import pytest

import sceneloom
from sceneloom.checks import validate
from sceneloom.checks.faults import FAULT_CODES, RECORDING_FAULT_RULES
from sceneloom.formats.base.diagnostics import MOST_LOCATIONS

READER = Path(sceneloom.__file__).parent / "formats" / "recording"
ROWS = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
CAMERA_MODEL = {
    "model": "pinhole",
    "focalLengthX": 9.0,
    "focalLengthY": 9.0,
    "principalPointX": 3.5,
    "principalPointY": 3.5,
    "imageWidth": 8,
    "imageHeight": 8,
    "imuToCamera": ROWS,
}
POSE = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
SOUND = [
    {"groundTruth": POSE, "time": 0.0},
    {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": "0.bin"}, "time": 0.5},
    {"groundTruth": POSE, "time": 1.0},
]
FRAME = {"frames": [{"cameraInd": 0}], "number": 0, "time": 0.2}


def codes_of_reader():
    """The first argument of every call that keeps a fault."""
    for path in READER.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in {"fault", "refuse", "_fault"}:
                first = node.args[0]
                if isinstance(first, ast.Constant):
                    yield first.value


def test_every_code_of_the_reader_has_a_rule():
    codes = set(codes_of_reader())
    assert "broken-lines" in codes
    assert codes - FAULT_CODES == set()


@pytest.fixture
def write(tmp_path):
    """A folder of these lines with a lidar file, and with this calibration."""

    def run(lines=SOUND, calibration=None, **files):
        texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
        (tmp_path / "data.jsonl").write_text("".join(text + "\n" for text in texts))
        if calibration is not None:
            text = calibration if isinstance(calibration, str) else json.dumps(calibration)
            (tmp_path / "calibration.json").write_text(text)
        (tmp_path / "0.bin").write_bytes(b"\0" * 46)
        for name, content in files.items():
            (tmp_path / name.replace("__", ".")).write_bytes(content)
        return tmp_path

    return run


TILTED = [[1.0, 0.0, 0.5, 0.0], *ROWS[1:]]
BAD_POSE = {**POSE, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 3.0}}
FAULTY = {
    "recording-readable": ({"lines": []}, "data.jsonl"),
    "broken-lines": ({"lines": [*SOUND, "{torn"]}, "data.jsonl: line 4"),
    "unfit-lines": ({"lines": [*SOUND, {"gps": {"latitude": 1.0}, "time": 1}]}, "data.jsonl: line 4"),
    "unusable-orientations": (
        {"lines": [*SOUND, {"groundTruth": BAD_POSE, "time": 2}]},
        "data.jsonl: line 4",
    ),
    "unreadable-calibration": ({"calibration": "{"}, "calibration.json"),
    "unusable-calibrations": (
        {"calibration": {"cameras": [{**CAMERA_MODEL, "imuToCamera": TILTED}]}},
        "calibration.json: cameras[0].imuToCamera",
    ),
    "repeated-lidars": (
        {"calibration": {"lidars": [{"imuToLidar": ROWS}, {"imuToLidar": ROWS}]}},
        "calibration.json: lidars[1]",
    ),
    "unusable-cameras": (
        {"calibration": {"cameras": [{**CAMERA_MODEL, "model": "kaleidoscope"}]}},
        "calibration.json: cameras[0]",
    ),
    "cameras-without-calibration": ({"lines": [*SOUND, FRAME]}, "calibration.json"),
    "missing-videos": ({"lines": [*SOUND, FRAME], "calibration": {"cameras": [CAMERA_MODEL]}}, ""),
    "unreadable-videos": (
        {"lines": [*SOUND, FRAME], "calibration": {"cameras": [CAMERA_MODEL]}, "data__mkv": b"no video"},
        "data.mkv",
    ),
    "unusable-lidar-files": (
        {"lines": [*SOUND, {"lidar": {**SOUND[1]["lidar"], "dataFile": "1.bin"}, "time": 1}]},
        "data.jsonl: line 4",
    ),
    "unreadable-vio-config": ({"vio_config__yaml": b"\xff\xfe\xff"}, "vio_config.yaml"),
}


def reported(folder):
    """Rule and location of each finding that is one of a fault."""
    report = validate(folder)
    return [(f.rule, f.path) for f in report.findings if f.rule in FAULT_CODES]


@pytest.mark.parametrize("code", FAULTY)
def test_a_fault_is_reported_once_with_its_location(write, code):
    content, location = FAULTY[code]
    found = reported(write(**content))
    [path] = [path for rule, path in found if rule == code]
    assert path.startswith(location)
    assert {rule for rule, _ in found} <= {code, "missing-videos"}  # a camera of lines alone lacks that, too


def test_a_sound_recording_has_none(write):
    assert reported(write()) == []


def test_a_lidar_file_is_distinguished_from_the_folder_on_also_where_that_is_named_relatively(
    write, tmp_path, monkeypatch
):
    write([*SOUND], torn__bin=b"\0" * 24)
    with (tmp_path / "data.jsonl").open("a") as log:
        log.write('{"lidar":{"model":"RoboSense M1 XYZIRT","dataFile":"torn.bin"},"time":2}\n')
    monkeypatch.chdir(tmp_path.parent)
    report = validate(tmp_path.name, rules=["unusable-lidar-files"])
    assert [finding.path for finding in report.findings] == ["torn.bin: byte 23"]


def test_all_faults_are_reported_at_once(write):
    lines = ["{torn", *SOUND, "", {"groundTruth": BAD_POSE, "time": 2}]
    calibration = {"cameras": [{**CAMERA_MODEL, "focalLengthX": "wide"}]}
    assert reported(write([*lines, FRAME], calibration)) == [
        ("broken-lines", "data.jsonl: line 1"),
        ("unfit-lines", "data.jsonl: line 5"),
        ("unusable-orientations", "data.jsonl: line 6"),
        ("unusable-calibrations", "calibration.json: cameras[0].focalLengthX"),
        ("missing-videos", ""),
    ]


def test_very_many_faults_are_counted(write):
    lines = [*SOUND * (3 * MOST_LOCATIONS), *["{torn"] * (2 * MOST_LOCATIONS)]
    report = validate(write(lines), rules=["broken-lines"], locations=None)
    assert sum(finding.count for finding in report.findings) == 2 * MOST_LOCATIONS
    assert len(report.findings) == MOST_LOCATIONS + 1


def test_nothing_is_repaired_where_the_calibration_cannot_be_read(write, tmp_path):
    report = validate(write(calibration="["), fix=tmp_path / "out.sfs")
    assert report.output is None


def test_ids_of_the_rules_are_the_codes():
    assert len(FAULT_CODES) == len(RECORDING_FAULT_RULES)
