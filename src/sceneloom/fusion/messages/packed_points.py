"""Points as other systems pack them: fields of any type at any offset, one point after the other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array
from sceneloom.errors import DataError

PACKED_COLORS = ("rgb", "rgba")
"""Fields that hold a colour in four bytes: blue, green, red, and one that is not used.

Source: "PointXYZRGB" of the Point Cloud Library.
"""

TIME_UNITS: Mapping[tuple[str, str], tuple[float, bool]] = MappingProxyType(
    {
        ("t", "uint32"): (1e-9, False),
        ("offset_time", "uint32"): (1e-9, False),
        ("timestamp", "float64"): (1.0, True),
    }
)
"""Fields of makers of lidars that say when a point was measured, by name and type: seconds in their unit, and whether
they count from the epoch and not from the cloud's time stamp."""

_LONGEST_STRIDE = 65535


@dataclass(frozen=True, slots=True)
class PackedField:
    """One field of packed points.

    Attributes:
        name: of the field.
        offset: where it begins in a point [byte].
        dtype: the NumPy name of its type.
        count: how many values it has; those of several become fields `name[k]`.
    """

    name: str
    offset: int
    dtype: str
    count: int = 1


def unpack_points(
    rows: AnyArray, fields: Sequence[PackedField], *, owner: str, seconds: int, big_endian: bool = False
) -> tuple[tuple[str, ...], Float32Array]:
    """Give all fields of points as numbers of 32 bits, without points that have no finite position.

    Packed colours become fields r, g and b, times in other units the field `time` [s, from the cloud's time stamp].

    Args:
        rows: (N, stride) uint8.
        fields: what each row holds.
        owner: the type of the message, for messages.
        seconds: of the cloud's time stamp.
        big_endian: whether values are.

    Returns:
        The names, and (M, F) float32.

    Raises:
        DataError: a field reaches beyond its point, or there are two of one name.
    """
    columns: dict[str, AnyArray] = {}
    for field in fields:
        for name, values in _columns(rows, field, owner, big_endian=big_endian):
            for told, told_values in _read(name, values, field.dtype, seconds):
                if told in columns:
                    raise DataError(owner, "fields", f"{told!r} twice; expected different names")
                columns[told] = told_values
    if not {"x", "y", "z"} <= set(columns):
        raise DataError(owner, "fields", f"{list(columns)}; expected x, y and z among them")
    table = np.column_stack([values.astype(np.float32) for values in columns.values()])
    finite = np.isfinite(table[:, [list(columns).index(axis) for axis in "xyz"]]).all(axis=1)
    return tuple(columns), table if finite.all() else table[finite]


def rows_of(
    content: bytes, *, count: int, stride: int, owner: str, row: tuple[int, int] | None = None
) -> AnyArray:
    """Give the points of packed bytes.

    Args:
        count: how many points.
        stride: bytes from point to point.
        owner: the type of the message, for messages.
        row: where points lie in rows: how many rows, and bytes from row to row.

    Returns:
        (count, stride) uint8.

    Raises:
        DataError: there are more or fewer bytes.
    """
    rows, row_stride = (1, count * stride) if row is None else row
    width = count // rows * stride if rows else 0
    if not 0 < stride <= _LONGEST_STRIDE or row_stride < width or len(content) != rows * row_stride:
        expected = f"{count} points of {stride} bytes in {rows} rows of {row_stride} bytes"
        raise DataError(owner, "data", f"{len(content)} bytes; expected {expected}")
    lines = np.frombuffer(content, np.uint8).reshape(rows, row_stride)[:, :width]
    return np.ascontiguousarray(lines).reshape(count, stride)


def _columns(
    rows: AnyArray, field: PackedField, owner: str, *, big_endian: bool
) -> list[tuple[str, AnyArray]]:
    dtype = np.dtype(field.dtype).newbyteorder(">" if big_endian else "<")
    stop = field.offset + dtype.itemsize * field.count
    if field.count < 1 or stop > rows.shape[1]:
        problem = f"{field.name!r} to byte {stop}; expected at most {rows.shape[1]}, as a point has"
        raise DataError(owner, "fields", problem)
    values = np.ascontiguousarray(rows[:, field.offset : stop]).view(dtype).reshape(len(rows), field.count)
    names = [field.name] if field.count == 1 else [f"{field.name}[{k}]" for k in range(field.count)]
    return list(zip(names, values.T, strict=True))


def _read(name: str, values: AnyArray, dtype: str, seconds: int) -> list[tuple[str, AnyArray]]:
    """Give a field under the name and in the unit of table 6."""
    if name in PACKED_COLORS and values.dtype.itemsize == 4:
        packed = np.ascontiguousarray(values).view(values.dtype.str[0] + "u4")
        return [(color, packed >> shift & 255) for color, shift in (("r", 16), ("g", 8), ("b", 0))]
    unit = TIME_UNITS.get((name, dtype))
    if unit is None:
        return [(name, values)]
    scale, absolute = unit
    return [("time", values.astype(np.float64) * scale - (seconds if absolute else 0))]
