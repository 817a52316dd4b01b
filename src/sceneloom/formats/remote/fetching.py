"""Folders and whole files behind URLs, fetched side by side to disk until the drive is closed."""

import atexit
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import mkdtemp
from urllib.parse import unquote, urlsplit

from sceneloom.errors import DataError
from sceneloom.formats.remote.faults import CutShortError, faults, may_pass
from sceneloom.formats.remote.patience import patiently
from sceneloom.formats.remote.ranged import SIDE_BY_SIDE
from sceneloom.formats.remote.stores import Facts, Store, open_store
from sceneloom.formats.remote.uploads import MARKER
from sceneloom.redaction import redacted

LARGEST = 256 << 30
"""More is not fetched: who wants it all has a place for it [bytes]."""

_LEFT_FREE = 1 << 30
"""What stays free on the disk [bytes]."""


@dataclass(frozen=True, slots=True)
class Fetched:
    """What was fetched.

    Attributes:
        path: where it is on disk.
        files: how many files.
        size: of all of them [bytes].
        remove: takes it away again; does nothing in other processes.
    """

    path: Path
    files: int
    size: int
    remove: Callable[[], None]


def find_urls(pattern: str) -> list[str]:
    """Find what fits a pattern such as `s3://bucket/2025-*/drive.sfs` in a store, by their names.

    Raises:
        DataError: the store cannot be read.
        MissingExtraError: what reads such addresses is not installed.
    """
    with faults(pattern, ""):
        return patiently(lambda: open_store(pattern).fitting())


def names_below(url: str) -> list[str]:
    """Names of the files and folders just below a place in a store; none where it is not there.

    Raises:
        DataError: the store cannot be read.
        MissingExtraError: what reads such addresses is not installed.
    """
    with faults(url, ""):
        return patiently(lambda: open_store(url).names())


def remote_contents(url: str) -> list[tuple[str, int, str]] | None:
    """What a store says of a file, or of all files of a folder: name below it, size [bytes], mark of the content.

    Names bear no secrets, so that they are the same when an address is signed anew.

    Returns:
        None where nothing is there, or where of a file that is not known.

    Raises:
        DataError: the store cannot be read.
        MissingExtraError: what reads such addresses is not installed.
    """

    def look() -> list[Facts]:
        store = open_store(url)
        try:
            top = store.facts()
        except FileNotFoundError as error:
            if may_pass(error):
                raise
            return []
        return list(store.walk()) if top.is_folder else [top]

    with faults(url, ""):
        found = patiently(look)
    known = [
        (redacted(facts.path), facts.size, facts.version)
        for facts in found
        if facts.size is not None and facts.version is not None
    ]
    return known if known and len(known) == len(found) else None


def fetch(url: str, *, largest: int = LARGEST) -> Fetched:
    """Fetch a file, or a folder with all that is below it, into the system's temporary folder (`TMPDIR`).

    Args:
        url: the address.
        largest: how much is fetched at most [bytes].

    Raises:
        DataError: it is not there, cannot be read, or is larger than what may be fetched or fits on the disk.
        MissingExtraError: what reads such addresses is not installed.
    """
    with faults(url, ""):
        store = open_store(url)
        top = patiently(store.facts)
        found = patiently(lambda: list(store.walk())) if top.is_folder else [top]
    places = _places(url, store, top, found)
    size = sum(facts.size or 0 for facts in found)
    workplace = Path(mkdtemp(prefix="sceneloom-"))
    remove = partial(_remove, workplace, os.getpid())
    atexit.register(remove)
    try:
        _check_room(url, size, min(largest, shutil.disk_usage(workplace).free - _LEFT_FREE))
        root = workplace / (Path(unquote(urlsplit(url).path)).name or "drive")
        with ThreadPoolExecutor(SIDE_BY_SIDE) as crew:
            list(
                crew.map(
                    lambda name: _fetch_one(url, store.at(places[name].path), places[name], root / name),
                    places,
                )
            )
    except BaseException:
        remove()
        raise
    return Fetched(root, len(places), size, remove)


def _places(url: str, store: Store, top: Facts, found: list[Facts]) -> dict[str, Facts]:
    """The files by their names below the place; a file itself has none."""
    if not top.is_folder:
        return {"": top}
    root = store.path.rstrip("/") + "/"
    places = {facts.path.removeprefix(root): facts for facts in found if not facts.is_folder}
    places.pop(MARKER, None)
    for name in places:
        parts = PurePosixPath(name)
        if parts.is_absolute() or ".." in parts.parts or "\\" in name:
            raise DataError(url, name, "leads out of its folder; expected names of files below it")
    if not places:
        raise DataError(url, "", "is a folder without files")
    return places


def _check_room(url: str, size: int, room: int) -> None:
    if size > room:
        problem = (
            f"has {size / 1e9:.1f} GB, and {max(room, 0) / 1e9:.1f} GB may be fetched; download what you need"
        )
        raise DataError(url, "", problem)


def _fetch_one(url: str, place: Store, facts: Facts, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)

    def once() -> None:
        place.get(target)
        if facts.size is not None and target.stat().st_size != facts.size:
            raise CutShortError(f"the server gave {target.stat().st_size} of {facts.size} bytes")

    with faults(url, redacted(PurePosixPath(place.path).name)):
        patiently(once)


def _remove(workplace: Path, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(workplace, ignore_errors=True)
