"""Camera models and mountings of single images in the words that they were read from, where these still mean them."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.errors import SceneloomError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Loss
from sceneloom.formats.recording.camera_models import CameraParameters, camera_model
from sceneloom.formats.recording.frame_parameters import read_mount, read_parameters
from sceneloom.formats.recording.written_calibration import camera_model_entry, camera_model_losses, cropped
from sceneloom.formats.recording.written_mounts import matrix_entry
from sceneloom.formats.recording.written_shots import field_of
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.shooting import ShootingSensor, Shot

CAMERA_MODEL, MOUNT = "cameraParameters", "imuToCamera"
"""Fields of an entry, and extras of an image that has been read with them."""

_NON_FINITE = Path("data.jsonl")


class ImageParameters:
    """Writes what images of a camera have of their own.

    Attributes:
        losses: camera models that the format does not have.
    """

    def __init__(self, sensor: ShootingSensor, width: int, height: int) -> None:
        """Begin.

        Args:
            sensor: the camera.
            width: of the images as they are written [px].
            height: likewise.
        """
        self.losses: list[Loss] = []
        self._sensor, self._size = sensor, (width, height)
        self._written: CameraParameters | None = None
        self._last_camera_model: tuple[bytes, Camera | None] = (b"", None)
        self._last_mount: tuple[bytes, RigidTransform | None] = (b"", None)

    def fields(self, shot: Shot, kept: Mapping[str, Any]) -> dict[str, Any]:
        """Give the camera model and the mounting of an image, as far as they are its own.

        Args:
            shot: the image.
            kept: the fields that it was read with.
        """
        sensor, fields = self._sensor, dict[str, Any]()
        if CAMERA_MODEL in kept and self._means_camera_model(kept[CAMERA_MODEL], shot.camera):
            fields[CAMERA_MODEL] = kept[CAMERA_MODEL]
        elif CAMERA_MODEL in kept or shot.camera != sensor.camera:
            written, how_far = camera_model_entry(shot.camera, model_key="distortionModel")
            fields[CAMERA_MODEL] = {k: v for k, v in written.items() if not k.startswith("image")}
            self.losses += camera_model_losses(f"{field_of(sensor)}[].camera", how_far)
        if shot.mount is None:
            return fields
        if MOUNT in kept and self._means_mount(kept[MOUNT], shot.mount):
            fields[MOUNT] = kept[MOUNT]
        elif MOUNT in kept or shot.mount is not sensor.mount:
            fields[MOUNT] = matrix_entry(shot.mount.inverse())
        return fields

    def _means_camera_model(self, words: Any, camera: Camera) -> bool:
        text = msgspec.json.encode(words)
        if text != self._last_camera_model[0]:
            self._last_camera_model = text, self._camera_model_of(text)
        stated = self._last_camera_model[1]
        return stated is not None and _without_zeros(stated) == _without_zeros(cropped(camera, *self._size))

    def _camera_model_of(self, text: bytes) -> Camera | None:
        """What a reader of the written recording makes of it."""
        try:
            if self._written is None:
                entry, _ = camera_model_entry(cropped(self._sensor.camera, *self._size))
                self._written = msgspec.convert(entry, CameraParameters)
            parameters = read_parameters(text, 0, path=_NON_FINITE).over(self._written)
            return camera_model(parameters, self._size, "").resized(*self._size)
        except (SceneloomError, msgspec.ValidationError):
            return None

    def _means_mount(self, words: Any, mount: RigidTransform) -> bool:
        text = msgspec.json.encode(words)
        if text != self._last_mount[0]:
            self._last_mount = text, _mount_of(text)
        read = self._last_mount[1]
        return read is not None and np.array_equal(read.matrix, mount.matrix)


def _mount_of(text: bytes) -> RigidTransform | None:
    """What a reader makes of it; None where it would have to repair it."""
    ledger = Ledger(lenient=True)
    try:
        mount = read_mount(text, 0, path=_NON_FINITE, ledger=ledger)
    except SceneloomError:
        return None
    return None if ledger.warnings else mount


def _without_zeros(camera: Camera) -> Camera:
    """A camera without the zeros that other formats add at the end of its coefficients."""
    count = max((k + 1 for k, value in enumerate(camera.coefficients) if value), default=0)
    return replace(camera, coefficients=camera.coefficients[:count])
