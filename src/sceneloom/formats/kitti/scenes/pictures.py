"""KITTI's pictures: files, all of one lens, or each with a lens and a mounting of its own."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from sceneloom.arrays import Int64Array
from sceneloom.formats.kitti.calibration import KittiCalibration
from sceneloom.formats.rig.pictures import PictureFile, is_jpeg, picture_size
from sceneloom.scene.cameras import Picture


@dataclass(frozen=True, slots=True, eq=False)
class FramedPictures:
    """Makes pictures whose lenses and mountings stand in a file of each frame; none is decoded before it is asked for.

    Attributes:
        files: of each picture.
        names: of the files, seen from the folder above theirs.
        timestamps_ns: (N,) int64 [ns].
        camera: the number of the camera.
        calibrations: those that occur.
        chosen: which of them each picture has.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    timestamps_ns: Int64Array
    camera: int
    calibrations: tuple[KittiCalibration, ...]
    chosen: tuple[int, ...]

    def __call__(self, k: int) -> Picture:
        """Make picture `k`, whose size its file tells.

        Raises:
            DataError: the file is missing, or no picture.
        """
        calibration, path = self.calibrations[self.chosen[k]], self.files[k]
        lens = calibration.camera(self.camera, picture_size(path))
        file = PictureFile(path, lens.width, lens.height)
        extras: Mapping[str, str] = MappingProxyType({"file": self.names[k]})
        mount = calibration.camera_from_lidar(self.camera).inverse()
        encoded = file.encoded if is_jpeg(path) else None
        return Picture(int(self.timestamps_ns[k]), lens, file, mount, extras, encoded)
