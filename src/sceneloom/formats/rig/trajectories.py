"""The trajectories of a manifest: TUM, KITTI and CSV files, of any frame of the rig, brought to the ego."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import read_only
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.poses import GREATEST_NORM_ERROR, PoseRows
from sceneloom.formats.rig.csv_files import TIME_COLUMNS, pick_columns, read_table
from sceneloom.formats.rig.manifest import Manifest
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.roots import Root, open_root
from sceneloom.formats.rig.times import line_timestamps
from sceneloom.formats.rig.timestamps import shifted
from sceneloom.formats.rig.transforms import FrameTree, frame_from_optical
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    GREATEST_ERROR,
    multiply_quaternions,
    nearest_rotation,
    normalise_quaternion,
    quaternion_from_matrix,
    rotate_vectors,
)
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.warnings import WarningKind

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
