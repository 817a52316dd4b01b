"""Camera models in the words of camera calibrations of ROS and Foxglove, and ours.

`plumb_bob` and `rational_polynomial` are OpenCV's pinhole camera model with distortion, `equidistant` and
`kannala_brandt` its fisheye camera model. Source: sensor_msgs/distortion_models.hpp and CameraInfo of ROS,
CameraCalibration of Foxglove.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.table import MODELS
from sceneloom.errors import CalibrationError, DataError, UnknownFormatError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.topics.records import CameraModelRecord
from sceneloom.scene.warnings import WarningKind

UNKNOWN = "unknown"
"""Model of cameras without a calibration: images can be looked at, and nothing can be projected."""

OUR_PREFIX = "sceneloom:"
"""Begins the names of models that only we know, in calibrations of ours."""

_READ: Mapping[str, tuple[str, int]] = MappingProxyType(
    {
        "": ("brown_conrady", 5),
        "none": ("brown_conrady", 5),
        "pinhole": ("brown_conrady", 5),
        "plumb_bob": ("brown_conrady", 5),
        "rational_polynomial": ("brown_conrady", 14),
        "equidistant": ("fisheye", 4),
        "fisheye": ("fisheye", 4),
        "kannala_brandt": ("fisheye", 4),
    }
)
"""Our model of each name, and how many coefficients it may have."""

_TOLERANCE = 1e-9


def no_camera_model(width: int, height: int) -> Camera:
    """The camera model of a camera without a calibration."""
    return Camera(UNKNOWN, width, height, 1.0, 1.0, (width - 1) / 2, (height - 1) / 2)


def read_camera_model(record: CameraModelRecord, owner: str, location: str, ledger: Ledger) -> Camera | None:
    """Read a calibration; None for one that says that the camera is not calibrated.

    Raises:
        UnknownFormatError: the model is unknown.
        DataError: its numbers are none.
    """
    k = record.k
    if len(k) != 9:
        raise DataError(owner, location, f"K of {len(k)} numbers; expected 9")
    if k[0] == 0.0:
        return None
    model, coefficients = _model(record, owner, location)
    if abs(k[1]) > _TOLERANCE * abs(k[0]):
        message = f"skew {k[1]:g} of K is not used"
        ledger.note(WarningKind.SKIPPED, "camera-model-skew", f"{owner}: {location}", message)
    try:
        return Camera(model, record.width, record.height, k[0], k[4], k[2], k[5], coefficients)
    except CalibrationError as error:
        raise DataError(owner, location, str(error)) from None


def _model(record: CameraModelRecord, owner: str, location: str) -> tuple[str, tuple[float, ...]]:
    named = record.model.strip()
    own = named.removeprefix(OUR_PREFIX)
    if named.startswith(OUR_PREFIX) and own in MODELS:
        return own, record.coefficients
    if named.lower() not in _READ:
        known = ", ".join(filter(None, _READ))
        problem = f"{record.model!r}; expected one of {known}"
        raise UnknownFormatError(owner, f"{location}.distortion_model", problem)
    model, most = _READ[named.lower()]
    numbers = record.coefficients
    while len(numbers) > most and numbers[-1] == 0.0:
        numbers = numbers[:-1]
    if len(numbers) > most:
        problem = f"{len(numbers)} coefficients of {named or 'a camera model without model'}; expected at most {most}"
        raise DataError(owner, f"{location}.D", problem)
    if model == "fisheye":
        return model, (*numbers, *(0.0,) * (most - len(numbers)))
    if not any(numbers):
        return "pinhole", ()
    if len(numbers) > 8:
        # s1-s4 and the tilt come after k6; in our model after lx and ly, which OpenCV does not have
        numbers = (*numbers[:8], 0.0, 0.0, *numbers[8:])
    return model, numbers


def camera_model_record(camera: Camera, timestamp_ns: int, frame_id: str, fisheye: str) -> CameraModelRecord:
    """Put a camera model into the words of calibrations.

    Args:
        camera: the camera model; a model that the words do not know is named as only we understand.
        timestamp_ns: since when [ns].
        frame_id: of the camera.
        fisheye: what the format calls an OpenCV fisheye camera model.
    """
    model, numbers = _written_model(camera, fisheye)
    k = tuple(float(value) for value in camera.matrix.reshape(-1))
    if camera.model == UNKNOWN:
        k = (0.0,) * 9
    p = (*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0)
    return CameraModelRecord(timestamp_ns, frame_id, camera.width, camera.height, model, numbers, k, p)


def _written_model(camera: Camera, fisheye: str) -> tuple[str, tuple[float, ...]]:
    numbers = camera.coefficients
    padded = (*numbers, *(0.0,) * 16)
    if camera.model in {"pinhole", UNKNOWN}:
        return "plumb_bob", (0.0,) * 5
    if camera.model == "fisheye":
        return fisheye, padded[:4]
    if camera.model == "brown_conrady" and not any(padded[8:]):
        return ("rational_polynomial", padded[:8]) if len(numbers) > 5 else ("plumb_bob", padded[:5])
    return f"{OUR_PREFIX}{camera.model}", numbers


def is_foreign(camera: Camera) -> bool:
    """Whether other programs do not know the camera model."""
    return _written_model(camera, "")[0].startswith(OUR_PREFIX)


def fitted(camera: Camera, size: tuple[int, int], location: str, ledger: Ledger) -> Camera:
    """Fit a camera model to the size of the images, with a warning where it is for another one."""
    if (camera.width, camera.height) == size:
        return camera
    message = (
        f"the calibration is for {camera.width}x{camera.height}, the images are {size[0]}x{size[1]}; "
        "the camera model was scaled"
    )
    ledger.note(WarningKind.REPAIRED, "camera-model-scaled", location, message)
    return replace(no_camera_model(*size)) if camera.model == UNKNOWN else camera.resized(*size)


def camera_model_text(camera: Camera) -> str:
    """A camera model as JSON, for notes of ours."""
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
    return json.dumps([camera.model, camera.width, camera.height, numbers, list(camera.coefficients)])


def camera_model_from_text(text: str) -> Camera:
    """The camera model of `camera_model_text`."""
    model, width, height, numbers, coefficients = json.loads(text)
    fx, fy, cx, cy = numbers
    return Camera(model, width, height, fx, fy, cx, cy, tuple(coefficients))
