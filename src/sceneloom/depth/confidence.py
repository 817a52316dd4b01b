"""How far a completed depth can be trusted: a table, fitted to simulated drives whose depths are known exactly.

A pixel's confidence is the share of pixels like it whose depth was less than 0.5 m, or 5 %, from the truth. Alike are
pixels with the same doubt (how far apart the depths are between which the pixel lies, in units of that tolerance, of
which a twentieth counts where they are of one surface) and the same gap (in spacings of the scan lines). Both tables
fall along rows and columns. `python -m benchmarks.depth fit` makes them; the sky counts as wrong.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.depth.gaps import Filled
from sceneloom.kernels.depth_grades import grade_depths

TOLERANCE, TOLERANCE_SHARE = 0.5, 0.05
"""What counts as right: an error of less than 0.5 m, or of less than 5 % where that is more."""

SLOPE_SHARE = 0.05
DOUBT_STEPS = (0.03, 0.1, 0.3, 1.0, 2.0, 4.0, 8.0)
GAP_STEPS = (0.5, 1.1, 1.6, 2.1, 3.1, 5.1)

TABLES: Mapping[str, tuple[tuple[float, ...], ...]] = MappingProxyType(
    {
        "fast": (
            (0.973, 0.973, 0.973, 0.863, 0.863, 0.863, 0.863),
            (0.973, 0.973, 0.973, 0.817, 0.815, 0.815, 0.815),
            (0.973, 0.973, 0.947, 0.768, 0.768, 0.768, 0.768),
            (0.973, 0.893, 0.795, 0.721, 0.373, 0.373, 0.373),
            (0.973, 0.830, 0.795, 0.721, 0.373, 0.373, 0.373),
            (0.973, 0.830, 0.795, 0.721, 0.373, 0.373, 0.373),
            (0.939, 0.805, 0.795, 0.721, 0.358, 0.358, 0.358),
            (0.045, 0.045, 0.045, 0.045, 0.045, 0.045, 0.045),
        ),
        "quality": (
            (0.995, 0.995, 0.995, 0.936, 0.936, 0.936, 0.936),
            (0.992, 0.992, 0.973, 0.851, 0.851, 0.851, 0.851),
            (0.982, 0.982, 0.929, 0.830, 0.817, 0.727, 0.437),
            (0.982, 0.837, 0.814, 0.813, 0.782, 0.724, 0.437),
            (0.982, 0.837, 0.814, 0.813, 0.691, 0.691, 0.437),
            (0.982, 0.837, 0.814, 0.813, 0.691, 0.691, 0.437),
            (0.974, 0.837, 0.814, 0.813, 0.636, 0.636, 0.437),
            (0.553, 0.553, 0.428, 0.334, 0.334, 0.334, 0.334),
        ),
    }
)
"""Confidence by method, row by row of rising doubt, column by column of rising gaps."""


def grade(method: str, filled: Filled) -> Float32Array:
    """Give the confidence of each pixel, (H, W) float32, 0 to 1.

    Args:
        method: whose table counts.
        filled: what the method made.
    """
    confidence = np.empty_like(filled.depths)
    grade_depths(
        filled.depths,
        filled.trusts,
        filled.spreads,
        filled.gaps,
        max(filled.spacing, 1.0),
        TOLERANCE,
        TOLERANCE_SHARE,
        SLOPE_SHARE,
        np.array(DOUBT_STEPS, np.float32),
        np.array(GAP_STEPS, np.float32),
        np.array(TABLES[method], np.float32),
        confidence,
    )
    return confidence
