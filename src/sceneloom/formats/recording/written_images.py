"""Where a camera's images go: into a video, a folder of PNG images, or nowhere where its video is copied."""

import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from sceneloom.arrays import Int64Array, UInt8Array, UInt16Array, check_array
from sceneloom.errors import SceneloomError
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.written_depth import DepthImages, DepthScales
from sceneloom.formats.recording.written_shots import frame_rate
from sceneloom.formats.video.codecs import is_lossless
from sceneloom.formats.video.png_folder import image_name
from sceneloom.formats.video.reader import VideoReader
from sceneloom.formats.video.remux import copy_to_matroska
from sceneloom.formats.video.writer import VideoWriter
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.shooting import ShootingSensor, Shot, shots_of

IMAGES = ("copy", "lossless", "h264", "ffv1", "png")
"""Ways to keep images."""

_ENCODED_AS = {"copy": "h264", "lossless": "ffv1"}
"""Codecs for videos that should have been copied and cannot be."""

_SPELT = {"h264": "H.264", "ffv1": "FFV1, which loses nothing"}

_PNG_EFFORT = 1
"""Images of scenes shrink little more with more effort, at many times the time."""

_EBML = b"\x1a\x45\xdf\xa3"
"""How a Matroska file begins. Source: RFC 8794, section 11.2.1."""
_COPIED_AT_ONCE = 1 << 20


class ImageSink(Protocol):
    """Takes the images of one camera, one per `frames` line."""

    width: int
    height: int
    losses: list[Loss]

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Give what the entry of an image has to report it that it can be read."""
        ...

    def add(self, shot: Shot | None, timestamp_ns: int) -> None:
        """Take an image; None for a line in which the camera has none."""
        ...

    def close(self) -> None:
        """Finish."""
        ...

    def abandon(self) -> None:
        """Let go of what is not finished."""
        ...


class CopiedVideo:
    """The camera's own video, copied as it is or packet by packet, before the first line is written."""

    def __init__(self, sensor: ShootingSensor) -> None:
        self.width, self.height = sensor.camera.width, sensor.camera.height
        self.losses: list[Loss] = []
        self._scales = DepthScales(sensor) if isinstance(sensor, DepthCameraSensor) else None

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Name the kind of a depth image, and the length of its steps."""
        return {} if self._scales is None else self._scales.fields(shot)

    def add(self, shot: Shot | None, timestamp_ns: int) -> None:
        """Take nothing: the image is there already."""

    def close(self) -> None:
        """Do nothing."""

    def abandon(self) -> None:
        """Do nothing."""


class Images(Protocol):
    """Makes the images of one camera as a video takes them.

    Attributes:
        codec: of the video, as `VideoWriter` calls it.
        width, height: of the video [px].
        blank: (height, width, 3) or (height, width), what a line before the first image gets.
        losses: what the video cannot hold, added to as images are made.
    """

    codec: str
    width: int
    height: int
    blank: UInt8Array | UInt16Array
    losses: list[Loss]

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Give what the entry of an image has to report it that it can be read."""
        ...

    def image(self, shot: Shot) -> UInt8Array | UInt16Array | None:
        """Give what is encoded, of the shape of `blank`; None of what is none of this camera's."""
        ...


class ColorImages:
    """The images of a camera; those of an odd size lose their last line or column in H.264."""

    def __init__(self, sensor: CameraSensor, codec: str) -> None:
        """Begin; no image is read."""
        camera, self.codec = sensor.camera, codec
        lossy = codec == "h264"
        cut = 2 if lossy else 1
        self.width, self.height = camera.width - camera.width % cut, camera.height - camera.height % cut
        self.blank: UInt8Array | UInt16Array = np.broadcast_to(np.uint8(0), (self.height, self.width, 3))
        self.losses = _encoding_losses(sensor, (self.width, self.height)) if lossy else []
        self._full = (camera.height, camera.width, 3)

    def fields(self, shot: Shot) -> dict[str, Any]:  # noqa: ARG002 - a video says what it is
        """Give nothing."""
        return {}

    def image(self, shot: Shot) -> UInt8Array | None:
        """Give an image, (height, width, 3), cut to the size of the video; None of what is no image."""
        if not isinstance(shot, CameraImage):
            return None
        rgb = shot.rgb
        check_array(_of_one_size(shot), rgb, self._full, np.uint8)
        return rgb[: self.height, : self.width]


def _of_one_size(image: CameraImage) -> str:
    """What a message calls an image of another size."""
    return f"the image at {image.timestamp_ns} ns (a recording's camera has images of one size)"


class EncodedVideo:
    """Images encoded anew; a line without one gets the image before."""

    def __init__(self, images: Images, path: Path, fps: float) -> None:
        """Start the file."""
        self.width, self.height, self.losses = images.width, images.height, images.losses
        self.fields = images.fields
        self._images, self._last = images, images.blank
        self._last_ns: int | None = None
        self._writer = VideoWriter(path, self.width, self.height, fps, codec=images.codec)

    def add(self, shot: Shot | None, timestamp_ns: int) -> None:
        """Encode an image."""
        image = None if shot is None else self._images.image(shot)
        self._last = self._last if image is None else image
        # the time of a line without an image can be before that of an image whose entry has a time of its own
        self._last_ns = timestamp_ns if self._last_ns is None else max(timestamp_ns, self._last_ns)
        self._writer.add(self._last, self._last_ns / 1e9)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()

    def abandon(self) -> None:
        """Close the file."""
        with suppress(SceneloomError):
            self._writer.close()


class PngImages:
    """Images as numbered PNG files; a line without one gets the image before."""

    def __init__(self, sensor: CameraSensor, folder: Path) -> None:
        """Make the folder."""
        self.width, self.height = sensor.camera.width, sensor.camera.height
        rate = Loss(field=f"sensors[{sensor.id}].fps", what="left out: files have no rate")
        self.losses: list[Loss] = [rate] if sensor.fps else []
        folder.mkdir()
        self._folder = folder
        self._count = 0
        self._last: UInt8Array = np.broadcast_to(np.uint8(0), (self.height, self.width, 3))

    def fields(self, shot: Shot) -> dict[str, Any]:  # noqa: ARG002 - an image says what it is
        """Give nothing."""
        return {}

    def add(self, shot: Shot | None, timestamp_ns: int) -> None:  # noqa: ARG002 - the files have no times
        """Write an image."""
        if isinstance(shot, CameraImage):
            rgb = shot.rgb
            check_array(_of_one_size(shot), rgb, (self.height, self.width, 3), np.uint8)
            self._last = rgb
        image = Image.fromarray(np.ascontiguousarray(self._last))
        image.save(self._folder / image_name(self._count), compress_level=_PNG_EFFORT)
        self._count += 1

    def close(self) -> None:
        """Do nothing: every file is whole."""

    def abandon(self) -> None:
        """Do nothing."""


def open_sink(
    sensor: ShootingSensor, folder: Path, index: int, rows: Int64Array, *, images: str
) -> ImageSink:
    """Choose how a camera's images are kept, and start.

    Args:
        sensor: the camera.
        folder: the recording that is being written.
        index: `cameraInd`.
        rows: (N,) int64, which of its images each line has, -1 for none.
        images: "copy": the camera's own video where it can be copied, else H.264, or FFV1 where that video has lost
            nothing; "lossless": the same, else FFV1;
            "h264" and "ffv1": the own video only if it is that already; "png": PNG images. Depth is kept as its own
            video, or as FFV1, in any case.
    """
    path = folder / f"data{index + 1 if index else ''}.mkv"
    if isinstance(sensor, DepthCameraSensor):
        copied = _copied(sensor, path, rows, codecs=("ffv1",)) and _all_stepped(sensor)
        return CopiedVideo(sensor) if copied else EncodedVideo(DepthImages(sensor), path, frame_rate(sensor))
    if images == "png":
        return PngImages(sensor, folder / f"frames{index + 1}")
    if _copied(sensor, path, rows, codecs=None if images in _ENCODED_AS else (images,)):
        return CopiedVideo(sensor)
    codec = _ENCODED_AS.get(images, images)
    if images == "copy" and sensor.video is not None and is_lossless(sensor.video.codec):
        codec = "ffv1"
    encoded = EncodedVideo(ColorImages(sensor, codec), path, frame_rate(sensor))
    if sensor.video is not None and images in {*_ENCODED_AS, sensor.video.codec}:
        what = f"encoded anew as {_SPELT[codec]}: the video could not be copied for these images alone"
        field = f"sensors[{sensor.id}].video"
        encoded.losses.append(Loss(field=field, what=what, support=Support.APPROXIMATED))
    return encoded


def _encoding_losses(sensor: CameraSensor, size: tuple[int, int]) -> list[Loss]:
    field, count, camera = f"sensors[{sensor.id}].images[].rgb", len(sensor.images), sensor.camera
    what = "encoded as H.264, which changes colours a little"
    losses = [Loss(field=field, what=what, count=count, support=Support.APPROXIMATED)]
    if size != (camera.width, camera.height):
        what = f"cut from {camera.width}x{camera.height} to {size[0]}x{size[1]}: H.264 needs even sizes"
        losses.append(Loss(field=field, what=what, count=count))
    return losses


def _copied(sensor: ShootingSensor, path: Path, rows: Int64Array, *, codecs: tuple[str, ...] | None) -> bool:
    """Copy the camera's own video, cut to the images of the lines, where that needs no decoding."""
    video, count = sensor.video, len(shots_of(sensor))
    if video is None or (codecs is not None and video.codec not in codecs) or count == 0:
        return False
    whole = video.frame_indices is None
    indices = np.arange(count) if video.frame_indices is None else np.asarray(video.frame_indices, np.int64)
    taken = _images_of_lines(indices, rows)
    if taken is None:
        return False
    name = f"video of {sensor.id}"
    if whole and len(taken) == count and _is_matroska(video, count, name):
        with video.open() as source, path.open("wb") as target:
            shutil.copyfileobj(source, target, _COPIED_AT_ONCE)
        return True
    images = count if whole else None
    return copy_to_matroska(video.open, path, images=images, frame_indices=taken, name=name) is not None


def _images_of_lines(indices: Int64Array, rows: Int64Array) -> Int64Array | None:
    """Choose an image of the video for each line.

    Args:
        indices: (N,) the image in the video of each of the camera's images.
        rows: (L,) which of the camera's images each line has, -1 for none; such a line takes one of those between
            its neighbours', which nobody looks at, since there has to be one for each line.

    Returns:
        (L,) int64, ascending; None where the video has none for a line.
    """
    known = np.flatnonzero(rows >= 0)
    if len(known) == 0:
        return None
    chosen = indices[rows[known]]
    if (np.diff(chosen) < np.diff(known)).any() or chosen[0] < known[0]:
        return None
    lines = np.arange(len(rows))
    before = np.maximum(np.searchsorted(known, lines, side="right") - 1, 0)
    taken: Int64Array = chosen[before] + lines - known[before]
    return taken


def _is_matroska(video: VideoContent, count: int, name: str) -> bool:
    """Whether a video is as we would write it, so that its file can be copied byte by byte."""
    with video.open() as file:
        if file.read(len(_EBML)) != _EBML:
            return False
    with VideoReader(video.open, name=name) as reader:
        return reader.index.timed and reader.index.hidden == 0 and reader.count == count


def _all_stepped(sensor: DepthCameraSensor) -> bool:
    """Whether the source says of each image how long its steps are."""
    return all(frame.scale is not None for frame in sensor.frames)
