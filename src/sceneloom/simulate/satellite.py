"""What a satellite receiver in the ego's origin reports on the way."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.geometry.geodesy import geodetic_from_enu
from sceneloom.scene.motion import GnssSensor
from sceneloom.simulate.bounds import check_bounds
from sceneloom.simulate.path import EgoPath
from sceneloom.simulate.randomness import Stream, generator_for


@dataclass(frozen=True, slots=True)
class GnssSpec:
    """A satellite receiver; the world's x, y and z are east, north and up at its origin.

    Attributes:
        rate_hz: fixes a second.
        horizontal_sigma, vertical_sigma: standard deviation of each fix [m], the first for east and for north.
        origin_lla: where the world's origin lies: latitude, longitude [deg], altitude above the ellipsoid [m].

    Raises:
        OptionError: a number is out of bounds.
    """

    rate_hz: float = 10.0
    horizontal_sigma: float = 0.4
    vertical_sigma: float = 0.8
    origin_lla: tuple[float, float, float] = (60.1708, 24.9375, 14.0)

    def __post_init__(self) -> None:
        latitude, longitude, altitude = self.origin_lla
        bounds = (
            ("rate_hz", self.rate_hz, 0.01, 1000.0),
            ("horizontal_sigma", self.horizontal_sigma, 0.0, 1e4),
            ("vertical_sigma", self.vertical_sigma, 0.0, 1e4),
            ("origin_lla[0]", latitude, -90.0, 90.0),
            ("origin_lla[1]", longitude, -180.0, 180.0),
            ("origin_lla[2]", altitude, -1e4, 1e5),
        )
        check_bounds("gnss", bounds)


def gnss_sensor(spec: GnssSpec, path: EgoPath, timestamps_ns: Int64Array, *, seed: int) -> GnssSensor:
    """Give noisy fixes at (N,) int64 times [ns]."""
    sigmas = np.array([spec.horizontal_sigma, spec.horizontal_sigma, spec.vertical_sigma])
    noise = sigmas * generator_for(seed, Stream.GNSS).standard_normal((len(timestamps_ns), 3))
    positions = geodetic_from_enu(path.at(timestamps_ns).positions + noise, np.array(spec.origin_lla))
    count = len(timestamps_ns)
    return GnssSensor(
        "gnss",
        timestamps_ns,
        positions,
        np.full(count, spec.horizontal_sigma),
        np.full(count, spec.vertical_sigma),
    )
