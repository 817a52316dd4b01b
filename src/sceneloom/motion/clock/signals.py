"""Signals from which clocks are compared: orientations, and positions on the ground.

Positions on the ground, and the body axes seen from above, are complex numbers: x (east) + i y (north).
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, finite_rows
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.geometry.rigid import (
    conjugate_quaternion,
    multiply_quaternions,
    normalise_quaternion,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from sceneloom.motion.ego_trajectory import usable_fixes
from sceneloom.motion.imu import running_product, usable_samples
from sceneloom.scene.motion import GnssSensor, VectorSamples
from sceneloom.scene.poses import Trajectory

_LONGEST_GAP = 5.5
"""A longer time between samples, in median sample intervals, is a gap: the rotation across it is unknown."""

LEAST_KNOTS = 4
"""Samples that a chunk without gaps needs for a cubic spline."""

_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Orientations:
    """Orientations of a body over time; across gaps they are unrelated.

    Attributes:
        timestamps_ns: (N,) int64 [ns], strictly increasing.
        quaternions_xyzw: (N, 4) float64 unit, from the body into a frame that is fixed within each chunk.
        chunks: (N,) int64, number of the chunk without gaps of each, ascending.
    """

    timestamps_ns: Int64Array
    quaternions_xyzw: Float64Array
    chunks: Int64Array

    @classmethod
    def of_poses(cls, timestamps_ns: Int64Array, quaternions_xyzw: Float64Array) -> "Orientations":
        """Take orientations (N, 4) at (N,) times [ns], strictly increasing."""
        return cls(timestamps_ns, normalise_quaternion(quaternions_xyzw), _number_chunks(timestamps_ns))

    @classmethod
    def of_rates(cls, timestamps_ns: Int64Array, rates: Float64Array) -> "Orientations":
        """Integrate angular velocities, (N,) [ns] and (N, 3) [rad/s] in the body frame; invalid samples are left out.

        Between samples the rates follow a cubic spline.

        Source: de Boor 1978, "A Practical Guide to Splines", chapter IV; the last term is the coning correction of
        Savage 1998, "Strapdown Inertial Navigation Integration Algorithm Design, Part 1", for a linear rate.
        """
        from scipy.interpolate import CubicSpline

        times, values, _ = usable_samples(VectorSamples(timestamps_ns, rates))
        chunks = _number_chunks(times)
        rotations = np.tile(_IDENTITY, (len(times), 1))
        for rows in _slices(chunks):
            if rows.stop - rows.start >= LEAST_KNOTS:
                seconds, own = (times[rows] - times[rows.start]) * 1e-9, values[rows]
                angles = CubicSpline(seconds, own).antiderivative()(seconds)
                coning = np.diff(seconds)[:, None] ** 2 / 12.0 * np.cross(own[:-1], own[1:])
                rotations[rows] = _chained(np.diff(angles, axis=0) + coning)
        return cls(times, rotations, chunks)

    @classmethod
    def of_steps(cls, timestamps_ns: Int64Array, vectors: Float64Array) -> "Orientations":
        """Chain rotations (N - 1, 3) [rad] from each of (N,) times [ns] to the next; NaN where one is unknown."""
        known = finite_rows(vectors)
        chunks = _number_chunks(timestamps_ns)
        chunks[1:] += np.cumsum(~known)
        return cls(timestamps_ns, _chained(np.where(known[:, None], vectors, 0.0)), chunks)

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @property
    def step_ns(self) -> int:
        """Median time between samples [ns]; 0 where there are none."""
        return int(np.median(np.diff(self.timestamps_ns))) if len(self) > 1 else 0

    @property
    def parts(self) -> list[slice]:
        """The rows of each chunk."""
        return _slices(self.chunks)

    def rotations(self, first: Int64Array, last: Int64Array) -> Float64Array:
        """Rotation vectors (N, 3) [rad] from some samples to others, in the frames of the first ones."""
        return _relative(self.quaternions_xyzw[first], self.quaternions_xyzw[last])

    def rate_noise(self) -> Float64Array:
        """Upper bound of the power of the white noise in the angular velocities, (3,) [rad²/s].

        Source: second differences of white noise have six times its variance.
        """
        rows = np.flatnonzero(np.diff(self.chunks) == 0)
        if len(rows) < LEAST_KNOTS:
            return np.full(3, np.inf)
        seconds = (self.timestamps_ns - self.timestamps_ns[0]) * 1e-9
        lengths = seconds[rows + 1] - seconds[rows]
        vectors = self.rotations(rows, rows + 1)
        jumps = np.diff(vectors / lengths[:, None], n=2, axis=0)
        variance = (1.4826 * np.median(np.abs(jumps), axis=0)) ** 2 / 6.0
        return np.asarray(variance * np.median(lengths), np.float64)


class RotationCurve:
    """Orientations between samples: cubic splines through the quaternions of each chunk.

    Source: de Boor 1978, chapter IV: the error of a cubic spline is of the fourth order in the step.
    """

    def __init__(self, orientations: Orientations, origin_ns: int) -> None:
        """Fit the splines; times are seconds after `origin_ns`."""
        from scipy.interpolate import CubicSpline

        self._chunks = []
        for rows in orientations.parts:
            if rows.stop - rows.start >= LEAST_KNOTS:
                seconds = (orientations.timestamps_ns[rows] - origin_ns) * 1e-9
                quaternions = orientations.quaternions_xyzw[rows]
                flips = (quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0
                signs = np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])
                self._chunks.append((seconds[0], seconds[-1], CubicSpline(seconds, quaternions * signs[:, None])))
        self._begins = np.array([begin for begin, _, _ in self._chunks])

    def __bool__(self) -> bool:
        return bool(self._chunks)

    def rotations(self, starts: Float64Array, stops: Float64Array) -> Float64Array:
        """Rotations (N, 3) [rad] between pairs of times (N,) [s]; NaN across gaps."""
        first, of_first = self.orientations(starts)
        last, of_last = self.orientations(stops)
        vectors = np.full((len(starts), 3), np.nan)
        known = (of_first >= 0) & (of_first == of_last)
        if known.any():
            vectors[known] = _relative(first[known], last[known])
        return vectors

    def rates(self, seconds: Float64Array, window: float) -> Float64Array:
        """Mean angular velocities (N, 3) [rad/s] over a window around times (N,) [s]; NaN where unknown."""
        return np.asarray(self.rotations(seconds - window / 2, seconds + window / 2) / window, np.float64)

    def orientations(self, seconds: Float64Array) -> tuple[Float64Array, Int64Array]:
        """Unit quaternions (N, 4) at times (N,) [s], and the number of each one's chunk, -1 outside of all."""
        quaternions = np.tile(_IDENTITY, (len(seconds), 1))
        of = np.full(len(seconds), -1, np.int64)
        numbers = np.searchsorted(self._begins, seconds, side="right") - 1
        for number in np.unique(numbers[numbers >= 0]).tolist():
            _, end, curve = self._chunks[number]
            inside = (numbers == number) & (seconds <= end)
            quaternions[inside] = curve(seconds[inside])
            of[inside] = number
        return normalise_quaternion(quaternions), of


def _relative(first: Float64Array, last: Float64Array) -> Float64Array:
    return rotation_vector_from_quaternion(multiply_quaternions(conjugate_quaternion(first), last))


def _slices(chunks: Int64Array) -> list[slice]:
    """The rows of each chunk, from the chunks' numbers (N,)."""
    edges = [0, *(np.flatnonzero(np.diff(chunks)) + 1).tolist(), len(chunks)]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


def _number_chunks(timestamps_ns: Int64Array) -> Int64Array:
    numbers = np.zeros(len(timestamps_ns), np.int64)
    if len(timestamps_ns) > 1:
        steps = np.diff(timestamps_ns)
        numbers[1:] = np.cumsum(steps > _LONGEST_GAP * np.median(steps))
    return numbers


def _chained(vectors: Float64Array) -> Float64Array:
    """The orientations (N + 1, 4) after rotations (N, 3) [rad], each in the frame that the one before left."""
    return running_product(np.vstack([_IDENTITY, quaternion_from_rotation_vector(vectors)]))


def from_above(values: Float64Array) -> AnyArray:
    """Positions (N, 3), or the axes of bodies (N, 3, 3), seen from above."""
    return np.asarray(values[:, 0] + 1j * values[:, 1])


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Positions on the ground, (N,) complex [m], at (N,) times [ns]."""

    timestamps_ns: Int64Array
    locations: AnyArray

    @classmethod
    def of_receiver(cls, receiver: GnssSensor) -> "Fixes":
        """Take a receiver's fixes, without unusable ones and repeated timestamps."""
        usable = np.flatnonzero(usable_fixes(receiver))
        times, first = np.unique(receiver.timestamps_ns[usable], return_index=True)
        positions = np.nan_to_num(receiver.positions_lla[usable[first]])
        if len(times) == 0:
            return cls(times, np.zeros(0, np.complex128))
        return cls(times, from_above(enu_from_geodetic(positions, positions[len(times) // 2])))

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory) -> "Fixes":
        """Take a trajectory's positions."""
        return cls(trajectory.timestamps_ns, from_above(trajectory.positions))

    def __len__(self) -> int:
        return len(self.timestamps_ns)


@dataclass(frozen=True, slots=True, eq=False)
class TrajectorySamples:
    """A trajectory at times (N,); NaN where unknown."""

    locations: AnyArray  # (N,) complex [m], in each window up to a polynomial and a rotation
    velocities: AnyArray  # (N,) complex [m/s]
    axes: AnyArray  # (N, 3) complex, the body axes seen from above
    drifts: AnyArray  # (N, E) complex, changes of the locations by small errors, each with an amount for each window
    drift_velocities: AnyArray  # (N, E) complex, their derivatives
    drift_sigmas: Float64Array  # (E,), standard deviations of the amounts; infinite where free


class SmoothedTrajectory(Protocol):
    """A trajectory that can be evaluated at any time."""

    degree: int
    """In a window the trajectory is known up to a polynomial of this degree."""
    window: float
    """Length of the windows [s]."""
    model_sigma: float
    """Standard deviation of an offset by the trajectory's own errors [s]."""

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Evaluate at (N,) times [s] in and around a window."""
        ...

    def finer(self, amounts: Float64Array) -> "SmoothedTrajectory | None":
        """The same trajectory for longer windows, if any; `amounts` (W, E) of the drifts are those of the last fit."""
        ...
