"""Images, depth images and camera models as messages: videos packet by packet, files as they are, the rest encoded."""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.formats.topics.camera_models import camera_model_record
from sceneloom.formats.topics.dialect import Losses
from sceneloom.formats.topics.pixels import MILLIMETRE
from sceneloom.formats.topics.records import CompressedImageRecord, ImageRecord
from sceneloom.formats.topics.streams import Stated
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.depth import DepthCameraSensor

IMAGES = ("copy", "jpeg", "png", "raw")
"""How images are written: files and videos as they are and the rest as JPEG; or all in one form."""

JPEG_QUALITY = 95

_JPEG_START = b"\xff\xd8\xff"
_MOST_STEPS = 65535


def check_images(images: str) -> None:
    """Refuse a way of writing images that does not exist.

    Raises:
        OptionError: it does not.
    """
    if images not in IMAGES:
        raise OptionError(f"images {images!r}; expected one of {', '.join(IMAGES)}")


@dataclass(slots=True)
class ShotWriter:
    """Makes the records of a camera.

    Attributes:
        topic: of its images.
        camera_model_topic: of its camera model.
        frame_id: of the camera.
        field: what the model calls its images, for losses.
        losses: takes what is lost.
        fisheye: the name of OpenCV's fisheye camera model.
        images: one of `IMAGES`.
        packets: of its video, where that is handed on.
        codec: of the video.
        camera_model: that was stated last.
        each_camera_model: whether each image says its camera model, and not only those whose camera model is another
            than before.
    """

    topic: str
    camera_model_topic: str
    frame_id: str
    field: str
    losses: Losses
    fisheye: str
    images: str = "copy"
    packets: Iterator[bytes] | None = None
    codec: str = ""
    camera_model: Camera | None = None
    each_camera_model: bool = False

    def image(self, sensor: CameraSensor, k: int) -> Iterator[Stated]:
        """Make the records of image `k`."""
        image = sensor.images[k]
        yield from self._camera_model(image.camera, image.timestamp_ns)
        self._note_shot(image)
        encoded = None
        if image.encoded is not None and self.images == "copy":
            encoded = image.encoded()
        if encoded is not None and encoded.startswith(_JPEG_START):
            yield self.topic, self._file(image.timestamp_ns, "jpeg", encoded)
        elif self.images == "raw":
            yield self.topic, self._raw(image.timestamp_ns, "rgb8", image.rgb, image.rgb.shape[1] * 3)
        elif self.images == "png":
            yield self.topic, self._file(image.timestamp_ns, "png", _png(image.rgb))
        else:
            what = f"encoded as JPEG of quality {JPEG_QUALITY}"
            self.losses.approximated(f"{self.field}.rgb", what)
            yield self.topic, self._file(image.timestamp_ns, "jpeg", _jpeg(image.rgb))

    def packet(self, sensor: CameraSensor, k: int) -> Iterator[Stated]:
        """Make the record of the next packet of the video, which shows image `k`."""
        image = sensor.images[k]
        yield from self._camera_model(image.camera, image.timestamp_ns)
        self._note_shot(image)
        if self.packets is not None:
            content = next(self.packets)
            form = {"hevc": "h265"}.get(self.codec, self.codec)
            yield self.topic, self._file(image.timestamp_ns, form, content)

    def depth(self, sensor: DepthCameraSensor, k: int) -> Iterator[Stated]:
        """Make the records of depth image `k`: whole millimetres where the source has these, else floats."""
        frame = sensor.frames[k]
        yield from self._camera_model(frame.camera, frame.timestamp_ns)
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

    def _camera_model(self, camera: Camera, timestamp_ns: int) -> Iterator[Stated]:
        """Report the camera model where it is another one than before."""
        if self.each_camera_model or camera != self.camera_model:
            self.camera_model = camera
            yield (
                self.camera_model_topic,
                camera_model_record(camera, timestamp_ns, self.frame_id, self.fisheye),
            )

    def _note_shot(self, shot: Any) -> None:
        self.losses.dropped(f"{self.field}.extras", "further fields of an image", count=bool(shot.extras))

    def _file(self, timestamp_ns: int, form: str, content: bytes) -> CompressedImageRecord:
        return CompressedImageRecord(timestamp_ns, self.frame_id, form, memoryview(content))

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
