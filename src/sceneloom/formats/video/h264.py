"""What has to be known of H.264 to put newly encoded groups of pictures between copied ones."""

from collections.abc import Iterator
from dataclasses import dataclass

_IDR, _SEI, _SPS, _PPS = 5, 6, 7, 8
_SLICES = range(1, 6)
_WITH_CHROMA = frozenset({100, 110, 122, 144})
"""Profiles whose record says the kind of colours, too. Source: ISO/IEC 14496-15, 5.3.3.1.2."""

_USER_DATA = frozenset({4, 5})
"""Messages whose content is anybody's: cameras put places and names there. Source: H.264, annex D."""


@dataclass(frozen=True, slots=True)
class ParameterSets:
    """The decoder configuration of a stream ("avcC").

    Attributes:
        sequence, picture: the parameter sets, each with its header byte.
        length_size: bytes of the number before each unit of a packet.

    Source: ISO/IEC 14496-15, 5.3.3.1.2.
    """

    sequence: tuple[bytes, ...]
    picture: tuple[bytes, ...]
    length_size: int = 4

    @classmethod
    def of_record(cls, record: bytes) -> "ParameterSets | None":
        """Parse the configuration of an mp4 or Matroska file; None where it is of another kind."""
        if len(record) < 7 or record[0] != 1:
            return None
        position, groups = 5, []
        for mask in (0x1F, 0xFF):
            units = []
            if position >= len(record):
                return None
            count = record[position] & mask
            position += 1
            for _ in range(count):
                length = int.from_bytes(record[position : position + 2])
                units.append(record[position + 2 : position + 2 + length])
                position += 2 + length
            groups.append(tuple(units))
        whole = position <= len(record) and all(groups[0]) and all(groups[1]) and groups[0]
        return cls(groups[0], groups[1], (record[4] & 3) + 1) if whole else None

    def record(self) -> bytes:
        """Format the configuration, with the profile and level that hold for all sets."""
        profile = max(unit[1] for unit in self.sequence)
        level = max(unit[3] for unit in self.sequence)
        alike = len({unit[1:3] for unit in self.sequence}) == 1
        head = bytes((1, profile, self.sequence[0][2] if alike else 0, level, 0xFC | (self.length_size - 1)))
        tail = bytes((0xFD, 0xF8, 0xF8, 0)) if profile in _WITH_CHROMA else b""
        return head + b"".join((_listed(self.sequence, 0xE0), _listed(self.picture, 0), tail))


def _listed(units: tuple[bytes, ...], mark: int) -> bytes:
    return bytes((mark | len(units),)) + b"".join(len(unit).to_bytes(2) + unit for unit in units)


def parameter_sets_of(encoder_header: bytes) -> ParameterSets:
    """Find the parameter sets in what an encoder puts before its stream, with start codes."""
    units = tuple(_after_start_codes(encoder_header))
    return ParameterSets(
        tuple(unit for unit in units if unit[0] & 31 == _SPS),
        tuple(unit for unit in units if unit[0] & 31 == _PPS),
    )


def _after_start_codes(content: bytes) -> Iterator[bytes]:
    """The units of a stream with start codes. Source: H.264, annex B."""
    for piece in content.split(b"\x00\x00\x01")[1:]:
        unit = piece.rstrip(b"\x00")
        if unit:
            yield unit


def packet_of(encoded: bytes, length_size: int) -> bytes:
    """Bring an encoder's packet with start codes into the form of files: only pictures, each unit after its length."""
    units = (unit for unit in _after_start_codes(encoded) if unit[0] & 31 in _SLICES)
    return b"".join(len(unit).to_bytes(length_size) + unit for unit in units)


def units_of(packet: bytes, length_size: int) -> list[bytes] | None:
    """The units of a file's packet; None where it is not made so."""
    units, position = [], 0
    while position < len(packet):
        length = int.from_bytes(packet[position : position + length_size])
        unit = packet[position + length_size : position + length_size + length]
        if len(unit) != length or not length:
            return None
        units.append(unit)
        position += length_size + length
    return units


def starts_anew(units: list[bytes]) -> bool:
    """Whether nothing after a picture leans on anything before it."""
    slices = [unit[0] & 31 for unit in units if unit[0] & 31 in _SLICES]
    return bool(slices) and all(kind == _IDR for kind in slices)


def is_parameter_set(unit: bytes) -> bool:
    """Whether a unit says how pictures are coded, in place of holding one."""
    return unit[0] & 31 in {_SPS, _PPS}


def identifier_of(unit: bytes) -> int:
    """The number of a parameter set. Source: H.264, 7.3.2.1.1 and 7.3.2.2."""
    bits = "".join(f"{byte:08b}" for byte in unit[4 if unit[0] & 31 == _SPS else 1 :][:9])
    zeros = len(bits) - len(bits.lstrip("0"))
    return int(bits[zeros : 2 * zeros + 1], 2) - 1


def without_user_data(units: list[bytes], length_size: int) -> tuple[bytes, int]:
    """Give a packet without messages of anybody's content, and how many units of them there were."""
    kept = [unit for unit in units if not _is_user_data(unit)]
    content = b"".join(len(unit).to_bytes(length_size) + unit for unit in kept)
    return content, len(units) - len(kept)


def _is_user_data(unit: bytes) -> bool:
    """Whether a unit begins with such a message; encoders put each into a unit of its own."""
    return unit[0] & 31 == _SEI and len(unit) > 1 and unit[1] in _USER_DATA
