"""Bags of ROS 1 with damaged records: a fault with its location, and without it what is whole."""

import numpy as np
import pytest
from tests.malformed.mutants import ALL_DRIVES, rewrite_bag

from sceneloom.errors import DataError
from sceneloom.formats import open_scene, write_scene
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene

pytest.importorskip("rosbags")

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
def test_a_damaged_record_is_a_fault_and_what_is_whole_is_read_without_it(bag, mark, step, byte, reported):
    content = bytearray(bag.read_bytes())
    content[(content.rfind if step < 0 else content.find)(mark) + step] = byte
    bag.write_bytes(bytes(content))
    with pytest.raises(DataError, match=rf"log.bag: byte \d+: the record is damaged: {reported}"):
        open_scene(bag)
    if step < 0:
        with open_scene(bag, lenient=True) as scene:
            assert [len(frame.points) for frame in scene.lidars[0].frames] == [len(POINTS)] * 2


def test_a_chunk_that_declares_to_become_far_more_is_refused_before_memory_is_asked_for(tmp_path):
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


def test_metadata_nested_without_end_are_refused_before_they_are_parsed(tmp_path):
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: " + "[" * 100_000)
    with pytest.raises(DataError, match=r"metadata\.yaml.*nested deeper than 64 levels"):
        open_scene(tmp_path, format="ros2")
