"""What is known of one clock against another."""

from enum import StrEnum

import msgspec
import numpy as np

SIGMAS = 4.0
"""An offset of so many standard deviations is one: by chance such a one comes once in 16,000."""

TOLERANCE_NS = 1_000_000.0
"""Offsets below it are in step whatever their uncertainty: no sensor's timestamps are that exact [ns]."""

WORST_SIGMA_NS = 50_000_000.0
"""Where the offset is not known better than this, nothing is stated of it [ns]."""

WORST_SKEW_SIGMA_PPM = 300.0
"""The same of the skew: quartz clocks differ by less than 200 ppm."""


class ClockVerdict(StrEnum):
    """What the comparison of two clocks came to."""

    IN_STEP = "in step"
    OFF = "off"
    NOT_OBSERVABLE = "not observable"


class OffsetPiece(msgspec.Struct, frozen=True, kw_only=True):
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
    chunks: tuple[OffsetPiece, ...] = ()

    @classmethod
    def unknown(cls, reason: str, **known: object) -> "ClockEstimate":
        """Report why nothing can be stated."""
        return cls(verdict=ClockVerdict.NOT_OBSERVABLE, reason=reason, **known)  # type: ignore[arg-type]

    @property
    def is_off(self) -> bool:
        """Whether the clocks differ."""
        return self.verdict is ClockVerdict.OFF


def judged(
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
    chunks: tuple[OffsetPiece, ...] = (),
) -> ClockEstimate:
    """Report from the numbers whether two clocks are in step."""
    knows_skew = skew_sigma_ppm <= WORST_SKEW_SIGMA_PPM
    drift_ns = abs(skew_ppm) * 1e-6 * span_ns / 2 if knows_skew else 0.0
    drifts = drift_ns > TOLERANCE_NS and abs(skew_ppm) > SIGMAS * skew_sigma_ppm
    reason = ""
    if not np.isfinite(offset_sigma_ns) or offset_sigma_ns > WORST_SIGMA_NS:
        verdict = ClockVerdict.NOT_OBSERVABLE
        reason = (
            f"too little motion in common: the offset is known within {offset_sigma_ns / 1e6:.0f} ms only; "
            f"expected {WORST_SIGMA_NS / 1e6:.0f} ms or better"
        )
    elif drifts or abs(offset_ns) > max(SIGMAS * offset_sigma_ns, TOLERANCE_NS):
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
