"""Whatever bytes a capture is made of: it is read, or refused with one of our errors."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.malformed.damage import flipped, look_at_everything, scattered
from tests.unit.formats.packets import build
from tests.unit.formats.packets.build import START_NS, frames_of, pcap, pcapng
from tests.unit.formats.packets.test_reader import ouster_packets, rotation

from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats import open_scene
from sceneloom.formats.packets import hesai, ouster, velodyne


def sound(folder):
    """A small drive of every maker, in fragments and whole."""
    build.ouster_metadata(folder / "a.json")
    flat = np.full((12, 32), 700)
    shapes = ((10, 40), (6, 32), (4, 64))
    makes = (build.hesai_40p, build.hesai, build.hesai)
    angles = list(range(-8, 8))
    packets = [(port, one) for port, one in zip((7502, 7502), ouster_packets()[3:5], strict=True)]
    packets += [(2368, one) for one in rotation(2)]
    packets += [
        (7788, build.robosense_state(angles, angles)),
        (6699, build.robosense(range(12), flat, flat % 250, time_us=3)),
    ]
    for port, (shape, make) in enumerate(zip(shapes, makes, strict=True), 3000):
        packets.append((port, make(range(shape[0]), np.full(shape, 300), np.full(shape, 30), time_us=9)))
    return [
        (START_NS + number * 10**6, frame)
        for number, (port, packet) in enumerate(packets)
        for frame in frames_of(packet, port=port, number=number, mtu=800 if number % 2 else 0)
    ]


def read(path, content):
    path.write_bytes(content)
    with suppress(SceneloomError), open_scene(path, format="pcap") as scene:
        look_at_everything(scene)
        return len(scene.sensors)
    return 0


@pytest.mark.parametrize("form", [pcap, pcapng])
def test_a_capture_that_is_cut_flipped_or_scattered_is_read_or_refused(tmp_path, form):
    whole = form(sound(tmp_path))
    path = tmp_path / "a.pcap"
    assert read(path, whole) == 6
    chance = np.random.default_rng(5)
    for cut in chance.integers(0, len(whole), 25).tolist():
        read(path, whole[:cut])
    for location in [*range(0, 120, 3), *chance.integers(0, len(whole), 40).tolist()]:
        read(path, flipped(whole, location, 0xFF))
    for count in (1, 20, 1000, 10_000):
        read(path, scattered(whole, chance, count, start=24))


@settings(max_examples=60)
@given(junk=st.binary(max_size=300), magic=st.sampled_from(["d4c3b2a1", "a1b23c4d", "0a0d0d0a"]))
def test_any_bytes_after_a_magic_number_are_no_capture_or_an_empty_one(tmp_path_factory, junk, magic):
    path = tmp_path_factory.mktemp("junk") / "a.pcap"
    assert read(path, bytes.fromhex(magic) + junk) == 0


@pytest.mark.parametrize("value", [None, "x", -1, 0, 1e300, float("nan"), [], [[]], {}, 2**70])
def test_any_value_of_metadata_may_be_wrong(tmp_path, value):
    content = ouster.read_json(build.ouster_metadata(tmp_path / "a.json"), dict)
    for group, fields in content.items():
        for name in fields:
            with suppress(DataError):
                ouster.parse_metadata({**content, group: {**fields, name: value}}, "a.json")
        with suppress(DataError):
            ouster.parse_metadata({**content, group: value}, "a.json")


@settings(max_examples=60)
@given(junk=st.binary(max_size=400))
def test_any_file_of_angles_is_read_or_refused(tmp_path_factory, junk):
    path = tmp_path_factory.mktemp("junk") / "a.csv"
    for content in (junk, b"\xee\xff\x01\x05\x80\x03\x03" + junk, b"lasers:\n- laser_id: 0\n  rot_correction: " + junk):
        path.write_bytes(content)
        for reader in (
            hesai.read_at_correction,
            velodyne.read_corrections,
            lambda file: hesai.decoder_of("xt32m", file),
        ):
            with pytest.raises(DataError):
                reader(path)


@pytest.mark.parametrize("kind", ["ros1", "SQLITE3"])
def test_a_message_that_is_cut_or_has_wrong_lengths_is_read_or_refused(kind, tmp_path):
    rosbags = pytest.importorskip("rosbags.highlevel")
    from tests.interop.test_lidar_messages import Bag, write_bag

    with rosbags.AnyReader([write_bag(tmp_path, kind)]) as reader:
        sound = [(one.topic, one.msgtype, bytes(raw), time_ns) for one, time_ns, raw in reader.messages()]
    chance = np.random.default_rng(4)
    # of a message, bytes that say how many follow: of packets, of points, of a packet's bytes
    for number in range(9):
        with Bag(tmp_path / f"bad{number}", kind) as bag:
            for topic, name, raw, time_ns in sound:
                content = bytearray(raw)
                at = 4 * int(chance.integers(0, 20))
                if number % 3 == 0:
                    content = content[: int(chance.integers(0, len(raw)))]
                elif number % 3 == 1:
                    content[at : at + 4] = (0xFFFFFFFF, 0x7FFFFFFF, 1 << 24)[number // 3].to_bytes(4, "little")
                else:
                    content[-int(chance.integers(1, 9))] ^= 0xFF
                if (topic, name) not in bag.connections:
                    bag.connections[topic, name] = bag.writer.add_connection(topic, name, typestore=bag.store)
                bag.writer.write(bag.connections[topic, name], time_ns, bytes(content))
        path = bag.path if kind == "ros1" else next(bag.path.glob("*.db3"))
        for lenient in (False, True):
            with suppress(SceneloomError), open_scene(path, lenient=lenient) as scene:
                look_at_everything(scene)


@settings(max_examples=60)
@given(junk=st.binary(min_size=1, max_size=300), version=st.sampled_from([b"\x01\x01", b"\x02\x00"]))
def test_any_bytes_after_the_head_of_a_livox_file_are_read_or_refused(tmp_path_factory, junk, version):
    path = tmp_path_factory.mktemp("junk") / "a.lvx"
    path.write_bytes(b"livox_tech".ljust(16, b"\0") + version + b"\0\0\x67\xa7\x0e\xac" + bytes(4) + junk)
    with suppress(SceneloomError), open_scene(path, lenient=bool(junk[0] % 2)) as scene:
        look_at_everything(scene)
