"""The ground: coordinates along and across the ego trajectory, and a map of them for the painter."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array
from sceneloom.simulate.path import EgoPath

PALETTE = ((104, 105, 110), (238, 238, 228), (172, 166, 158), (196, 194, 188), (112, 136, 74))
"""Asphalt, paint, pavement, kerb, grass."""

GRAIN = 0.55
"""Share of laser light that the ground gives back where it is white."""

_STEP = 0.25
_WIDTH = 14.0
_CELL = 0.5
_FAR = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """The ego trajectory as a chain of points every 25 cm, which the street follows.

    Attributes:
        points: (L, 2) float64 [m], world frame.
        headings: (L,) float64 [rad].
        curvatures: (L,) float64 [1/m].
        along: (L,) float64 [m], arc length, 0 where the drive begins.
        parameters: (L,) float64 [s], of the path's curve.
    """

    points: Float64Array
    headings: Float64Array
    curvatures: Float64Array
    along: Float64Array
    parameters: Float64Array

    @classmethod
    def of(cls, path: EgoPath) -> "Lane":
        """Follow a path from the beginning to the end of its curve."""
        first, last = path.reach
        fine = np.linspace(first, last, int((last - first) * 100) + 1)[:-1]
        xy = path.on_curve(fine).positions[:, :2]
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
        even = np.arange(0.0, length[-1], _STEP)
        seconds = np.interp(even, length, fine)
        states = path.on_curve(seconds)
        (vx, vy), (ax, ay) = states.velocities[:, :2].T, states.accelerations[:, :2].T
        return cls(
            states.positions[:, :2],
            np.unwrap(np.arctan2(vy, vx)),
            (vx * ay - vy * ax) / np.hypot(vx, vy) ** 3,
            even - np.interp(0.0, fine, length),
            seconds,
        )

    def location(self, along: float, left: float) -> tuple[float, float, float]:
        """World x, y [m] and heading [rad] of a spot `along` the trajectory and `left` of it."""
        x, y = (float(np.interp(along, self.along, self.points[:, axis])) for axis in range(2))
        heading = float(np.interp(along, self.along, self.headings))
        return x - left * np.sin(heading), y + left * np.cos(heading), heading

    def offsets(self, points: Float64Array) -> Float64Array:
        """How far left of the trajectory (M, 2) points lie [m]; negative to the right."""
        apart = points[:, None, :] - self.points[None, ::4, :]
        nearest = np.argmin((apart * apart).sum(axis=2), axis=1)
        dx, dy = apart[np.arange(len(points)), nearest].T
        heading = self.headings[::4][nearest]
        sign = np.sign(np.cos(heading) * dy - np.sin(heading) * dx)
        left: Float64Array = sign * np.hypot(dx, dy)
        return left


@dataclass(frozen=True, slots=True, eq=False)
class GroundMap:
    """Coordinates of the ground around the trajectory, at the nodes of a square grid.

    Attributes:
        nodes: (X, Y, 4) float32: along [m], left [m], cosine and sine of the trajectory's heading.
        corner: (2,) float64 [m], world position of node (0, 0).
        cell: distance of neighbouring nodes [m].
    """

    nodes: Float32Array
    corner: Float64Array
    cell: float = _CELL

    @classmethod
    def of(cls, lane: Lane) -> "GroundMap":
        """Draw a strip along the lane; elsewhere the ground lies far to its left."""
        corner = np.floor(lane.points.min(axis=0)) - _FAR
        size = np.ceil((lane.points.max(axis=0) + _FAR - corner) / _CELL).astype(np.int64) + 1
        nodes = np.zeros((*size, 4), np.float32)
        nodes[..., 1], nodes[..., 2] = _WIDTH, 1.0
        nearest = np.full(size, np.inf)
        for k in range(len(lane.points)):
            _draw(nodes, nearest, corner, lane, k)
        return cls(nodes, corner)


def _draw(nodes: Float32Array, nearest: Float64Array, corner: Float64Array, lane: Lane, k: int) -> None:
    """Write the coordinates of the nodes that lie nearer to point k of the lane than to those before."""
    low = np.maximum(0, np.floor((lane.points[k] - _WIDTH - corner) / _CELL).astype(np.int64))
    high = np.ceil((lane.points[k] + _WIDTH - corner) / _CELL).astype(np.int64) + 1
    window = (slice(low[0], high[0]), slice(low[1], high[1]))
    shape = nearest[window].shape
    x = (corner[0] + _CELL * (low[0] + np.arange(shape[0])) - lane.points[k, 0])[:, None]
    y = (corner[1] + _CELL * (low[1] + np.arange(shape[1])) - lane.points[k, 1])[None, :]
    squared = x * x + y * y
    closer = squared < np.minimum(nearest[window], _WIDTH**2)
    cosine, sine = np.cos(lane.headings[k]), np.sin(lane.headings[k])
    ahead, left = (cosine * x + sine * y)[closer], (cosine * y - sine * x)[closer]
    stretch = np.maximum(0.2, 1.0 - lane.curvatures[k] * left)
    values = np.column_stack(
        [lane.along[k] + ahead / stretch, left, np.full(len(left), cosine), np.full(len(left), sine)]
    )
    nearest[window][closer] = squared[closer]
    nodes[window][closer] = values
