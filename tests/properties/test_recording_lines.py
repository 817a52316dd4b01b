"""Any lines of a recording, opened and written, state the same again: sorted by time, and else as they were."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

from sceneloom.formats import open_scene, write_scene

ROWS = [[1.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.75], [0.0, 0.0, 0.0, 1.0]]
CAMERA_MODEL = {
    "model": "pinhole",
    "focalLengthX": 9.0,
    "focalLengthY": 9.0,
    "principalPointX": 3.5,
    "principalPointY": 3.5,
    "imuToCamera": ROWS,
}
ROTATION = {"w": 0.53464, "x": -0.15299, "y": -0.826976, "z": -0.082863}
TIMES = (0, 0.1 + 0.2, 1.5, 1.5000000000000002, 1.4497692636718750, 7, -3.25, 1e-10, 1e-9, 123456.789012345)
"""Few, so that many lines have one; some closer than a nanosecond."""

numbers = st.one_of(st.floats(-1e6, 1e6), st.integers(-5, 5))
beside = st.dictionaries(
    st.sampled_from(["temperature", "status", "note", "ünïcode %s"]),
    st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=3), st.lists(numbers, max_size=2)),
    max_size=2,
)


def axes(names: str) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries(dict.fromkeys(names, numbers))


@st.composite
def samples(draw: st.DrawFn) -> dict[str, Any]:
    width = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3, "imuTemperature": 1}
    name = draw(st.sampled_from([*width, "barometer", "odd"]))
    count = width.get(name) or draw(st.integers(1, 3))
    values = draw(st.lists(numbers, min_size=count, max_size=count))
    return {"sensor": {"type": name, "values": values} | draw(beside)}


@st.composite
def fixes(draw: st.DrawFn) -> dict[str, Any]:
    accuracy = st.dictionaries(st.sampled_from(["accuracy", "verticalAccuracy"]), st.floats(0, 99))
    fix = draw(axes("abc"))
    fix = {"latitude": fix["a"], "longitude": fix["b"], "altitude": fix["c"]} | draw(accuracy) | draw(beside)
    root = draw(st.sampled_from(["gps", "gps", "rtkgps", "groundTruth", "pose"]))
    return {root: {"name": "gps"} | fix if root == "pose" else fix}


@st.composite
def poses(draw: st.DrawFn) -> dict[str, Any]:
    root = draw(st.sampled_from(["groundTruth", "pose", "ARKit", "arengine", "output", "externalPose", ""]))
    pose: dict[str, Any] = {"position": draw(axes("xyz")) | draw(beside)}
    # a trajectory has an orientation with each pose, or with none
    if root in {"groundTruth", "ARKit", ""}:
        pose["orientation"] = ROTATION
    if root == "pose" and draw(st.booleans()):
        pose["name"] = "slam"
    pose |= draw(beside)
    return {root: pose} if root else pose


@st.composite
def others(draw: st.DrawFn) -> dict[str, Any]:
    root = draw(st.sampled_from(["systemMetrics", "droppedFrame", "trigger", "externalVelocity", "barometer"]))
    return {root: draw(st.one_of(st.none(), st.booleans(), numbers, beside))}


pressures = st.builds(lambda value, more: {"barometer": {"pressureHectopascals": value} | more}, numbers, beside)
enus = st.builds(
    lambda mean, more: {"gnssEnu": {"mean": mean} | more}, st.lists(numbers, min_size=3, max_size=3), beside
)
records = st.one_of(samples(), samples(), fixes(), poses(), pressures, enus)


@st.composite
def lines(draw: st.DrawFn) -> dict[str, Any]:
    """A line: one record, unknown keys, a time, in any order."""
    line: dict[str, Any] = draw(records)
    line |= draw(st.sampled_from([{}, draw(others())]))
    line |= draw(beside)
    line["time"] = draw(st.sampled_from(TIMES))
    return {key: line[key] for key in draw(st.permutations(list(line)))}


@st.composite
def drives(draw: st.DrawFn) -> list[dict[str, Any]]:
    """All lines of a recording: of records, of images, of sweeps, without time or subject; in any order."""
    found = draw(st.lists(lines(), max_size=8))
    times = sorted(draw(st.lists(st.sampled_from(TIMES), max_size=3, unique=True)))
    for number, time in enumerate(times):
        entry = {"cameraInd": 0, "time": time} | draw(beside)
        if draw(st.booleans()):
            entry |= {"features": [{"id": 1}], "exposureTimeSeconds": 0.01}
        found.append({"frames": [entry], "number": number, "time": time} | draw(beside))
    for time in draw(st.lists(st.sampled_from(TIMES), max_size=2)):
        sweep = {"model": "RoboSense M1 XYZIRT", "dataFile": "points.bin"} | draw(beside)
        found.append({"lidar": sweep, "time": time} | draw(beside))
    found += draw(st.lists(st.sampled_from([{"sdkVersion": "1.5"}, {"status": None}, {}]), max_size=2))
    return draw(st.permutations(found))


def write_drive(folder: Path, drive: list[dict[str, Any]]) -> None:
    count = sum("frames" in line for line in drive)
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in drive), "utf-8")
    (folder / "calibration.json").write_text(
        json.dumps({"cameras": [CAMERA_MODEL] if count else [], "lidars": [{"imuToLidar": ROWS}]})
    )
    (folder / "points.bin").write_bytes(struct.pack("<fffBHd", 1, 2, 3, 4, 5, 0.5))
    if count:
        (folder / "frames1").mkdir()
    for number in range(count):
        Image.new("RGB", (8, 8)).save(folder / "frames1" / f"{number:08d}.png")


def in_order(drive: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Sorted by time, lines without one behind those of the time that they stood behind; of one time by their text."""
    keys, last = [], -float("inf")
    for line in drive:
        last = round(line["time"] * 1e9) if "time" in line else last
        keys.append((last, "time" not in line, json.dumps(as_floats(line), sort_keys=True)))
    return [drive[k] for k in sorted(range(len(drive)), key=lambda k: keys[k])]


def as_floats(value: Any) -> Any:
    """A value with all its whole numbers as floats, which mean the same."""
    if isinstance(value, dict):
        return {key: as_floats(one) for key, one in value.items()}
    if isinstance(value, list):
        return [as_floats(one) for one in value]
    return float(value) if type(value) is int else value


def without_names(line: dict[str, Any]) -> dict[str, Any]:
    """Files of sweeps get new names."""
    if "lidar" not in line:
        return line
    return {**line, "lidar": {**line["lidar"], "dataFile": ""}}


def read_lines(folder: Path) -> list[dict[str, Any]]:
    text = (folder / "data.jsonl").read_text("utf-8")
    return [json.loads(line) for line in text.split("\n")[:-1]]


def check(drive: list[dict[str, Any]], target: Path) -> None:
    found = read_lines(target)
    timestamps = [round(line["time"] * 1e9) for line in found if "time" in line]
    assert timestamps == sorted(timestamps)
    lines = ([without_names(line) for line in each] for each in (drive, found))
    expected, written = map(in_order, lines)
    assert written == expected


TWICE = {"gnssEnu": {"mean": [0.0, 0.0, 0.0]}, "time": 7}


@given(drives())
@example([TWICE, {"temperature": None, **TWICE}, TWICE])  # nothing but poses that came before
def test_lines_are_written_as_they_were(drive):
    with TemporaryDirectory() as temporary:
        folder, target = Path(temporary, "drive"), Path(temporary, "again")
        folder.mkdir()
        write_drive(folder, drive)
        if not drive:
            return
        with open_scene(folder) as scene:
            write_scene(scene, target, images="png")
        check(drive, target)


EVERY_KIND: list[dict[str, Any]] = [
    {"sdkVersion": "1.5"},
    {"sensor": {"type": "gyroscope", "values": [1, 2.5, -3]}, "time": 0.30000000000000004},
    {"time": 0.30000000000000004, "sensor": {"type": "accelerometer", "values": [1, 2, 3], "temperature": 40}},
    {"sensor": {"type": "gyroscope", "values": [1, 2.5, 4]}, "time": 0.30000000000000004, "note": None},
    {"gps": {"longitude": 25, "latitude": 60, "altitude": 14.2}, "time": 0.5},
    {"rtkgps": {"latitude": 60, "longitude": 25, "altitude": 14.1, "accuracy": 0.02}, "time": 0.5},
    {"barometer": {"pressureHectopascals": 1013.25}, "time": 0.5},
    {"status": "TRACKING"},
    {"groundTruth": {"orientation": ROTATION, "position": {"x": 1, "y": 2, "z": 3}}, "time": 0.75},
    {"groundTruth": {"orientation": ROTATION, "position": {"x": 1, "y": 2, "z": 4}}, "time": 0.75},
    {"pose": {"name": "slam", "position": {"x": 1, "y": 2, "z": 3}}, "time": 1.25},
    {"gnssEnu": {"mean": [1, 2, 3], "covariance": [0.5]}, "time": 1.25},
    {"time": 1.5, "position": {"x": 1, "y": 2, "z": 3}, "orientation": ROTATION, "status": "TRACKING"},
    {"droppedFrame": True, "time": 1.5},
]


def test_lines_of_every_kind_come_back_key_by_key_and_through_a_scene_file(tmp_path):
    (tmp_path / "drive").mkdir()
    write_drive(tmp_path / "drive", EVERY_KIND)
    with open_scene(tmp_path / "drive") as scene:
        write_scene(scene, tmp_path / "again")
        write_scene(scene, tmp_path / "scene.sfs")
    with open_scene(tmp_path / "scene.sfs") as scene:
        write_scene(scene, tmp_path / "from_scene")
    for target in ("again", "from_scene"):
        found = read_lines(tmp_path / target)
        assert in_order(found) == in_order(EVERY_KIND)


def test_what_was_changed_is_written_and_the_rest_of_its_line_stays(tmp_path):
    (tmp_path / "drive").mkdir()
    write_drive(tmp_path / "drive", EVERY_KIND)
    with open_scene(tmp_path / "drive") as scene:
        imu = scene.sensor("imu")
        gyroscope = imu.streams["gyroscope"]
        rotated = {**imu.streams, "gyroscope": replace(gyroscope, values=gyroscope.values + 1)}
        others = tuple(sensor for sensor in scene.sensors if sensor.id != "imu")
        write_scene(replace(scene, sensors=(*others, replace(imu, streams=rotated))), tmp_path / "again")
    expected = [
        {**line, "sensor": {**line["sensor"], "values": [value + 1 for value in line["sensor"]["values"]]}}
        if line.get("sensor", {}).get("type") == "gyroscope"
        else line
        for line in EVERY_KIND
    ]
    assert in_order(read_lines(tmp_path / "again")) == in_order(expected)


def test_the_records_of_a_line_are_written_one_by_one_and_its_unknown_keys_stay(tmp_path):
    sample = {"sensor": {"type": "gyroscope", "values": [9.0, 9.0, 9.0], "temperature": 40}}
    fix = {"gps": {"latitude": 1.0, "longitude": 2.0, "altitude": 3.0}}
    images = {"frames": [{"cameraInd": 0, "time": 0.5, "features": [1]}], "number": 0}
    drive = [sample | images | fix | {"status": "INIT", "time": 0.5}, fix | sample | {"note": 1, "time": 1.5}]
    (tmp_path / "drive").mkdir()
    write_drive(tmp_path / "drive", drive)
    with open_scene(tmp_path / "drive") as scene:
        write_scene(scene, tmp_path / "again", images="png")
    assert in_order(read_lines(tmp_path / "again")) == in_order(
        [
            sample | {"time": 0.5},
            fix | {"time": 0.5},
            images | {"status": "INIT", "time": 0.5},
            sample | {"note": 1, "time": 1.5},
            fix | {"time": 1.5},
        ]
    )
