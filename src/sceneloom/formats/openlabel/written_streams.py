"""Sensors as streams, and where they are as coordinate systems and transforms."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.openlabel.camera_models import camera_model_properties
from sceneloom.formats.openlabel.words import EGO, OURS, WORLD
from sceneloom.formats.recording.written_times import seconds_text
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.sensor_sources import check_one_ego
from sceneloom.scene.shooting import mounts_of_shots
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Coordinates, Identifier

STREAM_TYPES: Mapping[type[Any], str] = {
    CameraSensor: "camera",
    LidarSensor: "lidar",
    RadarSensor: "radar",
    ImuSensor: "gps_imu",
    GnssSensor: "gps_imu",
}
_EXACT_M, _EXACT_DEG = 1e-6, 1e-4
"""Poses this near to where they were count as exact."""
_WITHIN = 0.5
"""A frame belongs to the one of the file that is nearer than this part of its sensor's median interval."""


@dataclass(frozen=True, slots=True, eq=False)
class Streams:
    """The sensors of a scene that a file names.

    Attributes:
        names: of the streams, by the ids of sensors.
        sensors: by the names.
        trajectory: `world_from_ego`, or None.
        moving: ids of the cameras whose images have mountings of their own: only their poses report where they were.
    """

    names: Mapping[Identifier, str]
    sensors: Mapping[str, Sensor]
    trajectory: Poses | None
    moving: frozenset[Identifier] = frozenset()

    @classmethod
    def of(cls, scene: Scene) -> "Streams":
        """Name the sensors of a scene; those of types that streams do not have are left out.

        Raises:
            PoseError: sensors in ego coordinates refer to another trajectory than the one that is written.
        """
        trajectory = trajectory_of(scene)
        check_one_ego(scene, trajectory)
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
        return cls(names, sensors, trajectory, moving)

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
        if world or self.trajectory is not None or WORLD in parents:
            roots[WORLD] = {"type": "scene_cs", "parent": ""}
        if EGO in parents or self.trajectory is not None or not roots:
            roots[EGO] = {"type": "local_cs", "parent": WORLD if self.trajectory is not None else ""}
        systems = {**roots, **found}
        for name, system in systems.items():
            system["children"] = [other for other, one in systems.items() if one["parent"] == name]
        return systems

    def transforms(self, time_ns: int) -> dict[str, Any]:
        """The transforms of the frame of a time: of the ego, and of sensors with ways of their own."""
        moving = {} if self.trajectory is None else {EGO: self.trajectory}
        found = {}
        for name, path in (moving | self._moving_sensors()).items():
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

    def _moving_sensors(self) -> dict[str, Poses]:
        """`world_from_sensor` of the sensors that have transforms of their own, by the names of their streams."""
        found: dict[str, Poses] = {}
        for name, sensor in self.sensors.items():
            placed, poses = self._parent_and_pose(sensor), getattr(sensor, "poses", None)
            if placed is not None and placed[1] is None and poses is not None:
                found[name] = poses
        return found

    def losses(self, times_ns: Int64Array) -> Iterator[Loss]:
        """How far the poses that transforms at the times of the file's frames report are off.

        Of a sensor at the times of its own frames, of the ego at those of its trajectory's poses; and how many of these
        lie beyond the file's frames.
        """
        if self.trajectory is not None:
            yield from _sampled(
                self.trajectory,
                self.trajectory.timestamps_ns,
                times_ns,
                "trajectories.positions",
                "its poses",
            )
        for name, path in self._moving_sensors().items():
            sensor = self.sensors[name]
            own = _times(sensor)
            own_times = own if len(own) else path.timestamps_ns
            reported = "its frames" if len(own) else "its poses"
            yield from _sampled(path, own_times, times_ns, f"sensors[{sensor.id}].poses", reported)

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
                if (
                    isinstance(sensor, CameraSensor)
                    and (camera_model := sensor.images[k].camera) != sensor.camera
                ):
                    properties |= {
                        key: value
                        for key, value in camera_model_properties(camera_model).items()
                        if key != OURS
                    }
                found[name] = {"stream_properties": properties}
        return found


def _sampled(path: Poses, own_ns: Int64Array, times_ns: Int64Array, field: str, own: str) -> Iterator[Loss]:
    """How far a path is off between the times that it is written at, and how many of its own lie beyond them."""
    written = path.interpolate(times_ns)
    known = np.isfinite(written.positions).all(axis=1)
    right = path.interpolate(own_ns)
    wanted = np.isfinite(right.positions).all(axis=1)
    reached: BoolArray = np.zeros(len(own_ns), bool)
    if known.any():
        read = Poses(times_ns[known], written.positions[known], written.quaternions_xyzw[known])
        found = read.interpolate(own_ns)
        reached = np.asarray(wanted & np.isfinite(found.positions).all(axis=1), np.bool_)
        moved = np.linalg.norm(found.positions[reached] - right.positions[reached], axis=1)
        rotated = np.degrees(angle_between(found.quaternions_xyzw[reached], right.quaternions_xyzw[reached]))
        off, rotation = float(moved.max(initial=0.0)), float(rotated.max(initial=0.0))
        if off > _EXACT_M or rotation > _EXACT_DEG:
            what = (
                f"written at the times of the frames; at the times of {own} they are up to {round(off, 4):g} m and "
                f"{round(rotation, 3):g} degrees off"
            )
            count = int(reached.sum())
            yield Loss(field=field, what=what, count=count, support=Support.APPROXIMATED, largest_error=off)
    beyond = int((wanted & ~reached).sum())
    if beyond:
        what = f"left out at times of {own} that lie beyond the file's frames"
        yield Loss(field=field, what=what, count=beyond)


def _times(sensor: Sensor) -> Int64Array:
    if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor):
        return frame_times(sensor)
    return np.zeros(0, np.int64)


def trajectory_of(scene: Scene) -> Poses | None:
    """The ego trajectory: the first trajectory with orientations, else that of an odometry sensor."""
    trajectories = [
        trajectory.poses
        for trajectory in scene.trajectories.values()
        if trajectory.quaternions_xyzw is not None
    ]
    trajectories += [sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
    return next((trajectory for trajectory in trajectories if not trajectory.static), None)


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
    properties = camera_model_properties(sensor.camera) if isinstance(sensor, CameraSensor) else {}
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
