"""The drives of a run: paths, patterns, URLs, and lists of them in a file."""

import glob
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sceneloom.batch.jobs import NOTHING, Input
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.drives import drives_of
from sceneloom.formats.files import read_settings
from sceneloom.formats.table import PART
from sceneloom.formats.urls import is_url

_READING = "reading"
READING = f"{_READING}."
"""Before the name of an option that a line says its drive is to be opened with."""

_LONGEST = 1e10
"""No drive lasts so long [s]: int64 nanoseconds end before."""
_SHORT = 40
_WILD = frozenset("*?[")


@dataclass(frozen=True, slots=True, kw_only=True)
class FileOption:
    """An option of a verb that names files.

    Attributes:
        several: whether it takes more than one.
        names: what it takes, too, and is no file.
    """

    several: bool = False
    names: frozenset[str] = frozenset()


def find_inputs(
    locations: Iterable[str],
    lists: Iterable[Path] = (),
    *,
    files: Mapping[str, FileOption] = NOTHING,
    others: Collection[str] = (),
) -> tuple[Input, ...]:
    """Find drives.

    Args:
        locations: paths, patterns such as `drives/**/*.sfs`, or URLs.
        lists: files with a path, or an object {"path": …, "start": …, "stop": …, "reading": {"sequence": …}}, in each
            line; options of reading are named `reading.sequence` and so on.
        files: options that a line may state as well, {"boxes3d": "boxes/a.jsonl"}: a path, or a list of them.
        others: further options that lines may state for other verbs: they are left out, and named in `Input.unread`.

    Returns:
        each once, in the order in which they were named; those of one pattern by their names.

    Raises:
        OptionError: there is none at all, none that fits a pattern, or one twice with different files.
        DataError: a list is faulty, or a file that it names is not there.
    """
    found = [Input(location=location) for text in locations for location in _locations(text)]
    found += [drive for file in lists for drive in _listed(file, files, frozenset(others).difference(files))]
    if not found:
        raise OptionError("no drives; name some, a pattern in quotes, or a list of them")
    once: dict[tuple[Any, ...], Input] = {}
    for drive in found:
        if once.setdefault((drive.location, *sorted(drive.options.items())), drive).files != drive.files:
            raise OptionError(f"{drive.name}: named twice, with different files beside it; do them apart")
    return tuple(once.values())


def each_drive(given: Input, *, read_as: str | None = None) -> tuple[Input, ...]:
    """Name the drives of a data set, where a folder has several and none was chosen; else what is given.

    Args:
        given: a drive or a data set.
        read_as: name of its format, where its content shall not decide.
    """
    if is_url(given.location) or f"{READING}sequence" in given.options:
        return (given,)
    found = drives_of(Path(given.location), read_as=given.options.get(f"{READING}read_as", read_as))
    drives = [
        replace(given, location=str(one))
        if isinstance(one, Path)
        else replace(given, options={**given.options, f"{READING}sequence": one})
        for one in found
    ]
    return tuple(drives) or (given,)


def _locations(text: str) -> list[str]:
    if is_url(text):
        return _urls(text)
    if not _WILD.intersection(text) or Path(text).exists():
        return [text]
    found = sorted(glob.glob(text, recursive=True))  # noqa: PTH207 - patterns from the root, too
    if not found:
        raise OptionError(f"{text}: no file or folder fits this pattern")
    return found


def _urls(text: str) -> list[str]:
    """A URL, or those that fit a pattern; web servers list nothing, and have wild signs in their queries."""
    if not _WILD.intersection(text.partition("?")[0]) or text.lower().startswith(("http:", "https:")):
        return [text]
    from sceneloom.formats.remote.fetching import find_urls

    found = find_urls(text)
    if not found:
        raise OptionError(f"{text}: no file or folder fits this pattern")
    return found


def _listed(file: Path, files: Mapping[str, FileOption], others: frozenset[str]) -> Iterator[Input]:
    try:
        # what else Unicode ends lines with may stand in names
        lines = read_settings(file).decode("utf-8-sig").replace("\r\n", "\n").split("\n")
    except UnicodeDecodeError as error:
        raise DataError(file, "", "is no text in UTF-8; expected a path or an object in each line") from error
    for number, line in enumerate(map(str.strip, lines), start=1):
        if line and not line.startswith("#"):
            yield _line(line, file, number, files, others)


def _line(
    line: str, file: Path, number: int, files: Mapping[str, FileOption], others: frozenset[str]
) -> Input:
    if not line.startswith("{"):
        return Input(location=_beside(file, line))
    location = f"line {number}"
    try:
        reported: dict[str, Any] = json.loads(line)
    except (ValueError, RecursionError) as error:
        stated = repr(line[:_SHORT])
        raise DataError(file, location, f"{stated}: {error}; expected a path or an object of JSON") from error
    path = reported.pop("path", None)
    if not isinstance(path, str) or not path:
        raise DataError(file, location, f"path {path!r}; expected the path of a drive")
    known = (*PART, *files, _READING)
    unknown = [name for name in reported if name not in known and name not in others]
    if unknown:
        expected = f"path, {', '.join(known[:-1])} and {known[-1]}"
        raise DataError(file, location, f"{unknown[0]!r}; expected {expected} only")
    part = {name: reported[name] for name in PART if reported.get(name) is not None}
    for name, value in part.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < _LONGEST:
            stated = repr(value)[:_SHORT]
            raise DataError(
                file, location, f"{name} {stated}; expected seconds from the beginning of the drive on"
            )
    return Input(
        location=_beside(file, path),
        options={**part, **_reading(reported.get(_READING), file, location)},
        files={
            name: _own_files(reported[name], option, file, f"{location}: {name}")
            for name, option in files.items()
            if reported.get(name) is not None
        },
        unread=frozenset(name for name in others if reported.get(name) is not None),
    )


def _own_files(reported: Any, option: FileOption, file: Path, location: str) -> Any:
    """The files of one option, as far as a line says them: beside the list, as drives are."""
    texts = reported if isinstance(reported, list) and option.several else [reported]
    if not texts or not all(isinstance(text, str) and text for text in texts):
        several = ", or a list of such" if option.several else ""
        raise DataError(file, location, f"{repr(reported)[:_SHORT]}; expected the path of a file{several}")
    found = [text if text in option.names else file.parent / text for text in texts]
    for text, own in zip(texts, found, strict=True):
        if is_url(text):
            raise DataError(file, location, f"{text!r} is a URL; expected the path of a file")
        if isinstance(own, Path) and not own.exists():
            names = f"; expected a file, or one of {', '.join(sorted(option.names))}" if option.names else ""
            raise DataError(file, location, f"{own}: no such file or folder{names}")
    return tuple(found) if option.several else found[0]


def _reading(reported: Any, file: Path, location: str) -> dict[str, str | bool]:
    """How a drive is opened, as far as a line says it."""
    stated = {} if reported is None else reported
    if not isinstance(stated, dict) or not all(isinstance(value, str | bool) for value in stated.values()):
        raise DataError(
            file, location, f"reading {reported!r}; expected options by their names, each a text or true"
        )
    return {READING + name: value for name, value in stated.items()}


def _beside(file: Path, text: str) -> str:
    """Paths in a list are those of its own folder."""
    return text if is_url(text) else str(file.parent / text)
