"""The time by which a camera's clock is off the IMU's: left alone, or applied where the caller asks for it."""

from collections.abc import Mapping
from typing import Any

from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.calibration import Calibration, CameraCalibration
from sceneloom.scene.warnings import WarningKind

SHIFT_KEY = "imuToCameraShiftSeconds"

CAMERA_SHIFTS: Mapping[str, int] = {"ignore": 0, "apply": 1, "subtract": -1}
"""What becomes of `imuToCameraShiftSeconds`: by how many times it is added to the times of images.

The description of the format has no such field. "apply": t_imu = t_camera + shift (ASSUMED). "subtract": the sense in
which the open part of the vendor's software takes it.

Source: `imuToCameraShiftSeconds` in `codegen/parameter_definitions.c` and `src/odometry/sample_sync.cpp` of HybVIO.
"""


def shift_of(calibration: CameraCalibration, camera_shift: str, ledger: Ledger) -> float:
    """Give what is to be added to the times of a camera's images [s], with a warning where the calibration has any."""
    if not calibration.shift:
        return 0.0
    factor, stated = CAMERA_SHIFTS[camera_shift], f"{SHIFT_KEY} {calibration.shift}"
    code, message = {
        0: (
            "camera-shift-not-applied",
            f"{stated} is not applied: frame times are taken to be on the recording's clock",
        ),
        1: ("camera-shift-applied", f"{stated} was added to the times of the camera's images"),
        -1: ("camera-shift-applied", f"{stated} was taken off the times of the camera's images"),
    }[factor]
    ledger.note(WarningKind.ASSUMED, code, calibration.location, message)
    return factor * calibration.shift


def entry_after(calibration: CameraCalibration, camera_shift: str) -> Mapping[str, Any]:
    """Give the entry that holds for the images as they are read: one that was applied is not in it any more."""
    if not CAMERA_SHIFTS[camera_shift]:
        return calibration.entry
    return {key: value for key, value in calibration.entry.items() if key != SHIFT_KEY}


def applied_shifts(calibration: Calibration, camera_shift: str) -> dict[str, Any]:
    """Record which cameras' times were shifted, and by how much [s]; nothing where none was."""
    factor = CAMERA_SHIFTS[camera_shift]
    shifts = {
        f"camera{index}": factor * camera.shift
        for index, camera in calibration.cameras.items()
        if camera.shift
    }
    return {"camera_shifts": shifts} if factor and shifts else {}
