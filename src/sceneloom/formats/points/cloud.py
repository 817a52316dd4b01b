"""A file of points as named columns: layouts, roles of columns, rows of text, and the columns that are written."""

import re
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, Self

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, UInt8Array, UInt16Array, hold_arrays
from sceneloom.errors import DataError, OptionError

MOST_POINTS = 1 << 28
"""Files that claim more points are refused: a damaged head can claim any number."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The points of one file, column by column.

    Attributes:
        file: where they come from, for messages.
        count: number of points N.
        columns: (N,) or (N, K) arrays by the file's own names, of the file's own dtypes in native byte order.
        head: what else the file says, by the words of its kind.
    """

    file: Path
    count: int
    columns: Mapping[str, AnyArray]
    head: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


def unique_names(names: Iterable[str], mark: str = "~") -> list[str]:
    """The same names, with a mark and a number where one is there once more; of columns `_` stays padding."""
    seen = Counter[str]()
    unique = []
    for name in names:
        seen[name] += 1
        unique.append(name if seen[name] == 1 else f"{name}{mark}{seen[name]}")
    return unique


TYPES = (
    "float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64",
)  # fmt: skip
"""The types that a column can have."""

_FIELD = re.compile(r"(?P<name>[^:\s]+)(?::(?P<type>\w+))?")


@dataclass(frozen=True, slots=True)
class FieldLayout:
    """Columns in the order of the file.

    Attributes:
        names: differ from each other; those that begin with `_` are padding.
        types: one of `TYPES` each.
    """

    names: tuple[str, ...]
    types: tuple[str, ...]

    @property
    def dtype(self) -> np.dtype[np.void]:
        """One point, packed, little-endian."""
        return np.dtype([(n, np.dtype(t).newbyteorder("<")) for n, t in zip(self.names, self.types, strict=True)])

    @classmethod
    def parse(cls, fields: Sequence[str], *, default: str = "float32") -> Self:
        """Parse columns that are written as `x` or `ring:uint16`; `_` names one that is left out.

        Args:
            default: the type of columns that name none.

        Raises:
            OptionError: a column is no such text, its type is unknown, or there is none.
        """
        names, types = [], []
        for field in fields:
            match = _FIELD.fullmatch(field)
            kind = (match["type"] or default) if match else ""
            if match is None or kind not in TYPES:
                raise OptionError(f"{field!r}; expected a name, or name:type with one of the types {', '.join(TYPES)}")
            names.append(match["name"])
            types.append(kind)
        if not names:
            raise OptionError("no fields; expected at least x, y, z")
        repeated = {name for name in names if names.count(name) > 1 and not name.startswith("_")}
        if repeated:
            raise OptionError(f"{', '.join(sorted(repeated))} twice; expected each field once")
        return cls(tuple(unique_names(names)), tuple(types))

    def __str__(self) -> str:
        return " ".join(f"{n}:{t}" for n, t in zip(self.names, self.types, strict=True))


KITTI = FieldLayout.parse(["x", "y", "z", "intensity"])
"""Four float32. Source: the development kit of KITTI's raw data, "Velodyne 3D laser scan data"."""

NUSCENES = FieldLayout.parse(["x", "y", "z", "intensity", "ring"])
"""Five float32. Source: the development kit of nuScenes, class LidarPointCloud: x, y, z, intensity, ring index."""

ALIASES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "x": ("x",),
        "y": ("y",),
        "z": ("z",),
        "intensity": (
            "intensity", "intensities", "i", "reflectivity", "reflectance", "remission", "scalar_intensity",
        ),
        "ring": ("ring", "rings", "laser_id", "laser_number", "channel", "line", "beam", "ring_id"),
        "time": (
            "time", "t", "timestamp", "timestamps", "timestamps_ns", "offset_time", "time_offset", "offset_ns",
            "time_stamp", "point_time", "time_offset_ns", "time_offset_us", "point_time_offset", "timestamp_ns",
            "timestamp_us", "timeoffset", "time_ns", "time_us", "relative_time", "ts",
        ),
        "red": ("red", "r"),
        "green": ("green", "g"),
        "blue": ("blue", "b"),
    }
)  # fmt: skip
"""The roles that a single column can have, and the names by which each is known, the likeliest first."""

ROW_ALIASES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"positions": ("points", "positions", "xyz", "pos", "pts"), "colors": ("colors", "colours", "rgb", "color")}
)
"""The roles that rows of three numbers can have."""

_PACKED_COLORS = ("rgb", "rgba")
"""Columns of a colour in four bytes: blue, green, red, unused. Source: "PointXYZRGB" of the Point Cloud Library."""


def find_roles(columns: Mapping[str, AnyArray], named: Mapping[str, str]) -> dict[str, str]:
    """Find the column of each role.

    Args:
        columns: of the file, by its own names.
        named: column by role, where somebody stated it; it may be one that the file does not have.

    Returns:
        Column by role, for the roles that the file has; `packed` stands for a packed colour.
    """
    single = {name.lower(): name for name in reversed([*columns]) if columns[name].ndim == 1}
    rows = {
        name.lower(): name for name in reversed([*columns]) if columns[name].ndim == 2 and columns[name].shape[1] == 3
    }
    roles = {}
    tables = ((ALIASES, single), (ROW_ALIASES, rows), ({"packed": _PACKED_COLORS}, single))
    for aliases, known in tables:
        for role, names in aliases.items():
            found = next((known[name] for name in names if name in known), None)
            if found is not None:
                roles[role] = found
    return {**roles, **named}


def parse_rows(path: Path, lines: Sequence[str], dtype: np.dtype[np.void], first_line: int) -> AnyArray:
    """Parse one row of numbers per line; integers are read as integers, so that no digit is lost.

    Args:
        path: for messages.
        lines: none of them empty.
        dtype: a structured dtype, one entry per number of a row.
        first_line: number of the first line in the file, for messages.

    Returns:
        (len(lines),) array of the dtype.

    Raises:
        DataError: a line holds something else.
    """
    if not lines:
        return np.empty(0, dtype)
    try:
        with warnings.catch_warnings():
            # an integer that is written as "1.0" is read with a warning
            warnings.simplefilter("ignore")
            rows = np.loadtxt(lines, dtype, comments=None, ndmin=1)
    except (ValueError, OverflowError) as error:
        row, problem = _first_fault(lines, dtype, str(error))
        raise DataError(path, f"line {first_line + row}", problem) from None
    return np.atleast_1d(rows)


def _first_fault(lines: Sequence[str], dtype: np.dtype[np.void], error: str) -> tuple[int, str]:
    """Find the first line that does not parse on its own."""
    width = sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())
    for row, line in enumerate(lines):
        found = len(line.split())
        if found != width:
            return row, f"{found} values; expected {width}: {' '.join(dtype.names or ())}"
    for row, line in enumerate(lines):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                np.loadtxt([line], dtype, comments=None, ndmin=1)
        except (ValueError, OverflowError) as fault:
            return row, str(fault).split(" at row")[0]
    return 0, error


NO_LABEL = 65535
"""In `labels`: nothing is stated for the point."""


@dataclass(frozen=True, slots=True, eq=False)
class WrittenPoints:
    """Some points of a cloud; all chunks of one file have the same columns.

    Attributes:
        positions_world: (N, 3) float64 [m].
        colors: (N, 3) uint8, red, green, blue, or None.
        intensities: (N,) uint8, or None.
        timestamps_ns: (N,) int64 [ns], or None.
        labels: (N,) uint16, number of a class, `NO_LABEL` for none; or None.
        extras: further columns, (N,) each, by name.
    """

    positions_world: Float64Array
    colors: UInt8Array | None = None
    intensities: UInt8Array | None = None
    timestamps_ns: Int64Array | None = None
    labels: UInt16Array | None = None
    extras: Mapping[str, AnyArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        hold_arrays(
            self,
            "",
            {
                "positions_world": (np.float64, "N", 3),
                "colors?": (np.uint8, "N", 3),
                "intensities?": (np.uint8, "N"),
                "timestamps_ns?": (np.int64, "N"),
                "labels?": (np.uint16, "N"),
            },
        )

    def __len__(self) -> int:
        return len(self.positions_world)


class CloudWriter(Protocol):
    """An open file of points."""

    def add(self, points: WrittenPoints, /) -> None:
        """Write some more points."""
        ...

    def close(self) -> None:
        """Complete the file; its head says how many points there are."""
        ...
