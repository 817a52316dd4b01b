"""Copying the packets of a video into another container, with times that every container accepts."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Self

import numpy as np
from av.container import OutputContainer
from av.packet import Packet
from av.video.stream import VideoStream

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import ArrayError, DataError
from sceneloom.formats.video.index import VideoIndex
from sceneloom.formats.video.source import OpenVideo, VideoSource, decoder_faults
from sceneloom.formats.video.writer import (
    MICROSECONDS,
    VideoTarget,
    abandon,
    open_container,
    target_name,
    writing_faults,
)


@dataclass(frozen=True, slots=True, eq=False)
class PacketTimes:
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
    def of(cls, index: VideoIndex, timestamps_seconds: Sequence[float] | Float64Array | None) -> Self:
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
        ranks = np.empty(count, np.int64)
        ranks[index.positions] = np.arange(count)
        delay = int((np.arange(count) - ranks).max(initial=0))
        before = -periods[:1] * np.arange(delay, 0, -1)
        return cls(tick, shown[ranks], np.concatenate([before, shown])[:count], periods[ranks])


def check_count(timestamps: int, images: int) -> None:
    """Refuse a list of times that is not one for each image.

    Raises:
        ArrayError: it is not.
    """
    if timestamps != images:
        raise ArrayError(f"timestamps_seconds: {timestamps} times for {images} images; expected one for each")


def copy_packets(
    source: VideoSource,
    target: VideoTarget,
    container: str,
    times: PacketTimes,
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

    Raises:
        DataError: the source is damaged.
        OutputError: the target cannot be written.
    """
    called = target_name(target)
    opened = OpenVideo(source, name)
    try:
        header = len(opened.stream.codec_context.extradata or b"")
        output = open_container(target, container, images=len(times.pts), header_bytes=header)
        try:
            with writing_faults(called):
                stream = _same_stream(output, opened.stream, times.tick)
            for position, packet in enumerate(_taken(iter_image_packets(opened, name), taken)):
                set_times(packet, times, position, name)
                packet.stream = stream
                with writing_faults(called):
                    output.mux_one(packet)
        except BaseException:
            abandon(output)
            raise
        with writing_faults(called):
            output.close()
    finally:
        opened.close()


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


def iter_image_packets(opened: OpenVideo, name: str) -> "Iterator[Packet[VideoStream]]":
    """Give the packets that hold an image which is shown, in the order of storage.

    Raises:
        DataError: the container is damaged.
    """
    packets = opened.container.demux(opened.stream)
    while True:
        with decoder_faults(name, ""):
            packet = next(packets, None)
        if packet is None:
            return
        if packet.size and not packet.is_discard:
            yield packet


def _taken(
    packets: "Iterator[Packet[VideoStream]]", taken: BoolArray | None
) -> "Iterator[Packet[VideoStream]]":
    if taken is None:
        return packets
    # packets beyond those that were there before are handed on, and refused there
    return (packet for k, packet in enumerate(packets) if k >= len(taken) or taken[k])


def set_times(packet: "Packet[VideoStream]", times: PacketTimes, position: int, name: str) -> None:
    """Set the times of the packet that is stored at a position.

    Raises:
        DataError: no time was found for it: the file is being changed.
    """
    if position >= len(times.pts):
        raise DataError(name, f"packet {position}", "was not there before; the file changes while it is read")
    packet.time_base = times.tick
    packet.pts, packet.dts = int(times.pts[position]), int(times.dts[position])
    packet.duration = int(times.durations[position])


def _to_ticks(timestamps_seconds: Sequence[float] | Float64Array, count: int) -> Int64Array:
    timestamps = np.asarray(timestamps_seconds, np.float64)
    check_count(len(timestamps), count)
    ticks = np.rint((timestamps - timestamps[:1]) / float(MICROSECONDS)).astype(np.int64)
    backwards = np.flatnonzero(np.diff(ticks) <= 0)
    if len(backwards):
        k = int(backwards[0]) + 1
        raise ArrayError(f"timestamps_seconds[{k}]: {timestamps[k]}; expected more than {timestamps[k - 1]}")
    return ticks
