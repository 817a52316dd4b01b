"""How well the numbers of a refined calibration are known.

The objective's slope at the solution is a sum over parts of the images. How differently these parts pull, through the
objective's curvature, is the covariance: the sandwich of M-estimators. What one part of a view shows in one frame it
shows in the next ones, too: frames of one view pull together.

Source: Huber 1967, "The behavior of maximum likelihood estimates under nonstandard conditions"; clusters: Liang and
Zeger 1986.
"""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.calibrate.refinement.cues import CHANNELS
from sceneloom.calibrate.refinement.hill import FARTHEST
from sceneloom.calibrate.refinement.search import Found
from sceneloom.kernels.aligned_maps import sum_maps

_ACROSS, _DOWN = 6, 3
_SYSTEMATIC = 0.05
"""What all parts share [units], such as shadows beside objects: 0.0125 degrees, 2.5 mm, 1 ms. With less, intervals of
simulated drives hold the truth too rarely."""


def covariance_of(found: Found, views: Int64Array) -> Float64Array:
    """Give the covariance of the free numbers, (P, P), in units.

    Args:
        views: (F,) int64, which frames show nearly the same.
    """
    reach = FARTHEST[found.free]
    pulls = cluster_slopes(found, views)
    count = int((np.abs(pulls).sum(axis=1) > 0).sum())
    spread = pulls.T @ pulls * (count / max(count - 1, 1)) + np.diag(reach**-2.0)
    systematic = np.diag(np.full(len(found.free), _SYSTEMATIC**2))
    return np.asarray(found.inverse @ spread @ found.inverse + systematic, np.float64)


def cluster_slopes(found: Found, views: Int64Array) -> Float64Array:
    """The slope of each tile of each view at the solution, (K, P)."""
    level = found.last.level
    frames = level.groups // len(CHANNELS)
    height, width = level.maps.shape[1:]
    inside = np.nan_to_num(found.last.pixels)
    across = np.clip(inside[:, 0] / width * _ACROSS, 0, _ACROSS - 1).astype(np.int64)
    down = np.clip(inside[:, 1] / height * _DOWN, 0, _DOWN - 1).astype(np.int64)
    clusters = ((views[frames] * _DOWN + down) * _ACROSS + across).astype(np.int32)
    count, free = int(clusters.max(initial=0)) + 1, len(found.free)
    slopes = np.zeros((count, free))
    weights = (level.weights * found.weights[level.groups % len(CHANNELS)]).astype(np.float32)
    sum_maps(
        found.last.pixels, found.last.slopes, np.zeros(free), weights, level.rows, clusters, level.maps,
        np.zeros(count), np.zeros(count), slopes,
    )  # fmt: skip
    return slopes
