"""Remuxing: the packets of a video copied into another container or Annex B messages, encoded again where needed."""

import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import chain
from typing import Any, BinaryIO, Self, cast

import av
import numpy as np
from av.container import OutputContainer
from av.packet import Packet
from av.video.stream import VideoStream

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.errors import ArrayError, DataError, OutputError
from sceneloom.formats.base.files import FileView
from sceneloom.formats.video.index import (
    OpenVideo,
    VideoIndex,
    VideoSource,
    decoder_faults,
    read_index,
    source_name,
)
from sceneloom.formats.video.reader import VideoReader
from sceneloom.formats.video.writer import (
    MICROSECONDS,
    VideoTarget,
    VideoWriter,
    abandon,
    open_container,
    target_name,
    writing_faults,
)
from sceneloom.scene.cameras import VideoContent


@dataclass(frozen=True, slots=True, eq=False)
class _PacketTimes:
    """When the packets of a copy are shown and decoded.

    Attributes:
        tick: length of one tick [s].
        pts, dts, durations: (N,) int64 [ticks], one per packet in the order of storage.
    """

    tick: Fraction
    pts: Int64Array
    dts: Int64Array
    durations: Int64Array

    @classmethod
    def of(cls, index: VideoIndex, timestamps_seconds: Sequence[float] | Float64Array | None = None) -> Self:
        """Spread times, given in the order of showing, over the packets in their order of storage.

        An image must be decoded no later than it is shown. With the packets' times sorted, s, and d the most
        locations that a packet is stored behind its rank in showing, dts[k] = s[k - d] fulfils that and increases;
        before the first time it goes on backwards in steps of the first period.
        """
        if timestamps_seconds is None:
            tick, shown = index.time_base, index.pts - index.pts[:1]
        else:
            tick, shown = MICROSECONDS, _to_ticks(timestamps_seconds, len(index))
        count = len(shown)
        periods = np.ones(count, np.int64)
        periods[:-1] = np.diff(shown)
        periods[-1:] = periods[-2:-1] if count > 1 else 1
        ranks = np.argsort(index.positions)
        delay = int((np.arange(count) - ranks).max(initial=0))
        before = -periods[:1] * np.arange(delay, 0, -1)
        return cls(tick, shown[ranks], np.concatenate([before, shown])[:count], periods[ranks])


def _copy_packets(
    source: VideoSource,
    target: VideoTarget,
    container: str,
    times: _PacketTimes,
    name: str,
    *,
    taken: BoolArray | None = None,
) -> None:
    """Copy packets that hold images into a new container, one at a time.

    Args:
        source: the video.
        target: where to.
        container: of what kind.
        times: of the packets that are copied.
        name: what messages call the source.
        taken: (N,) bool, which packets to copy, in the order of storage; None for all.
    """
    called = target_name(target)
    with closing(OpenVideo(source, name)) as opened:
        header = len(opened.stream.codec_context.extradata or b"")
        output = open_container(target, container, images=len(times.pts), header_bytes=header)
        with ExitStack() as stack:
            stack.callback(abandon, output)
            with writing_faults(called):
                stream = _same_stream(output, opened.stream, times.tick)
            packets = enumerate(_image_packets(opened, name))
            # packets beyond those that were there before are refused
            chosen = (packet for k, packet in packets if taken is None or k >= len(taken) or taken[k])
            for position, packet in enumerate(chosen):
                if position >= len(times.pts):
                    problem = "was not there before; the file changes while it is read"
                    raise DataError(name, f"packet {position}", problem)
                packet.time_base = times.tick
                packet.pts, packet.dts = int(times.pts[position]), int(times.dts[position])
                packet.duration = int(times.durations[position])
                packet.stream = stream
                with writing_faults(called):
                    output.mux_one(packet)
            stack.pop_all()
        with writing_faults(called):
            output.close()


def _same_stream(output: OutputContainer, original: VideoStream, tick: Fraction) -> VideoStream:
    """Add a stream like another one to a file, with ticks of its own."""
    stream = output.add_stream_from_template(original, opaque=True)
    stream.time_base = tick
    if "matroska" in output.format.name and original.average_rate:
        # else readers take the ticks for the rate
        stream.codec_context.framerate = original.average_rate
    if output.format.name == "mp4" and original.codec_context.codec.canonical_name == "hevc":
        # of the two names of HEVC in mp4, Apple's players know this one only
        stream.codec_context.codec_tag = "hvc1"
    return stream


def _image_packets(opened: OpenVideo, name: str) -> "Iterator[Packet[VideoStream]]":
    """Give the packets that hold an image which is shown, in the order of storage."""
    packets = opened.container.demux(opened.stream)
    while True:
        with decoder_faults(name, ""):
            packet = next(packets, None)
        if packet is None:
            return
        if packet.size and not packet.is_discard:
            yield packet


def _check_count(timestamps: int, images: int) -> None:
    if timestamps != images:
        raise ArrayError(f"timestamps_seconds: {timestamps} times for {images} images; expected one for each")


def _to_ticks(timestamps_seconds: Sequence[float] | Float64Array, count: int) -> Int64Array:
    timestamps = np.asarray(timestamps_seconds, np.float64)
    _check_count(len(timestamps), count)
    ticks = np.rint((timestamps - timestamps[:1]) / float(MICROSECONDS)).astype(np.int64)
    backwards = np.flatnonzero(np.diff(ticks) <= 0)
    if len(backwards):
        k = int(backwards[0]) + 1
        raise ArrayError(f"timestamps_seconds[{k}]: {timestamps[k]}; expected more than {timestamps[k - 1]}")
    return ticks


_MP4_CODECS = frozenset({"h264", "hevc"})
"""What is copied into mp4; others either do not belong there or play nowhere."""

_DEFAULT_FPS = 10.0


@dataclass(frozen=True, slots=True)
class RemuxResult:
    """What was written.

    Attributes:
        images: how many.
        codec: the codec in the target.
        copied: whether the packets are the source's own.
        reason: why they are not; None where they are.
    """

    images: int
    codec: str
    copied: bool
    reason: str | None = None


def remux_to_mp4(
    source: VideoSource,
    target: BinaryIO,
    *,
    timestamps_seconds: Sequence[float] | Float64Array | None = None,
    frame_indices: Sequence[int] | None = None,
    name: str | None = None,
) -> RemuxResult:
    """Put a video into mp4, H.264 and HEVC packet by packet, others as H.264; the first image is shown at 0.

    Args:
        source: read twice or more: the packets' times have to be known before the first is written.
        target: a seekable binary file, written from where it stands at 0; it stays open.
        timestamps_seconds: when each image is shown, strictly increasing; None for the source's own times.
        frame_indices: which images to take, ascending, by the order in which they are shown; None for all.
        name: what messages call the source.

    Raises:
        DataError: the source is damaged.
        ArrayError: not one time for each image, or times that do not increase.
        OptionError: the images must be encoded, and have an odd size.
        OutputError: the target cannot be written.
    """
    called = source_name(source, name)
    with VideoReader(source, name=called) as reader:
        chosen = range(reader.count) if frame_indices is None else frame_indices
        reason = _obstacle(reader, chosen, _MP4_CODECS)
        if reason is not None:
            timestamps = timestamps_seconds
            if timestamps is None and reader.index.timed:
                timestamps = reader.timestamps[np.asarray(chosen, np.int64)]
            images = (reader.rgb(index) for index in chosen)
            fps = reader.fps or _DEFAULT_FPS
            result = encode_to_mp4(images, target, fps=fps, timestamps_seconds=timestamps, count=len(chosen))
            return RemuxResult(result.images, result.codec, copied=False, reason=reason)
        codec, index = reader.codec, reader.index
    _copy_packets(source, target, "mp4", _PacketTimes.of(index, timestamps_seconds), called)
    return RemuxResult(len(index), codec, copied=True)


def copy_to_matroska(
    source: VideoSource,
    target: VideoTarget,
    *,
    images: int | None = None,
    frame_indices: Sequence[int] | Int64Array | None = None,
    name: str | None = None,
) -> RemuxResult | None:
    """Put a video into Matroska packet by packet, whatever its codec, at its own times from 0 on.

    Args:
        source: read twice or more: the packets' times have to be known before the first is written.
        target: a path or a seekable binary file.
        images: how many images there must be; None for any number.
        frame_indices: which images to take, ascending, by the order in which they are shown; None for all.
        name: what messages call the source.

    Returns:
        What was written; None, and nothing written, where the packets cannot be copied: their times are unknown,
        some are not to be shown, they are not as many as they must be, images that are taken cannot be decoded
        without others that are not, or Matroska does not hold their codec.

    Raises:
        DataError: the source is damaged.
        OutputError: the target cannot be written.
    """
    called = source_name(source, name)
    with VideoReader(source, name=called) as reader:
        wanted = range(reader.count if images is None else images)
        if _obstacle(reader, wanted, frozenset({reader.codec})) is not None:
            return None
        codec, index = reader.codec, reader.index
    taken = np.arange(len(index)) if frame_indices is None else np.asarray(frame_indices, np.int64)
    if not _can_be_cut(index, taken) or codec not in _matroska_codecs():
        return None
    is_taken = np.zeros(len(index), np.bool_)
    is_taken[index.positions[taken]] = True
    _copy_packets(source, target, "matroska", _PacketTimes.of(index.part(taken)), called, taken=is_taken)
    return RemuxResult(len(taken), codec, copied=True)


@cache
def _matroska_codecs() -> frozenset[str]:
    """Names of the codecs that can be put into Matroska."""
    with open_container(io.BytesIO(), "matroska") as container:
        return frozenset(container.supported_codecs)


def _can_be_cut(index: VideoIndex, taken: Int64Array) -> bool:
    """Whether some images can be decoded without the others: each needs all that is stored from its key frame on."""
    if len(taken) == 0 or (np.diff(taken) <= 0).any() or taken[0] < 0 or taken[-1] >= len(index):
        return False
    stored = np.zeros(len(index) + 1, np.int64)
    stored[index.positions[taken] + 1] = 1
    before = np.cumsum(stored)
    starts, stops = index.positions[index.entries[taken]], index.positions[taken] + 1
    return bool((before[stops] - before[starts] == stops - starts).all())


def encode_to_mp4(
    images: Iterable[UInt8Array],
    target: VideoTarget,
    *,
    fps: float = _DEFAULT_FPS,
    timestamps_seconds: Sequence[float] | Float64Array | None = None,
    count: int | None = None,
) -> RemuxResult:
    """Encode images as H.264 in mp4, one at a time; the first is shown at 0.

    Args:
        images: (height, width, 3) uint8 each, red green blue, all of one size.
        target: a path or a seekable binary file.
        fps: nominal images a second.
        timestamps_seconds: when each image is shown, strictly increasing; None for even steps at `fps`.
        count: how many images there are; needed only where there are no times, for the tables to stand first.

    Raises:
        ArrayError: not one time for each image, or times that do not increase.
        OptionError: the size is odd.
        OutputError: there is no image, or the target cannot be written.
    """
    timestamps = None if timestamps_seconds is None else np.asarray(timestamps_seconds, np.float64)
    remaining = iter(images)
    first = next(remaining, None)
    if first is None:
        raise OutputError(f"{target_name(target)}: cannot be written: a video needs at least one image")
    height, width = first.shape[:2]
    most, found = count if timestamps is None else len(timestamps), 0
    with VideoWriter(target, width, height, fps, container="mp4", images=most) as writer:
        for found, rgb in enumerate(chain([first], remaining), 1):
            if timestamps is None:
                writer.add(rgb)
            elif found <= len(timestamps):
                writer.add(rgb, float(timestamps[found - 1]))
        if timestamps is not None:
            _check_count(len(timestamps), found)
    return RemuxResult(writer.count, "h264", copied=False)


def _obstacle(reader: VideoReader, chosen: Sequence[int], codecs: frozenset[str]) -> str | None:
    """Why the packets cannot be copied; None where they can."""
    index = reader.index
    if len(index) == 0:
        raise DataError(reader.name, "", "holds no images")
    obstacles = (
        (reader.codec not in codecs, f"{reader.codec} is not copied into mp4"),
        (not index.timed, "the source does not state when its images are shown"),
        (index.hidden > 0, "the source holds images that are not to be shown"),
        (not np.array_equal(chosen, np.arange(len(index))), "not all images of the source are taken"),
    )
    return next((reason for stands, reason in obstacles if stands), None)


_FILTERS = {"h264": "h264_mp4toannexb", "hevc": "hevc_mp4toannexb"}
"""FFmpeg's filters that put packets into Annex B form, with the parameters before each key image."""

_START_CODE = b"\x00\x00\x01"

_PARAMETERS = {"h264": lambda byte: byte & 0x1F == 7, "hevc": lambda byte: (byte >> 1) & 0x3F == 33}
"""Whether a unit with this first byte holds the parameters of a sequence, without which nothing is decoded."""


def starts_video(packet: bytes | memoryview, codec: str) -> bool:
    """Whether decoding can begin with a packet in Annex B form: whether it holds the sequence's parameters."""
    content, location = bytes(packet), 0
    while (location := content.find(_START_CODE, location)) >= 0 and location + 3 < len(content):
        if _PARAMETERS[codec](content[location + 3]):
            return True
        location += 3
    return False


def annex_b_to_mp4(raw: BinaryIO, target: BinaryIO, timestamps_ns: Int64Array, name: str) -> None:
    """Put a stream in Annex B form into an mp4 file.

    Args:
        raw: the packets one after another.
        target: a seekable binary file.
        timestamps_ns: (N,) int64 [ns], when each image is shown, in the order of decoding.
        name: what messages call the video.

    Raises:
        DataError: the packets cannot be read, or are more or fewer than their times.
    """
    order = np.argsort(timestamps_ns, kind="stable").astype(np.int64)
    micros = (timestamps_ns[order] - timestamps_ns[order[:1]]) // 1000
    # images of one microsecond keep their order
    steps = np.arange(len(micros))
    ticks = np.maximum.accumulate(micros - steps) + steps
    zeros = np.zeros(len(order), np.int64)
    index = VideoIndex(Fraction(1, 1_000_000), ticks, order, zeros, timed=True, hidden=0)
    source = cast("Callable[[], BinaryIO]", lambda: io.BufferedReader(FileView(raw)))
    _copy_packets(source, target, "mp4", _PacketTimes.of(index), name)


class AnnexBPackets:
    """The packets of a camera's video, one by one.

    Attributes:
        codec: "h264" or "hevc".
        obstacle: why the packets cannot be copied; None where they can.
        reordered: whether images are decoded in another order than they are shown in.
        order: (N,) int64, which image of the camera each packet is, in the order of decoding.
    """

    def __init__(self, video: VideoContent, count: int, name: str) -> None:
        """List the packets of a video that the `count` images of a camera need.

        Raises:
            DataError: the video is damaged, or has another number of images.
        """
        self.codec, self._video, self._name = video.codec, video, name
        index = read_index(video.open, name)
        indices = video.frame_indices
        chosen = np.arange(len(index)) if indices is None else np.asarray(indices, np.int64)
        if len(chosen) != count:
            raise DataError(name, "", f"{len(chosen)} images; expected {count} as the camera has")
        self.obstacle: str | None = None
        if video.codec not in _FILTERS:
            self.obstacle = f"messages hold H.264 and HEVC, the video is {video.codec}"
        elif index.hidden:
            self.obstacle = "the video holds images that are not to be shown"
        elif not _can_be_cut(index, chosen):
            self.obstacle = "images that are taken need others that are not"
        positions = index.positions[chosen] if self.obstacle is None else np.zeros(0, np.int64)
        self.order = np.argsort(positions).astype(np.int64)
        self.reordered = bool((np.diff(self.order) < 0).any())
        self._wanted = frozenset(positions.tolist())

    def __iter__(self) -> Iterator[bytes]:
        with closing(OpenVideo(self._video.open, self._name)) as opened:
            with decoder_faults(self._name, ""):
                filtered: Any = av.BitStreamFilterContext(_FILTERS[self.codec], in_stream=opened.stream)
            for position, packet in enumerate(_image_packets(opened, self._name)):
                with decoder_faults(self._name, f"packet {position}"):
                    content = b"".join(bytes(part) for part in filtered.filter(packet))
                if position in self._wanted:
                    yield content
