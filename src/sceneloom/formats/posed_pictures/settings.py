"""What one can choose of pictures and points, as texts from the command line or as values."""

from dataclasses import dataclass

from sceneloom.errors import OptionError

IMAGES = ("jpg", "png", "none")
_OPTIONS = ("images", "voxel", "points", "trajectory")


@dataclass(frozen=True, slots=True)
class PosedSettings:
    """How pictures and points are written.

    Attributes:
        images: "jpg" copies a camera's own JPEG files, and encodes what has none; "png" loses nothing; "none".
        voxel: side of the cubes of which one point stays [m].
        points: the most points.
        trajectory: name of the ego's way, where sensors ride on it; None for the default.
    """

    images: str = "jpg"
    voxel: float = 0.1
    points: int = 500_000
    trajectory: str | None = None

    @classmethod
    def of(
        cls,
        *,
        images: str = "jpg",
        voxel: str | float = 0.1,
        points: str | int = 500_000,
        trajectory: str | None = None,
    ) -> "PosedSettings":
        """Read values that may be texts.

        Raises:
            OptionError: one cannot be followed.
        """
        if images not in IMAGES:
            raise OptionError(f"images {images!r}; expected one of {', '.join(IMAGES)}")
        return cls(images, _positive("voxel", voxel), _count("points", points), trajectory)


def _positive(name: str, value: str | float) -> float:
    try:
        number = float(value)
    except ValueError:
        number = -1.0
    if not 0.0 < number < float("inf"):
        raise OptionError(f"{name} {value!r}; expected a number above 0")
    return number


def _count(name: str, value: str | int) -> int:
    try:
        number = int(value)
    except ValueError:
        number = -1
    if number < 0:
        raise OptionError(f"{name} {value!r}; expected a whole number of 0 or more")
    return number


NAMES = _OPTIONS
"""The names of the options."""
