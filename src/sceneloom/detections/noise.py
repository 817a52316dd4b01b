"""How far off boxes are, where their detector does not report it.

Deviations along the axes of a box and of its sizes fall with the score and grow with the range,

    σ = exp(base + by_score x + by_range log(range / 20 m)),

fitted for each class (`detectors.BoxNoise`); a class without numbers of its own has those of its family, in proportion
to its usual size. What a detector reports counts instead where it is a covariance: finite, with variances
above 0.

Errors have heavier tails than a Gaussian's: one car in twenty is longer by half a metre than the box of its visible
half. So the matrices go with a Student distribution of `Detectors.degrees_of_freedom` ν: the region that holds the
share p of the errors e is eᵀ C⁻¹ e <= 3 F (ν - 2) / ν, F the quantile of the F distribution with 3 and ν.
"""

import math

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, read_only
from sceneloom.detections.classes import KINDS
from sceneloom.detections.detectors import ClassStatistics, Detectors
from sceneloom.detections.existence import statistics_of

LOW, HIGH, BASE = 0, 1, 2
"""The first columns of the table: how low and how high scores count, as logarithms of odds, and the logarithms of the
deviations of x, y, z along the axes of the box, length, width, height [m] and heading [rad], at score 0 and `USUAL`."""
BY_SCORE, BY_RANGE = BASE + 7, BASE + 14
"""How much those grow with the score, and with the logarithm of the range, seven columns each."""
AGREED = BASE + 21
"""By how much the covariances of middle and size of a box with a partner in the image are multiplied."""
IMAGE = AGREED + 2
"""Deviations of the partner in the image: of its middle across, of its middle upright and of its height, in pixels
and beside that as a share of its own size there, six columns."""
COLUMNS = IMAGE + 6

USUAL = 20.0
"""The range at which `BASE` holds [m]."""
NEAREST = 5.0
"""What is nearer counts as so far away [m]."""


def noise_table(detectors: Detectors) -> Float64Array:
    """Give how far off boxes are as `box_covariances` takes it.

    Returns:
        (K + 1, COLUMNS) float64, a row for each class of `classes.KINDS` and a last one for whatever else there is; the
        columns are those named above.
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
    noise, row = own.noise, np.empty(COLUMNS)
    row[LOW], row[HIGH] = noise.scores
    for first, (centers, sizes, yaw) in (
        (BASE, (noise.center_base + growth, noise.size_base + growth, noise.yaw[0])),
        (BY_SCORE, (noise.center_by_score, noise.size_by_score, noise.yaw[1])),
        (BY_RANGE, (noise.center_by_range, noise.size_by_range, noise.yaw[2])),
    ):
        row[first : first + 7] = *centers, *sizes, yaw
    row[AGREED : AGREED + 2] = noise.agreed
    reported = own.image_noise
    row[IMAGE : IMAGE + 6] = *reported.across, *reported.upright, *reported.height
    return row


def image_sigmas(table: Float64Array, kinds: Int64Array, *, added_px: float = 0.0) -> Float64Array:
    """Give how far off boxes of images are, (N, 6), by the rows of the table.

    Args:
        added_px: deviation of locations in the image by a calibration that is not exact [px].
    """
    sigmas: Float64Array = table[kinds, IMAGE:]
    if added_px > 0.0:
        for column in (0, 2):
            sigmas[:, column] = np.sqrt(sigmas[:, column] ** 2 + added_px**2)
    return sigmas


def box_covariances(
    boxes: Float64Array,
    scores: Float64Array,
    reported: Float64Array,
    rows: Int64Array,
    kinds: Int64Array,
    table: Float64Array,
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Give the covariances of middles and sizes, and the variances of headings.

    Args:
        boxes: (N, 7), middle, size [m] and heading [rad], in the frame of the sensor.
        scores: (N,), logarithms of odds as the detector reports them; NaN for no numbers.
        reported: what the detector reports, (A, 7, 7) of all of its boxes, or (0, 7, 7).
        rows: (N,), which of them these are.
        kinds: (N,), rows of the table.
        table: (K, COLUMNS).

    Returns:
        (N, 6, 6) float64 [m²]: middle in the frame of the boxes, then length, width, height; (N,) float64 [rad²], and
        (N,) bool, whether they are the detector's own.
    """
    distances = np.sqrt((boxes[:, :3] ** 2).sum(axis=1))
    variances = _sigmas(distances, scores, table[kinds]) ** 2
    along, across, of_yaws = variances[:, 0], variances[:, 1], variances[:, 6].copy()
    cosines, sines = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    found, own = np.zeros((len(boxes), 6, 6)), np.zeros(len(boxes), np.bool_)
    found[:, 0, 0] = along * cosines * cosines + across * sines * sines
    found[:, 1, 1] = along * sines * sines + across * cosines * cosines
    found[:, 0, 1] = found[:, 1, 0] = (along - across) * cosines * sines
    for k in range(2, 6):
        found[:, k, k] = variances[:, k]
    if len(reported):
        # halves first: no sum of finite numbers is infinite then
        halves = reported[rows, :6, :6] / 2.0
        symmetric = halves + halves.transpose(0, 2, 1)
        own = _are_covariances(symmetric)
        found[own] = symmetric[own]
        yaws_reported = reported[rows, 6, 6]
        known = own & (yaws_reported > 0.0) & np.isfinite(yaws_reported)
        of_yaws[known] = yaws_reported[known]
    return found, of_yaws, own


def _sigmas(distances: Float64Array, scores: Float64Array, numbers: Float64Array) -> Float64Array:
    """Deviations (N, 7) of boxes; one whose score is no number is as uncertain as the lowest."""
    low, high = numbers[:, LOW], numbers[:, HIGH]
    held = np.where(np.isnan(scores), low, np.clip(scores, low, high))
    far = np.log(np.maximum(distances, NEAREST) / USUAL)
    base, by_score, by_range = (numbers[:, first : first + 7] for first in (BASE, BY_SCORE, BY_RANGE))
    sigmas: Float64Array = np.exp(base + by_score * held[:, None] + by_range * far[:, None])
    return sigmas


def _are_covariances(matrices: Float64Array) -> BoolArray:
    """Report which symmetric matrices are finite and positive definite."""
    good: BoolArray = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    for k in np.flatnonzero(good):
        try:
            np.linalg.cholesky(matrices[k])
        except np.linalg.LinAlgError:
            good[k] = False
    return good


def widen_agreed(
    covariances: Float64Array, partners: Int64Array, own: BoolArray, kinds: Int64Array, table: Float64Array
) -> None:
    """Multiply the covariances of boxes with a partner.

    The update makes them as small as if both sensors erred independently.

    Args:
        covariances: (N, 6, 6), of middles and sizes; changed.
        partners: (N,), -1 for none.
        own: (N,), those of a detector that knows them stay.
        kinds: (N,), rows of the table.
        table: (K, COLUMNS).
    """
    widened: Int64Array = np.flatnonzero((partners >= 0) & ~own)
    factors = np.sqrt(np.repeat(table[kinds[widened], AGREED : AGREED + 2], 3, axis=1))
    covariances[widened] *= factors[:, :, None] * factors[:, None]


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
