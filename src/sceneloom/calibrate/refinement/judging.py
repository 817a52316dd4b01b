"""Whether what a search found is to be taken."""

from collections.abc import Sequence

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.calibrate.measures.candidate import COUNT, UNITS, Parameter
from sceneloom.calibrate.refinement.objective import Level
from sceneloom.calibrate.refinement.results import RefinementVerdict
from sceneloom.calibrate.refinement.search import Found, search

LOOSEST = {"rotation": np.radians(0.5), "translation": 0.15, "time": 0.05, "focal": 0.02}
"""Standard deviations [rad], [m], [s], and of the focal length's logarithm, from which a group is not reported.

The stated
calibration is usually known as well."""
LEAST_VIEWS = 4
"""Shift, time and focal length move pixels by a little as a rotation does.

What single objects suggest of the difference
averages out over several views only."""

_SHARPEST_WRONG = 4.0
"""How far above others around it, in their standard deviations, wrong calibrations come at most; right ones reach 6."""
_AROUND, _NEARBY = 60, (3.0, 8.0)
_FARTHEST_ROTATION, _FARTHEST_SHIFT, _FARTHEST_LATER = np.radians(4.0), 0.5, 0.2
"""A repair beyond these [rad], [m], [s] is no repair: the search went astray, or the stated calibration is no start."""


def held_out_gain(levels: Sequence[Level], held_out: BoolArray, free: Int64Array) -> float:
    """How much likelier frames are under what the others found than under the stated calibration."""
    start = np.zeros(COUNT)
    found = search(levels, ~held_out, free, thinned=2)
    level = levels[-1].part(held_out)
    values = [
        float(
            (level.around(numbers, free).sums(np.zeros(len(free))).values.sum(axis=0) * found.weights).sum()
        )
        for numbers in (start, found.numbers)
    ]
    return values[1] - values[0]


def sharpness_of(found: Found) -> float:
    """How far the solution stands above others a degree or two around it, in their standard deviations."""
    rotations = np.flatnonzero(found.free < 3)
    drawn = np.random.default_rng(3).normal(size=(_AROUND, len(rotations)))
    sizes = np.random.default_rng(4).uniform(*_NEARBY, _AROUND)
    values = []
    for direction, size in zip(drawn, sizes, strict=True):
        step = np.zeros(len(found.free))
        step[rotations] = direction / np.linalg.norm(direction) * size
        values.append(float((found.last.sums(step).values.sum(axis=0) * found.weights).sum()))
    here = float((found.last.sums(np.zeros(len(found.free))).values.sum(axis=0) * found.weights).sum())
    return (here - float(np.mean(values))) / max(float(np.std(values)), 1e-12)


def judged(
    found: Found, covariance: Float64Array, gains: Sequence[float], sharpness: float
) -> tuple[RefinementVerdict, str]:
    """Whether what was found is to be taken."""
    numbers = found.numbers
    sigma = float(np.degrees(np.sqrt(np.diagonal(covariance)[:3].max()) * UNITS[0]))
    if not found.weights.any() or not sharpness > _SHARPEST_WRONG:
        return RefinementVerdict.UNDETERMINED, (
            f"nothing stands out near the stated calibration: the best is {sharpness:.1f} standard deviations above "
            f"others around it; expected {_SHARPEST_WRONG:.0f} or more"
        )
    if sigma > np.degrees(LOOSEST["rotation"]):
        return (
            RefinementVerdict.UNDETERMINED,
            f"the rotation is known within {sigma:.2g} deg only; expected 0.5 or better",
        )
    if (
        np.linalg.norm(numbers[:3]) > _FARTHEST_ROTATION
        or np.linalg.norm(numbers[3:6]) > _FARTHEST_SHIFT
        or abs(numbers[Parameter.LATER]) > _FARTHEST_LATER
    ):
        return RefinementVerdict.UNDETERMINED, (
            f"the best is {np.degrees(np.linalg.norm(numbers[:3])):.1f} deg, {np.linalg.norm(numbers[3:6]):.2f} m and "
            f"{numbers[Parameter.LATER] * 1e3:.0f} ms away from the stated calibration, too far for a repair; "
            "expected a start within a few degrees (`--target`, `--hand-eye` give one)"
        )
    if min(gains) <= 0.0:
        return RefinementVerdict.KEPT, (
            f"frames that took no part do not agree: {sum(gain <= 0 for gain in gains)} of {len(gains)} held-out parts "
            "of the drive fit the stated calibration better"
        )
    step = numbers[found.free] / UNITS[found.free]
    distance = float(step @ np.linalg.solve(covariance, step)) / len(step)
    if distance < 1.0:
        return RefinementVerdict.KEPT, "the stated calibration is as good as the drive can report"
    return RefinementVerdict.REFINED, (
        f"all {len(gains)} held-out parts of the drive fit better than the stated calibration"
    )
