"""Packets and files of Livox's lidars, built from the public descriptions, against a slow reading of them."""

import math

import numpy as np
import pytest
from tests.unit.formats.packets import build
from tests.unit.formats.packets.build import START_NS, capture, livox, livox_points, lvx

from sceneloom.errors import DataError
from sceneloom.formats import open_scene

RNG = np.random.default_rng(3)
FORMS = [(False, kind) for kind in build.LIVOX_FIRST] + [(True, kind) for kind in build.LIVOX_SECOND]


def returns_of(second, data_type):
    """Random returns of a packet, (N, R, 5); the angles of all returns of a point are the same."""
    form, count, several = (build.LIVOX_SECOND if second else build.LIVOX_FIRST)[data_type]
    if form.startswith("I"):
        found = RNG.integers(1, 18_000, (count, several, 5))
        found[:, :, 1:3] = found[:, :1, 1:3]
    else:
        found = RNG.integers(-30_000, 30_000, (count, several, 5))
    found[..., 3:] = RNG.integers(0, 256, (count, several, 2))
    return found


def expected(second, data_type, returns):
    """Positions [m], one return after another."""
    form = (build.LIVOX_SECOND if second else build.LIVOX_FIRST)[data_type][0]
    found = []
    for depth, theta, phi, *_ in returns.reshape(-1, 5).tolist():
        if form.startswith("I"):
            a, b, r = math.radians(theta / 100), math.radians(phi / 100), depth / 1000
            found.append((r * math.sin(a) * math.cos(b), r * math.sin(a) * math.sin(b), r * math.cos(a)))
        else:
            unit = 0.01 if form.startswith("h") else 0.001
            found.append((depth * unit, theta * unit, phi * unit))
    return np.array(found)


@pytest.mark.parametrize(("second", "data_type"), FORMS)
def test_points_of_every_data_type_are_those_of_the_description(second, data_type, tmp_path):
    step_ns = 480_000
    packets, all_returns = [], []
    for k in range(5):
        all_returns.append(returns_of(second, data_type))
        content = livox_points(data_type, all_returns[-1], second=second)
        packets.append(livox(data_type, content, time_ns=START_NS + k * step_ns, second=second))
    path = capture(tmp_path / "a.pcap", packets, step_ns=step_ns, port=56301)
    with open_scene(path) as scene:
        (lidar,) = scene.sensors
        (frame,) = lidar.frames
    points = frame.points
    assert lidar.model.startswith("Livox")
    assert frame.timestamp_ns == START_NS
    flat = np.concatenate([one.reshape(-1, 5) for one in all_returns])
    places = np.concatenate([expected(second, data_type, one) for one in all_returns])
    np.testing.assert_allclose(points.positions, places, atol=4e-6)
    assert np.array_equal(points.intensities, flat[:, 3])
    assert data_type in (0, 1) or np.array_equal(points.extras["tag"], flat[:, 4])
    count, several = all_returns[0].shape[:2]
    # by the header of the second SDK, whose last point is 0.475 ms behind the first; else by when packets follow
    between = 475_000 / 95 if second else step_ns / count
    offsets = points.timestamps_ns.reshape(5, count, several) - START_NS - np.arange(5)[:, None, None] * step_ns
    steps = np.rint(np.arange(count) * between)[None, :, None]
    np.testing.assert_array_equal(offsets, np.broadcast_to(steps, offsets.shape))
    if several > 1:
        assert points.extras["return_number"].tolist() == [*range(1, several + 1)] * (5 * count)


def test_sweeps_are_tenths_of_a_second_and_points_at_the_origin_are_none(tmp_path):
    returns = returns_of(False, 2)
    returns[::2, :, :3] = 0
    content = livox_points(2, returns)
    packets = [livox(2, content, time_ns=START_NS + k * 10_000_000) for k in range(25)]
    imu = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 1.0], "<f4").tobytes()
    packets += [livox(6, imu, time_ns=START_NS + 250_000_000)]
    with open_scene(capture(tmp_path / "a.pcap", packets, step_ns=10_000_000)) as scene:
        lidar, unit = scene.sensors
        assert [len(frame.points) for frame in lidar.frames] == [480, 480, 240]
        assert unit.streams["gyroscope"].values[0] == pytest.approx([0.1, 0.2, 0.3])
        assert unit.streams["accelerometer"].values[0] == pytest.approx([0, 0, 9.80665])


def write_file(folder):
    """A small `.lvx` file."""
    frames = [[(2, START_NS + k * 50_000_000, livox_points(2, returns_of(False, 2)))] * 2 for k in range(3)]
    (folder / "drive.lvx").write_bytes(lvx(frames))
    return folder / "drive.lvx"


@pytest.mark.parametrize("version", [1, 2])
def test_files_have_the_points_of_their_packets_and_state_where_the_lidar_is(version, tmp_path):
    data_type = 2 if version == 1 else 1
    returns = returns_of(version == 2, data_type)
    content = livox_points(data_type, returns, second=version == 2)
    imu = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 1.0], "<f4").tobytes()
    frames = [
        [(data_type, START_NS + (5 * k + j) * 10_000_000, content) for j in range(5)]
        + [(6 if version == 1 else 0, START_NS + k * 50_000_000, imu)]
        for k in range(4)
    ]
    path = tmp_path / ("a.lvx" if version == 1 else "a.lvx2")
    path.write_bytes(lvx(frames, version=version, device_type=7 if version == 1 else 9))
    with open_scene(path) as scene:
        lidar, unit = scene.sensors
        assert lidar.model == ("Livox Avia" if version == 1 else "Livox Mid-360")
        assert [len(frame.points) for frame in lidar.frames] == [960, 960]
        points = lidar.frames[1].points
        np.testing.assert_allclose(points.positions[:96], expected(version == 2, data_type, returns), atol=4e-6)
        assert points.rings[:5].tolist() == ([0, 1, 2, 3, 4] if version == 1 else [0, 1, 2, 3, 0])
        assert points.timestamps_ns[0] == START_NS + 100_000_000
        # roll, pitch, yaw: x of the lidar points to the left
        np.testing.assert_allclose(lidar.mount.apply(np.array([[1.0, 0, 0]])), [[1, 3, 3]], atol=1e-6)
        assert len(unit.streams["accelerometer"].timestamps_ns) == 4


def test_a_clock_of_gnss_is_a_date_and_the_microseconds_of_an_hour(tmp_path):
    hour = (23, 11, 14, 22)  # START_NS is 13 minutes and 20 seconds later
    time = int.from_bytes(bytes(hour) + (800 * 10**6).to_bytes(4, "little"), "little")
    packet = livox(2, livox_points(2, returns_of(False, 2)), time_ns=time, time_type=3)
    with open_scene(capture(tmp_path / "a.pcap", [packet])) as scene:
        assert scene.sensors[0].frames.timestamps_ns[0] == START_NS


def test_other_versions_and_damaged_frames_are_refused(tmp_path):
    whole = lvx([[(2, START_NS, livox_points(2, returns_of(False, 2)))]] * 2)
    path = tmp_path / "a.lvx"
    for place, value, problem in ((17, 0, "version 1.0"), (28, 200, "200 devices"), (88, 9, "a frame from 9")):
        path.write_bytes(whole[:place] + bytes((value,)) + whole[place + 1 :])
        with pytest.raises(DataError, match=problem):
            open_scene(path)
    path.write_bytes(whole[:-700])
    with pytest.raises(DataError, match="frame"):
        open_scene(path)
    with open_scene(path, lenient=True) as scene:
        assert len(scene.sensors[0].frames[0].points) == 96
