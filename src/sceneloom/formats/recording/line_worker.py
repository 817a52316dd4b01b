"""A process that reads parts of a file of lines for another one.

It is told the parts on its input, a line each: where one begins and where it ends; and puts the columns of each on its
output, pickled, after their length. It ends with its input.
"""

import json
import pickle
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from sceneloom.errors import SceneloomError
from sceneloom.formats.recording.columns import RecordingColumns
from sceneloom.formats.recording.line_blocks import blocks_of_lines
from sceneloom.formats.recording.line_reading import LineReader

LENGTH_BYTES = 8
MOST_FAULTS = 10_000
"""A part with more faults is left to the process that counts them all."""

START = f"import json, sys; sys.path[:] = json.loads(sys.argv[1]); from {__name__} import main; main()"
"""What such a process runs; its arguments are where modules are looked for, as JSON, and the file."""


@dataclass(slots=True)
class ReadPart:
    """What a part of a file says.

    Attributes:
        columns: its lines.
        faults: code, number of the line in the part, and problem.
    """

    columns: RecordingColumns
    faults: list[tuple[str, int, str]]


def read_part(path: Path, start: int, stop: int) -> ReadPart | None:
    """Read the lines that begin in a part of a file; None where that is better done as one with the others."""
    reader = LineReader()
    try:
        with path.open("rb") as file:
            for lines, offset in blocks_of_lines(file, path, start, stop):
                reader.read(lines, offset)
                if len(reader.faults) > MOST_FAULTS:
                    return None
    except (OSError, SceneloomError):
        return None
    return ReadPart(reader.columns, reader.faults)


def answer(requests: BinaryIO, answers: BinaryIO, path: Path) -> None:
    """Read parts until there are no more requests."""
    for request in requests:
        start, stop = json.loads(request)
        text = pickle.dumps(read_part(path, start, stop), pickle.HIGHEST_PROTOCOL)
        answers.write(len(text).to_bytes(LENGTH_BYTES, "little"))
        answers.write(text)
        answers.flush()


def main() -> None:
    """Answer on standard output."""
    answer(sys.stdin.buffer, sys.stdout.buffer, Path(sys.argv[2]))
