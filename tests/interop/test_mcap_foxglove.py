"""MCAP files that the reference library writes with Foxglove's own classes, and ours as that library reads them."""

import base64
import io
import json
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from tests.properties.injected import injected_scene

import sceneloom
from sceneloom import scene as sc
from sceneloom.errors import DataError
from sceneloom.formats.messages.mcap import schema_bytes

EPOCH_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
SPEED = 10.0
RGB = np.random.default_rng(3).integers(0, 255, (8, 12, 3), np.uint8)


@cache
def injected():
    return injected_scene(odd=False)


def foxglove(name):
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


def time(timestamp_ns):
    return {"seconds": timestamp_ns // 10**9, "nanos": timestamp_ns % 10**9}


def rotation_left(angle=np.pi / 2):
    return {"z": np.sin(angle / 2), "w": np.cos(angle / 2)}


class Log:
    """Writes a file as any other program would."""

    def __init__(self, **options):
        self.stream = io.BytesIO()
        self.writer = Writer(self.stream, **{"compression": CompressionType.NONE, **options})
        self.writer.start(profile="", library="another program")
        self.channels = {}

    def add(self, topic, name, timestamp_ns, *, late_ns=5_000_000, **fields):
        if (topic, name) not in self.channels:
            schema = self.writer.register_schema(f"foxglove.{name}", "protobuf", schema_bytes(foxglove(name)))
            self.channels[topic, name] = self.writer.register_channel(topic, "protobuf", schema)
        content = foxglove(name)(**fields).SerializeToString()
        self.writer.add_message(self.channels[topic, name], timestamp_ns + late_ns, content, timestamp_ns)

    def add_other(self, topic, name, encoding, content, timestamp_ns):
        if (topic, name) not in self.channels:
            schema = self.writer.register_schema(name, encoding, b"")
            self.channels[topic, name] = self.writer.register_channel(topic, encoding.removesuffix("schema"), schema)
        self.writer.add_message(self.channels[topic, name], timestamp_ns, content, timestamp_ns)

    def saved(self, path):
        self.writer.finish()
        path.write_bytes(self.stream.getvalue())
        return path


def cloud_fields(timestamp_ns, points, frame="lidar_top"):
    table = np.zeros(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pad", "<f4"), ("t", "<u4"), ("i", "u1")])
    for axis, column in zip("xyz", points.T, strict=True):
        table[axis] = column
    table["t"] = np.linspace(0, 0.99 * PERIOD_NS, len(points))
    table["i"] = np.arange(len(points)) % 256
    offsets = {"x": (0, 7), "y": (4, 7), "z": (8, 7), "t": (16, 5), "intensity": (20, 1)}
    return {
        "timestamp": time(timestamp_ns),
        "frame_id": frame,
        "point_stride": table.dtype.itemsize,
        "fields": [{"name": n, "offset": o, "type": t} for n, (o, t) in offsets.items()],
        "data": table.tobytes(),
    }


POINTS = np.random.default_rng(1).normal(0, 20, (500, 3)).astype(np.float32)
K = [100.0, 0, 5.5, 0, 101.0, 3.5, 0, 0, 1]


def drive(**options):
    """A car that goes 10 m/s along x; its lidar sits 2 m above it and looks left, its camera looks ahead."""
    log = Log(**options)
    fixed = [
        {"timestamp": time(EPOCH_NS), "parent_frame_id": "base_link", "child_frame_id": "lidar_top",
         "translation": {"z": 2.0}, "rotation": rotation_left()},
        {"timestamp": time(EPOCH_NS), "parent_frame_id": "base_link", "child_frame_id": "front_optical",
         "translation": {"x": 1.5}, "rotation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}},
    ]  # fmt: skip
    log.add("/tf_static", "FrameTransforms", EPOCH_NS, transforms=fixed)
    for k in range(5):
        timestamp = EPOCH_NS + k * PERIOD_NS
        log.add(
            "/tf", "FrameTransform", timestamp, timestamp=time(timestamp), parent_frame_id="map",
            child_frame_id="base_link",
            translation={"x": SPEED * k * 0.1}, rotation={"w": 1.0},
        )  # fmt: skip
        log.add("/top/points", "PointCloud", timestamp, **cloud_fields(timestamp, POINTS))
        jpeg = simplejpeg.encode_jpeg(RGB, 95, "RGB", "444")
        log.add("/front/image/compressed", "CompressedImage", timestamp, timestamp=time(timestamp),
        frame_id="front_optical",
                format="jpeg", data=jpeg)  # fmt: skip
        log.add("/front/camera_info", "CameraCalibration", timestamp, timestamp=time(timestamp),
        frame_id="front_optical",
                width=12, height=8, distortion_model="plumb_bob", K=K, D=[0.1, -0.05, 0.001, 0.002, 0.01])  # fmt: skip
        log.add("/side/image", "RawImage", timestamp, timestamp=time(timestamp), frame_id="side", width=12, height=8,
                encoding="bgr8", step=36, data=np.ascontiguousarray(RGB[:, :, ::-1]).tobytes())  # fmt: skip
        depth = (np.arange(96).reshape(8, 12) * 100).astype("<u2")
        log.add("/depth/image", "RawImage", timestamp, timestamp=time(timestamp), frame_id="front_optical", width=12,
                height=8, encoding="16UC1", step=24, data=depth.tobytes())  # fmt: skip
        log.add("/gnss/fix", "LocationFix", timestamp, timestamp=time(timestamp), frame_id="base_link",
        latitude=48.0 + k,
                longitude=11.0, altitude=500.0, position_covariance_type=2,
                position_covariance=[4.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0])  # fmt: skip
        # an object that stands at (50, 3, 1) in the world, reported in the frame of the car, rotated by 0.3
        log.add("/objects", "SceneUpdate", timestamp, entities=[{
            "timestamp": time(timestamp), "frame_id": "base_link", "id": "car 7",
            "metadata": [{"key": "category", "value": "car"}, {"key": "score", "value": "0.75"}],
            "cubes": [{"pose": {"position": {"x": 50 - SPEED * k * 0.1, "y": 3, "z": 1},
            "orientation": rotation_left(0.3)},
                       "size": {"x": 4, "y": 2, "z": 1.5}}],
        }])  # fmt: skip
        corners = [(10.0, 20.0), (15.0, 20.0), (15.0, 28.0), (10.0, 28.0)]
        log.add("/front/annotations", "ImageAnnotations", timestamp, points=[{
            "timestamp": time(timestamp), "type": 2, "points": [{"x": x, "y": y} for x, y in corners],
            "metadata": [{"key": "id", "value": "box 1"}, {"key": "class", "value": "person"}],
        }], circles=[{"timestamp": time(timestamp)}])  # fmt: skip
        log.add("/rosout", "Log", timestamp, message="hello")
    return log


NO_SUMMARY = {
    "index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False,
    "use_summary_offsets": False,
}  # fmt: skip


@pytest.fixture(
    scope="module",
    params=[
        {},
        {"compression": CompressionType.LZ4, "chunk_size": 4000},
        {"compression": CompressionType.ZSTD},
        {"use_chunking": False},
        NO_SUMMARY,
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False, "chunk_size": 2000},
        {"index_types": IndexType.CHUNK, "compression": CompressionType.ZSTD},
    ],
)
def scene(request, tmp_path_factory):
    """A drive that another program wrote, whatever its chunks and index."""
    path = drive(**request.param).saved(tmp_path_factory.mktemp("foxglove") / "drive.mcap")
    with sceneloom.open(path) as opened:
        yield opened


def test_topics_become_sensors_with_all_that_they_measured(scene):
    assert scene.format == "mcap"
    kinds = {sensor.id: sensor.type for sensor in scene.sensors}
    assert kinds == {"top": "lidar", "front": "camera", "side": "camera", "depth": "depth_camera", "gnss": "gnss"}
    for name in ("top", "front", "side", "depth"):
        sensor = scene.sensor(name)
        frames = sensor.images if sensor.type == "camera" else sensor.frames
        np.testing.assert_array_equal(frames.timestamps_ns, EPOCH_NS + PERIOD_NS * np.arange(5))
    points = scene.sensor("top").frames[3].points
    np.testing.assert_array_equal(points.positions, POINTS)
    np.testing.assert_array_equal(points.intensities, np.arange(500) % 256)
    expected = EPOCH_NS + 3 * PERIOD_NS + np.linspace(0, 0.99 * PERIOD_NS, 500).astype(np.int64)
    np.testing.assert_array_equal(points.timestamps_ns, expected)
    assert any(n.code == "point-times-assumed" and "nanoseconds" in n.message for n in scene.warnings)
    camera_model = scene.sensor("front").camera
    numbers = (camera_model.fx, camera_model.fy, camera_model.cx, camera_model.cy)
    assert (camera_model.model, *numbers) == ("brown_conrady", 100.0, 101.0, 5.5, 3.5)
    assert camera_model.coefficients == (0.1, -0.05, 0.001, 0.002, 0.01)
    image = scene.sensor("front").images[2]
    assert image.encoded() == simplejpeg.encode_jpeg(RGB, 95, "RGB", "444")
    np.testing.assert_array_equal(image.rgb, simplejpeg.decode_jpeg(image.encoded(), "RGB"))
    assert scene.sensor("side").camera.model == "unknown"
    assert any(n.code == "camera-model-missing" and "/side/image" in n.location for n in scene.warnings)
    np.testing.assert_array_equal(scene.sensor("side").images[4].rgb, RGB)
    # 16UC1 counts millimetres
    depth = scene.sensor("depth").frames[0].depth
    np.testing.assert_allclose(depth, np.arange(96).reshape(8, 12) * 0.1, rtol=1e-6)
    gnss = scene.sensor("gnss")
    np.testing.assert_array_equal(gnss.positions_lla[:, 0], 48.0 + np.arange(5))
    np.testing.assert_array_equal([gnss.accuracies, gnss.vertical_accuracies], [[2.0] * 5, [3.0] * 5])
    reported = {warning.code: warning for warning in scene.warnings}
    assert (reported["unknown-messages"].count, reported["plots-not-read"].count) == (5, 5)
    assert "foxglove.Log" in reported["unknown-messages"].message


def test_transforms_locate_sensors_boxes_and_the_ego(scene):
    left = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
    np.testing.assert_allclose(scene.sensor("top").mount.matrix, left, atol=1e-15)
    assert scene.sensor("top").points_frame is sc.PointsFrame.SENSOR
    # forward of the camera is x of the car
    np.testing.assert_allclose(scene.sensor("front").mount.rotate(np.array([0, 0, 1.0])), [1, 0, 0], atol=1e-15)
    trajectory = scene.trajectories["tf"]
    np.testing.assert_array_equal(trajectory.positions[:, 0], SPEED * 0.1 * np.arange(5))
    poses = scene.sensor("front").poses
    np.testing.assert_allclose(poses.positions[:, 0], 1.5 + SPEED * 0.1 * np.arange(5), atol=1e-12)
    assert scene.sensor("side").mount is None
    assert any(n.code == "frames-missing" and "'side'" in n.message for n in scene.warnings)
    cuboid, box = scene.annotations
    assert (cuboid.type, cuboid.id, cuboid.label) == ("cuboid", "car 7", "car")
    expected = np.tile([4, 2, 1.5, 50, 3, 1, 0, 0, np.rad2deg(0.3)], (5, 1))
    np.testing.assert_allclose(cuboid.path.values, expected, atol=1e-12)
    assert [(a.name, a.values) for a in cuboid.attributes] == [("score", (0.75,))]
    assert (box.type, box.id, box.label, box.sensor_id) == ("box_2d", "box 1", "person", "front")
    np.testing.assert_array_equal(box.path.values, np.tile([10, 20, 5, 8], (5, 1)))


def test_messages_in_json_state_the_same(tmp_path):
    log = Log()
    fields = cloud_fields(EPOCH_NS, POINTS)
    content = {
        "timestamp": {"sec": EPOCH_NS // 10**9, "nsec": 5},
        "frame_id": "lidar",
        "pose": {"position": {"x": 1, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}},
        "point_stride": fields["point_stride"],
        "fields": fields["fields"],
        "data": base64.b64encode(fields["data"]).decode(),
    }
    log.add_other("/points", "foxglove.PointCloud", "jsonschema", json.dumps(content).encode(), EPOCH_NS)
    with sceneloom.open(log.saved(tmp_path / "drive.mcap")) as scene:
        (lidar,) = scene.lidars
        assert lidar.frames.timestamps_ns.tolist() == [EPOCH_NS + 5]
        # the pose says where the points' origin is in their frame
        np.testing.assert_allclose(lidar.frames[0].points.positions, POINTS + np.array([1, 0, 0]), atol=1e-5)


def test_a_grid_is_a_map_with_the_colours_that_it_states(tmp_path):
    fields = [{"name": name, "offset": k, "type": 1} for k, name in enumerate(("red", "green", "blue"))]
    cells = np.zeros((2, 40), np.uint8)
    cells[:, :36].reshape(2, 3, 12)[..., :3] = RGB[:2, :3]
    grid = {"column_count": 3, "cell_size": {"x": 2, "y": 0.5}, "row_stride": 40, "cell_stride": 12}
    head = {"timestamp": time(EPOCH_NS), "frame_id": "map", "pose": {"position": {"x": -1}, "orientation": {"w": 1}}}
    for names, colors in ((fields, RGB[:2, :3].reshape(-1, 3)), (fields[:2], None)):
        log = Log()
        log.add("/grid", "Grid", EPOCH_NS, **head, **grid, fields=names, data=cells.tobytes())
        with sceneloom.open(log.saved(tmp_path / "drive.mcap")) as scene:
            (found,) = scene.sensors
            assert found.positions.tolist() == [[2 * x, 0.25 + 0.5 * y, 0] for y in range(2) for x in range(3)]
            assert (found.colors is None) if colors is None else np.array_equal(found.colors, colors)
    log = Log()
    log.add("/grid", "Grid", EPOCH_NS, **head, **{**grid, "row_stride": 35}, fields=fields, data=cells.tobytes())
    with pytest.raises(DataError, match=r"/grid\[0\].*3 columns of 12 bytes in rows of 35"):
        sceneloom.open(log.saved(tmp_path / "drive.mcap"))


def test_points_in_a_frame_are_a_trajectory_without_orientations(tmp_path):
    log = Log()
    for k in range(3):
        head = {"timestamp": time(EPOCH_NS + k * PERIOD_NS), "frame_id": "map"}
        log.add("/prism/position", "Point3InFrame", EPOCH_NS + k * PERIOD_NS, **head, point={"x": k, "y": 2, "z": -1})
        rows = {"position": {"x": 2 * k}, "orientation": {"w": 1}}
        log.add("/ego/pose", "PoseInFrame", EPOCH_NS + k * PERIOD_NS, **head, pose=rows)
    with sceneloom.open(log.saved(tmp_path / "drive.mcap")) as scene:
        found = scene.trajectories["prism/position"]
        assert found.positions.tolist() == [[k, 2, -1] for k in range(3)]
        assert found.quaternions_xyzw is None


def decoded(path):
    """Topic, schema and message of a file, as the reference library and Foxglove's classes have them."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_summary().statistics.message_count > 0
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                yield channel.topic, schema.name, message, json.loads(message.data)
                continue
            found = foxglove(schema.name.removeprefix("foxglove."))()
            found.ParseFromString(message.data)
            yield channel.topic, schema.name, message, found


GOLDEN = Path(__file__).parent / "golden"  # FlatBuffers made by flatc 2.0.8: programs/foxglove_flatbuffers_write.py


def same_in_json(path):
    """The messages of the golden file in JSON, as Foxglove's schemas for it have them."""
    log = Log()
    for topic, name, fields in json.loads((GOLDEN / "foxglove_flatbuffers.json").read_text()):
        message = {key.upper() if len(key) == 1 else key: value for key, value in fields.items()}
        if "data" in message:
            message["data"] = base64.b64encode(bytes(message["data"])).decode()
        stamp = next(find_times(message))
        log.add_other(topic, f"foxglove.{name}", "jsonschema", json.dumps(message).encode(), stamp)
    return sceneloom.open(log.saved(path))


def find_times(value):
    if isinstance(value, dict):
        if set(value) == {"sec", "nsec"}:
            yield value["sec"] * 10**9 + value["nsec"]
        for part in value.values():
            yield from find_times(part)
    elif isinstance(value, list):
        for part in value:
            yield from find_times(part)


def test_flatbuffers_by_the_schemas_of_their_channels_state_what_the_same_messages_in_json_do(tmp_path):
    with sceneloom.open(GOLDEN / "foxglove_flatbuffers.mcap") as scene, same_in_json(tmp_path / "a.mcap") as expected:
        assert [(one.id, one.type) for one in scene.sensors] == [(one.id, one.type) for one in expected.sensors]
        assert [one.type for one in scene.sensors] == ["lidar", "camera", "gnss"]
        for ours, theirs in zip(scene.lidars[0].frames, expected.lidars[0].frames, strict=True):
            assert ours.timestamp_ns == theirs.timestamp_ns
            assert np.array_equal(ours.points.positions, theirs.points.positions)
            assert ours.points.intensities.tolist() == [7, 255, 30]
        (ours,), (theirs,) = scene.cameras, expected.cameras
        assert ours.camera == theirs.camera
        assert (ours.camera.width, ours.camera.fx) == (16, 20)
        assert np.array_equal(ours.images[1].rgb, theirs.images[1].rgb)
        assert np.array_equal(scene.sensor("gnss").positions_lla, expected.sensor("gnss").positions_lla)
        assert scene.sensor("gnss").positions_lla[2].tolist() == [48.50002, 11.25, 501]
        assert list(scene.trajectories) == list(expected.trajectories) == ["tf", "odometry"]
        for name, trajectory in scene.trajectories.items():
            other = expected.trajectories[name]
            assert np.array_equal(trajectory.positions, other.positions)
            assert np.array_equal(trajectory.quaternions_xyzw, other.quaternions_xyzw)
        assert repr(scene.annotations) == repr(expected.annotations)
        assert [(one.id, one.type) for one in scene.annotations] == [("car-1", "cuboid"), ("b", "box_2d")]
        assert [one.code for one in scene.warnings] == [one.code for one in expected.warnings]


def test_a_schema_of_flatbuffers_that_is_none_or_of_something_else_is_a_fault_of_the_file(tmp_path):
    with (GOLDEN / "foxglove_flatbuffers.mcap").open("rb") as stream:
        rows = [(schema, message.data) for schema, _, message in make_reader(stream).iter_messages()]
    clouds = [(schema.data, data) for schema, data in rows if schema.name == "foxglove.PointCloud"]
    poses = next(schema.data for schema, _ in rows if schema.name == "foxglove.PoseInFrame")
    content = clouds[0][1]
    for schema, data, problem in (
        (b"", content, "schema 'foxglove.PointCloud': no schema of FlatBuffers"),
        (poses[: len(poses) // 2], content, "no schema of FlatBuffers"),
        (poses, content, r"/points\[0\]"),
        (clouds[0][0], content[:20], r"/points\[0\]"),
        (clouds[0][0], b"", r"/points\[0\]"),
    ):
        log = Log()
        number = log.writer.register_schema("foxglove.PointCloud", "flatbuffer", schema)
        channel = log.writer.register_channel("/points", "flatbuffer", number)
        log.writer.add_message(channel, EPOCH_NS, data, EPOCH_NS)
        with pytest.raises(DataError, match=problem):
            sceneloom.open(log.saved(tmp_path / "a.mcap"))


@pytest.mark.parametrize("compression", ["none", pytest.param("zstd", marks=pytest.mark.slow)])
def test_what_we_write_the_reference_library_reads(compression, tmp_path):
    source = injected()
    path = tmp_path / "drive.mcap"
    sceneloom.write(source, path, compression=compression)
    found = list(decoded(path))
    assert not [1 for *_, message, _ in found if message.publish_time != message.log_time]
    topic = f"/{source.lidars[0].id}/points"
    clouds = [m for where, name, _, m in found if (where, name) == (topic, "foxglove.PointCloud")]
    dtypes = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
    for cloud, frame in zip(clouds, source.lidars[0].frames, strict=True):
        names, formats, offsets = zip(*((f.name, dtypes[f.type], f.offset) for f in cloud.fields), strict=True)
        layout = {"names": names, "formats": formats, "offsets": offsets, "itemsize": cloud.point_stride}
        table = np.frombuffer(cloud.data, layout)
        np.testing.assert_array_equal(np.stack([table[axis] for axis in "xyz"], axis=1), frame.points.positions)
        assert cloud.timestamp.ToNanoseconds() == frame.timestamp_ns
    schemas = {name for _, name, _, _ in found}
    assert {"foxglove.FrameTransform", "foxglove.CameraCalibration", "foxglove.SceneUpdate"} <= schemas


def test_a_video_goes_through_packet_by_packet(data_dir, tmp_path):
    path = tmp_path / "drive.mcap"
    with sceneloom.open(data_dir / "recordings" / "kitti_drive") as source:
        report = sceneloom.write(source, path)
        packets = [m for _, name, _, m in decoded(path) if name == "foxglove.CompressedVideo"]
        assert len(packets) == 12
        assert all(bytes(packet.data).startswith(b"\x00\x00\x00\x01") for packet in packets)
        assert any(loss.field == "sensors.camera.video" and "B frames" in loss.what for loss in report)
        with sceneloom.open(path) as scene:
            mine, theirs = scene.cameras[0].images, source.cameras[0].images
            np.testing.assert_array_equal(mine.timestamps_ns, theirs.timestamps_ns)
            for k in (0, 1, 11):
                np.testing.assert_array_equal(mine[k].rgb, theirs[k].rgb)


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD], ids=["plain", "zstd"])
def test_a_file_that_was_cut_off_is_refused_or_read_as_far_as_it_is_whole(compression, tmp_path):
    whole = drive(compression=compression, chunk_size=3000).saved(tmp_path / "whole.mcap").read_bytes()
    counts = []
    for cut in np.linspace(len(whole) - 1, 2_000, 5).astype(int):
        path = tmp_path / "cut.mcap"
        path.write_bytes(whole[:cut])
        with pytest.raises(DataError, match=r"not finished|--lenient"):
            sceneloom.open(path)
        with sceneloom.open(path, lenient=True) as scene:
            counts.append(sum(len(lidar.frames) for lidar in scene.lidars))
            assert any(warning.code == "mcap-unfinished" for warning in scene.warnings)
            for lidar in scene.lidars:
                assert [len(frame.points) for frame in lidar.frames] == [500] * len(lidar.frames)
    assert counts[0] == 5
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < 5
