"""A folder with a `rig.toml` as a scene; IMU and GNSS receivers among its sensors."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.projection import check_camera
from sceneloom.errors import CalibrationError, DataError, OptionError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.images import IMAGE_SUFFIXES, ImageReader, images_image_size
from sceneloom.formats.base.poses import GREATEST_NORM_ERROR, PoseRows, default_poses
from sceneloom.formats.base.text_tables import (
    GNSS_COLUMNS,
    POSE_COLUMNS,
    TIME_COLUMNS,
    Table,
    line_timestamps,
    pick_columns,
    read_table,
    shifted,
)
from sceneloom.formats.points.cloud import ALIASES, ROW_ALIASES, Cloud, FieldLayout, find_roles, parse_layout
from sceneloom.formats.points.files import CLOUD_SUFFIXES, cloud_suffix, read_cloud
from sceneloom.formats.points.mapping import (
    IntensityScale,
    PointMapping,
    PointTimes,
    ReadPoints,
    SweepClock,
    detect_scale,
    points_of,
)
from sceneloom.formats.points.npz import default_layout
from sceneloom.formats.rig.manifest import (
    Faults,
    Manifest,
    Record,
    Root,
    TimeSource,
    Timestamps,
    drop_unreadable,
    open_root,
    read_manifest,
)
from sceneloom.formats.rig.spec import MANIFEST, manifest_path
from sceneloom.formats.video.reader import VideoFile, VideoImages
from sceneloom.geometry.euler import rotation_from_cuboid_angles
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    GREATEST_ERROR,
    SILENT_ERROR,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
    normalise_quaternion,
    quaternion_from_matrix,
    rotate_vectors,
)
from sceneloom.scene.cameras import LONGEST_ROLL_S, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Poses, Trajectory, poses_along
from sceneloom.scene.scene import Scene, Sensor, frame_times, with_assumed_models
from sceneloom.scene.types import NO_FIELDS, PointsFrame
from sceneloom.warnings import WarningKind

_ROTATIONS = ("quaternion_xyzw", "quaternion_wxyz", "rotation_matrix", "euler_deg")


_NORM_ERROR = 0.01


_FARTHEST = 1e6


_QUARTER_ERROR = 0.003
"""Angles rounded to 1.57 and 3.14 are quarter rotations in radians within this share; 1.5 and 3 degrees are not."""


_AGREEMENT_ROTATION = 2e-3


_AGREEMENT_SHIFT = 0.01
"""Two ways between the same frames may differ by this much [rad, m]: what rounding in files comes to."""


_AXES: Mapping[str, tuple[str, str, str]] = {
    "optical": ("+x", "+y", "+z"),
    "flu": ("-y", "-z", "+x"),
    "frd": ("+y", "+z", "+x"),
}
"""Which axes of a frame point right, down and forward: of a camera's optical frame, and of bodies whose x y z are
forward left up, or forward right down."""


_DIRECTIONS = {sign + axis: value for axis in "xyz" for sign, value in (("+", 1.0), ("-", -1.0), ("", 1.0))}


def read_transform(record: Record, location: str, ledger: Ledger) -> RigidTransform:
    """Build a transform from `matrix`, or from `translation` and one form of rotation.

    Raises:
        CalibrationError: it says too much or too little, or the rotation is none.
    """
    forms = [form for form in _ROTATIONS if form in record]
    if "matrix" in record:
        if forms or "translation" in record:
            raise CalibrationError(f"matrix beside {(forms or ['translation'])[0]}; expected one of them")
        return _checked(record["matrix"], location, ledger)
    if len(forms) > 1:
        raise CalibrationError(f"{' and '.join(forms)}; expected one of them")
    if not forms and "translation" not in record:
        raise CalibrationError(f"says nothing; expected matrix, or translation and one of {', '.join(_ROTATIONS)}")
    matrix = np.eye(4)
    matrix[:3, 3] = record.get("translation", (0.0, 0.0, 0.0))
    matrix[:3, :3] = _rotation(record, forms[0]) if forms else np.eye(3)
    if forms == ["euler_deg"] and _are_radians(record["euler_deg"]):
        message = f"euler_deg {record['euler_deg'].tolist()} look like radians; degrees are expected, as 90 or -180"
        ledger.note(WarningKind.ASSUMED, "angles-in-radians", location, message)
    return _checked(matrix, location, ledger)


def _are_radians(angles: Float64Array) -> bool:
    """Whether all angles lie within a rotation in radians, and one is a quarter or half rotation of them."""
    quarters = np.abs(angles) / (np.pi / 2)
    whole = (np.abs(quarters - np.round(quarters)) < _QUARTER_ERROR) & (np.round(quarters) > 0)
    return bool(np.abs(angles).max() < 2 * np.pi and whole.any())


def _rotation(record: Record, form: str) -> Float64Array:
    value: Float64Array = record[form]
    if (form == "euler_deg") != ("euler_order" in record):
        raise CalibrationError("euler_deg and euler_order; expected both or neither")
    if form == "rotation_matrix":
        return value
    if form == "euler_deg":
        return rotation_from_cuboid_angles(value, order=record["euler_order"])
    quaternion_xyzw = value if form == "quaternion_xyzw" else value[[1, 2, 3, 0]]
    norm = float(np.linalg.norm(quaternion_xyzw))
    if abs(norm - 1.0) > _NORM_ERROR:
        raise CalibrationError(f"{form} {value.tolist()} of length {norm:.4f}; expected 1 within {_NORM_ERROR}")
    return matrix_from_quaternion(quaternion_xyzw)


def _checked(matrix: Float64Array, location: str, ledger: Ledger) -> RigidTransform:
    if np.abs(matrix[:3, 3]).max() > _FARTHEST or np.abs(matrix[:3, :3]).max() > 2:
        problem = f"{matrix.tolist()}; expected a rotation and a translation in metres within {_FARTHEST:g}"
        raise CalibrationError(problem)
    transform, error = RigidTransform.nearest(matrix)
    if not error <= GREATEST_ERROR:
        problem = "mirrored or singular" if error == float("inf") else f"off by {error:.2g} (max abs of R Rᵀ - I)"
        expected = f"expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
        raise CalibrationError(f"rotation {problem}; {expected}")
    if error > SILENT_ERROR:
        message = f"rotation off by {error:.2g} (max abs of R Rᵀ - I); the nearest rotation was taken"
        ledger.note(WarningKind.REPAIRED, "rotation-normalised", location, message)
    return transform


def frame_from_optical(axes: tuple[str, ...]) -> RigidTransform:
    """Rotate from the optical axes (x right, y down, z forward) to those of a frame.

    Args:
        axes: a word out of `_AXES`, or the axes of the frame that point right, down and forward.

    Raises:
        CalibrationError: they are no three different axes, or a mirror.
    """
    if len(axes) == 1:
        if axes[0] not in _AXES:
            raise CalibrationError(
                f"axes {axes[0]!r}; expected one of {', '.join(_AXES)}, or right, down and forward as '-y,-z,+x'"
            )
        axes = _AXES[axes[0]]
    rotation = np.zeros((3, 3))
    if len(axes) != 3 or not set(axes) <= set(_DIRECTIONS):
        raise CalibrationError(f"axes {','.join(axes)!r}; expected right, down and forward as '-y,-z,+x'")
    for column, axis in enumerate(axes):
        rotation["xyz".index(axis[-1]), column] = _DIRECTIONS[axis]
    if round(np.linalg.det(rotation)) != 1:
        raise CalibrationError(
            f"axes {','.join(axes)!r} (right, down, forward) are a mirror or no three axes; expected a right-handed set"
        )
    return RigidTransform(rotation, np.zeros(3))


@dataclass(frozen=True, slots=True)
class Edge:
    """One transform of a manifest: `to_from` takes points of frame `source` into frame `target`."""

    source: str
    target: str
    target_from_source: RigidTransform
    location: str


class FrameTree:
    """Frames and the trajectories between them.

    Attributes:
        ego: the frame that everything is seen from.
    """

    def __init__(self, ego: str, edges: Iterable[Edge]) -> None:
        """Follow the transforms from the ego to every frame that they reach.

        Raises:
            CalibrationError: a transform goes from a frame to itself, or two ways between frames contradict each other.
        """
        self.ego = ego
        self._edges = tuple(edges)
        for edge in self._edges:
            if edge.source == edge.target:
                raise CalibrationError(f"{edge.location}: from {edge.source!r} to itself; expected two frames")
        self._ego_from: dict[str, RigidTransform] = {}
        self._towards_ego: dict[str, str] = {}
        self._spread(ego)
        for edge in self._edges:
            self._check(edge)

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames that a transform names, and the ego's."""
        named = [name for edge in self._edges for name in (edge.source, edge.target)]
        return tuple(dict.fromkeys([self.ego, *named]))

    @property
    def loose(self) -> tuple[str, ...]:
        """Frames that no way connects with the ego."""
        return tuple(frame for frame in self.frames if frame not in self._ego_from)

    def ego_from(self, frame: str) -> RigidTransform:
        """Give `ego_from_frame`.

        Raises:
            CalibrationError: no way leads there.
        """
        if frame in self._ego_from:
            return self._ego_from[frame]
        raise CalibrationError(
            f"no transforms lead from frame {frame!r} to the ego's frame {self.ego!r}; {self._hint(frame)}"
        )

    def _hint(self, frame: str) -> str:
        with_ego = ", ".join(map(repr, self._ego_from))
        near = self._connected(frame)
        if len(near) > 1:
            with_frame = ", ".join(map(repr, near[1:]))
            return f"it is connected with {with_frame}, the ego's with {with_ego}: one is missing between"
        known = ", ".join(map(repr, self.frames))
        return f'no transform names it (known frames: {known}); give it an `extrinsic`, or state `ego = "{frame}"`'

    def _connected(self, frame: str) -> list[str]:
        reached = [frame]
        for name in reached:
            pairs = [(edge.source, edge.target) for edge in self._edges if name in (edge.source, edge.target)]
            reached += [other for pair in pairs for other in pair if other not in reached]
        return reached

    def _spread(self, ego: str) -> None:
        self._ego_from[ego] = RigidTransform.identity()
        waiting = deque([ego])
        while waiting:
            frame = waiting.popleft()
            for edge in self._edges:
                for near, far, near_from_far in (
                    (edge.target, edge.source, edge.target_from_source),
                    (edge.source, edge.target, edge.target_from_source.inverse()),
                ):
                    if near == frame and far not in self._ego_from:
                        self._ego_from[far] = self._ego_from[near] @ near_from_far
                        self._towards_ego[far] = near
                        waiting.append(far)

    def _trajectory(self, frame: str) -> list[str]:
        """The frames from one to the ego."""
        trajectory = [frame]
        while trajectory[-1] != self.ego:
            trajectory.append(self._towards_ego[trajectory[-1]])
        return trajectory

    def _loop(self, edge: Edge) -> str:
        """The frames between those of a transform, on the other way."""
        source, target = self._trajectory(edge.source), self._trajectory(edge.target)
        meeting = next(frame for frame in source if frame in target)
        trajectory = [*source[: source.index(meeting) + 1], *reversed(target[: target.index(meeting)])]
        return " - ".join(map(repr, trajectory))

    def _check(self, edge: Edge) -> None:
        """Compare a transform with what the others state of its two frames."""
        if edge.source not in self._ego_from:
            return
        target_from_source = self._ego_from[edge.target].inverse() @ self._ego_from[edge.source]
        rotation = float(np.abs(target_from_source.rotation - edge.target_from_source.rotation).max())
        shift = float(np.abs(target_from_source.translation - edge.target_from_source.translation).max())
        if rotation > _AGREEMENT_ROTATION or shift > _AGREEMENT_SHIFT:
            raise CalibrationError(
                f"{edge.location}: from {edge.source!r} to {edge.target!r} contradicts the trajectory "
                f"{self._loop(edge)} by "
                f"{shift:.3g} m and {np.degrees(rotation):.3g}°; is one of these transforms the other way round?"
            )


def _build_trajectory(manifest: Manifest, record: Record, location: str, tree: FrameTree, ledger: Ledger) -> Trajectory:
    """Read a trajectory and bring it to the ego.

    Raises:
        DataError: the file is missing or wrong.
        CalibrationError: no transforms lead to its frame.
    """
    frame = record.get("frame", manifest.ego)
    frame_from_ego = tree.ego_from(frame).inverse()
    root = open_root(manifest.path, [record.get("root"), manifest.record.get("root")], f"{location}.root")
    path = root.file(record["file"], f"{location}.file")
    poses = _READERS[record["form"]](manifest, record, location, root, path)
    if not len(poses.timestamps_ns):
        raise DataError(path, "", "holds no poses")
    _check_orientations(path, poses)
    poses = _in_order(path, poses, ledger)
    if record.get("world_axes") == "optical":
        # the scene's world is z up: x forward, y left
        poses = _rotated(poses, frame_from_optical(("flu",)))
    poses = _of_ego(path, poses, frame, frame_from_ego, ledger)
    name = record.get("name", "pose")
    offset_ns = int(record.get("time_offset_s", 0))
    return Trajectory(
        name,
        read_only(shifted(poses.timestamps_ns, offset_ns, manifest.path, f"{location}.time_offset_s")),
        read_only(poses.positions),
        None if poses.quaternions_xyzw is None else read_only(poses.quaternions_xyzw),
    )


def _read_tum(manifest: Manifest, record: Record, location: str, root: Root, path: Path) -> PoseRows:
    """Lines `timestamp tx ty tz qx qy qz qw`. Source: "File Formats" of the TUM RGB-D benchmark."""
    del manifest, location, root
    table = read_table(path, named=False)
    if table.rows and len(table.rows[0]) != 8:
        problem = f"{len(table.rows[0])} values; expected 8: timestamp tx ty tz qx qy qz qw"
        raise DataError(path, f"line {table.lines[0]}", problem)
    values = table.numbers(range(1, 8))
    return PoseRows(table.timestamps(0, record.get("unit")), values[:, :3], values[:, 3:], table.lines)


def _read_kitti(manifest: Manifest, record: Record, location: str, root: Root, path: Path) -> PoseRows:
    """Lines of the 12 numbers of [R t], row by row. Source: the development kit of KITTI's odometry benchmark."""
    if "times" not in record:
        problem = "missing; a kitti file has no times: expected a text file with one time per pose"
        raise DataError(manifest.path, f"{location}.times", problem)
    table = read_table(path, named=False)
    if table.rows and len(table.rows[0]) != 12:
        problem = f"{len(table.rows[0])} values; expected 12: three rows of [R t]"
        raise DataError(path, f"line {table.lines[0]}", problem)
    times_path = root.file(record["times"], f"{location}.times")
    timestamps = line_timestamps(times_path, record.get("unit"))
    if len(timestamps) != len(table.rows):
        raise DataError(times_path, "", f"{len(timestamps)} times for {len(table.rows)} poses; expected as many")
    matrices = table.numbers(range(12)).reshape(-1, 3, 4)
    quaternions = np.empty((len(matrices), 4))
    for k, matrix in enumerate(matrices):
        if np.abs(matrix[:, :3]).max() > 2:
            raise DataError(path, f"line {table.lines[k]}", f"{matrix.tolist()}; expected a rotation and a translation")
        rotation, error = nearest_rotation(matrix[:, :3])
        if not error <= GREATEST_ERROR:
            problem = f"rotation off by {error:.2g}; expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
            raise DataError(path, f"line {table.lines[k]}", problem)
        quaternions[k] = quaternion_from_matrix(rotation)
    return PoseRows(timestamps, matrices[:, :, 3].copy(), quaternions, table.lines)


def _read_csv(manifest: Manifest, record: Record, location: str, root: Root, path: Path) -> PoseRows:
    del root
    table = read_table(path)
    columns = pick_columns(table, POSE_COLUMNS, record.get("columns", {}), f"{location}.columns", manifest.path)
    missing = [role for role in ("time", "x", "y", "z") if role not in columns]
    rotating = [role for role in ("qx", "qy", "qz", "qw") if role in columns]
    if missing or len(rotating) not in {0, 4}:
        lacking = missing or [role for role in ("qx", "qy", "qz", "qw") if role not in columns]
        problem = f"no column for {', '.join(lacking)} among {', '.join(table.names)}; name them with `columns`"
        raise DataError(path, "line 1", problem)
    values = table.numbers([columns[role] for role in ("x", "y", "z", *rotating)])
    timestamps = table.timestamps(columns["time"], record.get("unit"))
    return PoseRows(timestamps, values[:, :3].copy(), values[:, 3:].copy() if rotating else None, table.lines)


_READERS: Mapping[str, Callable[[Manifest, Record, str, Root, Path], PoseRows]] = MappingProxyType(
    {"tum": _read_tum, "kitti": _read_kitti, "csv": _read_csv}
)


def _check_orientations(path: Path, poses: PoseRows) -> None:
    if poses.quaternions_xyzw is None:
        return
    norms = np.linalg.norm(poses.quaternions_xyzw, axis=1)
    wrong = np.flatnonzero(~(np.abs(norms - 1.0) <= GREATEST_NORM_ERROR))
    if len(wrong):
        k = int(wrong[0])
        problem = f"orientation {poses.quaternions_xyzw[k].tolist()} of length {norms[k]:.4f}; expected 1 within 0.01"
        raise DataError(path, f"line {poses.lines[k]}", problem)


def _in_order(path: Path, poses: PoseRows, ledger: Ledger) -> PoseRows:
    """Sort by time; of several poses at one time the first counts."""
    if (poses.timestamps_ns[1:] < poses.timestamps_ns[:-1]).any():
        ledger.note(WarningKind.REPAIRED, "poses-sorted", str(path), "poses out of order; sorted by time")
    times, rows = np.unique(poses.timestamps_ns, return_index=True)
    if len(times) < len(poses.timestamps_ns):
        message = "several poses at one time; the first was kept"
        count = len(poses.timestamps_ns) - len(times)
        ledger.note(WarningKind.SKIPPED, "repeated-poses", str(path), message, count=count)
    quaternions = poses.quaternions_xyzw
    return PoseRows(
        times, poses.positions[rows], None if quaternions is None else normalise_quaternion(quaternions[rows])
    )


def _rotated(poses: PoseRows, world_from_file: RigidTransform) -> PoseRows:
    """The same way in a world with other axes."""
    quaternions = poses.quaternions_xyzw
    if quaternions is not None:
        quaternions = multiply_quaternions(world_from_file.quaternion_xyzw, quaternions)
    return PoseRows(poses.timestamps_ns, world_from_file.apply(poses.positions), quaternions)


def _of_ego(path: Path, poses: PoseRows, frame: str, frame_from_ego: RigidTransform, ledger: Ledger) -> PoseRows:
    """From `world_from_frame` to `world_from_ego`."""
    if poses.quaternions_xyzw is None:
        distance = float(np.linalg.norm(frame_from_ego.translation))
        if distance > 0:
            message = f"positions of frame {frame!r}, without orientations, are taken for the ego, {distance:.3g} m off"
            ledger.note(WarningKind.ASSUMED, "lever-arm-ignored", str(path), message)
        return poses
    return PoseRows(
        poses.timestamps_ns,
        rotate_vectors(poses.quaternions_xyzw, frame_from_ego.translation) + poses.positions,
        multiply_quaternions(poses.quaternions_xyzw, frame_from_ego.quaternion_xyzw),
    )


def _own_frame(record: Record) -> str:
    """The name of a sensor's own frame."""
    return str(record["frame"] if "frame" in record else record["id"])


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    """A manifest while its scene is made.

    Attributes:
        manifest: the records.
        tree: the frames.
        ego_path: `world_from_ego` of the default trajectory, or None.
        ledger: takes warnings, and faults in a lenient reading.
        videos: those that were opened; the scene closes them.
    """

    manifest: Manifest
    tree: FrameTree
    ego_path: Poses | None
    ledger: Ledger
    videos: list[VideoFile] = field(default_factory=list)

    def root(self, record: Record, location: str) -> Root:
        """The folder of a sensor's files.

        Raises:
            DataError: there is no such folder.
        """
        return open_root(self.manifest.path, [record.get("root"), self.manifest.record.get("root")], f"{location}.root")

    def time_source(self, record: Record, location: str) -> TimeSource:
        """What the timestamps of a sensor are read with."""
        root = self.root(record, location)
        offset_ns = int(record.get("time_offset_s", 0))
        return TimeSource(
            record.get("times", {}), f"{location}.times", self.manifest.path, root, offset_ns, self.ledger
        )

    def mount(self, record: Record) -> RigidTransform:
        """`ego_from_frame` of a sensor's own frame.

        Raises:
            CalibrationError: no transforms lead there.
        """
        return self.tree.ego_from(_own_frame(record))

    def poses(self, mount: RigidTransform, timestamps_ns: Int64Array) -> Poses | None:
        """`world_from_sensor` at those of the times that the default trajectory covers."""
        return poses_along(self.ego_path, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)


_MODEL_ALIASES: Mapping[str, str] = {
    "opencv": "brown_conrady",
    "plumb_bob": "brown_conrady",
    "radtan": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "equidistant": "fisheye",
    "opencv_fisheye": "fisheye",
    "kannala_brandt": "fisheye",
    "kannala_brandt4": "fisheye",
    "fisheye624": "fisheye_rad_tan_prism",
}
"""Names that ROS, OpenCV and others have for models of the table."""


_OPENCV_LENGTHS = (0, 4, 5, 8, 12, 14)


_OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
"""Source: "Camera Calibration and 3D Reconstruction" of the OpenCV documentation."""


_SKEW = 1e-3


def read_camera_model(record: Record, image_size: tuple[int, int]) -> Camera:
    """Build the camera model, for the image size that its numbers hold for.

    Args:
        record: the `camera_model` of a camera.
        image_size: width and height of the images [px], taken where the record names none.

    Raises:
        CalibrationError: it says too much or too little, or a number is impossible.
    """
    fx, fy, cx, cy = _pinhole(record)
    if ("width" in record) != ("height" in record):
        raise CalibrationError("width without height; expected both or neither")
    given = record.get("coefficients", [])
    model = _model(record, given)
    used = [] if record.get("undistorted", False) else given
    size = (record["width"], record["height"]) if "width" in record else image_size
    if record.get("undistorted", False):
        model = "pinhole"
    camera = Camera(model, size[0], size[1], fx, fy, cx, cy, _coefficients(model, used))
    check_camera(camera)
    return camera


def frame_from_camera(record: Record) -> RigidTransform:
    """The shift that a projection matrix P = K·[I t] has in it: p_camera = p_frame + t."""
    if "P" not in record:
        return RigidTransform.identity()
    return RigidTransform(np.eye(3), -np.linalg.solve(record["P"][:, :3], record["P"][:, 3]))


def _pinhole(record: Record) -> tuple[float, float, float, float]:
    forms = [form for form in ("fx", "K", "P") if form in record]
    if len(forms) != 1:
        raise CalibrationError(f"{' and '.join(forms) or 'no focal length'}; expected one of fx fy cx cy, K, P")
    if forms == ["fx"]:
        missing = [name for name in ("cx", "cy") if name not in record]
        if missing:
            raise CalibrationError(f"{' and '.join(missing)} missing; expected fx fy cx cy [px]")
        fx: float = record["fx"]
        return fx, record.get("fy", fx), record["cx"], record["cy"]
    beside = [name for name in ("fy", "cx", "cy") if name in record]
    if beside:
        raise CalibrationError(f"{forms[0]} beside {', '.join(beside)}; expected one of them")
    matrix: Float64Array = record[forms[0]][:, :3]
    rest = np.array([matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1.0])
    if np.abs(rest).max() > _SKEW:
        raise CalibrationError(f"{forms[0]} {matrix.tolist()}; expected [fx 0 cx; 0 fy cy; 0 0 1], row by row")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _model(record: Record, given: Any) -> str:
    name = record.get("model")
    if name is None:
        return "brown_conrady" if given else "pinhole"
    plain = name.lower().replace("-", "_").replace(" ", "_")
    model = _MODEL_ALIASES.get(plain, plain)
    if model not in MODELS:
        known = [*MODELS, *_MODEL_ALIASES]
        close = get_close_matches(plain, known, 1, 0.6)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise CalibrationError(f"model {name!r}; expected one of {', '.join(known)}{hint}")
    return "brown_conrady" if model == "pinhole" and given else model


def _coefficients(model: str, given: list[float] | dict[str, float]) -> tuple[float, ...]:
    names = MODELS[model].coefficient_names
    if isinstance(given, dict):
        unknown = [name for name in given if name not in names]
        if unknown:
            raise CalibrationError(f"coefficients {', '.join(unknown)}; {model} has {' '.join(names) or 'none'}")
        return tuple(given.get(name, 0.0) for name in names) if given else ()
    if model != "brown_conrady":
        return tuple(given)
    if len(given) not in _OPENCV_LENGTHS:
        lengths = ", ".join(map(str, _OPENCV_LENGTHS))
        raise CalibrationError(
            f"{len(given)} coefficients; expected {lengths} in OpenCV's order: {' '.join(_OPENCV_NAMES)}"
        )
    by_name = dict(zip(_OPENCV_NAMES, given, strict=False))
    return tuple(by_name.get(name, 0.0) for name in names) if len(given) > 8 else tuple(given)


_RATIO_ERROR = 0.01


def _build_camera(drive: _Drive, record: Record, location: str) -> CameraSensor:
    """Build a camera; the head of its first image is read.

    Raises:
        DataError: images are missing or wrong, or the manifest contradicts them.
        CalibrationError: the camera model is unusable, or it is not known where the camera is.
    """
    if ("files" in record) == ("video" in record):
        found = "files and video" if "files" in record else "neither files nor video"
        raise DataError(drive.manifest.path, location, f"{found}; expected one of them")
    return (_from_files if "files" in record else _from_video)(drive, record, location)


def _mount(drive: _Drive, record: Record) -> RigidTransform:
    axes = frame_from_optical(record.get("axes", ("optical",)))
    return drive.mount(record) @ axes @ frame_from_camera(record["camera_model"])


def _from_files(drive: _Drive, record: Record, location: str) -> CameraSensor:
    root = drive.root(record, location)
    files = root.files(record["files"], f"{location}.files")
    for path in files:
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            problem = f"{path.name!r}; expected files that end with {' '.join(IMAGE_SUFFIXES)}"
            raise DataError(drive.manifest.path, f"{location}.files", problem)
    timestamps = drive.time_source(record, location).timestamp_files(files)
    if not len(timestamps.chosen):
        raise DataError(drive.manifest.path, f"{location}.files", "none of the files has a time")
    timestamps = drop_unreadable(timestamps, lambda k: images_image_size(files[k]), drive.ledger)
    camera_model = _fitted_camera_model(drive, record, location, images_image_size(files[timestamps.chosen[0]]))
    mount = _mount(drive, record)
    used = tuple(files[k] for k in timestamps.chosen)
    reader = ImageReader(used, tuple(map(root.relative, used)), timestamps.timestamps_ns, camera_model)
    return CameraSensor(
        id=record["id"],
        camera=camera_model,
        images=LazyFrames(timestamps.timestamps_ns, reader),
        poses=drive.poses(mount, timestamps.timestamps_ns),
        mount=mount,
        extras=_shutter(drive, record, location),
    )


def _from_video(drive: _Drive, record: Record, location: str) -> CameraSensor:
    path = drive.root(record, location).file(record["video"], f"{location}.video")
    video = VideoFile(path)
    drive.videos.append(video)
    reader = video.whole_or_left(drive.ledger)
    camera_model = _fitted_camera_model(drive, record, location, (reader.width, reader.height))
    mount = _mount(drive, record)
    source = drive.time_source(record, location)
    timestamps = source.timestamp_images(reader.count, video.container_ns, path.name)
    return CameraSensor(
        id=record["id"],
        camera=camera_model,
        images=LazyFrames(
            timestamps.timestamps_ns,
            VideoImages(video, timestamps.chosen, timestamps.timestamps_ns, camera_model),
        ),
        poses=drive.poses(mount, timestamps.timestamps_ns),
        mount=mount,
        video=video.content(timestamps.chosen),
        fps=_fps(record, reader.fps, np.diff(timestamps.timestamps_ns)),
        extras=_shutter(drive, record, location),
    )


def _shutter(drive: _Drive, record: Record, location: str) -> Mapping[str, Any]:
    """What the manifest says of a rolling shutter, in the words in which recordings keep it."""
    if "shutter_roll_s" not in record:
        return NO_FIELDS
    seconds = record["shutter_roll_s"] / 1e9
    if seconds > LONGEST_ROLL_S:
        problem = f"{seconds:g} s; expected at most {LONGEST_ROLL_S:g} s"
        raise DataError(drive.manifest.path, f"{location}.shutter_roll_s", problem)
    entry = {"shutterRollTimeSeconds": seconds}
    left_to_right = {"rollingShutterLeftToRight": True} if record.get("shutter_left_to_right") else {}
    return {"calibration": entry | left_to_right}


def _fps(record: Record, nominal: float | None, intervals_ns: Int64Array) -> float | None:
    stated = record["times"].get("rate_hz")
    if stated is not None:
        return float(stated)
    return 1e9 / float(np.median(intervals_ns)) if len(intervals_ns) else nominal


def _fitted_camera_model(drive: _Drive, record: Record, location: str, size: tuple[int, int]) -> Camera:
    """Give the camera model for the images as they are, with a warning where its numbers are for another size."""
    calibrated = read_camera_model(record["camera_model"], size)
    if (calibrated.width, calibrated.height) == size:
        return calibrated
    sizes = f"{calibrated.width}x{calibrated.height}, the images are {size[0]}x{size[1]}"
    ratio = (size[0] / calibrated.width) / (size[1] / calibrated.height)
    if abs(ratio - 1.0) > _RATIO_ERROR:
        swapped = (calibrated.height, calibrated.width) == size
        meant = "are width and height exchanged?" if swapped else "if they were cut, cx and cy move with the cut"
        problem = f"for {sizes}, another shape; expected the numbers of the images as they are; {meant}"
        raise DataError(drive.manifest.path, f"{location}.camera model", problem)
    message = f"the numbers are for {sizes}; the camera model was scaled"
    drive.ledger.note(
        WarningKind.REPAIRED,
        "camera-model-scaled",
        f"{drive.manifest.path}: {location}.camera model",
        message,
    )
    return calibrated.resized(*size)


@dataclass(frozen=True, slots=True, eq=False)
class SweepReader:
    """Reads the sweeps of one lidar, each when it is asked for.

    Attributes:
        files: of each sweep.
        names: of the files, seen from their root.
        clocks_ns: (N, 2) int64 [ns]: the file's timestamp and the sweep's start.
        timestamps_ns: (N,) int64 [ns], of the frames.
        zero_ns: what the sensor's own clock is ahead by [ns].
        layout: columns of files that do not state them.
        mapping: what the columns mean.
        rotation: takes points of the files into the frame that they are given in, None where they are in it.
        deskewed: whether the points are placed as at the timestamp, which then is the time of all of them.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    clocks_ns: Int64Array
    timestamps_ns: Int64Array
    zero_ns: int
    layout: FieldLayout | None
    mapping: PointMapping
    rotation: RigidTransform | None = None
    deskewed: bool = False

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing or wrong.
        """
        read = self.read(k)
        points = read.points if self.rotation is None else _rotated_points(read.points, self.rotation)
        if self.deskewed:
            times_ns = np.full(len(points), self.timestamps_ns[k], np.int64)
            points = replace(points, timestamps_ns=read_only(times_ns))
        extras: dict[str, Any] = {"file": self.names[k]}
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        extras.update({name: count for name, count in counts.items() if count})
        return LidarFrame(int(self.timestamps_ns[k]), points, MappingProxyType(extras))

    def read(self, k: int) -> ReadPoints:
        """Read the points of sweep `k` in the frame of the file."""
        timestamp_ns, start_ns = self.clocks_ns[k].tolist()
        return points_of(self.cloud(k), self.mapping, SweepClock(timestamp_ns, start_ns, self.zero_ns))

    def cloud(self, k: int) -> Cloud:
        """Read the columns of sweep `k`."""
        return read_cloud(self.files[k], layout=self.layout)


def _rotated_points(points: LidarPoints, rotation: RigidTransform) -> LidarPoints:
    return replace(points, positions=read_only(rotation.apply(points.positions), np.float32))


_LOOKED_AT = 10
"""Files that are looked through for one that is bright enough to report the scale of brightness."""


_ROLES = (*(role for role in ALIASES if role != "time"), *ROW_ALIASES)


_KNOWN_TIMES: dict[tuple[str, str], PointTimes] = {
    ("t", "u"): PointTimes("nanoseconds"),
    ("offset_time", "u"): PointTimes("nanoseconds"),
    ("offset_ns", "u"): PointTimes("nanoseconds"),
    ("offset_ns", "i"): PointTimes("nanoseconds"),
    ("time", "f"): PointTimes("seconds"),
    ("timestamp", "f"): PointTimes("seconds", "clock"),
}
"""What columns of point times mean that well-known drivers write, by name and kind of number.

Source: Ouster's and Livox' drivers for ROS (t, offset_time: uint32 nanoseconds from the timestamp), Velodyne's (time:
float32 seconds from the timestamp), Hesai's and RoboSense's (timestamp: float64 seconds of the clock); Argoverse 2
(offset_ns).
"""


def _choose_layout(drive: _Drive, record: Record, location: str, first: Path) -> FieldLayout | None:
    """The columns that the manifest says, or those that files without a head are taken to have.

    Raises:
        DataError: the manifest's are none.
    """
    if "fields" in record:
        try:
            return parse_layout(record["fields"], default=record.get("dtype", "float32"))
        except OptionError as error:
            raise DataError(drive.manifest.path, f"{location}.fields", str(error)) from None
    if "dtype" in record:
        raise DataError(drive.manifest.path, f"{location}.dtype", "says nothing without `fields`")
    if cloud_suffix(first) != ".bin":
        return None
    layout = default_layout(first)
    message = f"`fields` not stated; the points are taken to be {layout}"
    drive.ledger.note(WarningKind.ASSUMED, "fields-assumed", f"{drive.manifest.path}: {location}", message)
    return layout


def _named_columns(drive: _Drive, record: Record, location: str) -> Mapping[str, str]:
    """The columns that the manifest's `use` names, by role.

    Raises:
        DataError: a role is unknown.
    """
    named = record.get("use", {})
    for role in named:
        if role not in _ROLES:
            problem = f"unknown; expected some of {', '.join(_ROLES)}; times of points go into point_times.field"
            raise DataError(drive.manifest.path, f"{location}.use.{role}", problem)
    return MappingProxyType(named)


def _with_columns(drive: _Drive, record: Record, location: str, reader: SweepReader) -> SweepReader:
    """Settle what brightness and times mean, looking at the first files where the manifest does not state it.

    Raises:
        DataError: the first file cannot be read, or its brightness fits no scale.
    """
    columns = reader.cloud(0).columns
    roles = find_roles(columns, reader.mapping.named)
    where = f"{drive.manifest.path}: {location}"
    scale = None
    if "intensity_max" in record:
        scale = IntensityScale(record["intensity_max"])
    elif roles.get("intensity") in columns:
        scale = _detected_scale(drive, location, _telling(reader, roles["intensity"]), roles["intensity"])
    times = _point_times(drive, record, where, columns, roles)
    settled = replace(reader, mapping=PointMapping(reader.mapping.named, scale, times))
    return settled if times is None or "point_times" in record else _with_tried_times(drive, where, settled, times)


def _telling(reader: SweepReader, name: str) -> Cloud:
    """The first of the first files that has any brightness in it, else the first of all."""
    first = reader.cloud(0)
    for k in range(min(len(reader.files), _LOOKED_AT)):
        cloud = first if k == 0 else reader.cloud(k)
        if name in cloud.columns and (cloud.columns[name] > 0).any():
            return cloud
    return first


def _with_tried_times(drive: _Drive, where: str, reader: SweepReader, times: PointTimes) -> SweepReader:
    """Keep a guess at what the times of points mean only if the first sweep agrees with it."""
    try:
        reader.read(0)
    except DataError as error:
        if not error.location.startswith(f"{times.field}["):
            raise
        message = (
            f"column {times.field!r} looks like times of points, but {error.problem}; state `point_times` to use it"
        )
        drive.ledger.note(WarningKind.SKIPPED, "point-times-not-used", where, message)
        return replace(reader, mapping=replace(reader.mapping, times=None))
    message = f"column {times.field!r} is taken for times of points: {times.unit} relative to the {times.relative_to}"
    drive.ledger.note(WarningKind.ASSUMED, "point-times-assumed", where, message)
    return reader


def _detected_scale(drive: _Drive, location: str, cloud: Cloud, name: str) -> IntensityScale:
    scale = detect_scale(cloud.columns[name])
    if scale is None:
        problem = f"up to {cloud.columns[name].max()}; state what becomes 255 with {location}.intensity_max"
        raise DataError(cloud.file, name, problem)
    if cloud.columns[name].dtype != np.uint8:
        message = f"`intensity_max` not stated; {name} goes up to {cloud.columns[name].max():g}"
        message += f", so {scale.maximum:g} becomes 255" if len(cloud.columns[name]) else ""
        drive.ledger.note(WarningKind.ASSUMED, "intensity-scale", f"{drive.manifest.path}: {location}", message)
    return scale


def _point_times(
    drive: _Drive, record: Record, where: str, columns: Mapping[str, AnyArray],
    roles: dict[str, str],
) -> PointTimes | None:  # fmt: skip
    if record.get("deskewed", False):
        return None
    stated = record.get("point_times")
    if stated is not None:
        return PointTimes(stated["unit"], stated.get("relative_to", "timestamp"), stated.get("field"))
    name = roles.get("time")
    if name is None:
        return None
    known = _KNOWN_TIMES.get((name.lower(), columns[name].dtype.kind))
    if known is None:
        message = f"column {name!r} looks like times of points; state `point_times` to use it"
        drive.ledger.note(WarningKind.SKIPPED, "point-times-not-used", where, message)
        return None
    return replace(known, field=name)


_FARTHEST_MOUNT = 30.0
"""A sensor that is mounted farther than this from the ego [m] is remarked: no vehicle is as long."""


_WITHIN_NS = 1_000_000_000
"""Streams that miss each other by less may well belong together."""


_FARTHEST_POINT = 10_000.0
"""No lidar measures as far [m]: numbers of another type give such points."""


_NEAREST_POINT = 1e-6


_ODD_SHARE = 0.01


_LEANING = 0.5
"""Cosine of 60 degrees: an ego whose z axis leans more than that is on its side or head."""


def _note_odd_points(path: Path, positions: Float32Array, columns: Mapping[str, AnyArray], ledger: Ledger) -> None:
    """Note points that come out of columns which are not what they are taken for.

    Args:
        path: the file.
        positions: (N, 3) float32 [m], read from it.
        columns: of the file, by name.
        ledger: takes the warnings.
    """
    distances = np.linalg.norm(positions.astype(np.float64), axis=1)
    far, near = (distances > _FARTHEST_POINT).sum(), (distances < _NEAREST_POINT).sum()
    intensities = columns.get(find_roles(columns, {}).get("intensity", ""), positions[:0, 0])
    dark = int((intensities < 0).sum())
    odd = (
        (far, f"points farther than {_FARTHEST_POINT:g} m"),
        (near, f"points nearer than {_NEAREST_POINT:g} m"),
        (dark, "brightness below zero"),
    )
    for count, what in odd:
        if count > _ODD_SHARE * max(len(distances), 1):
            message = f"{what}; does the file have the columns and types that it is taken to have?"
            ledger.note(WarningKind.ASSUMED, "odd-points", str(path), message, count=int(count))


def _note_leaning(path: Path, name: str, trajectory: Trajectory, ledger: Ledger) -> None:
    """Note a trajectory on which the ego hardly ever stands upright, as another order of quaternions makes it."""
    if trajectory.quaternions_xyzw is None or not len(trajectory.timestamps_ns):
        return
    x, y = trajectory.quaternions_xyzw[:, 0], trajectory.quaternions_xyzw[:, 1]
    leaning = int((1.0 - 2.0 * (x * x + y * y) < _LEANING).sum())
    if leaning > len(trajectory.timestamps_ns) / 2:
        message = (
            f"trajectory {name!r} has the ego on its side or head in {leaning} of {len(trajectory.timestamps_ns)} "
            f"poses; "
            "are the quaternions x y z w, and is the world's z axis up?"
        )
        ledger.note(WarningKind.ASSUMED, "ego-leaning", str(path), message)


def _note_doubts(path: Path, sensors: Sequence[Sensor], trajectories: Mapping[str, Trajectory], ledger: Ledger) -> None:
    """Note what can hardly be meant.

    Args:
        path: the manifest.
        sensors: of the scene.
        trajectories: of the scene.
        ledger: takes the warnings.
    """
    for sensor in sensors:
        if isinstance(sensor, LidarSensor | CameraSensor) and sensor.mount is not None:
            distance = float(np.linalg.norm(sensor.mount.translation))
            if distance > _FARTHEST_MOUNT:
                message = f"sensor {sensor.id!r} is {distance:.5g} m from the ego; are these millimetres?"
                ledger.note(WarningKind.ASSUMED, "far-mount", str(path), message)
    for name, trajectory in trajectories.items():
        _note_leaning(path, name, trajectory, ledger)
    spans = [(f"sensor {sensor.id!r}", frame_times(sensor)) for sensor in sensors]
    spans += [(f"trajectory {name!r}", trajectory.timestamps_ns) for name, trajectory in trajectories.items()]
    ordered = sorted((int(times.min()), int(times.max()), name) for name, times in spans if len(times))
    latest = ordered[0][1] if ordered else 0
    for before, after in pairwise(ordered):
        latest = max(latest, before[1])
        if after[0] > latest + _WITHIN_NS:
            message = (
                f"{after[2]} begins {(after[0] - latest) / 1e9:.3f} s after {before[2]} and all before it end; "
                "are their clocks or units the same?"
            )
            ledger.note(WarningKind.ASSUMED, "clocks-apart", str(path), message)


_WORLD = "world"


FARTHEST_WORLD = 100_000.0
"""float32 resolves 8 mm there: points in the world beyond it need a nearer origin [m]."""


_LONGEST_SWEEP_NS = 60_000_000_000
"""A sweep that takes longer than this [ns] is none."""


def _build_lidar(drive: _Drive, record: Record, location: str) -> LidarSensor:
    """Build a lidar; its first file is read, to see what its columns are.

    Raises:
        DataError: files are missing or wrong, or the manifest contradicts them.
        CalibrationError: it is not known where the lidar, or the frame of its points, is.
    """
    mount = drive.mount(record)
    root = drive.root(record, location)
    files = root.files(record["files"], f"{location}.files")
    _check_suffixes(drive, files, location)
    timestamps = drive.time_source(record, location).timestamp_files(files)
    if not len(timestamps.chosen):
        raise DataError(drive.manifest.path, f"{location}.files", "none of the files has a time")
    layout = _choose_layout(drive, record, location, files[0])
    timestamps = drop_unreadable(timestamps, lambda k: read_cloud(files[k], layout=layout), drive.ledger)
    reader = SweepReader(
        files=tuple(files[k] for k in timestamps.chosen),
        names=tuple(root.relative(files[k]) for k in timestamps.chosen),
        clocks_ns=np.stack([timestamps.timestamps_ns, timestamps.timestamps_ns], axis=1),
        timestamps_ns=timestamps.timestamps_ns,
        zero_ns=int(record.get("time_offset_s", 0)),
        layout=layout,
        mapping=PointMapping(named=_named_columns(drive, record, location)),
    )
    reader = _with_columns(drive, record, location, reader)
    reader = _with_clocks(drive, record, location, reader, timestamps)
    points_frame, rotation = _points_frame(drive, record, mount)
    reader = replace(reader, rotation=rotation)
    _note_first_sweep(drive, reader, points_frame)
    scale = reader.mapping.scale
    return LidarSensor(
        id=record["id"],
        frames=LazyFrames(reader.timestamps_ns, reader),
        poses=drive.poses(mount, reader.timestamps_ns),
        mount=mount,
        points_frame=points_frame,
        model=record.get("model"),
        extras=MappingProxyType({} if scale is None else {"intensity_max": scale.maximum}),
    )


def _check_suffixes(drive: _Drive, files: list[Path], location: str) -> None:
    for path in files:
        if cloud_suffix(path) is None:
            problem = f"{path.name!r}; expected files that end with {' '.join(CLOUD_SUFFIXES)}"
            raise DataError(drive.manifest.path, f"{location}.files", problem)


def _with_clocks(
    drive: _Drive, record: Record, location: str, reader: SweepReader, timestamps: Timestamps
) -> SweepReader:
    """Bring timestamps that mean the middle or end of a sweep to its start.

    Points without times belong to one moment: the middle of the sweep, where it is known, else the timestamp.
    """
    meant = record.get("timestamp", "start")
    sweep_ns: int = record.get("sweep_s", 0)
    if record.get("deskewed", False):
        return replace(reader, deskewed=True)
    if not sweep_ns and meant != "start":
        sweep_ns = _median_interval(drive, location, timestamps)
    if sweep_ns > _LONGEST_SWEEP_NS:
        problem = f"{sweep_ns / 1e9:g}; expected how long a sweep takes, at most {_LONGEST_SWEEP_NS // 10**9} s"
        raise DataError(drive.manifest.path, f"{location}.sweep_s", problem)
    share = {"start": 0.0, "middle": 0.5, "end": 1.0}[meant]
    starts_ns = timestamps.timestamps_ns - round(sweep_ns * share)
    times_ns = starts_ns if reader.mapping.times is not None else starts_ns + round(sweep_ns / 2)
    clocks = np.stack([timestamps.timestamps_ns, starts_ns], axis=1)
    return replace(reader, clocks_ns=clocks, timestamps_ns=times_ns)


def _median_interval(drive: _Drive, location: str, timestamps: Timestamps) -> int:
    if len(timestamps.timestamps_ns) < 2:
        problem = "missing, and a single sweep has no interval; expected how long a sweep takes [s]"
        raise DataError(drive.manifest.path, f"{location}.sweep_s", problem)
    interval_ns = int(np.median(np.diff(timestamps.timestamps_ns)))
    message = f"`sweep_s` not stated; a sweep is taken to last as long as the median interval, {interval_ns / 1e9:g} s"
    drive.ledger.note(WarningKind.ASSUMED, "sweep-length", f"{drive.manifest.path}: {location}", message)
    return interval_ns


def _points_frame(drive: _Drive, record: Record, mount: RigidTransform) -> tuple[PointsFrame, RigidTransform | None]:
    """The frame that the points will be in, and what takes them there if the file has them in another."""
    own = _own_frame(record)
    name: str = record.get("points_in", own)
    if name == own:
        return PointsFrame.SENSOR, None
    if name == drive.tree.ego:
        return PointsFrame.EGO, None
    if name == _WORLD and _WORLD not in drive.tree.frames:
        return PointsFrame.WORLD, None
    return PointsFrame.SENSOR, mount.inverse() @ drive.tree.ego_from(name)


def _note_first_sweep(drive: _Drive, reader: SweepReader, points_frame: PointsFrame) -> None:
    """Look at the points of the first sweep, and state what was left out of it."""
    read = reader.read(0)
    if read.dropped:
        message = "points that are not finite, or exactly at the origin, are no returns and are left out"
        location = str(reader.files[0])
        drive.ledger.note(WarningKind.SKIPPED, "points-dropped", location, message, count=read.dropped)
    positions = read.points.positions
    _note_odd_points(reader.files[0], positions, reader.cloud(0).columns, drive.ledger)
    if points_frame is PointsFrame.WORLD and len(positions) and np.abs(positions).max() > FARTHEST_WORLD:
        problem = f"points up to {np.abs(positions).max():.0f} m from the world's origin; expected {FARTHEST_WORLD:g} m"
        raise DataError(reader.files[0], "", f"{problem} at most: give points and trajectory a nearer origin")


_IMU_COLUMNS: Mapping[str, Sequence[str]] = {
    "time": TIME_COLUMNS,
    "ax": ("ax", "acc_x", "accel_x", "a_x", "accx", "linear_acceleration_x"),
    "ay": ("ay", "acc_y", "accel_y", "a_y", "accy", "linear_acceleration_y"),
    "az": ("az", "acc_z", "accel_z", "a_z", "accz", "linear_acceleration_z"),
    "gx": ("gx", "wx", "gyro_x", "gyr_x", "w_x", "angular_velocity_x", "omega_x"),
    "gy": ("gy", "wy", "gyro_y", "gyr_y", "w_y", "angular_velocity_y", "omega_y"),
    "gz": ("gz", "wz", "gyro_z", "gyr_z", "w_z", "angular_velocity_z", "omega_z"),
}


_STREAMS = {"accelerometer": ("ax", "ay", "az"), "gyroscope": ("gx", "gy", "gz")}


_FACTORS = {"m/s2": 1.0, "g": 9.80665, "rad/s": 1.0, "deg/s": float(np.pi / 180.0)}
"""Source: the standard acceleration of the 3rd General Conference on Weights and Measures, 1901."""


def _build_imu(drive: _Drive, record: Record, location: str) -> ImuSensor:
    """Read an IMU; its values are converted to the axes of the ego.

    Raises:
        DataError: the file is missing or wrong.
        CalibrationError: no transforms lead to its frame.
    """
    mount = drive.mount(record)
    table, columns = _open(drive, record, location, _IMU_COLUMNS)
    order, timestamps = _timestamps(drive, record, table, columns)
    units = {
        "accelerometer": record.get("accelerometer_unit", "m/s2"),
        "gyroscope": record.get("gyroscope_unit", "rad/s"),
    }
    streams = {}
    for stream, roles in _STREAMS.items():
        found = [columns[role] for role in roles if role in columns]
        if len(found) == 3:
            values = table.numbers(found)[order] * _FACTORS[units[stream]]
            streams[stream] = VectorSamples(timestamps, read_only(mount.rotate(values)))
    if not streams:
        problem = f"no columns ax ay az or gx gy gz among {', '.join(table.names)}; name them with `columns`"
        raise DataError(table.path, "line 1", problem)
    distance = float(np.linalg.norm(mount.translation))
    if distance > 0 and "accelerometer" in streams:
        message = f"accelerations are converted to the ego's axes, but not carried over the {distance:.3g} m to it"
        drive.ledger.note(WarningKind.ASSUMED, "imu-lever-arm", str(table.path), message)
    return ImuSensor(record["id"], MappingProxyType(streams))


def _build_gnss(drive: _Drive, record: Record, location: str) -> GnssSensor:
    """Read a satellite receiver.

    Raises:
        DataError: the file is missing or wrong.
    """
    table, columns = _open(drive, record, location, GNSS_COLUMNS)
    missing = [role for role in ("latitude", "longitude", "altitude") if role not in columns]
    if missing:
        problem = f"no column for {', '.join(missing)} among {', '.join(table.names)}; name them with `columns`"
        raise DataError(table.path, "line 1", problem)
    order, timestamps = _timestamps(drive, record, table, columns)
    positions = table.numbers([columns[role] for role in ("latitude", "longitude", "altitude")])[order]
    _check_locations(table, positions, order)
    return GnssSensor(
        id=record["id"],
        timestamps_ns=timestamps,
        positions_lla=read_only(positions),
        accuracies=_optional(table, columns, "accuracy", order),
        vertical_accuracies=_optional(table, columns, "vertical_accuracy", order),
    )


def _open(
    drive: _Drive, record: Record, location: str, wanted: Mapping[str, Sequence[str]]
) -> tuple[Table, dict[str, int]]:
    path: Path = drive.root(record, location).file(record["file"], f"{location}.file")
    table = read_table(path)
    named = record.get("columns", {})
    columns = pick_columns(table, wanted, named, f"{location}.columns", drive.manifest.path)
    if "time" not in columns:
        problem = f"no column of times among {', '.join(table.names)}; name it with `columns`"
        raise DataError(path, "line 1", problem)
    return table, columns


def _timestamps(
    drive: _Drive, record: Record, table: Table, columns: Mapping[str, int]
) -> tuple[Int64Array, Int64Array]:
    """The rows in the order of time, and their times."""
    offset_ns = int(record.get("time_offset_s", 0))
    timestamps = shifted(table.timestamps(columns["time"], record.get("unit")), offset_ns, table.path, "")
    order = np.argsort(timestamps, kind="stable")
    back = int((timestamps[1:] < timestamps[:-1]).sum())
    if back:
        message = "times run backwards; sorted by time"
        drive.ledger.note(WarningKind.REPAIRED, "samples-sorted", str(table.path), message, count=back)
    return order, read_only(timestamps[order])


def _optional(table: Table, columns: Mapping[str, int], role: str, order: Int64Array) -> Float64Array:
    if role not in columns:
        return read_only(np.full(len(table.rows), np.nan))
    return read_only(table.numbers([columns[role]])[order, 0])


def _check_locations(table: Table, positions: Float64Array, order: Int64Array) -> None:
    outside = (np.abs(positions[:, 0]) > 90) | (np.abs(positions[:, 1]) > 180)
    if outside.any():
        k = int(np.flatnonzero(outside)[0])
        problem = f"latitude {positions[k, 0]}, longitude {positions[k, 1]}; expected degrees within ±90 and ±180"
        raise DataError(table.path, f"line {table.lines[int(order[k])]}", problem)


_BUILDERS: Mapping[str, Callable[[_Drive, Record, str], Sensor]] = MappingProxyType(
    {"lidar": _build_lidar, "camera": _build_camera, "imu": _build_imu, "gnss": _build_gnss}
)


_RESERVED_NAMES = {"gnss", "lidar", "identity"}
"""Names of trajectories that stand for ways which are computed."""


def open_rig(path: Path, *, lenient: bool = False, assume_model: bool = False) -> Scene:
    """Open a folder with a `rig.toml`, or a manifest itself; images and points are read when asked for.

    Args:
        path: the folder, or the manifest.
        lenient: leave out sensors and trajectories that are at fault, files without time and times without file.
        assume_model: allow computing with camera models whose formulas nothing confirms.

    Raises:
        DataError: the manifest, or what it names, is at fault; all faults are reported at once.
    """
    manifest = read_manifest(manifest_path(path))
    ledger = Ledger(lenient=lenient)
    try:
        with ledger.telling():
            scene = _scene_from_rig_open(manifest, ledger)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error}") from error
    return with_assumed_models(scene) if assume_model else scene


def _scene_from_rig_open(manifest: Manifest, ledger: Ledger) -> Scene:
    faults = manifest.faults()
    tree = _frame_tree(manifest, faults, ledger)
    trajectories = _trajectories(manifest, tree, faults, ledger)
    drive = _Drive(manifest, tree, default_poses(trajectories, str(manifest.path), ledger), ledger)
    closing = _CloseVideos(drive.videos)
    sensors: list[Sensor] = []
    try:
        for location, record in manifest.records("sensors"):
            with _judging(location, faults, ledger):
                sensors.append(_BUILDERS[record["type"]](drive, record, location))
        faults.raise_all()
    except BaseException:
        closing()
        raise
    _note_frames_and_roots(drive)
    _note_doubts(manifest.path, sensors, trajectories, ledger)
    return Scene(
        sensors=tuple(sensors),
        trajectories=MappingProxyType(trajectories),
        metadata=MappingProxyType({"rig": _about(manifest, tree)}),
        source=str(manifest.path.parent if manifest.path.name == MANIFEST else manifest.path),
        format="rig",
        warnings=ledger.warnings,
        on_close=closing,
    )


@dataclass(frozen=True, slots=True)
class _CloseVideos:
    """Closes the videos of a scene."""

    videos: list[VideoFile]

    def __call__(self) -> None:
        """Close them all."""
        for video in self.videos:
            video.close()


@contextmanager
def _judging(location: str, faults: Faults, ledger: Ledger) -> Iterator[None]:
    """Note what goes wrong with one part; a lenient reading leaves the part out."""
    if not ledger.lenient:
        with faults.catching(location):
            yield
        return
    try:
        yield
    except SceneloomError as error:
        where, problem = location, str(error)
        if isinstance(error, DataError) and error.file == str(faults.file) and error.location:
            where, problem = error.location, error.problem
        message = f"left out: {problem}"
        ledger.note(WarningKind.SKIPPED, "parts-at-fault", f"{faults.file}: {where}", message)


def _frame_tree(manifest: Manifest, faults: Faults, ledger: Ledger) -> FrameTree:
    """Read all transforms; without a sound tree nothing else can be judged.

    Raises:
        DataError: naming all transforms that are at fault.
    """
    edges = []
    tables = [(location, record, record["from"], record["to"]) for location, record in manifest.records("transforms")]
    for location, sensor in manifest.records("sensors"):
        if "extrinsic" not in sensor:
            continue
        where, record, frame = f"{location}.extrinsic", sensor["extrinsic"], _own_frame(sensor)
        if ("to" in record) == ("from" in record):
            found = "to and from" if "to" in record else "neither to nor from"
            faults.add(where, f"{found}; expected `to`: the frame that points of {frame!r} are taken into")
            continue
        tables.append((where, record, record.get("from", frame), record.get("to", frame)))
    for location, record, source, target in tables:
        with faults.catching(location):
            where = f"{manifest.path}: {location}"
            edges.append(Edge(source, target, read_transform(record, where, ledger), location))
    faults.raise_all()
    try:
        return FrameTree(manifest.ego, edges)
    except CalibrationError as error:
        raise DataError(manifest.path, "", str(error)) from None


def _trajectories(manifest: Manifest, tree: FrameTree, faults: Faults, ledger: Ledger) -> dict[str, Trajectory]:
    trajectories = {}
    for location, record in manifest.records("trajectories"):
        name = record.get("name", "pose")
        if name in _RESERVED_NAMES:
            faults.add(
                f"{location}.name",
                f"{name!r} stands for a trajectory that is computed; expected another name",
            )
        elif name in trajectories:
            faults.add(f"{location}.name", f"a second trajectory {name!r}; expected different names")
        else:
            with _judging(location, faults, ledger):
                trajectories[name] = _build_trajectory(manifest, record, location, tree, ledger)
    return trajectories


def _note_frames_and_roots(drive: _Drive) -> None:
    path = drive.manifest.path
    if drive.tree.loose:
        message = f"frames {', '.join(map(repr, drive.tree.loose))} are not connected with {drive.tree.ego!r}; not used"
        drive.ledger.note(WarningKind.SKIPPED, "loose-frames", str(path), message)
    records = [drive.manifest.record, *(record for _, record in drive.manifest.records("sensors"))]
    for name in dict.fromkeys(record["root"] for record in records if "root" in record):
        root = open_root(path, [name], "root").folder
        if not root.is_relative_to(path.parent.resolve()):
            message = f"files are read from {root}, outside the manifest's folder"
            drive.ledger.note(WarningKind.ASSUMED, "root-elsewhere", str(path), message)


def _about(manifest: Manifest, tree: FrameTree) -> dict[str, Any]:
    """What the manifest says that the model has no other location for: its name, and `ego_from_frame` of all frames."""
    frames = {
        name: [*tree.ego_from(name).translation.tolist(), *tree.ego_from(name).quaternion_xyzw.tolist()]
        for name in tree.frames
        if name not in tree.loose
    }
    about: dict[str, Any] = {"ego": manifest.ego, "ego_from_frame": frames}
    return {**about, "name": manifest.record["name"]} if "name" in manifest.record else about
