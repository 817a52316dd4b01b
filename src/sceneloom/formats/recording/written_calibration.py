"""Camera models and mountings as the entries of `calibration.json`.

In the spelling that the vendor's software reads.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.cameras.table import MODELS
from sceneloom.errors import CalibrationError
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.unwritten import main_receiver
from sceneloom.formats.recording.written_mounts import matrix_entry, mount_entry
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.shooting import ShootingSensor


class _Writing(NamedTuple):
    model: str
    locations: tuple[int, ...]


_CAMERA_MODELS: Mapping[str, tuple[_Writing, ...]] = {
    "pinhole": (_Writing("pinhole", ()),),
    "fisheye": (_Writing("kannala-brandt4", (0, 1, 2, 3)),),
    "brown_conrady": (
        _Writing("brown-conrady", tuple(range(8))),
        _Writing("brown-conrady", (*range(8), *range(10, 16))),
    ),
    "kannala_brandt18": (_Writing("kannala-brandt18", tuple(range(18))),),
    "omnidir": (_Writing("omnidir", tuple(range(6))),),
}
"""By our model: the format's name, and which of our coefficients it has, in order; the shortest list that holds all
coefficients that are not 0 is written.

Source: "Calibration format" of the recording format's description, and the models that the vendor's software knows.
"""

_STAND_INS: Mapping[str, tuple[str, ...]] = {
    "brown_conrady": ("lx", "ly"),
    "fisheye": (),
    "omnidir": (),
    "kannala_brandt18": (),
}
"""Models that other camera models are fitted to, each with the coefficients of ours that the format does not have."""

_FARTHEST_SHARE, _LEAST_SHARE = 0.01, 0.5
"""A camera model that is further off than this share of the image's width, in the mean square.

Or holds less of the image
than that is none that stands in for another."""


@lru_cache(maxsize=64)
def holdable_camera_model(camera: Camera) -> tuple[Camera, str | None]:
    """Give the camera model that a recording can hold: the same, or the nearest one of a model that it has.

    Returns:
        The camera model, and in words how far it is off; None where it is the same.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    if camera.model in _CAMERA_MODELS and not _unplaced(camera):
        return camera, None
    if camera.model not in MODELS:
        raise CalibrationError(
            f"camera model {camera.model!r}; a recording can hold {', '.join(_CAMERA_MODELS)}"
        )
    found = nearest(camera, _STAND_INS)
    if found.rms_px > _FARTHEST_SHARE * camera.width or found.share < _LEAST_SHARE:
        raise CalibrationError(
            f"{found.message(camera)}; a recording can hold {', '.join(_CAMERA_MODELS)}: leave the camera out, or "
            f"undistort "
            "its images with `sceneloom edit undistort`"
        )
    return found.camera, found.message(camera)


def _unplaced(camera: Camera) -> bool:
    """Whether a coefficient is used that no list of the format holds."""
    held = {location for row in _CAMERA_MODELS[camera.model] for location in row.locations}
    return any(value != 0 for location, value in enumerate(camera.coefficients) if location not in held)


def camera_model_entry(camera: Camera, *, model_key: str = "model") -> tuple[dict[str, Any], str | None]:
    """Write a camera model.

    Args:
        camera: the camera model.
        model_key: "model" in `calibration.json`, "distortionModel" in a line.

    Returns:
        The fields, and in words how far they are off the camera model; None where they hold it.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    camera, how_far = holdable_camera_model(camera)
    used = {location for location, value in enumerate(camera.coefficients) if value != 0}
    writing = next(row for row in _CAMERA_MODELS[camera.model] if used <= set(row.locations))
    values = dict(enumerate(camera.coefficients))
    fields = {
        model_key: writing.model,
        "distortionCoefficients": [float(values.get(location, 0.0)) for location in writing.locations],
        "focalLengthX": float(camera.fx),
        "focalLengthY": float(camera.fy),
        "principalPointX": float(camera.cx),
        "principalPointY": float(camera.cy),
        "imageWidth": camera.width,
        "imageHeight": camera.height,
    }
    return fields, how_far


def camera_model_losses(field: str, how_far: str | None) -> list[Loss]:
    """Report that a camera model was fitted."""
    return [] if how_far is None else [Loss(field=field, what=how_far, support=Support.APPROXIMATED)]


def camera_entry(
    sensor: ShootingSensor, camera: Camera, mount: RigidTransform
) -> tuple[dict[str, Any], list[Loss]]:
    """Write a camera.

    Args:
        sensor: whose further fields, if it came from a recording, are written back.
        camera: its camera model, for the images as they are written.
        mount: `ego_from_camera`.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    camera_model, how_far = camera_model_entry(camera)
    losses = camera_model_losses(f"sensors[{sensor.id}].camera", how_far)
    before = _entry_before(sensor)
    further = {k: v for k, v in before.items() if k not in {"imuToCameraMatrix", "distortionModel"}}
    matrix = mount_entry(mount, before, "imuToCamera", "imuToCameraMatrix")
    return {**further, **camera_model, "imuToCamera": matrix}, losses


def lidar_entry(sensor: LidarSensor, index: int, mount: RigidTransform, model: str) -> dict[str, Any]:
    """Write a lidar; `mount` is `ego_from_lidar`."""
    before = _entry_before(sensor)
    number = {"lidarInd": index} if index else {}
    unwanted = {"imuToLidarMatrix", "lidarInd"} - number.keys()
    further = {k: v for k, v in before.items() if k not in unwanted}
    matrix = mount_entry(mount, before, "imuToLidar", "imuToLidarMatrix")
    return {**further, "model": model, **number, "imuToLidar": matrix}


def antenna_entry(scene: Scene, before: Mapping[str, Any]) -> dict[str, Any]:
    """Write where the antenna of the receiver of `gps` lines sits; what a calibration stated of it before stays.

    Args:
        scene: what is written.
        before: the root of the calibration that the scene was read with.
    """
    main = main_receiver([sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)])
    mount = main[0].mount if main else None
    return {} if mount is None or "imuToGnss" in before else {"imuToGnss": matrix_entry(mount.inverse())}


def _entry_before(sensor: ShootingSensor | LidarSensor) -> dict[str, Any]:
    entry = sensor.extras.get("calibration")
    return dict(entry) if isinstance(entry, Mapping) else {}


def cropped(camera: Camera, width: int, height: int) -> Camera:
    """The camera model for images whose last rows and columns are cut off: nothing else changes."""
    return replace(camera, width=width, height=height)
