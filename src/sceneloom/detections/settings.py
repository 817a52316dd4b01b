"""The numbers that detection fusion by projection goes by."""

from dataclasses import dataclass
from typing import NamedTuple

from sceneloom.arrays import Float64Array
from sceneloom.detections.detector_files import DEFAULT, find_detectors
from sceneloom.detections.detectors import Detectors
from sceneloom.detections.existence import existence_table
from sceneloom.detections.noise import noise_table
from sceneloom.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class ProjectionSettings:
    """What `fuse_by_projection` takes for granted.

    Attributes:
        detectors: how often detectors are right, and how far off: `Detectors`, a name out of `detector_names()`, or the
            path of a file.
        least_iou: boxes that overlap less in the image than this are not one object, 0 to 1.
        recall_2d, recall_3d: share of the objects in its view that the detector of images and that of sweeps finds, 0
            to 1 (excluded), for all classes; 0 where its silence shall state nothing. [default: by `detectors`]
        keep_camera_only: whether boxes of the image without one in the sweep become objects.
        rotation_sigma_deg: how well the rotation from lidar to camera is known, beyond what images of such detectors
            show anyway [°].
        time_sigma: how well the time of a box is known; objects with a velocity are as uncertain along it [s].

    Raises:
        OptionError: a number is out of bounds.
    """

    detectors: str | Detectors = DEFAULT
    least_iou: float = 0.3
    recall_2d: float | None = None
    recall_3d: float | None = None
    keep_camera_only: bool = True
    rotation_sigma_deg: float = 0.0
    time_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in _BOUNDS.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise OptionError(f"{name} {value!r}; expected {low:g} to {high:g}")


_BOUNDS = {
    "least_iou": (0.0, 1.0),
    "recall_2d": (0.0, 0.999),
    "recall_3d": (0.0, 0.999),
    "rotation_sigma_deg": (0.0, 90.0),
    "time_sigma": (0.0, float("inf")),
}


class Tables(NamedTuple):
    """What detectors are like, as compiled formulas take it.

    Attributes:
        existence: columns of `kernels.existence_probability`.
        noise: columns of `noise`.
        degrees_of_freedom: of errors.
    """

    existence: Float64Array
    noise: Float64Array
    degrees_of_freedom: float


_TABLES: dict[ProjectionSettings, Tables] = {}
_MOST = 64


def tables_of(settings: ProjectionSettings) -> Tables:
    """Give the tables of some settings.

    Raises:
        OptionError: no detectors have that name.
        DataError: their file says something else.
    """
    found = _TABLES.get(settings)
    if found is None:
        reported = settings.detectors
        detectors = find_detectors(reported) if isinstance(reported, str) else reported
        existence = existence_table(detectors, recall_2d=settings.recall_2d, recall_3d=settings.recall_3d)
        found = Tables(existence, noise_table(detectors), detectors.degrees_of_freedom)
        if len(_TABLES) >= _MOST:
            _TABLES.clear()
        _TABLES[settings] = found
    return found
