"""Which images a video holds, found by walking through its packets without decoding any."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
from av.packet import Packet
from av.video.stream import VideoStream

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.video.matroska import check_whole
from sceneloom.formats.video.source import OpenVideo, VideoSource, decoder_faults

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
        entries = np.maximum(np.searchsorted(taken, self.entries[taken], side="right") - 1, 0).astype(
            np.int64
        )
        return VideoIndex(self.time_base, self.pts[taken], order, entries, timed=self.timed, hidden=0)

    def find(self, pts: int | None) -> int | None:
        """The image that has this presentation time, or None."""
        if pts is None:
            return None
        index = int(np.searchsorted(self.pts, pts))
        return index if index < len(self) and self.pts[index] == pts else None


@dataclass(frozen=True, slots=True)
class _Packets:
    """What the walk through a container notes down, in the order of storage."""

    ticks: list[int | None]
    keys: list[bool]
    hidden: int


def _lacks_presentation_times(opened: OpenVideo) -> bool:
    """Whether the presentation times of the packets are guesses: the container has none, and they are needed."""
    decoder = opened.stream.codec_context
    return opened.container.format.name in _UNTIMED and codec_reorders(opened.stream) and decoder.has_b_frames


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
    opened = OpenVideo(source, name, options=options)
    try:
        with decoder_faults(name, ""):
            if "matroska" in opened.container.format.name and not cut_off:
                check_whole(source, name)
            packets = _first_packets(opened) if cut_off else _walk(opened, name)
        tick, rate = opened.stream.time_base, opened.stream.average_rate
        return _index_of(
            packets,
            Fraction(tick.numerator, tick.denominator) if tick else Fraction(1, av.time_base),
            Fraction(rate.numerator, rate.denominator) if rate else None,
        )
    finally:
        opened.close()


def _walk(opened: OpenVideo, name: str) -> _Packets:
    reorders, guessed = codec_reorders(opened.stream), _lacks_presentation_times(opened)
    ticks: list[int | None] = []
    keys: list[bool] = []
    hidden = 0
    for packet in opened.container.demux(opened.stream):
        if packet.is_corrupt:
            raise DataError(name, f"packet {len(ticks) + hidden}", "is damaged or cut off")
        if packet.is_discard:
            hidden += 1
        elif packet.size:
            ticks.append(None if guessed else presentation_ticks(packet, reorders=reorders))
            keys.append(packet.is_keyframe)
    declared = opened.stream.frames if "mp4" in opened.container.format.name else 0
    if len(ticks) + hidden < declared:
        found = len(ticks) + hidden
        raise DataError(name, "", f"is cut off: holds {found} of the {declared} images that it declares")
    return _Packets(ticks, keys, hidden)


def _first_packets(opened: OpenVideo) -> _Packets:
    """Walk as far as a container that breaks off can be followed.

    An image that is shown before one that is there may have been stored after it. No packet after the last one is
    decoded earlier than that, nor shown before it is decoded: the images up to the last decoding time are all there.
    """
    reorders, guessed = codec_reorders(opened.stream), _lacks_presentation_times(opened)
    found: list[tuple[int | None, bool]] = []
    last_dts, hidden = None, 0
    with suppress(av.FFmpegError):
        for packet in opened.container.demux(opened.stream):
            if packet.is_corrupt:
                break
            if packet.is_discard:
                hidden += 1
            elif packet.size:
                tick = None if guessed else presentation_ticks(packet, reorders=reorders)
                found.append((tick, packet.is_keyframe))
                last_dts = packet.dts
    if reorders and last_dts is not None and not guessed:
        found = [(tick, key) for tick, key in found if tick is not None and tick <= last_dts]
    elif reorders and opened.stream.codec_context.has_b_frames:
        found = found[:-_MOST_REORDERED]
    return _Packets([tick for tick, _ in found], [key for _, key in found], hidden)


def _index_of(packets: _Packets, time_base: Fraction, rate: Fraction | None) -> VideoIndex:
    known = [tick for tick in packets.ticks if tick is not None]
    if len(set(known)) != len(packets.ticks):
        return _counted_index(packets, time_base, rate)
    pts = np.array(known, np.int64)
    order = np.argsort(pts, kind="stable")
    entries = _entries(pts, np.array(packets.keys, bool), order)
    return VideoIndex(time_base, pts[order], order, entries, timed=True, hidden=packets.hidden)


def _entries(pts: Int64Array, keys: BoolArray, order: Int64Array) -> Int64Array:
    """For each image, the last key frame that is both stored and shown no later than it.

    An image stored after a key frame but shown before it may lean on what came before the key frame (open
    groups of images), so decoding for it has to begin at the key frame before.
    """
    ranks = np.empty(len(order), np.int64)
    ranks[order] = np.arange(len(order))
    entries = np.zeros(len(order), np.int64)
    key_positions = [0]
    for position, (tick, key) in enumerate(zip(pts.tolist(), keys.tolist(), strict=True)):
        if key:
            key_positions.append(position)
        start = next((k for k in reversed(key_positions) if pts[k] <= tick), 0)
        entries[ranks[position]] = ranks[start]
    return entries


def _counted_index(packets: _Packets, time_base: Fraction, rate: Fraction | None) -> VideoIndex:
    count = len(packets.ticks)
    period = 1 / (rate or _ASSUMED_RATE) / time_base
    pts = np.array([round(k * period) for k in range(count)], np.int64)
    start = np.zeros(count, np.int64)
    return VideoIndex(time_base, pts, np.arange(count), start, timed=False, hidden=packets.hidden)
