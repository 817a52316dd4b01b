"""The deskew job: the same scene, each sweep corrected to one timestamp."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float32Array, Int64Array, spread_rows
from sceneloom.editing.references import ours_of, with_ours
from sceneloom.errors import DataError, OptionError, PoseError, check_choice
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.registry import check_scene_output, write_scene
from sceneloom.motion.deskew import BodyKnots, PointTimesStatistics
from sceneloom.motion.ego_trajectory import IMU, find_ego_motion, is_computed, with_trajectory_estimated
from sceneloom.motion.imu import imu_motion
from sceneloom.pipeline.play import Skips, check_has_lidar, report_of, reported_once, telling
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion, points_source, sensor_path, sensor_source
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.point_times import LONGEST_LAG_NS, RawTimes, TimesFound, timed_frame
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.scene import Scene, scene_period_ns, sweep_period_ns
from sceneloom.scene.time_range import cut_scene
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, Progress, key_of
from sceneloom.warnings import DataWarning

MEASURED = "measured_timestamps_ns"
"""Name of the additional array of a deskewed sweep's points with the time when each was measured [ns]."""

LEFT_SKEWED = "left_skewed"
"""Name of the additional field of a sweep with the reason why it could not be deskewed."""

_EMPTY = "no points"
_INSTANT = "all points of one time"
_UNTIMED_POINTS = "no times of the points"
_IN_GAP = "in a gap of the measured motion"
_BEYOND = "beyond the trajectory"  # why a sweep is left as it is


def _median_ns(times_ns: Int64Array) -> int:
    middle = len(times_ns) // 2
    return int(np.partition(times_ns, middle)[middle])


_MOMENTS: Mapping[str, Callable[[Int64Array], int]] = MappingProxyType(
    {"start": lambda times_ns: int(times_ns.min()), "middle": _median_ns, "end": lambda times_ns: int(times_ns.max())}
)
"""The moments of a sweep that its points can be deskewed to, by its point times (N,) int64 [ns], N >= 1."""

_SAMPLED_SWEEPS = 5  # sweeps from which the usual location of the timestamp within a sweep is taken


@dataclass(frozen=True, slots=True, eq=False)
class _DeskewedFrame:
    """A sweep as if all its points had been measured at once."""

    frame: LidarFrame  # points in their original frame, at the frame's time; as measured where `left` gives the reason
    times: TimesFound  # how the times of its points were read
    shifts: Float32Array  # (N,) [m], how far each point was moved; none where it was left
    raw: RawTimes | None = None  # what reading the next sweep's times may need
    extrapolated: bool = False  # whether poses beyond the trajectory's ends were used
    left: str | None = None  # why it was left as it was


@dataclass(frozen=True, slots=True, eq=False)
class _Deskewer:
    """Deskews a lidar's sweeps to one moment each; the points stay in their original frame."""

    source: PoseSource  # transforms the points as stored into the world
    period_ns: int  # from sweep to sweep
    offset_ns: int  # from a sweep's timestamp to the moment that it is deskewed to
    gaps_ns: Int64Array  # (G, 2) [ns], between which the motion is unknown

    def deskew(self, frame: LidarFrame, *, previous: RawTimes | None = None) -> _DeskewedFrame:
        """Deskew one sweep, if its points have times and the motion at these times is known."""
        timed = timed_frame(frame, self.period_ns, previous=previous)
        moment_ns = frame.timestamp_ns + self.offset_ns
        measured = timed.frame.point_times_ns
        knots = self._knots(timed.frame, moment_ns)
        # the file's own time of a sweep no longer holds where its timestamp moves
        extras = {name: value for name, value in timed.frame.extras.items() if name != "file_seconds"}
        if isinstance(knots, str):
            # left as measured: the timestamp moves like those of the others, the points keep their times
            if knots not in {_INSTANT, _EMPTY}:
                extras[LEFT_SKEWED] = knots
            points = replace(timed.frame.points, timestamps_ns=measured)
            left = LidarFrame(moment_ns, points, MappingProxyType(extras))
            return _DeskewedFrame(left, timed.found, np.zeros(0, np.float32), timed.raw, left=knots)
        at_moment = knots.seen_at(self.source, moment_ns)
        positions = at_moment.moved(frame.points.positions, measured, self.source.mount).astype(np.float32)
        apart = positions - frame.points.positions
        columns = {name: array for name, array in timed.frame.points.extras.items() if name != "file_seconds"}
        points = replace(
            timed.frame.points,
            positions=positions,
            timestamps_ns=np.full(len(measured), moment_ns, np.int64),
            extras=MappingProxyType({**columns, MEASURED: measured}),
        )
        moved = LidarFrame(moment_ns, points, MappingProxyType(extras))
        shifts = np.sqrt(np.einsum("ij,ij->i", apart, apart))
        return _DeskewedFrame(moved, timed.found, shifts, timed.raw, knots.extrapolated)

    def _knots(self, frame: LidarFrame, moment_ns: int) -> BodyKnots | str:
        """The poses over a sweep and the moment that it is deskewed to, or why it stays as it is."""
        times = frame.points.timestamps_ns
        if len(frame.points) == 0:
            return _EMPTY
        if times is None:
            return _UNTIMED_POINTS
        if times.min() == times.max():
            return _INSTANT
        first_ns, last_ns = int(times.min(initial=moment_ns)), int(times.max(initial=moment_ns))
        if ((self.gaps_ns[:, 0] < last_ns) & (self.gaps_ns[:, 1] > first_ns)).any():
            return _IN_GAP
        try:
            return BodyKnots.of(self.source, first_ns, last_ns)
        except PoseError:
            return _BEYOND


class _DeskewedFrames:
    """Reads sweeps and deskews them, as `LazyFrames` asks for a lidar's frames.

    It keeps the point times of the sweep that it read last, which help to interpret those of the next one.
    """

    def __init__(
        self,
        frames: LazyFrames[LidarFrame],
        deskewer: _Deskewer,
        on_frame: Callable[[int, _DeskewedFrame], None] | None = None,
    ) -> None:
        """Hold the sweeps as measured; `on_frame` is called with each one after it was deskewed."""
        self._frames, self._deskewer, self._on_frame = frames, deskewer, on_frame
        self._last: tuple[int, RawTimes | None] = (-1, None)

    def __call__(self, k: int) -> LidarFrame:
        """Deskew sweep `k`.

        Raises:
            DataError: it cannot be read.
        """
        frame = self._frames[k]
        deskewed = self._deskewer.deskew(frame, previous=self._previous(k, frame))
        self._last = (k, deskewed.raw)
        if self._on_frame is not None:
            self._on_frame(k, deskewed)
        return deskewed.frame

    def _previous(self, k: int, frame: LidarFrame) -> RawTimes | None:
        """Of the sweep before; it is read again only where its times may be needed, near the clock's zero."""
        if self._last[0] == k - 1:
            return self._last[1]
        if k == 0 or abs(frame.timestamp_ns) > LONGEST_LAG_NS:
            return None
        try:
            return timed_frame(self._frames[k - 1], self._deskewer.period_ns).raw
        except DataError:
            return None


def _typical_offset_ns(frames: LazyFrames[LidarFrame], period_ns: int, at: str) -> int:
    """Median time [ns] from a sweep's timestamp to one of its `_MOMENTS`, by a few sweeps; 0 without point times."""
    # one offset for all keeps their moments as even as their timestamps are, and known without reading them
    offsets = []
    for k in spread_rows(len(frames), _SAMPLED_SWEEPS, nearest=False).tolist():
        try:
            frame, previous = frames[k], frames[k - 1] if k else None
        except DataError:
            continue
        raw = None if previous is None else timed_frame(previous, period_ns).raw
        times = timed_frame(frame, period_ns, previous=raw).frame.points.timestamps_ns
        if times is not None and len(times):
            offsets.append(_MOMENTS[at](times) - frame.timestamp_ns)
    # whole microseconds: where the timestamps are such, the moments can be written as exactly
    return round(float(np.median(offsets)) / 1000) * 1000 if offsets else 0


class DeskewReport(msgspec.Struct, frozen=True, kw_only=True):
    """One deskewing.

    Attributes:
        trajectory: name of the ego trajectory, or None where the lidars' own poses were used.
        at: the moment of each sweep that its points were brought to: "start", "middle" or "end".
        sweeps: how many they have.
        deskewed: sweeps whose points were brought to one moment.
        extrapolated: those of them that needed poses beyond the trajectory's ends.
        left: why the others stayed as they were, with counts.
        skipped: sweeps that could not be read, one line each.
        points: points of the deskewed sweeps whose location is a number.
        mean_shift, max_shift: how far these were moved [m].
    """

    source: str
    output: str
    trajectory: str | None
    at: str
    lidars: tuple[Identifier, ...]
    sweeps: int
    deskewed: int
    extrapolated: int
    left: dict[str, int]
    skipped: tuple[str, ...]
    points: int
    mean_shift: float
    max_shift: float
    seconds: float
    losses: LossReport
    warnings: tuple[DataWarning, ...]


@dataclass(slots=True)
class _DeskewStatistics:
    """Counts what became of the sweeps, under the names of `DeskewReport`; each once, however often it is read."""

    deskewed: int = 0
    extrapolated: int = 0
    points: int = 0
    shifted: float = 0.0
    max_shift: float = 0.0
    left: dict[str, int] = field(default_factory=dict)
    times: PointTimesStatistics = field(default_factory=PointTimesStatistics)
    seen: set[tuple[type, Identifier, int]] = field(default_factory=set)

    def add(
        self, sensor_id: Identifier, k: int, frame: _DeskewedFrame, *, progress: Progress | None, total: int
    ) -> None:
        """Count sweep `k` of a sensor, and report how many of all are done."""
        key = (type(sensor_id), sensor_id, k)
        if key in self.seen:
            return
        self.seen.add(key)
        self.times.add(frame.times)
        if frame.left is not None:
            self.left[frame.left] = self.left.get(frame.left, 0) + 1
        else:
            shifts = frame.shifts[np.isfinite(frame.shifts)]
            self.deskewed += 1
            self.extrapolated += frame.extrapolated
            self.points += len(shifts)
            self.shifted += float(shifts.sum())
            self.max_shift = max(self.max_shift, float(shifts.max(initial=0.0)))
        if progress is not None:
            progress(len(self.seen), total)


@dataclass(frozen=True, slots=True, eq=False)
class _DeskewPlan:
    """A scene, which of its lidars are deskewed, and by what."""

    scene: Scene
    lidars: tuple[LidarSensor, ...]
    ego: EgoMotion | None  # None where they go by poses of their own
    at: str  # the moment of each sweep that its points are brought to
    gaps_ns: Int64Array = field(default_factory=lambda: np.zeros((0, 2), np.int64))  # (G, 2), without trajectory

    @property
    def trajectory(self) -> str | None:
        """Name of the ego trajectory."""
        return None if self.ego is None else self.ego.name

    def deskewed(self, on_frame: Callable[[Identifier, int, _DeskewedFrame], None] | None = None) -> Scene:
        """Give the scene whose sweeps are deskewed when they are read; `on_frame` gets each."""
        chosen = {key_of(sensor.id) for sensor in self.lidars}
        sensors = tuple(
            self._deskewed_lidar(sensor, on_frame)
            if isinstance(sensor, LidarSensor) and key_of(sensor.id) in chosen
            else sensor
            for sensor in self.scene.sensors
        )
        entry = {
            "lidars": [sensor.id for sensor in self.lidars],
            "trajectory": self.trajectory,
            "at": self.at,
            # the name of a folder may hold bytes that are no Unicode
            "source": Path(self.scene.source).name.encode(errors="replace").decode(),
        }
        scene = self.scene
        if self.ego is not None:
            scene = replace(scene, warnings=(*scene.warnings, *self.ego.warnings))
            if is_computed(self.scene, self.ego.name):
                scene = with_trajectory_estimated(self.scene, self.ego)
        return with_ours(replace(scene, sensors=sensors), deskew=[*_earlier(self.scene), entry])

    def _deskewed_lidar(
        self, sensor: LidarSensor, on_frame: Callable[[Identifier, int, _DeskewedFrame], None] | None
    ) -> LidarSensor:
        reach_ns, period_ns = scene_period_ns(self.scene), sweep_period_ns(sensor)
        source = points_source(self.scene, sensor, self.ego, reach_ns=reach_ns)
        if source is None:
            raise OptionError(_in_world(self.scene, sensor))
        offset_ns = _typical_offset_ns(sensor.frames, period_ns, self.at)
        deskewer = _Deskewer(source, period_ns, offset_ns, self.gaps_ns)
        reported = None if on_frame is None else partial(on_frame, sensor.id)
        timestamps_ns = sensor.frames.timestamps_ns + offset_ns
        frames = LazyFrames(timestamps_ns, _DeskewedFrames(sensor.frames, deskewer, reported))
        poses = sensor.poses
        if poses is not None and sensor.coordinates is Coordinates.WORLD and self.trajectory != IMU:
            poses = sensor_path(sensor_source(self.scene, sensor, self.ego, reach_ns=reach_ns), timestamps_ns) or poses
        return replace(sensor, frames=frames, poses=poses)


def _plan_deskew(
    scene: Scene,
    trajectory: str | None,
    heading: str | None,
    *,
    at: str,
    lidar: Identifier | None,
    start: float | None = None,
    stop: float | None = None,
    skips: Skips,
    progress: Progress | None = None,
) -> _DeskewPlan:
    """Choose lidars, part and trajectory; the arguments are those of `deskew`."""
    check_choice("at", at, _MOMENTS)
    scene = scene.corrected()
    _chosen_lidars(scene, lidar)
    part = cut_scene(scene, start=start, stop=stop)
    if skips.lenient:
        sensors = [_readable(sensor, skips) if isinstance(sensor, LidarSensor) else sensor for sensor in part.sensors]
        part = replace(part, sensors=tuple(sensors))
    lidars = _chosen_lidars(part, lidar)
    if trajectory == IMU and IMU not in scene.trajectories:
        _check_on_ego(scene, lidars)
        motion = imu_motion(scene)
        return _DeskewPlan(part, lidars, motion.ego, at, motion.gaps_ns)
    # where each has poses in the world and no mounting, the ego trajectory says nothing about it
    if trajectory is None and all(
        sensor.points_frame is PointsFrame.SENSOR
        and sensor.mount is None
        and sensor.poses is not None
        and sensor.coordinates is Coordinates.WORLD
        for sensor in lidars
    ):
        return _DeskewPlan(part, lidars, None, at)
    if trajectory is not None:
        _check_on_ego(scene, lidars)
    # a heading comes from the trajectory before the part, too
    whole = part if heading is None else scene
    ego = find_ego_motion(whole, name=trajectory, heading=heading, progress=progress, lenient=skips.lenient)
    return _DeskewPlan(part, lidars, ego, at)


def _readable(sensor: LidarSensor, skips: Skips) -> LidarSensor:
    """The lidar without the sweeps that cannot be read, which takes reading them all."""
    rows = []
    for k in range(len(sensor.frames)):
        try:
            sensor.frames[k]
        except DataError as error:
            skips.add(error)
        else:
            rows.append(k)
    return replace(sensor, frames=sensor.frames.chosen(np.array(rows, np.int64)))


def _check_on_ego(scene: Scene, lidars: tuple[LidarSensor, ...]) -> None:
    for sensor in lidars:
        on_ego = sensor.poses is not None and sensor.coordinates is Coordinates.EGO
        if sensor.mount is None and sensor.points_frame is PointsFrame.SENSOR and not on_ego:
            raise PoseError(
                f"{scene.source}: it is not known how lidar {sensor.id!r} is mounted on the ego, so the ego trajectory "
                "cannot deskew it; leave the trajectory out to use the poses that the lidar has of its own"
            )


def _chosen_lidars(scene: Scene, lidar: Identifier | None) -> tuple[LidarSensor, ...]:
    """The lidars to deskew: not those whose points are in the world, unless one is asked for, which is an error."""
    if lidar is not None:
        sensor = scene.sensor(lidar)
        if not isinstance(sensor, LidarSensor):
            raise OptionError(f"{scene.source}: sensor {lidar!r} is a {sensor.type}; expected a lidar")
        asked: tuple[LidarSensor, ...] = (sensor,)
    else:
        check_has_lidar(scene, "deskewing needs")
        asked = scene.lidars
    lidars = tuple(sensor for sensor in asked if sensor.points_frame is not PointsFrame.WORLD)
    if not lidars:
        raise OptionError(_in_world(scene, asked[0]))
    for sensor in lidars:
        for entry in _earlier(scene):
            if sensor.id in entry["lidars"]:
                raise OptionError(
                    f"{scene.source}: lidar {sensor.id!r} was deskewed before, by {entry.get('trajectory')} at the "
                    f"{entry.get('at')} of its sweeps; deskew the drive as it was measured"
                )
    return lidars


def _earlier(scene: Scene) -> list[Mapping[str, Any]]:
    """What the metadata say of earlier deskewing; anything else in that entry is ignored."""
    entries = ours_of(scene).get("deskew")
    if not isinstance(entries, list):
        return []
    return [entry for entry in entries if isinstance(entry, Mapping) and isinstance(entry.get("lidars"), list)]


def _in_world(scene: Scene, sensor: LidarSensor) -> str:
    return (
        f"{scene.source}: the points of lidar {sensor.id!r} are in the world already, each brought there by its own "
        "time; there is nothing to deskew"
    )


def deskew(
    scene: Scene, output: str | Path, *, trajectory: str | None = None, heading: str | None = None, at: str = "middle",
    lidar: Identifier | None = None, start: float | None = None, stop: float | None = None, lenient: bool = False,
    progress: Progress | None = None, overwrite: bool = False, **writing: Any,
) -> DeskewReport:  # fmt: skip
    """Undo the motion during each lidar sweep, and write the scene with the deskewed sweeps.

    Args:
        output: a scene file or a recording, by its suffix.
        trajectory: name of the ego trajectory, "identity", "lidar" to find it from the sweeps, "imu" to undo only the
            rotating that the IMU reports, or None for the scene's default.
        heading: "motion" to derive orientations where the trajectory has positions only.
        at: the moment of each sweep that its points are brought to: "start", "middle" or "end".
        lidar: id of the only lidar to deskew; None for all whose points are not in the world.
        start: seconds after the scene's first timestamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        lenient: leave out sweeps that cannot be read, and count them.
        writing: further options of the output's format.

    Returns:
        What was done, in numbers, with all losses and warnings.

    Raises:
        OptionError: a value cannot be followed, or the scene was deskewed before.
        PoseError: the motion is not known.
        DataError: there is no lidar, or a sweep cannot be read.
        OutputError: the output exists, or cannot be written.
    """
    begun = time.perf_counter()
    # finding the motion may take long: an output that cannot be is reported before
    check_scene_output(Path(output), overwrite=overwrite)
    skips, statistics = Skips(lenient), _DeskewStatistics()
    with telling(skips):
        part: dict[str, Any] = {"start": start, "stop": stop, "skips": skips, "progress": progress}
        plan = _plan_deskew(scene, trajectory, heading, at=at, lidar=lidar, **part)
        total = sum(len(sensor.frames) for sensor in plan.lidars)
        changed = plan.deskewed(partial(statistics.add, progress=progress, total=total))
        losses = write_scene(changed, output, overwrite=overwrite, **writing)
    return report_of(
        DeskewReport,
        statistics,
        source=scene.source,
        output=str(output),
        trajectory=plan.trajectory,
        at=at,
        lidars=tuple(sensor.id for sensor in plan.lidars),
        sweeps=total + len(skips.reasons),
        skipped=skips.reasons,
        mean_shift=statistics.shifted / statistics.points if statistics.points else 0.0,
        seconds=time.perf_counter() - begun,
        losses=losses,
        warnings=reported_once(changed.warnings, statistics.times.warnings()),
    )


def deskewed_scene(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    at: str = "middle",
    lidar: Identifier | None = None,
) -> Scene:
    """Give the scene with sweeps that are deskewed when they are read; the arguments are those of `deskew`.

    Points stay in their frame, as if all of a sweep had been measured at its new timestamp. When each was measured
    stands in the further array `measured_timestamps_ns` of the points.

    Raises:
        OptionError: a value cannot be followed, or the scene was deskewed before.
        PoseError: the motion is not known.
        DataError: there is no lidar.
    """
    skips = Skips(lenient=False)
    return _plan_deskew(scene, trajectory, heading, at=at, lidar=lidar, skips=skips).deskewed()
