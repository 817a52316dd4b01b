"""Sensors as streams, and where they are as coordinate systems and transforms."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.openlabel.lenses import lens_properties
from sceneloom.formats.openlabel.words import EGO, OURS, WORLD
from sceneloom.formats.recording.written_times import seconds_text
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    CameraSensor,
    Coordinates,
    GnssSensor,
    Identifier,
    ImuSensor,
    LidarSensor,
    OdometrySensor,
    PlainSensor,
    PosePath,
    RadarSensor,
    Scene,
    Sensor,
)
from sceneloom.scene.sensor_sources import check_one_ego
from sceneloom.scene.shooting import mounts_of_shots
from sceneloom.scene.span import frame_times

STREAM_TYPES: Mapping[type[Any], str] = {
    CameraSensor: "camera",
    LidarSensor: "lidar",
    RadarSensor: "radar",
    ImuSensor: "gps_imu",
    GnssSensor: "gps_imu",
}
_WITHIN = 0.5
"""A frame belongs to the one of the file that is nearer than this part of its sensor's median interval."""


@dataclass(frozen=True, slots=True, eq=False)
class Streams:
    """The sensors of a scene that a file names.

    Attributes:
        names: of the streams, by the ids of sensors.
        sensors: by the names.
        way: `world_from_ego`, or None.
        moving: ids of the cameras whose pictures have mountings of their own: only their poses tell where they were.
    """

    names: Mapping[Identifier, str]
    sensors: Mapping[str, Sensor]
    way: PosePath | None
    moving: frozenset[Identifier] = frozenset()

    @classmethod
    def of(cls, scene: Scene) -> "Streams":
        """Name the sensors of a scene; those of types that streams do not have are left out.

        Raises:
            PoseError: sensors in ego coordinates refer to another trajectory than the one that is written.
        """
        way = way_of(scene)
        check_one_ego(scene, way)
        names: dict[Identifier, str] = {}
        sensors: dict[str, Sensor] = {}
        for sensor in scene.sensors:
            plain = isinstance(sensor, PlainSensor) and sensor.type.startswith("openlabel_")
            if type(sensor) not in STREAM_TYPES and not plain:
                continue
            name = str(sensor.id)
            while name in sensors or name in {WORLD, EGO}:
                name += "_"
            names[sensor.id], sensors[name] = name, sensor
        moving = frozenset(
            one.id
            for one in scene.cameras
            if mounts_of_shots(one) is not None and one.coordinates is Coordinates.WORLD
        )
        return cls(names, sensors, way, moving)

    def _parent_and_pose(self, sensor: Any) -> tuple[str, RigidTransform | None] | None:
        """The system that a sensor is placed in, its pose there, None where it moves; None where nothing is known."""
        if type(sensor) is CameraSensor and sensor.id in self.moving:
            return None if sensor.poses is None else (WORLD, None)
        return _parent_and_pose(sensor)

    def members(self) -> dict[str, Any]:
        """The member `streams`."""
        return {name: _stream(sensor) for name, sensor in self.sensors.items()}

    def systems(self, *, world: bool) -> dict[str, Any]:
        """The member `coordinate_systems`; the ego is the root where nothing stands in the world."""
        found: dict[str, Any] = {}
        for name, sensor in self.sensors.items():
            placed = self._parent_and_pose(sensor)
            if placed is not None:
                parent, pose = placed
                found[name] = {"type": "sensor_cs", "parent": parent, **({} if pose is None else _pose(pose))}
        parents = {system["parent"] for system in found.values()}
        roots: dict[str, Any] = {}
        if world or self.way is not None or WORLD in parents:
            roots[WORLD] = {"type": "scene_cs", "parent": ""}
        if EGO in parents or self.way is not None or not roots:
            roots[EGO] = {"type": "local_cs", "parent": WORLD if self.way is not None else ""}
        systems = {**roots, **found}
        for name, system in systems.items():
            system["children"] = [other for other, one in systems.items() if one["parent"] == name]
        return systems

    def transforms(self, time_ns: int) -> dict[str, Any]:
        """The transforms of the frame of a time: of the ego, and of sensors with ways of their own."""
        moving = {} if self.way is None else {EGO: self.way}
        for name, sensor in self.sensors.items():
            placed, poses = self._parent_and_pose(sensor), getattr(sensor, "poses", None)
            if placed is not None and placed[1] is None and poses is not None:
                moving[name] = poses
        found = {}
        for name, path in moving.items():
            samples = path.interpolate(np.array([time_ns], np.int64))
            if np.isfinite(samples.positions[0]).all():
                matrix = RigidTransform.from_quaternion(
                    samples.positions[0], samples.quaternions_xyzw[0]
                ).matrix
                found[f"{name}_to_{WORLD}"] = {
                    "src": name,
                    "dst": WORLD,
                    "transform_src_to_dst": {"matrix4x4": matrix.reshape(-1).tolist()},
                }
        return found

    def syncs(self, time_ns: int) -> dict[str, Any]:
        """Which frame of each sensor is the nearest to a time, and when it is of."""
        found = {}
        for name, sensor in self.sensors.items():
            times = _times(sensor)
            if not len(times):
                continue
            k = int(np.argmin(np.abs(times - time_ns)))
            reach = float(np.median(np.diff(times))) * _WITHIN if len(times) > 1 else 0.0
            if abs(int(times[k]) - time_ns) <= reach:
                properties: dict[str, Any] = {
                    "sync": {"frame_stream": k, "timestamp": seconds_text(int(times[k]))}
                }
                if isinstance(sensor, CameraSensor) and (lens := sensor.pictures[k].camera) != sensor.camera:
                    properties |= {key: value for key, value in lens_properties(lens).items() if key != OURS}
                found[name] = {"stream_properties": properties}
        return found


def _times(sensor: Sensor) -> Int64Array:
    if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor):
        return frame_times(sensor)
    return np.zeros(0, np.int64)


def way_of(scene: Scene) -> PosePath | None:
    """The way of the ego: the first trajectory with orientations, else that of an odometry sensor."""
    ways = [way.poses for way in scene.trajectories.values() if way.quaternions_xyzw is not None]
    ways += [sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
    return next((way for way in ways if not way.endless), None)


def _parent_and_pose(sensor: Any) -> tuple[str, RigidTransform | None] | None:
    """The system that a sensor is placed in, and its pose there, None where it moves; None where nothing is known."""
    mount, poses = getattr(sensor, "mount", None), getattr(sensor, "poses", None)
    if mount is not None:
        return EGO, mount
    if poses is None:
        return None
    if len(poses.timestamps_ns) == 1:
        parent = EGO if sensor.coordinates is Coordinates.EGO else WORLD
        return parent, RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])
    return None if sensor.coordinates is Coordinates.EGO else (WORLD, None)


def _pose(pose: RigidTransform) -> dict[str, Any]:
    return {"pose_wrt_parent": {"matrix4x4": pose.matrix.reshape(-1).tolist()}}


def _stream(sensor: Any) -> dict[str, Any]:
    if isinstance(sensor, PlainSensor):
        return dict(sensor.fields)
    own = {"id": sensor.id, "type": str(sensor.type)}
    properties = lens_properties(sensor.camera) if isinstance(sensor, CameraSensor) else {}
    kept = sensor.extras.get("stream_properties")
    stream = {
        "type": STREAM_TYPES[type(sensor)],
        "stream_properties": {
            **(kept if isinstance(kept, dict) else {}),
            **properties,
            OURS: {**own, **properties.get(OURS, {})},
        },
    }
    for name in ("uri", "description"):
        if isinstance(sensor.extras.get(name), str):
            stream[name] = sensor.extras[name]
    return stream
