"""Where a camera's pictures go: into a video, a folder of PNG pictures, or nowhere where its video is copied."""

from contextlib import suppress
from pathlib import Path
from typing import Protocol

import numpy as np
from PIL import Image

from sceneloom.arrays import Int64Array, UInt8Array, check_array
from sceneloom.errors import SceneloomError
from sceneloom.formats.loss import Loss
from sceneloom.formats.video import VideoWriter, copy_to_matroska
from sceneloom.formats.video.png_folder import picture_name
from sceneloom.scene import CameraSensor, Picture

_PNG_EFFORT = 1
"""Pictures of scenes shrink little more with more effort, at many times the time."""
_DEFAULT_FPS = 10.0


class PictureSink(Protocol):
    """Takes the pictures of one camera, one per `frames` line."""

    width: int
    height: int
    losses: list[Loss]

    def add(self, picture: Picture | None, timestamp_ns: int) -> None:
        """Take a picture; None for a line in which the camera has none."""
        ...

    def close(self) -> None:
        """Finish."""
        ...

    def abandon(self) -> None:
        """Let go of what is not finished."""
        ...


class CopiedVideo:
    """The camera's own video, copied packet by packet before the first line is written."""

    def __init__(self, sensor: CameraSensor) -> None:
        self.width, self.height = sensor.camera.width, sensor.camera.height
        self.losses: list[Loss] = []

    def add(self, picture: Picture | None, timestamp_ns: int) -> None:
        """Take nothing: the picture is there already."""

    def close(self) -> None:
        """Do nothing."""

    def abandon(self) -> None:
        """Do nothing."""


class EncodedVideo:
    """Pictures encoded as H.264; a line without one gets the picture before, an odd size loses its last line."""

    def __init__(self, sensor: CameraSensor, path: Path) -> None:
        """Start the file."""
        camera = sensor.camera
        self.width, self.height = camera.width - camera.width % 2, camera.height - camera.height % 2
        field = f"sensors[{sensor.id}].pictures"
        encoded = Loss(
            field=field, what="encoded as H.264, which changes colours a little", count=len(sensor.pictures)
        )
        self.losses = [encoded]
        if (self.width, self.height) != (camera.width, camera.height):
            what = f"cut from {camera.width}x{camera.height} to {self.width}x{self.height}: H.264 needs even sizes"
            self.losses.append(Loss(field=field, what=what, count=len(sensor.pictures)))
        self._full = (camera.height, camera.width, 3)
        self._writer = VideoWriter(path, self.width, self.height, _rate(sensor))
        self._last: UInt8Array = np.zeros((self.height, self.width, 3), np.uint8)
        self._last_seconds = -np.inf

    def add(self, picture: Picture | None, timestamp_ns: int) -> None:
        """Encode a picture."""
        if picture is not None:
            rgb = picture.rgb
            check_array("picture", rgb, self._full, np.uint8)
            self._last = rgb[: self.height, : self.width]
        # pictures of one time keep their order
        seconds = max(timestamp_ns / 1e9, np.nextafter(self._last_seconds, np.inf))
        self._writer.add(self._last, seconds)
        self._last_seconds = seconds

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()

    def abandon(self) -> None:
        """Close the file."""
        with suppress(SceneloomError):
            self._writer.close()


class PngPictures:
    """Pictures as numbered PNG files; a line without one gets the picture before."""

    def __init__(self, sensor: CameraSensor, folder: Path) -> None:
        """Make the folder."""
        self.width, self.height = sensor.camera.width, sensor.camera.height
        self.losses: list[Loss] = []
        folder.mkdir()
        self._folder = folder
        self._count = 0
        self._last: UInt8Array = np.zeros((self.height, self.width, 3), np.uint8)

    def add(self, picture: Picture | None, timestamp_ns: int) -> None:  # noqa: ARG002 - the files have no times
        """Write a picture."""
        if picture is not None:
            rgb = picture.rgb
            check_array("picture", rgb, (self.height, self.width, 3), np.uint8)
            self._last = rgb
        image = Image.fromarray(np.ascontiguousarray(self._last))
        image.save(self._folder / picture_name(self._count), compress_level=_PNG_EFFORT)
        self._count += 1

    def close(self) -> None:
        """Do nothing: every file is whole."""

    def abandon(self) -> None:
        """Do nothing."""


def open_sink(
    sensor: CameraSensor, folder: Path, index: int, rows: Int64Array, *, pictures: str
) -> PictureSink:
    """Choose how a camera's pictures are kept, and start.

    Args:
        sensor: the camera.
        folder: the recording that is being written.
        index: `cameraInd`.
        rows: (N,) int64, which of its pictures each line has, -1 for none.
        pictures: "copy": the camera's own video where it can be copied, else H.264; "h264": the own video only if it
            is H.264; "png": PNG pictures.
    """
    if pictures == "png":
        return PngPictures(sensor, folder / f"frames{index + 1}")
    path = folder / f"data{index + 1 if index else ''}.mkv"
    if _copied(sensor, path, rows, pictures=pictures):
        return CopiedVideo(sensor)
    return EncodedVideo(sensor, path)


def _copied(sensor: CameraSensor, path: Path, rows: Int64Array, *, pictures: str) -> bool:
    video, count = sensor.video, len(sensor.pictures)
    if video is None or (pictures == "h264" and video.codec != "h264"):
        return False
    in_step = np.array_equal(rows, np.arange(count))
    if not in_step or (video.frame_indices is not None and video.frame_indices != tuple(range(count))):
        return False
    return copy_to_matroska(video.open, path, pictures=count, name=f"video of {sensor.id}") is not None


def _rate(sensor: CameraSensor) -> float:
    stamps = sensor.pictures.timestamps_ns
    if sensor.fps:
        return sensor.fps
    span = float(stamps[-1] - stamps[0]) * 1e-9 if len(stamps) > 1 else 0.0
    return (len(stamps) - 1) / span if span > 0 else _DEFAULT_FPS
