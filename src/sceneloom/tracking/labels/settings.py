"""The numbers that labels are made by."""

from dataclasses import dataclass, fields

from sceneloom.errors import OptionError

_ANY = float("inf")


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelSettings:
    """How tracks become annotations.

    Attributes:
        tolerance_m: what interpolation between keyframes may be off in place, and in size [m].
        tolerance_deg: what it may be off in heading [deg].
        constant_sizes: whether each object gets one size.
        stationary: whether what is stationary is found, and given one pose.
        stationary_spread: what stands is never farther than this from its usual location [m].
        stationary_speed: nor does it get on faster than this from its first to its last state [m/s], or than its speed
            is uncertain.
        least_states: objects that fewer boxes of detectors support are left out.
        least_score: objects that are never surer than this are left out, 0 to 1.
        boxes_2d: whether the detector's boxes in images become annotations.
        longest_gap: a box in images that was not found for longer is another annotation [s].
        projections: whether cameras report where they see the cuboids, and when.
        points: whether lidars report how many points the cuboids hold, and when.
        radar: whether radars report which cuboids they meet, and how fast these come nearer.
        links: whether riders are linked with what they ride.
        source: where the tracks come from, for those who read the labels.

    Raises:
        OptionError: a number is out of bounds.
    """

    tolerance_m: float = 0.05
    tolerance_deg: float = 1.0
    constant_sizes: bool = True
    stationary: bool = True
    stationary_spread: float = 0.6
    stationary_speed: float = 0.25
    least_states: int = 2
    least_score: float = 0.0
    boxes_2d: bool = True
    longest_gap: float = 0.5
    projections: bool = True
    points: bool = True
    radar: bool = True
    links: bool = True
    source: str = "tracks"

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            low, high = _BOUNDS.get(f.name, (0.0, _ANY))
            if isinstance(value, float | int) and not low <= value <= high:
                raise OptionError(f"{f.name} {value!r}; expected {low:g} to {high:g}")


_BOUNDS = {"least_score": (0.0, 1.0), "tolerance_deg": (0.0, 180.0), "least_states": (1.0, _ANY)}
