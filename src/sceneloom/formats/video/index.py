"""The source of a video, and which images it holds: found without decoding, from packets or the tables of an mp4."""

import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, cast

import av
import numpy as np
from av.codec.context import ThreadType
from av.container import InputContainer
from av.packet import Packet
from av.video.stream import VideoStream

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.files import (
    Bytes,
    ByteStream,
    check_pixels,
    check_regular,
    file_faults,
    open_file,
    processors,
    why_no_file,
)

VideoSource = Path | str | bytes | bytearray | memoryview | Callable[[], BinaryIO]
"""A file, its bytes, or a function that opens them anew each time."""

_DEMUXERS = (
    "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi,mpegts,mpeg,flv,ogg,ivf,h264,hevc,obu,mjpeg,mxf,asf,nut,yuv4mpegpipe"
)
"""Containers of one video each. Playlists are not among them: they could name any file or address."""

_MOST_AHEAD = 4
"""Images that are decoded at the same time at most: each is kept, and a jump waits for all of them."""


def source_name(source: VideoSource, name: str | None) -> str:
    """What messages call the video: the given name, else its path, else `video`."""
    return name or (str(source) if isinstance(source, Path | str) else "video")


def as_path(source: Path | str) -> Path:
    """The path of a file, of the class that it is of."""
    return source if isinstance(source, Path) else Path(source)


def open_bytes(source: VideoSource) -> BinaryIO:
    """Open the source as a new seekable binary file."""
    if isinstance(source, Path | str):
        return open_file(as_path(source))
    if callable(source):
        return source()
    return cast("BinaryIO", io.BufferedReader(ByteStream(memoryview(source).cast("B"))))


@contextmanager
def decoder_faults(name: str, location: str) -> Iterator[None]:
    """Turn whatever the video library raises into a DataError at `location`."""
    try:
        yield
    except (av.FFmpegError, OSError, ValueError, MemoryError) as error:
        problem = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise DataError(name, location, f"cannot be read as video: {problem}") from error


class OpenVideo:
    """An open container and its video stream; closes what it opened.

    Attributes:
        container: positioned at the first packet.
        stream: the container's video.
        works_ahead: whether the decoder gives images and faults some packets late.
    """

    container: InputContainer
    stream: VideoStream
    works_ahead: bool = False

    def __init__(self, source: VideoSource, name: str, *, options: Mapping[str, str] | None = None) -> None:
        """Open the source and find its video stream.

        Args:
            source: the video.
            name: what messages call it.
            options: further ones for the container.

        Raises:
            DataError: the source cannot be opened, is no video, or holds no video stream.
        """
        if isinstance(source, Path | str):
            path = as_path(source)
            if not path.is_file():
                raise DataError(name, "", "not a file" if path.is_dir() else why_no_file(path))
            with file_faults(path):
                check_regular(path)
        with ExitStack() as stack:
            with decoder_faults(name, ""):
                # the prefix keeps a colon in a file's name from being taken for a protocol
                target: Any = f"file:{os.fspath(source)}" if isinstance(source, Path | str) else open_bytes(source)
                if not isinstance(target, str):
                    stack.callback(target.close)
                options = {"format_whitelist": _DEMUXERS, **(options or {})}
                self.container = cast("InputContainer", av.open(target, "r", container_options=options))
                stack.callback(self.container.close)
            stream = cast("VideoStream | None", self.container.streams.best("video"))
            if stream is None:
                raise DataError(name, "", "holds no video stream")
            decoder = stream.codec_context
            if decoder is None or decoder.width <= 0 or decoder.height <= 0:
                raise DataError(name, "", "its video stream is of an unknown codec or image size")
            check_pixels(name, "", decoder.width, decoder.height)
            self.stream, self._files = stream, stack.pop_all()

    def decode_ahead(self) -> None:
        """Decode the next images in further threads while the last is used; to be called before the first image.

        Such a decoder takes for a fault what others pass over, and does not say which packet is damaged.
        """
        available = processors()
        if available == 1:
            return
        decoder = self.stream.codec_context
        decoder.thread_type = ThreadType.AUTO
        decoder.thread_count = min(available + 1, _MOST_AHEAD)
        decoder.options = {**decoder.options, "err_detect": "explode"}
        self.works_ahead = True

    def close(self) -> None:
        """Release the container and the file under it."""
        with suppress(av.FFmpegError, OSError):
            self._files.close()


_SEGMENT, _LONGEST_HEAD = b"\x18\x53\x80\x67", 12


def _matroska_stop(file: BinaryIO, size: int) -> int:
    """Where a Matroska file ends by the sizes of its elements, as far as it can be followed. Source: RFC 8794, 4 to 6.

    An element whose size is not known, as while it is being recorded, is entered like the segment.
    """
    location = 0
    while location < size:
        file.seek(location)
        head = file.read(_LONGEST_HEAD)
        split = _width(head, longest=4)
        width = _width(head[split:], longest=8)
        start = split + width
        if not split or not width or len(head) < start:
            break
        unknown = (1 << 7 * width) - 1
        length = int.from_bytes(head[split:start], "big") & unknown
        if length != unknown and location + start + length > size:
            return location + start + length
        location += start if length == unknown or head[:split] == _SEGMENT else start + length
    return location


def _width(head: bytes, *, longest: int) -> int:
    """How many bytes a number has that begins like this; 0 where none does."""
    width = 9 - head[0].bit_length() if head else 0
    return width if width <= longest else 0


_ASSUMED_RATE = Fraction(25)
"""Images a second where neither packets nor container name any time; only `timestamps` depend on it."""

_UNTIMED = frozenset({"avi", "h264", "hevc"})
"""Containers that state nothing of when an image is shown."""

_REORDERS = 1 << 3
"""Source: AV_CODEC_PROP_REORDER of libavcodec/codec_desc.h."""

_MOST_REORDERED = 16
"""So many images at most are stored before one that is shown before them. Source: H.264, `max_num_reorder_frames`."""


@dataclass(frozen=True, slots=True, eq=False)
class VideoIndex:
    """The images of a video in the order in which they are shown.

    Attributes:
        time_base: length of one tick [s].
        pts: (N,) int64 [ticks], presentation times, ascending; counted up where the container has none.
        positions: (N,) int64, each image's location among the packets.
        entries: (N,) int64, the image at whose key frame decoding has to begin to get this one.
        timed: whether `pts` identify an image; else images are known by counting from the start only.
        hidden: packets that have to be decoded but are not shown (cut away by an edit list).
    """

    time_base: Fraction
    pts: Int64Array
    positions: Int64Array
    entries: Int64Array
    timed: bool
    hidden: int

    def __len__(self) -> int:
        return len(self.pts)

    @property
    def timestamps(self) -> Float64Array:
        """(N,) float64 [s], presentation time of each image."""
        return self.pts.astype(np.float64) * (self.time_base.numerator / self.time_base.denominator)

    @property
    def independent(self) -> bool:
        """Whether each image is a key frame."""
        return bool(np.array_equal(self.entries, np.arange(len(self))))

    def part(self, taken: Int64Array) -> "VideoIndex":
        """The list of some of the images, (M,) ascending, as if the others had never been stored."""
        order = np.argsort(np.argsort(self.positions[taken])).astype(np.int64)
        entries = np.maximum(np.searchsorted(taken, self.entries[taken], side="right") - 1, 0).astype(np.int64)
        return VideoIndex(self.time_base, self.pts[taken], order, entries, timed=self.timed, hidden=0)

    def find(self, pts: int | None) -> int | None:
        """The image that has this presentation time, or None."""
        if pts is None:
            return None
        index = int(np.searchsorted(self.pts, pts))
        return index if index < len(self) and self.pts[index] == pts else None


def codec_reorders(stream: VideoStream) -> bool:
    """Whether images of this codec may be shown in another order than they are stored in."""
    return bool(stream.codec_context.codec.properties & _REORDERS)


def presentation_ticks(packet: "Packet[VideoStream]", *, reorders: bool) -> int | None:
    """When a packet's image is shown: its pts, or its dts where the codec never reorders images."""
    if packet.pts is not None:
        return packet.pts
    return None if reorders else packet.dts


def read_index(
    source: VideoSource, name: str, *, options: Mapping[str, str] | None = None, cut_off: bool = False
) -> VideoIndex:
    """Walk through all packets of a video.

    Args:
        source: the video.
        name: what messages call it.
        options: further ones for the container.
        cut_off: take the images of a video that breaks off, up to the first that may be missing.

    Raises:
        DataError: the container breaks off, or a packet is damaged.
    """
    with closing(OpenVideo(source, name, options=options)) as opened, decoder_faults(name, ""):
        if "matroska" in opened.container.format.name and not cut_off:
            with open_bytes(source) as file:
                size = file.seek(0, os.SEEK_END)
                stop = _matroska_stop(file, size)
            if stop > size:
                raise DataError(name, f"byte {size}", f"is cut off: the container goes on to byte {stop} at least")
        packets, hidden = _walk(opened, name, cut_off=cut_off)
        tick, rate = opened.stream.time_base, opened.stream.average_rate
        time_base = Fraction(tick.numerator, tick.denominator) if tick else Fraction(1, av.time_base)
    pts = np.array([tick for tick, _ in packets if tick is not None], np.int64)
    if len(np.unique(pts)) == len(packets):
        order = np.argsort(pts, kind="stable")
        entries = _entries(pts, [key for _, key in packets], order)
        return VideoIndex(time_base, pts[order], order, entries, timed=True, hidden=hidden)
    period = 1 / (Fraction(rate.numerator, rate.denominator) if rate else _ASSUMED_RATE) / time_base
    pts = np.array([round(k * period) for k in range(len(packets))], np.int64)
    return VideoIndex(time_base, pts, np.arange(len(pts)), np.zeros_like(pts), timed=False, hidden=hidden)


def _walk(opened: OpenVideo, name: str, *, cut_off: bool) -> tuple[list[tuple[int | None, bool]], int]:
    """When the image of each packet is shown [ticks] and whether it is a key frame; and how many images are hidden.

    Of a container that breaks off, an image that is shown before one that is there may have been stored after it. No
    packet after the last one is decoded earlier than that, nor shown before it is decoded: the images up to the last
    decoding time are all there.
    """
    decoder, container = opened.stream.codec_context, opened.container
    reorders = codec_reorders(opened.stream)
    # times that such containers are given are guesses
    guessed = container.format.name in _UNTIMED and reorders and decoder.has_b_frames
    found: list[tuple[int | None, bool]] = []
    last_dts, hidden = None, 0
    with suppress(*([av.FFmpegError] if cut_off else [])):
        for packet in container.demux(opened.stream):
            if packet.is_corrupt:
                if cut_off:
                    break
                raise DataError(name, f"packet {len(found) + hidden}", "is damaged or cut off")
            if packet.is_discard:
                hidden += 1
            elif packet.size:
                tick = None if guessed else presentation_ticks(packet, reorders=reorders)
                found.append((tick, packet.is_keyframe))
                last_dts = packet.dts
    if not cut_off:
        declared, count = opened.stream.frames if "mp4" in container.format.name else 0, len(found) + hidden
        if count < declared:
            raise DataError(name, "", f"is cut off: holds {count} of the {declared} images that it declares")
    elif reorders and last_dts is not None and not guessed:
        found = [(tick, key) for tick, key in found if tick is not None and tick <= last_dts]
    elif reorders and decoder.has_b_frames:
        found = found[:-_MOST_REORDERED]
    return found, hidden


def _entries(pts: Int64Array, keys: Sequence[bool], order: Int64Array) -> Int64Array:
    """For each image, the last key frame that is both stored and shown no later than it.

    An image stored after a key frame but shown before it may depend on what came before the key frame (open groups of
    images), so decoding for it has to begin at the key frame before.
    """
    ranks, entries = np.argsort(order), np.zeros(len(order), np.int64)
    key_positions = [0]
    for position, (tick, key) in enumerate(zip(pts.tolist(), keys, strict=True)):
        if key:
            key_positions.append(position)
        start = next((k for k in reversed(key_positions) if pts[k] <= tick), 0)
        entries[ranks[position]] = ranks[start]
    return entries


BY_TABLES = {"fflags": "noparse+nofillin"}
"""Options for packets as the tables list them. Source: AVFMT_FLAG_NOPARSE of libavformat/avformat.h."""

_LONG_SIZE, _TO_THE_END = 1, 0
_LOOKED_AT = 64 << 10
_MOST_BOXES = 10_000


def read_table_index(content: Bytes, name: str) -> VideoIndex:
    """Walk through all packets of an mp4 video; of the bytes of its images only the first few are fetched.

    Raises:
        DataError: the container breaks off.
    """
    return read_index(lambda: open_hollow(content), name, options=BY_TABLES)


def open_hollow(content: Bytes) -> BinaryIO:
    """Open an mp4 video as a file whose images read as NULs, but for their first bytes, which name the codec."""
    payloads = [(start + _LOOKED_AT, stop) for start, stop in _media(content)]
    return cast("BinaryIO", io.BufferedReader(_Hollow(content, payloads), _LOOKED_AT))


class _Hollow(ByteStream):
    """A file whose payloads read as NULs."""

    def __init__(self, content: Bytes, payloads: list[tuple[int, int]]) -> None:
        super().__init__(content)
        self._payloads = payloads

    def readinto(self, buffer: Any) -> int:
        start, length = self.location, len(buffer)
        for first, stop in self._payloads:
            if first <= start < stop:
                length = min(length, stop - start)
                buffer[:length] = bytes(length)
                self.location += length
                return length
            if start < first:
                length = min(length, first - start)
        return super().readinto(memoryview(buffer)[:length])


def _media(content: Bytes) -> Iterator[tuple[int, int]]:
    """What is in the boxes that hold images: first byte, and the one after the last.

    Source: ISO/IEC 14496-12, 4.2 (boxes) and 8.1.1 (media data).
    """
    location = 0
    for _ in range(_MOST_BOXES):
        head = bytes(content[location : location + 16])
        if len(head) < 8:
            return
        size, name, header = int.from_bytes(head[:4], "big"), head[4:8], 8
        if size == _LONG_SIZE:
            size, header = int.from_bytes(head[8:16], "big"), 16
        stop = len(content) if size == _TO_THE_END else location + size
        if stop < location + header:
            return
        if name == b"mdat":
            yield location + header, min(stop, len(content))
        location = stop
