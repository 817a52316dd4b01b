"""Building catalogues, and bringing them up to date: only what changed is read again."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from hashlib import blake2b
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.catalog.layout import VERSION, Layout, scene_name
from sceneloom.catalog.parquet import check_file, read_columns
from sceneloom.catalog.rows import scene_rows
from sceneloom.catalog.tables import TABLES, Rows
from sceneloom.checks import validate
from sceneloom.errors import DataError, OptionError, OutputError, SceneloomError
from sceneloom.formats import open_scene, size_on_disk
from sceneloom.formats.fingerprints import fingerprint
from sceneloom.formats.urls import is_url, path_or_url
from sceneloom.redaction import redacted
from sceneloom.scene import Finding
from sceneloom.scene.types import Progress
from sceneloom.version import __version__


class Checks(StrEnum):
    """How drives are checked for the table of findings."""

    NONE = "none"
    QUICK = "quick"
    """Without reading frames and pictures."""
    FULL = "full"


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A drive that could not be read, and why."""

    path: str
    error: str


class CatalogReport(msgspec.Struct, frozen=True, kw_only=True):
    """What building or updating did.

    Attributes:
        catalogue: its folder.
        scenes: how many it holds now.
        added: paths of drives that are new in it.
        changed: of those that were read again.
        unchanged: how many were left as they were.
        removed: paths of those that were taken out.
        gone: of those that are not where they were, and still stand in it.
        failed: those that could not be read; what stood of them before still does.
    """

    catalogue: str
    scenes: int
    added: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    unchanged: int = 0
    removed: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    failed: tuple[Failure, ...] = ()


@dataclass(frozen=True, slots=True)
class _Drive:
    """A drive to be catalogued; `reading` are the options for opening it."""

    path: str
    reading: Mapping[str, Any]

    @property
    def name(self) -> str:
        return scene_name(self.path, self.reading)


def build(
    drives: Iterable[str | Path],
    catalogue: str | Path,
    *,
    overwrite: bool = False,
    checks: Checks | str = Checks.QUICK,
    progress: Progress | None = None,
    **reading: Any,
) -> CatalogReport:
    """Make a catalogue of drives.

    A run that is stopped leaves a catalogue of the drives so far; `update` with the same drives goes on.

    Args:
        drives: files, folders or URLs.
        catalogue: folder of the catalogue.
        overwrite: whether a catalogue there may be replaced.
        checks: how much is checked for the findings: "none", "quick" (no frames are read) or "full".
        progress: called with the number of drives done and of all.
        reading: reading options of the drives' formats.

    Raises:
        OptionError: there are no drives, or no such checks, or an address holds a secret.
        OutputError: the folder holds something else, or cannot be written.
        MissingExtraError: pyarrow is not installed.
    """
    chosen = _drives(drives, reading)
    if not chosen:
        raise OptionError("no drives; name some")
    how = _checks(checks)
    layout = Layout.made(Path(catalogue), overwrite=overwrite)
    names = {drive.name for drive in chosen}
    for stale in set(layout.scenes()) - names:
        layout.remove(stale)
    return _updated(layout, chosen, how, progress=progress, again=True)


def update(
    catalogue: str | Path,
    drives: Iterable[str | Path] = (),
    *,
    prune: bool = False,
    checks: Checks | str = Checks.QUICK,
    progress: Progress | None = None,
    **reading: Any,
) -> CatalogReport:
    """Bring a catalogue up to date: what is new or changed is read, nothing else is touched.

    Args:
        catalogue: its folder.
        drives: drives that are new or may have changed; without any, all that stand in it are looked at.
        prune: take out drives that are not there any more; without drives only.
        checks: as in `build`.
        progress: as in `build`.
        reading: reading options of the drives that are named; those that stand in it are read as before.

    Raises:
        OptionError: drives are named together with `prune`, there are no such checks, or an address holds a secret.
        DataError: there is no catalogue.
        OutputError: it cannot be written.
        MissingExtraError: pyarrow is not installed.
    """
    layout, how = Layout.found(Path(catalogue)), _checks(checks)
    chosen = _drives(drives, reading)
    if chosen and prune:
        raise OptionError("pruning looks at all drives of the catalogue; name none")
    if chosen:
        return _updated(layout, chosen, how, progress=progress)
    standing, damaged = _standing(layout)
    gone = [drive for drive in standing if not is_url(drive.path) and not Path(drive.path).exists()]
    there = [drive for drive in standing if drive not in gone]
    for drive in gone if prune else ():
        layout.remove(drive.name)
    report = _updated(layout, there, how, progress=progress)
    paths = tuple(drive.path for drive in gone)
    told = {"removed": paths} if prune else {"gone": paths}
    return msgspec.structs.replace(report, failed=(*damaged, *report.failed), **told)


def _checks(checks: Checks | str) -> Checks:
    if checks not in tuple(Checks):
        raise OptionError(f"checks {checks!r}; expected one of {', '.join(Checks)}")
    return Checks(checks)


def _drives(drives: Iterable[str | Path], reading: Mapping[str, Any]) -> list[_Drive]:
    paths = [path_or_url(place) for place in drives]
    texts = [path if isinstance(path, str) else str(path.absolute()) for path in paths]
    for text in texts:
        if is_url(text) and redacted(text) != text:
            raise OptionError(
                f"{redacted(text)}: catalogues keep addresses, and this one holds a secret; say it in the environment"
            )
    return [_Drive(text, reading) for text in dict.fromkeys(texts)]


def _standing(layout: Layout) -> tuple[list[_Drive], list[Failure]]:
    """The drives that stand in a catalogue; of a damaged row no one knows which drive it is."""
    found, damaged = [], []
    for file in layout.files("scenes"):
        try:
            (row,) = read_columns(file, ["path", "options"])
            found.append(_Drive(row["path"], json.loads(row["options"])))
        except (DataError, ValueError, TypeError) as error:
            told = f"{error}; say `update` with the path of this drive"
            damaged.append(Failure(path=file.parent.name.removeprefix("scene="), error=told))
    return found, damaged


def _updated(
    layout: Layout,
    drives: Sequence[_Drive],
    checks: Checks,
    *,
    progress: Progress | None,
    again: bool = False,
) -> CatalogReport:
    added: list[str] = []
    changed: list[str] = []
    failed: list[Failure] = []
    for number, drive in enumerate(drives):
        stamp, before = _stamp(drive, checks), _stamp_before(layout, drive.name)
        if again or not stamp or stamp != before:
            try:
                layout.write(drive.name, _read(drive, checks, stamp))
            except OutputError:
                raise  # what befell the catalogue befalls all drives
            except (SceneloomError, OSError, MemoryError) as error:
                failed.append(Failure(path=drive.path, error=str(error) or type(error).__name__))
            else:
                (added if before is None or again else changed).append(drive.path)
        if progress is not None:
            progress(number + 1, len(drives))
    return CatalogReport(
        catalogue=str(layout.folder),
        scenes=len(layout.scenes()),
        added=tuple(added),
        changed=tuple(changed),
        unchanged=len(drives) - len(added) - len(changed) - len(failed),
        failed=tuple(failed),
    )


def _stamp(drive: _Drive, checks: Checks) -> str:
    """What tells a drive and how it is catalogued from another time; "" where that is not known."""
    try:
        files = fingerprint(drive.path)
    except DataError:
        files = ""  # reading it tells why
    told = repr((files, VERSION, __version__, checks.value))
    return blake2b(told.encode(), digest_size=16).hexdigest() if files else ""


def _stamp_before(layout: Layout, name: str) -> str | None:
    """The stamp of a scene that stands whole in the catalogue; "" where it is damaged, None where it is not there."""
    scenes = layout.part("scenes", name)
    if not scenes.is_file():
        return None
    try:
        for table in TABLES:
            check_file(layout.part(table, name))
        (row,) = read_columns(scenes, ["fingerprint"])
    except (DataError, ValueError):
        return ""
    return str(row["fingerprint"])


def _read(drive: _Drive, checks: Checks, stamp: str) -> dict[str, Rows]:
    place = path_or_url(drive.path)
    with open_scene(place, **drive.reading) as scene:
        return scene_rows(
            scene,
            path=drive.path,
            options=drive.reading,
            fingerprint=stamp,
            size_bytes=size_on_disk(place),
            findings=tuple(_findings(drive, checks)),
        )


def _findings(drive: _Drive, checks: Checks) -> Iterator[Finding]:
    if checks is Checks.NONE:
        return
    report = validate(path_or_url(drive.path), frames=checks is Checks.FULL, **drive.reading)
    yield from report.findings
