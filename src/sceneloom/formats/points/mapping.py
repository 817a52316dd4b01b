"""From the columns of a file to the points of a lidar: positions, intensities, rings, times and colours."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Int64Array, UInt8Array, UInt16Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.text_tables import UNITS_NS
from sceneloom.formats.points.cloud import Cloud, FieldLayout, find_roles
from sceneloom.formats.points.files import read_cloud
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarPoints

_FARTHEST_POINT_TIME_NS = 10_000_000_000
"""A point that is farther than this from its file's timestamp has another unit or another clock."""

_INTENSITY_SCALES = (1.0, 255.0, 65535.0)  # the brightest value of the usual scales

FARTHEST_WORLD = 100_000.0
"""float32 resolves 8 mm there: points in the world beyond it need a nearer origin [m]."""

_LARGEST_NS = 9.2e18
_LARGEST_BYTE = 255


@dataclass(frozen=True, slots=True)
class IntensityScale:
    """How brightness becomes 0 to 255.

    Attributes:
        maximum: the value that becomes 255.
    """

    maximum: float

    def apply(self, values: AnyArray) -> tuple[UInt8Array, int]:
        """Scale, round and clip; give how many values were beyond the scale. What is not a number becomes 0."""
        if values.dtype == np.uint8 and self.maximum == 255.0:
            return values, 0
        with np.errstate(invalid="ignore"):
            scaled = np.nan_to_num(
                values.astype(np.float64) * (255.0 / self.maximum), nan=0.0, posinf=256.0, neginf=-1.0
            )
        outside = int(((scaled < -0.5) | (scaled > 255.5)).sum())
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8), outside


def detect_scale(values: AnyArray) -> IntensityScale | None:
    """Guess the scale of brightness from the values of one file; None where they fit none of the usual ones."""
    if values.dtype == np.uint8:
        return IntensityScale(255.0)
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    largest = float(finite.max()) if len(finite) else 0.0
    known = _INTENSITY_SCALES if values.dtype.kind == "f" else _INTENSITY_SCALES[1:]
    return next((IntensityScale(scale) for scale in known if largest <= scale * (1 + 1e-6)), None)


@dataclass(frozen=True, slots=True)
class PointTimes:
    """What the times of points mean.

    Attributes:
        unit: one of `UNITS_NS`.
        relative_to: "timestamp", the file's own timestamp; "start", the start of the sweep; "clock", the sensor's
            clock.
        field: the column, or None for the one that is known by its name.
    """

    unit: str
    relative_to: str = "timestamp"
    field: str | None = None


@dataclass(frozen=True, slots=True)
class PointMapping:
    """What the columns of a lidar's files mean.

    Attributes:
        named: column by role (x y z positions intensity ring red green blue colors), where the aliases do not report.
        scale: of the brightness; None: it is left aside.
        times: of the points, None where they have none or where they are not to be used.
    """

    named: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    scale: IntensityScale | None = None
    times: PointTimes | None = None


@dataclass(frozen=True, slots=True)
class SweepClock:
    """The times that points can refer to [ns]: the file's timestamp, the sweep's start, and the zero of its clock."""

    timestamp_ns: int
    start_ns: int
    zero_ns: int

    def base_ns(self, relative_to: str) -> int:
        """The time that `relative_to` names."""
        return {"timestamp": self.timestamp_ns, "start": self.start_ns, "clock": self.zero_ns}[relative_to]


@dataclass(frozen=True, slots=True, eq=False)
class ReadPoints:
    """Points, and what was left out of their file.

    Attributes:
        points: read-only arrays.
        dropped: points without a return: not finite, or exactly at the origin.
        clipped: brightness beyond the scale.
    """

    points: LidarPoints
    dropped: int
    clipped: int


def points_of(cloud: Cloud, mapping: PointMapping, clock: SweepClock, *, keep_all: bool = False) -> ReadPoints:
    """Read the columns of a file as points.

    Columns that mean nothing here are kept as `extras`, those of the brightness as 0 to 255 only.

    Args:
        cloud: the columns.
        mapping: what they mean.
        clock: what their times refer to.
        keep_all: points that are not finite or at the origin are points, too.

    Raises:
        DataError: x, y or z or a column that the mapping names is missing, or a time is impossible.
    """
    times_field = None if mapping.times is None else mapping.times.field
    named = mapping.named if times_field is None else {**mapping.named, "time": times_field}
    roles = find_roles(cloud.columns, named)
    for role, name in roles.items():
        if name not in cloud.columns:
            raise DataError(cloud.file, name, f"no such column for {role}; the file has {_names(cloud)}")
    positions = _positions(cloud, roles)
    kept = np.ones(cloud.count, np.bool_) if keep_all else _returns(positions)
    chosen: Any = slice(None) if kept.all() else kept
    columns = {name: column[chosen] for name, column in cloud.columns.items()}
    intensities, clipped = None, 0
    if "intensity" in roles and mapping.scale is not None:
        intensities, clipped = mapping.scale.apply(columns[roles["intensity"]])
    colors, color_roles = _colors(columns, roles)
    rings = _rings(columns.get(roles.get("ring", "")))
    times = None if mapping.times is None else _times(cloud, columns, roles, mapping.times, clock)
    used = {roles[r] for r in ("x", "y", "z", "positions", *color_roles) if r in roles}
    used |= {roles[r] for r, v in (("intensity", intensities), ("ring", rings), ("time", times)) if v is not None}
    points = LidarPoints(
        positions=read_only(positions[chosen]),
        intensities=_sealed(intensities),
        colors=_sealed(colors),
        timestamps_ns=_sealed(times),
        rings=_sealed(rings),
        extras=MappingProxyType({n: read_only(c) for n, c in columns.items() if n not in used}),
    )
    return ReadPoints(points, int(len(kept) - kept.sum()), clipped)


def _returns(positions: Float32Array) -> BoolArray:
    """Which points are finite and not exactly at the origin; column by column, which is much quicker than by rows."""
    x, y, z = positions.T
    returns: BoolArray = np.isfinite(x) & np.isfinite(y) & np.isfinite(z) & ((x != 0) | (y != 0) | (z != 0))
    return returns


def _sealed(array: AnyArray | None) -> Any:
    return None if array is None else read_only(array)


def _names(cloud: Cloud) -> str:
    return " ".join(cloud.columns) or "none"


def _positions(cloud: Cloud, roles: Mapping[str, str]) -> Float32Array:
    """The positions, (N, 3) float32 [m], out of rows or three columns."""
    axes = [roles.get(axis) for axis in "xyz"]
    if "positions" in roles and None in axes:
        with np.errstate(over="ignore"):
            return cloud.columns[roles["positions"]].astype(np.float32)
    positions = np.empty((cloud.count, 3), np.float32)
    for k, name in enumerate(axes):
        if name is None or cloud.columns[name].ndim != 1:
            problem = f"no column for {'xyz'[k]}; the file has {_names(cloud)}; name the columns with `use`"
            raise DataError(cloud.file, "", problem)
        with np.errstate(over="ignore"):
            positions[:, k] = cloud.columns[name]
    return positions


def _rings(values: AnyArray | None) -> UInt16Array | None:
    """Lasers as whole numbers; None where the column holds anything else."""
    if values is None or values.ndim != 1 or (values.dtype.kind == "f" and not np.isfinite(values).all()):
        return None
    if len(values) and not (values.min() >= 0 and values.max() <= 65535):
        return None
    rings = values.astype(np.uint16)
    return rings if np.array_equal(rings, values) else None


def _colors(columns: Mapping[str, AnyArray], roles: Mapping[str, str]) -> tuple[UInt8Array | None, tuple[str, ...]]:
    """Colours of one byte each, and the roles that they came from; others are left as they are."""
    names = ("red", "green", "blue")
    channels = [channel for name in names if (channel := columns.get(roles.get(name, ""))) is not None]
    for dtype in (np.uint8, np.uint16):
        if len(channels) == len(names) and all(channel.dtype == dtype for channel in channels):
            stacked = np.stack(channels, axis=1)
            if dtype is np.uint16 and stacked.max(initial=0) > _LARGEST_BYTE:  # some writers put bytes into 16 bits
                stacked = (stacked.astype(np.uint32) * 255 + 32767) // 65535
            return stacked.astype(np.uint8, copy=False), names
    rows = columns.get(roles.get("colors", ""))
    if rows is not None and rows.dtype == np.uint8:
        return rows, ("colors",)
    packed = columns.get(roles.get("packed", ""))
    if packed is not None and packed.dtype.itemsize == 4:
        # little-endian: blue, green, red, unused
        numbers = np.ascontiguousarray(packed).view(np.uint32)
        return np.stack([numbers >> 16, numbers >> 8, numbers], axis=1).astype(np.uint8), ("packed",)
    return None, ()


def _times(
    cloud: Cloud, columns: Mapping[str, AnyArray], roles: Mapping[str, str], times: PointTimes, clock: SweepClock
) -> Int64Array | None:
    name = roles.get("time")
    if name is None:
        return None
    values, unit_ns = columns[name], UNITS_NS[times.unit]
    offsets: AnyArray = values.astype(np.float64) * unit_ns
    wrong = ~(np.abs(offsets) < _LARGEST_NS)
    if values.ndim != 1 or wrong.any():
        row = int(np.flatnonzero(wrong.reshape(-1))[0]) if wrong.any() else 0
        problem = f"{values.reshape(-1)[row] if values.size else 'no'}; expected times"
        raise DataError(cloud.file, f"{name}[{row}]", problem)
    base_ns = clock.base_ns(times.relative_to)
    far = np.flatnonzero(np.abs(offsets + np.float64(base_ns - clock.timestamp_ns)) > _FARTHEST_POINT_TIME_NS)
    if len(far):
        raise DataError(cloud.file, f"{name}[{far[0]}]", _far_time(values, int(far[0]), times, clock))
    # the base goes on as an integer: an absolute time has no room in float64
    exact = values.astype(np.int64) * unit_ns if values.dtype.kind in "iu" else np.rint(offsets).astype(np.int64)
    return np.asarray(exact + base_ns, np.int64)


def _far_time(values: AnyArray, row: int, times: PointTimes, clock: SweepClock) -> str:
    """Report how far a point's time is off, and which unit and reference would bring all of them near."""
    near = []
    for unit, unit_ns in UNITS_NS.items():
        for base in ("timestamp", "clock"):
            offsets_ns = values.astype(np.float64) * unit_ns + float(clock.base_ns(base) - clock.timestamp_ns)
            # like those of one sweep: within two seconds, over more than a millisecond
            if np.abs(offsets_ns).max() < 2e9 and np.ptp(offsets_ns) > 1e6:
                near.append(f'unit = "{unit}", relative_to = "{base}"')
    off = (float(values[row]) * UNITS_NS[times.unit] + clock.base_ns(times.relative_to) - clock.timestamp_ns) / 1e9
    hint = f"; these would fit: {' or '.join(near)}" if near else ""
    return (
        f"{values[row]} {times.unit} relative to the {times.relative_to}: {off:.6g} s from the file's timestamp; "
        f"expected within {_FARTHEST_POINT_TIME_NS // 10**9} s{hint}"
    )


@dataclass(frozen=True, slots=True, eq=False)
class SweepReader:
    """Reads the sweeps of one lidar, each on demand.

    Attributes:
        files: of each sweep.
        names: of the files, relative to their root.
        clocks_ns: (N, 2) int64 [ns]: the file's timestamp and the sweep's start.
        timestamps_ns: (N,) int64 [ns], of the frames.
        zero_ns: offset of the sensor's own clock [ns].
        layout: columns of files that do not state them.
        mapping: meaning of the columns.
        rotation: takes points of the files into the frame that they are given in, None where they are in it.
        deskewed: whether the points are placed as at the timestamp, which then is the time of all of them.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    clocks_ns: Int64Array
    timestamps_ns: Int64Array
    zero_ns: int
    layout: FieldLayout | None
    mapping: PointMapping
    rotation: RigidTransform | None = None
    deskewed: bool = False

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing or wrong.
        """
        read = self.read(k)
        points = read.points
        if self.rotation is not None:
            points = replace(points, positions=read_only(self.rotation.apply(points.positions), np.float32))
        if self.deskewed:
            points = replace(points, timestamps_ns=read_only(np.full(len(points), self.timestamps_ns[k], np.int64)))
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        extras = {"file": self.names[k], **{name: count for name, count in counts.items() if count}}
        return LidarFrame(int(self.timestamps_ns[k]), points, MappingProxyType(extras))

    def read(self, k: int) -> ReadPoints:
        """Read the points of sweep `k` in the frame of the file."""
        timestamp_ns, start_ns = self.clocks_ns[k].tolist()
        return points_of(self.cloud(k), self.mapping, SweepClock(timestamp_ns, start_ns, self.zero_ns))

    def cloud(self, k: int) -> Cloud:
        """Read the columns of sweep `k`."""
        return read_cloud(self.files[k], layout=self.layout)
