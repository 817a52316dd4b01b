"""The files of single images: those in which something is hidden made anew, the others without what they state."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.encoded_images import encode_png
from sceneloom.formats.image_metadata import PNG_START, without_metadata
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Key, key_of

PixelsByImage = Mapping[int, Int64Array]
"""What is hidden in each image: (K, 4) left, top, right, bottom [px]."""


def with_hidden_files(scene: Scene, hidden: Scene, pixels: Mapping[Key, PixelsByImage]) -> Scene:
    """Give a scene with hidden locations the files of its images again.

    Args:
        scene: before anything was hidden.
        hidden: afterwards.
        pixels: what was hidden, by camera.
    """
    before = {key_of(camera.id): camera for camera in scene.cameras}
    sensors: list[Any] = [
        replace(
            sensor,
            images=LazyFrames(
                sensor.images.timestamps_ns,
                _WithFiles(before[key_of(sensor.id)].images, sensor.images, pixels[key_of(sensor.id)]),
            ),
        )
        if isinstance(sensor, CameraSensor)
        else sensor
        for sensor in hidden.sensors
    ]
    return replace(hidden, sensors=tuple(sensors))


@dataclass(frozen=True, slots=True, eq=False)
class _WithFiles:
    """Reads images; what `LazyFrames` asks for."""

    before: LazyFrames[CameraImage]
    after: LazyFrames[CameraImage]
    pixels: PixelsByImage

    def __call__(self, k: int) -> CameraImage:
        old, image = self.before[k], self.after[k]
        if old.encoded is None:
            return image
        if k not in self.pixels:
            return replace(image, encoded=_Bare(old))
        # a JPEG is made by the writer, which says so; PNG files stay what they are
        is_png = old.encoded().startswith(PNG_START)
        return replace(image, encoded=_AsPng(image)) if is_png else image


@dataclass(frozen=True, slots=True, eq=False)
class _AsPng:
    image: CameraImage

    def __call__(self) -> bytes:
        return encode_png(self.image.rgb)


@dataclass(frozen=True, slots=True, eq=False)
class _Bare:
    """Gives an image's file without what it says besides the image."""

    image: CameraImage

    def __call__(self) -> bytes:
        content = b"" if self.image.encoded is None else self.image.encoded()
        try:
            return without_metadata(content)[0]
        except DataError:
            # a file that cannot be taken apart is made anew from its pixels
            return encode_png(self.image.rgb)
