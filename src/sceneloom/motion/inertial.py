"""How the ego rotated, from its IMU alone; how fast it went, no IMU reports."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.rotations import (
    multiply_quaternions,
    normalise_quaternion,
    quaternion_from_rotation_vector,
)
from sceneloom.motion.imu_samples import (
    ACCELEROMETER,
    GYROSCOPE,
    MISSING_SAMPLES,
    gaps_between,
    usable_samples,
)
from sceneloom.motion.stationary import Stationary, find_stationary
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.motion import ImuSensor, VectorSamples
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning, WarningKind


@dataclass(frozen=True, slots=True, eq=False)
class InertialMotion:
    """The rotating of the ego.

    Attributes:
        ego: `world_from_ego` under the name "imu": its axes at the first sample are the world's, and its position
            stays at the origin, since an IMU does not report it.
        gaps_ns: (G, 2) int64 [ns], between which samples are missing.
        bias: (3,) float64 [rad/s], what the gyroscope reported while the ego stood, taken off; None where it never did.
    """

    ego: EgoMotion
    gaps_ns: Int64Array
    bias: Float64Array | None

    def is_known(self, first_ns: int, last_ns: int) -> bool:
        """Whether no gap lies between two times."""
        return not bool(((self.gaps_ns[:, 0] < last_ns) & (self.gaps_ns[:, 1] > first_ns)).any())


def imu_motion(scene: Scene) -> InertialMotion:
    """Integrate the yaw rates of the scene's first IMU with a gyroscope; the IMU's frame is the ego's.

    Raises:
        PoseError: there is no IMU, or none with two yaw rates or more.
    """
    imu, rates = _rates_of(scene)
    times, values, left_out = usable_samples(rates)
    location = f"{scene.source}: sensors[{imu.id}].streams.{GYROSCOPE}"
    if len(times) < 2:
        raise PoseError(
            f"{location}: {len(times)} usable samples; expected two or more to report how the ego rotated"
        )
    stationary = _stationary(imu, times, values)
    bias = None if stationary is None else stationary.rate
    rotating = integrate_rates(times, values if bias is None else values - bias)
    gaps_ns = gaps_between(times)
    warnings = [_rotation_only(location), _bias_warning(location, stationary)]
    if left_out:
        message = "samples that are no numbers, or not later than the one before, were left out"
        warnings.append(_warning(WarningKind.REPAIRED, "imu-samples", location, message, left_out))
    if len(gaps_ns):
        message = (
            f"at least {MISSING_SAMPLES} samples in a row are missing; sweeps in such a gap stay as they are"
        )
        warnings.append(_warning(WarningKind.SKIPPED, "imu-gaps", location, message, len(gaps_ns)))
    path = Poses(times, np.zeros((len(times), 3)), rotating)
    return InertialMotion(EgoMotion("imu", path, warnings=tuple(warnings)), gaps_ns, bias)


def integrate_rates(timestamps_ns: Int64Array, rates: Float64Array) -> Float64Array:
    """Give the orientation at each sample, relative to that at the first.

    Between two samples the rate is taken to change evenly. The rotation over that time is then the exponential of the
    mean rate times the time, and of half the commutator that two rates about different axes leave (coning).

    Args:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 1.
        rates: (N, 3) float64 [rad/s], in the frame that rotations.

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


def _rates_of(scene: Scene) -> tuple[ImuSensor, VectorSamples]:
    imus = [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor)]
    for imu in imus:
        if GYROSCOPE in imu.streams:
            return imu, imu.streams[GYROSCOPE]
    if not imus:
        raise PoseError(f"{scene.source}: no IMU in it; expected one to report how the ego rotated")
    streams = [name for imu in imus for name in imu.streams]
    raise PoseError(f"{scene.source}: the IMU has no {GYROSCOPE}; it has: {', '.join(streams) or 'nothing'}")


def _stationary(imu: ImuSensor, times_ns: Int64Array, rates: Float64Array) -> Stationary | None:
    if ACCELEROMETER not in imu.streams:
        return None
    force_times, forces, _ = usable_samples(imu.streams[ACCELEROMETER])
    return find_stationary(times_ns, rates, force_times, forces)


def _rotation_only(location: str) -> DataWarning:
    message = (
        "an IMU alone reports how the ego rotated, not how fast it went: of the motion during a sweep only the "
        "rotating "
        "is undone"
    )
    return _warning(WarningKind.ASSUMED, "rotation-only", location, message)


def _bias_warning(location: str, stationary: Stationary | None) -> DataWarning:
    if stationary is None:
        message = "the ego was never seen to stand, so the gyroscope's bias is not known and was left in"
        return _warning(WarningKind.ASSUMED, "gyroscope-bias-unknown", location, message)
    rate = ", ".join(f"{value:.5f}" for value in stationary.rate)
    message = f"the ego stood for {stationary.seconds:.1f} s; the rate then, {rate} rad/s, was taken off as the bias"
    return _warning(WarningKind.REPAIRED, "gyroscope-bias", location, message)


def _warning(kind: WarningKind, code: str, location: str, message: str, count: int = 1) -> DataWarning:
    return DataWarning(kind=kind, code=code, location=location, message=message, count=count)
