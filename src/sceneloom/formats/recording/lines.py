"""`data.jsonl` read line by line into columns; the file is never in memory as a whole."""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.columns import RecordingColumns
from sceneloom.formats.recording.line_reading import OUTPUT_TRAJECTORY, LineReader
from sceneloom.scene import NoticeKind

__all__ = ["OUTPUT_TRAJECTORY", "iter_lines", "read_lines"]

_BLOCK = 1 << 16
_LONGEST_LINE = 1 << 26
_KEYS_SHOWN = 10


def read_lines(path: Path, ledger: Ledger) -> RecordingColumns:
    """Read all lines.

    Args:
        path: `data.jsonl`.
        ledger: takes notices, and the faults of single lines.

    Raises:
        DataError: the file cannot be read or is empty; or a line is wrong and the reading is not lenient.
    """
    reader = LineReader()
    try:
        with path.open("rb") as file:
            for lines, offset in _blocks_of_lines(file, path):
                reader.read(lines, offset)
                _pass_faults(reader.faults, path, ledger)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror}") from error
    columns = reader.columns
    if not columns.log.codes:
        raise DataError(path, "", "is empty; expected JSON lines")
    _note_order(columns, path, ledger)
    _note_other_lines(columns, path, ledger)
    return columns


def iter_lines(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Give the lines of a file without their line feeds, block by block.

    Raises:
        DataError: a line is longer than 64 MiB, so this is no file of lines.
    """
    for lines, _ in _blocks_of_lines(file, path):
        yield from lines


def _blocks_of_lines(file: BinaryIO, path: Path) -> Iterator[tuple[list[bytes], int]]:
    """Give the lines of a file, some at a time, and the byte at which the first of them begins."""
    parts: list[bytes] = []
    length, offset = 0, 0
    while block := file.read(_BLOCK):
        end = block.rfind(b"\n") + 1
        if end:
            text = b"".join([*parts, block[:end]])
            yield text.split(b"\n")[:-1], offset
            offset += len(text)
            parts, length = [], 0
        parts.append(block[end:])
        length += len(block) - end
        if length > _LONGEST_LINE:
            raise DataError(path, "", f"a line is longer than {_LONGEST_LINE} bytes; expected JSON lines")
    if length:
        yield [b"".join(parts)], offset


def _pass_faults(faults: list[tuple[str, int, str]], path: Path, ledger: Ledger) -> None:
    for code, number, problem in faults:
        ledger.fault(code, DataError(path, f"line {number}", problem))
    faults.clear()


def _note_order(columns: RecordingColumns, path: Path, ledger: Ledger) -> None:
    seconds = columns.line_seconds()
    timed = np.flatnonzero(~np.isnan(seconds))
    backwards = timed[1:][np.diff(seconds[timed]) < 0]
    if len(backwards):
        ledger.note(
            NoticeKind.REPAIRED,
            "lines-sorted",
            f"{path}: line {backwards[0] + 1}",
            "time is earlier than that of the line before; all streams were sorted by time",
            count=len(backwards),
        )


def _note_other_lines(columns: RecordingColumns, path: Path, ledger: Ledger) -> None:
    if not columns.other_lines:
        return
    counts = sorted(columns.other_keys.items(), key=lambda item: -item[1])
    shown = ", ".join(f"{count} of {key or 'no key'!r}" for key, count in counts[:_KEYS_SHOWN])
    more = ", …" if len(counts) > _KEYS_SHOWN else ""
    ledger.note(
        NoticeKind.SKIPPED,
        "lines-kept-as-text",
        str(path),
        f"nothing here computes with these lines: {shown}{more}; their text is kept",
        count=len(columns.other_lines),
    )
