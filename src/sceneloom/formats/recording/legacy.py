"""Recordings from before `calibration.json`: `parameters.txt`, and lines about cameras at the head of `data.jsonl`."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.base.files import open_file
from sceneloom.formats.recording.json_faults import DECODER_FAULTS

PARAMETERS_FILE = "parameters.txt"
_FISHEYE = "kannala-brandt4"
_FISHEYE_IN_LINES = "KANNALA_BRANDT4"
_FISHEYE_COUNT = 4
_MOST_CAMERAS = 2
_LONGEST = 1 << 22


@dataclass(frozen=True, slots=True, eq=False)
class OldCalibration:
    """What the old forms state of cameras, in the words of `calibration.json`.

    Attributes:
        path: the file that says most of it.
        content: with `cameras`; empty where nothing is stated.
        doubts: what had to be assumed.
    """

    path: Path
    content: Mapping[str, Any] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()


def read_old_calibration(folder: Path, data_path: Path, other_lines: Iterable[str]) -> OldCalibration:
    """Read what stands in for a `calibration.json`; what `parameters.txt` says counts before the lines.

    Args:
        folder: the recording.
        data_path: its lines.
        other_lines: those of them that report no time.

    Raises:
        DataError: `parameters.txt` cannot be read, or says something that is no parameter.
    """
    entries = _entries_of_lines(other_lines)
    path = folder / PARAMETERS_FILE
    doubts: list[str] = []
    if path.is_file():
        for index, entry in _entries_of_parameters(_read_parameters_file(path), path, doubts).items():
            entries.setdefault(index, {}).update(entry)
    if not entries:
        return OldCalibration(path)
    for index, entry in entries.items():
        if "model" not in entry:
            entry["model"] = "pinhole"
            doubts.append(f"camera {index} is taken for a pinhole: no model is stated")
    cameras = [entries.get(index, {}) for index in range(max(entries) + 1)]
    return OldCalibration(path if path.is_file() else data_path, {"cameras": cameras}, tuple(doubts))


def _entries_of_lines(other_lines: Iterable[str]) -> dict[int, dict[str, Any]]:
    """By camera, what lines like `{"cameraInd": 0, "imuToCamera": [...]}` state."""
    entries: dict[int, dict[str, Any]] = {}
    for text in other_lines:
        line = _object(text) if '"cameraInd"' in text else {}
        index = line.get("cameraInd")
        if not isinstance(index, int) or not 0 <= index < _MOST_CAMERAS:
            continue
        stated = {"imuToCamera": line["imuToCamera"]} if "imuToCamera" in line else {}
        if _FISHEYE_IN_LINES in str(line.get("model")) and isinstance(line.get("coeffs"), list):
            stated |= {"model": _FISHEYE, "distortionCoefficients": _without_fifth(line["coeffs"])}
        if stated:
            entries.setdefault(index, {}).update(stated)
    return entries


def _without_fifth(coefficients: list[Any]) -> list[Any]:
    """Some recorders wrote a fifth coefficient that is zero."""
    spare = coefficients[_FISHEYE_COUNT:]
    return coefficients[:_FISHEYE_COUNT] if spare == [0] else coefficients


def _object(text: str) -> dict[str, Any]:
    try:
        line = msgspec.json.decode(text)
    except DECODER_FAULTS:
        return {}
    return line if isinstance(line, dict) else {}


def has_old_frame(line: Mapping[str, Any]) -> bool:
    """Whether a line reports the one image of a recording with one camera, under `frame`."""
    return "frames" not in line and isinstance(line.get("frame"), dict)


def with_frames(line: Mapping[str, Any]) -> dict[str, Any]:
    """The same line in the words of today: `frames`, with one entry of camera 0."""
    further = {key: value for key, value in line.items() if key != "frame"}
    return {**further, "frames": [{**line["frame"], "cameraInd": 0}]}


def _read_parameters_file(path: Path) -> dict[str, str]:
    """Read `parameters.txt`: `name value;` again and again.

    Raises:
        DataError: it cannot be read as text, or a part of it is no name and value, or stands there twice.
    """
    try:
        with open_file(path) as file:
            text = file.read(_LONGEST).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, "", f"cannot be read as text: {error}") from error
    values: dict[str, str] = {}
    for part in text.split(";"):
        words = part.split()
        if not words:
            continue
        if len(words) != 2 or words[0] in values:
            shown = " ".join(words)[:60]
            raise DataError(path, shown, "expected a name and a value, each name once, with `;` behind them")
        values[words[0]] = words[1]
    return values


def _entries_of_parameters(values: Mapping[str, str], path: Path, doubts: list[str]) -> dict[int, dict[str, Any]]:
    entries: dict[int, dict[str, Any]] = {}
    for index in range(_MOST_CAMERAS):
        entry = _Reader(values, path, index).entry()
        if entry:
            entries[index] = entry
    if values.get("videoRotation", "NONE") != "NONE":
        for entry in entries.values():
            entry.pop("imuToCamera", None)
        doubts.append("videoRotation rotates the mountings in a way that is not known here; they are left out")
    return entries


@dataclass(frozen=True, slots=True, eq=False)
class _Reader:
    """Reads what the parameters state of one of the two cameras; those of the second begin with `second`."""

    values: Mapping[str, str]
    path: Path
    index: int

    def entry(self) -> dict[str, Any]:
        focal = self._number("focalLength")
        stated = {
            "focalLengthX": self._number("focalLengthX") or focal,
            "focalLengthY": self._number("focalLengthY") or focal,
            "principalPointX": self._number("principalPointX"),
            "principalPointY": self._number("principalPointY"),
            "imuToCamera": self._matrix(),
            "imuToCameraShiftSeconds": self._read("imuToCameraShiftSeconds", float),
        }
        entry = {name: value for name, value in stated.items() if value is not None}
        coefficients = self._read("distortionCoeffs", _numbers) or []
        if not entry and not coefficients:
            return {}
        is_fisheye = self.values.get("fisheyeCamera") == "true"
        if is_fisheye or coefficients:
            # a single zero stands for no distortion
            entry["distortionCoefficients"] = [] if coefficients == [0.0] else coefficients
            entry["model"] = _FISHEYE if is_fisheye else "pinhole"
        return entry

    def _number(self, name: str) -> float | None:
        """A length in pixels; -1 stands for one that is not stated."""
        value = self._read(name, float)
        return None if value is None or value < 0 else value

    def _matrix(self) -> list[float] | None:
        """Nine or sixteen numbers column by column; fewer stand for a mounting that is not stated."""
        numbers = self._read("imuToCameraMatrix", _numbers)
        return numbers if numbers is not None and len(numbers) > 1 else None

    def _read(self, name: str, read: Callable[[str], Any]) -> Any:
        key = f"second{name[0].upper()}{name[1:]}" if self.index else name
        text = self.values.get(key)
        try:
            return None if text is None else read(text)
        except ValueError as error:
            raise DataError(self.path, key, f"{text[:60]!r}; expected numbers") from error  # type: ignore[index]


def _numbers(text: str) -> list[float]:
    return [float(number) for number in text.split(",")]
