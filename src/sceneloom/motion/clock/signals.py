"""Signals from which clocks are compared: orientations, and positions on the ground.

Positions on the ground, and the body axes seen from above, are complex numbers: x (east) + i y (north).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.geometry.rigid import (
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    normalise_quaternion,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from sceneloom.motion.ego_trajectory import usable_fixes
from sceneloom.motion.imu import measured_rows, running_product, usable_samples
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

        usable = np.flatnonzero(measured_rows(rates))
        times, first = np.unique(timestamps_ns[usable], return_index=True)
        values, chunks = rates[usable[first]], _number_chunks(times)
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


def finite_rows(values: Float64Array) -> BoolArray:
    """Which rows of (N, K) are finite."""
    return np.asarray(np.isfinite(values).all(axis=1), np.bool_)


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


def _ground(positions: Float64Array) -> AnyArray:
    return np.asarray(positions[:, 0] + 1j * positions[:, 1])


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
        return cls(times, _ground(enu_from_geodetic(positions, positions[len(times) // 2])))

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory) -> "Fixes":
        """Take a trajectory's positions."""
        return cls(trajectory.timestamps_ns, _ground(trajectory.positions))

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


class TrajectoryCurve:
    """A recorded trajectory, which may drift slowly: cubic splines through its poses."""

    degree, window, model_sigma = 1, 30.0, 0.0

    def __init__(self, trajectory: Trajectory, origin_ns: int) -> None:
        """Fit the splines; times are seconds after `origin_ns`."""
        from scipy.interpolate import CubicSpline

        times, rotations = trajectory.timestamps_ns, trajectory.quaternions_xyzw
        self._chunks = [
            CubicSpline(seconds, trajectory.positions[rows, :2], extrapolate=False)
            for rows in _slices(_number_chunks(times))
            if len(seconds := (times[rows] - origin_ns) * 1e-9) >= LEAST_KNOTS
        ]
        self._rotation = (
            None if rotations is None else RotationCurve(Orientations.of_poses(times, rotations), origin_ns)
        )

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Evaluate at (N,) times [s]; the window does not matter."""
        del window
        locations, velocities = np.full((2, len(seconds)), np.nan, np.complex128)
        for curve in self._chunks:
            inside = (seconds >= curve.x[0]) & (seconds <= curve.x[-1])
            locations[inside] = _ground(curve(seconds[inside]))
            velocities[inside] = _ground(curve(seconds[inside], 1))
        axes = np.zeros((len(seconds), 3), np.complex128)
        if self._rotation is not None:
            axes = _axes_from_above(matrix_from_quaternion(self._rotation.orientations(seconds)[0]))
        no_drifts = np.zeros((len(seconds), 0), np.complex128)
        return TrajectorySamples(locations, velocities, axes, no_drifts, no_drifts, np.zeros(0))

    def finer(self, amounts: Float64Array) -> None:
        """None: it is the same for all windows."""
        del amounts


def _axes_from_above(rotations: Float64Array) -> AnyArray:
    """The axes (N, 3) of bodies (N, 3, 3) seen from above."""
    return np.asarray(rotations[:, 0] + 1j * rotations[:, 1])


_MARGIN = 6.0  # dead reckoning extends so far beyond a window on both sides, so that offsets can be tried [s]
_GRAVITY = 9.8
_FORCE_BIAS, _RATE_BIAS = 0.5, 0.05  # standard deviations of the biases [m/s², rad/s]

_FORCE_NOISE, _RATE_NOISE = 3e-4, 3e-5
"""Least densities assumed [m/s²/√Hz, rad/s/√Hz]: slow wander does not show from sample to sample."""

_FORCE_STEP, _RATE_STEP = 2.0, 4.0  # seconds between the kicks that stand for the noise of forces and rates

_COMPONENTS = 24
"""Principal components kept of the effects of all kicks in a window; the 24th is a hundred times smaller than the
first."""

_GRID = 1.0  # seconds between the knots of the effects of noise
_LONG_WINDOW = 60.0  # seconds of the longer windows: doubling them would improve the offset by a twentieth
_RATE_BIASES = slice(3, 6)  # the drifts over long windows that are the gyroscope's biases

_Curve = Callable[..., AnyArray]
"""Gives values, or with a second argument derivatives, (N, C) at (N,) times [s]; NaN outside its span."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """Samples of an IMU.

    Attributes:
        rates, forces: samples of the gyroscope and of the accelerometer.
        bias: (3,) subtracted from the rates [rad/s].
        force_noise, rate_noise: noise densities [m/s²/√Hz, rad/s/√Hz].
    """

    rates: VectorSamples
    forces: VectorSamples
    bias: Float64Array
    force_noise: float
    rate_noise: float

    @classmethod
    def of(cls, rates: VectorSamples, forces: VectorSamples) -> "ImuSamples":
        """Take samples, and estimate their noise."""
        orientations = Orientations.of_rates(rates.timestamps_ns, rates.values[:, :3])
        power = orientations.rate_noise() if len(orientations) else np.zeros(3)
        rate_noise = float(np.sqrt(np.where(np.isfinite(power), power, 0.0).mean()))
        times, values, _ = usable_samples(forces)
        force_noise = 0.0
        if len(times) >= LEAST_KNOTS:
            deviations = 1.4826 * np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0) / np.sqrt(6.0)
            force_noise = float(np.sqrt((deviations**2).mean() * np.median(np.diff(times)) * 1e-9))
        return cls(rates, forces, np.zeros(3), max(force_noise, _FORCE_NOISE), max(rate_noise, _RATE_NOISE))


@dataclass(frozen=True, slots=True, eq=False)
class _DeadReckoning:
    """One window: velocity and position with the effects of errors in the columns after the first, and of noise."""

    chunk: int
    level_from_start: Float64Array
    velocity: _Curve
    position: _Curve
    noise: _Curve


class DeadReckonedTrajectory:
    """The trajectory from an IMU: integrated twice, anew in each window.

    The vertical is taken from the mean force in the window. Over short windows the remaining errors, biases and
    initial motion are a cubic polynomial. Over long ones each error is modelled by itself: tilt, biases, and noise,
    which kicks velocity, tilt and heading every few seconds; of the effects of all kicks in a window the largest
    principal components are kept.

    Source: Groves 2013, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 5.2, 5.7 and
    14.2: the mechanisation, the growth of errors with the second and third power of the time, and their equations;
    Loève 1948, "Fonctions aléatoires du second ordre": few components describe a process that is mostly slow.
    """

    def __init__(self, imu: ImuSamples, origin_ns: int, *, long: bool = False, rounds: int = 2) -> None:
        """Integrate the angular velocities; times are seconds after `origin_ns`.

        `long`: whether for long windows; `rounds`: how often estimated biases may still be subtracted.
        """
        self.degree, self.window = (1, _LONG_WINDOW) if long else (3, 20.0)
        # measured on synthetic streets with fixes of a centimetre, where nothing else is left
        self.model_sigma = 0.0005 if long else 0.004
        self._imu, self._origin_ns, self._long, self._rounds = imu, origin_ns, long, rounds
        rates = imu.rates
        self._rotation = RotationCurve(
            Orientations.of_rates(rates.timestamps_ns, rates.values[:, :3] - imu.bias), origin_ns
        )
        times, self._forces, _ = usable_samples(imu.forces)
        self._seconds = np.asarray((times - origin_ns) * 1e-9, np.float64)
        self._known: dict[tuple[float, float], _DeadReckoning | None] = {}

    def finer(self, amounts: Float64Array) -> "DeadReckonedTrajectory | None":
        """The trajectory over long windows, from rates without the biases that were estimated, (W, E)."""
        if not self._long:
            return DeadReckonedTrajectory(self._imu, self._origin_ns, long=True)
        if not self._rounds:
            return None
        imu = replace(self._imu, bias=self._imu.bias + np.median(amounts[:, _RATE_BIASES], axis=0))
        return DeadReckonedTrajectory(imu, self._origin_ns, long=True, rounds=self._rounds - 1)

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Evaluate at (N,) times [s] in and around a window."""
        if window not in self._known:
            self._known[window] = self._integrate(window)
        known, sigmas = self._known[window], self._drift_sigmas(window)
        if known is None:
            nothing = np.full((len(seconds), max(len(sigmas), 3)), np.nan, np.complex128)
            drifts = nothing[:, : len(sigmas)]
            return TrajectorySamples(nothing[:, 0], nothing[:, 0], nothing[:, :3], drifts, drifts, sigmas)
        rotations, chunks = self._rotation.orientations(seconds)
        velocities, positions = known.velocity(seconds), known.position(seconds)
        positions[chunks != known.chunk] = np.nan
        axes = _axes_from_above(known.level_from_start @ matrix_from_quaternion(rotations))
        drifts = np.hstack([positions[:, 1:], known.noise(seconds)])
        drift_velocities = np.hstack([velocities[:, 1:], known.noise(seconds, 1)])
        return TrajectorySamples(positions[:, 0], velocities[:, 0], axes, drifts, drift_velocities, sigmas)

    def _drift_sigmas(self, window: tuple[float, float]) -> Float64Array:
        if not self._long:
            return np.full(3, np.inf)
        kicks = 2 * len(_kick_times(window, _FORCE_STEP)) + 3 * len(_kick_times(window, _RATE_STEP))
        return np.repeat([_FORCE_BIAS, _RATE_BIAS, np.inf, 1.0], [3, 3, 2, min(kicks, _COMPONENTS)])

    def _integrate(self, window: tuple[float, float]) -> _DeadReckoning | None:
        from scipy.interpolate import CubicSpline

        rows = slice(*np.searchsorted(self._seconds, [window[0] - _MARGIN, window[1] + _MARGIN]))
        seconds, forces = self._seconds[rows], self._forces[rows]
        rotations, chunks = self._rotation.orientations(seconds)
        within = chunks[(seconds >= window[0]) & (seconds < window[1])]
        if len(within) < LEAST_KNOTS or within[len(within) // 2] < 0:
            return None
        chunk = int(within[len(within) // 2])
        inside = chunks == chunk
        seconds = seconds[inside]
        forces_start = rotate_vectors(rotations[inside], forces[inside])
        up = forces_start.mean(axis=0)
        if len(forces_start) < LEAST_KNOTS or not up.any():
            return None
        level_from_start = _levelling(up)
        bodies = level_from_start @ matrix_from_quaternion(rotations[inside])
        errors = _long_errors if self._long else _short_errors
        columns = errors(seconds - 0.5 * sum(window), forces_start @ level_from_start.T, bodies)
        velocity = CubicSpline(seconds, columns, extrapolate=False).antiderivative()
        position = velocity.antiderivative()
        knots = np.linspace(seconds[0], seconds[-1], max(4, round(float(seconds[-1] - seconds[0]) / _GRID) + 1))
        effects = np.zeros((len(knots), 0), np.complex128)
        if self._long:
            effects = self._noise_effects(window, knots, velocity, position)
        noise = CubicSpline(knots, effects, extrapolate=False)
        return _DeadReckoning(chunk, level_from_start, velocity, position, noise)

    def _noise_effects(
        self, window: tuple[float, float], seconds: Float64Array, velocity: _Curve, position: _Curve
    ) -> AnyArray:
        """Principal components of the positions after kicks of velocity, tilt and heading as large as the noise."""
        force, rate = (_kick_times(window, step) for step in (_FORCE_STEP, _RATE_STEP))
        force_size, rate_size = (
            noise * np.sqrt((window[1] - window[0]) / len(times))
            for noise, times in ((self._imu.force_noise, force), (self._imu.rate_noise, rate))
        )
        after_force, after_rate = (np.maximum(seconds[:, None] - at, 0.0) for at in (force, rate))
        moved, tilted = force_size * after_force, rate_size * 0.5 * _GRAVITY * after_rate**2
        inside = np.clip(rate, seconds[0], seconds[-1])
        since_kick = position(seconds)[:, :1] - position(inside)[:, 0] - velocity(inside)[:, 0] * after_rate
        rotated = rate_size * 1j * since_kick * (after_rate > 0)
        kicks = np.hstack([moved, 1j * moved, tilted, 1j * tilted, rotated])
        vectors, sizes, _ = np.linalg.svd(np.vstack([kicks.real, kicks.imag]), full_matrices=False)
        columns = np.zeros((2 * len(seconds), min(kicks.shape[1], _COMPONENTS)))
        kept = min(len(sizes), columns.shape[1])
        columns[:, :kept] = vectors[:, :kept] * sizes[:kept]
        return np.asarray(columns[: len(seconds)] + 1j * columns[len(seconds) :])


def _kick_times(window: tuple[float, float], step: float) -> Float64Array:
    """When kicks begin, evenly in a window, about `step` seconds apart."""
    length = window[1] - window[0]
    count = max(1, round(length / step))
    return np.asarray(window[0] + length / count * np.arange(count), np.float64)


def _short_errors(since: Float64Array, forces: Float64Array, bodies: Float64Array) -> AnyArray:
    """Accelerations (N,), and the effects of two force biases and of a rate bias about the vertical."""
    accelerations, axes = _ground(forces), _axes_from_above(bodies)
    return np.stack([accelerations, axes[:, 0], axes[:, 1], 1j * since * accelerations], axis=1)


def _long_errors(since: Float64Array, forces: Float64Array, bodies: Float64Array) -> AnyArray:
    """Accelerations (N,), and the effects of three force biases, three rate biases subtracted, and two tilts."""
    # a small rotation ψ subtracted from the orientation adds f x ψ to the force f
    accelerations, up, axes = _ground(forces), forces[:, 2:], _axes_from_above(bodies)
    rotated, spun = _integral(since, axes), _integral(since, bodies[:, 2])
    rates = 1j * (up * rotated - spun * accelerations[:, None])
    return np.hstack([accelerations[:, None], axes, rates, up, 1j * up])


def _integral(seconds: Float64Array, values: AnyArray) -> AnyArray:
    """The integral of (N, K) values from time 0, by the trapezoidal rule."""
    steps = 0.5 * np.diff(seconds)[:, None] * (values[1:] + values[:-1])
    total = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
    return np.asarray(total - total[int(np.argmin(np.abs(seconds)))])


def _levelling(up: Float64Array) -> Float64Array:
    """The smallest rotation (3, 3) that takes a direction to z."""
    unit = up / np.linalg.norm(up)
    half = np.array([unit[1], -unit[0], 0.0, 1.0 + unit[2]])
    if half[3] < 1e-9:
        half = np.array([1.0, 0.0, 0.0, 0.0])
    return matrix_from_quaternion(half / np.linalg.norm(half))
