"""What an mp4 file says about its video before any decoder is loaded."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from sceneloom.formats.byte_stream import Bytes

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


UNKNOWN_CODEC = "unknown"
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
    return UNKNOWN_CODEC


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
