"""The items of a container: each puts an array into its location of the header, or is at fault."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from mmap import mmap
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import AnyArray

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


def put_items(header: dict[str, Any], items: list[Any], content: mmap, start: int) -> list[ItemFault]:
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


def _location_item(header: dict[str, Any], item: Any, content: mmap, start: int) -> tuple[int, int]:
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


def _array(item: dict[str, Any], content: mmap, start: int, length: int) -> AnyArray:
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
