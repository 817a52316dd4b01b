"""Shared by KITTI's readers: sweeps with point times, camera images, sensors on the ego, labels as annotations."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.images import ImageReader
from sceneloom.formats.kitti.labels import CENTRE_TO_CORNER, NO_TRACK, KittiLabels
from sceneloom.formats.kitti.text import NumberedFiles
from sceneloom.formats.points.cloud import KITTI, parse_rows
from sceneloom.formats.points.files import read_bin
from sceneloom.formats.points.mapping import IntensityScale, detect_scale
from sceneloom.geometry.euler import cuboid_angles_from_rotation
from sceneloom.geometry.rigid import RigidTransform, matrix_from_quaternion
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
    Projection,
)
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, PoseSamples, Trajectory, poses_along
from sceneloom.scene.types import Identifier
from sceneloom.warnings import WarningKind

_REFLECTANCE = IntensityScale(1.0)
"""KITTI's reflectance goes from 0 to 1. Source: the readme of the raw data's development kit."""

POINT_BYTES = KITTI.dtype.itemsize
"""How long a point is in a file of sweeps [bytes]."""


_Rotations = tuple[Int64Array, Int64Array, Int64Array]
"""When the scanner began each rotation, looked ahead and ended it, (N,) int64 [ns] each."""


@dataclass(frozen=True, slots=True, eq=False)
class _SweepFiles:
    """Reads sweeps, each when it is asked for; all points stay in their order, so that labels fit."""

    files: tuple[Path, ...]
    names: tuple[str, ...]  # seen from the folder above theirs
    timestamps_ns: Int64Array
    scale: IntensityScale = _REFLECTANCE  # of the reflectance
    rotations: _Rotations | None = None  # None where the source does not report them

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`."""
        columns = _read_columns(self.files[k])
        positions = _positions(self.files[k], columns)
        intensities, clipped = self.scale.apply(columns["intensity"])
        extras: dict[str, Any] = {"file": self.names[k]}
        if clipped:
            extras["clipped_intensities"] = clipped
        times = None
        if self.rotations is not None:
            start_ns, middle_ns, end_ns = (int(timestamps[k]) for timestamps in self.rotations)
            times = read_only(times_in_rotation(positions, start_ns, middle_ns, end_ns))
            extras |= {"forward_ns": middle_ns, "end_ns": end_ns}
        points = LidarPoints(read_only(positions), read_only(intensities), timestamps_ns=times)
        return LidarFrame(int(self.timestamps_ns[k]), points, MappingProxyType(extras))


def _read_columns(path: Path) -> Mapping[str, AnyArray]:
    """The columns x, y, z and intensity of a sweep: packed float32, or text where the name ends in `.txt`."""
    if path.suffix.lower() != ".txt":
        return read_bin(path, layout=KITTI).columns
    lines = [line for line in read_bytes(path).decode("utf-8", "replace").splitlines() if line.strip()]
    rows = parse_rows(path, lines, KITTI.dtype, 1)
    return {name: np.ascontiguousarray(rows[name]) for name in KITTI.names}


def _positions(path: Path, columns: Mapping[str, AnyArray]) -> Float32Array:
    positions: Float32Array = np.stack([columns[axis] for axis in "xyz"], axis=1)
    finite = np.isfinite(positions).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        problem = f"{positions[row].tolist()}; expected finite metres: is it a file of packed float32?"
        raise DataError(path, f"point {row}", problem)
    return positions


def times_in_rotation(positions: Float32Array, start_ns: int, middle_ns: int, end_ns: int) -> Int64Array:
    """When points were measured, by the direction in which they lie, (N,) int64 [ns].

    The scanner rotates counter-clockwise seen from above; it begins behind, looks ahead in the middle and ends behind.

    Args:
        positions: (N, 3) float32 [m], lidar frame: x forward, y left.
        start_ns, middle_ns, end_ns: of the rotation [ns].

    Source: the development kit of KITTI's raw data: cameras are triggered when the lasers look forward.
    """
    rotations = np.arctan2(positions[:, 1].astype(np.float64), positions[:, 0].astype(np.float64)) / np.pi
    spans = np.where(rotations < 0, middle_ns - start_ns, end_ns - middle_ns)
    return middle_ns + np.rint(rotations * spans).astype(np.int64)


def _scale_of(path: Path, ledger: Ledger) -> IntensityScale:
    """The scale of the reflectance, by a sensor's first sweep: 0 to 1, else that of other programs, with a warning."""
    values = _read_columns(path)["intensity"]
    found = detect_scale(values) or IntensityScale(255.0)
    if found.maximum != _REFLECTANCE.maximum:
        message = f"reflectance beyond 1, where KITTI's ends: taken as 0 to {found.maximum:g}"
        ledger.note(WarningKind.ASSUMED, "reflectance-scale", str(path), message)
    return found


LIDAR_ID = "velodyne"


def camera_id(number: int) -> str:
    """What a camera is called: its number is that of KITTI's."""
    return f"camera{number}"


def lidar_sensor(
    files: NumberedFiles,
    timestamps_ns: Int64Array,
    mount: RigidTransform,
    path: Poses | None,
    ledger: Ledger,
    *,
    rotations: _Rotations | None = None,
) -> LidarSensor:
    """The lidar.

    Args:
        files: its sweeps.
        timestamps_ns: of each, (N,) int64 [ns].
        mount: `ego_from_lidar`.
        path: `world_from_ego`, or None.
        ledger: takes a warning if the reflectance has another scale.
        rotations: when the scanner began each, looked ahead and ended it, (N,) int64 [ns] each.

    Raises:
        DataError: the first sweep is wrong.
    """
    timestamps = read_only(timestamps_ns)
    reader = _SweepFiles(files.paths, files.names, timestamps, _scale_of(files.paths[0], ledger), rotations)
    return LidarSensor(
        LIDAR_ID,
        LazyFrames(timestamps, reader),
        poses=poses_along(path, {0: mount}, np.zeros(len(timestamps), np.int64), timestamps),
        mount=mount,
    )


def camera_sensor(
    number: int,
    files: NumberedFiles,
    timestamps_ns: Int64Array,
    camera_model: Camera,
    mount: RigidTransform,
    path: Poses | None,
) -> CameraSensor:
    """A camera whose images have one camera model and one mounting; it may have no images.

    Args:
        number: KITTI's.
        files: its images.
        timestamps_ns: of each, (N,) int64 [ns].
        camera_model: of all images.
        mount: `ego_from_camera`.
        path: `world_from_ego`, or None.
    """
    timestamps = read_only(timestamps_ns)
    images: LazyFrames[CameraImage] = LazyFrames(
        timestamps, ImageReader(files.paths, files.names, timestamps, camera_model)
    )
    return CameraSensor(
        camera_id(number),
        camera_model,
        images,
        poses=poses_along(path, {0: mount}, np.zeros(len(timestamps), np.int64), timestamps),
        mount=mount,
    )


def stationary(timestamps_ns: Int64Array, location: Path | str, reason: str, ledger: Ledger) -> Trajectory:
    """The trajectory of a stationary ego, with a warning: boxes need a world, and no ego trajectory is known.

    Args:
        timestamps_ns: (N,) int64 [ns], N >= 1, of all that is placed.
        location: for the warning.
        reason: why the trajectory is not known.
        ledger: takes the warning.
    """
    ledger.note(
        WarningKind.ASSUMED, "ego-stands", str(location), f"{reason}: boxes are placed as if the ego was stationary"
    )
    times = np.unique(np.array([timestamps_ns.min(), timestamps_ns.max()], np.int64))
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    return Trajectory("stationary", read_only(times), read_only(np.zeros((len(times), 3))), read_only(rotations))


def kitti_metadata(benchmark: str, **reported: Any) -> Mapping[str, Any]:
    """What a scene keeps of where it was read: `metadata["kitti"]`, and how the angles of its boxes are meant.

    Args:
        benchmark: "raw", "object", "tracking" or "odometry".
        reported: further fields; those that are None are left out.
    """
    about = {"benchmark": benchmark, **{name: value for name, value in reported.items() if value is not None}}
    return MappingProxyType({"sceneloom": {"euler_unit": "degrees", "euler_order": "xyz"}, "kitti": about})


@dataclass(frozen=True, slots=True, eq=False)
class LabelLocations:
    """When and where the frames of labels are.

    Attributes:
        timestamps_ns: by row of the labels, (N,) int64 [ns].
        world_from_rectified: by row of the labels.
        camera_id: in whose images the boxes are.
        file: the labels' file or folder, for messages.
    """

    timestamps_ns: Int64Array
    world_from_rectified: PoseSamples
    camera_id: Identifier
    file: object


def label_annotations(labels: KittiLabels, locations: LabelLocations) -> tuple[Annotation, ...]:
    """Give one annotation for each track, and for each object that has none.

    Tracks have their numbers as ids, other objects `frame.count`. Regions in which nothing counts, and objects without
    a box in space, are boxes in images.

    Raises:
        DataError: a track stands twice in a frame.
    """
    values = _cuboid_rows(labels, locations.world_from_rectified)
    have_position = labels.have_position
    found: list[Annotation] = []
    for identifier, rows in _objects(labels, locations.file):
        solid = rows[have_position[rows]]
        flat = rows[~have_position[rows]]
        if len(solid):
            found.append(_cuboid(identifier, labels, solid, values, locations))
        if len(flat):
            flat_id: Identifier = f"{identifier} (image)" if len(solid) else identifier
            found.append(_box_2d(flat_id, labels, flat, locations))
    return tuple(found)


def _cuboid_rows(labels: KittiLabels, world_from_rectified: PoseSamples) -> Float64Array:
    """Boxes as rows of cuboids, (N, 9) float64; rows without a box in space mean nothing."""
    # Source: the readme of KITTI's development kit for objects: at 0 a box looks along the camera's x axis.
    centers = labels.bottoms - np.array([0.0, 0.5, 0.0]) * labels.sizes_hwl[:, :1]
    cosines, sines, zeros = np.cos(labels.rotations_y), np.sin(labels.rotations_y), np.zeros(len(labels))
    rectified_from_box = np.stack(
        [
            np.stack([cosines, sines, zeros], axis=1),
            np.stack([zeros, zeros, zeros - 1.0], axis=1),
            np.stack([-sines, cosines, zeros], axis=1),
        ],
        axis=1,
    )
    rotations = matrix_from_quaternion(world_from_rectified.quaternions_xyzw) if len(labels) else np.zeros((0, 3, 3))
    centers_world = np.einsum("nij,nj->ni", rotations, centers) + world_from_rectified.positions
    angles = cuboid_angles_from_rotation(rotations @ rectified_from_box)
    return np.concatenate([labels.sizes_hwl[:, ::-1], centers_world, angles], axis=1)


def _objects(labels: KittiLabels, file: object) -> list[tuple[Identifier, Int64Array]]:
    """The rows of each object, in the order in which objects first come up."""
    tracks: dict[Identifier, list[int]] = defaultdict(list)
    seen: dict[tuple[int, int], int] = {}
    in_frame: dict[int, int] = defaultdict(int)
    for row, (frame, track) in enumerate(zip(labels.frames.tolist(), labels.track_ids.tolist(), strict=True)):
        if track == NO_TRACK:
            tracks[f"{frame:06d}.{in_frame[frame]}"].append(row)
            in_frame[frame] += 1
            continue
        if (frame, track) in seen:
            raise DataError(file, f"frame {frame}", f"track {track} stands in it twice; expected once")
        seen[frame, track] = row
        tracks[track].append(row)
    return [
        (identifier, np.array(sorted(rows, key=labels.frames.__getitem__), np.int64))
        for identifier, rows in tracks.items()
    ]


def _cuboid(
    identifier: Identifier, labels: KittiLabels, rows: Int64Array, values: Float64Array, locations: LabelLocations
) -> CuboidAnnotation:
    timestamps = locations.timestamps_ns[rows]
    shown = rows[labels.have_outline[rows]]
    seen = Projection(locations.camera_id, locations.timestamps_ns[shown], _boxes(labels, shown))
    return CuboidAnnotation(
        identifier,
        CuboidPath(timestamps, values[rows]),
        label=labels.types[int(rows[0])],
        attributes=_attributes(labels, rows, locations),
        projections=(seen,) if len(shown) else (),
    )


def _box_2d(
    identifier: Identifier, labels: KittiLabels, rows: Int64Array, locations: LabelLocations
) -> Box2DAnnotation:
    return Box2DAnnotation(
        identifier,
        locations.camera_id,
        BoxPath(locations.timestamps_ns[rows], _boxes(labels, rows)),
        label=labels.types[int(rows[0])],
        attributes=_attributes(labels, rows, locations),
    )


def _boxes(labels: KittiLabels, rows: Int64Array) -> Float64Array:
    """Boxes in images as `left top width height` [px], corner convention."""
    corners = labels.corners_xyxy[rows]
    return np.concatenate([corners[:, :2] + CENTRE_TO_CORNER, corners[:, 2:] - corners[:, :2]], axis=1)


def _attributes(labels: KittiLabels, rows: Int64Array, locations: LabelLocations) -> tuple[AttributePath, ...]:
    """What is reported beside the boxes, as the text has it; what it does not report is left out."""
    timestamps = locations.timestamps_ns[rows]
    reported: dict[str, Sequence[float | str]] = {
        "truncated": labels.truncations[rows].tolist(),
        "occluded": labels.occlusions[rows].tolist(),
        "alpha": labels.alphas[rows].tolist(),
    }
    if labels.scores is not None:
        reported["score"] = labels.scores[rows].tolist()
    types = [labels.types[k] for k in rows.tolist()]
    if len(set(types)) > 1:
        reported["type"] = types
    camera_id = locations.camera_id if labels.have_outline[rows].any() else None
    return tuple(
        AttributePath(name, tuple(values), timestamps, camera_id)
        for name, values in reported.items()
        if name not in UNTOLD or any(value != UNTOLD[name] for value in values)
    )


UNTOLD = {"truncated": -1.0, "occluded": -1, "alpha": -10.0}
"""What the text has where it states nothing."""
