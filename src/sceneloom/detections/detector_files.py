"""The files that state what detectors are like: TOML, small enough to read; those of the package go by name."""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from sceneloom.detections.classes import KINDS, kind_name
from sceneloom.detections.detectors import ClassStatistics, Detectors
from sceneloom.detections.independent import INDEPENDENT, independent_detectors
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.files import read_settings

FOLDER = Path(__file__).parent / "fitted"
"""Where the package keeps its files."""

DEFAULT = "simulated"
"""The detectors that are taken for granted: made up, and known exactly."""


def detector_names() -> tuple[str, ...]:
    """Names of the detectors whose numbers come with the package."""
    return (*sorted(path.stem for path in FOLDER.glob("*.toml")), INDEPENDENT)


def find_detectors(name: str) -> Detectors:
    """Give detectors by their name, or by the path of a file.

    Raises:
        OptionError: there are none of that name, and no such file.
        DataError: the file says something else.
    """
    if name == INDEPENDENT:
        return _independent()
    kept = FOLDER / f"{name}.toml"
    if name in detector_names():
        return _kept(kept)
    path = Path(name)
    if path.suffix != ".toml" and not path.is_file():
        known = ", ".join(detector_names())
        raise OptionError(f"detectors {name!r}; expected one of {known}, or the path of a TOML file")
    return read_detectors(path)


@lru_cache(maxsize=1)
def _independent() -> Detectors:
    return independent_detectors()


@lru_cache(maxsize=16)
def _kept(path: Path) -> Detectors:
    return read_detectors(path)


def read_detectors(path: str | Path) -> Detectors:
    """Read what detectors are like.

    Raises:
        DataError: it cannot be read, or says something else.
    """
    try:
        raw = tomllib.loads(read_settings(Path(path)).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(path, "", f"{error}; expected the TOML of detectors") from None
    try:
        found = _File.read(raw)
    except (msgspec.ValidationError, OverflowError) as error:
        raise DataError(path, "", f"{error}; expected the numbers of detectors") from None
    wrong = list(_faults(found))
    if wrong:
        raise DataError(path, *wrong[0])
    classes = {kind_name(name): statistics for name, statistics in found.classes.items()}
    return Detectors(
        name=found.name,
        classes=MappingProxyType(classes),
        otherwise=kind_name(found.otherwise),
        degrees_of_freedom=found.degrees_of_freedom,
        provenance=MappingProxyType(found.provenance),
    )


class _File(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The file's own form."""

    name: str
    otherwise: str
    classes: dict[str, ClassStatistics]
    degrees_of_freedom: float = float("inf")
    provenance: dict[str, str] = {}

    @classmethod
    def read(cls, raw: Mapping[str, Any]) -> "_File":
        return msgspec.convert(dict(raw), cls)


def _faults(found: _File) -> Iterator[tuple[str, str]]:
    """Locations and what is wrong there."""
    if found.otherwise not in found.classes:
        yield "otherwise", f"{found.otherwise!r}; expected one of {', '.join(found.classes)}"
    if not found.degrees_of_freedom > 2.0:
        yield "degrees_of_freedom", f"{found.degrees_of_freedom}; expected more than 2"
    for name, own in found.classes.items():
        if kind_name(name) not in KINDS:
            yield f"classes.{name}", f"no known class; expected one of {', '.join(KINDS)}"
        numbers = dict(_numbers(asdict(own), f"classes.{name}"))
        for location, value in numbers.items():
            if value != value or abs(value) == float("inf"):  # noqa: PLR0124 - no number
                yield location, f"{value}; expected a finite number"
        visibility = own.visibility
        for key in ("recall_2d", "recall_3d", "weak_recall_2d", "weak_share", "seen_share", "prior"):
            value = getattr(visibility, key)
            if not 0.0 <= value <= 1.0 or (key == "prior" and value in {0.0, 1.0}):
                yield f"classes.{name}.visibility.{key}", f"{value}; expected 0 to 1"


def _numbers(value: Any, location: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(inner, f"{location}.{key}")
    elif isinstance(value, (tuple, list)):
        for k, inner in enumerate(value):
            yield from _numbers(inner, f"{location}[{k}]")
    elif isinstance(value, (int, float)):
        yield location, float(value)


def format_detectors(detectors: Detectors) -> str:
    """Give the text of the file that says what detectors are like."""
    lines = [
        f"name = {_text(detectors.name)}",
        f"otherwise = {_text(detectors.otherwise)}",
        f"degrees_of_freedom = {_text(detectors.degrees_of_freedom)}",
        "",
        "[provenance]",
        *(f"{key} = {_text(value)}" for key, value in detectors.provenance.items()),
    ]
    for name, own in detectors.classes.items():
        for part, numbers in asdict(own).items():
            lines += ["", f"[classes.{name}.{part}]"]
            lines += [f"{key} = {_text(value)}" for key, value in numbers.items()]
    return "\n".join(lines) + "\n"


def _text(value: Any) -> str:
    if isinstance(value, str):
        return msgspec.json.encode(value).decode()
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(_text(inner) for inner in value)}]"
    number = f"{value:.5g}"
    return number if any(sign in number for sign in ".en") else f"{number}.0"
