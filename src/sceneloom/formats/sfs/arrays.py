"""The arrays of a container: items of the header, arrays mapped into memory.

And arrays behind a URL that are not fetched yet.
"""

import io
import mmap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, NoReturn, Self, cast

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.base.files import ByteStream, FileIdentity, open_file

ITEMS = "$items"

_DTYPE_NAMES = [
    "bool",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
    "float16",
    "float32",
    "float64",
    "complex64",
    "complex128",
]

_LITTLE_ENDIAN = {name: np.dtype(name).newbyteorder("<") for name in _DTYPE_NAMES}

DTYPES: Mapping[str, np.dtype[Any]] = MappingProxyType(
    {
        **_LITTLE_ENDIAN,
        **{dtype.str: dtype for dtype in _LITTLE_ENDIAN.values()},
        **{dtype.newbyteorder(">").str: dtype.newbyteorder(">") for dtype in _LITTLE_ENDIAN.values()},
    }
)
"""The dtypes that an item may name: NumPy's names, and its codes with a byte order."""

_MOST_AXES = 64
"""Source: NPY_MAXDIMS of NumPy 2."""


class RawBytes(np.ndarray[Any, Any]):
    """The bytes of an item that names no dtype; the field that they belong to decides what they are."""


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
            offset, length = _location_item(header, item, content, start)
        except _TakenError as error:
            problems[number] = str(error)
            continue
        except _ItemError as error:
            problems[number] = str(error)
            _clear(header, item, placed=False)
            continue
        if length:
            extents.append((offset, offset + length, number))
    for number, problem in _overlaps(extents).items():
        problems[number] = problem
        _clear(header, items[number], placed=True)
    return [_fault(number, items[number], problems[number], header) for number in sorted(problems)]


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
        node = step(node, key)
    return text


def step(node: Any, key: Any) -> Any:
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
            node = step(node, key)
    return node


class _ItemError(ValueError):
    """What is wrong with an item."""


class _TakenError(_ItemError):
    """The item is well, but its location is not free."""


def _location_item(header: dict[str, Any], item: Any, content: mmap.mmap, start: int) -> tuple[int, int]:
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
        array: AnyArray = np.ndarray(
            (count,) if shape is None else shape, dtype, content, start if count else 0
        )
    except (ValueError, OverflowError):
        raise _ItemError(f"shape {shape} is beyond what an array can have") from None
    return array.view(RawBytes) if name is None and shape is None else array


def _overlaps(extents: list[tuple[int, int, int]]) -> dict[int, str]:
    """Report of each item that starts inside an earlier one what is wrong; extents are (start, stop, number)."""
    problems: dict[int, str] = {}
    reached, holder = 0, 0
    for start, stop, number in sorted(extents):
        if start < reached:
            problems[number] = f"starts at byte {start}, inside item {holder}, which ends at {reached}"
        if stop > reached:
            reached, holder = stop, number
    return problems


def _fault(number: int, item: Any, problem: str, header: dict[str, Any]) -> ItemFault:
    keys = item.get("keys") if isinstance(item, dict) else None
    if not isinstance(keys, list):
        return ItemFault(number, None, "", problem)
    return ItemFault(number, tuple(keys), format_keys(keys, header), problem)


def _clear(header: dict[str, Any], item: Any, *, placed: bool) -> None:
    """Put None in the position of an item at fault; what is not its own there stays.

    Args:
        placed: whether its array stands there already.
    """
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
        node = step(node, key)
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

_DONT_NEED: int | None = getattr(mmap, "MADV_DONTNEED", None)
"""Not on every system."""


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


class MappedContent:
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

    def bytes_of(self, array: AnyArray) -> "MappedContent":
        """Give the bytes of an array without copying them."""
        return MappedContent(self.content, array.data.cast("B"))

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
