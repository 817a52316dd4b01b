"""Arrays without a header: NPZ and NPY (pickled objects are refused), and raw BIN as in KITTI and nuScenes."""

import ast
import math
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.base.files import check_length, check_unpacked, file_faults, open_file, read_bytes
from sceneloom.formats.points.cloud import (
    ALIASES,
    KITTI,
    NUSCENES,
    ROW_ALIASES,
    Cloud,
    FieldLayout,
    check_count,
    columns_of,
)
from sceneloom.formats.points.spec import POSITION_NAMES

_MAGIC = b"\x93NUMPY"
_LONGEST_HEAD = 20_000

_FAULTS = (
    ValueError, KeyError, EOFError, TypeError, SyntaxError, RuntimeError, NotImplementedError, OverflowError,
    IndexError, RecursionError, zipfile.BadZipFile, zlib.error, tokenize.TokenError, UserWarning,
)  # fmt: skip
"""What NumPy and the modules below it raise for files that are damaged, encrypted, or hold objects."""

_PLAIN_COLUMNS = ("x", "y", "z", "intensity")
_NAMES_OF_COLUMNS = {name for names in (*ALIASES.values(), *ROW_ALIASES.values()) for name in names}


def read_npz(path: Path, *, layout: FieldLayout | None = None) -> Cloud:
    """Read arrays by name; rows of several numbers are cut into columns by `layout`, by default x y z intensity.

    Raises:
        DataError: the file is damaged, holds objects, its arrays do not have one length, or two give one column.
    """
    arrays = _arrays(path)
    columns: dict[str, AnyArray] = {}
    for name, array in arrays.items():
        found = _columns(path, name, array, layout)
        twice = [column for column in found if column in columns]
        if twice:
            # whichever came last would be taken in silence
            problem = f"gives {' '.join(twice)}, which another array gives, too; expected each column once"
            hint = "leave out one of rows by `_` in `fields`, or one of the arrays"
            raise DataError(path, name, f"{problem}: {hint}")
        columns.update(found)
    if not columns:
        held = ", ".join(f"{name} {getattr(array, 'shape', '')}".strip() for name, array in arrays.items()) or "nothing"
        expected = "arrays of numbers with a row per point, of 1 or 2 dimensions"
        raise DataError(path, "", f"holds {held}; expected {expected}")
    lengths = {name: len(column) for name, column in columns.items()}
    main = (lengths[name] for name in (*_PLAIN_COLUMNS, *POSITION_NAMES) if name in lengths)
    count = next(main, max(lengths.values()))
    check_count(path, "", count)
    for name, length in lengths.items():
        # a column that is one of the points by its name; single numbers are none
        if length not in {1, count} and name.lower() in _NAMES_OF_COLUMNS:
            raise DataError(path, name, f"{length} numbers for {count} points; expected one per point")
    # other arrays of other lengths state something of the file, not of its points
    return Cloud(path, count, {name: column for name, column in columns.items() if len(column) == count})


def _arrays(path: Path) -> dict[str, AnyArray]:
    with file_faults(path), open_file(path) as file:
        size = check_length(path)
        if not size:
            raise DataError(path, "", "is empty; expected arrays of NumPy")
        try:
            head = file.read(_LONGEST_HEAD)
            file.seek(0)
            if head.startswith(_MAGIC):
                _check_size(path, "", head, size)
            loaded: Any = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return {"points" if loaded.dtype.names is None else "": loaded}
            # what the entries declare is compared with the bytes of the file before any of them is unpacked
            check_unpacked(path, "", size, sum(entry.file_size for entry in loaded.zip.infolist()))
            for entry in loaded.zip.infolist():
                with loaded.zip.open(entry) as inner:
                    _check_size(path, entry.filename, inner.read(_LONGEST_HEAD), entry.file_size)
            return {name: loaded[name] for name in loaded.files}
        except _FAULTS as error:
            objects = "allow_pickle" in str(error) or "pickle" in str(error).lower()
            problem = "holds Python objects, which are never loaded" if objects else f"cannot be read: {error}"
            raise DataError(path, "", f"{problem}; expected arrays of numbers") from error


def _check_size(path: Path, location: str, head: bytes, size: int) -> None:
    """Refuse an array that is not as long as the bytes behind its head. Source: "NPY format", numpy.lib.format."""
    if not head.startswith(_MAGIC) or len(head) < 12:
        return
    start = 10 if head[6] == 1 else 12
    stop = start + int.from_bytes(head[8:start], "little")
    reported = ast.literal_eval(head[start:stop].decode("latin-1").strip())
    kind = np.lib.format.descr_to_dtype(reported["descr"])
    if kind.hasobject:
        return
    expected = math.prod(reported["shape"]) * kind.itemsize
    if min(reported["shape"], default=0) < 0 or expected != size - stop:
        problem = f"{size - stop} bytes; expected {expected} of shape {reported['shape']} and type {kind}"
        raise DataError(path, location, problem)


def _columns(path: Path, name: str, array: AnyArray, layout: FieldLayout | None) -> dict[str, AnyArray]:
    """Cut one array into columns; what is no array of numbers with a row per point is passed over."""
    if not isinstance(array, np.ndarray):
        raise DataError(path, name, "is no array; expected arrays of numbers")
    if array.dtype.names is not None and array.ndim == 1:
        return columns_of(array)
    if array.dtype.kind not in "iufb" or array.ndim not in {1, 2}:
        return {}
    plain = np.ascontiguousarray(array, array.dtype.newbyteorder("="))
    if plain.ndim == 1 or name not in POSITION_NAMES:
        return {name: plain[:, 0] if plain.ndim == 2 and plain.shape[1] == 1 else plain}
    names = _PLAIN_COLUMNS[: plain.shape[1]] if layout is None else layout.names
    if plain.shape[1] != len(names) or plain.shape[1] < 3:
        expected = "3 or 4 (x y z intensity)" if layout is None else f"{len(names)}: {' '.join(names)}"
        problem = f"rows of {plain.shape[1]} numbers; expected {expected}; name them with `fields`"
        raise DataError(path, name, problem)
    return {column: np.ascontiguousarray(plain[:, k]) for k, column in enumerate(names) if column[0] != "_"}


def default_layout(path: Path) -> FieldLayout:
    """The layout of a file whose manifest names none: nuScenes' for `.pcd.bin`, else KITTI's."""
    return NUSCENES if path.name.lower().endswith(".pcd.bin") else KITTI


def read_bin(path: Path, *, layout: FieldLayout | None = None) -> Cloud:
    """Read a file of packed little-endian points.

    Raises:
        DataError: the file is no whole number of points.
    """
    chosen = layout or default_layout(path)
    content, record = read_bytes(path), chosen.dtype
    count, rest = divmod(len(content), record.itemsize)
    if rest:
        problem = (
            f"{len(content)} bytes are {count} points of {record.itemsize} bytes ({chosen}) and {rest} bytes more; "
            "expected whole points: is the file cut off, or has it other fields?"
        )
        raise DataError(path, f"byte {count * record.itemsize}", problem)
    check_count(path, "", count)
    return Cloud(path, count, columns_of(np.frombuffer(content, record, count)))
