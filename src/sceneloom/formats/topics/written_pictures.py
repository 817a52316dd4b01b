"""Pictures, depth images and lenses as messages: videos packet by packet, files as they are, the rest encoded."""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.formats.topics.dialect import Losses
from sceneloom.formats.topics.lenses import lens_record
from sceneloom.formats.topics.pixels import MILLIMETRE
from sceneloom.formats.topics.records import ImageRecord, PictureRecord
from sceneloom.formats.topics.streams import Said
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor

PICTURES = ("copy", "jpeg", "png", "raw")
"""How pictures are written: files and videos as they are and the rest as JPEG; or all in one form."""

JPEG_QUALITY = 95

_JPEG_START = b"\xff\xd8\xff"
_MOST_STEPS = 65535


def check_pictures(pictures: str) -> None:
    """Refuse a way of writing pictures that does not exist.

    Raises:
        OptionError: it does not.
    """
    if pictures not in PICTURES:
        raise OptionError(f"pictures {pictures!r}; expected one of {', '.join(PICTURES)}")


@dataclass(slots=True)
class ShotWriter:
    """Makes the records of a camera.

    Attributes:
        topic: of its pictures.
        lens_topic: of its lens.
        frame_id: of the camera.
        field: what the model calls its pictures, for losses.
        losses: takes what is lost.
        fisheye: the name of OpenCV's fisheye lens.
        pictures: one of `PICTURES`.
        packets: of its video, where that is handed on.
        codec: of the video.
        lens: that was said last.
        each_lens: whether each picture says its lens, and not only those whose lens is another than before.
    """

    topic: str
    lens_topic: str
    frame_id: str
    field: str
    losses: Losses
    fisheye: str
    pictures: str = "copy"
    packets: Iterator[bytes] | None = None
    codec: str = ""
    lens: Camera | None = None
    each_lens: bool = False

    def picture(self, sensor: CameraSensor, k: int) -> Iterator[Said]:
        """Make the records of picture `k`."""
        picture = sensor.pictures[k]
        yield from self._lens(picture.camera, picture.timestamp_ns)
        self._note_shot(picture)
        encoded = None
        if picture.encoded is not None and self.pictures == "copy":
            encoded = picture.encoded()
        if encoded is not None and encoded.startswith(_JPEG_START):
            yield self.topic, self._file(picture.timestamp_ns, "jpeg", encoded)
        elif self.pictures == "raw":
            yield self.topic, self._raw(picture.timestamp_ns, "rgb8", picture.rgb, picture.rgb.shape[1] * 3)
        elif self.pictures == "png":
            yield self.topic, self._file(picture.timestamp_ns, "png", _png(picture.rgb))
        else:
            what = f"encoded as JPEG of quality {JPEG_QUALITY}"
            self.losses.approximated(f"{self.field}.rgb", what)
            yield self.topic, self._file(picture.timestamp_ns, "jpeg", _jpeg(picture.rgb))

    def packet(self, sensor: CameraSensor, k: int) -> Iterator[Said]:
        """Make the record of the next packet of the video, which shows picture `k`."""
        picture = sensor.pictures[k]
        yield from self._lens(picture.camera, picture.timestamp_ns)
        self._note_shot(picture)
        if self.packets is not None:
            content = next(self.packets)
            form = {"hevc": "h265"}.get(self.codec, self.codec)
            yield self.topic, self._file(picture.timestamp_ns, form, content)

    def depth(self, sensor: DepthCameraSensor, k: int) -> Iterator[Said]:
        """Make the records of depth image `k`: whole millimetres where the source has these, else floats."""
        frame = sensor.frames[k]
        yield from self._lens(frame.camera, frame.timestamp_ns)
        self._note_shot(frame)
        depth = frame.depth
        steps = np.rint(depth.astype(np.float64) / MILLIMETRE)
        if frame.scale == MILLIMETRE and steps.max(initial=0) <= _MOST_STEPS:
            rows = np.ascontiguousarray(steps.astype("<u2"))
            yield self.topic, self._raw(frame.timestamp_ns, "16UC1", rows, depth.shape[1] * 2)
            return
        self.losses.dropped(
            f"{self.field}.scale", "steps of the source; depths are floats", count=frame.scale is not None
        )
        rows = np.ascontiguousarray(depth, "<f4")
        yield self.topic, self._raw(frame.timestamp_ns, "32FC1", rows, depth.shape[1] * 4)

    def _lens(self, camera: Camera, timestamp_ns: int) -> Iterator[Said]:
        """Say the lens where it is another one than before."""
        if self.each_lens or camera != self.lens:
            self.lens = camera
            yield self.lens_topic, lens_record(camera, timestamp_ns, self.frame_id, self.fisheye)

    def _note_shot(self, shot: Any) -> None:
        self.losses.dropped(f"{self.field}.extras", "further fields of a picture", count=bool(shot.extras))

    def _file(self, timestamp_ns: int, form: str, content: bytes) -> PictureRecord:
        return PictureRecord(timestamp_ns, self.frame_id, form, memoryview(content))

    def _raw(self, timestamp_ns: int, encoding: str, rows: Any, step: int) -> ImageRecord:
        height, width = rows.shape[:2]
        data = memoryview(np.ascontiguousarray(rows).view(np.uint8).reshape(-1))  # type: ignore[arg-type]
        return ImageRecord(timestamp_ns, self.frame_id, encoding, width, height, step, data)


def _jpeg(rgb: UInt8Array) -> bytes:
    from simplejpeg import encode_jpeg

    content: bytes = encode_jpeg(np.ascontiguousarray(rgb), JPEG_QUALITY, "RGB", "444")
    return content


def _png(rgb: UInt8Array) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "PNG", compress_level=1)
    return file.getvalue()
