"""The images of a camera: out of a video, or out of JPEG files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.files import check_pixels
from sceneloom.formats.sfs.container import Container, format_keys
from sceneloom.formats.sfs.mapped_file import MappedContent
from sceneloom.formats.sfs.mp4 import is_mp4, video_codec
from sceneloom.formats.sfs.records import Location
from sceneloom.formats.sfs.remote import RemoteContent
from sceneloom.formats.sfs.source import Source
from sceneloom.scene.cameras import CameraImage, VideoContent
from sceneloom.scene.types import NO_FIELDS

if TYPE_CHECKING:
    from sceneloom.formats.video.index import VideoIndex
    from sceneloom.formats.video.reader import VideoReader


@dataclass(frozen=True, slots=True, eq=False)
class ImageContent:
    """Where a camera's images come from.

    Attributes:
        starts_ns: (N,) int64 [ns], start of each image.
        read: makes image `k`, taken by the given camera model, its time still that of its start.
        video: the encoded video, where there is one.
        fps: nominal images a second.
        further: fields that have no other location in the model.
        own_fields: further fields of each image; empty where no image has any.
    """

    starts_ns: Int64Array
    read: Callable[[int, Camera], CameraImage]
    video: VideoContent | None = None
    fps: float | None = None
    further: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    own_fields: tuple[Mapping[str, Any], ...] = ()


def _no_image(index: int, _: Camera) -> CameraImage:
    raise IndexError(index)


def no_content() -> ImageContent:
    """A camera without images."""
    return ImageContent(np.zeros(0, np.int64), _no_image)


def video_content(
    source: Source, video: Mapping[str, Any], starts_ns: Int64Array, location: Location
) -> ImageContent:
    """Give the images of a `video` record; the video is opened when its first image is asked for."""
    content: AnyArray = video["content"]
    where = format_keys((*location, "content"))
    coded = source.container.bytes_of(content)
    player = _Player(source.container, coded, where)
    source.parts.videos[where] = player
    rgb, open_file = source.parts.keep(where, player.rgb), source.parts.keep(f"{where}: file", player.open)
    starts = starts_ns.tolist()

    def read(index: int, camera: Camera) -> CameraImage:
        size = player.size()
        camera_model = camera if size == (camera.width, camera.height) else camera.resized(*size)
        return CameraImage(starts[index], camera_model, partial(rgb, index))

    further = {name: value for name, value in video.items() if name not in {"timestamps", "content", "fps"}}
    return ImageContent(
        starts_ns,
        read,
        VideoContent(open_file, video_codec(coded)),
        None if video.get("fps") is None else float(video["fps"]),
        {"video": further} if further else NO_FIELDS,
    )


def image_content(source: Source, images: list[Mapping[str, Any]], location: Location) -> ImageContent:
    """Give the images of an `images` list."""
    container = source.container
    rgb = source.parts.keep(format_keys(location), partial(_decode_image, container, images, location))
    own = tuple({k: v for k, v in image.items() if k not in {"timestamp", "content"}} for image in images)

    def read(index: int, camera: Camera) -> CameraImage:
        container.check_open(format_keys((*location, index, "content")))
        content: AnyArray = container.fetch(images[index]["content"])
        return CameraImage(
            images[index]["timestamp"],
            _camera_model_for(content, camera),
            partial(rgb, index),
            extras=own[index],
            encoded=content.tobytes,
        )

    starts_ns = np.array([image["timestamp"] for image in images], np.int64)
    return ImageContent(starts_ns, read, own_fields=own)


def _camera_model_for(content: AnyArray, camera: Camera) -> Camera:
    """Fit the camera model to the size that an image's head reports; one without a head may still be copied."""
    from simplejpeg import decode_jpeg_header

    try:
        height, width = decode_jpeg_header(content.data)[:2]
    except (ValueError, RuntimeError):
        return camera
    return camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)


def _decode_image(
    container: Container, images: list[Mapping[str, Any]], location: Location, index: int
) -> UInt8Array:
    where = format_keys((*location, index, "content"))
    container.check_open(where)
    return _decode_jpeg(container, container.fetch(images[index]["content"]), where)


def _decode_jpeg(container: Container, content: AnyArray, location: str) -> UInt8Array:
    from simplejpeg import decode_jpeg, decode_jpeg_header

    try:
        height, width = decode_jpeg_header(content.data)[:2]
        check_pixels(container.file, location, width, height)
        return cast("UInt8Array", decode_jpeg(content.data, "RGB"))
    except (ValueError, RuntimeError, MemoryError) as error:
        raise DataError(container.file, location, f"cannot be decoded as JPEG: {error}") from None


class _Player:
    """Opens a video at its first use and keeps it open.

    It has no lock, which a fork could leave locked for good: two threads may both open the video, and one wins.

    Attributes:
        index: the list of its images, None until it is known.
    """

    def __init__(self, container: Container, content: MappedContent | RemoteContent, location: str) -> None:
        self._container, self._content, self._location = container, content, location
        self._reader: VideoReader | None = None
        self.index: VideoIndex | None = None
        container.on_close(self._close)

    def open(self) -> Any:
        """Open the video's bytes as a file."""
        from sceneloom.formats.video.source import open_bytes

        self._container.check_open(self._location)
        return open_bytes(self._content)

    def size(self) -> tuple[int, int]:
        """Width and height of its images [px]."""
        reader = self._opened()
        check_pixels(self._container.file, self._location, reader.width, reader.height)
        return reader.width, reader.height

    def rgb(self, index: int) -> UInt8Array:
        """Decode one image."""
        reader = self._opened()
        if self.index is None:
            self.index = reader.index
        return reader.rgb(index)

    def _opened(self) -> "VideoReader":
        from sceneloom.formats.video.reader import VideoReader
        from sceneloom.formats.video.table_index import read_table_index

        self._container.check_open(self._location)
        reader = self._reader
        if reader is None:
            name = f"{self._container.file}: {self._location}"
            if self.index is None and isinstance(self._content, RemoteContent) and is_mp4(self._content):
                self.index = read_table_index(self._content, name)
            reader = self._reader = VideoReader(self._content, name=name, index=self.index)
        return reader

    def _close(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()
