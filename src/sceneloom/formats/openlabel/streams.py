"""Sensors as OpenLABEL streams, read and written: intrinsics, coordinate systems and transforms."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.formats.base.text_tables import seconds_text
from sceneloom.formats.openlabel.document import EGO, OURS, SENSOR_TYPES, WORLD, Part
from sceneloom.formats.openlabel.systems import Systems
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.cameras import CameraSensor, mounts_of_shots
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import check_one_ego
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import Coordinates, Identifier
from sceneloom.warnings import WarningKind

_OPENCV_COUNTS = (0, 4, 5, 8, 12, 14)

_OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
"""Source: `cv::projectPoints`."""

_NAMES = ("model", "width", "height", "fx", "fy", "cx", "cy", "coefficients")


def _read_camera_model(properties: Part) -> Camera | None:
    """Read the camera model of a stream; None where none is stated, or one of a model that is not known.

    Raises:
        DataError: it is wrong.
    """
    ours = properties.get(OURS)
    camera_model = None if ours is None else ours.get("camera_model")
    if camera_model is not None:
        return _ours(camera_model)
    pinhole, fisheye = properties.get("intrinsics_pinhole"), properties.get("intrinsics_fisheye")
    if pinhole is not None:
        return _pinhole(pinhole)
    return None if fisheye is None else _fisheye(fisheye)


def _built(part: Part, *values: Any) -> Camera:
    try:
        return Camera(*values)
    except (SceneloomError, TypeError) as error:
        raise DataError(part.file, part.location, str(error)) from error


def _ours(part: Part) -> Camera:
    model = part.need("model").text()
    if model not in MODELS:
        raise part.need("model").fault(f"one of {', '.join(MODELS)}")
    numbers = [_number(part.need(name)) for name in _NAMES[3:7]]
    coefficients = tuple(part.need("coefficients").numbers())
    return _built(part, model, _pixels(part, "width"), _pixels(part, "height"), *numbers, coefficients)


def _number(part: Part) -> float:
    return Part(part.file, part.location, [part.value]).numbers((1,))[0]


def _pixels(part: Part, name: str) -> int:
    found = part.need(name)
    if not isinstance(found.value, int) or not 0 < found.value < 1 << 20:
        raise found.fault("a number of pixels")
    return found.value


def _either(part: Part, *names: str) -> Part | None:
    return next((found for name in names if (found := part.get(name)) is not None), None)


def _pinhole(part: Part) -> Camera:
    matrix = _either(part, "camera_matrix_3x4", "camera_matrix")
    if matrix is None:
        raise DataError(part.file, f"{part.location}.camera_matrix_3x4", "missing")
    values = matrix.numbers((12, 9))
    row = len(values) // 3
    fx, skew, cx, fy, cy = values[0], values[1], values[2], values[row + 1], values[row + 2]
    if abs(skew) > 1e-9 * abs(fx):
        raise matrix.fault("a camera matrix without skew")
    listed = _either(part, "distortion_coeffs_1xN", "distortion_coeffs")
    coefficients = [] if listed is None else listed.numbers(_OPENCV_COUNTS)
    size = (_pixels(part, "width_px"), _pixels(part, "height_px"))
    if not any(coefficients):
        return _built(part, "pinhole", *size, fx, fy, cx, cy)
    named = dict(zip(_OPENCV_ORDER, coefficients, strict=False))
    names = MODELS["brown_conrady"].coefficient_names
    ordered = tuple(named.get(name, 0.0) for name in names)
    return _built(part, "brown_conrady", *size, fx, fy, cx, cy, _without_zeros(ordered))


def _without_zeros(values: tuple[float, ...]) -> tuple[float, ...]:
    count = next((k for k in range(len(values), 0, -1) if values[k - 1]), 0)
    return values[: max(count, 5)]


def _fisheye(part: Part) -> Camera | None:
    locations = [part.get(name) for name in ("focal_length_x", "focal_length_y", "center_x", "center_y")]
    listed = _either(part, "camera_model_coeffs_1xN", "camera_model_coeffs_1x4")
    model = part.get("model")
    if listed is None or any(location is None for location in locations):
        return None
    if model is not None and model.text() != "opencv_fisheye":
        return None
    numbers = [_number(location) for location in locations if location is not None]
    size = (_pixels(part, "width_px"), _pixels(part, "height_px"))
    return _built(part, "fisheye", *size, *numbers, tuple(listed.numbers((4,))))


def _camera_model_properties(camera: Camera) -> dict[str, Any]:
    """Report a camera model in the words of the format where it has some, and in ours, which state it exactly."""
    ours = {name: getattr(camera, name) for name in _NAMES[:7]}
    found: dict[str, Any] = {OURS: {"camera_model": {**ours, "coefficients": list(camera.coefficients)}}}
    named = dict(zip(MODELS[camera.model].coefficient_names, camera.coefficients, strict=False))
    size = {"width_px": camera.width, "height_px": camera.height}
    if camera.model == "fisheye":
        found["intrinsics_fisheye"] = {
            **size,
            "center_x": camera.cx,
            "center_y": camera.cy,
            "focal_length_x": camera.fx,
            "focal_length_y": camera.fy,
            "camera_model_coeffs_1xN": [named.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")],
            "model": "opencv_fisheye",
        }
    elif _is_pinhole(camera):
        coefficients = [named.get(name, 0.0) for name in _OPENCV_ORDER]
        count = next(count for count in _OPENCV_COUNTS[1:] if not any(coefficients[count:]))
        matrix = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        found["intrinsics_pinhole"] = {
            **size,
            "camera_matrix_3x4": matrix,
            "distortion_coeffs_1xN": coefficients[: max(count, 5)],
        }
    else:
        found["intrinsics_custom"] = {**size, "model": camera.model, **ours, **named}
    return found


def _is_pinhole(camera: Camera) -> bool:
    """Whether OpenCV's pinhole with distortion says the camera model.

    One that does not shift the centre of distortion.
    """
    if camera.model == "pinhole":
        return True
    named = dict(zip(MODELS[camera.model].coefficient_names, camera.coefficients, strict=False))
    return camera.model == "brown_conrady" and not (named.get("lx") or named.get("ly"))


def _nothing_to_read(number: int) -> NoReturn:
    """Refuse to read a frame: there are none.

    Raises:
        OptionError: always.
    """
    raise OptionError(f"frame {number}: an OpenLABEL file holds no frames of sensors")


def _no_frames() -> LazyFrames[Any]:
    return LazyFrames(np.zeros(0, np.int64), _nothing_to_read)


def read_streams(document: Part, systems: Systems, ledger: Ledger) -> tuple[Sensor, ...]:
    """Read all streams, placed by the coordinate systems of their names.

    Raises:
        DataError: one is wrong.
    """
    found = tuple(_sensor(name, stream, systems, ledger) for name, stream in document.each("streams"))
    if found:
        reported = "OpenLABEL names sensors and holds what is stated for their frames, but not the frames"
        ledger.note(
            WarningKind.SKIPPED,
            "frames-elsewhere",
            f"{document.file}: openlabel.streams",
            reported,
            count=len(found),
        )
    return found


def _sensor(name: str, stream: Part, systems: Systems, ledger: Ledger) -> Sensor:
    kind = "other" if stream.get("type") is None else stream.need("type").text()
    if kind not in SENSOR_TYPES:
        raise stream.need("type").fault(f"one of {', '.join(SENSOR_TYPES)}")
    properties = stream.get("stream_properties") or Part(stream.file, f"{stream.location}.stream_properties", {})
    ours = properties.members().get(OURS)
    ours = ours if isinstance(ours, dict) else {}
    sensor_id: Identifier = ours["id"] if isinstance(ours.get("id"), int | str) else name
    stated = ours.get("type")
    further = {key: value for key, value in stream.members().items() if key not in {"type", "stream_properties"}}
    rest = {key: value for key, value in properties.members().items() if key not in {OURS, "intrinsics_pinhole"}}
    if kind != "camera" and rest:
        further["stream_properties"] = rest
    placed = _placed(name, systems)
    extras = MappingProxyType(further)
    build = _BUILDERS.get(stated if isinstance(stated, str) and stated in _BUILDERS else _DEFAULTS.get(kind, kind))
    camera_model = _read_camera_model(properties) if kind == "camera" else None
    if kind == "camera" and camera_model is not None:
        return CameraSensor(sensor_id, camera_model, _no_frames(), extras=extras, **placed)
    if build is not None and kind != "camera":
        return build(sensor_id, placed, extras)
    if kind == "camera":
        reported = "its camera model is not stated, or of a model that is not known; kept as it stands"
        ledger.note(WarningKind.SKIPPED, "camera-model-not-read", f"{stream.file}: {stream.location}", reported)
    return PlainSensor(sensor_id, f"openlabel_{kind}", MappingProxyType(dict(stream.members())))


def _placed(name: str, systems: Systems) -> dict[str, Any]:
    """The poses of a sensor in the root, and its mounting on the ego where there is one."""
    if name not in systems.names:
        return {}
    chain, ego = systems.chain(name), systems.ego
    found: dict[str, Any] = {"poses": systems.path_to(name, chain[-1])}
    if ego is None and len(chain) > 1:
        # nothing moves: the root may be the vehicle as well as the world
        ego = chain[-1]
    mount = None if ego is None or ego == name else systems.path_to(name, ego)
    if mount is not None and mount.static:
        found["mount"] = RigidTransform.from_quaternion(mount.positions[0], mount.quaternions_xyzw[0])
    if len(chain) == 1:
        del found["poses"]
    return found


def _lidar(sensor_id: Identifier, placed: dict[str, Any], extras: Mapping[str, Any]) -> Sensor:
    return LidarSensor(sensor_id, _no_frames(), extras=extras, **placed)


def _radar(sensor_id: Identifier, placed: dict[str, Any], extras: Mapping[str, Any]) -> Sensor:
    return RadarSensor(sensor_id, _no_frames(), extras=extras, **placed)


def _imu(sensor_id: Identifier, placed: dict[str, Any], extras: Mapping[str, Any]) -> Sensor:
    del placed
    return ImuSensor(sensor_id, {}, extras=extras)


def _gnss(sensor_id: Identifier, placed: dict[str, Any], extras: Mapping[str, Any]) -> Sensor:
    none = np.zeros(0)
    return GnssSensor(
        sensor_id,
        np.zeros(0, np.int64),
        np.zeros((0, 3)),
        none,
        none,
        mount=placed.get("mount"),
        extras=extras,
    )


_BUILDERS: Mapping[str, Callable[[Identifier, dict[str, Any], Mapping[str, Any]], Sensor]] = MappingProxyType(
    {"lidar": _lidar, "radar": _radar, "imu": _imu, "gnss": _gnss}
)
"""By the types of our model."""

_DEFAULTS = {"gps_imu": "gnss"}
"""Types of our model by those of streams, where they differ."""


def ego_path(systems: Systems) -> tuple[str, Poses] | None:
    """The name and the ego trajectory in its root; None where nothing moves."""
    ego = systems.ego
    if ego is None:
        return None
    path = systems.path_to(ego, systems.chain(ego)[-1])
    return None if path is None else (ego, path)


_STREAM_TYPES: Mapping[type[Any], str] = {
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
        trajectory = _trajectory_of(scene)
        check_one_ego(scene, trajectory)
        names: dict[Identifier, str] = {}
        sensors: dict[str, Sensor] = {}
        for sensor in scene.sensors:
            plain = isinstance(sensor, PlainSensor) and sensor.type.startswith("openlabel_")
            if type(sensor) not in _STREAM_TYPES and not plain:
                continue
            name = str(sensor.id)
            while name in sensors or name in {WORLD, EGO}:
                name += "_"
            names[sensor.id], sensors[name] = name, sensor
        moving = frozenset(
            one.id for one in scene.cameras if mounts_of_shots(one) is not None and one.coordinates is Coordinates.WORLD
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
        """The member `coordinate_systems`; the ego is the root where nothing is placed in the world."""
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
        """The transforms of the frame of a time: of the ego, and of sensors with poses of their own."""
        moving = {} if self.trajectory is None else {EGO: self.trajectory}
        found = {}
        for name, path in (moving | self._moving_sensors()).items():
            samples = path.interpolate(np.array([time_ns], np.int64))
            if np.isfinite(samples.positions[0]).all():
                matrix = RigidTransform.from_quaternion(samples.positions[0], samples.quaternions_xyzw[0]).matrix
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
                properties: dict[str, Any] = {"sync": {"frame_stream": k, "timestamp": seconds_text(int(times[k]))}}
                if isinstance(sensor, CameraSensor) and (camera_model := sensor.images[k].camera) != sensor.camera:
                    properties |= {
                        key: value for key, value in _camera_model_properties(camera_model).items() if key != OURS
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


def _trajectory_of(scene: Scene) -> Poses | None:
    """The ego trajectory: the first trajectory with orientations, else that of an odometry sensor."""
    trajectories = [
        trajectory.poses for trajectory in scene.trajectories.values() if trajectory.quaternions_xyzw is not None
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
    properties = _camera_model_properties(sensor.camera) if isinstance(sensor, CameraSensor) else {}
    kept = sensor.extras.get("stream_properties")
    stream = {
        "type": _STREAM_TYPES[type(sensor)],
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
