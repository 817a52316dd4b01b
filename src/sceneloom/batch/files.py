"""Files that a verb reads beside a drive, such as lists of boxes: of all drives the same, or of each its own."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

from sceneloom.batch.inputs import FileOption
from sceneloom.batch.jobs import Input
from sceneloom.batch.naming import drive_names
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.fingerprints import fingerprint
from sceneloom.formats.urls import is_url

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
    own = {option: value for option, value in paths.items() if any(map(_varies, _each(value)))}
    alike = {option: value for option, value in paths.items() if option not in own}
    for option, value in alike.items():
        for path in _each(value):
            if not path.exists():
                raise DataError(path, "", _missing(option, path, options[option]))
    if not own:
        return tuple(inputs), alike
    given = [
        replace(drive, files={**_placed(own, drive, name), **drive.files})
        for drive, name in zip(inputs, drive_names(inputs), strict=True)
    ]
    _refuse_missing(given, own)
    return tuple(given), alike


def with_files(drive: str, files: Mapping[str, Any]) -> str:
    """Report a drive and the files beside it from what they were at another time, as `fingerprint` does.

    Args:
        drive: its fingerprint.
        files: by option, as of `Job`.
    """
    seen = [drive]
    seen += [fingerprint(str(path)) for _, value in sorted(files.items()) for path in _each(value)]
    if len(seen) == 1 or not all(seen):
        return seen[0] if all(seen) else ""
    return blake2b("\n".join(seen).encode(), digest_size=16).hexdigest()


def flag_of(option: str) -> str:
    """An option, as the user says it."""
    return f"--{option.replace('_', '-')}"


def _each(value: Any) -> tuple[Path, ...]:
    """The files of an option, without names."""
    values = value if isinstance(value, tuple) else (value,)
    return tuple(path for path in values if isinstance(path, Path))


def _varies(path: Path) -> bool:
    return _PLACEHOLDER.search(str(path)) is not None


def _placed(own: Mapping[str, Any], drive: Input, name: str) -> dict[str, Any]:
    """The paths of one drive."""

    def location(path: Path) -> Path:
        if is_url(drive.location) and any(sign in str(path) for sign in _PLACEHOLDERS[1:]):
            raise OptionError(
                f"{path}: {drive.name} is behind a URL, which is no path; expected {{name}} only"
            )
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
        raise DataError(path, "", f"no such file or folder, for {flag_of(option)} of {drive.name}{more}")


def _missing(option: str, path: Path, about: FileOption) -> str:
    names = f"; expected a file, or one of {', '.join(sorted(about.names))}" if about.names else ""
    hint = f"; drives may differ by {', '.join(_PLACEHOLDERS)}" if "{" in str(path) else ""
    return f"no such file or folder, for {flag_of(option)}{names}{hint}"
