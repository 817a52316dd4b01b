"""The deskew job: the same scene, each sweep corrected to one timestamp."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.references import ours_of, with_ours
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.registry import check_scene_output, write_scene
from sceneloom.motion.deskew import (
    MOMENTS,
    DeskewedFrame,
    DeskewedFrames,
    Deskewer,
    PointTimesStatistics,
    typical_offset_ns,
)
from sceneloom.motion.ego_trajectory import IMU, find_ego_motion, is_computed, with_trajectory_estimated
from sceneloom.motion.imu import imu_motion
from sceneloom.pipeline.play import Skips, check_has_lidar, report_of, reported_once, telling
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.ego import EgoMotion, points_source, sensor_path, sensor_source
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, scene_period_ns, sweep_period_ns
from sceneloom.scene.time_range import cut_scene
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, Progress, key_of
from sceneloom.warnings import DataWarning


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
        self, sensor_id: Identifier, k: int, frame: DeskewedFrame, *, progress: Progress | None, total: int
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

    def deskewed(self, on_frame: Callable[[Identifier, int, DeskewedFrame], None] | None = None) -> Scene:
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
        self, sensor: LidarSensor, on_frame: Callable[[Identifier, int, DeskewedFrame], None] | None
    ) -> LidarSensor:
        reach_ns, period_ns = scene_period_ns(self.scene), sweep_period_ns(sensor)
        source = points_source(self.scene, sensor, self.ego, reach_ns=reach_ns)
        if source is None:
            raise OptionError(_in_world(self.scene, sensor))
        offset_ns = typical_offset_ns(sensor.frames, period_ns, self.at)
        deskewer = Deskewer(source, period_ns, offset_ns, self.gaps_ns)
        reported = None if on_frame is None else partial(on_frame, sensor.id)
        timestamps_ns = sensor.frames.timestamps_ns + offset_ns
        frames = LazyFrames(timestamps_ns, DeskewedFrames(sensor.frames, deskewer, reported))
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
    if at not in MOMENTS:
        raise OptionError(f"at {at!r}; expected one of {', '.join(MOMENTS)}")
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
    scene: Scene,
    output: str | Path,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    at: str = "middle",
    lidar: Identifier | None = None,
    start: float | None = None,
    stop: float | None = None,
    lenient: bool = False,
    progress: Progress | None = None,
    overwrite: bool = False,
    **writing: Any,
) -> DeskewReport:
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
