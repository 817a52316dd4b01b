"""Planes around points of a sweep."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sceneloom.arrays import BoolArray, Float64Array, Int64Array

_NEIGHBOURS = 12
_THICKEST = 0.03
_WIDEST = 1.0
"""Neighbours must be this near, and lie this near to their plane [m]."""
_FLATTEST = 4.0
"""They spread over the plane so many times as far as across it, in both directions."""
_ROUNDEST = 0.14
"""They spread in both directions: not along a single line of the scan, which has no plane."""
_MOST_POINTS = 5000


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """Pieces of planes.

    Attributes:
        points: (N, 3) float64 [m], their middles.
        normals: (N, 3) float64, of either sign.
    """

    points: Float64Array
    normals: Float64Array

    def select(self, rows: Int64Array | BoolArray) -> "Planes":
        """Some of them."""
        return Planes(self.points[rows], self.normals[rows])


def find_planes(points: Float64Array, rows: Int64Array) -> Planes:
    """Find planes around some points of a sweep, evenly drawn if these are many.

    Args:
        points: (N, 3) [m].
        rows: (K,) int64, around which of them.
    """
    if len(points) < _NEIGHBOURS or len(rows) == 0:
        return Planes(np.zeros((0, 3)), np.zeros((0, 3)))
    drawn = rows[:: max(len(rows) // _MOST_POINTS, 1)]
    distances, near = map(np.asarray, cKDTree(points).query(points[drawn], _NEIGHBOURS))
    middles = points[near].mean(axis=1)
    about = points[near] - middles[:, None]
    spreads, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", about, about) / _NEIGHBOURS)
    across, narrow, wide = np.sqrt(np.maximum(spreads, 0.0)).T
    flat = (distances[:, -1] < _WIDEST) & (across < _THICKEST)
    flat &= (narrow > _FLATTEST * across) & (narrow > _ROUNDEST * wide)
    return Planes(middles[flat], axes[flat, :, 0])
