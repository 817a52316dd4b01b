"""Rules about localization adjustments and camera calibrations."""

from dataclasses import replace

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.scene import CameraCalibration, ImuSensor, LocalizationAdjustment, VectorSamples

PERIOD = 100_000_000
RULES = (
    "localization-adjustments-several",
    "localization-adjustment-short",
    "camera-calibrations-several",
    "camera-calibration-empty",
    "camera-calibration-size",
)


def test_a_sound_scene_keeps_all_of_them(sound, found):
    annotations = (
        LocalizationAdjustment("a", sound.path(np.array([PERIOD, 4 * PERIOD]))),
        CameraCalibration("c", "front", time_offset_ns=5),
        CameraCalibration("d", "back", intrinsics=sound.camera().camera),
    )
    scene = sound.scene(sound.lidar(), sound.camera(), sound.camera(id="back"), annotations=annotations)
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


def test_a_second_adjustment_is_found(sound, found):
    scene = sound.scene(annotations=tuple(LocalizationAdjustment(k, sound.path()) for k in "ab"))
    assert [path for path, _ in found(scene, "localization-adjustments-several")] == ["annotations[1]"]


def test_an_adjustment_that_ends_more_than_a_sweep_too_soon_is_found(sound, found):
    for last, hits in ((4 * PERIOD, 0), (4 * PERIOD - 1, 1)):
        adjustment = LocalizationAdjustment("a", sound.path(np.array([0, last])))
        assert len(found(sound.scene(annotations=(adjustment,)), "localization-adjustment-short")) == hits


def test_an_adjustment_need_not_cover_what_inertial_sensors_measured_before_and_after(sound, found):
    timestamps = np.arange(-20, 40) * PERIOD
    imu = ImuSensor("imu", {"gyroscope": VectorSamples(timestamps, np.zeros((60, 3)))})
    adjustment = LocalizationAdjustment("a", sound.path(np.array([0, 5 * PERIOD])))
    scene = sound.scene(sound.lidar(), imu, annotations=(adjustment,))
    assert found(scene, "localization-adjustment-short") == []


def test_an_adjustment_of_one_pose_may_hold_throughout(sound, found):
    adjustment = LocalizationAdjustment("a", sound.path(np.array([0])))
    assert found(sound.scene(annotations=(adjustment,)), "localization-adjustment-short") == []


def test_a_second_calibration_of_a_camera_is_found(sound, found):
    first = CameraCalibration("c", "front", time_offset_ns=5)
    scene = sound.scene(annotations=(first, replace(first, id="d")))
    assert [path for path, _ in found(scene, "camera-calibrations-several")] == ["annotations[1]"]


def test_a_calibration_that_says_nothing_is_found(sound, found):
    scene = sound.scene(
        annotations=(CameraCalibration("c", "front"), CameraCalibration("d", "front", sound.path()))
    )
    assert [path for path, _ in found(scene, "camera-calibration-empty")] == ["annotations[0]"]


def test_a_calibrated_camera_model_for_other_images_is_found(sound, found):
    camera_model = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
    scene = sound.scene(annotations=(CameraCalibration("c", "front", intrinsics=camera_model),))
    assert found(scene, "camera-calibration-size") == [
        ("annotations[0].intrinsics", "64 x 48 px; the camera's images are 32 x 24 px")
    ]
