"""The videos of a file: the boxes of mp4, and what is left of videos that were cut off."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.base.files import Bytes
from sceneloom.formats.sfs.container import Container, ItemFault
from sceneloom.formats.sfs.records import Location

if TYPE_CHECKING:
    from av.video.stream import VideoStream

    from sceneloom.formats.video.reader import OpenVideo

UNKNOWN_CODEC = "unknown"


def is_mp4(content: Bytes) -> bool:
    """Whether the bytes begin as an mp4 file does; QuickTime's own brand is another format."""
    return bytes(content[4:8]) == b"ftyp" and bytes(content[8:12]) != b"qt  "


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


@dataclass(frozen=True, slots=True)
class DamagedVideo:
    """A video that was cut, or cannot be read.

    Attributes:
        problem: what is wrong, and how many images are whole.
        lost_bytes: how many bytes are not there; 0 where that is not known.
        kept: which of its images are whole and are in the header in its location.
        count: how many images it had.
    """

    problem: str
    lost_bytes: int
    kept: Sequence[int] = ()
    count: int = 0


def damaged_videos(container: Container) -> dict[Location, tuple[Any, int, str]]:
    """Look at the tables of all videos of a file: which have bytes that end before their last image.

    Returns:
        Content, declared length and problem of each video that is cut or no video, by the position of its content.
    """
    found: dict[Location, tuple[Any, int, str]] = {}
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
    from sceneloom.formats.video.reader import read_index, read_table_index

    try:
        index = read_table_index(there, "video") if is_mp4(there) else read_index(there, "video")
    except DataError as error:
        return error.problem
    return None if len(index) else "a video without images"


def rescue_videos(container: Container, items: Sequence[ItemFault]) -> dict[Location, DamagedVideo]:
    """Put what is left of videos that were cut into their locations of the header.

    Args:
        container: the file, on disk; its header is changed.
        items: what is wrong with its arrays.

    Returns:
        The videos that are damaged, by the position of their content; those that nothing is left of stay as they are.
    """
    damaged = damaged_videos(container)
    for fault in items:
        keys = container.item_keys(fault.number) or ()
        if keys[-2:] == ("video", "content"):
            item = container.item(fault.number)
            offset, length = item.get("offset"), item.get("length")
            if type(offset) is int and type(length) is int and offset >= 0:
                there = container.bytes_between(offset, offset + length)
                if 0 < len(there) < length:
                    damaged[keys] = there, length, _cut(there, length)
    return {keys: _rescued(container.header, keys, *content) for keys, content in damaged.items()}


def _rescued(header: dict[str, Any], keys: Location, there: memoryview, length: int, why: str) -> DamagedVideo:
    sensor: Any = header
    for key in keys[:-2]:
        sensor = sensor[key]
    video = sensor["video"]
    timestamps = video.get("timestamps")
    missing = length - len(there)
    lost = DamagedVideo(why, missing)
    if not isinstance(timestamps, list) or not missing:
        return lost
    try:
        content, kept, count = _rescue_video(there, length)
    except DataError:
        return lost
    if count != len(timestamps):
        return lost
    video["content"] = np.frombuffer(content, np.uint8)
    video["timestamps"] = [timestamps[k] for k in kept]
    problem = f"the video was cut: {len(kept)} of its {count} images are whole"
    return DamagedVideo(problem, missing, kept, count)


class _CutBytes:
    """Bytes of which only the first ones are there; the others are NULs."""

    def __init__(self, there: memoryview, length: int) -> None:
        self._there, self._length = there, length

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, part: slice) -> bytes:
        start, stop, _ = part.indices(self._length)
        piece = bytes(self._there[start:stop])
        return piece + bytes(max(0, stop - start) - len(piece))


def _rescue_video(there: memoryview, length: int) -> tuple[bytes, list[int], int]:
    """A video of the packets before the first damaged one; which images of the original it has, of how many."""
    from sceneloom.formats.video.reader import (
        BY_TABLES,
        OpenVideo,
        decoder_faults,
        open_hollow,
        read_index,
        read_table_index,
    )

    name = "video"
    whole = _CutBytes(there, length)
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

    from sceneloom.formats.video.reader import BY_TABLES, OpenVideo

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
