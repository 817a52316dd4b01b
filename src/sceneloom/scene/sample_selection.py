"""Which sensors of a scene a sample holds."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import Posed
from sceneloom.scene.shooting import ShootingSensor
from sceneloom.scene.span import sweep_period_ns, usual_period_ns
from sceneloom.scene.types import Identifier, key_of

ALL = "all"

Choice = Identifier | Iterable[Identifier]
"""Sensors of one kind: "all", one id, or several."""

Kind = TypeVar("Kind", LidarSensor, CameraSensor, RadarSensor, DepthCameraSensor)


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """What was asked for.

    Attributes:
        scene: the scene.
        reference: the sensor whose frames are counted.
        lidars: whose sweeps are looked for, the one of `Sample.sweep` first.
        cameras, depth_cameras, radars: whose images, depth images and frames are looked for.
        trajectory: name of the ego trajectory, the trajectory itself, or None for the default.
        tolerance_ns: how far from the moment a frame may be [ns].
    """

    scene: Scene
    reference: LidarSensor | CameraSensor
    lidars: tuple[LidarSensor, ...]
    cameras: tuple[CameraSensor, ...]
    depth_cameras: tuple[DepthCameraSensor, ...]
    radars: tuple[RadarSensor, ...]
    trajectory: str | EgoMotion | None
    tolerance_ns: int

    @property
    def shooting(self) -> tuple[ShootingSensor, ...]:
        """The cameras of colours, then those of depths."""
        return self.cameras + self.depth_cameras


def select(
    scene: Scene,
    *,
    reference: Identifier,
    lidars: Choice | None,
    cameras: Choice,
    depth_cameras: Choice,
    radars: Choice,
    trajectory: str | EgoMotion | None,
    tolerance_ns: int | None,
) -> Selection:
    """Find the sensors that were asked for.

    Raises:
        OptionError: the scene has no such sensor, or the tolerance is negative.
    """
    counted = _reference(scene, reference)
    if tolerance_ns is not None and tolerance_ns < 0:
        raise OptionError(f"tolerance {tolerance_ns} ns; expected 0 or more")
    if lidars is None:
        lidars = () if isinstance(counted, LidarSensor) else [lidar.id for lidar in scene.lidars[:1]]
    chosen_lidars = chosen_sensors(scene, "lidar", scene.lidars, lidars)
    chosen_cameras = chosen_sensors(scene, "camera", scene.cameras, cameras)
    if isinstance(counted, LidarSensor):
        chosen_lidars = (counted, *(lidar for lidar in chosen_lidars if lidar is not counted))
    elif not any(camera is counted for camera in chosen_cameras):
        chosen_cameras = (counted, *chosen_cameras)
    depths_there = tuple(sensor for sensor in scene.sensors if isinstance(sensor, DepthCameraSensor))
    radars_there = tuple(sensor for sensor in scene.sensors if isinstance(sensor, RadarSensor))
    return Selection(
        scene,
        counted,
        chosen_lidars,
        chosen_cameras,
        chosen_sensors(scene, "depth camera", depths_there, depth_cameras),
        chosen_sensors(scene, "radar", radars_there, radars),
        trajectory,
        _period_ns(counted, chosen_lidars) if tolerance_ns is None else tolerance_ns,
    )


def _reference(scene: Scene, wanted: Identifier) -> LidarSensor | CameraSensor:
    """The lidar or camera of that id, else the first one of that kind."""
    sensors: list[LidarSensor | CameraSensor] = [*scene.lidars, *scene.cameras]
    for sensor in sensors:
        if _is(sensor, wanted):
            return sensor
    for sensor in sensors:
        if sensor.type == wanted:
            return sensor
    there = _listed(sensors)
    raise OptionError(
        f"{scene.source}: reference {wanted!r}; expected one of its lidars and cameras: {there}"
    )


def chosen_sensors(scene: Scene, kind: str, there: tuple[Kind, ...], wanted: Choice) -> tuple[Kind, ...]:
    """Find the sensors of one kind that are wanted, in that order.

    Raises:
        OptionError: the scene has no such sensor.
    """
    if isinstance(wanted, str) and wanted == ALL:
        return there
    ids = [wanted] if isinstance(wanted, str | int) else list(wanted)
    chosen: dict[int, Kind] = {}
    for wanted_id in ids:
        found = [sensor for sensor in there if _is(sensor, wanted_id)]
        if not found:
            known = ", ".join([repr(ALL), _listed(there)])
            raise OptionError(f"{scene.source}: no {kind} {wanted_id!r}; expected some of: {known}")
        chosen[id(found[0])] = found[0]
    return tuple(chosen.values())


def _is(sensor: Posed, wanted: Identifier) -> bool:
    return key_of(sensor.id) == key_of(wanted)


def _listed(sensors: Iterable[Posed]) -> str:
    return ", ".join(repr(sensor.id) for sensor in sensors) or "none, it has no such sensor"


def _period_ns(reference: LidarSensor | CameraSensor, lidars: tuple[LidarSensor, ...]) -> int:
    """One sweep period, or the time from image to image where there is no lidar."""
    if lidars:
        return sweep_period_ns(lidars[0])
    times = reference.images.timestamps_ns if isinstance(reference, CameraSensor) else np.zeros(0, np.int64)
    return usual_period_ns(times)
