"""Logs of a satellite receiver as NMEA 0183: lines such as `$GNGGA,…*5D`. Only read."""

import re
from pathlib import Path

from sceneloom.formats.base.spec import FormatSpec, first_bytes

_POSITION = re.compile(rb"(^|[\r\n])\$[A-Z]{2}(GGA|RMC),")
_BEGINNING = 16_384


def _sniff(path: Path) -> bool:
    """Whether the beginning of a file has a sentence with a position."""
    return path.is_file() and _POSITION.search(first_bytes(path, _BEGINNING)) is not None


FORMAT = FormatSpec(
    name="nmea",
    title="a log of NMEA 0183",
    looks_like="a file of lines such as $GNGGA,…*5D and $GNRMC,…*4A, as satellite receivers send them",
    suffixes=(".nmea",),
    sniff=_sniff,
    reader="sceneloom.formats.nmea.reader:read_nmea",
    read_options=("lenient",),
    instead="a log of NMEA 0183 is only read; write a recording (a folder), or its fixes (`--to gnss`)",
)
