"""How far off boxes are, where their detector does not say so.

Deviations grow with size and range, σ = (share · size + least) (1 + range / scale), along the axes of the box. What a
detector tells counts instead where it is a covariance: finite, with variances above 0. The formulas are compiled:
`kernels.box_noise`.
"""

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.detections.classes import UNLISTED
from sceneloom.kernels import box_noise as columns

CENTER_SIGMAS = (0.05, 0.03)
"""Deviation of a middle along an axis of its box: this share of its size along that axis, plus so much [m].

Source: about twice the errors of PointRCNN on KITTI's sequences, on which it was trained: 0.18, 0.09 and 0.06 m along
length, width and height of cars at 15 to 30 m, 0.28, 0.19 and 0.13 m beyond 50 m.
"""
SIZE_SIGMAS = (0.06, 0.04)
"""Deviation of a size: this share of it, plus so much [m]."""
RANGE_SCALE = 60.0
"""Range at which deviations have doubled [m]."""


def _noise_table() -> Float64Array:
    row = np.empty(columns.COLUMNS)
    row[columns.CENTER_SHARE], row[columns.CENTER_LEAST] = CENTER_SIGMAS
    row[columns.SIZE_SHARE], row[columns.SIZE_LEAST] = SIZE_SIGMAS
    row[columns.RANGE_SCALE] = RANGE_SCALE
    return read_only(np.tile(row, (UNLISTED + 1, 1)))


NOISE = _noise_table()
"""(K + 1, COLUMNS) float64, a row for each class of `classes.KINDS` and a last one for whatever else there is; the
columns are those of `kernels.box_noise`."""
