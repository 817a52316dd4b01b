"""JPEG and PNG files without what they state besides the image: locations, times, devices.

Small copies of themselves.
"""

from collections.abc import Iterator

from sceneloom.errors import DataError

JPEG_START, PNG_START = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"

_KEPT_CHUNKS = frozenset(
    {
        b"IHDR",
        b"PLTE",
        b"IDAT",
        b"IEND",
        b"tRNS",
        b"gAMA",
        b"cHRM",
        b"sRGB",
        b"iCCP",
        b"sBIT",
        b"bKGD",
        b"cICP",
    }
)
"""What a PNG file needs to show its image in its colours. Source: PNG, 3rd edition, 11.2 and 11.3."""

_APPLICATIONS, _COMMENT = range(0xE0, 0xF0), 0xFE
_SCAN, _STOP, _RESTARTS = 0xDA, 0xD9, range(0xD0, 0xD8)
_ADOBE, _PROFILE = 0xEE, 0xE2


def without_metadata(content: bytes, *, name: str = "image") -> tuple[bytes, tuple[str, ...]]:
    """Give an image's file without anything that its pixels do not need; they stay bit by bit.

    Args:
        content: a JPEG or PNG file.
        name: what messages call it.

    Returns:
        The file, and what was left out of it: "APP1", "COM", "eXIf", "after the end", …

    Raises:
        DataError: it is neither, or its parts do not follow one another as they must.

    Source: ITU-T T.81, annex B; PNG, 3rd edition, 5.3.
    """
    if content.startswith(PNG_START):
        parts = _png_parts(content, name)
    elif content.startswith(JPEG_START):
        parts = _jpeg_parts(content, name)
    else:
        raise DataError(name, "", "is neither JPEG nor PNG, so what it says of itself cannot be left out")
    kept, left_out = [], []
    for part, called in parts:
        if called:
            left_out.append(called)
        else:
            kept.append(part)
    return b"".join(kept), tuple(left_out)


def _png_parts(content: bytes, name: str) -> Iterator[tuple[bytes, str]]:
    """The parts of a file, each with its name if it is to be left out."""
    yield PNG_START, ""
    position = len(PNG_START)
    while position < len(content):
        length = int.from_bytes(content[position : position + 4])
        kind = content[position + 4 : position + 8]
        stop = position + 12 + length
        if stop > len(content) or len(kind) < 4:
            raise DataError(name, f"byte {position}", "the file ends within a part of it")
        yield content[position:stop], "" if kind in _KEPT_CHUNKS else kind.decode("latin-1")
        position = stop
        if kind == b"IEND":
            break
    else:
        raise DataError(name, "", "the file has no end")
    if position < len(content):
        yield content[position:], "after the end"


def _jpeg_parts(content: bytes, name: str) -> Iterator[tuple[bytes, str]]:
    """The segments of a file, each with its name if it is to be left out."""
    yield content[:2], ""
    position = 2
    while True:
        while content[position : position + 2] == b"\xff\xff":
            position += 1
        if position + 2 > len(content):
            # broken off after the image's data: decoders show it
            return
        if content[position] != 0xFF:
            raise DataError(name, f"byte {position}", f"{content[position]:#04x}; expected a marker")
        marker = content[position + 1]
        if marker == _STOP:
            yield content[position : position + 2], ""
            break
        stop = position + 2 + int.from_bytes(content[position + 2 : position + 4])
        if stop > len(content) or stop < position + 4:
            raise DataError(name, f"byte {position}", "the file ends within a segment")
        yield content[position:stop], _segment_name(marker, content[position + 4 : stop])
        position = stop
        if marker == _SCAN:
            stop = _scan_end(content, position)
            yield content[position:stop], ""
            position = stop
    if position + 2 < len(content):
        yield content[position + 2 :], "after the end"


def _segment_name(marker: int, payload: bytes) -> str:
    """What a segment is called that an image's colours do not need; nothing for one that they do."""
    if marker == _COMMENT:
        return "COM"
    if marker not in _APPLICATIONS:
        return ""
    needed = (marker == _ADOBE and payload.startswith(b"Adobe")) or (
        marker == _PROFILE and payload.startswith(b"ICC_PROFILE")
    )
    # the plain head says the shape of pixels; with a small image in it, it is left out
    plain = marker == _APPLICATIONS[0] and payload.startswith(b"JFIF") and len(payload) == 14
    return "" if needed or plain else f"APP{marker - _APPLICATIONS[0]}"


def _scan_end(content: bytes, position: int) -> int:
    """Where the data of a scan end: at the next marker that is none of its own."""
    while True:
        position = content.find(b"\xff", position)
        if position < 0 or position + 1 >= len(content):
            return len(content)
        marker = content[position + 1]
        if marker != 0 and marker not in _RESTARTS and marker != 0xFF:
            return position
        position += 1 if marker == 0xFF else 2
