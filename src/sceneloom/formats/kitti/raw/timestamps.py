"""Times of KITTI's raw data: a date and a time of day to the nanosecond in each line, by the frames' numbers."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.kitti.number_lines import read_lines
from sceneloom.formats.kitti.scenes.numbered import NumberedFiles, frames_within
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.timestamps import TimestampError, parse_timestamp
from sceneloom.scene.warnings import WarningKind


@dataclass(frozen=True, slots=True, eq=False)
class TimestampFile:
    """The times of one stream.

    Attributes:
        path: the file.
        values_ns: (N,) int64 [ns], by number of the frame.
        reported: (N,) bool, false where the line is blank: the frame is not there.
    """

    path: Path
    values_ns: Int64Array
    reported: BoolArray

    @classmethod
    def read(cls, path: Path) -> "TimestampFile":
        """Read a file of times.

        Raises:
            DataError: it is missing or empty, or a line is no time.
        """
        if not path.is_file():
            raise DataError(path, "", "is missing; expected the time of each frame, a line each")
        lines = read_lines(path)
        if not lines:
            raise DataError(path, "", "is empty; expected the time of each frame, a line each")
        values = np.zeros(len(lines), np.int64)
        for k, line in enumerate(lines):
            try:
                values[k] = parse_timestamp(" ".join(line.words), None) if line.words else 0
            except TimestampError as error:
                raise line.fault(str(error)) from None
        return cls(path, values, np.array([bool(line.words) for line in lines], np.bool_))


def timestamped(files: NumberedFiles, timestamps: TimestampFile, ledger: Ledger) -> NumberedFiles:
    """The files that have a time; frames without a file between others are left out with a warning.

    Raises:
        DataError: files are missing at the end, or one has no time.
    """
    count = len(timestamps.values_ns)
    files = frames_within(files, count, timestamps.path, ledger)
    untold = [number for number in files.numbers.tolist() if not timestamps.reported[number]]
    if untold:
        fault = DataError(
            timestamps.path, f"line {untold[0] + 1}", "is blank; expected the time of a file that is there"
        )
        ledger.fault("files-without-time", fault, count=len(untold))
        files = files.only([bool(timestamps.reported[number]) for number in files.numbers.tolist()])
    missing = np.setdiff1d(np.flatnonzero(timestamps.reported), files.numbers)
    if len(missing) and (not len(files) or missing[-1] > files.numbers[-1]):
        problem = (
            f"{len(files)} files for {count} times of {timestamps.path.name}, the last of them is missing (number "
            f"{int(missing[-1])}); expected as many"
        )
        ledger.fault("counts-disagree", DataError(files.folder, "", problem), count=len(missing))
    elif len(missing):
        message = f"frames without a file, number {int(missing[0])} the first of them"
        ledger.note(WarningKind.SKIPPED, "frames-missing", str(files.folder), message, count=len(missing))
    return files


def in_order(numbers: Int64Array, timestamps: TimestampFile, ledger: Ledger) -> Int64Array:
    """Give the rows of numbers in the order of their times; of two of one time the first stays."""
    times = timestamps.values_ns[numbers]
    _, rows = np.unique(times, return_index=True)
    back = int((np.diff(times) < 0).sum())
    if back:
        message = "times run backwards in the order of the numbers; sorted by time"
        ledger.note(WarningKind.REPAIRED, "files-sorted", str(timestamps.path), message, count=back)
    if len(rows) < len(numbers):
        message, lost = "frames with the time of another one", len(numbers) - len(rows)
        ledger.note(WarningKind.SKIPPED, "repeated-times", str(timestamps.path), message, count=lost)
    return rows.astype(np.int64)


def format_timestamp(timestamp_ns: int) -> str:
    """Write a time as KITTI does, all nine digits of the second: `2011-09-26 13:02:25.594360375`."""
    seconds, nanoseconds = divmod(timestamp_ns, 10**9)
    moment = datetime.fromtimestamp(seconds, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{nanoseconds:09d}"
