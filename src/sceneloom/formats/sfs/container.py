"""The container of `.sfs` files, reading side: a JSON header, then arrays, mapped into memory and not copied.

Layout: the header is UTF-8 JSON and ends at the first NUL. Its `$items` list names the arrays: `keys` is the path of
the array's place in the header, `offset` counts from that first NUL, `length` is in bytes; `dtype` and `shape` may be
absent, and then the field decides.

Source: scale-json-binary 0.0.7, whose files this reads; the format's description leaves the container out.
"""

import json
import mmap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.sfs.mapped_file import MappedFile

HEADER_LIMIT = 1 << 30
"""Longest header that is read [bytes]: beyond it the text alone would fill the memory of a large machine."""

_LOOKED_THROUGH = 64 << 20
"""How far a file without the suffix is searched for the end of a header: logs begin with a brace, too [bytes]."""

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


class RawBytes(np.ndarray[Any, Any]):
    """The bytes of an item that names no dtype; the field that they belong to decides what they are."""


@dataclass(frozen=True, slots=True)
class ItemFault:
    """What is wrong with an item.

    Attributes:
        number: which entry of `$items` it is.
        keys: the place that it names, as it stands in the item; None where it names none.
        path: that place as text (`sensors[0].frames[3].points.positions`), empty where it names none.
        problem: the value and what was expected.
    """

    number: int
    keys: tuple[Any, ...] | None
    path: str
    problem: str

    @property
    def place(self) -> str:
        """Where in the header the fault is, for messages."""
        return f"{ITEMS}[{self.number}]" + (f" ({self.path})" if self.path else "")


class Container:
    """An open `.sfs` file.

    Attributes:
        file: its name, for messages.
        identity: how to tell it from a file that takes its place.
        header: the decoded header without `$items`; arrays stand in their places as read-only views.

    Raises:
        DataError: the file cannot be read, or its header or an item is wrong.
    """

    def __init__(self, path: Path, *, faults: list[ItemFault] | None = None) -> None:
        """Map the file and decode its header.

        Args:
            path: the file.
            faults: where items at fault are noted, in the order of `$items`; None stands in the place of each in the
                header, if it has one. Without a list the first fault is raised.
        """
        self.file = str(path)
        self._faults = faults
        self._numbers: dict[str, int] | None = None
        self._mapped = _map_file(path)
        self.identity = self._mapped.identity
        self.closed = False
        self._on_close: list[Callable[[], None]] = []
        self._start = _header_stop(self._mapped, self.file)
        header = _decode(self._mapped, self._start, self.file)
        if not isinstance(header, dict):
            raise DataError(self.file, "header", f"a JSON {type(header).__name__}; expected an object")
        self._items = header.pop(ITEMS, [])
        if not isinstance(self._items, list):
            raise DataError(self.file, ITEMS, f"a {type(self._items).__name__}; expected a list")
        self.header: dict[str, Any] = header
        self._place_items()

    def close(self) -> None:
        """Let go of the file; arrays that are still in use keep their part of it."""
        self.closed = True
        while self._on_close:
            self._on_close.pop()()

    def on_close(self, close: Callable[[], None]) -> None:
        """Have something closed together with the file."""
        self._on_close.append(close)

    def check_open(self, place: str) -> None:
        """Refuse to read from a closed file.

        Raises:
            DataError: the file is closed.
        """
        if self.closed:
            raise DataError(self.file, place, "the scene is closed; read its frames before that")

    def item_number(self, place: str) -> int | None:
        """Find the item that fills a place such as `sensors[0].frames[3].points.positions`."""
        if self._numbers is None:
            named = ((n, item.get("keys")) for n, item in enumerate(self._items) if isinstance(item, dict))
            self._numbers = {format_keys(k, self.header): n for n, k in named if isinstance(k, list)}
        return self._numbers.get(place)

    def _place_items(self) -> None:
        extents: list[tuple[int, int, int]] = []
        problems: dict[int, str] = {}
        for number, item in enumerate(self._items):
            try:
                offset, length = self._place_item(item)
            except _ItemError as error:
                problems[number] = str(error)
                if self._faults is None:
                    break
                continue
            if length:
                extents.append((offset, offset + length, number))
        problems |= _overlaps(extents)
        for number in sorted(problems):
            self._note_fault(_fault(number, self._items[number], problems[number]))

    def _note_fault(self, fault: ItemFault) -> None:
        if self._faults is None:
            raise DataError(self.file, fault.place, fault.problem)
        self._faults.append(fault)
        if not fault.problem.startswith(_TAKEN):
            _clear(self.header, fault.keys or ())

    def _place_item(self, item: Any) -> tuple[int, int]:
        if not isinstance(item, dict):
            raise _ItemError(f"a {type(item).__name__}; expected an object with keys, length and offset")
        offset, length = _count(item, "offset"), _count(item, "length")
        available = len(self._mapped) - self._start
        if offset + length > available:
            raise _ItemError(
                f"bytes {offset} to {offset + length}; the file has {available} after its header"
            )
        array = self._array(item, offset, length)
        _put(self.header, item.get("keys"), array)
        return offset, length

    def _array(self, item: dict[str, Any], offset: int, length: int) -> AnyArray:
        name = item.get("dtype")
        dtype = np.dtype(np.uint8) if name is None else DTYPES.get(name) if isinstance(name, str) else None
        if dtype is None:
            raise _ItemError(f"dtype {name!r}; expected one of {', '.join(_DTYPE_NAMES)}")
        count, rest = divmod(length, dtype.itemsize)
        if rest:
            raise _ItemError(f"{length} bytes are no whole number of {dtype.name}")
        array: AnyArray = np.frombuffer(self._mapped, dtype, count, self._start + offset if count else 0)
        if item.get("shape") is not None:
            return _shaped(array, item["shape"])
        return array.view(RawBytes) if name is None else array


class _ItemError(ValueError):
    """What is wrong with an item."""


_TAKEN = "its place in the header is taken already"


def has_scene_header(path: Path) -> bool:
    """Say whether a file starts with `{` and has a header that ends in a NUL and names `$items`."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            if not file.read(4096).lstrip(b" \t\r\n").startswith(b"{"):
                return False
            if path.suffix.lower() == ".sfs":
                return True
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
                stop = mapped.find(b"\0", 0, _LOOKED_THROUGH)
                return stop > 0 and mapped.find(f'"{ITEMS}"'.encode(), 0, stop) > 0
    except (OSError, ValueError):
        return False


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
    if isinstance(node, dict):
        return node.get(str(key))
    index = _index(key)
    return node[index] if isinstance(node, list) and index is not None and index < len(node) else None


def _map_file(path: Path) -> MappedFile:
    try:
        if path.exists() and not path.is_file():
            raise DataError(path, "", "not a file; expected a Sensor Fusion Scene file")
        return MappedFile.of(path)
    except ValueError:
        raise DataError(path, "", "is empty; expected a JSON header") from None
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error


def _header_stop(mapped: mmap.mmap, file: str) -> int:
    stop = mapped.find(b"\0", 0, HEADER_LIMIT)
    if stop >= 0:
        return stop
    if len(mapped) > HEADER_LIMIT:
        raise DataError(file, "header", f"no NUL ends it within {HEADER_LIMIT} bytes")
    # A file without arrays needs no NUL; one that was cut inside its header is no whole JSON.
    return len(mapped)


def _decode(mapped: mmap.mmap, stop: int, file: str) -> Any:
    with memoryview(mapped) as whole, whole[:stop] as text:
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


def _overlaps(extents: list[tuple[int, int, int]]) -> dict[int, str]:
    """Say of each item that starts inside an earlier one what is wrong; extents are (start, stop, number)."""
    problems: dict[int, str] = {}
    reached, holder = 0, 0
    for start, stop, number in sorted(extents):
        if start < reached:
            problems[number] = f"starts at byte {start}, inside item {holder}, which ends at {reached}"
        if stop > reached:
            reached, holder = stop, number
    return problems


def _fault(number: int, item: Any, problem: str) -> ItemFault:
    keys = item.get("keys") if isinstance(item, dict) else None
    if not isinstance(keys, list):
        return ItemFault(number, None, "", problem)
    return ItemFault(number, tuple(keys), format_keys(keys), problem)


def _clear(header: dict[str, Any], keys: tuple[Any, ...]) -> None:
    """Put None in the place of an item at fault, where there is such a place."""
    parent: Any = header
    for key in keys[:-1]:
        parent = _step(parent, key)
    slot = _slot(parent, keys[-1]) if keys and isinstance(parent, dict | list) else None
    if slot is not None:
        cast("dict[str | int, Any]", parent)[slot] = None


def _count(item: dict[str, Any], name: str) -> int:
    value = item.get(name)
    if type(value) is not int or value < 0:
        raise _ItemError(f"{name} {value!r}; expected a whole number of bytes, 0 or more")
    return value


def _shaped(array: AnyArray, shape: Any) -> AnyArray:
    if not isinstance(shape, list) or any(type(length) is not int or length < 0 for length in shape):
        raise _ItemError(f"shape {shape!r}; expected a list of numbers, 0 or more")
    if prod(shape) != array.size:
        raise _ItemError(f"shape {shape} needs {prod(shape)} values; the item holds {array.size}")
    try:
        return array.reshape(shape)
    except (ValueError, OverflowError):
        raise _ItemError(f"shape {shape} is beyond what an array can have") from None


def _index(key: Any) -> int | None:
    if type(key) is int:
        return key if key >= 0 else None
    return int(key) if isinstance(key, str) and key.isascii() and key.isdigit() and len(key) < 19 else None


def _put(header: dict[str, Any], keys: Any, array: AnyArray) -> None:
    if not isinstance(keys, list) or not keys:
        raise _ItemError(f"keys {keys!r}; expected the path of the array's place")
    parent = header
    for depth, key in enumerate(keys[:-1]):
        parent = _step(parent, key)
        if not isinstance(parent, dict | list):
            raise _ItemError(f"its keys lead nowhere: there is no {format_keys(keys[: depth + 1], header)}")
    slot = _slot(parent, keys[-1])
    if slot is None:
        raise _ItemError(f"its keys lead nowhere: there is no {format_keys(keys, header)}")
    _fill(parent, slot, array)


def _slot(parent: dict[str, Any] | list[Any], key: Any) -> str | int | None:
    if isinstance(parent, dict):
        return str(key) if isinstance(key, str | int) and str(key) in parent else None
    index = _index(key)
    return index if index is not None and index < len(parent) else None


def _fill(parent: dict[str, Any] | list[Any], slot: str | int, array: AnyArray) -> None:
    holder = cast("dict[str | int, Any]", parent)
    held = parent.get(cast("str", slot)) if isinstance(parent, dict) else parent[cast("int", slot)]
    if isinstance(held, np.ndarray) or (held is not None and held not in ("", [], {})):
        raise _ItemError(_TAKEN)
    holder[slot] = array
