"""KITTI's text files line by line, folders of files named by frame number, and choosing one of several sequences."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import file_faults, read_bytes
from sceneloom.formats.kitti.spec import NUMBER
from sceneloom.warnings import WarningKind

LARGEST = 1e9
"""Larger numbers are none of a drive: what is computed with them has no digits left."""

LATEST = 999_999
"""The largest number of a frame or a track: names of KITTI's files have six digits, and there is one entry a frame."""

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_SHOWN = 40
_NUMBERS_SHOWN = 5


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a file, by its number from 1, split into words."""

    path: Path
    number: int
    words: tuple[str, ...]

    def fault(self, problem: str) -> DataError:
        """What is wrong with it, with its location."""
        return DataError(self.path, f"line {self.number}", problem)

    def check_count(self, counts: Sequence[int], meaning: str) -> None:
        """Refuse a line with more or fewer words; `meaning` says in the message what they are."""
        if len(self.words) not in counts:
            expected = " or ".join(map(str, counts))
            raise self.fault(f"{len(self.words)} values; expected {expected}: {meaning}")

    def float_at(self, column: int, name: str) -> float:
        """A finite number; DataError if it is none, or is too large."""
        text = self.words[column]
        value = float(text) if _NUMBER.fullmatch(text) else float("nan")
        if not abs(value) <= LARGEST:
            raise self.fault(f"{name} {text[:_SHOWN]!r}; expected a number within ±{LARGEST:g}")
        return value

    def floats(self, first: int, names: Sequence[str]) -> list[float]:
        """As many finite numbers as there are names, from a column on; DataError if one is none, or is too large."""
        return [self.float_at(first + k, name) for k, name in enumerate(names)]

    def whole_at(self, column: int, name: str, *, low: int = 0) -> int:
        """A whole number from `low` to `LATEST`, with or without a fraction of zeros; DataError if it is none."""
        value = self.float_at(column, name)
        if value != int(value) or not low <= value <= LATEST:
            shown = self.words[column][:_SHOWN]
            raise self.fault(f"{name} {shown!r}; expected a whole number from {low} to {LATEST}")
        return int(value)

    def entry(self, count: int) -> Float64Array:
        """The numbers behind the name of an entry, (count,) float64; DataError if there are more or fewer."""
        self.check_count((count + 1,), f"a name and {count} numbers")
        return np.array(self.floats(1, [f"{self.words[0].rstrip(':')}[{k}]" for k in range(count)]))


def read_entries(path: Path) -> dict[str, Line]:
    """The lines of a file of named numbers, by name; DataError if a name is there twice."""
    entries: dict[str, Line] = {}
    for line in read_lines(path):
        if line.words:
            name = line.words[0].rstrip(":")
            if name in entries:
                raise line.fault(f"{name} is in line {entries[name].number} already; expected it once")
            entries[name] = line
    return entries


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


def as_table(rows: Sequence[Sequence[float]], columns: int) -> Float64Array:
    """Rows as (N, columns) float64, also where there are none."""
    return np.array(rows, np.float64).reshape(len(rows), columns)


@dataclass(frozen=True, slots=True, eq=False)
class NumberedFiles:
    """The files of one folder, by their numbers (N,) int64, rising."""

    folder: Path
    numbers: Int64Array
    paths: tuple[Path, ...]

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def names(self) -> tuple[str, ...]:
        """What the files are called, seen from the folder above."""
        return tuple(f"{self.folder.name}/{path.name}" for path in self.paths)

    def only(self, kept: Sequence[bool]) -> "NumberedFiles":
        """Those for which `kept` is true."""
        rows = [k for k, there in enumerate(kept) if there]
        return NumberedFiles(self.folder, self.numbers[rows], tuple(self.paths[k] for k in rows))


def numbered_files(folder: Path, suffixes: tuple[str, ...], ledger: Ledger) -> NumberedFiles:
    """Find the files of a folder, which may be missing; such with other names are left out and counted.

    Raises:
        DataError: two files have one number, or the folder cannot be read.
    """
    found: dict[int, Path] = {}
    if not folder.is_dir():
        return NumberedFiles(folder, np.zeros(0, np.int64), ())
    with file_faults(folder):
        candidates = sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes)
    for path in candidates:
        if not NUMBER.fullmatch(path.stem):
            message = "files that are not named by a number"
            ledger.note(WarningKind.SKIPPED, "names-without-number", str(path), message)
            continue
        number = int(path.stem)
        if number > LATEST:
            raise DataError(path, "", f"number {number}; expected 0 to {LATEST}")
        if number in found:
            raise DataError(path, "", f"has the number of {found[number].name}; expected one file for each")
        found[number] = path
    numbers = sorted(found)
    return NumberedFiles(folder, np.array(numbers, np.int64), tuple(found[k] for k in numbers))


def frames_within(files: NumberedFiles, count: int, reported_by: Path, ledger: Ledger) -> NumberedFiles:
    """The files whose numbers are below the count of times; others are faults, and left out in a lenient reading.

    Raises:
        DataError: a file has no time.
    """
    beyond = int((files.numbers >= count).sum())
    if not beyond:
        return files
    problem = (
        f"{len(files)} files up to number {int(files.numbers[-1])} for {count} times of {reported_by.name}; "
        "expected a time for each"
    )
    ledger.fault("files-without-time", DataError(files.folder, "", problem), count=beyond)
    return files.only([number < count for number in files.numbers.tolist()])


def note_unread(folder: Path, known: Iterable[str], ledger: Ledger) -> None:
    """Warn about files in a folder that are not read; hidden files and readmes are ignored."""
    names = set(known)
    with file_faults(folder):
        others = sorted(path.name for path in folder.iterdir() if path.name not in names)
    others = [name for name in others if not name.startswith((".", "README", "readme"))]
    if others:
        shown = ", ".join(others[:_NUMBERS_SHOWN]) + (", …" if len(others) > _NUMBERS_SHOWN else "")
        message = f"{shown} not read"
        ledger.note(WarningKind.SKIPPED, "not-read", str(folder), message, count=len(others))


def note_other_part(path: Path, found: Sequence[Path], ledger: Ledger) -> None:
    """Warn that of `training` and `testing` the first one that was found is read."""
    if len(found) > 1 and found[0] != path:
        message = f"{found[0].name} is read, {found[1].name} is not; name its folder to read it"
        ledger.note(WarningKind.SKIPPED, "other-part", str(path), message)


def choose_sequence(path: Path, sequences: tuple[str, ...], wanted: str | None) -> str:
    """The only sequence, or the wanted one; leading zeros are optional.

    Raises:
        OptionError: there are several and none was chosen, or the chosen one is not there.
    """
    names = ", ".join(sequences) or "none"
    if wanted is not None:
        chosen = [name for name in sequences if wanted and wanted.lstrip("0") == name.lstrip("0")]
        if len(chosen) != 1:
            raise OptionError(f"sequence {wanted!r}: {path} has {names}")
        return chosen[0]
    if len(sequences) != 1:
        raise OptionError(f"{path} has several sequences: {names}; choose one with `--sequence NAME`")
    return sequences[0]


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write a text, a line each."""
    path.write_text("".join(f"{line}\n" for line in lines), "utf-8", newline="\n")
