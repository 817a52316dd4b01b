"""Whatever bytes a recording is made of: it opens as a scene, or fails with one of our errors."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sceneloom.errors import SceneloomError
from sceneloom.formats.recording.spec import FORMAT

ROWS = [[1.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.75], [0.0, 0.0, 0.0, 1.0]]
POSE = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
CAMERA_MODEL = {
    "model": "pinhole",
    "focalLengthX": 9.0,
    "focalLengthY": 9.0,
    "principalPointX": 3.5,
    "principalPointY": 3.5,
}
LINES = [
    {"sensor": {"type": "gyroscope", "values": [0.5, -1e-3, 3]}, "time": 0.0},
    {"groundTruth": POSE, "time": 0.0},
    {"frames": [{"cameraInd": 0, "imuToCamera": ROWS, "time": 0.25}], "number": 0, "time": 0.25},
    {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": "0.bin"}, "time": 0.5},
    {"gps": {"latitude": 60.0, "longitude": 25.0, "altitude": 10.0, "accuracy": 4.0}, "time": 0.5},
    {"arcore": POSE, "status": "TRACKING", "time": 1.0},
    {"barometer": [1013.25], "time": 1.0},
    {"groundTruth": POSE, "time": 1.5},
]
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000080000000808020000004b6d29dc0000000e49444154789c63601805a301000000c80001"
    "a48d4c620000000049454e44ae426082"
)
VALUES = [
    *("null", "-1", "1e308", '"x"', "[]", "{}"),
    *(pytest.param(value, marks=pytest.mark.slow) for value in ("true", "1e999", "[[[[]]]]", "9" * 30)),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small recording with a line of every kind."""
    (tmp_path / "data.jsonl").write_text("".join(json.dumps(line, separators=(",", ":")) + "\n" for line in LINES))
    (tmp_path / "calibration.json").write_text(
        json.dumps({"cameras": [CAMERA_MODEL | {"imuToCamera": ROWS}], "lidars": [{"imuToLidar": ROWS}]})
    )
    (tmp_path / "frames1").mkdir()
    (tmp_path / "frames1" / "00000000.png").write_bytes(PNG)
    (tmp_path / "0.bin").write_bytes(struct.pack("<fffBHd", 1, 2, 3, 4, 5, 0.5) * 2)
    return tmp_path


def read_everything(folder: Path, *, lenient: bool) -> bool:
    """Open a recording and read each of its sweeps and the head of each image; report whether that went well."""
    try:
        with FORMAT.open(folder, lenient=lenient) as scene:
            for lidar in scene.lidars:
                for frame in lidar.frames:
                    assert frame.points.positions.dtype == np.float32
            for camera in scene.cameras:
                for image in camera.images:
                    assert image.camera.width > 0
    except SceneloomError:
        return False
    return True


def mutations(content: bytes, *, step: int) -> Iterator[bytes]:
    """The content cut at every `step`-th byte, and with a bit of that byte changed."""
    for location in range(0, len(content), step):
        yield content[:location]
        yield content[:location] + bytes([content[location] ^ (1 << location % 8)]) + content[location + 1 :]


def test_the_recording_itself_is_read(folder):
    with FORMAT.open(folder) as scene:
        assert [sensor.id for sensor in scene.sensors] == ["lidar", "camera0", "imu", "gnss"]
        assert list(scene.trajectories) == ["groundTruth", "arcore"]
        assert len(scene.cameras[0].images) == 1
    assert read_everything(folder, lenient=False)


@pytest.mark.parametrize("name", ["data.jsonl", "calibration.json", "0.bin"])
@pytest.mark.parametrize("step", [5, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.few(1)
def test_any_cut_or_changed_byte_gives_a_scene_or_one_of_our_errors(folder, name, step):
    path = folder / name
    strict, lenient = [], []
    for content in mutations(path.read_bytes(), step=step):
        path.write_bytes(content)
        strict.append(read_everything(folder, lenient=False))
        if not strict[-1]:
            lenient.append(read_everything(folder, lenient=True))
    assert True in strict
    assert False in strict
    # a lenient reading gets over most faults of lines and points, but a torn calibration is none
    assert sum(lenient) > 0.5 * len(lenient) or name == "calibration.json"


@pytest.mark.parametrize("line", range(len(LINES)))
def test_any_line_may_be_missing(folder, line):
    kept = [json.dumps(other) + "\n" for k, other in enumerate(LINES) if k != line]
    (folder / "data.jsonl").write_text("".join(kept))
    read_everything(folder, lenient=False)


@pytest.mark.parametrize("name", ["data.jsonl", "calibration.json", "0.bin", "frames1"])
def test_any_file_may_be_missing_or_be_a_folder(folder, name):
    (folder / name).rename(folder / "elsewhere")
    read_everything(folder, lenient=False)
    read_everything(folder, lenient=True)
    (folder / name).mkdir()
    read_everything(folder, lenient=False)
    read_everything(folder, lenient=True)


@pytest.mark.parametrize("name", ["data.jsonl", "calibration.json"])
@pytest.mark.parametrize("value", VALUES)
@pytest.mark.few(4)
def test_any_value_may_stand_anywhere(folder, name, value):
    path = folder / name
    lines = path.read_text().splitlines()
    for number, line in enumerate(lines):
        for changed in with_each_value_replaced(json.loads(line), value):
            path.write_text("\n".join([*lines[:number], changed, *lines[number + 1 :]]))
            read_everything(folder, lenient=False)
            read_everything(folder, lenient=True)


def with_each_value_replaced(content: object, value: str) -> Iterator[str]:
    """The JSON text of the content with one of its values, at any depth, replaced by a text."""
    marker = "the-value-that-is-replaced"

    def replaced(part: object) -> Iterator[object]:
        yield marker
        items = part.items() if isinstance(part, dict) else enumerate(part) if isinstance(part, list) else ()
        for key, inner in items:
            for changed in replaced(inner):
                whole = part.copy()
                whole[key] = changed
                yield whole

    for changed in replaced(content):
        yield json.dumps(changed).replace(f'"{marker}"', value)


CHUNKS = [
    *(b"", b"\n", b"\r\n", b"\x00", b"\xff", b"\xe2\x82", b" ", b"[" * 2000, b"9" * 400, b'"\\ud800"', b'"time":1,'),
    *b'NaN -Infinity 1e999 null true "" { } [ ] , : " -0'.split(),
    *(json.dumps(line).encode() for line in LINES),
]
"""What is put into a log instead of a part of it."""


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_whatever_is_put_into_a_log_it_is_read_or_refused_and_each_line_is_accounted_for(folder, data):
    path = folder / "data.jsonl"
    content = "".join(json.dumps(line, separators=(",", ":")) + "\n" for line in LINES).encode()
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(content)))
        stop = data.draw(st.integers(start, min(start + 40, len(content))))
        content = content[:start] + data.draw(st.sampled_from(CHUNKS)) + content[stop:]
    path.write_bytes(content)
    if read_everything(folder, lenient=False):
        assert read_everything(folder, lenient=True)
    found = FORMAT.examine(folder)
    if found.contents is not None:
        lines = content.count(b"\n") + (not content.endswith(b"\n"))
        columns = found.contents.columns
        assert columns.count == lines
        taken = {line for stream in (*columns.streams(), columns.frames) for line in stream.lines}
        wrong = {int(fault.path.rsplit("line ", 1)[1]) for fault in found.faults if fault.code in LINE_CODES}
        # blank lines at the end are no faults
        last = len(content.rstrip(b" \t\r\n").split(b"\n"))
        assert set(range(1, last + 1)) - taken == wrong


LINE_CODES = {"broken-lines", "unfit-lines"}
