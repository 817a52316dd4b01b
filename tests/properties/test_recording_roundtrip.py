"""What is written as a recording is read back: arrays, times, mountings, camera models and images."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation
from tests.properties.strategies import floats, timestamps

from sceneloom import scene as sc
from sceneloom.cameras import MODELS, intrinsics_vector
from sceneloom.cameras.camera import Camera
from sceneloom.formats import open_scene, write_scene
from sceneloom.geometry.rigid import RigidTransform

EXACT_NS = 2**51
"""Up to 26 days, a 64-bit number of seconds holds every nanosecond."""
EPOCH_NS = 1_700_000_000_000_000_000


rigids = st.builds(
    lambda rotation, translation: RigidTransform(Rotation.from_rotvec(rotation).as_matrix(), translation),
    floats(3, within=3),
    floats(3, within=50),
)


def round_trip(scene: sc.Scene, **options):
    """Write a scene and read it; gives what was read, and the losses that were reported."""
    with TemporaryDirectory() as folder:
        report = write_scene(scene, Path(folder, "drive"), **options)
        with open_scene(Path(folder, "drive")) as found:
            yield found, [loss for loss in report if loss.field != "replay"]


def gyroscope(timestamps, values=None, seconds=None):
    values = np.ones((len(timestamps), 3)) if values is None else values
    return sc.Scene((sc.ImuSensor("imu", {"gyroscope": sc.VectorSamples(timestamps, values, seconds)}),))


@given(timestamps(-EXACT_NS, EXACT_NS, unique=False), st.data())
def test_samples_keep_their_times_to_the_nanosecond_and_their_values_to_the_bit(timestamps, data):
    values = data.draw(floats(len(timestamps), 3, within=1e6))
    for found, report in round_trip(gyroscope(timestamps, values)):
        assert not report
        stream = found.sensor("imu").streams["gyroscope"]
        np.testing.assert_array_equal(stream.timestamps_ns, timestamps)
        np.testing.assert_array_equal(stream.values, values)


@given(st.lists(st.floats(-9e9, 9e9), min_size=1, max_size=12))
def test_the_seconds_that_a_file_had_are_in_the_next_file(seconds):
    numbers = np.array(sorted(seconds))
    timestamps = np.rint(numbers * 1e9).astype(np.int64)
    for found, report in round_trip(gyroscope(timestamps, None, numbers)):
        assert not report
        stream = found.sensor("imu").streams["gyroscope"]
        np.testing.assert_array_equal(stream.file_seconds, numbers)  # equal as numbers: -0.0 is 0.0
        np.testing.assert_array_equal(stream.timestamps_ns, timestamps)


@given(timestamps(EPOCH_NS, EPOCH_NS + 10**13, unique=False))
def test_times_since_1970_are_off_by_no_more_than_is_reported(timestamps):
    for found, report in round_trip(gyroscope(timestamps)):
        off = np.abs(found.sensor("imu").streams["gyroscope"].timestamps_ns - timestamps)
        # half of the step of such seconds, 2^-22 s, and half of the step of the same time in nanoseconds, 2^8 ns
        assert off.max() <= 119 + 128
        assert sum(loss.count for loss in report) == int((off > 0).sum())


@given(timestamps(-EXACT_NS, EXACT_NS), st.booleans(), st.data())
def test_trajectories_come_back_under_their_names(timestamps, oriented, data):
    count = len(timestamps)
    positions = data.draw(floats(count, 3, within=1e6))
    rotations = data.draw(floats(count, 3, within=3))
    quaternions = Rotation.from_rotvec(rotations).as_quat() if oriented else None
    known = ["groundTruth", "pose", "arkit", "my method", "output"]
    names = data.draw(st.lists(st.sampled_from(known), min_size=1, unique=True))
    scene = sc.Scene((), trajectories={name: sc.Trajectory(name, timestamps, positions, quaternions) for name in names})
    for found, _ in round_trip(scene):
        assert set(found.trajectories) == set(names)
        for trajectory in found.trajectories.values():
            np.testing.assert_array_equal(trajectory.timestamps_ns, timestamps)
            np.testing.assert_array_equal(trajectory.positions, positions)
            assert (trajectory.quaternions_xyzw is None) == (not oriented)
            if oriented:
                np.testing.assert_array_equal(trajectory.quaternions_xyzw, quaternions)


@given(timestamps(-EXACT_NS, EXACT_NS, unique=False), st.data())
def test_fixes_come_back_with_the_accuracies_that_they_have(timestamps, data):
    count = len(timestamps)
    lla = data.draw(floats(count, 3, within=90))
    known = st.one_of(st.just(np.nan), st.floats(0, 100))
    accuracies = [data.draw(hnp.arrays(np.float64, count, elements=known)) for _ in range(2)]
    scene = sc.Scene((sc.GnssSensor("gnss", timestamps, lla, *accuracies),))
    for found, _ in round_trip(scene):
        gnss = found.sensor("gnss")
        np.testing.assert_array_equal(gnss.timestamps_ns, timestamps)
        np.testing.assert_array_equal(gnss.positions_lla, lla)
        np.testing.assert_array_equal(gnss.accuracies, accuracies[0])
        np.testing.assert_array_equal(gnss.vertical_accuracies, accuracies[1])


def points_at(data: st.DataObject, start_ns: int) -> sc.LidarPoints:
    count = data.draw(st.integers(0, 6))
    floats = st.floats(allow_nan=True, allow_infinity=True, width=32)
    offsets = data.draw(hnp.arrays(np.int64, count, elements=st.integers(0, 10**8)))
    return sc.LidarPoints(
        positions=data.draw(hnp.arrays(np.float32, (count, 3), elements=floats)),
        intensities=data.draw(hnp.arrays(np.uint8, count)),
        timestamps_ns=start_ns + offsets,
        rings=data.draw(hnp.arrays(np.uint16, count)),
    )


@given(timestamps(-EXACT_NS, EXACT_NS), rigids, st.data())
def test_sweeps_come_back_point_by_point(timestamps, mount, data):
    frames = [sc.LidarFrame(int(timestamp), points_at(data, int(timestamp))) for timestamp in timestamps]
    lidars = tuple(
        sc.LidarSensor(f"lidar{index}", sc.LazyFrames.of(frames, timestamps), mount=mount) for index in range(2)
    )
    for found, report in round_trip(sc.Scene(lidars)):
        assert not report
        for lidar in found.lidars:
            # the mounting is inverted on the way there and back
            np.testing.assert_allclose(lidar.mount.matrix, mount.matrix, atol=1e-12)
            np.testing.assert_array_equal(lidar.frames.timestamps_ns, timestamps)
            for before, after in zip(frames, lidar.frames, strict=True):
                for name in ("positions", "intensities", "timestamps_ns", "rings"):
                    np.testing.assert_array_equal(getattr(after.points, name), getattr(before.points, name))


HELD = ("brown_conrady", "fisheye", "kannala_brandt18", "omnidir", "pinhole")
"""The models that the format has; others come back as the nearest of these."""


@st.composite
def camera_models(draw: st.DrawFn) -> Camera:
    name = draw(st.sampled_from(HELD))
    names = MODELS[name].coefficient_names
    count = draw(st.sampled_from(sorted({0, min(5, len(names)), len(names)})))
    # the format has no decentring
    values = [0.0 if names[k] in {"lx", "ly"} else draw(st.floats(-0.01, 0.01)) for k in range(count)]
    numbers = [draw(st.floats(10, 50)) for _ in range(4)]
    return Camera(name, 32, 16, *numbers, tuple(values))


@given(camera_models(), rigids, timestamps(-EXACT_NS, EXACT_NS), st.integers(1, 2))
def test_cameras_come_back_with_camera_model_mounting_times_and_pixels(camera_model, mount, timestamps, count):
    rng = np.random.default_rng(len(timestamps))
    shots = [rng.integers(0, 256, (16, 32, 3), dtype=np.uint8) for _ in timestamps]
    images = [sc.CameraImage.of(int(time), camera_model, rgb) for time, rgb in zip(timestamps, shots, strict=True)]
    frames = sc.LazyFrames.of(images, timestamps)
    cameras = tuple(sc.CameraSensor(f"camera{index}", camera_model, frames, mount=mount) for index in range(count))
    for found, report in round_trip(sc.Scene(cameras), images="png"):
        assert not report
        assert len(found.cameras) == count
        for camera in found.cameras:
            np.testing.assert_array_equal(intrinsics_vector(camera.camera), intrinsics_vector(camera_model))
            np.testing.assert_allclose(camera.mount.matrix, mount.matrix, atol=1e-12)
            np.testing.assert_array_equal(camera.images.timestamps_ns, timestamps)
            for rgb, image in zip(shots, camera.images, strict=True):
                np.testing.assert_array_equal(image.rgb, rgb)


@pytest.mark.parametrize("start_ns", [0, -5_000_000_000, EPOCH_NS])
def test_a_drive_with_h264_has_as_many_images_at_the_same_times(start_ns, tmp_path):
    camera_model = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
    timestamps = start_ns + np.cumsum([0, 100, 100, 33, 170, 97, 100]).astype(np.int64) * 1_000_000
    shots = [np.full((48, 64, 3), 30 * k + 20, np.uint8) for k in range(len(timestamps))]
    images = [sc.CameraImage.of(int(time), camera_model, rgb) for time, rgb in zip(timestamps, shots, strict=True)]
    frames = sc.LazyFrames.of(images, timestamps)
    camera = sc.CameraSensor("camera0", camera_model, frames, mount=RigidTransform.identity())
    write_scene(sc.Scene((camera,)), tmp_path / "drive")
    with open_scene(tmp_path / "drive") as found:
        after = found.cameras[0]
        # whole milliseconds since 1970 come back within what a 64-bit number of seconds holds
        assert np.abs(after.images.timestamps_ns - timestamps).max() <= (0 if start_ns < 10**12 else 128)
        for rgb, image in zip(shots, after.images, strict=True):
            assert np.abs(image.rgb.astype(int) - rgb).max() <= 3  # flat grey through crf 18
