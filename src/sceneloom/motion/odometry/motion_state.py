"""Where the ego is, how it moves, how sure that is, and how all three go on in time."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from sceneloom.kernels.scan_matching import move_points

ROTATION, SHIFT, YAW_RATE, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
"""Locations of the four errors in a covariance of the state."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """The ego's pose and motion at one time.

    Attributes:
        timestamp_ns: [ns].
        rotation: (3, 3) `world_from_ego`.
        position: (3,) [m], world frame.
        yaw_rate: (3,) [rad/s], world axes.
        velocity: (3,) [m/s], world axes.
        covariance: (12, 12) of a small rotation, a small shift, and changes of the yaw rate and the velocity, all along
            the world's axes.
    """

    timestamp_ns: int
    rotation: Float64Array
    position: Float64Array
    yaw_rate: Float64Array
    velocity: Float64Array
    covariance: Float64Array

    def at(self, timestamp_ns: int) -> tuple[Float64Array, Float64Array]:
        """Rotation and position at another time, at constant velocity and yaw rate in the ego's own frame."""
        dt = (timestamp_ns - self.timestamp_ns) * 1e-9
        rotated = rotation_matrix(self.yaw_rate * dt)
        bend = 0.5 * dt * dt * np.cross(self.yaw_rate, self.velocity)
        return rotated @ self.rotation, self.position + dt * self.velocity + bend

    def move(
        self, points_ego: Float64Array, seconds: Float64Array, points_world: Float64Array, arms: Float64Array
    ) -> None:
        """Take points into the world, each at its own time.

        Args:
            points_ego: (N, 3) float64 [m].
            seconds: (N,) float64, times after the state's.
            points_world: (N, 3) float64 [m], written.
            arms: (N, 3) float64 [m], written: from the ego to each point, along the world's axes.
        """
        move_points(
            points_ego,
            seconds,
            self.rotation,
            self.position,
            self.yaw_rate,
            self.velocity,
            points_world,
            arms,
        )

    def predicted(self, timestamp_ns: int, acceleration: float, yaw_acceleration: float) -> "MotionState":
        """The state at a later time, with what accelerations of the given size add to its uncertainty.

        Source: Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2, piecewise constant white acceleration.
        """
        dt = (timestamp_ns - self.timestamp_ns) * 1e-9
        rotation, position = self.at(timestamp_ns)
        rotated = rotation_matrix(self.yaw_rate * dt)
        step = np.eye(12)
        step[ROTATION, YAW_RATE] = step[SHIFT, VELOCITY] = dt * np.eye(3)
        noise = np.zeros((12, 12))
        for value, rate, size in ((ROTATION, YAW_RATE, yaw_acceleration), (SHIFT, VELOCITY, acceleration)):
            gain = np.array([0.5 * dt * dt, dt])[:, None] * size
            for a, first in enumerate((value, rate)):
                for b, second in enumerate((value, rate)):
                    noise[first, second] = float(gain[a, 0] * gain[b, 0]) * np.eye(3)
        return MotionState(
            timestamp_ns,
            rotation,
            position,
            self.yaw_rate,
            rotated @ self.velocity,
            step @ self.covariance @ step.T + noise,
        )

    def changed(self, step: Float64Array) -> "MotionState":
        """The state after small changes, (12,)."""
        rotation = rotation_matrix(step[ROTATION]) @ self.rotation
        return replace(
            self,
            rotation=rotation,
            position=self.position + step[SHIFT],
            yaw_rate=self.yaw_rate + step[YAW_RATE],
            velocity=self.velocity + step[VELOCITY],
        )

    def minus(self, other: "MotionState") -> Float64Array:
        """The changes, (12,), that lead from another state to this one."""
        return np.concatenate(
            [
                rotation_vector(self.rotation @ other.rotation.T),
                self.position - other.position,
                self.yaw_rate - other.yaw_rate,
                self.velocity - other.velocity,
            ]
        )


def rotation_matrix(rotation_vector: Float64Array) -> Float64Array:
    """The (3, 3) rotation about a (3,) vector by its length [rad]."""
    return matrix_from_quaternion(quaternion_from_rotation_vector(rotation_vector))


def rotation_vector(rotation: Float64Array) -> Float64Array:
    """The (3,) rotation vector of a (3, 3) rotation."""
    return rotation_vector_from_quaternion(quaternion_from_matrix(rotation))
