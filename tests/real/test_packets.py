"""Packets that real lidars sent, against what other programs decoded of them: digests and clouds beside the packets."""

import hashlib
import json
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sceneloom.formats import open_scene
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.packets import hesai, ouster, robosense, velodyne
from sceneloom.formats.packets.captures import read_datagrams
from sceneloom.formats.packets.sweeps import find_sweeps
from sceneloom.formats.points.files import read_cloud

STRANGERS = "real/strangers"


class Messages:
    """The packets of a bag's scan messages: a header, then stamps with arrays of bytes of fixed length."""

    def __init__(self, folder, length, *, kind=False):
        (file,) = folder.glob("*.db3")
        self.packets, times, self.states = [], [], []
        with closing(sqlite3.connect(f"file:{file}?immutable=1", uri=True)) as bag:
            messages = [row[0] for row in bag.execute("SELECT data FROM messages ORDER BY timestamp")]
        for data in messages:
            at = 16 + int.from_bytes(data[12:16], "little")
            at += -at % 4
            count, at = int.from_bytes(data[at : at + 4], "little"), at + 4
            for _ in range(count):
                at += -at % 4
                seconds, nanoseconds = np.frombuffer(data, "<u4", 2, at).tolist()
                is_state, at = kind and data[at + 8], at + 8 + kind
                packet, at = data[at : at + length], at + length
                if length == 1500:
                    at += -at % 4
                    packet, at = packet[: int.from_bytes(data[at : at + 4], "little")], at + 4
                (self.states if is_state else self.packets).append(packet)
                times += [] if is_state else [seconds * 10**9 + nanoseconds]
        self.arrivals_ns = np.array(times)
        self.array = np.frombuffer(b"".join(self.packets), np.uint8).reshape(len(self.packets), -1)

    def payloads(self, rows):
        return self.array[rows]

    def frames(self, decoder):
        rows = np.arange(len(self.packets))
        return find_sweeps(self, rows, self.arrivals_ns, decoder, "bag", Ledger(lenient=False)).frames


def nearest(folder, frames):
    """Distances [m] of the points of the cloud in a folder to the nearest one of the sweeps."""
    (file,) = folder.glob("*.pcd")
    columns = read_cloud(file).columns
    theirs = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return [cKDTree(frame.points.positions).query(theirs)[0] for frame in frames]


@pytest.mark.parametrize("name", ["OS-0-128-U1_v2.3.0_1024x10", "OS-1-32-G_v2.1.1_1024x10"])
def test_every_field_of_an_ouster_is_what_the_digests_say(drive, name):
    folder = drive(f"{STRANGERS}/ouster")
    stated = json.loads((folder / f"{name}_digest.json").read_text())
    decoder = ouster.OusterDecoder(ouster.read_metadata(folder / f"{name}.json"))
    flow = next(one for one in read_datagrams(folder / f"{name}.pcap", Ledger(lenient=False)) if one.port == 7502)
    packets = flow.payloads(np.arange(len(flow.lengths)))
    columns = decoder.columns(packets)
    found = {"FRAME_ID": decoder.frame_numbers(packets).astype("u2"), "ENCODER_COUNT": np.zeros(columns.shape, "u4")}
    found |= {field: columns[field] for field in columns.dtype.names if field not in ("words", "FRAME_ID")}
    found["STATUS"] = found["STATUS"].astype("u4")
    if "FRAME_ID" not in columns.dtype.names:
        assert stated["scans"][0]["FRAME_ID"] == str(found["FRAME_ID"][0, 0])
        found["FRAME_ID"] = found["FRAME_ID"] * 0  # the digests look for it in the columns, which have none
    for field, digest in stated["packet_hash"].items():
        values = found[field] if field in found else decoder.field(packets, field).transpose(0, 2, 1)
        assert hashlib.md5(np.ascontiguousarray(values).tobytes()).hexdigest() == digest, field
    image = decoder.field(packets, "RANGE").transpose(2, 0, 1).reshape(decoder.metadata.rows, -1)
    assert hashlib.md5(image.tobytes()).hexdigest() == stated["scans"][0]["RANGE"]


def test_checksums_hold_and_imu_packets_are_on_the_clock_of_the_lidar(drive):
    folder = drive(f"{STRANGERS}/ouster")
    with open_scene(folder / "crc_test.pcap") as scene:
        assert {warning.code for warning in scene.warnings} == {"clock-shifted", "extrinsics-unknown"}
        lidar, imu = scene.sensors
        assert [len(frame.points) for frame in lidar.frames] == [28055, 1637]
        gravity = imu.streams["accelerometer"].values.mean(axis=0)
        assert np.linalg.norm(gravity) == pytest.approx(9.81, abs=0.3)
        assert abs(imu.streams["gyroscope"].timestamps_ns[0] - lidar.frames.timestamps_ns[0]) < 10**9


def test_a_vlp_16_has_the_sweeps_and_the_fix_of_its_capture(drive):
    with open_scene(drive(f"{STRANGERS}/velodyne_pcap") / "sample_velodyne_vlp16_gps.pcap") as scene:
        lidar, gnss = scene.sensors
        # velodyne-decoder 3.1 has as many points; its sweeps end with packets
        assert sum(len(frame.points) for frame in lidar.frames) == 73486
        assert gnss.positions_lla[0, :2] == pytest.approx([36.829131, -2.407572], abs=1e-6)
        assert abs(int(gnss.timestamps_ns[0]) - int(lidar.frames.timestamps_ns[0])) < 10**9


def test_points_of_bags_are_those_of_the_clouds_beside_them(drive):
    folder = drive(f"{STRANGERS}/velodyne_bag/vlp16")
    # that cloud was made without offsets of lasers, as the calibration beside it states
    decoder = velodyne.decoder_of("vlp-16", drive(f"{STRANGERS}/velodyne_bag") / "VLP16.yaml")
    assert min(map(np.median, nearest(folder, Messages(folder, 1206).frames(decoder)))) < 0.0005
    for name, key, table in (("40p", "pandar40p", "Pandar40P.csv"), ("xt32m", "xt32m", "PandarXT32M.csv")):
        folder = drive(f"{STRANGERS}/hesai_bag/{name}")
        distances = nearest(folder, Messages(folder, 1500).frames(hesai.decoder_of(key, folder / table)))
        assert min(map(np.median, distances)) < 1e-6
        assert min(np.percentile(one, 99) for one in distances) < 1e-5
    folder = drive(f"{STRANGERS}/robosense_bag")
    messages = Messages(folder, 1500, kind=True)
    state = np.frombuffer(messages.states[0], np.uint8)
    by_file = robosense.decoder_of("helios-16p", folder / "RobosenseHelios16P.csv")
    assert np.array_equal(robosense.state_angles(state), by_file.angles_deg)
    distances = nearest(folder, messages.frames(by_file))
    assert min(map(np.median, distances)) < 0.0005
    assert min(np.percentile(one, 99) for one in distances) < 0.003
