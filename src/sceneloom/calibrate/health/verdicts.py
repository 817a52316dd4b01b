"""What the numbers of a check mean.

The limits are lengths and angles that matter, and what the measures got wrong by themselves on simulated drives of
other seeds than those of the tests: see docs/calibration.md.
"""

from dataclasses import dataclass
from enum import StrEnum

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array


class Verdict(StrEnum):
    """What is to be stated of one part of a calibration."""

    GOOD = "good"
    DRIFTING = "drifting"
    WRONG = "wrong"
    UNDETERMINED = "cannot determine"


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """One part of a calibration.

    Attributes:
        name: "rotation", "translation", "focal_length", "principal_point" or "time_offset"; "boxes",
            "boxes_roll" and "motion".
        verdict: what is to be stated of it.
        reason: why, where it is not good.
        unit: of the numbers.
        values: what would have to be changed; empty where nothing was found.
        sigmas: their standard deviations, what the measures get wrong by themselves included.
    """

    name: str
    verdict: Verdict
    reason: str = ""
    unit: str = ""
    values: tuple[float, ...] = ()
    sigmas: tuple[float, ...] = ()

    @property
    def suspected(self) -> bool:
        """Whether it seems to be off, but that may be chance."""
        limits = LIMITS.get(self.name)
        if limits is None or self.verdict is not Verdict.UNDETERMINED or not self.values:
            return False
        return max(abs(v) - 2.0 * s for v, s in zip(self.values, self.sigmas, strict=True)) > limits.good

    @classmethod
    def unknown(cls, name: str, reason: str) -> "Item":
        """Report why nothing can be stated."""
        return cls(name=name, verdict=Verdict.UNDETERMINED, reason=reason)


@dataclass(frozen=True, slots=True)
class Limits:
    """From where on a part is what.

    Attributes:
        name, unit: of the part.
        scale: from radians, metres, logarithms and seconds to the unit.
        good: up to this it is good.
        wrong: beyond this it is wrong.
        floor: what the measures get wrong by themselves, on each axis.
        vague: with a larger standard deviation on any axis nothing is stated.
        what: agrees.
    """

    name: str
    unit: str
    scale: float
    good: float
    wrong: float
    floor: float
    vague: float
    what: str = "images and sweeps agree"


_BOXES = "boxes of images and sweeps come together"
LIMITS = {
    limits.name: limits
    for limits in (
        Limits("rotation", "deg", 180.0 / np.pi, 0.4, 1.0, 0.12, 0.35),
        Limits("translation", "m", 1.0, 0.1, 0.3, 0.04, 0.06),
        Limits("focal_length", "%", 100.0, 1.0, 3.0, 0.4, 0.8),
        Limits("time_offset", "ms", 1e3, 15.0, 60.0, 4.0, 9.0),
        Limits("boxes", "deg", 180.0 / np.pi, 0.4, 1.0, 0.12, 0.35, _BOXES),
        Limits("boxes_roll", "deg", 180.0 / np.pi, 1.0, 2.0, 0.4, 0.6, _BOXES),
        Limits("motion", "deg", 180.0 / np.pi, 1.5, 3.0, 0.5, 0.8, "camera and lidar rotate alike"),
    )
}
SIGNIFICANT = 16.0
"""Squared distance from nothing, in standard deviations, of what is more than chance."""


def judge(name: str, values: Float64Array, covariance: Float64Array) -> Item:
    """Judge what would have to be changed of a part.

    Args:
        name: out of `LIMITS`.
        values: (P,), in radians, metres, logarithms or seconds.
        covariance: (P, P), of the same.
    """
    limits = LIMITS[name]
    found = values * limits.scale
    spread = covariance * limits.scale**2 + limits.floor**2 * np.eye(len(values))
    sigmas, size = np.sqrt(np.diag(spread)), float(np.linalg.norm(found))
    verdict, reason = Verdict.GOOD, ""
    significant = float(found @ np.linalg.solve(spread, found)) > SIGNIFICANT
    if sigmas.max() > limits.vague:
        verdict = Verdict.UNDETERMINED
        reason = f"known within {sigmas.max():.2g} {limits.unit} only; expected {limits.vague:g} or better"
    elif size > limits.good and not significant:
        verdict = Verdict.UNDETERMINED
        reason = f"{size:.2g} {limits.unit} may be chance"
    elif size > limits.good:
        verdict = Verdict.WRONG if size > limits.wrong else Verdict.DRIFTING
        reason = f"{limits.what} best {size:.2g} {limits.unit} away from it"
    return Item(
        name=name,
        verdict=verdict,
        reason=reason,
        unit=limits.unit,
        values=tuple(map(float, found)),
        sigmas=tuple(map(float, sigmas)),
    )
