"""Compressed points, depths and videos, scans and Foxglove's schemas in bags, as other programs write them."""

import base64
import json
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
import zstandard
from mcap.writer import Writer
from tests.interop import packed_messages as write
from tests.interop.test_ros_bags import DATATYPES, EPOCH_NS, PERIOD_NS, Bag
from tests.malformed.damage import flipped

from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.messages.compressed_points import unpacked
from sceneloom.formats.messages.records import PackedCloudRecord

COUNT = 700
PACKED = "point_cloud_interfaces/msg/CompressedPointCloud2"


def table(count=COUNT, *, nan=False, doubles=True):
    """Points with columns of most types, whose positions change little from one to the next."""
    chance = np.random.default_rng(11)
    dtype = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("kind", "<u1")]
    rows = np.zeros(count, [*dtype, *([("stamp", "<f8")] if doubles else []), ("code", "<i4")])
    for name in "xyz":
        rows[name] = 10 + chance.normal(0, 0.3, count).cumsum()
    rows["intensity"], rows["ring"] = chance.integers(0, 200, count), np.arange(count) % 32
    rows["kind"], rows["code"] = chance.integers(0, 9, count), chance.integers(-(2**31), 2**31, count)
    if doubles:
        rows["stamp"] = EPOCH_NS / 1e9 + np.arange(count) * 1e-4
    if nan:
        for name in "xyz":
            rows[name][5:9] = np.nan
    return rows


def fields_of(bag, rows):
    kind = "sensor_msgs/msg/PointField"
    return [bag.make(kind, name, o, DATATYPES[t.str[1:]], 1) for name, (t, o, *_) in rows.dtype.fields.items()]


def send_packed(bag, topic, timestamp_ns, rows, form, content, step=None):
    size = rows.dtype.itemsize
    data = np.frombuffer(content, np.uint8)
    bag.send(topic, PACKED, timestamp_ns, "lidar", 1, len(rows), fields_of(bag, rows), False, size, size * len(rows),
             data, True, form)  # fmt: skip


def columns(record):
    layout = {f.name: (f.dtype, f.offset) for f in record.fields}
    names = list(layout)
    dtype = np.dtype({"names": names, "formats": [layout[n][0] for n in names],
                      "offsets": [layout[n][1] for n in names], "itemsize": record.stride})  # fmt: skip
    return np.frombuffer(record.data, dtype, record.count)


@pytest.mark.parametrize("kind", ["ros1", "MCAP"])
def test_packed_points_are_those_that_were_packed(kind, tmp_path):
    rows = table(doubles=False)
    packers = {"zstd": zstandard.ZstdCompressor().compress, "zlib": write.gzipped}
    with Bag(tmp_path / "drive", kind) as bag:
        bag.cloud("/plain/points", EPOCH_NS, "lidar", rows)
        for form, pack in packers.items():
            send_packed(bag, f"/{form}/points/{form}", EPOCH_NS, rows, form, pack(rows.tobytes()))
        content = write.cloudini(rows, version=4, stage="LOSSLESS")
        send_packed(bag, "/cloudini/points/cloudini", EPOCH_NS, rows, "cloudini", content)
    with open_scene(bag.path) as scene:
        assert {lidar.id for lidar in scene.lidars} == {"plain", "zstd", "zlib", "cloudini"}
        plain = scene.sensor("plain").frames[0].points
        for form in ("zstd", "zlib", "cloudini"):
            points = scene.sensor(form).frames[0].points
            np.testing.assert_array_equal(points.positions, plain.positions)
            np.testing.assert_array_equal(points.intensities, plain.intensities)
            np.testing.assert_array_equal(points.rings, plain.rings)
            np.testing.assert_array_equal(points.extras["code"], plain.extras["code"])
        assert write_scene(scene, tmp_path / "out.sfs")


@pytest.mark.parametrize(("version", "text"), [(2, False), (3, True), (4, False), (5, True)])
@pytest.mark.parametrize("stage", ["NONE", "LOSSY", "LOSSLESS"])
@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_cloudini_of_every_version_and_stage_is_decoded(version, text, stage, compression):
    rows = table(nan=stage != "NONE")
    lossy = stage == "LOSSY"
    content = write.cloudini(
        rows, version=version, stage=stage, compression=compression, text=text, resolution=0.002 if lossy else None
    )
    found = columns(unpacked(PackedCloudRecord(1, "lidar", "cloudini", memoryview(content))))
    for name in rows.dtype.names:
        exact = not lossy or rows.dtype[name].kind != "f"
        # half a step, and what 32 bits round at 20 m
        np.testing.assert_allclose(found[name], rows[name], rtol=0, atol=0 if exact else 0.001 + 2e-6)


@pytest.mark.parametrize("mode", range(4))
def test_columns_of_cloudini_are_decoded_by_steps_palettes_and_runs(mode):
    rows = table(33_000 if mode == 0 else 3000)[["x", "y", "z", "ring", "kind", "code"]].copy()  # beyond one chunk
    rows["code"] = np.repeat(np.arange(len(rows) // 10) * -7, 10)
    rows["ring"] = np.arange(len(rows)) // 900
    content = write.cloudini(rows, version=5, modes=mode, resolution=0.001)
    found = columns(unpacked(PackedCloudRecord(1, "lidar", "", memoryview(content))))
    for name in ("ring", "code", "kind"):
        np.testing.assert_array_equal(found[name], rows[name])


def draco_file(count=COUNT):
    rows = table(count, doubles=False)
    columns_of = [(0, rows[name].reshape(-1, 1)) for name in "xyz"]
    columns_of += [(4, rows[name].reshape(-1, 1)) for name in ("intensity", "ring", "kind")]
    return rows[["x", "y", "z", "intensity", "ring", "kind"]].copy(), write.draco(columns_of, count)


def test_draco_of_ros_has_an_attribute_for_each_field(tmp_path):
    pytest.importorskip("DracoPy", reason="DracoPy is not installed")
    rows, content = draco_file()
    rows = np.array(rows.tolist(), [(n, rows.dtype[n]) for n in rows.dtype.names])
    with Bag(tmp_path / "drive", "MCAP") as bag:
        send_packed(bag, "/top/points/draco", EPOCH_NS, rows, "draco", content)
    with open_scene(bag.path) as scene:
        points = scene.sensor("top").frames[0].points
        np.testing.assert_array_equal(points.positions, np.stack([rows[name] for name in "xyz"], axis=1))
        np.testing.assert_array_equal(points.intensities, rows["intensity"])
        np.testing.assert_array_equal(points.rings, rows["ring"])


def test_draco_of_foxglove_names_its_attributes_and_what_the_library_rounds_is_left_out(tmp_path):
    draco = pytest.importorskip("DracoPy", reason="DracoPy is not installed")
    chance = np.random.default_rng(4)
    positions = chance.normal(0, 20, (500, 3)).astype(np.float32)
    colours = chance.integers(0, 255, (500, 3), np.uint8)
    content = draco.encode(positions, quantization_bits=16, preserve_order=True, colors=colours,
                           generic_attributes={"intensity": chance.random((500, 1)).astype(np.float32)})  # fmt: skip
    stamps = (4, np.arange(500, dtype="<f8").reshape(-1, 1) + EPOCH_NS / 1e9)
    timed = write.draco([(0, positions), stamps], 500, names=[(1, "stamp")])
    parts = {"/a/points": content, "/b/points": timed}
    messages = [(topic, {"pose": pose((1, 0, 0)), "data": data, "format": "draco"}) for topic, data in parts.items()]
    path = json_log(tmp_path, "CompressedPointCloud", messages)
    with open_scene(path) as scene:
        points = scene.sensor("a").frames[0].points
        # half a step of 16 bits over the largest extent
        extent = (positions.max(axis=0) - positions.min(axis=0)).max()
        np.testing.assert_allclose(points.positions - [1, 0, 0], positions, atol=0.6 * extent / 65535 + 1e-5)
        np.testing.assert_array_equal(points.colors[:, :3], colours)
        np.testing.assert_allclose(scene.sensor("b").frames[0].points.positions - [1, 0, 0], positions, atol=1e-5)
        assert next(w.message for w in scene.warnings if w.code == "fields-rounded").startswith("fields stamp,")


def test_without_the_library_of_draco_a_person_is_told_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "DracoPy", None)
    rows, content = draco_file()
    rows = np.array(rows.tolist(), [(n, rows.dtype[n]) for n in rows.dtype.names])
    with Bag(tmp_path / "drive", "MCAP") as bag:
        send_packed(bag, "/top/points/draco", EPOCH_NS, rows, "draco", content)
        bag.cloud("/plain/points", EPOCH_NS, "lidar", rows)
    with pytest.raises(SceneloomError, match=r"pip install 'sceneloom\[draco\]'"):
        open_scene(bag.path)
    with open_scene(bag.path, lenient=True) as scene:
        assert [lidar.id for lidar in scene.lidars] == ["plain"]


def write_drive(path):
    """A bag of every kind of packed message but Draco, for those who damage it."""
    rows = table(200, doubles=False)
    depths = np.full((8, 12), 700, np.uint16)
    with Bag(path, "MCAP") as bag:
        for k in range(2):
            time_ns = EPOCH_NS + k * PERIOD_NS
            send_packed(bag, "/a/points/zstd", time_ns, rows, "zstd", zstandard.compress(rows.tobytes()))
            for version in (3, 5):
                content = write.cloudini(rows, version=version, compression="NONE", modes=k + 1)
                send_packed(bag, f"/c{version}/points/cloudini", time_ns, rows, "cloudini", content)
            for form, content in (("rvl", write.rvl(depths)), ("png", cv2.imencode(".png", depths)[1].tobytes())):
                bag.send(f"/{form}/image/compressedDepth", "sensor_msgs/msg/CompressedImage", time_ns, "camera",
                         f"16UC1; compressedDepth {form}", np.frombuffer(bytes(12) + content, np.uint8))  # fmt: skip
            bag.send("/scan", "sensor_msgs/msg/LaserScan", time_ns, "laser", -0.4, 0.3, 0.1, 0.002, 0.1, 0.1, 30.0,
                     RANGES, np.arange(8, dtype=np.float32))  # fmt: skip
        for content, shown in encoded(*VIDEOS["vp9"][:1], **VIDEOS["vp9"][1])[:4]:
            bag.send("/front/ffmpeg", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket", EPOCH_NS + shown * PERIOD_NS,
                     "camera", 64, 48, "vp9", shown, 0, False, np.frombuffer(content, np.uint8))  # fmt: skip
    return bag.path


def pose(position):
    return {"position": dict(zip("xyz", position, strict=True)), "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}


def json_log(folder, schema, messages, *, count=1):
    """A file of JSON messages, each a topic and its fields, `PERIOD_NS` apart."""
    path = folder / "log.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "test")
        number = writer.register_schema(f"foxglove.{schema}", "jsonschema", b"{}")
        channels = {topic: writer.register_channel(topic, "json", number) for topic in dict(messages)}
        for k, (topic, fields) in enumerate(messages):
            shown = fields.pop("shown", k if len(channels) == 1 else 0)
            seconds, nanos = divmod(EPOCH_NS + shown * PERIOD_NS, 10**9)
            encoded = {n: base64.b64encode(v).decode() if isinstance(v, bytes) else v for n, v in fields.items()}
            stamp = {"timestamp": {"sec": seconds, "nsec": nanos}, "frame_id": "lidar"}
            writer.add_message(channels[topic], EPOCH_NS + k, json.dumps(stamp | encoded).encode(), EPOCH_NS + k)
        writer.finish()
    return path


@pytest.mark.parametrize("form", ["png", "rvl"])
@pytest.mark.parametrize("kind", ["16UC1", "32FC1"])
def test_compressed_depths_are_metres(kind, form, tmp_path):
    depths = np.linspace(0.5, 9.5, 96, dtype=np.float32).reshape(8, 12)
    depths[2, 3:7] = 0 if kind == "16UC1" else np.nan
    head, steps = (bytes(12), (depths * 1000).astype(np.uint16)) if kind == "16UC1" else write.inverse(depths)
    content = head + (write.rvl(steps) if form == "rvl" else cv2.imencode(".png", steps)[1].tobytes())
    with Bag(tmp_path / "drive", "MCAP") as bag:
        bag.camera_model("/depth/camera_info", EPOCH_NS, "camera", "plumb_bob", [0.0] * 5)
        bag.send("/depth/image/compressedDepth", "sensor_msgs/msg/CompressedImage", EPOCH_NS, "camera",
                 f"{kind}; compressedDepth {form}", np.frombuffer(content, np.uint8))  # fmt: skip
    with open_scene(bag.path) as scene:
        (camera,) = scene.sensors
        frame = camera.frames[0]
        found = frame.decode()
        assert (camera.camera.model, frame.scale) == ("pinhole", 0.001 if kind == "16UC1" else None)
    known = depths > 0
    np.testing.assert_array_equal(found > 0, known)
    # of inverse depths, a step is d^2 / a
    worst = 0.001 if kind == "16UC1" else depths[known].max() ** 2 / (100 * 101) + 1e-4
    np.testing.assert_allclose(found[known], depths[known], atol=worst)


def encoded(library, **options):
    """The packets of a video of twelve grey images, each brighter than the one before, and which image each shows."""
    encoder = av.CodecContext.create(library, "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.gop_size = 64, 48, "yuv420p", 5
    encoder.time_base, encoder.framerate, encoder.options = Fraction(1, 10), Fraction(10), options
    packets = []
    for k in range(12):
        frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 20 * k, np.uint8), "rgb24").reformat(format="yuv420p")
        frame.pts = k
        packets += encoder.encode(frame)
    return [(bytes(packet), packet.pts) for packet in [*packets, *encoder.encode(None)]]


VIDEOS = {
    "h264": ("libx264", {"preset": "ultrafast", "bf": "0"}),
    "h264 reordered": ("libx264", {"preset": "fast", "bf": "2"}),
    "vp9": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8"}),
    "av1": ("libsvtav1", {"preset": "12"}),
}


@pytest.mark.parametrize("name", VIDEOS)
def test_videos_are_decoded_in_order_from_any_image_and_images_before_a_key_frame_are_counted(name, tmp_path):
    library, options = VIDEOS[name]
    packets = encoded(library, **options)[1:]  # the first key frame was lost
    lost = next(k for k, (_, shown) in enumerate(packets) if shown >= 5)
    codec = name.partition(" ")[0]
    with Bag(tmp_path / "drive", "MCAP") as bag:
        for content, shown in packets:
            bag.send("/front/image_raw/ffmpeg", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
                     EPOCH_NS + shown * PERIOD_NS, "camera", 64, 48, f"{codec};yuv420p;bgr8;bgr8", shown, 0, False,
                     np.frombuffer(content, np.uint8))  # fmt: skip
    messages = [("/front/video", {"data": c, "format": codec, "shown": shown}) for c, shown in packets]
    for path in (bag.path, json_log(tmp_path, "CompressedVideo", messages)):
        with open_scene(path) as scene:
            (camera,) = scene.cameras
            late = [w for w in scene.warnings if w.code == "video-begins-late"]
            assert (camera.id, late[0].count, len(camera.images)) == ("front", lost, len(packets) - lost)
            shown = sorted(shown for _, shown in packets[lost:])
            np.testing.assert_array_equal(camera.images.timestamps_ns - EPOCH_NS, np.array(shown) * PERIOD_NS)
            for k in (3, 0, len(shown) - 1, 1):
                # encoders lose a few levels
                assert abs(float(camera.images[k].decode().mean()) - 20 * shown[k]) < 4


RANGES = np.array([1.0, 2.0, np.inf, 0.05, 3.0, np.nan, 40.0, 5.0], np.float32)
KEPT = [0, 1, 4, 7]  # within 0.1 to 30 m


@pytest.mark.parametrize("kind", ["ros1", "SQLITE3"])
def test_scans_are_lidars_of_one_line_with_the_time_of_each_beam(kind, tmp_path):
    angles = -0.4 + 0.1 * np.arange(8)
    shape = (-0.4, 0.3, 0.1, 0.002, 0.1, 0.1, 30.0)
    with Bag(tmp_path / "drive", kind) as bag:
        for k in range(2):
            time_ns = EPOCH_NS + k * PERIOD_NS
            bag.send("/front/scan", "sensor_msgs/msg/LaserScan", time_ns, "laser", *shape, RANGES,
                     np.arange(8, dtype=np.float32))  # fmt: skip
            echo = [bag.make("sensor_msgs/msg/LaserEcho", np.array([r, r + 1], np.float32)) for r in RANGES]
            bag.send("/rear/scan", "sensor_msgs/msg/MultiEchoLaserScan", time_ns, "laser", *shape, echo, [])
    with open_scene(bag.path) as scene:
        frame = scene.sensor("front").frames[1]
        expected = RANGES[KEPT, None] * np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], axis=1)[KEPT]
        np.testing.assert_allclose(frame.points.positions, expected, atol=1e-5)
        # 2 ms as 32 bits have it
        np.testing.assert_allclose(frame.points.timestamps_ns - frame.timestamp_ns, np.array(KEPT) * 2e6, atol=1)
        np.testing.assert_array_equal(frame.points.intensities, KEPT)
        assert frame.extras["dropped_points"] == 4
        points = scene.sensor("rear").frames[0].points
        assert len(points) == 2 * len(KEPT) + 1  # the second echo of a beam whose first is too near
        np.testing.assert_allclose(np.linalg.norm(points.positions, axis=1)[:2], [1, 2], atol=1e-6)
        np.testing.assert_array_equal(points.extras["echo"][:2], [0, 1])


@pytest.mark.parametrize("kind", ["ros1", "MCAP"])
def test_schemas_of_foxglove_in_ros_state_the_same(kind, tmp_path):
    with Bag(tmp_path / "drive", kind) as bag:

        def send(topic, name, *fields):
            stamp = bag.make("builtin_interfaces/msg/Time", EPOCH_NS // 10**9, EPOCH_NS % 10**9)
            schema = f"foxglove_msgs/msg/{name}"
            bag.add(topic, schema, bag.make(schema, stamp, "lidar", *fields), EPOCH_NS + 3_000_000)

        send("/scan", "LaserScan", bag.pose((0, 0, 2)), 0.0, np.pi, np.array([1.0, 2.0, 3.0]), np.zeros(0))
        send("/where", "PoseInFrame", bag.pose((1, 2, 3)))
        send("/cam/image", "RawImage", 2, 1, "rgb8", 6, np.arange(6, dtype=np.uint8))
        jpeg = cv2.imencode(".jpg", np.full((8, 8, 3), 90, np.uint8))[1].reshape(-1)
        send("/other/image/compressed", "CompressedImage", jpeg, "jpeg")
    with open_scene(bag.path) as scene:
        frame = scene.sensor("scan").frames[0]
        assert frame.timestamp_ns == EPOCH_NS
        np.testing.assert_allclose(frame.points.positions, [[1, 0, 2], [0, 2, 2], [-3, 0, 2]], atol=1e-6)
        np.testing.assert_array_equal(scene.trajectories["where"].positions, [[1, 2, 3]])
        np.testing.assert_array_equal(scene.sensor("cam").images[0].decode(), [[[0, 1, 2], [3, 4, 5]]])
        assert abs(int(scene.sensor("other").images[0].decode()[0, 0, 0]) - 90) <= 2


def test_velocities_and_covariances_stand_beside_what_they_are_of(tmp_path):
    spread = np.diag([0.1, 0.2, 0.3]).reshape(-1)
    turned = (0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4))  # a quarter turn about z
    with Bag(tmp_path / "drive", "MCAP") as bag:
        bag.transform("/tf_static", EPOCH_NS, "base_link", "imu", (0, 0, 0), turned)
        for k in range(3):
            time_ns = EPOCH_NS + k * PERIOD_NS
            moved = bag.make("geometry_msgs/msg/Twist", bag.vector(2, 0, 0), bag.vector(0, 0, 0.5))
            known = bag.make("geometry_msgs/msg/TwistWithCovariance", moved, np.diag([4.0] * 3 + [9.0] * 3).reshape(-1))
            body = bag.make("geometry_msgs/msg/PoseWithCovariance", bag.pose((k, 0, 0)), np.zeros(36))
            bag.send("/odom", "nav_msgs/msg/Odometry", time_ns, "map", "base_link", body, known)
            bag.send("/wheels", "geometry_msgs/msg/TwistStamped", time_ns, "base_link", moved)
            bag.send("/imu/data", "sensor_msgs/msg/Imu", time_ns, "imu", bag.rotation(0, 0, 0, 1), np.full(9, -1.0),
                     bag.vector(0, 0, 1), np.zeros(9), bag.vector(1, 0, 0), spread)  # fmt: skip
    with open_scene(bag.path) as scene:
        assert [sensor.id for sensor in scene.sensors] == ["imu", "wheels", "odom/twist"]
        odometry, wheels, imu = (scene.sensor(name) for name in ("odom/twist", "wheels", "imu"))
        for sensor in (odometry, wheels):
            np.testing.assert_array_equal(sensor.streams["linearVelocity"].values, [[2, 0, 0]] * 3)
            np.testing.assert_array_equal(sensor.streams["angularVelocity"].values, [[0, 0, 0.5]] * 3)
        assert odometry.extras["covariances"] == {
            "linearVelocity": np.diag([4.0] * 3).tolist(),
            "angularVelocity": np.diag([9.0] * 3).tolist(),
        }
        np.testing.assert_allclose(imu.streams["accelerometer"].values, [[0, 1, 0]] * 3, atol=1e-12)
        assert list(imu.extras["covariances"]) == ["accelerometer"]
        np.testing.assert_allclose(imu.extras["covariances"]["accelerometer"], np.diag([0.2, 0.1, 0.3]), atol=1e-12)
        assert not any(w.code == "unknown-messages" for w in scene.warnings)
        write_scene(scene, tmp_path / "out.sfs")
    with open_scene(tmp_path / "out.sfs") as scene:
        assert scene.sensor("odom/twist").extras["covariances"]["linearVelocity"] == np.diag([4.0] * 3).tolist()


def test_a_calibration_elsewhere_is_found_by_its_frame(data_dir):
    path = data_dir / "real" / "strangers" / "mcap" / "custom-camera-model.mcap"
    if not path.is_file():
        pytest.skip("no files of others beside the real data")
    with open_scene(path) as scene:
        camera = scene.cameras[0].camera
        # of two calibrations the one of a known model; 640x480 scaled to the images
        assert (camera.model, camera.width, camera.height) == ("brown_conrady", 520, 360)
        assert camera.fx == pytest.approx(800 * 520 / 640)
        assert any(w.code == "calibration-by-frame" for w in scene.warnings)


def test_real_scans_have_the_points_that_their_ranges_say(data_dir):
    from rosbags.highlevel import AnyReader

    path = data_dir / "real" / "strangers" / "ros1_bags" / "tilt_laser.bag"
    if not path.is_file():
        pytest.skip("no files of others beside the real data")
    with AnyReader([path]) as reader:
        rows = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == "/scan"]
    with open_scene(path) as scene:
        frames = scene.sensor("scan").frames
        assert len(frames) == len(rows)
        for k in (0, 100, 177):
            row = rows[k]
            good = np.isfinite(row.ranges) & (row.ranges >= row.range_min) & (row.ranges <= row.range_max)
            angles = row.angle_min + row.angle_increment * np.flatnonzero(good)
            x, y = row.ranges[good] * np.cos(angles), row.ranges[good] * np.sin(angles)
            np.testing.assert_allclose(frames[k].points.positions[:, :2], np.stack([x, y], axis=1), atol=1e-4)


def payloads():
    rows = table(60, nan=True)
    found = {f"cloudini {v} {c}": write.cloudini(rows, version=v, compression=c) for v, c in ((3, "ZSTD"), (5, "LZ4"))}
    found |= {f"sections {mode}": write.cloudini(rows, version=5, compression="NONE", modes=mode) for mode in range(4)}
    found["gorilla"] = write.cloudini(rows, version=4, stage="LOSSLESS", compression="NONE", text=False)
    return found | {"draco": draco_file(60)[1]}


@pytest.mark.parametrize("name", payloads())
def test_packed_points_that_are_cut_or_changed_are_decoded_or_refused(name):
    content, chance = payloads()[name], np.random.default_rng(8)
    if name == "draco":
        pytest.importorskip("DracoPy", reason="DracoPy is not installed")

    def refused(changed):
        try:
            unpacked(PackedCloudRecord(1, "lidar", name, memoryview(changed)))
        except ValueError:
            return True
        return False

    assert not refused(content)
    cuts = chance.integers(0, len(content), 60).tolist()
    assert all(refused(content[:cut]) for cut in cuts)
    for location in [*range(min(600, len(content)))]:
        refused(flipped(content, location, 0xFF))
    for location in chance.integers(0, len(content), 200).tolist():
        refused(flipped(content, location, 1 << int(chance.integers(8))))


def head_of(width, height):
    values = f"width: {width}\nheight: {height}\npoint_step: 16\nencoding_opt: LOSSY\ncompression_opt: ZSTD\nfields:\n"
    return b"CLOUDINI_V03\n" + values.encode() + b"\0"


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"CLOUDINI_V06\nversion: 6\n\0", "version '06'; expected 2 to 5"),
        (head_of(4_000_000_000, 4_000_000_000), "points; expected 0 to"),
        (head_of(100_000_000, 1), "that unpack to 1600000000"),
        (b"CLOUDINI_V03\nwidth: 1\n\0", "does not state"),
        (write.draco([(0, np.zeros((1, 3), "<f4"))], 100_000_000), "that unpack to 1200000000"),
        (write.draco([(0, np.zeros((1, 3), "<f4"))], -1), "-1 points"),
        (b"DRACO\2\3\1\1\0\0" + bytes(20), "expected points"),
        (b"what is this", "begin with 77 68 61 74"),
    ],
)  # fmt: skip
def test_hostile_heads_are_refused_before_memory_is_asked_for(content, problem):
    with pytest.raises(ValueError, match=problem):
        unpacked(PackedCloudRecord(1, "lidar", "x", memoryview(content)))


def test_packed_points_of_another_size_and_damaged_depths_are_refused_with_their_location(tmp_path):
    rows = table(doubles=False)
    with Bag(tmp_path / "drive", "MCAP") as bag:
        send_packed(bag, "/top/points/zstd", EPOCH_NS, rows, "zstd", zstandard.compress(rows.tobytes()[:-1]))
    with pytest.raises(DataError, match=r"/top/points/zstd\[0\]: unpacks to \d+ bytes; expected \d+"):
        open_scene(bag.path)
    depths = np.full((8, 12), 700, np.uint16)
    sound = {"png": bytes(12) + cv2.imencode(".png", depths)[1].tobytes(), "rvl": bytes(12) + write.rvl(depths)}
    chance = np.random.default_rng(2)
    for form, content in sound.items():
        with Bag(tmp_path / form, "MCAP") as bag:
            damaged = [content[:cut] for cut in range(0, len(content), 7)]
            damaged += [flipped(content, int(k), 0xFF) for k in chance.integers(0, len(content), 30)]
            for k, one in enumerate([content, *damaged]):
                bag.send("/depth/image/compressedDepth", "sensor_msgs/msg/CompressedImage", EPOCH_NS + k, "camera",
                         f"16UC1; compressedDepth {form}", np.frombuffer(one, np.uint8))  # fmt: skip
        with open_scene(bag.path) as scene:
            np.testing.assert_allclose(scene.sensors[0].frames[0].decode(), 0.7, atol=1e-6)
            with pytest.raises(DataError, match=r"compressedDepth\[1\]"):
                scene.sensors[0].frames[1].decode()
            for frame in scene.sensors[0].frames:
                try:
                    frame.decode()
                except DataError:
                    continue
