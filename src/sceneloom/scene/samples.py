"""Synchronised samples of a scene: a sweep with the images, poses and boxes that belong to it."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any, Generic, TypeVar, overload

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.geometry.rigid import EXTRAPOLATED, OUT_OF_REACH, RigidTransform, matrix_from_quaternion
from sceneloom.scene.annotations_at import Boxes, BoxTable
from sceneloom.scene.cameras import (
    CameraImage,
    CameraSensor,
    DepthCameraSensor,
    DepthFrame,
    ShootingSensor,
    Shot,
    shots_of,
)
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.ego import EgoMotion, needs_ego, points_source, sensor_source
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.point_times import timed_frame
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Posed, Scene, frame_times, scene_period_ns, sweep_period_ns, usual_period_ns
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, key_of

ALL = "all"
Choice = Identifier | Iterable[Identifier]
"""Sensors of one kind: "all", one id, or several."""

_Kind = TypeVar("_Kind", LidarSensor, CameraSensor, RadarSensor, DepthCameraSensor)


def chosen_sensors(scene: Scene, kind: str, there: tuple[_Kind, ...], wanted: Choice) -> tuple[_Kind, ...]:
    """Find the sensors of one kind that are wanted, in that order.

    Raises:
        OptionError: the scene has no such sensor.
    """
    if isinstance(wanted, str) and wanted == ALL:
        return there
    ids = [wanted] if isinstance(wanted, str | int) else list(wanted)
    chosen: dict[int, _Kind] = {}
    for wanted_id in ids:
        found = [sensor for sensor in there if key_of(sensor.id) == key_of(wanted_id)]
        if not found:
            known = ", ".join(repr(sensor.id) for sensor in there) or "none, it has no such sensor"
            raise OptionError(f"{scene.source}: no {kind} {wanted_id!r}; expected some of: {ALL!r}, {known}")
        chosen[id(found[0])] = found[0]
    return tuple(chosen.values())


_IDENTITY = "identity"  # the trajectory of an ego that is stationary
WORLD = PoseSource(Poses.identity(), RigidTransform.identity())
"""Where points are that are in the world already."""


@dataclass(frozen=True, slots=True, eq=False)
class _Location:
    """Where something is, as far as it is known."""

    source: PoseSource | None  # its pose in the world over time
    problem: str = ""  # why there is none
    mount: RigidTransform | None = None  # `ego_from_sensor` where it is rigid and known


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    """A pose at a time, as far as it is known."""

    world_from_sensor: RigidTransform | None
    problem: str = ""  # why there is none
    extrapolated: bool = False  # whether the time lies beyond the trajectory's ends


def choose_ego(scene: Scene, trajectory: str | EgoMotion | None) -> EgoMotion | None:
    """Take the ego trajectory by name, or the scene's default one; None where poses need none, or there is none.

    Raises:
        OptionError: there is none of that name, or everything is placed in the world already.
        PoseError: the named one has no orientations.
    """
    if not needs_ego(scene):
        if trajectory is not None:
            raise OptionError(
                f"{scene.source}: its points and sensors are placed in the world already; a trajectory cannot be chosen"
            )
        return None
    if isinstance(trajectory, EgoMotion):
        return trajectory
    if trajectory is None:
        default = next(iter(scene.trajectories.values()), None)
        return None if default is None or default.quaternions_xyzw is None else EgoMotion.of(default)
    if trajectory in scene.trajectories:
        return EgoMotion.of(scene.trajectories[trajectory])
    if trajectory == _IDENTITY:
        return EgoMotion(_IDENTITY, Poses.identity())
    choices = ", ".join([*scene.trajectories, _IDENTITY])
    raise OptionError(
        f"{scene.source}: no trajectory {trajectory!r}; there are: {choices}; "
        "one that `sceneloom.motion.ego_trajectory.find_ego_motion` finds can be handed in"
    )


def locations_of(scene: Scene, sensors: Iterable[Posed], ego: EgoMotion | None) -> dict[Identifier, _Location]:
    """Give the locations of sensors by id; a sensor of which nothing is known has a location that says why."""
    found, period_ns = {}, scene_period_ns(scene)
    for sensor in sensors:
        mount, source = _static_mount(sensor), None
        problem = f"{scene.source}: no trajectory with orientations, so that it is not known where the ego was"
        try:
            source, problem = sensor_source(scene, sensor, ego, reach_ns=period_ns), ""
        except PoseError as error:
            problem = problem if mount is not None else str(error)
        found[sensor.id] = _Location(source, problem, mount)
    return found


def frame_of_points(scene: Scene, lidar: LidarSensor | RadarSensor, ego: EgoMotion | None) -> _Location:
    """Give what takes a lidar's or radar's points as stored into the world, and into the ego's frame where rigid."""
    mounts = {PointsFrame.SENSOR: _static_mount(lidar), PointsFrame.EGO: RigidTransform.identity()}
    mount = mounts.get(lidar.points_frame)
    try:
        source = points_source(scene, lidar, ego, reach_ns=scene_period_ns(scene))
    except PoseError as error:
        return _Location(None, str(error), mount)
    return _Location(source or WORLD, "", mount)


def poses_at(locations: Sequence[tuple[_Location, int]]) -> list[_Pose]:
    """Give the pose of each location at its time [ns]; locations on one path are interpolated in one go."""
    poses = [_Pose(None, location.problem) for location, _ in locations]
    by_path: dict[int, list[int]] = {}
    for row, (location, _) in enumerate(locations):
        if location.source is not None:
            by_path.setdefault(id(location.source.path), []).append(row)
    for rows in by_path.values():
        sources = [source for row in rows if (source := locations[row][0].source) is not None]
        times = np.array([locations[row][1] for row in rows], np.int64)
        body = sources[0].path.interpolate(times, reach_ns=sources[0].reach_ns)
        rotations = matrix_from_quaternion(np.nan_to_num(body.quaternions_xyzw, nan=0.5))
        for k, (row, source) in enumerate(zip(rows, sources, strict=True)):
            if body.coverage[k] == OUT_OF_REACH:
                away_ns = max(source.path.start_ns - int(times[k]), int(times[k]) - source.path.stop_ns)
                poses[row] = _Pose(None, f"{away_ns / 1e9:.3f} s beyond the ends of the trajectory")
                continue
            moved = RigidTransform(
                rotations[k] @ source.mount.rotation, rotations[k] @ source.mount.translation + body.positions[k]
            )
            poses[row] = _Pose(moved, extrapolated=bool(body.coverage[k] == EXTRAPOLATED))
    return poses


def _static_mount(sensor: Posed) -> RigidTransform | None:
    """The mounting on the ego, stated as such or as the one pose of a sensor in ego coordinates."""
    if sensor.mount is not None:
        return sensor.mount
    if sensor.poses is None or sensor.coordinates is not Coordinates.EGO or len(sensor.poses.positions) != 1:
        return None
    return RigidTransform.from_quaternion(sensor.poses.positions[0], sensor.poses.quaternions_xyzw[0])


@dataclass(frozen=True, slots=True, eq=False)
class SamplePoses:
    """Where the sensors of a sample were.

    Attributes:
        world_from_sensor: the pose of each sensor at the time of its frame, by id; None where it is not known.
        ego_from_sensor: its rigid mounting on the ego, by id; None where there is none.
        world_from_points: takes the positions of the sweep, as they are stored, into the world; None where not known.
        ego_from_points: takes them into the ego's frame at the time of the sweep; None where they are in the world.
        unposed: why a pose in the world is not known, by id.
        extrapolated: sensors whose pose continues the trajectory beyond its ends.
    """

    world_from_sensor: Mapping[Identifier, RigidTransform | None]
    ego_from_sensor: Mapping[Identifier, RigidTransform | None]
    world_from_points: RigidTransform | None
    ego_from_points: RigidTransform | None
    unposed: Mapping[Identifier, str]
    extrapolated: tuple[Identifier, ...]

    def into(self, sensor_id: Identifier, body_id: Identifier | None) -> RigidTransform | None:
        """Give `sensor_from_body`, each at its own time; `body_id` None: of the points of the sweep as stored.

        Where a pose in the world is not known it comes from the mountings alone.
        """
        world_from_body, ego_from_body = self.world_from_points, self.ego_from_points
        if body_id is not None:
            world_from_body, ego_from_body = self.world_from_sensor[body_id], self.ego_from_sensor[body_id]
        world_from_sensor, ego_from_sensor = (self.world_from_sensor[sensor_id], self.ego_from_sensor[sensor_id])
        if world_from_sensor is not None and world_from_body is not None:
            return world_from_sensor.inverse() @ world_from_body
        if ego_from_sensor is not None and ego_from_body is not None:
            return ego_from_sensor.inverse() @ ego_from_body
        return None


_Value = TypeVar("_Value")
_Image = TypeVar("_Image", CameraImage, DepthFrame)


class _Once(Generic[_Value]):
    """Works something out when it is first called, and then keeps it; pickled, it is what was worked out."""

    def __init__(self, work_out: Callable[[], _Value]) -> None:
        """Take the work."""
        self._work_out = work_out

    def __call__(self) -> _Value:
        """Give the result."""
        return self._result

    @cached_property
    def _result(self) -> _Value:
        return self._work_out()

    def __reduce__(self) -> tuple[Any, ...]:
        return _finished, (self(),)


def _finished(result: _Value) -> _Once[_Value]:
    return _Once(partial(_itself, result))


def _itself(result: _Value) -> _Value:
    return result


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """What several sensors measured about one moment.

    Every sensor that was asked for is a key of the mappings. Where it has no frame near enough, or its pose is not
    known, the value is None, and `missing` or `unposed` says why. Images are decoded when their `rgb` is asked for,
    depth images when their `depth` is. A sample that is pickled takes pixels, poses and boxes along, so that whoever
    gets it needs no file.

    Attributes:
        index: number of the reference sensor's frame.
        timestamp_ns: the moment [ns]: the sweep's reference time (median of its point times), or that of the image.
        reference_id: the sensor that gives the moment.
        lidar_id: the lidar of `sweep`; None without any.
        sweeps: by id of the lidar.
        images: by id of the camera.
        radar_frames: by id of the radar.
        depth_frames: by id of the depth camera.
        cameras: the camera model by id of the camera or depth camera: that of the image or depth image, where there is
            one.
        times_ns: time of each frame that is there, by id [ns]; of sweeps their reference time.
        missing: why a frame is not there, by id.
        find_poses: works out where the sensors were.
        find_boxes: works out the boxes as a sensor sees them at the time of its frame, by id.
    """

    index: int
    timestamp_ns: int
    reference_id: Identifier
    lidar_id: Identifier | None
    sweeps: Mapping[Identifier, LidarFrame | None]
    images: Mapping[Identifier, CameraImage | None]
    radar_frames: Mapping[Identifier, RadarFrame | None]
    depth_frames: Mapping[Identifier, DepthFrame | None]
    cameras: Mapping[Identifier, Camera]
    times_ns: Mapping[Identifier, int]
    missing: Mapping[Identifier, str]
    find_poses: Callable[[], SamplePoses]
    find_boxes: Mapping[Identifier, Callable[[], Boxes]]

    @property
    def sweep(self) -> LidarFrame | None:
        """The reference lidar's sweep; with a camera as reference, the nearest one of the first lidar."""
        return None if self.lidar_id is None else self.sweeps[self.lidar_id]

    @property
    def boxes(self) -> Boxes:
        """The scene's boxes at the sample's moment as the reference sensor sees them, interpolated when asked for.

        A box whose activations name that sensor is there only while it is active for it, by its own computed cuboids.

        Raises:
            OptionError: unit or order of their angles is none of those known.
        """
        return self.boxes_for(self.reference_id)

    def boxes_for(self, sensor_id: Identifier) -> Boxes:
        """Give the boxes as another sensor of the sample sees them, at the time of its own frame.

        Raises:
            OptionError: the sensor has no frame in this sample, or as of `boxes`.
        """
        if sensor_id not in self.find_boxes:
            known = ", ".join(map(repr, self.find_boxes))
            raise OptionError(f"sensor {sensor_id!r} has no frame in this sample; it has frames of {known}")
        return self.find_boxes[sensor_id]()

    @property
    def poses(self) -> SamplePoses:
        """Where the sensors were, each at the time of its frame; interpolated when first asked for."""
        return self.find_poses()

    @property
    def unposed(self) -> Mapping[Identifier, str]:
        """Why the pose of a sensor in the world is not known, by id."""
        return self.poses.unposed

    @property
    def time_differences_ns(self) -> dict[Identifier, int]:
        """How much later than the sample's moment each frame that is there was taken, by id [ns]."""
        return {sensor_id: time_ns - self.timestamp_ns for sensor_id, time_ns in self.times_ns.items()}

    @property
    def world_from_lidar(self) -> RigidTransform | None:
        """Pose of the lidar of `sweep` at the sweep's reference time."""
        return None if self.lidar_id is None else self.poses.world_from_sensor[self.lidar_id]

    @property
    def world_from_camera(self) -> dict[Identifier, RigidTransform | None]:
        """Pose of each camera and depth camera at the time of its image or depth image, by id."""
        return {camera_id: self.poses.world_from_sensor[camera_id] for camera_id in self.cameras}

    @property
    def camera_from_lidar(self) -> dict[Identifier, RigidTransform | None]:
        """Takes the lidar at the sweep's reference time into each of `cameras` at the time of its image, by id.

        The ego's motion between the two times is in it. Without a trajectory (`unposed` says so) only the mountings
        are, which is right for an ego that is stationary.
        """
        poses, lidar_id = self.poses, self.lidar_id
        return {key: None if lidar_id is None else poses.into(key, lidar_id) for key in self.cameras}

    @property
    def camera_from_points(self) -> dict[Identifier, RigidTransform | None]:
        """The same for the positions of `sweep` as they are stored, whichever frame that is, by id of the camera."""
        return {camera_id: self.poses.into(camera_id, None) for camera_id in self.cameras}

    def arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Give all of it as plain arrays by name, of the same names and dtypes for every sample of a scene.

        They are the caller's own. Shapes differ from sample to sample only where counts do: of points and of boxes.
        docs/samples.md lists the names.

        Raises:
            DataError: an image or depth image cannot be decoded.
        """
        return _arrays_of(self)

    def __reduce__(self) -> tuple[Any, ...]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for images in ("images", "depth_frames"):
            values[images] = {camera_id: _with_pixels(image) for camera_id, image in values[images].items()}
        return Sample, tuple(values.values())


def _with_pixels(image: _Image | None) -> _Image | None:
    """Decode an image; one that cannot be decoded stays as it is and says so when it is asked for."""
    try:
        return None if image is None else image.loaded()
    except DataError:
        return image


_Named = tuple[str, np.ndarray[Any, Any]]
_LIDAR_ARRAYS = ("positions", "intensities", "colors", "timestamps_ns", "rings", "camera_index")
_RADAR_ARRAYS = ("positions", "directions", "lengths", "timestamps_ns")


def _arrays_of(sample: Sample) -> dict[str, np.ndarray[Any, Any]]:
    """Give all arrays of a sample by name."""
    arrays = {"index": np.array(sample.index), "timestamp_ns": np.array(sample.timestamp_ns)}
    for lidar_id, sweep in sample.sweeps.items():
        arrays.update(_cloud(lidar_id, sweep, _LIDAR_ARRAYS))
    for radar_id, frame in sample.radar_frames.items():
        arrays.update(_cloud(radar_id, frame, _RADAR_ARRAYS))
    for camera_id, camera_model in sample.cameras.items():
        arrays.update(_camera(sample, camera_id, camera_model))
    for sensor_id, world_from_sensor in sample.poses.world_from_sensor.items():
        arrays[f"{sensor_id}.found"] = np.array(sensor_id in sample.times_ns)
        arrays[f"{sensor_id}.time_ns"] = np.array(sample.times_ns.get(sensor_id, sample.timestamp_ns))
        arrays[f"{sensor_id}.world_from_sensor"] = _matrix(world_from_sensor)
    if sample.lidar_id is not None:
        arrays[f"{sample.lidar_id}.world_from_points"] = _matrix(sample.poses.world_from_points)
        for camera_id, transform in sample.camera_from_lidar.items():
            arrays[f"{camera_id}.camera_from_lidar"] = _matrix(transform)
        for camera_id, transform in sample.camera_from_points.items():
            arrays[f"{camera_id}.camera_from_points"] = _matrix(transform)
    return {**arrays, **dict(_boxes(sample))}


def _cloud(sensor_id: Identifier, frame: LidarFrame | RadarFrame | None, names: tuple[str, ...]) -> Iterator[_Named]:
    """The arrays that the points have; of a frame that is not there no points."""
    if frame is None:
        yield f"{sensor_id}.positions", np.zeros((0, 3), np.float32)
        return
    for name in names:
        array: AnyArray | None = getattr(frame.points, name)
        if array is not None:
            yield f"{sensor_id}.{name}", array.copy()


def _camera(sample: Sample, camera_id: Identifier, camera_model: Camera) -> Iterator[_Named]:
    """Pixels or depths, and the camera model; of an image that is not there black ones, of a depth image no depths."""
    size = (camera_model.height, camera_model.width)
    if camera_id in sample.images:
        image = sample.images[camera_id]
        yield f"{camera_id}.rgb", _own(image.rgb) if image else np.zeros((*size, 3), np.uint8)
    else:
        frame = sample.depth_frames[camera_id]
        yield f"{camera_id}.depth", _own(frame.depth) if frame else np.zeros(size, np.float32)
    yield f"{camera_id}.matrix", camera_model.matrix
    yield f"{camera_id}.coefficients", np.array(camera_model.coefficients, np.float64)


def _own(image: AnyArray) -> AnyArray:
    return image if image.flags.writeable else image.copy()


def _matrix(transform: RigidTransform | None) -> Float64Array:
    return np.full((4, 4), np.nan) if transform is None else transform.matrix


def _boxes(sample: Sample) -> Iterator[_Named]:
    boxes = sample.boxes
    yield "boxes.centers_world", boxes.centers_world
    yield "boxes.sizes_lwh", boxes.sizes_lwh
    yield "boxes.rotations_world", boxes.rotations_world
    numbers = np.arange(len(boxes), dtype=np.int64) if boxes.numbers is None else boxes.numbers.copy()
    yield "boxes.track_numbers", numbers
    yield "boxes.track_ids", _texts([str(identifier) for identifier in boxes.ids])
    yield "boxes.labels", _texts(["" if label is None else label for label in boxes.labels])


def _texts(texts: list[str]) -> np.ndarray[Any, Any]:
    """Texts of 64 characters, so that all samples have one dtype; wider only where one is longer."""
    return np.array(texts, f"<U{max([64, *map(len, texts)])}")


_Timestamped = TypeVar("_Timestamped", CameraImage, DepthFrame, RadarFrame)
_NONE = "it has no frames"


class _FramesByTimestamp(Generic[_Timestamped]):
    """Frames that are found by their timestamps; these need not be in order."""

    def __init__(self, frames: LazyFrames[_Timestamped]) -> None:
        """Take the frames; nothing is read."""
        self.frames: LazyFrames[_Timestamped] = frames
        self._timestamps_ns: Int64Array = frames.timestamps_ns
        self._rows: Sequence[int] = range(len(frames))
        if (self._timestamps_ns[1:] < self._timestamps_ns[:-1]).any():
            order = np.argsort(self._timestamps_ns, kind="stable")
            self._timestamps_ns, self._rows = self._timestamps_ns[order], order.tolist()

    def read(self, index: int) -> tuple[_Timestamped, int]:
        """Read a frame, and give its time [ns]."""
        frame = self.frames[index]
        return frame, frame.timestamp_ns

    def find(self, time_ns: int, tolerance_ns: int) -> tuple[_Timestamped, int] | str:
        """Read the frame nearest in time, the earlier one of two; or state why there is none."""
        row = self._nearest(time_ns)
        if row is None:
            return _NONE
        away_ns = abs(int(self._timestamps_ns[row]) - time_ns)
        return self.read(self._rows[row]) if away_ns <= tolerance_ns else _too_far(away_ns, tolerance_ns)

    def _nearest(self, time_ns: int) -> int | None:
        timestamps = self._timestamps_ns
        if len(timestamps) == 0:
            return None
        after = int(np.searchsorted(timestamps, time_ns))
        if after == 0:
            return 0
        before_ns = int(timestamps[after - 1])
        if after < len(timestamps) and int(timestamps[after]) - time_ns < time_ns - before_ns:
            return after
        # of frames with the same timestamp the first one counts
        return int(np.searchsorted(timestamps, before_ns))


class _SweepsByReference:
    """Sweeps by their reference times, which only they themselves report; the times are kept, the sweeps are not."""

    def __init__(self, frames: LazyFrames[LidarFrame], period_ns: int) -> None:
        """Take the sweeps, in the order of their timestamps, and the usual time from one to the next."""
        self.frames = frames
        self._period_ns = period_ns
        self._known: dict[int, int] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_known": {}}

    def read(self, index: int) -> tuple[LidarFrame, int]:
        """Read a sweep, its point times brought onto the scene's clock, and report its reference time [ns]."""
        frame = timed_frame(self.frames[index], self._period_ns).frame
        self._known[index] = frame.reference_ns
        return frame, frame.reference_ns

    def find(self, time_ns: int, tolerance_ns: int) -> tuple[LidarFrame, int] | str:
        """Read the sweep whose reference time is nearest, the earlier one of two; or state why there is none."""
        # sweeps around that time with unknown reference times are read for them; these are taken to be no earlier than
        # the sweeps' timestamps, and in their order
        if len(self.frames) == 0:
            return _NONE
        held: dict[int, LidarFrame] = {}
        index = max(int(np.searchsorted(self.frames.timestamps_ns, time_ns, side="right")) - 1, 0)
        while index > 0 and self._reference_ns(index, held) > time_ns:
            index -= 1
        while self._next_is_nearer(index, time_ns, held):
            index += 1
        reference_ns = self._reference_ns(index, held)
        away_ns = abs(reference_ns - time_ns)
        if away_ns > tolerance_ns:
            return _too_far(away_ns, tolerance_ns)
        return (held[index], reference_ns) if index in held else self.read(index)

    def _next_is_nearer(self, index: int, time_ns: int, held: dict[int, LidarFrame]) -> bool:
        timestamps = self.frames.timestamps_ns
        away_ns = abs(time_ns - self._reference_ns(index, held))
        if index + 1 == len(timestamps) or int(timestamps[index + 1]) - time_ns >= away_ns:
            return False
        return abs(time_ns - self._reference_ns(index + 1, held)) < away_ns

    def _reference_ns(self, index: int, held: dict[int, LidarFrame]) -> int:
        if index not in self._known:
            held[index], self._known[index] = self.read(index)
        return self._known[index]


def _too_far(away_ns: int, tolerance_ns: int) -> str:
    """Report that the nearest frame is not near enough."""
    return f"its nearest frame is {away_ns / 1e9:.3f} s away; expected at most {tolerance_ns / 1e9:.3f} s"


@dataclass(frozen=True, slots=True, eq=False)
class _Selection:
    """What was asked for."""

    scene: Scene
    reference: LidarSensor | CameraSensor  # the sensor whose frames are counted
    lidars: tuple[LidarSensor, ...]  # whose sweeps are looked for, the one of `Sample.sweep` first
    cameras: tuple[CameraSensor, ...]
    depth_cameras: tuple[DepthCameraSensor, ...]
    radars: tuple[RadarSensor, ...]
    trajectory: str | EgoMotion | None  # the ego's, or its name; None for the default
    tolerance_ns: int  # how far from the moment a frame may be

    @property
    def shooting(self) -> tuple[ShootingSensor, ...]:
        """The cameras of colours, then those of depths."""
        return self.cameras + self.depth_cameras


def _reference(scene: Scene, wanted: Identifier) -> LidarSensor | CameraSensor:
    """The lidar or camera of that id, else the first one of that kind."""
    sensors: list[LidarSensor | CameraSensor] = [*scene.lidars, *scene.cameras]
    for sensor in sensors:
        if key_of(sensor.id) == key_of(wanted):
            return sensor
    for sensor in sensors:
        if sensor.type == wanted:
            return sensor
    there = ", ".join(repr(sensor.id) for sensor in sensors) or "none, it has no such sensor"
    raise OptionError(f"{scene.source}: reference {wanted!r}; expected one of its lidars and cameras: {there}")


_Finder = _SweepsByReference | _FramesByTimestamp[Any]
_NO_POINTS = _Location(None, "there is no sweep")


@dataclass(slots=True)
class _Found:
    """What was found for a moment, by id of the sensor; the frames are of the class that the sensor gives."""

    frames: dict[Identifier, Any] = field(default_factory=dict)
    times_ns: dict[Identifier, int] = field(default_factory=dict)
    missing: dict[Identifier, str] = field(default_factory=dict)

    def add(self, sensor_id: Identifier, answer: tuple[Any, int] | str) -> None:
        if isinstance(answer, str):
            self.missing[sensor_id] = answer
        else:
            self.frames[sensor_id], self.times_ns[sensor_id] = answer


class _SampleMaker:
    """Makes the samples of a selection; a pickled one begins anew with the same selection."""

    def __init__(self, selection: _Selection) -> None:
        """Prepare what all samples share; no frame is read."""
        self.selection = selection
        scene, reference = selection.scene, selection.reference
        frames = reference.frames if isinstance(reference, LidarSensor) else reference.images
        self.count = len(frames)
        ego = choose_ego(scene, selection.trajectory)
        self.trajectory = None if ego is None else ego.name
        self._finders: dict[Identifier, _Finder] = {
            **{lidar.id: _SweepsByReference(lidar.frames, sweep_period_ns(lidar)) for lidar in selection.lidars},
            **{camera.id: _FramesByTimestamp(shots_of(camera)) for camera in selection.shooting},
            **{radar.id: _FramesByTimestamp(radar.frames) for radar in selection.radars},
        }
        sensors: list[Posed] = [*selection.lidars, *selection.shooting, *selection.radars]
        self._locations = locations_of(scene, sensors, ego)
        self._points = frame_of_points(scene, selection.lidars[0], ego) if selection.lidars else _NO_POINTS
        self._boxes = BoxTable(scene)

    def __reduce__(self) -> tuple[Any, ...]:
        return _SampleMaker, (self.selection,)

    def make(self, index: int) -> Sample:
        """Make the sample of the reference sensor's frame `index`."""
        reference_id = self.selection.reference.id
        found = _Found()
        found.add(reference_id, self._finders[reference_id].read(index))
        moment_ns = found.times_ns[reference_id]
        for sensor_id, finder in self._finders.items():
            if sensor_id != reference_id:
                found.add(sensor_id, finder.find(moment_ns, self.selection.tolerance_ns))
        return self._sample(index, moment_ns, found)

    def _sample(self, index: int, moment_ns: int, found: _Found) -> Sample:
        selection, frames = self.selection, found.frames
        return Sample(
            index=index,
            timestamp_ns=moment_ns,
            reference_id=selection.reference.id,
            lidar_id=selection.lidars[0].id if selection.lidars else None,
            sweeps={lidar.id: frames.get(lidar.id) for lidar in selection.lidars},
            images={camera.id: frames.get(camera.id) for camera in selection.cameras},
            radar_frames={radar.id: frames.get(radar.id) for radar in selection.radars},
            depth_frames={camera.id: frames.get(camera.id) for camera in selection.depth_cameras},
            cameras={camera.id: frames.get(camera.id, camera).camera for camera in selection.shooting},
            times_ns=found.times_ns,
            missing=found.missing,
            find_poses=_Once(partial(self._poses, frames, found.times_ns)),
            find_boxes={
                sensor_id: _Once(partial(self._boxes_of, sensor_id, time_ns, found.frames[sensor_id]))
                for sensor_id, time_ns in found.times_ns.items()
            },
        )

    def _boxes_of(self, sensor_id: Identifier, time_ns: int, frame: Any) -> Boxes:
        """The boxes as a sensor sees them at the time of its frame."""
        return self._boxes.at(time_ns, sensor_id=sensor_id, window_ns=(int(frame.timestamp_ns), time_ns))

    def _locations_for(self, frames: Mapping[Identifier, Any]) -> dict[Identifier, _Location]:
        """The sensors' locations, of cameras those of images that have a mounting of their own."""
        locations = dict(self._locations)
        for sensor_id, frame in frames.items():
            if isinstance(frame, Shot) and frame.mount is not None:
                location = locations[sensor_id]
                source = None if location.source is None else location.source.mounted(frame.mount)
                locations[sensor_id] = replace(location, source=source, mount=frame.mount)
        return locations

    def _poses(self, frames: Mapping[Identifier, Any], times_ns: Mapping[Identifier, int]) -> SamplePoses:
        """Poses of the sensors, each at the time of its frame, and that of the stored points."""
        locations = self._locations_for(frames)
        asked = [(locations[key], time_ns) for key, time_ns in times_ns.items()]
        lidars = self.selection.lidars
        swept_ns = times_ns.get(lidars[0].id) if lidars else None
        if swept_ns is not None:
            asked.append((self._points, swept_ns))
        poses = poses_at(asked)
        points = _Pose(None) if swept_ns is None else poses.pop()
        found = {key: _Pose(None, "it has no frame in this sample") for key in locations}
        found |= dict(zip(times_ns, poses, strict=True))
        return SamplePoses(
            world_from_sensor={key: pose.world_from_sensor for key, pose in found.items()},
            ego_from_sensor={key: location.mount for key, location in locations.items()},
            world_from_points=points.world_from_sensor,
            ego_from_points=self._points.mount,
            unposed={key: pose.problem for key, pose in found.items() if pose.problem},
            extrapolated=tuple(key for key, pose in found.items() if pose.extrapolated),
        )


_Item = TypeVar("_Item")


class Samples(Sequence[Sample]):
    """The synchronised sets of a scene, one per frame of the reference sensor.

    Nothing is read before a sample is asked for, and nothing but reference times is kept. Any sample can be had at any
    time; going forward is the fastest way through videos. Samples can be pickled, and forked processes can use
    them: each process opens the scene's files for itself.
    """

    def __init__(self, maker: _SampleMaker, rows: range) -> None:
        """Take what makes the samples, and which of them these are."""
        self._maker, self._rows = maker, rows

    @classmethod
    def of(
        cls,
        scene: Scene,
        *,
        reference: Identifier = "lidar",
        cameras: Choice = ALL,
        depth_cameras: Choice = ALL,
        lidars: Choice | None = None,
        radars: Choice = (),
        trajectory: str | EgoMotion | None = None,
        tolerance_ns: int | None = None,
    ) -> "Samples":
        """Give the synchronised sets of a scene; `Scene.samples` describes the arguments."""
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
        if tolerance_ns is None:
            # one sweep period, or the time from image to image where there is no lidar
            tolerance_ns = sweep_period_ns(chosen_lidars[0]) if chosen_lidars else usual_period_ns(frame_times(counted))
        selection = _Selection(
            scene,
            counted,
            chosen_lidars,
            chosen_cameras,
            chosen_sensors(scene, "depth camera", depths_there, depth_cameras),
            chosen_sensors(scene, "radar", radars_there, radars),
            trajectory,
            tolerance_ns,
        )
        maker = _SampleMaker(selection)
        return cls(maker, range(maker.count))

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self._maker.selection.scene

    @property
    def reference_id(self) -> Identifier:
        """The sensor whose frames are counted."""
        return self._maker.selection.reference.id

    @property
    def tolerance_ns(self) -> int:
        """How far from a sample's moment a frame may be [ns]."""
        return self._maker.selection.tolerance_ns

    @property
    def trajectory(self) -> str | None:
        """Name of the trajectory that poses come from; None where there is none, or the sensors' own poses state it."""
        return self._maker.trajectory

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> "Samples": ...
    def __getitem__(self, index: int | slice) -> "Sample | Samples":
        if isinstance(index, slice):
            return Samples(self._maker, self._rows[index])
        return self._maker.make(self._rows[index])

    def __iter__(self) -> Iterator[Sample]:
        return map(self._maker.make, self._rows)

    def map(self, function: Callable[[Sample], _Item]) -> "MappedSamples[_Item]":
        """Give what a function makes of each sample, made when it is asked for: what a loader's workers hand on.

        Args:
            function: such as `Sample.arrays`; one of a module, if it is to be pickled.
        """
        return MappedSamples(self, function)


class MappedSamples(Sequence[_Item], Generic[_Item]):
    """What a function makes of each sample; nothing is made before it is asked for, nothing kept."""

    def __init__(self, samples: Samples, function: Callable[[Sample], _Item]) -> None:
        """Take the samples and the function."""
        self.samples, self._function = samples, function

    def __len__(self) -> int:
        return len(self.samples)

    @overload
    def __getitem__(self, index: int) -> _Item: ...
    @overload
    def __getitem__(self, index: slice) -> "MappedSamples[_Item]": ...
    def __getitem__(self, index: int | slice) -> "_Item | MappedSamples[_Item]":
        if isinstance(index, slice):
            return MappedSamples(self.samples[index], self._function)
        return self._function(self.samples[index])

    def __iter__(self) -> Iterator[_Item]:
        return map(self._function, self.samples)
