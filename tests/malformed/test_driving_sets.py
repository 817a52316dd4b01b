"""Folders of public driving data with files that are cut off or changed: a scene or an error of ours, nothing else."""

import re
from contextlib import suppress

import numpy as np
import pytest
from tests.unit.formats.argoverse2.test_reader import write_log
from tests.unit.formats.nuscenes.schema_folder import street
from tests.unit.formats.nuscenes.test_writer import with_classes
from tests.unit.formats.pandaset.test_reader import write_drive
from tests.unit.formats.scale_toolkit.test_reader import write_folder

import sceneloom
from sceneloom.errors import SceneloomError

ODD_NUMBERS = ("1e400", "-1", "0", "null", '"a"', "1e30", "99999999999999999999999", "true", "[]", "NaN")

WRITERS = {
    "nuscenes": lambda folder: with_classes(street(folder)).write(),
    "argoverse2": write_log,
    "pandaset": write_drive,
    "scale-toolkit": write_folder,
}


def changed(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut a file, flip its bits, put other bytes in, or another number into a text."""
    trajectory, location = rng.integers(4), int(rng.integers(len(content) + 1))
    if trajectory == 0:
        return content[:location]
    if trajectory == 1:
        flipped = bytearray(content)
        flipped[location - 1] ^= 1 << int(rng.integers(8))
        return bytes(flipped)
    if trajectory == 2 or not content.isascii():
        return content[:location] + rng.bytes(int(rng.integers(9))) + content[location + 1 :]
    numbers = list(re.finditer(rb"-?\d+\.?\d*", content))
    if not numbers:
        return content
    number = numbers[int(rng.integers(len(numbers)))]
    return content[: number.start()] + str(rng.choice(ODD_NUMBERS)).encode() + content[number.end() :]


def use(root, name):
    """Open a drive and read all that is in it."""
    with sceneloom.open(root, format=name) as scene:
        for sensor in scene.sensors:
            for frame in getattr(sensor, "frames", ()):
                assert frame.points is not None
            for image in getattr(sensor, "images", ()):
                assert image.rgb.ndim == 3
        for annotation in scene.annotations:
            list(getattr(annotation, "labeled_points", ()))


def shake(root, name, count, seed):
    rng = np.random.default_rng(seed)
    files = sorted(path for path in root.rglob("*") if path.is_file())
    for _ in range(count):
        path = files[int(rng.integers(len(files)))]
        content = path.read_bytes()
        path.write_bytes(changed(content, rng))
        with suppress(SceneloomError):
            use(root, name)
        path.write_bytes(content)


@pytest.fixture
def folder(request, tmp_path):
    if request.param == "argoverse2":
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    return WRITERS[request.param](tmp_path / "drive"), request.param


@pytest.mark.parametrize("folder", WRITERS, indirect=True)
def test_a_changed_file_gives_a_scene_or_an_error_of_ours(folder):
    shake(*folder, count=12, seed=4)


@pytest.mark.slow
@pytest.mark.parametrize("folder", WRITERS, indirect=True)
def test_many_changed_files_give_a_scene_or_an_error_of_ours(folder):
    shake(*folder, count=3000, seed=5)


def test_a_table_that_is_no_text_is_known_by_its_name(tmp_path):
    root = WRITERS["nuscenes"](tmp_path / "drive")
    (root / "v1.0-mini" / "sensor.json").write_bytes(b'[{"token": "\xe7"}]')
    with pytest.raises(SceneloomError, match=r"sensor.json: is no JSON"):
        sceneloom.open(root)


def test_a_feather_file_whose_texts_lead_beyond_its_end_is_refused(tmp_path):
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    root = WRITERS["argoverse2"](tmp_path / "drive")
    path = root / "calibration" / "egovehicle_SE3_sensor.feather"
    whole = pa.feather.read_table(str(path))
    offsets = pa.py_buffer(np.array([0, 8, 1 << 30, 35], np.int32).tobytes())
    names = pa.StringArray.from_buffers(3, offsets, pa.py_buffer(b"up_lidar" * 5))
    pa.feather.write_feather(whole.set_column(0, "sensor_name", names), str(path), compression="uncompressed")
    with pytest.raises(SceneloomError, match=r"is no whole feather file"):
        sceneloom.open(root)
