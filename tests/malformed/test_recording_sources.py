"""Whatever stands in the files beside the lines of a recording, opening it gives a scene or an error of ours."""

import io
import json
import zipfile
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sceneloom.errors import SceneloomError
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.formats.recording.vio_config import read_vio_config, repeated_keys
from sceneloom.formats.recording.writer import unknown_keys

LINES = [
    {"sensor": {"type": "gyroscope", "values": [0.0, 0.1, 0.2]}, "time": 0.0},
    {"gps": {"latitude": 60.0, "longitude": 24.0, "altitude": 3.0}, "time": 0.0},
    {"frames": [{"cameraInd": 0, "depthScale": 0.001}], "number": 0, "time": 0.0},
]
CAMERA_MODEL = {
    "model": "pinhole",
    "focalLengthX": 20.0,
    "focalLengthY": 20.0,
    "principalPointX": 7.5,
    "principalPointY": 7.5,
    "imuToCamera": np.eye(4).tolist(),
}
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from("xyzw"), inner, max_size=4),
    max_leaves=20,
)
MATRICES = st.lists(st.lists(st.floats(-2, 2), min_size=3, max_size=4), min_size=3, max_size=4) | st.lists(
    st.floats(-2, 2), min_size=9, max_size=16
)
FIELDS = st.sampled_from(["imuToGnss", "imuToOutput", "imuToMagnetometer", "imuForward", "cameras", "lidars", "other"])
CAMERA_FIELDS = st.sampled_from(
    ["imuToCamera", "imuToCameraShiftSeconds", "shutterRollTimeSeconds", "exposureTimeSeconds", "model"]
)
NAMES = ["focalLength", "secondFocalLengthX", "imuToCameraMatrix", "distortionCoeffs", "fisheyeCamera", "rot", "x"]
NUMBERS = ["1", "-1", "0,0,0", "1,0,0,0,1,0,0,0,1", "true", "nan", "1e999", "a b", ""]
PARAMETERS = st.lists(st.tuples(st.sampled_from(NAMES), st.sampled_from(NUMBERS)), max_size=5)
QUICK = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def write_drive(folder, lines=LINES):
    folder.mkdir()
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with av.open(str(folder / "data.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10, options={"threads": "1"})
        stream.width, stream.height, stream.pix_fmt = 16, 16, "gray16le"
        image = np.arange(256, dtype=np.uint16).reshape(16, 16)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray16le")))
        container.mux(stream.encode())
    (folder / "calibration.json").write_text(json.dumps({"cameras": [CAMERA_MODEL]}))
    return folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return write_drive(tmp_path_factory.mktemp("sources") / "drive")


def look(path: Path) -> None:
    """Open strictly and leniently, and read every depth image."""
    for lenient in (False, True):
        try:
            with FORMAT.open(path, lenient=lenient, camera_shift="apply") as scene:
                for sensor in scene.sensors:
                    for frame in getattr(sensor, "frames", ()):
                        assert frame.depth.shape == (16, 16)
        except SceneloomError:
            continue


@QUICK
@given(
    st.dictionaries(FIELDS, JSON | MATRICES, max_size=3), st.dictionaries(CAMERA_FIELDS, JSON | MATRICES, max_size=3)
)
def test_any_calibration(drive, fields, camera):
    content = {"cameras": [{**CAMERA_MODEL, **camera}], **fields}
    (drive / "calibration.json").write_text(json.dumps(content, allow_nan=True))
    look(drive)
    (drive / "calibration.json").write_text(json.dumps({"cameras": [CAMERA_MODEL]}))


@QUICK
@given(PARAMETERS, st.binary(max_size=20))
def test_any_parameters(drive, parameters, noise):
    (drive / "calibration.json").unlink()
    text = "".join(f"{name} {value};\n" for name, value in parameters).encode()
    for content in (text, text + noise):
        (drive / "parameters.txt").write_bytes(content)
        look(drive)
    (drive / "calibration.json").write_text(json.dumps({"cameras": [CAMERA_MODEL]}))
    (drive / "parameters.txt").unlink()


@QUICK
@given(JSON)
def test_any_depth_scale(drive, scale):
    before = (drive / "data.jsonl").read_bytes()
    line = {"frames": [{"cameraInd": 0, "depthScale": scale}], "number": 0, "time": 0.0}
    (drive / "data.jsonl").write_text(json.dumps(line) + "\n")
    look(drive)
    (drive / "data.jsonl").write_bytes(before)


@QUICK
@given(st.text(max_size=200))
def test_any_settings(text):
    config = read_vio_config(text)
    assert len(config.settings) + len(config.strange) <= len(text.splitlines()) + 1
    assert set(unknown_keys(text)) <= {setting.key for setting in config.settings}
    assert set(repeated_keys(text)) <= {setting.key for setting in config.settings}


@QUICK
@given(st.data())
def test_any_archive(tmp_path_factory, drive, data):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in drive.iterdir():
            archive.write(file, file.name)
    content = bytearray(buffer.getvalue())
    for location in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[location] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("archive") / "drive.zip"
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content)
    FORMAT.sniff(path)
    look(path)
