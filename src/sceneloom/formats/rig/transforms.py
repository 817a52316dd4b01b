"""Transforms and trajectories of a manifest: the tree of frames, trajectories brought to the ego.

And what the sensors are built with.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.poses import GREATEST_NORM_ERROR, PoseRows
from sceneloom.formats.base.text_tables import TIME_COLUMNS, pick_columns, read_table, shifted
from sceneloom.formats.rig.manifest import Manifest, Root, TimeSource, line_timestamps, open_root
from sceneloom.formats.rig.schema import Record
from sceneloom.formats.video.reader import VideoFile
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
from sceneloom.scene.poses import Poses, Trajectory, poses_along
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
        raise CalibrationError(
            f"says nothing; expected matrix, or translation and one of {', '.join(_ROTATIONS)}"
        )
    matrix = np.eye(4)
    matrix[:3, 3] = record.get("translation", (0.0, 0.0, 0.0))
    matrix[:3, :3] = _rotation(record, forms[0]) if forms else np.eye(3)
    if forms == ["euler_deg"] and _are_radians(record["euler_deg"]):
        message = (
            f"euler_deg {record['euler_deg'].tolist()} look like radians; degrees are expected, as 90 or -180"
        )
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
        raise CalibrationError(
            f"{form} {value.tolist()} of length {norm:.4f}; expected 1 within {_NORM_ERROR}"
        )
    return matrix_from_quaternion(quaternion_xyzw)


def _checked(matrix: Float64Array, location: str, ledger: Ledger) -> RigidTransform:
    if np.abs(matrix[:3, 3]).max() > _FARTHEST or np.abs(matrix[:3, :3]).max() > 2:
        problem = f"{matrix.tolist()}; expected a rotation and a translation in metres within {_FARTHEST:g}"
        raise CalibrationError(problem)
    transform, error = RigidTransform.nearest(matrix)
    if not error <= GREATEST_ERROR:
        problem = (
            "mirrored or singular" if error == float("inf") else f"off by {error:.2g} (max abs of R Rᵀ - I)"
        )
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
                raise CalibrationError(
                    f"{edge.location}: from {edge.source!r} to itself; expected two frames"
                )
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


POSE_COLUMNS: Mapping[str, Sequence[str]] = {
    "time": TIME_COLUMNS,
    "x": ("x", "tx", "px", "pos_x", "position_x", "p_x", "x_m"),
    "y": ("y", "ty", "py", "pos_y", "position_y", "p_y", "y_m"),
    "z": ("z", "tz", "pz", "pos_z", "position_z", "p_z", "z_m"),
    "qx": ("qx", "q_x", "orientation_x", "quat_x", "rot_x"),
    "qy": ("qy", "q_y", "orientation_y", "quat_y", "rot_y"),
    "qz": ("qz", "q_z", "orientation_z", "quat_z", "rot_z"),
    "qw": ("qw", "q_w", "orientation_w", "quat_w", "rot_w"),
}
"""The columns of a CSV file by what they are."""


def build_trajectory(
    manifest: Manifest, record: Record, location: str, tree: FrameTree, ledger: Ledger
) -> Trajectory:
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
        raise DataError(
            times_path, "", f"{len(timestamps)} times for {len(table.rows)} poses; expected as many"
        )
    matrices = table.numbers(range(12)).reshape(-1, 3, 4)
    quaternions = np.empty((len(matrices), 4))
    for k, matrix in enumerate(matrices):
        if np.abs(matrix[:, :3]).max() > 2:
            raise DataError(
                path, f"line {table.lines[k]}", f"{matrix.tolist()}; expected a rotation and a translation"
            )
        rotation, error = nearest_rotation(matrix[:, :3])
        if not error <= GREATEST_ERROR:
            problem = f"rotation off by {error:.2g}; expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
            raise DataError(path, f"line {table.lines[k]}", problem)
        quaternions[k] = quaternion_from_matrix(rotation)
    return PoseRows(timestamps, matrices[:, :, 3].copy(), quaternions, table.lines)


def _read_csv(manifest: Manifest, record: Record, location: str, root: Root, path: Path) -> PoseRows:
    del root
    table = read_table(path)
    columns = pick_columns(
        table, POSE_COLUMNS, record.get("columns", {}), f"{location}.columns", manifest.path
    )
    missing = [role for role in ("time", "x", "y", "z") if role not in columns]
    rotating = [role for role in ("qx", "qy", "qz", "qw") if role in columns]
    if missing or len(rotating) not in {0, 4}:
        lacking = missing or [role for role in ("qx", "qy", "qz", "qw") if role not in columns]
        problem = (
            f"no column for {', '.join(lacking)} among {', '.join(table.names)}; name them with `columns`"
        )
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


def _of_ego(
    path: Path, poses: PoseRows, frame: str, frame_from_ego: RigidTransform, ledger: Ledger
) -> PoseRows:
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


def own_frame(record: Record) -> str:
    """The name of a sensor's own frame."""
    return str(record["frame"] if "frame" in record else record["id"])


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
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
        return open_root(
            self.manifest.path, [record.get("root"), self.manifest.record.get("root")], f"{location}.root"
        )

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
        return self.tree.ego_from(own_frame(record))

    def poses(self, mount: RigidTransform, timestamps_ns: Int64Array) -> Poses | None:
        """`world_from_sensor` at those of the times that the default trajectory covers."""
        return poses_along(self.ego_path, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)
