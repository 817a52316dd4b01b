"""Where a recording is: a folder, its `data.jsonl`, a zip archive that is unpacked while it is open, or a lone log."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.formats.files import open_file
from sceneloom.formats.recording.json_faults import BYTE_ORDER_MARK, DECODER_FAULTS
from sceneloom.formats.recording.line_shapes import RECORD_KEYS
from sceneloom.formats.recording.picture_files import OpenPictures
from sceneloom.formats.recording.zipped import damage_of_zip, is_zip, unpack

DATA_FILE = "data.jsonl"

_LONGEST_FIRST_LINE = 1 << 18
_LEADING_LINES = 20


def _nothing() -> None:
    pass


@dataclass(frozen=True, slots=True)
class RecordingPlace:
    """A recording's folder.

    Attributes:
        folder: where its files are.
        source: what messages call it.
        data_path: its lines.
        alone: whether these are a log by itself, as programs put out, and what lies beside it is somebody else's.
        remove: takes away what was made for it.
    """

    folder: Path
    source: str
    data_path: Path
    alone: bool = False
    remove: Callable[[], None] = _nothing


@dataclass(frozen=True, slots=True, eq=False)
class Closing:
    """Closes what a scene holds open, then takes away what was made for it."""

    pictures: OpenPictures
    remove: Callable[[], None]

    def __call__(self) -> None:
        """Close everything."""
        self.pictures.close()
        self.remove()


def find_place(path: Path) -> RecordingPlace:
    """Find the folder of a recording that is named by its folder, its log or a zip archive of it.

    Raises:
        DataError: the archive is damaged, or holds something else or too much.
    """
    if path.is_dir():
        return RecordingPlace(path, str(path), path / DATA_FILE)
    if is_zip(path):
        unpacked = unpack(path, DATA_FILE)
        return RecordingPlace(unpacked.folder, str(path), unpacked.folder / DATA_FILE, remove=unpacked.remove)
    if path.name == DATA_FILE:
        return RecordingPlace(path.parent, str(path.parent), path)
    if path.is_file():
        return RecordingPlace(path.parent, str(path), path, alone=True)
    return RecordingPlace(path, str(path), path / DATA_FILE)


def near_miss(path: Path) -> str | None:
    """Say what keeps a path from being a recording, where it nearly is one; None where it is something else."""
    if not path.is_dir():
        return damage_of_zip(path) if is_zip(path) else None
    names = sorted(entry.name for entry in path.iterdir())
    packed = [name for name in names if name.lower().startswith(DATA_FILE + ".")]
    if packed:
        return f"there is {packed[0]}: unpack it to {DATA_FILE}"
    logs = [name for name in names if name.lower().endswith(".jsonl")]
    return f"there is {logs[0]}: is it the recording's {DATA_FILE}?" if logs else None


def is_log(path: Path) -> bool:
    """Whether a file is lines of JSON as a recording or the output of a method has them: one of the first is known."""
    try:
        with open_file(path) as file:
            for _ in range(_LEADING_LINES):
                line = _object(file.readline(_LONGEST_FIRST_LINE).removeprefix(BYTE_ORDER_MARK))
                if line is None or _is_known(line):
                    return line is not None
    except OSError:
        pass
    return False


def _object(text: bytes) -> dict[str, Any] | None:
    """A line's object, {} for a blank one; None where it is none, so that files of other kinds are not read on."""
    if not text.startswith((b"{", b" ", b"\t", b"\r", b"\n")):
        return None
    try:
        line = msgspec.json.decode(text) if text.strip() else {}
    except DECODER_FAULTS:
        return None
    return line if isinstance(line, dict) else None


def _is_known(line: dict[str, Any]) -> bool:
    if "time" not in line:
        return False
    values = (line, *line.values())
    is_pose = any(isinstance(value, dict) and isinstance(value.get("position"), dict) for value in values)
    return is_pose or bool(RECORD_KEYS & line.keys())
