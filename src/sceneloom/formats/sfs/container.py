"""The container of `.sfs` files, reading side: a JSON header, then arrays.

Mapped into memory or read by ranges behind a URL.
"""

import gc
import io
import json
import mmap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, NoReturn, Self, cast

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError, redacted
from sceneloom.formats.base.files import ByteStream, FileIdentity, is_url, open_file
from sceneloom.formats.remote.stores import Range, RangedFile, RemoteIdentity, coalesced

ITEMS = "$items"

_DTYPE_NAMES = (
    "bool",
    *(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)),
    *("float16", "float32", "float64", "complex64", "complex128"),
)
_LITTLE_ENDIAN = {name: np.dtype(name).newbyteorder("<") for name in _DTYPE_NAMES}

DTYPES: Mapping[str, np.dtype[Any]] = MappingProxyType(
    {
        **_LITTLE_ENDIAN,
        **{dtype.str: dtype for dtype in _LITTLE_ENDIAN.values()},
        **{dtype.newbyteorder(">").str: dtype.newbyteorder(">") for dtype in _LITTLE_ENDIAN.values()},
    }
)
"""The dtypes that an item may name: NumPy's names, and its codes with a byte order."""

_MOST_AXES = 64  # Source: NPY_MAXDIMS of NumPy 2


class RawBytes(np.ndarray[Any, Any]):
    """The bytes of an item that names no dtype; the field that they belong to decides what they are."""

    def plain(self) -> AnyArray:
        """The same bytes as an array that is none of these."""
        return self.view(np.ndarray)


@dataclass(frozen=True, slots=True)
class ItemFault:
    """What is wrong with an item.

    Attributes:
        number: which entry of `$items` it is.
        keys: the location that it names, as it stands in the item; None where it names none.
        path: that location as text (`sensors[0].frames[3].points.positions`), empty where it names none.
        problem: the value and what was expected.
    """

    number: int
    keys: tuple[Any, ...] | None
    path: str
    problem: str

    @property
    def location(self) -> str:
        """Where in the header the fault is, for messages."""
        return f"{ITEMS}[{self.number}]" + (f" ({self.path})" if self.path else "")


def put_items(header: dict[str, Any], items: list[Any], content: mmap.mmap, start: int) -> list[ItemFault]:
    """Put the arrays of a file into their locations of its header; None stands in the locations of those at fault.

    Args:
        header: the header, which is changed.
        items: the entries of `$items`.
        content: the whole file.
        start: where the header ends, from where offsets count.

    Returns:
        What is wrong with items, in their order.
    """
    extents: list[tuple[int, int, int]] = []
    problems: dict[int, str] = {}
    for number, item in enumerate(items):
        try:
            offset, length = _put_item(header, item, content, start)
        except _TakenError as error:
            problems[number] = str(error)
        except _ItemError as error:
            problems[number] = str(error)
            _clear(header, item, placed=False)
        else:
            extents += [(offset, offset + length, number)] if length else []
    reached, holder = 0, 0
    for first, stop, number in sorted(extents):
        if first < reached:
            problems[number] = f"starts at byte {first}, inside item {holder}, which ends at {reached}"
            _clear(header, items[number], placed=True)
        if stop > reached:
            reached, holder = stop, number
    faults = []
    for number in sorted(problems):
        keys: Any = items[number].get("keys") if isinstance(items[number], dict) else None
        known = isinstance(keys, list)
        path = format_keys(keys, header) if known else ""
        faults.append(ItemFault(number, tuple(keys) if known else None, path, problems[number]))
    return faults


def item_locations(header: dict[str, Any], items: list[Any]) -> dict[str, int]:
    """Number of each item by the location that it names, such as `sensors[0].frames[3].points.positions`."""
    keys = [item.get("keys") if isinstance(item, dict) else None for item in items]
    return {format_keys(path, header): k for k, path in reversed(list(enumerate(keys))) if path}


def format_keys(keys: Any, root: Any = None) -> str:
    """Write a path of keys as `sensors[3].frames[12].points`; numeric text counts as an index where a list is."""
    text, node = "", root
    for key in keys if isinstance(keys, list | tuple) else [keys]:
        if isinstance(node, list) or isinstance(key, int):
            text += f"[{key}]"
        else:
            text += f".{key}" if text else str(key)
        node = _step(node, key)
    return text


def _step(node: Any, key: Any) -> Any:
    """Follow one key of a path; None where it leads nowhere."""
    if isinstance(node, dict):
        return node.get(str(key))
    index = _index(key)
    return node[index] if isinstance(node, list) and index is not None and index < len(node) else None


def _walk(node: Any, keys: list[Any]) -> Any:
    """Follow a path; what files nearly always have goes first, as there may be hundreds of thousands of paths."""
    for key in keys:
        if type(node) is list and type(key) is int and 0 <= key < len(node):
            node = node[key]
        elif type(node) is dict and type(key) is str:
            node = node.get(key)
        else:
            node = _step(node, key)
    return node


class _ItemError(ValueError):
    """What is wrong with an item."""


class _TakenError(_ItemError):
    """The item is well, but its location is not free."""


def _put_item(header: dict[str, Any], item: Any, content: mmap.mmap, start: int) -> tuple[int, int]:
    if not isinstance(item, dict):
        raise _ItemError(f"a {type(item).__name__}; expected an object with keys, length and offset")
    offset, length = item.get("offset"), item.get("length")
    if not (type(offset) is int and type(length) is int and offset >= 0 and length >= 0):
        name = "length" if _is_count(offset) else "offset"
        raise _ItemError(f"{name} {item.get(name)!r}; expected a whole number of bytes, 0 or more")
    available = len(content) - start
    if offset + length > available:
        raise _ItemError(f"bytes {offset} to {offset + length}; the file has {available} after its header")
    _put(header, item.get("keys"), _array(item, content, start + offset, length))
    return offset, length


def _array(item: dict[str, Any], content: mmap.mmap, start: int, length: int) -> AnyArray:
    name = item.get("dtype")
    dtype = np.dtype(np.uint8) if name is None else DTYPES.get(name) if isinstance(name, str) else None
    if dtype is None:
        raise _ItemError(f"dtype {name!r}; expected one of {', '.join(_DTYPE_NAMES)}")
    count, rest = divmod(length, dtype.itemsize)
    if rest:
        raise _ItemError(f"{length} bytes are no whole number of {dtype.name}")
    shape = item.get("shape")
    if shape is not None:
        _check_shape(shape, count)
    try:
        array: AnyArray = np.ndarray((count,) if shape is None else shape, dtype, content, start if count else 0)
    except (ValueError, OverflowError):
        raise _ItemError(f"shape {shape} is beyond what an array can have") from None
    return array.view(RawBytes) if name is None and shape is None else array


def _clear(header: dict[str, Any], item: Any, *, placed: bool) -> None:
    """Put None in the location of an item at fault, unless something else stands there; `placed`: its array does."""
    keys = item.get("keys") if isinstance(item, dict) else None
    location = _find(header, keys) if isinstance(keys, list) and keys else None
    if location is not None and (placed or _is_free(location)):
        holder, slot = location
        cast("dict[str | int, Any]", holder)[slot] = None


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


def _check_shape(shape: Any, count: int) -> None:
    if not isinstance(shape, list) or not all(map(_is_count, shape)):
        raise _ItemError(f"shape {shape!r}; expected a list of numbers, 0 or more")
    if len(shape) > _MOST_AXES:
        raise _ItemError(f"a shape of {len(shape)} axes is beyond what an array can have")
    if prod(shape) != count:
        raise _ItemError(f"shape {shape} needs {prod(shape)} values; the item holds {count}")


def _index(key: Any) -> int | None:
    if type(key) is int:
        return key if key >= 0 else None
    return int(key) if isinstance(key, str) and key.isascii() and key.isdigit() and len(key) < 19 else None


_Slot = tuple[dict[str, Any] | list[Any], str | int]
"""A location in the header: the object or list, and the key or index in it."""


def _put(header: dict[str, Any], keys: Any, array: AnyArray) -> None:
    if not isinstance(keys, list) or not keys:
        raise _ItemError(f"keys {keys!r}; expected the path of the array's location")
    location = _find(header, keys)
    if location is None:
        raise _ItemError(f"its keys lead nowhere: there is no {_missing(header, keys)}")
    if not _is_free(location):
        raise _TakenError("its location in the header is taken already")
    holder, slot = location
    cast("dict[str | int, Any]", holder)[slot] = array


def _find(header: dict[str, Any], keys: list[Any]) -> _Slot | None:
    holder = _walk(header, keys[:-1])
    if not isinstance(holder, dict | list):
        return None
    slot = _slot(holder, keys[-1])
    return None if slot is None else (holder, slot)


def _missing(header: dict[str, Any], keys: list[Any]) -> str:
    """The part of a path that is not in the header."""
    node: Any = header
    for depth, key in enumerate(keys[:-1]):
        node = _step(node, key)
        if not isinstance(node, dict | list):
            return format_keys(keys[: depth + 1], header)
    return format_keys(keys, header)


def _slot(parent: dict[str, Any] | list[Any], key: Any) -> str | int | None:
    if isinstance(parent, dict):
        return str(key) if isinstance(key, str | int) and str(key) in parent else None
    index = _index(key)
    return index if index is not None and index < len(parent) else None


def _is_free(location: _Slot) -> bool:
    """Whether an array can be put there: writers leave an empty text."""
    held = cast("dict[str | int, Any]", location[0])[location[1]]
    return not isinstance(held, np.ndarray) and (held is None or held in ("", [], {}))


_MAPPED_AT_MOST = 128 << 20
_DONT_NEED: int | None = getattr(mmap, "MADV_DONTNEED", None)  # not on every system


class MappedFile(mmap.mmap):
    """The bytes of a file, read only.

    Attributes:
        identity: how to report the file from one that takes its location.
        handed_out: bytes of arrays that were asked for since pages were last let go.
    """

    identity: FileIdentity
    handed_out: int = 0

    @classmethod
    def of(cls, path: Path) -> Self:
        """Map a file.

        Raises:
            OSError: it cannot be read.
            ValueError: it is empty.
        """
        with open_file(path) as file:
            mapped = cls(file.fileno(), 0, access=mmap.ACCESS_READ)
            mapped.identity = FileIdentity.of(path, descriptor=file.fileno())
        return mapped

    def hand_out(self, size: int) -> None:
        """Count bytes that are going to be read, and now and then let go of all pages that were.

        The system keeps them in its cache and maps them again if they are touched; but they count as this process's
        memory as long as they are mapped, and a long drive would be all in it in the end.
        """
        self.handed_out += size
        if self.handed_out > _MAPPED_AT_MOST and _DONT_NEED is not None:
            self.handed_out = 0
            self.madvise(_DONT_NEED)

    def reference(self, array: AnyArray) -> "StoredArray":
        """Give what stands for a contiguous array of these bytes in other processes."""
        start = _address(array) - _address(np.frombuffer(self, np.uint8))
        return StoredArray(self.identity, start, array.dtype, array.shape)


@dataclass(frozen=True, slots=True, eq=False)
class StoredArray:
    """Where an array is in a file."""

    identity: FileIdentity
    start: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    def __call__(self) -> AnyArray:
        """Map the file again, and give the array.

        Raises:
            DataError: the file was changed, replaced or removed.
        """
        self.identity.check()
        mapped = MappedFile.of(self.identity.path)
        return np.frombuffer(mapped, self.dtype, prod(self.shape), self.start).reshape(self.shape)


class _MappedContent:
    """The bytes of an array of a mapped file, whose pages are let go as they are read."""

    def __init__(self, file: MappedFile, content: memoryview) -> None:
        """Nothing is read yet."""
        self._file, self._content = file, content

    def __len__(self) -> int:
        return len(self._content)

    def __getitem__(self, part: slice) -> memoryview:
        piece = self._content[part]
        self._file.hand_out(len(piece))
        return piece

    def __call__(self) -> BinaryIO:
        """Open them as a file."""
        return cast("BinaryIO", io.BufferedReader(ByteStream(self)))


@dataclass(frozen=True, slots=True, eq=False)
class LocalFile:
    """A file of this machine for a container.

    Attributes:
        content: its bytes.
        identity: how to report it from a file that takes its location.
    """

    content: MappedFile
    identity: FileIdentity

    @classmethod
    def of(cls, path: Path) -> Self:
        """Map a file.

        Raises:
            DataError: it cannot be read, or is empty.
        """
        try:
            if path.exists() and not path.is_file():
                raise DataError(path, "", "not a file; expected a Sensor Fusion Scene file")
            content = MappedFile.of(path)
        except ValueError:
            raise DataError(path, "", "is empty; expected a JSON header") from None
        except OSError as error:
            raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
        return cls(content, content.identity)

    def header(self, limit: int) -> memoryview:
        """Give the bytes before the first NUL.

        Raises:
            DataError: they are more than `limit`.
        """
        stop = self.content.find(b"\0", 0, limit)
        if stop < 0 and len(self.content) > limit:
            raise DataError(self.identity.name, "header", f"no NUL ends it within {limit} bytes")
        # A file without arrays needs no NUL; one that was cut inside its header is no whole JSON.
        return memoryview(self.content)[: stop if stop >= 0 else len(self.content)]

    def fill(self, header: dict[str, Any]) -> None:
        """Do nothing: all arrays have their values."""

    def fetch(self, value: Any) -> Any:
        """Give the value itself: the system reads its pages when they are touched."""
        self.content.hand_out(_bytes_in(value))
        return value

    def bytes_of(self, array: AnyArray) -> "_MappedContent":
        """Give the bytes of an array without copying them."""
        return _MappedContent(self.content, array.data.cast("B"))

    def close(self) -> None:
        """Do nothing: the map stays as long as an array of it is in use."""


def _bytes_in(value: Any) -> int:
    """How large the arrays of a record are in all."""
    if isinstance(value, dict):
        return sum(map(_bytes_in, value.values()))
    return value.nbytes if isinstance(value, np.ndarray) else 0


def _address(array: AnyArray) -> int:
    return int(array.__array_interface__["data"][0])


class Unfetched(np.ndarray[Any, Any]):
    """The location of an array in a file: shape and dtype are known, and looking at values is an error.

    Its memory is a part of the file's placeholder, so that its address reports where in the file it is.
    """

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise DataError("", "", f"the values of an array {self.shape} of a remote file were not asked for")

    __getitem__ = __array_ufunc__ = __array_function__ = _refuse
    __iter__ = __reduce__ = __copy__ = __deepcopy__ = _refuse
    tolist = tobytes = item = copy = sum = min = max = any = all = _refuse


class UnfetchedBytes(RawBytes, Unfetched):
    """The same for an item that names no dtype."""

    def plain(self) -> AnyArray:
        """The same bytes as an array that is not fetched either."""
        return self.view(Unfetched)


def unfetched(array: AnyArray) -> Unfetched:
    """Keep others from looking at the values of an array that has none yet."""
    return array.view(UnfetchedBytes if isinstance(array, RawBytes) else Unfetched)


def arrays_in(value: Any) -> Iterator[Unfetched]:
    """All arrays without values inside objects and lists."""
    if isinstance(value, Unfetched):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from arrays_in(part)


def replaced(value: Any, filled: dict[int, AnyArray]) -> Any:
    """Copy objects and lists with arrays put in the locations of those without values; by `id` of the latter."""
    if isinstance(value, Unfetched):
        return filled[id(value)]
    if isinstance(value, dict):
        return {key: replaced(part, filled) for key, part in value.items()}
    if isinstance(value, list):
        return [replaced(part, filled) for part in value]
    return value


_FIRST_BLOCK, _LARGEST_BLOCK = 64 << 10, 16 << 20
_PIECE = 256 << 10
_NO_RESERVE = 0x4000  # Source: MAP_NORESERVE of Linux; the placeholder takes addresses, not memory
_OF_FRAMES = {"lidar": "frames", "radar": "frames"}
_PLAYED = {"images", "video"}


class RemoteFile:
    """A file behind a URL for a container.

    Attributes:
        content: as many bytes as the file has, without its values: arrays are views of it before they are fetched.
        identity: how to report the file from one that takes its location.
    """

    def __init__(self, file: RangedFile) -> None:
        """Take an open file."""
        self.identity = file.identity
        self.content = _placeholder(file.identity.size)
        self._address = _address(np.frombuffer(self.content, np.uint8))
        self._file = file

    @classmethod
    def of(cls, url: str, storage_options: Mapping[str, Any] | None = None) -> Self:
        """Open a URL.

        Raises:
            DataError: it cannot be read, or is empty.
            MissingExtraError: what reads such URLs is not installed.
        """
        return cls(RemoteIdentity.of(url, storage_options).open())

    def header(self, limit: int) -> memoryview:
        """Fetch the bytes before the first NUL, in blocks that grow.

        Raises:
            DataError: they are more than `limit`, or cannot be read.
        """
        text, block = bytearray(), _FIRST_BLOCK
        while len(text) < self.identity.size:
            if len(text) > limit:
                raise DataError(self.identity.name, "header", f"no NUL ends it within {limit} bytes")
            piece = self._file.ask(len(text), min(len(text) + block, self.identity.size))
            stop = piece.find(b"\0")
            text += piece if stop < 0 else piece[:stop]
            if stop >= 0:
                break
            block = min(2 * block, _LARGEST_BLOCK)
        return memoryview(bytes(text))

    def fill(self, header: dict[str, Any]) -> None:
        """Fetch all arrays of a header but those of frames and images, which are marked as unfetched."""
        looked_into: list[tuple[Any, Any]] = []
        for holder, key, deferred in _locations(header, (), header):
            array = holder[key]
            holder[key] = unfetched(array)
            if not (deferred and array.dtype.isnative):
                looked_into.append((holder, key))
        filled = self._filled([holder[key] for holder, key in looked_into])
        for holder, key in looked_into:
            holder[key] = filled[id(holder[key])]

    def fetch(self, value: Any) -> Any:
        """Give a value with all arrays in it filled; neighbouring ones are fetched at one go.

        Raises:
            DataError: the file cannot be read.
        """
        return replaced(value, self._filled(list(arrays_in(value))))

    def bytes_of(self, array: AnyArray) -> "_RemoteContent":
        """Give the bytes of an array as what fetches the chunks that are read."""
        return _RemoteContent(self, *self._range(array))

    def close(self) -> None:
        """Let go of the connection."""
        self._file.close()

    def read(self, start: int, stop: int) -> bytes:
        """Fetch a range; what was fetched a moment ago is remembered.

        Raises:
            DataError: the file cannot be read.
        """
        return self._file.fetch(start, stop)

    def _range(self, array: AnyArray) -> Range:
        start = _address(array) - self._address if array.nbytes else 0
        return start, start + array.nbytes

    def _filled(self, arrays: Sequence[Unfetched]) -> dict[int, AnyArray]:
        """Fetch arrays; by `id` of those without values."""
        ranges = {id(array): self._range(array) for array in arrays}
        blocks = coalesced(range_ for range_ in ranges.values() if range_[0] < range_[1])
        starts = np.array([start for start, _ in blocks], np.int64)
        contents = [self.read(*block) for block in blocks]
        filled = {}
        for array in arrays:
            start, _ = ranges[id(array)]
            block = int(np.searchsorted(starts, start, side="right")) - 1
            content, skipped = (contents[block], start - blocks[block][0]) if array.nbytes else (b"", 0)
            plain = np.frombuffer(content, array.dtype, array.size, skipped).reshape(array.shape)
            filled[id(array)] = plain.view(RawBytes) if isinstance(array, RawBytes) else plain
        return filled


class _RemoteContent:
    """The bytes of an array of a file behind a URL, fetched piece by piece as they are read."""

    def __init__(self, file: RemoteFile, start: int, stop: int) -> None:
        """Nothing is fetched yet."""
        self._remote, self._start, self._stop = file, start, stop

    def __len__(self) -> int:
        return self._stop - self._start

    def __getitem__(self, part: slice) -> bytes:
        start, stop, _ = part.indices(len(self))
        return b"".join(self._chunks(start, stop)) if start < stop else b""

    def __call__(self) -> BinaryIO:
        """Open them as a file."""
        return cast("BinaryIO", io.BufferedReader(ByteStream(self), _PIECE))

    def _chunks(self, start: int, stop: int) -> Iterator[bytes]:
        """Fetch whole chunks of one length, so that readings side by side find them remembered."""
        for number in range(start // _PIECE, -(-stop // _PIECE)):
            first = number * _PIECE
            piece = self._remote.read(self._start + first, min(self._start + first + _PIECE, self._stop))
            yield piece[max(0, start - first) : stop - first]


def _locations(node: Any, keys: tuple[Any, ...], header: dict[str, Any]) -> Iterator[tuple[Any, Any, bool]]:
    """All arrays of a header: what holds them, under which key, and whether readers leave them for later."""
    for key, value in list(node.items()) if isinstance(node, dict) else enumerate(node):
        if isinstance(value, np.ndarray):
            yield node, key, _is_deferred(header, (*keys, key))
        elif isinstance(value, dict | list):
            yield from _locations(value, (*keys, key), header)


def _is_deferred(header: dict[str, Any], keys: tuple[Any, ...]) -> bool:
    """Whether an array belongs to a frame of a lidar or radar, or is an image or a video of a camera."""
    ours = keys[:2] == ("metadata", "sceneloom")
    keys, root = (keys[2:], header["metadata"]["sceneloom"]) if ours else (keys, header)
    if len(keys) < 4 or keys[0] != "sensors" or not isinstance(root["sensors"], list):
        return False
    sensor = root["sensors"][keys[1]]
    kind = sensor.get("type") if isinstance(sensor, dict) else None
    if kind == "camera":
        return keys[2] in _PLAYED and keys[-1] == "content"
    return bool(keys[2] == _OF_FRAMES.get(str(kind)))


def _placeholder(size: int) -> mmap.mmap:
    if hasattr(mmap, "MAP_PRIVATE"):
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _NO_RESERVE
        return mmap.mmap(-1, size, flags=flags, prot=mmap.PROT_READ)
    return mmap.mmap(-1, size, access=mmap.ACCESS_READ)


__all__ = ["DTYPES", "ITEMS", "Container", "ItemFault", "RawBytes", "format_keys"]

HEADER_LIMIT = 1 << 30
"""Longest header that is read [bytes]: beyond it the text alone would fill the memory of a large machine."""

Content = _MappedContent | _RemoteContent
"""The bytes of an array, by slices, and as a file when it is called."""


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
        self._stored: LocalFile | RemoteFile
        self._stored = RemoteFile.of(str(path), storage_options) if is_url(path) else LocalFile.of(Path(path))
        self.identity: FileIdentity | RemoteIdentity = self._stored.identity
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

    @property
    def is_remote(self) -> bool:
        """Whether the file is behind a URL."""
        return isinstance(self._stored, RemoteFile)

    def bytes_of(self, array: AnyArray) -> Content:
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

    def item_keys(self, number: int) -> tuple[str | int, ...] | None:
        """The path that an item names, with numbers where a list is: writers may state them as text; None for none."""
        item = self._items[number]
        keys = item.get("keys") if isinstance(item, dict) else None
        if not isinstance(keys, list):
            return None
        node: Any = self.header
        found: list[str | int] = []
        for key in keys:
            found.append(int(key) if isinstance(node, list) and str(key).isdigit() else str(key))
            node = _step(node, key)
        return tuple(found)

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


@contextmanager
def collector_paused() -> Iterator[None]:
    """Pause the search for reference cycles.

    A header makes very many small objects that all stay and form no cycles: the collector would walk over them again
    and again and take more time than the parsing.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
