"""KITTI's images: files, all of one camera model, or each with a camera model and a mounting of its own."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from sceneloom.arrays import Int64Array
from sceneloom.formats.kitti.calibration import KittiCalibration
from sceneloom.formats.rig.images import ImageFile, image_size, is_jpeg
from sceneloom.scene.cameras import CameraImage


@dataclass(frozen=True, slots=True, eq=False)
class FramedImages:
    """Makes images whose camera models and mountings stand in a file of each frame.

    None is decoded before it is asked for.

    Attributes:
        files: of each image.
        names: of the files, seen from the folder above theirs.
        timestamps_ns: (N,) int64 [ns].
        camera: the number of the camera.
        calibrations: those that occur.
        chosen: which of them each image has.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    timestamps_ns: Int64Array
    camera: int
    calibrations: tuple[KittiCalibration, ...]
    chosen: tuple[int, ...]

    def __call__(self, k: int) -> CameraImage:
        """Make image `k`, whose size its file reports.

        Raises:
            DataError: the file is missing, or no image.
        """
        calibration, path = self.calibrations[self.chosen[k]], self.files[k]
        camera_model = calibration.camera(self.camera, image_size(path))
        file = ImageFile(path, camera_model.width, camera_model.height)
        extras: Mapping[str, str] = MappingProxyType({"file": self.names[k]})
        mount = calibration.camera_from_lidar(self.camera).inverse()
        encoded = file.encoded if is_jpeg(path) else None
        return CameraImage(int(self.timestamps_ns[k]), camera_model, file, mount, extras, encoded)
