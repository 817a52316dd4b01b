"""Where a body was on the ground over time: by fixes, by a trajectory, or reckoned from an IMU."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.geometry.rotations import matrix_from_quaternion, rotate_vectors
from sceneloom.motion.clock.turning import LEAST_KNOTS, Turning, TurningCurve, numbered_pieces, piece_slices
from sceneloom.motion.gnss_receivers import usable_fixes
from sceneloom.motion.imu_samples import usable_samples
from sceneloom.scene import GnssSensor, Trajectory, VectorSamples

_AROUND = 6.0
"""An IMU's reckoning reaches so far beyond a window on both sides, so that offsets can be tried [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Places on the ground, east and north as the real and imaginary part [m], (N,) at (N,) times [ns]."""

    timestamps_ns: Int64Array
    places: AnyArray

    @classmethod
    def of_receiver(cls, receiver: GnssSensor) -> "Fixes":
        """Take a receiver's fixes; those that are no places, or of a time that was there, are left out."""
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
class WaySamples:
    """A way at some times (N,); NaN where not known.

    Attributes:
        places: (N,) complex [m], up to a constant, a motion that is even, and a turn, for each window.
        velocities: (N,) complex [m/s].
        axes: (N, 3) complex, the body's axes seen from above.
        drifts: (N, E) complex, what small errors of the way would move: their amounts are free in each window.
    """

    places: AnyArray
    velocities: AnyArray
    axes: AnyArray
    drifts: AnyArray


class Way(Protocol):
    """A way that can be asked for any time."""

    degree: int
    """What it does not know of the motion in a window: a polynomial of this degree."""
    window: float
    """For so many seconds that holds."""
    model_sigma: float
    """What the way's own errors make of an offset [s]."""

    def at(self, window: tuple[float, float], seconds: Float64Array) -> WaySamples:
        """Give the way at (N,) times [s] in and around a window."""
        ...


class TrajectoryWay:
    """A trajectory, which may drift slowly."""

    degree, window, model_sigma = 1, 30.0, 0.0

    def __init__(self, trajectory: Trajectory, origin_ns: int) -> None:
        """Lay cubic splines through positions and orientations; times are seconds after `origin_ns`."""
        from scipy.interpolate import CubicSpline

        times = trajectory.timestamps_ns
        self._pieces = [
            CubicSpline(seconds, trajectory.positions[piece, :2], extrapolate=False)
            for piece in piece_slices(numbered_pieces(times))
            if len(seconds := (times[piece] - origin_ns) * 1e-9) >= LEAST_KNOTS
        ]
        turns = trajectory.quaternions_xyzw
        self._turning = None if turns is None else TurningCurve(Turning.of_poses(times, turns), origin_ns)

    def at(self, window: tuple[float, float], seconds: Float64Array) -> WaySamples:
        """Give the way at (N,) times [s]; the window does not matter."""
        del window
        places, velocities = np.full((2, len(seconds)), np.nan, np.complex128)
        for curve in self._pieces:
            inside = (seconds >= curve.x[0]) & (seconds <= curve.x[-1])
            places[inside] = _on_ground(curve(seconds[inside]))
            velocities[inside] = _on_ground(curve(seconds[inside], 1))
        return WaySamples(places, velocities, self._axes(seconds), np.zeros((len(seconds), 0), np.complex128))

    def _axes(self, seconds: Float64Array) -> AnyArray:
        if self._turning is None:
            return np.zeros((len(seconds), 3), np.complex128)
        turns, _ = self._turning.orientations(seconds)
        return _axes_from_above(turns)


class ReckonedWay:
    """What turn rates and specific forces tell of the way: twice integrated, anew in each window.

    Where down is comes from the mean force in the window; what that leaves, as biases and the motion before, is a
    polynomial of third degree over so short a time.

    Source: Groves 2013, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 5.2 and 5.7:
    the mechanisation, and the growth of errors with the second and third power of the time.
    """

    degree, window = 3, 20.0
    model_sigma = 0.004
    # measured on made-up streets with fixes of a centimetre, where nothing else is left

    def __init__(self, rates: VectorSamples, forces: VectorSamples, origin_ns: int) -> None:
        """Integrate the turn rates; times are seconds after `origin_ns`."""
        turning = Turning.of_rates(rates.timestamps_ns, rates.values[:, :3])
        self._turning = TurningCurve(turning, origin_ns)
        times, self._forces, _ = usable_samples(forces)
        self._seconds = np.asarray((times - origin_ns) * 1e-9, np.float64)
        self._known: dict[tuple[float, float], _Reckoning | None] = {}

    def at(self, window: tuple[float, float], seconds: Float64Array) -> WaySamples:
        """Give the way at (N,) times [s] in and around a window."""
        if window not in self._known:
            self._known[window] = self._reckoned(window)
        reckoning = self._known[window]
        if reckoning is None:
            nothing = np.full((len(seconds), 3), np.nan, np.complex128)
            return WaySamples(nothing[:, 0], nothing[:, 0], nothing, nothing)
        turns, pieces = self._turning.orientations(seconds)
        velocities = reckoning.velocity(seconds)
        values = reckoning.way(seconds)
        unknown = pieces != reckoning.piece
        values[unknown] = np.nan
        axes = _axes_from_above(turns, reckoning.level_from_start)
        return WaySamples(values[:, 0], velocities[:, 0], axes, values[:, 1:])

    def _reckoned(self, window: tuple[float, float]) -> "_Reckoning | None":
        from scipy.interpolate import CubicSpline

        rows = slice(*np.searchsorted(self._seconds, [window[0] - _AROUND, window[1] + _AROUND]))
        seconds, forces = self._seconds[rows], self._forces[rows]
        turns, pieces = self._turning.orientations(seconds)
        within = pieces[(seconds >= window[0]) & (seconds < window[1])]
        if len(within) < LEAST_KNOTS or within[len(within) // 2] < 0:
            return None
        piece = int(within[len(within) // 2])
        inside = pieces == piece
        felt = rotate_vectors(turns[inside], forces[inside])
        up = felt.mean(axis=0)
        if len(felt) < LEAST_KNOTS or not up.any():
            return None
        level_from_start = _levelling(up)
        accelerations = _on_ground(felt @ level_from_start.T)
        axes = _axes_from_above(turns[inside], level_from_start)
        since = seconds[inside] - 0.5 * sum(window)
        columns = np.stack([accelerations, axes[:, 0], axes[:, 1], 1j * since * accelerations], axis=1)
        velocity = CubicSpline(seconds[inside], columns, extrapolate=False).antiderivative()
        return _Reckoning(piece, level_from_start, velocity, velocity.antiderivative())


@dataclass(frozen=True, slots=True, eq=False)
class _Reckoning:
    """In a window: velocity and way as splines, each with what three errors would add, and the frame they are in.

    The errors are biases of the forces along two axes of the body, and a bias of the turn rate about the vertical.
    """

    piece: int
    level_from_start: Float64Array
    velocity: Callable[[Float64Array], AnyArray]
    way: Callable[[Float64Array], AnyArray]


def _on_ground(positions: Float64Array) -> AnyArray:
    return np.asarray(positions[:, 0] + 1j * positions[:, 1])


def _axes_from_above(
    quaternions_xyzw: Float64Array, level_from_world: Float64Array | None = None
) -> AnyArray:
    matrices = matrix_from_quaternion(quaternions_xyzw)
    if level_from_world is not None:
        matrices = level_from_world @ matrices
    return np.asarray(matrices[:, 0] + 1j * matrices[:, 1])


def _levelling(up: Float64Array) -> Float64Array:
    """The smallest rotation (3, 3) that takes a direction to z."""
    unit = up / np.linalg.norm(up)
    half = np.array([unit[1], -unit[0], 0.0, 1.0 + unit[2]])
    if half[3] < 1e-9:
        half = np.array([1.0, 0.0, 0.0, 0.0])
    return matrix_from_quaternion(half / np.linalg.norm(half))
