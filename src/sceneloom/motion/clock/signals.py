"""The signals that clocks are compared by: rotation, and positions on the ground by fixes.

A trajectory or dead reckoning.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.geometry.rotations import (
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

_LONGEST_STEPS = 5.5
"""So many usual steps without a sample are a gap, across which nothing is known of the rotating."""

_LEAST_KNOTS = 4
"""A piece without gaps needs so many samples for a cubic curve."""


@dataclass(frozen=True, slots=True, eq=False)
class Rotating:
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
    def of_poses(cls, timestamps_ns: Int64Array, quaternions_xyzw: Float64Array) -> "Rotating":
        """Take the orientations of a path, (N,) [ns] strictly increasing and (N, 4)."""
        return cls(timestamps_ns, normalise_quaternion(quaternions_xyzw), _numbered_chunks(timestamps_ns))

    @classmethod
    def of_rates(cls, timestamps_ns: Int64Array, rates: Float64Array) -> "Rotating":
        """Integrate yaw rates, (N,) [ns] and (N, 3) [rad/s] in the body's frame; samples that are none are left out.

        Between samples the rates go along a cubic curve.

        Source: de Boor 1978, "A Practical Guide to Splines", chapter IV; the last term is the coning correction of
        Savage 1998, "Strapdown Inertial Navigation Integration Algorithm Design, Part 1", for a linear rate.
        """
        usable = np.flatnonzero(measured_rows(rates))
        times, first = np.unique(timestamps_ns[usable], return_index=True)
        values, chunks = rates[usable[first]], _numbered_chunks(times)
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        for piece in _piece_slices(chunks):
            if piece.stop - piece.start >= _LEAST_KNOTS:
                rotations[piece] = _integrated(times[piece], values[piece])
        return cls(times, rotations, chunks)

    @classmethod
    def of_steps(cls, timestamps_ns: Int64Array, vectors: Float64Array) -> "Rotating":
        """Chain the rotations (N - 1, 3) [rad] from each of (N,) times [ns] to the next; NaN where one is not known."""
        known = finite_rows(vectors)
        steps = quaternion_from_rotation_vector(np.where(known[:, None], vectors, 0.0))
        rotations = running_product(np.vstack([[[0.0, 0.0, 0.0, 1.0]], steps]))
        chunks = _numbered_chunks(timestamps_ns)
        chunks[1:] += np.cumsum(~known)
        return cls(timestamps_ns, rotations, chunks)

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @property
    def step_ns(self) -> int:
        """The usual time between samples [ns]; 0 where there are none."""
        return int(np.median(np.diff(self.timestamps_ns))) if len(self) > 1 else 0


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Rotates of a body from one time to another, and which of them are taken as one.

    Attributes:
        starts, stops: (N,) float64 [s] after an origin that is distinguished.
        vectors: (N, 3) float64 [rad], rotation vectors in the body's frame.
        begins: (G,) int64, number of the first rotation of each group; a group ends where the next begins.
        chunks: (G,) int64, which piece without gaps each group lies in.
    """

    starts: Float64Array
    stops: Float64Array
    vectors: Float64Array
    begins: Int64Array
    chunks: Int64Array

    def __len__(self) -> int:
        return len(self.begins)

    def mean(self, values: Float64Array) -> Float64Array:
        """Give the mean (G, …) over each group of something that each rotation has, (N, …)."""
        counts = np.diff(np.append(self.begins, len(values)))
        means: Float64Array = np.add.reduceat(values, self.begins, axis=0) / counts.reshape(
            -1, *[1] * (values.ndim - 1)
        )
        return means


def steps_of(rotating: Rotating, origin_ns: int, least: float) -> Steps:
    """Give the rotations from each sample to the next one that is at least `least` seconds later.

    As many as overlap are one group, so that noise of single orientations averages out.
    """
    stride = 1
    if least > 0 and rotating.step_ns > 0:
        stride = max(1, int(np.ceil(least * 1e9 / rotating.step_ns - 1e-3)))
    first: list[Int64Array] = []
    begins: list[Int64Array] = []
    count = 0
    for piece in _piece_slices(rotating.chunks):
        rows = np.arange(piece.start, piece.stop - stride)
        # groups of one length: what is left over at the end of a piece is left out
        rows = rows[: len(rows) - len(rows) % stride]
        begins.append(count + np.arange(0, len(rows), stride))
        first.append(rows)
        count += len(rows)
    starting = np.concatenate([*first, np.zeros(0, np.int64)]).astype(np.int64)
    grouped = np.concatenate([*begins, np.zeros(0, np.int64)]).astype(np.int64)
    seconds = np.asarray((rotating.timestamps_ns - origin_ns) * 1e-9, np.float64)
    rotations = _rotation(rotating.quaternions_xyzw[starting], rotating.quaternions_xyzw[starting + stride])
    chunks = rotating.chunks[starting[grouped]] if len(grouped) else np.zeros(0, np.int64)
    return Steps(seconds[starting], seconds[starting + stride], rotations, grouped, chunks)


def rate_noise(rotating: Rotating) -> Float64Array:
    """The power of the white noise in the rates of a rotating, (3,) [rad²/s]: what samples jump about, at most.

    Source: second differences of white noise have six times its variance.
    """
    steps = steps_of(rotating, int(rotating.timestamps_ns[0]), 0.0)
    if len(steps) < _LEAST_KNOTS:
        return np.full(3, np.inf)
    lengths = steps.stops - steps.starts
    jumps = np.diff(steps.vectors / lengths[:, None], n=2, axis=0)
    variance = (1.4826 * np.median(np.abs(jumps), axis=0)) ** 2 / 6.0
    return np.asarray(variance * np.median(lengths), np.float64)


class RotationCurve:
    """A rotating between its samples: a smooth curve through the orientations of each piece."""

    def __init__(self, rotating: Rotating, origin_ns: int) -> None:
        """Lay cubic splines through the quaternions; times are seconds after `origin_ns`.

        Source: de Boor 1978, chapter IV: the error of a cubic spline is of the fourth order in the step.
        """
        from scipy.interpolate import CubicSpline

        self._chunks = []
        for piece in _piece_slices(rotating.chunks):
            if piece.stop - piece.start < _LEAST_KNOTS:
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
            vectors[known] = _rotation(first[known], last[known])
        return vectors

    def rates(self, seconds: Float64Array, window: float) -> Float64Array:
        """Give the mean yaw rates (N, 3) [rad/s] over a window around some times (N,) [s]; NaN where not known."""
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


def _rotation(first: Float64Array, last: Float64Array) -> Float64Array:
    return rotation_vector_from_quaternion(multiply_quaternions(conjugate_quaternion(first), last))


def _numbered_chunks(timestamps_ns: Int64Array) -> Int64Array:
    """Number the chunks without gaps that times (N,) [ns] fall into, ascending."""
    numbers = np.zeros(len(timestamps_ns), np.int64)
    if len(timestamps_ns) > 1:
        steps = np.diff(timestamps_ns)
        numbers[1:] = np.cumsum(steps > _LONGEST_STEPS * np.median(steps))
    return numbers


def _piece_slices(chunks: Int64Array) -> list[slice]:
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
        return cls(times, _on_ground(enu_from_geodetic(positions, positions[len(times) // 2])))

    @classmethod
    def of_trajectory(cls, trajectory: Trajectory) -> "Fixes":
        """Take a trajectory's positions."""
        return cls(trajectory.timestamps_ns, _on_ground(trajectory.positions))

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
        """Give the same way for longer windows, where there is one, and what the last fit's drifts came to, (W, E)."""
        ...


class TrajectoryCurve:
    """A trajectory, which may drift slowly."""

    degree, window, model_sigma = 1, 30.0, 0.0

    def __init__(self, trajectory: Trajectory, origin_ns: int) -> None:
        """Lay cubic splines through positions and orientations; times are seconds after `origin_ns`."""
        from scipy.interpolate import CubicSpline

        times = trajectory.timestamps_ns
        self._chunks = [
            CubicSpline(seconds, trajectory.positions[piece, :2], extrapolate=False)
            for piece in _piece_slices(_numbered_chunks(times))
            if len(seconds := (times[piece] - origin_ns) * 1e-9) >= _LEAST_KNOTS
        ]
        rotations = trajectory.quaternions_xyzw
        self._rotating = (
            None if rotations is None else RotationCurve(Rotating.of_poses(times, rotations), origin_ns)
        )

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Give the trajectory at (N,) times [s]; the window does not matter."""
        del window
        locations, velocities = np.full((2, len(seconds)), np.nan, np.complex128)
        for curve in self._chunks:
            inside = (seconds >= curve.x[0]) & (seconds <= curve.x[-1])
            locations[inside] = _on_ground(curve(seconds[inside]))
            velocities[inside] = _on_ground(curve(seconds[inside], 1))
        no_drifts = np.zeros((len(seconds), 0), np.complex128)
        return TrajectorySamples(
            locations, velocities, self._axes(seconds), no_drifts, no_drifts, np.zeros(0)
        )

    def finer(self, amounts: Float64Array) -> None:
        """Give none: it is the same for all windows."""
        del amounts

    def _axes(self, seconds: Float64Array) -> AnyArray:
        if self._rotating is None:
            return np.zeros((len(seconds), 3), np.complex128)
        rotations, _ = self._rotating.orientations(seconds)
        return _axes_from_above(rotations)


def _on_ground(positions: Float64Array) -> AnyArray:
    """Give the first two of (N, 3) as complex numbers (N,)."""
    return np.asarray(positions[:, 0] + 1j * positions[:, 1])


def _axes_from_above(quaternions_xyzw: Float64Array) -> AnyArray:
    matrices = matrix_from_quaternion(quaternions_xyzw)
    return np.asarray(matrices[:, 0] + 1j * matrices[:, 1])


_AROUND = 6.0
"""A dead_reckoning reaches so far beyond a window on both sides, so that offsets can be tried [s]."""

_GRAVITY = 9.8

_FORCE_BIAS, _RATE_BIAS = 0.5, 0.05
"""How large biases may be [m/s², rad/s]."""

_FORCE_NOISE, _RATE_NOISE = 3e-4, 3e-5
"""No unit is taken to be better [m/s²/√Hz, rad/s/√Hz]: what wanders slowly does not show from sample to sample."""

_FORCE_STEP, _RATE_STEP = 2.0, 4.0
"""Noise of forces and rates is known by one kick in so many seconds."""

_COMPONENTS = 24
"""All kicks in a window are reported by so many principal components of what they make of the trajectory.

The 24th is a hundred
times smaller than the first."""

_GRID = 1.0
"""What noise makes of the trajectory is known by a smooth curve through locations so many seconds apart."""

_LONG = 60.0
"""Seconds of the longer windows: twice as long ones know the offset a twentieth better."""

_Curve = Callable[..., AnyArray]
"""Gives values, or with a second argument derivatives, (N, C) at (N,) times [s]; NaN outside of its span."""


@dataclass(frozen=True, slots=True, eq=False)
class Unit:
    """What an IMU measured.

    Attributes:
        rates, forces: samples of the gyroscope and of the accelerometer.
        bias: (3,) taken off the rates [rad/s].
        force_noise, rate_noise: density of what its samples jump about [m/s²/√Hz, rad/s/√Hz].
    """

    rates: VectorSamples
    forces: VectorSamples
    bias: Float64Array
    force_noise: float
    rate_noise: float

    @classmethod
    def of(cls, rates: VectorSamples, forces: VectorSamples) -> "Unit":
        """Take samples, and report their noise."""
        rotating = Rotating.of_rates(rates.timestamps_ns, rates.values[:, :3])
        rate_power = rate_noise(rotating) if len(rotating) else np.zeros(3)
        return cls(
            rates,
            forces,
            np.zeros(3),
            max(_force_noise(forces), _FORCE_NOISE),
            max(float(np.sqrt(np.where(np.isfinite(rate_power), rate_power, 0.0).mean())), _RATE_NOISE),
        )


def _force_noise(forces: VectorSamples) -> float:
    """The density of the white noise in forces, from second differences as `rate_noise` does."""
    times, values, _ = usable_samples(forces)
    if len(times) < _LEAST_KNOTS:
        return 0.0
    deviations = 1.4826 * np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0) / np.sqrt(6.0)
    return float(np.sqrt((deviations**2).mean() * np.median(np.diff(times)) * 1e-9))


class DeadReckonedTrajectory:
    """What an IMU reports the trajectory: twice integrated, anew in each window.

    Where down is comes from the mean force in the window. Over short windows, what that leaves, as biases and the
    motion before, is a polynomial of third degree; over long ones each error is known by itself: tilt, biases, and
    noise, which kicks the velocity, the tilt and the heading every few seconds; of what all kicks of a window make of
    the trajectory, the largest principal components are taken.

    Source: Groves 2013, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 5.2, 5.7 and
    14.2: the mechanisation, the growth of errors with the second and third power of the time, and their equations;
    Loève 1948, "Fonctions aléatoires du second ordre": few components report a process that is mostly slow.
    """

    def __init__(self, unit: Unit, origin_ns: int, *, long: bool = False, rounds: int = 2) -> None:
        """Integrate the yaw rates; times are seconds after `origin_ns`.

        Args:
            long: whether for long windows.
            rounds: how often the biases that are found may be taken off.
        """
        self.degree, self.window = (1, _LONG) if long else (3, 20.0)
        # measured on synthetic streets with fixes of a centimetre, where nothing else is left
        self.model_sigma = 0.0005 if long else 0.004
        self._unit, self._origin_ns, self._long, self._rounds = unit, origin_ns, long, rounds
        rates = unit.rates
        rotating = Rotating.of_rates(rates.timestamps_ns, rates.values[:, :3] - unit.bias)
        self._rotating = RotationCurve(rotating, origin_ns)
        times, self._forces, _ = usable_samples(unit.forces)
        self._seconds = np.asarray((times - origin_ns) * 1e-9, np.float64)
        self._known: dict[tuple[float, float], _DeadReckoning | None] = {}

    def finer(self, amounts: Float64Array) -> "DeadReckonedTrajectory | None":
        """Give the trajectory over long windows, of rates without the biases that came out, (W, E)."""
        if not self._long:
            return DeadReckonedTrajectory(self._unit, self._origin_ns, long=True)
        if not self._rounds:
            return None
        found = np.median(amounts[:, _RATE_BIASES], axis=0)
        unit = replace(self._unit, bias=self._unit.bias + found)
        return DeadReckonedTrajectory(unit, self._origin_ns, long=True, rounds=self._rounds - 1)

    def at(self, window: tuple[float, float], seconds: Float64Array) -> TrajectorySamples:
        """Give the trajectory at (N,) times [s] in and around a window."""
        if window not in self._known:
            self._known[window] = self._dead_reckoned(window)
        dead_reckoning = self._known[window]
        held = self._held(window)
        if dead_reckoning is None:
            nothing = np.full((len(seconds), max(len(held), 3)), np.nan, np.complex128)
            drifts = nothing[:, : len(held)]
            return TrajectorySamples(nothing[:, 0], nothing[:, 0], nothing[:, :3], drifts, drifts, held)
        rotations, chunks = self._rotating.orientations(seconds)
        velocities, values = dead_reckoning.velocity(seconds), dead_reckoning.trajectory(seconds)
        values[chunks != dead_reckoning.piece] = np.nan
        axes = _across(dead_reckoning.level_from_start @ matrix_from_quaternion(rotations))
        drifts = np.hstack([values[:, 1:], dead_reckoning.noise(seconds)])
        drift_velocities = np.hstack([velocities[:, 1:], dead_reckoning.noise(seconds, 1)])
        return TrajectorySamples(values[:, 0], velocities[:, 0], axes, drifts, drift_velocities, held)

    def _held(self, window: tuple[float, float]) -> Float64Array:
        if not self._long:
            return np.full(3, np.inf)
        kicks = 2 * len(_kick_times(window, _FORCE_STEP)) + 3 * len(_kick_times(window, _RATE_STEP))
        parts = [(3, _FORCE_BIAS), (3, _RATE_BIAS), (2, np.inf), (min(kicks, _COMPONENTS), 1.0)]
        return np.concatenate([np.full(count, sigma) for count, sigma in parts])

    def _noise(
        self,
        window: tuple[float, float],
        span: tuple[float, float],
        velocity: _Curve,
        trajectory: _Curve,
    ) -> _Curve:
        """What the noise of the samples may make of the trajectory, as columns whose amounts are expected to be 1."""
        from scipy.interpolate import CubicSpline

        seconds = np.linspace(*span, max(4, round((span[1] - span[0]) / _GRID) + 1))
        if not self._long:
            return CubicSpline(seconds, np.zeros((len(seconds), 0), np.complex128), extrapolate=False)
        kicks = self._kicks(window, seconds, velocity, trajectory)
        vectors, sizes, _ = np.linalg.svd(np.vstack([kicks.real, kicks.imag]), full_matrices=False)
        columns = np.zeros((2 * len(seconds), min(kicks.shape[1], _COMPONENTS)))
        kept = min(len(sizes), columns.shape[1])
        columns[:, :kept] = vectors[:, :kept] * sizes[:kept]
        reported = columns[: len(seconds)] + 1j * columns[len(seconds) :]
        return CubicSpline(seconds, reported, extrapolate=False)

    def _kicks(
        self, window: tuple[float, float], seconds: Float64Array, velocity: _Curve, trajectory: _Curve
    ) -> AnyArray:
        """What kicks of velocity, tilt and heading, as large as the noise makes them, make of the trajectory later."""
        force, rate = (_kick_times(window, step) for step in (_FORCE_STEP, _RATE_STEP))
        force_size, rate_size = (
            noise * np.sqrt((window[1] - window[0]) / len(times))
            for noise, times in ((self._unit.force_noise, force), (self._unit.rate_noise, rate))
        )
        after_force, after_rate = (np.maximum(seconds[:, None] - at, 0.0) for at in (force, rate))
        moved, tilted = force_size * after_force, rate_size * 0.5 * _GRAVITY * after_rate**2
        inside = np.clip(rate, seconds[0], seconds[-1])
        since_kick = (
            trajectory(seconds)[:, :1] - trajectory(inside)[:, 0] - velocity(inside)[:, 0] * after_rate
        )
        rotated = rate_size * 1j * since_kick * (after_rate > 0)
        return np.hstack([moved, 1j * moved, tilted, 1j * tilted, rotated])

    def _dead_reckoned(self, window: tuple[float, float]) -> "_DeadReckoning | None":
        from scipy.interpolate import CubicSpline

        rows = slice(*np.searchsorted(self._seconds, [window[0] - _AROUND, window[1] + _AROUND]))
        seconds, forces = self._seconds[rows], self._forces[rows]
        rotations, chunks = self._rotating.orientations(seconds)
        within = chunks[(seconds >= window[0]) & (seconds < window[1])]
        if len(within) < _LEAST_KNOTS or within[len(within) // 2] < 0:
            return None
        piece = int(within[len(within) // 2])
        inside = chunks == piece
        felt = rotate_vectors(rotations[inside], forces[inside])
        up = felt.mean(axis=0)
        if len(felt) < _LEAST_KNOTS or not up.any():
            return None
        level_from_start = _levelling(up)
        since = seconds[inside] - 0.5 * sum(window)
        bodies = level_from_start @ matrix_from_quaternion(rotations[inside])
        errors = _long_errors if self._long else _short_errors
        columns = errors(since, felt @ level_from_start.T, bodies)
        velocity = CubicSpline(seconds[inside], columns, extrapolate=False).antiderivative()
        trajectory = velocity.antiderivative()
        span = float(seconds[inside][0]), float(seconds[inside][-1])
        return _DeadReckoning(
            piece, level_from_start, velocity, trajectory, self._noise(window, span, velocity, trajectory)
        )


def _kick_times(window: tuple[float, float], step: float) -> Float64Array:
    """When kicks begin, evenly in a window, about so many seconds apart."""
    length = window[1] - window[0]
    count = max(1, round(length / step))
    return np.asarray(window[0] + length / count * np.arange(count), np.float64)


_RATE_BIASES = slice(3, 6)
"""Which drifts over long windows are those of the gyroscope's biases."""


def _short_errors(since: Float64Array, felt: Float64Array, bodies: Float64Array) -> AnyArray:
    """Accelerations (N,), what biases of the forces along two axes add, and a bias of the rate about the vertical."""
    accelerations, axes = _on_ground(felt), _across(bodies)
    return np.stack([accelerations, axes[:, 0], axes[:, 1], 1j * since * accelerations], axis=1)


def _long_errors(since: Float64Array, felt: Float64Array, bodies: Float64Array) -> AnyArray:
    """Accelerations (N,), and what biases of three forces and of three rates taken off, and a tilt about two axes, add.

    A small rotation ψ taken off the orientation adds f × ψ to the force f.
    """
    accelerations, up, axes = _on_ground(felt), felt[:, 2:], _across(bodies)
    rotated, spun = _integral(since, axes), _integral(since, bodies[:, 2])
    rates = 1j * (up * rotated - spun * accelerations[:, None])
    return np.hstack([accelerations[:, None], axes, rates, up, 1j * up])


def _integral(seconds: Float64Array, values: AnyArray) -> AnyArray:
    """The integral of (N, K) values from the time 0 on, by trapezia."""
    steps = 0.5 * np.diff(seconds)[:, None] * (values[1:] + values[:-1])
    total = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
    return np.asarray(total - total[int(np.argmin(np.abs(seconds)))])


@dataclass(frozen=True, slots=True, eq=False)
class _DeadReckoning:
    """In a window: velocity and trajectory as curves, each with what errors would add, what noise does.

    And their frame.
    """

    piece: int
    level_from_start: Float64Array
    velocity: _Curve
    trajectory: _Curve
    noise: _Curve


def _across(bodies: Float64Array) -> AnyArray:
    """The axes (N, 3) of bodies (N, 3, 3) seen from above."""
    return np.asarray(bodies[:, 0] + 1j * bodies[:, 1])


def _levelling(up: Float64Array) -> Float64Array:
    """The smallest rotation (3, 3) that takes a direction to z."""
    unit = up / np.linalg.norm(up)
    half = np.array([unit[1], -unit[0], 0.0, 1.0 + unit[2]])
    if half[3] < 1e-9:
        half = np.array([1.0, 0.0, 0.0, 0.0])
    return matrix_from_quaternion(half / np.linalg.norm(half))
