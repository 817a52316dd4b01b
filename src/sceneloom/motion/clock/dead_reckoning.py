"""Where a body was on the ground over time, computed from yaw rates and specific forces."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.geometry.rotations import matrix_from_quaternion, rotate_vectors
from sceneloom.motion.clock.rotating import LEAST_KNOTS, Rotating, RotationCurve, rate_noise
from sceneloom.motion.clock.trajectories import TrajectorySamples, on_ground
from sceneloom.motion.imu_samples import usable_samples
from sceneloom.scene.motion import VectorSamples

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


Curve = Callable[..., AnyArray]
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
    if len(times) < LEAST_KNOTS:
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
        velocity: Curve,
        trajectory: Curve,
    ) -> Curve:
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
        self, window: tuple[float, float], seconds: Float64Array, velocity: Curve, trajectory: Curve
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
        if len(within) < LEAST_KNOTS or within[len(within) // 2] < 0:
            return None
        piece = int(within[len(within) // 2])
        inside = chunks == piece
        felt = rotate_vectors(rotations[inside], forces[inside])
        up = felt.mean(axis=0)
        if len(felt) < LEAST_KNOTS or not up.any():
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
    accelerations, axes = on_ground(felt), _across(bodies)
    return np.stack([accelerations, axes[:, 0], axes[:, 1], 1j * since * accelerations], axis=1)


def _long_errors(since: Float64Array, felt: Float64Array, bodies: Float64Array) -> AnyArray:
    """Accelerations (N,), and what biases of three forces and of three rates taken off, and a tilt about two axes, add.

    A small rotation ψ taken off the orientation adds f × ψ to the force f.
    """
    accelerations, up, axes = on_ground(felt), felt[:, 2:], _across(bodies)
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
    velocity: Curve
    trajectory: Curve
    noise: Curve


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
