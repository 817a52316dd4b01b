"""Build catalogues and update them: only drives that changed are read again, by several workers."""

import json
import math
import os
import re
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.batch.jobs import Outcome, Task
from sceneloom.batch.running import LOST, Executor, ProcessPool, Warming, run_task
from sceneloom.catalog.storage import SCENES_KEY, TABLES, VERSION, Layout, arrow_type, pyarrow, read_footer, read_part
from sceneloom.checks.validation import validate
from sceneloom.errors import DataError, OptionError, OutputError, SceneloomError, check_choice, redacted
from sceneloom.formats.base.files import fingerprint, is_url, path_or_url, processors, size_on_disk
from sceneloom.formats.base.registry import drives_of, open_scene
from sceneloom.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef, geodetic_from_enu
from sceneloom.geometry.rigid import rotate_vectors
from sceneloom.motion.ego_trajectory import usable_positions
from sceneloom.scene.annotations import AttributePath, Box2DAnnotation, CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame, box_2d_at, cuboid_poses
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import stated_origin
from sceneloom.scene.motion import GnssSensor, OdometrySensor
from sceneloom.scene.scene import Scene, Sensor, frame_times, usual_period_ns
from sceneloom.scene.summary import SensorSummary, summarise
from sceneloom.scene.types import Coordinates, Progress, key_of
from sceneloom.version import __version__
from sceneloom.warnings import Finding


@dataclass(frozen=True, slots=True)
class _Repeated:
    """A column of text in which few words stand in many rows."""

    codes: np.ndarray[Any, Any]  # (N,) integers, which word stands in each row
    words: tuple[str | None, ...]  # None for null


_Values = np.ndarray[Any, Any] | list[Any] | _Repeated  # the rows of a column: NaN, None and counts below 0 are null

_Rows = dict[str, _Values]  # the rows of a table, by columns

_WINDOW_NS = 500_000_000  # speeds are those over so long, so that the noise of poses does not count as motion

_REACH_NS = 1_000_000_000  # so far beyond its first and last point a trajectory holds


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryPoints:
    """Points over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns], strictly increasing.
        positions: (N, 3) float64 [m].
    """

    timestamps_ns: Int64Array
    positions: Float64Array

    @classmethod
    def of(cls, timestamps_ns: Int64Array, positions: Float64Array) -> "TrajectoryPoints | None":
        """Make a way of points in any order, without those that are no numbers; None where none is left."""
        known = np.flatnonzero(np.isfinite(positions).all(axis=1))
        times, rows = np.unique(timestamps_ns[known], return_index=True)
        return cls(times, positions[known][rows]) if len(times) else None

    def at(self, timestamps_ns: Int64Array) -> Float64Array:
        """Give the points (M, 3) at times (M,) [ns]; NaN where it does not reach."""
        times = self._seconds(timestamps_ns)
        own = self._seconds(self.timestamps_ns)
        axes = [np.interp(times, own, axis) for axis in self.positions.T]
        points: Float64Array = np.stack(axes, axis=-1)
        reach = _REACH_NS / 1e9
        points[(times < own[0] - reach) | (times > own[-1] + reach)] = np.nan
        return points

    def speeds(self, timestamps_ns: Int64Array) -> Float64Array:
        """Give the speeds (M,) [m/s] at times (M,) [ns]; NaN where it does not reach, or for a single point."""
        first, last = int(self.timestamps_ns[0]), int(self.timestamps_ns[-1])
        inside = np.clip(timestamps_ns, -(2**63) + _WINDOW_NS, 2**63 - 1 - _WINDOW_NS)
        start = np.clip(inside - _WINDOW_NS // 2, first, max(first, last - _WINDOW_NS))
        stop = np.clip(np.minimum(start, 2**63 - 1 - _WINDOW_NS) + _WINDOW_NS, first, last)
        seconds = (stop - start) / 1e9
        gone = np.linalg.norm(self.at(stop) - self.at(start), axis=1)
        unknown = np.full(len(seconds), np.nan)
        speeds: Float64Array = np.divide(gone, seconds, out=unknown, where=seconds > 0)
        speeds[np.isnan(self.at(timestamps_ns)[:, 0])] = np.nan
        return speeds

    @property
    def metres(self) -> float:
        """Its length [m]."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def _seconds(self, timestamps_ns: Int64Array) -> Float64Array:
        seconds: Float64Array = (timestamps_ns - self.timestamps_ns[0]) / 1e9
        return seconds


@dataclass(frozen=True, slots=True, eq=False)
class Ego:
    """What is known of the ego.

    Attributes:
        trajectory: in the scene's world, or None.
        fixes: of the first satellite receiver that has usable ones, earth-centred, or None.
        origin_lla: the location whose east, north and up are the world's axes, or None.
    """

    trajectory: TrajectoryPoints | None
    fixes: TrajectoryPoints | None
    origin_lla: tuple[float, float, float] | None

    @classmethod
    def of(cls, scene: Scene) -> "Ego":
        """Take it from the first trajectory, the odometry, or what poses in the world a sensor has; and from fixes."""
        return cls(_trajectory(scene), _fixes(scene), stated_origin(scene))

    def positions(self, timestamps_ns: Int64Array) -> Float64Array:
        """Where it was in the world, (M, 3) [m]; NaN where that is not known."""
        return _unknown(timestamps_ns, 3) if self.trajectory is None else self.trajectory.at(timestamps_ns)

    def speeds(self, timestamps_ns: Int64Array) -> Float64Array:
        """How fast it was, (M,) [m/s]; NaN where that is not known."""
        trajectory = self.trajectory or self.fixes
        return _unknown(timestamps_ns, 1)[:, 0] if trajectory is None else trajectory.speeds(timestamps_ns)

    def positions_lla(self, timestamps_ns: Int64Array) -> Float64Array:
        """Latitude, longitude [deg] and height [m], (M, 3); NaN where they are not known."""
        if self.fixes is not None:
            return geodetic_from_ecef(self.fixes.at(timestamps_ns))
        if self.origin_lla is not None and self.trajectory is not None:
            return geodetic_from_enu(self.trajectory.at(timestamps_ns), self.origin_lla)
        return _unknown(timestamps_ns, 3)

    @property
    def metres(self) -> float:
        """Length of its trajectory [m]; NaN where that is not known."""
        return math.nan if self.trajectory is None else self.trajectory.metres


def _unknown(timestamps_ns: Int64Array, width: int) -> Float64Array:
    return np.full((len(timestamps_ns), width), np.nan)


def _trajectory(scene: Scene) -> TrajectoryPoints | None:
    for trajectory in scene.trajectories.values():
        return TrajectoryPoints.of(trajectory.timestamps_ns, trajectory.positions)
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor) and not sensor.poses.static:
            return TrajectoryPoints.of(sensor.poses.timestamps_ns, sensor.poses.positions)
    for sensor in scene.sensors:
        poses = getattr(sensor, "poses", None)
        in_world = getattr(sensor, "coordinates", None) is Coordinates.WORLD
        if poses is not None and in_world and not poses.static:
            return TrajectoryPoints.of(poses.timestamps_ns, poses.positions)
    return None


def _fixes(scene: Scene) -> TrajectoryPoints | None:
    for sensor in scene.sensors:
        if isinstance(sensor, GnssSensor):
            rows, locations = usable_positions(sensor)
            if len(rows):
                return TrajectoryPoints.of(sensor.timestamps_ns[rows], ecef_from_geodetic(locations))
    return None


_NOT_3D = np.full(8, np.nan)
_NOT_2D = np.full(4, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class BoxRows:
    """Boxes of one annotation, or of all.

    Attributes:
        tracks: (N,) int64, number of the annotation.
        timestamps_ns: (N,) int64 [ns].
        solids: (N, 8) float64: centre [m], length, width, height [m], yaw [rad], speed [m/s]; NaN of boxes in images.
        flats: (N, 4) float64 [px]: left, top, width, height; NaN of boxes in space.
    """

    tracks: Int64Array
    timestamps_ns: Int64Array
    solids: Float64Array
    flats: Float64Array

    @classmethod
    def joined(cls, parts: Sequence["BoxRows"]) -> "BoxRows":
        """Put those of many annotations together, in the order of time."""
        if not parts:
            none = np.zeros(0, np.int64)
            return cls(none, none, np.zeros((0, 8)), np.zeros((0, 4)))
        whole = [np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)]
        order = np.argsort(whole[1], kind="stable")
        return cls(*(column[order] for column in whole))


def box_rows(scene: Scene, moments_ns: Int64Array) -> BoxRows:
    """Give each box at each of the scene's moments at which it is there, or at its own timestamps where it is at none.

    Boxes in images are given at the times of their camera's images.

    Args:
        scene: the scene.
        moments_ns: (M,) int64 [ns], ascending.

    Raises:
        OptionError: unit or order of the cuboids' angles is none of those known.
    """
    angles = CuboidAngles.of(scene)
    images_ns = {key_of(sensor.id): np.unique(frame_times(sensor)) for sensor in scene.sensors}
    parts = []
    for track, annotation in enumerate(scene.annotations):
        if isinstance(annotation, CuboidAnnotation) and len(annotation.path.timestamps_ns):
            parts.append(_solid(track, annotation, _times(annotation, moments_ns), angles))
        elif isinstance(annotation, Box2DAnnotation) and len(annotation.path.timestamps_ns):
            own_ns = images_ns.get(key_of(annotation.sensor_id), moments_ns)
            parts.append(_flat(track, annotation, _times(annotation, own_ns)))
    return BoxRows.joined(parts)


def _times(annotation: CuboidAnnotation | Box2DAnnotation, moments_ns: Int64Array) -> Int64Array:
    timestamps = annotation.path.timestamps_ns
    if annotation.stationary and len(moments_ns):
        return moments_ns
    inside = slice(
        np.searchsorted(moments_ns, timestamps.min()), np.searchsorted(moments_ns, timestamps.max(), "right")
    )
    times = moments_ns[inside]
    return times if len(times) else np.unique(timestamps)


def _solid(track: int, annotation: CuboidAnnotation, times_ns: Int64Array, angles: CuboidAngles) -> BoxRows:
    found = cuboid_poses(annotation, times_ns, angles=angles)
    with np.errstate(invalid="ignore", over="ignore"):  # files hold numbers that are none
        forward = rotate_vectors(found.quaternions_xyzw, np.array([1.0, 0.0, 0.0]))
        yaws = np.arctan2(forward[:, 1], forward[:, 0])
        speeds = _speeds(found.centers_world, times_ns)
    solids = np.column_stack([found.centers_world, found.sizes_lwh, yaws, speeds])
    count = len(times_ns)
    return BoxRows(np.full(count, track), times_ns, solids, np.broadcast_to(_NOT_2D, (count, 4)))


def _flat(track: int, annotation: Box2DAnnotation, times_ns: Int64Array) -> BoxRows:
    boxes, _ = box_2d_at(annotation, times_ns)
    count = len(times_ns)
    return BoxRows(np.full(count, track), times_ns, np.broadcast_to(_NOT_3D, (count, 8)), boxes)


def _speeds(centers: Float64Array, times_ns: Int64Array) -> Float64Array:
    if len(times_ns) < 2:
        return np.full(len(times_ns), np.nan)
    seconds = (times_ns - times_ns[0]) / 1e9
    speeds: Float64Array = np.linalg.norm(np.gradient(centers, seconds, axis=0), axis=1)
    return speeds


def _annotation_rows(scene: Scene, ego: Ego, rows: BoxRows, start_ns: int) -> _Rows:
    """Give the table `annotations`."""
    stated = [_stated(annotation) for annotation in scene.annotations]
    texts = {
        name: _Repeated(rows.tracks, tuple(row[name] for row in stated))
        for name in ("annotation", "type", "label", "sensor")
    }
    # all boxes of a moment share what is known of the ego then
    moments_ns, of_row = np.unique(rows.timestamps_ns, return_inverse=True)
    locations = ego.positions_lla(moments_ns)[of_row]
    names = ("x", "y", "z", "length", "width", "height", "yaw", "speed")
    flat_names = ("left_px", "top_px", "width_px", "height_px")
    return {
        "track": rows.tracks,
        **texts,
        "timestamp_ns": rows.timestamps_ns,
        "seconds": (rows.timestamps_ns - start_ns) / 1e9,
        **{name: rows.solids[:, k] for k, name in enumerate(names)},
        "distance": distances(scene, ego, rows),
        **{name: rows.flats[:, k] for k, name in enumerate(flat_names)},
        "latitude": locations[:, 0],
        "longitude": locations[:, 1],
        "ego_speed": ego.speeds(moments_ns)[of_row],
    }


@np.errstate(invalid="ignore", over="ignore")
def distances(scene: Scene, ego: Ego, rows: BoxRows) -> Float64Array:
    """How far the boxes' centres are from the ego, (N,) float64 [m]; NaN where that is not known."""
    centers = rows.solids[:, :3]
    if annotations_frame(scene) is Coordinates.WORLD:
        moments_ns, of_row = np.unique(rows.timestamps_ns, return_inverse=True)
        centers = centers - ego.positions(moments_ns)[of_row]
    away: Float64Array = np.linalg.norm(centers, axis=1)
    return away


def _stated(annotation: Any) -> dict[str, str | None]:
    return {
        "annotation": _text_of(annotation.id),
        "type": str(annotation.type),
        "label": _text_of(getattr(annotation, "label", None)),
        "parent": _text_of(getattr(annotation, "parent_id", None)),
        "sensor": _text_of(getattr(annotation, "sensor_id", None)),
    }


def track_rows(scene: Scene, rows: BoxRows, away: Float64Array, start_ns: int) -> _Rows:
    """Give the table `tracks`: every annotation, whatever its type."""
    count = len(scene.annotations)
    order = np.argsort(rows.tracks, kind="stable")
    bounds = np.searchsorted(rows.tracks[order], np.arange(count + 1))
    numbers = np.full((count, 4), np.nan)
    for track in np.flatnonzero(np.diff(bounds)).tolist():
        mine = order[bounds[track] : bounds[track + 1]]
        times = rows.timestamps_ns[mine]
        numbers[track, :2] = (int(times[0]) - start_ns) / 1e9, (int(times[-1]) - start_ns) / 1e9
        numbers[track, 2] = np.linalg.norm(np.diff(rows.solids[mine, :3], axis=0), axis=1).sum()
        numbers[track, 3] = np.fmin.reduce(away[mine])
    stated = [_stated(annotation) for annotation in scene.annotations]
    texts = {name: [row[name] for row in stated] for name in ("annotation", "type", "label", "parent", "sensor")}
    return {
        "track": np.arange(count),
        **texts,
        "stationary": [getattr(annotation, "stationary", None) for annotation in scene.annotations],
        "boxes": np.diff(bounds),
        **{name: numbers[:, k] for k, name in enumerate(("start", "stop", "metres", "nearest"))},
    }


_Row = tuple[str, int, str | None, str, str, float, int | None, int | None]
_NAMES = ("owner", "track", "sensor", "name", "value", "number", "start_ns", "stop_ns")


def _attribute_rows(scene: Scene) -> _Rows:
    """Give the table `attributes`."""
    found: list[_Row] = []
    for attribute in scene.attributes:
        owner = "scene" if attribute.sensor_id is None else "sensor"
        found += _rows(attribute, owner, -1)
    for track, annotation in enumerate(scene.annotations):
        for attribute in getattr(annotation, "attributes", ()):
            found += _rows(attribute, "annotation", track)
    columns: _Rows = {name: [row[k] for row in found] for k, name in enumerate(_NAMES)}
    return {**columns, "track": np.array([row[1] for row in found], np.int64)}


def _rows(attribute: AttributePath, owner: str, track: int) -> Iterator[_Row]:
    for value, start_ns, stop_ns in _spans(attribute):
        for part in value if isinstance(value, tuple | list) else (value,):
            if part is not None:
                sensor = _text_of(attribute.sensor_id)
                yield owner, track, sensor, str(attribute.name), _text(part), _number(part), start_ns, stop_ns


def _spans(attribute: AttributePath) -> Iterator[tuple[Any, int | None, int | None]]:
    """Each value holds until the next; one without times always."""
    if not attribute.is_timed or attribute.timestamps_ns is None:
        yield from ((value, None, None) for value in attribute.values[:1])
        return
    times = attribute.timestamps_ns.tolist()
    yield from zip(attribute.values, times, [*times[1:], None][: len(times)], strict=True)


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return str(value) if isinstance(value, int | float) else json.dumps(value, default=str, sort_keys=True)


def _number(value: Any) -> float:
    """NaN for what is no number, or too large for one."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


_FRAMED = (LidarSensor, CameraSensor, RadarSensor, DepthCameraSensor, GnssSensor, OdometrySensor)
"""What gives frames; the first of the first kind that has any gives a scene's moments."""


def scene_rows(
    scene: Scene,
    *,
    path: str,
    options: Mapping[str, Any],
    fingerprint: str,
    size_bytes: int | None,
    findings: Sequence[Finding],
) -> dict[str, _Rows]:
    """Give the rows of all tables.

    Args:
        scene: the scene; of its frames only the first of each lidar is read.
        path: where the drive is.
        options: how it is read.
        fingerprint: what reports it from what it was at another time.
        size_bytes: bytes on disk, where known.
        findings: what the rules found in it.

    Raises:
        DataError: the first frame of a lidar cannot be read.
        OptionError: unit or order of the cuboids' angles is none of those known.
    """
    summary = summarise(scene)
    start_ns = summary.start_ns or 0
    ego, reference = Ego.of(scene), _reference_sensor(scene)
    moments_ns = _annotated_ns(scene) if reference is None else np.unique(frame_times(reference))
    boxes = box_rows(scene, moments_ns)
    tables = {
        "sensors": _sensors(summary.sensors),
        "frames": _frames(scene, ego, reference, start_ns),
        "annotations": _annotation_rows(scene, ego, boxes, start_ns),
        "tracks": track_rows(scene, boxes, distances(scene, ego, boxes), start_ns),
        "attributes": _attribute_rows(scene),
        "findings": _finding_rows(findings),
    }
    first_lla = ego.positions_lla(np.array([start_ns]))[0] if summary.start_ns is not None else (np.nan, np.nan)
    whole = {
        "path": path,
        "options": json.dumps(dict(options), sort_keys=True),
        "format": scene.format,
        "start_ns": summary.start_ns,
        "duration": summary.duration,
        "period": usual_period_ns(moments_ns) / 1e9,
        "moments_of": None if reference is None else _text_of(reference.id),
        "metres": ego.metres,
        "latitude": first_lla[0],
        "longitude": first_lla[1],
        "sensors": len(scene.sensors),
        "frames": len(tables["frames"]["seconds"]),  # type: ignore[arg-type]
        "tracks": len(scene.annotations),
        "boxes": len(boxes.tracks),
        "findings": sum(finding.count for finding in findings),
        "size_bytes": size_bytes,
        "fingerprint": fingerprint,
    }
    return {"scenes": {name: [value] for name, value in whole.items()}, **tables}


def _reference_sensor(scene: Scene) -> Sensor | None:
    """The sensor whose frames are the scene's moments: a lidar, else a camera, else what else has times."""
    for kind in _FRAMED:
        for sensor in scene.sensors:
            if isinstance(sensor, kind) and len(frame_times(sensor)):
                return sensor
    return None


def _annotated_ns(scene: Scene) -> Int64Array:
    """The times at which boxes are stated to be: the moments of a scene without frames."""
    boxes = [one for one in scene.annotations if isinstance(one, CuboidAnnotation | Box2DAnnotation)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *(box.path.timestamps_ns for box in boxes)]))


def _sensors(sensors: Sequence[SensorSummary]) -> _Rows:
    same = ("type", "count", "rate_hz", "start", "stop", "camera_model", "video", "mounted")
    return {
        "sensor": [str(sensor.id) for sensor in sensors],
        "gaps": [sensor.gap_count for sensor in sensors],
        **{name: [getattr(sensor, name) for sensor in sensors] for name in same},
    }


def _frames(scene: Scene, ego: Ego, reference: Sensor | None, start_ns: int) -> _Rows:
    sensors = [sensor for sensor in scene.sensors if isinstance(sensor, _FRAMED)]
    timestamps = [frame_times(sensor) for sensor in sensors]
    counts = [len(times) for times in timestamps]
    times_ns: Int64Array = np.concatenate([np.zeros(0, np.int64), *timestamps])
    codes = np.repeat(np.arange(len(sensors)), counts)
    positions, locations = ego.positions(times_ns), ego.positions_lla(times_ns)
    return {
        "sensor": _Repeated(codes, tuple(str(sensor.id) for sensor in sensors)),
        "type": _Repeated(codes, tuple(str(sensor.type) for sensor in sensors)),
        "reference": np.repeat(np.array([sensor is reference for sensor in sensors], np.bool_), counts),
        "frame": np.concatenate([np.zeros(0, np.int64), *map(np.arange, counts)]),
        "timestamp_ns": times_ns,
        "seconds": (times_ns - start_ns) / 1e9,
        **{name: positions[:, k] for k, name in enumerate("xyz")},
        "latitude": locations[:, 0],
        "longitude": locations[:, 1],
        "ego_speed": ego.speeds(times_ns),
    }


def _finding_rows(findings: Sequence[Finding]) -> _Rows:
    same = ("rule", "severity", "message", "remedy", "count", "fixable")
    rows: _Rows = {name: [getattr(finding, name) for finding in findings] for name in same}
    return {**rows, "location": [finding.path for finding in findings]}


def _text_of(identifier: object) -> str | None:
    """An id as text; None where there is none."""
    return None if identifier is None else str(identifier)


_ODD = re.compile(r"[^A-Za-z0-9_]+")


_NAME_LENGTH = 60


def scene_name(path: str, options: Mapping[str, Any]) -> str:
    """Name a drive by its file and a hash of its whole path and how it is read.

    The name holds letters, digits, `_` and one `-` only, so that it means the same in folders, SQL and URLs, and no
    reader takes it for a number or a date.
    """
    reported = json.dumps([path, dict(options)], sort_keys=True, default=str)
    code = blake2b(reported.encode("utf-8", "surrogateescape"), digest_size=8).hexdigest()
    last = [part for part in re.split(r"[/\\]", path) if part]
    return f"{_ODD.sub('_', last[-1] if last else '')[:_NAME_LENGTH]}-{code}"


def write_draft(scene: str, tables: Mapping[str, _Rows], folder: Path) -> int:
    """Write the rows of all tables of a scene.

    Returns:
        the number of rows of the longest table.

    Raises:
        DataError: a value is one that a table cannot hold.
        OutputError: the files cannot be written.
        MissingExtraError: pyarrow is not installed.
    """
    pa, _ = pyarrow()
    made = {name: _table(pa, scene, name, tables[name]) for name in TABLES}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, table in made.items():
            with pa.OSFile(str(folder / name), "wb") as file, pa.ipc.new_file(file, table.schema) as writer:
                writer.write_table(table)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    return max(int(table.num_rows) for table in made.values())


def _table(pa: Any, scene: str, name: str, rows: _Rows) -> Any:
    columns = TABLES[name]
    try:
        arrays = [_array(pa, arrow_type(column.kind), rows[column.name]) for column in columns]
    except (pa.ArrowException, OverflowError) as error:
        raise DataError(name, "", f"holds what Parquet cannot ({' '.join(str(error).split())})") from error
    scenes = pa.repeat(pa.scalar(scene, pa.string()), len(arrays[0]))
    return pa.table([scenes, *arrays], names=["scene", *(column.name for column in columns)])


def _array(pa: Any, kind: Any, values: _Values) -> Any:
    if isinstance(values, _Repeated):
        words = pa.array([_unicode(word) for word in values.words], pa.string())
        return pa.DictionaryArray.from_arrays(pa.array(values.codes, pa.int32()), words).cast(kind)
    if kind == pa.string():
        return pa.array([_unicode(value) for value in values], kind)
    if isinstance(values, np.ndarray) and kind == pa.int32():
        return pa.array(values.astype(np.int32), kind, mask=values < 0)
    return pa.array(values, kind, from_pandas=True)


def _unicode(value: Any) -> str | None:
    """Names of files may be no Unicode, which Parquet cannot hold."""
    return None if value is None else str(value).encode("utf-8", "backslashreplace").decode()


def _write_part(table: Any, scenes: Any, path: Path) -> None:
    """Write rows, a table of pyarrow, to a file whose footer lists scenes, as values that JSON has."""
    _, parquet = pyarrow()
    reported = {SCENES_KEY: json.dumps(scenes).encode()}
    texts = [column.name for column in table.schema if str(column.type) == "string"]
    parquet.write_table(
        table.replace_schema_metadata(reported),
        path,
        compression="zstd",
        row_group_size=_ROWS_OF_GROUP,
        use_dictionary=[*texts, *(name for name in _TIMES if name in table.schema.names)],
    )


def read_draft(folder: Path, table: str) -> Any:
    """Read the rows of a table, as a table of pyarrow."""
    pa, _ = pyarrow()
    with pa.OSFile(str(folder / table), "rb") as file:
        return pa.ipc.open_file(file).read_all()


PART_ROWS = 131_072
"""Rows of its longest table up to which a part takes further scenes: writing so many takes some 0.1 s."""

_PART_SCENES = 1024
_ROWS_OF_GROUP = 131_072
_IN_ORDER = (*(table for table in TABLES if table != "scenes"), "scenes")
_TIMES = ("timestamp_ns", "seconds", "track")  # numbers that many rows share, and all other numbers few


class Entry(msgspec.Struct, frozen=True, array_like=True):
    """What each file that holds a scene states of it.

    Attributes:
        path: where its drive is.
        options: how that is read.
        timestamp: what reports the drive from what it was at another time; "" where that is not known.
    """

    path: str
    options: dict[str, Any]
    timestamp: str


@dataclass(frozen=True, slots=True)
class Fresh:
    """A scene that was read.

    Attributes:
        scene: its name.
        entry: what files state of it.
        folder: its rows (`write_draft`).
        rows: how many the longest table has.
    """

    scene: str
    entry: Entry
    folder: Path
    rows: int


@dataclass(slots=True)
class _Part:
    """What is known of a part: the scenes by tables whose file is whole, rows of the longest, damage."""

    held: dict[str, dict[str, Entry]] = field(default_factory=dict)
    rows: int = 0
    damage: list[DataError] = field(default_factory=list)

    @property
    def entries(self) -> dict[str, Entry]:
        return {scene: entry for table in _IN_ORDER for scene, entry in self.held.get(table, {}).items()}

    def has_whole(self, scene: str, entry: Entry) -> bool:
        return all(self.held.get(table, {}).get(scene) == entry for table in TABLES)


class Parts:
    """The parts of a catalogue; one process at a time may have them (`Layout.held`)."""

    def __init__(self, layout: Layout) -> None:
        """Read the footers of all files."""
        self._layout = layout
        self._parts = {number: _read(layout, number) for number in layout.numbers()}

    @property
    def entries(self) -> dict[str, Entry]:
        """The entries of all scenes, by their names."""
        return {scene: entry for part in self._parts.values() for scene, entry in part.entries.items()}

    @property
    def lost(self) -> list[DataError]:
        """The damage of parts of which no file is whole, so that none reports what was in them."""
        return [part.damage[0] for part in self._parts.values() if part.damage and not part.held]

    def whole(self) -> dict[str, Entry]:
        """Those scenes of which all tables report the same."""
        return {
            scene: entry
            for part in self._parts.values()
            for scene, entry in part.entries.items()
            if part.has_whole(scene, entry)
        }

    def put(self, scenes: Iterable[Fresh]) -> set[str]:
        """Put scenes in, each into the part where it is, else into one that has room.

        Returns:
            the names of other scenes that must be read again, since a file of their part was damaged.

        Raises:
            OutputError: a file cannot be written.
        """
        known = {scene: number for number, part in self._parts.items() for scene in part.entries}
        chosen: dict[int, list[Fresh]] = {}
        for one in scenes:
            number = known.get(one.scene)
            number = self._with_room(one.rows, chosen) if number is None else number
            chosen.setdefault(number, []).append(one)
        return {name for number, some in chosen.items() for name in self._rewrite(number, some)}

    def remove(self, scenes: AbstractSet[str]) -> None:
        """Take scenes out.

        Raises:
            OutputError: a file cannot be written.
        """
        for number, part in list(self._parts.items()):
            if scenes & set(part.entries):
                self._rewrite(number, (), gone=scenes)

    def _with_room(self, rows: int, chosen: Mapping[int, list[Fresh]]) -> int:
        """The first part that takes so many rows beside what is chosen for it, or a new one."""
        for number, part in self._parts.items():
            coming = chosen.get(number, ())
            has_room = part.rows + sum(one.rows for one in coming) + rows <= PART_ROWS
            if has_room and not part.damage and len(part.entries) + len(coming) < _PART_SCENES:
                return number
        number = max(self._parts, default=-1) + 1
        self._parts[number] = _Part()
        return number

    def _rewrite(self, number: int, fresh: Iterable[Fresh], *, gone: AbstractSet[str] = frozenset()) -> set[str]:
        before, coming, now = self._parts[number], {one.scene: one for one in fresh}, _Part()
        staying = set(before.entries) - set(coming) - gone
        lost: set[str] = set()
        for table in _IN_ORDER:
            held = before.held.get(table, {})
            kept = {scene: entry for scene, entry in held.items() if scene in staying}
            location = self._layout.part(table, number)
            try:
                rows = _kept_rows(location, table, kept, some=len(kept) < len(held))
            except DataError:
                rows, kept = [], {}
            lost |= staying - set(kept)
            now.held[table] = kept | {scene: one.entry for scene, one in coming.items()}
            rows += [read_draft(one.folder, table) for one in coming.values()]
            now.rows = max(now.rows, _replaced(location, rows, now.held[table]))
        self._parts[number] = now
        if not now.entries:
            del self._parts[number]
        return lost


def _read(layout: Layout, number: int) -> _Part:
    part = _Part()
    for table in TABLES:
        location = layout.part(table, number)
        try:
            rows, reported = read_footer(location)
            part.held[table] = msgspec.convert(reported, dict[str, Entry])
            part.rows = max(part.rows, rows)
        except DataError as error:
            part.damage.append(error)
        except msgspec.ValidationError as error:
            part.damage.append(DataError(location, "", f"lists scenes that cannot be: {error}"))
    return part


def _kept_rows(location: Path, table: str, kept: Mapping[str, Entry], *, some: bool) -> list[Any]:
    """The rows of scenes that stay; `some`: others are there, too."""
    if not kept:
        return []
    pa, _ = pyarrow()
    rows = read_part(location)
    if rows.schema.names != ["scene", *(column.name for column in TABLES[table])]:
        raise DataError(location, "", f"columns {', '.join(rows.schema.names)}; expected those of {table}")
    if some:
        from pyarrow import compute

        rows = rows.filter(compute.is_in(rows["scene"], value_set=pa.array(list(kept))))
    return [rows]


def _replaced(location: Path, rows: list[Any], held: Mapping[str, Entry]) -> int:
    """Write a file beside its location and then into it, or remove it where it holds nothing; gives the rows it has."""
    pa, _ = pyarrow()
    draft = location.with_name(f".{location.name}.{os.getpid()}")
    try:
        if not held:
            location.unlink(missing_ok=True)
            return 0
        location.parent.mkdir(parents=True, exist_ok=True)
        table = pa.concat_tables(rows)
        _write_part(table, msgspec.to_builtins(held), draft)
        draft.replace(location)
    except OSError as error:
        raise OutputError(f"{location}: cannot be written: {error.strerror or error}") from error
    finally:
        draft.unlink(missing_ok=True)
    return int(table.num_rows)


class Checks(StrEnum):
    """How drives are checked for the table of findings."""

    NONE = "none"
    QUICK = "quick"
    """Without reading frames and images."""
    FULL = "full"


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive to be catalogued.

    Attributes:
        path: of the drive, or its URL.
        reading: options for opening it.
    """

    path: str
    reading: Mapping[str, Any]

    @property
    def called(self) -> str:
        """What people call it: its path, and its name in a data set."""
        return f"{self.path} (sequence {self.reading['sequence']})" if "sequence" in self.reading else self.path

    @property
    def name(self) -> str:
        """What its scene is called in the catalogue."""
        return scene_name(self.path, self.reading)

    def timestamp(self, checks: Checks, files: str) -> str:
        """What reports it, its files by `_looked_at`, and how it is catalogued from another time; "" for not known."""
        reported = repr((files, VERSION, __version__, checks.value))
        return blake2b(reported.encode(), digest_size=16).hexdigest() if files else ""


def _is_gone(drive: Drive, names: Callable[[Path], Sequence[Path | str]]) -> bool:
    path = Path(drive.path)
    if not path.exists():
        return True
    if "sequence" not in drive.reading or drive.reading["sequence"] in names(path):
        return False
    try:
        open_scene(drive.path, **drive.reading).close()
    except OptionError:
        return True
    except SceneloomError:
        return False  # reading it reports why
    return False


def _looked_at(drives: Iterable[Drive]) -> dict[str, str]:
    """Look at the files of drives, those of a data set once: fingerprints by path, "" where nobody knows."""
    found = {}
    for path in dict.fromkeys(drive.path for drive in drives):
        try:
            found[path] = fingerprint(path)
        except DataError:
            found[path] = ""  # reading it reports why
    return found


def read_drive(location: str, output: Path, options: Mapping[str, Any]) -> int:
    """Read a drive and write the rows of all its tables.

    Args:
        location: path or URL of the drive.
        output: folder to write (`write_draft`).
        options: `scene`, its name; `timestamp`, what reports it from another time; `checks`; `reading`, options for
            opening.

    Returns:
        the number of rows of the longest table.

    Raises:
        SceneloomError: it cannot be read, or the rows cannot be written.
    """
    where, reading = path_or_url(location), options["reading"]
    with open_scene(where, **reading) as scene:
        tables = scene_rows(
            scene.corrected(),
            path=location,
            options=reading,
            fingerprint=options["timestamp"],
            size_bytes=size_on_disk(where),
            findings=tuple(_findings(location, Checks(options["checks"]), reading)),
        )
    return write_draft(options["scene"], tables, output)


def _findings(location: str, checks: Checks, reading: Mapping[str, Any]) -> Iterator[Finding]:
    if checks is Checks.NONE:
        return
    yield from validate(path_or_url(location), frames=checks is Checks.FULL, **reading).findings


_CALL = "sceneloom.catalog.building:read_drive"
_LOOK_SECONDS = 0.5

_PATIENCE_SECONDS = 20.0
"""After so long what was read is put into parts, though they have room: a run that is killed loses no more."""

_TRIES = 3

_DRIVES_OF_WORKER = 8  # so many short drives take as long as a process to start


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A drive that could not be read, and why."""

    path: str
    error: str


class _Run:
    """One going through drives; only one goes on in a catalogue at a time (`Layout.held`)."""

    def __init__(
        self, parts: Parts, drafts: Path, checks: Checks, *, workers: int | None = 1, progress: Progress | None = None
    ) -> None:
        """Have nothing read; scenes are put into `parts`, by way of `drafts`; `progress` gets drives done and all."""
        self._parts, self._drafts, self._checks = parts, drafts, checks
        self._workers, self._progress = workers, progress
        self._waiting: dict[str, tuple[Drive, Fresh]] = {}
        self._put_at = time.monotonic()
        self.read: list[Drive] = []
        self.failed: list[Failure] = []

    def go(self, drives: Sequence[Drive], files: Mapping[str, str], *, done: int = 0) -> None:
        """Read drives, and those whose rows were lost with damaged files of the same parts; `done`: before."""
        tried: set[str] = set()
        due = list(drives)
        while due:
            tried |= {drive.name for drive in due}
            lost = self._read(due, files, done) - tried
            done += len(due)
            due = [Drive(entry.path, entry.options) for scene, entry in self._parts.entries.items() if scene in lost]
            files = _looked_at(due)

    def _read(self, drives: Sequence[Drive], files: Mapping[str, str], before: int) -> set[str]:
        """Read drives and put them in; the names of scenes whose rows are lost."""
        workers = self._workers or min(processors(), -(-len(drives) // _DRIVES_OF_WORKER))
        executor: Executor = ProcessPool(workers) if min(workers, len(drives)) > 1 else _Here()
        lost: set[str] = set()
        tasks = [self._task(number, drive, files[drive.path]) for number, drive in enumerate(drives)]
        try:
            for done, (task, outcome) in enumerate(_finished(tasks, executor), start=1):
                self._take(drives[task.number], task, outcome)
                if self._is_time():
                    lost |= self._put()
                if self._progress is not None:
                    self._progress(before + done, before + len(drives))
        finally:  # what was read is kept, too, when the run is stopped
            executor.stop()
            lost |= self._put()
        return lost

    def _task(self, number: int, drive: Drive, files: str) -> Task:
        options = {
            "scene": drive.name,
            "timestamp": drive.timestamp(self._checks, files),
            "checks": self._checks.value,
            "reading": dict(drive.reading),
        }
        draft = self._drafts / drive.name
        return Task(number=number, attempt=1, call=_CALL, location=drive.path, draft=draft, options=options)

    def _take(self, drive: Drive, task: Task, outcome: Outcome) -> None:
        if outcome.kind == OutputError.__name__:
            raise OutputError(outcome.error)  # what befell the catalogue befalls all drives
        if outcome.error:
            shutil.rmtree(task.draft, ignore_errors=True)
            self.failed.append(Failure(path=drive.path, error=outcome.error))
            return
        entry = Entry(drive.path, dict(drive.reading), task.options["timestamp"])
        self._waiting[drive.name] = drive, Fresh(drive.name, entry, task.draft, outcome.report)

    def _is_time(self) -> bool:
        rows = sum(fresh.rows for _, fresh in self._waiting.values())
        return rows >= PART_ROWS or time.monotonic() - self._put_at > _PATIENCE_SECONDS

    def _put(self) -> set[str]:
        waiting = list(self._waiting.values())
        lost = self._parts.put(fresh for _, fresh in waiting)
        for drive, fresh in waiting:
            self.read.append(drive)
            shutil.rmtree(fresh.folder, ignore_errors=True)
        self._waiting.clear()
        self._put_at = time.monotonic()
        return lost


class _Here:
    """Does tasks in this process, one after another."""

    def __init__(self) -> None:
        self._ended: list[tuple[Task, Outcome]] = []

    @property
    def free(self) -> int:
        return int(not self._ended)

    def submit(self, task: Task) -> None:
        self._ended.append((task, run_task(task)))

    def finished(self, seconds: float) -> list[tuple[Task, Outcome]]:  # noqa: ARG002 - as all executors
        ended, self._ended = self._ended, []
        return ended

    def stop(self) -> None:
        self._ended.clear()


def _finished(tasks: Iterable[Task], executor: Executor) -> Iterator[tuple[Task, Outcome]]:
    """Have tasks done, and give each when it has ended; those of workers that are gone are done again."""
    due, running, warming = deque(tasks), 0, Warming()
    while due or running:
        while due and executor.free and not (running and warming.goes_on()):
            executor.submit(due.popleft())
            running += 1
        for task, outcome in executor.finished(_LOOK_SECONDS):
            running -= 1
            warming.end()
            if outcome.kind == LOST and task.attempt < _TRIES:
                shutil.rmtree(task.draft, ignore_errors=True)
                due.appendleft(replace(task, attempt=task.attempt + 1))
            else:
                yield task, outcome


class CatalogReport(msgspec.Struct, frozen=True, kw_only=True):
    """What building or updating did.

    Attributes:
        catalogue: its folder.
        scenes: how many it holds now.
        added: paths of drives that are new in it.
        changed: of those that were read again.
        unchanged: how many were left as they were.
        removed: paths of those that were taken out, with their names in data sets.
        gone: of those that are not where they were, and still stand in it.
        failed: those that could not be read; what stood of them before still does.
    """

    catalogue: str
    scenes: int
    added: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    unchanged: int = 0
    removed: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    failed: tuple[Failure, ...] = ()


def build(
    drives: Iterable[str | Path | Drive],
    catalogue: str | Path,
    *,
    overwrite: bool = False,
    checks: Checks | str = Checks.QUICK,
    workers: int | None = 1,
    progress: Progress | None = None,
    **reading: Any,
) -> CatalogReport:
    """Make a catalogue of drives.

    A run that is stopped leaves a catalogue of the drives so far; `update` with the same drives goes on.

    Args:
        drives: files, folders or URLs, with reading options of their own as `Drive`.
        catalogue: folder of the catalogue.
        overwrite: whether a catalogue there may be replaced.
        checks: how much is checked for the findings: "none", "quick" (no frames are read) or "full".
        workers: so many processes read drives; None: one for each processor, where there are drives enough.
        progress: called with the number of drives done and of all.
        reading: reading options of the drives' formats.

    Raises:
        OptionError: there are no drives, or no such checks, or an address holds a secret.
        OutputError: the folder holds something else, cannot be written, or another process writes into it.
        MissingExtraError: pyarrow is not installed.
    """
    chosen, how = _drives(drives, reading), _checks(checks)
    if not chosen:
        raise OptionError("no drives; name some")
    layout = Layout.made(Path(catalogue), overwrite=overwrite)
    with layout.held():
        layout.clear()
        return _updated(layout, Parts(layout), chosen, how, workers=workers, progress=progress)


def update(
    catalogue: str | Path,
    drives: Iterable[str | Path | Drive] = (),
    *,
    prune: bool = False,
    checks: Checks | str = Checks.QUICK,
    workers: int | None = 1,
    progress: Progress | None = None,
    **reading: Any,
) -> CatalogReport:
    """Bring a catalogue up to date: what is new or changed is read, nothing else is.

    Args:
        catalogue: its folder.
        drives: drives that are new or may have changed; without any, all that stand in it are looked at.
        prune: take out drives that are not there any more; without drives only.
        checks: as in `build`.
        workers: as in `build`.
        progress: as in `build`.
        reading: reading options of the drives that are named; those that stand in it are read as before.

    Raises:
        OptionError: drives are named together with `prune`, there are no such checks, or an address holds a secret.
        DataError: there is no catalogue.
        OutputError: it cannot be written, or another process writes into it.
        MissingExtraError: pyarrow is not installed.
    """
    layout, how = Layout.found(Path(catalogue)), _checks(checks)
    chosen = _drives(drives, reading)
    if chosen and prune:
        raise OptionError("pruning looks at all drives of the catalogue; name none")
    with layout.held():
        parts = Parts(layout)
        if chosen:
            return _updated(layout, parts, chosen, how, workers=workers, progress=progress)
        stationary = [Drive(entry.path, entry.options) for entry in parts.entries.values()]
        names = cache(drives_of)  # a drive is gone where no such path, or no drive of this name in the data set, is
        gone = [drive for drive in stationary if not is_url(drive.path) and _is_gone(drive, names)]
        there = [drive for drive in stationary if drive not in gone]
        if prune:
            parts.remove({drive.name for drive in gone})
        report = _updated(layout, parts, there, how, workers=workers, progress=progress)
    paths = tuple(drive.called for drive in gone)
    return msgspec.structs.replace(report, **({"removed": paths} if prune else {"gone": paths}))


def _checks(checks: Checks | str) -> Checks:
    check_choice("checks", checks, Checks)
    return Checks(checks)


def _drives(drives: Iterable[str | Path | Drive], reading: Mapping[str, Any]) -> list[Drive]:
    found: dict[str, Drive] = {}
    for given in drives:
        own = given if isinstance(given, Drive) else Drive(str(given), {})
        path = path_or_url(own.path)
        text = path if isinstance(path, str) else str(path.absolute())
        if is_url(text) and redacted(text) != text:
            raise OptionError(
                f"{redacted(text)}: catalogues keep addresses, and this one holds a secret; give it in the environment"
            )
        drive = Drive(text, {**reading, **own.reading})
        found.setdefault(drive.name, drive)
    return list(found.values())


def _updated(
    layout: Layout,
    parts: Parts,
    drives: Sequence[Drive],
    checks: Checks,
    *,
    workers: int | None,
    progress: Progress | None,
) -> CatalogReport:
    known, whole = parts.entries, parts.whole()
    files = _looked_at(drives)
    timestamps = {drive.name: drive.timestamp(checks, files[drive.path]) for drive in drives}
    due = [
        drive
        for drive in drives
        if not timestamps[drive.name]
        or drive.name not in whole
        or whole[drive.name].timestamp != timestamps[drive.name]
    ]
    run = _Run(parts, layout.drafts, checks, workers=workers, progress=progress)
    run.go(due, files, done=len(drives) - len(due))
    lost = [
        Failure(path=damage.file, error=f"{damage}; delete it, and run `update` with the paths of its drives")
        for damage in parts.lost
    ]
    return CatalogReport(
        catalogue=str(layout.folder),
        scenes=len(parts.entries),
        added=tuple(drive.path for drive in run.read if drive.name not in known),
        changed=tuple(drive.path for drive in run.read if drive.name in known),
        unchanged=len(drives) - len(due),
        failed=(*lost, *run.failed),
    )
