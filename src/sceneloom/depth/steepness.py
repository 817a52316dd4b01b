"""How much depth changes along one surface, so that a jump can be distinguished from a slope.

With x, y the direction of a pixel (x/z, y/z of the points in it), a plane n·p = d has 1/z = n·(x, y, 1) / d. So the
inverse depth changes evenly over the image, by at most 1/d for each radian, however far away and however grazing the
plane is seen: a road 1.65 m below the camera has the slope 0.6 1/m everywhere. Steeper is only what passes the camera
nearer than that, or a jump from one thing to another.

How near surfaces pass the camera is measured: most of a street's image is ground and walls, so 0.7 of the image is
no steeper than they are. What is 1.3 times as steep is half a jump.
"""

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array
from sceneloom.depth.samples import weighted_quantile

_SURFACES = 0.7
_STEEPER = 1.2
_LEAST, _MOST = 0.5, 10.0
"""Bounds of what counts as steep [1/m/rad]: surfaces that pass the camera at 2 m are never cut apart."""

EVEN, SUDDEN = 0.85, 1.3
"""Up to 0.85 of it there is one surface; from 1.3 on there are two."""


def steepest_slope(slopes: AnyArray, weights: AnyArray, per_radian: float) -> float:
    """Give how much the inverse depth of one surface changes at most from pixel to pixel [1/m/px].

    Args:
        slopes: (N,) [1/m/px], measured ones.
        weights: (N,), how much of the image each of them is of.
        per_radian: pixels per radian.
    """
    finite = np.isfinite(slopes)
    usual = weighted_quantile(slopes[finite], weights[finite], _SURFACES)
    return float(np.clip(_STEEPER * usual * per_radian, _LEAST, _MOST)) / per_radian


def trusts_of(slopes: AnyArray, steepest: float) -> Float32Array:
    """Give 1 for slopes of one surface, 0 for jumps, and what is between for what is between."""
    jumps = np.clip((slopes / steepest - EVEN) / (SUDDEN - EVEN), 0.0, 1.0)
    return (1.0 - jumps).astype(np.float32)
