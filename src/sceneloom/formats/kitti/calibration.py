"""KITTI's calibration files, in the spellings of the tracking and of the object benchmark."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.kitti.number_lines import Line, read_lines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import GREATEST_ERROR, nearest_rotation

RECTIFIED_FROM_VELODYNE = "Tr"
"""The odometry benchmark's entry: it leads into the rectified frame at once, so that no rotation stands beside it."""

_SPELLINGS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "rectification": ("R_rect", "R0_rect", "R_rect_00", "R_rect_0"),
        "camera_from_velodyne": ("Tr_velo_cam", "Tr_velo_to_cam", RECTIFIED_FROM_VELODYNE),
        "velodyne_from_imu": ("Tr_imu_velo", "Tr_imu_to_velo"),
    }
)
"""What the entries are called in the tracking benchmark, in the object benchmark, and in that of odometry; with or
without a colon behind."""

OPTICAL_FROM_BODY = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3)
)
"""Takes a frame that looks forward, left and up into the camera's: right, down, forward."""

IMAGE_SIZES: Mapping[float, tuple[int, int]] = MappingProxyType(
    {
        721.5377: (1242, 375),
        707.0493: (1224, 370),
        718.3351: (1238, 374),
        718.856: (1241, 376),
        707.0912: (1226, 370),
    }
)
"""Width and height of rectified images by focal length [px], one for each day of the recordings.

Source: the sizes of the benchmarks' own images.
"""


@dataclass(frozen=True, slots=True, eq=False)
class KittiCalibration:
    """How the sensors of a drive lie.

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

    def camera(self, number: int, size_wh: tuple[int, int]) -> Camera:
        """The camera model of a rectified camera.

        Args:
            number: of the camera.
            size_wh: of its images [px].
        """
        p = self.projections[number]
        return Camera("pinhole", *size_wh, float(p[0, 0]), float(p[1, 1]), float(p[0, 2]), float(p[1, 2]))

    def camera_from_lidar(self, number: int) -> RigidTransform:
        """Takes the lidar's frame into that of a camera.

        A projection K [I t] sees the rectified frame from t = K⁻¹ p₄, its fourth column being p₄.
        """
        p = self.projections[number]
        shift = np.linalg.solve(p[:, :3], p[:, 3]).astype(np.float64)
        return RigidTransform(np.eye(3), shift) @ self.rectified_from_lidar

    def usual_size(self, number: int) -> tuple[int, int] | None:
        """Width and height of the images of KITTI's cameras with this focal length [px]; None for others."""
        focal = float(self.projections[number][0, 0])
        return next((size for known, size in IMAGE_SIZES.items() if abs(known - focal) < 1e-3), None)


def read_calibration(path: Path, *, needs_lidar: bool = True) -> KittiCalibration:
    """Read a calibration file.

    Args:
        needs_lidar: refuse a file that does not state where the lidar is; else the lidar's frame is then that of
            the rectified camera 0, rotated forward, left and up.

    Raises:
        DataError: an entry is missing, there twice, or its numbers are no projection or no rigid transform.

    Source: the readme files of KITTI's development kits for objects and tracking.
    """
    entries: dict[str, Line] = {}
    for line in read_lines(path):
        if not line.words:
            continue
        name = line.words[0].rstrip(":")
        if name in entries:
            raise line.fault(f"{name} stands in line {entries[name].number} already; expected it once")
        entries[name] = line
    projections = {
        int(name[1:]): projection_of(line)
        for name, line in entries.items()
        if len(name) == 2 and name[0] == "P" and name[1].isdigit()
    }
    has_imu = any(name in entries for name in _SPELLINGS["velodyne_from_imu"])
    return KittiCalibration(
        MappingProxyType(projections),
        _rectified_from_lidar(path, entries, needs_lidar=needs_lidar),
        _rigid(_entry(path, entries, "velodyne_from_imu")) if has_imu else None,
        MappingProxyType(_finite_entries(entries)),
    )


def _rectified_from_lidar(path: Path, entries: Mapping[str, Line], *, needs_lidar: bool) -> RigidTransform:
    known = _SPELLINGS["camera_from_velodyne"]
    if not needs_lidar and not any(name in entries for name in known):
        return OPTICAL_FROM_BODY
    line = _entry(path, entries, "camera_from_velodyne")
    camera_from_velodyne = _rigid(line)
    if line.words[0].rstrip(":") == RECTIFIED_FROM_VELODYNE:
        return camera_from_velodyne
    line = _entry(path, entries, "rectification")
    rectification = RigidTransform(rotation_of(line, _numbers(line, 9).reshape(3, 3)), np.zeros(3))
    return rectification @ camera_from_velodyne


def _finite_entries(entries: Mapping[str, Line]) -> dict[str, tuple[float, ...]]:
    found = {}
    for name, line in entries.items():
        try:
            found[name] = tuple(line.floats(1, [name] * (len(line.words) - 1)))
        except DataError:
            continue  # such as a date: no number that a scene is made of
    return found


def _entry(path: Path, entries: Mapping[str, Line], meaning: str) -> Line:
    known = _SPELLINGS[meaning]
    found = [entries[name] for name in known if name in entries]
    if len(found) == 1:
        return found[0]
    if not found:
        raise DataError(path, "", f"no {' or '.join(known[:2])}; it has {', '.join(entries) or 'nothing'}")
    raise found[1].fault(f"{found[1].words[0]} beside {found[0].words[0]}; expected one of both")


def _numbers(line: Line, count: int) -> Float64Array:
    line.check_count((count + 1,), f"a name and {count} numbers")
    return np.array(line.floats(1, [f"{line.words[0].rstrip(':')}[{k}]" for k in range(count)]))


def projection_of(line: Line) -> Float64Array:
    """The (3, 4) matrix of a projection, K [I t].

    Raises:
        DataError: it is none.
    """
    matrix = _numbers(line, 12).reshape(3, 4)
    k = matrix[:, :3]
    upright = np.array_equal(k[[1, 2, 2], [0, 0, 1]], np.zeros(3)) and k[2, 2] == 1 and k[0, 1] == 0
    if not (upright and k[0, 0] > 0 and k[1, 1] > 0):
        raise line.fault(
            f"{k.tolist()}; expected rows (f, 0, c), (0, f, c), (0, 0, 1) with focal lengths above 0"
        )
    return matrix


def rotation_of(line: Line, matrix: Float64Array) -> Float64Array:
    """The rotation nearest to a (3, 3) matrix of a line.

    Raises:
        DataError: the matrix is too far from one.
    """
    small = np.abs(matrix).max() <= 2  # larger ones would overflow in the test
    rotation, error = nearest_rotation(matrix) if small else (matrix, float("inf"))
    if not error <= GREATEST_ERROR:
        raise line.fault(
            f"a rotation off by {error:.2g}; expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
        )
    return rotation


def _rigid(line: Line) -> RigidTransform:
    matrix = _numbers(line, 12).reshape(3, 4)
    try:
        return RigidTransform(rotation_of(line, matrix[:, :3]), matrix[:, 3].copy())
    except CalibrationError as error:
        raise line.fault(str(error)) from error
