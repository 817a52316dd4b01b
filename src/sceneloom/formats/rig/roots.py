"""The files that a manifest names: found below one folder, never outside it."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

from sceneloom.errors import DataError
from sceneloom.formats.files import why_no_file

_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True, slots=True)
class Root:
    """A folder whose files a manifest may name.

    Attributes:
        folder: resolved.
        manifest: for messages.
    """

    folder: Path
    manifest: Path

    def file(self, name: str, location: str) -> Path:
        """Find one file.

        Raises:
            DataError: there is no such file, or it lies outside the folder.
        """
        path = self.folder / self._checked(name, location)
        if not path.is_file():
            raise DataError(self.manifest, location, f"{name!r}: {why_no_file(path)} in {self.folder}")
        self._check_inside([path], location)
        return path

    def files(self, patterns: Sequence[str], location: str) -> list[Path]:
        """Find the files of some patterns, in the order in which people number them: 2 before 10.

        Raises:
            DataError: there is none, one is no regular file, or one lies outside the folder.
        """
        found: set[Path] = set()
        for pattern in patterns:
            try:
                matches = [
                    path for path in self.folder.glob(self._checked(pattern, location)) if not path.is_dir()
                ]
            except (ValueError, NotImplementedError, IndexError, re.error) as error:
                raise DataError(self.manifest, location, f"{pattern!r} is no pattern: {error}") from error
            if not matches:
                raise DataError(
                    self.manifest,
                    location,
                    f"{pattern!r}: no such files in {self.folder}{self._hint(pattern)}",
                )
            found.update(matches)
        files = sorted(found, key=natural_key)
        odd = next((path for path in files if not path.is_file()), None)
        if odd is not None:
            raise DataError(self.manifest, location, f"{self.relative(odd)!r}: {why_no_file(odd)}")
        self._check_inside(files, location)
        return files

    def relative(self, path: Path) -> str:
        """What a file is called seen from the folder."""
        # of many thousands of files, each asked for: cutting the text is ten times as fast as `relative_to`
        return str(path)[len(str(self.folder)) :].lstrip(os.sep).replace(os.sep, "/")

    def _checked(self, name: str, location: str) -> str:
        windows = PureWindowsPath(name)
        outside = PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts
        if outside:
            problem = f"{name!r}; expected a path below {self.folder}; name another folder with `root`"
            raise DataError(self.manifest, location, problem)
        return name

    def _check_inside(self, files: Sequence[Path], location: str) -> None:
        """Refuse links that lead out; folders are looked up once each."""
        resolved: dict[Path, bool] = {}
        for path in files:
            if path.parent not in resolved:
                resolved[path.parent] = path.parent.resolve().is_relative_to(self.folder)
            inside = resolved[path.parent]
            if inside and path.is_symlink():
                inside = path.resolve().is_relative_to(self.folder)
            if not inside:
                problem = (
                    f"{self.relative(path)!r} leads out of {self.folder} by a link, to {path.resolve()}; "
                    "name the folder that the files are in as `root`"
                )
                raise DataError(self.manifest, location, problem)

    def _hint(self, pattern: str) -> str:
        """Report what there is instead of a pattern without matches."""
        folder = self.folder
        for part in PurePosixPath(pattern).parts[:-1]:
            if any(sign in part for sign in "*?["):
                break
            if not (folder / part).is_dir():
                return f"; {folder.name or folder} has {_folders_in(folder)}{_spelling_hint(pattern)}"
            folder /= part
        suffixes = sorted({entry.suffix for entry in folder.iterdir() if entry.is_file() and entry.suffix})
        held = ", ".join("*" + suffix for suffix in suffixes[:10]) or "no files"
        also = f" and {_folders_in(folder)}" if folder == self.folder else ""
        return f"; {folder.name or folder} has {held}{also}{_spelling_hint(pattern)}"


def _folders_in(folder: Path) -> str:
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    return f"the folders {', '.join(names[:10])}" if names else "no folders"


def _spelling_hint(pattern: str) -> str:
    """Explain signs that mean something else in a pattern than in a name."""
    if "\\" in pattern:
        return "; folders are parted by /, also on Windows"
    return "; [ ] stand for a choice of signs: write [[] for the sign [" if "[" in pattern else ""


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Order numbers inside names by their value."""
    parts = _DIGITS.split(path.as_posix())
    return tuple(
        (1, int(part), part) if part.isdecimal() and part.isascii() else (0, 0, part) for part in parts
    )


def open_root(manifest: Path, names: Sequence[str | None], location: str) -> Root:
    """Find the folder of some files.

    Args:
        manifest: the manifest, from whose folder a relative root is seen.
        names: `root` of the sensor and of the manifest, None where not stated; the first that is stated counts.

    Raises:
        DataError: there is no such folder.
    """
    name = next((name for name in names if name is not None), None)
    folder = manifest.parent if name is None else manifest.parent / Path(name).expanduser()
    try:
        resolved = folder.resolve()
    except (OSError, RuntimeError) as error:
        raise DataError(manifest, location, f"{name!r} cannot be read: {error}") from error
    if not resolved.is_dir():
        raise DataError(manifest, location, f"{name!r}: no such folder; expected the folder of the files")
    return Root(resolved, manifest)
