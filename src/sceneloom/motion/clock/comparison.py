"""Time offset and skew between two clocks whose streams measure the same motion, from rotations or from positions.

Both are fits by Gauss-Newton with nuisances that are linear and free in every window (biases of a gyroscope; rotation,
scale and drifts of a trajectory), judged by the same rules.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import combinations, pairwise

import msgspec
import numpy as np
from numpy.polynomial.legendre import legvander

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, finite_rows
from sceneloom.geometry.rigid import matrix_from_rotation_vector, nearest_rotation, rotation_vector_from_matrix
from sceneloom.motion.clock.signals import Fixes, Orientations, RotationCurve, SmoothedTrajectory, TrajectorySamples

REACH_NS = 5_000_000_000
"""Largest offset that is searched [ns]."""

LEVER_SIGMA = 1.0
"""Standard deviation of a receiver's antenna from the ego's origin on each axis, where its position is unknown [m]."""

TOLERANCE_NS = 5_000_000
"""Offsets up to this do no harm [ns]: they are 5 cm at 10 m/s, as a lidar's range noise, and 0.15° at 30 °/s."""

LEVEL = 0.99
"""Confidence level of intervals: a drive has some ten streams, and a wrong verdict changes all times of one."""

_WORST_SIGMA_NS = 50_000_000.0  # offsets that are known less well are not reported [ns]
_WORST_SKEW_SIGMA_PPM = 300.0  # the same of the skew
_QUARTZ_PPM = 100.0  # standard deviation of a skew that is not known: quartz clocks differ by less than 200 ppm


class ClockVerdict(StrEnum):
    """Result of a comparison of two clocks."""

    IN_STEP = "in step"
    OFF = "off"
    CANNOT_TELL = "cannot tell"
    NOT_OBSERVABLE = "not observable"


class _OffsetChunk(msgspec.Struct, frozen=True, kw_only=True):
    """The offset in one part of a drive."""

    at_ns: int  # middle of the part, on the reference's clock [ns]
    offset_ns: float
    sigma_ns: float  # its standard deviation [ns]


class ClockEstimate(msgspec.Struct, frozen=True, kw_only=True):
    """A stream's clock relative to that of a reference.

    A time t of the stream is the reference's t - offset - skew (t - offset - at).

    Attributes:
        verdict: in step: the interval is within the tolerance from begin to end of the common time; off: somewhere it
            is beyond; cannot tell: neither; not observable: there is no interval.
        reason: why the clocks cannot be compared; "" otherwise.
        offset_ns: the stream's timestamps minus the reference's, at `at_ns` [ns]; None where unknown.
        offset_sigma_ns: its standard deviation [ns].
        interval_ns: confidence interval of the offset at `at_ns`, of the level `LEVEL` [ns]; None where unknown.
        limit_ns: the largest offset in either direction within the intervals of the whole common time [ns].
        skew_ppm: how much faster the stream's clock runs [parts in a million]; None where unknown.
        skew_sigma_ppm: its standard deviation.
        at_ns: middle of the common time, on the reference's clock [ns].
        span_ns: length of the common time [ns].
        samples: number of measurements compared.
        correlation: of both motions at the offset, 0 to 1; None where none was computed.
        rotation_vector: rotation [rad] from the stream's body frame into the reference's, where it is known.
        chunks: the offset in parts of a long drive.
    """

    verdict: ClockVerdict
    reason: str = ""
    offset_ns: float | None = None
    offset_sigma_ns: float | None = None
    interval_ns: tuple[float, float] | None = None
    limit_ns: float | None = None
    skew_ppm: float | None = None
    skew_sigma_ppm: float | None = None
    at_ns: int = 0
    span_ns: int = 0
    samples: int = 0
    correlation: float | None = None
    rotation_vector: tuple[float, float, float] | None = None
    chunks: tuple[_OffsetChunk, ...] = ()

    @classmethod
    def unknown(cls, reason: str, **known: object) -> "ClockEstimate":
        """An estimate that gives the reason why nothing is known."""
        return cls(verdict=ClockVerdict.NOT_OBSERVABLE, reason=reason, **known)  # type: ignore[arg-type]

    @property
    def summary(self) -> str:
        """The verdict in words, with the reason why nothing is known, or how large the offset may be."""
        if self.verdict is ClockVerdict.CANNOT_TELL and self.limit_ns is not None:
            return f"{self.verdict}, up to {self.limit_ns / 1e6:.1f} ms"
        return f"{self.verdict}: {self.reason}" if self.reason else str(self.verdict)

    @property
    def is_off(self) -> bool:
        """Whether the clocks surely differ by more than the tolerance."""
        return self.verdict is ClockVerdict.OFF


_HUBER = 2.0  # residuals beyond so many standard deviations count linearly. Source: Huber 1964.
_MOST_LAGS = 10  # largest order of the autoregression that whitens the noise
_ROUNDS, _STEPS = 3, 10

_SERIAL = 200_000
"""Matrix products are taken in parts of so many multiplications: BLAS shares larger ones among threads, which costs
more than it saves."""

_CONVERGED = 0.02  # steps are small enough at this share of a standard deviation


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """A model linearised at some parameters."""

    residuals: Float64Array  # (N, K): measured minus modelled, without what the nuisances explain
    jacobian: Float64Array  # (N, K, P), derivative of the modelled values
    nuisances: Float64Array  # (N, K, M), columns whose amounts are free in every window
    known: BoolArray  # (N,) whether a row can be used
    windows: Int64Array  # (N,), number of each row's window, ascending; the noise is not correlated across windows
    nuisance_sigmas: Float64Array | None = None  # (M,), of the nuisances' amounts, infinite where free; None: all are

    @property
    def precision(self) -> Float64Array:
        """Prior precision of the nuisances' amounts, (M,)."""
        if self.nuisance_sigmas is None:
            return np.zeros(self.nuisances.shape[2])
        return np.asarray(self.nuisance_sigmas**-2.0, np.float64)

    def without_nuisances(self, amounts: Float64Array) -> Float64Array:
        """The residuals (N, K) minus nuisances of these amounts (W, M)."""
        return np.asarray(self.residuals - np.einsum("nkm,nm->nk", self.nuisances, amounts[self.windows]), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """The state of a fit."""

    parameters: Float64Array  # (P,)
    covariance: Float64Array  # (P, P)
    amounts: Float64Array  # (W, M), of the nuisances in each window
    information: Float64Array  # (P, P), of the measurements alone
    residuals: Float64Array  # (N, K): whitened, weighted, without nuisances, in units of `scales`
    jacobian: Float64Array  # (N, K, P): whitened, weighted, without nuisances, in units of `scales`
    used: BoolArray  # (N,)
    scales: Float64Array  # (K,), standard deviation of the whitened residuals
    windows: Int64Array  # (N,)
    colour: Float64Array  # (K, L), the autoregression
    prior: "_NuisancePrior"  # of the nuisances' amounts

    @property
    def rows(self) -> int:
        """How many rows were used."""
        return int(self.used.sum())

    @property
    def misfit(self) -> float:
        """Robust sum of the squared whitened residuals in units of `scales`."""
        return float((self.residuals**2).sum() + (self.prior.residuals**2).sum())

    @property
    def level(self) -> float:
        """Logarithm of the misfit of a value in its own unit, so that fits with different scales compare."""
        mean = self.misfit / max(self.rows * self.residuals.shape[1], 1)
        return float(np.log(max(mean, 1e-300)) + 2 * np.log(self.scales).mean())

    def evidence_against(self, other: "_Fit") -> float:
        """Logarithm of the likelihood ratio of this fit to another one."""
        return 0.5 * self.rows * int(self.residuals.shape[1]) * (other.level - self.level)


@dataclass(frozen=True, slots=True, eq=False)
class _NuisancePrior:
    """Prior knowledge of the nuisances' amounts, as measurements in standard deviations."""

    residuals: Float64Array  # (H,)
    jacobian: Float64Array  # (H, P)
    spent: float  # how many nuisances the measurements determine

    @property
    def information(self) -> Float64Array:
        """What it adds to the information on the parameters, (P, P)."""
        return np.asarray(self.jacobian.T @ self.jacobian, np.float64)


_Model = Callable[[Float64Array, Float64Array], Linearised]
"""Linearises the model at parameters (P,) and amounts of the nuisances (W, M), which are (0, 0) at first."""

_NO_AMOUNTS = np.zeros((0, 0))


def fit(
    model: _Model,
    start: Float64Array,
    prior_sigmas: Float64Array,
    *,
    like: _Fit | None = None,
    whiten: bool = True,
    scales: Float64Array | None = None,
) -> _Fit | None:
    """Fit parameters by Gauss-Newton; None where too few rows are known.

    Noise that is correlated from row to row is whitened by an autoregression fitted to the residuals, nuisances are
    free in each window, large residuals count less, and the covariance is that of Newey and West for the remaining
    correlation.

    Args:
        start: (P,), the prior mean.
        prior_sigmas: (P,), its standard deviations, infinite where nothing is known.
        like: first guess of parameters and noise; None: the start, and white noise.
        scales: (K,), fixed standard deviations of the residuals; None: estimated.

    Source: whitening before the estimate of Newey and West 1987 is Andrews and Monahan 1992; the autoregression is
    that of Yule 1927 and Walker 1931; weights are those of Huber 1964.
    """
    parameters = (start if like is None else like.parameters).astype(np.float64)
    at = model(parameters, _NO_AMOUNTS)
    colour = np.zeros((at.residuals.shape[1], 0)) if like is None else like.colour
    precision = 1.0 / prior_sigmas**2
    solved = _solve(at, colour, precision, parameters - start, fixed_scales=scales)
    if solved is None:
        return None
    _, state = solved
    for round_number in range(_ROUNDS if whiten else 2):
        for _ in range(_STEPS):
            at = model(parameters, state.amounts)
            solved = _solve(at, colour, precision, parameters - start, fixed_scales=scales, scales=state.scales)
            if solved is None:
                return None
            step, state = solved
            parameters = parameters + step
            spread = np.sqrt(np.diag(np.linalg.pinv(state.information + np.diag(precision + 1e-300))))
            if (np.abs(step) <= _CONVERGED * spread + 1e-12).all():
                break
        if whiten and round_number < _ROUNDS - 1:
            spent = at.nuisances.shape[2] / at.residuals.shape[1]
            colour = _colour(at.without_nuisances(state.amounts), state.used, at.windows, spent)
    return replace(state, parameters=parameters, covariance=_covariance(state, precision))


def misfit_of(at: Linearised, *, colour: Float64Array | None = None, scales: Float64Array | None = None) -> float:
    """Misfit of a model as it stands: in units of `scales`, else the squared mean size of the residuals.

    It is infinite where too few rows are known.

    Args:
        colour, scales: (K, L) autoregression and (K,) standard deviations, those of a fit.
    """
    colour = np.zeros((at.residuals.shape[1], 0)) if colour is None else colour
    nothing = np.zeros(0)
    solved = _solve(replace(at, jacobian=at.jacobian[:, :, :0]), colour, nothing, nothing, fixed_scales=scales)
    if solved is None:
        return float("inf")
    state = solved[1]
    if scales is not None:
        return state.misfit
    return float((np.abs(state.residuals[state.used]) * state.scales).mean() ** 2)


def _solve(
    at: Linearised,
    colour: Float64Array,
    precision: Float64Array,
    moved: Float64Array,
    *,
    fixed_scales: Float64Array | None,
    scales: Float64Array | None = None,
) -> tuple[Float64Array, _Fit] | None:
    """One step of the parameters, and the state, which lacks parameters and covariance."""
    used = _usable(at, colour)
    size = len(moved)
    if used.sum() < size + 4:
        return None
    residuals, jacobian, nuisances = (
        _whitened(values, at.known, used, colour) for values in (at.residuals, at.jacobian, at.nuisances)
    )
    white = replace(at, residuals=residuals, jacobian=jacobian, nuisances=nuisances)
    # twice: the weights come from residuals without nuisances, and determine how these are eliminated
    weights = used.astype(np.float64)
    scales = np.ones(residuals.shape[1]) if scales is None else scales
    for _ in range(2):
        clean_r, clean_j, amounts, prior = _eliminate_nuisances(white, weights, scales)
        scales = _scales(clean_r, used) if fixed_scales is None else fixed_scales
        lengths = np.sqrt(((clean_r / scales) ** 2).mean(axis=1))
        weights = used * np.minimum(1.0, _HUBER / np.maximum(lengths, 1e-12))
    root = np.sqrt(weights)[:, None]
    r = clean_r / scales * root
    j = clean_j / scales[None, :, None] * root[:, :, None]
    slopes = j.reshape(r.size, size)
    products = _inner(slopes, np.concatenate([slopes, r.reshape(-1, 1)], axis=1))
    information = products[:, :size] + prior.information
    gradient = products[:, size] + prior.jacobian.T @ prior.residuals - precision * moved
    step = np.linalg.lstsq(information + np.diag(precision), gradient, rcond=None)[0].astype(np.float64)
    unknown = np.zeros(0)
    used = used & (weights > 0)
    return step, _Fit(unknown, unknown, amounts, information, r, j, used, scales, at.windows, colour, prior)


def _eliminate_nuisances(
    at: Linearised, weights: Float64Array, scales: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array, _NuisancePrior]:
    """Take out of residuals and derivatives what the nuisances of each window explain; also give their amounts."""
    residuals, jacobian, nuisances, windows = at.residuals, at.jacobian, at.nuisances, at.windows
    precision = at.precision
    clean_r, clean_j = residuals.copy(), jacobian.copy()
    count, columns = int(windows[-1]) + 1, nuisances.shape[2]
    amounts = np.zeros((count, columns))
    size = jacobian.shape[2]
    if columns == 0:
        return clean_r, clean_j, amounts, _NuisancePrior(np.zeros(0), np.zeros((0, size)), 0.0)
    edges = np.searchsorted(windows, np.arange(count + 1))
    expected = precision > 0
    priors, spent = [], 0.0
    for window in range(count):
        rows = slice(edges[window], edges[window + 1])
        root = np.sqrt(weights[rows])[:, None] / scales
        basis = (nuisances[rows] * root[:, :, None]).reshape(-1, columns)
        values = np.concatenate([residuals[rows, :, None], jacobian[rows]], axis=2)
        targets = (values * root[:, :, None]).reshape(-1, 1 + size)
        products = _inner(basis, np.concatenate([basis, targets], axis=1))
        lengths = np.sqrt(np.maximum(np.diag(products) + precision, 1e-300))
        normal = (products[:, :columns] + np.diag(precision)) / np.outer(lengths, lengths)
        right = np.concatenate([products[:, columns:] / lengths[:, None], np.eye(columns)], axis=1)
        solved = np.linalg.solve(normal + 1e-10 * np.eye(columns), right) / lengths[:, None]
        solution = solved[:, : 1 + size]
        amounts[window] = solution[:, 0]
        left = values - _times(nuisances[rows].reshape(-1, columns), solution).reshape(values.shape)
        clean_r[rows], clean_j[rows] = left[:, :, 0], left[:, :, 1:]
        priors.append(np.sqrt(precision[expected])[:, None] * solution[expected])
        kept = np.diag(solved[:, 1 + size :])[expected] / lengths[expected]
        spent += columns - float(kept @ precision[expected])
    before = np.concatenate(priors)
    return clean_r, clean_j, amounts, _NuisancePrior(before[:, 0], before[:, 1:], spent)


def _inner(left: Float64Array, right: Float64Array) -> Float64Array:
    """The product of (R, A) transposed with (R, B), where R is large."""
    a, b = left.shape[1], right.shape[1]
    rows = max(1, _SERIAL // max(a * b, 1))
    parts = len(left) // rows
    whole = parts * rows
    products = left[:whole].reshape(parts, rows, a).swapaxes(1, 2) @ right[:whole].reshape(parts, rows, b)
    return np.asarray(products.sum(axis=0) + left[whole:].T @ right[whole:], np.float64)


def _times(left: Float64Array, right: Float64Array) -> Float64Array:
    """The product of (R, A) with (A, B), where R is large."""
    a, b = right.shape
    rows = max(1, _SERIAL // max(a * b, 1))
    parts = len(left) // rows
    whole = parts * rows
    products = left[:whole].reshape(parts, rows, a) @ right
    return np.concatenate([products.reshape(whole, b), left[whole:] @ right])


def _usable(at: Linearised, colour: Float64Array) -> BoolArray:
    """Which rows can be used: known ones, with all rows before them that whitening needs, (N,)."""
    used = at.known.copy()
    for lag in range(1, colour.shape[1] + 1):
        used[lag:] &= at.known[:-lag] & (at.windows[lag:] == at.windows[:-lag])
        used[:lag] = False
    return used


def _whitened(values: Float64Array, known: BoolArray, used: BoolArray, colour: Float64Array) -> Float64Array:
    """Subtract from rows (N, K, …) what the rows before them predict; 0 where not used."""
    whitened = np.where(known.reshape(-1, *[1] * (values.ndim - 1)), values, 0.0)
    plain = whitened.copy()
    for lag in range(1, colour.shape[1] + 1):
        factors = colour[:, lag - 1].reshape(1, -1, *[1] * (values.ndim - 2))
        whitened[lag:] -= factors * plain[:-lag]
    whitened[~used] = 0.0
    return whitened


def _colour(residuals: Float64Array, used: BoolArray, windows: Int64Array, spent: float) -> Float64Array:
    """Fit an autoregression (K, L) to the residuals, clipped against outliers; `spent` nuisances in each window."""
    order = min(_MOST_LAGS, int(used.sum()) // 25)
    components = residuals.shape[1]
    if order == 0:
        return np.zeros((components, 0))
    scales = _scales(residuals, used)
    clipped = np.clip(residuals, -3 * scales, 3 * scales) * used[:, None]
    moments = np.empty((components, order + 1))
    for lag in range(order + 1):
        pairs = used[lag:] & used[: len(used) - lag] & (windows[lag:] == windows[: len(windows) - lag])
        products = clipped[lag:] * clipped[: len(clipped) - lag]
        moments[:, lag] = (products * pairs[:, None]).sum(axis=0) / len(used)
    length = float(used.sum()) / (int(windows[-1]) + 1)
    chosen = [_lasting(row, int(used.sum()), length, spent) for row in moments]
    colour = np.zeros((components, max(map(len, chosen))))
    for k, factors in enumerate(chosen):
        colour[k, : len(factors)] = factors
    return colour


def _lasting(moments: Float64Array, count: int, length: float, spent: float) -> Float64Array:
    """The autoregression, with a root close to 1 where nuisances hide how long the noise lasts.

    Without the smoothest `spent` functions in windows of `length` rows a random walk keeps a variance of length / (π²
    spent) squared steps, as if it lasted 2 length / (π² spent) rows. What seems to last half of that may last longer.

    Source: the eigenvalues of the random walk are those of Karhunen and Loève; the bias is that of Kendall 1954.
    """
    factors = _autoregression(moments, count)
    if not len(factors) or 1.0 - factors.sum() > np.pi**2 * spent / length:
        return factors
    root = 1.0 - 0.1 / length
    before = np.append(moments[1], moments[:-2])
    rest = _autoregression((1.0 + root**2) * moments[:-1] - root * (moments[1:] + before), count)
    return np.asarray(-np.convolve([1.0, -root], np.append(1.0, -rest))[1:], np.float64)


def _autoregression(moments: Float64Array, count: int) -> Float64Array:
    """The autoregression of moments at lags 0 … L (Levinson 1947, Durbin 1960), of the order by Schwarz 1978."""
    factors = np.zeros(0)
    if moments[0] <= 0:
        return factors
    left, best = float(moments[0]), (count * np.log(moments[0]), factors)
    for order in range(1, len(moments)):
        reflection = float((moments[order] - factors @ moments[order - 1 : 0 : -1]) / left)
        factors = np.append(factors - reflection * factors[::-1], reflection)
        left *= max(1.0 - reflection**2, 1e-9)
        best = min(best, (count * np.log(left) + order * np.log(count), factors), key=lambda found: found[0])
    return best[1]


def _scales(residuals: Float64Array, used: BoolArray) -> Float64Array:
    """Standard deviation of each column, (K,), from the median of the absolute values."""
    spread = 1.4826 * np.median(np.abs(residuals[used]), axis=0)
    floor = 1e-12 + 1e-9 * np.abs(residuals[used]).max(axis=0)
    return np.asarray(np.maximum(spread, floor), np.float64)


def _covariance(state: _Fit, precision: Float64Array) -> Float64Array:
    """The covariance (P, P), robust against correlation of scores; Newey and West 1987, eq. 5; lags as in 1994."""
    rows = state.rows
    scores = (state.jacobian * state.residuals[:, :, None]).sum(axis=1)
    meat = _inner(scores, scores)
    lags = int(4 * (len(scores) / 100) ** (2 / 9))
    for lag in range(1, lags + 1):
        same = (state.windows[lag:] == state.windows[:-lag])[:, None]
        part = _inner(scores[lag:] * same, scores[:-lag])
        meat = meat + (1 - lag / (lags + 1)) * (part + part.T)
    meat = meat + state.prior.information
    freedom = rows / max(rows - len(precision) - state.prior.spent / state.residuals.shape[1], 1.0)
    inverse = np.linalg.pinv(state.information + np.diag(precision))
    # the scales are medians, which ignore the tails that the weights leave
    plain = np.diag(inverse) * float((state.residuals[state.used] ** 2).mean())
    robust = inverse @ (meat + np.diag(precision)) @ inverse
    lifted = np.sqrt(np.maximum(plain / np.maximum(np.diag(robust), 1e-300), 1.0))
    return np.asarray(freedom * robust * np.outer(lifted, lifted), np.float64)


_LEAST_EVIDENCE = 12.0
"""Logarithm of the likelihood ratio that an offset needs, against no common motion and against another offset: with
the many lags tried, chance alone reaches 8 now and then."""

_LEAST_MARGIN = 2.0
"""By how many standard deviations of chance the correlation at an offset must exceed that at any other one.

Unrelated motions reached 1.8 and less in 26 of 27 tries, in one of 20 s 2.3."""

_BLOCKS = 8  # parts of a drive whose offsets are checked for their scatter
_CHUNK = 60.0  # length of a part whose offset is reported [s]
_FINEST = 1e-6  # no timestamps are better than a microsecond [s]


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """One offset that fits."""

    fit: _Fit  # of offset [s], skew and more; the offset is the finer stream's timestamp minus the other's
    times: Float64Array  # (N,) [s], of the rows
    middle: float  # the time at which the offset holds [s]
    span: float  # length of the common time [s]
    without_motion: float  # misfit of the same rows without the motion, in the same units
    score: float | None = None  # correlation at the lag
    margin: float | None = None
    rotation: Float64Array | None = None  # (3, 3), from the finer stream's body into the other's, or None
    model_sigma: float = 0.0  # standard deviation of the offset by errors of the model [s]

    @property
    def offset(self) -> float:
        """The offset [s]."""
        return float(self.fit.parameters[0])

    @property
    def sigma(self) -> float:
        """Its standard deviation [s]."""
        return float(max(np.hypot(np.sqrt(self.fit.covariance[0, 0]) * self.scatter, self.model_sigma), _FINEST))

    @property
    def scatter(self) -> float:
        """By how much offsets of parts of the drive scatter more than the noise explains, 1 at least (Birge 1932)."""
        # errors that are no noise, such as a bent trajectory between fixes, show there
        squares = sum((step / sigma) ** 2 for _, step, sigma in self.block_offsets(_BLOCKS))
        return float(np.sqrt(max(1.0, squares / self.freedom)))

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the scatter: the parts less offset and skew."""
        return max(len(self.block_offsets(_BLOCKS)) - 2, 1)

    @property
    def skew_sigma(self) -> float:
        """Standard deviation of the skew."""
        return max(float(np.sqrt(self.fit.covariance[1, 1])) * self.scatter, _FINEST / max(self.span, 1e-3))

    @property
    def knows_skew(self) -> bool:
        """Whether the skew is known well enough to be reported."""
        return self.skew_sigma * 1e6 <= _WORST_SKEW_SIGMA_PPM

    def interval(self, since: float = 0.0) -> tuple[float, float]:
        """Confidence interval of the offset [s] so many seconds after the middle.

        Source: the mean of parts divided by their own scatter follows Student's t, however the noise is correlated
        within a part: Schmeiser 1982, "Batch Size Effects in the Analysis of Simulation Output".
        """
        from scipy.special import stdtrit

        offset, variance = self.offset, self.sigma**2
        if self.knows_skew:
            offset += since * float(self.fit.parameters[1])
            covariance = self.scatter**2 * self.fit.covariance
            variance += 2 * since * float(covariance[0, 1]) + (since * self.skew_sigma) ** 2
        else:
            variance += (since * _QUARTZ_PPM * 1e-6) ** 2
        reach = float(stdtrit(self.freedom, 0.5 + 0.5 * LEVEL)) * float(np.sqrt(max(variance, _FINEST**2)))
        return offset - reach, offset + reach

    def block_offsets(self, count: int) -> list[tuple[float, float, float]]:
        """For each of `count` parts of the drive the middle [s], its offset from the line, and its sigma [s]."""
        # it is one step of the fit from the line, with the part's rows alone and all else unchanged
        first, length = float(self.times.min()), max(float(np.ptp(self.times)), 1e-9)
        numbers = np.clip(((self.times - first) / length * count).astype(np.int64), 0, count - 1)
        slopes, residuals = self.fit.jacobian[:, :, 0], self.fit.residuals
        blocks = []
        for number in range(count):
            rows = numbers == number
            information = float((slopes[rows] ** 2).sum())
            if information > 1e-3 * self.fit.information[0, 0] / count:
                step = float((slopes[rows] * residuals[rows]).sum()) / information
                blocks.append((first + (number + 0.5) * length / count, step, float(1 / np.sqrt(information))))
        return blocks


@dataclass(frozen=True, slots=True)
class _Clocks:
    """To which of two streams' timestamps the offset adds, the origin of the seconds, and the tolerable offset."""

    origin_ns: int
    finer_is_stream: bool
    tolerance_ns: int

    @property
    def sign(self) -> float:
        """Turns the finer stream's offset into that of the stream against the reference."""
        return 1.0 if self.finer_is_stream else -1.0

    def choose(self, candidates: Sequence[_Candidate]) -> ClockEstimate:
        """Choose the offset that fits best, and say how well it is known, or why it is not."""
        # evidence is the logarithm of the likelihood ratio, half the number of values times that of the misfits' ratio,
        # since the whitened residuals of different rows are independent
        ranked = sorted(candidates, key=lambda candidate: candidate.fit.level)
        if not ranked:
            return ClockEstimate.unknown("too few samples in common to fit an offset")
        best = ranked[0]
        known = {"samples": best.fit.rows, "span_ns": round(best.span * 1e9)}
        values = best.fit.residuals.shape[1] * best.fit.rows
        evidence = 0.5 * values * np.log(max(best.without_motion, 1e-300) / max(best.fit.misfit, 1e-300))
        if evidence < _LEAST_EVIDENCE:
            return ClockEstimate.unknown("the streams show no motion in common", **known)
        rivals = [other for other in ranked[1:] if abs(other.offset - best.offset) > max(6 * best.sigma, 0.01)]
        if best.margin is None and any(best.fit.evidence_against(other.fit) < _LEAST_EVIDENCE for other in rivals):
            return ClockEstimate.unknown(self.ambiguity([one.offset for one in (best, *rivals)]), **known)
        return self._judge(best)

    def ambiguity(self, offsets: Sequence[float]) -> str:
        """Say that several offsets [s] fit equally well, or a single one no better than chance."""
        if len(offsets) < 2:
            return "no offset makes the motions more alike than chance would"
        some = sorted(self.sign * offset for offset in offsets[:2])
        return "several offsets fit equally well: " + ", ".join(f"{offset * 1e3:.0f} ms" for offset in some)

    def _judge(self, best: _Candidate) -> ClockEstimate:
        offset_ns, skew_ppm = (self.sign * best.fit.parameters[:2] * [1e9, 1e6]).tolist()
        sigma_ns, span_ns = best.sigma * 1e9, round(best.span * 1e9)
        # offset and skew are a line, whose extremes are at the ends; in the middle it is known best
        intervals = 1e9 * np.sort([best.interval(since) for since in (0.0, -0.5 * best.span, 0.5 * best.span)], axis=1)
        low, high = np.sort(self.sign * intervals[0]).tolist()
        limit_ns = float(np.abs(intervals).max())
        least_ns = float(np.where(intervals[:, 0] * intervals[:, 1] > 0, np.abs(intervals).min(axis=1), 0.0).max())
        known, reason, verdict = True, "", ClockVerdict.CANNOT_TELL
        if not np.isfinite(sigma_ns) or sigma_ns > _WORST_SIGMA_NS:
            known, verdict = False, ClockVerdict.NOT_OBSERVABLE
            reason = (
                f"too little motion in common: the offset is known within {sigma_ns / 1e6:.0f} ms only; "
                f"expected {_WORST_SIGMA_NS / 1e6:.0f} ms or better"
            )
        elif limit_ns <= self.tolerance_ns:
            verdict = ClockVerdict.IN_STEP
        elif least_ns > self.tolerance_ns:
            verdict = ClockVerdict.OFF
        middle_ns = self.origin_ns + round(best.middle * 1e9)
        rotation = best.rotation
        if rotation is not None:
            into_reference = rotation if self.finer_is_stream else rotation.T
            rotation = rotation_vector_from_matrix(into_reference)
        return ClockEstimate(
            verdict=verdict,
            reason=reason,
            offset_ns=offset_ns if known else None,
            offset_sigma_ns=sigma_ns,
            interval_ns=(low, high) if known else None,
            limit_ns=limit_ns if known else None,
            skew_ppm=skew_ppm if known and best.knows_skew else None,
            skew_sigma_ppm=best.skew_sigma * 1e6,
            # the middle is a time of the slower stream's clock
            at_ns=middle_ns if self.finer_is_stream else middle_ns + round(best.offset * 1e9),
            span_ns=span_ns,
            samples=best.fit.rows,
            correlation=best.score,
            rotation_vector=None if rotation is None else tuple(rotation.tolist()),
            chunks=self._chunks(best),
        )

    def _chunks(self, best: _Candidate) -> tuple[_OffsetChunk, ...]:
        """The offset in each minute of a drive of three minutes or more."""
        count = int(best.span // _CHUNK)
        if count < 3:
            return ()
        offset, skew = best.fit.parameters[:2]
        inflation = best.sigma * np.sqrt(max(best.fit.information[0, 0], 0.0))
        return tuple(
            _OffsetChunk(
                at_ns=self.origin_ns + round(at * 1e9),
                offset_ns=self.sign * float(offset + skew * (at - best.middle) + step) * 1e9,
                sigma_ns=max(sigma * inflation, _FINEST) * 1e9,
            )
            for at, step, sigma in best.block_offsets(count)
        )


_LEAST_OVERLAP = 0.3  # lags count where at least this share of the most samples that any lag compares overlap
_LONGEST = 3.0  # vectors are shortened to so many times the 0.9 quantile of their lengths
_ALIKE = 0.7  # autocorrelation within a peak's lobe


@dataclass(frozen=True, slots=True, eq=False)
class _Peak:
    """One lag at which two streams look alike."""

    lag: float  # steps of the grid by which the second stream is later
    score: float  # correlation, 0 to 1
    margin: float  # by how many standard deviations of chance that exceeds the best one at another lag
    rotation: Float64Array  # (3, 3) that takes the second stream's vectors into the first's


_MOST_PEAKS = 4  # lags at which two streams are compared


def _correlation_peaks(
    first: Float64Array, second: Float64Array, reach: int, *, centre: int, expected: Float64Array
) -> list[_Peak]:
    """Find lags, within `reach` steps of `centre`, at which second[k + lag] is most like first[k], the best first."""
    # the sum of the singular values of the 3x3 correlation at a lag is the largest correlation that a rotation between
    # the streams can give, so axes need not be known; rotations of a car, about one axis, keep their signs
    # Source: correlation of masked signals: Padfield 2012, eq. 24; best rotation: Wahba 1965, as in Markley 1988
    first, second = _clipped(first), _clipped(second)
    products, counts = _masked_correlation(first, second, centre + np.arange(-reach, reach + 1))
    usable = counts >= max(8.0, _LEAST_OVERLAP * counts.max(initial=0.0))
    if not usable.any():
        return []
    products = np.where(usable[:, None, None], products, 0.0)
    singular = np.linalg.svd(products, compute_uv=False)
    handed = np.where(np.linalg.det(products) < 0, -1.0, 1.0)
    scores = singular[:, 0] + singular[:, 1] + handed * singular[:, 2]
    padded = np.concatenate([[-1.0], scores, [-1.0]])
    tops = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:]) & (scores > 0))
    sigma, lobe = _chance(first, second)
    peaks = []
    for k in tops[np.argsort(-scores[tops])][:_MOST_PEAKS].tolist():
        others = scores[np.abs(np.arange(len(scores)) - k) > 2 * lobe]
        heights = np.arctanh(np.clip([scores[k], others.max(initial=0.0)], 0.0, 1 - 1e-9))
        rotation, _ = nearest_rotation(products[k] + 0.02 * expected)
        lag = k + _vertex(scores, k) - reach + centre
        peaks.append(_Peak(lag, float(min(scores[k], 1.0)), float((heights[0] - heights[1]) / sigma), rotation))
    return peaks


def _chance(first: Float64Array, second: Float64Array) -> tuple[float, int]:
    """Standard deviation of the atanh of correlations of unrelated streams; within how many steps lags are alike."""
    # Source: Bartlett 1946: the variance is the sum of products of both autocorrelations, by the number; Fisher 1915
    own = [_autocorrelation(values) for values in (first, second)]
    size = min(map(len, own)) // 2
    product = own[0][:size] * own[1][:size]
    total = max(product[0] + 2.0 * float(product[1:].sum()), 1.0)
    count = max(min(int(finite_rows(values).sum()) for values in (first, second)) / total, 4.5)
    smooth = np.maximum(own[0][:size], own[1][:size])
    apart = np.flatnonzero(smooth < _ALIKE)
    return float(1.0 / np.sqrt(count - 3.0)), int(apart[0]) if len(apart) else size


def _autocorrelation(values: Float64Array) -> Float64Array:
    mask, known = _known(values)
    known = (known - known.sum(axis=0) / max(float(mask.sum()), 1.0)) * mask[:, None]
    size = 1 << int(np.ceil(np.log2(2 * len(known) + 1)))
    spectrum = np.abs(np.fft.rfft(known, size, axis=0)) ** 2
    lagged = np.fft.irfft(spectrum.sum(axis=1), size)[: len(known)]
    return np.asarray(lagged / max(float(lagged[0]), 1e-300), np.float64)


def _clipped(values: Float64Array) -> Float64Array:
    """Vectors with outliers shortened."""
    known = values[finite_rows(values)]
    if len(known) == 0:
        return values
    middle = np.median(known, axis=0)
    longest = _LONGEST * max(float(np.quantile(np.linalg.norm(known - middle, axis=1), 0.9)), 1e-12)
    lengths = np.linalg.norm(values - middle, axis=1)
    factors = np.minimum(1.0, longest / np.maximum(lengths, 1e-12))
    return np.asarray(middle + (values - middle) * factors[:, None], np.float64)


def _masked_correlation(
    first: Float64Array, second: Float64Array, lags: Int64Array
) -> tuple[Float64Array, Float64Array]:
    """The 3x3 correlations at some lags, over the rows known in both, and the number of these."""
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


def _vertex(scores: Float64Array, k: int) -> float:
    """The vertex of the parabola through a local maximum and its neighbours, in steps from it."""
    if not 0 < k < len(scores) - 1:
        return 0.0
    before, at, after = scores[k - 1 : k + 2]
    bend = before - 2 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0


_STEEPEST = 1e-3  # no clock's skew is larger; steeper lines go through wrong lags


def _robust_line(times: Float64Array, offsets: Float64Array) -> tuple[float, float]:
    """Offset at time 0 [s] and slope of a line through offsets (N,) [s], of which nearly half may be wrong."""
    # Source: slope, of those that clocks can have: Siegel 1982, repeated medians; offset: Rousseeuw 1984, least median
    slopes = [
        (offsets[j] - offsets[i]) / (times[j] - times[i])
        for i, j in combinations(range(len(times)), 2)
        if abs(offsets[j] - offsets[i]) <= _STEEPEST * abs(times[j] - times[i]) + 1e-12
    ]
    slope = float(np.median(slopes)) if slopes else 0.0
    ordered = np.sort(offsets - slope * times)
    half = len(ordered) // 2 + 1
    begin = int(np.argmin(ordered[half - 1 :] - ordered[: len(ordered) - half + 1]))
    return float(np.median(ordered[begin : begin + half])), slope


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """Rotations of a body between two times each, in groups of which the means are compared."""

    starts: Float64Array  # (N,) float64 [s]
    stops: Float64Array  # (N,) float64 [s]
    vectors: Float64Array  # (N, 3) float64 [rad], rotation vectors in the body frame
    begins: Int64Array  # (G,) int64, number of the first rotation of each group
    chunks: Int64Array  # (G,) int64, the chunk without gaps of each group

    @classmethod
    def of(cls, orientations: Orientations, origin_ns: int, least: float) -> "_Steps":
        """Rotations to the next sample at least `least` seconds later; those that overlap are a group."""
        # so the noise of single orientations averages out
        stride = 1
        if least > 0 and orientations.step_ns > 0:
            stride = max(1, int(np.ceil(least * 1e9 / orientations.step_ns - 1e-3)))
        none = np.zeros(0, np.int64)
        first, begins, count = [none], [none], 0
        for chunk in orientations.parts:
            rows = np.arange(chunk.start, chunk.stop - stride)
            # groups of one length: the remainder at the end of a chunk is left out
            rows = rows[: len(rows) - len(rows) % stride]
            begins.append(count + np.arange(0, len(rows), stride))
            first.append(rows)
            count += len(rows)
        starting, grouped = np.concatenate(first), np.concatenate(begins)
        seconds = np.asarray((orientations.timestamps_ns - origin_ns) * 1e-9, np.float64)
        vectors = orientations.rotations(starting, starting + stride)
        chunks = orientations.chunks[starting[grouped]]
        return cls(seconds[starting], seconds[starting + stride], vectors, grouped, chunks)

    def mean(self, values: Float64Array) -> Float64Array:
        """The mean (G, …) over each group of values (N, …)."""
        counts = np.diff(np.append(self.begins, len(values))).reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(np.add.reduceat(values, self.begins, axis=0) / counts, np.float64)


_LEAST_COMMON = 2.0  # seconds that two streams need in common
_MOST_COMMON = 86_400.0  # no drive is longer [s]; wrong times of both must not make millions of parts
_GRID = 0.02  # step of the coarse search [s]; rotations of people and cars are slower
_PART = 120.0  # seconds that are searched at once: a skew of 200 ppm moves the offset by 24 ms in them
_BIAS_WINDOW = 60.0  # a gyroscope's bias is constant for so many seconds

_LEAST_SECONDS = (0.05, 0.1, 0.2, 0.4)
"""Rotations over at least so many seconds are compared, the shortest that the noise allows [s]."""

_NOISE_SHARE = 0.1  # largest share of noise in the differences of the rates between start and stop of a rotation
_MOST_NOISE = 1.0  # with more noise than motion in them nothing is compared
_FAR_LESS = 4.0  # lags whose correlation is farther from 1 than the best one's by this factor are left out

_PRIORS = np.array([10.0, 2e-3, 0.7, 0.7, 0.7])
"""Standard deviations of offset [s], skew and rotation [rad] around the start."""


def compare_rotations(
    reference: Orientations,
    stream: Orientations,
    *,
    reach_ns: int = REACH_NS,
    tolerance_ns: int = TOLERANCE_NS,
    reference_from_stream: Float64Array | None = None,
) -> ClockEstimate:
    """Estimate offset and skew of a stream's clock from the rotation that two streams measure.

    The streams may have any rates and gaps, their bodies any constant rotation between them, and either a constant
    bias. First the lag is searched at which the angular velocities are most alike; then rotations from sample to sample
    of the slower stream are fitted by those of the other one between the same times, with offset, skew, rotation and
    bias free at once.

    Args:
        reference: the stream whose clock is taken as correct.
        stream: the other one.
        reach_ns: largest offset that is searched [ns].
        tolerance_ns: largest offset that counts as in step [ns].
        reference_from_stream: (3, 3), prior rotation between the bodies, used where the motion does not determine it.

    Source: the rate correlation before the fit, and the continuous-time fit of offset with the rotation, are as in
    Furgale, Rehder and Siegwart 2013, "Unified Temporal and Spatial Calibration for Multi-Sensor Systems".
    """
    if min(len(reference), len(stream)) < 8:
        return ClockEstimate.unknown(f"{len(reference)} and {len(stream)} rotation samples; expected 8 or more of each")
    finer_is_stream = stream.step_ns <= reference.step_ns
    coarse, fine = (reference, stream) if finer_is_stream else (stream, reference)
    expected = np.eye(3) if reference_from_stream is None else reference_from_stream
    pair = _Pair.of(coarse, fine, expected if finer_is_stream else expected.T)
    clocks = _Clocks(pair.origin_ns, finer_is_stream, tolerance_ns)
    if not pair.fine or pair.common < _LEAST_COMMON:
        return ClockEstimate.unknown(
            f"{max(pair.common, 0.0):.1f} s in common; expected {_LEAST_COMMON:.0f} s or more without gaps"
        )
    if pair.common > _MOST_COMMON:
        return ClockEstimate.unknown(
            f"{pair.common:.6g} s in common; expected at most {_MOST_COMMON:.0f}: is a timestamp wrong?"
        )
    starts = list(pair.starts(reach_ns * 1e-9))
    if not starts:
        return ClockEstimate.unknown("there is no rotation in both at once")
    if max(peak.margin for _, peak in starts) < _LEAST_MARGIN:
        offsets = [offset for (offset, _), _ in starts]
        return ClockEstimate.unknown(clocks.ambiguity(offsets), span_ns=round(pair.common * 1e9))
    candidates = [candidate for line, peak in starts if (candidate := pair.fitted(line, peak)) is not None]
    return clocks.choose(candidates)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """The slower stream as rotations, the other one as a curve, both in seconds after one origin."""

    origin_ns: int
    coarse: Orientations
    fine: RotationCurve
    coarse_curve: RotationCurve
    fine_noise: Float64Array
    coarse_from_fine: Float64Array
    grid: float
    common: float
    """Seconds in which both have samples, by their timestamps."""

    @classmethod
    def of(cls, coarse: Orientations, fine: Orientations, coarse_from_fine: Float64Array) -> "_Pair":
        origin_ns = int(max(coarse.timestamps_ns[0], fine.timestamps_ns[0]))
        grid = max(_GRID, coarse.step_ns * 1e-9)
        curves = RotationCurve(fine, origin_ns), RotationCurve(coarse, origin_ns)
        stop_ns = min(int(coarse.timestamps_ns[-1]), int(fine.timestamps_ns[-1]))
        return cls(origin_ns, coarse, *curves, fine.rate_noise(), coarse_from_fine, grid, (stop_ns - origin_ns) * 1e-9)

    def starts(self, reach: float) -> Iterator[tuple[tuple[float, float], _Peak]]:
        """First guesses of offset and skew: the best lags of a short drive, a line through those of a long one."""
        reach = min(reach, max(self.common / 2, 4 * self.grid))
        if self.common <= 2.5 * _PART:
            peaks = self._peaks(0.0, self.common, reach)
            for peak in peaks:
                # much weaker peaks need no fit to be told from the best one
                if 1 - peak.score > _FAR_LESS * (1 - peaks[0].score) + 0.1:
                    break
                yield (peak.lag * self.grid, 0.0), peak
            return
        edges = np.linspace(0.0, self.common, int(self.common // _PART) + 1)
        found = [(0.5 * (a + b), peak) for a, b in pairwise(edges.tolist()) for peak in self._peaks(a, b, reach)[:1]]
        if len(found) >= 2:
            times = np.array([time for time, _ in found]) - 0.5 * self.common
            lags = np.array([peak.lag * self.grid for _, peak in found])
            yield _robust_line(times, lags), max((peak for _, peak in found), key=lambda peak: peak.margin)

    def _peaks(self, begin: float, end: float, reach: float) -> list[_Peak]:
        edges = np.arange(begin, end, self.grid)
        wide = np.arange(begin - np.ceil(reach / self.grid) * self.grid, end + reach, self.grid)
        first = self.coarse_curve.rotations(edges[:-1], edges[1:]) / self.grid
        second = self.fine.rotations(wide[:-1], wide[1:]) / self.grid
        shift = round((begin - wide[0]) / self.grid)
        steps = int(reach / self.grid)
        peaks = _correlation_peaks(first, second, steps, centre=shift, expected=self.coarse_from_fine)
        return [replace(peak, lag=peak.lag - shift) for peak in peaks]

    def fitted(self, line: tuple[float, float], peak: _Peak) -> _Candidate | None:
        """Refine an offset over rotations that are as short as the noise allows."""
        own = self.coarse.step_ns * 1e-9
        start = np.array([*line, 0.0, 0.0, 0.0])
        chosen: tuple[_RotationModel, _Fit] | None = None
        for least in (0.0, *(seconds for seconds in _LEAST_SECONDS if seconds > own)):
            steps = _Steps.of(self.coarse, self.origin_ns, least)
            if len(steps.begins) < (16 if chosen is not None else 1):
                break
            model = _RotationModel(self, steps, peak.rotation)
            found = fit(model, start, _PRIORS, whiten=False)
            if found is None:
                break
            chosen, start = (model, found), found.parameters
            if model.noise_share(found) <= _NOISE_SHARE:
                break
        if chosen is None:
            return None
        model, found = chosen
        if model.noise_share(found) > _MOST_NOISE:
            return None
        whitened = fit(model, found.parameters, _PRIORS)
        return None if whitened is None else model.candidate(whitened, peak)


class _RotationModel:
    """Rotations of the slower stream, predicted by the curve of the other one: offset, skew, three of rotation."""

    def __init__(self, pair: _Pair, steps: _Steps, coarse_from_fine: Float64Array) -> None:
        self.pair, self.steps, self.coarse_from_fine = pair, steps, coarse_from_fine
        self.middle = 0.5 * pair.common
        lengths = steps.stops - steps.starts
        self.times = 0.5 * (steps.starts + steps.stops) - self.middle
        self.smoothing = float(np.clip(np.median(lengths), 0.02, 0.4))
        self.vectors = steps.mean(steps.vectors)
        self.nuisances = steps.mean(lengths)[:, None, None] * np.eye(3)
        self.row_times = steps.mean(self.times) + self.middle
        count = max(1, round(pair.common / _BIAS_WINDOW))
        parts = np.clip((self.row_times / max(pair.common, 1e-9) * count).astype(np.int64), 0, count - 1)
        # a new window wherever the part or the chunk changes
        self.windows = np.zeros(len(parts), np.int64)
        self.windows[1:] = np.cumsum((np.diff(parts) != 0) | (np.diff(steps.chunks) != 0))

    def __call__(self, parameters: Float64Array, amounts: Float64Array) -> Linearised:
        del amounts  # the biases are linear
        offset, skew = parameters[:2]
        rotation = self.rotated(parameters)
        shifts = offset + skew * self.times
        starts, stops = self.steps.starts + shifts, self.steps.stops + shifts
        vectors = self.pair.fine.rotations(starts, stops)
        before = self.pair.fine.rates(starts, self.smoothing)
        after = self.pair.fine.rates(stops, self.smoothing)
        slope = after - before + 0.5 * np.cross(vectors, before + after)
        vectors, slope, drift = (self.steps.mean(x) for x in (vectors, slope, slope * self.times[:, None]))
        known = finite_rows(np.hstack([vectors, slope]))
        moved, slope, drift = (np.where(known[:, None], x, 0.0) @ rotation.T for x in (vectors, slope, drift))
        # (N, 3, 3) cross-product matrices of -moved
        crossed = np.cross(np.eye(3), moved[:, None, :]).swapaxes(1, 2)
        jacobian = np.concatenate([slope[:, :, None], drift[:, :, None], crossed], axis=2)
        return Linearised(self.vectors - moved, jacobian, self.nuisances, known, self.windows)

    def rotated(self, parameters: Float64Array) -> Float64Array:
        """The rotation (3, 3) from the finer stream's body into the other's."""
        rotation = matrix_from_rotation_vector(parameters[2:5])
        return np.asarray(rotation @ self.coarse_from_fine, np.float64)

    def noise_share(self, found: _Fit) -> float:
        """The share of the finer stream's noise in the differences of the rates."""
        # the noise is no more than the residuals, and no more than what single samples of the stream vary by
        if not found.used.any():
            return 0.0
        at = self(found.parameters, found.amounts)
        left = at.without_nuisances(found.amounts)[found.used]
        of_residuals = (1.4826 * np.median(np.abs(left), axis=0) / self.smoothing) ** 2
        noise = 2.0 * np.minimum(of_residuals, self.pair.fine_noise / self.smoothing)
        changes = at.jacobian[found.used, :, 0]
        return float(noise.sum() / max(float((changes**2).mean(axis=0).sum()), 1e-300))

    def candidate(self, found: _Fit, peak: _Peak) -> _Candidate:
        """The fit with what is needed to judge it; without motion there are biases alone."""
        still = replace(self(found.parameters, found.amounts), residuals=self.vectors)
        return _Candidate(
            fit=found,
            times=self.row_times,
            middle=self.middle,
            span=self.pair.common,
            without_motion=misfit_of(still, colour=found.colour, scales=found.scales),
            score=peak.score,
            margin=peak.margin,
            rotation=self.rotated(found.parameters),
        )


_LEAST_FIXES = 12
_LEAST_COMMON_FIXES = 5.0  # seconds that fixes and a trajectory need in common
_LEAST_DISTANCE = 1.0  # fixes that stay within so many metres are of a stationary body, and vary by their errors
_LAG = 0.2  # step of the search [s]; from so near the fit converges where the noise of fixes is white
_FINE_LAG = 0.05  # the same where it is correlated: whitened motion is that of the accelerations
_MOST_SEARCHED = 3000  # largest number of fixes in the search and for the biases of an IMU; the last fit uses all

_MOVED = 12.0  # windows of a trajectory move with the searched offset in such steps [s]

_LEAST_SHARE = 0.01
"""Least share of the speed that must determine the offset, lest errors of the trajectory do; on synthetic streets it
is a tenth to a half."""

_LEAST_LIKELY = 100.0  # offsets whose log-likelihood is lower than the best one's by so much are dropped
_FARTHEST = 1.0  # longer windows and the noise's correlation do not change an offset by more [s]

_MOST_SCALE = 1.5
"""Largest factor between the sizes of both motions, which are in metres: noise does not fit noise at its own size."""

_MOST_WORSE = 0.15
"""Largest growth of the logarithm of the residuals over longer windows: a bad IMU is not described by its noise."""

_POSITION_PRIORS = (10.0, 2e-3)  # standard deviations of offset [s] and skew around the start


def compare_trajectories(
    fixes: Fixes,
    trajectory: SmoothedTrajectory,
    *,
    origin_ns: int,
    fixes_are_reference: bool,
    reach_ns: int,
    tolerance_ns: int = TOLERANCE_NS,
    lever: Float64Array | None = None,
    lever_sigma: float = LEVER_SIGMA,
) -> ClockEstimate:
    """Estimate offset and skew between fixes and a trajectory of the same body.

    The fixes are the trajectory at their times, shifted by the offset, up to what the trajectory does not know: in
    every window a rotation and a scale on the ground, and a polynomial in the time. Changes of the body's speed beyond
    that determine the offset. The receiver's position on the body is estimated along with it; steady turns and a
    constant speed leave the offset uncertain by it.

    Args:
        fixes: positions at some times.
        trajectory: moves between them.
        origin_ns: origin of the trajectory's seconds.
        fixes_are_reference: whose clock is taken as correct.
        reach_ns: largest offset that is searched [ns].
        tolerance_ns: largest offset that counts as in step [ns].
        lever: (3,) position of the receiver on the body of the trajectory [m]; None for its origin.
        lever_sigma: its standard deviation on each axis [m].

    Source: linear amounts are eliminated as in Golub and Pereyra 1973, "The Differentiation of Pseudo-Inverses and
    Nonlinear Least Squares Problems Whose Variables Separate".
    """
    if len(fixes) < _LEAST_FIXES:
        return ClockEstimate.unknown(f"{len(fixes)} fixes; expected {_LEAST_FIXES} or more")
    extent = max(np.ptp(fixes.locations.real), np.ptp(fixes.locations.imag))
    if extent < _LEAST_DISTANCE:
        return ClockEstimate.unknown(f"fixes within {extent:.2f} m; expected a body that moves {_LEAST_DISTANCE:.0f} m")
    model = _TrajectoryModel.of(fixes, trajectory, origin_ns)
    known = model.known
    common = float(np.ptp(model.times[known])) if known.any() else 0.0
    if known.sum() < _LEAST_FIXES or common < _LEAST_COMMON_FIXES:
        return ClockEstimate.unknown(
            f"{int(known.sum())} fixes in {common:.1f} s in common; expected {_LEAST_FIXES} in "
            f"{_LEAST_COMMON_FIXES:.0f} s or more"
        )
    priors = np.array([*_POSITION_PRIORS, *[max(lever_sigma, 1e-6)] * 3])
    location = np.zeros(3) if lever is None else lever
    reach = min(reach_ns * 1e-9, common / 2)
    part = model.part(_MOST_SEARCHED)

    def fitted_from(lags: list[float], like: _Fit | None = None) -> list[_Fit]:
        starts = [np.array([lag, 0.0, *location]) for lag in lags]
        likes = [None if like is None else replace(like, parameters=start) for start in starts]
        near = (fit(part, start, priors, like=one) for start, one in zip(starts, likes, strict=True))
        return [one for one in near if one is not None and abs(one.parameters[0]) <= reach + 2 * _LAG]

    found = fitted_from(_lags(part, np.arange(-np.floor(reach / _LAG), np.floor(reach / _LAG) + 1) * _LAG))
    if not found:
        return ClockEstimate.unknown(f"no offset up to {reach:.1f} s makes the motions alike")
    best = min(found, key=lambda near: near.level)
    if best.colour.shape[1]:
        around = best.parameters[0] + np.arange(-_FARTHEST, _FARTHEST + _FINE_LAG, _FINE_LAG)
        found += fitted_from(_lags(part, around[np.abs(around) <= reach], best), best)
        best = min(found, key=lambda near: near.level)
    likely = {round(near.parameters[0], 3): near for near in found if best.evidence_against(near) < _LEAST_LIKELY}
    refined = [_refined(part, near, fixes, location, priors) for near in likely.values()]
    ranked = sorted((one for one in refined if one is not None), key=lambda one: one[1].level)
    if ranked and (doubt := ranked[0][0].doubt(ranked[0][1], reach)):
        return ClockEstimate.unknown(doubt)
    clocks = _Clocks(origin_ns, fixes_are_reference, tolerance_ns)
    return clocks.choose([model.candidate(fitted, common) for model, fitted in ranked])


def _lags(part: "_TrajectoryModel", lags: Float64Array, like: _Fit | None = None) -> list[float]:
    """The offsets among (L,) at which a trajectory fits best, as first guesses; `like`: with the noise of a fit."""
    how = {} if like is None else {"colour": like.colour, "scales": like.scales}
    costs = np.array([misfit_of(part(np.array([lag, 0, 0, 0, 0]), _NO_AMOUNTS), **how) for lag in lags.tolist()])
    padded = np.concatenate([[np.inf], costs, [np.inf]])
    lows = np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] < padded[2:]))
    return [float(lags[k]) for k in lows[np.argsort(costs[lows])][:3]]


def _refined(
    part: "_TrajectoryModel", near: _Fit, fixes: Fixes, location: Float64Array, priors: Float64Array
) -> tuple["_TrajectoryModel", _Fit] | None:
    """Fit the trajectory, chosen by `part`, over longer windows if they fit as well as the short ones; then to all."""
    start = np.array([near.parameters[0], 0.0, *location])
    at, found, like = part, near, None
    while (trajectory := at.trajectory.finer(at.drifts_of(found.amounts))) is not None:
        longer = _TrajectoryModel.of(fixes, trajectory, part.origin_ns).part(_MOST_SEARCHED)
        better = fit(longer, start, priors, like=like)
        if better is None or abs(better.parameters[0] - near.parameters[0]) > _FARTHEST:
            at, found = part, near
            break
        at, found, like = longer, better, better
    if float(np.log(found.scales / near.scales).mean()) >= _MOST_WORSE:
        at, found = part, near
    whole = _TrajectoryModel.of(fixes, at.trajectory, part.origin_ns)
    if len(whole.times) == len(at.times):
        return at, found
    last = fit(whole, start, priors, like=found)
    return None if last is None else (whole, last)


@dataclass(frozen=True, slots=True, eq=False)
class _TrajectoryModel:
    """Fixes predicted by a trajectory: offset, skew, and the receiver's position (3,) on the body."""

    locations: AnyArray
    times: Float64Array
    windows: Int64Array
    bounds: tuple[tuple[float, float], ...]
    polynomials: Float64Array
    trajectory: SmoothedTrajectory
    middle: float
    origin_ns: int

    @classmethod
    def of(cls, fixes: Fixes, trajectory: SmoothedTrajectory, origin_ns: int) -> "_TrajectoryModel":
        """Divide the fixes into windows."""
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
        # centred in each window: kilometres leave no digits for millimetres
        sums = np.zeros(len(bounds), np.complex128)
        np.add.at(sums, windows, fixes.locations)
        locations = fixes.locations - (sums / np.bincount(windows))[windows]
        middle = 0.5 * float(times[0] + times[-1])
        return cls(locations, times, windows, bounds, polynomials, trajectory, middle, origin_ns)

    def part(self, most: int) -> "_TrajectoryModel":
        """Windows spread over the drive with about `most` fixes; all where there are no more."""
        if len(self.times) <= most:
            return self
        chosen = np.unique(self.windows)[:: -(-len(self.times) // most)]
        rows = np.isin(self.windows, chosen)
        return replace(
            self,
            locations=self.locations[rows],
            times=self.times[rows],
            windows=np.searchsorted(chosen, self.windows[rows]),
            bounds=tuple(self.bounds[k] for k in chosen.tolist()),
            polynomials=self.polynomials[rows],
        )

    def drifts_of(self, amounts: Float64Array) -> Float64Array:
        """The amounts of the trajectory's drifts (W, E) among those of all nuisances."""
        return amounts[:, 2 * (self.trajectory.degree + 1) : -2]

    @property
    def known(self) -> BoolArray:
        """At which fixes the trajectory is known, (N,)."""
        return np.asarray(np.isfinite(self._samples(np.zeros(len(self.times))).locations), np.bool_)

    def _samples(self, shifts: Float64Array) -> TrajectorySamples:
        edges = np.searchsorted(self.windows, np.arange(len(self.bounds) + 1))
        # a dead reckoning is known around its window: where times move farther, the windows move with them
        moved = _MOVED * np.round(shifts[edges[:-1]] / _MOVED)
        parts = [
            self.trajectory.at((begin + by, end + by), (self.times + shifts)[first:last])
            for (begin, end), by, first, last in zip(self.bounds, moved.tolist(), edges, edges[1:], strict=False)
        ]
        return TrajectorySamples(
            np.concatenate([_centred(part.locations) for part in parts]),
            np.concatenate([part.velocities for part in parts]),
            np.concatenate([part.axes for part in parts]),
            np.concatenate([part.drifts for part in parts]),
            np.concatenate([part.drift_velocities for part in parts]),
            parts[0].drift_sigmas,
        )

    def __call__(self, parameters: Float64Array, amounts: Float64Array) -> Linearised:
        offset, skew, lever = parameters[0], parameters[1], parameters[2:5]
        since = self.times - self.middle
        samples = self._samples(offset + skew * since)
        known = np.isfinite(samples.locations) & np.isfinite(samples.velocities)
        locations, velocities = (np.where(known, x, 0.0) for x in (samples.locations, samples.velocities))
        axes, drifts = (np.where(known[:, None], x, 0.0) for x in (samples.axes, samples.drifts))
        rotation = np.zeros(len(locations), np.complex128)
        if amounts.shape[1]:
            rotation = (amounts[:, -2] + 1j * amounts[:, -1])[self.windows]
            drifting = np.where(known[:, None], samples.drift_velocities, 0.0)
            velocities = velocities + (drifting * self.drifts_of(amounts)[self.windows]).sum(axis=1)
        moved = (locations + axes @ lever)[:, None]
        of_drifts = rotation[:, None] * drifts
        nuisances = np.hstack([self.polynomials, 1j * self.polynomials, of_drifts, moved, 1j * moved])
        speed = (rotation * velocities)[:, None]
        slopes = np.hstack([speed, speed * since[:, None], rotation[:, None] * axes])
        free = np.full(2 * (self.trajectory.degree + 1), np.inf)
        sigmas = np.concatenate([free, samples.drift_sigmas, [np.inf, np.inf]])
        return Linearised(
            _split(self.locations), _split(slopes), _split(nuisances), known, self.windows, nuisance_sigmas=sigmas
        )

    def doubt(self, found: _Fit, reach: float) -> str:
        """Why the fit is not of a motion in common that determines the offset; "" where it is."""
        if self.speed_share(found) < _LEAST_SHARE:
            return "the motion is too even to tell an offset from another position and heading"
        scale = float(np.median(np.hypot(*found.amounts[:, -2:].T)))
        if not 1 / _MOST_SCALE <= scale <= _MOST_SCALE:
            return f"by offsets up to {reach:.1f} s the motions differ in size by more than a factor of {_MOST_SCALE}"
        return ""

    def speed_share(self, found: _Fit) -> float:
        """The share of the speed that determines the offset, beyond what the nuisances explain."""
        at = self(found.parameters, found.amounts)
        scales = _scales(at.without_nuisances(found.amounts), found.used)
        slopes = _eliminate_nuisances(at, found.used.astype(np.float64), scales)[1][found.used]
        length = self.bounds[0][1] - self.bounds[0][0]
        # positions of an even motion over a window have this standard deviation
        speed = float(np.sqrt(12.0 * (np.abs(self.locations) ** 2).mean())) / length
        return float(np.sqrt((slopes[:, :, 0] ** 2).sum(axis=1).mean())) / max(speed, 1e-9)

    def candidate(self, found: _Fit, common: float) -> _Candidate:
        """The fit with what is needed to judge it; without motion there are polynomials alone."""
        at = self(found.parameters, found.amounts[:, :0])
        still = replace(at, nuisances=at.nuisances[:, :, :-2], nuisance_sigmas=None)
        return _Candidate(
            fit=found,
            times=self.times,
            middle=self.middle,
            span=common,
            without_motion=misfit_of(still, colour=found.colour, scales=found.scales),
            model_sigma=self.trajectory.model_sigma,
        )


def _centred(locations: AnyArray) -> AnyArray:
    known = np.isfinite(locations)
    return locations - locations[known].mean() if known.any() else locations


def _split(values: AnyArray) -> Float64Array:
    """Complex (N, …) as (N, 2, …)."""
    return np.stack([values.real, values.imag], axis=1)
