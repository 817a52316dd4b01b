"""Simulated detectors: classes, miss rates and noise, and scores that are true probabilities.

How it is done. Detector and street together expect, over the frames that are looked at, p_m true boxes of object m
(its chance to be found) and F false ones. The false ones are dealt out to the objects, f_m to object m, more to those
that are hard to find: a false box looks like a poor observation. So among the boxes that look like object m the share

    π_m = p_m / (p_m + f_m)

is true. Let the scores of all these together be spread as g = Beta(κ π_m, κ (1 - π_m)), whose mean is π_m, and draw

    true boxes from  s g(s) / π_m              = Beta(κ π_m + 1, κ (1 - π_m)),
    false ones from  (1 - s) g(s) / (1 - π_m)  = Beta(κ π_m, κ (1 - π_m) + 1).

Bayes then gives P(true | s) = π_m s g / π_m / (s g + (1 - s) g) = s for every object, hence for all boxes together.
The concentration κ says how little a score reports: towards 0 all are 0 or 1, and far above 1 all are π_m.
Duplicates count as false: object m bears r p_m more of them, where r boxes are repeated.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.errors import OptionError
from sceneloom.scene.detections import ScoreForm
from sceneloom.simulate.parameters import check_bounds, each_of

_SMALLEST = 1e-9
"""Scores keep this far from 0 and 1, so that their logits are finite."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreSpec:
    """How a detector reports how sure it is.

    Attributes:
        concentration: κ above 0; the larger, the less a score reports true from false.
        likeness: above 0; how much the false boxes look like objects that are easy to find: a sure one draws this
            share of them, against 1 + this for one that is never found.
        form: probabilities, or logits: ln(s / (1 - s)).
        logit_scale, logit_shift: logits come as scale · logit + shift; any but 1 and 0 are not calibrated.

    Raises:
        OptionError: a number is out of bounds.
    """

    concentration: float = 2.0
    likeness: float = 0.2
    form: ScoreForm = ScoreForm.PROBABILITY
    logit_scale: float = 1.0
    logit_shift: float = 0.0

    def __post_init__(self) -> None:
        bounds = (
            ("concentration", self.concentration, 0.01, 1e4),
            ("likeness", self.likeness, 1e-3, 1e3),
            ("logit_scale", self.logit_scale, 1e-3, 1e3),
            ("logit_shift", self.logit_shift, -1e3, 1e3),
        )
        check_bounds("scores", bounds)
        if self.form == ScoreForm.PROBABILITY and (self.logit_scale, self.logit_shift) != (1.0, 0.0):
            raise OptionError(
                "scores: logit_scale and logit_shift are for logits; set form to ScoreForm.LOGIT"
            )


class LooksLike(NamedTuple):
    """What the boxes of one class look like.

    Attributes:
        true_shares: (M,) float64, π_m: share of the boxes looking like object m that are true.
        false_shares: (M,) float64, share of the false boxes that look like object m; they sum to 1.
    """

    true_shares: Float64Array
    false_shares: Float64Array


def deal_out(
    chances: Float64Array, false_count: float, *, repeated: float = 0.0, likeness: float = 0.2
) -> LooksLike:
    """Deal the expected false boxes of a class out to its objects.

    Args:
        chances: (M,) float64, 0 to 1: chance of each object in each frame to be found.
        false_count: how many false boxes are expected in all these frames.
        repeated: how many duplicates a true box has.
        likeness: as in `ScoreSpec`.
    """
    lent = 1.0 + likeness - chances
    false_shares = lent / max(float(lent.sum()), _SMALLEST)
    expected = chances * (1.0 + repeated) + false_count * false_shares
    true_shares = chances / np.maximum(expected, np.finfo(np.float64).tiny)
    return LooksLike(true_shares, false_shares)


def draw_scores(
    generator: np.random.Generator, true_shares: Float64Array, true: BoolArray, spec: ScoreSpec
) -> Float64Array:
    """Draw the score of each box.

    Args:
        generator: where the numbers come from.
        true_shares: (N,) float64, π of what each box looks like.
        true: (N,) bool, whether it is true.
        spec: concentration and form of the scores.

    Returns:
        (N,) float64, in the form that the spec asks for.
    """
    a = spec.concentration * true_shares + true
    b = spec.concentration * (1.0 - true_shares) + ~true
    scores = np.clip(
        generator.beta(np.maximum(a, _SMALLEST), np.maximum(b, _SMALLEST)), _SMALLEST, 1.0 - _SMALLEST
    )
    if spec.form == ScoreForm.PROBABILITY:
        return scores
    logits: Float64Array = spec.logit_scale * np.log(scores / (1.0 - scores)) + spec.logit_shift
    return logits


_MANY = 1e6
"""No number of a detector is larger: squares and products of them stay finite."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassSpec:
    """How a detector does on one class.

    Attributes:
        half_evidence: points on an object in plain view (pixels, for a detector of images) with which half of such
            objects are found.
        false_rate: expected number of false boxes in a sweep or image.
        size_lwh: mean size of false boxes [m].

    Raises:
        OptionError: a number is out of bounds.
    """

    half_evidence: float
    false_rate: float
    size_lwh: tuple[float, float, float]

    def __post_init__(self) -> None:
        bounds = (
            ("half_evidence", self.half_evidence, 1e-6, _MANY),
            ("false_rate", self.false_rate, 0.0, 100.0),
            *each_of("size_lwh", self.size_lwh, 1e-3, 100.0),
        )
        check_bounds("detector.classes", bounds)


@dataclass(frozen=True, slots=True, kw_only=True)
class MissSpec:
    """What a detector misses: chance = recall / (1 + exp(-z)), z = steepness ln(evidence / half) - hiding occlusion.

    Attributes:
        recall: chance to find what is seen best.
        steepness: how fast the chance grows with the logarithm of the evidence.
        hiding: how much an object is harder to find of which nothing but a sliver is seen.

    Raises:
        OptionError: a number is out of bounds.
    """

    recall: float = 0.98
    steepness: float = 2.0
    hiding: float = 2.0

    def __post_init__(self) -> None:
        bounds = (
            ("recall", self.recall, 1e-6, 1.0),
            ("steepness", self.steepness, 0.0, _MANY),
            ("hiding", self.hiding, 0.0, _MANY),
        )
        check_bounds("detector.misses", bounds)

    def chances(self, evidence: Float64Array, occlusions: Float64Array, half: Float64Array) -> Float64Array:
        """Chance of each object to be found, (N,) float64; 0 without evidence."""
        seen = evidence > 0
        exponent = self.steepness * np.log(np.where(seen, evidence, 1.0) / half) - self.hiding * occlusions
        # 1 / (1 + exp(-z)) as exp(-ln(1 + exp(-z))), which does not overflow.
        chances: Float64Array = np.where(seen, self.recall * np.exp(-np.logaddexp(0.0, -exponent)), 0.0)
        return chances


_CLASSES_3D: Mapping[str, ClassSpec] = MappingProxyType(
    {
        "car": ClassSpec(half_evidence=8.0, false_rate=0.6, size_lwh=(4.2, 1.8, 1.5)),
        "pedestrian": ClassSpec(half_evidence=6.0, false_rate=0.6, size_lwh=(0.7, 0.6, 1.75)),
        "cyclist": ClassSpec(half_evidence=6.0, false_rate=0.3, size_lwh=(1.8, 0.6, 1.75)),
    }
)
"""A fair detector, counted in lidar points."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Detector3dSpec:
    """A detector in lidar sweeps.

    Every deviation is for an object of many points near the lidar. It grows by
    (1 + range / `range_scale`) · √(1 + `few_points` / points).

    Attributes:
        classes: what it looks for.
        misses: what it does not find.
        center_sigmas: deviation of the middle [m] along the object's length, width and height.
        size_sigmas: deviation of length, width and height [m]; no size falls under a fifth of the true one.
        yaw_sigma_deg: deviation of the heading [deg].
        range_scale: range at which deviations have doubled [m].
        few_points: so many points make deviations √2 times larger.
        lasting_share: share of the variance of an object's errors that is the same in all sweeps.
        flip_share: share of boxes that head backwards, each sweep anew.
        velocity_sigma: deviation of each level component of the velocity [m/s], whatever the range; None for a
            detector that gives none.
        repeated: share of found objects that are reported twice.
        covariances: whether the boxes report their true covariances.
        scores: how sure it says it is.
        seed: another number makes other errors.

    Raises:
        OptionError: a number is out of bounds.
    """

    classes: Mapping[str, ClassSpec] = field(default_factory=lambda: _CLASSES_3D)
    misses: MissSpec = field(default_factory=MissSpec)
    center_sigmas: tuple[float, float, float] = (0.10, 0.06, 0.04)
    size_sigmas: tuple[float, float, float] = (0.12, 0.05, 0.05)
    yaw_sigma_deg: float = 1.5
    range_scale: float = 60.0
    few_points: float = 30.0
    lasting_share: float = 0.0
    flip_share: float = 0.02
    velocity_sigma: float | None = None
    repeated: float = 0.0
    covariances: bool = False
    scores: ScoreSpec = field(default_factory=ScoreSpec)
    seed: int = 0

    def __post_init__(self) -> None:
        bounds = (
            *each_of("center_sigmas", self.center_sigmas, 0.0, 1e3),
            *each_of("size_sigmas", self.size_sigmas, 0.0, 1e3),
            ("yaw_sigma_deg", self.yaw_sigma_deg, 0.0, 180.0),
            ("range_scale", self.range_scale, 1e-3, float("inf")),
            ("few_points", self.few_points, 0.0, _MANY),
            ("lasting_share", self.lasting_share, 0.0, 1.0),
            ("flip_share", self.flip_share, 0.0, 1.0),
            ("velocity_sigma", 0.0 if self.velocity_sigma is None else self.velocity_sigma, 0.0, 1e3),
            ("repeated", self.repeated, 0.0, 1.0),
            ("seed", self.seed, 0, float("inf")),
        )
        check_bounds("detector", bounds)

    def growth(self, ranges: Float64Array, points: Float64Array) -> Float64Array:
        """Factor on all deviations, (N,) float64, for objects at ranges [m] with numbers of points on them."""
        growth: Float64Array = (1.0 + ranges / self.range_scale) * np.sqrt(
            1.0 + self.few_points / np.maximum(1.0, points)
        )
        return growth


_CLASSES_2D: Mapping[str, ClassSpec] = MappingProxyType(
    {
        "car": ClassSpec(half_evidence=150.0, false_rate=0.3, size_lwh=(4.2, 1.8, 1.5)),
        "pedestrian": ClassSpec(half_evidence=120.0, false_rate=0.3, size_lwh=(0.7, 0.6, 1.75)),
        "cyclist": ClassSpec(half_evidence=150.0, false_rate=0.15, size_lwh=(1.8, 0.6, 1.75)),
    }
)
"""A fair detector, counted in pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Detector2dSpec:
    """A detector in images.

    Attributes:
        classes: what it looks for.
        misses: what it does not find.
        amodal: its boxes are those of whole objects, hidden parts included: the projected box in space, which is a
            little larger than the object. Else they hold what is to be seen. Both end where the image does.
        corner_sigma_px: deviation of each edge of a box [px].
        corner_sigma_share: added to it, a share of the box's width (height).
        lasting_share: share of the variance of an object's errors that is the same in all images.
        repeated: share of found objects that are reported twice.
        scores: how sure it says it is.
        seed: another number makes other errors.

    Raises:
        OptionError: a number is out of bounds.
    """

    classes: Mapping[str, ClassSpec] = field(default_factory=lambda: _CLASSES_2D)
    misses: MissSpec = field(default_factory=MissSpec)
    amodal: bool = False
    corner_sigma_px: float = 0.8
    corner_sigma_share: float = 0.015
    lasting_share: float = 0.0
    repeated: float = 0.0
    scores: ScoreSpec = field(default_factory=ScoreSpec)
    seed: int = 0

    def __post_init__(self) -> None:
        bounds = (
            ("corner_sigma_px", self.corner_sigma_px, 0.0, 1e4),
            ("corner_sigma_share", self.corner_sigma_share, 0.0, 10.0),
            ("lasting_share", self.lasting_share, 0.0, 1.0),
            ("repeated", self.repeated, 0.0, 1.0),
            ("seed", self.seed, 0, float("inf")),
        )
        check_bounds("detector", bounds)
