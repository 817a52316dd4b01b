"""How far off boxes are, where their detector does not say so.

Deviations along the axes of a box and of its sizes fall with the score and grow with the range,

    σ = exp(base + by_score x + by_range log(range / 20 m)),

fitted for each class (`detectors.BoxNoise`); a class without numbers of its own has those of its family, in proportion
to its usual size. What a detector tells counts instead where it is a covariance: finite, with variances above 0. The
formulas are compiled: `kernels.box_noise`.

Errors have heavier tails than a Gaussian's: one car in twenty is longer by half a metre than the box of its visible
half. So the matrices go with a Student distribution of `Detectors.degrees_of_freedom` ν: the region that holds the
share p of the errors e is eᵀ C⁻¹ e <= 3 F (ν - 2) / ν, F the quantile of the F distribution with 3 and ν.
"""

import math

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.detections.classes import KINDS
from sceneloom.detections.detectors import ClassStatistics, Detectors
from sceneloom.detections.existence import statistics_of
from sceneloom.kernels import box_noise as columns


def noise_table(detectors: Detectors) -> Float64Array:
    """Give how far off boxes are as the compiled formulas take it.

    Returns:
        (K + 1, COLUMNS) float64, a row for each class of `classes.KINDS` and a last one for whatever else there is; the
        columns are those of `kernels.box_noise`.
    """
    rows = [_row(statistics_of(detectors, name), _growth(detectors, name)) for name in (*KINDS, "")]
    return read_only(np.array(rows))


def _growth(detectors: Detectors, name: str) -> Float64Array:
    """Logarithms of how much larger a class is than the one whose numbers it has, along each axis."""
    own = statistics_of(detectors, name)
    source = next(other for other, statistics in detectors.classes.items() if statistics is own)
    if name not in KINDS or source not in KINDS or name in detectors.classes:
        return np.zeros(3)
    growth: Float64Array = np.log(np.array(KINDS[name].size_lwh) / np.array(KINDS[source].size_lwh))
    return growth


def _row(own: ClassStatistics, growth: Float64Array) -> Float64Array:
    noise, row = own.noise, np.empty(columns.COLUMNS)
    row[columns.LOW], row[columns.HIGH] = noise.scores
    for first, (centers, sizes, yaw) in (
        (columns.BASE, (noise.center_base + growth, noise.size_base + growth, noise.yaw[0])),
        (columns.BY_SCORE, (noise.center_by_score, noise.size_by_score, noise.yaw[1])),
        (columns.BY_RANGE, (noise.center_by_range, noise.size_by_range, noise.yaw[2])),
    ):
        row[first : first + 7] = *centers, *sizes, yaw
    row[columns.AGREED : columns.AGREED + 2] = noise.agreed
    told = own.picture_noise
    row[columns.PICTURE : columns.PICTURE + 6] = *told.across, *told.upright, *told.height
    return row


def picture_sigmas(table: Float64Array, kinds: Int64Array, *, added_px: float = 0.0) -> Float64Array:
    """Give how far off boxes of pictures are, (N, 6), by the rows of the table.

    Args:
        added_px: deviation of places in the picture by a calibration that is not exact [px].
    """
    sigmas: Float64Array = table[kinds, columns.PICTURE :]
    if added_px > 0.0:
        for column in (0, 2):
            sigmas[:, column] = np.sqrt(sigmas[:, column] ** 2 + added_px**2)
    return sigmas


def radius_squared(level: float, *, degrees_of_freedom: float, dimensions: int = 3) -> float:
    """Give how large eᵀ C⁻¹ e is on the border of the region that holds a share of the errors e.

    Args:
        level: the share, 0 to 1.
        degrees_of_freedom: of `Detectors`, more than 2; infinite for a Gaussian.
        dimensions: of e.

    Source: Kotz and Nadarajah 2004, "Multivariate t Distributions and Their Applications", section 1.7.
    """
    from scipy import stats

    if math.isinf(degrees_of_freedom):
        return float(stats.chi2.ppf(level, dimensions))
    share = (degrees_of_freedom - 2.0) / degrees_of_freedom
    return float(dimensions * stats.f.ppf(level, dimensions, degrees_of_freedom) * share)
