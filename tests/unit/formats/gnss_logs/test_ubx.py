"""Logs of UBX: frames that pyubx2 wrote, alone and between sentences and corrections."""

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.base.registry import find_format, open_scene
from sceneloom.geometry.rigid import rotate_vectors

# what pyubx2 1.4.0 writes of: latitude 37.426, longitude -122.1, height 31.5 m, hAcc 20 mm, vAcc 30 mm, iTOW 518416000
FRAMES = {
    "PVT": "b56201075c008066e61ee8070511173b3a0714000000fa0000000301000cc00439b720c14e160c7b00003cf00000"
    "140000001e0000000000000000000000000000000000000000000000000000000000000078000000000000000000"
    "0000000000005aeb",
    # a second later, fixType 0
    "PVT without": "b56201075c00686ae61ee8070511173b3b03000000000000000000000000c00439b720c14e160c7b000000000000"
    "140000001e0000000000000000000000000000000000000000000000000000000000000000000000000000000000"
    "00000000000081c2",
    # 49e-9 degrees further east, 29e-9 further south, 0.4 mm higher; hAcc 14.1 mm, vAcc 10 mm
    "HPPOSLLH": "b56201142400000000008066e61ec00439b720c14e160c7b00003cf0000031e304048d00000064000000dc60",
    "COV": "b562013640008066e61e00010100000000000000000017b7d139000000000000000017b7d13800000000faed6b3a"
    "0000000000000000000000000000000000000000000000009ee5",
    # roll 1°, pitch 2°, heading 60°
    "ATT": "b562010520008066e61e000000009f8601003f0d03007f8d5b0010270000102700004fc300006c98",
    # two seconds later
    "ATT 2": "b56201052000506ee61e000000009f8601003f0d03007f8d5b0010270000102700004fc300004490",
    "TIMEGPS 2": "b56201201000506ee61e000000000a09120714000000338e",
    "POSLLH 2": "b56201021c00506ee61ec00439b708c54e160c7b00003cf00000140000001e000000abed",
    # a second after these, and that there is no fix
    "POSLLH 3": "b56201021c003872e61ec00439b708c54e160c7b00003cf00000140000001e00000097b9",
    "STATUS 3": "b562010310003872e61e000000000000000000000000c2b5",
}
START = "2024-05-17T23:59:58"
MEAS = bytes.fromhex("b5621002200088130000003000002c01000e30f8ff0de803000564000010ceffff11342700121ab0")
"""ESF-MEAS of tick 5000: gyroscope 300, -2000, 1000 times 2^-12 degree/s; accelerometer 100, -50, 10036 times 2^-10."""

RTCM = bytes.fromhex("D300133ED7D30202980EDEEF34B4BD62AC0941986F33360B98")
"""The example of message 1005 in RTCM 10403.2."""

SENTENCE = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"


def frames(*names):
    return b"".join(bytes.fromhex(FRAMES[name]) for name in names)


def framed(body):
    """A frame with its checksum, of class, number, length and payload: RFC 1145's algorithm, byte by byte."""
    low = high = 0
    for byte in body:
        low = (low + byte) % 256
        high = (high + low) % 256
    return b"\xb5\x62" + body + bytes((low, high))


def at_tick(tick):
    return framed(MEAS[2:6] + tick.to_bytes(4, "little") + MEAS[10:-2])


def write_log(folder, content=None):
    path = folder / "drive.ubx"
    if content is None:
        content = MEAS + frames("PVT", "COV", "ATT") + at_tick(7000) + SENTENCE + RTCM
        content += frames("TIMEGPS 2", "POSLLH 2", "ATT 2")
    path.write_bytes(content)
    return path


def opened(folder, content=None, **options):
    path = write_log(folder, content)
    assert find_format(path).name == "ubx"
    scene = open_scene(path, **options)
    return scene, scene.sensors[0], {warning.code: warning for warning in scene.warnings}


def nanoseconds(text):
    return int(np.datetime64(text, "ns").astype(np.int64))


def test_positions_are_those_of_pvt_hpposllh_and_posllh_with_their_deviations(tmp_path):
    _, gnss, _ = opened(tmp_path, frames("PVT"))
    assert gnss.positions_lla[0] == pytest.approx([37.426, -122.1, 31.5], abs=1e-12)
    # UTC with its own nanoseconds; hAcc is that of both horizontal directions
    assert gnss.timestamps_ns.tolist() == [nanoseconds(START) + 250]
    assert (gnss.accuracies[0], gnss.vertical_accuracies[0]) == pytest.approx((0.02 / 2**0.5, 0.03))
    _, gnss, _ = opened(tmp_path, frames("PVT", "HPPOSLLH"))
    assert gnss.positions_lla[0] == pytest.approx([37.426 - 29e-9, -122.1 + 49e-9, 31.5004], abs=1e-12)
    assert gnss.accuracies == pytest.approx([0.0141 / 2**0.5])
    _, gnss, _ = opened(tmp_path, frames("PVT", "HPPOSLLH", "COV"))
    assert (gnss.accuracies[0], gnss.vertical_accuracies[0]) == pytest.approx((0.00025**0.5, 0.03))


def test_times_of_messages_without_a_date_come_from_the_week_and_leap_seconds(tmp_path):
    content = frames("POSLLH 2", "TIMEGPS 2", "POSLLH 3", "STATUS 3")
    _, gnss, warnings = opened(tmp_path, content)
    assert (gnss.timestamps_ns.tolist(), "ubx-week" in warnings) == ([nanoseconds(START) + 2 * 10**9], False)
    _, gnss, warnings = opened(tmp_path, frames("POSLLH 2"))
    assert "1980" in warnings["ubx-week"].message
    _, _, warnings = opened(tmp_path, frames("PVT", "PVT without"))
    assert warnings["no-reception"].count == 1


def test_attitudes_give_poses_and_ticks_of_the_inertial_unit_times(tmp_path):
    scene, gnss, warnings = opened(tmp_path)
    poses = scene.trajectories["receiver"]
    forward = rotate_vectors(poses.quaternions_xyzw[0], np.eye(3)[0])
    level = np.cos(np.deg2rad(2))
    expected = [level * np.sin(np.pi / 3), level * np.cos(np.pi / 3), np.sin(np.deg2rad(2))]
    np.testing.assert_allclose(forward, expected, atol=1e-6)  # the frame has 1.99999°
    imu = scene.sensors[1]
    assert imu.streams["gyroscope"].values[0] == pytest.approx(np.deg2rad([300 / 4096, -2000 / 4096, 1000 / 4096]))
    assert imu.streams["accelerometer"].values[0] == pytest.approx([100 / 1024, -50 / 1024, 10036 / 1024])
    # milliseconds, 5000 before the first message of 518416000 and 7000 before that of 518418000
    times = imu.streams["gyroscope"].timestamps_ns
    assert times.tolist() == [nanoseconds(START), nanoseconds(START) + 2 * 10**9]
    assert len(gnss.timestamps_ns) == 2
    assert {"imu-clock", "imu-axes"} <= set(warnings)


def test_other_messages_noise_and_broken_frames_between_are_counted(tmp_path):
    broken = bytearray(frames("PVT"))
    broken[40] ^= 1
    content = b"\xb5\x00abc" + frames("PVT") + RTCM + SENTENCE + b"\xb5\x62" + bytes(broken) + frames("PVT")[:50]
    scene, gnss, warnings = opened(tmp_path, content)
    assert len(gnss.timestamps_ns) == 1
    unused = warnings["messages-not-used"].message
    assert ("RTCM 1005 (1)" in unused, "fixes of NMEA beside those of UBX (1)" in unused) == (True, True)
    assert warnings["messages-broken"].count == 3
    # five bytes before, those of the broken frame and of the last one, some without the bytes that they begin with
    assert 140 < warnings["bytes-of-no-message"].count <= 5 + 2 + 100 + 50
    assert scene.format == "ubx"


def test_a_message_that_is_sound_by_its_checksum_and_says_nonsense_is_a_fault(tmp_path):
    short = framed(b"\x01\x02\x04\x00" + bytes(4))
    far = framed(frames("POSLLH 2")[2:14] + b"\xff\xff\xff\x7f" + frames("POSLLH 2")[18:-2])
    for wrong, expected in (
        (short, "byte 100: NAV-POSLLH: 4 bytes; expected at least 28"),
        (far, "NAV-POSLLH: latitude"),
    ):
        with pytest.raises(DataError, match=expected):
            opened(tmp_path, frames("PVT") + wrong)
        _, gnss, warnings = opened(tmp_path, frames("PVT") + wrong, lenient=True)
        assert (len(gnss.timestamps_ns), warnings["ubx-message"].count) == (1, 1)
    with pytest.raises(DataError, match=r"no GGA, .* NAV message has a position \(1 without\)"):
        opened(tmp_path, frames("PVT without"))
