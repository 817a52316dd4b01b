"""`data.jsonl` read line by line into columns; the file is never in memory as a whole."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import BinaryIO

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.files import open_file
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.column_arrays import line_seconds
from sceneloom.formats.recording.columns import RecordingColumns
from sceneloom.formats.recording.columns_joining import ColumnsJoiner
from sceneloom.formats.recording.json_faults import other_file
from sceneloom.formats.recording.line_blocks import blocks_of_lines
from sceneloom.formats.recording.line_parts import LineParts, reading_processes
from sceneloom.formats.recording.line_reading import LineReader
from sceneloom.formats.recording.other_records import OUTPUT_TRAJECTORY
from sceneloom.scene import NoticeKind

__all__ = ["OUTPUT_TRAJECTORY", "iter_lines", "read_lines"]

_KEYS_SHOWN = 10


def read_lines(path: Path, ledger: Ledger) -> RecordingColumns:
    """Read all lines; of a large file, with several processes (`reading_processes`).

    Args:
        path: `data.jsonl`.
        ledger: takes notices, and the faults of single lines.

    Raises:
        DataError: the file cannot be read or is empty; or a line is wrong and the reading is not lenient.
        OptionError: the environment names no number of processes.
    """
    reader = LineReader()
    try:
        _check_beginning(path)
        size = path.stat().st_size
        processes = reading_processes(size)
        if processes > 1:
            _read_parts(reader, path, size, processes, ledger)
        else:
            _read_serially(reader, path, ledger)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror}") from error
    columns = reader.columns
    if not columns.log.codes:
        raise DataError(path, "", "is empty; expected JSON lines: record or export it again")
    _note_order(columns, path, ledger)
    _note_other_lines(columns, path, ledger)
    return columns


def _check_beginning(path: Path) -> None:
    """Refuse a file that is no text at once: of its lines there would be none that is right."""
    with open_file(path) as file:
        told = other_file(file.read(16))
    if told is not None:
        raise DataError(path, "", f"{told}; expected lines of JSON in UTF-8: unpack or export it as such")


def _read_serially(
    reader: LineReader, path: Path, ledger: Ledger, start: int = 0, stop: int | None = None
) -> None:
    with open_file(path) as file:
        for lines, offset in blocks_of_lines(file, path, start, stop):
            reader.read(lines, offset)
            _pass_faults(reader.faults, path, ledger)


def _read_parts(reader: LineReader, path: Path, size: int, processes: int, ledger: Ledger) -> None:
    joiner = ColumnsJoiner(reader.columns)
    with closing(LineParts(path, size, processes)) as parts:
        for bounds, part in parts:
            if part is None or not joiner.can_join(part.columns):
                joiner.finish()
                reader.bind()
                _read_serially(reader, path, ledger, *bounds)
                joiner = ColumnsJoiner(reader.columns)
                continue
            before = joiner.lines
            joiner.join(part.columns)
            _pass_faults([(code, before + line, why) for code, line, why in part.faults], path, ledger)
    joiner.finish()


def iter_lines(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Give the lines of a file without their line feeds, block by block.

    Raises:
        DataError: a line is longer than 64 MiB, so this is no file of lines.
    """
    for lines, _ in blocks_of_lines(file, path):
        yield from lines


def _pass_faults(faults: list[tuple[str, int, str]], path: Path, ledger: Ledger) -> None:
    for code, number, problem in faults:
        ledger.fault(code, DataError(path, f"line {number}", problem))
    faults.clear()


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
