"""From states to the trajectory between them, at the rate of the IMU."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from sceneloom.kernels.preintegration import preintegrate_until
from sceneloom.motion.gnss_imu.chain import Chain, States
from sceneloom.motion.gnss_imu.samples import InertialSamples

_COASTING_STEP_NS = 100_000_000
"""Poses lie no farther apart where no IMU measured [ns]."""


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedTrajectory:
    """The motion at N times.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        rotations: (N, 3, 3) `world_from_body`.
        positions, velocities: (N, 3) [m] and [m/s], world.
        biases: (N, 6) of gyroscope [rad/s] and accelerometer [m/s²].
    """

    timestamps_ns: Int64Array
    rotations: Float64Array
    positions: Float64Array
    velocities: Float64Array
    biases: Float64Array


def trajectory_times(chain: Chain, samples: InertialSamples | None) -> Int64Array:
    """The times of the states, of the IMU's samples between them, and some where it measured none."""
    times = [chain.knots_ns]
    if samples is not None:
        inside = samples.timestamps_ns
        times.append(inside[(inside >= chain.knots_ns[0]) & (inside <= chain.knots_ns[-1])])
    for k in np.flatnonzero(~chain.measured):
        start, stop = int(chain.knots_ns[k]), int(chain.knots_ns[k + 1])
        times.append(np.arange(start, stop, _COASTING_STEP_NS, dtype=np.int64))
    return np.unique(np.concatenate(times))


def trajectory_between(
    chain: Chain, states: States, samples: InertialSamples | None, times_ns: Int64Array
) -> SmoothedTrajectory:
    """Give the motion at some times from the first state to the last.

    From each state the IMU leads on; what is missing at the next one is spread over the time between: of the rotation
    evenly, of position and velocity by the cubic that is the likeliest for white errors of the acceleration.

    Source: the cubic is the mean of the integrated Brownian bridge, Barfoot 2017, "State Estimation for Robotics",
    11.1.4 (white noise on acceleration).
    """
    knots = np.clip(np.searchsorted(chain.knots_ns, times_ns, side="right") - 1, 0, len(chain.measured) - 1)
    delta_rotations, gains, trajectories = _felt(chain, states, samples, times_ns, knots)
    all_knots = np.arange(len(chain.measured))
    end_rotations, end_gains, end_trajectories = _felt(chain, states, samples, chain.knots_ns[1:], all_knots)
    elapsed = np.asarray((times_ns - chain.knots_ns[knots]) * 1e-9, np.float64)
    rotations, positions, velocities = _led(
        chain, states, knots, elapsed, delta_rotations, gains, trajectories
    )
    ends = _led(chain, states, all_knots, chain.seconds, end_rotations, end_gains, end_trajectories)
    missing_rotation = rotation_vector_from_quaternion(
        quaternion_from_matrix(np.swapaxes(ends[0], 1, 2) @ states.rotations[1:])
    )
    missing_trajectory, missing_speed = states.positions[1:] - ends[1], states.velocities[1:] - ends[2]
    length = chain.seconds[knots][:, None]
    share = elapsed[:, None] / length
    rotated = matrix_from_quaternion(quaternion_from_rotation_vector(share * missing_rotation[knots]))
    trajectory, speed = missing_trajectory[knots], missing_speed[knots]
    positions += share**2 * (3.0 - 2.0 * share) * trajectory + share**2 * (share - 1.0) * length * speed
    velocities += 6.0 * share * (1.0 - share) * trajectory / length + share * (3.0 * share - 2.0) * speed
    biases = states.biases[knots] + share * (states.biases[knots + 1] - states.biases[knots])
    return SmoothedTrajectory(times_ns, rotations @ rotated, positions, velocities, biases)


def _felt(
    chain: Chain, states: States, samples: InertialSamples | None, times_ns: Int64Array, knots: Int64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """What the IMU measured from the knot to each time; nothing where there is none."""
    count = len(times_ns)
    delta_rotations, gains, trajectories = (
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
    )
    if samples is not None:
        preintegrate_until(
            samples.timestamps_ns, samples.values, chain.knots_ns, np.ascontiguousarray(states.biases[:-1]), times_ns,
            knots, delta_rotations, gains, trajectories, np.empty((0, 9, 6)),
        )  # fmt: skip
    unmeasured = ~chain.measured[knots]
    delta_rotations[unmeasured], gains[unmeasured], trajectories[unmeasured] = np.eye(3), 0.0, 0.0
    return delta_rotations, gains, trajectories


def _led(
    chain: Chain, states: States, knots: Int64Array, elapsed: Float64Array, delta_rotations: Float64Array,
    gains: Float64Array, trajectories: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:  # fmt: skip
    """Rotation, position and velocity to which what was felt leads from the knot."""
    pull = np.where(chain.measured[knots], -chain.gravity, 0.0)[:, None] * [0.0, 0.0, 1.0]
    start, t = states.rotations[knots], elapsed[:, None]
    speed = states.velocities[knots]
    positions = states.positions[knots] + t * speed + 0.5 * t**2 * pull
    positions += np.einsum("nij,nj->ni", start, trajectories)
    velocities = speed + t * pull + np.einsum("nij,nj->ni", start, gains)
    return start @ delta_rotations, positions, velocities


def pose_covariances(
    chain: Chain, states: States, own: Float64Array, trajectory: SmoothedTrajectory
) -> Float64Array:
    """Give the covariances of a small rotation [rad] and shift [m] about the world's axes, (N, 6, 6).

    They are those of the states; between two, which are at most a second apart, in proportion to the time.
    """
    axes = np.zeros((len(own), 6, 6))
    axes[:, :3, :3], axes[:, 3:, 3:] = states.rotations, np.eye(3)
    at_knots = axes @ own[:, :6, :6] @ np.swapaxes(axes, 1, 2)
    knots = np.clip(
        np.searchsorted(chain.knots_ns, trajectory.timestamps_ns, side="right") - 1, 0, len(own) - 2
    )
    share = ((trajectory.timestamps_ns - chain.knots_ns[knots]) * 1e-9 / chain.seconds[knots])[:, None, None]
    covariances: Float64Array = (1.0 - share) * at_knots[knots] + share * at_knots[knots + 1]
    return covariances
