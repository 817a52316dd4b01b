"""Packets of lidars against the makers' and others' decoders: velodyne-decoder and Ouster's SDK, where installed."""

import numpy as np
import pytest
from tests.unit.formats.packets import build

from sceneloom.formats.packets import ouster, velodyne

RNG = np.random.default_rng(11)
MODELS = {"vlp-16": "VLP16", "puck-hi-res": "PuckHiRes", "hdl-32e": "HDL32E", "vlp-32c": "VLP32C",
          "vls-128": "VLS128", "hdl-64e-s2": "HDL64E_S2", "hdl-64e-s3": "HDL64E_S3"}  # fmt: skip


@pytest.mark.parametrize("mode", [0x37, 0x39])
@pytest.mark.parametrize("key", MODELS)
def test_velodyne_points_are_those_of_velodyne_decoder(key, mode, tmp_path):
    peer = pytest.importorskip("velodyne_decoder")
    paired, returns = key.startswith("hdl-64e"), 2 if mode == 0x39 else 1
    apart = (2 if paired else 1) * returns
    azimuths = [1000 + 18 * (k // apart) for k in range(12)]
    flags = (0xEEFF, 0xDDFF) * 6 if paired else (0xEEFF,) * 12
    if key == "vls-128":  # with two returns four blocks hold nothing; how azimuths grow is another matter
        flags = tuple(np.repeat((0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF) * (3 // returns), returns).tolist())
        flags, azimuths = (*flags, *(0xFFFF,) * (12 - len(flags))), [1000] * 12
    distances, intensities = RNG.integers(600, 5000, (12, 32)), RNG.integers(0, 256, (12, 32))
    packet = build.velodyne(
        azimuths, distances, intensities, time_us=77, mode=mode, product=velodyne.MODELS[key].product or 0,
        flags=flags,
    )  # fmt: skip
    calibration = None
    if paired:
        (tmp_path / "a.yaml").write_text(hdl_64e())
        calibration = peer.Calibration.read(str(tmp_path / "a.yaml"))
    config = peer.Config(model=getattr(peer.Model, MODELS[key]), calibration=calibration, min_range=0, max_range=1e4)
    _, theirs = peer.ScanDecoder(config).decode([peer.VelodynePacket(1.7e9, packet)])
    decoder = velodyne.decoder_of(key, tmp_path / "a.yaml" if paired else None)
    array = np.frombuffer(packet, np.uint8)[None]
    ours = decoder.points(array, np.zeros(1, np.int64), np.ones((1, 12), bool))
    assert len(ours) == len(theirs) == 32 * sum(flag != 0xFFFF for flag in flags)
    theirs = theirs[np.lexsort((theirs[:, 3], theirs[:, 6], np.rint(theirs[:, 4] * 1e8)))]
    order = np.lexsort((ours.intensities, ours.rings, (ours.timestamps_ns + 5) // 10))
    assert np.array_equal(ours.rings[order], theirs[:, 6])
    assert np.array_equal(ours.intensities[order], theirs[:, 3])
    offset = np.linalg.norm(ours.positions[order] - theirs[:, :3], axis=1)
    # theirs rounds azimuths to 0.01 degree, and takes the two-point correction of heights in another way
    assert (offset < (2e-3 if paired else 5e-4) + np.deg2rad(0.0051) * np.linalg.norm(theirs[:, :3], axis=1)).all()
    times = (ours.timestamps_ns[order] - ours.timestamps_ns.min()) / 1e9
    assert np.abs(times - (theirs[:, 4] - theirs[:, 4].min())).max() < 1e-6


def hdl_64e():
    """A calibration with every correction."""
    rows = []
    for k in range(64):
        numbers = {
            "dist_correction": 1 + k / 100,
            "dist_correction_x": 1.01 + k / 100,
            "dist_correction_y": 0.98 + k / 100,
            "focal_distance": 0,
            "focal_slope": 0,
            "horiz_offset_correction": 0.026 * (-1) ** k,
            "laser_id": k,
            "rot_correction": 0.1 * np.sin(k),
            "vert_correction": 0.03 - 0.007 * k,
            "vert_offset_correction": 0.2 - 0.001 * k,
        }
        rows.append("- " + "\n  ".join(f"{name}: {value}" for name, value in numbers.items()))
    return "distance_resolution: 0.002\nlasers:\n" + "\n".join(rows) + "\nnum_lasers: 64\n"


def metadata(core, path, profile="RNG15_RFL8_NIR8"):
    """What the SDK says of a usual sensor, and what our reader reads of that."""
    info = core.SensorInfo.from_default(core.LidarMode(1024, 10))
    layout = info.format
    layout.udp_profile_lidar = core.UDPProfileLidar.__members__[profile]
    info.format = layout
    path.write_text(info.to_json_string())
    return info, ouster.OusterDecoder(ouster.read_metadata(path))


@pytest.mark.parametrize("profile", sorted(ouster.PROFILES))
def test_every_field_of_every_ouster_profile_is_what_the_sdk_sets(profile, tmp_path):
    core = pytest.importorskip("ouster.sdk.core")
    info, decoder = metadata(core, tmp_path / "a.json", profile)
    layout = core.PacketFormat.from_info(info)
    assert layout.lidar_packet_size == decoder.metadata.length
    packet = core.LidarPacket(layout)
    layout.set_frame_id(packet, 1234)
    assert decoder.frame_numbers(np.array(packet.buf, np.uint8)[None])[0, 0] == 1234
    names = [name for name in ouster.PROFILES[profile][1] if name in set(layout.fields)]
    assert set(names) >= {"RANGE", "REFLECTIVITY"}
    for name in names:
        packet = core.LidarPacket(layout)
        packet.buf[:] = 0
        kind = decoder.field(np.zeros((1, layout.lidar_packet_size), np.uint8), name).dtype
        stated = (RNG.integers(0, 2**32, (64, 16)) & layout.field_value_mask(name)).astype(kind)
        layout.set_field(packet, name, stated)
        found = decoder.field(np.array(packet.buf, np.uint8)[None], name)
        assert np.array_equal(found[0].T, stated), name


def test_ouster_positions_are_those_of_the_sdk(tmp_path):
    core = pytest.importorskip("ouster.sdk.core")
    info, decoder = metadata(core, tmp_path / "a.json")
    theirs = core.XYZLut(info, False)(np.full((64, 1024), 40_000, np.uint32))
    words = np.zeros((16, 64, 4), np.uint8)
    words[..., :2] = np.array([40_000 // 8], "<u2").view(np.uint8)
    for start in range(0, 1024, 16):
        packet = np.frombuffer(build.ouster(range(start, start + 16), words), np.uint8)[None]
        ours = decoder.points(packet, np.zeros(1, np.int64), np.ones((1, 16), bool))
        expected = theirs[:, start : start + 16].transpose(1, 0, 2).reshape(-1, 3)
        np.testing.assert_allclose(ours.positions, expected, atol=1e-5)
