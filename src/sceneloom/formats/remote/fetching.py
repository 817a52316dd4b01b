"""Files behind URLs, fetched to disk until the drive is closed; of folders what is opened."""

import atexit
import os
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import mkdtemp
from urllib.parse import unquote, urlsplit

from sceneloom.errors import DataError
from sceneloom.formats.remote.faults import faults, may_pass
from sceneloom.formats.remote.mirror import LEFT_FREE, ListedFile, Listing, fetch_whole
from sceneloom.formats.remote.mirrored_path import WORKPLACE, mirror_of, plant, uproot
from sceneloom.formats.remote.patience import patiently
from sceneloom.formats.remote.stores import Facts, Store, open_store
from sceneloom.formats.remote.uploads import MARKER
from sceneloom.redaction import redacted

LARGEST = 64 << 30
"""More of a drive is not on disk at one time [bytes]."""

_TABLES = (".json", ".jsonl", ".txt", ".csv", ".toml", ".yaml", ".yml", ".xml", ".md")
_SMALL = 4 << 20
"""Tables of this size are fetched at once, side by side: readers open them one after the other [bytes]."""

_NUMBERS = re.compile(r"(\D*)(\d*)", re.ASCII)


@dataclass(frozen=True, slots=True)
class Fetched:
    """What was fetched, or will be when it is opened.

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

    def reported(self) -> str:
        """Report what is where, for people."""
        mirror = mirror_of(self.path)
        if mirror is None:
            return f"{self.size / 1e6:.1f} MB were fetched to {self.path}; they go when the scene is closed"
        return (
            f"{mirror.on_disk() / 1e6:.1f} of {self.size / 1e6:.1f} MB in {self.files} files were fetched to "
            f"{self.path}; others come when they are read, and all go when the scene is closed"
        )


def find_urls(pattern: str) -> list[str]:
    """Find what fits a pattern such as `s3://bucket/2025-*/drive.sfs` in a store, by their names.

    Raises:
        DataError: the store cannot be read.
        MissingExtraError: what reads such addresses is not installed.
    """
    with faults(pattern, ""):
        return patiently(lambda: open_store(pattern).fitting())


def names_below(url: str) -> list[str]:
    """Names of the files and folders just below a location in a store; none where it is not there.

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
    """Fetch a file into the system's temporary folder (`TMPDIR`), or prepare to fetch what is opened of a folder.

    Of a folder all files are listed, and small tables fetched. Others are fetched when they are opened by the path that
    is given here, or one that is made of it.

    Args:
        url: the address.
        largest: how much of it is on disk at most [bytes]; of a folder the files go that were used longest ago.

    Raises:
        DataError: it is not there, cannot be read, or a file is larger than what may be fetched or fits on the disk.
        MissingExtraError: what reads such addresses is not installed.
    """
    with faults(url, ""):
        store = open_store(url)
        top = patiently(store.facts)
        found = patiently(lambda: list(store.walk())) if top.is_folder else [top]
    files = _listed(url, store, found) if top.is_folder else ()
    workplace = Path(mkdtemp(prefix=WORKPLACE))
    remove = partial(_remove, workplace, os.getpid())
    atexit.register(remove)
    try:
        root = workplace / (Path(unquote(urlsplit(url).path)).name or "drive")
        most = min(largest, shutil.disk_usage(workplace).free - LEFT_FREE)
        _check_room(url, max((facts.size or 0 for facts in found), default=0), most)
        if not top.is_folder:
            with faults(url, ""):
                patiently(lambda: fetch_whole(store.at(top.path), top.size, root))
            return Fetched(root, 1, top.size or 0, remove)
        listing = Listing(
            url=url,
            root=store.path.rstrip("/"),
            top=str(root),
            largest=most,
            listed_ns=time.time_ns() // 10**9 * 10**9,
            files=files,
        )
        path = plant(listing)
        _gather_tables(path, listing)
    except BaseException:
        remove()
        raise
    return Fetched(path, len(files), sum(file.size for file in files), remove)


def _gather_tables(path: Path, listing: Listing) -> None:
    tables = [file for file in listing.files if file.size <= _SMALL and file.name.lower().endswith(_TABLES)]
    mirror = mirror_of(path)
    if mirror is not None and sum(file.size for file in tables) < listing.largest // 2:
        mirror.gather(tables)


def _listed(url: str, store: Store, found: list[Facts]) -> tuple[ListedFile, ...]:
    """The files by their names below the location."""
    root = store.path.rstrip("/") + "/"
    files = []
    for facts in found:
        name = facts.path.removeprefix(root)
        parts = PurePosixPath(name)
        if parts.is_absolute() or ".." in parts.parts or "\\" in name:
            raise DataError(url, name, "leads out of its folder; expected names of files below it")
        if facts.is_folder or name == MARKER:
            continue
        if facts.size is None:
            raise DataError(url, name, "the store does not state how long it is; fetch the folder first")
        files.append(ListedFile(name, facts.size, facts.version))
    if not files:
        raise DataError(url, "", "is a folder without files")
    return tuple(sorted(files, key=_as_numbered))


def _as_numbered(file: ListedFile) -> tuple[str, list[tuple[int, str]]]:
    """By folders, and 2 before 10."""
    return file.folder, [(int(part or -1), text) for text, part in _NUMBERS.findall(file.name)]


def _check_room(url: str, size: int, room: int) -> None:
    if size > room:
        problem = (
            f"a file of {size / 1e9:.1f} GB is more than the {max(room, 0) / 1e9:.1f} GB that may be fetched; "
            "set TMPDIR to a folder of a larger disk"
        )
        raise DataError(url, "", problem)


def _remove(workplace: Path, process: int) -> None:
    if os.getpid() == process:
        uproot(workplace)
        shutil.rmtree(workplace, ignore_errors=True)
