"""Whatever a recording is made of: it opens as a scene or fails with an error of ours, and `validate` reports."""

import io
import json
import shutil
import struct
import zipfile

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.malformed.damage import flipped, locations, replaced

from sceneloom.checks import ValidationReport, validate
from sceneloom.errors import SceneloomError
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.formats.recording.vio_config import read_vio_config

ROWS = [[1.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 1.0, 0.75], [0.0, 0.0, 0.0, 1.0]]
POSE = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
PINHOLE = {"model": "pinhole", "focalLengthX": 9.0, "focalLengthY": 9.0, "principalPointX": 3.5, "principalPointY": 3.5}
CALIBRATION = {"cameras": [PINHOLE | {"imuToCamera": ROWS}], "lidars": [{"imuToLidar": ROWS}]}
GPS = {"latitude": 60.0, "longitude": 25.0, "altitude": 10.0, "accuracy": 4.0}
LINES = [
    {"sensor": {"type": "gyroscope", "values": [0.5, -1e-3, 3]}, "time": 0.0},
    {"groundTruth": POSE, "time": 0.0},
    {"frames": [{"cameraInd": 0, "imuToCamera": ROWS, "time": 0.25}], "number": 0, "time": 0.25},
    {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": "0.bin"}, "time": 0.5},
    {"gps": GPS, "time": 0.5},
    {"arcore": POSE, "status": "TRACKING", "time": 1.0},
    {"barometer": [1013.25], "time": 1.0},
    {"groundTruth": POSE, "time": 1.5},
]
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000080000000808020000004b6d29dc0000000e49444154789c63601805a301000000c80001"
    "a48d4c620000000049454e44ae426082"
)
IN_ONE_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
QUICK = settings(IN_ONE_FOLDER, max_examples=60)


def as_text(line):
    return json.dumps(line, separators=(",", ":"))


def write(folder, texts, calibration, sweeps=1):
    """A recording with these lines, and a sweep and an image of each number."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "frames1").mkdir(parents=True)
    (folder / "data.jsonl").write_text("\n".join(texts) + "\n")
    (folder / "calibration.json").write_text(calibration)
    for k in range(sweeps):
        (folder / f"{k}.bin").write_bytes(struct.pack("<fffBHd", 1, 2, 3, 4, 5, 0.5) * 3)
        (folder / "frames1" / f"{k:08d}.png").write_bytes(PNG)
    return folder


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path / "small", [as_text(line) for line in LINES], json.dumps(CALIBRATION))


def opens(folder, *, lenient=False, **options):
    """Open a recording and read all that is in it; report whether that went well."""
    try:
        with FORMAT.open(folder, lenient=lenient, **options) as scene:
            for camera in scene.cameras:
                assert all(image.camera.width > 0 for image in camera.images)
            for sensor in scene.sensors:
                for frame in getattr(sensor, "frames", ()):
                    assert (frame.points.positions if hasattr(frame, "points") else frame.depth).ndim == 2
    except SceneloomError:
        return False
    return True


@pytest.mark.parametrize("name", ["data.jsonl", "calibration.json", "0.bin"])
@pytest.mark.parametrize("step", [5, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.few(1)
def test_any_cut_or_changed_byte_gives_a_scene_or_one_of_our_errors(folder, name, step):
    path, strict, lenient = folder / name, [], []
    whole = path.read_bytes()
    for location in range(0, len(whole), step):
        for content in (whole[:location], flipped(whole, location, 1 << location % 8)):
            path.write_bytes(content)
            strict.append(opens(folder))
            if not strict[-1]:
                lenient.append(opens(folder, lenient=True))
    assert set(strict) == {True, False}
    # a lenient reading gets over most faults of lines and points, but a torn calibration is none
    assert sum(lenient) > 0.5 * len(lenient) or name == "calibration.json"


def test_the_recording_itself_is_read_and_any_line_or_file_may_be_missing_or_be_a_folder(folder):
    with FORMAT.open(folder) as scene:
        assert [sensor.id for sensor in scene.sensors] == ["lidar", "camera0", "imu", "gnss"]
        assert list(scene.trajectories) == ["groundTruth", "arcore"]
        assert len(scene.cameras[0].images) == 1
    assert opens(folder)
    for name in ("calibration.json", "0.bin", "frames1", "data.jsonl"):
        (folder / name).rename(folder / "elsewhere")
        for make in (lambda: None, (folder / name).mkdir):
            make()
            opens(folder)
            opens(folder, lenient=True)
        (folder / name).rmdir()
        (folder / "elsewhere").rename(folder / name)
    for line in range(len(LINES)):
        (folder / "data.jsonl").write_text("".join(as_text(o) + "\n" for k, o in enumerate(LINES) if k != line))
        opens(folder)


VALUES = [
    *("null", "-1", "1e308", '"x"', "[]", "{}"),
    *(pytest.param(value, marks=pytest.mark.slow) for value in ("true", "1e999", "[[[[]]]]", "9" * 30)),
]


@pytest.mark.parametrize("name", ["data.jsonl", "calibration.json"])
@pytest.mark.parametrize("value", VALUES)
@pytest.mark.few(4)
def test_any_value_may_stand_anywhere(folder, name, value):
    lines = (folder / name).read_text().splitlines()
    for number, line in enumerate(lines):
        content = json.loads(line)
        for path in ((), *locations(content)):
            changed = as_text(replaced(content, path, "MARK") if path else "MARK").replace('"MARK"', value)
            (folder / name).write_text("\n".join([*lines[:number], changed, *lines[number + 1 :]]))
            opens(folder)
            opens(folder, lenient=True)


CHUNKS = [
    *(b"", b"\n", b"\r\n", b"\x00", b"\xff", b"\xe2\x82", b" ", b"[" * 2000, b"9" * 400, b'"\\ud800"', b'"time":1,'),
    *b'NaN -Infinity 1e999 null true "" { } [ ] , : " -0'.split(),
    *(json.dumps(line).encode() for line in LINES),
]
"""What is put into a log instead of a part of it."""


@IN_ONE_FOLDER
@given(st.data())
def test_whatever_is_put_into_a_log_it_is_read_or_refused_and_each_line_is_accounted_for(folder, data):
    content = "".join(as_text(line) + "\n" for line in LINES).encode()
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(content)))
        stop = data.draw(st.integers(start, min(start + 40, len(content))))
        content = content[:start] + data.draw(st.sampled_from(CHUNKS)) + content[stop:]
    (folder / "data.jsonl").write_bytes(content)
    if opens(folder):
        assert opens(folder, lenient=True)
    found = FORMAT.examine(folder)
    if found.contents is not None:
        columns = found.contents.columns
        assert columns.count == content.count(b"\n") + (not content.endswith(b"\n"))
        taken = {line for stream in (*columns.streams(), columns.frames) for line in stream.lines}
        codes = {"broken-lines", "unfit-lines"}
        wrong = {int(fault.path.rsplit("line ", 1)[1]) for fault in found.faults if fault.code in codes}
        # blank lines at the end are no faults
        last = len(content.rstrip(b" \t\r\n").split(b"\n"))
        assert set(range(1, last + 1)) - taken == wrong


def drive_lines():
    random, lines = np.random.default_rng(0), []
    for k in range(40):
        time = 0.05 * k
        for name, mean in (("accelerometer", 5.7), ("gyroscope", 0.1), ("magnetometer", 30)):
            values = (mean + 0.1 * random.normal(size=3)).tolist()
            lines.append({"sensor": {"type": name, "values": values}, "time": time})
        if k % 4 == 0:
            pose = POSE | {"position": {"x": 2.0 * time, "y": 0.5, "z": 0.0}}
            lines += [
                {"groundTruth": pose, "time": time},
                {"arcore": pose, "status": "TRACKING", "time": time},
                {"gps": GPS, "time": time},
                {"barometer": {"pressureHectopascals": 1013.25}, "time": time},
                {"sensor": {"type": "imuTemperature", "values": [300.0]}, "time": time},
            ]
    for k in range(2):
        lines.append({"frames": [{"cameraInd": 0, "imuToCamera": ROWS}], "number": k, "time": 2.0 + k})
        lines.append({"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": f"{k}.bin"}, "time": 2.0 + k})
    return lines


DRIVE = drive_lines()
TEXTS = [as_text(line) for line in DRIVE]
SIZED = CALIBRATION | {"cameras": [CALIBRATION["cameras"][0] | {"imageWidth": 8, "imageHeight": 8}]}
ODD = [None, True, -1, 0, 2**70, 1e308, -1e308, 1e-320, "", "x", [], [[]], {}, [0, 0, 0], {"x": 1}]


def report_of(tmp_path, texts=TEXTS, calibration=SIZED):
    text = calibration if isinstance(calibration, str) else json.dumps(calibration)
    report = validate(write(tmp_path / "drive", texts, text, sweeps=2), locations=None)
    assert isinstance(report, ValidationReport)
    return report


def with_odd_value(draw, content):
    odd = [draw(st.sampled_from(ODD) | st.floats(allow_nan=False) | st.integers())] if draw(st.booleans()) else []
    return replaced(content, draw(st.sampled_from(list(locations(content)))), *odd)


@st.composite
def mutated_lines(draw):
    """The lines with some of them changed, gone, doubled, exchanged, cut, or at another time."""
    texts = list(TEXTS)
    for _ in range(draw(st.integers(1, 12))):
        row = draw(st.integers(0, len(texts) - 1))
        match draw(st.sampled_from(["value", "value", "drop", "double", "move", "cut", "byte", "time"])):
            case "value":
                texts[row] = json.dumps(with_odd_value(draw, draw(st.sampled_from(DRIVE))))
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
                texts[row] = json.dumps({**draw(st.sampled_from(DRIVE)), "time": time})
    return texts


@st.composite
def scaled_streams(draw):
    """All values of a stream odd at once, and all its times."""
    name = draw(st.sampled_from(["sensor", "gps", "groundTruth", "barometer", "frames"]))
    factor, shift = draw(st.sampled_from([0.0, 1e-300, -1.0, 1e9, 1e308])), draw(st.sampled_from([0, 1e-10, 1e8]))
    slowness = draw(st.sampled_from([0.0, 1e-12, 1.0, -1.0, 1e6]))

    def scaled(value):
        if isinstance(value, dict):
            return {key: scaled(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [scaled(inner) for inner in value]
        return value * factor if isinstance(value, float) and abs(value * factor) < 1.7e308 else value

    return [
        as_text({**line, name: scaled(line[name]), "time": slowness * line["time"] + shift} if name in line else line)
        for line in DRIVE
    ]


@settings(IN_ONE_FOLDER, max_examples=80)
@given(texts=st.just(TEXTS) | mutated_lines() | scaled_streams(), data=st.data())
def test_changed_lines_calibrations_and_streams_of_absurd_numbers_give_a_report(tmp_path, texts, data):
    calibration = SIZED
    if texts is TEXTS:
        text = json.dumps(with_odd_value(data.draw, SIZED))
        calibration = text[: data.draw(st.integers(0, len(text)))] if data.draw(st.booleans()) else text
    report_of(tmp_path, texts, calibration)


@pytest.mark.parametrize("name", ["data.jsonl", "calibration.json", "0.bin", "frames1", "frames1/00000000.png"])
@pytest.mark.parametrize("content", [None, b"", b"\xff\x00{", b"\n" * 9, b"[]\n"])
def test_any_file_may_be_missing_or_hold_anything_and_is_reported(tmp_path, name, content):
    whole = report_of(tmp_path)
    assert whole.profile == "recording"
    assert not {finding.rule for finding in whole.findings} & {"file-readable", "broken-lines"}
    folder = tmp_path / "drive"
    path = folder / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    if content is not None:
        path.write_bytes(content)
    # without the log it is no recording, but may be named as one
    assert validate(folder / "data.jsonl" if name == "data.jsonl" and content else folder, format="recording").findings
    # a clock that runs for centuries, and an image without width
    late = as_text({"groundTruth": POSE, "time": 9.2e9})
    assert report_of(tmp_path, [*TEXTS, late], replaced(SIZED, ("cameras", 0, "imageWidth"), 0)).findings


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from("xyzw"), inner, max_size=4),
    max_leaves=20,
)
MATRICES = st.lists(st.lists(st.floats(-2, 2), min_size=3, max_size=4), min_size=3, max_size=4) | st.lists(
    st.floats(-2, 2), min_size=9, max_size=16
)
FIELDS = ["imuToGnss", "imuToOutput", "imuToMagnetometer", "imuForward", "cameras", "lidars", "other"]
CAMERA_FIELDS = ["imuToCamera", "imuToCameraShiftSeconds", "shutterRollTimeSeconds", "exposureTimeSeconds", "model"]
NAMES = ["focalLength", "secondFocalLengthX", "imuToCameraMatrix", "distortionCoeffs", "fisheyeCamera", "rot", "x"]
NUMBERS = ["1", "-1", "0,0,0", "1,0,0,0,1,0,0,0,1", "true", "nan", "1e999", "a b", ""]
DEPTH_LINES = [
    {"sensor": {"type": "gyroscope", "values": [0.0, 0.1, 0.2]}, "time": 0.0},
    {"gps": GPS, "time": 0.0},
    {"frames": [{"cameraInd": 0, "depthScale": 0.001}], "number": 0, "time": 0.0},
]
DEPTH_FILES = {
    "data.jsonl": "".join(json.dumps(line) + "\n" for line in DEPTH_LINES),
    "calibration.json": json.dumps({"cameras": [PINHOLE | {"imuToCamera": ROWS}]}),
}


@pytest.fixture(scope="module")
def depth_drive(tmp_path_factory):
    """A recording of depth images in a video, and a function that opens it with other texts in some of its files."""
    folder = tmp_path_factory.mktemp("sources")
    with av.open(str(folder / "data.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10, options={"threads": "1"})
        stream.width, stream.height, stream.pix_fmt = 16, 16, "gray16le"
        image = np.arange(256, dtype=np.uint16).reshape(16, 16)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray16le")))
        container.mux(stream.encode())

    def look(**texts):
        for name, text in {**DEPTH_FILES, "parameters.txt": None, **texts}.items():
            (folder / name).unlink(missing_ok=True)
            if text is not None:
                (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return folder, [opens(folder, lenient=lenient, camera_shift="apply") for lenient in (False, True)]

    folder, well = look()
    assert well == [True, True]
    return look


@QUICK
@given(*(st.dictionaries(st.sampled_from(keys), JSON | MATRICES, max_size=3) for keys in (FIELDS, CAMERA_FIELDS)), JSON)
def test_any_calibration_and_depth_scale(depth_drive, fields, camera, scale):
    content = {"cameras": [{**PINHOLE, "imuToCamera": ROWS, **camera}], **fields}
    depth_drive(**{"calibration.json": json.dumps(content, allow_nan=True)})
    line = {"frames": [{"cameraInd": 0, "depthScale": scale}], "number": 0, "time": 0.0}
    depth_drive(**{"data.jsonl": json.dumps(line)})


@QUICK
@given(st.lists(st.tuples(st.sampled_from(NAMES), st.sampled_from(NUMBERS)), max_size=5), st.binary(max_size=20))
def test_any_parameters(depth_drive, parameters, noise):
    text = "".join(f"{name} {value};\n" for name, value in parameters).encode()
    for content in (text, text + noise):
        depth_drive(**{"calibration.json": None, "parameters.txt": content})


@QUICK
@given(st.text(max_size=200))
def test_any_settings(text):
    config = read_vio_config(text)
    assert len(config.settings) + len(config.strange) <= len(text.splitlines()) + 1
    assert {*config.unknown_keys} <= {setting.key for setting in config.settings}


@QUICK
@given(st.data())
def test_any_archive(tmp_path_factory, depth_drive, data):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in depth_drive()[0].iterdir():
            archive.write(file, file.name)
    content = bytearray(buffer.getvalue())
    for location in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[location] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("archive") / "drive.zip"
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content)
    FORMAT.sniff(path)
    for lenient in (False, True):
        opens(path, lenient=lenient, camera_shift="apply")
