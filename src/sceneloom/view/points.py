"""Lidar sweeps, radar frames and maps of points, and their colours."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, FloatArray, UInt8Array
from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.deskew import points_at
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.ego import ego_path
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import scene_period_ns, sweep_period_ns
from sceneloom.scene.types import PointsFrame
from sceneloom.view.poses import Locations, pose_at, transform
from sceneloom.view.settings import ColourBy
from sceneloom.view.stream import Report, Stream, fits, sdk
from sceneloom.visualization.colour_scales import colour_map

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


def one_packed(rgb: tuple[int, int, int], *, alpha: int = 255) -> int:
    """Pack one colour."""
    return (rgb[0] << 24) | (rgb[1] << 16) | (rgb[2] << 8) | alpha


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


WORLD, SENSORS, _CLOUDS = "world", "sensors", "clouds"
"""Entities below which things are: all that has a location, frames of sensors, points that are not in such a frame."""
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
class LidarView:
    """Shows the sweeps of one lidar.

    Attributes:
        colour_by: what gives the points their colours; None: the best that there is.
        as_measured: leave the motion during a sweep in.
        notify: of what could not be shown.
    """

    stream: Stream
    locations: Locations
    lidar: LidarSensor
    colour_by: ColourBy | None
    as_measured: bool
    notify: Report
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
class RadarView:
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
        held = fits(positions) & fits(rotated)
        self.stream.leave_out("radar points", np.count_nonzero(~held))
        positions, rotated = positions[held], rotated[held]
        colours = np.where((rotated * positions).sum(axis=1) < 0, _NEARING, _LEAVING).astype(np.uint32)
        shown = rr.Points3D(positions, colors=colours, radii=_ui_points(_RADAR_SIZE))
        self.stream.log(time_ns, f"{entity}/points", shown, kind="radar cycles", size=16 * len(points))
        arrows = rr.Arrows3D(vectors=rotated, origins=positions, colors=colours, radii=_ui_points(_ARROW_SIZE))
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


def show_map(stream: Stream, locations: Locations, sensor: PointsSensor) -> None:
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
