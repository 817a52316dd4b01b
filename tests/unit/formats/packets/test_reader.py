"""Captures as scenes: which lidars are in them, their sweeps in order, and what is reported of the rest."""

import pickle
import struct

import numpy as np
import pytest
from tests.unit.formats.packets import build
from tests.unit.formats.packets.build import START_NS, capture, frames_of, pcap

from sceneloom.errors import DataError, OptionError, UnknownFormatError
from sceneloom.formats import open_scene

HOUR_US = START_NS // 1000 % 3_600_000_000
PERIOD_US = 1327


def rotation(count, *, start_us=HOUR_US, **how):
    """Packets of a VLP-16 at 10 Hz, of which each return lies one step farther than the one before."""
    found = []
    for number in range(count):
        azimuths = [int(number * 477.7 + 39.8 * k) % 36000 for k in range(12)]
        distances = np.full((12, 32), 1000) + 12 * number + np.arange(12)[:, None]
        time_us = (start_us + number * PERIOD_US) % 3_600_000_000
        found.append(build.velodyne(azimuths, distances, np.full((12, 32), 9), time_us=time_us, **how))
    return found


def opened(path, **options):
    with open_scene(path, **options) as scene:
        return scene, {warning.code: warning for warning in scene.warnings}


def test_sweeps_begin_where_the_sensor_passes_its_zero_and_bear_times_of_each_point(tmp_path):
    path = capture(tmp_path / "a.pcap", rotation(200), step_ns=PERIOD_US * 1000)
    scene, warnings = opened(path)
    (lidar,) = scene.sensors
    assert (lidar.id, lidar.model, set(warnings)) == ("lidar", "Velodyne VLP-16", {"extrinsics-unknown"})
    frames = pickle.loads(pickle.dumps(lidar.frames))
    assert sum(len(frame.points) for frame in frames) == 200 * 384
    for number, frame in list(enumerate(frames))[1:]:
        first = np.argmin(frame.points.timestamps_ns)
        assert frame.timestamp_ns == frame.points.timestamps_ns[first]
        azimuths = np.rad2deg(np.arctan2(-frame.points.positions[:, 1], frame.points.positions[:, 0])) % 360
        assert azimuths[first] < 0.5
        if number < len(frames) - 1:
            assert np.ptp(azimuths[np.argsort(frame.points.timestamps_ns)]) > 359
    starts = np.diff([frame.timestamp_ns for frame in frames[1:]])
    assert np.abs(starts - 100e6).max() < 1e6


def test_hours_come_from_the_arrival_also_where_the_clock_begins_anew(tmp_path):
    before = START_NS // 1000 // 3_600_000_000 * 3_600_000_000 + 3_600_000_000 - 100_000
    packets = rotation(150, start_us=before)
    path = capture(tmp_path / "a.pcap", packets, step_ns=PERIOD_US * 1000, start_ns=before * 1000 + 5_000_000)
    scene, _ = opened(path)
    times = np.concatenate([frame.points.timestamps_ns for frame in scene.sensors[0].frames])
    assert times.min() == before * 1000
    assert np.ptp(times) == pytest.approx(150 * PERIOD_US * 1000, rel=0.01)


def test_packets_out_of_order_twice_and_missing_are_counted_and_the_points_are_the_same(tmp_path):
    packets = rotation(100)
    plain, _ = opened(capture(tmp_path / "a.pcap", packets, step_ns=PERIOD_US * 1000))
    mixed = [*packets[:20], packets[21], packets[20], *packets[22:50], packets[49], *packets[50:]]
    again, warnings = opened(capture(tmp_path / "b.pcap", mixed, step_ns=PERIOD_US * 1000))
    assert warnings["packets-reordered"].count == 1
    assert warnings["packets-repeated"].count == 1
    for one, other in zip(plain.sensors[0].frames, again.sensors[0].frames, strict=True):
        assert np.array_equal(one.points.positions, other.points.positions)
        assert np.array_equal(one.points.timestamps_ns, other.points.timestamps_ns)
    _, warnings = opened(capture(tmp_path / "c.pcap", packets[:30] + packets[33:], step_ns=PERIOD_US * 1000))
    assert warnings["packets-missing"].count == 3
    foreign = [*packets[:50], b"\xee" * 1206, *packets[50:]]
    _, warnings = opened(capture(tmp_path / "d.pcap", foreign, step_ns=PERIOD_US * 1000))
    assert warnings["packets-unusable"].count == 1


def test_a_clock_that_is_set_or_wrong_in_a_packet_does_no_harm(tmp_path):
    packets, wrong = rotation(100), rotation(100, start_us=HOUR_US + 1_200_000_000)
    mixed = [*packets[:40], wrong[40], *packets[41:70], *wrong[70:]]
    scene, warnings = opened(capture(tmp_path / "a.pcap", mixed, step_ns=PERIOD_US * 1000))
    assert warnings["clock-jumped"].count == 31
    times = np.concatenate([frame.points.timestamps_ns for frame in scene.sensors[0].frames])
    assert np.ptp(times) < 100 * PERIOD_US * 1000
    assert (np.diff(scene.sensors[0].frames.timestamps_ns) > 0).all()


def test_a_sector_without_measurements_is_none_of_missing_packets(tmp_path):
    packets = [one for k, one in enumerate(rotation(400)) if not 40 < k * 477.7 % 36000 / 477.7 < 60]
    _, warnings = opened(capture(tmp_path / "a.pcap", packets, step_ns=PERIOD_US * 1000))
    assert "packets-missing" not in warnings


def test_several_lidars_keep_apart_and_each_names_its_sender(tmp_path):
    records = []
    for k, packet in enumerate(rotation(30)):
        senders = ("192.168.1.201", "192.168.1.202")
        records += [(START_NS + k * PERIOD_US * 1000, *frames_of(packet, sender=sender)) for sender in senders]
    records.append((START_NS, *frames_of(b"hello", port=53)))
    (tmp_path / "a.pcap").write_bytes(pcap(records))
    scene, warnings = opened(tmp_path / "a.pcap")
    assert [lidar.id for lidar in scene.sensors] == ["lidar_1", "lidar_2"]
    assert [lidar.extras["sender"] for lidar in scene.sensors] == ["192.168.1.201:2368", "192.168.1.202:2368"]
    assert (warnings["datagrams-unknown"].count, "5 bytes to port 53" in warnings["datagrams-unknown"].message) == (
        1,
        True,
    )


def test_position_packets_become_fixes_each_sentence_once_and_only_those_that_hold(tmp_path):
    def position(sentence):
        return bytes(206) + f"{sentence}\r\n".encode().ljust(306, b"\0")

    valid = "$GPRMC,221320.00,A,3649.7478558,N,00224.4542928,W,0.034,212.5,141123,0.0,E,A"
    sentences = [f"{valid}*{check(valid):02X}", f"{valid}*00", "", valid.replace(",A,", ",V,", 1)]
    records = [(START_NS + k * PERIOD_US * 1000, *frames_of(one)) for k, one in enumerate(rotation(20))]
    for k, sentence in enumerate([sentences[0], *sentences]):
        records.append((START_NS + k * 1000, *frames_of(position(sentence), port=8308)))
    (tmp_path / "a.pcap").write_bytes(pcap(records))
    scene, warnings = opened(tmp_path / "a.pcap")
    gnss = scene.sensor("gnss")
    assert gnss.timestamps_ns.tolist() == [START_NS]
    assert gnss.positions_lla[0, :2] == pytest.approx([36 + 49.7478558 / 60, -(2 + 24.4542928 / 60)])
    assert (gnss.positions_lla[0, 2], "altitude-unknown" in warnings) == (0, True)
    gga = "$GPGGA,221321.50,3649.7478558,S,00224.4542928,E,1,08,0.9,100.0,M,45.5,M,,"
    records.append((START_NS + 10**9, *frames_of(position(f"{gga}*{check(gga):02X}"), port=8308)))
    (tmp_path / "a.pcap").write_bytes(pcap(records))
    gnss = opened(tmp_path / "a.pcap")[0].sensor("gnss")
    assert gnss.timestamps_ns.tolist() == [START_NS, START_NS + 1_500_000_000]
    assert gnss.positions_lla[1, 2] == 145.5


def check(sentence):
    found = 0
    for character in sentence[1:]:
        found ^= ord(character)
    return found


def ouster_packets(columns=64, frames=3, size=4):
    words = np.arange(16 * 4 * size, dtype=np.uint8).reshape(16, 4, size) | 1
    return [
        build.ouster(
            range(start, start + 16), words, frame=frame, size=size, first_ns=10**12 + frame * 10**8, step_ns=1_562_500
        )
        for frame in range(frames)
        for start in range(0, columns, 16)
    ]


def test_an_ouster_needs_its_metadata_beside_the_capture_or_by_option(tmp_path):
    path = capture(tmp_path / "a.pcap", ouster_packets(), step_ns=25_000_000, port=7502)
    metadata = build.ouster_metadata(tmp_path / "a.json")
    scene, warnings = opened(path)
    assert set(warnings) == {"clock-shifted", "extrinsics-unknown"}
    assert [len(frame.points) for frame in scene.sensors[0].frames] == [64 * 4] * 3
    assert np.diff(scene.sensors[0].frames.timestamps_ns).tolist() == [10**8, 10**8]
    assert scene.sensors[0].frames.timestamps_ns[0] == pytest.approx(START_NS, abs=25_000_000)
    metadata.rename(tmp_path / "other.txt")
    with pytest.raises(DataError, match="no packets of lidars"):
        opened(path)  # too short to look like an Ouster's
    assert len(opened(path, metadata=str(tmp_path / "other.txt"))[0].sensors) == 1
    big = [packet + bytes(2000) for packet in ouster_packets()]
    with pytest.raises(DataError, match="expected its metadata beside the capture"):
        opened(capture(tmp_path / "b.pcap", big, port=7502))
    (tmp_path / "b.json").write_text("{}")
    with pytest.raises(DataError, match="is no metadata of an Ouster sensor"):
        opened(tmp_path / "b.pcap", metadata=str(tmp_path / "b.json"))


def test_columns_of_a_window_and_of_frames_that_overlap_go_into_their_frames(tmp_path):
    build.ouster_metadata(tmp_path / "a.json")
    packets = ouster_packets(columns=32)
    packets[1], packets[2] = packets[2], packets[1]  # the end of a frame comes after the beginning of the next one
    scene, warnings = opened(capture(tmp_path / "a.pcap", packets, step_ns=10_000_000, port=7502))
    assert [len(frame.points) for frame in scene.sensors[0].frames] == [32 * 4] * 3
    assert warnings["packets-reordered"].count == 1


def test_imu_packets_are_in_units_of_the_model_on_the_clock_of_the_lidar(tmp_path):
    build.ouster_metadata(tmp_path / "a.json")
    records = [(START_NS + k * 10**7, *frames_of(one, port=7502)) for k, one in enumerate(ouster_packets())]
    for k in range(5):
        imu = struct.pack("<3Q6f", 0, 10**12 + k * 10**7, 10**12 + k * 10**7 + 1, 0, 0, 1, 90, 0, -90)
        records.append((START_NS + k * 10**7, *frames_of(imu, port=7503)))
    (tmp_path / "a.pcap").write_bytes(pcap(records))
    scene, _ = opened(tmp_path / "a.pcap")
    streams, lidar = scene.sensor("imu").streams, scene.sensor("lidar")
    assert streams["accelerometer"].values[0] == pytest.approx([0, 0, 9.80665])
    assert streams["gyroscope"].values[0] == pytest.approx([np.pi / 2, 0, -np.pi / 2])
    assert streams["accelerometer"].timestamps_ns[0] == lidar.frames.timestamps_ns[0]
    assert streams["gyroscope"].timestamps_ns[0] == lidar.frames.timestamps_ns[0] + 1


def test_files_of_angles_stand_beside_the_capture_or_are_named_for_each_host(tmp_path):
    distances = np.full((4, 64), 500)
    packets = [
        build.hesai([k * 240 + 60 * j for j in range(4)], distances, distances % 256, time_us=k * 600)
        for k in range(20)
    ]
    path = capture(tmp_path / "a.pcap", packets, step_ns=600_000)
    lines = "\n".join(f"{k + 1},0.0,0.0" for k in range(64))
    default = opened(path)[0].sensors[0].frames[0].points.positions
    assert np.ptp(default[:, 2]) > 3
    (tmp_path / "a.csv").write_text(lines)
    assert np.ptp(opened(path)[0].sensors[0].frames[0].points.positions[:, 2]) == 0
    (tmp_path / "a.csv").rename(tmp_path / "b.csv")
    for angles, flat in ((f"192.168.1.201={tmp_path / 'b.csv'}", True), (f"10.0.0.1={tmp_path / 'b.csv'}", False)):
        positions = opened(path, angles=angles)[0].sensors[0].frames[0].points.positions
        assert (np.ptp(positions[:, 2]) == 0) == flat
    (tmp_path / "b.csv").write_text("1,2,3")
    with pytest.raises(DataError, match="1 lines of elevation and azimuth; expected 64"):
        opened(path, angles=str(tmp_path / "b.csv"))
    for value in ("nan", "400.0", "-inf"):
        (tmp_path / "b.csv").write_text("channel,elevation,azimuth\n" + lines.replace("7,0.0,", f"7,{value},", 1))
        with pytest.raises(DataError, match=rf"b\.csv: line 8: angle {value}; expected 360 degrees"):
            opened(path, angles=str(tmp_path / "b.csv"))
    assert opened(path)[0].sensors[0].mount.rotation.tolist() == [
        [0, 1, 0],
        [-1, 0, 0],
        [0, 0, 1],
    ]  # x right to x ahead


def test_difop_packets_among_the_returns_of_a_robosense_lidar_state_its_angles_and_are_none_that_are_damaged(tmp_path):
    distances = np.tile(2000 + 200 * np.arange(32), (12, 1))
    packets = [
        build.robosense([(k * 240 + 20 * j) % 36000 for j in range(12)], distances, distances % 256, time_us=k * 667)
        for k in range(300)
    ]
    angles = np.linspace(-15, 16, 32).tolist()
    state = build.robosense_state(angles, [1.0] * 32)
    among = [*packets[:100], state, *packets[100:200], bytes(1248), *packets[200:], state]
    scene, warnings = opened(capture(tmp_path / "a.pcap", among, step_ns=667_000))
    assert (warnings.pop("packets-unusable").count, set(warnings)) == (1, {"extrinsics-unknown"})
    points = [frame.points for frame in scene.sensors[0].frames]
    assert sum(map(len, points)) == 300 * 12 * 32
    sines = points[1].positions[:, 2].max() / (2000 + 200 * 31) / 0.0025
    assert np.rad2deg(np.arcsin(sines)) == pytest.approx(16, abs=0.01)
    with pytest.raises(DataError, match="no DIFOP packet of this Helios has its angles"):
        opened(capture(tmp_path / "c.pcap", packets, step_ns=667_000))


def test_captures_without_lidars_and_unknown_models_are_refused_in_one_sentence(tmp_path):
    (tmp_path / "a.pcap").write_bytes(pcap([(START_NS, *frames_of(b"hello", port=53))]))
    with pytest.raises(DataError, match="expected UDP packets of Ouster, Velodyne, Hesai, RoboSense or Livox"):
        opened(tmp_path / "a.pcap")
    with pytest.raises(OptionError, match="model 'vlp'; expected one of vlp-16, "):
        opened(tmp_path / "a.pcap", model="vlp")
    (tmp_path / "b.pcap").write_bytes(b"hello")
    with pytest.raises(UnknownFormatError, match="called like a capture"):
        opened(tmp_path / "b.pcap")
    lenient = rotation(30)
    records = [(START_NS + k * PERIOD_US * 1000, *frames_of(one)) for k, one in enumerate(lenient)]
    records += [(START_NS, *frames_of(bytes(9000), port=7502))]
    (tmp_path / "c.pcap").write_bytes(pcap(records))
    with pytest.raises(DataError, match="as of an Ouster"):
        opened(tmp_path / "c.pcap")
    scene, warnings = opened(tmp_path / "c.pcap", lenient=True)
    assert (len(scene.sensors), "lidar-unreadable" in warnings) == (1, True)


def test_the_model_can_be_named_where_packets_do_not_tell_it(tmp_path):
    path = capture(tmp_path / "a.pcap", rotation(30, product=0x24), step_ns=PERIOD_US * 1000)
    assert opened(path)[0].sensors[0].model == "Velodyne Puck Hi-Res"
    with pytest.raises(DataError, match="no packets of lidars"):
        opened(path, model="vlp-16")  # none of its packets are
