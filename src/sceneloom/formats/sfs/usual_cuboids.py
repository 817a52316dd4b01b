"""The usual cuboids of a file, all at once: those without fields beyond the common ones.

Labelled drives hold tens of thousands of them. Each is checked by a typed record, and its numbers are packed as they
are met; the arrays of all are made in one piece, of which every path is a part. A cuboid that is not usual in any
respect is left to the table of fields, which knows unknown fields and reports what is wrong.
"""

import struct
from collections.abc import Callable
from functools import lru_cache
from itertools import chain
from typing import Any, Literal

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.sfs.annotation_parts import attribute_values
from sceneloom.formats.sfs.times import FileClock, TimeRangeError
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath, cut_cuboid_paths
from sceneloom.scene.types import Identifier

_COLUMNS = 9


class _Path(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    timestamps: list[int]
    values: list[Any]


class _Attribute(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    name: str
    timestamps: list[int]
    values: list[Any]
    static: bool | None = None
    sensor_id: Identifier | None = None


class _Cuboid(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    id: Identifier
    type: Literal["cuboid"]
    path: _Path
    label: str | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: list[_Attribute] | None = None


class _UnusualError(ValueError):
    """Something is not as usual."""


_UNUSUAL = (_UnusualError, msgspec.ValidationError, struct.error, TypeError, OverflowError)


def read_usual_cuboids(annotations: list[Any], clock: FileClock) -> dict[int, CuboidAnnotation]:
    """Make the cuboids that have nothing unusual.

    Args:
        annotations: the file's list of annotations.
        clock: rotates timestamps into nanoseconds.

    Returns:
        The cuboids by their number in the list.
    """
    found: dict[int, _Cuboid] = {}
    timestamps: list[bytes] = []
    rows: list[bytes] = []
    stated: list[bytes] = []
    for index, annotation in enumerate(annotations):
        try:
            cuboid = msgspec.convert(annotation, _Cuboid)
            packed = _packed_timestamps(cuboid.path.timestamps), _packed_rows(cuboid.path)
            stated_at = [_packed_timestamps(attribute.timestamps) for attribute in cuboid.attributes or ()]
        except _UNUSUAL:
            continue
        found[index] = cuboid
        timestamps.append(packed[0])
        rows.append(packed[1])
        stated += stated_at
    try:
        times_ns, stated_ns = _times(timestamps, clock), _times(stated, clock)
    except TimeRangeError:
        return {}
    values = np.frombuffer(b"".join(rows), np.float64).reshape(-1, _COLUMNS)
    counts = [len(cuboid.path.timestamps) for cuboid in found.values()]
    paths = cut_cuboid_paths(times_ns, values, counts)
    saying = _Saying(stated_ns)
    return {
        index: _cuboid(cuboid, path, saying)
        for (index, cuboid), path in zip(found.items(), paths, strict=True)
    }


def _packed_timestamps(timestamps: list[int]) -> bytes:
    return _packer("q", len(timestamps))(*timestamps)


def _packed_rows(path: _Path) -> bytes:
    count = len(path.timestamps)
    if len(path.values) != count or set(map(len, path.values)) != {_COLUMNS}:
        raise _UnusualError
    return _packer("d", count * _COLUMNS)(*chain.from_iterable(path.values))


@lru_cache(maxsize=256)
def _packer(code: str, count: int) -> Callable[..., bytes]:
    return struct.Struct(f"{count}{code}").pack


def _times(packed: list[bytes], clock: FileClock) -> Int64Array:
    times_ns = clock.absolute_array(np.frombuffer(b"".join(packed), np.int64))
    times_ns.flags.writeable = False
    return times_ns


def _cuboid(cuboid: _Cuboid, path: CuboidPath, saying: "_Saying") -> CuboidAnnotation:
    return CuboidAnnotation(
        cuboid.id,
        path,
        cuboid.label,
        cuboid.stationary,
        cuboid.parent_id,
        tuple(map(saying.attribute, cuboid.attributes)) if cuboid.attributes else (),
    )


class _Saying:
    """Deals the times of all attributes out to them, in order."""

    def __init__(self, times_ns: Int64Array) -> None:
        self._times_ns = times_ns
        self._next = 0

    def attribute(self, attribute: _Attribute) -> AttributePath:
        """Make the next one."""
        values, first = attribute.values, self._next
        self._next += len(attribute.timestamps)
        return AttributePath(
            attribute.name,
            attribute_values(values) if list in map(type, values) else tuple(values),
            self._times_ns[first : self._next],
            attribute.sensor_id,
            attribute.static,
        )
