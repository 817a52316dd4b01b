"""From fits to a verdict: is there motion in common, is the offset the only one, and how well is it known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rotations import quaternion_from_matrix, rotation_vector_from_quaternion
from sceneloom.motion.clock.estimate import ClockEstimate, OffsetPiece, judged
from sceneloom.motion.clock.fitting import Fit

LEAST_EVIDENCE = 12.0
"""Logarithm of the likelihood ratio that an offset needs, against no common motion and against another offset: the
many lags that are tried make chance alone reach 8 now and then."""

_PIECE = 60.0
"""Seconds of a piece whose offset is told apart."""

_FINEST = 1e-6
"""No stamps are better than a microsecond [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One offset that fits.

    Attributes:
        fit: of offset [s], skew and whatever else; the offset is the finer stream's stamp minus the other's.
        times: (N,) [s], of the rows.
        middle: the time at which the offset holds [s].
        span: of the common time [s].
        without_motion: misfit of the same rows where the motion is left out, in the same units; None: not known.
        score: correlation at the lag.
        rotation: (3, 3), from the finer stream's body into the other's, or None.
    """

    fit: Fit
    times: Float64Array
    middle: float
    span: float
    without_motion: float | None
    score: float | None
    rotation: Float64Array | None = None

    @property
    def offset(self) -> float:
        """The offset [s]."""
        return float(self.fit.parameters[0])

    @property
    def sigma(self) -> float:
        """Its standard deviation [s]."""
        return float(max(np.sqrt(self.fit.covariance[0, 0]), _FINEST))


@dataclass(frozen=True, slots=True)
class Clocks:
    """Which of two streams' stamps the offset adds to, and where the seconds count from."""

    origin_ns: int
    finer_is_stream: bool

    @property
    def sign(self) -> float:
        """What turns the finer stream's offset into that of the stream against the reference."""
        return 1.0 if self.finer_is_stream else -1.0


def concluded(candidates: Sequence[Candidate], clocks: Clocks) -> ClockEstimate:
    """Choose the offset that fits best, and tell how well it is known, or why it is not.

    Evidence is the logarithm of the likelihood ratio, half the number of values times that of the misfits' ratio,
    since the whitened residuals of a row tell nothing of the next one's.
    """
    ranked = sorted(candidates, key=_level)
    if not ranked:
        return ClockEstimate.unknown("too few samples in common to fit an offset")
    best = ranked[0]
    told = {"samples": best.fit.rows, "span_ns": round(best.span * 1e9)}
    values = best.fit.residuals.shape[1] * best.fit.rows
    if best.without_motion is not None:
        evidence = 0.5 * values * np.log(max(best.without_motion, 1e-300) / max(best.fit.misfit, 1e-300))
        if evidence < LEAST_EVIDENCE:
            return ClockEstimate.unknown("the streams show no motion in common", **told)
    for other in ranked[1:]:
        apart = abs(other.offset - best.offset)
        if (
            apart > max(6 * best.sigma, 0.01)
            and 0.5 * values * (_level(other) - _level(best)) < LEAST_EVIDENCE
        ):
            return ClockEstimate.unknown(
                f"two offsets fit alike: {clocks.sign * best.offset * 1e3:.0f} ms and "
                f"{clocks.sign * other.offset * 1e3:.0f} ms",
                **told,
            )
    return _judged(best, clocks)


def _level(candidate: Candidate) -> float:
    """Logarithm of the misfit of a value [in its own unit], so that fits in different units of noise compare."""
    fit = candidate.fit
    mean = fit.misfit / max(fit.rows * fit.residuals.shape[1], 1)
    return float(np.log(max(mean, 1e-300)) + 2 * np.log(fit.scales).mean())


def _judged(best: Candidate, clocks: Clocks) -> ClockEstimate:
    sign = clocks.sign
    middle_ns = clocks.origin_ns + round(best.middle * 1e9)
    # the middle was told on the slower stream's clock
    at_ns = middle_ns if clocks.finer_is_stream else middle_ns + round(best.offset * 1e9)
    return judged(
        offset_ns=sign * best.offset * 1e9,
        offset_sigma_ns=best.sigma * 1e9,
        skew_ppm=sign * float(best.fit.parameters[1]) * 1e6,
        skew_sigma_ppm=float(max(np.sqrt(best.fit.covariance[1, 1]), _FINEST / max(best.span, 1e-3))) * 1e6,
        at_ns=at_ns,
        span_ns=round(best.span * 1e9),
        samples=best.fit.rows,
        correlation=best.score,
        rotation_vector=_vector(best.rotation, transposed=not clocks.finer_is_stream),
        pieces=_pieces(best, clocks),
    )


def _vector(rotation: Float64Array | None, *, transposed: bool) -> tuple[float, float, float] | None:
    if rotation is None:
        return None
    x, y, z = rotation_vector_from_quaternion(quaternion_from_matrix(rotation.T if transposed else rotation))
    return float(x), float(y), float(z)


def _pieces(best: Candidate, clocks: Clocks) -> tuple[OffsetPiece, ...]:
    """The offset in each minute, by one step of the fit from the line to what the minute alone tells."""
    count = int(best.span // _PIECE)
    if count < 3:
        return ()
    numbers = np.clip((best.times / best.span * count).astype(np.int64), 0, count - 1)
    offset, skew = best.fit.parameters[:2]
    inflation = best.fit.covariance[0, 0] * max(best.fit.information[0, 0], 1e-300)
    pieces = []
    for number in range(count):
        rows = numbers == number
        slope = best.fit.jacobian[rows][:, :, 0]
        information = float((slope**2).sum())
        if information <= 0:
            continue
        time = (number + 0.5) * best.span / count
        step = float((slope * best.fit.residuals[rows]).sum()) / information
        pieces.append(
            OffsetPiece(
                at_ns=clocks.origin_ns + round(time * 1e9),
                offset_ns=clocks.sign * float(offset + skew * (time - best.middle) + step) * 1e9,
                sigma_ns=float(np.sqrt(inflation / information)) * 1e9,
            )
        )
    return tuple(pieces)
