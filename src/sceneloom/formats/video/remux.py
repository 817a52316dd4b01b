"""Putting a video into another container: its packets copied where that can be done, encoded anew where not."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from itertools import chain
from typing import BinaryIO

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.errors import DataError, OutputError
from sceneloom.formats.video.index import VideoIndex
from sceneloom.formats.video.packet_copy import PacketTimes, check_count, copy_packets
from sceneloom.formats.video.reader import VideoReader
from sceneloom.formats.video.source import VideoSource, source_name
from sceneloom.formats.video.writer import VideoTarget, VideoWriter, open_container, target_name

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
    crop_to_even: bool = False,
    name: str | None = None,
) -> RemuxResult:
    """Put a video into mp4, H.264 and HEVC packet by packet, others as H.264; the first image is shown at 0.

    Args:
        source: read twice or more: the packets' times have to be known before the first is written.
        target: a seekable binary file, written from where it stands at 0; it stays open.
        timestamps_seconds: when each image is shown, strictly increasing; None for the source's own times.
        frame_indices: which images to take, ascending, by the order in which they are shown; None for all.
        crop_to_even: where the images must be encoded and a side is odd, cut off its last line.
        name: what messages call the source.

    Raises:
        DataError: the source is damaged.
        ArrayError: not one time for each image, or times that do not increase.
        OptionError: the images must be encoded, have an odd size, and may not be cropped.
        OutputError: the target cannot be written.
    """
    called = source_name(source, name)
    with VideoReader(source, name=called) as reader:
        chosen = range(reader.count) if frame_indices is None else frame_indices
        reason = _obstacle(reader, chosen, _MP4_CODECS)
        if reason is not None:
            timestamps = _timestamps_of(reader, chosen) if timestamps_seconds is None else timestamps_seconds
            images = (reader.rgb(index) for index in chosen)
            result = encode_to_mp4(
                images,
                target,
                fps=reader.fps,
                timestamps_seconds=timestamps,
                count=len(chosen),
                crop_to_even=crop_to_even,
            )
            return RemuxResult(result.images, result.codec, copied=False, reason=reason)
        codec, index = reader.codec, reader.index
    copy_packets(source, target, "mp4", PacketTimes.of(index, timestamps_seconds), called)
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
    if not can_be_cut(index, taken) or codec not in _codecs_of_matroska():
        return None
    times = PacketTimes.of(index.part(taken), None)
    is_taken = np.zeros(len(index), np.bool_)
    is_taken[index.positions[taken]] = True
    copy_packets(source, target, "matroska", times, called, taken=is_taken)
    return RemuxResult(len(taken), codec, copied=True)


@cache
def _codecs_of_matroska() -> frozenset[str]:
    """Names of the codecs that can be put into Matroska."""
    with open_container(BytesIO(), "matroska") as container:
        return frozenset(container.supported_codecs)


def can_be_cut(index: VideoIndex, taken: Int64Array) -> bool:
    """Whether some images of a video can be decoded without the others.

    An image needs what is stored from its key frame up to it, and nothing else.

    Args:
        index: the list of the video's images.
        taken: which images, by the order in which they are shown.
    """
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
    fps: float | None = None,
    timestamps_seconds: Sequence[float] | Float64Array | None = None,
    count: int | None = None,
    crop_to_even: bool = False,
) -> RemuxResult:
    """Encode images as H.264 in mp4, one at a time; the first is shown at 0.

    Args:
        images: (height, width, 3) uint8 each, red green blue, all of one size.
        target: a path or a seekable binary file.
        fps: nominal images a second; None for what the times state.
        timestamps_seconds: when each image is shown, strictly increasing; None for even steps at `fps`.
        count: how many images there are; needed only where there are no times, for the tables to stand first.
        crop_to_even: cut off the last line of an odd side; else odd sizes are refused.

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
    if crop_to_even:
        height, width = height - height % 2, width - width % 2
    most = count if timestamps is None else len(timestamps)
    rate = fps or _mean_rate(timestamps)
    with VideoWriter(target, width, height, rate, container="mp4", images=most) as writer:
        for rgb, seconds in _with_times(chain([first], remaining), timestamps):
            writer.add(rgb[:height, :width], seconds)
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


def _timestamps_of(reader: VideoReader, chosen: Sequence[int]) -> Float64Array | None:
    return reader.timestamps[np.asarray(chosen, np.int64)] if reader.index.timed else None


def _mean_rate(timestamps: Float64Array | None) -> float:
    if timestamps is None or len(timestamps) < 2 or not timestamps[-1] > timestamps[0]:
        return _DEFAULT_FPS
    return (len(timestamps) - 1) / float(timestamps[-1] - timestamps[0])


def _with_times(
    images: Iterable[UInt8Array], timestamps: Float64Array | None
) -> Iterator[tuple[UInt8Array, float | None]]:
    if timestamps is None:
        yield from ((rgb, None) for rgb in images)
        return
    count = 0
    for rgb in images:
        if count < len(timestamps):
            yield rgb, float(timestamps[count])
        count += 1
    check_count(len(timestamps), count)
