"""Drives that are catalogued, and reading one of them, in whatever process that happens."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

from sceneloom.catalog.drafts import write_draft
from sceneloom.catalog.layout import VERSION, scene_name
from sceneloom.catalog.rows import scene_rows
from sceneloom.checks.validation import validate
from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.drives import drives_of
from sceneloom.formats.fingerprints import fingerprint
from sceneloom.formats.size import size_on_disk
from sceneloom.formats.table import open_scene
from sceneloom.formats.urls import is_url, path_or_url
from sceneloom.scene.findings import Finding
from sceneloom.version import __version__


class Checks(StrEnum):
    """How drives are checked for the table of findings."""

    NONE = "none"
    QUICK = "quick"
    """Without reading frames and images."""
    FULL = "full"


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive to be catalogued.

    Attributes:
        path: of the drive, or its URL.
        reading: options for opening it.
    """

    path: str
    reading: Mapping[str, Any]

    @property
    def called(self) -> str:
        """What people call it: its path, and its name in a data set."""
        return (
            f"{self.path} (sequence {self.reading['sequence']})" if "sequence" in self.reading else self.path
        )

    @property
    def name(self) -> str:
        """What its scene is called in the catalogue."""
        return scene_name(self.path, self.reading)

    def timestamp(self, checks: Checks, files: str) -> str:
        """What reports it, its files by `looked_at`, and how it is catalogued from another time; "" for not known."""
        reported = repr((files, VERSION, __version__, checks.value))
        return blake2b(reported.encode(), digest_size=16).hexdigest() if files else ""


def gone_of(drives: Iterable[Drive]) -> list[Drive]:
    """Those that are not where they were: no such path, or no drive of this name in the data set there."""
    names = cache(drives_of)
    return [drive for drive in drives if not is_url(drive.path) and _is_gone(drive, names)]


def _is_gone(drive: Drive, names: Callable[[Path], Sequence[Path | str]]) -> bool:
    path = Path(drive.path)
    if not path.exists():
        return True
    if "sequence" not in drive.reading or drive.reading["sequence"] in names(path):
        return False
    try:
        open_scene(drive.path, **drive.reading).close()
    except OptionError:
        return True
    except SceneloomError:
        return False  # reading it reports why
    return False


def looked_at(drives: Iterable[Drive]) -> dict[str, str]:
    """Look at the files of drives, those of a data set once: fingerprints by path, "" where nobody knows."""
    found = {}
    for path in dict.fromkeys(drive.path for drive in drives):
        try:
            found[path] = fingerprint(path)
        except DataError:
            found[path] = ""  # reading it reports why
    return found


def read_drive(location: str, output: Path, options: Mapping[str, Any]) -> int:
    """Read a drive and write the rows of all its tables.

    Args:
        location: path or URL of the drive.
        output: folder to write (`write_draft`).
        options: `scene`, its name; `timestamp`, what reports it from another time; `checks`; `reading`, options for
            opening.

    Returns:
        the number of rows of the longest table.

    Raises:
        SceneloomError: it cannot be read, or the rows cannot be written.
    """
    where, reading = path_or_url(location), options["reading"]
    with open_scene(where, **reading) as scene:
        tables = scene_rows(
            scene.corrected(),
            path=location,
            options=reading,
            fingerprint=options["timestamp"],
            size_bytes=size_on_disk(where),
            findings=tuple(_findings(location, Checks(options["checks"]), reading)),
        )
    return write_draft(options["scene"], tables, output)


def _findings(location: str, checks: Checks, reading: Mapping[str, Any]) -> Iterator[Finding]:
    if checks is Checks.NONE:
        return
    yield from validate(path_or_url(location), frames=checks is Checks.FULL, **reading).findings
