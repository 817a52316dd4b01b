"""Point clouds of records and sweeps of the scene model."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Int64Array, UInt8Array, UInt16Array, read_only
from sceneloom.errors import OptionError
from sceneloom.formats.recording.lidar_files import XYZIRT
from sceneloom.fusion.messages.fused import SensorFusionData
from sceneloom.fusion.messages.sensor_data import PointCloudData, RawData
from sceneloom.fusion.messages.tables import RAW
from sceneloom.fusion.messages.timestamps import NANOSECONDS, Timestamp
from sceneloom.scene.clouds import LidarFrame, LidarPoints

REFLECTIVITY_NAMES = ("reflectivity", "intensity")
"""Fields that state how bright a return is; the first one is written."""

COLOR_NAMES = ("r", "g", "b")
"""Fields of a coloured point, 0 to 255."""

_RAW_FIELDS = ("reflectivity", "ring", "time")
"""What the 23-byte records of the recording format report a point beside its position."""

_LONGEST_OFFSET = 3600.0
"""Times of points that are farther than so many seconds from their cloud's are none."""

_SCALES = (255.0, 65535.0)


def lidar_frame_of(record: PointCloudData) -> LidarFrame:
    """Give the sweep of a point cloud record.

    `reflectivity` or `intensity` becomes intensities: whole numbers to 255 as they are, fractions to 1 times 255,
    larger ones scaled from 65535; `ring` rings; `time` [s, from the cloud's timestamp] times; `r`, `g`, `b` colours. A
    field that these do not hold exactly, and any other, stays as it is in `points.extras`. The frame's extras hold
    sensor_id, seq, fields, sensor_type, beam and ring of the record. Points with a number that is not finite are left
    out: the sweep has fewer then.
    """
    extras = {
        "sensor_id": record.sensor_id,
        "seq": record.seq,
        "fields": record.fields,
        "sensor_type": record.sensor_type,
        "beam": record.beam,
        "ring": record.ring,
    }
    values = record.points
    if not _are_finite(values):
        values = values[np.isfinite(values).all(axis=1)]
    points = points_of(values, record.fields, record.timestamp.nanoseconds)
    return LidarFrame(record.timestamp.nanoseconds, points, extras=MappingProxyType(extras))


def lidar_frame_of_result(record: SensorFusionData) -> LidarFrame:
    """Give the points of a result of sensor-data fusion as a sweep, in the frame that `point_frame` names."""
    timestamp_ns = record.timestamp.nanoseconds
    points = points_of(record.points, record.point_fields, timestamp_ns)
    extras = {"sensor_id": record.lidar_id, "seq": record.points_seq, "fields": record.point_fields}
    return LidarFrame(timestamp_ns, points, extras=MappingProxyType(extras))


def lidar_frame_of_raw(record: RawData) -> LidarFrame:
    """Give the sweep of raw data that are the 23-byte records of the recording format.

    Points with a number that is not finite are left out, as those of table 6 are.

    Raises:
        DataError: the bytes are no whole number of records, or times are none.
    """
    count, remainder = divmod(record.length, XYZIRT.itemsize)
    if remainder:
        expected = f"expected records of {XYZIRT.itemsize} bytes"
        raise RAW.fault("data", f"{count} records and a remainder of {remainder} bytes; {expected}")
    rows = np.frombuffer(record.data, XYZIRT)
    finite = np.ones(count, np.bool_)
    for name in ("x", "y", "z", "timestamp"):
        finite &= np.isfinite(rows[name])
    if not finite.all():
        rows = rows[finite]
        count = len(rows)
    latest = float(rows["timestamp"].max()) if count else 0.0
    if latest >= 2**32 or (count and rows["timestamp"].min() < 0):
        raise RAW.fault("data", f"times up to {latest} s; expected 0 to {2**32} s")
    seconds = np.floor(rows["timestamp"])
    parts = np.rint((rows["timestamp"] - seconds) * NANOSECONDS).astype(np.int64)
    points = LidarPoints(
        np.column_stack([rows[name] for name in "xyz"]).astype(np.float32, copy=False).reshape(count, 3),
        rows["intensity"].copy(),
        timestamps_ns=seconds.astype(np.int64) * NANOSECONDS + parts,
        rings=rows["ring"].astype(np.uint16),
    )
    extras = {"sensor_id": record.sensor_id, "seq": record.seq}
    return LidarFrame(record.timestamp.nanoseconds, points, extras=MappingProxyType(extras))


def point_cloud_of(
    frame: LidarFrame, *, sensor_id: int, seq: int, fields: Sequence[str] | None = None
) -> PointCloudData:
    """Give the record of a sweep; points without a finite position are left out.

    Args:
        fields: what to give of each point; None for what the sweep's record had, else for all that there is.

    Raises:
        DataError: a number cannot stand in the record.
        OptionError: the points have no such field.
    """
    extras = frame.extras
    names = tuple(fields if fields is not None else extras.get("fields") or fields_of(frame.points))
    data = point_columns(frame.points, names, frame.timestamp_ns)
    return PointCloudData(
        sensor_id=sensor_id,
        timestamp=Timestamp.of(frame.timestamp_ns),
        seq=seq,
        number=len(data),
        fields=names,
        fields_number=len(names),
        data=data,
        sensor_type=extras.get("sensor_type", 0),
        beam=extras.get("beam"),
        ring=extras.get("ring"),
    )


def points_of(values: Float32Array, fields: Sequence[str], timestamp_ns: int) -> LidarPoints:
    """Give the points of a table of fields.

    Args:
        values: (N, F) float32, finite.
        fields: F names, x, y and z among them.
        timestamp_ns: that times are counted from [ns].
    """
    columns = {name: values[:, k] for k, name in enumerate(fields)}
    parts: dict[str, Any] = {}
    exact = set("xyz")
    for part, names, convert in _PARTS:
        name = next((name for name in names if name in columns), None)
        found = None if name is None else convert(columns[name], timestamp_ns)
        if name is not None and found is not None:
            parts[part] = read_only(found)
            if np.array_equal(_BACK[part](found, timestamp_ns), columns[name]):
                exact.add(name)
    colors = _colors(columns)
    if colors is not None:
        parts["colors"] = read_only(colors)
        exact.update(COLOR_NAMES)
    positions = values if tuple(fields) == ("x", "y", "z") else _together([columns[axis] for axis in "xyz"])
    extras = {name: read_only(column) for name, column in columns.items() if name not in exact}
    return LidarPoints(cast("Float32Array", read_only(positions)), extras=MappingProxyType(extras), **parts)


def result_fields(sent: LidarFrame) -> tuple[str, ...]:
    """The fields of the points of table 9, by the names of what was sent and by nothing else.

    Args:
        sent: the sweep of a record of table 6, or of raw data.

    Source: READING of point_fields in docs/CONVENTIONS.md.
    """
    names = sent.extras.get("fields", ("x", "y", "z", *_RAW_FIELDS))
    others = (name for name in names if name not in ("x", "y", "z", *COLOR_NAMES))
    return ("x", "y", "z", *others, *COLOR_NAMES)


def fields_of(points: LidarPoints) -> tuple[str, ...]:
    """The names of all fields that points have; of further arrays those of 32-bit numbers."""
    there = (
        ("reflectivity",) * (points.intensities is not None),
        ("ring",) * (points.rings is not None),
        ("time",) * (points.timestamps_ns is not None),
        COLOR_NAMES * (points.colors is not None),
    )
    names = [*"xyz", *(name for names in there for name in names)]
    further = [name for name, array in points.extras.items() if array.ndim == 1 and array.dtype == np.float32]
    if any(name in further for name in REFLECTIVITY_NAMES) and "reflectivity" in names:
        names.remove("reflectivity")
    return tuple(dict.fromkeys((*names, *further)))


def point_columns(points: LidarPoints, fields: Sequence[str], timestamp_ns: int) -> Float32Array:
    """Give the table of fields of points, without those that have no finite position.

    Args:
        fields: F names; those of `points.extras` as they are there, else as `points_of` reads them.
        timestamp_ns: that times are counted from [ns].

    Returns:
        (M, F) float32.

    Raises:
        OptionError: the points have no such field.
    """
    values = np.empty((len(points), len(fields)), np.float32)
    for k, name in enumerate(fields):
        values[:, k] = _column(points, name, timestamp_ns)
    # to look for the largest number takes a fortieth of the time of looking at each row
    return values if _are_finite(points.positions) else values[np.isfinite(points.positions).all(axis=1)]


def _are_finite(values: Float32Array) -> bool:
    return values.size == 0 or bool(np.isfinite(values.min()) and np.isfinite(values.max()))


def _column(points: LidarPoints, name: str, timestamp_ns: int) -> AnyArray:
    if name in ("x", "y", "z"):
        return points.positions[:, "xyz".index(name)]
    if name in points.extras:
        return points.extras[name]
    if name in COLOR_NAMES and points.colors is not None:
        return points.colors[:, COLOR_NAMES.index(name)]
    for part, names, _ in _PARTS:
        found = getattr(points, part)
        if name in names and found is not None:
            return _BACK[part](found, timestamp_ns)
    raise OptionError(f"field {name!r}; the points have {', '.join(fields_of(points))}")


def _together(columns: Sequence[Float32Array]) -> Float32Array:
    table = np.empty((len(columns[0]), len(columns)), np.float32)
    for k, column in enumerate(columns):
        table[:, k] = column
    return table


def _intensities(values: Float32Array, timestamp_ns: int) -> UInt8Array | None:
    del timestamp_ns
    if values.size == 0:
        return np.zeros(0, np.uint8)
    low, high = float(values.min()), float(values.max())
    whole = np.rint(values)
    if low < 0 or high > _SCALES[-1]:
        return None
    scale = next(scale for scale in _SCALES if high <= scale)
    if high <= 1 and not np.array_equal(whole, values):
        scale = 1.0
    return whole.astype(np.uint8) if scale == 255.0 else np.rint(values * (255.0 / scale)).astype(np.uint8)


def _rings(values: Float32Array, timestamp_ns: int) -> UInt16Array | None:
    del timestamp_ns
    whole = np.rint(values)
    if values.size and (not np.array_equal(whole, values) or values.min() < 0 or values.max() > 65535):
        return None
    return whole.astype(np.uint16)


def _times(values: Float32Array, timestamp_ns: int) -> Int64Array | None:
    if values.size and max(-float(values.min()), float(values.max())) > _LONGEST_OFFSET:
        return None
    return timestamp_ns + np.rint(values.astype(np.float64) * NANOSECONDS).astype(np.int64)


def _colors(columns: Mapping[str, Float32Array]) -> UInt8Array | None:
    if not all(name in columns for name in COLOR_NAMES):
        return None
    colors = _together([columns[name] for name in COLOR_NAMES])
    return colors.astype(np.uint8) if not colors.size or _are_bytes(colors) else None


def _are_bytes(values: Float32Array) -> bool:
    return bool(values.min() >= 0 and values.max() <= 255 and np.array_equal(np.rint(values), values))


def _seconds(timestamps_ns: Int64Array, timestamp_ns: int) -> Float32Array:
    return ((timestamps_ns - timestamp_ns) / NANOSECONDS).astype(np.float32)


def _plain(values: AnyArray, timestamp_ns: int) -> Float32Array:
    del timestamp_ns
    return values.astype(np.float32)


_PARTS: tuple[tuple[str, tuple[str, ...], Callable[[Float32Array, int], AnyArray | None]], ...] = (
    ("intensities", REFLECTIVITY_NAMES, _intensities),
    ("rings", ("ring",), _rings),
    ("timestamps_ns", ("time",), _times),
)
"""Which part of the points a field becomes, and how."""

_BACK: Mapping[str, Callable[[Any, int], Float32Array]] = {
    "intensities": _plain,
    "rings": _plain,
    "timestamps_ns": _seconds,
}
"""How the field comes back out of the part."""
