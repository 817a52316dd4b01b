"""`data.jsonl` read line by line into columns; the file is never in memory as a whole."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.columns import RecordingColumns
from sceneloom.formats.recording.json_faults import DECODER_FAULTS, json_problem, quote
from sceneloom.formats.recording.line_shapes import RECORD_KEYS, ROOT_KEYS, ExactLine, ExactPose, Line, Pose
from sceneloom.formats.recording.line_taking import UnfitLineError, take_line, take_pose
from sceneloom.scene import NoticeKind

OUTPUT_TRAJECTORY = "output"
"""Name of the trajectory of lines with a position at their root, as the vendor's software puts out."""

_BLOCK = 1 << 20
_LONGEST_LINE = 1 << 26
_KEYS_SHOWN = 10

_decode_exact = msgspec.json.Decoder(ExactLine).decode
_decode_open = msgspec.json.Decoder(Line).decode
_decode_any = msgspec.json.Decoder().decode


def read_lines(path: Path, ledger: Ledger) -> RecordingColumns:
    """Read all lines.

    Args:
        path: `data.jsonl`.
        ledger: takes notices, and the faults of single lines.

    Raises:
        DataError: the file cannot be read or is empty; or a line is wrong and the reading is not lenient.
    """
    reader = _LineReader(path, ledger)
    try:
        with path.open("rb") as file:
            reader.read(iter_lines(file, path))
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror}") from error
    return reader.columns


def iter_lines(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Give the lines of a file without their line feeds, block by block.

    Raises:
        DataError: a line is longer than 64 MiB, so this is no file of lines.
    """
    rest = b""
    while block := file.read(_BLOCK):
        lines = (rest + block).split(b"\n")
        rest = lines.pop()
        if len(rest) > _LONGEST_LINE:
            raise DataError(path, "", f"a line is longer than {_LONGEST_LINE} bytes; expected JSON lines")
        yield from lines
    if rest:
        yield rest


class _LineReader:
    """Takes lines apart into columns.

    Attributes:
        columns: what was read so far.
    """

    def __init__(self, path: Path, ledger: Ledger) -> None:
        self.columns = RecordingColumns()
        self._path = path
        self._ledger = ledger

    def read(self, lines: Iterator[bytes]) -> None:
        """Take all lines, and note where times run backwards."""
        number, offset, latest = 0, 0, -float("inf")
        backwards, first_backwards = 0, 0
        for number, text in enumerate(lines, start=1):
            try:
                line = _decode_exact(text)
            except DECODER_FAULTS:
                seconds = self._take_inexact(text, number, offset)
            else:
                seconds = self._take_exact(line, text, number)
            offset += len(text) + 1
            if seconds is not None:
                if seconds < latest:
                    backwards += 1
                    first_backwards = first_backwards or number
                latest = seconds
        if number == 0:
            raise DataError(self._path, "", "is empty; expected JSON lines")
        if backwards:
            self._note_order(backwards, first_backwards)
        if self.columns.other_lines:
            self._note_other_lines()

    def _take_exact(self, line: ExactLine, text: bytes, number: int) -> float | None:
        """Take a line that says nothing but what the columns hold; give its time."""
        try:
            stream, seconds = take_line(self.columns, line, number)
        except UnfitLineError as error:
            self._fault("unfit-lines", number, str(error))
            return None
        if stream is None and line.frames is None:
            self._keep_text(text, "")
        return seconds

    def _take_inexact(self, text: bytes, number: int, offset: int) -> float | None:
        """Take a line that is broken, wrong, or says more than the exact shapes hold."""
        try:
            return self._take_open(text, _decode_object(text), number, offset)
        except UnfitLineError as error:
            self._fault("unfit-lines", number, str(error))
        except msgspec.ValidationError as error:
            self._fault("unfit-lines", number, json_problem(error, text))
        except DECODER_FAULTS as error:
            self._fault("broken-lines", number, json_problem(error, text))
        return None

    def _take_open(self, text: bytes, content: dict[str, Any], number: int, offset: int) -> float | None:
        line, poses = _decode_open(text), _other_poses(content)
        if not poses and all(getattr(line, key) is None for key in RECORD_KEYS):
            self._keep_text(text, next((key for key in content if key not in ROOT_KEYS), ""))
            return line.time
        stream, seconds = take_line(self.columns, line, number, offset=offset)
        for pose in poses:
            stream = take_pose(self.columns, seconds, pose.pose, pose.origin, number)
        if stream is not None and not (len(poses) == 1 and poses[0].says_all):
            stream.further[len(stream) - 1] = text.decode()
        return seconds

    def _keep_text(self, text: bytes, key: str) -> None:
        self.columns.other_lines.append(text.decode().strip())
        counts = self.columns.other_keys
        counts[key] = counts.get(key, 0) + 1

    def _fault(self, code: str, number: int, problem: str) -> None:
        self._ledger.fault(code, DataError(self._path, f"line {number}", problem))

    def _note_order(self, backwards: int, first: int) -> None:
        self._ledger.note(
            NoticeKind.REPAIRED,
            "lines-sorted",
            f"{self._path}: line {first}",
            "time is earlier than that of the line before; all streams were sorted by time",
            count=backwards,
        )

    def _note_other_lines(self) -> None:
        counts = sorted(self.columns.other_keys.items(), key=lambda item: -item[1])
        shown = ", ".join(f"{count} of {key or 'no key'!r}" for key, count in counts[:_KEYS_SHOWN])
        more = ", …" if len(counts) > _KEYS_SHOWN else ""
        self._ledger.note(
            NoticeKind.SKIPPED,
            "lines-kept-as-text",
            str(self._path),
            f"nothing here computes with these lines: {shown}{more}; their text is kept",
            count=len(self.columns.other_lines),
        )


def _decode_object(text: bytes) -> dict[str, Any]:
    if not text.strip():
        raise UnfitLineError("blank; expected a JSON object")
    content = _decode_any(text)
    if not isinstance(content, dict):
        raise UnfitLineError(f"{quote(text)}: expected a JSON object")
    return content


@dataclass(frozen=True, slots=True)
class _OtherPose:
    """A pose under a root key that has no shape of its own.

    Attributes:
        origin: root key and name of its trajectory.
        says_all: whether the line holds nothing else.
    """

    pose: Pose
    origin: tuple[str, str]
    says_all: bool


def _other_poses(content: dict[str, Any]) -> list[_OtherPose]:
    """Find the poses of a line: under any root key, or at the root itself.

    Raises:
        UnfitLineError: a position or an orientation is incomplete.
    """
    poses = [
        _other_pose(value, (key, key), says_all=set(content) == {"time", key})
        for key, value in content.items()
        if key not in ROOT_KEYS and isinstance(value, dict) and isinstance(value.get("position"), dict)
    ]
    if isinstance(content.get("position"), dict):
        fields = {key: value for key, value in content.items() if key != "time"}
        poses.append(_other_pose(fields, ("", OUTPUT_TRAJECTORY), says_all="time" in content))
    return poses


def _other_pose(value: dict[str, Any], origin: tuple[str, str], *, says_all: bool) -> _OtherPose:
    try:
        return _OtherPose(msgspec.convert(value, ExactPose), origin, says_all)
    except msgspec.ValidationError:
        pass
    try:
        return _OtherPose(msgspec.convert(value, Pose), origin, says_all=False)
    except msgspec.ValidationError as error:
        text = msgspec.json.encode(value)
        raise UnfitLineError(json_problem(error, text, prefix=origin[0])) from error
