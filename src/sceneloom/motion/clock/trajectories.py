"""Where a body was on the ground over time: by fixes or by a trajectory."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.motion.clock.rotating import (
    LEAST_KNOTS,
    Rotating,
    RotationCurve,
    numbered_chunks,
    piece_slices,
)
from sceneloom.motion.gnss_receivers import usable_fixes
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Trajectory


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
            for piece in piece_slices(numbered_chunks(times))
            if len(seconds := (times[piece] - origin_ns) * 1e-9) >= LEAST_KNOTS
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
            locations[inside] = on_ground(curve(seconds[inside]))
            velocities[inside] = on_ground(curve(seconds[inside], 1))
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


def on_ground(positions: Float64Array) -> AnyArray:
    """Give the first two of (N, 3) as complex numbers (N,)."""
    return np.asarray(positions[:, 0] + 1j * positions[:, 1])


def _axes_from_above(quaternions_xyzw: Float64Array) -> AnyArray:
    matrices = matrix_from_quaternion(quaternions_xyzw)
    return np.asarray(matrices[:, 0] + 1j * matrices[:, 1])
