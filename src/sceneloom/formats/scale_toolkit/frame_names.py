"""The names of frames, which clouds, images and poses share, and the times that they stand for."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.scene.warnings import WarningKind

_UNITS = ((18, 20, 1, "nanoseconds"), (15, 18, 1_000, "microseconds"), (12, 15, 1_000_000, "milliseconds"))
"""From so many digits up to so many a name is a time since 1970 in a unit of so many nanoseconds."""

_SECOND = 1_000_000_000


def frame_names(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """The files of a folder by their names without ending: whole numbers in their order, else as texts.

    Raises:
        DataError: two files share a name.
    """
    found: dict[str, Path] = {}
    files = [file for file in folder.iterdir() if file.suffix.lower() in suffixes] if folder.is_dir() else []
    for file in sorted(files):
        if file.stem in found:
            raise DataError(file, "", f"{found[file.stem].name} is of the same frame; expected one of both")
        found[file.stem] = file
    return {name: found[name] for name in sorted(found, key=_order)}


def _order(name: str) -> tuple[int, int, str]:
    return (0, int(name), name) if _is_number(name) else (1, 0, name)


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) < 20 and int(name) < 1 << 63


def times_of(names: Sequence[str], rate_hz: float | None, location: Path, ledger: Ledger) -> Int64Array:
    """The times of frames [ns], by their names where these are times, else so many a second.

    Args:
        names: of the frames, in order.
        rate_hz: frames a second; None: 10, unless the names are times.
        location: the folder, for messages.
        ledger: takes what is assumed.

    Raises:
        DataError: two names stand for one time.
    """
    lengths = {len(name) for name in names}
    numbers = all(map(_is_number, names))
    if numbers and rate_hz is None and len(lengths) == 1:
        for low, high, unit_ns, word in _UNITS:
            if low <= min(lengths) < high:
                ledger.note(
                    WarningKind.ASSUMED, "names-are-times", str(location), f"names of frames are {word}"
                )
                return _ascending(
                    np.array([int(name) * unit_ns for name in names], np.int64), names, location
                )
    period_ns = round(_SECOND / (10.0 if rate_hz is None else rate_hz))
    if rate_hz is None:
        message = "the folder has no times; 10 frames a second, from 0"
        ledger.note(WarningKind.ASSUMED, "nominal-times", str(location), message, count=len(names))
    counts = [int(name) - int(names[0]) for name in names] if numbers else range(len(names))
    if numbers and counts and counts[-1] > _LONGEST:
        raise DataError(
            location, names[-1], f"frame {names[-1]} after {names[0]}; expected numbers of frames"
        )
    return _ascending(np.array(counts, np.int64) * period_ns, names, location)


_LONGEST = 10_000_000
"""No drive has more frames than this."""


def _ascending(timestamps_ns: Int64Array, names: Sequence[str], location: Path) -> Int64Array:
    same = np.flatnonzero(timestamps_ns[1:] <= timestamps_ns[:-1])
    if len(same):
        k = int(same[0])
        raise DataError(location, names[k + 1], f"stands for the same time as {names[k]}; expected another")
    return timestamps_ns
