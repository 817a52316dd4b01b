"""Settings of the tracker and of labels made from tracks."""

from dataclasses import dataclass, fields
from enum import StrEnum

from sceneloom.detections.detectors import DEFAULT, Detectors
from sceneloom.errors import OptionError


class ImageBox(StrEnum):
    """Which box of an object in an image is reported."""

    IMAGE = "image"
    """What the detector of images says of it, filtered; where it says nothing, what it would state."""
    PROJECTED = "projected"
    """The outline of the box in space."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerSettings:
    """What a tracker takes for granted about objects and detectors.

    Attributes:
        detectors: what they find, and how their boxes in images differ from outlines, as in `ProjectionSettings`.
        vehicle_acceleration: how much the velocity of vehicles changes in a second [m/s].
        person_acceleration: the same of people [m/s].
        yaw_acceleration: how quickly vehicles change how fast they rotate [rad/s²].
        side_slip: how fast vehicles move across their heading [m/s].
        recall_2d, recall_3d: share of the objects that it sees openly which the detector of images and that of
            sweeps finds at one time, 0 to 1 (excluded). [default: by `detectors`]
        trust: how much one more box counts, 0 to 1: detectors repeat their mistakes from one moment to the next.
        lifetime: how long objects stay in view [s].
        report: objects are reported from this existence probability on, 0 to 1.
        drop: they are forgotten below this one.
        longest_gap: an object without any box for so long is forgotten [s].
        vehicle_density, person_density: how many boxes of other things lie around a vehicle and a person [1/m²].
        hidden_time, open_time: how long objects are hidden by something unknown, and how long they are not [s].
        accept: offline, objects are reported that were so likely at one moment, 0 to 1.
        longest_fill: offline, moments without a box between two with one are reported if they last no longer [s].
        image_box: which box of an object in an image is reported.

    Raises:
        OptionError: a number is out of bounds.
    """

    detectors: str | Detectors = DEFAULT
    vehicle_acceleration: float = 1.0
    person_acceleration: float = 0.3
    yaw_acceleration: float = 0.5
    side_slip: float = 0.5
    recall_2d: float | None = None
    recall_3d: float | None = None
    trust: float = 0.2
    lifetime: float = 10.0
    report: float = 0.5
    drop: float = 0.005
    longest_gap: float = 3.0
    vehicle_density: float = 0.0003
    person_density: float = 0.001
    hidden_time: float = 1.0
    open_time: float = 5.0
    accept: float = 0.9
    longest_fill: float = 1.0
    image_box: ImageBox = ImageBox.IMAGE

    def __post_init__(self) -> None:
        _check(self)


_ANY = float("inf")
_BOUNDS = {
    **dict.fromkeys(("recall_2d", "recall_3d"), (0.0, 0.999)),
    **dict.fromkeys(("trust", "report", "drop", "accept", "least_score"), (0.0, 1.0)),
    "lifetime": (1e-3, _ANY),
    "tolerance_deg": (0.0, 180.0),
    "least_states": (1.0, _ANY),
}


def _check(settings: "TrackerSettings | LabelSettings") -> None:
    """Check that every number is in its bounds, 0 or more if it has none."""
    for f in fields(settings):
        value, (low, high) = getattr(settings, f.name), _BOUNDS.get(f.name, (0.0, _ANY))
        if isinstance(value, float | int) and not low <= value <= high:
            raise OptionError(f"{f.name} {value!r}; expected {low:g} to {high:g}")


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
        _check(self)
