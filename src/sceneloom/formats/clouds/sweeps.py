"""Reading files of points as the frames of a lidar, each when it is asked for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.clouds.cloud import Cloud
from sceneloom.formats.clouds.layout import FieldLayout
from sceneloom.formats.clouds.points import (
    UNITS_NS,
    IntensityScale,
    PointMapping,
    PointTimes,
    SweepClock,
    detect_scale,
    points_of,
)
from sceneloom.formats.clouds.roles import find_roles
from sceneloom.formats.clouds.table import read_cloud
from sceneloom.scene.clouds import LidarFrame, white_where_unseen

_LOOKED_AT = 10
"""Files that are looked through for one that is bright enough to report the scale of brightness."""

_FARTHEST_EXACT = 4000.0
"""Farther from 0 than this [m], float32 is coarser than a quarter of a millimetre: points count from an origin."""

_RELATIVE = ("offset_ns", "nanoseconds")
"""The column of times that our files have, from the frame's time on, and its unit."""

_TRAJECTORIES: Mapping[str, tuple[PointTimes, ...]] = MappingProxyType(
    {
        "f": (PointTimes("seconds"), PointTimes("seconds", "clock"), PointTimes("microseconds")),
        "u": (PointTimes("nanoseconds"), PointTimes("nanoseconds", "clock"), PointTimes("microseconds", "clock")),
        "i": (PointTimes("nanoseconds"), PointTimes("nanoseconds", "clock"), PointTimes("microseconds", "clock")),
    }
)  # fmt: skip
"""What columns of times can mean, by the kind of their numbers, the likeliest first."""

_NEAR_NS = 2e9
_NOTHING_STATED = PointMapping()
_FIRST_NS, _LAST_NS = 631_152_000e9, 4_102_444_800e9
"""The beginnings of the years 1990 and 2100."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudFrames:
    """Reads the frames of one lidar.

    Attributes:
        files: of each frame.
        timestamps_ns: (N,) int64 [ns].
        layout: columns of files that do not state them.
        mapping: what the columns mean.
        origin: (3,) float64 [m], taken off the locations in the files; None for nothing.
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    layout: FieldLayout | None = None
    mapping: PointMapping = _NOTHING_STATED
    origin: Float64Array | None = None

    def __call__(self, k: int) -> LidarFrame:
        """Read frame `k`.

        Raises:
            DataError: its file is missing or wrong.
        """
        cloud, timestamp_ns = self.cloud(k), int(self.timestamps_ns[k])
        read = points_of(cloud, self.mapping, SweepClock(timestamp_ns, timestamp_ns, 0))
        kept = _kept_brightness(cloud, self.mapping, read.dropped)
        extras = {name: column for name, column in read.points.extras.items() if name != "camera_index"}
        cameras = read.points.extras.get("camera_index")
        if cameras is not None and (cameras.dtype != np.uint8 or cameras.ndim != 1):
            extras["camera_index"], cameras = cameras, None
        colors = read.points.colors
        points = replace(
            read.points,
            colors=None if colors is None else white_where_unseen(colors, cameras),
            camera_index=cameras,
            extras=MappingProxyType({**extras, **kept}),
        )
        reported: dict[str, Any] = {
            "file": self.files[k].name,
            **({"head": dict(cloud.head)} if cloud.head else {}),
        }
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        reported.update({name: count for name, count in counts.items() if count})
        return LidarFrame(timestamp_ns, points, MappingProxyType(reported))

    def cloud(self, k: int) -> Cloud:
        """Read the columns of frame `k`, locations from the origin on."""
        cloud = read_cloud(self.files[k], layout=self.layout)
        columns = _without_redundant(cloud.columns)
        if self.origin is not None:
            columns.update(
                {
                    axis: columns[axis].astype(np.float64) - start
                    for axis, start in zip("xyz", self.origin.tolist(), strict=True)
                    if axis in columns
                }
            )
        return replace(cloud, columns=columns)


def _without_redundant(columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Leave out the absolute times beside our own exact ones, and dimensions that state nothing."""
    found = dict(columns)
    if _RELATIVE[0] in found:
        found.pop("time", None)
    return {name: column for name, column in found.items() if name not in LAS_DIMENSIONS or column.any()}


LAS_DIMENSIONS = frozenset(
    {
        "bit_fields", "raw_classification", "return_number", "number_of_returns", "scan_direction_flag",
        "edge_of_flight_line", "synthetic", "key_point", "withheld", "overlap", "scanner_channel", "classification",
        "classification_flags", "user_data", "scan_angle", "scan_angle_rank", "point_source_id",
    }
)  # fmt: skip
"""What every point of a LAS file has a location for; all zero, nobody filled it in."""


def _kept_brightness(cloud: Cloud, mapping: PointMapping, dropped: int) -> dict[str, AnyArray]:
    """The brightness as the file has it, where 0 to 255 do not state it all."""
    name = find_roles(cloud.columns, mapping.named).get("intensity")
    if name is None or mapping.scale is None:
        return {}
    values = cloud.columns[name]
    if dropped:
        values = values[_returns(cloud)]
    bytes_, clipped = mapping.scale.apply(values)
    back = bytes_ * (mapping.scale.maximum / 255.0)
    back = np.rint(back) if values.dtype.kind in "iu" else back
    same = np.array_equal(back.astype(values.dtype), values) if not clipped else False
    return {} if same else {name: read_only(values)}


def _returns(cloud: Cloud) -> AnyArray:
    """Which points are returns, as `points_of` has it."""
    roles = find_roles(cloud.columns, {})
    if "positions" in roles and any(axis not in roles for axis in "xyz"):
        locations = cloud.columns[roles["positions"]].astype(np.float32)
    else:
        with np.errstate(over="ignore"):
            locations = np.stack([cloud.columns[roles[axis]].astype(np.float32) for axis in "xyz"], axis=1)
    kept: AnyArray = np.isfinite(locations).all(axis=1) & (locations != 0).any(axis=1)
    return kept


def origin_of(cloud: Cloud) -> Float64Array | None:
    """Whole metres near the points of a file, where they lie too far from 0 for float32; None where they do not."""
    columns = [cloud.columns.get(axis) for axis in "xyz"]
    if any(column is None or column.dtype != np.float64 for column in columns):
        return None
    locations = np.stack([column for column in columns if column is not None], axis=1)
    finite = locations[np.isfinite(locations).all(axis=1)]
    if not len(finite) or np.abs(finite).max() <= _FARTHEST_EXACT:
        return None
    origin: Float64Array = np.floor(finite.mean(axis=0))
    return origin


def scale_of(frames: CloudFrames) -> tuple[IntensityScale | None, str | None]:
    """The scale of brightness, by the first file that has any, and the column; None where there is none."""
    for k in range(min(len(frames.files), _LOOKED_AT)):
        columns = frames.cloud(k).columns
        name = find_roles(columns, {}).get("intensity")
        if name is None or columns[name].ndim != 1:
            return None, None
        if (columns[name] > 0).any() or k == min(len(frames.files), _LOOKED_AT) - 1:
            return (None if (columns[name] < 0).any() else detect_scale(columns[name])), name
    return None, None


def times_of(cloud: Cloud, timestamp_ns: int | None) -> PointTimes | None:
    """What the times of a file's points mean, where they are reported by a column and lie around its time.

    Args:
        cloud: the file.
        timestamp_ns: its time [ns], or None where it is not known.
    """
    name = find_roles(cloud.columns, {}).get("time")
    if name is None or cloud.columns[name].ndim != 1 or not cloud.count:
        return None
    if name == _RELATIVE[0]:
        return PointTimes(_RELATIVE[1], "timestamp", name)
    values = cloud.columns[name].astype(np.float64)
    if not np.isfinite(values).all():
        return None
    for trajectory in _TRAJECTORIES.get(cloud.columns[name].dtype.kind, ()):
        if timestamp_ns is None and trajectory.relative_to == "clock":
            continue
        base_ns = float(timestamp_ns or 0) if trajectory.relative_to == "clock" else 0.0
        if np.abs(values * UNITS_NS[trajectory.unit] - base_ns).max() < _NEAR_NS:
            return replace(trajectory, field=name)
    return None


def first_time_ns(cloud: Cloud) -> int | None:
    """The time of the first point of a file [ns], where a column reports times of day; None where none does."""
    name = find_roles(cloud.columns, {}).get("time")
    if name is None or name == _RELATIVE[0] or cloud.columns[name].ndim != 1 or not cloud.count:
        return None
    first = float(cloud.columns[name].min())
    for unit_ns in UNITS_NS.values():
        if _FIRST_NS <= first * unit_ns <= _LAST_NS:
            whole = cloud.columns[name].dtype.kind in "iu"
            return int(cloud.columns[name].min()) * unit_ns if whole else round(first * unit_ns)
    return None


def readable(files: Sequence[Path], layout: FieldLayout | None) -> list[DataError | None]:
    """Read every file, and give what is wrong with each."""
    found: list[DataError | None] = []
    for path in files:
        try:
            read_cloud(path, layout=layout)
        except DataError as error:
            found.append(error)
        else:
            found.append(None)
    return found
