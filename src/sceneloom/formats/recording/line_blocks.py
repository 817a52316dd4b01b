"""The lines of a file, some at a time, from a part of it or all of it."""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from sceneloom.errors import DataError

BLOCK = 1 << 16
LONGEST_LINE = 1 << 26


def blocks_of_lines(
    file: BinaryIO, path: Path, start: int = 0, stop: int | None = None
) -> Iterator[tuple[list[bytes], int]]:
    """Give the lines that begin in a part of a file, without their line feeds.

    Args:
        file: the file.
        path: what messages call it.
        start: byte at which the part begins.
        stop: byte at which it ends, or None for the end of the file.

    Returns:
        Lines, and the byte at which the first of them begins.

    Raises:
        DataError: a line is longer than 64 MiB, so this is no file of lines.
    """
    offset = line_start(file, path, start)
    end = None if stop is None else line_start(file, path, stop)
    file.seek(offset)
    parts: list[bytes] = []
    length, reached = 0, offset
    while block := file.read(BLOCK if end is None else min(BLOCK, end - reached)):
        reached += len(block)
        last = block.rfind(b"\n") + 1
        if last:
            text = b"".join([*parts, block[:last]])
            yield text.split(b"\n")[:-1], offset
            offset += len(text)
            parts, length = [], 0
        parts.append(block[last:])
        length += len(block) - last
        _check_length(length, path)
    if length:
        yield [b"".join(parts)], offset


def line_start(file: BinaryIO, path: Path, position: int) -> int:
    """Find where the first line begins that begins at a byte or after it; the end of the file where none does.

    Raises:
        DataError: a line is longer than 64 MiB.
    """
    if position <= 0:
        return 0
    file.seek(position - 1)
    reached = position - 1
    while block := file.read(BLOCK):
        place = block.find(b"\n")
        if place >= 0:
            return reached + place + 1
        reached += len(block)
        _check_length(reached - position, path)
    return reached


def _check_length(length: int, path: Path) -> None:
    if length > LONGEST_LINE:
        raise DataError(path, "", f"a line is longer than {LONGEST_LINE} bytes; expected JSON lines")
