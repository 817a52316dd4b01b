"""IMU samples that can be used, stationary intervals, and the rotation integrated from an IMU alone."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import multiply_quaternions, normalise_quaternion, quaternion_from_rotation_vector
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.motion import ImuSensor, VectorSamples
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.warnings import assumed, repaired, skipped

GYROSCOPE, ACCELEROMETER = "gyroscope", "accelerometer"
"""Streams of an IMU, in the words of the recording format."""

_MISSING_SAMPLES = 5  # so many sample intervals without a sample are a gap, in which the motion is unknown
_LARGEST_SAMPLE = 1e5  # no IMU measures more, in whatever unit [rad/s, m/s²]: larger values stem from a torn line


def usable_samples(samples: VectorSamples) -> tuple[Int64Array, Float64Array, int]:
    """The samples that can be used.

    Returns:
        timestamps_ns: (N,) int64 [ns], strictly increasing.
        values: (N, 3) float64, in the stream's unit.
        left_out: number of samples that are implausible or repeat a timestamp.
    """
    measured = np.flatnonzero((np.abs(samples.values[:, :3]) <= _LARGEST_SAMPLE).all(axis=1))
    times, first = np.unique(samples.timestamps_ns[measured], return_index=True)
    return times, samples.values[measured[first], :3], len(samples) - len(times)


def gaps_between(timestamps_ns: Int64Array) -> Int64Array:
    """The times before and after each gap in (N,) times [ns], (G, 2) int64 [ns]."""
    steps = np.diff(timestamps_ns)
    holes = np.flatnonzero(steps > (_MISSING_SAMPLES + 0.5) * np.median(steps)) if len(steps) else np.zeros(0, int)
    return np.stack([timestamps_ns[holes], timestamps_ns[holes + 1]], axis=1)


_WINDOW_NS = 1_000_000_000
"""Length of the windows that are judged: long enough for the body of a moving car to swing [ns]."""

_LEAST_SAMPLES = 20  # samples of either kind that a window needs

QUIET_RATE = 0.005
"""Largest standard deviation of a stationary ego's angular velocity on each axis: noise of a consumer's gyroscope
[rad/s]."""

QUIET_FORCE = 0.2
"""The same of the specific force, with the engine running [m/s²]."""

WHITE = 1.5
"""Largest ratio of the variance to that of successive differences for white noise, which has 1, with 200 samples within
0.1. A car that rolls, however smoothly, sways slowly: neighbouring samples are alike."""

_ROUNDING = 1e-20  # computed variance of samples that are all equal
_LARGEST_BIAS = 0.06  # a larger mean rate is a rotation, however even [rad/s]


@dataclass(frozen=True, slots=True, eq=False)
class _Stationary:
    """Mean (3,) of the gyroscope [rad/s] while the ego was stationary, and for how many seconds it was."""

    rate: Float64Array
    seconds: float


def find_stationary(
    rate_times_ns: Int64Array, rates: Float64Array, force_times_ns: Int64Array, forces: Float64Array
) -> _Stationary | None:
    """Find the windows of a second in which both sensors are quiet; None where there is none.

    Quiet means a small deviation by white noise alone: an even drive on a smooth road deviates little, too.

    Args:
        rate_times_ns: (N,) int64 [ns], ascending.
        rates: (N, 3) float64 [rad/s].
        force_times_ns: (M,) int64 [ns], ascending.
        forces: (M, 3) float64 [m/s²].

    Source: the two moving variances are those that Skog, Händel, Nilsson and Rantakokko 2010, "Zero-Velocity
    Detection - An Algorithm Evaluation", compare; the ratio is that of von Neumann 1941, "Distribution of the Ratio of
    the Mean Square Successive Difference to the Variance"; the thresholds are ours.
    """
    if len(rate_times_ns) == 0:
        return None
    # numbered in order: a wrong timestamp would make windows by the million
    seconds, rate_windows = np.unique((rate_times_ns - rate_times_ns[0]) // _WINDOW_NS, return_inverse=True)
    count = len(seconds)
    of_forces = (force_times_ns - rate_times_ns[0]) // _WINDOW_NS
    force_windows = np.minimum(np.searchsorted(seconds, of_forces), count - 1)
    mean, quiet = _statistics(rate_windows, rates, count, QUIET_RATE)
    inside = seconds[force_windows] == of_forces
    _, quiet_forces = _statistics(force_windows[inside], forces[inside], count, QUIET_FORCE)
    stood = quiet & quiet_forces & (np.abs(mean) < _LARGEST_BIAS).all(axis=1)
    if stood.any():
        # a bias is the same each time, a very even rotation is not
        stood &= (np.abs(mean - np.median(mean[stood], axis=0)) < QUIET_RATE).all(axis=1)
    if not stood.any():
        return None
    return _Stationary(rates[stood[rate_windows]].mean(axis=0), float(stood.sum()) * _WINDOW_NS * 1e-9)


def _statistics(windows: Int64Array, values: Float64Array, count: int, quiet: float) -> tuple[Float64Array, BoolArray]:
    """Mean of the values in each window, (count, 3), and whether they deviate by less than `quiet`, (count,)."""
    samples = np.maximum(np.bincount(windows, minlength=count), 1)[:, None]
    mean = _sums(windows, values, count) / samples
    variance = _sums(windows, (values - mean[windows]) ** 2, count) / samples
    pairs = windows[1:] == windows[:-1]
    steps = _sums(windows[1:][pairs], np.diff(values, axis=0)[pairs] ** 2, count) / samples
    calm = (variance < quiet**2) & (variance <= WHITE * steps / 2 + _ROUNDING)
    return mean, (samples[:, 0] >= _LEAST_SAMPLES) & calm.all(axis=1)


def _sums(windows: Int64Array, values: Float64Array, count: int) -> Float64Array:
    return np.stack([np.bincount(windows, column, minlength=count) for column in values.T], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class InertialMotion:
    """The rotation of the ego.

    Attributes:
        ego: `world_from_ego` under the name "imu": its axes at the first sample are the world's, and its position
            stays at the origin, since an IMU does not measure it.
        gaps_ns: (G, 2) int64 [ns], between which samples are missing.
        bias: (3,) float64 [rad/s] of the gyroscope while the ego was stationary, subtracted; None where it never was.
    """

    ego: EgoMotion
    gaps_ns: Int64Array
    bias: Float64Array | None

    def is_known(self, first_ns: int, last_ns: int) -> bool:
        """Whether there is no gap between two times."""
        return not bool(((self.gaps_ns[:, 0] < last_ns) & (self.gaps_ns[:, 1] > first_ns)).any())


def imu_motion(scene: Scene) -> InertialMotion:
    """Integrate the angular velocities of the scene's first IMU with a gyroscope; the IMU's frame is the ego's.

    Raises:
        PoseError: there is no IMU, or none with two angular velocities or more.
    """
    imus = [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor)]
    if not imus:
        raise PoseError(f"{scene.source}: no IMU in it; expected one for the ego's rotation")
    imu = next((imu for imu in imus if GYROSCOPE in imu.streams), None)
    if imu is None:
        streams = ", ".join(name for imu in imus for name in imu.streams)
        raise PoseError(f"{scene.source}: the IMU has no {GYROSCOPE}; it has: {streams or 'nothing'}")
    times, values, left_out = usable_samples(imu.streams[GYROSCOPE])
    location = f"{scene.source}: sensors[{imu.id}].streams.{GYROSCOPE}"
    if len(times) < 2:
        raise PoseError(f"{location}: {len(times)} usable samples; expected two or more for the ego's rotation")
    stationary = None
    if ACCELEROMETER in imu.streams:
        force_times, forces, _ = usable_samples(imu.streams[ACCELEROMETER])
        stationary = find_stationary(times, values, force_times, forces)
    bias = None if stationary is None else stationary.rate
    gaps_ns = gaps_between(times)
    message = "an IMU alone measures rotation, not speed: of the motion during a sweep only the rotation is corrected"
    warnings = [assumed("rotation-only", location, message)]
    if stationary is None:
        message = "the ego was never seen to be stationary, so the gyroscope's bias is unknown and was not subtracted"
        warnings.append(assumed("gyroscope-bias-unknown", location, message))
    else:
        rate = ", ".join(f"{value:.5f}" for value in stationary.rate)
        message = f"stationary for {stationary.seconds:.1f} s; the mean rate then, {rate} rad/s, was subtracted as bias"
        warnings.append(repaired("gyroscope-bias", location, message))
    if left_out:
        message = "samples that are not finite, or not later than the one before, were left out"
        warnings.append(repaired("imu-samples", location, message, count=left_out))
    if len(gaps_ns):
        message = f"at least {_MISSING_SAMPLES} samples in a row are missing; sweeps in such a gap stay as they are"
        warnings.append(skipped("imu-gaps", location, message, count=len(gaps_ns)))
    rotations = integrate_rates(times, values if bias is None else values - bias)
    path = Poses(times, np.zeros((len(times), 3)), rotations)
    return InertialMotion(EgoMotion("imu", path, warnings=tuple(warnings)), gaps_ns, bias)


def integrate_rates(timestamps_ns: Int64Array, rates: Float64Array) -> Float64Array:
    """Give the orientation at each sample, relative to that at the first.

    Between two samples the rate is taken to change evenly. The rotation over that time is then the exponential of the
    mean rate times the time, and of half the commutator that two rates about different axes leave (coning).

    Args:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 1.
        rates: (N, 3) float64 [rad/s], in the rotating frame.

    Returns:
        (N, 4) float64 unit quaternions xyzw, `first_from_body`.

    Source: Magnus 1954, second term for a linear rate: h²/12 ω₀ × ω₁, error O(h⁵); the same is the coning correction
    of Savage 1998, "Strapdown Inertial Navigation Integration Algorithm Design, Part 1", section III.
    """
    seconds = np.diff(timestamps_ns)[:, None] * 1e-9
    before, after = rates[:-1], rates[1:]
    vectors = 0.5 * seconds * (before + after) + seconds**2 / 12.0 * np.cross(before, after)
    rotations = np.vstack([[[0.0, 0.0, 0.0, 1.0]], quaternion_from_rotation_vector(vectors)])
    return running_product(rotations)


def running_product(rotations: Float64Array) -> Float64Array:
    """Products of the first 1, 2, … N of (N, 4) quaternions: all blocks side by side, then block after block."""
    length = int(np.ceil(np.sqrt(len(rotations))))
    blocks = np.tile([0.0, 0.0, 0.0, 1.0], (-(-len(rotations) // length) * length, 1))
    blocks[: len(rotations)] = rotations
    blocks = blocks.reshape(-1, length, 4)
    for column in range(1, length):
        blocks[:, column] = multiply_quaternions(blocks[:, column - 1], blocks[:, column])
    for row in range(1, len(blocks)):
        blocks[row] = multiply_quaternions(blocks[row - 1, -1], blocks[row])
    return normalise_quaternion(blocks.reshape(-1, 4)[: len(rotations)])
