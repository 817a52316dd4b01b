"""What is left of videos in damaged files: the pictures whose packets are whole, and why others cannot be written."""

import io
from typing import TYPE_CHECKING, Any

from sceneloom.errors import DataError
from sceneloom.formats.sfs.mp4 import UNKNOWN_CODEC
from sceneloom.scene import CameraSensor

if TYPE_CHECKING:
    from av.video.stream import VideoStream

    from sceneloom.formats.video.source import OpenVideo


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
        A video of these packets, which pictures of the original it holds, in the order of their times, and how many
        the original had.

    Raises:
        DataError: its tables are lost, or no picture is whole.
    """
    from sceneloom.formats.video.index import read_index
    from sceneloom.formats.video.source import OpenVideo, decoder_faults
    from sceneloom.formats.video.table_index import BY_TABLES, open_hollow, read_table_index

    name = "video"
    whole = CutBytes(there, length)
    index = read_table_index(whole, name)
    if not index.timed:
        raise DataError(name, "", "does not say when its pictures are shown")
    opened = OpenVideo(lambda: open_hollow(whole), name, options=BY_TABLES)
    try:
        with decoder_faults(name, ""):
            shown = _whole_packets(opened, len(there))
    finally:
        opened.close()
    kept = sorted(k for k in (index.find(pts) for pts in shown) if k is not None)
    if not kept or len(kept) != len(shown):
        raise DataError(name, "", "no picture of it is whole")
    with decoder_faults(name, ""):
        content = _copied(there, len(shown))
    if len(read_index(content, name)) != len(kept):
        raise DataError(name, "", "its whole pictures cannot be told from the others")
    return content, kept, len(index)


def _whole_packets(opened: "OpenVideo", available: int) -> list[int | None]:
    """When the pictures of the first packets are shown, up to the first packet that is not whole [ticks]."""
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

    from sceneloom.formats.video.source import OpenVideo
    from sceneloom.formats.video.table_index import BY_TABLES

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

    if camera.video is None or not len(camera.pictures):
        return None
    try:
        camera.pictures[0]  # opens the video
        if camera.video.codec != UNKNOWN_CODEC:
            return None
        count = len(read_index(camera.video.open, "video"))
    except DataError as error:
        return error.problem
    stamps = len(camera.pictures)
    return None if count == stamps else f"{count} pictures; expected {stamps} as its time stamps"
