"""Extrinsics out of files of any layout: JSON, TOML, and texts of names and numbers."""

import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from sceneloom.calibrate.conventions.forms import COUNTS
from sceneloom.calibrate.conventions.hypotheses import hypotheses
from sceneloom.errors import DataError
from sceneloom.formats.files import read_settings

_MOST_FOUND = 1_000

_TRANSLATIONS = ("translation", "position", "t", "T", "trans", "xyz")
_ROTATIONS = ("rotation", "heading", "quaternion", "orientation", "R", "r", "q", "rpy", "rot")
_FIRST = MappingProxyType({"order of parts": "translation first"})
_FIRST_XYZW = MappingProxyType({**_FIRST, "quaternion": "x y z w"})
_XYZ, _XYZW, _QXYZW = ("x", "y", "z"), ("x", "y", "z", "w"), ("qx", "qy", "qz", "qw")


@dataclass(frozen=True, slots=True)
class Extrinsic:
    """Numbers that can be an extrinsic.

    Attributes:
        place: where in the file, as its keys name it.
        numbers: 6, 7, 9, 12 or 16.
        known: choices of `CHOICES` that names in the file leave no doubt of.
        apart: the numbers are nine of a rotation, and three of a translation that stands beside it.
    """

    place: str
    numbers: tuple[float, ...]
    known: Mapping[str, str] = field(default_factory=dict)
    apart: bool = False


def read_extrinsics(path: Path) -> tuple[Extrinsic, ...]:
    """Find all numbers of a file that can be an extrinsic.

    Raises:
        DataError: the file cannot be read, or holds none.
    """
    try:
        text = read_settings(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise DataError(str(path), "", f"{error}; expected a text with an extrinsic in it") from error
    found: list[Extrinsic] = []
    try:
        for extrinsic in _walk(_parsed(text), ""):
            if hypotheses(extrinsic.numbers, extrinsic.known, apart=extrinsic.apart):
                found.append(extrinsic)
            if len(found) == _MOST_FOUND:
                break
    except OverflowError as error:  # whole numbers may have any length
        raise DataError(str(path), "", f"{error}; expected the numbers of an extrinsic") from error
    if not found:
        raise DataError(
            str(path), "", "no extrinsic in it; expected 16, 12 or 9 numbers of a matrix, 7 of a translation and a "
            "quaternion, or 6 of a translation and angles",
        )  # fmt: skip
    return tuple(found)


def _parsed(text: str) -> Any:
    """Give what a text says, as JSON, TOML, or lines of names and numbers."""
    with suppress(msgspec.DecodeError, RecursionError):
        return msgspec.json.decode(text.encode())
    with suppress(ValueError, RecursionError):
        return tomllib.loads(text)
    return _lines(text)


def _lines(text: str) -> dict[str, Any]:
    """Read `name: numbers` lines; numbers of lines without a name are of the name before them, or of none."""
    named: dict[str, list[float]] = {}
    name = ""
    for line in text.splitlines():
        head, separator, tail = line.partition(":")
        words = (tail if separator else line).replace(",", " ").replace("[", " ").replace("]", " ").split()
        if not separator and words and not _is_number(words[0]):
            head, words = words[0], words[1:]
            separator = " "
        if separator:
            name = head.strip()
        with suppress(ValueError):
            named.setdefault(name, []).extend(float(word) for word in words)
    return dict(named)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _walk(value: Any, place: str) -> Iterator[Extrinsic]:
    numbers = _numbers(value)
    if numbers is not None:
        if len(numbers) in COUNTS:
            yield Extrinsic(place or "the file", numbers)
        return
    if isinstance(value, dict):
        parts = _parts(value, place)
        if parts is not None:
            yield parts
        for key, inner in value.items():
            if parts is None or key not in (*_TRANSLATIONS, *_ROTATIONS):
                yield from _walk(inner, f"{place}.{key}" if place else str(key))
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from _walk(inner, f"{place}[{number}]")


def _numbers(value: Any) -> tuple[float, ...] | None:
    """Flatten a list of numbers, or of lists of them; None for anything else."""
    if not isinstance(value, list) or not value:
        return None
    flat = (
        [number for row in value for number in row] if all(isinstance(row, list) for row in value) else value
    )
    if not all(type(number) in {int, float} for number in flat):
        return None
    return tuple(map(float, flat))


def _parts(value: dict[str, Any], place: str) -> Extrinsic | None:
    """Put a translation and a rotation together that stand side by side; None where there are none."""
    flat = _named_pose(value)
    if flat is not None:
        return Extrinsic(place or "the file", flat, _FIRST_XYZW)
    translation = next((_vector(value[name], _XYZ) for name in _TRANSLATIONS if name in value), None)
    rotation = next((value[name] for name in _ROTATIONS if name in value), None)
    if translation is None or rotation is None:
        return None
    quaternion = _vector(rotation, _XYZW) if isinstance(rotation, dict) else None
    if quaternion is not None:
        return Extrinsic(place or "the file", (*translation, *quaternion), _FIRST_XYZW)
    numbers = _numbers(rotation)
    if numbers is None or len(numbers) not in {3, 4, 9}:
        return None
    if len(numbers) == 9:
        return Extrinsic(place or "the file", (*numbers, *translation), apart=True)
    return Extrinsic(place or "the file", (*translation, *numbers), _FIRST)


def _named_pose(value: dict[str, Any]) -> tuple[float, ...] | None:
    """Give translation and quaternion where each number has its name."""
    for names in ((*_XYZ, *_QXYZW), ("px", "py", "pz", *_QXYZW), ("tx", "ty", "tz", *_QXYZW)):
        found = _vector(value, names)
        if found is not None:
            return found
    return None


def _vector(value: Any, names: tuple[str, ...]) -> tuple[float, ...] | None:
    """Give numbers by their names, or in the order of a list of as many."""
    if isinstance(value, dict):
        value = [value.get(name) for name in names]
    numbers = _numbers(value)
    return numbers if numbers is not None and len(numbers) == len(names) else None
