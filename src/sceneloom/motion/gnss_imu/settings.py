"""Settings of the smoother, with defaults that hold for everything from a phone to a surveyor's unit."""

from dataclasses import dataclass

from sceneloom.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class SmootherSettings:
    """What the smoother takes for granted.

    Attributes:
        gyroscope_noise, accelerometer_noise: least densities of the white noise [rad/s/√Hz] and [m/s²/√Hz]; the
            samples themselves report more.
        gyroscope_walk, accelerometer_walk: densities of what makes the biases wander [rad/s²/√Hz] and [m/s³/√Hz].
        gyroscope_bias, accelerometer_bias: how large the biases may be, one standard deviation [rad/s] and [m/s²].
        acceleration: density of the acceleration of an ego without IMU [m/s²/√Hz].
        rotating: density of the yaw rate of an ego without IMU [rad/s/√Hz].
        fix_noise: standard deviation of a fix that does not report its accuracy, to begin with [m].
        least_fix_noise: no fix is believed to be better [m].
        gate: a fix this many standard deviations off is left out, as long as it is.
        longest_interval: states lie no farther apart in time [s].
        vehicle: whether the ego moves along one axis of its own only, as cars do: True, False, or None to let the
            data report.
        gravity: [m/s²]; None for that of the location.

    Raises:
        OptionError: a number is not positive.
    """

    gyroscope_noise: float = 5e-5
    accelerometer_noise: float = 5e-4
    gyroscope_walk: float = 5e-6
    accelerometer_walk: float = 5e-5
    gyroscope_bias: float = 0.003
    accelerometer_bias: float = 0.05
    acceleration: float = 2.0
    rotating: float = 0.5
    fix_noise: float = 2.0
    least_fix_noise: float = 0.01
    gate: float = 3.5
    longest_interval: float = 1.0
    vehicle: bool | None = None
    gravity: float | None = None

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if value is not None and not isinstance(value, bool) and not value > 0:
                raise OptionError(f"{name}: {value}; expected a number above 0")


DEFAULTS = SmootherSettings()
