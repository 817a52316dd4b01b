"""`fast`: the gaps between scan lines closed along columns, or along rows where that is the shorter arc.

Morphology closes a gap by widening what is known and drawing the rim back; here the two rims are joined by what lies
between them: evenly in inverse depth on one surface, evenly in depth across a jump, where that errs least. Samples are
first widened along their row to their neighbours on the scan line, so that columns meet the lines.
"""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.depth.samples import Samples
from sceneloom.depth.steepness import steepest_slope
from sceneloom.kernels.gap_filling import (
    blend_neighbours,
    fill_across,
    fill_down,
    look_up,
    widen_samples,
)

_WIDENED_PER_STEP = 0.6
"""Widening, in steps from sample to sample of a scan line: a little more than half, as steps differ."""

_USUAL_STEP_SHARE = 0.4
_THIN = 2.0
"""Up to so many rows apart samples are of one scan line, which is on its trajectory from row to row [px]."""

_LONGEST, _REACH = 3.0, 1.0
"""The longest gap that is closed, and how far the last scan line reaches, in spacings of the lines."""


@dataclass(frozen=True, slots=True, eq=False)
class Filled:
    """A dense depth image in the making.

    Attributes:
        depths: (H, W) float32 [m], 0 for none.
        trusts: (H, W) float32, 1 on one surface, 0 across a jump.
        spreads: (H, W) float32 [m], how far apart the depths are that a pixel lies between.
        gaps: (H, W) float32 [px], how far apart they are in the image.
        spacing: between scan lines [px]; 0 where there are no two.
    """

    depths: Float32Array
    trusts: Float32Array
    spreads: Float32Array
    gaps: Float32Array
    spacing: float


def close_gaps(samples: Samples, per_radian: float) -> Filled:
    """Fill the gaps between samples.

    Args:
        samples: the measured points.
        per_radian: pixels per radian.
    """
    sparse = samples.image
    locations = np.flatnonzero(sparse)
    rows, columns = np.divmod(locations, sparse.shape[1])
    widened, above, distances = (np.empty_like(sparse) for _ in range(3))
    widen_samples(sparse, _widening(rows, columns), widened)
    look_up(widened, above, distances)
    spacing, steepest = _measure(sparse, rows, columns, above, distances, per_radian)
    depths, trusts, spreads, gaps = (np.empty_like(sparse) for _ in range(4))
    longest = _LONGEST * spacing
    fill_down(widened, above, distances, longest, _REACH * spacing, steepest, depths, trusts, spreads, gaps)
    fill_across(sparse, longest, steepest, depths, trusts, spreads, gaps)
    return Filled(depths, trusts, spreads, gaps, spacing)


def blend(depths: Float32Array) -> Float32Array:
    """Average each pixel with its filled neighbours, over five pixels."""
    blended = np.empty_like(depths)
    blend_neighbours(depths, np.empty((2, depths.size), np.float32), blended)
    return blended


def _widening(rows: np.ndarray, columns: np.ndarray) -> int:
    """How far a sample is widened [px]; 0 where no two are in one row."""
    steps = np.diff(columns)[np.diff(rows) == 0]
    if len(steps) == 0:
        return 0
    at = int(_USUAL_STEP_SHARE * (len(steps) - 1))
    return max(1, round(_WIDENED_PER_STEP * float(np.partition(steps, at)[at])))


def _measure(
    sparse: Float32Array,
    rows: np.ndarray,
    columns: np.ndarray,
    above: Float32Array,
    distances: Float32Array,
    per_radian: float,
) -> tuple[float, float]:
    """Give the spacing of the scan lines [px], and the steepest slope of one surface [1/m/px]."""
    inner = rows > 0
    rows, columns = rows[inner], columns[inner]
    apart = distances[rows - 1, columns] + 1.0
    between = (apart > _THIN) & (apart < sparse.shape[0])
    rows, columns, apart = rows[between], columns[between], apart[between]
    changes = np.abs(1.0 / sparse[rows, columns] - 1.0 / above[rows - 1, columns])
    spacing = float(np.median(apart)) if len(apart) else 0.0
    return spacing, steepest_slope(changes / apart, apart, per_radian)
