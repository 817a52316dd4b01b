"""What a run does: the verb, the drives, the files beside each drive, and the names of outputs."""

import glob
import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any
from urllib.parse import unquote, urlsplit

import msgspec

from sceneloom.errors import DataError, OptionError, redacted
from sceneloom.formats.base.files import is_url, read_settings
from sceneloom.formats.base.output import file_stems
from sceneloom.formats.base.registry import PART, drives_of

_NOTHING: Mapping[str, Any] = MappingProxyType({})


class State(StrEnum):
    """Where a drive is in a run."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Input:
    """One drive of a run.

    Attributes:
        location: its path, or its URL.
        options: what counts for it alone, as the seconds at which a part of it starts and stops.
        files: what the verb reads beside it, by option, instead of what all drives have; as of `Job`.
        unread: options whose files a list names for other verbs.
    """

    location: str
    options: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)
    files: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)
    unread: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        """What the record calls it: its location without secrets, which stays the same when a URL is signed anew."""
        return redacted(self.location)

    def drives(self, *, read_as: str | None = None) -> "tuple[Input, ...]":
        """Name the drives of a data set, where a folder has several and none was chosen; else this alone.

        Args:
            read_as: name of its format, where its content shall not decide.
        """
        if is_url(self.location) or f"{READING}sequence" in self.options:
            return (self,)
        found = drives_of(Path(self.location), read_as=self.options.get(f"{READING}format", read_as))
        drives = [
            replace(self, location=str(one))
            if isinstance(one, Path)
            else replace(self, options={**self.options, f"{READING}sequence": one})
            for one in found
        ]
        return tuple(drives) or (self,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Further:
    """A further output that was asked for of all drives.

    Attributes:
        option: the verb's option that names it.
        location: what was stated: a folder, or a file whose name stands behind those of the drives.
        is_folder: which of both.
    """

    option: str
    location: str
    is_folder: bool

    @property
    def folder(self) -> str:
        """Where those of all drives lie."""
        if self.is_folder:
            return self.location.rstrip("/")
        return self.location.rpartition("/")[0] if is_url(self.location) else str(Path(self.location).parent)

    def of(self, drive: str) -> str:
        """The location of one drive's.

        Args:
            drive: what its output is called, without a suffix.
        """
        name = drive if self.is_folder else f"{drive}.{_name_of(self.location).lstrip('.')}"
        return f"{self.folder}/{name}" if is_url(self.location) else str(Path(self.folder, name))


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One verb over many drives.

    Attributes:
        verb: its name, for people and for the record.
        call: `module:function` that does one drive: `function(location, output, options)` writes `output` and gives
            what the record keeps, or raises.
        inputs: the drives.
        options: of the verb, alike for all; they pickle.
        files: those that name files which the verb reads beside a drive, as far as all drives have the same: a path
            each, or several as a tuple; they go before `options`. A drive is done anew when one of its files changed.
        suffix: what names of outputs end in; "" for folders.
        retries: how often a drive is tried again where the cause can pass.
        modules: what workers of this machine import before they begin, once for all of them.
        further: outputs beside these, which `call` writes where its options of these names state.
    """

    verb: str
    call: str
    inputs: tuple[Input, ...]
    options: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)
    files: Mapping[str, Any] = field(default_factory=lambda: _NOTHING)
    suffix: str = ""
    retries: int = 2
    modules: tuple[str, ...] = ()
    further: tuple[Further, ...] = ()

    @property
    def output_names(self) -> tuple[str, ...]:
        """The names of the outputs, in the order of the drives."""
        return output_names(self.inputs, self.suffix)


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One try at one drive; it pickles, and any worker can take it.

    Attributes:
        number: of the drive in the run.
        attempt: 1 for the first try.
        call, location, options: as of `Job` and `Input`.
        draft: where the output is written; from there it is moved to its location once it is whole. Below the temporary
            folder of the worker's machine if there is a `target`.
        target: the folder of a store that the worker sends the output to once it is whole; "" for none.
        further: where further outputs belong, by the option that names each.
        files: what is read beside the drive, by option, as of `Job`.
    """

    number: int
    attempt: int
    call: str
    location: str
    draft: Path
    options: Mapping[str, Any]
    target: str = ""
    further: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, Any] = field(default_factory=dict)

    @property
    def further_names(self) -> dict[str, str]:
        """The last parts of the locations of further outputs, by option."""
        return {option: _name_of(location) for option, location in self.further.items()}


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """What came of one try.

    Attributes:
        number: of the drive in the run.
        error: what went wrong, for a person; "" if nothing did.
        kind: name of the error's class, "Lost" for a worker that is gone.
        passing: whether the same may work another time.
        report: what the verb reported, as JSON values; if it is an object, with the seconds of its stages as `stages`,
            and where its further outputs are as `further`.
        fingerprint: of the drive as it was before.
        seconds: by the clock [s].
        processor_seconds: of the worker's processor [s].
        peak_bytes: the most memory that the worker ever had up to then.
        worker: who did it.
    """

    number: int
    error: str = ""
    kind: str = ""
    passing: bool = False
    report: Any = None
    fingerprint: str = ""
    seconds: float = 0.0
    processor_seconds: float = 0.0
    peak_bytes: int = 0
    worker: str = ""


def _name_of(location: str) -> str:
    """The last part of a path or address."""
    return PurePosixPath(unquote(urlsplit(location).path)).name if is_url(location) else Path(location).name


_READING = "reading"

READING = f"{_READING}."
"""Before the name of an option that a line says its drive is to be opened with."""

_LONGEST = 1e10  # no drive lasts so long [s]: int64 nanoseconds end before

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
    files: Mapping[str, FileOption] = _NOTHING,
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
    from sceneloom.formats.remote.mirror import find_urls

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


def _line(line: str, file: Path, number: int, files: Mapping[str, FileOption], others: frozenset[str]) -> Input:
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
            raise DataError(file, location, f"{name} {stated}; expected seconds from the beginning of the drive on")
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
        raise DataError(file, location, f"reading {reported!r}; expected options by their names, each a text or true")
    return {READING + name: value for name, value in stated.items()}


def _beside(file: Path, text: str) -> str:
    """Paths in a list are those of its own folder."""
    return text if is_url(text) else str(file.parent / text)


def output_names(inputs: Sequence[Input], suffix: str) -> tuple[str, ...]:
    """Name outputs by their drives; where these share a name, by the folders above, too.

    Args:
        inputs: the drives.
        suffix: what all names end in.
    """
    parts = [_parts(drive) for drive in inputs]
    depths = [1] * len(parts)
    while True:
        names = ["_".join(own[-depth:]) for own, depth in zip(parts, depths, strict=True)]
        counts = Counter(names)
        deeper = [
            min(depth + 1, len(own)) if counts[name] > 1 else depth
            for own, depth, name in zip(parts, depths, names, strict=True)
        ]
        if deeper == depths:
            # what is left alike is numbered, and made fit for file systems
            return tuple(stem + suffix for stem in file_stems(names))
        depths = deeper


def _drive_names(inputs: Sequence[Input]) -> tuple[str, ...]:
    """Name drives as their outputs are, without a suffix, and alike for all parts of one in time."""
    reading = [{name: value for name, value in one.options.items() if name not in PART} for one in inputs]
    whole = [Input(location=one.location, options=own or _NOTHING) for one, own in zip(inputs, reading, strict=True)]
    keys = [(one.location, *sorted(one.options.items())) for one in whole]
    once = dict(zip(keys, whole, strict=True))
    names = dict(zip(once, output_names(tuple(once.values()), ""), strict=True))
    return tuple(names[key] for key in keys)


def _parts(drive: Input) -> tuple[str, ...]:
    text = unquote(urlsplit(drive.location).path) if is_url(drive.location) else drive.location.replace("\\", "/")
    path = PurePosixPath(text.rstrip("/"))
    parts = [part for part in path.parts if part not in {"/", ".", ".."}] or ["drive"]
    parts[-1] = path.stem or parts[-1]
    parts[-1] = "_".join([parts[-1], *(_word(name, value) for name, value in sorted(drive.options.items()))])
    return tuple(parts)


def _word(name: str, value: Any) -> str:
    """What counts for a drive alone, as a word."""
    if name.startswith(READING):
        return name.removeprefix(READING) if value is True else str(value)
    return f"{name}{value:g}"


_PLACEHOLDERS = ("{name}", "{drive}", "{folder}")
_PLACEHOLDER = re.compile("|".join(map(re.escape, _PLACEHOLDERS)))


def give_files(
    inputs: Sequence[Input], stated: Mapping[str, Any], options: Mapping[str, FileOption]
) -> tuple[tuple[Input, ...], Mapping[str, Any]]:
    """Give drives the files that are stated of all of them, where a list says nothing else.

    Args:
        inputs: the drives.
        stated: paths by option, several as a tuple, or a name that the option takes, too. `{name}` in a path is what
            the drive is called, as its output is but for seconds; `{drive}` its path, `{folder}` the folder it lies in.
        options: of the verb, that take files.

    Returns:
        inputs: with files of their own, where a path has a placeholder.
        files: the others, which all drives have; no names.

    Raises:
        DataError: a file is not there.
        OptionError: a drive behind a URL has no path to put in.
    """
    paths = {
        option: tuple(map(Path, value)) if isinstance(value, tuple) else Path(value)
        for option, value in stated.items()
        if value not in options[option].names
    }
    own = {
        option: value for option, value in paths.items() if any(_PLACEHOLDER.search(str(path)) for path in _each(value))
    }
    alike = {option: value for option, value in paths.items() if option not in own}
    for option, value in alike.items():
        for path in _each(value):
            if not path.exists():
                raise DataError(path, "", _missing(option, path, options[option]))
    if not own:
        return tuple(inputs), alike
    given = [
        replace(drive, files={**_placed(own, drive, name), **drive.files})
        for drive, name in zip(inputs, _drive_names(inputs), strict=True)
    ]
    _refuse_missing(given, own)
    return tuple(given), alike


def _flag_of(option: str) -> str:
    """An option, as the user says it."""
    return f"--{option.replace('_', '-')}"


def _each(value: Any) -> tuple[Path, ...]:
    """The files of an option, without names."""
    values = value if isinstance(value, tuple) else (value,)
    return tuple(path for path in values if isinstance(path, Path))


def _placed(own: Mapping[str, Any], drive: Input, name: str) -> dict[str, Any]:
    """The paths of one drive."""

    def location(path: Path) -> Path:
        if is_url(drive.location) and any(sign in str(path) for sign in _PLACEHOLDERS[1:]):
            raise OptionError(f"{path}: {drive.name} is behind a URL, which is no path; expected {{name}} only")
        found = Path(drive.location)
        words = dict(zip(_PLACEHOLDERS, (name, str(found), str(found.parent)), strict=True))
        return Path(_PLACEHOLDER.sub(lambda match: words[match[0]], str(path)))

    return {
        option: tuple(map(location, value)) if isinstance(value, tuple) else location(value)
        for option, value in own.items()
        if option not in drive.files
    }


def _refuse_missing(drives: Iterable[Input], options: Iterable[str]) -> None:
    missing = [
        (path, option, drive)
        for drive in drives
        for option in options
        for path in _each(drive.files[option])
        if not path.exists()
    ]
    if missing:
        path, option, drive = missing[0]
        more = f"; so it is with {len(missing) - 1} more" if len(missing) > 1 else ""
        raise DataError(path, "", f"no such file or folder, for {_flag_of(option)} of {drive.name}{more}")


def _missing(option: str, path: Path, about: FileOption) -> str:
    names = f"; expected a file, or one of {', '.join(sorted(about.names))}" if about.names else ""
    hint = f"; drives may differ by {', '.join(_PLACEHOLDERS)}" if "{" in str(path) else ""
    return f"no such file or folder, for {_flag_of(option)}{names}{hint}"
