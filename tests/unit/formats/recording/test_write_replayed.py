"""What the vendor's software would refuse, ignore or suspect is named when a recording is written."""

from types import MappingProxyType

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.formats.recording.writer import write_recording
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    CameraImage,
    CameraSensor,
    DepthCameraSensor,
    DepthFrame,
    ImuSensor,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    Scene,
    VectorSamples,
)

MS = 1_000_000
CAMERA_MODEL = Camera("pinhole", 32, 16, 30.0, 31.0, 16.0, 8.0)
HERE = RigidTransform.identity()
NO_IMU = "the vendor's software gives no output without accelerometer and gyroscope"


def times(count, *, start_ms=0, step_ms=100):
    return (np.arange(count, dtype=np.int64) * step_ms + start_ms) * MS


def a_camera(name="camera0", timestamps=None):
    timestamps = times(3) if timestamps is None else timestamps
    images = [CameraImage.of(int(t), CAMERA_MODEL, np.zeros((16, 32, 3), np.uint8)) for t in timestamps]
    return CameraSensor(name, CAMERA_MODEL, LazyFrames.of(images, timestamps), mount=HERE)


def a_depth_camera(name="camera1"):
    frames = [DepthFrame(int(t), CAMERA_MODEL, lambda: np.ones((16, 32), np.float32), 0.001) for t in times(3)]
    return DepthCameraSensor(name, CAMERA_MODEL, LazyFrames.of(frames, times(3)), mount=HERE)


def an_imu(*names, start_ms=1):
    timestamps = times(60, start_ms=start_ms, step_ms=5)
    return ImuSensor("imu", {name: VectorSamples(timestamps, np.ones((60, 3))) for name in names})


def a_lidar(name):
    return LidarSensor(name, LazyFrames.of([LidarFrame(0, LidarPoints(np.zeros((1, 3), np.float32)))], [0]), mount=HERE)


BOTH = ("accelerometer", "gyroscope")
CASES = {
    "nothing wrong": ((a_camera(), a_camera("camera1"), an_imu(*BOTH)), {}),
    "depth beside images": ((a_camera(), a_depth_camera(), an_imu(*BOTH)), {}),
    "no IMU": ((a_camera(),), {NO_IMU: 1}),
    "no gyroscope": (
        (a_camera(), an_imu("accelerometer")),
        {"the vendor's software gives no output without gyroscope": 1},
    ),
    "neither images": ((a_lidar("lidar"),), {}),
    "times of the IMU": (
        (a_camera(timestamps=times(3, start_ms=1)), an_imu(*BOTH)),
        {
            "images have exactly the times of IMU samples, which makes the vendor's diagnosis suspect that their times "
            "were not measured; they are written as they are": 3
        },
    ),
    "three cameras": (
        (a_camera(), a_camera("camera1"), a_camera("camera2"), an_imu(*BOTH)),
        {"the vendor's software uses the first two cameras, not camera2": 1},
    ),
    "two lidars": (
        (a_lidar("lidar0"), a_lidar("lidar1")),
        {"the vendor's software does not report lidars apart (`lidarInd`)": 2},
    ),
    "depth alone": (
        (a_depth_camera("camera0"), an_imu(*BOTH)),
        {"the vendor's software tracks in the first camera, and camera0 measures depth": 1},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_will_not_be_replayed_is_named(tmp_path, case):
    sensors, expected = CASES[case]
    report = write_recording(Scene(sensors), tmp_path / "drive", images="png")
    assert {loss.what: loss.count for loss in report if loss.field == "replay"} == expected


def test_settings_that_are_not_publicly_known_are_named(tmp_path):
    metadata = MappingProxyType({"recording": {"vio_config": "useStereo: True\nsparkle: 3\n"}})
    scene = Scene((a_camera(), an_imu(*BOTH)), metadata=metadata, format="recording")
    report = write_recording(scene, tmp_path / "drive")
    stated = [loss.what for loss in report if loss.field == "replay"]
    assert stated == ["the vendor's software may stop at settings that are not publicly known: sparkle"]
    assert (tmp_path / "drive" / "vio_config.yaml").read_text() == "useStereo: True\nsparkle: 3\n"
