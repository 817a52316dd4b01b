"""Sensors as OpenLABEL streams, read and written: intrinsics, coordinate systems and transforms."""

from collections.abc import Iterator, Mapping
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
from sceneloom.formats.openlabel.document import EGO, OURS, WORLD, Part
from sceneloom.formats.openlabel.systems import Systems
from sceneloom.geometry.rigid import RigidTransform, angle_between
from sceneloom.scene.cameras import CameraSensor, mounts_of_shots
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import check_one_ego
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import Coordinates, Identifier
from sceneloom.warnings import WarningKind

_STREAM_TYPES: Mapping[type[Any], str] = {
    CameraSensor: "camera",
    LidarSensor: "lidar",
    RadarSensor: "radar",
    ImuSensor: "gps_imu",
    GnssSensor: "gps_imu",
}
_KNOWN_TYPES = ("camera", "lidar", "radar", "gps_imu", "other")

_OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
"""Source: `cv::projectPoints`."""

_OPENCV_COUNTS = (0, 4, 5, 8, 12, 14)

_OURS_CAMERA = ("model", "width", "height", "fx", "fy", "cx", "cy")
_FISHEYE = {"center_x": "cx", "center_y": "cy", "focal_length_x": "fx", "focal_length_y": "fy"}
_FISHEYE_COEFFICIENTS = ("k1", "k2", "k3", "k4")

_EXACT_M, _EXACT_DEG = 1e-6, 1e-4
"""Poses this near to the exact ones count as exact."""

_WITHIN = 0.5
"""A frame of a sensor belongs to the file's nearest frame within this share of the sensor's median interval."""


# reading


def read_streams(document: Part, systems: Systems, ledger: Ledger) -> dict[str, Sensor]:
    """Read all streams by their names, placed by the coordinate systems of these names.

    Raises:
        DataError: one is wrong.
    """
    found = {name: _sensor(name, stream, systems, ledger) for name, stream in document.each("streams")}
    if found:
        message = "OpenLABEL names sensors and holds what is stated for their frames, but not the frames"
        document.need("streams").note(ledger, WarningKind.SKIPPED, "frames-elsewhere", message, count=len(found))
    return found


def _sensor(name: str, stream: Part, systems: Systems, ledger: Ledger) -> Sensor:
    kind = "other" if stream.get("type") is None else stream.need("type").text()
    if kind not in _KNOWN_TYPES:
        raise stream.need("type").fault(f"one of {', '.join(_KNOWN_TYPES)}")
    properties = stream.below("stream_properties")
    ours = properties.members().get(OURS)
    ours = ours if isinstance(ours, dict) else {}
    sensor_id: Identifier = ours["id"] if isinstance(ours.get("id"), int | str) else name
    extras = {key: value for key, value in stream.members().items() if key not in {"type", "stream_properties"}}
    rest = {key: value for key, value in properties.members().items() if key not in {OURS, "intrinsics_pinhole"}}
    if kind != "camera" and rest:
        extras["stream_properties"] = rest
    further, placed = MappingProxyType(extras), _placed(name, systems)
    frames = LazyFrames[Any](np.zeros(0, np.int64), _no_frame)
    stated = ours.get("type")
    if kind == "camera":
        camera = _read_camera(properties)
        if camera is not None:
            return CameraSensor(sensor_id, camera, frames, extras=further, **placed)
        message = "its camera model is missing or unknown; the stream is kept as it is"
        stream.note(ledger, WarningKind.SKIPPED, "camera-model-not-read", message)
    else:
        match stated if stated in ("lidar", "radar", "imu", "gnss") else kind:
            case "lidar":
                return LidarSensor(sensor_id, frames, extras=further, **placed)
            case "radar":
                return RadarSensor(sensor_id, frames, extras=further, **placed)
            case "imu":
                return ImuSensor(sensor_id, {}, extras=further)
            case "gnss" | "gps_imu":
                no_times, none, mount = np.zeros(0, np.int64), np.zeros(0), placed.get("mount")
                return GnssSensor(sensor_id, no_times, np.zeros((0, 3)), none, none, mount=mount, extras=further)
    return PlainSensor(sensor_id, f"openlabel_{kind}", MappingProxyType(dict(stream.members())))


def _no_frame(number: int) -> NoReturn:
    raise OptionError(f"frame {number}: an OpenLABEL file holds no frames of sensors")


def _placed(name: str, systems: Systems) -> dict[str, Any]:
    """The poses of a sensor in the root, and its mounting on the ego where there is one."""
    if name not in systems.names:
        return {}
    chain, ego = systems.chain(name), systems.ego
    if ego is None and len(chain) > 1:
        # nothing moves: the root may be the vehicle as well as the world
        ego = chain[-1]
    found: dict[str, Any] = {} if len(chain) == 1 else {"poses": systems.path_to(name, chain[-1])}
    mount = None if ego is None or ego == name else systems.path_to(name, ego)
    if mount is not None and mount.static:
        found["mount"] = RigidTransform.from_quaternion(mount.positions[0], mount.quaternions_xyzw[0])
    return found


def _read_camera(properties: Part) -> Camera | None:
    """The camera model of a stream: ours, else that of the format; None where it is missing or unknown."""
    ours = properties.get(OURS)
    camera = None if ours is None else ours.get("camera_model")
    if camera is not None:
        model = camera.need("model").text()
        if model not in MODELS:
            raise camera.need("model").fault(f"one of {', '.join(MODELS)}")
        size = [_pixels(camera, name) for name in ("width", "height")]
        numbers = [camera.need(name).number() for name in _OURS_CAMERA[3:]]
        return _built(camera, model, *size, *numbers, tuple(camera.need("coefficients").numbers()))
    pinhole, fisheye = properties.get("intrinsics_pinhole"), properties.get("intrinsics_fisheye")
    if pinhole is not None:
        return _pinhole(pinhole)
    return None if fisheye is None else _fisheye(fisheye)


def _pinhole(part: Part) -> Camera:
    matrix = part.get("camera_matrix_3x4") or part.get("camera_matrix")
    if matrix is None:
        raise DataError(part.file, f"{part.location}.camera_matrix_3x4", "missing")
    (fx, skew, cx, *_), (_, fy, cy, *_), _ = np.reshape(matrix.numbers(12, 9), (3, -1)).tolist()
    if abs(skew) > 1e-9 * abs(fx):
        raise matrix.fault("a camera matrix without skew")
    listed = part.get("distortion_coeffs_1xN") or part.get("distortion_coeffs")
    coefficients = [] if listed is None else listed.numbers(*_OPENCV_COUNTS)
    values = (_pixels(part, "width_px"), _pixels(part, "height_px"), fx, fy, cx, cy)
    if not any(coefficients):
        return _built(part, "pinhole", *values)
    named = dict(zip(_OPENCV_ORDER, coefficients, strict=False))
    ordered = np.array([named.get(name, 0.0) for name in MODELS["brown_conrady"].coefficient_names])
    count = max([5, *(np.flatnonzero(ordered) + 1).tolist()])
    return _built(part, "brown_conrady", *values, tuple(ordered[:count].tolist()))


def _fisheye(part: Part) -> Camera | None:
    numbers = {field: found for name, field in _FISHEYE.items() if (found := part.get(name)) is not None}
    listed = part.get("camera_model_coeffs_1xN") or part.get("camera_model_coeffs_1x4")
    model = part.get("model")
    if listed is None or len(numbers) < len(_FISHEYE) or (model is not None and model.text() != "opencv_fisheye"):
        return None
    size = [_pixels(part, "width_px"), _pixels(part, "height_px")]
    values = [numbers[name].number() for name in _OURS_CAMERA[3:]]
    return _built(part, "fisheye", *size, *values, tuple(listed.numbers(4)))


def _pixels(part: Part, name: str) -> int:
    found = part.need(name)
    if not isinstance(found.value, int) or not 0 < found.value < 1 << 20:
        raise found.fault("a number of pixels")
    return found.value


def _built(part: Part, *values: Any) -> Camera:
    try:
        return Camera(*values)
    except (SceneloomError, TypeError) as error:
        raise DataError(part.file, part.location, str(error)) from error


# writing


def _camera_properties(camera: Camera) -> dict[str, Any]:
    """A camera model in the words of the format where it has some, and in ours, which state it exactly."""
    ours = {name: getattr(camera, name) for name in _OURS_CAMERA}
    named = dict(zip(MODELS[camera.model].coefficient_names, camera.coefficients, strict=False))
    size = {"width_px": camera.width, "height_px": camera.height}
    # OpenCV has no model with distortion whose centre of distortion is shifted
    unshifted = not (named.get("lx") or named.get("ly"))
    if camera.model == "fisheye":
        kind, found = (
            "fisheye",
            {
                **{name: getattr(camera, field) for name, field in _FISHEYE.items()},
                "camera_model_coeffs_1xN": [named.get(name, 0.0) for name in _FISHEYE_COEFFICIENTS],
                "model": "opencv_fisheye",
            },
        )
    elif camera.model == "pinhole" or (camera.model == "brown_conrady" and unshifted):
        coefficients = [named.get(name, 0.0) for name in _OPENCV_ORDER]
        count = next(count for count in _OPENCV_COUNTS[2:] if not any(coefficients[count:]))
        matrix = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        kind, found = "pinhole", {"camera_matrix_3x4": matrix, "distortion_coeffs_1xN": coefficients[:count]}
    else:
        kind, found = "custom", {**ours, **named}
    return {
        OURS: {"camera_model": {**ours, "coefficients": list(camera.coefficients)}},
        f"intrinsics_{kind}": {**size, **found},
    }


@dataclass(frozen=True, slots=True, eq=False)
class Streams:
    """The sensors of a scene that a file names.

    Attributes:
        names: of the streams, by the ids of sensors.
        sensors: by the names.
        trajectory: `world_from_ego`, or None.
        placed: by the names, the coordinate system that each is placed in, and its pose there, None where it moves.
    """

    names: Mapping[Identifier, str]
    sensors: Mapping[str, Sensor]
    trajectory: Poses | None
    placed: Mapping[str, tuple[str, RigidTransform | None]]

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
        placed = {}
        for sensor in scene.sensors:
            plain = isinstance(sensor, PlainSensor) and sensor.type.startswith("openlabel_")
            if type(sensor) not in _STREAM_TYPES and not plain:
                continue
            name = str(sensor.id)
            while name in sensors or name in {WORLD, EGO}:
                name += "_"
            names[sensor.id], sensors[name] = name, sensor
            if (where := _system_and_pose(sensor)) is not None:
                placed[name] = where
        return cls(names, sensors, trajectory, placed)

    def members(self) -> dict[str, Any]:
        """The member `streams`."""
        return {name: _stream(sensor) for name, sensor in self.sensors.items()}

    def systems(self, *, world: bool) -> dict[str, Any]:
        """The member `coordinate_systems`; the ego is the root where nothing is placed in the world."""
        parents = {parent for parent, _ in self.placed.values()}
        systems: dict[str, Any] = {}
        if world or self.trajectory is not None or WORLD in parents:
            systems[WORLD] = {"type": "scene_cs", "parent": ""}
        if EGO in parents or self.trajectory is not None or not systems:
            systems[EGO] = {"type": "local_cs", "parent": WORLD if self.trajectory is not None else ""}
        for name, (parent, pose) in self.placed.items():
            stated = {} if pose is None else {"pose_wrt_parent": _matrix(pose)}
            systems[name] = {"type": "sensor_cs", "parent": parent, **stated}
        for name, system in systems.items():
            system["children"] = [other for other, one in systems.items() if one["parent"] == name]
        return systems

    def transforms(self, time_ns: int) -> dict[str, Any]:
        """The transforms of the frame of a time: of the ego, and of sensors with poses of their own."""
        ego = {} if self.trajectory is None else {EGO: self.trajectory}
        found = {}
        for name, path in (ego | self._moving_sensors()).items():
            at = path.interpolate(np.array([time_ns], np.int64))
            if np.isfinite(at.positions[0]).all():
                pose = _matrix(RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0]))
                found[f"{name}_to_{WORLD}"] = {"src": name, "dst": WORLD, "transform_src_to_dst": pose}
        return found

    def _moving_sensors(self) -> dict[str, Poses]:
        """`world_from_sensor` of the sensors that have transforms of their own, by the names of their streams."""
        moving = [name for name, (_, pose) in self.placed.items() if pose is None]
        return {name: poses for name in moving if (poses := getattr(self.sensors[name], "poses", None)) is not None}

    def losses(self, times_ns: Int64Array) -> Iterator[Loss]:
        """How far the poses that transforms at the times of the file's frames give are off, and which are left out.

        Of a sensor at the times of its own frames, of the ego at those of its trajectory's poses.
        """
        ego = self.trajectory
        if ego is not None:
            yield from _sampled(ego, ego.timestamps_ns, times_ns, "trajectories.positions", "its poses")
        for name, path in self._moving_sensors().items():
            sensor = self.sensors[name]
            field, times = f"sensors[{sensor.id}].poses", _times(sensor)
            if len(times):
                yield from _sampled(path, times, times_ns, field, "its frames")
            else:
                yield from _sampled(path, path.timestamps_ns, times_ns, field, "its poses")

    def syncs(self, time_ns: int) -> dict[str, Any]:
        """Which frame of each sensor is the nearest to a time, and its own time."""
        found = {}
        for name, sensor in self.sensors.items():
            times = _times(sensor)
            if not len(times):
                continue
            k = int(np.argmin(np.abs(times - time_ns)))
            limit = float(np.median(np.diff(times))) * _WITHIN if len(times) > 1 else 0.0
            if abs(int(times[k]) - time_ns) <= limit:
                properties: dict[str, Any] = {"sync": {"frame_stream": k, "timestamp": seconds_text(int(times[k]))}}
                if isinstance(sensor, CameraSensor) and (camera := sensor.images[k].camera) != sensor.camera:
                    properties |= _camera_properties(camera)
                    del properties[OURS]
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
        yield Loss(field=field, what=f"left out at times of {own} that lie beyond the file's frames", count=beyond)


def _times(sensor: Sensor) -> Int64Array:
    has_frames = isinstance(sensor, LidarSensor | RadarSensor | CameraSensor)
    return frame_times(sensor) if has_frames else np.zeros(0, np.int64)


def _trajectory_of(scene: Scene) -> Poses | None:
    """The ego trajectory: the first one with orientations, else that of an odometry sensor."""
    trajectories = [one.poses for one in scene.trajectories.values() if one.quaternions_xyzw is not None]
    trajectories += [sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
    return next((trajectory for trajectory in trajectories if not trajectory.static), None)


def _system_and_pose(sensor: Any) -> tuple[str, RigidTransform | None] | None:
    """The system that a sensor is placed in, and its pose there, None where it moves; None where nothing is known."""
    mount, poses = getattr(sensor, "mount", None), getattr(sensor, "poses", None)
    if isinstance(sensor, CameraSensor) and sensor.coordinates is Coordinates.WORLD and mounts_of_shots(sensor):
        # its images have mountings of their own: only its poses state where they were taken
        return None if poses is None else (WORLD, None)
    if mount is not None:
        return EGO, mount
    if poses is None:
        return None
    if len(poses.timestamps_ns) == 1:
        parent = EGO if sensor.coordinates is Coordinates.EGO else WORLD
        return parent, RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])
    return None if sensor.coordinates is Coordinates.EGO else (WORLD, None)


def _matrix(pose: RigidTransform) -> dict[str, Any]:
    return {"matrix4x4": pose.matrix.reshape(-1).tolist()}


def _stream(sensor: Any) -> dict[str, Any]:
    if isinstance(sensor, PlainSensor):
        return dict(sensor.fields)
    camera = _camera_properties(sensor.camera) if isinstance(sensor, CameraSensor) else {}
    kept = sensor.extras.get("stream_properties")
    own = {"id": sensor.id, "type": str(sensor.type), **camera.get(OURS, {})}
    stream = {
        "type": _STREAM_TYPES[type(sensor)],
        "stream_properties": {**(kept if isinstance(kept, dict) else {}), **camera, OURS: own},
    }
    texts = {name: sensor.extras.get(name) for name in ("uri", "description")}
    return stream | {name: text for name, text in texts.items() if isinstance(text, str)}
