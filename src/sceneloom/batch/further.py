"""Outputs of a verb beside its own, such as folders of depth images: each drive has its own in the position of all.

A verb writes them below its draft. They go to their locations before the output itself does, which may be on another
disk, or in a store where outputs go into one.
"""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import unquote

from sceneloom.batch.jobs import Further, name_of
from sceneloom.batch.outputs import FURTHER, move
from sceneloom.errors import OptionError, OutputError
from sceneloom.formats.urls import is_url
from sceneloom.redaction import redacted


def check_further(wanted: Iterable[Further], store: str) -> None:
    """Refuse locations that are not where the outputs go, on disk or in a store, or that cannot be folders.

    Raises:
        OptionError: one is in a store and the outputs are not, or the other way round.
        OutputError: a file lies where a folder is to be.
    """
    for one in wanted:
        if is_url(one.location) != bool(store):
            asked, others = ("on disk", "into a store") if store else ("in a store", "on disk")
            raise OptionError(
                f"--{one.option}: {redacted(one.location)} is {asked}, and outputs go {others}; expected both in one"
            )
        if not store and Path(one.folder).exists() and not Path(one.folder).is_dir():
            raise OutputError(f"{one.folder}: is a file; expected a folder or a new name")


def check_locations(locations: Sequence[str]) -> None:
    """Refuse locations of which two are one.

    Raises:
        OptionError: the same location twice.
    """
    seen: set[str] = set()
    for location in locations:
        known = location if is_url(location) else str(Path(location).absolute())
        if known in seen:
            raise OptionError(
                f"{redacted(location)}: two outputs of one drive would go there; name other locations"
            )
        seen.add(known)


class Locations:
    """What is there already, in folders each of which is looked at once."""

    def __init__(self) -> None:
        self._names: dict[str, frozenset[str]] = {}

    def has(self, location: str) -> bool:
        """Whether there is a file or folder.

        Raises:
            DataError: a store cannot be read.
        """
        if not is_url(location):
            return Path(location).exists()
        folder, _, name = location.rstrip("/").rpartition("/")
        if folder not in self._names:
            from sceneloom.formats.remote.fetching import names_below

            self._names[folder] = frozenset(names_below(folder))
        return unquote(name) in self._names[folder]


def drafts_of(draft: Path, locations: Mapping[str, str]) -> dict[str, Path]:
    """Where a verb writes its further outputs, by option.

    Args:
        draft: of its own output.
        locations: where they belong, by option.
    """
    return {
        option: draft.parent / FURTHER / option / name_of(location) for option, location in locations.items()
    }


def bring(draft: Path, locations: Mapping[str, str]) -> None:
    """Put what was written into its locations: each appears whole or not at all.

    Raises:
        OSError: it cannot be moved.
        OutputError: a store cannot be written to.
    """
    for option, made in drafts_of(draft, locations).items():
        if not made.exists():
            continue
        if is_url(locations[option]):
            from sceneloom.formats.remote.uploads import upload

            upload(made, locations[option])
        else:
            _move(made, Path(locations[option]))


def _move(made: Path, location: Path) -> None:
    """Move something in one step, onto another disk, too."""
    location.parent.mkdir(parents=True, exist_ok=True)
    if made.stat().st_dev == location.parent.stat().st_dev:
        move(made, location)
        return
    with TemporaryDirectory(prefix=f".{location.name}-", dir=location.parent) as workplace:
        copy = Path(workplace, location.name)
        shutil.copytree(made, copy) if made.is_dir() else shutil.copy2(made, copy)
        move(copy, location)
