"""`data.jsonl` read line by line into columns; the file is never in memory as a whole."""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.files import open_file
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.column_arrays import line_seconds
from sceneloom.formats.recording.columns import RecordingColumns
from sceneloom.formats.recording.json_faults import BYTE_ORDER_MARK, other_file
from sceneloom.formats.recording.line_reading import BLANK, BLANK_LINE, LineReader
from sceneloom.scene.warnings import WarningKind

_BLOCK = 1 << 16
_LONGEST_LINE = 1 << 26
_KEYS_SHOWN = 10


def read_lines(path: Path, ledger: Ledger) -> RecordingColumns:
    """Read all lines.

    Args:
        path: `data.jsonl`.
        ledger: takes warnings, and the faults of single lines.

    Raises:
        DataError: the file cannot be read or is empty; or a line is wrong and the reading is not lenient.
    """
    try:
        _check_beginning(path, ledger)
        columns, blank = _read(path, ledger)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror}") from error
    count = len(columns.log.codes)
    if count == blank:
        raise DataError(path, "", "is empty; expected JSON lines: record or export it again")
    if blank:
        location, message = f"{path}: line {count - blank + 1}", "blank lines at the end were left out"
        ledger.note(WarningKind.REPAIRED, "blank-lines-at-end", location, message, count=blank)
    _note_order(columns, path, ledger)
    _note_other_lines(columns, path, ledger)
    return columns


def _check_beginning(path: Path, ledger: Ledger) -> None:
    """Refuse a file that is no text at once: of its lines there would be none that is right."""
    with open_file(path) as file:
        beginning = file.read(16)
    reported = other_file(beginning)
    if reported is not None:
        raise DataError(path, "", f"{reported}; expected lines of JSON in UTF-8: unpack or export it as such")
    note_mark(beginning, path, ledger)


def note_mark(text: bytes, path: Path, ledger: Ledger) -> None:
    """Note a byte order mark at the beginning of a file of JSON, which is read over it."""
    if text.startswith(BYTE_ORDER_MARK):
        message = "begins with a byte order mark, which JSON must not have; it was passed over"
        ledger.note(WarningKind.REPAIRED, "byte-order-mark", str(path), message)


def _read(path: Path, ledger: Ledger) -> tuple[RecordingColumns, int]:
    """Give the columns, and how many lines at the end are blank, which is no fault there."""
    reader, ended = LineReader(), 0
    with open_file(path) as file:
        for lines, offset in _blocks_of_lines(file, path):
            before = len(reader.columns.log.codes)
            reader.read(lines, offset)
            count, faults = len(reader.columns.log.codes), reader.faults
            blank = 0
            while blank < len(faults) and faults[-1 - blank][:2] == (BLANK, count - blank):
                blank += 1
            if blank < count - before:
                # so the blank lines before are none at the end
                for number in range(ended + 1, before + 1):
                    _pass_fault((BLANK, number, BLANK_LINE), path, ledger)
                for fault in faults[: len(faults) - blank]:
                    _pass_fault(fault, path, ledger)
                ended = count - blank
            faults.clear()
    return reader.columns, len(reader.columns.log.codes) - ended


def _pass_fault(fault: tuple[str, int, str], path: Path, ledger: Ledger) -> None:
    code, number, problem = fault
    ledger.fault("unfit-lines" if code == BLANK else code, DataError(path, f"line {number}", problem))


def _blocks_of_lines(file: BinaryIO, path: Path) -> Iterator[tuple[list[bytes], int]]:
    """Give the lines of a file without their line feeds, some at a time, without a byte order mark before the first.

    Args:
        file: the file, from its beginning.
        path: what messages call it.

    Returns:
        Lines, and the byte at which the first of them begins.

    Raises:
        DataError: a line is longer than 64 MiB, so this is no file of lines.
    """
    mark = len(BYTE_ORDER_MARK) if file.read(len(BYTE_ORDER_MARK)) == BYTE_ORDER_MARK else 0
    file.seek(mark)
    offset, parts, length = mark, list[bytes](), 0
    while block := file.read(_BLOCK):
        last = block.rfind(b"\n") + 1
        if last:
            text = b"".join([*parts, block[:last]])
            yield text.split(b"\n")[:-1], offset
            offset += len(text)
            parts, length = [], 0
        parts.append(block[last:])
        length += len(block) - last
        if length > _LONGEST_LINE:
            raise DataError(path, "", f"a line is longer than {_LONGEST_LINE} bytes; expected JSON lines")
    if length:
        yield [b"".join(parts)], offset


def _note_order(columns: RecordingColumns, path: Path, ledger: Ledger) -> None:
    seconds = line_seconds(columns)
    numbers = None
    if np.isnan(seconds).any():
        numbers = np.flatnonzero(~np.isnan(seconds))
        seconds = seconds[numbers]
    backwards = np.flatnonzero(seconds[1:] < seconds[:-1]) + 1
    if numbers is not None:
        backwards = numbers[backwards]
    if len(backwards):
        ledger.note(
            WarningKind.REPAIRED,
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
        WarningKind.SKIPPED,
        "lines-kept-as-text",
        str(path),
        f"nothing here computes with these lines: {shown}{more}; their text is kept",
        count=len(columns.other_lines),
    )
