"""What our metadata says about single images of a camera: a camera model.

A mounting and further fields of their own.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.formats.sfs.poses import mount_of, mount_rows
from sceneloom.formats.sfs.records import FieldError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.types import NO_FIELDS

EXPOSURE = "exposureTimeSeconds"
"""The field that says how long a image was exposed [s], on the camera or on a image."""

_LONGEST_EXPOSURE = 3600.0


def exposure_ns(fields: Mapping[str, Any], otherwise_ns: int) -> int:
    """How long a image was exposed [ns], as its fields state."""
    seconds = fields.get(EXPOSURE)
    if isinstance(seconds, int | float) and 0 <= seconds < _LONGEST_EXPOSURE:
        return round(seconds * 1e9)
    return otherwise_ns


def camera_of(record: Mapping[str, Any]) -> Camera:
    """Make a camera model of a `camera` record.

    Raises:
        FieldError: its coefficients are no numbers.
        CalibrationError: the numbers are those of no camera model.
    """
    return camera_model_of(record, record["model"], numbers_of(record["coefficients"]))


def camera_model_of(record: Mapping[str, Any], model: str, coefficients: tuple[float, ...]) -> Camera:
    """Make a camera model of a record that has size, focal lengths and centre by name."""
    fx, fy, cx, cy = (float(record[name]) for name in ("fx", "fy", "cx", "cy"))
    return Camera(model, record["width"], record["height"], fx, fy, cx, cy, coefficients)


def camera_record(camera: Camera) -> dict[str, Any]:
    """Make the `camera` record of a camera model."""
    names = ("model", "width", "height", "fx", "fy", "cx", "cy")
    return {**{name: getattr(camera, name) for name in names}, "coefficients": list(camera.coefficients)}


def numbers_of(values: Any) -> tuple[float, ...]:
    """Take a list of numbers.

    Raises:
        FieldError: it is none.
    """
    numbers = values.tolist() if isinstance(values, np.ndarray) else values
    if not isinstance(numbers, list) or any(type(number) not in (int, float) for number in numbers):
        raise FieldError(f"{str(numbers)[:60]}; expected a list of numbers")
    try:
        return tuple(float(number) for number in numbers)
    except OverflowError:
        raise FieldError("a number is beyond what a float can hold") from None


@dataclass(frozen=True, slots=True, eq=False)
class ImageNotes:
    """The own camera models, mountings and fields of a camera's images; each list is empty where no image has one."""

    camera_model: Camera
    cameras: list[Camera]
    mounts: list[RigidTransform | None]
    fields: list[Mapping[str, Any]]

    @classmethod
    def of(cls, note: Mapping[str, Any], camera_model: Camera, count: int) -> Self:
        """Read the note of a camera with so many images.

        Raises:
            FieldError: the note does not fit.
            CalibrationError: it holds numbers that are those of no camera model.
        """
        cameras = [camera_of(record) for record in note.get("cameras") or []]
        chosen = _listed(note, "camera_of_image", count)
        if any(type(k) is not int or not 0 <= k < len(cameras) for k in chosen):
            raise FieldError(f"camera_of_image: expected numbers below {len(cameras)}")
        fields = _listed(note, "extras", count)
        if any(not isinstance(extra, dict | None) for extra in fields):
            raise FieldError("extras: expected objects")
        mounts = _listed(note, "mounts", count)
        return cls(
            camera_model,
            [cameras[k] for k in chosen],
            [None if row is None else mount_of(row) for row in mounts],
            [extra or NO_FIELDS for extra in fields],
        )

    def camera(self, index: int) -> Camera:
        """The camera model of an image."""
        return self.cameras[index] if self.cameras else self.camera_model

    def mount(self, index: int) -> RigidTransform | None:
        """The mounting of an image where it has one of its own."""
        return self.mounts[index] if self.mounts else None

    def extras(self, index: int) -> Mapping[str, Any]:
        """Further fields of an image."""
        return self.fields[index] if self.fields else NO_FIELDS


def _listed(note: Mapping[str, Any], name: str, count: int) -> list[Any]:
    values = note.get(name)
    listed = values.tolist() if isinstance(values, np.ndarray) else values or []
    if not isinstance(listed, list) or (listed and len(listed) != count):
        raise FieldError(f"{name}: expected a list of one entry per image")
    return listed


@dataclass(slots=True)
class ImageNotesWriter:
    """Collects what single images have of their own.

    Attributes:
        camera_model: the camera model; images that have the same need no note.
    """

    camera_model: Camera
    _cameras: dict[Camera, int]
    _chosen: list[int]
    _mounts: list[list[list[float]] | None]
    _extras: list[Mapping[str, Any]]

    @classmethod
    def empty(cls, camera_model: Camera) -> Self:
        """Begin without images."""
        return cls(camera_model, {camera_model: 0}, [], [], [])

    def add(self, image: CameraImage, extras: Mapping[str, Any]) -> None:
        """Note one image, with the fields that have no other location."""
        self._chosen.append(self._cameras.setdefault(image.camera, len(self._cameras)))
        self._mounts.append(None if image.mount is None else mount_rows(image.mount))
        self._extras.append(extras)

    @property
    def own_cameras(self) -> int:
        """How many images have a camera model of their own."""
        return sum(k > 0 for k in self._chosen)

    def record(self) -> dict[str, Any] | None:
        """Make the note; None where no image has anything of its own."""
        note: dict[str, Any] = {}
        if any(self._chosen):
            note["cameras"] = [camera_record(camera) for camera in self._cameras]
            note["camera_of_image"] = self._chosen
        if any(row is not None for row in self._mounts):
            note["mounts"] = self._mounts
        if any(self._extras):
            note["extras"] = self._extras
        return note or None
