"""What tools that label point clouds have in common: frames of a cloud and its images, and cuboids and points in them.

Reading makes a scene of `TaskFrame`s and tracks; writing goes through the `WrittenFrame`s of a `TaskPlan`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt32Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.images import ImageFile, images_image_size, is_jpeg, with_pinholes, write_image
from sceneloom.formats.base.losses import Losses, Support, Supports, field_losses
from sceneloom.formats.base.output import file_stem
from sceneloom.formats.base.poses import STATIONARY_EGO, ego_in_world, lengths_of
from sceneloom.formats.base.spec import as_positive
from sceneloom.formats.points.reader import listed_frames, numbers_of_names, times_of_names
from sceneloom.formats.points.spec import KINDS
from sceneloom.geometry.rigid import (
    RigidTransform,
    angle_between,
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    normalise_quaternion,
    rotate_vectors,
)
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    LabeledPoints,
    LabeledPointsAnnotation,
)
from sceneloom.scene.annotations_at import (
    CuboidAngles,
    CuboidPoses,
    annotations_frame,
    attribute_at,
    cuboid_poses,
    not_in_world,
)
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, PoseSource, Trajectory
from sceneloom.scene.samples import choose_ego, frame_of_points, locations_of
from sceneloom.scene.scene import Scene, Sensor, sweep_period_ns
from sceneloom.scene.types import Coordinates, Identifier, Key, PointsFrame, key_of
from sceneloom.warnings import WarningKind

if TYPE_CHECKING:
    from sceneloom.formats.points.writer import FrameFiles

LIDAR_ID = "lidar"
"""What the lidar of a task is called."""

SECOND_NS = 1_000_000_000
_STATIONARY = "stationary"  # the trajectory of clouds whose poses are not known
_FARTHEST = 1e7  # no box and no camera is farther from 0, or larger, than this [m]
_RIGID_WITHIN_M, _RIGID_WITHIN = 0.001, 1e-4  # [m], [rad]: how far the mountings of one camera may be apart
_MOST_FRAMES = 10_000_000
_CUBOID, _POINTS = "annotations.cuboid", "annotations.labeled_points"


class XYZ(msgspec.Struct):
    """Three numbers by the names of axes."""

    x: float
    y: float
    z: float

    def array(self, path: object, location: str) -> Float64Array:
        """Give them, (3,) float64.

        Raises:
            DataError: one is not finite, or larger than what is measured in metres.
        """
        values = (self.x, self.y, self.z)
        if not all(isfinite(value) and abs(value) < _FARTHEST for value in values):
            raise DataError(path, location, f"{list(values)}; expected finite numbers below {_FARTHEST:g}")
        return np.array(values, np.float64)


def xyz(values: Float64Array) -> dict[str, float]:
    """Three numbers, (3,), by the names of axes."""
    return dict(zip("xyz", values.tolist(), strict=True))


def rigid_of(path: object, location: str, position: Float64Array, quaternion_xyzw: Iterable[float]) -> RigidTransform:
    """Make a pose of a position and a quaternion.

    Raises:
        DataError: the quaternion is not of length 1, within a hundredth.
    """
    quaternion = np.array([*quaternion_xyzw], np.float64)
    if lengths_of(quaternion[None])[1][0]:
        raise DataError(path, location, f"x, y, z, w = {quaternion.tolist()}; expected a quaternion of length 1")
    return RigidTransform.from_quaternion(position, normalise_quaternion(quaternion))


def rigid_of_rows(path: object, location: str, numbers: Sequence[float]) -> RigidTransform:
    """Make a transform of the 12 or 16 numbers of its matrix, row by row.

    Raises:
        DataError: they are of another number, not finite, or no rotation within a thousandth.
    """
    expected = "expected the 12 or 16 numbers of a rotation and a translation, row by row"
    if len(numbers) not in (12, 16) or not all(isfinite(number) and abs(number) < _FARTHEST for number in numbers):
        raise DataError(path, location, f"{len(numbers)} numbers, {list(numbers)[:4]} …; {expected}")
    matrix = np.eye(4)
    matrix[:3] = np.array(numbers[:12], np.float64).reshape(3, 4)
    if len(numbers) == 16 and not np.allclose(numbers[12:], [0, 0, 0, 1]):
        raise DataError(path, location, f"its last row is {list(numbers[12:])}; expected 0, 0, 0, 1")
    try:
        transform, off = RigidTransform.nearest(matrix)
    except CalibrationError as error:
        raise DataError(path, location, str(error)) from error
    if off > 1e-3:
        raise DataError(path, location, f"a matrix {off:.2g} off a rotation; {expected}")
    return transform


def pinhole_of(path: object, location: str, image: Path, numbers: Sequence[float], losses: Ledger) -> Camera:
    """Make a pinhole of the nine numbers of its matrix, row by row, and the size of an image.

    Raises:
        DataError: they are no such matrix, or the image cannot be read.
    """
    if len(numbers) != 9 or not all(map(isfinite, numbers)):
        raise DataError(path, location, f"{list(numbers)[:4]} …; expected the nine numbers of a camera matrix")
    fx, skew, cx, _, fy, cy = numbers[:6]
    if abs(skew) > 1e-6 * abs(fx):
        message = "the skew of camera matrices is not used"
        losses.note(WarningKind.SKIPPED, "camera-skew", str(path), message)
    return camera_of(path, location, image, "pinhole", (fx, fy, cx, cy))


def camera_of(
    path: object, location: str, image: Path, model: str, numbers: Sequence[float], coefficients: Sequence[float] = ()
) -> Camera:
    """Make a camera model of fx, fy, cx, cy, coefficients and the size of an image.

    Raises:
        DataError: the numbers are no camera, or the image cannot be read.
    """
    try:
        width, height = images_image_size(image)
        fx, fy, cx, cy = map(float, numbers)
        return Camera(model, width, height, fx, fy, cx, cy, tuple(map(float, coefficients)))
    except CalibrationError as error:
        raise DataError(path, location, str(error)) from error


def identifier_of(text: str) -> Identifier:
    """Give the id that a text stands for in files whose ids are texts: a whole number where it is written as one."""
    is_number = text.isascii() and text.isdigit() and len(text) < 16
    return int(text) if is_number and str(int(text)) == text else text


def unique_text(taken: dict[str, Identifier], identifier: Identifier, losses: Losses) -> str:
    """Give the text of an id, which no other has; where it is read as another one, that is reported.

    Args:
        taken: ids by their texts, to which this is added.
    """
    text = next((text for text, one in taken.items() if key_of(one) == key_of(identifier)), None)
    if text is None:
        text = str(identifier)
        while text in taken or not text:
            text += "~"
        taken[text] = identifier
        if key_of(identifier_of(text)) != key_of(identifier):
            losses.converted(f"{_CUBOID}.id", f"{identifier!r} is read back as {identifier_of(text)!r}")
    return text


def task_file(root: Path, path: object, location: str, name: str) -> Path:
    """Give the path of a file that a task names.

    Raises:
        DataError: the name leads out of the task.
    """
    parts = PurePosixPath(name).parts
    if not parts or PurePosixPath(name).is_absolute() or ".." in parts or "\0" in name:
        raise DataError(path, location, f"{name!r}; expected the name of a file inside of the task")
    return root.joinpath(*parts)


def frame_times(
    names: Sequence[str], location: Path, ledger: Ledger, *, rate_hz: float | str | None, usual_hz: float = 10.0
) -> Int64Array:
    """Give the times of frames [ns]: of their names where these end with times, else so many a second.

    Args:
        names: of the frames in their order, without endings.
        location: for messages.
        rate_hz: frames a second; None: what the names state, else `usual_hz`, which is reported.

    Raises:
        OptionError: the rate is no number above 0.
        DataError: a frame is not later than the one before.
    """
    rate = None if rate_hz is None else as_positive("rate_hz", rate_hz)
    stated = times_of_names(names) if rate is None else None
    if stated is None:
        if rate is None:
            message = f"names of frames have no times: {usual_hz:g} frames a second, from 0"
            ledger.note(WarningKind.ASSUMED, "nominal-times", str(location), message, count=len(names))
        numbers = numbers_of_names(names)
        counts = range(len(names)) if numbers is None else [number - numbers[0] for number in numbers]
        if len(counts) and max(counts) > _MOST_FRAMES:
            raise DataError(location, names[-1], f"{max(counts)} frames after the first; expected numbers of frames")
        stated = [round(count * SECOND_NS / (usual_hz if rate is None else rate)) for count in counts]
    times = np.array(stated, np.int64)
    for k in np.flatnonzero(np.diff(times) <= 0)[:1].tolist():
        raise DataError(location, names[k + 1], f"is not later than {names[k]}; expected frames in order of time")
    return times


# reading


@dataclass(frozen=True, slots=True, eq=False)
class TaskImage:
    """An image beside a cloud.

    Attributes:
        camera_id: its camera.
        path: the file.
        name: of the file, seen from the task's root.
        timestamp_ns: when it was taken [ns].
        camera: the camera model.
        cloud_from_camera: where the camera was at that time, in the frame of the cloud at the cloud's time.
    """

    camera_id: str
    path: Path
    name: str
    timestamp_ns: int
    camera: Camera
    cloud_from_camera: RigidTransform


@dataclass(frozen=True, slots=True, eq=False)
class TaskFrame:
    """A cloud and its images.

    Attributes:
        name: of the frame, for messages.
        timestamp_ns: its time [ns].
        cloud: the file of its points; None where it is missing.
        world_from_cloud: where the cloud's frame is; None where the task does not state it.
        images: of different cameras.
    """

    name: str
    timestamp_ns: int
    cloud: Path | None
    world_from_cloud: RigidTransform | None = None
    images: tuple[TaskImage, ...] = ()


def note_missing_clouds(frames: Sequence[TaskFrame], location: Path, ledger: Ledger) -> None:
    """Warn of frames without a cloud: exports without data have labels only."""
    missing = sum(frame.cloud is None for frame in frames)
    if missing:
        message = f"clouds of {missing} of {len(frames)} frames are not there; their labels are read"
        ledger.note(WarningKind.SKIPPED, "clouds-missing", str(location), message, count=missing)


@dataclass(slots=True)
class _Track:
    """What is stated of one object, frame by frame."""

    label: str | None
    rows: dict[int, tuple[Float64Array, Float64Array, Float64Array]] = field(default_factory=dict)
    stated: dict[str, dict[int, Any]] = field(default_factory=dict)


class TaskTracks:
    """Collects the boxes of a task's objects."""

    def __init__(self) -> None:
        """Begin without any."""
        self._tracks: dict[Key, _Track] = {}

    def add(
        self,
        path: object,
        location: str,
        identifier: Identifier,
        frame: int,
        label: str | None,
        box: tuple[Float64Array, Float64Array, Float64Array],
        *,
        stated: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        """Add a box of an object.

        Args:
            path, location: where it is stated, for messages.
            identifier: the object.
            frame: number of the frame.
            label: its class; where that changes, it is an attribute, too.
            box: centre (3,) [m], size (3,) length, width, height [m], rotation (4,) x, y, z, w.
            stated: attributes in that frame.

        Raises:
            DataError: the object has two boxes in the frame, or the box has no volume.
        """
        if not (box[1] > 0).all():
            raise DataError(path, location, f"size {box[1].tolist()}; expected sizes above 0")
        track = self._tracks.setdefault(key_of(identifier), _Track(label))
        if frame in track.rows:
            raise DataError(path, location, f"object {identifier!r} is in the frame twice; expected it once")
        track.rows[frame] = box
        for name, value in {**stated, **({} if label is None else {"label": label})}.items():
            track.stated.setdefault(name, {})[frame] = value

    def cuboids(
        self,
        times_ns: Int64Array,
        world: "TaskWorld | None",
        *,
        lidar_id: Identifier | None,
        attributes: Mapping[Key, Sequence[AttributePath]] = MappingProxyType({}),
    ) -> list[CuboidAnnotation]:
        """Give a cuboid for each object, in the order in which they were first added.

        Args:
            times_ns: (N,) of the frames.
            world: where the clouds are that boxes are in; None where these are in the world.
            lidar_id: the lidar by which an object is not seen in frames between its own; None without one.
            attributes: further ones, by object.
        """
        found = []
        for key, track in self._tracks.items():
            frames = sorted(track.rows)
            centers, sizes, quaternions = (np.array([track.rows[k][part] for k in frames]) for part in range(3))
            if world is not None:
                rotations = world.quaternions_xyzw[frames]
                centers = rotate_vectors(rotations, centers) + world.positions[frames]
                quaternions = multiply_quaternions(rotations, quaternions)
            values = np.hstack([sizes, centers, CuboidAngles().from_quaternions(quaternions)])
            stated = track.stated.items()
            own = [_changes(name, at, times_ns) for name, at in stated if name != "label" or _changing(at)]
            found.append(
                CuboidAnnotation(
                    key[1],
                    CuboidPath(times_ns[frames], values),
                    track.label,
                    attributes=(*attributes.get(key, ()), *own),
                    activations=() if lidar_id is None else _presence(frames, times_ns, lidar_id),
                )
            )
        return found


def _changing(stated: Mapping[int, Any]) -> bool:
    return len(set(map(repr, stated.values()))) > 1


def _changes(name: str, stated: Mapping[int, Any], times_ns: Int64Array) -> AttributePath:
    """What is stated, at the times when that changes."""
    frames = sorted(stated)
    kept = [k for k, frame in enumerate(frames) if k == 0 or stated[frame] != stated[frames[k - 1]]]
    values = tuple(stated[frames[k]] for k in kept)
    return AttributePath(name, values, times_ns[[frames[k] for k in kept]])


def _presence(frames: Sequence[int], times_ns: Int64Array, lidar_id: Identifier) -> tuple[Activation, ...]:
    """When the lidar sees an object that is not in all frames between its first and last one."""
    if frames[-1] - frames[0] + 1 == len(frames):
        return ()
    numbers = np.array(frames)
    cuts = np.flatnonzero(np.diff(numbers) > 1)
    first, last = np.insert(numbers[cuts + 1], 0, numbers[0]), np.append(numbers[cuts], numbers[-1])
    durations = tuple((times_ns[last] - times_ns[first] + 1).tolist())  # the end of an activation does not count
    return (Activation(lidar_id, times_ns[first], durations),)


@dataclass(frozen=True, slots=True, eq=False)
class TaskWorld:
    """Where the clouds of a task are.

    Attributes:
        times_ns: (N,) of the frames.
        trajectory: of the clouds' frame, which is the ego's.
        positions: (N, 3) float64 [m], of each frame's cloud in the world.
        quaternions_xyzw: (N, 4) float64, the same.
    """

    times_ns: Int64Array
    trajectory: Trajectory
    positions: Float64Array
    quaternions_xyzw: Float64Array

    @classmethod
    def of(cls, frames: Sequence[TaskFrame], location: Path, ledger: Ledger) -> "TaskWorld":
        """Take the poses that frames state; without any, each cloud's frame is the world's, which is reported.

        Raises:
            DataError: some frames have a pose and others none, and the reading is not lenient.
        """
        times = np.array([frame.timestamp_ns for frame in frames], np.int64)
        known = [(frame.timestamp_ns, frame.world_from_cloud) for frame in frames if frame.world_from_cloud is not None]
        if not known:
            message = "the poses of the clouds are not known: boxes are placed as if the ego was stationary"
            ledger.note(WarningKind.ASSUMED, "ego-stands", str(location), message)
            still = np.zeros((len(frames), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(frames), 1))
            ends = np.unique([0, len(frames) - 1])
            trajectory = Trajectory(_STATIONARY, times[ends], *(read_only(part[ends]) for part in still))
            return cls(times, trajectory, *still)
        if len(known) < len(frames):
            name = next(frame.name for frame in frames if frame.world_from_cloud is None)
            problem = f"frame {name} has no pose, and others have; expected one for each"
            ledger.fault("poses-missing", DataError(location, "", problem), count=len(frames) - len(known))
        positions = np.array([pose.translation for _, pose in known])
        quaternions = np.array([pose.quaternion_xyzw for _, pose in known])
        stated = np.array([time for time, _ in known], np.int64)
        trajectory = Trajectory("pose", stated, read_only(positions), read_only(quaternions))
        held = trajectory.poses.held(times)
        return cls(times, trajectory, held.positions, held.quaternions_xyzw)

    def poses(self, rows: Sequence[int]) -> Poses | None:
        """The poses of some frames, by number; None without any."""
        if not rows:
            return None
        return Poses(self.times_ns[rows], self.positions[rows], self.quaternions_xyzw[rows])


def lidar_of(
    frames: Sequence[TaskFrame], world: TaskWorld, ledger: Ledger, *, keep_all: bool = False
) -> LidarSensor | None:
    """Make the lidar of the frames that have a cloud; None without any.

    Args:
        keep_all: as of `listed_frames`.
    """
    there = [k for k, frame in enumerate(frames) if frame.cloud is not None]
    files = [frame.cloud for frame in frames if frame.cloud is not None]
    if not files:
        return None
    times = np.array([frames[k].timestamp_ns for k in there], np.int64)
    sweeps, extras = listed_frames(files, times, ledger, keep_all=keep_all)
    return posed_lidar(sweeps, world.poses(there), extras=extras)


def posed_lidar(
    sweeps: LazyFrames[LidarFrame],
    poses: Poses | None,
    *,
    points_frame: PointsFrame = PointsFrame.SENSOR,
    extras: Mapping[str, Any] = MappingProxyType({}),
) -> LidarSensor:
    """Make a lidar of its sweeps and their poses; the ego is where it is."""
    mount = RigidTransform.identity()
    return LidarSensor(LIDAR_ID, sweeps, poses, mount, points_frame=points_frame, extras=extras)


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """Reads the images of one camera."""

    images: tuple[TaskImage, ...]

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without decoding it."""
        image = self.images[k]
        file = ImageFile(image.path, image.camera.width, image.camera.height)
        encoded = file.encoded if is_jpeg(image.path) else None
        return CameraImage(
            image.timestamp_ns, image.camera, file, extras=MappingProxyType({"file": image.name}), encoded=encoded
        )


def cameras_of(frames: Sequence[TaskFrame], world: TaskWorld, location: Path, ledger: Ledger) -> list[CameraSensor]:
    """Make the cameras of a task's images, by name; a mounting is found where that of all images is the same."""
    found: dict[str, dict[int, tuple[int, TaskImage]]] = {}
    again = 0
    for number, frame in enumerate(frames):
        for image in frame.images:
            own, chosen = found.setdefault(image.camera_id, {}), image
            if image.timestamp_ns in own and world.trajectory.name == _STATIONARY:
                # the same image beside two clouds: where it is in each is not the same
                chosen = replace(image, timestamp_ns=frame.timestamp_ns)
            again += chosen.timestamp_ns in own
            own.setdefault(chosen.timestamp_ns, (number, chosen))
    if again:
        message = "images of one camera and time are left out but for the first"
        ledger.note(WarningKind.SKIPPED, "same-images", str(location), message, count=again)
    return [_camera(name, [own[time] for time in sorted(own)], world) for name, own in sorted(found.items())]


def _camera(name: str, listed: Sequence[tuple[int, TaskImage]], world: TaskWorld) -> CameraSensor:
    frames, images = [number for number, _ in listed], tuple(image for _, image in listed)
    times = np.array([image.timestamp_ns for image in images], np.int64)
    clouds, locations = world.quaternions_xyzw[frames], [image.cloud_from_camera for image in images]
    positions = rotate_vectors(clouds, np.array([one.translation for one in locations])) + world.positions[frames]
    quaternions = multiply_quaternions(clouds, np.array([one.quaternion_xyzw for one in locations]))
    held = world.trajectory.poses.held(times)
    ego_from_world = conjugate_quaternion(held.quaternions_xyzw)
    on_ego = rotate_vectors(ego_from_world, positions - held.positions)
    rotated = multiply_quaternions(ego_from_world, quaternions)
    apart = np.linalg.norm(on_ego - on_ego[0], axis=1).max()
    is_rigid = apart <= _RIGID_WITHIN_M and angle_between(rotated, rotated[0]).max() <= _RIGID_WITHIN
    return CameraSensor(
        id=name,
        camera=images[0].camera,
        images=LazyFrames(times, _Images(images), stage=None),
        poses=Poses(times, positions, quaternions),
        mount=RigidTransform.from_quaternion(on_ego[0], rotated[0]) if is_rigid else None,
    )


def instance_points(
    labels: Mapping[tuple[Identifier, str | None, bool], Mapping[int, UInt32Array]],
) -> list[LabeledPointsAnnotation]:
    """Give annotations of labelled points.

    Args:
        labels: rows of points by number of the lidar's frame; by id, class, and whether it is one object.
    """
    return [
        LabeledPointsAnnotation(
            identifier,
            tuple(LabeledPoints(LIDAR_ID, rows, frame) for frame, rows in sorted(entries.items())),
            label,
            is_instance=is_instance,
        )
        for (identifier, label, is_instance), entries in labels.items()
    ]


def task_scene(
    sensors: Sequence[Sensor | None],
    annotations: Sequence[Annotation],
    world: TaskWorld,
    ledger: Ledger,
    *,
    source: Path | str,
    format: str,
    about: Mapping[str, Any],
    attributes: Sequence[AttributePath] = (),
) -> Scene:
    """Put a scene together; `about` is kept as `metadata[format]`."""
    angles = CuboidAngles()
    ours = {"euler_unit": str(angles.unit), "euler_order": angles.order}
    return Scene(
        sensors=tuple(sensor for sensor in sensors if sensor is not None),
        annotations=tuple(annotations),
        trajectories=MappingProxyType({world.trajectory.name: world.trajectory}),
        attributes=tuple(attributes),
        metadata=MappingProxyType({"sceneloom": ours, format: dict(about)}),
        source=str(source),
        format=format,
        warnings=ledger.warnings,
    )


# writing


@dataclass(frozen=True, slots=True, eq=False)
class WrittenBox:
    """A cuboid in a frame.

    Attributes:
        number: of the cuboid among the plan's.
        cuboid: the annotation.
        center, size_lwh, quaternion_xyzw: in the frame of the cloud, or the world where that was asked for.
        stated: values of its attributes.
    """

    number: int
    cuboid: CuboidAnnotation
    center: Float64Array
    size_lwh: Float64Array
    quaternion_xyzw: Float64Array
    stated: Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class WrittenImage:
    """The image of a camera that is nearest to a cloud.

    Attributes:
        camera_id: its camera.
        stem: name of its file without ending; the same image has the same one.
        image: the image.
        cloud_from_camera: the camera at the image's time, in the frame of the cloud; None where it is not known.
    """

    camera_id: Identifier
    stem: str
    image: CameraImage
    cloud_from_camera: RigidTransform | None


@dataclass(frozen=True, slots=True, eq=False)
class WrittenFrame:
    """A frame of a task.

    Attributes:
        number: of the frame.
        name: made of its time.
        timestamp_ns: its time [ns].
        sweep: the points, in the frame of the cloud.
        world_from_cloud: where that is; the identity where it is not known.
        boxes: the cuboids that are there.
        images: of the cameras that have one near enough.
        labelled: numbers of labelled points annotations among the plan's, and the rows of their points.
    """

    number: int
    name: str
    timestamp_ns: int
    sweep: LidarFrame
    world_from_cloud: RigidTransform
    boxes: tuple[WrittenBox, ...]
    images: tuple[WrittenImage, ...]
    labelled: tuple[tuple[int, UInt32Array], ...]


@dataclass(frozen=True, slots=True)
class TaskOptions:
    """How a task is written.

    Attributes:
        lidar: id of the lidar whose sweeps are the clouds; None for the first one.
        points_frame: frame of the clouds: "sensor" or "world"; None for the tool's usual one.
        trajectory: the ego's, as of `ego_in_world`.
    """

    lidar: str | None = None
    points_frame: str | None = None
    trajectory: str | None = None

    def __post_init__(self) -> None:
        frames = (PointsFrame.SENSOR, PointsFrame.WORLD)
        if self.points_frame not in (None, *frames):
            raise OptionError(f"points_frame {self.points_frame!r}; expected one of {', '.join(frames)}")


class TaskPlan:
    """What of a scene a task holds, frame by frame.

    Attributes:
        scene: the scene; its cameras have models that the tool knows.
        lidar: whose sweeps are the clouds.
        cuboids: those that are in a frame.
        labelled: labelled points of the lidar.
        names: of the frames.
        times_ns: (N,) of the frames.
        losses: takes what a task cannot hold.
    """

    def __init__(
        self,
        scene: Scene,
        supports: Supports,
        options: TaskOptions,
        *,
        usual_frame: PointsFrame = PointsFrame.SENSOR,
        boxes_in_world: bool = False,
        camera_models: Iterable[str] = ("pinhole",),
        holds_points: bool = False,
        holds_times: bool = False,
    ) -> None:
        """Decide about a scene; no frame is read.

        Args:
            supports: the table of the format.
            usual_frame: the tool's frame of clouds.
            boxes_in_world: whether the tool has boxes in the world, whatever the frame of its clouds.
            camera_models: those that the tool has.
            holds_points: whether the tool has labelled points.
            holds_times: whether the tool has times of points.

        Raises:
            OptionError: there is no such lidar or no sweep, or the annotations are not in the world.
            PoseError: a named trajectory cannot be taken.
        """
        self.losses = Losses(loss for loss in field_losses(scene, supports) if loss.support is Support.DROPPED)
        if annotations_frame(scene) is not Coordinates.WORLD and scene.annotations:
            raise not_in_world(scene.source)
        self.scene = with_pinholes(scene, self.losses, keep=camera_models)
        self.lidar = _chosen_lidar(self.scene, options.lidar, self.losses)
        self._boxes_in_world, self._holds_times = boxes_in_world, holds_times
        self.times_ns = self._frame_times()
        self.names = tuple(f"{time:0{19 if time >= 0 else 20}d}" for time in self.times_ns.tolist())
        self._ego = self._find_ego(options.trajectory)
        self._locations = locations_of(self.scene, [self.lidar, *self.scene.cameras], self._ego)
        wanted = usual_frame if options.points_frame is None else PointsFrame(options.points_frame)
        self._place(wanted)
        self._take_cuboids()
        self._take_points(held=holds_points)
        self._used: dict[Key, set[int]] = {}
        self._note_cameras()

    def _frame_times(self) -> Int64Array:
        """Times of the sweeps that names can be made of: equal ones are put a nanosecond apart."""
        times = self.lidar.frames.timestamps_ns
        later = np.arange(len(times))
        distinct = np.maximum.accumulate(times - later) + later
        what, count = "frames of one time put 1 ns apart, which their names need", int((distinct != times).sum())
        error = float((distinct - times).max(initial=0))
        self.losses.approximated("sensors.lidar.frames.timestamp_ns", what, count=count, error=error)
        return np.asarray(distinct, np.int64)

    def _find_ego(self, trajectory: str | None) -> EgoMotion | None:
        if trajectory is None:
            try:
                return choose_ego(self.scene, None)
            except OptionError:  # everything is placed in the world already
                return None
        ego, reported = ego_in_world(self.scene, name=trajectory)
        self.losses.extend(reported)
        return ego

    def _place(self, wanted: PointsFrame) -> None:
        """Find where the clouds are, and what takes stored points into their frame."""
        stored = self.lidar.points_frame
        times = self.lidar.frames.timestamps_ns
        location = frame_of_points(self.scene, self.lidar, self._ego)
        points = self._poses_at(location.source, times)
        if stored is PointsFrame.WORLD:
            points = [RigidTransform.identity()] * len(times)
        sensor = self._poses_at(self._locations[self.lidar.id].source, times)
        boxed = any(isinstance(one, CuboidAnnotation) for one in self.scene.annotations)
        if points is None and (boxed or wanted is PointsFrame.WORLD):
            self.losses.extend([STATIONARY_EGO])
        self.posed = points is not None
        points = points or [RigidTransform.identity()] * len(times)
        if wanted is PointsFrame.WORLD:
            self.world_from_cloud = [RigidTransform.identity()] * len(times)
            self._device = sensor or points
        elif stored is PointsFrame.WORLD and sensor is not None:
            self.world_from_cloud = self._device = sensor
        else:
            self.world_from_cloud = self._device = points
        self._cloud_from_points = [
            there.inverse() @ here for there, here in zip(self.world_from_cloud, points, strict=True)
        ]

    def device(self, number: int) -> RigidTransform:
        """Where the lidar was in the world in a frame; the frame of its points where that is not known."""
        return self._device[number]

    def _poses_at(self, source: PoseSource | None, times_ns: Int64Array) -> list[RigidTransform] | None:
        """Poses at times; beyond the ends of the path its end poses hold, which is reported."""
        if source is None:
            return None
        samples = source.at(times_ns)
        beyond = ~np.isfinite(samples.positions[:, 0])
        if beyond.any():
            held = source.at(np.clip(times_ns, source.path.start_ns, source.path.stop_ns))
            what = "frames beyond the ego trajectory have its end poses"
            self.losses.approximated("trajectories.positions", what, count=int(beyond.sum()))
            samples = held
        return [*map(RigidTransform.from_quaternion, samples.positions, samples.quaternions_xyzw)]

    def _take_cuboids(self) -> None:
        angles = CuboidAngles.of(self.scene)
        times = self.lidar.frames.timestamps_ns
        self.cuboids: list[CuboidAnnotation] = []
        self._boxes: list[CuboidPoses] = []
        self._present: list[BoolArray] = []
        self._stated: list[dict[str, list[Any]]] = []
        for one in self.scene.annotations:
            if not isinstance(one, CuboidAnnotation):
                continue
            poses = cuboid_poses(one, times, angles=angles, sensor_id=self.lidar.id)
            numbers = np.hstack([poses.centers_world, poses.sizes_lwh, poses.quaternions_xyzw])
            finite = np.isfinite(numbers).all(axis=1) & (poses.sizes_lwh > 0).all(axis=1)
            what = "boxes that are no finite numbers, or have no volume, are left out"
            self.losses.dropped(f"{_CUBOID}.path", what, count=int((poses.there & ~finite).sum()))
            there = poses.there & finite
            self._report(one, there)
            if there.any():
                self.cuboids.append(one)
                self._boxes.append(poses)
                self._present.append(there)
                self._stated.append(
                    {
                        path.name: [*map(self._plain, attribute_at(path, times))]
                        for path in one.attributes
                        if self._is_held(path)
                    }
                )

    def _plain(self, value: Any) -> Any:
        """A value as JSON has it: a text, a finite number, true or false, or a list of these."""
        if value is None or isinstance(value, str | bool | int):
            return value
        if isinstance(value, float):
            if isfinite(value):
                return value
            self.losses.dropped(f"{_CUBOID}.attributes", "numbers that are not finite are left out")
            return None
        if isinstance(value, list | tuple):
            return [one for one in map(self._plain, value) if one is not None]
        self.losses.converted(f"{_CUBOID}.attributes", "values of other types are written as texts")
        return str(value)

    def _is_held(self, path: AttributePath) -> bool:
        return path.sensor_id is None or key_of(path.sensor_id) == key_of(self.lidar.id)

    def _report(self, cuboid: CuboidAnnotation, there: BoolArray) -> None:
        losses, frames = self.losses, self.lidar.frames.timestamps_ns
        others = [one for one in cuboid.activations if key_of(one.sensor_id) != key_of(self.lidar.id)]
        losses.dropped(f"{_CUBOID}.activations", "when other sensors see a cuboid is left out", count=len(others))
        what = "boxes in images are left out"
        losses.dropped(f"{_CUBOID}.projections", what, count=len(cuboid.projections))
        if not there.any():
            losses.dropped(_CUBOID, "cuboids that are in no frame are left out")
            return
        own = cuboid.path.timestamps_ns
        lost = int((~np.isin(own, frames)).sum())
        losses.dropped(f"{_CUBOID}.path.values", "boxes between frames are left out", count=lost)
        between = int((~np.isin(frames[there], own)).sum())
        losses.approximated(f"{_CUBOID}.path.values", "boxes in frames are interpolated", count=between)
        sensors = sum(not self._is_held(path) for path in cuboid.attributes)
        what = "attributes of a box as one sensor sees it are left out"
        losses.dropped(f"{_CUBOID}.attributes", what, count=sensors)

    def _take_points(self, *, held: bool) -> None:
        self.labelled: list[LabeledPointsAnnotation] = []
        self._rows: dict[int, list[tuple[int, UInt32Array]]] = {}
        for one in self.scene.annotations:
            if not held or not isinstance(one, LabeledPointsAnnotation):
                continue
            entries = [entry for entry in one.labeled_points if self._is_of_lidar(entry)]
            other = len(one.labeled_points) - len(entries)
            self.losses.dropped(_POINTS, "points of other sensors are left out", count=other)
            if not entries:
                continue
            for entry in entries:
                self._rows.setdefault(int(entry.sensor_frame or 0), []).append((len(self.labelled), entry.point_ids))
            self.labelled.append(one)

    def _is_of_lidar(self, entry: LabeledPoints) -> bool:
        return key_of(entry.sensor_id) == key_of(self.lidar.id) and entry.sensor_frame is not None

    def _note_cameras(self) -> None:
        for camera in self.scene.cameras:
            if not len(camera.images):
                self.losses.dropped("sensors.camera", f"{camera.id!r} has no image, and is left out")

    def __iter__(self) -> Iterator[WrittenFrame]:
        """Give the frames, each read when its turn comes; at the end, images that were not used are reported."""
        tolerance_ns = sweep_period_ns(self.lidar)
        cameras = [camera for camera in self.scene.cameras if len(camera.images)]
        for number in range(len(self.times_ns)):
            frame = self.lidar.frames[number]
            moment_ns = frame.reference_ns
            yield WrittenFrame(
                number,
                self.names[number],
                int(self.times_ns[number]),
                self._moved(frame, self._cloud_from_points[number]),
                self.world_from_cloud[number],
                tuple(self._boxes_of(number)),
                tuple(filter(None, (self._image_of(one, number, moment_ns, tolerance_ns) for one in cameras))),
                tuple(self._labelled_of(number, len(frame.points))),
            )
        for camera in cameras:
            left = len(camera.images) - len(self._used.get(key_of(camera.id), ()))
            self.losses.dropped("sensors.camera.images", "images that are the nearest of no cloud", count=left)

    def _moved(self, frame: LidarFrame, transform: RigidTransform) -> LidarFrame:
        """A sweep in the frame of the cloud; without point times, since labels hold for the whole cloud."""
        points = frame.points
        if not np.array_equal(transform.matrix, np.eye(4)):
            points = replace(points, positions=read_only(transform.apply(points.positions), np.float32))
        if points.timestamps_ns is not None and not self._holds_times:
            what = "left out: labels hold for the whole cloud"
            self.losses.dropped("sensors.lidar.frames.points.timestamps_ns", what)
            points = replace(points, timestamps_ns=None)
        return frame if points is frame.points else replace(frame, points=points)

    def _boxes_of(self, number: int) -> Iterator[WrittenBox]:
        there = [k for k, present in enumerate(self._present) if present[number]]
        if not there:
            return
        centers = np.array([self._boxes[k].centers_world[number] for k in there])
        quaternions = np.array([self._boxes[k].quaternions_xyzw[number] for k in there])
        if not self._boxes_in_world:
            cloud_from_world = self.world_from_cloud[number].inverse()
            centers = cloud_from_world.apply(centers)
            quaternions = multiply_quaternions(cloud_from_world.quaternion_xyzw, quaternions)
        for k, center, quaternion in zip(there, centers, quaternions, strict=True):
            stated = {name: values[number] for name, values in self._stated[k].items()}
            size_lwh = self._boxes[k].sizes_lwh[number]
            yield WrittenBox(k, self.cuboids[k], center, size_lwh, quaternion, stated)

    def _labelled_of(self, number: int, count: int) -> Iterator[tuple[int, UInt32Array]]:
        for k, rows in self._rows.get(number, ()):
            inside = rows[rows < count]
            self.losses.dropped(_POINTS, "points that the sweep does not have", count=len(rows) - len(inside))
            yield k, inside

    def _image_of(self, camera: CameraSensor, number: int, moment_ns: int, tolerance_ns: int) -> WrittenImage | None:
        times = camera.images.timestamps_ns
        k = int(np.argmin(np.abs(times - moment_ns)))
        if abs(int(times[k]) - moment_ns) > tolerance_ns:
            return None
        self._used.setdefault(key_of(camera.id), set()).add(k)
        image = camera.images[k]
        time = image.timestamp_ns
        stem = f"{file_stem(camera.id)}_{time:0{19 if time >= 0 else 20}d}"
        return WrittenImage(camera.id, stem, image, self._cloud_from_camera(camera, image, number))

    def _cloud_from_camera(self, camera: CameraSensor, image: CameraImage, number: int) -> RigidTransform | None:
        location = self._locations[camera.id]
        source = location.source
        if source is not None and image.mount is not None:
            source = source.mounted(image.mount)
        if source is not None and self.posed:
            there = self._poses_at(source, np.array([image.timestamp_ns], np.int64))
            if there is not None:
                return self.world_from_cloud[number].inverse() @ there[0]
        mount, points = image.mount or location.mount, frame_of_points(self.scene, self.lidar, self._ego).mount
        if mount is None or points is None:
            return None
        return self._cloud_from_points[number] @ points.inverse() @ mount

    def clouds(self) -> "FrameFiles":
        """Give what writes clouds: PCD files of float32, as all these tools read them."""
        from sceneloom.formats.points.writer import FrameFiles

        return FrameFiles(KINDS["pcd"], "binary", self.losses, float_intensities=True)

    def write_image(self, written: WrittenImage, folder: Path) -> Path:
        """Write an image once, and give its path."""
        folder.mkdir(parents=True, exist_ok=True)
        known = next(iter(folder.glob(f"{written.stem}.*")), None)
        return known or write_image(folder / written.stem, written.image, self.losses)


def _chosen_lidar(scene: Scene, wanted: str | None, losses: Losses) -> LidarSensor:
    there = [one for one in scene.lidars if len(one.frames) and (wanted is None or str(one.id) == wanted)]
    if not there:
        known = ", ".join(repr(str(one.id)) for one in scene.lidars) or "none"
        asked = "no sweep of a lidar" if wanted is None else f"no sweep of a lidar {wanted!r}"
        raise OptionError(f"{scene.source}: {asked}, whose clouds could be labelled; its lidars: {known}")
    for lidar in scene.lidars:
        if lidar is not there[0]:
            losses.dropped("sensors.lidar", f"{lidar.id!r} is left out: a task has the clouds of one lidar")
    return there[0]


def headings_of(boxes: Sequence[WrittenBox]) -> tuple[Float64Array, Float64Array]:
    """Give the yaws of boxes, and how far their upright axes are from z.

    Returns:
        yaws: (B,) direction of the forward axes about z, counter-clockwise from x [rad].
        tilts: (B,) [rad].
    """
    rotations = matrix_from_quaternion(np.array([box.quaternion_xyzw for box in boxes]).reshape(-1, 4))
    yaws: Float64Array = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    tilts: Float64Array = np.arccos(np.clip(rotations[:, 2, 2], -1.0, 1.0))
    return yaws, tilts
