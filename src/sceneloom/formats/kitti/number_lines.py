"""Lines of numbers and words, as KITTI's text files have them, each known by its number in the file."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.ledger import Ledger

LARGEST = 1e9
"""Larger numbers are none of a drive: what is computed with them has no digits left."""

LATEST = 999_999
"""The largest number of a frame or a track: names of KITTI's files have six digits, and there is one entry a frame."""

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_SHOWN = 40


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a file, taken apart.

    Attributes:
        path: the file.
        number: of the line, from 1.
        words: its words.
    """

    path: Path
    number: int
    words: tuple[str, ...]

    def fault(self, problem: str) -> DataError:
        """What is wrong with it, reported with its location."""
        return DataError(self.path, f"line {self.number}", problem)

    def check_count(self, counts: Sequence[int], meaning: str) -> None:
        """Refuse a line with more or fewer words.

        Args:
            counts: how many there may be.
            meaning: what they are, for the message.

        Raises:
            DataError: it has another number of words.
        """
        if len(self.words) not in counts:
            expected = " or ".join(map(str, counts))
            raise self.fault(f"{len(self.words)} values; expected {expected}: {meaning}")

    def float_at(self, column: int, name: str) -> float:
        """A finite number.

        Raises:
            DataError: it is none, or is too large.
        """
        text = self.words[column]
        value = float(text) if _NUMBER.fullmatch(text) else float("nan")
        if not abs(value) <= LARGEST:
            raise self.fault(f"{name} {text[:_SHOWN]!r}; expected a number within ±{LARGEST:g}")
        return value

    def floats(self, first: int, names: Sequence[str]) -> list[float]:
        """As many finite numbers as there are names, from a column on.

        Raises:
            DataError: one is none, or is too large.
        """
        return [self.float_at(first + k, name) for k, name in enumerate(names)]

    def whole_at(self, column: int, name: str, *, low: int = 0) -> int:
        """A whole number of up to six digits, with or without a fraction of zeros.

        Raises:
            DataError: it is none, less than `low`, or larger.
        """
        value = self.float_at(column, name)
        if value != int(value) or not low <= value <= LATEST:
            shown = self.words[column][:_SHOWN]
            raise self.fault(f"{name} {shown!r}; expected a whole number from {low} to {LATEST}")
        return int(value)


def read_lines(path: Path, *, separator: str | None = None) -> list[Line]:
    """Read the lines of a file; blank ones at its end do not count.

    Args:
        separator: between values; None for blanks.

    Raises:
        DataError: it cannot be read, or is no text.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(path, f"byte {error.start}", "is no UTF-8 text") from error
    rows = text.replace("\r\n", "\n").rstrip().split("\n")
    if rows == [""]:
        return []
    return [
        Line(path, number, tuple(word.strip() for word in row.split(separator)) if row.strip() else ())
        for number, row in enumerate(rows, 1)
    ]


def sound_rows(
    lines: Sequence[Line], parse: "Parser", ledger: Ledger, code: str
) -> Iterator[tuple[Line, list[float]]]:
    """Take each line apart into numbers; a faulty one raises, or is left out in a lenient reading.

    Args:
        parse: gives the numbers of a line.
        ledger: reported faults.
        code: of the warning about them.

    Raises:
        DataError: a line is faulty, and the reading is not lenient.
    """
    for line in lines:
        try:
            row = parse(line)
        except DataError as error:
            ledger.fault(code, error)
            continue
        yield line, row


class Parser:
    """Takes lines of one layout apart: how many values they have, and what each is called."""

    def __init__(self, names: Sequence[str], *, whole: Sequence[str] = ()) -> None:
        """Remember the layout.

        Args:
            names: of the values, in their order.
            whole: which of them are whole numbers of 0 or more.
        """
        self._names = tuple(names)
        self._whole = {names.index(name): name for name in whole}
        self._meaning = ",".join(names)

    def __call__(self, line: Line) -> list[float]:
        """The numbers of a line.

        Raises:
            DataError: there are more or fewer, or one is none.
        """
        line.check_count((len(self._names),), self._meaning)
        row = line.floats(0, self._names)
        for column, name in self._whole.items():
            line.whole_at(column, name)
        return row


def as_table(rows: Sequence[Sequence[float]], columns: int) -> Float64Array:
    """Rows as (N, columns) float64, also where there are none."""
    return np.array(rows, np.float64).reshape(len(rows), columns)
