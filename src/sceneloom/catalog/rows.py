"""A scene as rows of all tables: scene, sensors, frames, annotations, tracks and attributes."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.catalog.tables import Repeated, Rows
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
from sceneloom.scene.types import Coordinates, key_of
from sceneloom.warnings import Finding

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


def _annotation_rows(scene: Scene, ego: Ego, rows: BoxRows, start_ns: int) -> Rows:
    """Give the table `annotations`."""
    stated = [_stated(annotation) for annotation in scene.annotations]
    texts = {
        name: Repeated(rows.tracks, tuple(row[name] for row in stated))
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


def track_rows(scene: Scene, rows: BoxRows, away: Float64Array, start_ns: int) -> Rows:
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


def _attribute_rows(scene: Scene) -> Rows:
    """Give the table `attributes`."""
    found: list[_Row] = []
    for attribute in scene.attributes:
        owner = "scene" if attribute.sensor_id is None else "sensor"
        found += _rows(attribute, owner, -1)
    for track, annotation in enumerate(scene.annotations):
        for attribute in getattr(annotation, "attributes", ()):
            found += _rows(attribute, "annotation", track)
    columns: Rows = {name: [row[k] for row in found] for k, name in enumerate(_NAMES)}
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
) -> dict[str, Rows]:
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
        "findings": _findings(findings),
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


def _sensors(sensors: Sequence[SensorSummary]) -> Rows:
    same = ("type", "count", "rate_hz", "start", "stop", "camera_model", "video", "mounted")
    return {
        "sensor": [str(sensor.id) for sensor in sensors],
        "gaps": [sensor.gap_count for sensor in sensors],
        **{name: [getattr(sensor, name) for sensor in sensors] for name in same},
    }


def _frames(scene: Scene, ego: Ego, reference: Sensor | None, start_ns: int) -> Rows:
    sensors = [sensor for sensor in scene.sensors if isinstance(sensor, _FRAMED)]
    timestamps = [frame_times(sensor) for sensor in sensors]
    counts = [len(times) for times in timestamps]
    times_ns: Int64Array = np.concatenate([np.zeros(0, np.int64), *timestamps])
    codes = np.repeat(np.arange(len(sensors)), counts)
    positions, locations = ego.positions(times_ns), ego.positions_lla(times_ns)
    return {
        "sensor": Repeated(codes, tuple(str(sensor.id) for sensor in sensors)),
        "type": Repeated(codes, tuple(str(sensor.type) for sensor in sensors)),
        "reference": np.repeat(np.array([sensor is reference for sensor in sensors], np.bool_), counts),
        "frame": np.concatenate([np.zeros(0, np.int64), *map(np.arange, counts)]),
        "timestamp_ns": times_ns,
        "seconds": (times_ns - start_ns) / 1e9,
        **{name: positions[:, k] for k, name in enumerate("xyz")},
        "latitude": locations[:, 0],
        "longitude": locations[:, 1],
        "ego_speed": ego.speeds(times_ns),
    }


def _findings(findings: Sequence[Finding]) -> Rows:
    same = ("rule", "severity", "message", "remedy", "count", "fixable")
    rows: Rows = {name: [getattr(finding, name) for finding in findings] for name in same}
    return {**rows, "location": [finding.path for finding in findings]}


def _text_of(identifier: object) -> str | None:
    """An id as text; None where there is none."""
    return None if identifier is None else str(identifier)
