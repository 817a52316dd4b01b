"""Which line of `data.jsonl` a sample stands in: looked up only once something is wrong with one."""

from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.lines import iter_lines

LINED_KEYS = ("gps", "rtkgps", "barometer")
"""Root keys of lines that are a stream each; those of `sensor` lines go by their type."""


class _Typed(msgspec.Struct, gc=False):
    type: str = ""


class _Head(msgspec.Struct, gc=False):
    """Of a line only what tells its stream and its time."""

    time: float | None = None
    sensor: _Typed | None = None
    gps: msgspec.Raw = msgspec.Raw()
    rtkgps: msgspec.Raw = msgspec.Raw()
    barometer: msgspec.Raw = msgspec.Raw()


_decode = msgspec.json.Decoder(_Head).decode


@dataclass(frozen=True, slots=True, eq=False)
class LineNumbers:
    """Numbers and times of the lines of each stream, those that were not taken included.

    Attributes:
        numbers: by stream.
        seconds: by stream [s].
    """

    numbers: dict[str, list[int]] = field(default_factory=dict)
    seconds: dict[str, list[float]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> "LineNumbers":
        """Read all lines once more; of a file that cannot be read, none."""
        found = cls()
        try:
            with path.open("rb") as file:
                for number, text in enumerate(iter_lines(file, path), start=1):
                    found._take(text, number)
        except (OSError, DataError):
            return cls()
        return found

    def _take(self, text: bytes, number: int) -> None:
        try:
            head = _decode(text)
        except DECODER_FAULTS:
            return
        if head.time is None:
            return
        named = [head.sensor.type] if head.sensor is not None else []
        named += [key for key in LINED_KEYS if len(getattr(head, key))]
        for name in named:
            self.numbers.setdefault(name, []).append(number)
            self.seconds.setdefault(name, []).append(head.time)

    def of(self, name: str, seconds: Float64Array) -> Int64Array | None:
        """Give the line of each sample of a stream, (N,) int64, or None where lines and samples do not agree.

        Args:
            name: of the stream.
            seconds: (N,) times of its samples in the order of the file [s].
        """
        numbers, times = np.array(self.numbers.get(name, ()), np.int64), self.seconds.get(name, [])
        if len(times) != len(seconds):
            kept = _taken(times, seconds)
            if kept is None:
                return None
            numbers, times = numbers[kept], [times[row] for row in kept]
        return numbers if np.array_equal(np.array(times, np.float64), seconds) else None


def _taken(times: list[float], seconds: Float64Array) -> list[int] | None:
    """Which lines became samples: the first that fit, in order."""
    rows: list[int] = []
    wanted = iter(seconds.tolist())
    expected = next(wanted, None)
    for row, time in enumerate(times):
        if expected is None:
            break
        if time == expected:
            rows.append(row)
            expected = next(wanted, None)
    return rows if expected is None else None
