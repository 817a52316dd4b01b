"""Two streams of vectors shifted against each other: how alike they are at each lag, whatever their axes."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.motion.clock.rotating import finite_rows

LEAST_OVERLAP = 0.3
"""Lags count where this share of the most samples that any lag compares lie over each other."""


_LONGEST = 3.0
"""Vectors are shortened to so many times the length that nine of ten do not reach."""

_ALIKE = 0.7
"""Autocorrelation from which a stream counts as like itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Peak:
    """One lag at which two streams look alike.

    Attributes:
        lag: steps of the grid by which the second stream is later.
        score: correlation, 0 to 1.
        margin: how far that lies above the best one at another lag, in standard deviations of what chance gives.
        rotation: (3, 3) that takes the second stream's vectors into the first's.
    """

    lag: float
    score: float
    margin: float
    rotation: Float64Array


def correlation_peaks(
    first: Float64Array,
    second: Float64Array,
    reach: int,
    *,
    centre: int = 0,
    expected: Float64Array | None = None,
    most: int = 4,
) -> list[Peak]:
    """Find the lags at which second[k + lag] is most like first[k], up to one unknown rotation and constant vectors.

    The sum of the singular values of the 3x3 correlation at a lag is the largest correlation that a rotation between
    the streams can give, so axes need not be known; a car's rotations, which are all about one axis, keep their signs.

    Args:
        first, second: (N, 3) and (M, 3), on grids of one step; rows with NaN are not known.
        reach: the farthest lag from `centre`, in steps.
        centre: the lag in the middle of those that are tried, in steps.
        expected: (3, 3) rotation to take where the motion does not report one.
        most: how many peaks at most.

    Returns:
        Peaks, the best one first; none where nothing moves or overlaps.

    Source: the correlation of masked signals is Padfield 2012, "Masked Object Registration in the Fourier Domain",
    eq. 24; the best rotation is Wahba 1965, solved by the singular values as in Markley 1988.
    """
    first, second = _tamed(first), _tamed(second)
    products, counts = _masked_correlation(first, second, centre + np.arange(-reach, reach + 1))
    usable = counts >= max(8.0, LEAST_OVERLAP * counts.max(initial=0.0))
    if not usable.any():
        return []
    products = np.where(usable[:, None, None], products, 0.0)
    singular = np.linalg.svd(products, compute_uv=False)
    handed = np.where(np.linalg.det(products) < 0, -1.0, 1.0)
    scores = singular[:, 0] + singular[:, 1] + handed * singular[:, 2]
    tops = [k for k in _tops(scores) if scores[k] > 0][:most]
    chance = _chance(first, second)
    return [
        Peak(
            k + _between(scores, k) - reach + centre,
            float(min(scores[k], 1.0)),
            _margin(scores, k, chance),
            _rotation(products[k], expected),
        )
        for k in tops
    ]


@dataclass(frozen=True, slots=True)
class _Chance:
    """How large correlations of streams are that have nothing in common.

    Attributes:
        sigma: standard deviation of the inverse hyperbolic tangent of a correlation.
        lobe: so many steps from a peak lags are still alike.
    """

    sigma: float
    lobe: int


def _chance(first: Float64Array, second: Float64Array) -> _Chance:
    """Report from how alike each stream is to itself a while later.

    Source: Bartlett 1946, "On the Theoretical Specification and Sampling Properties of Autocorrelated Time-Series":
    the variance of a correlation is the sum of the products of both autocorrelations, by the number; the inverse
    hyperbolic tangent is Fisher 1915.
    """
    own = [_autocorrelation(values) for values in (first, second)]
    size = min(map(len, own)) // 2
    product = own[0][:size] * own[1][:size]
    total = max(product[0] + 2.0 * float(product[1:].sum()), 1.0)
    count = max(min(_count(first), _count(second)) / total, 4.5)
    smooth = np.maximum(own[0][:size], own[1][:size])
    apart = np.flatnonzero(smooth < _ALIKE)
    return _Chance(float(1.0 / np.sqrt(count - 3.0)), int(apart[0]) if len(apart) else size)


def _autocorrelation(values: Float64Array) -> Float64Array:
    mask, known = _known(values)
    known = (known - known.sum(axis=0) / max(float(mask.sum()), 1.0)) * mask[:, None]
    size = 1 << int(np.ceil(np.log2(2 * len(known) + 1)))
    spectrum = np.abs(np.fft.rfft(known, size, axis=0)) ** 2
    lagged = np.fft.irfft(spectrum.sum(axis=1), size)[: len(known)]
    return np.asarray(lagged / max(float(lagged[0]), 1e-300), np.float64)


def _count(values: Float64Array) -> int:
    return int(finite_rows(values).sum())


def _margin(scores: Float64Array, k: int, chance: _Chance) -> float:
    """How far a score lies above the best one beyond its lobe."""
    lags = np.abs(np.arange(len(scores)) - k)
    others = scores[lags > 2 * chance.lobe]
    heights = np.arctanh(np.clip([scores[k], others.max(initial=0.0)], 0.0, 1 - 1e-9))
    return float((heights[0] - heights[1]) / chance.sigma)


def _tamed(values: Float64Array) -> Float64Array:
    """Vectors with those shortened that are far longer than most: single wild samples report no motion."""
    known = values[finite_rows(values)]
    if len(known) == 0:
        return values
    middle = np.median(known, axis=0)
    longest = _LONGEST * max(float(np.quantile(np.linalg.norm(known - middle, axis=1), 0.9)), 1e-12)
    lengths = np.linalg.norm(values - middle, axis=1)
    tamed: Float64Array = (
        middle + (values - middle) * np.minimum(1.0, longest / np.maximum(lengths, 1e-12))[:, None]
    )
    return tamed


def _masked_correlation(
    first: Float64Array, second: Float64Array, lags: Int64Array
) -> tuple[Float64Array, Float64Array]:
    """Give the 3x3 correlations at some lags, over what is known in both there, and how much that is."""
    mask_a, a = _known(first)
    mask_b, b = _known(second)
    size = 1 << int(np.ceil(np.log2(len(a) + len(b) + 2)))
    spectra = [np.fft.rfft(x, size, axis=0) for x in (mask_a, a, (a * a).sum(1), mask_b, b, (b * b).sum(1))]
    ones_a, sums_a, squares_a, ones_b, sums_b, squares_b = spectra

    def over(x: AnyArray, y: AnyArray) -> Float64Array:
        return np.asarray(np.fft.irfft(np.conj(x) * y, size, axis=0)[lags % size], np.float64)

    counts = np.rint(over(ones_a, ones_b))
    safe = np.maximum(counts, 1.0)
    mean_a = over(sums_a, ones_b[:, None]) / safe[:, None]
    mean_b = over(ones_a[:, None], sums_b) / safe[:, None]
    energy_a = over(squares_a, ones_b) - safe * (mean_a**2).sum(1)
    energy_b = over(ones_a, squares_b) - safe * (mean_b**2).sum(1)
    products = np.stack([over(sums_a[:, i, None], sums_b) for i in range(3)], axis=1)
    products -= safe[:, None, None] * mean_a[:, :, None] * mean_b[:, None, :]
    floor = 1e-12 * max(float((a * a).sum()), float((b * b).sum()), 1e-30)
    scale = np.sqrt(np.maximum(energy_a, floor) * np.maximum(energy_b, floor))
    return products / scale[:, None, None], counts


def _known(values: Float64Array) -> tuple[Float64Array, Float64Array]:
    known = finite_rows(values)
    return known.astype(np.float64), np.where(known[:, None], values, 0.0)


def _tops(scores: Float64Array) -> list[int]:
    """Where the scores are higher than on both sides, highest first."""
    padded = np.concatenate([[-1.0], scores, [-1.0]])
    tops = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:]))
    return [int(k) for k in tops[np.argsort(-scores[tops])]]


def _between(scores: Float64Array, k: int) -> float:
    """The top of the parabola through a highest score and its neighbours, in steps from it."""
    if not 0 < k < len(scores) - 1:
        return 0.0
    before, at, after = scores[k - 1 : k + 2]
    bend = before - 2 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def _rotation(products: Float64Array, expected: Float64Array | None) -> Float64Array:
    leaning = products + 0.02 * (np.eye(3) if expected is None else expected)
    u, _, vt = np.linalg.svd(leaning)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation: Float64Array = (u * signs) @ vt
    return rotation
