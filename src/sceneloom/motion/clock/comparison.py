"""Time offset and skew between two clocks, from angular velocities or from positions."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import combinations, pairwise

import msgspec
import numpy as np
from numpy.polynomial.legendre import legvander

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from sceneloom.motion.clock.signals import (
    LEAST_KNOTS,
    Fixes,
    Orientations,
    RotationCurve,
    SmoothedTrajectory,
    TrajectorySamples,
    chunk_slices,
    finite_rows,
    relative_rotation,
)


@dataclass(frozen=True, slots=True, eq=False)
class _Steps:
    """Rotations of a body from one time to another, and which of them form a group.

    Attributes:
        starts, stops: (N,) float64 [s] after a given origin.
        vectors: (N, 3) float64 [rad], rotation vectors in the body's frame.
        begins: (G,) int64, number of the first rotation of each group; a group ends where the next begins.
        chunks: (G,) int64, which piece without gaps each group lies in.
    """

    starts: Float64Array
    stops: Float64Array
    vectors: Float64Array
    begins: Int64Array
    chunks: Int64Array

    def __len__(self) -> int:
        return len(self.begins)

    def mean(self, values: Float64Array) -> Float64Array:
        """Give the mean (G, …) over each group of something that each rotation has, (N, …)."""
        counts = np.diff(np.append(self.begins, len(values)))
        means: Float64Array = np.add.reduceat(values, self.begins, axis=0) / counts.reshape(
            -1, *[1] * (values.ndim - 1)
        )
        return means


def _steps_of(rotating: Orientations, origin_ns: int, least: float) -> _Steps:
    """Give the rotations from each sample to the next one that is at least `least` seconds later.

    As many as overlap are one group, so that noise of single orientations averages out.
    """
    stride = 1
    if least > 0 and rotating.step_ns > 0:
        stride = max(1, int(np.ceil(least * 1e9 / rotating.step_ns - 1e-3)))
    first: list[Int64Array] = []
    begins: list[Int64Array] = []
    count = 0
    for piece in chunk_slices(rotating.chunks):
        rows = np.arange(piece.start, piece.stop - stride)
        # groups of one length: what is left over at the end of a piece is left out
        rows = rows[: len(rows) - len(rows) % stride]
        begins.append(count + np.arange(0, len(rows), stride))
        first.append(rows)
        count += len(rows)
    starting = np.concatenate([*first, np.zeros(0, np.int64)]).astype(np.int64)
    grouped = np.concatenate([*begins, np.zeros(0, np.int64)]).astype(np.int64)
    seconds = np.asarray((rotating.timestamps_ns - origin_ns) * 1e-9, np.float64)
    rotations = relative_rotation(rotating.quaternions_xyzw[starting], rotating.quaternions_xyzw[starting + stride])
    chunks = rotating.chunks[starting[grouped]] if len(grouped) else np.zeros(0, np.int64)
    return _Steps(seconds[starting], seconds[starting + stride], rotations, grouped, chunks)


def rate_noise(rotating: Orientations) -> Float64Array:
    """The power of the white noise in the rates of a rotating, (3,) [rad²/s]: what samples jump about, at most.

    Source: second differences of white noise have six times its variance.
    """
    steps = _steps_of(rotating, int(rotating.timestamps_ns[0]), 0.0)
    if len(steps) < LEAST_KNOTS:
        return np.full(3, np.inf)
    lengths = steps.stops - steps.starts
    jumps = np.diff(steps.vectors / lengths[:, None], n=2, axis=0)
    variance = (1.4826 * np.median(np.abs(jumps), axis=0)) ** 2 / 6.0
    return np.asarray(variance * np.median(lengths), np.float64)


_HUBER = 2.0
"""Residuals beyond so many standard deviations count linearly. Source: Huber 1964."""

_MOST_LAGS = 10
"""Order of the autoregression that whitens the noise, where there are samples enough."""

_ROUNDS, _STEPS = 3, 10

_SERIAL = 200_000
"""Products of matrices are taken in parts of so many multiplications: libraries share larger ones among threads, which
cost more than they save."""

_CLOSE = 0.02
"""_Steps are small enough at this share of a standard deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """A model around some parameters.

    Attributes:
        residuals: (N, K): measured minus modelled, without what the nuisances explain.
        jacobian: (N, K, P), derivative of what is modelled.
        nuisances: (N, K, M), columns whose amounts are free in every window.
        known: (N,) whether a row can be used.
        expected: (M,), standard deviation of the nuisances' amounts, infinite where free; None: all are.
    """

    residuals: Float64Array
    jacobian: Float64Array
    nuisances: Float64Array
    known: BoolArray
    expected: Float64Array | None = None

    @property
    def precision(self) -> Float64Array:
        """What is known of the nuisances' amounts before, (M,)."""
        if self.expected is None:
            return np.zeros(self.nuisances.shape[2])
        return np.asarray(self.expected**-2.0, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """What came out.

    Attributes:
        parameters: (P,).
        covariance: (P, P).
        information: (P, P), of the measurements alone.
        misfit: sum of the squared whitened residuals in units of `scales`, robust.
        rows: how many rows were used.
        scales: (K,), standard deviation of the whitened residuals.
        jacobian, residuals: (N, K, P), (N, K): whitened, weighted, without nuisances, in units of `scales`.
        used: (N,).
        amounts: (W, M), of the nuisances in each window.
        colour: (K, L), the autoregression.
    """

    parameters: Float64Array
    covariance: Float64Array
    information: Float64Array
    misfit: float
    rows: int
    scales: Float64Array
    jacobian: Float64Array
    residuals: Float64Array
    used: BoolArray
    amounts: Float64Array
    colour: Float64Array

    @property
    def level(self) -> float:
        """Logarithm of the misfit of a value [in its own unit], so that fits in different units of noise compare."""
        mean = self.misfit / max(self.rows * self.residuals.shape[1], 1)
        return float(np.log(max(mean, 1e-300)) + 2 * np.log(self.scales).mean())

    def evidence_against(self, other: "_Fit") -> float:
        """Logarithm of how much likelier the measurements are by this fit than by another one."""
        values = self.rows * int(self.residuals.shape[1])
        return 0.5 * values * (other.level - self.level)


_Model = Callable[[Float64Array, Float64Array], Linearised]
"""Gives the model at parameters (P,) and amounts of the nuisances (W, M)."""


def fit(
    model: _Model,
    start: Float64Array,
    prior_sigmas: Float64Array,
    windows: Int64Array,
    *,
    begin: Float64Array | None = None,
    whiten: bool = True,
    colour: Float64Array | None = None,
    scales: Float64Array | None = None,
) -> _Fit | None:
    """Fit parameters by Gauss-Newton; None where too few rows are known.

    Noise that is alike from row to row is whitened by an autoregression that is fitted to the residuals, nuisances
    are free in each window, large residuals count less, and the covariance is that of Newey and West from what
    correlation is left.

    Args:
        start: (P,).
        prior_sigmas: (P,), how far from the start parameters may be; infinite for anywhere.
        windows: (N,), number of the window of each row, ascending; the noise is not followed from one to the next.
        begin: (P,), where to begin, near to what will come out; None: at the start.
        whiten: whether to.
        colour, scales: (K, L) and (K,) to take as they are.

    Source: whitening before the estimate of Newey and West 1987 is Andrews and Monahan 1992; the autoregression is
    that of Yule 1927 and Walker 1931; weights are those of Huber 1964.
    """
    parameters = (start if begin is None else begin).astype(np.float64)
    count = int(windows[-1]) + 1 if len(windows) else 0
    at = model(parameters, np.zeros((count, 0)))
    fixed_colour, fixed_scales = colour, scales
    colour = np.zeros((at.residuals.shape[1], 0)) if colour is None else colour
    precision = 1.0 / prior_sigmas**2
    first = _solve(at, windows, colour, fixed_scales, precision, parameters - start)
    if first is None:
        return None
    _, amounts, state = first
    for round_number in range(_ROUNDS if whiten or fixed_colour is not None else 2):
        for _ in range(_STEPS):
            at = model(parameters, amounts)
            solved = _solve(at, windows, colour, fixed_scales, precision, parameters - start, scales=state.scales)
            if solved is None:
                return None
            step, amounts, state = solved
            parameters = parameters + step
            spread = np.sqrt(np.diag(np.linalg.pinv(state.information + np.diag(precision + 1e-300))))
            if (np.abs(step) <= _CLOSE * spread + 1e-12).all():
                break
        if fixed_colour is None and whiten and round_number < _ROUNDS - 1:
            colour = _colour(state.raw, state.used, windows)
    return _finished(parameters, amounts, state, precision, colour, windows)


def misfit_of(
    model: _Model,
    parameters: Float64Array,
    windows: Int64Array,
    *,
    colour: Float64Array | None = None,
    scales: Float64Array | None = None,
) -> float:
    """The misfit of a model at some parameters: in units of `scales`, else the mean residual's size, squared.

    It is infinite where too few rows are known.
    """
    at = model(parameters, np.zeros((int(windows[-1]) + 1, 0)))
    bare = replace(at, jacobian=at.jacobian[:, :, :0])
    filter_by = np.zeros((at.residuals.shape[1], 0)) if colour is None else colour
    solved = _solve(bare, windows, filter_by, scales, np.zeros(0), np.zeros(0))
    if solved is None:
        return float("inf")
    state = solved[2]
    if scales is not None:
        return state.misfit
    sizes = np.abs(state.residuals[state.used]) * state.scales
    return float(sizes.mean() ** 2)


def _bare_slopes(model: _Model, found: _Fit, windows: Int64Array) -> Float64Array:
    """What a fit's parameters change of the rows that were used, (R, K, P), beyond what the nuisances may do."""
    at = model(found.parameters, found.amounts)
    reported = at.residuals, at.jacobian, at.nuisances
    used = found.used.astype(np.float64)
    scales = _scales(at.residuals - _explained(at.nuisances, found.amounts, windows), found.used)
    slopes = _without_nuisances(*reported, used, scales, windows, at.precision)[1]
    return slopes[found.used]


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    information: Float64Array
    residuals: Float64Array
    jacobian: Float64Array
    used: BoolArray
    scales: Float64Array
    raw: Float64Array
    held: "_Held"

    @property
    def misfit(self) -> float:
        return float((self.residuals**2).sum() + (self.held.residuals**2).sum())


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """What is known before of nuisances' amounts counts as measurements, too.

    Attributes:
        residuals, jacobian: (H,) and (H, P), in standard deviations.
        spent: how many nuisances the measurements decide.
    """

    residuals: Float64Array
    jacobian: Float64Array
    spent: float

    @property
    def information(self) -> Float64Array:
        """What they report the parameters, (P, P)."""
        return np.asarray(self.jacobian.T @ self.jacobian, np.float64)


def _solve(
    at: Linearised,
    windows: Int64Array,
    colour: Float64Array,
    fixed_scales: Float64Array | None,
    precision: Float64Array,
    moved: Float64Array,
    *,
    scales: Float64Array | None = None,
) -> tuple[Float64Array, Float64Array, _State] | None:
    """One step of the parameters, the amounts of the nuisances, and what belongs to the covariance."""
    residuals, used = _filtered(at.residuals, at.known, windows, colour)
    jacobian, _ = _filtered(at.jacobian, at.known, windows, colour)
    nuisances, _ = _filtered(at.nuisances, at.known, windows, colour)
    size = len(moved)
    if used.sum() < size + 4:
        return None
    # twice: the weights come from residuals without nuisances, and decide how these are taken out
    weights = used.astype(np.float64)
    scales = np.ones(residuals.shape[1]) if scales is None else scales
    for _ in range(2):
        clean_r, clean_j, amounts, held = _without_nuisances(
            residuals, jacobian, nuisances, weights, scales, windows, at.precision
        )
        scales = _scales(clean_r, used) if fixed_scales is None else fixed_scales
        weights = used * _weights(clean_r / scales)
    root = np.sqrt(weights)[:, None]
    r = clean_r / scales * root
    j = clean_j / scales[None, :, None] * root[:, :, None]
    slopes = j.reshape(r.size, size)
    reported = _inner(slopes, np.concatenate([slopes, r.reshape(-1, 1)], axis=1))
    information = reported[:, :size] + held.information
    gradient = reported[:, size] + held.jacobian.T @ held.residuals - precision * moved
    step = np.linalg.lstsq(information + np.diag(precision), gradient, rcond=None)[0].astype(np.float64)
    raw = at.residuals - _explained(at.nuisances, amounts, windows)
    return step, amounts, _State(information, r, j, used & (weights > 0), scales, raw, held)


def _without_nuisances(
    residuals: Float64Array,
    jacobian: Float64Array,
    nuisances: Float64Array,
    weights: Float64Array,
    scales: Float64Array,
    windows: Int64Array,
    precision: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array, _Held]:
    """Take out of residuals and derivatives what the nuisances of each window can explain."""
    clean_r, clean_j = residuals.copy(), jacobian.copy()
    count, columns = int(windows[-1]) + 1, nuisances.shape[2]
    amounts = np.zeros((count, columns))
    size = jacobian.shape[2]
    if columns == 0:
        return clean_r, clean_j, amounts, _Held(np.zeros(0), np.zeros((0, size)), 0.0)
    edges = np.searchsorted(windows, np.arange(count + 1))
    known_before = precision > 0
    held, spent = [], 0.0
    for window in range(count):
        rows = slice(edges[window], edges[window + 1])
        root = np.sqrt(weights[rows])[:, None] / scales
        basis = (nuisances[rows] * root[:, :, None]).reshape(-1, columns)
        reported = np.concatenate([residuals[rows, :, None], jacobian[rows]], axis=2)
        targets = (reported * root[:, :, None]).reshape(-1, 1 + size)
        products = _inner(basis, np.concatenate([basis, targets], axis=1))
        lengths = np.sqrt(np.maximum(np.diag(products) + precision, 1e-300))
        normal = (products[:, :columns] + np.diag(precision)) / np.outer(lengths, lengths)
        asked = np.concatenate([products[:, columns:] / lengths[:, None], np.eye(columns)], axis=1)
        solved = np.linalg.solve(normal + 1e-10 * np.eye(columns), asked) / lengths[:, None]
        solution = solved[:, : 1 + size]
        amounts[window] = solution[:, 0]
        left = reported - _times(nuisances[rows].reshape(-1, columns), solution).reshape(reported.shape)
        clean_r[rows], clean_j[rows] = left[:, :, 0], left[:, :, 1:]
        held.append(np.sqrt(precision[known_before])[:, None] * solution[known_before])
        kept = np.diag(solved[:, 1 + size :])[known_before] / lengths[known_before]
        spent += columns - float(kept @ precision[known_before])
    before = np.concatenate(held)
    return clean_r, clean_j, amounts, _Held(before[:, 0], before[:, 1:], spent)


def _inner(left: Float64Array, right: Float64Array) -> Float64Array:
    """The product of (R, A) rotated over with (R, B), where R is large."""
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


def _explained(nuisances: Float64Array, amounts: Float64Array, windows: Int64Array) -> Float64Array:
    explained: Float64Array = np.einsum("nkm,nm->nk", nuisances, amounts[windows])
    return explained


def _filtered(
    values: Float64Array, known: BoolArray, windows: Int64Array, colour: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Whiten rows, (N, K, …), by what the rows before them report; rows without all of those before are not used."""
    whitened = np.where(known.reshape(-1, *[1] * (values.ndim - 1)), values, 0.0)
    used = known.copy()
    plain = whitened.copy()
    for lag in range(1, colour.shape[1] + 1):
        factors = colour[:, lag - 1].reshape(1, -1, *[1] * (values.ndim - 2))
        whitened[lag:] -= factors * plain[:-lag]
        used[lag:] &= known[:-lag] & (windows[lag:] == windows[:-lag])
        used[:lag] = False
    whitened[~used] = 0.0
    return whitened, used


def _colour(residuals: Float64Array, used: BoolArray, windows: Int64Array) -> Float64Array:
    """Fit an autoregression (K, L) to the residuals, clipped so that outliers do not decide."""
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
    chosen = [_autoregression(row, int(used.sum())) for row in moments]
    colour = np.zeros((components, max(map(len, chosen))))
    for k, factors in enumerate(chosen):
        colour[k, : len(factors)] = factors
    return colour


def _autoregression(moments: Float64Array, count: int) -> Float64Array:
    """The autoregression of moments at lags 0 … L, of the order that the number of samples warrants.

    Source: Levinson 1947 and Durbin 1960; the order is that of Schwarz 1978, "Estimating the Dimension of a Model".
    """
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


def _weights(residuals: Float64Array) -> Float64Array:
    size = np.sqrt((residuals**2).mean(axis=1))
    weights: Float64Array = np.minimum(1.0, _HUBER / np.maximum(size, 1e-12))
    return weights


def _finished(
    parameters: Float64Array,
    amounts: Float64Array,
    state: _State,
    precision: Float64Array,
    colour: Float64Array,
    windows: Int64Array,
) -> _Fit:
    rows = int(state.used.sum())
    scores = (state.jacobian * state.residuals[:, :, None]).sum(axis=1)
    meat = _long_run(scores, windows) + state.held.information
    freedom = rows / max(rows - len(parameters) - state.held.spent / state.residuals.shape[1], 1.0)
    inverse = np.linalg.pinv(state.information + np.diag(precision))
    # the scales are medians, which know nothing of the tails that the weights leave
    plain = np.diag(inverse) * float((state.residuals[state.used] ** 2).mean())
    robust = inverse @ (meat + np.diag(precision)) @ inverse
    lifted = np.sqrt(np.maximum(plain / np.maximum(np.diag(robust), 1e-300), 1.0))
    covariance = freedom * robust * np.outer(lifted, lifted)
    return _Fit(
        parameters,
        covariance,
        state.information,
        state.misfit,
        rows,
        state.scales,
        state.jacobian,
        state.residuals,
        state.used,
        amounts,
        colour,
    )


def _long_run(scores: Float64Array, windows: Int64Array) -> Float64Array:
    """The covariance of the sum of (N, P) scores that are alike from row to row.

    Source: Newey and West 1987, eq. 5; the number of lags is that of their 1994 paper.
    """
    total = _inner(scores, scores)
    lags = int(4 * (len(scores) / 100) ** (2 / 9))
    for lag in range(1, lags + 1):
        same = (windows[lag:] == windows[:-lag])[:, None]
        part = _inner(scores[lag:] * same, scores[:-lag])
        total = total + (1 - lag / (lags + 1)) * (part + part.T)
    return np.asarray(total, np.float64)


_SIGMAS = 4.0
"""An offset of so many standard deviations is one: by chance such a one comes once in 16,000."""

_TOLERANCE_NS = 1_000_000.0
"""Offsets below it are in step whatever their uncertainty: no sensor's timestamps are that exact [ns]."""

_WORST_SIGMA_NS = 50_000_000.0
"""Where the offset is not known better than this, nothing is stated of it [ns]."""

_WORST_SKEW_SIGMA_PPM = 300.0
"""The same of the skew: quartz clocks differ by less than 200 ppm."""


class ClockVerdict(StrEnum):
    """What the comparison of two clocks came to."""

    IN_STEP = "in step"
    OFF = "off"
    NOT_OBSERVABLE = "not observable"


class _OffsetPiece(msgspec.Struct, frozen=True, kw_only=True):
    """The offset in one part of a drive.

    Attributes:
        at_ns: middle of the part, on the reference's clock [ns].
        offset_ns, sigma_ns: offset and its standard deviation [ns].
    """

    at_ns: int
    offset_ns: float
    sigma_ns: float


class ClockEstimate(msgspec.Struct, frozen=True, kw_only=True):
    """How the clock of a stream goes against that of a reference.

    A time t of the stream is the reference's t - offset - skew (t - offset - at).

    Attributes:
        verdict: what came out.
        reason: why nothing can be stated, or what else is to be stated; "" for nothing.
        offset_ns: what the stream's timestamps state more than the reference's, at `at_ns` [ns]; None where not known.
        offset_sigma_ns: its standard deviation [ns].
        skew_ppm: how much faster the stream's clock runs [parts in a million]; None where not known.
        skew_sigma_ppm: its standard deviation.
        at_ns: middle of the common time, on the reference's clock [ns].
        span_ns: how long the common time is [ns].
        samples: how many measurements were compared.
        correlation: of both motions at the offset, 0 to 1; None where none was computed.
        rotation_vector: rotate [rad] that takes directions of the stream's body into the reference's, three numbers;
            where the motion reports it.
        chunks: the offset in parts of a long drive.
    """

    verdict: ClockVerdict
    reason: str = ""
    offset_ns: float | None = None
    offset_sigma_ns: float | None = None
    skew_ppm: float | None = None
    skew_sigma_ppm: float | None = None
    at_ns: int = 0
    span_ns: int = 0
    samples: int = 0
    correlation: float | None = None
    rotation_vector: tuple[float, float, float] | None = None
    chunks: tuple[_OffsetPiece, ...] = ()

    @classmethod
    def unknown(cls, reason: str, **known: object) -> "ClockEstimate":
        """Report why nothing can be stated."""
        return cls(verdict=ClockVerdict.NOT_OBSERVABLE, reason=reason, **known)  # type: ignore[arg-type]

    @property
    def is_off(self) -> bool:
        """Whether the clocks differ."""
        return self.verdict is ClockVerdict.OFF


def _estimate_judged(
    *,
    offset_ns: float,
    offset_sigma_ns: float,
    skew_ppm: float,
    skew_sigma_ppm: float,
    at_ns: int,
    span_ns: int,
    samples: int,
    correlation: float | None,
    rotation_vector: tuple[float, float, float] | None = None,
    chunks: tuple[_OffsetPiece, ...] = (),
) -> ClockEstimate:
    """Report from the numbers whether two clocks are in step."""
    knows_skew = skew_sigma_ppm <= _WORST_SKEW_SIGMA_PPM
    drift_ns = abs(skew_ppm) * 1e-6 * span_ns / 2 if knows_skew else 0.0
    drifts = drift_ns > _TOLERANCE_NS and abs(skew_ppm) > _SIGMAS * skew_sigma_ppm
    reason = ""
    if not np.isfinite(offset_sigma_ns) or offset_sigma_ns > _WORST_SIGMA_NS:
        verdict = ClockVerdict.NOT_OBSERVABLE
        reason = (
            f"too little motion in common: the offset is known within {offset_sigma_ns / 1e6:.0f} ms only; "
            f"expected {_WORST_SIGMA_NS / 1e6:.0f} ms or better"
        )
    elif drifts or abs(offset_ns) > max(_SIGMAS * offset_sigma_ns, _TOLERANCE_NS):
        verdict = ClockVerdict.OFF
    else:
        verdict = ClockVerdict.IN_STEP
    known = verdict is not ClockVerdict.NOT_OBSERVABLE
    return ClockEstimate(
        verdict=verdict,
        reason=reason,
        offset_ns=offset_ns if known else None,
        offset_sigma_ns=offset_sigma_ns,
        skew_ppm=skew_ppm if known and knows_skew else None,
        skew_sigma_ppm=skew_sigma_ppm,
        at_ns=at_ns,
        span_ns=span_ns,
        samples=samples,
        correlation=correlation,
        rotation_vector=rotation_vector,
        chunks=chunks,
    )


_LEAST_EVIDENCE = 12.0
"""Logarithm of the likelihood ratio that an offset needs, against no common motion and against another offset: the
many lags that are tried make chance alone reach 8 now and then."""

_LEAST_MARGIN = 2.0
"""How far the correlation at an offset has to lie above that at any other one, in standard deviations of chance.

Motions that have nothing to do with one another came to 1.8 and less in 26 of 27 tries, in one of 20 s to 2.3."""

_BLOCKS = 8
"""Into so many parts a drive is cut, to see whether their offsets scatter as they should."""

_PIECE = 60.0
"""Length of a chunk whose offset is reported [s]."""

_FINEST = 1e-6
"""No timestamps are better than a microsecond [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """One offset that fits.

    Attributes:
        fit: of offset [s], skew and whatever else; the offset is the finer stream's timestamp minus the other's.
        times: (N,) [s], of the rows.
        middle: the time at which the offset holds [s].
        span: of the common time [s].
        without_motion: misfit of the same rows where the motion is left out, in the same units; None: not known.
        score: correlation at the lag.
        margin: how far that is above the correlation at other lags, in standard deviations of chance; None where the
            fits themselves have to report.
        rotation: (3, 3), from the finer stream's body into the other's, or None.
        model_sigma: standard deviation of the offset by what the model leaves out [s].
    """

    fit: _Fit
    times: Float64Array
    middle: float
    span: float
    without_motion: float | None
    score: float | None
    margin: float | None = None
    rotation: Float64Array | None = None
    model_sigma: float = 0.0

    @property
    def offset(self) -> float:
        """The offset [s]."""
        return float(self.fit.parameters[0])

    @property
    def sigma(self) -> float:
        """Its standard deviation [s]."""
        return float(max(np.hypot(np.sqrt(self.fit.covariance[0, 0]) * self.scatter, self.model_sigma), _FINEST))

    @property
    def skew_sigma(self) -> float:
        """Standard deviation of the skew."""
        known = float(np.sqrt(self.fit.covariance[1, 1])) * self.scatter
        return max(known, _FINEST / max(self.span, 1e-3))

    @property
    def scatter(self) -> float:
        """By how much the offsets of parts of the drive scatter more than the noise would make them, 1 at least.

        What no noise explains, as a bent trajectory between fixes, reports itself so.

        Source: Birge 1932, "The Calculation of Errors by the Method of Least Squares".
        """
        blocks = _block_offsets(self, _BLOCKS)
        freedom = len(blocks) - 2
        if freedom < 2:
            return 1.0
        return float(np.sqrt(max(1.0, sum((step / sigma) ** 2 for _, step, sigma in blocks) / freedom)))


def _misfit_without_motion(found: _Fit, windows: Int64Array, reported: Callable[[], Linearised]) -> float:
    """The misfit of the rows of a fit where the motion is left out, in the fit's units.

    Args:
        found: the fit.
        windows: (N,), number of the window of each of its rows.
        reported: gives the rows, and the nuisances that report them alone.
    """

    def still(parameters: Float64Array, amounts: Float64Array) -> Linearised:
        # a parameter that does nothing stands for the motion
        del parameters, amounts
        at = reported()
        return replace(at, jacobian=np.zeros((*at.residuals.shape, 1)))

    model: _Model = still
    return misfit_of(model, np.zeros(1), windows, colour=found.colour, scales=found.scales)


@dataclass(frozen=True, slots=True)
class _Clocks:
    """Which of two streams' timestamps the offset adds to, and where the seconds count from."""

    origin_ns: int
    finer_is_stream: bool

    @property
    def sign(self) -> float:
        """What rotates the finer stream's offset into that of the stream against the reference."""
        return 1.0 if self.finer_is_stream else -1.0


def _concluded(candidates: Sequence[_Candidate], clocks: _Clocks) -> ClockEstimate:
    """Choose the offset that fits best, and report how well it is known, or why it is not.

    Evidence is the logarithm of the likelihood ratio, half the number of values times that of the misfits' ratio,
    since the whitened residuals of a row state nothing of the next one's.
    """
    ranked = sorted(candidates, key=lambda candidate: candidate.fit.level)
    if not ranked:
        return ClockEstimate.unknown("too few samples in common to fit an offset")
    best = ranked[0]
    reported = {"samples": best.fit.rows, "span_ns": round(best.span * 1e9)}
    values = best.fit.residuals.shape[1] * best.fit.rows
    if best.without_motion is not None:
        evidence = 0.5 * values * np.log(max(best.without_motion, 1e-300) / max(best.fit.misfit, 1e-300))
        if evidence < _LEAST_EVIDENCE:
            return ClockEstimate.unknown("the streams show no motion in common", **reported)
    rivals = [other for other in ranked[1:] if abs(other.offset - best.offset) > max(6 * best.sigma, 0.01)]
    if best.margin is None and any(best.fit.evidence_against(other.fit) < _LEAST_EVIDENCE for other in rivals):
        offsets = [clocks.sign * candidate.offset for candidate in (best, *rivals)]
        return ClockEstimate.unknown(_ambiguous(offsets), **reported)
    return _judged(best, clocks)


def _ambiguous(offsets: Sequence[float]) -> str:
    """State that some offsets [s] fit alike, or a single one no better than chance."""
    if len(offsets) < 2:
        return "no offset makes the motions more alike than chance would"
    return "several offsets fit alike: " + ", ".join(f"{offset * 1e3:.0f} ms" for offset in sorted(offsets[:2]))


def _judged(best: _Candidate, clocks: _Clocks) -> ClockEstimate:
    sign = clocks.sign
    middle_ns = clocks.origin_ns + round(best.middle * 1e9)
    # the middle was reported on the slower stream's clock
    at_ns = middle_ns if clocks.finer_is_stream else middle_ns + round(best.offset * 1e9)
    return _estimate_judged(
        offset_ns=sign * best.offset * 1e9,
        offset_sigma_ns=best.sigma * 1e9,
        skew_ppm=sign * float(best.fit.parameters[1]) * 1e6,
        skew_sigma_ppm=best.skew_sigma * 1e6,
        at_ns=at_ns,
        span_ns=round(best.span * 1e9),
        samples=best.fit.rows,
        correlation=best.score,
        rotation_vector=_vector(best.rotation, transposed=not clocks.finer_is_stream),
        chunks=_chunks(best, clocks),
    )


def _vector(rotation: Float64Array | None, *, transposed: bool) -> tuple[float, float, float] | None:
    if rotation is None:
        return None
    x, y, z = rotation_vector_from_quaternion(quaternion_from_matrix(rotation.T if transposed else rotation))
    return float(x), float(y), float(z)


def _chunks(best: _Candidate, clocks: _Clocks) -> tuple[_OffsetPiece, ...]:
    """The offset in each minute of a drive of three and more."""
    count = int(best.span // _PIECE)
    if count < 3:
        return ()
    offset, skew = best.fit.parameters[:2]
    inflation = best.sigma * np.sqrt(max(best.fit.information[0, 0], 0.0))
    return tuple(
        _OffsetPiece(
            at_ns=clocks.origin_ns + round(at * 1e9),
            offset_ns=clocks.sign * float(offset + skew * (at - best.middle) + step) * 1e9,
            sigma_ns=max(sigma * inflation, _FINEST) * 1e9,
        )
        for at, step, sigma in _block_offsets(best, count)
    )


def _block_offsets(best: _Candidate, count: int) -> list[tuple[float, float, float]]:
    """For each of some parts of the drive the middle [s], what its offset is off the line, and its sigma [s].

    It is one step of the fit from the line to what the part alone reports, all else being as it is.
    """
    first = float(best.times.min())
    lengths = max(float(np.ptp(best.times)), 1e-9)
    numbers = np.clip(((best.times - first) / lengths * count).astype(np.int64), 0, count - 1)
    slopes, residuals = best.fit.jacobian[:, :, 0], best.fit.residuals
    blocks = []
    for number in range(count):
        rows = numbers == number
        information = float((slopes[rows] ** 2).sum())
        if information > 1e-3 * best.fit.information[0, 0] / count:
            step = float((slopes[rows] * residuals[rows]).sum()) / information
            blocks.append((first + (number + 0.5) * lengths / count, step, float(1 / np.sqrt(information))))
    return blocks


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
    tamed: Float64Array = middle + (values - middle) * np.minimum(1.0, longest / np.maximum(lengths, 1e-12))[:, None]
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
"""Step of the coarse search [s]; rotations of bodies that people and cars carry are slower."""

_PART = 120.0
"""Seconds that are searched at once: a clock that is 200 ppm too fast moves 24 ms on in them."""

_BIAS_WINDOW = 60.0
"""A gyroscope's bias is one constant for so many seconds."""

_COMPARISON_STEPS = (0.05, 0.1, 0.2, 0.4)
"""Rotations over at least so many seconds are compared, the shortest that the noise allows [s]."""

_NOISE_SHARE = 0.1
"""Of the rates' changes between start and stop of a rotation at most this share may be noise."""

_FAR_LESS = 4.0
"""Lags whose correlation lacks so many times more of 1 than that of the best are left aside."""

_PRIORS = np.array([10.0, 2e-3, 0.7, 0.7, 0.7])
"""How far offset [s], skew and rotation [rad] may be from the start."""


def compare_rotations(
    reference: Orientations,
    stream: Orientations,
    *,
    reach_ns: int = REACH_NS,
    reference_from_stream: Float64Array | None = None,
) -> ClockEstimate:
    """Find the offset and the skew of a stream's clock from the rotating that two streams report.

    The streams may have any rates and gaps, their bodies any constant rotation between them, and either a constant
    bias. First the lag is searched at which the angular velocities are most alike; then rotations from sample to sample
    of the slower stream are fitted by those of the other one between the same times, with offset, skew, rotation and
    bias free at once.

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
    clocks = _Clocks(pair.origin_ns, finer_is_stream)
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
    if max(peak.margin for _, peak in starts) < _LEAST_MARGIN:
        lags = [clocks.sign * line.offset for line, _ in starts]
        return ClockEstimate.unknown(_ambiguous(lags), span_ns=round(pair.common * 1e9))
    candidates = [candidate for line, peak in starts if (candidate := pair.fitted(line, peak)) is not None]
    return _concluded(candidates, clocks)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """The slower stream as rotates, the other as a curve, both in seconds after one origin."""

    origin_ns: int
    coarse: Orientations
    fine: RotationCurve
    coarse_curve: RotationCurve
    fine_noise: Float64Array
    expected: Float64Array
    grid: float
    span: tuple[float, float]

    @classmethod
    def of(cls, coarse: Orientations, fine: Orientations, coarse_from_fine: Float64Array) -> "_Pair":
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
        found = [(0.5 * (a + b), peak) for a, b in pairwise(edges.tolist()) for peak in self._peaks(a, b, reach)[:1]]
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

    def fitted(self, line: _Line, peak: _Peak) -> _Candidate | None:
        """Refine an offset over rotations that are as short as the noise allows."""
        own = self.coarse.step_ns * 1e-9
        start = np.array([line.offset, line.slope, 0.0, 0.0, 0.0])
        chosen: tuple[_RotatingModel, _Fit] | None = None
        for least in (0.0, *(step for step in _COMPARISON_STEPS if step > own)):
            steps = _steps_of(self.coarse, self.origin_ns, least)
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
    """Rotations of the slower stream, predicted by the curve of the other one: offset, skew, three of rotation."""

    def __init__(self, pair: _Pair, steps: _Steps, coarse_from_fine: Float64Array) -> None:
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
        moved, slope, drift = (np.where(known[:, None], x, 0.0) @ rotation.T for x in (reported, slope, drift))
        jacobian = np.concatenate([slope[:, :, None], drift[:, :, None], -_crossing(moved)], axis=2)
        return Linearised(self.vectors - moved, jacobian, self.nuisances, known)

    def rotated(self, parameters: Float64Array) -> Float64Array:
        """The rotation (3, 3) from the finer stream's body into the other's."""
        rotation = matrix_from_quaternion(quaternion_from_rotation_vector(parameters[2:5]))
        return np.asarray(rotation @ self.rotation, np.float64)

    def noise_share(self, found: _Fit) -> float:
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

    def candidate(self, found: _Fit, peak: _Peak) -> _Candidate:
        """The fit with what is needed to judge it."""
        return _Candidate(
            fit=found,
            times=self.row_times,
            middle=self.middle,
            span=self.pair.common,
            without_motion=_misfit_without_motion(found, self.windows, lambda: self._still(found)),
            score=peak.score,
            margin=peak.margin,
            rotation=self.rotated(found.parameters),
        )

    def _still(self, found: _Fit) -> Linearised:
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
    return np.stack([np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], axis=1)


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
"""Longer windows sharpen an offset and do not change it [s]."""

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
    clocks = _Clocks(origin_ns, finer_is_stream=fixes_are_reference)
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
        return ClockEstimate.unknown("the motion is too even: another offset is like another location and heading")
    return _concluded([_candidate(*one, common) for one in reported], clocks)


def _share_reported(model: "_TrajectoryModel", found: _Fit) -> float:
    """How much of the speed reports the offset, as nothing else that is free does."""
    reported = _bare_slopes(model, found, model.windows)[:, :, 0] ** 2
    length = model.bounds[0][1] - model.bounds[0][0]
    # of an even motion over a window the locations scatter so
    speed = float(np.sqrt(12.0 * (np.abs(model.locations) ** 2).mean())) / length
    return float(np.sqrt(reported.sum(axis=1).mean())) / max(speed, 1e-9)


def _refined(
    part: "_TrajectoryModel", near: _Fit, fixes: Fixes, location: Float64Array, priors: Float64Array
) -> tuple["_TrajectoryModel", _Fit] | None:
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


def _candidate(model: _TrajectoryModel, found: _Fit, common: float) -> _Candidate:
    return _Candidate(
        fit=found,
        times=model.times,
        middle=model.middle,
        span=common,
        without_motion=_misfit_without_motion(found, model.windows, lambda: _unmoved(model, found)),
        score=None,
        model_sigma=model.trajectory.model_sigma,
    )


def _unmoved(model: _TrajectoryModel, found: _Fit) -> Linearised:
    """The same fixes, reported by polynomials alone."""
    at = model(found.parameters, found.amounts[:, :0])
    return replace(at, nuisances=at.nuisances[:, :, :-2], expected=None)
