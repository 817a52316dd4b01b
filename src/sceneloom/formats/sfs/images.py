"""The images of a camera: out of a video or out of JPEG files, with the metadata of single images.

And what is left of damaged videos.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.base.files import Bytes, check_pixels
from sceneloom.formats.sfs.arrays import ItemFault, MappedContent, step
from sceneloom.formats.sfs.container import Container, RemoteContent, format_keys
from sceneloom.formats.sfs.metadata import Source
from sceneloom.formats.sfs.records import FieldError, Location, mount_of, mount_rows
from sceneloom.formats.sfs.schema import Keys, keep_in_step
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.types import NO_FIELDS

if TYPE_CHECKING:
    from av.video.stream import VideoStream

    from sceneloom.formats.video.index import OpenVideo, VideoIndex
    from sceneloom.formats.video.reader import VideoReader

_CODECS: Mapping[bytes, str] = MappingProxyType(
    {
        b"avc1": "h264",
        b"avc3": "h264",
        b"hvc1": "hevc",
        b"hev1": "hevc",
        b"av01": "av1",
        b"vp09": "vp9",
        b"vp08": "vp8",
        b"mp4v": "mpeg4",
        b"jpeg": "mjpeg",
        b"mjpa": "mjpeg",
        b"FFV1": "ffv1",
        b"png ": "png",
    }
)
"""Sample entry of the video track, and what FFmpeg calls its codec. Source: the registry at mp4ra.org."""

_UNKNOWN_CODEC = "unknown"

_LONG_SIZE, _TO_THE_END = 1, 0

_MOST_BOXES = 10_000


def is_mp4(content: Bytes) -> bool:
    """Whether the bytes begin as an mp4 file does; QuickTime's own brand is another format."""
    return bytes(content[4:8]) == b"ftyp" and bytes(content[8:12]) != b"qt  "


def video_codec(content: Bytes) -> str:
    """Name the codec of the first known track, as FFmpeg calls it; "unknown" where none is found.

    Source: ISO/IEC 14496-12, 4.2 (boxes) and 8.5.2 (sample description).
    """
    movie = _box(content, b"moov")
    location = 0
    while (location := movie.find(b"stsd", location)) >= 0:
        entry = movie[location + 16 : location + 20]
        if entry in _CODECS:
            return _CODECS[entry]
        location += 4
    return _UNKNOWN_CODEC


def _box(content: Bytes, wanted: bytes) -> bytes:
    """Find a box of the outermost level and give what is in it; nothing where there is none."""
    location = 0
    for _ in range(_MOST_BOXES):
        size, name = (
            int.from_bytes(content[location : location + 4], "big"),
            bytes(content[location + 4 : location + 8]),
        )
        header = 8
        if size == _LONG_SIZE:
            size, header = int.from_bytes(content[location + 8 : location + 16], "big"), 16
        stop = len(content) if size == _TO_THE_END else location + size
        if name == wanted:
            return bytes(content[location + header : stop])
        if stop < location + header or stop >= len(content):
            break
        location = stop
    return b""


def declared_length(content: Any) -> int:
    """How long an mp4 video has to be by the sizes of its boxes [bytes].

    Args:
        content: its bytes, by slices.

    Source: ISO/IEC 14496-12, 4.2.
    """
    location, available = 0, len(content)
    while location + 8 <= available:
        head = bytes(content[location : location + 16])
        size = int.from_bytes(head[:4], "big")
        size = int.from_bytes(head[8:16], "big") if size == 1 else size
        if size < 8:  # up to the end, or no box
            return available
        location += size
    return max(location, available)


_EXPOSURE = "exposureTimeSeconds"
"""The field that says how long a image was exposed [s], on the camera or on a image."""

_LONGEST_EXPOSURE = 3600.0


def exposure_ns(fields: Mapping[str, Any], otherwise_ns: int) -> int:
    """How long a image was exposed [ns], as its fields state."""
    seconds = fields.get(_EXPOSURE)
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
    rgb = source.parts.keep(
        f"{format_keys(location)}: content", partial(_decode_image, container, images, location)
    )
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
        from sceneloom.formats.video.index import open_bytes

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
        from sceneloom.formats.video.index import read_table_index
        from sceneloom.formats.video.reader import VideoReader

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


@dataclass(frozen=True, slots=True)
class DamagedVideo:
    """A video that was cut, or cannot be read.

    Attributes:
        problem: what is wrong, and how many images are whole.
        lost_bytes: how many bytes are not there; 0 where that is not known.
        is_rescued: whether its first images are in the header in its location.
    """

    problem: str
    lost_bytes: int
    is_rescued: bool


def damaged_videos(container: Container) -> dict[Keys, tuple[Any, int, str]]:
    """Look at the tables of all videos of a file: which have bytes that end before their last image.

    Returns:
        Content, declared length and problem of each video that is cut or no video, by the position of its content.
    """
    found: dict[Keys, tuple[Any, int, str]] = {}
    sensors = container.header.get("sensors")
    for number, sensor in enumerate(sensors if isinstance(sensors, list) else []):
        video = sensor.get("video") if isinstance(sensor, dict) else None
        content = video.get("content") if isinstance(video, dict) else None
        if isinstance(content, np.ndarray) and content.dtype == np.uint8 and content.size:
            there = np.ascontiguousarray(content).reshape(-1).data.cast("B")
            length = declared_length(there) if is_mp4(there) else len(there)
            problem = _cut(there, length) if length > len(there) else _problem_of_tables(there)
            if problem is not None:
                found["sensors", number, "video", "content"] = there, length, problem
    return found


def _cut(there: memoryview, length: int) -> str:
    return f"{len(there)} bytes of a video of {length}: it was cut"


def _problem_of_tables(there: memoryview) -> str | None:
    from sceneloom.formats.video.index import read_index, read_table_index

    try:
        index = read_table_index(there, "video") if is_mp4(there) else read_index(there, "video")
    except DataError as error:
        return error.problem
    return None if len(index) else "a video without images"


def rescue_videos(container: Container, items: Sequence[ItemFault]) -> dict[Keys, DamagedVideo]:
    """Put what is left of videos that were cut into their locations of the header.

    Args:
        container: the file, on disk; its header is changed.
        items: what is wrong with its arrays.

    Returns:
        The videos that are damaged, by the position of their content; those that nothing is left of stay as they are.
    """
    damaged = damaged_videos(container)
    for fault in items:
        keys = as_keys(container.header, list(fault.keys or ()))
        if keys[-2:] == ("video", "content"):
            item = container.item(fault.number)
            offset, length = item.get("offset"), item.get("length")
            if type(offset) is int and type(length) is int and offset >= 0:
                there = container.bytes_between(offset, offset + length)
                if 0 < len(there) < length:
                    damaged[keys] = there, length, _cut(there, length)
    return {keys: _rescued(container.header, keys, *content) for keys, content in damaged.items()}


def _rescued(header: dict[str, Any], keys: Keys, there: memoryview, length: int, why: str) -> DamagedVideo:
    sensor: Any = header
    for key in keys[:-2]:
        sensor = sensor[key]
    video = sensor["video"]
    timestamps = video.get("timestamps")
    missing = length - len(there)
    lost = DamagedVideo(why, missing, is_rescued=False)
    if not isinstance(timestamps, list) or not missing:
        return lost
    try:
        content, kept, count = rescue_video(there, length)
    except DataError:
        return lost
    if count != len(timestamps):
        return lost
    video["content"] = np.frombuffer(content, np.uint8)
    video["timestamps"] = [timestamps[k] for k in kept]
    keep_in_step(header, sensor.get("id"), "images", kept, count)
    problem = f"the video was cut: {len(kept)} of its {count} images are whole"
    return DamagedVideo(problem, missing, is_rescued=True)


def as_keys(header: dict[str, Any], keys: list[Any]) -> Keys:
    """The path that an item names, with numbers where a list is: writers may state them as text."""
    node: Any = header
    found: list[str | int] = []
    for key in keys:
        is_index = isinstance(node, list) and str(key).isdigit()
        found.append(int(key) if is_index else str(key))
        node = step(node, key)
    return tuple(found)


class CutBytes:
    """Bytes of which only the first ones are there; the others are NULs."""

    def __init__(self, there: memoryview, length: int) -> None:
        self._there, self._length = there, length

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, part: slice) -> bytes:
        start, stop, _ = part.indices(self._length)
        piece = bytes(self._there[start:stop])
        return piece + bytes(max(0, stop - start) - len(piece))


def rescue_video(there: memoryview, length: int) -> tuple[bytes, list[int], int]:
    """Keep the packets that are whole, up to the first one that is not.

    Args:
        there: the bytes that are left.
        length: how many there were.

    Returns:
        A video of these packets, which images of the original it holds, in the order of their times, and how many
        the original had.

    Raises:
        DataError: its tables are lost, or no image is whole.
    """
    from sceneloom.formats.video.index import (
        BY_TABLES,
        OpenVideo,
        decoder_faults,
        open_hollow,
        read_index,
        read_table_index,
    )

    name = "video"
    whole = CutBytes(there, length)
    index = read_table_index(whole, name)
    if not index.timed:
        raise DataError(name, "", "does not state when its images are shown")
    opened = OpenVideo(lambda: open_hollow(whole), name, options=BY_TABLES)
    try:
        with decoder_faults(name, ""):
            shown = _whole_packets(opened, len(there))
    finally:
        opened.close()
    kept = sorted(k for k in (index.find(pts) for pts in shown) if k is not None)
    if not kept or len(kept) != len(shown):
        raise DataError(name, "", "no image of it is whole")
    with decoder_faults(name, ""):
        content = _copied(there, len(shown))
    if len(read_index(content, name)) != len(kept):
        raise DataError(name, "", "its whole images cannot be distinguished from the others")
    return content, kept, len(index)


def _whole_packets(opened: "OpenVideo", available: int) -> list[int | None]:
    """When the images of the first packets are shown, up to the first packet that is not whole [ticks]."""
    shown: list[int | None] = []
    for packet in opened.container.demux(opened.stream):
        if packet.size and not packet.is_discard:
            if packet.pos is None or packet.pos < 0 or packet.pos + packet.size > available:
                break
            shown.append(packet.pts)
    return shown


def _copied(there: memoryview, count: int) -> bytes:
    """Copy the first packets of a video into one of its own."""
    import av

    from sceneloom.formats.video.index import BY_TABLES, OpenVideo

    target = io.BytesIO()
    opened = OpenVideo(there, "video", options=BY_TABLES)
    try:
        with av.open(target, "w", format="mp4") as output:
            stream: VideoStream = output.add_stream_from_template(opened.stream)
            stream.time_base = opened.stream.time_base
            packets: Any = (p for p in opened.container.demux(opened.stream) if p.size)
            for _, packet in zip(range(count), packets, strict=False):
                packet.stream = stream
                output.mux(packet)
    finally:
        opened.close()
    return target.getvalue()


def video_problem(camera: CameraSensor) -> str | None:
    """Why a camera's video cannot be written; None where it can."""
    from sceneloom.formats.video.index import read_index

    if camera.video is None or not len(camera.images):
        return None
    try:
        camera.images[0]  # opens the video
        if camera.video.codec != _UNKNOWN_CODEC:
            return None
        count = len(read_index(camera.video.open, "video"))
    except DataError as error:
        return error.problem
    timestamps = len(camera.images)
    return None if count == timestamps else f"{count} images; expected {timestamps} as its timestamps"
