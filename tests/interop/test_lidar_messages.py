"""Messages of lidars and radars as their drivers state them, in bags that rosbags writes: layouts, times, packets."""

import json
import struct

import numpy as np
import pytest
from tests.interop.test_ros_bags import EPOCH_NS, PERIOD_NS, Bag
from tests.unit.formats.packets import build

from sceneloom.errors import DataError
from sceneloom.formats import open_scene
from sceneloom.formats.messages import ros

COUNT = 300
POINTS = np.random.default_rng(1).normal(0, 20, (COUNT, 3)).astype(np.float32)
OFFSETS_NS = np.linspace(0, 99_000_000, COUNT).astype(np.int64)
XYZI = (("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"))
OUSTER = {
    "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
    "formats": ["f4", "f4", "f4", "f4", "u4", "u2", "u1", "u2", "u4"],
    "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
    "itemsize": 48,
}
"""Source: ouster_ros, os_point.h: padding behind z and at the end."""

# of each layout: fields, the one of times, what it holds of (timestamp, offsets) [ns], how exact that is [ns]
LAYOUTS = {
    "velodyne": ([*XYZI, ("ring", "u2"), ("time", "f4")], "time", lambda t, o: o / 1e9, 10),
    "velodyne before": ([*XYZI, ("ring", "u2"), ("time", "f4")], "time", lambda t, o: (o - 99_000_000) / 1e9, 10),
    "velodyne t": ([*XYZI, ("ring", "u2"), ("t", "f4")], "t", lambda t, o: o / 1e9, 10),
    "ouster": (OUSTER, "t", lambda t, o: o, 0),
    "hesai": ([*XYZI, ("timestamp", "f8"), ("ring", "u2")], "timestamp", lambda t, o: (t + o) / 1e9, 400),
    "hesai time stamp": ([*XYZI, ("timeStamp", "f8"), ("ring", "u2")], "timeStamp", lambda t, o: (t + o) / 1e9, 400),
    "robosense": ([*XYZI, ("ring", "u2"), ("timestamp", "f8")], "timestamp", lambda t, o: (t + o) / 1e9, 400),
    "livox": ([*XYZI, ("tag", "u1"), ("line", "u1"), ("timestamp", "f8")], "timestamp", lambda t, o: t + o, 400),
    "autoware": ([*XYZI, ("return_type", "u1"), ("channel", "u2"), ("time_stamp", "u4")], "time_stamp",
                 lambda t, o: o, 0),
    "µs": ([*XYZI, ("t", "u4")], "t", lambda t, o: o // 1000, 1000),
    "absolute µs": ([*XYZI, ("timestamp", "f8")], "timestamp", lambda t, o: (t + o) / 1e3, 1000),
    "ms": ([*XYZI, ("time", "f4")], "time", lambda t, o: o / 1e6, 10),
    "whole ns as float": ([*XYZI, ("t", "f4")], "t", lambda t, o: o, 10),
    "since it began": ([*XYZI, ("timestamp", "f8")], "timestamp", lambda t, o: (t + o - EPOCH_NS) / 1e9 + 77.5, 20),
}  # fmt: skip


def table_of(fields, time, values, order):
    dtype = np.dtype(fields).newbyteorder(order)
    table = np.zeros(COUNT, dtype)
    for axis, column in zip("xyz", POINTS.T, strict=True):
        table[axis] = column
    table["intensity"] = np.arange(COUNT) % 256
    table[time] = values
    return table


@pytest.mark.parametrize("kind", ["ros1", "MCAP"])
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_of_drivers_keeps_the_times_of_points(name, order, kind, tmp_path):
    if kind == "MCAP" and order == ">":
        pytest.skip("one kind of bag for the byte order")
    fields, time, values, exact = LAYOUTS[name]
    with Bag(tmp_path / "bag", kind) as bag:
        for k in range(3):
            timestamp_ns = EPOCH_NS + k * PERIOD_NS
            table = table_of(fields, time, values(timestamp_ns, OFFSETS_NS), order)
            # points without a return, as clouds that are not dense have them
            table[5:9][["x", "y", "z"]], table[time][7:9] = (np.nan, np.nan, np.nan), 0
            bag.cloud("/top/points", timestamp_ns, "top", table, order=order)
    with open_scene(bag.path) as scene:
        (lidar,) = scene.lidars
        frame = lidar.frames[1]
    kept = np.delete(np.arange(COUNT), np.s_[5:9])
    begins = EPOCH_NS + PERIOD_NS - (99_000_000 if "before" in name else 0)
    # rounded to the time of the first point, where that is not the message's
    assert abs(frame.timestamp_ns - begins) <= max(exact, 10)
    assert np.array_equal(frame.points.positions, POINTS[kept])
    assert np.abs(frame.points.timestamps_ns - begins - OFFSETS_NS[kept]).max() <= exact
    other = [w for w in scene.warnings if w.code == "point-times-other-clock"]
    assert bool(other) == name.startswith("since")


def test_times_of_a_simulation_are_read_by_two_messages(tmp_path):
    # absolute, but in the first sweep as near to the clock's zero as to the message
    with Bag(tmp_path / "bag", "MCAP") as bag:
        for k in range(1, 40):
            table = table_of([*XYZI, ("timestamp", "f8")], "timestamp", (k * PERIOD_NS + OFFSETS_NS) / 1e9, "<")
            bag.cloud("/points", k * PERIOD_NS, "top", table)
    with open_scene(bag.path) as scene:
        times_ns = scene.lidars[0].frames[-1].points.timestamps_ns
    assert np.abs(times_ns - 39 * PERIOD_NS - OFFSETS_NS).max() <= 1


def test_what_is_no_time_and_what_falls_is_reported(tmp_path):
    with Bag(tmp_path / "bag", "MCAP") as bag:
        for k in range(3):
            stamp = EPOCH_NS + k * PERIOD_NS
            bag.cloud("/a", stamp, "a", table_of([*XYZI, ("t", "f4")], "t", 20 + OFFSETS_NS / 1e9, "<"))
            bag.cloud("/b", stamp, "b", table_of([*XYZI, ("t", "u4")], "t", OFFSETS_NS[::-1], "<"))
            bag.cloud("/c", stamp, "c", table_of([*XYZI, ("time", "u4")], "time", OFFSETS_NS // 50, "<"))
    with open_scene(bag.path) as scene:
        codes = {(w.code, w.location.rpartition("/")[2]) for w in scene.warnings if w.code.startswith("point-times")}
        assert scene.sensor("a").frames[0].points.timestamps_ns is None
    assert codes == {("point-times-not-used", "a"), ("point-times-assumed", "b"), ("point-times-fall", "b"),
                     ("point-times-assumed", "c"), ("point-times-uncertain", "c")}  # fmt: skip


def livox(bag, package, stamp_ns, base_ns):
    points = [
        bag.make(f"{package}/msg/CustomPoint", int(offset), *map(float, xyz), n % 256, 16, n % 6)
        for n, (offset, xyz) in enumerate(zip(OFFSETS_NS, POINTS, strict=True))
    ]
    rest = base_ns, COUNT, 3, np.zeros(3, np.uint8), points
    bag.send("/livox/lidar", f"{package}/msg/CustomMsg", stamp_ns, "livox_frame", *rest)


@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2", "livox_interfaces"])
@pytest.mark.parametrize("kind", ["ros1", "SQLITE3"])
def test_livox_messages_are_sweeps(kind, package, tmp_path):
    apart_ns = {"livox_ros_driver": 0, "livox_ros_driver2": 3_000_000, "livox_interfaces": 10**18}[package]
    with Bag(tmp_path / "bag", kind) as bag:
        for k in range(2):
            stamp = EPOCH_NS + k * PERIOD_NS
            livox(bag, package, stamp, stamp - apart_ns)
    with open_scene(bag.path) as scene:
        (lidar,) = scene.lidars
        frame = lidar.frames[1]
    # a base that is of another clock is not used
    base_ns = EPOCH_NS + PERIOD_NS - (apart_ns if apart_ns < 10**9 else 0)
    assert np.array_equal(frame.points.positions, POINTS)
    assert np.array_equal(frame.points.timestamps_ns, base_ns + OFFSETS_NS)
    assert np.array_equal(frame.points.intensities, np.arange(COUNT) % 256)
    assert np.array_equal(frame.points.rings, np.arange(COUNT) % 6)
    assert (frame.points.extras["tag"] == 16).all()
    assert any(w.code == "point-times-other-clock" for w in scene.warnings) == (apart_ns > 10**9)
    assert not any(w.code == "unknown-messages" for w in scene.warnings)


def velodyne_packets(count=400):
    rng = np.random.default_rng(2)
    flat = rng.integers(600, 5000, (12, 32)), rng.integers(0, 256, (12, 32))
    return [
        build.velodyne([(n * 240 + 20 * k) % 36000 for k in range(12)], *flat, time_us=10_000 + 1327 * n)
        for n in range(count)
    ]


def scans(bag, packets, *, each=76, step_ns=1_327_000):
    for start in range(0, len(packets), each):
        found = []
        for number, packet in enumerate(packets[start : start + each], start):
            time_ns = EPOCH_NS + number * step_ns
            stamp = bag.make("builtin_interfaces/msg/Time", time_ns // 10**9, time_ns % 10**9)
            found.append(bag.make("velodyne_msgs/msg/VelodynePacket", stamp, np.frombuffer(packet, np.uint8)))
        bag.send("/velodyne_packets", "velodyne_msgs/msg/VelodyneScan", time_ns, "velodyne", found)


def write_bag(folder, kind="ros1"):
    """A small bag of packets and of Livox's messages."""
    with Bag(folder / "drive", kind) as bag:
        scans(bag, velodyne_packets(8), each=4)
        for k in range(2):
            livox(bag, "livox_ros_driver2", EPOCH_NS + k * PERIOD_NS, EPOCH_NS + k * PERIOD_NS)
            stamp = bag.make("builtin_interfaces/msg/Time", EPOCH_NS // 10**9, k * PERIOD_NS)
            lists = [method.to_bytes(4, "big") + bytes(size) for method, size in ((336, 35332), (329, 9397))]
            found = [bag.make("nebula_msgs/msg/NebulaPacket", stamp, np.frombuffer(one, np.uint8)) for one in lists]
            bag.send("/radar/packets", "nebula_msgs/msg/NebulaPackets", EPOCH_NS + k * PERIOD_NS, "radar", found)
            sized = np.zeros(1500, np.uint8)
            sized[:1262] = np.frombuffer(
                build.hesai_40p(range(10), np.full((10, 40), 300), np.full((10, 40), 30), time_us=9 + k), np.uint8
            )
            found = [bag.make("pandar_msgs/msg/PandarPacket", stamp, sized, 1262)]
            bag.send("/pandar_packets", "pandar_msgs/msg/PandarScan", EPOCH_NS + k * PERIOD_NS, "pandar", found)
    return bag.path


@pytest.mark.parametrize("kind", ["ros1", "SQLITE3"])
def test_a_bag_and_a_capture_give_the_same_points(kind, tmp_path):
    packets = velodyne_packets()
    with Bag(tmp_path / "bag", kind) as bag:
        scans(bag, packets)
        bag.transform("/tf_static", EPOCH_NS, "base_link", "velodyne", (1, 0, 2))
    path = build.capture(tmp_path / "a.pcap", packets, step_ns=1_327_000, start_ns=EPOCH_NS)
    with open_scene(path) as capture, open_scene(bag.path) as scene:
        (lidar,), (same,) = scene.lidars, capture.lidars
        assert lidar.model == same.model == "Velodyne VLP-16"
        np.testing.assert_allclose(lidar.mount.translation, [1, 0, 2])
        assert len(lidar.frames) == 3
        assert np.array_equal(lidar.frames.timestamps_ns, same.frames.timestamps_ns)
        for ours, theirs in zip(lidar.frames, same.frames, strict=True):
            assert np.array_equal(ours.points.positions, theirs.points.positions)
            assert np.array_equal(ours.points.timestamps_ns, theirs.points.timestamps_ns)


PACKETS = {  # types of packets, by that of their message
    "velodyne_msgs/msg/VelodyneScan": ("velodyne_msgs/msg/VelodynePacket", 1206, ()),
    "pandar_msgs/msg/PandarScan": ("pandar_msgs/msg/PandarPacket", 1500, (1262,)),
    "robosense_msgs/msg/RobosenseScan": ("robosense_msgs/msg/RobosensePacket", 1500, (1248,)),
}


@pytest.mark.parametrize("encoding", ["ros1", "cdr", "cdr of the other order"])
@pytest.mark.parametrize("name", PACKETS)
def test_packets_as_they_lie_in_a_message_are_those_that_rosbags_reads_and_cut_ones_are_refused(name, encoding):
    packet, length, size = PACKETS[name]
    connection = ros._Connection("/packets", name, "", "", encoding[:4].strip())
    store = ros._store_of(connection, None)
    make, rng = store.types, np.random.default_rng(3)

    def content_of(sizes):
        found = [
            make[packet](make[ros._TIME](1_700_000_000 + k, 5 * k), rng.integers(0, 256, length, np.uint8), *one)
            for k, one in enumerate(sizes)
        ]
        sequence = (7,) if encoding == "ros1" else ()
        header = make["std_msgs/msg/Header"](*sequence, make[ros._TIME](1_700_000_001, 12), "top")
        message = make[name](header, found)
        if encoding == "ros1":
            return memoryview(store.serialize_ros1(message, name))
        return memoryview(store.serialize_cdr(message, name, little_endian=encoding == "cdr"))

    for count in (0, 1, 5):
        content = content_of([size] * count)
        (expected,) = ros._packets(ros._parsed(connection, content, None))
        found = ros._packed_packets(store, connection, content)
        assert (found.timestamp_ns, found.frame_id) == (expected.timestamp_ns, expected.frame_id)
        assert [*map(bytes, found.packets)] == [*map(bytes, expected.packets)]
        if count:
            assert np.array_equal(found.arrivals_ns, expected.arrivals_ns)
        for cut in (1, 9, 40, len(content) // 2):
            with pytest.raises(ros._FAULTS):
                ros._packed_packets(store, connection, content[: max(len(content) - cut, 0)])
        with pytest.raises(ValueError, match="bytes behind"):
            ros._packed_packets(store, connection, memoryview(bytes(content) + bytes(8)))
    if size:
        assert ros._packed_packets(store, connection, content_of([(9,), (10,)])) is None  # each by itself
        with pytest.raises(ValueError, match=f"a packet of {length + 1} bytes, of which {length} are there"):
            ros._packed_packets(store, connection, content_of([(length + 1,)]))


@pytest.mark.parametrize("extra", [0, 1])
def test_ouster_packets_need_metadata_of_a_topic_or_a_file(extra, tmp_path):
    text = build.ouster_metadata(tmp_path / "a.json").read_text()
    (tmp_path / "a.json").rename(tmp_path / "a.txt")
    words = np.random.default_rng(1).integers(0, 256, (16, 4, 4), np.uint8)
    packets = [build.ouster(range(s, s + 16), words, frame=f, first_ns=10**12 + f * 10**8) for f in (1, 2)
               for s in range(0, 64, 16)]  # fmt: skip
    imu = np.zeros(1, np.dtype([("t", "<u8", 3), ("v", "<f4", 6)]))
    imu["t"], imu["v"] = 10**12, [0, 0, 1, 0, 0, 0]
    for with_topic in (True, False):
        with Bag(tmp_path / f"bag{with_topic}", "MCAP") as bag:
            if with_topic:
                bag.add("/ouster/metadata", "std_msgs/msg/String", bag.make("std_msgs/msg/String", text), EPOCH_NS)
            for number, packet in enumerate(packets):
                content = np.frombuffer(packet + bytes(extra), np.uint8)
                name = "ouster_sensor_msgs/msg/PacketMsg"
                bag.add("/ouster/lidar_packets", name, bag.make(name, content), EPOCH_NS + number * 25_000_000)
            bag.add("/ouster/imu_packets", name, bag.make(name, imu.view(np.uint8)), EPOCH_NS)
        if not with_topic:
            with pytest.raises(DataError, match="metadata"):
                open_scene(bag.path)
        with open_scene(bag.path, metadata=None if with_topic else str(tmp_path / "a.txt")) as scene:
            (lidar,), (unit,) = scene.lidars, [one for one in scene.sensors if one.type == "imu"]
            assert lidar.id == "ouster/lidar_packets"
            assert len(lidar.frames) == 2
            assert len(lidar.frames[0].points) > 100
            assert unit.streams["accelerometer"].values[0] == pytest.approx([0, 0, 9.80665])
            assert abs(int(unit.streams["accelerometer"].timestamps_ns[0]) - EPOCH_NS) < 10**9
            assert not any(w.code == "unknown-messages" for w in scene.warnings)


NEAR, HRR, OBJECTS = (900, 901), (1100, 1101), (1200, 1201)
DETECTION = (("range", 12), ("azimuth", 9), ("range_rate", 11), ("rcs", 7), ("pdh", 5), ("snr", 4))
OBJECT = (
    ("id", 8), ("x", 16), ("y", 16), ("vx", 14), ("vy", 14), ("ax", 10), ("ay", 10), ("deviations", 84), ("length", 12),
    ("width", 12), ("orientation", 12), ("rcs", 12), ("score", 4), ("life", 16), ("rest", 8),
)  # fmt: skip


def bits(fields, values):
    text = "".join(format(values.get(name, 0), f"0{count}b") for name, count in fields)
    return int(text, 2).to_bytes(len(text) // 8, "big")


def can_list(ids, rows, *, elements, each, seconds, numbers, sync=1, cycle=0):
    """The packets of a list of an SRR520 by nebula's description: a head, elements, and a checksum."""
    counts = (
        struct.pack(">HHH", *numbers, len(rows)) if ids != OBJECTS else struct.pack(">HHBB", *numbers, 3, len(rows))
    )
    head = struct.pack(">IIIIBBBI", ids[0], 1234, seconds, 500, sync, 1, 9, cycle) + counts
    packets = [head + bytes(36 - len(head))]
    for k in range(elements):
        body = b"".join(rows[k * each : (k + 1) * each])
        packets.append(struct.pack(">I", ids[1]) + body.ljust(62, b"\0") + bytes((k, 9)))
    return [*packets, struct.pack(">IBHB", 800, 0, 0, 0)]


def srr520(bag, *, sync=1, late=0, without=()):
    stamp = bag.make("builtin_interfaces/msg/Time", EPOCH_NS // 10**9, late)
    rows = [bits(DETECTION, {"range": 100 * k, "azimuth": 255 + k, "range_rate": 1023 - k, "rcs": 84, "pdh": 0b10001,
                             "snr": 3}) for k in range(23)]  # fmt: skip
    rows[4] = bits(DETECTION, {"range": 9, "azimuth": 511})
    things = [bits(OBJECT, {"id": 5 + k, "x": 33859, "y": 32767 + 1092 * k, "vx": 9283, "vy": 8191, "ax": 511,
                            "ay": 1023, "deviations": 546 << 70 | 1, "length": 614, "width": 273, "orientation": 3070,
                            "rcs": 2047, "score": 15, "life": 300, "rest": 0b101}) for k in range(3)]  # fmt: skip
    second = EPOCH_NS // 10**9 + late // 10**9
    lists = [
        can_list(NEAR, rows, elements=50, each=10, seconds=second, numbers=(65535, 1000), sync=sync),
        can_list(HRR, rows[:2], elements=20, each=10, seconds=second, numbers=(65535, 1500), sync=sync),
        can_list(OBJECTS, things, elements=20, each=2, seconds=second, numbers=(36044, 32767), sync=sync),
    ]
    for content in lists:
        content[:] = [packet for k, packet in enumerate(content) if k not in without]
        found = [bag.make("nebula_msgs/msg/NebulaPacket", stamp, np.frombuffer(one, np.uint8)) for one in content]
        bag.send("/radar/packets", "nebula_msgs/msg/NebulaPackets", EPOCH_NS + late, "radar", found)


@pytest.mark.parametrize("kind", ["ros1", "SQLITE3"])
def test_lists_of_an_srr520_are_read_as_nebula_describes_them(kind, tmp_path):
    with Bag(tmp_path / "bag", kind) as bag:
        srr520(bag)
        srr520(bag, late=10**9)
    with open_scene(bag.path) as scene:
        by_id = {one.id.rpartition("/")[2]: one for one in scene.sensors}
        (near,) = (one for one in scene.sensors if not one.id.endswith(("/hrr", "/objects")))
        hrr, objects = by_id["hrr"], by_id["objects"]
        assert [len(one.frames) for one in (near, hrr, objects)] == [2, 2, 2]
        times = near.frames.timestamps_ns
        assert times.tolist() == [EPOCH_NS // 10**9 * 10**9 + 500 + k * 10**9 for k in range(2)]
        frame, points = near.frames[0], near.frames[0].points
        assert len(points) == 22
        assert frame.extras["dropped_points"] == 1  # its azimuth is no value
        assert (frame.extras["v_ambiguous"], frame.extras["max_range"]) == (pytest.approx(100, abs=0.01), 100)
        kept = np.delete(np.arange(23), 4)
        ranges, azimuths = kept * 2.4420024, np.deg2rad((kept + 255 - 255) * 180 / 510)
        expected = np.stack((ranges * np.cos(azimuths), ranges * np.sin(azimuths), 0 * ranges), axis=1)
        np.testing.assert_allclose(points.positions, expected, atol=1e-3)
        np.testing.assert_allclose(points.lengths, -kept * 0.014662757, atol=1e-4)
        assert points.extras["rcs"][0] == pytest.approx(0, abs=1e-4)
        assert points.extras["snr"][0] == pytest.approx(16.1)
        assert [points.extras[f"pdh0{k}"][0] for k in range(5)] == [100, 0, 0, 0, 100]
        assert len(hrr.frames[0].points) == 2
        points = objects.frames[0].points
        assert objects.points_frame == "ego"
        assert points.extras["object_id"].tolist() == [5, 6, 7]
        np.testing.assert_allclose(points.positions, [[10, 10 * k, 0] for k in range(3)], atol=0.01)
        # they move at 10 m/s over ground, as the vehicle does
        np.testing.assert_allclose(points.extras["v_abs_x"], 10, atol=0.01)
        np.testing.assert_allclose(points.lengths, 0, atol=0.02)
        assert np.isnan(points.extras["a_abs_y"]).all()
        for name, value in (("dist_x_std", 1), ("box_length", 4.5), ("box_width", 2), ("orientation", 1.5708),
                            ("rcs", 0), ("score", 100), ("life_cycles", 300), ("box_valid", 1)):  # fmt: skip
            assert points.extras[name][2] == pytest.approx(value, abs=0.003), name
        assert points.extras["a_abs_y_std"][0] == pytest.approx(0.0018, abs=1e-4)
        assert points.extras["object_status"].tolist() == [2, 2, 2]
        assert objects.frames[0].extras["ego_vx"] == pytest.approx(10, abs=0.01)
    assert not [one for one in scene.warnings if one.code.startswith(("packets", "lidar"))]


def test_lists_of_an_srr520_with_missing_packets_or_without_a_clock_are_reported(tmp_path):
    with Bag(tmp_path / "bag", "SQLITE3") as bag:
        srr520(bag, sync=3)
        srr520(bag, sync=3, late=10**9, without=(2,))  # the second element of each list
        srr520(bag, sync=3, late=2 * 10**9, without=(0,))
    with open_scene(bag.path) as scene:
        (near,) = (one for one in scene.sensors if not one.id.endswith(("/hrr", "/objects")))
        assert near.frames.timestamps_ns.tolist() == [EPOCH_NS, EPOCH_NS + 10**9]
        frame = near.frames[1]
        assert frame.extras["dropped_points"] == 11
        np.testing.assert_allclose(frame.points.lengths[8:10], -np.array([9, 20]) * 0.014662757, atol=1e-4)
        codes = {one.code: one.count for one in scene.warnings}
    assert codes["radar-clock"] == 6
    assert codes["packets-unusable"] == 3


def test_the_last_grid_of_a_topic_in_a_fixed_frame_is_a_map_and_one_that_moves_is_reported(tmp_path):
    with Bag(tmp_path / "bag", "SQLITE3") as bag:
        bag.transform("/tf_static", EPOCH_NS, "base_link", "top", (0, 0, 2))
        bag.transform("/tf_static", EPOCH_NS, "map", "site", (100, 0, 0))
        for k in range(3):
            stamp = EPOCH_NS + k * PERIOD_NS
            bag.transform("/tf", stamp, "map", "base_link", (5 * k, 0, 0))
            bag.cloud("/points", stamp, "top", table_of([*XYZI, ("t", "u4")], "t", OFFSETS_NS, "<"))
            time = bag.header(stamp, "").stamp
            for topic, frame, corner in (("/map", "site", (10, 20, 1)), ("/costmap", "base_link", (0, 0, 0))):
                # turned by 90 degrees: columns along y, rows against x
                info = bag.make(
                    "nav_msgs/msg/MapMetaData", time, 0.5, 3, 2, bag.pose(corner, (0, 0, 0.5**0.5, 0.5**0.5))
                )
                cells = np.array([0, 100, -1, 40, 101, k], np.int8)
                bag.send(topic, "nav_msgs/msg/OccupancyGrid", stamp, frame, info, cells)
    with open_scene(bag.path) as scene:
        (cloud,) = (one for one in scene.sensors if one.type == "points")
        assert cloud.id == "map"
        expected = [[109.75, 20.25, 1], [109.75, 20.75, 1], [109.25, 20.25, 1], [109.25, 21.25, 1]]
        np.testing.assert_allclose(cloud.positions, expected, atol=1e-5)
        assert cloud.colors[:, 0].tolist() == [255, 0, 153, 250]
        codes = {one.code: (one.location.rpartition(": ")[2], one.count) for one in scene.warnings}
    assert codes["grids-replaced"] == ("/map", 2)
    assert codes["grids-moving"] == ("/costmap", 3)


def test_texts_of_others_and_packets_of_unknown_sensors_are_listed(tmp_path):
    other = json.dumps({"beam_altitude_angles": []})
    with Bag(tmp_path / "other", "MCAP") as bag:
        bag.add("/a/metadata", "std_msgs/msg/String", bag.make("std_msgs/msg/String", other), EPOCH_NS)
        bag.cloud("/points", EPOCH_NS, "top", table_of([*XYZI], "intensity", 1, "<"))
        stamp = bag.make("builtin_interfaces/msg/Time", EPOCH_NS // 10**9, 0)
        packet = bag.make("nebula_msgs/msg/NebulaPacket", stamp, np.ones(900, np.uint8))
        bag.send("/packets", "nebula_msgs/msg/NebulaPackets", EPOCH_NS, "another", [packet] * 3)
    with open_scene(bag.path) as scene:
        assert [w.count for w in scene.warnings if w.code == "unknown-messages"] == [1]
        assert [w.count for w in scene.warnings if w.code == "packets-unknown"] == [3]
