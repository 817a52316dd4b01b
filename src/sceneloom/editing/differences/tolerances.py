"""How much may differ without a word, and which field is counted in what."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType

from sceneloom.errors import OptionError


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Largest differences that count as none.

    Attributes:
        metres: of locations, sizes and translations.
        degrees: of rotations.
        nanoseconds: of timestamps; frames so near in time are the same frame.
        pixels: of what is drawn into images.
        other_timestamps: whether a path may be reported at other timestamps, if it is the same way within the
            tolerances.

    Raises:
        OptionError: one is negative or not a number.
    """

    metres: float = 0.0
    degrees: float = 0.0
    nanoseconds: float = 0.0
    pixels: float = 0.0
    other_timestamps: bool = False

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not 0.0 <= value < float("inf"):
                raise OptionError(f"tolerance {value} {each.name}; expected a number from 0 on")


METRES, DEGREES, NANOSECONDS, PIXELS, EXACT = "m", "deg", "ns", "px", ""

FIELDS: Mapping[tuple[str, str], str] = MappingProxyType(
    {
        ("Poses", "positions"): METRES,
        ("Poses", "quaternions_xyzw"): DEGREES,
        ("Trajectory", "positions"): METRES,
        ("Trajectory", "quaternions_xyzw"): DEGREES,
        ("LidarPoints", "positions"): METRES,
        ("RadarPoints", "positions"): METRES,
        ("PointsSensor", "positions"): METRES,
        ("PointPath", "values"): METRES,
        ("PointProjection", "positions"): METRES,
        ("PointProjection", "points"): PIXELS,
        ("Projection", "boxes"): PIXELS,
        ("BoxPath", "values"): PIXELS,
        ("RigidTransform", "translation"): METRES,
        ("RigidTransform", "rotation"): DEGREES,
    }
)
"""Class and field of everything that has a tolerance, besides timestamps (`_ns`), cuboids and vertices."""


def unit_of(owner: str, name: str) -> str:
    """What a field of a class is counted in; "" where it has to be equal."""
    return NANOSECONDS if name.endswith("_ns") else FIELDS.get((owner, name), EXACT)


def limit_of(tolerances: Tolerances, unit: str) -> float:
    """The tolerance of a unit."""
    limits = {
        METRES: tolerances.metres,
        DEGREES: tolerances.degrees,
        NANOSECONDS: tolerances.nanoseconds,
        PIXELS: tolerances.pixels,
    }
    return limits.get(unit, 0.0)
