"""The container of `.sfs` files, reading side: a JSON header, then arrays, mapped into memory and not copied.

Layout: the header is UTF-8 JSON and ends at the first NUL. Its `$items` list names the arrays: `keys` is the path of
the array's location in the header, `offset` counts from that first NUL, `length` is in bytes; `dtype` and `shape` may
be absent, and then the field decides.

Source: scale-json-binary 0.0.7, whose files this reads; the format's description leaves the container out.
"""

import json
import mmap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import msgspec

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.identity import Identity
from sceneloom.formats.sfs.items import (
    DTYPES,
    ITEMS,
    ItemFault,
    RawBytes,
    format_keys,
    item_locations,
    put_items,
)
from sceneloom.formats.sfs.mapped_file import LocalFile, MappedContent
from sceneloom.formats.sfs.remote import RemoteContent, RemoteFile
from sceneloom.formats.urls import is_url
from sceneloom.redaction import redacted

__all__ = ["DTYPES", "ITEMS", "Container", "ItemFault", "RawBytes", "format_keys"]

HEADER_LIMIT = 1 << 30
"""Longest header that is read [bytes]: beyond it the text alone would fill the memory of a large machine."""


class StoredFile(Protocol):
    """A file on disk or behind a URL."""

    @property
    def content(self) -> mmap.mmap:
        """Its bytes, or what has as many."""
        ...

    @property
    def identity(self) -> Identity:
        """How to report it from a file that takes its location."""
        ...

    def header(self, limit: int) -> memoryview:
        """Give the bytes before the first NUL."""
        ...

    def fill(self, header: dict[str, Any]) -> None:
        """Give values to the arrays of a header that readers look into."""
        ...

    def fetch(self, value: Any) -> Any:
        """Give a value with all arrays in it filled."""
        ...

    def bytes_of(self, array: AnyArray) -> MappedContent | RemoteContent:
        """Give the bytes of an array, which may be read piece by piece."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class Container:
    """An open `.sfs` file, on disk or behind a URL.

    Attributes:
        file: its name, for messages.
        identity: how to report it from a file that takes its location.
        size: its length [bytes].
        header: the decoded header without `$items`; arrays stand in their locations as read-only views. In that of a
            file behind a URL, arrays of frames and images have no values: `fetch` gives them.

    Raises:
        DataError: the file cannot be read, or its header or an item is wrong.
        MissingExtraError: it is behind a URL, and what reads those is not installed.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        faults: list[ItemFault] | None = None,
        storage_options: Mapping[str, Any] | None = None,
        decode: Callable[[memoryview, str], Any] | None = None,
    ) -> None:
        """Open the file and decode its header.

        Args:
            path: the file, or its URL.
            faults: where items at fault are noted, in the order of `$items`; None stands in the position of each in the
                header, if it has one. Without a list the first fault is raised.
            storage_options: what the fsspec back end of a URL is made with.
            decode: makes a value of the header's text and the file's name, instead of the strict decoder.
        """
        self.file = redacted(path) if is_url(path) else str(path)
        self._stored: StoredFile = (
            RemoteFile.of(str(path), storage_options) if is_url(path) else LocalFile.of(Path(path))
        )
        self.identity = self._stored.identity
        self.size = len(self._stored.content)
        self.closed = False
        self._on_close: list[Callable[[], None]] = [self._stored.close]
        try:
            self._read(decode or _decode, faults)
        except BaseException:
            self.close()
            raise

    def _read(self, decode: Callable[[memoryview, str], Any], faults: list[ItemFault] | None) -> None:
        with self._stored.header(HEADER_LIMIT) as text:
            self.start = len(text)
            header = decode(text, self.file)
        if not isinstance(header, dict):
            raise DataError(self.file, "header", f"a JSON {type(header).__name__}; expected an object")
        self._items = header.pop(ITEMS, [])
        if not isinstance(self._items, list):
            raise DataError(self.file, ITEMS, f"a {type(self._items).__name__}; expected a list")
        found = put_items(header, self._items, self._stored.content, self.start)
        if found and faults is None:
            raise DataError(self.file, found[0].location, found[0].problem)
        if faults is not None:
            faults.extend(found)
        self._stored.fill(header)
        self.header: dict[str, Any] = header
        self._numbers: dict[str, int] | None = None

    def close(self) -> None:
        """Let go of the file; arrays that are still in use keep their part of it."""
        self.closed = True
        while self._on_close:
            self._on_close.pop()()

    def on_close(self, close: Callable[[], None]) -> None:
        """Have something closed together with the file."""
        self._on_close.append(close)

    def check_open(self, location: str) -> None:
        """Refuse to read from a closed file.

        Raises:
            DataError: the file is closed.
        """
        if self.closed:
            raise DataError(self.file, location, "the scene is closed; read its frames before that")

    def fetch(self, value: Any) -> Any:
        """Give an array, or whatever holds arrays, with their values; of a file on disk it is the value itself.

        Raises:
            DataError: the file is behind a URL and cannot be read, or has changed.
        """
        return self._stored.fetch(value)

    def bytes_of(self, array: AnyArray) -> MappedContent | RemoteContent:
        """Give the bytes of an array, to be read piece by piece where the file is behind a URL."""
        return self._stored.bytes_of(array)

    def bytes_between(self, start: int, stop: int) -> memoryview:
        """Give bytes of a file on disk by their offsets from the end of the header, as many as there are."""
        return memoryview(self._stored.content)[self.start + start : self.start + stop]

    @property
    def item_count(self) -> int:
        """How many entries `$items` has."""
        return len(self._items)

    def item(self, number: int) -> Any:
        """Give an entry of `$items` as the file has it."""
        return self._items[number]

    def item_number(self, location: str, header: dict[str, Any] | None = None) -> int | None:
        """Find the item that fills a location such as `sensors[0].frames[3].points.positions`.

        Args:
            location: where.
            header: as it was when the file was opened, where parts have been taken out of `self.header` since.
        """
        if self._numbers is None:
            self._numbers = item_locations(self.header if header is None else header, self._items)
        return self._numbers.get(location)


def _decode(text: memoryview, file: str) -> Any:
    try:
        return msgspec.json.decode(text)
    except RecursionError:
        raise DataError(file, "header", "nested too deeply") from None
    except (ValueError, msgspec.DecodeError) as error:
        problem = str(error)
    return _decode_again(bytes(text), problem, file)


def _decode_again(text: bytes, problem: str, file: str) -> Any:
    """Decode what strict JSON refuses but Python's writers produce: NaN and Infinity."""
    if b"NaN" in text or b"Infinity" in text:
        try:
            return json.loads(text)
        except RecursionError:
            problem = "nested too deeply"
        except ValueError as error:
            problem = str(error)
    raise DataError(file, "header", f"no valid JSON: {problem}")
