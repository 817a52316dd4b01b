"""The videos of cameras in whose pictures places are hidden: written anew, as much of them copied as can be."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.editing.hiding import filled
from sceneloom.editing.record import with_notices
from sceneloom.errors import OptionError
from sceneloom.formats.video.replacing import ReplacedPictures, replace_pictures
from sceneloom.pipeline.sharing.hidden_pictures import PixelsByPicture
from sceneloom.scene import CameraSensor, Notice, NoticeKind, Scene, VideoContent
from sceneloom.scene.types import Key, key_of

_EBML = b"\x1a\x45\xdf\xa3"
"""How a Matroska file begins. Source: RFC 8794, section 11.2.1."""


@dataclass(frozen=True, slots=True)
class _HidingChange:
    """Hides places in the pictures of a video."""

    pixels: PixelsByPicture
    fill: str

    def __call__(self, number: int, image: UInt8Array, *, halved: bool, black: int) -> UInt8Array:
        boxes = self.pixels[number]
        return filled(image, boxes // 2 if halved else boxes, fill=self.fill, black=black)


@dataclass(slots=True, eq=False)
class HiddenVideos:
    """Writes videos into a folder, where they have to stay until the scene is written.

    Attributes:
        folder: where.
        fill: what takes the place of what was there.
        written: what was done, by camera.
    """

    folder: Path
    fill: str
    written: dict[Key, ReplacedPictures] = field(default_factory=dict)
    notices: list[Notice] = field(default_factory=list)

    def scene(self, scene: Scene, hidden: Scene, pixels: Mapping[Key, PixelsByPicture]) -> Scene:
        """Give a scene with hidden places its videos again, the places hidden in them too.

        Args:
            scene: before anything was hidden, with its videos.
            hidden: afterwards.
            pixels: what was hidden, by camera.

        Raises:
            DataError: a video is damaged.
            OutputError: the folder cannot be written.
        """
        videos = {key_of(camera.id): camera for camera in scene.cameras if camera.video is not None}
        sensors: list[Any] = [
            replace(sensor, video=self._video(videos[key_of(sensor.id)], pixels[key_of(sensor.id)]))
            if isinstance(sensor, CameraSensor) and key_of(sensor.id) in videos
            else sensor
            for sensor in hidden.sensors
        ]
        return with_notices(replace(hidden, sensors=tuple(sensors)), self.notices)

    def _video(self, camera: CameraSensor, pixels: PixelsByPicture) -> VideoContent | None:
        """The video anew; None where its pictures have to go one by one."""
        video, place = camera.video, f"sensors[{camera.id}].video"
        if video is None or not len(camera.pictures):
            return video
        taken = None if video.frame_indices is None else np.asarray(video.frame_indices, np.int64)
        numbers = np.arange(len(camera.pictures)) if taken is None else taken
        in_video = {int(numbers[k]): boxes for k, boxes in pixels.items()}
        touched = np.zeros(_length(camera, numbers), np.bool_)
        touched[list(in_video)] = True
        target = self.folder / f"video{len(self.written)}{_suffix(video)}"
        change = _HidingChange(in_video, self.fill)
        try:
            done = replace_pictures(video.open, target, change, touched, taken=taken, name=place)
        except OptionError:
            # an odd size cannot be encoded as H.264
            self._tell(place, "cannot be encoded in its odd size: its pictures go one by one")
            return None
        self.written[key_of(camera.id)] = done
        if done.reason is not None:
            self._tell(place, f"encoded anew as {done.codec}: {done.reason}", done.pictures)
        elif done.encoded:
            self._tell(place, "pictures encoded anew; the others are copied", done.encoded)
        return VideoContent(_Opened(target), done.codec)

    def _tell(self, place: str, message: str, count: int = 1) -> None:
        self.notices.append(
            Notice(kind=NoticeKind.REPAIRED, code="video-hidden", place=place, message=message, count=count)
        )


@dataclass(frozen=True, slots=True)
class _Opened:
    """Opens a video that was written."""

    path: Path

    def __call__(self) -> BinaryIO:
        return self.path.open("rb")


def _length(camera: CameraSensor, numbers: Int64Array) -> int:
    """How many pictures the video has."""
    from sceneloom.formats.video import VideoReader

    if camera.video is None or camera.video.frame_indices is None:
        return len(numbers)
    with VideoReader(camera.video.open, name=f"video of {camera.id}") as reader:
        return reader.count


def _suffix(video: VideoContent) -> str:
    with video.open() as file:
        return ".mkv" if file.read(len(_EBML)) == _EBML or video.codec == "ffv1" else ".mp4"
