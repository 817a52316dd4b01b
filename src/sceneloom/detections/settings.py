"""The numbers that detection fusion by projection goes by."""

from dataclasses import dataclass, fields

from sceneloom.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class ProjectionSettings:
    """What `fuse_by_projection` takes for granted about detectors.

    Attributes:
        least_iou: boxes that overlap less in the picture than this are not one object, 0 to 1.
        prior: share of the places at which a detector could report something that hold an object, 0 to 1, both
            excluded; see `existence`.
        recall_2d, recall_3d: share of the objects in its view that the detector of pictures and that of sweeps finds,
            0 to 1 (excluded).
        least_height_px: a box less high than this in the picture need not have been found there [px].
        farthest_3d: what is farther than this need not have been found in the sweep [m].
        keep_camera_only: whether boxes of the picture without one in the sweep become objects.

    Raises:
        OptionError: a number is out of bounds.
    """

    least_iou: float = 0.3
    prior: float = 0.1
    recall_2d: float = 0.9
    recall_3d: float = 0.5
    least_height_px: float = 25.0
    farthest_3d: float = 70.0
    keep_camera_only: bool = True

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            low, high = _BOUNDS.get(f.name, (0.0, float("inf")))
            if not low <= value <= high:
                raise OptionError(f"{f.name} {value!r}; expected {low:g} to {high:g}")


_BOUNDS = {
    "least_iou": (0.0, 1.0),
    "prior": (1e-6, 1.0 - 1e-6),
    "recall_2d": (0.0, 0.999),
    "recall_3d": (0.0, 0.999),
}
