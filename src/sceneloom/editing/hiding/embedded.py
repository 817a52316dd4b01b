"""Copies of images in the free fields of a scene: they would show what is hidden in the images themselves."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene

_STARTS = (b"\xff\xd8\xff", b"\x89PNG\r\n", b"GIF8", b"II*\x00", b"MM\x00*", b"\x1a\x45\xdf\xa3")
"""How JPEG, PNG, GIF, TIFF and Matroska files begin."""

_LEAST_BYTES = 64
"""No image of anything is shorter."""

_AS_TEXT = re.compile(r"^(data:(image|video)/|/9j/|iVBORw0KGgo|R0lGOD|UklGR)")
"""How such files begin in base64, or as a link that holds them."""


@dataclass(slots=True)
class EmbeddedImages:
    """Takes copies of images out of free fields, and keeps where they were.

    Attributes:
        locations: where.
    """

    locations: list[str] = field(default_factory=list)

    def scene(self, scene: Scene) -> Scene:
        """Give the scene without copies in the fields of itself, its sensors and its annotations."""
        sensors = [self._bare(sensor, f"sensors[{sensor.id}]") for sensor in scene.sensors]
        annotations = [self._bare(one, f"annotations[{one.id}]") for one in scene.annotations]
        return replace(
            scene,
            sensors=tuple(sensors),
            annotations=tuple(annotations),
            metadata=self.fields(scene.metadata, "metadata"),
            extras=self.fields(scene.extras, "extras"),
        )

    def _bare(self, part: Any, location: str) -> Any:
        """A sensor or an annotation without copies in its free fields."""
        extras = getattr(part, "extras", None)
        return replace(part, extras=self.fields(extras, location)) if extras else part

    def fields(self, fields: Mapping[str, Any], location: str) -> Mapping[str, Any]:
        """Give free fields without copies."""
        kept = self._without(fields, location)
        return fields if kept is fields else MappingProxyType(kept)

    def _without(self, value: Any, location: str) -> Any:
        """The value without what is an image in it; itself where nothing is."""
        if isinstance(value, Mapping):
            pairs = {key: self._without(one, f"{location}.{key}") for key, one in value.items()}
            changed = any(pairs[key] is not value[key] for key in value)
            return {key: one for key, one in pairs.items() if one is not _GONE} if changed else value
        if isinstance(value, list | tuple):
            items = [self._without(one, f"{location}[{k}]") for k, one in enumerate(value)]
            changed = any(new is not old for new, old in zip(items, value, strict=True))
            return [one for one in items if one is not _GONE] if changed else value
        if looks_like_image(value):
            self.locations.append(location)
            return _GONE
        return value


_GONE = object()


def looks_like_image(value: Any) -> bool:
    """Whether a value holds the bytes of an image or a video, plain or as text."""
    if isinstance(value, str):
        return len(value) >= _LEAST_BYTES and _AS_TEXT.match(value) is not None
    if isinstance(value, np.ndarray):
        if value.dtype != np.uint8 or value.ndim != 1:
            return value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] in {1, 3, 4}
        value = value[:_LEAST_BYTES].tobytes()
    if not isinstance(value, bytes | bytearray | memoryview):
        return False
    start = bytes(value[:_LEAST_BYTES])
    others = start[4:8] == b"ftyp" or (start[:4] == b"RIFF" and start[8:12] in {b"WEBP", b"AVI "})
    return len(start) >= _LEAST_BYTES and (start.startswith(_STARTS) or others)


def images_without_embedded(camera: CameraSensor) -> CameraSensor:
    """Give a camera whose images have no copies in their free fields, read when they are."""
    images = camera.images
    return replace(camera, images=LazyFrames(images.timestamps_ns, _Cleaned(images)))


@dataclass(frozen=True, slots=True, eq=False)
class _Cleaned:
    images: LazyFrames[CameraImage]

    def __call__(self, k: int) -> CameraImage:
        image = self.images[k]
        kept = EmbeddedImages().fields(image.extras, "images[]")
        return image if kept is image.extras else replace(image, extras=kept)
