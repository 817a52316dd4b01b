"""Outputs of a verb beside its own, such as folders of depth images: each drive has its own in the place of all.

A verb writes them below its draft. They go to their places before the output itself does, which may be on another disk,
or in a store where outputs go into one.
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
    """Refuse places that are not where the outputs go, on disk or in a store, or that cannot be folders.

    Raises:
        OptionError: one is in a store and the outputs are not, or the other way round.
        OutputError: a file lies where a folder is to be.
    """
    for one in wanted:
        if is_url(one.place) != bool(store):
            asked, others = ("on disk", "into a store") if store else ("in a store", "on disk")
            raise OptionError(
                f"--{one.option}: {redacted(one.place)} is {asked}, and outputs go {others}; expected both in one"
            )
        if not store and Path(one.folder).exists() and not Path(one.folder).is_dir():
            raise OutputError(f"{one.folder}: is a file; expected a folder or a new name")


def check_places(places: Sequence[str]) -> None:
    """Refuse places of which two are one.

    Raises:
        OptionError: the same place twice.
    """
    seen: set[str] = set()
    for place in places:
        known = place if is_url(place) else str(Path(place).absolute())
        if known in seen:
            raise OptionError(
                f"{redacted(place)}: two outputs of one drive would go there; name other places"
            )
        seen.add(known)


class Places:
    """What is there already, in folders each of which is looked at once."""

    def __init__(self) -> None:
        self._names: dict[str, frozenset[str]] = {}

    def has(self, place: str) -> bool:
        """Whether there is a file or folder.

        Raises:
            DataError: a store cannot be read.
        """
        if not is_url(place):
            return Path(place).exists()
        folder, _, name = place.rstrip("/").rpartition("/")
        if folder not in self._names:
            from sceneloom.formats.remote.fetching import names_below

            self._names[folder] = frozenset(names_below(folder))
        return unquote(name) in self._names[folder]


def drafts_of(draft: Path, places: Mapping[str, str]) -> dict[str, Path]:
    """Where a verb writes its further outputs, by option.

    Args:
        draft: of its own output.
        places: where they belong, by option.
    """
    return {option: draft.parent / FURTHER / option / name_of(place) for option, place in places.items()}


def bring(draft: Path, places: Mapping[str, str]) -> None:
    """Put what was written into its places: each appears whole or not at all.

    Raises:
        OSError: it cannot be moved.
        OutputError: a store cannot be written to.
    """
    for option, made in drafts_of(draft, places).items():
        if not made.exists():
            continue
        if is_url(places[option]):
            from sceneloom.formats.remote.uploads import upload

            upload(made, places[option])
        else:
            _move(made, Path(places[option]))


def _move(made: Path, place: Path) -> None:
    """Move something in one step, onto another disk, too."""
    place.parent.mkdir(parents=True, exist_ok=True)
    if made.stat().st_dev == place.parent.stat().st_dev:
        move(made, place)
        return
    with TemporaryDirectory(prefix=f".{place.name}-", dir=place.parent) as workplace:
        copy = Path(workplace, place.name)
        shutil.copytree(made, copy) if made.is_dir() else shutil.copy2(made, copy)
        move(copy, place)
