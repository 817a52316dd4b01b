"""The offset and skew between two streams, by rotation or by position."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.polynomial.legendre import legvander

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.geometry.rotations import matrix_from_quaternion, quaternion_from_rotation_vector
from sceneloom.motion.clock.estimate import (
    LEAST_MARGIN,
    Candidate,
    ClockEstimate,
    Clocks,
    ambiguous,
    concluded,
    misfit_without_motion,
)
from sceneloom.motion.clock.fitting import Fit, Linearised, bare_slopes, fit, misfit_of
from sceneloom.motion.clock.signals import (
    Fixes,
    Rotating,
    RotationCurve,
    SmoothedTrajectory,
    Steps,
    TrajectorySamples,
    finite_rows,
    rate_noise,
    steps_of,
)

_LEAST_OVERLAP = 0.3
"""Lags count where this share of the most samples that any lag compares lie over each other."""

_LONGEST = 3.0
"""Vectors are shortened to so many times the length that nine of ten do not reach."""

_ALIKE = 0.7
"""Autocorrelation from which a stream counts as like itself."""


@dataclass(frozen=True, slots=True, eq=False)
class _Peak:
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


def _correlation_peaks(
    first: Float64Array,
    second: Float64Array,
    reach: int,
    *,
    centre: int = 0,
    expected: Float64Array | None = None,
    most: int = 4,
) -> list[_Peak]:
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
    usable = counts >= max(8.0, _LEAST_OVERLAP * counts.max(initial=0.0))
    if not usable.any():
        return []
    products = np.where(usable[:, None, None], products, 0.0)
    singular = np.linalg.svd(products, compute_uv=False)
    handed = np.where(np.linalg.det(products) < 0, -1.0, 1.0)
    scores = singular[:, 0] + singular[:, 1] + handed * singular[:, 2]
    tops = [k for k in _tops(scores) if scores[k] > 0][:most]
    chance = _chance(first, second)
    return [
        _Peak(
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


@dataclass(frozen=True, slots=True)
class _Line:
    """An offset [s] in the middle, and how much it grows in a second."""

    offset: float
    slope: float


_STEEPEST = 1e-3
"""No clock is off by more; steeper lines go through wrong lags."""


def _robust_line(times: Float64Array, offsets: Float64Array) -> _Line:
    """Lay a line through offsets (N,) [s] at times (N,) [s], of which nearly half may be wrong.

    Source: Siegel 1982, "Robust Regression Using Repeated Medians"; of its slopes those of clocks count.
    """
    slopes = [
        (offsets[j] - offsets[i]) / (times[j] - times[i])
        for i, j in combinations(range(len(times)), 2)
        if abs(offsets[j] - offsets[i]) <= _STEEPEST * abs(times[j] - times[i]) + 1e-12
    ]
    slope = float(np.median(slopes)) if slopes else 0.0
    levels = offsets - slope * times
    return _Line(float(_densest(levels)), slope)


def _densest(values: Float64Array) -> float:
    """The median of the half that lies closest together. Source: Rousseeuw 1984, least median of squares."""
    ordered = np.sort(values)
    half = len(ordered) // 2 + 1
    widths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    begin = int(np.argmin(widths))
    return float(np.median(ordered[begin : begin + half]))


REACH_NS = 5_000_000_000
"""Offsets up to this are looked for [ns]."""

_LEAST_COMMON = 2.0
"""Seconds that two streams need in common."""

_MOST_COMMON = 86_400.0
"""No drive is longer [s]: wrong times of both are not to be searched in millions of parts."""

_GRID = 0.02
"""Step of the coarse search [s]; rotates of bodies that people and cars carry are slower."""

_PART = 120.0
"""Seconds that are searched at once: a clock that is 200 ppm too fast moves 24 ms on in them."""

_BIAS_WINDOW = 60.0
"""A gyroscope's bias is one constant for so many seconds."""

_STEPS = (0.05, 0.1, 0.2, 0.4)
"""Rotations over at least so many seconds are compared, the shortest that the noise allows [s]."""

_NOISE_SHARE = 0.1
"""Of the rates' changes between start and stop of a rotation at most this share may be noise."""

_FAR_LESS = 4.0
"""Lags whose correlation lacks so many times more of 1 than that of the best are left aside."""

_PRIORS = np.array([10.0, 2e-3, 0.7, 0.7, 0.7])
"""How far offset [s], skew and rotation [rad] may be from the start."""


def compare_turnings(
    reference: Rotating,
    stream: Rotating,
    *,
    reach_ns: int = REACH_NS,
    reference_from_stream: Float64Array | None = None,
) -> ClockEstimate:
    """Find the offset and the skew of a stream's clock from the rotating that two streams report.

    The streams may have any rates and gaps, their bodies any constant rotation between them, and either a constant
    bias. First the lag is searched at which the yaw rates are most alike; then rotates from sample to sample of the
    slower stream are fitted by those of the other one between the same times, with offset, skew, rotation and bias
    free at once.

    Args:
        reference: the stream whose clock is taken for the right one.
        stream: the other one.
        reach_ns: offsets up to this are looked for [ns].
        reference_from_stream: (3, 3), the rotation between the bodies as far as it is known; the motion decides
            where it reports.

    Source: the rate correlation before the fit, and the continuous-time fit of offset with the rotation, are as in
    Furgale, Rehder and Siegwart 2013, "Unified Temporal and Spatial Calibration for Multi-Sensor Systems".
    """
    if min(len(reference), len(stream)) < 8:
        return ClockEstimate.unknown(
            f"{len(reference)} and {len(stream)} samples of rotating; expected 8 or more of each"
        )
    finer_is_stream = stream.step_ns <= reference.step_ns
    coarse, fine = (reference, stream) if finer_is_stream else (stream, reference)
    expected = np.eye(3) if reference_from_stream is None else reference_from_stream
    pair = _Pair.of(coarse, fine, expected if finer_is_stream else expected.T)
    clocks = Clocks(pair.origin_ns, finer_is_stream)
    if not pair.fine or pair.common < _LEAST_COMMON:
        return ClockEstimate.unknown(
            f"{max(pair.common, 0.0):.1f} s in common; expected {_LEAST_COMMON:.0f} s or more without gaps"
        )
    if pair.common > _MOST_COMMON:
        return ClockEstimate.unknown(
            f"{pair.common:.6g} s in common; expected at most {_MOST_COMMON:.0f}: is a time wrong?"
        )
    starts = list(pair.starts(reach_ns * 1e-9))
    if not starts:
        return ClockEstimate.unknown("nothing rotates in both at once")
    if max(peak.margin for _, peak in starts) < LEAST_MARGIN:
        lags = [clocks.sign * line.offset for line, _ in starts]
        return ClockEstimate.unknown(ambiguous(lags), span_ns=round(pair.common * 1e9))
    candidates = [candidate for line, peak in starts if (candidate := pair.fitted(line, peak)) is not None]
    return concluded(candidates, clocks)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """The slower stream as rotates, the other as a curve, both in seconds after one origin."""

    origin_ns: int
    coarse: Rotating
    fine: RotationCurve
    coarse_curve: RotationCurve
    fine_noise: Float64Array
    expected: Float64Array
    grid: float
    span: tuple[float, float]

    @classmethod
    def of(cls, coarse: Rotating, fine: Rotating, coarse_from_fine: Float64Array) -> "_Pair":
        origin_ns = int(max(coarse.timestamps_ns[0], fine.timestamps_ns[0]))
        grid = max(_GRID, coarse.step_ns * 1e-9)
        curves = RotationCurve(fine, origin_ns), RotationCurve(coarse, origin_ns)
        ends = min(int(coarse.timestamps_ns[-1]), int(fine.timestamps_ns[-1]))
        return cls(
            origin_ns,
            coarse,
            *curves,
            rate_noise(fine),
            coarse_from_fine,
            grid,
            (0.0, (ends - origin_ns) * 1e-9),
        )

    @property
    def common(self) -> float:
        """Seconds in which there are samples of both, by their timestamps."""
        return self.span[1] - self.span[0]

    def starts(self, reach: float) -> Iterator[tuple[_Line, _Peak]]:
        """Offsets to begin with: the best lags of a short drive, a line through those of the parts of a long one."""
        reach = min(reach, max(self.common / 2, 4 * self.grid))
        if self.common <= 2.5 * _PART:
            peaks = self._peaks(*self.span, reach)
            for peak in peaks:
                # what is far less alike than the best one needs no fit to be distinguished from it
                if 1 - peak.score > _FAR_LESS * (1 - peaks[0].score) + 0.1:
                    break
                yield _Line(peak.lag * self.grid, 0.0), peak
            return
        count = int(self.common // _PART)
        edges = np.linspace(*self.span, count + 1)
        found = [
            (0.5 * (a + b), peak)
            for a, b in pairwise(edges.tolist())
            for peak in self._peaks(a, b, reach)[:1]
        ]
        if len(found) >= 2:
            times = np.array([time for time, _ in found]) - 0.5 * self.common
            lags = np.array([peak.lag * self.grid for _, peak in found])
            best = max((peak for _, peak in found), key=lambda peak: peak.margin)
            yield _robust_line(times, lags), best

    def _peaks(self, begin: float, end: float, reach: float) -> list[_Peak]:
        edges = np.arange(begin, end, self.grid)
        wide = np.arange(begin - np.ceil(reach / self.grid) * self.grid, end + reach, self.grid)
        first = self.coarse_curve.rotations(edges[:-1], edges[1:]) / self.grid
        second = self.fine.rotations(wide[:-1], wide[1:]) / self.grid
        shift = round((begin - wide[0]) / self.grid)
        steps = int(reach / self.grid)
        peaks = _correlation_peaks(first, second, steps, centre=shift, expected=self.expected)
        return [replace(peak, lag=peak.lag - shift) for peak in peaks]

    def fitted(self, line: _Line, peak: _Peak) -> Candidate | None:
        """Refine an offset over rotates that are as short as the noise allows."""
        own = self.coarse.step_ns * 1e-9
        start = np.array([line.offset, line.slope, 0.0, 0.0, 0.0])
        chosen: tuple[_RotatingModel, Fit] | None = None
        for least in (0.0, *(step for step in _STEPS if step > own)):
            steps = steps_of(self.coarse, self.origin_ns, least)
            if len(steps) < 16 and chosen is not None:
                break
            if len(steps) == 0:
                break
            model = _RotatingModel(self, steps, peak.rotation)
            found = fit(model, start, _PRIORS, model.windows, whiten=False)
            if found is None:
                break
            chosen, start = (model, found), found.parameters
            if model.noise_share(found) <= _NOISE_SHARE:
                break
        if chosen is None:
            return None
        model, found = chosen
        whitened = fit(model, found.parameters, _PRIORS, model.windows)
        return None if whitened is None else model.candidate(whitened, peak)


class _RotatingModel:
    """Rotates of the slower stream, reported by the curve of the other one: offset, skew, three of rotation."""

    def __init__(self, pair: _Pair, steps: Steps, coarse_from_fine: Float64Array) -> None:
        self.pair, self.steps, self.rotation = pair, steps, coarse_from_fine
        self.middle = 0.5 * sum(pair.span)
        self.lengths = steps.stops - steps.starts
        self.times = 0.5 * (steps.starts + steps.stops) - self.middle
        self.smoothing = float(np.clip(np.median(self.lengths), 0.02, 0.4))
        self.vectors = steps.mean(steps.vectors)
        self.nuisances = steps.mean(self.lengths)[:, None, None] * np.eye(3)
        self.row_times = steps.mean(self.times) + self.middle
        count = max(1, round(pair.common / _BIAS_WINDOW))
        parts = np.clip((self.row_times / max(pair.common, 1e-9) * count).astype(np.int64), 0, count - 1)
        self.windows = _numbered(parts, steps.chunks)

    def __call__(self, parameters: Float64Array, amounts: Float64Array) -> Linearised:
        del amounts  # the biases are linear
        offset, skew = parameters[:2]
        rotation = self.rotated(parameters)
        shifts = offset + skew * self.times
        starts, stops = self.steps.starts + shifts, self.steps.stops + shifts
        reported = self.pair.fine.rotations(starts, stops)
        before = self.pair.fine.rates(starts, self.smoothing)
        after = self.pair.fine.rates(stops, self.smoothing)
        slope = after - before + 0.5 * np.cross(reported, before + after)
        reported, slope, drift = (self.steps.mean(x) for x in (reported, slope, slope * self.times[:, None]))
        known = finite_rows(np.hstack([reported, slope]))
        moved, slope, drift = (
            np.where(known[:, None], x, 0.0) @ rotation.T for x in (reported, slope, drift)
        )
        jacobian = np.concatenate([slope[:, :, None], drift[:, :, None], -_crossing(moved)], axis=2)
        return Linearised(self.vectors - moved, jacobian, self.nuisances, known)

    def rotated(self, parameters: Float64Array) -> Float64Array:
        """The rotation (3, 3) from the finer stream's body into the other's."""
        rotation = matrix_from_quaternion(quaternion_from_rotation_vector(parameters[2:5]))
        return np.asarray(rotation @ self.rotation, np.float64)

    def noise_share(self, found: Fit) -> float:
        """How much of the rates' changes is noise of the finer stream.

        It is no more than what is left over, and no more than what single samples of the stream jump about.
        """
        at = self(found.parameters, found.amounts)
        if not found.used.any():
            return 0.0
        changes = at.jacobian[found.used, :, 0]
        left = at.residuals[found.used] - np.einsum(
            "nkm,nm->nk", at.nuisances[found.used], found.amounts[self.windows[found.used]]
        )
        of_residuals = (1.4826 * np.median(np.abs(left), axis=0) / self.smoothing) ** 2
        noise = 2.0 * np.minimum(of_residuals, self.pair.fine_noise / self.smoothing)
        return float(noise.sum() / max(float((changes**2).mean(axis=0).sum()), 1e-300))

    def candidate(self, found: Fit, peak: _Peak) -> Candidate:
        """The fit with what is needed to judge it."""
        return Candidate(
            fit=found,
            times=self.row_times,
            middle=self.middle,
            span=self.pair.common,
            without_motion=misfit_without_motion(found, self.windows, lambda: self._still(found)),
            score=peak.score,
            margin=peak.margin,
            rotation=self.rotated(found.parameters),
        )

    def _still(self, found: Fit) -> Linearised:
        """The same rotations, reported by biases alone."""
        return replace(self(found.parameters, found.amounts), residuals=self.vectors)


def _numbered(parts: Int64Array, chunks: Int64Array) -> Int64Array:
    """Number windows, a new one wherever the part or the piece changes."""
    changes = np.zeros(len(parts), np.int64)
    changes[1:] = (np.diff(parts) != 0) | (np.diff(chunks) != 0)
    return np.cumsum(changes)


def _crossing(vectors: Float64Array) -> Float64Array:
    """(N, 3, 3) matrices of the cross products with (N, 3) vectors."""
    zero = np.zeros(len(vectors))
    x, y, z = vectors.T
    return np.stack(
        [np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], axis=1
    )


_LEAST_FIXES = 12

_TRAJECTORY_CLOCK_LEAST_COMMON = 5.0
"""Seconds that two streams need in common."""

_LAG = 0.2
"""Step of the search [s]; from so near the fit finds its trajectory."""

_MOST_SEARCHED = 3000
"""Fixes of a long drive that are looked at in the search, and for the biases of an IMU; the last fit is to all."""

LEVER_SIGMA = 1.0
"""How far from the ego's origin a receiver's antenna may be on each axis, where nothing is stated [m]."""

_LEAST_SHARE = 0.01
"""Where less of the speed reports the offset, errors of the trajectory do that.

On synthetic streets it is a tenth to a half.
"""

_TRAJECTORY_CLOCK_FAR_LESS = 100.0
"""Offsets that are less likely than the best by so much in the logarithm are not looked at any further."""

_FAR = 1.0
"""Longer windows notify an offset better, not another one [s]."""

_MOST_WORSE = 0.15
"""Logarithm of how much more may be left of the fixes over longer windows.

There a bad IMU is not reported by its noise.
"""

_TRAJECTORY_CLOCK_PRIORS = (10.0, 2e-3)
"""How far offset [s] and skew may be from the start."""


def compare_trajectories(
    fixes: Fixes,
    trajectory: SmoothedTrajectory,
    *,
    origin_ns: int,
    fixes_are_reference: bool,
    reach_ns: int,
    lever: Float64Array | None = None,
    lever_sigma: float = LEVER_SIGMA,
) -> ClockEstimate:
    """Find the offset and the skew between fixes and a way of the same body.

    The fixes are the trajectory at their times, shifted by the offset, but for what the trajectory does not know: in
        every window
    of half a minute a rotation and a scale on the ground, and a polynomial in the time. What the body's speed changes
    beyond that reports the offset. The location of the receiver on the body is estimated along; where the body rotates,
    or goes on at one speed, that alone keeps the offset from being known better.

    Args:
        fixes: locations at some times.
        trajectory: what moves between them.
        origin_ns: where the trajectory's seconds count from.
        fixes_are_reference: which of both clocks is taken for the right one.
        reach_ns: offsets up to this are looked for [ns].
        lever: (3,) where on the body of the trajectory the fixes are of [m]; None for its origin.
        lever_sigma: how far from there they may be on each axis [m].

    Source: linear amounts are eliminated as in Golub and Pereyra 1973, "The Differentiation of Pseudo-Inverses and
    Nonlinear Least Squares Problems Whose Variables Separate".
    """
    if len(fixes) < _LEAST_FIXES:
        return ClockEstimate.unknown(f"{len(fixes)} fixes; expected {_LEAST_FIXES} or more")
    model = _TrajectoryModel.of(fixes, trajectory, origin_ns)
    clocks = Clocks(origin_ns, finer_is_stream=fixes_are_reference)
    known = model.known_at(0.0)
    common = float(np.ptp(model.times[known])) if known.any() else 0.0
    if known.sum() < _LEAST_FIXES or common < _TRAJECTORY_CLOCK_LEAST_COMMON:
        return ClockEstimate.unknown(
            f"{int(known.sum())} fixes in {common:.1f} s in common; expected {_LEAST_FIXES} in "
            f"{_TRAJECTORY_CLOCK_LEAST_COMMON:.0f} s "
            "or more"
        )
    priors = np.array([*_TRAJECTORY_CLOCK_PRIORS, *[max(lever_sigma, 1e-6)] * 3])
    location = np.zeros(3) if lever is None else lever
    reach = min(reach_ns * 1e-9, common / 2)
    part = model.part(_MOST_SEARCHED)
    found = [
        near
        for lag in _lags(part, reach)
        if (near := fit(part, np.array([lag, 0.0, *location]), priors, part.windows)) is not None
        and abs(near.parameters[0]) <= reach + 2 * _LAG
    ]
    if not found:
        return ClockEstimate.unknown(f"no offset up to {reach:.1f} s makes the motions alike")
    best = min(found, key=lambda near: near.level)
    refined = [
        _refined(part, near, fixes, location, priors)
        for near in found
        if best.evidence_against(near) < _TRAJECTORY_CLOCK_FAR_LESS
    ]
    reported = sorted((one for one in refined if one is not None), key=lambda one: one[1].level)
    if reported and _share_reported(*reported[0]) < _LEAST_SHARE:
        return ClockEstimate.unknown(
            "the motion is too even: another offset is like another location and heading"
        )
    return concluded([_candidate(*one, common) for one in reported], clocks)


def _share_reported(model: "_TrajectoryModel", found: Fit) -> float:
    """How much of the speed reports the offset, as nothing else that is free does."""
    reported = bare_slopes(model, found, model.windows)[:, :, 0] ** 2
    length = model.bounds[0][1] - model.bounds[0][0]
    # of an even motion over a window the locations scatter so
    speed = float(np.sqrt(12.0 * (np.abs(model.locations) ** 2).mean())) / length
    return float(np.sqrt(reported.sum(axis=1).mean())) / max(speed, 1e-9)


def _refined(
    part: "_TrajectoryModel", near: Fit, fixes: Fixes, location: Float64Array, priors: Float64Array
) -> tuple["_TrajectoryModel", Fit] | None:
    """Fit the trajectory over longer windows, where it has them and they report the fixes as well as the short ones.

    Args:
        part: the windows that are looked at in the search; which way is taken is decided by so many of them.
        near: the fit to it.
    """
    start = np.array([near.parameters[0], 0.0, *location])
    at, found, begin = part, near, None
    while (trajectory := at.trajectory.finer(at.drifts_of(found.amounts))) is not None:
        longer = _TrajectoryModel.of(fixes, trajectory, part.origin_ns).part(_MOST_SEARCHED)
        better = fit(longer, start, priors, longer.windows, begin=begin)
        if better is None or abs(better.parameters[0] - near.parameters[0]) > _FAR:
            at, found = part, near
            break
        at, found, begin = longer, better, better.parameters
    if float(np.log(found.scales / near.scales).mean()) >= _MOST_WORSE:
        at, found = part, near
    whole = _TrajectoryModel.of(fixes, at.trajectory, part.origin_ns)
    if len(whole.times) == len(at.times):
        return at, found
    last = fit(whole, start, priors, whole.windows, begin=found.parameters)
    return None if last is None else (whole, last)


@dataclass(frozen=True, slots=True, eq=False)
class _TrajectoryModel:
    """Fixes reported by a trajectory: offset, skew, and three numbers of where the one body is on the other."""

    locations: AnyArray
    times: Float64Array
    windows: AnyArray
    bounds: tuple[tuple[float, float], ...]
    polynomials: Float64Array
    trajectory: SmoothedTrajectory
    middle: float
    origin_ns: int

    @classmethod
    def of(cls, fixes: Fixes, trajectory: SmoothedTrajectory, origin_ns: int) -> "_TrajectoryModel":
        """Cut the fixes into windows."""
        times = np.asarray((fixes.timestamps_ns - origin_ns) * 1e-9, np.float64)
        span = float(times[-1] - times[0])
        count = max(1, round(span / trajectory.window))
        length = span / count
        numbers = np.clip(np.floor((times - times[0]) / length), 0, count - 1).astype(np.int64)
        present, windows = np.unique(numbers, return_inverse=True)
        begin = float(times[0])
        bounds = tuple((begin + k * length, begin + (k + 1) * length) for k in present.tolist())
        begins, ends = np.array(bounds)[windows].T
        polynomials = legvander(2 * (times - begins) / (ends - begins) - 1, trajectory.degree)
        # the middle of each window's locations is taken off: kilometres leave no digits for millimetres
        sums = np.zeros(len(bounds), np.complex128)
        np.add.at(sums, windows, fixes.locations)
        locations = fixes.locations - (sums / np.bincount(windows))[windows]
        return cls(
            locations,
            times,
            windows,
            bounds,
            polynomials,
            trajectory,
            0.5 * float(times[0] + times[-1]),
            origin_ns,
        )

    def part(self, most: int) -> "_TrajectoryModel":
        """Some of the windows, spread over the drive, with about so many fixes; all where there are no more."""
        if len(self.times) <= most:
            return self
        every = -(-len(self.times) // most)
        chosen = np.unique(self.windows)[::every]
        rows = np.isin(self.windows, chosen)
        windows = np.searchsorted(chosen, self.windows[rows])
        bounds = tuple(self.bounds[k] for k in chosen.tolist())
        return _TrajectoryModel(
            self.locations[rows],
            self.times[rows],
            windows,
            bounds,
            self.polynomials[rows],
            self.trajectory,
            self.middle,
            self.origin_ns,
        )

    def drifts_of(self, amounts: Float64Array) -> Float64Array:
        """The amounts of the trajectory's drifts (W, E) among those of all nuisances."""
        return amounts[:, 2 * (self.trajectory.degree + 1) : -2]

    def known_at(self, lag: float) -> AnyArray:
        """Which fixes the trajectory reports, (N,) bool."""
        return np.isfinite(self._trajectory(np.full(len(self.times), lag)).locations)

    def _trajectory(self, shifts: Float64Array) -> TrajectorySamples:
        edges = np.searchsorted(self.windows, np.arange(len(self.bounds) + 1))
        parts = [
            self.trajectory.at(self.bounds[k], (self.times + shifts)[edges[k] : edges[k + 1]])
            for k in range(len(self.bounds))
        ]
        return TrajectorySamples(
            np.concatenate([_centred(part.locations) for part in parts]),
            np.concatenate([part.velocities for part in parts]),
            np.concatenate([part.axes for part in parts]),
            np.concatenate([part.drifts for part in parts]),
            np.concatenate([part.drift_velocities for part in parts]),
            parts[0].held,
        )

    def __call__(self, parameters: Float64Array, amounts: Float64Array) -> Linearised:
        offset, skew, lever = parameters[0], parameters[1], parameters[2:5]
        since = self.times - self.middle
        reported = self._trajectory(offset + skew * since)
        known = np.isfinite(reported.locations) & np.isfinite(reported.velocities)
        locations, velocities = (np.where(known, x, 0.0) for x in (reported.locations, reported.velocities))
        axes, drifts = (np.where(known[:, None], x, 0.0) for x in (reported.axes, reported.drifts))
        rotation = np.zeros(len(locations), np.complex128)
        if amounts.shape[1]:
            rotation = (amounts[:, -2] + 1j * amounts[:, -1])[self.windows]
            drifting = np.where(known[:, None], reported.drift_velocities, 0.0)
            velocities = velocities + (drifting * self.drifts_of(amounts)[self.windows]).sum(axis=1)
        moved = locations + axes @ lever
        nuisances = np.concatenate(
            [
                self.polynomials,
                1j * self.polynomials,
                rotation[:, None] * drifts,
                moved[:, None],
                1j * moved[:, None],
            ],
            axis=1,
        )
        slopes = np.concatenate(
            [
                (rotation * velocities)[:, None],
                (rotation * velocities * since)[:, None],
                rotation[:, None] * axes,
            ],
            axis=1,
        )
        free = np.full(2 * (self.trajectory.degree + 1), np.inf)
        expected = np.concatenate([free, reported.held, [np.inf, np.inf]])
        return Linearised(_split(self.locations), _split(slopes), _split(nuisances), known, expected)


def _centred(locations: AnyArray) -> AnyArray:
    known = np.isfinite(locations)
    return locations - locations[known].mean() if known.any() else locations


def _split(values: AnyArray) -> Float64Array:
    """Complex (N, …) as (N, 2, …)."""
    return np.stack([values.real, values.imag], axis=1)


def _lags(part: _TrajectoryModel, reach: float) -> list[float]:
    """The offsets at which a trajectory fits best, to begin with."""
    lags = np.arange(-np.floor(reach / _LAG), np.floor(reach / _LAG) + 1) * _LAG
    costs = np.array([misfit_of(part, np.array([lag, 0, 0, 0, 0]), part.windows) for lag in lags.tolist()])
    padded = np.concatenate([[np.inf], costs, [np.inf]])
    lows = np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] < padded[2:]))
    return [float(lags[k]) for k in lows[np.argsort(costs[lows])][:3]]


def _candidate(model: _TrajectoryModel, found: Fit, common: float) -> Candidate:
    return Candidate(
        fit=found,
        times=model.times,
        middle=model.middle,
        span=common,
        without_motion=misfit_without_motion(found, model.windows, lambda: _unmoved(model, found)),
        score=None,
        model_sigma=model.trajectory.model_sigma,
    )


def _unmoved(model: _TrajectoryModel, found: Fit) -> Linearised:
    """The same fixes, reported by polynomials alone."""
    at = model(found.parameters, found.amounts[:, :0])
    return replace(at, nuisances=at.nuisances[:, :, :-2], expected=None)
