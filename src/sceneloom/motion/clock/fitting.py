"""Least squares for signals with coloured noise and outliers, with a covariance that can be believed."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array

HUBER = 2.0
"""Residuals beyond so many standard deviations count linearly. Source: Huber 1964."""

MOST_LAGS = 10
"""Order of the autoregression that whitens the noise, where there are samples enough."""

_ROUNDS, _STEPS = 3, 10

_SERIAL = 200_000
"""Products of matrices are taken in parts of so many multiplications: libraries share larger ones among threads, which
cost more than they save."""

_CLOSE = 0.02
"""Steps are small enough at this share of a standard deviation."""


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
class Fit:
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

    def evidence_against(self, other: "Fit") -> float:
        """Logarithm of how much likelier the measurements are by this fit than by another one."""
        values = self.rows * int(self.residuals.shape[1])
        return 0.5 * values * (other.level - self.level)


Model = Callable[[Float64Array, Float64Array], Linearised]
"""Gives the model at parameters (P,) and amounts of the nuisances (W, M)."""


def fit(
    model: Model,
    start: Float64Array,
    prior_sigmas: Float64Array,
    windows: Int64Array,
    *,
    begin: Float64Array | None = None,
    whiten: bool = True,
    colour: Float64Array | None = None,
    scales: Float64Array | None = None,
) -> Fit | None:
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
            solved = _solve(
                at, windows, colour, fixed_scales, precision, parameters - start, scales=state.scales
            )
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
    model: Model,
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


def bare_slopes(model: Model, found: Fit, windows: Int64Array) -> Float64Array:
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
    order = min(MOST_LAGS, int(used.sum()) // 25)
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
    weights: Float64Array = np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
    return weights


def _finished(
    parameters: Float64Array,
    amounts: Float64Array,
    state: _State,
    precision: Float64Array,
    colour: Float64Array,
    windows: Int64Array,
) -> Fit:
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
    return Fit(
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
