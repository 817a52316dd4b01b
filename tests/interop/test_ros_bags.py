"""Bags that rosbags writes, read by us; and ours, read by rosbags."""

import sqlite3
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import simplejpeg
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from tests.peers import python_with
from tests.properties.injected import injected_scene

import sceneloom
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.registry import find_format
from sceneloom.formats.messages.ros import DEFINITIONS

EPOCH_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
RGB = np.random.default_rng(3).integers(0, 255, (8, 12, 3), np.uint8)
POINTS = np.random.default_rng(1).normal(0, 20, (400, 3)).astype(np.float32)


@cache
def injected():
    return injected_scene(odd=False)


@cache
def store_of(version):
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


class Bag:
    """Writes a bag as any other program would; 5 ms pass until a message is received."""

    def __init__(self, path, kind, **options):
        self.version = 1 if kind == "ros1" else 2
        self.store = store_of(self.version)
        if kind == "ros1":
            self.path = path.with_suffix(".bag")
            self.writer = Writer1(self.path)
        else:
            self.path = path
            self.writer = Writer2(path, version=8, storage_plugin=StoragePlugin[kind])
        for name, arguments in options.items():
            getattr(self.writer, name)(*arguments)
        self.connections = {}
        self.writer.open()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.writer.close()

    def make(self, name, *values, **fields):
        return self.store.types[name](*values, **fields)

    def header(self, timestamp_ns, frame):
        number = (0,) if self.version == 1 else ()
        time = self.make("builtin_interfaces/msg/Time", timestamp_ns // 10**9, timestamp_ns % 10**9)
        return self.make("std_msgs/msg/Header", *number, time, frame)

    def add(self, topic, kind, message, received_ns):
        if (topic, kind) not in self.connections:
            self.connections[topic, kind] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialise = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic, kind], received_ns, serialise(message, kind))

    def send(self, topic, kind, timestamp_ns, frame, *values, late_ns=5_000_000, **fields):
        message = self.make(kind, self.header(timestamp_ns, frame), *values, **fields)
        self.add(topic, kind, message, timestamp_ns + late_ns)

    def vector(self, *values):
        return self.make("geometry_msgs/msg/Vector3", *map(float, values))

    def rotation(self, *values):
        return self.make("geometry_msgs/msg/Quaternion", *map(float, values))

    def pose(self, location, rotation=(0, 0, 0, 1)):
        point = self.make("geometry_msgs/msg/Point", *map(float, location))
        return self.make("geometry_msgs/msg/Pose", point, self.rotation(*rotation))

    def transform(self, topic, timestamp_ns, parent, child, location, rotation=(0, 0, 0, 1)):
        moved = self.make("geometry_msgs/msg/Transform", self.vector(*location), self.rotation(*rotation))
        timestamped = self.make("geometry_msgs/msg/TransformStamped", self.header(timestamp_ns, parent), child, moved)
        name = "tf2_msgs/msg/TFMessage"
        self.add(topic, name, self.make(name, [timestamped]), timestamp_ns)

    def cloud(
        self, topic, timestamp_ns, frame, table, *, received_ns=None, step=None, order="<", height=1, offsets=None
    ):
        offsets = offsets or {}
        fields = [
            self.make("sensor_msgs/msg/PointField", name, offsets.get(name, int(offset)), DATATYPES[dtype.base.str[1:]],
                      int(np.prod(dtype.shape, dtype=int)))
            for name, (dtype, offset, *_) in table.dtype.fields.items()
        ]  # fmt: skip
        width, step = len(table) // height, step or table.dtype.itemsize
        name = "sensor_msgs/msg/PointCloud2"
        message = self.make(
            name, self.header(timestamp_ns, frame), height, width, fields, order == ">", step, step * width,
            table.view(np.uint8).reshape(-1) if len(table) else np.zeros(0, np.uint8), True,
        )  # fmt: skip
        self.add(topic, name, message, timestamp_ns + 5_000_000 if received_ns is None else received_ns)

    def camera_model(self, topic, timestamp_ns, frame, model, coefficients, size=(12, 8)):
        k = np.array([100.0, 0, 5.5, 0, 101.0, 3.5, 0, 0, 1])
        region = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        names = "DKRP" if self.version == 1 else "dkrp"
        numbers = dict(zip(names, (np.array(coefficients), k, np.eye(3).reshape(-1), np.zeros(12)), strict=True))
        self.send(topic, "sensor_msgs/msg/CameraInfo", timestamp_ns, frame, height=size[1], width=size[0],
                  distortion_model=model, binning_x=0, binning_y=0, roi=region, **numbers)  # fmt: skip

    def image(self, topic, timestamp_ns, frame, encoding, pixels, *, order="<"):
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
        height, width = pixels.shape[:2]
        self.send(topic, "sensor_msgs/msg/Image", timestamp_ns, frame, height, width, encoding, int(order == ">"),
                  len(data) // height, data)  # fmt: skip


def packed(points, *further, order="<"):
    """Points with further columns: names, dtypes and values."""
    table = np.zeros(len(points), [(axis, f"{order}f4") for axis in "xyz"] + [(n, order + t) for n, t, _ in further])
    for axis, column in zip("xyz", points.T, strict=True):
        table[axis] = column
    for name, _, values in further:
        table[name] = values
    return table


def drive(path, kind, **options):
    """A car that goes 10 m/s along x of the map, in a frame odom that was moved by 100 m."""
    with Bag(path, kind, **options) as bag:
        bag.transform("/tf_static", EPOCH_NS, "base_link", "lidar", (0, 0, 2), (0, 0, np.sqrt(0.5), np.sqrt(0.5)))
        bag.transform("/tf_static", EPOCH_NS, "base_link", "camera", (1.5, 0, 0), (-0.5, 0.5, -0.5, 0.5))
        bag.transform("/tf_static", EPOCH_NS, "base_link", "imu", (0, 0, 0), (0, 0, 1, 0))
        for k in range(4):
            timestamp = EPOCH_NS + k * PERIOD_NS
            bag.transform("/tf", timestamp, "map", "odom", (100, 0, 0.001 * k))
            bag.transform("/tf", timestamp, "odom", "base_link", (k, 0, 0))
            seconds = np.linspace(0, 0.0999, len(POINTS))
            bag.cloud("/lidar/points", timestamp, "lidar", packed(POINTS, ("ring", "u2", np.arange(400) % 16),
                      ("intensity", "f4", np.arange(400) % 200), ("time", "f4", seconds)))  # fmt: skip
            bag.cloud("/radar/points", timestamp, "lidar", packed(POINTS[:5], ("velocity", "f4", np.arange(5))))
            jpeg = np.frombuffer(simplejpeg.encode_jpeg(RGB, 95, "RGB", "444"), np.uint8)
            kind = "sensor_msgs/msg/CompressedImage"
            bag.send("/front/image_raw/compressed", kind, timestamp, "camera", "rgb8; jpeg", jpeg)
            bag.camera_model("/front/camera_info", timestamp, "camera", "equidistant", [0.1, 0.02, 0.003, 0.0004])
            bag.image("/depth/image", timestamp, "camera", "32FC1", np.linspace(1, 5, 96, dtype="<f4").reshape(8, 12))
            bag.send("/imu/data", "sensor_msgs/msg/Imu", timestamp, "imu", bag.rotation(0, 0, 0, 1), np.full(9, -1.0),
                     bag.vector(0.1, 0.2, 0.3), np.zeros(9), bag.vector(1, 2, 9.8), np.zeros(9))  # fmt: skip
            bag.send("/gps/fix", "sensor_msgs/msg/NavSatFix", timestamp, "base_link",
                     bag.make("sensor_msgs/msg/NavSatStatus", 0, 1), 48.0 + k, 11.0, 500.0,
                     np.diag([4.0, 4.0, 9.0]).reshape(-1), 2)  # fmt: skip
            spread = np.arange(36.0).reshape(6, 6)
            covariance = (spread + spread.T).reshape(-1)
            body = bag.make("geometry_msgs/msg/PoseWithCovariance", bag.pose((k, 5, 0)), covariance)
            still = bag.make("geometry_msgs/msg/Twist", bag.vector(0, 0, 0), bag.vector(0, 0, 0))
            twist = bag.make("geometry_msgs/msg/TwistWithCovariance", still, np.zeros(36))
            bag.send("/slam/odometry", "nav_msgs/msg/Odometry", timestamp, "odom", "base_link", body, twist)
            reported = bag.make("vision_msgs/msg/ObjectHypothesis", "car", 0.75)
            nowhere = bag.make("geometry_msgs/msg/PoseWithCovariance", bag.pose((0, 0, 0)), np.zeros(36))
            results = [bag.make("vision_msgs/msg/ObjectHypothesisWithPose", reported, nowhere)]
            box = bag.make("vision_msgs/msg/BoundingBox3D", bag.pose((50 - k, 3, 1)), bag.vector(4, 2, 1.5))
            seen = bag.make("vision_msgs/msg/Detection3D", bag.header(timestamp, "base_link"), results, box, "7")
            bag.send("/objects", "vision_msgs/msg/Detection3DArray", timestamp, "base_link", [seen])
            center = bag.make("vision_msgs/msg/Pose2D", bag.make("vision_msgs/msg/Point2D", 6.0, 4.0), 0.0)
            flat = bag.make("vision_msgs/msg/BoundingBox2D", center, 4.0, 2.0)
            seen = bag.make("vision_msgs/msg/Detection2D", bag.header(timestamp, "camera"), results, flat, "b")
            bag.send("/front/detections", "vision_msgs/msg/Detection2DArray", timestamp, "camera", [seen])
            bag.add("/chatter", "std_msgs/msg/String", bag.make("std_msgs/msg/String", "hello"), timestamp)
    return bag.path


KINDS = ("ros1", "SQLITE3", "MCAP")


PACKED = (
    ("ros1", (Writer1.CompressionFormat.BZ2,)),
    ("ros1", (Writer1.CompressionFormat.LZ4,)),
    ("SQLITE3", (CompressionMode.MESSAGE, CompressionFormat.ZSTD)),
    ("MCAP", (CompressionMode.STORAGE, CompressionFormat.ZSTD)),
)


BAGS = [*((kind, None) for kind in KINDS), *(pytest.param(packed, marks=pytest.mark.slow) for packed in PACKED)]


@pytest.fixture(scope="module", params=BAGS)
def scene(request, tmp_path_factory):
    kind, compression = request.param
    options = {"set_compression": compression} if compression else {}
    with sceneloom.open(drive(tmp_path_factory.mktemp("bag") / "drive", kind, **options)) as opened:
        yield opened


def test_topics_become_sensors_with_all_that_they_measured(scene):
    assert {sensor.id: sensor.type for sensor in scene.sensors} == {
        "lidar": "lidar", "radar": "radar", "front": "camera", "depth": "depth_camera", "imu": "imu", "gps": "gnss",
    }  # fmt: skip
    reported = {warning.code: warning for warning in scene.warnings}
    assert reported["unknown-messages"].count == 4
    assert "std_msgs/msg/String" in reported["unknown-messages"].message
    timestamps = EPOCH_NS + PERIOD_NS * np.arange(4)
    np.testing.assert_array_equal(scene.lidars[0].frames.timestamps_ns, timestamps)
    points = scene.lidars[0].frames[2].points
    np.testing.assert_array_equal(points.positions, POINTS)
    np.testing.assert_array_equal(points.rings, np.arange(400) % 16)
    np.testing.assert_array_equal(points.intensities, np.arange(400) % 200)
    # a float32 of seconds resolves 8 ns at a tenth of a second
    np.testing.assert_allclose(points.timestamps_ns - timestamps[2], np.linspace(0, 99.9e6, 400), atol=8)
    points = scene.sensor("radar").frames[0].points
    np.testing.assert_array_equal(points.lengths, np.arange(5))
    along_sight = POINTS[:5] / np.linalg.norm(POINTS[:5], axis=1, keepdims=True)
    np.testing.assert_allclose(points.directions, along_sight, atol=1e-6)
    camera = scene.sensor("front")
    assert (camera.camera.model, camera.camera.coefficients) == ("fisheye", (0.1, 0.02, 0.003, 0.0004))
    jpeg = simplejpeg.encode_jpeg(RGB, 95, "RGB", "444")
    np.testing.assert_array_equal(camera.images[3].rgb, simplejpeg.decode_jpeg(jpeg, "RGB"))
    depth = scene.sensor("depth").frames[1].depth
    np.testing.assert_array_equal(depth, np.linspace(1, 5, 96, dtype=np.float32).reshape(8, 12))
    streams = scene.sensor("imu").streams
    # half a rotation about z: in the axes of the ego
    np.testing.assert_allclose(streams["accelerometer"].values, np.tile([-1, -2, 9.8], (4, 1)), atol=1e-12)
    np.testing.assert_allclose(streams["gyroscope"].values, np.tile([-0.1, -0.2, 0.3], (4, 1)), atol=1e-12)
    assert "orientation" not in streams  # its covariance begins with -1: there is none
    assert scene.sensor("gps").accuracies.tolist() == [2.0] * 4


def test_the_tree_of_frames_locates_sensors_boxes_and_the_ego(scene):
    left = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
    np.testing.assert_allclose(scene.lidars[0].mount.matrix, left, atol=1e-15)
    trajectory = scene.trajectories["tf"]
    np.testing.assert_allclose(trajectory.positions, [[100 + k, 0, 0.001 * k] for k in range(4)], atol=1e-12)
    (chosen,) = (warning.message for warning in scene.warnings if warning.code == "frames-chosen")
    assert "'base_link' is the ego, 'map' the world; odom could be it, too" in chosen
    np.testing.assert_allclose(scene.sensor("front").poses.positions[1], [102.5, 0, 0.001], atol=1e-12)
    # odometry is a trajectory with its covariance, rotation before location
    trajectory = scene.trajectories["slam"]
    np.testing.assert_array_equal(trajectory.positions, [[k, 5, 0] for k in range(4)])
    spread = np.arange(36.0).reshape(6, 6)
    spread, order = spread + spread.T, [3, 4, 5, 0, 1, 2]
    np.testing.assert_array_equal(trajectory.covariances[0], spread[np.ix_(order, order)])
    cuboid, box = scene.annotations
    assert (cuboid.type, cuboid.id, cuboid.label) == ("cuboid", "7", "car")
    expected = [[4, 2, 1.5, 150, 3, 1 + 0.001 * k, 0, 0, 0] for k in range(4)]
    np.testing.assert_allclose(cuboid.path.values, expected, atol=1e-12)
    assert (box.type, box.id, box.sensor_id) == ("box_2d", "b", "front")
    np.testing.assert_array_equal(box.path.values, np.tile([4, 3, 4, 2], (4, 1)))


@pytest.mark.parametrize(
    ("name", "dtype", "zero", "unit"),
    [
        ("t", "u4", 0, 1e9),
        ("offset_time", "u4", 0, 1e6),
        ("time", "f4", -0.1, 1.0),  # seconds before the timestamp
        ("timestamp", "f8", EPOCH_NS / 1e9, 1.0),  # of the clock
        ("time", "f8", 0, 1e3),
    ],
)
def test_times_of_points_are_understood_by_their_type_and_range(name, dtype, zero, unit, tmp_path):
    offsets = np.linspace(0, 0.099, 400)
    with Bag(tmp_path / "drive", "SQLITE3") as bag:
        for k in range(3):
            values = (offsets + zero + (k * 0.1 if zero > 1 else 0)) * unit
            bag.cloud("/points", EPOCH_NS + k * PERIOD_NS, "lidar", packed(POINTS, (name, dtype, values)))
    with sceneloom.open(bag.path) as scene:
        frame = scene.lidars[0].frames[1]
        start = EPOCH_NS + PERIOD_NS + (zero * 1e9 if -1 < zero < 0 else 0)
        # float64 seconds resolve 0.24 µs at today's epoch, whole microseconds half a one
        np.testing.assert_allclose(frame.points.timestamps_ns - start, offsets * 1e9, atol=1100)
        assert abs(frame.timestamp_ns - start) < 1000
        assert name not in frame.points.extras


def test_raw_images_are_read_whatever_their_encoding_and_what_is_not_understood_is_reported(tmp_path):
    plane = np.full((8, 12), 40, np.uint8)
    mosaic = plane.copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = 200, 90  # red, and blue, of rggb
    images = {
        "rgb8": (RGB, RGB),
        "bgr8": (RGB[:, :, ::-1], RGB),
        "rgba8": (np.dstack([RGB, plane]), RGB),
        "rgb16": (RGB.astype("<u2") << 8, RGB),
        "mono16": ((plane * np.uint16(256)).astype(">u2"), np.full((8, 12, 3), 40)),
        "bayer_rggb8": (mosaic, np.tile([200, 40, 90], (8, 12, 1))),
    }
    with Bag(tmp_path / "drive", "SQLITE3") as bag:
        bag.cloud("/points", EPOCH_NS, "lidar", packed(POINTS, ("t", "f4", np.full(400, 7e5))))
        for encoding, (pixels, _) in images.items():
            order = ">" if encoding == "mono16" else "<"
            bag.image(f"/{encoding}/image_raw", EPOCH_NS, "cam", encoding, pixels, order=order)
        bag.image("/odd/image_raw", EPOCH_NS, "cam", "yuv444", RGB)
        webp = np.frombuffer(b"RIFF0000WEBPVP8 ", np.uint8)
        bag.send("/web/compressed", "sensor_msgs/msg/CompressedImage", EPOCH_NS, "cam", "webp", webp)
    with sceneloom.open(bag.path) as scene:
        assert [sensor.id for sensor in scene.sensors] == ["points", *images]
        for encoding, (_, expected) in images.items():
            np.testing.assert_array_equal(scene.sensor(encoding).images[0].rgb, expected, encoding)
        points = scene.lidars[0].frames[0].points
        assert (points.timestamps_ns, points.extras["t"][0]) == (None, 7e5)  # no unit of time makes it one
        assert {n.code for n in scene.warnings} >= {"camera-model-missing", "point-times-not-used"}
        reported = [warning.message for warning in scene.warnings if warning.code == "unknown-images"]
        assert len(reported) == 2
        assert any("'yuv444'" in message for message in reported)


def read_by_rosbags(path):
    """Topic, time and message of each message, as rosbags has them."""
    with AnyReader([path]) as reader:
        for connection, time_ns, content in reader.messages():
            yield connection.topic, time_ns, reader.deserialize(content, connection.msgtype)


def fields_of(message):
    """The columns of a cloud by their names."""
    dtypes = {number: dtype for dtype, number in DATATYPES.items()}
    fields = {f.name: ("<" + dtypes[f.datatype], f.offset) for f in message.fields}
    layout = {"names": list(fields), "formats": [f for f, _ in fields.values()], "itemsize": message.point_step}
    return np.frombuffer(message.data.tobytes(), {**layout, "offsets": [offset for _, offset in fields.values()]})


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("drive.bag", {}),
        pytest.param("drive.ros2", {"storage": "sqlite3"}, marks=pytest.mark.slow),
        ("drive.ros2", {"storage": "mcap"}),
    ],
)
def test_what_we_write_rosbags_reads(name, options, tmp_path):
    source = injected()
    path = tmp_path / name
    sceneloom.write(source, path, **options)
    found = list(read_by_rosbags(path))
    lidar = source.lidars[0]
    clouds = [m for _, _, m in found if type(m).__name__.endswith("PointCloud2") and m.header.frame_id]
    mine = [m for m in clouds if m.width == len(lidar.frames[0].points)]
    assert mine
    table = fields_of(mine[0])
    np.testing.assert_array_equal(np.stack([table[a] for a in "xyz"], axis=1), lidar.frames[0].points.positions)
    names = {type(message).__name__ for _, _, message in found}
    assert {n.rpartition("__")[2] for n in names} >= {"TFMessage", "CameraInfo", "Imu", "NavSatFix", "Odometry"}
    assert find_format(path).name == ("ros1" if name.endswith(".bag") else "ros2")


COMMON_FIELDS = {"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "ring": "u2", "t": "u4"}
"""Names and types of what a lidar measured, as drivers write them and other programs look for them."""


def swept(tmp_path, *, earlier_ns=0):
    """A bag of ours: two sweeps of points with intensities, lasers and times, and two images of one camera."""
    timestamps = EPOCH_NS + PERIOD_NS * np.arange(2)
    times = np.linspace(0, 99_000_000, len(POINTS)).astype(np.int64) - earlier_ns
    measured = {
        "intensities": np.arange(len(POINTS), dtype=np.uint32).astype(np.uint8),
        "rings": (np.arange(len(POINTS)) % 16).astype(np.uint16),
    }
    sweeps = [sc.LidarFrame(int(t), sc.LidarPoints(POINTS, timestamps_ns=t + times, **measured)) for t in timestamps]
    camera_model = Camera("pinhole", 12, 8, 10.0, 10.0, 5.5, 3.5)
    images = [sc.CameraImage.of(int(t), camera_model, RGB) for t in timestamps + 30_000_000]
    lidar = sc.LidarSensor("top", sc.LazyFrames.of(sweeps, timestamps.tolist()))
    front = sc.CameraSensor("front", camera_model, sc.LazyFrames.of(images, (timestamps + 30_000_000).tolist()))
    scene = sc.Scene((lidar, front))
    sceneloom.write(scene, tmp_path / "drive.bag")
    return tmp_path / "drive.bag", timestamps, times, measured


@pytest.mark.parametrize("earlier_ns", [0, 50_000_000])
def test_clouds_have_the_fields_that_other_programs_look_for_and_come_back_exactly(tmp_path, earlier_ns):
    path, timestamps, times, measured = swept(tmp_path, earlier_ns=earlier_ns)
    with sceneloom.open(path) as scene:
        for frame, timestamp in zip(scene.lidars[0].frames, timestamps.tolist(), strict=True):
            assert frame.timestamp_ns == timestamp
            np.testing.assert_array_equal(frame.points.timestamps_ns, timestamp + times)
            np.testing.assert_array_equal(frame.points.intensities, measured["intensities"])
        sceneloom.write(scene, tmp_path / "copy.bag")
    found, copied = ({}, {})
    for bag, messages in ((path, found), (tmp_path / "copy.bag", copied)):
        for topic, _, message in read_by_rosbags(bag):
            messages.setdefault(topic, []).append(message)
    clouds, infos = found["/top/points"], found["/front/camera_info"]
    assert [bytes(message.data) for message in clouds] == [bytes(message.data) for message in copied["/top/points"]]
    for message in clouds:
        table = fields_of(message)
        if earlier_ns:  # points earlier than their sweep have seconds with a sign
            np.testing.assert_allclose(table["time"], times / 1e9, atol=1e-12)
            continue
        assert {name: dtype.str[1:] for name, (dtype, _) in table.dtype.fields.items()} == COMMON_FIELDS
        for name, expected in {"t": times, "intensity": measured["intensities"], "ring": measured["rings"]}.items():
            np.testing.assert_array_equal(table[name], expected)
    stamps = [[m.header.stamp for m in messages] for messages in (infos, found["/front/image/compressed"])]
    assert (stamps[0], len(clouds), len(infos)) == (stamps[1], 2, 2)


def test_kiss_icp_finds_the_times_that_it_deskews_by(tmp_path, ask):
    path, _, times, _ = swept(tmp_path)
    program = (
        "import sys\nfrom pathlib import Path\nfrom kiss_icp.datasets import dataset_factory\n"
        "bag = dataset_factory(dataloader='rosbag', data_dir=Path(sys.argv[1]), topic='')\n"
        "print(bag[0][1].astype(int).tolist())"
    )
    assert ask(python_with("kiss-icp", "SCENELOOM_KISS_PYTHON"), program, path) == times.tolist()


KISS = """
import json, sys
from pathlib import Path
import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.datasets import dataset_factory
from kiss_icp.kiss_icp import KissICP

def way(sweeps):
    config = KISSConfig()
    config.data.deskew, config.data.max_range, config.mapping.voxel_size = True, 80.0, 0.8
    odometry = KissICP(config=config)
    poses = []
    for points, times in sweeps:
        odometry.register_frame(np.asarray(points, np.float64), np.asarray(times, np.float64))
        poses.append(odometry.last_pose[:3].tolist())
    return poses

bag = dataset_factory(dataloader="rosbag", data_dir=Path(sys.argv[1]), topic="")
source = np.load(sys.argv[2])
sweeps = [(source[f"points{k}"], source[f"times{k}"]) for k in range(len(source.files) // 2)]
print(json.dumps([way(bag[k] for k in range(len(bag))), way(sweeps)]))
"""


KISS_SWEEPS = 25


@pytest.mark.parametrize("name", ["drive.bag", "drive.ros2"])
def test_kiss_icp_deskews_our_bags_and_finds_the_trajectory_of_the_source(data_dir, tmp_path, ask, name):
    python, arrays = python_with("kiss-icp", "SCENELOOM_KISS_PYTHON"), {}
    with sceneloom.open(data_dir / "recordings" / "kitti_drive_40") as scene:
        lidar = scene.lidars[0]
        for k, frame in enumerate(lidar.frames[:KISS_SWEEPS]):
            times = frame.points.timestamps_ns - frame.points.timestamps_ns.min()
            arrays |= {f"points{k}": frame.points.positions, f"times{k}": times / times.max()}
        frames = sc.LazyFrames.of([*lidar.frames[:KISS_SWEEPS]], lidar.frames.timestamps_ns[:KISS_SWEEPS])
        alone = sc.Scene((replace(lidar, frames=frames),))
        sceneloom.write(alone, tmp_path / name)
    np.savez(tmp_path / "source.npz", **arrays)
    ours, source = (np.array(poses) for poses in ask(python, KISS, tmp_path / name, tmp_path / "source.npz"))
    assert ours.shape == source.shape == (KISS_SWEEPS, 3, 4)
    # it moves; at most 1 cm and 0.05 degrees apart
    assert np.linalg.norm(source[-1, :, 3]) > 0.5
    assert np.linalg.norm(ours[:, :, 3] - source[:, :, 3], axis=1).max() < 0.01
    assert np.abs(ours[:, :, :3] - source[:, :, :3]).max() < 1e-3


def test_a_bag_in_mcap_is_ros_own_and_one_that_is_packed_as_a_whole_says_how_to_unpack_it(tmp_path):
    path = drive(tmp_path / "drive", "MCAP")
    (file,) = path.glob("*.mcap")
    assert find_format(path).name == find_format(file).name == "ros2"
    with sceneloom.open(file) as scene:
        assert len(scene.sensors) == 6
    whole = drive(tmp_path / "whole", "SQLITE3", set_compression=(CompressionMode.FILE, CompressionFormat.ZSTD))
    with pytest.raises(DataError, match="zstd -d"):
        sceneloom.open(whole)


@pytest.mark.parametrize(
    ("layout", "problem"),
    [
        ({"offsets": {"z": 10}}, r"/points\[0\].*'z' takes bytes 10 to 14 of each point, which has 12"),
        ({"step": 16}, "4800 bytes for 400 points of 16; expected 6400"),
    ],
)
def test_fields_beyond_the_point_and_fewer_bytes_than_points_are_refused_with_their_location(tmp_path, layout, problem):
    with Bag(tmp_path / "drive", "ros1") as bag:
        bag.cloud("/points", EPOCH_NS, "lidar", packed(POINTS), **layout)
    with pytest.raises(DataError, match=problem):
        sceneloom.open(bag.path)
    with sceneloom.open(bag.path, lenient=True) as scene:
        assert scene.sensors == ()
        assert any(warning.code == "topics-at-fault" for warning in scene.warnings)


def test_empty_sweeps_and_big_endian_rows_are_read_and_timestamps_of_0_and_repeated_ones_reported(tmp_path):
    with Bag(tmp_path / "drive", "MCAP") as bag:
        bag.cloud("/points", EPOCH_NS, "lidar", packed(POINTS[:0], ("intensity", "f4", [])))
        bag.cloud("/points", EPOCH_NS + PERIOD_NS, "lidar", packed(POINTS, ("intensity", "f4", np.full(400, 0.5))))
        bag.cloud("/rows", EPOCH_NS, "lidar", packed(POINTS, order=">"), order=">", height=4)
        for k, timestamp in enumerate((EPOCH_NS, 0, EPOCH_NS + 2 * PERIOD_NS, EPOCH_NS + 2 * PERIOD_NS)):
            bag.cloud("/zero", timestamp, "lidar", packed(POINTS), received_ns=EPOCH_NS + k * PERIOD_NS)
    with sceneloom.open(bag.path) as scene:
        lidar, rows, zero = scene.lidars
        assert [len(frame.points) for frame in lidar.frames] == [0, 400]
        assert lidar.frames[1].points.intensities[0] == 128
        np.testing.assert_array_equal(rows.frames[0].points.positions, POINTS)
        assert (zero.frames.timestamps_ns - EPOCH_NS).tolist() == [0, PERIOD_NS, 2 * PERIOD_NS]
        reported = {warning.code: warning.count for warning in scene.warnings}
        assert (reported["timestamps-zero"], reported["repeated-timestamps"]) == (1, 1)


def test_timestamps_of_two_clocks_are_refused_unless_one_is_chosen(tmp_path):
    with Bag(tmp_path / "drive", "SQLITE3") as bag:
        for k in range(3):
            bag.cloud("/points", EPOCH_NS + k * PERIOD_NS, "lidar", packed(POINTS))
            # this camera counts from when it was switched on
            bag.send("/cam/image_raw/compressed", "sensor_msgs/msg/CompressedImage", 5 * 10**9 + k * PERIOD_NS, "cam",
                     "jpeg", np.frombuffer(simplejpeg.encode_jpeg(RGB), np.uint8),
                     late_ns=EPOCH_NS - 5 * 10**9)  # fmt: skip
    with pytest.raises(DataError, match=r"mixed time bases: .* but of /cam/image_raw/compressed"):
        sceneloom.open(bag.path)
    for options in ({"lenient": True}, {"timestamps": "receive"}):
        with sceneloom.open(bag.path, **options) as scene:
            assert (scene.cameras[0].images.timestamps_ns - EPOCH_NS).tolist() == [0, PERIOD_NS, 2 * PERIOD_NS]
    with sceneloom.open(bag.path, timestamps="header") as scene:
        assert scene.cameras[0].images.timestamps_ns[0] == 5 * 10**9
    with pytest.raises(OptionError, match="header, receive"):
        sceneloom.open(bag.path, timestamps="mine")


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_was_cut_off_is_refused_or_read_as_far_as_it_is_whole(kind, tmp_path):
    path = drive(tmp_path / "drive", kind)
    file = path if path.is_file() else next(file for file in path.iterdir() if file.suffix in {".db3", ".mcap"})
    whole = file.read_bytes()
    file.write_bytes(whole[: int(len(whole) * 0.6)])
    with pytest.raises(DataError, match=r"cut off|not finished|--lenient|cannot be read|damaged|malformed"):
        sceneloom.open(path)
    # a database that lost its pages may be none at all
    with suppress(DataError) if kind == "SQLITE3" else nullcontext(), sceneloom.open(path, lenient=True) as scene:
        assert all(len(frame.points) == 400 for lidar in scene.lidars for frame in lidar.frames)


def test_bags_without_definitions_are_read_with_those_of_a_distribution(tmp_path):
    path = drive(tmp_path / "drive", "SQLITE3")
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE topics SET type='my_msgs/msg/Own' WHERE name='/chatter'")
    database.close()
    for options in ({}, {"distro": "jazzy"}):
        with sceneloom.open(path, **options) as scene:
            np.testing.assert_array_equal(scene.lidars[0].frames[0].points.positions, POINTS)
            assert any("my_msgs/msg/Own" in warning.message for warning in scene.warnings)
    with pytest.raises(OptionError, match=r"distro 'fortran'; expected one of .*humble"):
        sceneloom.open(path, distro="fortran")
