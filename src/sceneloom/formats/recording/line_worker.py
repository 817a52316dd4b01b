"""A process that reads parts of a file of lines for another one.

It says when it is there, a line on its output. Then it is told the parts on its input, a line each: where one begins,
where it ends, and the file that the columns of it are to be put into, pickled. When they are there it says so by the
length of that file, 0 for none. It ends with its input.

Files, and not pipes, take the columns: a pipe holds so little that this process would wait whenever the other one reads
lines of its own. And this process loads no module but those that reading lines needs, since starting would otherwise
take as long as reading 30 MB.
"""

import json
import pickle
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from sceneloom.errors import SceneloomError
from sceneloom.formats.files import open_file
from sceneloom.formats.recording.columns import RecordingColumns
from sceneloom.formats.recording.line_blocks import blocks_of_lines
from sceneloom.formats.recording.line_reading import LineReader

MOST_FAULTS = 10_000
"""A part with more faults is left to the process that counts them all."""

_START = """
import json, sys, types
sys.path[:], packages, path = json.loads(sys.argv[1])
for name, folders in packages.items():
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = folders
from {module} import main
main(path)
"""
"""What such a process runs. The packages that the module is in are empty there, not what their files would load."""


def command(path: Path) -> Sequence[str]:
    """Give the command that starts such a process with the interpreter of this one."""
    parents = __name__.split(".")[:-1]
    names = [".".join(parents[: depth + 1]) for depth in range(len(parents))]
    packages = {name: list(sys.modules[name].__path__) for name in names}
    told = json.dumps([sys.path, packages, str(path)])
    return [sys.executable, "-c", _START.format(module=__name__), told]


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
        with open_file(path) as file:
            for lines, offset in blocks_of_lines(file, path, start, stop):
                reader.read(lines, offset)
                if len(reader.faults) > MOST_FAULTS:
                    return None
    except (OSError, SceneloomError):
        return None
    return ReadPart(reader.columns, reader.faults)


def answer(requests: BinaryIO, answers: BinaryIO, path: Path) -> None:
    """Read parts until there are no more requests."""
    answers.write(b"0\n")
    answers.flush()
    for request in requests:
        start, stop, target = json.loads(request)
        answers.write(b"%d\n" % _write_part(read_part(path, start, stop), Path(target)))
        answers.flush()


def _write_part(part: ReadPart | None, target: Path) -> int:
    if part is None:
        return 0
    text = pickle.dumps(part, pickle.HIGHEST_PROTOCOL)
    try:
        return target.write_bytes(text)
    except OSError:
        return 0


def main(path: str) -> None:
    """Answer on standard output."""
    answer(sys.stdin.buffer, sys.stdout.buffer, Path(path))
