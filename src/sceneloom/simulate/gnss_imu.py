"""Simulated IMU and GNSS receiver in the ego origin."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.geodesy import geodetic_from_enu
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.simulate.parameters import Stream, check_bounds, generator_for
from sceneloom.simulate.trajectory import EgoPath

GRAVITY = 9.80665
"""[m/s²], down the world's z axis, wherever on earth a receiver puts the world's origin. Source: CGPM 1901, standard
gravity."""


@dataclass(frozen=True, slots=True)
class ImuSpec:
    """An inertial unit whose axes are the ego's.

    Attributes:
        rate_hz: samples a second.
        accelerometer_noise: density of the white noise [m/s²/√Hz]; a sample's deviation is this times √rate.
        gyroscope_noise: the same [rad/s/√Hz].
        accelerometer_bias_sigma: deviation from which the constant bias of each axis is drawn [m/s²].
        gyroscope_bias_sigma: the same [rad/s].

    Raises:
        OptionError: a number is out of bounds.
    """

    rate_hz: float = 200.0
    accelerometer_noise: float = 0.001
    gyroscope_noise: float = 0.0001
    accelerometer_bias_sigma: float = 0.02
    gyroscope_bias_sigma: float = 0.001

    def __post_init__(self) -> None:
        bounds = (
            ("rate_hz", self.rate_hz, 1.0, 10_000.0),
            ("accelerometer_noise", self.accelerometer_noise, 0.0, 1e3),
            ("gyroscope_noise", self.gyroscope_noise, 0.0, 1e3),
            ("accelerometer_bias_sigma", self.accelerometer_bias_sigma, 0.0, 1e3),
            ("gyroscope_bias_sigma", self.gyroscope_bias_sigma, 0.0, 1e3),
        )
        check_bounds("imu", bounds)


@dataclass(frozen=True, slots=True, eq=False)
class ImuTruth:
    """What the unit would report without errors, and its constant errors.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        specific_forces: (N, 3) float64 [m/s²], ego frame; at rest it points up.
        angular_rates: (N, 3) float64 [rad/s], ego frame.
        accelerometer_bias: (3,) float64 [m/s²].
        gyroscope_bias: (3,) float64 [rad/s].
    """

    timestamps_ns: Int64Array
    specific_forces: Float64Array
    angular_rates: Float64Array
    accelerometer_bias: Float64Array
    gyroscope_bias: Float64Array


def imu_truth(spec: ImuSpec, path: EgoPath, timestamps_ns: Int64Array, *, seed: int) -> ImuTruth:
    """Derive the unit's signals from the exact motion."""
    states = path.at(timestamps_ns)
    pulled = states.accelerations + np.array([0.0, 0.0, GRAVITY])
    return ImuTruth(
        timestamps_ns,
        np.einsum("nji,nj->ni", states.rotations, pulled),
        states.angular_rates,
        _bias(spec.accelerometer_bias_sigma, seed, Stream.ACCELEROMETER),
        _bias(spec.gyroscope_bias_sigma, seed, Stream.GYROSCOPE),
    )


def imu_sensor(spec: ImuSpec, truth: ImuTruth, *, seed: int) -> ImuSensor:
    """Add bias and white noise to the true signals."""
    forces = truth.specific_forces + truth.accelerometer_bias
    rates = truth.angular_rates + truth.gyroscope_bias
    noise = np.sqrt(spec.rate_hz)
    streams = {
        "accelerometer": _noisy(forces, noise * spec.accelerometer_noise, seed, Stream.ACCELEROMETER),
        "gyroscope": _noisy(rates, noise * spec.gyroscope_noise, seed, Stream.GYROSCOPE),
    }
    return ImuSensor(
        "imu", {name: VectorSamples(truth.timestamps_ns, values) for name, values in streams.items()}
    )


def _bias(sigma: float, seed: int, stream: Stream) -> Float64Array:
    return sigma * generator_for(seed, stream, 0).standard_normal(3)


def _noisy(values: Float64Array, sigma: float, seed: int, stream: Stream) -> Float64Array:
    noisy: Float64Array = values + sigma * generator_for(seed, stream, 1).standard_normal(values.shape)
    return noisy


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
