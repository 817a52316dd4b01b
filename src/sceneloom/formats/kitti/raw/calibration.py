"""The calibration of a day of KITTI's raw data: three files, for images as recorded and as rectified."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.kitti.calibration import projection_of, rotation_of
from sceneloom.formats.kitti.number_lines import Line, read_lines
from sceneloom.formats.kitti.spec import CALIBRATION_FILES
from sceneloom.geometry.rigid import RigidTransform

CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO = CALIBRATION_FILES

_COUNTS = {"S": 2, "K": 9, "D": 5, "R": 9, "T": 3, "S_rect": 2, "R_rect": 9, "P_rect": 12}
"""How many numbers each entry of a camera has. Source: the readme of the raw data's development kit."""


@dataclass(frozen=True, slots=True, eq=False)
class RawFile:
    """One file of named numbers.

    Attributes:
        path: the file.
        lines: by name.
    """

    path: Path
    lines: Mapping[str, Line]

    @classmethod
    def read(cls, path: Path) -> "RawFile":
        """Read the file.

        Raises:
            DataError: it is missing, or a name stands in it twice.
        """
        if not path.is_file():
            problem = "is missing; the calibration of a day stands beside its drives"
            raise DataError(path, "", problem)
        lines: dict[str, Line] = {}
        for line in read_lines(path):
            if line.words:
                name = line.words[0].rstrip(":")
                if name in lines:
                    raise line.fault(f"{name} stands in line {lines[name].number} already; expected it once")
                lines[name] = line
        return cls(path, MappingProxyType(lines))

    def numbers(self, name: str, count: int) -> Float64Array:
        """The numbers of an entry, (count,) float64.

        Raises:
            DataError: it is missing, or has another number of them.
        """
        if name not in self.lines:
            raise DataError(self.path, "", f"no {name}; it has {', '.join(self.lines) or 'nothing'}")
        line = self.lines[name]
        line.check_count((count + 1,), f"a name and {count} numbers")
        return np.array(line.floats(1, [f"{name}[{k}]" for k in range(count)]))

    def rigid(self, rotation: str, translation: str) -> RigidTransform:
        """A rotation and a translation that stand in two entries.

        Raises:
            DataError: they are missing, or no rigid transform.
        """
        matrix = self.numbers(rotation, 9).reshape(3, 3)
        try:
            return RigidTransform(rotation_of(self.lines[rotation], matrix), self.numbers(translation, 3))
        except CalibrationError as error:
            raise self.lines[rotation].fault(str(error)) from error

    @property
    def texts(self) -> dict[str, str]:
        """What stands behind each name."""
        return {name: " ".join(line.words[1:]) for name, line in self.lines.items()}


@dataclass(frozen=True, slots=True, eq=False)
class RawCalibration:
    """How the sensors of a drive lie.

    Attributes:
        rectified: whether the camera models are those of rectified images.
        camera_models: by number of the camera.
        camera_from_lidar: by number of the camera.
        lidar_from_imu: None where the day has no such file.
        texts: what stands in the files, by file and name.
    """

    rectified: bool
    camera_models: Mapping[int, Camera]
    camera_from_lidar: Mapping[int, RigidTransform]
    lidar_from_imu: RigidTransform | None
    texts: Mapping[str, Mapping[str, str]]


def read_raw_calibration(folder: Path, cameras: tuple[int, ...], *, rectified: bool) -> RawCalibration:
    """Read the calibration of a day.

    Args:
        folder: of the files.
        cameras: numbers of those that are needed; without any, the cameras' files may be missing.
        rectified: whether images are rectified, or as the cameras took them.

    Raises:
        DataError: a file or an entry is missing or wrong.
    """
    texts: dict[str, Mapping[str, str]] = {}
    camera_models: dict[int, Camera] = {}
    mounts: dict[int, RigidTransform] = {}
    if cameras:
        between, lidar = RawFile.read(folder / CAM_TO_CAM), RawFile.read(folder / VELO_TO_CAM)
        texts |= {CAM_TO_CAM: between.texts, VELO_TO_CAM: lidar.texts}
        first_from_lidar = lidar.rigid("R", "T")
        read = _rectified_camera if rectified else _recorded_camera
        for number in cameras:
            camera_models[number], camera_from_first = read(between, number)
            mounts[number] = camera_from_first @ first_from_lidar
    lidar_from_imu = None
    if (folder / IMU_TO_VELO).is_file():
        unit = RawFile.read(folder / IMU_TO_VELO)
        texts[IMU_TO_VELO] = unit.texts
        lidar_from_imu = unit.rigid("R", "T")
    return RawCalibration(rectified, camera_models, mounts, lidar_from_imu, MappingProxyType(texts))


def image_sizes(folder: Path, number: int) -> dict[bool, tuple[int, int]]:
    """Width and height of a camera's images [px], by whether they are rectified."""
    file = RawFile.read(folder / CAM_TO_CAM)
    return {
        rectified: _size(file, f"{name}_{number:02d}") for rectified, name in ((True, "S_rect"), (False, "S"))
    }


def _size(file: RawFile, name: str) -> tuple[int, int]:
    width, height = file.numbers(name, _COUNTS["S"]).tolist()
    if not (width == int(width) > 0 and height == int(height) > 0):
        raise file.lines[name].fault(f"{width:g} {height:g}; expected whole numbers of pixels above 0")
    return int(width), int(height)


def _rectified_camera(file: RawFile, number: int) -> tuple[Camera, RigidTransform]:
    """The camera model of a rectified camera, and what takes the frame of camera 0, as recorded, into its own.

    A projection K [I t] sees the rectified frame from t = K⁻¹ p₄, its fourth column being p₄.
    """
    name = f"P_rect_{number:02d}"
    file.numbers(name, _COUNTS["P_rect"])
    p = projection_of(file.lines[name])
    rotation = file.numbers("R_rect_00", _COUNTS["R_rect"]).reshape(3, 3)
    delta_rotation = RigidTransform(rotation_of(file.lines["R_rect_00"], rotation), np.zeros(3))
    shift = np.linalg.solve(p[:, :3], p[:, 3]).astype(np.float64)
    size = _size(file, f"S_rect_{number:02d}")
    camera_model = Camera("pinhole", *size, float(p[0, 0]), float(p[1, 1]), float(p[0, 2]), float(p[1, 2]))
    return camera_model, RigidTransform(np.eye(3), shift) @ delta_rotation


def _recorded_camera(file: RawFile, number: int) -> tuple[Camera, RigidTransform]:
    """The camera model of a camera as it recorded (OpenCV's k1 k2 p1 p2 k3).

    And what takes camera 0's frame into its own.
    """
    name = f"K_{number:02d}"
    k = file.numbers(name, _COUNTS["K"]).reshape(3, 3)
    line = file.lines[name]
    if not (k[0, 0] > 0 and k[1, 1] > 0 and k[2].tolist() == [0, 0, 1] and k[0, 1] == k[1, 0] == 0):
        raise line.fault(
            f"{k.tolist()}; expected rows (f, 0, c), (0, f, c), (0, 0, 1) with focal lengths above 0"
        )
    distortion = tuple(file.numbers(f"D_{number:02d}", _COUNTS["D"]).tolist())
    numbers = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    size = _size(file, f"S_{number:02d}")
    model = ("brown_conrady", distortion) if any(distortion) else ("pinhole", ())
    camera_model = Camera(model[0], *size, *numbers, _full(model[1]))
    return camera_model, file.rigid(f"R_{number:02d}", f"T_{number:02d}")


def _full(distortion: tuple[float, ...]) -> tuple[float, ...]:
    """The coefficients in the order of `brown_conrady`, which begins as OpenCV's; further ones are 0."""
    from sceneloom.cameras.table import MODELS

    if not distortion:
        return ()
    count = len(MODELS["brown_conrady"].coefficient_names)
    return (*distortion, *(0.0,) * (count - len(distortion)))
