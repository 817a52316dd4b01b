"""What is written as a recording is read back: arrays, times, mountings, camera models and images."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from sceneloom.cameras import MODELS, intrinsics_vector
from sceneloom.cameras.camera import Camera
from sceneloom.formats import open_scene, write_scene
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    CameraImage,
    CameraSensor,
    GnssSensor,
    ImuSensor,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    Scene,
    Trajectory,
    VectorSamples,
)

EXACT_NS = 2**51
"""Up to 26 days, a 64-bit number of seconds holds every nanosecond."""
NAMES = ["groundTruth", "pose", "arkit", "my method", "output"]
EPOCH_NS = 1_700_000_000_000_000_000

exact_times = st.integers(-EXACT_NS, EXACT_NS)
finite = st.floats(-1e6, 1e6)


def sorted_times(low: int, high: int, *, unique: bool = False) -> st.SearchStrategy[np.ndarray]:
    times = st.lists(st.integers(low, high), min_size=1, max_size=12, unique=unique)
    return times.map(lambda found: np.array(sorted(found), np.int64))


def rigid(draw: st.DrawFn) -> RigidTransform:
    rotation = Rotation.from_rotvec(draw(hnp.arrays(np.float64, 3, elements=st.floats(-3, 3))))
    return RigidTransform(rotation.as_matrix(), draw(hnp.arrays(np.float64, 3, elements=st.floats(-50, 50))))


rigids = st.composite(rigid)()


def round_trip(scene: Scene, **options):
    with TemporaryDirectory() as folder:
        report = write_scene(scene, Path(folder, "drive"), **options)
        with open_scene(Path(folder, "drive")) as found:
            yield found, report


@given(sorted_times(-EXACT_NS, EXACT_NS), st.data())
def test_samples_keep_their_times_to_the_nanosecond_and_their_values_to_the_bit(timestamps, data):
    values = data.draw(hnp.arrays(np.float64, (len(timestamps), 3), elements=finite))
    scene = Scene((ImuSensor("imu", {"gyroscope": VectorSamples(timestamps, values)}),))
    for found, report in round_trip(scene):
        assert len(report) == 0
        stream = found.sensor("imu").streams["gyroscope"]
        np.testing.assert_array_equal(stream.timestamps_ns, timestamps)
        np.testing.assert_array_equal(stream.values, values)


@given(st.lists(st.floats(-9e9, 9e9), min_size=1, max_size=12))
def test_the_seconds_that_a_file_had_are_in_the_next_file(seconds):
    numbers = np.array(sorted(seconds))
    timestamps = np.rint(numbers * 1e9).astype(np.int64)
    scene = Scene((ImuSensor("imu", {"gyroscope": VectorSamples(timestamps, np.ones((len(timestamps), 3)), numbers)}),))
    for found, report in round_trip(scene):
        stream = found.sensor("imu").streams["gyroscope"]
        assert len(report) == 0
        # equal as numbers: -0.0 is 0.0
        np.testing.assert_array_equal(stream.file_seconds, numbers)
        np.testing.assert_array_equal(stream.timestamps_ns, timestamps)


@given(sorted_times(EPOCH_NS, EPOCH_NS + 10**13))
def test_times_since_1970_are_off_by_no_more_than_is_reported(timestamps):
    scene = Scene((ImuSensor("imu", {"gyroscope": VectorSamples(timestamps, np.ones((len(timestamps), 3)))}),))
    for found, report in round_trip(scene):
        off = np.abs(found.sensor("imu").streams["gyroscope"].timestamps_ns - timestamps)
        # half of the step of such seconds, 2^-22 s, and half of the step of the same time in nanoseconds, 2^8 ns
        assert off.max() <= 119 + 128
        assert sum(loss.count for loss in report) == int((off > 0).sum())


@given(sorted_times(-EXACT_NS, EXACT_NS, unique=True), st.booleans(), st.data())
def test_trajectories_come_back_under_their_names(timestamps, oriented, data):
    count = len(timestamps)
    positions = data.draw(hnp.arrays(np.float64, (count, 3), elements=finite))
    rotations = data.draw(hnp.arrays(np.float64, (count, 3), elements=st.floats(-3, 3)))
    quaternions = Rotation.from_rotvec(rotations).as_quat() if oriented else None
    names = data.draw(
        st.lists(st.sampled_from(["groundTruth", "pose", "arkit", "my method", "output"]), min_size=1, unique=True)
    )
    scene = Scene((), trajectories={name: Trajectory(name, timestamps, positions, quaternions) for name in names})
    for found, _ in round_trip(scene):
        assert set(found.trajectories) == set(names)
        for trajectory in found.trajectories.values():
            np.testing.assert_array_equal(trajectory.timestamps_ns, timestamps)
            np.testing.assert_array_equal(trajectory.positions, positions)
            assert (trajectory.quaternions_xyzw is None) == (not oriented)
            if oriented:
                np.testing.assert_array_equal(trajectory.quaternions_xyzw, quaternions)


@given(sorted_times(-EXACT_NS, EXACT_NS), st.data())
def test_fixes_come_back_with_the_accuracies_that_they_have(timestamps, data):
    count = len(timestamps)
    lla = data.draw(hnp.arrays(np.float64, (count, 3), elements=st.floats(-90, 90)))
    known = st.one_of(st.just(np.nan), st.floats(0, 100))
    accuracies = [data.draw(hnp.arrays(np.float64, count, elements=known)) for _ in range(2)]
    scene = Scene((GnssSensor("gnss", timestamps, lla, *accuracies),))
    for found, _ in round_trip(scene):
        gnss = found.sensor("gnss")
        np.testing.assert_array_equal(gnss.timestamps_ns, timestamps)
        np.testing.assert_array_equal(gnss.positions_lla, lla)
        np.testing.assert_array_equal(gnss.accuracies, accuracies[0])
        np.testing.assert_array_equal(gnss.vertical_accuracies, accuracies[1])


def points_at(data: st.DataObject, start_ns: int) -> LidarPoints:
    count = data.draw(st.integers(0, 6))
    floats = st.floats(allow_nan=True, allow_infinity=True, width=32)
    offsets = data.draw(hnp.arrays(np.int64, count, elements=st.integers(0, 10**8)))
    return LidarPoints(
        positions=data.draw(hnp.arrays(np.float32, (count, 3), elements=floats)),
        intensities=data.draw(hnp.arrays(np.uint8, count)),
        timestamps_ns=start_ns + offsets,
        rings=data.draw(hnp.arrays(np.uint16, count)),
    )


@given(sorted_times(-EXACT_NS, EXACT_NS, unique=True), rigids, st.data())
def test_sweeps_come_back_point_by_point(timestamps, mount, data):
    frames = [LidarFrame(int(timestamp), points_at(data, int(timestamp))) for timestamp in timestamps]
    lidars = tuple(LidarSensor(f"lidar{index}", LazyFrames.of(frames, timestamps), mount=mount) for index in range(2))
    for found, report in round_trip(Scene(lidars)):
        assert not [loss for loss in report if loss.field != "replay"]
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
    model = draw(st.sampled_from(HELD))
    names = MODELS[model].coefficient_names
    count = draw(st.sampled_from(sorted({0, min(5, len(names)), len(names)})))
    # the format has no decentring
    values = [0.0 if names[k] in {"lx", "ly"} else draw(st.floats(-0.01, 0.01)) for k in range(count)]
    numbers = [draw(st.floats(10, 50)) for _ in range(4)]
    return Camera(model, 32, 16, *numbers, tuple(values))


@given(camera_models(), rigids, sorted_times(-EXACT_NS, EXACT_NS, unique=True), st.integers(1, 2))
def test_cameras_come_back_with_camera_model_mounting_times_and_pixels(camera_model, mount, timestamps, count):
    rng = np.random.default_rng(len(timestamps))
    shots = [rng.integers(0, 256, (16, 32, 3), dtype=np.uint8) for _ in timestamps]
    images = [
        CameraImage.of(int(timestamp), camera_model, rgb) for timestamp, rgb in zip(timestamps, shots, strict=True)
    ]
    cameras = tuple(
        CameraSensor(f"camera{index}", camera_model, LazyFrames.of(images, timestamps), mount=mount)
        for index in range(count)
    )
    for found, report in round_trip(Scene(cameras), images="png"):
        assert not [loss for loss in report if loss.field != "replay"]
        assert len(found.cameras) == count
        for camera in found.cameras:
            np.testing.assert_array_equal(intrinsics_vector(camera.camera), intrinsics_vector(camera_model))
            np.testing.assert_allclose(camera.mount.matrix, mount.matrix, atol=1e-12)
            np.testing.assert_array_equal(camera.images.timestamps_ns, timestamps)
            for rgb, image in zip(shots, camera.images, strict=True):
                np.testing.assert_array_equal(image.rgb, rgb)


def test_a_real_recording_read_written_and_read_again_is_the_same(data_dir, tmp_path):
    for name in ("kitti_drive", "pandaset", "kitti_oxts_0000"):
        with open_scene(data_dir / "recordings" / name) as before:
            report = write_scene(before, tmp_path / name)
            assert [loss for loss in report if loss.field != "replay"] == []
            with open_scene(tmp_path / name) as after:
                assert [sensor.id for sensor in after.sensors] == [sensor.id for sensor in before.sensors]
                assert [warning.code for warning in after.warnings] == [warning.code for warning in before.warnings]
                for old, new in zip(before.lidars, after.lidars, strict=True):
                    np.testing.assert_allclose(new.mount.matrix, old.mount.matrix, atol=1e-12)
                    sweep_before, sweep_after = old.frames[-1].points, new.frames[-1].points
                    np.testing.assert_array_equal(sweep_after.positions, sweep_before.positions)
                    np.testing.assert_array_equal(sweep_after.timestamps_ns, sweep_before.timestamps_ns)
                for old, new in zip(before.cameras, after.cameras, strict=True):
                    assert new.camera == old.camera
                    np.testing.assert_array_equal(new.images.timestamps_ns, old.images.timestamps_ns)
                    np.testing.assert_array_equal(new.images[2].rgb, old.images[2].rgb)
                for key, old in before.trajectories.items():
                    np.testing.assert_array_equal(after.trajectories[key].positions, old.positions)
                    np.testing.assert_array_equal(after.trajectories[key].file_seconds, old.file_seconds)


@pytest.mark.parametrize("start_ns", [0, -5_000_000_000, EPOCH_NS])
def test_a_drive_with_h264_has_as_many_images_at_the_same_times(start_ns, tmp_path):
    camera_model = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
    timestamps = start_ns + np.cumsum([0, 100, 100, 33, 170, 97, 100]).astype(np.int64) * 1_000_000
    shots = [np.full((48, 64, 3), 30 * k + 20, np.uint8) for k in range(len(timestamps))]
    images = [
        CameraImage.of(int(timestamp), camera_model, rgb) for timestamp, rgb in zip(timestamps, shots, strict=True)
    ]
    camera = CameraSensor("camera0", camera_model, LazyFrames.of(images, timestamps), mount=RigidTransform.identity())
    write_scene(Scene((camera,)), tmp_path / "drive")
    with open_scene(tmp_path / "drive") as found:
        after = found.cameras[0]
        # whole milliseconds since 1970 come back within what a 64-bit number of seconds holds
        assert np.abs(after.images.timestamps_ns - timestamps).max() <= (0 if start_ns < 10**12 else 128)
        for rgb, image in zip(shots, after.images, strict=True):
            assert np.abs(image.rgb.astype(int) - rgb).max() <= 3  # flat grey through crf 18
