"""Building catalogues, and bringing them up to date: only what changed is read again."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.catalog.drives import Checks, Drive, gone_of, looked_at
from sceneloom.catalog.layout import Layout
from sceneloom.catalog.parts import Parts
from sceneloom.catalog.running import Failure, Run
from sceneloom.errors import OptionError
from sceneloom.formats.urls import is_url, path_or_url
from sceneloom.redaction import redacted
from sceneloom.scene.types import Progress


class CatalogReport(msgspec.Struct, frozen=True, kw_only=True):
    """What building or updating did.

    Attributes:
        catalogue: its folder.
        scenes: how many it holds now.
        added: paths of drives that are new in it.
        changed: of those that were read again.
        unchanged: how many were left as they were.
        removed: paths of those that were taken out, with their names in data sets.
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


def build(
    drives: Iterable[str | Path | Drive],
    catalogue: str | Path,
    *,
    overwrite: bool = False,
    checks: Checks | str = Checks.QUICK,
    workers: int | None = 1,
    progress: Progress | None = None,
    **reading: Any,
) -> CatalogReport:
    """Make a catalogue of drives.

    A run that is stopped leaves a catalogue of the drives so far; `update` with the same drives goes on.

    Args:
        drives: files, folders or URLs, with reading options of their own as `Drive`.
        catalogue: folder of the catalogue.
        overwrite: whether a catalogue there may be replaced.
        checks: how much is checked for the findings: "none", "quick" (no frames are read) or "full".
        workers: so many processes read drives; None: one for each processor, where there are drives enough.
        progress: called with the number of drives done and of all.
        reading: reading options of the drives' formats.

    Raises:
        OptionError: there are no drives, or no such checks, or an address holds a secret.
        OutputError: the folder holds something else, cannot be written, or another process writes into it.
        MissingExtraError: pyarrow is not installed.
    """
    chosen, how = _drives(drives, reading), _checks(checks)
    if not chosen:
        raise OptionError("no drives; name some")
    layout = Layout.made(Path(catalogue), overwrite=overwrite)
    with layout.held():
        layout.clear()
        return _updated(layout, Parts(layout), chosen, how, workers=workers, progress=progress)


def update(
    catalogue: str | Path,
    drives: Iterable[str | Path | Drive] = (),
    *,
    prune: bool = False,
    checks: Checks | str = Checks.QUICK,
    workers: int | None = 1,
    progress: Progress | None = None,
    **reading: Any,
) -> CatalogReport:
    """Bring a catalogue up to date: what is new or changed is read, nothing else is.

    Args:
        catalogue: its folder.
        drives: drives that are new or may have changed; without any, all that stand in it are looked at.
        prune: take out drives that are not there any more; without drives only.
        checks: as in `build`.
        workers: as in `build`.
        progress: as in `build`.
        reading: reading options of the drives that are named; those that stand in it are read as before.

    Raises:
        OptionError: drives are named together with `prune`, there are no such checks, or an address holds a secret.
        DataError: there is no catalogue.
        OutputError: it cannot be written, or another process writes into it.
        MissingExtraError: pyarrow is not installed.
    """
    layout, how = Layout.found(Path(catalogue)), _checks(checks)
    chosen = _drives(drives, reading)
    if chosen and prune:
        raise OptionError("pruning looks at all drives of the catalogue; name none")
    with layout.held():
        parts = Parts(layout)
        if chosen:
            return _updated(layout, parts, chosen, how, workers=workers, progress=progress)
        stationary = [Drive(entry.path, entry.options) for entry in parts.entries.values()]
        gone = gone_of(stationary)
        there = [drive for drive in stationary if drive not in gone]
        if prune:
            parts.remove({drive.name for drive in gone})
        report = _updated(layout, parts, there, how, workers=workers, progress=progress)
    paths = tuple(drive.called for drive in gone)
    return msgspec.structs.replace(report, **({"removed": paths} if prune else {"gone": paths}))


def _checks(checks: Checks | str) -> Checks:
    if checks not in tuple(Checks):
        raise OptionError(f"checks {checks!r}; expected one of {', '.join(Checks)}")
    return Checks(checks)


def _drives(drives: Iterable[str | Path | Drive], reading: Mapping[str, Any]) -> list[Drive]:
    found: dict[str, Drive] = {}
    for given in drives:
        own = given if isinstance(given, Drive) else Drive(str(given), {})
        path = path_or_url(own.path)
        text = path if isinstance(path, str) else str(path.absolute())
        if is_url(text) and redacted(text) != text:
            raise OptionError(
                f"{redacted(text)}: catalogues keep addresses, and this one holds a secret; state it in the environment"
            )
        drive = Drive(text, {**reading, **own.reading})
        found.setdefault(drive.name, drive)
    return list(found.values())


def _updated(
    layout: Layout,
    parts: Parts,
    drives: Sequence[Drive],
    checks: Checks,
    *,
    workers: int | None,
    progress: Progress | None,
) -> CatalogReport:
    known, whole = parts.entries, parts.whole()
    files = looked_at(drives)
    timestamps = {drive.name: drive.timestamp(checks, files[drive.path]) for drive in drives}
    due = [
        drive
        for drive in drives
        if not timestamps[drive.name]
        or drive.name not in whole
        or whole[drive.name].timestamp != timestamps[drive.name]
    ]
    run = Run(parts, layout.drafts, checks, workers=workers, progress=progress)
    run.go(due, files, done=len(drives) - len(due))
    lost = [
        Failure(
            path=damage.file, error=f"{damage}; delete it, and state `update` with the paths of its drives"
        )
        for damage in parts.lost
    ]
    return CatalogReport(
        catalogue=str(layout.folder),
        scenes=len(parts.entries),
        added=tuple(drive.path for drive in run.read if drive.name not in known),
        changed=tuple(drive.path for drive in run.read if drive.name in known),
        unchanged=len(drives) - len(due),
        failed=(*lost, *run.failed),
    )
