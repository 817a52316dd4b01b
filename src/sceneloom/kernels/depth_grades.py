"""The confidence of each pixel of a dense depth image, out of a table."""

import numpy as np
from numba import float32, types, void

from sceneloom.arrays import Float32Array
from sceneloom.kernels.cache import kernel

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)


@kernel(
    void(
        _IN_F32_2D, _IN_F32_2D, _IN_F32_2D, _IN_F32_2D, float32, float32, float32, float32,
        _IN_F32_1D, _IN_F32_1D, _IN_F32_2D, float32[:, ::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def grade_depths(
    depths: Float32Array,
    trusts: Float32Array,
    spreads: Float32Array,
    gaps: Float32Array,
    spacing: float,
    tolerance: float,
    tolerance_share: float,
    slope_share: float,
    doubt_steps: Float32Array,
    gap_steps: Float32Array,
    table: Float32Array,
    confidence: Float32Array,
) -> None:
    """Look up the confidence of each pixel by its doubt and its gap.

    The doubt is the spread of the depths around the pixel, in tolerances; where these are of one surface, only
    `slope_share` of it counts.

    Args:
        depths: (H, W) [m], 0 for none, which has no confidence.
        trusts: (H, W), 1 on one surface, 0 across a jump.
        spreads: (H, W) [m].
        gaps: (H, W) [px].
        spacing: [px], the unit of the gaps.
        tolerance: [m], or …
        tolerance_share: … this share of the depth where that is more.
        slope_share: of the spread on one surface.
        doubt_steps: (D - 1,) rising, the borders of the table's rows.
        gap_steps: (G - 1,) rising, the borders of its columns.
        table: (D, G).
        confidence: (H, W), written.
    """
    height, width = depths.shape
    one = np.float32(1)
    for row in range(height):
        for column in range(width):
            depth = depths[row, column]
            if not depth > 0:
                confidence[row, column] = 0
                continue
            allowed = max(tolerance, tolerance_share * depth)
            share = one - trusts[row, column] * (one - slope_share)
            doubt, gap = share * spreads[row, column] / allowed, gaps[row, column] / spacing
            d, g = 0, 0
            for k in range(doubt_steps.shape[0]):
                d += doubt >= doubt_steps[k]
            for k in range(gap_steps.shape[0]):
                g += gap >= gap_steps[k]
            confidence[row, column] = table[d, g]
