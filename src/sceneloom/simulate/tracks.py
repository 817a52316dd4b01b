"""Lines beside the ego trajectory that others follow, by their own length."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.simulate.ground import Lane


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A line at a constant distance beside the trajectory, straight on beyond its ends.

    Attributes:
        points: (L, 2) float64 [m], world frame.
        headings: (L,) float64 [rad], of the trajectory.
        along: (L,) float64 [m], arc length of this line, from 0.
        widths: (L,) float64, length of this line per length of the trajectory: small on the inside of a bend.
        parameters: (L,) float64, the ego's curve parameters beside the points.
    """

    points: Float64Array
    headings: Float64Array
    along: Float64Array
    widths: Float64Array
    parameters: Float64Array

    @classmethod
    def of(cls, lane: Lane, left: float) -> "Track":
        """Lay a line `left` of the trajectory [m]."""
        normals = np.column_stack([-np.sin(lane.headings), np.cos(lane.headings)])
        points = lane.points + left * normals
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        return cls(points, lane.headings, along, 1.0 - lane.curvatures * left, lane.parameters)

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return float(self.along[-1])

    def beside(self, parameters: Float64Array) -> Float64Array:
        """How far along it one is beside the ego's curve at (N,) parameters, (N,) [m]."""
        along: Float64Array = np.interp(parameters, self.parameters, self.along)
        return along

    def at(self, along: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Give points (N, 2) [m] and the trajectory's headings (N,) [rad] at arc lengths (N,)."""
        inside = np.clip(along, 0.0, self.length)
        points = np.column_stack([np.interp(inside, self.along, self.points[:, axis]) for axis in range(2)])
        headings = np.interp(inside, self.along, self.headings)
        ahead = np.column_stack([np.cos(headings), np.sin(headings)])
        return points + (along - inside)[:, None] * ahead, headings

    def narrowest(self, first: float, last: float) -> float:
        """The least of `widths` between two arc lengths [m]; below 0 the line runs backwards."""
        low, high = np.searchsorted(self.along, [first, last])
        return float(self.widths[max(0, low - 1) : high + 1].min(initial=1.0))
