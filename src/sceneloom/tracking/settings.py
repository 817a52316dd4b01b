"""The numbers that tracking goes by, each with a meaning in the world or of the sensors."""

from dataclasses import dataclass, fields
from enum import StrEnum

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
        vehicle_acceleration: how strongly vehicles change their speed [m/s² in a second].
        person_acceleration: the same of people [m/s²].
        yaw_acceleration: how quickly vehicles change how fast they rotate [rad/s²].
        side_slip: how fast vehicles move across their heading [m/s].
        recall_2d, recall_3d: share of the objects that it sees openly which the detector of images and that of
            sweeps finds at one time, 0 to 1 (excluded).
        least_height_px: an object less high than this in an image need not be found there [px].
        farthest_3d: what is farther than this need not be found in a sweep [m].
        prior: share of the locations at which a detector could report something that hold an object, as in the fusion.
        trust: how much one more moment counts, 0 to 1: detectors repeat their mistakes from one moment to the next.
        lifetime: how long objects stay in view [s].
        report: objects are distinguished from this probability of existence on, 0 to 1.
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

    vehicle_acceleration: float = 3.0
    person_acceleration: float = 1.0
    yaw_acceleration: float = 0.5
    side_slip: float = 0.5
    recall_2d: float = 0.8
    recall_3d: float = 0.6
    least_height_px: float = 25.0
    farthest_3d: float = 70.0
    prior: float = 0.1
    trust: float = 0.5
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
        for f in fields(self):
            if f.name == "image_box":
                continue
            value = getattr(self, f.name)
            low, high = _BOUNDS.get(f.name, (0.0, float("inf")))
            if not low <= value <= high:
                raise OptionError(f"{f.name} {value!r}; expected {low:g} to {high:g}")


_BOUNDS = {
    "recall_2d": (0.0, 0.999),
    "recall_3d": (0.0, 0.999),
    "prior": (1e-6, 1.0 - 1e-6),
    "trust": (0.0, 1.0),
    "lifetime": (1e-3, float("inf")),
    "report": (0.0, 1.0),
    "drop": (0.0, 1.0),
    "accept": (0.0, 1.0),
}
