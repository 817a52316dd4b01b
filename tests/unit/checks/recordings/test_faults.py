"""Faults that the reader of recordings reports: each has its rule; a log that is wrong as a whole is one finding."""

import ast
import gzip
import json
from pathlib import Path

import pytest

import sceneloom
from sceneloom.checks import validate
from sceneloom.checks.faults import FAULT_CODES, RECORDING_FAULT_RULES

READER = Path(sceneloom.__file__).parent / "formats" / "recording"
ROWS = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
CAMERA_MODEL = {"model": "pinhole", "imuToCamera": ROWS, "imageWidth": 8, "imageHeight": 8}
CAMERA_MODEL |= {"focalLengthX": 9.0, "focalLengthY": 9.0, "principalPointX": 3.5, "principalPointY": 3.5}
POSE = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
SOUND = [
    {"groundTruth": POSE, "time": 0.0},
    {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": "0.bin"}, "time": 0.5},
    {"groundTruth": POSE, "time": 1.0},
]
MOST = 1000  # faults of one code that are reported with their locations
FRAME = {"frames": [{"cameraInd": 0}], "number": 0, "time": 0.2}


def codes_of_reader():
    """The first argument of every call that keeps a fault; what reads a trajectory alone is no recording."""
    for path in READER.glob("*.py"):
        if path.name == "pose_lines.py":
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in {"fault", "refuse", "_fault"}:
                first = node.args[0]
                if isinstance(first, ast.Constant):
                    yield first.value


def test_every_code_of_the_reader_has_a_rule():
    codes = set(codes_of_reader())
    assert "broken-lines" in codes
    assert codes - FAULT_CODES == set()
    assert len(FAULT_CODES) == len(RECORDING_FAULT_RULES)


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


def cameras(**fields):
    return {"cameras": [{**CAMERA_MODEL, **fields}]}


def lines(*more):
    return {"lines": [*SOUND, *more]}


TILTED = [[1.0, 0.0, 0.5, 0.0], *ROWS[1:]]
BAD_POSE = {"groundTruth": {**POSE, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 3.0}}, "time": 2}
OTHER_FILE = {"lidar": {**SOUND[1]["lidar"], "dataFile": "1.bin"}, "time": 1}
FAULTY = [
    (None, {}, None),
    ("recording-readable", {"lines": []}, "data.jsonl"),
    ("broken-lines", lines("{torn"), "data.jsonl: line 4"),
    ("unfit-lines", lines({"gps": {"latitude": 1.0}, "time": 1}), "data.jsonl: line 4"),
    ("unusable-orientations", lines(BAD_POSE), "data.jsonl: line 4"),
    ("unreadable-calibration", {"calibration": "{"}, "calibration.json"),
    ("unusable-calibrations", {"calibration": cameras(imuToCamera=TILTED)}, "calibration.json: cameras[0].imuToCamera"),
    ("repeated-lidars", {"calibration": {"lidars": [{"imuToLidar": ROWS}] * 2}}, "calibration.json: lidars[1]"),
    ("unusable-cameras", {"calibration": cameras(model="kaleidoscope")}, "calibration.json: cameras[0]"),
    ("cameras-without-calibration", lines(FRAME), "calibration.json"),
    ("missing-videos", {**lines(FRAME), "calibration": cameras()}, ""),
    ("unreadable-videos", {**lines(FRAME), "calibration": cameras(), "data__mkv": b"no video"}, "data.mkv"),
    ("unusable-lidar-files", lines(OTHER_FILE), "data.jsonl: line 4"),
    ("unreadable-vio-config", {"vio_config__yaml": b"\xff\xfe\xff"}, "vio_config.yaml"),
]


def reported(folder):
    """Rule and location of each finding that is one of a fault."""
    report = validate(folder)
    return [(f.rule, f.path) for f in report.findings if f.rule in FAULT_CODES]


@pytest.mark.parametrize(("code", "content", "location"), FAULTY)
def test_a_fault_is_reported_once_with_its_location(write, code, content, location):
    found = reported(write(**content))
    assert [path.startswith(location) for rule, path in found if rule == code] == [True] * (code is not None)
    assert {rule for rule, _ in found} <= {code, "missing-videos"} - {None}  # a camera of lines alone lacks that, too


def test_a_lidar_file_is_distinguished_from_the_folder_on_also_where_that_is_named_relatively(
    write, tmp_path, monkeypatch
):
    write([*SOUND], torn__bin=b"\0" * 24)
    with (tmp_path / "data.jsonl").open("a") as log:
        log.write('{"lidar":{"model":"RoboSense M1 XYZIRT","dataFile":"torn.bin"},"time":2}\n')
    monkeypatch.chdir(tmp_path.parent)
    report = validate(tmp_path.name, rules=["unusable-lidar-files"])
    assert [finding.path for finding in report.findings] == ["torn.bin: byte 23"]


def test_all_faults_are_reported_at_once_and_very_many_counted(write, tmp_path):
    texts = ["{torn", *SOUND, "", BAD_POSE, FRAME]
    assert reported(write(texts, cameras(focalLengthX="wide"))) == [
        ("broken-lines", "data.jsonl: line 1"),
        ("unfit-lines", "data.jsonl: line 5"),
        ("unusable-orientations", "data.jsonl: line 6"),
        ("unusable-calibrations", "calibration.json: cameras[0].focalLengthX"),
        ("missing-videos", ""),
    ]
    texts = [*SOUND * (3 * MOST), *["{torn"] * (2 * MOST)]
    findings = validate(write(texts), rules=["broken-lines"], locations=None).findings
    assert (sum(finding.count for finding in findings), len(findings)) == (2 * MOST, MOST + 1)
    # nothing is repaired where the calibration cannot be read
    assert validate(write(calibration="["), fix=tmp_path / "out.sfs").output is None


COUNT = 40
LINES = [{"groundTruth": {"position": {"x": 0.1 * k, "y": 0.0, "z": 0.0}}, "time": 0.1 * k} for k in range(COUNT)]
TEXTS = [json.dumps(line) for line in LINES]
LOG = "".join(text + "\n" for text in TEXTS).encode()


def reported_of_lines(folder, content):
    """Rule, location, message and count of each error, also of what would be counted at the end of a list."""
    (folder / "data.jsonl").write_bytes(content)
    report = validate(folder, locations=None)
    assert not report.passed
    return [(f.rule, f.path, f.message, f.count) for f in report.findings if f.severity == "error"]


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (gzip.compress(LOG, mtime=0), "compressed by gzip"),
        (LOG.decode().encode("utf-16"), "text in UTF-16"),
        (LOG.decode().encode("utf-16-be"), "text in UTF-16"),
        (b"", "empty"),
    ],
)
def test_a_file_that_is_no_log_is_one_finding(tmp_path, content, kind):
    [(rule, location, message, count)] = reported_of_lines(tmp_path, content)
    assert (rule, location, count) == ("recording-readable", "data.jsonl", 1)
    assert kind in message
    [finding] = validate(tmp_path).findings
    assert "salvage" not in finding.remedy
    assert "record" in finding.remedy


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
def test_times_in_another_unit_are_one_finding_that_names_it(tmp_path, factor, unit):
    texts = [json.dumps(line | {"time": int((1.7e9 + line["time"]) * factor)}) + "\n" for line in LINES]
    [(rule, location, message, count)] = reported_of_lines(tmp_path, "".join(texts).encode())
    assert (rule, count) == ("unfit-lines", COUNT)
    assert location == f"data.jsonl: lines 1, 2, 3, … {COUNT}"
    assert f"looks like {unit}" in message
    assert f"{COUNT} of {COUNT} lines" in message


def test_logs_of_another_layout_are_few_findings_and_torn_lines_are_listed_singly(tmp_path):
    found = reported_of_lines(tmp_path, ("[\n" + ",\n".join(TEXTS) + "\n]\n").encode())
    assert [(rule, count) for rule, _, _, count in found] == [("broken-lines", COUNT), ("broken-lines", 1)]
    assert "a log is no list" in found[0][2]
    content = "\n".join(json.dumps(line, indent=1) for line in LINES).encode()
    found = reported_of_lines(tmp_path, content)
    assert len(found) <= 5
    assert sum(count for *_, count in found) == content.count(b"\n") + 1
    [(_, location, _, count)] = reported_of_lines(tmp_path, b"time,x,y\n" * (3 * MOST))
    assert count == 3 * MOST
    assert location.endswith(f" {3 * MOST}")
    texts = [text[:-1] if k % 9 == 4 else text for k, text in enumerate(TEXTS)]
    found = reported_of_lines(tmp_path, ("\n".join(texts) + "\n").encode())
    assert [location for _, location, _, _ in found] == [f"data.jsonl: line {k + 1}" for k in range(4, COUNT, 9)]
