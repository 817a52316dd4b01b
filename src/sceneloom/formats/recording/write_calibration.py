"""Camera models and mountings in the words of a recording: for `calibration.json`, and for single images."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import CalibrationError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.formats.base.poses import field_of
from sceneloom.formats.recording.calibration import (
    CameraParameters,
    camera_model,
    read_mount,
    read_parameters,
    rigid_transform,
)
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import ShootingSensor, Shot
from sceneloom.scene.clouds import LidarSensor

CAMERA_MODEL, MOUNT = "cameraParameters", "imuToCamera"
"""Fields of an entry, and extras of an image that has been read with them."""

_CAMERA_MODELS: Mapping[str, tuple[tuple[str, tuple[int, ...]], ...]] = {
    "pinhole": (("pinhole", ()),),
    "fisheye": (("kannala-brandt4", (0, 1, 2, 3)),),
    "brown_conrady": (("brown-conrady", tuple(range(8))), ("brown-conrady", (*range(8), *range(10, 16)))),
    "kannala_brandt18": (("kannala-brandt18", tuple(range(18))),),
    "omnidir": (("omnidir", tuple(range(6))),),
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
"""A camera model whose root mean square error is a greater share of the image's width, or that covers a smaller share
of the image, does not stand in for another."""

_NO_FILE = Path("data.jsonl")


def matrix_entry(transform: RigidTransform) -> list[list[float]]:
    """A transform as four rows of four numbers."""
    rows: list[list[float]] = transform.matrix.tolist()
    return rows


def mount_entry(mount: RigidTransform, before: Mapping[str, Any], *keys: str) -> list[list[float]]:
    """Write a mounting: with the numbers of the entry that it was read from, where they still mean it.

    Args:
        mount: `ego_from_sensor`.
        before: the entry.
        keys: under which of its keys the matrix may stand.
    """
    for numbers in (before[key] for key in keys if key in before):
        try:
            read = rigid_transform(numbers, "", Ledger(lenient=True)).inverse()
            if np.shape(numbers) == (4, 4) and np.array_equal(read.matrix, mount.matrix):
                return [list(map(float, row)) for row in numbers]
        except (CalibrationError, *DECODER_FAULTS, TypeError):
            continue
    return matrix_entry(mount.inverse())


@lru_cache(maxsize=64)
def _holdable_camera_model(camera: Camera) -> tuple[Camera, str | None]:
    """The same camera model, or the nearest one that the format has, with how far it is off in words."""
    writings = _CAMERA_MODELS.get(camera.model, ())
    used = {k for k, value in enumerate(camera.coefficients) if value != 0}
    if writings and used <= {k for _, taken in writings for k in taken}:
        return camera, None
    known = f"a recording can hold {', '.join(_CAMERA_MODELS)}"
    if camera.model not in MODELS:
        raise CalibrationError(f"camera model {camera.model!r}; {known}")
    found = nearest(camera, _STAND_INS)
    if found.rms_px > _FARTHEST_SHARE * camera.width or found.share < _LEAST_SHARE:
        hint = "leave the camera out, or undistort its images with `sceneloom edit undistort`"
        raise CalibrationError(f"{found.message(camera)}; {known}: {hint}")
    return found.camera, found.message(camera)


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
    camera, how_far = _holdable_camera_model(camera)
    values = dict(enumerate(camera.coefficients))
    used = {k for k, value in values.items() if value != 0}
    model, taken = next((model, taken) for model, taken in _CAMERA_MODELS[camera.model] if used <= set(taken))
    fields = {
        model_key: model,
        "distortionCoefficients": [float(values.get(k, 0.0)) for k in taken],
        "focalLengthX": float(camera.fx),
        "focalLengthY": float(camera.fy),
        "principalPointX": float(camera.cx),
        "principalPointY": float(camera.cy),
        "imageWidth": camera.width,
        "imageHeight": camera.height,
    }
    return fields, how_far


def camera_entry(sensor: ShootingSensor, camera: Camera, mount: RigidTransform) -> tuple[dict[str, Any], list[Loss]]:
    """Write a camera.

    Args:
        sensor: whose unknown fields, if it came from a recording, are written back.
        camera: its camera model, for the images as they are written.
        mount: `ego_from_camera`.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    fields, how_far = camera_model_entry(camera)
    before = _entry_before(sensor)
    further = {k: v for k, v in before.items() if k not in {"imuToCameraMatrix", "distortionModel"}}
    matrix = mount_entry(mount, before, "imuToCamera", "imuToCameraMatrix")
    return {**further, **fields, "imuToCamera": matrix}, _fitting_losses(f"sensors[{sensor.id}].camera", how_far)


def lidar_entry(sensor: LidarSensor, index: int, mount: RigidTransform, model: str) -> dict[str, Any]:
    """Write a lidar; `mount` is `ego_from_lidar`."""
    before = _entry_before(sensor)
    number = {"lidarInd": index} if index else {}
    further = {k: v for k, v in before.items() if k not in {"imuToLidarMatrix", "lidarInd"} - number.keys()}
    matrix = mount_entry(mount, before, "imuToLidar", "imuToLidarMatrix")
    return {**further, "model": model, **number, "imuToLidar": matrix}


def _entry_before(sensor: ShootingSensor | LidarSensor) -> dict[str, Any]:
    entry = sensor.extras.get("calibration")
    return dict(entry) if isinstance(entry, Mapping) else {}


def _fitting_losses(field: str, how_far: str | None) -> list[Loss]:
    return [] if how_far is None else [Loss(field=field, what=how_far, support=Support.APPROXIMATED)]


class ImageParameters:
    """Writes the camera models and mountings that single images of a camera have.

    Attributes:
        losses: camera models that the format does not have.
    """

    def __init__(self, sensor: ShootingSensor, width: int, height: int) -> None:
        """Begin; width and height are those of the images as they are written [px]."""
        self.losses: list[Loss] = []
        self._sensor, self._size = sensor, (width, height)
        self._calibrated: CameraParameters | None = None
        self._last: dict[str, tuple[bytes, Any]] = {}

    def fields(self, shot: Shot, kept: Mapping[str, Any]) -> dict[str, Any]:
        """Give what is an image's own: in the words that it was read with (`kept`), where they still mean it."""
        sensor, fields = self._sensor, dict[str, Any]()
        if CAMERA_MODEL in kept and self._same_camera(kept[CAMERA_MODEL], shot.camera):
            fields[CAMERA_MODEL] = kept[CAMERA_MODEL]
        elif CAMERA_MODEL in kept or shot.camera != sensor.camera:
            written, how_far = camera_model_entry(shot.camera, model_key="distortionModel")
            fields[CAMERA_MODEL] = {k: v for k, v in written.items() if not k.startswith("image")}
            self.losses += _fitting_losses(f"{field_of(sensor)}[].camera", how_far)
        if shot.mount is None:
            return fields
        if MOUNT in kept and self._same_mount(kept[MOUNT], shot.mount):
            fields[MOUNT] = kept[MOUNT]
        elif MOUNT in kept or shot.mount is not sensor.mount:
            fields[MOUNT] = matrix_entry(shot.mount.inverse())
        return fields

    def _same_camera(self, words: Any, camera: Camera) -> bool:
        read = self._read(CAMERA_MODEL, words)
        width, height = self._size
        return read is not None and _without_zeros(read) == _without_zeros(replace(camera, width=width, height=height))

    def _same_mount(self, words: Any, mount: RigidTransform) -> bool:
        read = self._read(MOUNT, words)
        return read is not None and np.array_equal(read.matrix, mount.matrix)

    def _read(self, key: str, words: Any) -> Any:
        """What a reader of the written recording makes of the words; None where it would have to repair them."""
        text = msgspec.json.encode(words)
        if self._last.get(key, (b"", None))[0] != text:
            self._last[key] = text, self._read_anew(key, text)
        return self._last[key][1]

    def _read_anew(self, key: str, text: bytes) -> Camera | RigidTransform | None:
        ledger, (width, height) = Ledger(lenient=True), self._size
        try:
            if key == MOUNT:
                mount = read_mount(text, 0, path=_NO_FILE, ledger=ledger)
                return None if ledger.warnings else mount
            if self._calibrated is None:
                entry, _ = camera_model_entry(replace(self._sensor.camera, width=width, height=height))
                self._calibrated = msgspec.convert(entry, CameraParameters)
            parameters = read_parameters(text, 0, path=_NO_FILE).over(self._calibrated)
            return camera_model(parameters, self._size, "").resized(width, height)
        except (SceneloomError, msgspec.ValidationError):
            return None


def _without_zeros(camera: Camera) -> Camera:
    """A camera without the zeros that other formats add at the end of its coefficients."""
    count = max((k + 1 for k, value in enumerate(camera.coefficients) if value), default=0)
    return replace(camera, coefficients=camera.coefficients[:count])
