"""Stores behind URLs by fsspec: the only module that knows it."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, cast

from sceneloom.errors import MissingExtraError
from sceneloom.formats.remote.faults import EXTRA, CutShortError, NoRangesError
from sceneloom.redaction import redacted

_PART = 16 << 20
"""Length of the parts that a file is sent in; stores take 10,000 of them, which makes 160 GB [bytes]."""

_VERSIONS = (
    *("ETag", "etag", "Content-MD5", "Digest"),
    *("mtime", "LastModified", "Last-Modified", "last_modified", "updated", "created"),
)
"""What back ends call the mark of a content, best first."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What a store says of a file or folder.

    Attributes:
        path: its name in the store.
        size: its length [bytes]; None where the store does not state.
        version: what changes with the content; None where the store says nothing.
        is_folder: whether it is one.
    """

    path: str
    size: int | None
    version: str | None
    is_folder: bool


@dataclass(frozen=True, slots=True)
class Store:
    """A location in a store.

    Attributes:
        url: its address.
        files: the fsspec file system.
        path: the location's name there.
    """

    url: str
    files: Any
    path: str

    def facts(self) -> Facts:
        """Look at the location; what was known of it before does not count."""
        if hasattr(self.files, "invalidate_cache"):
            self.files.invalidate_cache()
        return _facts(self.files.info(self.path))

    def fitting(self) -> list[str]:
        """Addresses of what fits the location as a pattern, by their names."""
        scheme = self.url.partition("://")[0]
        return [f"{scheme}://{path.lstrip('/')}" for path in sorted(self.files.glob(self.path))]

    def handle(self, size: int) -> "Handle":
        """Open the file for reading by ranges."""
        known = {"size": size} if "http" in _protocols(self.files) else {}
        return Handle(self, self.files.open(self.path, "rb", cache_type="none", **known))

    def walk(self) -> Iterator[Facts]:
        """All files below the location, by their names."""
        found = self.files.find(self.path, detail=True)
        yield from (_facts(found[name]) for name in sorted(found))

    def names(self) -> list[str]:
        """Names of the files and folders just below the location; none where it is not there."""
        self.files.invalidate_cache()
        try:
            found = self.files.ls(self.path, detail=False)
        except FileNotFoundError:
            return []
        return [path.rstrip("/").rpartition("/")[2] for path in found]

    def put_first(self, content: bytes) -> bytes:
        """Put a small file there unless there is one; give what is there then."""
        self.files.invalidate_cache()
        if self.files.exists(self.path):  # not all stores refuse to put one twice
            return cast("bytes", self.files.cat_file(self.path))
        try:
            self.files.pipe_file(self.path, content, mode="create")
        except Exception:
            # back ends have many names for the refusal
            self.files.invalidate_cache()
            if not self.files.exists(self.path):
                raise
        self.files.invalidate_cache()
        return cast("bytes", self.files.cat_file(self.path))

    def get(self, target: Path) -> None:
        """Fetch the whole file."""
        self.files.get_file(self.path, str(target))

    def put(self, source: Path | None) -> None:
        """Put a file there, piece by piece; it appears whole once the last piece is there.

        Args:
            source: the file; None puts an empty one.
        """
        file = self.files.open(self.path, "wb", block_size=_PART, autocommit=False)
        try:
            if source is not None:
                with source.open("rb") as content:
                    while piece := content.read(_PART):
                        file.write(piece)
            file.close()
            file.commit()
        except BaseException:
            _abandon(file)
            raise
        self.files.invalidate_cache()

    def remove(self) -> None:
        """Take a file away; one that is not there is none."""
        with suppress(FileNotFoundError):
            self.files.rm_file(self.path)
        self.files.invalidate_cache()

    def at(self, path: str) -> "Store":
        """Another location of the same store."""
        return Store(self.url, self.files, path)


class Handle:
    """A connection to one file, which one thread at a time reads from.

    Not by `cat_ranges`: where a server gives all of a file for a part of it, that loads all. For two ranges of 1,000
    bytes of 300 MB it held 1.2 GB; this refuses after 3 MB.
    """

    def __init__(self, store: Store, file: Any) -> None:
        self._store, self._file = store, file

    def read(self, start: int, stop: int, *, seconds: float) -> bytes:
        """Ask for a range once.

        Raises:
            CutShortError: fewer bytes came.
            NoRangesError: the server gives the whole file only.
            Exception: whatever the back end raises.
        """
        content = self._content(start, stop, seconds)
        if len(content) != stop - start:
            raise CutShortError(f"the server gave {len(content)} of {stop - start} bytes")
        return content

    def _content(self, start: int, stop: int, seconds: float) -> bytes:
        ask = getattr(self._file, "async_fetch_range", None)
        if ask is None:
            if not self._file.seekable():
                raise NoRangesError
            self._file.seek(start)
            return cast("bytes", self._file.read(stop - start))
        from fsspec.asyn import sync

        try:
            return cast("bytes", sync(self._file.loop, ask, start, stop, timeout=seconds))
        except ValueError as error:
            # fsspec says so where a server gives all of a file for a part of it
            if "range requests" in str(error):
                raise NoRangesError from error
            raise

    def close(self) -> None:
        """Let go of the connection."""
        self._file.close()


def open_store(url: str, storage_options: Mapping[str, Any] | None = None) -> Store:
    """Find what reads and writes an address; its library is imported here.

    Args:
        url: the address.
        storage_options: what the back end is made with; what it needs of credentials it finds in the environment.

    Raises:
        MissingExtraError: fsspec, or what it needs for this scheme, is not installed.
        Exception: whatever the back end raises.
    """
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise MissingExtraError(f"{redacted(url)}: {EXTRA}") from None
    files, path = url_to_fs(url, **(storage_options or {}))
    return Store(url, files, path)


def _abandon(file: Any) -> None:
    """Give up what was begun: parts that were sent are not put together, and do not stay."""
    with suppress(Exception):
        file.discard()
    file.buffer = None
    file.closed = True  # else the file would be finished once nothing holds it


def _facts(reported: Mapping[str, Any]) -> Facts:
    size = reported.get("size")
    version = next((_mark(reported[name]) for name in _VERSIONS if reported.get(name)), None)
    return Facts(
        str(reported["name"]),
        size if isinstance(size, int) else None,
        version,
        reported.get("type") == "directory",
    )


def _mark(reported: object) -> str:
    """What a back end says that changes with the content, as text; lists and single files word it differently."""
    when = reported.timestamp() if isinstance(reported, datetime) else reported
    return f"{when:.6f}" if isinstance(when, float) else str(when).strip('"')


def _protocols(files: Any) -> tuple[str, ...]:
    return (files.protocol,) if isinstance(files.protocol, str) else tuple(files.protocol)
