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
from sceneloom.formats.rig.stamps import StampError, parse_stamp
from sceneloom.scene.notices import NoticeKind


@dataclass(frozen=True, slots=True, eq=False)
class StampFile:
    """The times of one stream.

    Attributes:
        path: the file.
        values_ns: (N,) int64 [ns], by number of the frame.
        told: (N,) bool, false where the line is blank: the frame is not there.
    """

    path: Path
    values_ns: Int64Array
    told: BoolArray

    @classmethod
    def read(cls, path: Path) -> "StampFile":
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
                values[k] = parse_stamp(" ".join(line.words), None) if line.words else 0
            except StampError as error:
                raise line.fault(str(error)) from None
        return cls(path, values, np.array([bool(line.words) for line in lines], np.bool_))


def stamped(files: NumberedFiles, stamps: StampFile, ledger: Ledger) -> NumberedFiles:
    """The files that have a time; frames without a file between others are left out with a notice.

    Raises:
        DataError: files are missing at the end, or one has no time.
    """
    count = len(stamps.values_ns)
    files = frames_within(files, count, stamps.path, ledger)
    untold = [number for number in files.numbers.tolist() if not stamps.told[number]]
    if untold:
        fault = DataError(
            stamps.path, f"line {untold[0] + 1}", "is blank; expected the time of a file that is there"
        )
        ledger.fault("files-without-time", fault, count=len(untold))
        files = files.only([bool(stamps.told[number]) for number in files.numbers.tolist()])
    missing = np.setdiff1d(np.flatnonzero(stamps.told), files.numbers)
    if len(missing) and (not len(files) or missing[-1] > files.numbers[-1]):
        problem = (
            f"{len(files)} files for {count} times of {stamps.path.name}, the last of them is missing (number "
            f"{int(missing[-1])}); expected as many"
        )
        ledger.fault("counts-disagree", DataError(files.folder, "", problem), count=len(missing))
    elif len(missing):
        message = f"frames without a file, number {int(missing[0])} the first of them"
        ledger.note(NoticeKind.SKIPPED, "frames-missing", str(files.folder), message, count=len(missing))
    return files


def in_order(numbers: Int64Array, stamps: StampFile, ledger: Ledger) -> Int64Array:
    """Give the rows of numbers in the order of their times; of two of one time the first stays."""
    times = stamps.values_ns[numbers]
    _, rows = np.unique(times, return_index=True)
    back = int((np.diff(times) < 0).sum())
    if back:
        message = "times run backwards in the order of the numbers; sorted by time"
        ledger.note(NoticeKind.REPAIRED, "files-sorted", str(stamps.path), message, count=back)
    if len(rows) < len(numbers):
        message, lost = "frames with the time of another one", len(numbers) - len(rows)
        ledger.note(NoticeKind.SKIPPED, "repeated-times", str(stamps.path), message, count=lost)
    return rows.astype(np.int64)


def format_stamp(timestamp_ns: int) -> str:
    """Write a time as KITTI does, all nine digits of the second: `2011-09-26 13:02:25.594360375`."""
    seconds, nanoseconds = divmod(timestamp_ns, 10**9)
    moment = datetime.fromtimestamp(seconds, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{nanoseconds:09d}"
