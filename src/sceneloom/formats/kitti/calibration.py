"""Calibration files of the object, tracking and odometry benchmarks, read and written."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError, SceneloomError
from sceneloom.formats.kitti.text import Line, read_entries
from sceneloom.geometry.rigid import GREATEST_ERROR, RigidTransform, nearest_rotation

_RECTIFIED_FROM_VELODYNE = "Tr"
"""The odometry benchmark's entry: it leads into the rectified frame at once, so that no rotation stands beside it."""

_SPELLINGS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "rectification": ("R_rect", "R0_rect", "R_rect_00", "R_rect_0"),
        "camera_from_velodyne": ("Tr_velo_cam", "Tr_velo_to_cam", _RECTIFIED_FROM_VELODYNE),
        "velodyne_from_imu": ("Tr_imu_velo", "Tr_imu_to_velo"),
    }
)
"""Names of entries in the tracking, object and odometry benchmarks; with or without a colon behind."""

_OPTICAL_FROM_BODY = RigidTransform(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
"""Takes a frame that looks forward, left and up into the camera's: right, down, forward."""

_IMAGE_SIZES: Mapping[float, tuple[int, int]] = MappingProxyType(
    {721.5377: (1242, 375), 707.0493: (1224, 370), 718.3351: (1238, 374), 718.856: (1241, 376), 707.0912: (1226, 370)}
)
"""Width and height of rectified images by focal length [px], a day each. Source: sizes of the benchmarks' images."""


@dataclass(frozen=True, slots=True, eq=False)
class KittiCalibration:
    """Calibration of a drive.

    Attributes:
        projections: (3, 4) float64 by number of the camera: from the rectified frame to pixels.
        rectified_from_lidar: into the rectified frame of camera 0, in which labels are.
        lidar_from_imu: None where the file does not have it.
        entries: the file's numbers by their names, as far as they are finite numbers.
    """

    projections: Mapping[int, Float64Array]
    rectified_from_lidar: RigidTransform
    lidar_from_imu: RigidTransform | None
    entries: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: MappingProxyType({}))

    @classmethod
    def of_projection(cls, line: Line) -> "KittiCalibration":
        """Of camera 0 alone, seen from the rectified frame; DataError if the line is no projection."""
        return cls(MappingProxyType({0: _projection(line)}), RigidTransform.identity(), None)

    def camera(self, number: int, size_wh: tuple[int, int]) -> Camera:
        """The camera model of a rectified camera whose images have a size [px]."""
        return _pinhole(self.projections[number], size_wh)

    def camera_from_lidar(self, number: int) -> RigidTransform:
        """Takes the lidar's frame into that of a camera."""
        return _camera_from_rectified(self.projections[number]) @ self.rectified_from_lidar

    def usual_size(self, number: int) -> tuple[int, int] | None:
        """Width and height of the images of KITTI's cameras with this focal length [px]; None for others."""
        focal = float(self.projections[number][0, 0])
        return next((size for known, size in _IMAGE_SIZES.items() if abs(known - focal) < 1e-3), None)


def read_calibration(path: Path, *, needs_lidar: bool = True) -> KittiCalibration:
    """Read a calibration file.

    Args:
        needs_lidar: refuse a file that does not state where the lidar is; else the lidar's frame is then that of
            the rectified camera 0, rotated forward, left and up.

    Raises:
        DataError: an entry is missing, there twice, or its numbers are no projection or no rigid transform.

    Source: the readme files of KITTI's development kits for objects and tracking.
    """
    entries = read_entries(path)
    projections = {
        int(name[1:]): _projection(line)
        for name, line in entries.items()
        if len(name) == 2 and name[0] == "P" and name[1].isdigit()
    }
    finite = {}
    for name, line in entries.items():
        with suppress(DataError):  # such as a date: no number that a scene is made of
            finite[name] = tuple(line.floats(1, [name] * (len(line.words) - 1)))
    has_imu = any(name in entries for name in _SPELLINGS["velodyne_from_imu"])
    imu = _entry(path, entries, "velodyne_from_imu") if has_imu else None
    return KittiCalibration(
        MappingProxyType(projections),
        _rectified_from_lidar(path, entries, needs_lidar=needs_lidar),
        None if imu is None else rigid_of(imu, imu.entry(12)),
        MappingProxyType(finite),
    )


def _rectified_from_lidar(path: Path, entries: Mapping[str, Line], *, needs_lidar: bool) -> RigidTransform:
    known = _SPELLINGS["camera_from_velodyne"]
    if not needs_lidar and not any(name in entries for name in known):
        return _OPTICAL_FROM_BODY
    line = _entry(path, entries, "camera_from_velodyne")
    camera_from_velodyne = rigid_of(line, line.entry(12))
    if line.words[0].rstrip(":") == _RECTIFIED_FROM_VELODYNE:
        return camera_from_velodyne
    line = _entry(path, entries, "rectification")
    rectification = RigidTransform(rotation_of(line, line.entry(9).reshape(3, 3)), np.zeros(3))
    return rectification @ camera_from_velodyne


def _entry(path: Path, entries: Mapping[str, Line], meaning: str) -> Line:
    known = _SPELLINGS[meaning]
    found = [entries[name] for name in known if name in entries]
    if len(found) == 1:
        return found[0]
    if not found:
        raise DataError(path, "", f"no {' or '.join(known[:2])}; it has {', '.join(entries) or 'nothing'}")
    raise found[1].fault(f"{found[1].words[0]} beside {found[0].words[0]}; expected one of both")


def _projection(line: Line) -> Float64Array:
    """The (3, 4) matrix of a projection, K [I t]; DataError if it is none."""
    matrix = line.entry(12).reshape(3, 4)
    k = matrix[:, :3]
    upright = np.array_equal(k[[1, 2, 2], [0, 0, 1]], np.zeros(3)) and k[2, 2] == 1 and k[0, 1] == 0
    if not (upright and k[0, 0] > 0 and k[1, 1] > 0):
        raise line.fault(f"{k.tolist()}; expected rows (f, 0, c), (0, f, c), (0, 0, 1) with focal lengths above 0")
    return matrix


def _pinhole(projection: Float64Array, size_wh: tuple[int, int]) -> Camera:
    """The camera model of a projection, for images of a size [px]."""
    p = projection.tolist()
    return Camera("pinhole", *size_wh, p[0][0], p[1][1], p[0][2], p[1][2])


def _camera_from_rectified(projection: Float64Array) -> RigidTransform:
    """Takes the rectified frame into the camera's: K [I t] sees it from t = K⁻¹ p₄, its fourth column being p₄."""
    return RigidTransform(np.eye(3), np.linalg.solve(projection[:, :3], projection[:, 3]).astype(np.float64))


def rotation_of(line: Line, matrix: Float64Array) -> Float64Array:
    """The rotation nearest to a (3, 3) matrix of a line; DataError if the matrix is too far from one."""
    small = np.abs(matrix).max() <= 2  # larger ones would overflow in the test
    rotation, error = nearest_rotation(matrix) if small else (matrix, float("inf"))
    if not error <= GREATEST_ERROR:
        raise line.fault(
            f"a rotation off by {error:.2g}; expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
        )
    return rotation


def rigid_of(line: Line, numbers: Float64Array) -> RigidTransform:
    """The transform of [R t], (12,), of a line; DataError if R is too far from a rotation."""
    matrix = numbers.reshape(3, 4)
    try:
        return RigidTransform(rotation_of(line, matrix[:, :3]), matrix[:, 3].copy())
    except CalibrationError as error:
        raise line.fault(str(error)) from error


CAMERAS = 4
SPARE_CAMERA = Camera("pinhole", 1242, 375, 721.5377, 721.5377, 609.5593, 172.854)
"""What files state of cameras where a scene has none: KITTI's own."""

_SAME = 1e-9

_NAMES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "object": ("R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"),
        "tracking": ("R_rect", "Tr_velo_cam", "Tr_imu_velo"),
        "odometry": ("", _RECTIFIED_FROM_VELODYNE, ""),
    }
)
"""What each benchmark calls the rectification, and where the lidar and the OXTS unit are."""

_PLAIN_NAMES = frozenset({"R_rect", "Tr_velo_cam", "Tr_imu_velo"})  # entries that stand without a colon behind


@dataclass(frozen=True, slots=True, eq=False)
class Mounted:
    """What a calibration states.

    Attributes:
        camera_models, camera_from_lidar: by KITTI's number of the camera.
        lidar_from_imu: None where the ego is the lidar.
        reference: the camera whose frame is the rectified one; None without cameras.
        has_lidar: whether there is one; else its frame is the ego's, and files may position it elsewhere.
    """

    camera_models: Mapping[int, Camera]
    camera_from_lidar: Mapping[int, RigidTransform]
    lidar_from_imu: RigidTransform | None
    reference: int | None
    has_lidar: bool = True

    @property
    def rectified_from_lidar(self) -> RigidTransform:
        """Takes the lidar's frame into that of labels; without cameras, that of one that looks ahead from the lidar."""
        if self.reference is None:
            return _OPTICAL_FROM_BODY
        return self.camera_from_lidar[self.reference]

    def files_lidar_from_lidar(
        self, camera_from_lidar: Mapping[int, RigidTransform], lidar_from_imu: RigidTransform | None
    ) -> RigidTransform | None:
        """Compare with the extrinsics in files.

        Returns:
            What takes this lidar frame into that of the files, which differ only where there is no lidar; None where
            sensors lie elsewhere.
        """
        same = RigidTransform.identity()
        between = same
        if not self.has_lidar:
            between = (lidar_from_imu or same) @ (self.lidar_from_imu or same).inverse()
        elif self.lidar_from_imu is not None and (
            lidar_from_imu is None or not _same(lidar_from_imu, self.lidar_from_imu)
        ):
            return None
        pairs = [(camera_from_lidar[number] @ between, self.camera_from_lidar[number]) for number in self.camera_models]
        return between if all(_same(a, b) for a, b in pairs) else None


def write_calibration(path: Path, benchmark: str, mounted: Mounted, kept: Mapping[str, Any] | None) -> RigidTransform:
    """Write a calibration file.

    Args:
        path: the file.
        benchmark: whose, which decides what entries are called.
        mounted: camera models and extrinsics.
        kept: entries that the scene was read with; they are written where they mean the same.

    Returns:
        What takes the lidar's frame into that of labels.
    """
    if kept:
        path.write_text(_text(_renamed(kept, benchmark)), "utf-8", newline="\n")
        found = _rectified_if_same(path, mounted)
        if found is not None:
            return found
    path.write_text(_text(_built(benchmark, mounted)), "utf-8", newline="\n")
    return mounted.rectified_from_lidar


def _rectified_if_same(path: Path, mounted: Mounted) -> RigidTransform | None:
    """The frame of labels that a file states, if all else in it is as in the scene; None if not."""
    try:
        read = read_calibration(path)
        mounts = {number: read.camera_from_lidar(number) for number in mounted.camera_models}
        pairs = [
            (read.camera(number, (camera.width, camera.height)), camera)
            for number, camera in mounted.camera_models.items()
        ]
    except (SceneloomError, KeyError):
        return None
    if not all(b.model == "pinhole" and np.abs(a.matrix - b.matrix).max() <= _SAME for a, b in pairs):
        return None
    between = mounted.files_lidar_from_lidar(mounts, read.lidar_from_imu)
    return None if between is None else read.rectified_from_lidar @ between


def _same(a: RigidTransform, b: RigidTransform) -> bool:
    return bool(np.abs(a.matrix - b.matrix).max() <= _SAME)


def _renamed(kept: Mapping[str, Any], benchmark: str) -> dict[str, list[float]]:
    """Entries under the names of a benchmark; a rectified frame's rotation is multiplied in where it has no name."""
    found = {
        name: np.asarray(row, np.float64).tolist()
        for name, row in kept.items()
        if name[:1] == "P" and name[1:].isdigit()
    }
    rotation, placed, unit = (
        next((np.asarray(kept[name], np.float64) for name in reversed(names) if name and name in kept), None)
        for names in zip(*_NAMES.values(), strict=True)
    )
    rectification = _NAMES[benchmark][0]
    if placed is not None and _RECTIFIED_FROM_VELODYNE in kept:
        rotation = np.eye(3).reshape(-1)
    if placed is not None and not rectification and rotation is not None:
        placed = (rotation.reshape(3, 3) @ placed.reshape(3, 4)).reshape(-1)
    for name, numbers in zip(_NAMES[benchmark], (rotation, placed, unit), strict=True):
        if name and numbers is not None:
            found[name] = numbers.tolist()
    return found


def _built(benchmark: str, mounted: Mounted) -> dict[str, list[float]]:
    """Entries that state what a scene says: the reference camera's frame is the rectified one."""
    base = mounted.rectified_from_lidar
    found = {}
    spare = next(iter(mounted.camera_models.values()), SPARE_CAMERA)
    for number in range(CAMERAS):
        camera_model = mounted.camera_models.get(number, mounted.camera_models.get(mounted.reference or 0, spare))
        shift = np.zeros(3)
        if number in mounted.camera_from_lidar and number != mounted.reference:
            shift = (mounted.camera_from_lidar[number] @ base.inverse()).translation
        found[f"P{number}"] = np.column_stack([camera_model.matrix, camera_model.matrix @ shift]).reshape(-1).tolist()
    rectification, lidar, unit = _NAMES[benchmark]
    if rectification:
        found[rectification] = np.eye(3).reshape(-1).tolist()
    found[lidar] = base.matrix[:3].reshape(-1).tolist()
    if unit and mounted.lidar_from_imu is not None:
        found[unit] = mounted.lidar_from_imu.matrix[:3].reshape(-1).tolist()
    return found


def _text(entries: Mapping[str, list[float]]) -> str:
    """The lines of a file, all digits."""
    return "".join(
        f"{name}{'' if name in _PLAIN_NAMES else ':'} {' '.join(map(repr, values))}\n"
        for name, values in entries.items()
    )
