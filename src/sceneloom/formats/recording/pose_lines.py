"""Trajectories as the `groundTruth` lines of a recording."""

from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from math import nan
from pathlib import Path

import msgspec
import numpy as np

from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import file_faults, open_file
from sceneloom.formats.base.losses import Loss
from sceneloom.formats.base.poses import PoseRows
from sceneloom.formats.base.text_tables import TimestampError, TimeWriter, parse_timestamp
from sceneloom.formats.recording.contents import DECODER_FAULTS, ROOT_KEYS, NamedPose, json_problem, quote
from sceneloom.formats.recording.reader import RANKS
from sceneloom.formats.recording.writer import NumberLines, merged_lines
from sceneloom.formats.trajectories.trajectory_file import (
    NAMED,
    Reading,
    TrajectoryFile,
    TrajectoryForm,
    further_losses,
    ordered,
)
from sceneloom.warnings import WarningKind

_ROOT_NAME = "output"  # how poses right at the root are called
_Line = dict[str, msgspec.Raw]
_decode_line = msgspec.json.Decoder(_Line).decode
_decode_pose = msgspec.json.Decoder(NamedPose).decode
_OTHER_KEYS = ROOT_KEYS - {"groundTruth", "pose"}  # keys of a recording's lines under which no pose stands


class _UnfitLineError(Exception):
    """A line is valid JSON, but does not state what a pose needs."""


@dataclass(slots=True)
class _Poses:
    """The lines of one trajectory; the values are x y z [m] and the quaternion x y z w, NaN where there is none."""

    timestamps_ns: "array[int]" = field(default_factory=lambda: array("q"))
    values: "array[float]" = field(default_factory=lambda: array("d"))
    lines: "array[int]" = field(default_factory=lambda: array("q"))
    unturned: int = 0


def _recognises(text: str) -> bool:
    line = next((line for line in text.splitlines() if line.strip()), "")
    try:
        return bool(_decode_line(line.encode())) and ('"time"' in text or '"position"' in text)
    except DECODER_FAULTS:
        return False


def _read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    found: dict[str, _Poses] = {}
    with file_faults(path), open_file(path) as file:
        for number, text in enumerate(file, 1):
            if not text.strip():
                continue
            try:
                _take_line(found, text, number, reading.unit)
            except _UnfitLineError as error:
                ledger.fault("bad-lines", DataError(path, f"line {number}", str(error)))
            except DECODER_FAULTS as error:
                ledger.fault("bad-lines", DataError(path, f"line {number}", json_problem(error, text)))
    name = _chosen(path, found, reading.name, ledger)
    poses = found[name]
    values = np.frombuffer(poses.values, np.float64).reshape(-1, 7)
    rotated = poses.unturned < len(poses.lines)
    rows = PoseRows(
        np.frombuffer(poses.timestamps_ns, np.int64), values[:, :3], values[:, 3:] if rotated else None, poses.lines
    )
    return TrajectoryFile(ordered(path, name, rows, ledger)[0], JSONL.name)


def _take_line(found: dict[str, _Poses], text: bytes, number: int, unit: str | None) -> None:
    """Add the poses of a line to those of their trajectories."""
    line = _decode_line(text)
    for key, raw in _poses_of(line, text):
        pose = _decode_pose(raw)
        timestamp_ns = _timestamp(line, unit)
        poses = found.setdefault(pose.name or key if key == "pose" else key, _Poses())
        location, rotation = pose.position, pose.orientation
        poses.timestamps_ns.append(timestamp_ns)
        poses.values.extend((location.x, location.y, location.z))
        poses.values.extend((nan,) * 4 if rotation is None else (rotation.x, rotation.y, rotation.z, rotation.w))
        poses.unturned += rotation is None
        poses.lines.append(number)


def _poses_of(line: _Line, text: bytes) -> Iterator[tuple[str, bytes | msgspec.Raw]]:
    """The keys under which a position stands, each with the text of the pose."""
    if "position" in line:
        yield _ROOT_NAME, text
    for key, raw in line.items():
        if key not in _OTHER_KEYS and b'"position"' in bytes(raw) and "position" in _fields(raw):
            yield key, raw


def _fields(raw: msgspec.Raw) -> _Line:
    try:
        return _decode_line(raw)
    except msgspec.ValidationError:
        return {}


def _timestamp(line: _Line, unit: str | None) -> int:
    if "time" not in line:
        raise _UnfitLineError("time: missing; expected seconds")
    text = bytes(line["time"])
    if text[:1] not in b"-0123456789":
        raise _UnfitLineError(f"time: {quote(text)}; expected a number")
    try:
        return parse_timestamp(text.decode(), unit)
    except TimestampError as error:
        raise _UnfitLineError(f"time: {error}") from None


def _chosen(path: Path, found: Mapping[str, _Poses], name: str | None, ledger: Ledger) -> str:
    """The name that was asked for, or the one that would be a recording's default trajectory."""
    if not found:
        raise DataError(path, "", 'holds no poses; expected lines such as {"groundTruth": {"position": …}}')
    if name is not None:
        if name not in found:
            raise OptionError(f"{path}: no trajectory {name!r}; there are: {', '.join(found)}")
        return name
    chosen = min(found, key=lambda known: RANKS.get(known, 2))
    others = ", ".join(other for other in found if other != chosen)
    if others:
        message = f"took the trajectory {chosen!r}; there are also: {others}"
        ledger.note(WarningKind.ASSUMED, "chosen-trajectory", str(path), message)
    return chosen


def _write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    del target
    # the number that a time was read from may mean another nanosecond when its decimals are read exactly
    trajectory = replace(content.trajectory, file_seconds=None)
    with path.open("wb") as file:
        for lines in merged_lines([NumberLines(TimeWriter(), {}).trajectory(trajectory, None)]):
            file.write("\n".join([*lines, ""]).encode())
    return further_losses(content)


JSONL = TrajectoryForm(
    "jsonl",
    (".jsonl",),
    'lines of JSON such as {"groundTruth": {"position": …, "orientation": …}, "time": …}',
    _recognises,
    _read,
    _write,
    supports=NAMED,
)
