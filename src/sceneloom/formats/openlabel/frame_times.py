"""When the frames of a file are of."""

from dataclasses import dataclass

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.clouds.points import UNITS_NS
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.rig.timestamps import TimestampError, parse_timestamp
from sceneloom.scene.warnings import WarningKind

DEFAULT_RATE_HZ = 10.0
_FARTHEST_NS = 9_200_000_000_000_000_000
_EPOCHS = (("nanoseconds", 1e17), ("microseconds", 1e14), ("milliseconds", 1e11))
"""Numbers from here on are times of our day in that unit; smaller ones are seconds."""


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """The times of the frames.

    Attributes:
        by_number: time of each frame [ns].
    """

    by_number: dict[int, int]

    @property
    def first_ns(self) -> int:
        """The earliest time; 0 where there are no frames."""
        return min(self.by_number.values(), default=0)

    def at(self, number: int) -> int:
        """The time of a frame [ns], from its neighbours where it is not in the file."""
        if number in self.by_number:
            return self.by_number[number]
        if not self.by_number:
            return round(number * 1e9 / DEFAULT_RATE_HZ)
        numbers = np.array(sorted(self.by_number))
        nearest = int(numbers[np.argmin(np.abs(numbers - number))])
        return self.by_number[nearest] + round((number - nearest) * 1e9 / DEFAULT_RATE_HZ)


def frame_times(document: Part, ledger: Ledger, rate_hz: float | None) -> FrameTimes:
    """Read the times of all frames; those without one are counted.

    Raises:
        DataError: a frame's key is no number, or its time is none.
    """
    known: dict[int, int] = {}
    missing: list[int] = []
    for key, frame in document.each("frames"):
        if not (key.isascii() and key.isdigit() and len(key) < 16):
            ledger.fault(
                "frame-numbers",
                DataError(document.file, frame.location, "expected a whole number as its key"),
            )
            continue
        properties = frame.get("frame_properties")
        timestamp = None if properties is None else properties.get("timestamp")
        if timestamp is None:
            missing.append(int(key))
            continue
        known[int(key)] = timestamp_ns(timestamp)
    if missing:
        _count(missing, known, document, ledger, rate_hz)
    return FrameTimes(known)


def _count(
    missing: list[int], known: dict[int, int], document: Part, ledger: Ledger, rate_hz: float | None
) -> None:
    """Give frames without a time one: by their number, or with the known ones by their distance from these."""
    times = FrameTimes(dict(known))
    rate = rate_hz or DEFAULT_RATE_HZ
    for number in missing:
        known[number] = times.at(number) if times.by_number else round(number * 1e9 / rate)
    reported = f"frames have no timestamp; taken at {rate:g} Hz by number, `--input-option rate_hz=HZ` says another rate"
    ledger.note(
        WarningKind.ASSUMED,
        "frame-times-assumed",
        f"{document.file}: openlabel.frames",
        reported,
        count=len(missing),
    )


def timestamp_ns(timestamp: Part) -> int:
    """Read a time [ns]: a number or its text, in seconds, or another unit that makes it one of our day; or a date.

    Raises:
        DataError: it is none.
    """
    value = timestamp.value
    if isinstance(value, int | float) and not isinstance(value, bool):
        unit = next((name for name, least in _EPOCHS if abs(value) >= least), "seconds")
        time_ns = value * UNITS_NS[unit] if isinstance(value, int) else round(value * UNITS_NS[unit])
        if abs(time_ns) <= _FARTHEST_NS:
            return int(time_ns)
    if isinstance(value, str):
        whole = value.strip().lstrip("-").partition(".")[0]
        digits = len(whole) if whole.isdigit() else 0
        unit = next((name for name, least in _EPOCHS if digits > len(f"{least:.0f}") - 1), "seconds")
        try:
            return parse_timestamp(value, unit if digits else None)
        except TimestampError:
            pass
    raise timestamp.fault("a time in seconds, or a date as 2011-09-26T13:02:25.594Z")
