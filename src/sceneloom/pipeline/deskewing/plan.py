"""Which lidars of a scene are deskewed, by what, and the scene that comes of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.motion.ego_motion import find_ego_motion, is_computed, with_trajectory_estimated
from sceneloom.motion.inertial import imu_motion
from sceneloom.motion.one_moment import MOMENTS, DeskewedFrame, DeskewedFrames, Deskewer, typical_offset_ns
from sceneloom.motion.sensor_paths import sensor_path
from sceneloom.motion.trajectories import IMU
from sceneloom.pipeline.needed_lidar import check_has_lidar
from sceneloom.pipeline.play import Skips
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.part import cut_scene
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import points_source, sensor_source
from sceneloom.scene.span import scene_period_ns, sweep_period_ns
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, Progress, key_of

OURS, ENTRY = "sceneloom", "deskew"
"""Where a scene's metadata state how it was deskewed."""

_NO_GAPS = np.zeros((0, 2), np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class DeskewPlan:
    """A scene, which of its lidars are deskewed, and by what.

    Attributes:
        scene: as read, or a part of it.
        lidars: those to deskew.
        ego: the trajectory they are deskewed by; None where they go by poses of their own.
        gaps_ns: (G, 2) int64 [ns], between which times the trajectory is not known.
        at: the moment of each sweep that its points are brought to.
    """

    scene: Scene
    lidars: tuple[LidarSensor, ...]
    ego: EgoMotion | None
    gaps_ns: Int64Array
    at: str

    @property
    def trajectory(self) -> str | None:
        """Name of the ego trajectory."""
        return None if self.ego is None else self.ego.name

    def deskewed(self, on_frame: Callable[[Identifier, int, DeskewedFrame], None] | None = None) -> Scene:
        """Give the scene whose sweeps are deskewed when they are read; `on_frame` is reported each."""
        chosen = {key_of(sensor.id) for sensor in self.lidars}
        sensors = tuple(
            self._deskewed_lidar(sensor, on_frame)
            if isinstance(sensor, LidarSensor) and key_of(sensor.id) in chosen
            else sensor
            for sensor in self.scene.sensors
        )
        ours = self.scene.metadata.get(OURS)
        entries = [
            *_earlier(self.scene),
            {
                "lidars": [sensor.id for sensor in self.lidars],
                "trajectory": self.trajectory,
                "at": self.at,
                # the name of a folder may hold bytes that are no Unicode
                "source": Path(self.scene.source).name.encode(errors="replace").decode(),
            },
        ]
        scene = self.scene if self.ego is None else _reported(self.scene, self.ego)
        reported = {**(ours if isinstance(ours, Mapping) else {}), ENTRY: entries}
        metadata = MappingProxyType({**self.scene.metadata, OURS: reported})
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
        reported = None if on_frame is None else partial(on_frame, sensor.id)
        timestamps_ns = sensor.frames.timestamps_ns + offset_ns
        frames = LazyFrames(timestamps_ns, DeskewedFrames(sensor.frames, deskewer, reported))
        poses = sensor.poses
        if poses is not None and sensor.coordinates is Coordinates.WORLD and self.trajectory != IMU:
            poses = (
                sensor_path(sensor_source(self.scene, sensor, self.ego, reach_ns=reach_ns), timestamps_ns)
                or poses
            )
        return replace(sensor, frames=frames, poses=poses)


def _reported(scene: Scene, ego: EgoMotion) -> Scene:
    """The scene with what is to be stated of the ego trajectory.

    And with the trajectory where it was found from the sweeps.
    """
    if is_computed(scene, ego.name):
        return with_trajectory_estimated(scene, ego)
    return replace(scene, warnings=(*scene.warnings, *ego.warnings))


def plan_deskew(
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
) -> DeskewPlan:
    """Choose lidars, part and trajectory; the arguments are those of `deskew`.

    `skips` collects sweeps that cannot be read.

    Raises:
        OptionError: a value cannot be followed, or the scene was deskewed before.
        PoseError: the motion is not known.
        DataError: there is no lidar, or a sweep cannot be read and there are no `skips`.
    """
    if at not in MOMENTS:
        raise OptionError(f"at {at!r}; expected one of {', '.join(MOMENTS)}")
    scene = scene.corrected()
    _chosen_lidars(scene, lidar)
    part = cut_scene(scene, start=start, stop=stop)
    if skips is not None:
        part = _readable(part, skips)
    lidars = _chosen_lidars(part, lidar)
    if trajectory == IMU and IMU not in scene.trajectories:
        _check_on_ego(scene, lidars)
        motion = imu_motion(scene)
        return DeskewPlan(part, lidars, motion.ego, motion.gaps_ns, at)
    if trajectory is None and _all_placed(lidars):
        return DeskewPlan(part, lidars, None, _NO_GAPS, at)
    if trajectory is not None:
        _check_on_ego(scene, lidars)
    # a heading comes from the trajectory before the part, too
    whole = part if heading is None else scene
    ego = find_ego_motion(
        whole, name=trajectory, heading=heading, progress=progress, lenient=skips is not None
    )
    return DeskewPlan(part, lidars, ego, _NO_GAPS, at)


def _all_placed(lidars: tuple[LidarSensor, ...]) -> bool:
    """Whether each has poses in the world and no mounting, so that the ego trajectory says nothing about it."""
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
    """What the metadata state of earlier deskewing; whatever else stands in that location is passed over."""
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
