"""The signals that clocks are compared by: orientations, and positions on the ground."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    multiply_quaternions,
    normalise_quaternion,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from sceneloom.motion.ego_trajectory import usable_fixes
from sceneloom.motion.imu import measured_rows, running_product
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Trajectory

_LONGEST_STEPS = 5.5
"""So many usual steps without a sample are a gap, across which nothing is known of the rotating."""

LEAST_KNOTS = 4
"""A piece without gaps needs so many samples for a cubic curve."""


@dataclass(frozen=True, slots=True, eq=False)
class Orientations:
    """The orientations of a body at some times; across a gap nothing relates them.

    Attributes:
        timestamps_ns: (N,) int64 [ns], strictly increasing.
        quaternions_xyzw: (N, 4) float64 unit, from the body into a frame that is stationary within each piece.
        chunks: (N,) int64, number of the piece without gaps that each belongs to, ascending.
    """

    timestamps_ns: Int64Array
    quaternions_xyzw: Float64Array
    chunks: Int64Array

    @classmethod
    def of_poses(cls, timestamps_ns: Int64Array, quaternions_xyzw: Float64Array) -> "Orientations":
        """Take the orientations of a path, (N,) [ns] strictly increasing and (N, 4)."""
        return cls(timestamps_ns, normalise_quaternion(quaternions_xyzw), number_chunks(timestamps_ns))

    @classmethod
    def of_rates(cls, timestamps_ns: Int64Array, rates: Float64Array) -> "Orientations":
        """Integrate angular velocities, (N,) [ns] and (N, 3) [rad/s] in the body frame, without invalid samples.

        Between samples the rates go along a cubic curve.

        Source: de Boor 1978, "A Practical Guide to Splines", chapter IV; the last term is the coning correction of
        Savage 1998, "Strapdown Inertial Navigation Integration Algorithm Design, Part 1", for a linear rate.
        """
        usable = np.flatnonzero(measured_rows(rates))
        times, first = np.unique(timestamps_ns[usable], return_index=True)
        values, chunks = rates[usable[first]], number_chunks(times)
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        for piece in chunk_slices(chunks):
            if piece.stop - piece.start >= LEAST_KNOTS:
                rotations[piece] = _integrated(times[piece], values[piece])
        return cls(times, rotations, chunks)

    @classmethod
    def of_steps(cls, timestamps_ns: Int64Array, vectors: Float64Array) -> "Orientations":
        """Chain the rotations (N - 1, 3) [rad] from each of (N,) times [ns] to the next; NaN where one is not known."""
        known = finite_rows(vectors)
        steps = quaternion_from_rotation_vector(np.where(known[:, None], vectors, 0.0))
        rotations = running_product(np.vstack([[[0.0, 0.0, 0.0, 1.0]], steps]))
        chunks = number_chunks(timestamps_ns)
        chunks[1:] += np.cumsum(~known)
        return cls(timestamps_ns, rotations, chunks)

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @property
    def step_ns(self) -> int:
        """The usual time between samples [ns]; 0 where there are none."""
        return int(np.median(np.diff(self.timestamps_ns))) if len(self) > 1 else 0


class RotationCurve:
    """A rotating between its samples: a smooth curve through the orientations of each piece."""

    def __init__(self, rotating: Orientations, origin_ns: int) -> None:
        """Lay cubic splines through the quaternions; times are seconds after `origin_ns`.

        Source: de Boor 1978, chapter IV: the error of a cubic spline is of the fourth order in the step.
        """
        from scipy.interpolate import CubicSpline

        self._chunks = []
        for piece in chunk_slices(rotating.chunks):
            if piece.stop - piece.start < LEAST_KNOTS:
                continue
            seconds = (rotating.timestamps_ns[piece] - origin_ns) * 1e-9
            signed = _on_one_side(rotating.quaternions_xyzw[piece])
            self._chunks.append((seconds[0], seconds[-1], CubicSpline(seconds, signed)))
        self._begins = np.array([begin for begin, _, _ in self._chunks])
        self.span = (self._begins[0], self._chunks[-1][1]) if self._chunks else (0.0, 0.0)

    def __bool__(self) -> bool:
        return bool(self._chunks)

    def rotations(self, starts: Float64Array, stops: Float64Array) -> Float64Array:
        """Give the rotations (N, 3) [rad] from some times to others, (N,) [s]; NaN where a gap lies between."""
        first, of_first = self._at(starts)
        last, of_last = self._at(stops)
        vectors = np.full((len(starts), 3), np.nan)
        known = (of_first >= 0) & (of_first == of_last)
        if known.any():
            vectors[known] = relative_rotation(first[known], last[known])
        return vectors

    def rates(self, seconds: Float64Array, window: float) -> Float64Array:
        """Give the mean angular velocities (N, 3) [rad/s] over a window around times (N,) [s]; NaN where unknown."""
        rotated = self.rotations(seconds - window / 2, seconds + window / 2)
        rates: Float64Array = rotated / window
        return rates

    def orientations(self, seconds: Float64Array) -> tuple[Float64Array, Int64Array]:
        """Give unit quaternions (N, 4) at some times (N,) [s], and which piece each is of, -1 where in none."""
        return self._at(seconds)

    def _at(self, seconds: Float64Array) -> tuple[Float64Array, Int64Array]:
        quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(seconds), 1))
        of = np.full(len(seconds), -1, np.int64)
        numbers = np.searchsorted(self._begins, seconds, side="right") - 1
        for number in np.unique(numbers[numbers >= 0]).tolist():
            _, end, curve = self._chunks[number]
            inside = (numbers == number) & (seconds <= end)
            quaternions[inside] = curve(seconds[inside])
            of[inside] = number
        return normalise_quaternion(quaternions), of


def finite_rows(values: Float64Array) -> BoolArray:
    """Which rows of (N, K) hold numbers only."""
    return np.asarray(np.isfinite(values).all(axis=1), np.bool_)


def relative_rotation(first: Float64Array, last: Float64Array) -> Float64Array:
    """Rotation vectors (N, 3) [rad] that lead from orientations (N, 4) xyzw to others, in the first ones' frames."""
    return rotation_vector_from_quaternion(multiply_quaternions(conjugate_quaternion(first), last))


def number_chunks(timestamps_ns: Int64Array) -> Int64Array:
    """Number the chunks without gaps that times (N,) [ns] fall into, ascending."""
    numbers = np.zeros(len(timestamps_ns), np.int64)
    if len(timestamps_ns) > 1:
        steps = np.diff(timestamps_ns)
        numbers[1:] = np.cumsum(steps > _LONGEST_STEPS * np.median(steps))
    return numbers


def chunk_slices(chunks: Int64Array) -> list[slice]:
    """The rows of each piece, from their numbers (N,)."""
    edges = [0, *(np.flatnonzero(np.diff(chunks)) + 1).tolist(), len(chunks)]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


def _integrated(timestamps_ns: Int64Array, rates: Float64Array) -> Float64Array:
    from scipy.interpolate import CubicSpline

    seconds = (timestamps_ns - timestamps_ns[0]) * 1e-9
    angles = CubicSpline(seconds, rates).antiderivative()(seconds)
    coning = np.diff(seconds)[:, None] ** 2 / 12.0 * np.cross(rates[:-1], rates[1:])
    steps = quaternion_from_rotation_vector(np.diff(angles, axis=0) + coning)
    return running_product(np.vstack([[[0.0, 0.0, 0.0, 1.0]], steps]))


def _on_one_side(quaternions_xyzw: Float64Array) -> Float64Array:
    """Choose the signs so that each is near the one before."""
    rotated: BoolArray = (quaternions_xyzw[1:] * quaternions_xyzw[:-1]).sum(axis=1) < 0
    signs = np.concatenate([[1.0], np.cumprod(np.where(rotated, -1.0, 1.0))])
    return np.asarray(quaternions_xyzw * signs[:, None], np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Locations on the ground, east and north as the real and imaginary part [m], (N,) at (N,) times [ns]."""

    timestamps_ns: Int64Array
    locations: AnyArray

    @classmethod
    def of_receiver(cls, receiver: GnssSensor) -> "Fixes":
        """Take a receiver's fixes; those that are no locations, or of a time that was there, are left out."""
        usable = np.flatnonzero(usable_fixes(receiver))
        times, first = np.unique(receiver.timestamps_ns[usable], return_index=True)
        positions = np.nan_to_num(receiver.positions_lla[usable[first]])
        if len(times) == 0:
            return cls(times, np.zeros(0, np.complex128))
        return cls(times, on_ground(enu_from_geodetic(positions, positions[len(times) // 2])))

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory) -> "Fixes":
        """Take a trajectory's positions."""
        return cls(trajectory.timestamps_ns, on_ground(trajectory.positions))

    def __len__(self) -> int:
        return len(self.timestamps_ns)


@dataclass(frozen=True, slots=True, eq=False)
class TrajectorySamples:
    """A trajectory at some times (N,); NaN where not known.

    Attributes:
        locations: (N,) complex [m], up to a constant, a motion that is even, and a rotation, for each window.
        velocities: (N,) complex [m/s].
        axes: (N, 3) complex, the body's axes seen from above.
        drifts: (N, E) complex, what small errors of the trajectory would move, each by an amount for each window.
        drift_velocities: (N, E) complex, their derivatives.
        held: (E,), how large those amounts are expected to be; infinite where they are free.
    """

    locations: AnyArray
    velocities: AnyArray
    axes: AnyArray
    drifts: AnyArray
    drift_velocities: AnyArray
    held: Float64Array


class SmoothedTrajectory(Protocol):
    """A trajectory that can be asked for any time."""

    degree: int
    """What it does not know of the motion in a window: a polynomial of this degree."""
    window: float
    """For so many seconds that holds."""
    model_sigma: float
    """What the trajectory's own errors make of an offset [s]."""

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Give the trajectory at (N,) times [s] in and around a window."""
        ...

    def finer(self, amounts: Float64Array) -> "SmoothedTrajectory | None":
        """Give the same trajectory for longer windows, if any; `amounts` (W, E): the drifts of the last fit."""
        ...


def on_ground(positions: Float64Array) -> AnyArray:
    """Give the first two of (N, 3) as complex numbers (N,)."""
    return np.asarray(positions[:, 0] + 1j * positions[:, 1])
