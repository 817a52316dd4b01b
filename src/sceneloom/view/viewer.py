"""Views saved to a file, shown in Rerun's window, or served to a browser on this machine."""

import http.client
import importlib.util
import os
import platform
import socket
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from heapq import merge
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import quote

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, FloatArray, Int64Array, UInt8Array, spread_rows
from sceneloom.errors import DataError, MissingExtraError, OptionError, OutputError, PoseError, how_to_install
from sceneloom.formats.base.output import check_output, replacing
from sceneloom.formats.base.registry import SharedOptions, open_scene
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import RigidTransform, conjugate_quaternion, rotate_vectors
from sceneloom.motion.deskew import points_at
from sceneloom.motion.ego_trajectory import usable_fixes, usable_positions
from sceneloom.scene.annotations import EventAnnotation, PlainAnnotation
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.ego import ego_path
from sceneloom.scene.motion import GnssSensor, ImuSensor, PlainSensor, VectorSamples
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene, scene_period_ns, sweep_period_ns, time_span
from sceneloom.scene.time_range import cut_scene
from sceneloom.scene.types import Identifier, Key, PointsFrame, Progress, key_of, reporting
from sceneloom.view.annotations import ATTRIBUTES, EVENTS, LIST, RELATIONS, AnnotationView
from sceneloom.view.images import DEPTH, IMAGE, camera_feed, fused_depth_feed, with_straight_camera_models
from sceneloom.view.objects import detection_feeds, track_feed
from sceneloom.view.poses import Locations, pose_at, transform, transform_columns
from sceneloom.view.settings import ColourBy, DrivePart, DriveShown, Source, ViewReport, ViewSettings
from sceneloom.view.stream import SENSORS, TIME, WORLD, Feed, Report, Stream, escaped, fits, one_packed, sdk
from sceneloom.visualization.canvas import Colour
from sceneloom.visualization.colour_scales import colour_map
from sceneloom.visualization.figures import colour_of_name
from sceneloom.warnings import DataWarning, Finding, Severity, WarningKind, repaired, skipped

_Packed = np.ndarray[tuple[int, ...], np.dtype[np.uint32]]  # colours 0xRRGGBBAA
_UNSEEN = np.uint32(0x6E6E6EFF)  # of points that no camera saw
_NO_CAMERA = 255
_SPREAD = (1.0, 99.0)
"""Percentiles that the ends of a scale are put at: single bright or high points would leave the others alike."""


def _packed(rgb: UInt8Array) -> _Packed:
    """Pack (N, 3) uint8 red, green, blue."""
    wide = rgb.astype(np.uint32)
    shifted = (wide[:, 0] << 24) | (wide[:, 1] << 16) | (wide[:, 2] << 8) | np.uint32(255)
    return np.asarray(shifted, np.uint32)


@dataclass(slots=True)
class _CloudPainter:
    """Gives the points of one sensor their colours; the ends of its scale are those of the first sweep."""

    wanted: ColourBy | None
    used: ColourBy | None = None
    _ends: tuple[float, float] | None = None
    _table: _Packed = field(  # from low (dark) to high (bright), for the dark ground of the viewer
        default_factory=lambda: np.ascontiguousarray(_packed(colour_map("lagoon").table)[::-1])
    )

    def paint(self, points: LidarPoints, heights: Callable[[], FloatArray]) -> _Packed:
        """Give (N,) colours; `heights` gives (N,) heights [m] when they are asked for."""
        if self.used is None:
            wanted = (self.wanted or ColourBy.COLOUR, ColourBy.INTENSITY)
            there = (by for by in wanted if by is ColourBy.HEIGHT or getattr(points, _FIELDS[by]) is not None)
            self.used = next(there, ColourBy.HEIGHT)
        if self.used is ColourBy.COLOUR:
            return _own_colours(points)
        values = heights() if self.used is ColourBy.HEIGHT else getattr(points, _FIELDS[self.used])
        if values is None or not len(values):
            values = np.zeros(len(points))
        elif self.used is ColourBy.TIME:
            values = values - values.min()
        return self._table[self._steps(np.asarray(values, np.float64))]

    def _steps(self, values: Float64Array) -> UInt8Array:
        finite = values[np.isfinite(values)]
        if self._ends is None and len(finite):
            low, high = np.percentile(finite, _SPREAD)
            self._ends = float(low), float(max(high, low + 1e-9))
        low, high = self._ends or (0.0, 1.0)
        shares = np.nan_to_num((values - low) / (high - low))
        return np.asarray(np.clip(shares, 0.0, 1.0) * 255, np.uint8)


_FIELDS: Mapping[ColourBy, str] = MappingProxyType(
    {
        ColourBy.COLOUR: "colors",
        ColourBy.INTENSITY: "intensities",
        ColourBy.RING: "rings",
        ColourBy.TIME: "timestamps_ns",
    }
)


def _own_colours(points: LidarPoints) -> _Packed:
    if points.colors is None:
        return np.full(len(points), _UNSEEN, np.uint32)
    colours = _packed(points.colors)
    if points.camera_index is not None:
        colours[points.camera_index == _NO_CAMERA] = _UNSEEN
    return colours


_CLOUDS = "clouds"  # the entity of points that are in no sensor's frame
_POINT_SIZE = 1.6
_RADAR_SIZE, _ARROW_SIZE = 3.0, 1.0
_LONGEST_SWEEP = 3  # times of points spread over more sweep periods than that are not when they were measured
_NEARING, _LEAVING = one_packed((255, 122, 69)), one_packed((82, 196, 255))
_BEYOND = "is not shown: the ego trajectory does not reach its time, or lies beyond the viewer's float32"
_AS_MEASURED = "is shown as measured: the ego trajectory does not reach all of its points' times"


def _ui_points(size: float) -> Any:
    """A radius in points of the screen, the same at any distance."""
    return sdk().Radius.ui_points(size)


@dataclass(slots=True, eq=False)
class _LidarView:
    """Shows the sweeps of one lidar."""

    stream: Stream
    locations: Locations
    lidar: LidarSensor
    colour_by: ColourBy | None  # what gives the points their colours; None: the best that there is
    as_measured: bool  # leave the motion during a sweep in
    notify: Report  # of what could not be shown
    painter: _CloudPainter = field(init=False)
    _sensor_source: PoseSource = field(init=False)
    _source: PoseSource = field(init=False)

    def __post_init__(self) -> None:
        self.painter = _CloudPainter(self.colour_by)
        self._sensor_source, problem = self.locations.source(self.lidar)
        self._source = self._points_source()
        if problem is not None and self.lidar.points_frame is PointsFrame.SENSOR:
            self.notify("not-placed", f"sensors[{self.lidar.id!r}]", problem)

    @property
    def path(self) -> str:
        """The entity of its points."""
        if self.lidar.points_frame is PointsFrame.SENSOR:
            return self.stream.path(WORLD, SENSORS, self.lidar.id, "points")
        return self.stream.path(WORLD, _CLOUDS, self.lidar.id)

    def log(self, k: int) -> tuple[int, Float32Array | None]:
        """Log sweep `k`; give the time that it is shown at, and its points in the frame of `path` if they are shown."""
        frame = self.lidar.frames[k]
        time_ns, rr = frame.reference_ns, sdk()
        shown_from_sensor = pose_at(self._sensor_source, time_ns)
        if shown_from_sensor is not None:
            self.stream.log(time_ns, self.stream.path(WORLD, SENSORS, self.lidar.id), transform(shown_from_sensor))
        in_sensor = self.lidar.points_frame is PointsFrame.SENSOR
        shown_from_points = shown_from_sensor if in_sensor else pose_at(self._source, time_ns)
        if shown_from_points is None:
            self.notify("beyond-the-trajectory", f"sensors[{self.lidar.id!r}].frames", _BEYOND)
            return time_ns, None
        positions = self._at_one_moment(frame, time_ns)
        above = self._heights(positions, shown_from_points, shown_from_sensor)
        colours, held = self.painter.paint(frame.points, above), fits(positions)
        self.stream.leave_out("lidar points", np.count_nonzero(~held))
        cloud = rr.Points3D(positions[held], colors=colours[held], radii=_ui_points(_POINT_SIZE))
        placed = () if in_sensor else (transform(shown_from_points),)
        self.stream.log(time_ns, self.path, *placed, cloud, kind="sweeps", size=16 * len(positions))
        return time_ns, positions

    def _points_source(self) -> PoseSource:
        """What takes the points as stored to where they are shown."""
        if self.lidar.points_frame is PointsFrame.SENSOR:
            return self._sensor_source
        reach_ns, path = scene_period_ns(self.locations.scene), Poses.identity()
        if self.lidar.points_frame is PointsFrame.EGO:
            try:
                path = ego_path(self.locations.scene, self.lidar, self.locations.ego)
            except PoseError as error:
                self.notify("not-placed", f"sensors[{self.lidar.id!r}]", str(error))
                return PoseSource(path, RigidTransform.identity())
        return self.locations.shown(PoseSource(path, RigidTransform.identity(), reach_ns))

    def _at_one_moment(self, frame: LidarFrame, time_ns: int) -> Float32Array:
        source, times = self._source, frame.points.timestamps_ns
        still = self.as_measured or source.path.static or times is None or len(times) == 0
        longest_ns = _LONGEST_SWEEP * sweep_period_ns(self.lidar)
        if still or times is None or np.ptp(times) == 0 or np.ptp(times) > longest_ns:
            return frame.points.positions
        try:
            moved, _ = points_at(frame, source, time_ns)
        except PoseError:
            self.notify("as-measured", f"sensors[{self.lidar.id!r}].frames", _AS_MEASURED)
            return frame.points.positions
        # `points_at` gives them in the frame of the sensor at that moment, which is that of `source` with its mounting
        return moved.astype(np.float32)

    def _heights(
        self, positions: Float32Array, shown_from_points: RigidTransform, shown_from_sensor: RigidTransform | None
    ) -> "_Heights":
        base = shown_from_points if shown_from_sensor is None else shown_from_sensor
        return _Heights(positions, shown_from_points, float(base.translation[2]))


@dataclass(frozen=True, slots=True, eq=False)
class _Heights:
    """How far points are above a height of the world; computed when it is asked for."""

    positions: Float32Array
    shown_from_points: RigidTransform
    base: float

    def __call__(self) -> Float64Array:
        upwards = self.shown_from_points.rotation[2]
        heights: Float64Array = self.positions @ upwards + (self.shown_from_points.translation[2] - self.base)
        return heights


@dataclass(slots=True, eq=False)
class _RadarView:
    """Shows the cycles of one radar: points, and an arrow for the trajectory that each makes in a second."""

    stream: Stream
    locations: Locations
    radar: RadarSensor
    notify: Report
    _source: PoseSource = field(init=False)

    def __post_init__(self) -> None:
        self._source, problem = self.locations.source(self.radar)
        if problem is not None:
            self.notify("not-placed", f"sensors[{self.radar.id!r}]", problem)

    def log(self, k: int, _: None) -> None:
        """Log cycle `k`."""
        rr, frame = sdk(), self.radar.frames[k]
        time_ns, points = frame.timestamp_ns, frame.points
        pose = pose_at(self._source, time_ns)
        if pose is None:
            self.notify("beyond-the-trajectory", f"sensors[{self.radar.id!r}].frames", _BEYOND)
            return
        entity = self.stream.path(WORLD, SENSORS, self.radar.id)
        self.stream.log(time_ns, entity, transform(pose))
        inside = self._into_sensor(pose, time_ns)
        vectors = _velocities(points.directions, points.lengths, len(points))
        rotated = vectors if inside is None else inside.rotate(vectors)
        positions = points.positions if inside is None else inside.apply(points.positions)
        held = fits(positions)
        self.stream.leave_out("radar points", np.count_nonzero(~held))
        positions, rotated = positions[held], rotated[held]
        colours = np.where((rotated * positions).sum(axis=1) < 0, _NEARING, _LEAVING).astype(np.uint32)
        shown = rr.Points3D(positions, colors=colours, radii=_ui_points(_RADAR_SIZE))
        self.stream.log(time_ns, f"{entity}/points", shown, kind="radar cycles", size=16 * len(points))
        known = fits(rotated)
        arrows = rr.Arrows3D(
            vectors=rotated[known], origins=positions[known], colors=colours[known], radii=_ui_points(_ARROW_SIZE)
        )
        self.stream.log(time_ns, f"{entity}/velocities", arrows)

    def _into_sensor(self, shown_from_sensor: RigidTransform, time_ns: int) -> RigidTransform | None:
        """What takes points as stored into the sensor's frame; None where they are in it."""
        if self.radar.points_frame is PointsFrame.SENSOR:
            return None
        if self.radar.points_frame is PointsFrame.WORLD:
            shown_from_points = RigidTransform(np.eye(3), -self.locations.origin_world)
        else:
            path = ego_path(self.locations.scene, self.radar, self.locations.ego)
            on_ego = self.locations.shown(PoseSource(path, RigidTransform.identity()))
            shown_from_points = pose_at(on_ego, time_ns) or RigidTransform.identity()
        return shown_from_sensor.inverse() @ shown_from_points


def _velocities(directions: Float32Array | None, lengths: Float32Array | None, count: int) -> Float64Array:
    """(N, 3) [m/s]; zeros where the radar gives none."""
    if directions is None or lengths is None:
        return np.zeros((count, 3))
    vectors: Float64Array = directions.astype(np.float64) * lengths[:, None]
    return vectors


def _show_map(stream: Stream, locations: Locations, sensor: PointsSensor) -> None:
    """Show a cloud without time."""
    colours = None if sensor.colors is None else _packed(sensor.colors)
    positions = sensor.positions - locations.origin_world
    held = fits(positions)
    stream.leave_out("points of maps", np.count_nonzero(~held))
    cloud = sdk().Points3D(
        positions[held].astype(np.float32),
        colors=None if colours is None else colours[held],
        radii=_ui_points(_POINT_SIZE),
    )
    stream.static(stream.path(WORLD, _CLOUDS, sensor.id), cloud)
    stream.counts["maps"] = stream.counts.get("maps", 0) + 1


_EGO, _TRAJECTORIES, _IMU, _GNSS, _MAP, _EARTH = "ego", "trajectories", "imu", "gnss", "map", "earth"
"""Entities: the ego's frame, ways through the world, curves of both kinds of sensors, the plan, locations on earth."""
_AXES = ("x", "y", "z")
_UNITS: Mapping[str, str] = MappingProxyType(
    {"accelerometer": "m/s²", "gyroscope": "rad/s", "magnetometer": "µT", "imuTemperature": "K", "barometer": "hPa"}
)
_AXIS_COLOURS = ((239, 83, 80), (102, 187, 106), (66, 165, 245))
_TRAJECTORY, _FIXES = (255, 206, 84), (82, 196, 255)
_MOST_POSES = 20_000
_ROWS_AT_ONCE = 8_192
_MOST_SAMPLES = 200_000


def _show_motion(stream: Stream, locations: Locations, scene: Scene) -> None:
    """Show the ego trajectory, _IMU and _GNSS; all of it at once, since it is small."""
    stream.static(stream.path(WORLD), sdk().ViewCoordinates.RIGHT_HAND_Z_UP)
    _show_ego(stream, locations)
    imus = [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor)]
    receivers = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
    receivers = [sensor for sensor in receivers if len(sensor.timestamps_ns)]
    for imu in imus:
        _show_imu(stream, imu)
    for receiver in receivers:
        _show_fixes(stream, receiver)
    origin_lla = _map_origin(locations, receivers)
    _show_plan(stream, locations, receivers, origin_lla)


def _show_ego(stream: Stream, locations: Locations) -> None:
    rr, path = sdk(), locations.path
    for name, trajectory in locations.scene.trajectories.items():
        if locations.ego is not None and name == locations.ego.name and path is not None:
            continue  # it is the ego trajectory, drawn below
        shifted = trajectory.positions - locations.origin_world
        line = _line(shifted)
        stream.leave_out("poses", np.count_nonzero(~fits(shifted)))
        stream.static(stream.path(WORLD, _TRAJECTORIES, name), _strips(line, colour_of_name(name), name))
    if path is None:
        return
    rows = spread_rows(len(path.timestamps_ns), _MOST_POSES, nearest=False)
    samples = path.moved(locations.origin_world).held(path.timestamps_ns[rows])
    held = fits(samples.positions)
    stream.leave_out("ego poses", np.count_nonzero(~held))
    entity, shown = stream.path(WORLD, _EGO), np.flatnonzero(held)
    stream.columns(path.timestamps_ns[rows][shown], entity, transform_columns(samples, shown), kind="ego poses")
    stream.static(entity, rr.TransformAxes3D(1.5))
    stream.static(
        stream.path(WORLD, _TRAJECTORIES, _trajectory_name(locations)),
        _strips(samples.positions[shown], _TRAJECTORY, _trajectory_name(locations)),
    )


def _trajectory_name(locations: Locations) -> str:
    return "ego" if locations.ego is None else locations.ego.name


def _strips(line: Float64Array, colour: Colour, name: str) -> object:
    return sdk().LineStrips3D(
        [line],
        colors=np.array([one_packed(colour)], np.uint32),
        radii=np.array([-1.5], np.float32),
        labels=[name],
        show_labels=False,
    )


def _line(positions: Float64Array) -> Float64Array:
    finite = positions[fits(positions)]
    return np.asarray(finite[spread_rows(len(finite), _MOST_POSES, nearest=False)], np.float64)


def _show_imu(stream: Stream, sensor: ImuSensor) -> None:
    for name, samples in sensor.streams.items():
        width = samples.values.shape[1]
        axes = [_AXES[k] if width == 3 else (name if width == 1 else str(k)) for k in range(width)]
        _curves(stream, stream.path(_IMU, sensor.id, name), samples, axes, _UNITS.get(name, ""))


def _curves(
    stream: Stream,
    path: str,
    samples: VectorSamples,
    names: Iterable[str],
    unit: str,
    *,
    colours: Sequence[Colour] = _AXIS_COLOURS,
) -> None:
    """Log a vector over time; of very long streams every Nth sample."""
    rr = sdk()
    titles = [f"{name} [{unit}]" if unit else name for name in names]
    chosen = [colours[k % len(colours)] for k in range(len(titles))]
    stream.static(path, rr.SeriesLines(names=titles, colors=chosen))
    step = -(-len(samples) // _MOST_SAMPLES) or 1
    times_ns, values = samples.timestamps_ns[::step], samples.values[::step]
    for start in range(0, len(times_ns), _ROWS_AT_ONCE):
        part = slice(start, start + _ROWS_AT_ONCE)
        rows = values[part]
        columns = rr.Scalars.columns(scalars=rows.reshape(-1)).partition(np.full(len(rows), rows.shape[1]))
        stream.columns(times_ns[part], path, columns, kind="samples")


def _show_fixes(stream: Stream, sensor: GnssSensor) -> None:
    """Log fixes as locations on earth, and their heights and accuracies as curves."""
    rr = sdk()
    usable = usable_fixes(sensor)
    times_ns, lla = sensor.timestamps_ns[usable], sensor.positions_lla[usable]
    colour = one_packed(_FIXES)
    points = rr.GeoPoints.columns(
        positions=lla[:, :2], radii=np.full(len(lla), -6.0, np.float32), colors=np.full(len(lla), colour, np.uint32)
    )
    stream.columns(times_ns, stream.path(_EARTH, sensor.id, "fix"), points, kind="fixes")
    trajectory = rr.GeoLineStrings(
        lat_lon=[lla[:, :2]], colors=np.array([colour], np.uint32), radii=np.array([-1.5], np.float32)
    )
    stream.static(stream.path(_EARTH, sensor.id, "trajectory"), trajectory)
    curves = (
        ("height", lla[:, 2], _AXIS_COLOURS[2]),
        ("accuracy", sensor.accuracies[usable], _AXIS_COLOURS[0]),
        ("vertical accuracy", sensor.vertical_accuracies[usable], _AXIS_COLOURS[1]),
    )
    for name, values, curve in curves:
        known = np.isfinite(values)
        if known.any():
            samples = VectorSamples(times_ns[known], np.ascontiguousarray(values[known, None]))
            _curves(stream, stream.path(_GNSS, sensor.id, name), samples, [name], "m", colours=(curve,))


def _map_origin(locations: Locations, receivers: list[GnssSensor]) -> Float64Array | None:
    """The location on earth that the plan counts from: the world's origin where it is known, else the first fix."""
    if locations.ego is not None and locations.ego.enu_origin_lla is not None:
        return np.array(locations.ego.enu_origin_lla)
    if not receivers:
        return None
    _, fixes = usable_positions(receivers[0])
    return fixes[0] if len(fixes) else None


def _show_plan(
    stream: Stream, locations: Locations, receivers: list[GnssSensor], origin_lla: Float64Array | None
) -> None:
    """Log a plan in metres, north (or the world's y) up: fixes, and the ego trajectory where both share their axes."""
    if origin_lla is not None:
        for sensor in receivers:
            rows, fixes = usable_positions(sensor)
            enu = enu_from_geodetic(fixes, origin_lla)
            _plan_line(stream, (_GNSS, sensor.id), enu, _FIXES)
            _plan_marks(stream, (_GNSS, sensor.id), sensor.timestamps_ns[rows], enu, _FIXES)
    is_enu = locations.ego is not None and locations.ego.enu_origin_lla is not None
    if locations.path is not None and (is_enu or origin_lla is None):
        positions = locations.path.positions if is_enu else locations.path.positions - locations.origin_world
        _plan_line(stream, (_EGO,), positions, _TRAJECTORY)
        _plan_marks(stream, (_EGO,), locations.path.timestamps_ns, positions, _TRAJECTORY)
        if is_enu and origin_lla is not None:
            _show_trajectory_on_earth(stream, locations.path, origin_lla)


def _plan_line(stream: Stream, names: tuple[str | int, ...], enu: Float64Array, colour: Colour) -> None:
    strip = _on_plan(_line(enu))
    line = sdk().LineStrips2D(
        [strip], colors=np.array([one_packed(colour)], np.uint32), radii=np.array([-1.0], np.float32)
    )
    stream.static(stream.path(_MAP, *names, "trajectory"), line)


def _plan_marks(
    stream: Stream, names: tuple[str | int, ...], times_ns: np.ndarray, enu: Float64Array, colour: Colour
) -> None:
    rows = spread_rows(len(enu), _MOST_POSES, nearest=False)
    marks = sdk().Points2D.columns(
        positions=_on_plan(enu[rows]),
        colors=np.full(len(rows), one_packed(colour), np.uint32),
        radii=np.full(len(rows), -5.0, np.float32),
    )
    stream.columns(times_ns[rows], stream.path(_MAP, *names, "location"), marks)


def _on_plan(enu: Float64Array) -> Float64Array:
    """East and north as pixels, which count downwards."""
    return enu[:, :2] * (1.0, -1.0)


def _show_trajectory_on_earth(stream: Stream, path: Poses, origin_lla: Float64Array) -> None:
    lla = geodetic_from_enu(_line(path.positions), origin_lla)
    trajectory = sdk().GeoLineStrings(
        lat_lon=[lla[:, :2]], colors=np.array([one_packed(_TRAJECTORY)], np.uint32), radii=np.array([-1.5], np.float32)
    )
    stream.static(stream.path(_EARTH, _EGO), trajectory)


_NOTES = "notes"

_LEVELS: Mapping[str, str] = MappingProxyType(
    {
        WarningKind.ASSUMED: "INFO",
        WarningKind.REPAIRED: "INFO",
        WarningKind.SKIPPED: "WARN",
        Severity.ERROR: "ERROR",
        Severity.WARNING: "WARN",
        Severity.HINT: "INFO",
    }
)


@dataclass(slots=True)
class _Reported:
    """Gathers what could not be shown, counted by code and location."""

    lines: dict[tuple[str, str], tuple[str, int]] = field(default_factory=dict)

    def __call__(self, code: str, location: str, message: str) -> None:
        """Take one more."""
        first, count = self.lines.get((code, location), (message, 0))
        self.lines[code, location] = first, count + 1

    @property
    def warnings(self) -> tuple[DataWarning, ...]:
        """All of it."""
        return tuple(
            (repaired if code == "straightened" else skipped)(code, location, message, count=count)
            for (code, location), (message, count) in self.lines.items()
        )


def _findings(scene: Scene) -> tuple[Finding, ...]:
    """What the rules of `validate` that need no frames report."""
    from sceneloom.checks.validation import validate

    return validate(scene, frames=False).findings


def _log_notes(stream: Stream, time_ns: int, warnings: Sequence[DataWarning], findings: Sequence[Finding]) -> None:
    """Log them at a time, the worst first; warnings that a finding reports already are not repeated."""
    reported = {finding.message for finding in findings}
    order = {level: k for k, level in enumerate(("ERROR", "WARN", "INFO"))}
    lines = [(_LEVELS[one.severity], f"{one.path}: {one.message}; {one.remedy} [{one.rule}]") for one in findings]
    lines += [
        (
            _LEVELS[one.kind],
            f"{one.kind}: {one.location}: {one.message}" + (f" ({one.count} times)" if one.count > 1 else ""),
        )
        for one in warnings
        if one.message not in reported
    ]
    for level, text in sorted(lines, key=lambda line: order[line[0]]):
        stream.log(time_ns, stream.path(_NOTES), sdk().TextLog(text, level=level), kind="notes")


_BEHIND, _ABOVE, _AHEAD = 14.0, 7.0, 8.0  # where the eye stands behind the ego, and where it looks [m]
_MOVED = 2.0  # how far the ego must have moved before its trajectory tells where forward is [m]
_IN_IMAGES = ("annotations", "tracks/boxes", "tracks/history")
"""What has a location in the world and is shown through the camera models, too."""
_BACKGROUND = (16, 18, 22)


def _eye(locations: Locations) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Behind and above the ego, looking where it goes; seen from the ego, whose axes may point anywhere."""
    forward, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    path = locations.path
    if path is not None:
        back = conjugate_quaternion(path.quaternions_xyzw[:1])
        up = rotate_vectors(back, up[None])[0]
        steps = np.linalg.norm(path.positions - path.positions[0], axis=1)
        trajectory = path.positions[int(np.argmax(steps > _MOVED))] - path.positions[0]
        if steps.max() > _MOVED:
            forward = rotate_vectors(back, trajectory[None])[0]
        forward = forward - (forward @ up) * up
        length = float(np.linalg.norm(forward))
        forward = forward / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    eye = _ABOVE * up - _BEHIND * forward
    return tuple(eye.tolist()), tuple((_AHEAD * forward).tolist())


@cache
def _blueprint_sdk() -> Any:
    """Import `rerun.blueprint`, of which layouts are made."""
    sdk()
    import rerun.blueprint

    return rerun.blueprint


def _layout_of(view: "DriveView") -> Any:
    """The layout of one drive: its world, tabs of what has no location, and the images of its cameras."""
    rrb, scene, root = _blueprint_sdk(), view.scene, f"/{escaped(view.name)}"
    world_path, follows = f"{root}/{WORLD}", view.locations.path is not None
    eye, target = _eye(view.locations)

    def world(name: str, *, following: bool) -> Any:
        """The world with the eye behind the ego; of a drive that moves also whole, the eye where the viewer puts it."""
        controls = {"position": eye, "look_target": target} if following or not follows else {}
        return rrb.Spatial3DView(
            origin=f"{world_path}/{_EGO}" if following else world_path,
            contents=f"+ {world_path}/**",
            name=name,
            background=_BACKGROUND,
            line_grid=not following,
            eye_controls=rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, **controls),
        )

    def camera(camera_id: Identifier) -> Any:
        """The images of a camera with what is drawn into them and what its model sees of the world; fused depths."""
        path = f"{world_path}/{SENSORS}/{escaped(camera_id)}/{IMAGE}"
        through = [f"+ {world_path}/{name}/**" for name in _IN_IMAGES]
        contents = ["+ $origin/**", f"- $origin/{DEPTH}/**", *through]
        images = rrb.Spatial2DView(origin=path, contents=contents, name=str(camera_id))
        if view.settings.depth is None:
            return images
        depths = rrb.Spatial2DView(origin=path, contents=[f"+ $origin/{DEPTH}/**"], name=f"{camera_id}: depth")
        return rrb.Tabs(images, depths, active_tab=0, name=str(camera_id))

    worlds = [world("world", following=follows)]
    if follows:
        worlds.append(world("from afar", following=False))
    top = rrb.Tabs(*worlds, active_tab=0) if len(worlds) > 1 else worlds[0]
    left = rrb.Vertical(top, rrb.Tabs(*_tabs(view, root), active_tab=0), row_shares=[3, 1])
    images = [camera(sensor.id) for sensor in scene.sensors if isinstance(sensor, CameraSensor | DepthCameraSensor)]
    if not images:
        return rrb.Horizontal(left, name=view.name)
    side = rrb.Grid(*images, grid_columns=1 if len(images) <= 3 else 2) if len(images) > 1 else images[0]
    return rrb.Horizontal(left, side, column_shares=[3, 2], name=view.name)


def _tabs(view: "DriveView", root: str) -> list[Any]:
    """What has no location in the world, as far as the drive has it."""
    rrb, scene, annotations = _blueprint_sdk(), view.scene, view.scene.annotations
    gnss = any(isinstance(sensor, GnssSensor) and len(sensor.timestamps_ns) for sensor in scene.sensors)
    views = [rrb.TextLogView(origin=root, contents=[f"+ {root}/{_NOTES}", f"+ {root}/{EVENTS}/**"], name="log")]
    if gnss:
        views.append(rrb.TimeSeriesView(origin=f"{root}/{_GNSS}", name="satellite fixes"))
    for sensor in scene.sensors:
        if isinstance(sensor, ImuSensor) and sensor.streams:
            base = f"{root}/{_IMU}/{escaped(sensor.id)}"
            plots = [rrb.TimeSeriesView(origin=f"{base}/{escaped(name)}", name=name) for name in sensor.streams]
            views.append(rrb.Horizontal(*plots, name=str(sensor.id)))
    if gnss or view.locations.path is not None:
        views.append(rrb.Spatial2DView(origin=f"{root}/{_MAP}", name="map [m]", background=_BACKGROUND))
    if gnss and view.settings.map_tiles:
        views.append(rrb.MapView(origin=f"{root}/{_EARTH}", name="map", background=rrb.MapProvider.OpenStreetMap))
    if any(isinstance(one, EventAnnotation) for one in annotations):
        views.append(rrb.StateTimelineView(origin=f"{root}/{EVENTS}", name="events"))
    if any(one.is_timed and one.values for one in scene.attributes):
        views.append(rrb.TimeSeriesView(origin=f"{root}/{ATTRIBUTES}", name="attributes"))
        views.append(rrb.StateTimelineView(origin=f"{root}/{ATTRIBUTES}", name="attributes in words"))
    if annotations or any(not one.is_timed for one in scene.attributes):
        views.append(rrb.TextDocumentView(origin=f"{root}/{LIST}", name="annotations"))
    if any(one.parent_id is not None or one.type in {"link", "group", "object"} for one in annotations):
        views.append(rrb.GraphView(origin=f"{root}/{RELATIONS}", name="relations"))
    return views


_READ_BY_THREADS = frozenset({"recording", "sfs"})
"""Formats in which each camera has a reader of its own, so that several may be read at once."""


@dataclass(frozen=True, slots=True, eq=False)
class DriveView:
    """A drive before it is logged.

    Attributes:
        scene: the shown part of it, camera models made straight.
        measured: the same with its own camera models.
        reference_ns: (N,) int64 [ns], by which frames of the drive are counted.
        bent: cameras whose images hang nowhere.
        reported: what could not be shown.
    """

    name: str
    scene: Scene
    measured: Scene
    reference_ns: Int64Array
    locations: Locations
    bent: frozenset[Key]
    settings: ViewSettings
    reported: _Reported

    @classmethod
    def of(cls, scene: Scene, name: str, settings: ViewSettings, *, progress: Progress | None = None) -> "DriveView":
        """Choose what of a scene is shown, and find where its sensors are.

        Raises:
            OptionError: a sensor or trajectory is not there, or no frame lies in the part.
            PoseError: the named trajectory cannot be used.
        """
        reported = _Reported()
        scene = scene.corrected()
        chosen = scene
        if settings.sensors is not None:
            ids = {str(sensor.id): sensor.id for sensor in scene.sensors}
            keys = {key_of(scene.sensor(ids.get(str(stated), stated)).id) for stated in settings.sensors}
            chosen = replace(scene, sensors=tuple(one for one in scene.sensors if key_of(one.id) in keys))
        part = cut_scene(chosen, start=settings.start, stop=settings.stop)
        straight, bent = with_straight_camera_models(part, reported)
        locations = Locations.of(straight, trajectory=settings.trajectory, heading=settings.heading, progress=progress)
        return cls(name, straight, part, _reference_ns(scene), locations, bent, settings, reported)

    @staticmethod
    def layout(views: "Sequence[DriveView]") -> Any:
        """The layout of one drive, or of several, each under a tab of its own, with all worlds over each other."""
        rrb, parts = _blueprint_sdk(), [_layout_of(view) for view in views]
        content = parts[0]
        if len(parts) > 1:
            worlds = [f"+ /{escaped(view.name)}/{WORLD}/**" for view in views]
            together = rrb.Spatial3DView(origin="/", contents=worlds, name="together")
            content = rrb.Tabs(*parts, together, active_tab=0)
        return rrb.Blueprint(
            content,
            rrb.BlueprintPanel(state="expanded"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline=TIME),
            auto_layout=False,
            auto_views=False,
        )

    def log(self, recording: Any, *, calendar: bool, progress: Progress | None = None) -> DriveShown:
        """Log the drive to an open stream of Rerun's, frame by frame.

        Args:
            calendar: whether times are shown as times of day, else as seconds.

        Raises:
            DataError: a frame cannot be read, and the reading is not lenient.
            OptionError: angles of cuboids have a unit or order that is not known.
        """
        scene, reported = self.scene, self.reported
        stream = Stream(recording, f"/{escaped(self.name)}", calendar, self.reference_ns)
        _show_motion(stream, self.locations, scene)
        span_ns = time_span(scene) or (0, 0)
        findings = _findings(self.measured) if self.settings.findings else ()
        _log_notes(stream, span_ns[0], (*scene.warnings, *self.locations.warnings), findings)
        run = _Run(self, stream, AnnotationView.of(stream, self.locations, scene, reported))
        run.log_maps()
        feeds = run.feeds()
        lenient = bool(self.settings.reading.get("lenient"))

        def passed_over(error: Exception) -> bool:
            """Whether to go on after a moment that cannot be read, and report it."""
            if not (lenient and isinstance(error, DataError)):
                return False
            reported("unreadable", error.location or error.file, error.problem)
            return True

        for _ in reporting(_play(feeds, passed_over), progress, sum(map(len, feeds))):
            pass
        run.annotations.finish()
        _log_notes(stream, span_ns[0], (*reported.warnings, *stream.warnings), ())
        return run.shown(span_ns, findings)


def _reference_ns(scene: Scene) -> Int64Array:
    """When the frames begin by which a drive is counted: the sweeps of the first lidar, else the first images."""
    for sensor in scene.lidars:
        if len(sensor.frames):
            return np.sort(sensor.frames.timestamps_ns)
    for camera in scene.cameras:
        if len(camera.images):
            return np.sort(camera.images.timestamps_ns)
    return np.zeros(0, np.int64)


@dataclass(slots=True, eq=False)
class _Run:
    """The logging of one drive."""

    view: DriveView
    stream: Stream
    annotations: AnnotationView
    lidars: list[_LidarView] = field(default_factory=list)

    def feeds(self) -> list[Feed]:
        """All that has a time, sensor by sensor."""
        scene, every = self.view.scene, self.view.settings.every
        feeds = [self._sweeps(lidar, first=lidar is scene.lidars[0]) for lidar in scene.lidars]
        for sensor in scene.sensors:
            if isinstance(sensor, RadarSensor):
                shown = _RadarView(self.stream, self.view.locations, sensor, self.view.reported)
                feeds.append(_thinned(Feed(sensor.frames.timestamps_ns, shown.log), every))
            elif isinstance(sensor, CameraSensor | DepthCameraSensor):
                feeds += self._camera(sensor)
        return [*feeds, *self._accompanying()]

    def _sweeps(self, lidar: LidarSensor, *, first: bool) -> Feed:
        settings = self.view.settings
        shown = _LidarView(
            self.stream, self.view.locations, lidar, settings.colour_by, settings.as_measured, self.view.reported
        )
        self.lidars.append(shown)

        def log(k: int, _: None) -> None:
            time_ns, positions = shown.log(k)
            if positions is not None:
                self.annotations.labelled.log(lidar.id, k, shown.path, time_ns, positions)
            if first:
                self.annotations.note(time_ns)

        return _thinned(Feed(lidar.frames.timestamps_ns, log), settings.every)

    def _camera(self, sensor: CameraSensor | DepthCameraSensor) -> list[Feed]:
        """Images, and at once all that is drawn into them, which is small."""
        view, every = self.view, self.view.settings.every
        if isinstance(sensor, CameraSensor):
            self.annotations.log_in_images(sensor.id, np.unique(sensor.images.timestamps_ns[::every]))
        feed = camera_feed(
            self.stream,
            view.locations,
            sensor,
            view.reported,
            every=every,
            has_pinhole=key_of(sensor.id) not in view.bent,
            ahead=view.scene.format in _READ_BY_THREADS,
        )
        if feed is None:
            return []
        log_image, times_ns = feed.log, feed.times_ns

        def log(k: int, prepared: Any) -> None:
            log_image(k, prepared)
            self.annotations.note(int(times_ns[k]))

        counts_moments = not view.scene.lidars and sensor is next(iter(view.scene.cameras), None)
        return [_thinned(replace(feed, log=log) if counts_moments else feed, every)]

    def _accompanying(self) -> list[Feed]:
        """What files beside the drive hold."""
        view, settings, origin = self.view, self.view.settings, self.view.locations.origin_world
        feeds: list[Feed] = []
        if settings.detections is not None:
            feeds += detection_feeds(self.stream, settings.detections, origin)
        if settings.tracks is not None:
            feeds.append(track_feed(self.stream, settings.tracks, view.scene, origin))
        if settings.depth is not None:
            feeds.append(fused_depth_feed(self.stream, settings.depth, view.measured, view.scene))
        span_ns = time_span(view.scene)
        if span_ns is None:
            return feeds
        first, last = span_ns  # the moments that lie in the shown part of the drive
        return [_chosen(one, np.flatnonzero((one.times_ns >= first) & (one.times_ns <= last))) for one in feeds]

    def log_maps(self) -> None:
        """Log clouds without time, and report what cannot be shown."""
        view, stream, scene = self.view, self.stream, self.view.scene
        for sensor in scene.sensors:
            if isinstance(sensor, PointsSensor):
                _show_map(stream, view.locations, sensor)
                path = stream.path("world", "clouds", sensor.id)
                with np.errstate(over="ignore"):  # what overflows is left out
                    positions = (sensor.positions - view.locations.origin_world).astype(np.float32)
                self.annotations.labelled.log(sensor.id, None, path, None, positions)
        for kind, things in (("sensors", scene.sensors), ("annotations", scene.annotations)):
            for one in things:
                if isinstance(one, PlainSensor | PlainAnnotation):
                    problem = f"nothing is known of the type {one.type!r}"
                    view.reported("not-shown", f"{kind}[{one.id!r}]", problem)

    def shown(self, span_ns: tuple[int, int], findings: tuple[Finding, ...]) -> DriveShown:
        """What was logged."""
        view, stream = self.view, self.stream
        colours = {str(one.lidar.id): one.painter.used for one in self.lidars}
        wanted = view.settings.colour_by
        for sensor_id, used in colours.items():
            if wanted is not None and used is not None and used is not wanted:
                problem = f"its points have no {wanted}; they show {used}"
                view.reported("colours-missing", f"sensors[{sensor_id!r}]", problem)
        return DriveShown(
            source=view.scene.source,
            format=view.scene.format,
            root=stream.root,
            origin=tuple(view.locations.origin_world.tolist()),
            seconds=(span_ns[1] - span_ns[0]) / 1e9,
            colours={sensor_id: used.value for sensor_id, used in colours.items() if used is not None},
            logged=dict(sorted(stream.counts.items())),
            findings=dict(Counter(str(finding.severity) for finding in findings)),
            warnings=(*view.scene.warnings, *view.locations.warnings, *view.reported.warnings, *stream.warnings),
        )


_MOST_THREADS = 4


@dataclass(slots=True)
class _Ahead:
    """Prepares the next moment of a feed while others are logged."""

    feed: Feed
    pool: ThreadPoolExecutor
    coming: "Future[Any] | None" = None

    def begin(self, k: int) -> None:
        """Begin to prepare moment `k`, if there is one."""
        if self.feed.prepare is not None and k < len(self.feed):
            self.coming = self.pool.submit(self.feed.prepare, k)

    def log(self, k: int) -> None:
        """Log moment `k`, and begin to prepare the next one."""
        coming, self.coming = self.coming, None
        try:
            prepared = None if coming is None else coming.result()
        finally:
            self.begin(k + 1)
        self.feed.log(k, prepared)


def _play(feeds: Sequence[Feed], on_fault: Callable[[Exception], bool]) -> Iterator[None]:
    """Log the moments of all feeds in the order of time; `on_fault` says whether to go on after what went wrong."""
    threads = min(_MOST_THREADS, os.cpu_count() or 1)
    with ThreadPoolExecutor(threads, thread_name_prefix="sceneloom-view") as pool:
        ahead = [_Ahead(feed, pool) for feed in feeds]
        for one in ahead:
            one.begin(0)
        try:
            for _, order, k in merge(*(_keyed(order, feed) for order, feed in enumerate(feeds))):
                try:
                    ahead[order].log(k)
                except Exception as error:
                    if not on_fault(error):
                        raise
                yield
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _keyed(order: int, feed: Feed) -> Iterator[tuple[int, int, int]]:
    return ((time_ns, order, k) for k, time_ns in enumerate(feed.times_ns.tolist()))


def _thinned(feed: Feed, every: int) -> Feed:
    """Every Nth moment, in the order of time."""
    rows = np.arange(0, len(feed), every)
    return _chosen(feed, rows[np.argsort(feed.times_ns[rows], kind="stable")])


def _chosen(feed: Feed, rows: Int64Array) -> Feed:
    """Some moments of a feed: (M,) numbers of them."""
    numbers: list[int] = rows.tolist()
    prepare = feed.prepare
    return Feed(
        feed.times_ns[rows],
        lambda k, prepared: feed.log(numbers[k], prepared),
        None if prepare is None else lambda k: prepare(numbers[k]),
    )


_APPLICATION = "sceneloom"
_SUFFIX = ".rrd"
_SINCE_EPOCH_NS = 100_000_000_000_000_000
"""Timestamps from here on (March 1973) count from 1970; smaller ones from the beginning of the drive."""
_MOST_DRIVES = 32  # more tabs would be hard to find


@contextmanager
def _opened_drives(
    sources: Sequence[Source], settings: ViewSettings, *, progress: Progress | None = None
) -> Iterator[tuple[DriveView, ...]]:
    """Open drives, each under a root of its own name."""
    if not sources:
        raise OptionError("no drive to show; expected one or more paths")
    if len(sources) > _MOST_DRIVES:
        raise OptionError(
            f"{len(sources)} drives, or parts of drives; expected no more than {_MOST_DRIVES} at once: choose some, as "
            f"`sceneloom catalog query … --limit {_MOST_DRIVES}` does"
        )
    settings.check_drives(len(sources))
    parts = [source if isinstance(source, DrivePart) else DrivePart(source) for source in sources]
    shared = SharedOptions(settings.reading)
    with ExitStack() as stack:
        scenes = [
            part.source
            if isinstance(part.source, Scene)
            else stack.enter_context(shared.read(partial(_open, part.source, part.reading)))
            for part in parts
        ]
        shared.check()
        yield tuple(
            DriveView.of(scene, name, part.settings(settings), progress=progress)
            for scene, name, part in zip(scenes, _roots(parts), parts, strict=True)
        )


def _open(location: str | Path, own: Mapping[str, Any], **reading: Any) -> Scene:
    return open_scene(location, **{**reading, **own})


def _roots(parts: Sequence[DrivePart]) -> list[str]:
    """The names of drives, each once."""
    roots: list[str] = []
    for part in parts:
        taken = sum(root == part.name or root.startswith(f"{part.name} (") for root in roots)
        roots.append(f"{part.name} ({taken + 1})" if taken else part.name)
    return roots


def _new_recording(views: Sequence[DriveView]) -> Any:
    """A stream of Rerun's whose only times are those of the drives."""
    rr = sdk()
    name = ", ".join(view.name for view in views)
    recording = rr.RecordingStream(_APPLICATION, send_properties=False)
    rr.set_log_tick_enabled(False, recording=recording)
    rr.set_log_time_enabled(False, recording=recording)
    recording.send_recording_name(name)
    return recording


def _log_drives(
    views: Sequence[DriveView], recording: Any, *, progress: Progress | None = None
) -> tuple[DriveShown, ...]:
    """Log drives one after another to an open stream, and close it."""
    try:
        spans = [time_span(view.scene) for view in views]
        calendar = all(span is not None and span[0] >= _SINCE_EPOCH_NS for span in spans)
        shown = tuple(view.log(recording, calendar=calendar, progress=progress) for view in views)
        recording.flush()
    finally:
        recording.disconnect()
    return shown


def save_view(
    sources: Sequence[Source],
    output: str | Path,
    *,
    settings: ViewSettings | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ViewReport:
    """Save drives with a layout of the viewer to a file that `rerun FILE` opens.

    Args:
        sources: paths of recordings, scenes, …, scenes that are open, or parts of either; each is under a root of its
            own.
        output: the file, which ends in `.rrd`.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        OptionError: an option cannot be followed.
        OutputError: the file exists or cannot be written.
        UnknownFormatError: no format fits a path.
        DataError: a frame cannot be read.
    """
    sdk()
    started, target = time.perf_counter(), Path(output)
    if target.suffix.lower() != _SUFFIX:
        raise OptionError(f"{target}: expected a name that ends in {_SUFFIX}")
    check_output(target, overwrite=overwrite)
    with (
        _opened_drives(sources, settings or ViewSettings(), progress=progress) as views,
        replacing(target, overwrite=overwrite) as draft,
    ):
        recording = _new_recording(views)
        recording.save(draft, default_blueprint=DriveView.layout(views))
        drives = _log_drives(views, recording, progress=progress)
    return ViewReport(
        output=str(target), size_bytes=target.stat().st_size, drives=drives, seconds=time.perf_counter() - started
    )


_LOOPBACK = "127.0.0.1"  # nobody but this machine is answered
_TILES = "https://tile.openstreetmap.org https://*.tile.openstreetmap.org"
_PASSED_ON = ("Content-Type", "rerun-final-length")
_PIECE = 1 << 20
_ANSWER_SECONDS = 60.0


def policy(sink_port: int, *, map_tiles: bool) -> str:
    """What the page may fetch: itself, the data of this machine, and map tiles where they are wanted.

    Source: W3C "Content Security Policy Level 3".
    """
    connect = f"'self' http://{_LOOPBACK}:{sink_port} data: blob:" + (f" {_TILES}" if map_tiles else "")
    return "; ".join(
        (
            "default-src 'self'",
            "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "worker-src 'self' blob:",
            f"connect-src {connect}",
            "frame-ancestors 'none'",
            "form-action 'none'",
        )
    )


def _handler(page_port: int, stated: str) -> type[BaseHTTPRequestHandler]:
    class Forwarding(BaseHTTPRequestHandler):
        """Passes requests on to Rerun's own server, and its answers back with the policy."""

        def do_GET(self) -> None:
            upstream = http.client.HTTPConnection(_LOOPBACK, page_port, timeout=_ANSWER_SECONDS)
            try:
                upstream.request("GET", self.path)
                answer = upstream.getresponse()
                self._pass_on(answer)
            except (OSError, http.client.HTTPException):
                self.close_connection = True
            finally:
                upstream.close()

        def _pass_on(self, answer: http.client.HTTPResponse) -> None:
            content = answer.read()
            self.send_response(answer.status)
            for name in _PASSED_ON:
                if (value := answer.getheader(name)) is not None:
                    self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Content-Security-Policy", stated)
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            for start in range(0, len(content), _PIECE):
                self.wfile.write(content[start : start + _PIECE])

        def log_message(self, format: str, *arguments: object) -> None:
            """Report nothing: the library does not print."""

    return Forwarding


@contextmanager
def guarded_page(page_port: int, sink_port: int, *, map_tiles: bool = False) -> Iterator[int]:
    """Serve Rerun's page on this machine with the policy; gives the port.

    Args:
        page_port: where Rerun serves it.
        sink_port: where the page gets its data.
        map_tiles: let it fetch tiles of OpenStreetMap.
    """
    server = ThreadingHTTPServer((_LOOPBACK, 0), _handler(page_port, policy(sink_port, map_tiles=map_tiles)))
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


_FOLDERS = ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME", "XDG_STATE_HOME")
"""Where programs of a desktop keep what they remember.

Source: XDG Base Directory Specification 0.8.
"""
_PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")
_NOBODY = "http://127.0.0.1:1"  # a proxy that is not there: what would go through it goes nowhere
_NEAR = "127.0.0.1,localhost"


def viewer_command(*options: str) -> list[str]:
    """The words that run Rerun's own program, which is installed with its SDK.

    The program itself and not the Python module that starts it: a program that is ended would leave its child behind.

    Raises:
        MissingExtraError: it is not installed.
    """
    sdk()
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise MissingExtraError(f"Rerun's viewer is missing: {how_to_install('view')}")
    name = "rerun.exe" if platform.system() == "Windows" else "rerun"
    return [str(Path(found.origin).with_name(name)), *options]


def silent_environment(folder: Path, given: Mapping[str, str] | None = None, *, offline: bool = True) -> dict[str, str]:
    """Give an environment in which Rerun's program sends no usage data and writes to `folder` only.

    The program sends none after its own command `analytics disable`, which it keeps in its folder of settings: that is
    a folder of ours here, so that nothing is written to the home folder, and what a person has set there stays as is.
    It would still ask for its newest version and for examples; that goes to a proxy that is not there.

    Args:
        folder: an empty folder that lives as long as the program.
        given: the environment to begin with; None for this process's.
        offline: let the program reach this machine only.
    """
    environment = {**(os.environ if given is None else given), **dict.fromkeys(_FOLDERS, str(folder))}
    if offline:
        # both spellings are in use, and the small one counts more
        for name in _PROXIES:
            environment |= {name: _NOBODY, name.lower(): _NOBODY}
        environment |= {"NO_PROXY": _NEAR, "no_proxy": _NEAR}
    if platform.system() == "Darwin":
        environment["HOME"] = str(folder)
    subprocess.run(  # noqa: S603 - our own words
        viewer_command("analytics", "disable"),
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    return environment


_SERVER_MEMORY = "2GiB"  # what the browser's server holds for it; beyond that the earliest frames go
_PATIENCE = 30.0
_POLL = 0.05


@dataclass(frozen=True, slots=True)
class Viewer:
    """A viewer's program that runs.

    Attributes:
        sink: where it takes what is logged.
        address: where a browser finds it, or None of one with a window of its own.
    """

    process: "subprocess.Popen[bytes]"
    sink: str
    address: str | None


def has_screen(environment: Mapping[str, str] | None = None) -> bool:
    """Whether a window can be opened, as far as the environment reports."""
    if platform.system() in {"Darwin", "Windows"}:
        return True
    known = os.environ if environment is None else environment
    return bool(known.get("DISPLAY") or known.get("WAYLAND_DISPLAY"))


def show_view(
    sources: Sequence[Source],
    *,
    settings: ViewSettings | None = None,
    web: bool = False,
    ready: Callable[[Viewer], None] | None = None,
    progress: Progress | None = None,
) -> ViewReport:
    """Show drives in the viewer, and wait until it is closed.

    The viewer listens on this machine only, sends no usage data and writes nothing to the home folder.

    Args:
        sources: paths of recordings, scenes, …, scenes that are open, or parts of either; each is under a root of its
            own.
        web: in a browser instead of a window: until the program is interrupted.
        ready: reported when the viewer runs, before anything is logged.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        OptionError: an option cannot be followed, or there is no screen for a window.
        OutputError: the viewer does not start.
        UnknownFormatError: no format fits a path.
        DataError: a frame cannot be read.
    """
    sdk()
    if not web and not has_screen():
        raise OptionError(
            "there is no screen to open a window on; use `--save FILE.rrd` to keep the view in a file, or `--web` to "
            "look at it in a browser"
        )
    started = time.perf_counter()
    wanted = settings or ViewSettings()
    with (
        _opened_drives(sources, wanted, progress=progress) as views,
        _viewer(web=web, map_tiles=wanted.map_tiles) as viewer,
    ):
        if ready is not None:
            ready(viewer)
        recording = _new_recording(views)
        recording.connect_grpc(viewer.sink, default_blueprint=DriveView.layout(views))
        drives = _log_drives(views, recording, progress=progress)
        report = ViewReport(output=None, size_bytes=0, drives=drives, seconds=time.perf_counter() - started)
        _wait(viewer)
    return report


def _wait(viewer: Viewer) -> None:
    """Wait until the window is closed, or the program interrupted: all has been shown by then."""
    try:
        viewer.process.wait()
    except KeyboardInterrupt:
        return


@contextmanager
def _viewer(*, web: bool, map_tiles: bool) -> Iterator[Viewer]:
    """Start Rerun's program, and end it in the end."""
    port, page = _free_ports()
    options = ["--bind", _LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
    if web:
        options += ["--serve-web", "--web-viewer-port", str(page), "--server-memory-limit", _SERVER_MEMORY]
    else:
        options += ["--expect-data-soon"]
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="sceneloom-view-"))
        process = subprocess.Popen(  # noqa: S603 - our own words
            viewer_command(*options),
            env=silent_environment(Path(folder), offline=not map_tiles),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        stack.callback(_end, process)
        sink = f"rerun+http://{_LOOPBACK}:{port}/proxy"
        _await_port(process, port)
        if not web:
            yield Viewer(process, sink, None)
            return
        _await_port(process, page)
        guarded = stack.enter_context(guarded_page(page, port, map_tiles=map_tiles))
        query = f"url={quote(sink, safe=':/')}&hide_welcome_screen=1"
        yield Viewer(process, sink, f"http://{_LOOPBACK}:{guarded}/?{query}")


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(timeout=5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _free_ports() -> tuple[int, int]:
    """Two ports of this machine that nobody listens on."""
    with socket.create_server((_LOOPBACK, 0)) as one, socket.create_server((_LOOPBACK, 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]


def _await_port(process: "subprocess.Popen[bytes]", port: int) -> None:
    """Wait until the program listens."""
    deadline = time.monotonic() + _PATIENCE
    while process.poll() is None and time.monotonic() < deadline:
        try:
            socket.create_connection((_LOOPBACK, port), timeout=1.0).close()
        except OSError:
            time.sleep(_POLL)
        else:
            return
    reported = "ended at once" if process.poll() is not None else f"did not listen within {_PATIENCE:.0f} s"
    raise OutputError(
        f"Rerun's viewer {reported}; look at `{' '.join(viewer_command('--version'))}`, or state `--save`"
    )
