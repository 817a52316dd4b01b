"""Pandas frames of numbers and texts read from pickles, without pandas and without running anything in them."""

import gzip
import pickle
import pickletools
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.files import file_faults, most_unpacked, open_file

LARGEST = 1 << 29
"""More bytes than this, unpacked, no frame has."""

_GZIP = b"\x1f\x8b"
_LONGEST_MEMO = 1 << 20

_OPERATIONS = frozenset(
    (
        *("PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK", "NONE", "NEWTRUE", "NEWFALSE"),
        *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "BINFLOAT"),
        *("SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8", "SHORT_BINSTRING", "BINSTRING"),
        *("SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
        *("EMPTY_LIST", "LIST", "APPEND", "APPENDS", "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
        *("EMPTY_DICT", "DICT", "SETITEM", "SETITEMS"),
        *("BINGET", "LONG_BINGET", "BINPUT", "LONG_BINPUT", "MEMOIZE"),
        *("GLOBAL", "STACK_GLOBAL", "REDUCE", "NEWOBJ", "BUILD"),
    )
)
"""What the files of frames are made of; out-of-band buffers, persistent ids and the like are not."""


class _Wrong(Exception):  # noqa: N818 - it never leaves this module
    """The file is not what was expected; says why."""


@dataclass(frozen=True, slots=True, eq=False)
class PickledFrame:
    """The columns of a pandas frame.

    Attributes:
        file: where they come from, for messages.
        count: number of rows N.
        columns: (N,) arrays of numbers or truth values; texts, and columns with gaps, as objects.
    """

    file: Path
    count: int
    columns: Mapping[str, AnyArray]

    @classmethod
    def read(cls, path: Path) -> "PickledFrame":
        """Read a pandas frame of numbers and texts from `.pkl` or `.pkl.gz`.

        Raises:
            DataError: the file cannot be read, is cut off, or holds anything else.
        """
        content = _unpacked(path)
        try:
            _check_operations(content)
            return _frame(path, _Reader(BytesIO(content)).load())
        except _Wrong as error:
            raise DataError(path, "", str(error)) from error
        except (pickle.UnpicklingError, EOFError, MemoryError, *_LOOKUPS) as error:
            raise DataError(path, "", f"is no whole pickle of a pandas frame: {error}") from error

    def column(self, name: str) -> AnyArray:
        """A column by its name.

        Raises:
            DataError: the frame does not have it.
        """
        if name not in self.columns:
            raise DataError(self.file, "", f"no column {name!r}; it has {', '.join(self.columns) or 'none'}")
        return self.columns[name]

    def numbers(self, name: str) -> AnyArray:
        """A column of finite numbers as float64.

        Raises:
            DataError: it holds something else.
        """
        column = self.column(name)
        if column.dtype.kind not in "fiub":
            raise DataError(self.file, name, f"values of type {column.dtype}; expected numbers")
        values = column.astype(np.float64)
        if not np.isfinite(values).all():
            raise DataError(self.file, name, f"row {int(np.argmin(np.isfinite(values)))} is not finite")
        return values


_LOOKUPS = (AttributeError, TypeError, ValueError, IndexError, KeyError, OverflowError, RecursionError)
"""What Python says of pickles that break off or do what they must not."""


def _unpacked(path: Path) -> bytes:
    try:
        with file_faults(path), open_file(path) as file:
            is_packed = file.read(2) == _GZIP
            file.seek(0)
            most = min(LARGEST, most_unpacked(path.stat().st_size)) if is_packed else LARGEST
            content = (gzip.GzipFile(fileobj=file) if is_packed else file).read(most + 1)
    except (EOFError, zlib.error) as error:
        raise DataError(path, "", f"is no whole gzip file: {error}") from error
    if len(content) > most:
        raise DataError(path, "", f"more than {most} bytes; expected a frame of a sweep")
    return content


def _check_operations(content: bytes) -> None:
    for operation, argument, location in pickletools.genops(content):
        if operation.name not in _OPERATIONS:
            raise _Wrong(f"byte {location}: operation {operation.name}, which no frame of numbers and texts needs")
        if operation.name in _MEMO_OPERATIONS and int(str(argument)) > _LONGEST_MEMO:
            raise _Wrong(f"byte {location}: {argument} things to remember; expected fewer than {_LONGEST_MEMO}")


_MEMO_OPERATIONS = {"BINPUT", "LONG_BINPUT", "BINGET", "LONG_BINGET"}

# What names of a file stand for. Each refuses to be changed by the file but for its own state.


class _Sealed:
    """Keeps nothing that a file wants to add to it."""

    __slots__ = ()

    def __setstate__(self, state: object) -> None:
        raise _Wrong("changes what it must not")


class _Name(_Sealed):
    """Stands for a class whose name alone matters."""

    __slots__ = ("name",)

    def __init__(self, name: str) -> None:
        self.name = name


class _Call(_Sealed):
    """Stands for a function."""

    __slots__ = ("_make",)

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make

    def __call__(self, *arguments: Any) -> Any:
        return self._make(*arguments)


class _Frame:
    """Stands for `DataFrame`."""

    __slots__ = ("state",)

    def __setstate__(self, state: object) -> None:
        self.state = state


class _Manager:
    """Stands for `BlockManager`: its axes and blocks, as constructed (pandas 1.3 and later) or as its state."""

    __slots__ = ("parts",)

    def __init__(self, *parts: Any) -> None:
        self.parts: tuple[Any, ...] = parts

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, tuple) and len(state) == 4:
            inner = state[3]["0.14.1"]
            blocks = tuple(_Block(block["values"], block["mgr_locs"]) for block in inner["blocks"])
            self.parts = (blocks, inner["axes"])
        elif state is not None:
            raise _Wrong("blocks of an unknown form")


@dataclass(frozen=True, slots=True)
class _Block:
    """Columns of one type: (K, N) values, and which columns they are."""

    values: Any
    locations: Any


class _Dtype:
    """Stands for NumPy's dtype of numbers, truth values or objects."""

    __slots__ = ("dtype",)

    def __init__(self, text: str, *_: object) -> None:
        if text not in _DTYPES:
            raise _Wrong(f"values of type {text!r}; expected numbers and texts")
        self.dtype = np.dtype(text)

    def __setstate__(self, state: Any) -> None:
        order = state[1]
        if order not in ("<", ">", "|", "="):
            raise _Wrong(f"byte order {order!r}")
        self.dtype = self.dtype.newbyteorder(order)


_DTYPES = frozenset(("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1", "O8", "O"))


class _Array:
    """Stands for an array; what it holds is reported afterwards."""

    __slots__ = ("values",)

    def __init__(self, *_: object) -> None:
        self.values: AnyArray | None = None

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, tuple) and len(state) == 2:  # pandas' arrays of texts: their dtype, and an array
            self.values = _values(state[1])
            return
        _, shape, dtype, is_fortran, content = state
        self.values = _array(content, dtype, shape, "F" if is_fortran else "C")


def _array(content: Any, dtype: Any, shape: Any, order: str) -> AnyArray:
    """Cut an array out of bytes, or make one of a list of texts and the like."""
    if not (isinstance(dtype, _Dtype) and isinstance(shape, tuple) and all(type(n) is int for n in shape)):
        raise _Wrong("an array without a shape")
    if dtype.dtype.kind == "O":
        if not isinstance(content, list):
            raise _Wrong("an array of objects without a list")
        values = np.empty(len(content), object)
        values[:] = [_plain(value) for value in content]
    else:
        values = np.frombuffer(bytes(content), dtype.dtype).astype(dtype.dtype.newbyteorder("="), copy=False)
    return values.reshape(shape, order="F" if order == "F" else "C")


def _plain(value: Any) -> Any:
    if value is None or type(value) in (str, int, float, bool):
        return value
    raise _Wrong(f"a {type(value).__name__.strip('_')} among texts; expected texts and numbers")


def _index(kind: Any, fields: Any) -> Any:
    """What a frame's index says: the labels, or None where it only counts."""
    del kind
    return fields.get("data")


_NAMED: Mapping[str, Any] = MappingProxyType(
    {
        "DataFrame": _Frame,
        "BlockManager": _Manager,
        "_new_Index": _Call(_index),
        "_unpickle_block": _Call(lambda values, locations, _: _Block(values, locations)),
        "__pyx_unpickle_NDArrayBacked": _Call(_Array),
        "StringDtype": _Call(lambda *_: None),
        "_reconstruct": _Call(_Array),
        "_frombuffer": _Call(_array),
        "scalar": _Call(lambda dtype, content: _array(content, dtype, (), "C").item()),
        "dtype": _Dtype,
        "slice": _Call(slice),
        "encode": _Call(lambda text, code: text.encode("latin-1") if code == "latin1" else b""),
    }
)

_MARKS = frozenset(("ndarray", "Index", "Int64Index", "UInt64Index", "Float64Index", "RangeIndex", "StringArray"))
"""Names of which it is enough that they are there."""

_LOCATIONS = ("pandas", "numpy", "builtins", "__builtin__", "_codecs")


class _Reader(pickle.Unpickler):
    """Looks names up in the table of this module, and imports nothing."""

    def find_class(self, module: str, name: str) -> Any:
        """Give what stands for a name."""
        if module.split(".", maxsplit=1)[0] in _LOCATIONS:
            if name in _MARKS:
                return _Name(name)
            if name in _NAMED:
                return _NAMED[name]
        raise _Wrong(f"asks for {module}.{name}, which no frame of numbers and texts needs; it was not loaded")


def _values(thing: Any) -> AnyArray:
    if isinstance(thing, _Array):
        thing = thing.values
    if not isinstance(thing, np.ndarray):
        raise _Wrong("an array is missing")
    return thing


def _frame(path: Path, found: object) -> PickledFrame:
    """Lay the blocks of a frame out as columns."""
    if not isinstance(found, _Frame):
        raise _Wrong(f"holds a {type(found).__name__.strip('_').lower()}; expected a pandas frame")
    state = found.state
    manager = state.get("_mgr", state.get("_data")) if isinstance(state, dict) else None
    if not isinstance(manager, _Manager):
        raise _Wrong("a frame without blocks")
    blocks, axes = manager.parts
    names = [str(name) for name in _values(axes[0]).tolist()]
    columns: dict[str, AnyArray] = {}
    for block in blocks:
        values = _values(block.values)
        where = block.locations
        for row, location in enumerate(
            range(len(names))[where] if isinstance(where, slice) else _values(where).tolist()
        ):
            columns[names[location]] = values if values.ndim == 1 else values[row]
    counts = {len(column) for column in columns.values()}
    if len(columns) != len(names) or len(counts) > 1:
        raise _Wrong(f"{len(columns)} columns of {sorted(counts)} rows; expected {len(names)} of one length")
    ordered = {name: read_only(columns[name]) for name in names}
    return PickledFrame(path, counts.pop() if counts else 0, MappingProxyType(ordered))
