"""The layout of points in files that do not state it themselves: names and types of the columns, in order."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.formats.clouds.cloud import unique_names

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
        return np.dtype(
            [(n, np.dtype(t).newbyteorder("<")) for n, t in zip(self.names, self.types, strict=True)]
        )

    def __str__(self) -> str:
        return " ".join(f"{n}:{t}" for n, t in zip(self.names, self.types, strict=True))


def parse_layout(fields: Sequence[str], *, default: str = "float32") -> FieldLayout:
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
            raise OptionError(
                f"{field!r}; expected a name, or name:type with one of the types {', '.join(TYPES)}"
            )
        names.append(match["name"])
        types.append(kind)
    if not names:
        raise OptionError("no fields; expected at least x, y, z")
    repeated = {name for name in names if names.count(name) > 1 and not name.startswith("_")}
    if repeated:
        raise OptionError(f"{', '.join(sorted(repeated))} twice; expected each field once")
    return FieldLayout(tuple(unique_names(names)), tuple(types))


KITTI = parse_layout(["x", "y", "z", "intensity"])
"""Four float32. Source: the development kit of KITTI's raw data, "Velodyne 3D laser scan data"."""

NUSCENES = parse_layout(["x", "y", "z", "intensity", "ring"])
"""Five float32. Source: the development kit of nuScenes, class LidarPointCloud: x, y, z, intensity, ring index."""
