"""Mutants of drives, many of each format: a scene or an error of ours, in bounded time and memory."""

import sys
from contextlib import suppress

import numpy as np
import pytest
from tests.malformed.mutants import (
    ALL_DRIVES,
    DRIVES,
    OTHER_DRIVES,
    STRANGERS,
    kinds_of_files,
    mutant_of,
    read,
    rewrite_bag,
    try_mutants,
)

from sceneloom.detections.settings import read_detectors
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats import open_scene, write_scene
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene
from sceneloom.service.running import read_configuration_file

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="memory of processes is bounded on Linux only")

FEW, MANY = 8, 2000
GUARDED = "mcap lz4"  # a drive of packed chunks with checksums, which few changes get by
ALWAYS = {"openlabel", "recording", "mcap"}
"""Drives whose files are replaced in the usual run; the others follow in the long one."""


@on_linux
@pytest.mark.few(7)
@pytest.mark.parametrize("name", DRIVES)
def test_a_mutant_of_a_drive_gives_a_scene_or_an_error_of_ours(name):
    tried = try_mutants(name, range(FEW))
    assert not tried.failures, str(tried)
    assert sum(tried.outcomes.values()) == FEW


@on_linux
@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVES | STRANGERS)
def test_many_mutants_of_a_drive_or_of_files_of_others_give_a_scene_or_an_error_of_ours(name, request):
    if name in STRANGERS and not (request.getfixturevalue("data_dir") / "real" / "strangers").is_dir():
        pytest.skip("no files of others beside the real data")
    tried = try_mutants(name, range(FEW, FEW + MANY), seconds=45)
    assert not tried.failures, str(tried)
    if name in DRIVES:
        assert set(tried.outcomes) >= ({"refused"} if name == GUARDED else {"scene", "refused"})


@on_linux
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in ALWAYS else pytest.mark.slow)
        for name in DRIVES | OTHER_DRIVES
        if " " not in name
    ],
)
def test_what_is_no_file_and_what_is_static_in_the_position_of_any_file_is_refused_and_never_waited_for(name):
    if name in {"argoverse2", "waymo"}:
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    tried = try_mutants(name, None)
    assert not tried.failures, str(tried)
    assert tried.outcomes["refused"]


LONG = "9" * 5000
DEEP = "[" * 100_000 + "]" * 100_000


def test_texts_with_infinite_numbers_and_depths_or_of_other_letters_are_faults_of_the_file(tmp_path):
    path = tmp_path / "file.toml"
    for text in (f"a = {LONG}", f"a = {DEEP}", f"[{'a.' * 20_000}a]"):
        path.write_text(text)
        for reader in (read_detectors, read_configuration_file, lambda path: open_scene(path, format="rig")):
            with pytest.raises(SceneloomError):
                reader(path)
    root = ALL_DRIVES["nuscenes"](tmp_path)
    (root / "v1.0-mini" / "sensor.json").write_bytes(b'[{"token": "\xe7"}]')
    with pytest.raises(SceneloomError, match=r"sensor.json: line 1, column 13: is no JSON: Invalid UTF-8"):
        open_scene(root)


@pytest.mark.parametrize(
    ("name", "file", "word"),
    [("segments", "release.json", b'"cuboid"'), ("supervisely", "annotation.json", b'"position"')],
)
def test_other_letters_in_parts_of_json_that_are_read_later_are_faults_of_the_file(tmp_path, name, file, word):
    root = ALL_DRIVES[name](tmp_path)
    path = next(root.rglob(file))
    path.write_bytes(path.read_bytes().replace(word, word[:2] + b"\xe7" + word[3:], 1))
    with pytest.raises(SceneloomError, match=rf"{file}: .*is no JSON: Invalid UTF-8"):
        open_scene(root)


def test_metadata_of_a_bag_with_infinite_numbers_and_depths_are_faults_of_the_file(tmp_path):
    pytest.importorskip("ruamel.yaml", reason="ruamel.yaml is not installed")
    drive = ALL_DRIVES["ros2"](tmp_path)
    for text in (f"rosbag2_bagfile_information: {LONG}", "- " * 20_000, f"a: {DEEP[:20_000]}"):
        (drive / "metadata.yaml").write_text(text)
        with pytest.raises(DataError, match=r"metadata.yaml: cannot be read"):
            open_scene(drive, format="ros2")
    (drive / "metadata.yaml").write_text("rosbag2_bagfile_information: " + "[" * 100_000)
    with pytest.raises(DataError, match=r"metadata\.yaml.*nested deeper than 64 levels"):
        open_scene(drive, format="ros2")


FOLDERS = ["kitti-raw", "kitti-object", "kitti-tracking", "kitti-odometry", "nuscenes", "argoverse2", "pandaset"]
FOLDERS += ["kitti-360", "waymo", "zod", "scale-toolkit", "euroc-mav"]
FOLDERS += ["supervisely", "segments", "scale-task", "sustechpoints"]


@pytest.mark.parametrize("count", [1, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FOLDERS)
def test_a_file_of_each_kind_that_is_changed_empty_or_gone_is_a_fault_or_does_no_harm(name, count, tmp_path):
    if name in {"argoverse2", "waymo"}:
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    drive, chance = ALL_DRIVES[name](tmp_path), np.random.default_rng(4)
    for file, *_ in kinds_of_files(drive):
        whole = file.read_bytes()
        changed = [mutant_of(whole, chance) for _ in range(count)]
        for content in (whole[: int(chance.integers(len(whole) + 1))], *changed, b"", None):
            file.unlink() if content is None else file.write_bytes(content)
            for lenient in (False, True):
                with suppress(SceneloomError):
                    read(drive, name, lenient=lenient)
        file.write_bytes(whole)
    read(drive, name)


def test_a_feather_file_whose_texts_lead_beyond_its_end_is_refused(tmp_path):
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    root = ALL_DRIVES["argoverse2"](tmp_path)
    path = root / "calibration" / "egovehicle_SE3_sensor.feather"
    whole = pa.feather.read_table(str(path))
    offsets = pa.py_buffer(np.array([0, 8, 1 << 30, 35], np.int32).tobytes())
    names = pa.StringArray.from_buffers(3, offsets, pa.py_buffer(b"up_lidar" * 5))
    pa.feather.write_feather(whole.set_column(0, "sensor_name", names), str(path), compression="uncompressed")
    with pytest.raises(SceneloomError, match=r"is no whole feather file"):
        open_scene(root)


TIMESTAMPS = [1_000_000_000, 1_100_000_000]
POINTS = np.arange(30, dtype=np.float32).reshape(-1, 3)


@pytest.fixture
def bag(tmp_path):
    frames = [LidarFrame(timestamp, LidarPoints(POINTS)) for timestamp in TIMESTAMPS]
    path = tmp_path / "log.bag"
    write_scene(Scene((LidarSensor("top", LazyFrames.of(frames, TIMESTAMPS)),)), path)
    return path


@pytest.mark.parametrize(
    ("mark", "step", "byte", "reported"),
    [
        (b"message_definition=", -2, 0x7F, "Declared field size"),  # a damaged connection
        (b"op=\x05", 3, 0x75, "an index before any chunk"),
    ],
)
def test_a_damaged_record_of_a_bag_is_a_fault_and_what_is_whole_is_read_without_it(bag, mark, step, byte, reported):
    content = bytearray(bag.read_bytes())
    content[(content.rfind if step < 0 else content.find)(mark) + step] = byte
    bag.write_bytes(bytes(content))
    with pytest.raises(DataError, match=rf"log.bag: byte \d+: the record is damaged: {reported}"):
        open_scene(bag)
    if step < 0:
        with open_scene(bag, lenient=True) as scene:
            assert [len(frame.points) for frame in scene.lidars[0].frames] == [len(POINTS)] * 2


def test_a_chunk_of_a_bag_that_declares_to_become_far_more_is_refused_before_memory_is_asked_for(tmp_path):
    path = ALL_DRIVES["ros1 lz4"](tmp_path)
    content = path.read_bytes()
    size = content.index(b"size=", content.index(b"compression=lz4") - 60) + 5
    path.write_bytes(content[:size] + (1 << 30).to_bytes(4, "little") + content[size + 4 :])
    with pytest.raises(DataError, match=r"chunk 0: \d+ bytes that unpack to 1073741824; expected 67108864"):
        open_scene(path)


@pytest.mark.parametrize("kind", ["TFMessage", "Odometry", "Detection3DArray", "Imu"])
@pytest.mark.few(2)
def test_orientations_beyond_what_can_be_squared_are_faults_and_no_warnings(tmp_path, kind):
    """Warnings are errors here: squares of such numbers overflow."""
    touched = 0

    def rotate(type_name, message):
        nonlocal touched
        touched += _rotated(message, 1e200) if type_name.endswith(kind) else 0
        return message

    path = rewrite_bag(ALL_DRIVES["ros1"](tmp_path), tmp_path / "other.bag", rotate)
    assert touched
    if kind == "TFMessage":
        with pytest.raises(DataError, match=r"transform .* of length inf; expected finite numbers"):
            open_scene(path)
        return
    with open_scene(path, lenient=True) as scene:
        assert scene.warnings or kind == "Imu"
        for sensor in scene.sensors:
            for frame in getattr(sensor, "frames", ()):
                assert frame.points is not None


def _rotated(message, number):
    """Set the last element of each quaternion in a message; state of how many."""
    if isinstance(message, list):
        return sum(_rotated(part, number) for part in message)
    if type(message).__name__.endswith("Quaternion"):
        message.w = number
        return 1
    return sum(_rotated(part, number) for part in getattr(message, "__dict__", {}).values())
