"""Packets that real lidars sent, against what other programs decoded of them: digests and clouds beside the packets."""

import hashlib
import json
import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sceneloom.formats import open_scene
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.packets import ouster
from sceneloom.formats.packets.captures import read_datagrams
from sceneloom.formats.points.files import read_cloud

STRANGERS = "real/strangers"


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


def frames_of(folder, **options):
    with open_scene(folder, **options) as scene:
        (lidar,) = scene.lidars
        return list(lidar.frames)


def test_points_of_bags_are_those_of_the_clouds_beside_them(drive):
    folder = drive(f"{STRANGERS}/velodyne_bag/vlp16")
    # that cloud was made without offsets of lasers, as the calibration beside it states
    angles = str(drive(f"{STRANGERS}/velodyne_bag") / "VLP16.yaml")
    assert min(map(np.median, nearest(folder, frames_of(folder, angles=angles)))) < 0.0005
    assert sum(map(len, (frame.points for frame in frames_of(folder)))) == 59414  # as velodyne-decoder 3.1 has
    for name, table in (("40p", "Pandar40P.csv"), ("xt32m", "PandarXT32M.csv")):
        folder = drive(f"{STRANGERS}/hesai_bag/{name}")
        distances = nearest(folder, frames_of(folder, angles=f"/pandar_packets={folder / table}"))
        assert min(map(np.median, distances)) < 1e-6
        assert min(np.percentile(one, 99) for one in distances) < 1e-5
    folder = drive(f"{STRANGERS}/robosense_bag")
    by_file, by_state = (frames_of(folder, angles=one) for one in (str(folder / "RobosenseHelios16P.csv"), None))
    # its DIFOP packets list 32 lasers, and the returns are of as many: the cloud and the file count 16 of them twice
    lasers = by_state[0].points.rings
    assert set(lasers) == set(range(32))
    upper = {tuple(one) for one in by_state[0].points.positions[lasers >= 16].tolist()}
    assert upper <= {tuple(one) for one in by_file[0].points.positions.tolist()}
    distances = nearest(folder, by_file)
    assert min(map(np.median, distances)) < 0.0005
    assert min(np.percentile(one, 99) for one in distances) < 0.003


def test_a_radar_has_the_detections_and_objects_of_the_lists_beside_it(drive):
    folder = drive(f"{STRANGERS}/radar_bag/ars548")
    stated = [next(folder.glob(f"*_{name}.yaml")).read_text("utf-8") for name in ("detection", "object")]

    def listed(text, name):
        return np.array(re.findall(rf"^  [- ] {name}: (\S+)$", text, re.MULTILINE), float)

    def listed_xyz(text, name):
        rows = re.findall(rf"^    {name}:\n +x: (\S+)\n +y: (\S+)\n +z: (\S+)$", text, re.MULTILINE)
        return np.array(rows, float)

    with open_scene(folder) as scene:
        sensors = sorted(scene.sensors, key=lambda one: len(one.id))
        np.testing.assert_allclose(sensors[0].mount.translation, [3.872, 0, 0.641], atol=1e-6)
        found = [sensor.frames[0].points for sensor in sensors]
    detections, objects = stated
    assert [len(one) for one in found] == [len(listed(text, "object_id")) for text in stated] == [308, 50]
    for name in ("azimuth_angle", "elevation_angle", "range", "range_std", "rcs", "measurement_id", "object_id"):
        np.testing.assert_allclose(found[0].extras[name], listed(detections, name), rtol=6e-6)
    np.testing.assert_allclose(found[0].lengths, listed(detections, "range_rate"), rtol=6e-6)
    azimuths, elevations = (listed(detections, f"{name}_angle") for name in ("azimuth", "elevation"))
    directions = np.stack((np.cos(elevations) * np.cos(azimuths), np.sin(elevations)), axis=1)
    np.testing.assert_allclose(found[0].directions[:, [0, 2]], directions, atol=1e-6)
    np.testing.assert_allclose(found[1].positions, listed_xyz(objects, "position"), atol=1e-3)
    for name in ("object_id", "age", "orientation", "shape_length_edge_mean", "raw_existence_probability"):
        np.testing.assert_allclose(found[1].extras[name], listed(objects, name), rtol=6e-6)
    # the lists have relative accelerations in the place of relative velocities: the radar moves at 6 m/s
    accelerations = listed_xyz(objects, "relative_velocity")[:, 0]
    np.testing.assert_allclose(found[1].extras["relative_acceleration_x"], accelerations, rtol=6e-6)
    assert np.median(found[1].extras["relative_velocity_x"]) == pytest.approx(-6, abs=0.5)
