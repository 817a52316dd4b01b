"""The IMU's samples as the smoother wants them: yaw rate and force at the same times, and how noisy they are."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.motion.gnss_imu.settings import SmootherSettings
from sceneloom.motion.imu_samples import ACCELEROMETER, GYROSCOPE, gaps_between, usable_samples
from sceneloom.scene.motion import ImuSensor, VectorSamples
from sceneloom.scene.scene import Scene

_NOISE_SECONDS, _NOISE_SAMPLES = 2.0, 21
"""Time over which the noise is averaged, and how many samples that takes at least."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialSamples:
    """What an IMU on the ego measured.

    Attributes:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 2.
        values: (N, 6) float64: yaw rate [rad/s], specific force [m/s²].
        gaps_ns: (G, 2) int64 [ns], between which samples are missing.
        left_out: samples that were no numbers or not later than others.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    gaps_ns: Int64Array
    left_out: int = 0

    @classmethod
    def of(cls, gyroscope: VectorSamples, accelerometer: VectorSamples) -> "InertialSamples | None":
        """Bring both streams to the times of that with more samples; None where they do not overlap."""
        rate_times, rates, lost_rates = usable_samples(gyroscope)
        force_times, forces, lost_forces = usable_samples(accelerometer)
        if len(rate_times) < 2 or len(force_times) < 2:
            return None
        times = rate_times if len(rate_times) >= len(force_times) else force_times
        first, last = max(rate_times[0], force_times[0]), min(rate_times[-1], force_times[-1])
        times = times[(times >= first) & (times <= last)]
        if len(times) < 2:
            return None
        values = np.hstack([_at(times, rate_times, rates), _at(times, force_times, forces)])
        gaps = np.vstack([gaps_between(rate_times), gaps_between(force_times)])
        inside = (gaps[:, 1] > first) & (gaps[:, 0] < last)
        return cls(times, values, np.unique(gaps[inside], axis=0), lost_rates + lost_forces)

    @property
    def period(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.timestamps_ns))) * 1e-9

    def is_measured(self, first_ns: Int64Array, last_ns: Int64Array) -> BoolArray:
        """Which intervals lie within the samples and have no gap in them."""
        slack_ns = round(1.5 * self.period * 1e9)
        measured: BoolArray = (first_ns >= self.timestamps_ns[0] - slack_ns) & (
            last_ns <= self.timestamps_ns[-1] + slack_ns
        )
        for start_ns, stop_ns in self.gaps_ns:
            measured &= (last_ns <= start_ns) | (first_ns >= stop_ns)
        return measured


def inertial_samples(scene: Scene) -> tuple[ImuSensor, InertialSamples] | None:
    """The first IMU of a scene that has both streams, with its samples; None where there is none."""
    for sensor in scene.sensors:
        if isinstance(sensor, ImuSensor) and GYROSCOPE in sensor.streams and ACCELEROMETER in sensor.streams:
            samples = InertialSamples.of(sensor.streams[GYROSCOPE], sensor.streams[ACCELEROMETER])
            if samples is not None:
                return sensor, samples
    return None


def noise_densities(
    samples: InertialSamples, times_ns: Int64Array, settings: SmootherSettings
) -> Float64Array:
    """Give the densities of the white noise around some times, (N, 2), (rad/s)²/Hz and (m/s²)²/Hz.

    A sample's noise shows in how far it lies from the middle between its neighbours, whose variance is 1.5 times that
    of white noise. What a low rate does not resolve of the motion counts as noise, too: rightly so, since it is not
    known between the samples either.
    """
    if len(samples.timestamps_ns) < 3:
        return np.tile([settings.gyroscope_noise**2, settings.accelerometer_noise**2], (len(times_ns), 1))
    values = samples.values
    apart = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    squares = np.stack([(apart[:, :3] ** 2).mean(axis=1), (apart[:, 3:] ** 2).mean(axis=1)], axis=1) / 1.5
    width = max(_NOISE_SAMPLES, round(_NOISE_SECONDS / samples.period)) | 1
    smooth = _moving_mean(squares, min(width, len(squares))) * samples.period
    found = np.stack(
        [np.interp(times_ns, samples.timestamps_ns[1:-1], smooth[:, k]) for k in range(2)], axis=1
    )
    floored: Float64Array = np.maximum(found, [settings.gyroscope_noise**2, settings.accelerometer_noise**2])
    return floored


def _moving_mean(values: Float64Array, width: int) -> Float64Array:
    sums = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    first = np.clip(np.arange(len(values)) - width // 2, 0, len(values) - width)
    mean: Float64Array = np.maximum(sums[first + width] - sums[first], 0.0) / width
    return mean


def _at(wanted_ns: Int64Array, times_ns: Int64Array, values: Float64Array) -> Float64Array:
    if np.array_equal(wanted_ns, times_ns):
        return values
    seconds, known = (wanted_ns - times_ns[0]) * 1e-9, (times_ns - times_ns[0]) * 1e-9
    return np.stack([np.interp(seconds, known, column) for column in values.T], axis=1)
