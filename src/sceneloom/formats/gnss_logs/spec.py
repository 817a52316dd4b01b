"""Logs of satellite receivers: NMEA 0183, UBX of u-blox, and positions of RTKLIB. Only read."""

import re
from pathlib import Path

from sceneloom.formats.base.spec import FormatSpec, first_bytes

_POSITION = re.compile(rb"(^|[^ -~])\$([A-Z]{2}(GGA|RMC|GNS|GLL)|PUBX,00),")
_POS_HEAD = re.compile(rb"^%.*\b(latitude\((deg|d'\")\)|x-ecef\(m\)|e-baseline\(m\)).*\bQ\b.*$", re.MULTILINE)
_POS_LINE = re.compile(rb"(\d{4}/\d{2}/\d{2}[ ,;\t]+\d{2}:\d{2}:|\d{1,4}[ ,;\t]+\d+\.\d+)[^%$a-zA-Z]{80}")
_BEGINNING = 65_536


def _has_frame(beginning: bytes) -> bool:
    """Whether there is a UBX frame with the right checksum."""
    start = beginning.find(b"\xb5\x62")
    while start >= 0:
        stop = start + 6 + int.from_bytes(beginning[start + 4 : start + 6], "little")
        body, stated = beginning[start + 2 : stop], beginning[stop : stop + 2]
        if len(stated) == 2:
            low = high = 0
            for byte in body:
                low = low + byte & 255
                high = high + low & 255
            if stated == bytes((low, high)):
                return True
        start = beginning.find(b"\xb5\x62", start + 2)
    return False


def _sniff_ubx(path: Path) -> bool:
    return path.is_file() and _has_frame(first_bytes(path, _BEGINNING))


def _sniff_nmea(path: Path) -> bool:
    """Whether the beginning of a file has a sentence with a position, and no frame of UBX."""
    if not path.is_file():
        return False
    beginning = first_bytes(path, _BEGINNING)
    return _POSITION.search(beginning) is not None and not _has_frame(beginning)


def _sniff_rtklib(path: Path) -> bool:
    """Whether a file has the names of columns that RTKLIB writes, or by its name is one of it without them."""
    if not path.is_file():
        return False
    beginning = first_bytes(path, _BEGINNING)
    named = path.suffix.lower() == ".pos" and _POS_LINE.match(beginning.lstrip()) is not None
    return named or _POS_HEAD.search(beginning) is not None


_INSTEAD = "is only read; write a recording (a folder), or its fixes (`--to gnss`)"

NMEA = FormatSpec(
    name="nmea",
    title="a log of NMEA 0183",
    looks_like="a file of lines such as $GNGGA,…*5D and $GNRMC,…*4A, as satellite receivers send them",
    suffixes=(".nmea",),
    sniff=_sniff_nmea,
    reader="sceneloom.formats.gnss_logs.receiver:read_log",
    read_options=("lenient",),
    given={"name": "nmea"},
    instead=f"a log of NMEA 0183 {_INSTEAD}",
)

UBX = FormatSpec(
    name="ubx",
    title="a log of UBX",
    looks_like="a file with UBX frames of u-blox, which begin with the bytes B5 62; also between other messages",
    suffixes=(".ubx",),
    sniff=_sniff_ubx,
    reader="sceneloom.formats.gnss_logs.receiver:read_log",
    read_options=("lenient",),
    given={"name": "ubx"},
    instead=f"a log of UBX {_INSTEAD}",
)

RTKLIB = FormatSpec(
    name="rtklib",
    title="positions of RTKLIB",
    looks_like="a .pos file: lines that begin with %, then a time, three coordinates, Q, ns and deviations a line",
    suffixes=(".pos",),
    sniff=_sniff_rtklib,
    reader="sceneloom.formats.gnss_logs.rtklib:read_pos",
    read_options=("lenient",),
    instead=f"a file of RTKLIB {_INSTEAD}",
)
