"""Clock estimates: offset, skew, uncertainty and verdict from the fits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.rotations import quaternion_from_matrix, rotation_vector_from_quaternion
from sceneloom.motion.clock.fitting import Fit, Linearised, Model, misfit_of

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

LEAST_MARGIN = 2.0
"""How far the correlation at an offset has to lie above that at any other one, in standard deviations of chance.

Motions that have nothing to do with one another came to 1.8 and less in 26 of 27 tries, in one of 20 s to 2.3."""

_BLOCKS = 8
"""Into so many parts a drive is cut, to see whether their offsets scatter as they should."""

_PIECE = 60.0
"""Seconds of a piece whose offset is distinguished."""

_FINEST = 1e-6
"""No timestamps are better than a microsecond [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
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

    fit: Fit
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
        return float(
            max(np.hypot(np.sqrt(self.fit.covariance[0, 0]) * self.scatter, self.model_sigma), _FINEST)
        )

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


def misfit_without_motion(found: Fit, windows: Int64Array, reported: Callable[[], Linearised]) -> float:
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

    model: Model = still
    return misfit_of(model, np.zeros(1), windows, colour=found.colour, scales=found.scales)


@dataclass(frozen=True, slots=True)
class Clocks:
    """Which of two streams' timestamps the offset adds to, and where the seconds count from."""

    origin_ns: int
    finer_is_stream: bool

    @property
    def sign(self) -> float:
        """What rotates the finer stream's offset into that of the stream against the reference."""
        return 1.0 if self.finer_is_stream else -1.0


def concluded(candidates: Sequence[Candidate], clocks: Clocks) -> ClockEstimate:
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
    if best.margin is None and any(
        best.fit.evidence_against(other.fit) < _LEAST_EVIDENCE for other in rivals
    ):
        offsets = [clocks.sign * candidate.offset for candidate in (best, *rivals)]
        return ClockEstimate.unknown(ambiguous(offsets), **reported)
    return _judged(best, clocks)


def ambiguous(offsets: Sequence[float]) -> str:
    """State that some offsets [s] fit alike, or a single one no better than chance."""
    if len(offsets) < 2:
        return "no offset makes the motions more alike than chance would"
    return "several offsets fit alike: " + ", ".join(
        f"{offset * 1e3:.0f} ms" for offset in sorted(offsets[:2])
    )


def _judged(best: Candidate, clocks: Clocks) -> ClockEstimate:
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


def _chunks(best: Candidate, clocks: Clocks) -> tuple[_OffsetPiece, ...]:
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


def _block_offsets(best: Candidate, count: int) -> list[tuple[float, float, float]]:
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
