"""Deskewing as a step of its own: a scene in, the same scene with sweeps of one moment each out."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.formats.output import check_output
from sceneloom.formats.table import format_for_output, write_scene
from sceneloom.motion.ego_motion import Progress, find_ego_motion, is_computed, with_way_found
from sceneloom.motion.inertial import imu_motion
from sceneloom.motion.one_moment import MOMENTS, DeskewedFrame, DeskewedFrames, Deskewer, typical_offset_ns
from sceneloom.motion.sensor_paths import sensor_path
from sceneloom.motion.trajectories import IMU
from sceneloom.pipeline.deskew_report import DeskewReport, DeskewTally
from sceneloom.pipeline.play import Skips
from sceneloom.pipeline.report import told_once
from sceneloom.scene import (
    Coordinates,
    Identifier,
    LazyFrames,
    LidarFrame,
    LidarSensor,
    PointsFrame,
    Scene,
)
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.part import cut_scene
from sceneloom.scene.sensor_sources import points_source, sensor_source
from sceneloom.scene.span import scene_period_ns, sweep_period_ns

OURS, ENTRY = "sceneloom", "deskew"
"""Where a scene's metadata say how it was deskewed."""

_NO_GAPS = np.zeros((0, 2), np.int64)


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
        trajectory: name of the ego's way, "identity", "lidar" to find it from the sweeps, "imu" to undo only the
            turning that the IMU tells, or None for the scene's default.
        heading: "motion" to derive orientations where the trajectory has positions only.
        at: the moment of each sweep that its points are brought to: "start", "middle" or "end".
        lidar: id of the only lidar to deskew; None for all whose points are not in the world.
        start: seconds after the scene's first time stamp, None for the beginning.
        stop: seconds after it, exclusive, None for the end.
        lenient: leave out sweeps that cannot be read, and count them.
        progress: told after each sweep.
        overwrite: whether an output that exists may be replaced.
        writing: further options of the output's format.

    Returns:
        What was done, in numbers, with all losses and notices.

    Raises:
        OptionError: a value cannot be followed, or the scene was deskewed before.
        PoseError: the motion is not known.
        DataError: there is no lidar, or a sweep cannot be read.
        OutputError: the output exists, or cannot be written.
    """
    begun = time.perf_counter()
    # finding the motion may take long: an output that cannot be is told before
    format_for_output(Path(output))
    check_output(Path(output), overwrite=overwrite)
    skips, tally = Skips(), DeskewTally()
    plan = _plan(
        scene,
        trajectory,
        heading,
        at=at,
        lidar=lidar,
        start=start,
        stop=stop,
        skips=skips if lenient else None,
        progress=progress,
    )
    total = sum(len(sensor.frames) for sensor in plan.lidars)
    changed = plan.deskewed(partial(tally.add, progress=progress, total=total))
    losses = write_scene(changed, output, overwrite=overwrite, **writing)
    return DeskewReport(
        source=scene.source,
        output=str(output),
        trajectory=plan.way,
        at=at,
        lidars=tuple(sensor.id for sensor in plan.lidars),
        sweeps=total + len(skips.reasons),
        deskewed=tally.deskewed,
        extrapolated=tally.extrapolated,
        left=tally.left,
        skipped=tuple(skips.reasons),
        points=tally.points,
        mean_shift=tally.shifted / tally.points if tally.points else 0.0,
        max_shift=tally.farthest,
        seconds=time.perf_counter() - begun,
        losses=losses,
        notices=told_once(changed.notices, tally.times.notices()),
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

    Points stay in their frame, as if all of a sweep had been measured at its new time stamp. When each was measured
    stands in the further array `measured_timestamps_ns` of the points.

    Raises:
        OptionError: a value cannot be followed, or the scene was deskewed before.
        PoseError: the motion is not known.
        DataError: there is no lidar.
    """
    return _plan(scene, trajectory, heading, at=at, lidar=lidar).deskewed()


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """A scene, which of its lidars are deskewed, and by what."""

    scene: Scene
    lidars: tuple[LidarSensor, ...]
    ego: EgoMotion | None
    gaps_ns: Int64Array
    at: str

    @property
    def way(self) -> str | None:
        return None if self.ego is None else self.ego.name

    def deskewed(self, on_frame: Callable[[Identifier, int, DeskewedFrame], None] | None = None) -> Scene:
        chosen = {(type(sensor.id), sensor.id) for sensor in self.lidars}
        sensors = tuple(
            self._deskewed_lidar(sensor, on_frame)
            if isinstance(sensor, LidarSensor) and (type(sensor.id), sensor.id) in chosen
            else sensor
            for sensor in self.scene.sensors
        )
        ours = self.scene.metadata.get(OURS)
        entries = [
            *_earlier(self.scene),
            {
                "lidars": [sensor.id for sensor in self.lidars],
                "trajectory": self.way,
                "at": self.at,
                # the name of a folder may hold bytes that are no Unicode
                "source": Path(self.scene.source).name.encode(errors="replace").decode(),
            },
        ]
        scene = self.scene if self.ego is None else _told(self.scene, self.ego)
        told = {**(ours if isinstance(ours, Mapping) else {}), ENTRY: entries}
        metadata = MappingProxyType({**self.scene.metadata, OURS: told})
        return replace(scene, sensors=sensors, metadata=metadata)

    def _deskewed_lidar(
        self, sensor: LidarSensor, on_frame: Callable[[Identifier, int, DeskewedFrame], None] | None
    ) -> LidarSensor:
        reach_ns, period_ns = scene_period_ns(self.scene), sweep_period_ns(sensor)
        source = points_source(self.scene, sensor, self.ego, reach_ns=reach_ns)
        if source is None:
            raise OptionError(_in_world(self.scene, sensor))
        offset_ns = typical_offset_ns(sensor.frames, period_ns, self.at)
        deskewer = Deskewer(source, period_ns, offset_ns, self.gaps_ns)
        told = None if on_frame is None else partial(on_frame, sensor.id)
        stamps_ns = sensor.frames.timestamps_ns + offset_ns
        frames = LazyFrames(stamps_ns, DeskewedFrames(sensor.frames, deskewer, told))
        poses = sensor.poses
        if poses is not None and sensor.coordinates is Coordinates.WORLD and self.way != IMU:
            poses = (
                sensor_path(sensor_source(self.scene, sensor, self.ego, reach_ns=reach_ns), stamps_ns)
                or poses
            )
        return replace(sensor, frames=frames, poses=poses)


def _told(scene: Scene, ego: EgoMotion) -> Scene:
    """The scene with what is to be said of the ego's way, and with the way where it was found from the sweeps."""
    if is_computed(scene, ego.name):
        return with_way_found(scene, ego)
    return replace(scene, notices=(*scene.notices, *ego.notices))


def _plan(
    scene: Scene,
    trajectory: str | None,
    heading: str | None,
    *,
    at: str,
    lidar: Identifier | None,
    start: float | None = None,
    stop: float | None = None,
    skips: Skips | None = None,
    progress: Progress | None = None,
) -> _Plan:
    if at not in MOMENTS:
        raise OptionError(f"at {at!r}; expected one of {', '.join(MOMENTS)}")
    _chosen_lidars(scene, lidar)
    part = cut_scene(scene, start=start, stop=stop)
    if skips is not None:
        part = _readable(part, skips)
    lidars = _chosen_lidars(part, lidar)
    if trajectory == IMU and IMU not in scene.trajectories:
        _check_on_ego(scene, lidars)
        motion = imu_motion(scene)
        return _Plan(part, lidars, motion.ego, motion.gaps_ns, at)
    if trajectory is None and _all_placed(lidars):
        return _Plan(part, lidars, None, _NO_GAPS, at)
    if trajectory is not None:
        _check_on_ego(scene, lidars)
    # a heading comes from the way before the part, too
    whole = part if heading is None else scene
    ego = find_ego_motion(
        whole, name=trajectory, heading=heading, progress=progress, lenient=skips is not None
    )
    return _Plan(part, lidars, ego, _NO_GAPS, at)


def _all_placed(lidars: tuple[LidarSensor, ...]) -> bool:
    """Whether each has poses in the world and no mounting, so that the ego's way says nothing about it."""
    return all(
        sensor.points_frame is PointsFrame.SENSOR
        and sensor.mount is None
        and sensor.poses is not None
        and sensor.coordinates is Coordinates.WORLD
        for sensor in lidars
    )


def _check_on_ego(scene: Scene, lidars: tuple[LidarSensor, ...]) -> None:
    for sensor in lidars:
        on_ego = sensor.poses is not None and sensor.coordinates is Coordinates.EGO
        if sensor.mount is None and sensor.points_frame is PointsFrame.SENSOR and not on_ego:
            raise PoseError(
                f"{scene.source}: it is not known how lidar {sensor.id!r} is mounted on the ego, so the ego's way "
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
        asked = scene.lidars
    if not asked:
        raise DataError(scene.source, "", "no lidar in it; deskewing needs one")
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
    """What the metadata say of earlier deskewing; whatever else stands in that place is passed over."""
    ours = scene.metadata.get(OURS)
    entries = ours.get(ENTRY) if isinstance(ours, Mapping) else None
    if not isinstance(entries, list):
        return []
    return [
        entry for entry in entries if isinstance(entry, Mapping) and isinstance(entry.get("lidars"), list)
    ]


def _in_world(scene: Scene, sensor: LidarSensor) -> str:
    return (
        f"{scene.source}: the points of lidar {sensor.id!r} are in the world already, each brought there by its own "
        "time; there is nothing to deskew"
    )


def _readable(scene: Scene, skips: Skips) -> Scene:
    """Leave out the sweeps that cannot be read, which takes reading them all."""
    return replace(
        scene,
        sensors=tuple(
            replace(sensor, frames=_readable_frames(sensor, skips))
            if isinstance(sensor, LidarSensor)
            else sensor
            for sensor in scene.sensors
        ),
    )


def _readable_frames(sensor: LidarSensor, skips: Skips) -> LazyFrames[LidarFrame]:
    rows = []
    for k in range(len(sensor.frames)):
        try:
            sensor.frames[k]
        except DataError as error:
            skips.add(error)
        else:
            rows.append(k)
    if len(rows) == len(sensor.frames):
        return sensor.frames
    return LazyFrames(sensor.frames.timestamps_ns[rows], partial(_read_row, sensor.frames, rows))


def _read_row(frames: LazyFrames[LidarFrame], rows: list[int], k: int) -> LidarFrame:
    return frames[rows[k]]
