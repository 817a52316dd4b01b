"""What moves in the street besides the ego: how much of it."""

from dataclasses import dataclass

from sceneloom.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class TrafficSpec:
    """How busy the street is.

    Attributes:
        cars: moving cars on 100 m of each lane.
        cyclists: on 100 m of each edge of the road.
        pedestrians: on 100 m of each pavement.
        standing: share of the pedestrians who stand.
        crossing: share of the pedestrians who cross the street.

    Raises:
        OptionError: a number is out of bounds.
    """

    cars: float = 2.0
    cyclists: float = 1.0
    pedestrians: float = 4.0
    standing: float = 0.25
    crossing: float = 0.25

    def __post_init__(self) -> None:
        bounds = (
            ("cars", self.cars, 0.0, 6.0),
            ("cyclists", self.cyclists, 0.0, 10.0),
            ("pedestrians", self.pedestrians, 0.0, 20.0),
            ("standing", self.standing, 0.0, 1.0),
            ("crossing", self.crossing, 0.0, 1.0 - self.standing),
        )
        for name, value, low, high in bounds:
            if not low <= value <= high:
                raise OptionError(f"traffic.{name}: {value}; expected {low} to {high}")
