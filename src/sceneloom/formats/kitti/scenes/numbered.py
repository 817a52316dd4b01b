"""Folders of files that are named by their frame's number."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.files import file_faults
from sceneloom.formats.kitti.number_lines import LATEST
from sceneloom.formats.kitti.spec import is_number
from sceneloom.formats.ledger import Ledger
from sceneloom.scene.warnings import WarningKind


@dataclass(frozen=True, slots=True, eq=False)
class NumberedFiles:
    """The files of one folder, by their numbers.

    Attributes:
        folder: where they are.
        numbers: (N,) int64, rising.
        paths: N files.
    """

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
        if not is_number(path.stem):
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
    """Report of what lies in a folder beside what is read of it; hidden and explaining files are no matter."""
    names = set(known)
    with file_faults(folder):
        others = sorted(path.name for path in folder.iterdir() if path.name not in names)
    others = [name for name in others if not name.startswith((".", "README", "readme"))]
    if others:
        shown = ", ".join(others[:_SHOWN]) + (", …" if len(others) > _SHOWN else "")
        message = f"nothing is read of {shown}"
        ledger.note(WarningKind.SKIPPED, "not-read", str(folder), message, count=len(others))


_SHOWN = 5
