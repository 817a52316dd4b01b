"""The files of single pictures: those in which something is hidden made anew, the others without what they say."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.encoded_pictures import encode_png
from sceneloom.formats.picture_metadata import PNG_START, without_metadata
from sceneloom.scene.cameras import CameraSensor, Picture
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Key, key_of

PixelsByPicture = Mapping[int, Int64Array]
"""What is hidden in each picture: (K, 4) left, top, right, bottom [px]."""


def with_hidden_files(scene: Scene, hidden: Scene, pixels: Mapping[Key, PixelsByPicture]) -> Scene:
    """Give a scene with hidden places the files of its pictures again.

    Args:
        scene: before anything was hidden.
        hidden: afterwards.
        pixels: what was hidden, by camera.
    """
    before = {key_of(camera.id): camera for camera in scene.cameras}
    sensors: list[Any] = [
        replace(
            sensor,
            pictures=LazyFrames(
                sensor.pictures.timestamps_ns,
                _WithFiles(before[key_of(sensor.id)].pictures, sensor.pictures, pixels[key_of(sensor.id)]),
            ),
        )
        if isinstance(sensor, CameraSensor)
        else sensor
        for sensor in hidden.sensors
    ]
    return replace(hidden, sensors=tuple(sensors))


@dataclass(frozen=True, slots=True, eq=False)
class _WithFiles:
    """Reads pictures; what `LazyFrames` asks for."""

    before: LazyFrames[Picture]
    after: LazyFrames[Picture]
    pixels: PixelsByPicture

    def __call__(self, k: int) -> Picture:
        old, picture = self.before[k], self.after[k]
        if old.encoded is None:
            return picture
        if k not in self.pixels:
            return replace(picture, encoded=_Bare(old))
        # a JPEG is made by the writer, which says so; PNG files stay what they are
        is_png = old.encoded().startswith(PNG_START)
        return replace(picture, encoded=_AsPng(picture)) if is_png else picture


@dataclass(frozen=True, slots=True, eq=False)
class _AsPng:
    picture: Picture

    def __call__(self) -> bytes:
        return encode_png(self.picture.rgb)


@dataclass(frozen=True, slots=True, eq=False)
class _Bare:
    """Gives a picture's file without what it says besides the picture."""

    picture: Picture

    def __call__(self) -> bytes:
        content = b"" if self.picture.encoded is None else self.picture.encoded()
        try:
            return without_metadata(content)[0]
        except DataError:
            # a file that cannot be taken apart is made anew from its pixels
            return encode_png(self.picture.rgb)
