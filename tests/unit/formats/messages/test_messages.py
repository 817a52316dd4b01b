"""MCAP files against the reference library, sweeps that stay packed, camera models and mosaics against OpenCV."""

import io
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import IndexType, Writer

from sceneloom.cameras import project
from sceneloom.errors import DataError, OptionError, OutputError, UnknownFormatError, UnknownOptionError
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.registry import find_format
from sceneloom.formats.messages import packets
from sceneloom.formats.messages import writer as messages_writer
from sceneloom.formats.messages.cameras import image_of, read_camera_model
from sceneloom.formats.messages.file_bytes import FileBytes
from sceneloom.formats.messages.mcap_files import McapWriter, read_index
from sceneloom.formats.messages.records import CameraModelRecord, ImageRecord
from sceneloom.formats.messages.spec import MCAP
from sceneloom.formats.messages.writer import camera_model_record, kept_record
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene

SIZES = (0, 10, 3000, 1_500_000, 40)
MESSAGES = [(k % 2, 1000 + 7 * k, np.random.default_rng(k).bytes(SIZES[k % len(SIZES)])) for k in range(12)]
"""Topic, time and bytes of each message; one in five fills a chunk of its own."""


def written(compression):
    stream = io.BytesIO()
    writer = McapWriter(stream, profile="test", library="ours", compression=compression)
    schema = writer.add_schema("a.Type", "protobuf", b"schema")
    channels = [writer.add_channel(f"/{name}", "protobuf", schema, {"reported": name}) for name in "ab"]
    for topic, time_ns, content in MESSAGES:
        half = len(content) // 2
        writer.add_message(channels[topic], time_ns, [content[:half], memoryview(content)[half:]], time_ns + 1)
    writer.add_metadata("notes", {"é": "ü"})
    writer.finish()
    return stream.getvalue()


def read(path):
    """Topic, time and bytes of all messages, in the order of the file, and the metadata."""
    with closing(FileBytes(path)) as file:
        index = read_index(file, Ledger(lenient=False))
        found = []
        for number, channel in index.channels.items():
            entries = index.messages.entries(number)
            contents = [bytes(index.messages.data(entries, k)) for k in range(len(entries))]
            heads = list(index.messages.heads(entries, np.arange(len(entries)), 16))
            assert heads == [content[:16] for content in contents]
            found += zip([channel.topic] * len(entries), entries.log_times_ns.tolist(), contents, strict=True)
        return sorted(found, key=lambda message: message[1]), index.metadata


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_the_reference_library_reads_what_we_write_and_so_do_we(compression, tmp_path):
    (tmp_path / "log.mcap").write_bytes(written(compression))
    reader = make_reader(io.BytesIO(written(compression)), validate_crcs=True)
    assert (reader.get_header().profile, reader.get_header().library) == ("test", "ours")
    found = [(channel.topic, m.log_time, m.data) for _, channel, m in reader.iter_messages(log_time_order=True)]
    assert found == [(f"/{'ab'[topic]}", time_ns, content) for topic, time_ns, content in MESSAGES]
    assert read(tmp_path / "log.mcap") == (found, [("notes", {"é": "ü"})])
    # written again by that library, without any index
    with (tmp_path / "log.mcap").open("wb") as stream:
        writer = Writer(stream, index_types=IndexType.NONE, use_statistics=False, use_summary_offsets=False)
        writer.start("", "theirs")
        schema = writer.register_schema("a.Type", "protobuf", b"schema")
        channels = {f"/{name}": writer.register_channel(f"/{name}", "protobuf", schema) for name in "ab"}
        for topic, time_ns, content in found:
            writer.add_message(channels[topic], time_ns, content, time_ns)
        writer.add_metadata("notes", {"é": "ü"})
        writer.finish()
    assert read(tmp_path / "log.mcap") == (found, [("notes", {"é": "ü"})])
    statistics = reader.get_summary().statistics
    assert (statistics.message_count, statistics.schema_count, statistics.channel_count) == (12, 1, 2)
    assert (statistics.message_start_time, statistics.message_end_time) == (1000, 1077)
    assert statistics.channel_message_counts == {1: 6, 2: 6}
    assert statistics.chunk_count == len(reader.get_summary().chunk_indexes) >= 3
    assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("notes", {"é": "ü"})]
    (schema,) = reader.get_summary().schemas.values()
    assert (schema.name, schema.encoding, schema.data) == ("a.Type", "protobuf", b"schema")


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_large_messages_stand_apart_where_chunks_are_compressed_and_each_chunk_says_its_channels(compression, tmp_path):
    stream = io.BytesIO()
    writer = McapWriter(stream, library="ours", compression=compression, chunk_bytes=50_000, large_apart=True)
    schema = writer.add_schema("a.Type", "protobuf", b"schema")
    large, small = (writer.add_channel(f"/{name}", "protobuf", schema) for name in ("large", "small"))
    for k in range(200):
        writer.add_message(small, 10 * k, [bytes(100)])
        writer.add_message(large, 10 * k + 5, [bytes([k]) * 20_000])
    writer.finish()
    (tmp_path / "log.mcap").write_bytes(stream.getvalue())
    with closing(FileBytes(tmp_path / "log.mcap")) as file:
        index = read_index(file, Ledger(lenient=False))
    chunks = [set(index.messages.entries(number).chunks.tolist()) for number in (large, small)]
    if compression != "none":
        assert (chunks[0] & chunks[1], len(chunks[1])) == (set(), 1)  # all small ones in one chunk, which comes last
    # who reads from the beginning to the end knows each channel before its first message
    stream.seek(0)
    records = [one for one in StreamReader(stream).records if isinstance(one, Channel | Message)]
    known = {one.id: k for k, one in reversed([*enumerate(records)]) if isinstance(one, Channel)}
    messages = [(k, one.channel_id) for k, one in enumerate(records) if isinstance(one, Message)]
    assert len(messages) == 400
    assert all(k > known[channel] for k, channel in messages)


def test_damaged_chunks_and_what_is_no_mcap_file_are_refused_with_what_was_expected(tmp_path):
    damaged = bytearray(written("lz4"))
    damaged[damaged.index(MESSAGES[2][2][100:120])] ^= 1  # noise is not compressed, so it stands there as it is
    huge = written("zstd")
    size = 17 + int.from_bytes(huge[9:17], "little") + 9 + 16  # after the magic, the header and the chunk's times
    huge = huge[:size] + (1 << 30).to_bytes(8, "little") + huge[size + 8 :]
    refused = {bytes(damaged): r"chunk \d: ", huge: r"chunk 0: \d+ bytes that unpack to 1073741824; expected"}
    refused |= dict.fromkeys((b"", b"\x89MCAP0", b"not one"), "does not begin as an MCAP file does")
    for content, problem in {**refused, b"\x89MCAP0\r\n" * 2: "not finished"}.items():
        (tmp_path / "log.mcap").write_bytes(content)
        with pytest.raises(DataError, match=problem):
            read(tmp_path / "log.mcap")


def test_times_compressions_options_and_names_that_the_format_lacks_are_refused(tmp_path):
    with pytest.raises(OptionError, match="none, lz4, zstd"):
        McapWriter(io.BytesIO(), library="", compression="brotli")
    writer = McapWriter(io.BytesIO(), library="")
    channel = writer.add_channel("/a", "json", 0)
    with pytest.raises(OutputError, match="-5 ns"):
        writer.add_message(channel, -5, [b""])
    path = tmp_path / "drive.mcap"
    path.write_bytes(b"no log")
    with pytest.raises(UnknownFormatError, match="called like an MCAP file"):
        find_format(path)
    with pytest.raises(UnknownOptionError, match="timestamps, ego, world"):
        MCAP.open(path, stamp="header")


WITHOUT = """
import sys, importlib.abc
class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] in {"google", "foxglove_schemas_protobuf", "rosbags", "ruamel"}:
            raise ImportError(f"No module named {name!r}")
sys.meta_path.insert(0, Missing())
import sceneloom
for target, extra in (("a.mcap", "mcap"), ("a.bag", "ros"), ("a.ros2", "ros")):
    try:
        sceneloom.write(sceneloom.Scene(()), target)
    except sceneloom.errors.MissingExtraError as error:
        assert f"sceneloom[{extra}]" in str(error), error
    else:
        raise SystemExit(f"{target} was written")
"""


def test_without_the_extras_a_person_is_reported_which_to_install(tmp_path):
    done = subprocess.run([sys.executable, "-c", WITHOUT], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


COUNT = 50
TIMESTAMPS = np.array([1_000_000_000, 1_100_000_000])


def points(k):
    rows = np.random.default_rng(k)
    return LidarPoints(
        rows.normal(size=(COUNT, 3)).astype(np.float32),
        intensities=np.arange(COUNT, dtype=np.uint8),
        colors=rows.integers(0, 256, (COUNT, 3), np.uint8),
        timestamps_ns=TIMESTAMPS[k] + np.arange(COUNT) * 1_000,
        rings=np.arange(COUNT, dtype=np.uint16),
        camera_index=np.full(COUNT, k, np.uint8),
        extras={"range": rows.random(COUNT, np.float32)},
    )


def write(path, *sweeps):
    frames = [LidarFrame(int(time), one) for time, one in zip(TIMESTAMPS, sweeps, strict=False)]
    write_scene(Scene((LidarSensor("top", LazyFrames.of(frames, TIMESTAMPS[: len(frames)].tolist())),)), path)
    return path


@pytest.fixture
def log(tmp_path):
    return write(tmp_path / "log.mcap", points(0), points(1))


def test_sweeps_of_a_log_stay_packed_until_a_field_is_asked_for_and_are_the_same_in_a_copy(log, tmp_path):
    with open_scene(log) as scene:
        frame = scene.lidars[0].frames[1]
        assert (frame.points.packed_count(), len(frame.points)) == (COUNT, COUNT)
        np.testing.assert_array_equal(frame.points.positions, points(1).positions)
        assert frame.points.packed_count() is None
        write_scene(scene, tmp_path / "copy.mcap")
    with open_scene(tmp_path / "copy.mcap") as copy:
        for k, frame in enumerate(copy.lidars[0].frames):
            expected = points(k)
            for name in ("positions", "intensities", "colors", "timestamps_ns", "rings", "camera_index"):
                np.testing.assert_array_equal(getattr(frame.points, name), getattr(expected, name), name)
            np.testing.assert_array_equal(frame.points.extras["range"], expected.extras["range"])
    with open_scene(log) as scene:
        frame = scene.lidars[0].frames[0]
        assert kept_record(frame.points, frame.timestamp_ns) is not None
        moved = replace(frame, timestamp_ns=frame.timestamp_ns + 1)
        assert kept_record(moved.points, moved.timestamp_ns) is None
        assert kept_record(points(0), frame.timestamp_ns) is None


def test_a_sweep_without_points_is_written_with_all_its_fields(tmp_path):
    empty = LidarPoints(np.zeros((0, 3), np.float32), intensities=np.zeros(0, np.uint8), rings=np.zeros(0, np.uint16))
    with open_scene(write(tmp_path / "log.mcap", empty, points(1))) as scene:
        first, second = (frame.points for frame in scene.lidars[0].frames)
        assert (len(first), first.rings.shape, first.intensities.shape) == (0, (0,), (0,))
        np.testing.assert_array_equal(second.positions, points(1).positions)


def test_logs_that_state_times_in_their_older_column_are_read(tmp_path, monkeypatch):
    def old(times, timestamp):
        return {("offset_ns",): (times - timestamp).astype(np.int32)}

    monkeypatch.setattr(messages_writer, "_offsets", old)
    write(tmp_path / "old.mcap", points(0))
    monkeypatch.undo()
    with open_scene(tmp_path / "old.mcap") as read:
        np.testing.assert_array_equal(read.lidars[0].frames[0].points.timestamps_ns, points(0).timestamps_ns)
        write_scene(read, tmp_path / "new.mcap")
    with open_scene(tmp_path / "new.mcap") as read:
        found = read.lidars[0].frames[0].points
        np.testing.assert_array_equal(found.timestamps_ns, points(0).timestamps_ns)
        assert "offset_ns" not in found.extras


K = (500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0)
D = (0.1, -0.05, 0.001, 0.002, 0.01, 0.02, 0.003, 0.001, 0.001, 0.002, 0.003, 0.004, 0.01, 0.02)
POINTS = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [1, 0.7, 0] + [0, 0, 3]


def camera_model(model, coefficients, k=K):
    return read_camera_model(
        CameraModelRecord(0, "c", 640, 480, model, coefficients, k), "file", "camera_model", Ledger(lenient=False)
    )


@pytest.mark.parametrize(
    ("model", "count"), [("plumb_bob", 5), ("rational_polynomial", 8), ("rational_polynomial", 14), ("equidistant", 4)]
)
def test_camera_models_project_as_opencv_does(model, count):
    camera = camera_model(model, D[:count])
    nothing, matrix = np.zeros(3), np.reshape(K, (3, 3))
    of = cv2.fisheye if model == "equidistant" else cv2
    expected = of.projectPoints(POINTS[:, None], nothing, nothing, matrix, np.array(D[:count]))[0][:, 0]
    pixels, visible = project(camera, POINTS)
    assert visible.all()
    np.testing.assert_allclose(pixels, expected, atol=1e-9)  # float64, some hundred pixels
    written = camera_model_record(camera, 0, "c", "equidistant")
    if count < 14:
        assert (written.model, written.coefficients) == (model, D[:count])
    assert read_camera_model(written, "file", "camera_model", Ledger(lenient=False)) == camera


def test_a_calibration_of_zeros_is_none_and_unknown_models_are_refused():
    assert camera_model("plumb_bob", (), (0.0,) * 9) is None
    with pytest.raises(DataError, match=r"'fisheye62'; expected one of .*plumb_bob"):
        camera_model("fisheye62", D[:7])
    with pytest.raises(DataError, match="8 coefficients of plumb_bob; expected at most 5"):
        camera_model("plumb_bob", D[:8])


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_are_filled_as_opencv_does(pattern):
    mosaic = np.random.default_rng(1).integers(0, 256, (20, 30), np.uint8)
    record = ImageRecord(0, "c", f"bayer_{pattern}8", 30, 20, 30, memoryview(mosaic.reshape(-1)))
    inner = slice(1, -1), slice(1, -1)  # OpenCV repeats its borders
    expected = cv2.cvtColor(mosaic, getattr(cv2, f"COLOR_Bayer{pattern.upper()}2RGB"))
    difference = image_of(record, "file", "image").astype(int) - expected
    assert np.abs(difference[inner]).max() <= 1  # the two round halves differently


def test_velocities_of_radar_objects_keep_a_direction_of_length_one_and_stay_unknown_where_they_are():
    velocities = np.array([[3.0, -4.0], [0.0, 0.0], [np.nan, 2.0], [0.5, np.nan]], np.float32)
    directions = [[0.6, -0.8, 0.0], *[[1.0, 0.0, 0.0]] * 3]
    rows = np.zeros(5, packets._OBJECT)
    rows["relative_velocity_x"][:4], rows["relative_velocity_y"][:4] = velocities.T
    rows["relative_velocity_x"][4] = np.inf
    rows["position_x"] = 1 + np.arange(5)
    ego = {"ego_vx": 2.0, "ego_yaw_rate": 0.0}
    columns = {name: np.ones(4, np.float32) for name in ("dist_x", "dist_y", "reserved")}
    columns |= {"v_abs_x": velocities[:, 0] + np.float32(2), "v_abs_y": velocities[:, 1]}
    for points in (packets._objects(rows), packets._can_objects(columns, ego)):
        np.testing.assert_allclose(points.directions[:4], directions, atol=1e-7)
        np.testing.assert_array_equal(points.lengths[:4], [5.0, 0.0, np.nan, np.nan])
    rows["position_x"][1], rows["position_invalid_flags"][2] = np.nan, 1
    assert packets._objects(rows).positions[:, 0].tolist() == [1, 4, 5]
    assert (packets._objects(rows).lengths[-1], *packets._objects(rows).directions[-1]) == (np.inf, 1, 0, 0)
    rows["relative_velocity_invalid_flags"][0] = 1
    np.testing.assert_array_equal(packets._objects(rows).lengths, [np.nan, np.nan, np.inf])


def test_radar_detections_of_unknown_velocities_have_none():
    rows = np.zeros(3, packets._DETECTION)
    rows["range"], rows["range_rate"], rows["invalid_flags"] = 10.0, [-3.0, 4.0, 5.0], [0, 0b1000000, 0b100]
    np.testing.assert_array_equal(packets._detections(rows).lengths, [-3.0, np.nan])
