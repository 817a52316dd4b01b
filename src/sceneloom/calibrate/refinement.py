"""Refinement of extrinsics, time offset and focal length over many frames, accepted only if held-out frames agree.

A rotation about one axis moves pixels nearly as a shift, or as another time, does: in these numbers the objective is a
    long
narrow ridge, along which one climbs slowly and whose curvature differences do not report. By the mean square of how far
pixels move it is round.

Source: preconditioning by a quadratic form, e.g. Nocedal and Wright 2006, "Numerical Optimization", 5.1.

The objective's slope at the solution is a sum over parts of the images. How differently these parts pull, through the
objective's curvature, is the covariance: the sandwich of M-estimators. What one part of a view shows in one frame it
shows in the next ones, too: frames of one view pull together.

Source: Huber 1967, "The behavior of maximum likelihood estimates under nonstandard conditions"; clusters: Liang and
Zeger 1986.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise
from typing import TypeVar

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.measures import COUNT, UNITS, Change, Parameter
from sceneloom.calibrate.refinement_objective import (
    CHANNELS,
    WIDTHS_PX,
    Cues,
    Level,
    Linearised,
    find_cues,
    focused,
)
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.image_agreement import sum_maps
from sceneloom.scene.types import Progress

_GROUPS: dict[str, tuple[Parameter, ...]] = {
    "rotation": (Parameter.PITCH, Parameter.YAW, Parameter.ROLL),
    "translation": (Parameter.RIGHT, Parameter.DOWN, Parameter.AHEAD),
    "time": (Parameter.LATER,),
    "focal": (Parameter.FOCAL,),
}
"""What can be refined, by the words of the command line."""


class RefinementVerdict(StrEnum):
    """What became of a calibration."""

    REFINED = "refined"
    KEPT = "kept"
    UNDETERMINED = "cannot determine"


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """What refining came to.

    Attributes:
        verdict: whether the calibration is another one now.
        reason: why.
        camera_from_lidar: the refined one; the stated one unless the verdict is `refined`.
        camera: the camera model with refined focal lengths, or the stated one.
        time_offset: seconds to be added to the camera's timestamps.
        change: what was found, whatever the verdict: rotate and shift about the camera's axes, focal length, time.
        parameters: the groups that were refined.
        held: groups that the drive does not report, and how well it would.
        free: (P,) int64, the numbers of the change that were searched.
        covariance: (P, P) of these, in rad, m, logarithm and s.
        gains: how much likelier the held-out frames of each fold are under what the others found.
        sharpness: how far the solution stands above others around it, in their standard deviations.
        frames: how many were used.
        views: how many of them show something different.
    """

    verdict: RefinementVerdict
    reason: str
    camera_from_lidar: RigidTransform
    camera: Camera
    time_offset: float = 0.0
    change: Change = field(default_factory=Change)
    parameters: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    free: Int64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    covariance: Float64Array = field(default_factory=lambda: np.zeros((0, 0)))
    gains: tuple[float, ...] = ()
    sharpness: float = 0.0
    frames: int = 0
    views: int = 0

    @property
    def sigmas(self) -> dict[str, float]:
        """The standard deviation of each refined number, by its name in lower case: rad, m, logarithm, s."""
        roots = np.sqrt(np.diagonal(self.covariance))
        return {
            Parameter(k).name.lower(): float(root) for k, root in zip(self.free.tolist(), roots, strict=True)
        }

    @property
    def found_change(self) -> dict[str, float]:
        """What was found of each number that was searched, in the same units."""
        return {Parameter(k).name.lower(): self.change.numbers[k] for k in self.free.tolist()}


_FARTHEST = np.array([6.0, 6.0, 6.0, 3.0, 3.0, 3.0, 2.0, 2.5])
"""How far a calibration is usually off, in units: 1.5 degrees, 15 cm, 2 % of the focal length, 50 ms."""

_CURVATURE_STEP = 0.4
"""Curvature is taken over this part of the blur's width: over less, single pixels show."""


@dataclass(frozen=True, slots=True, eq=False)
class _Hill:
    """What the channels state around a candidate, and what speaks against going far.

    Attributes:
        linearised: the channels.
        weights: (C,), what each counts.
        reach: (P,), how far the numbers usually go, in units.
        offset: (P,), the candidate, in units.
        basis: (P, P), steps of the length 1, in units: they move pixels by the width of the blur (root mean square), or
            the numbers as far as they usually go.
    """

    linearised: Linearised
    weights: Float64Array
    reach: Float64Array
    offset: Float64Array
    basis: Float64Array

    @classmethod
    def around(cls, level: Level, free: AnyArray, numbers: Float64Array) -> "_Hill":
        """Stand at a candidate, (8,) numbers, of which some are free, (P,)."""
        linearised = level.around(numbers, free)
        weights = linearised.channel_weights(np.zeros(len(free)))
        form = linearised.motion_form() + np.diag(_FARTHEST[free] ** -2.0)
        basis = np.linalg.inv(np.linalg.cholesky(form)).T
        return cls(linearised, weights, _FARTHEST[free], (numbers / UNITS)[free], basis)

    def downwards(self, step: Float64Array) -> tuple[float, Float64Array]:
        """Minus the objective and its slope at a step, (P,)."""
        in_units = self.basis @ step
        sums = self.linearised.sums(in_units)
        away = (self.offset + in_units) / self.reach
        value = float((sums.values.sum(axis=0) * self.weights).sum() - 0.5 * away @ away)
        slope = away / self.reach - np.einsum("fcp,c->p", sums.gradients, self.weights)
        return -value, self.basis.T @ slope

    def inverse_curvature(self) -> Float64Array:
        """The inverse of minus the second derivatives, (P, P); where the objective rises it counts as flat.

        What is flat is bounded by how far the numbers usually go.
        """
        rows = []
        for axis in np.eye(len(self.reach)) * _CURVATURE_STEP:
            (_, ahead), (_, behind) = self.downwards(axis), self.downwards(-axis)
            rows.append((ahead - behind) / (2.0 * _CURVATURE_STEP))
        curvature = np.array(rows)
        values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
        bounds = np.square(self.basis @ vectors / self.reach[:, None]).sum(axis=0)
        inverse: Float64Array = vectors / np.maximum(values, bounds) @ vectors.T
        return inverse


_ROTATIONS = np.arange(3)

_STARTS = 200

_KEPT = (8, 3, 1)
"""So many candidates are followed up after each look."""

_ROUNDS = 2

_MOST_ROTATED = (12_000, 16_000, 24_000)

_MOST_MOVED = (40_000, 160_000)
"""Points that count at each look, for the rotations alone and for all numbers; few report rotates.

And wide maps are smooth.
"""

_MOST_STEPS = 10

_FIRST_STEP, _LONGEST_STEP, _SMALLEST_STEP, _FARTHEST_CLIMB = 0.3, 1.0, 0.01, 2.0
"""Of a climb, in widths of the blur; the maps are smooth over about so much."""

_SEED = 7

_LAST_STEPS = 3


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Where a search ended.

    Attributes:
        numbers: (8,) float64, as of a `Change`.
        free: (P,) int64, which of them were searched.
        weights: (C,) of the channels there.
        inverse: (P, P), inverse of minus the second derivatives of the objective by units, at the last level.
        last: the last level around these numbers.
    """

    numbers: Float64Array
    free: AnyArray
    weights: Float64Array
    inverse: Float64Array
    last: Linearised


def _search(
    levels: Sequence[Level],
    frames: AnyArray,
    free: AnyArray,
    *,
    thinned: int = 1,
) -> _Found:
    """Find the best candidate near the stated calibration.

    Rotates are searched first, from many beginnings, for they move what is far away as well as what is near; then all
    numbers together from there.

    Args:
        levels: from wide to narrow.
        frames: (F,) bool, which of them count.
        free: (P,) int64, which of the eight numbers are searched.
        thinned: one point of so many counts.
    """
    most = [count // thinned for count in _MOST_ROTATED]
    best = _rotated([level.part(frames, most=count) for level, count in zip(levels, most, strict=True)])
    most = [count // thinned for count in _MOST_MOVED]
    parts = [level.part(frames, most=count) for level, count in zip(levels[1:], most, strict=True)]
    for level in parts:
        best = _climb(level, free, best)
    return _polished(parts[-1], free, best)


def _rotated(levels: Sequence[Level]) -> Float64Array:
    """The best rotate of the stated calibration."""
    found = _beginnings(levels[0])
    for number, level in enumerate(levels):
        climbed = [_climb(level, _ROTATIONS, begun) for begun in found]
        found = _best(level, climbed)[: _KEPT[number]]
    return found[0]


def _beginnings(level: Level) -> list[Float64Array]:
    """The stated calibration, and the best of some others rotated from it."""
    around = level.around(np.zeros(COUNT), _ROTATIONS)
    drawn = np.random.default_rng(_SEED).normal(0.0, 0.5, (_STARTS, len(_ROTATIONS))) * _FARTHEST[_ROTATIONS]
    best = np.argsort([-_stationary(around, step) for step in drawn])[: _KEPT[0] - 1]
    return [np.zeros(COUNT), *(_spread(_ROTATIONS, drawn[k]) for k in best)]


def _best(level: Level, found: Sequence[Float64Array]) -> list[Float64Array]:
    """Those found, the best first."""
    stationary = [
        _stationary(level.around(numbers, _ROTATIONS), np.zeros(len(_ROTATIONS))) for numbers in found
    ]
    return [found[k] for k in np.argsort(stationary)[::-1]]


def _stationary(linearised: Linearised, step: Float64Array) -> float:
    """How far the channels together stand above 0, in standard deviations; weights play no part, so it compares."""
    sums = linearised.sums(step)
    scores = sums.values.sum(axis=0) / np.sqrt(np.maximum(sums.squares.sum(axis=0), 1e-9))
    return float(scores.sum())


def _spread(free: AnyArray, step: Float64Array) -> Float64Array:
    """A step in units as a change of all eight numbers."""
    numbers = np.zeros(COUNT)
    numbers[free] = step * UNITS[free]
    return numbers


def _climb(level: Level, free: AnyArray, numbers: Float64Array) -> Float64Array:
    """Go uphill at one level, with pixels linearised anew in each round."""
    for _ in range(_ROUNDS):
        hill = _Hill.around(level, free, numbers)
        step = _descended(hill)
        numbers = numbers + _spread(free, hill.basis @ step)
        if np.abs(step).max() < 0.05:
            break
    return numbers


def _descended(hill: _Hill) -> Float64Array:
    """Where a quasi-Newton descent of minus the objective ends; a library's would wake threads for eight numbers.

    Source: the update of Broyden, Fletcher, Goldfarb and Shanno, with halved steps (Nocedal and Wright 2006,
    algorithm 6.1).
    """
    here = np.zeros(len(hill.basis))
    value, slope = hill.downwards(here)
    inverse = np.eye(len(here)) * (_FIRST_STEP / max(float(np.sqrt((slope**2).sum())), 1e-12))
    for _ in range(_MOST_STEPS):
        trajectory = -(inverse * slope).sum(axis=1)
        trajectory *= min(1.0, _LONGEST_STEP / max(float(np.sqrt((trajectory**2).sum())), 1e-12))
        for share in (1.0, 0.5, 0.25, 0.125):
            ahead = here + share * trajectory
            value_ahead, slope_ahead = hill.downwards(ahead)
            if value_ahead < value:
                break
        else:
            break
        moved, bent = ahead - here, slope_ahead - slope
        product = float((moved * bent).sum())
        if product > 1e-12:
            left = np.eye(len(here)) - np.outer(moved, bent) / product
            inverse = left @ inverse @ left.T + np.outer(moved, moved) / product
        here, value, slope = ahead, value_ahead, slope_ahead
        if np.abs(moved).max() < _SMALLEST_STEP or np.abs(here).max() > _FARTHEST_CLIMB:
            break
    return here


def _polished(level: Level, free: AnyArray, numbers: Float64Array) -> _Found:
    """Newton's steps to the top, which long narrow ridges need; none that leads down."""
    for _ in range(_LAST_STEPS):
        hill = _Hill.around(level, free, numbers)
        value, slope = hill.downwards(np.zeros(len(free)))
        step = np.clip(-hill.inverse_curvature() @ slope, -1.0, 1.0)
        share = next((part for part in (1.0, 0.5, 0.25) if hill.downwards(part * step)[0] < value), 0.0)
        numbers = numbers + _spread(free, hill.basis @ (share * step))
        if np.abs(share * step).max() < _SMALLEST_STEP:
            break
    hill = _Hill.around(level, free, numbers)
    inverse = hill.basis @ hill.inverse_curvature() @ hill.basis.T
    return _Found(numbers, free, hill.weights, inverse, hill.linearised)


_ACROSS, _DOWN = 6, 3

_SYSTEMATIC = 0.05
"""What all parts share [units], such as shadows beside objects: 0.0125 degrees, 2.5 mm, 1 ms. With less, intervals of
simulated drives hold the truth too rarely."""


def _covariance_of(found: _Found, views: Int64Array) -> Float64Array:
    """Give the covariance of the free numbers, (P, P), in units.

    Args:
        views: (F,) int64, which frames show nearly the same.
    """
    reach = _FARTHEST[found.free]
    pulls = _cluster_slopes(found, views)
    count = int((np.abs(pulls).sum(axis=1) > 0).sum())
    spread = pulls.T @ pulls * (count / max(count - 1, 1)) + np.diag(reach**-2.0)
    systematic = np.diag(np.full(len(found.free), _SYSTEMATIC**2))
    return np.asarray(found.inverse @ spread @ found.inverse + systematic, np.float64)


def _cluster_slopes(found: _Found, views: Int64Array) -> Float64Array:
    """The slope of each tile of each view at the solution, (K, P)."""
    level = found.last.level
    frames = level.groups // len(CHANNELS)
    height, width = level.maps.shape[1:]
    inside = np.nan_to_num(found.last.pixels)
    across = np.clip(inside[:, 0] / width * _ACROSS, 0, _ACROSS - 1).astype(np.int64)
    down = np.clip(inside[:, 1] / height * _DOWN, 0, _DOWN - 1).astype(np.int64)
    clusters = ((views[frames] * _DOWN + down) * _ACROSS + across).astype(np.int32)
    count, free = int(clusters.max(initial=0)) + 1, len(found.free)
    slopes = np.zeros((count, free))
    weights = (level.weights * found.weights[level.groups % len(CHANNELS)]).astype(np.float32)
    sum_maps(
        found.last.pixels, found.last.slopes, np.zeros(free), weights, level.rows, clusters, level.maps,
        np.zeros(count), np.zeros(count), slopes,
    )  # fmt: skip
    return slopes


_LOOSEST = {"rotation": np.radians(0.5), "translation": 0.15, "time": 0.05, "focal": 0.02}
"""Standard deviations [rad], [m], [s], and of the focal length's logarithm, from which a group is not reported.

The stated
calibration is usually known as well."""

_LEAST_VIEWS = 4
"""Shift, time and focal length move pixels by a little as a rotation does.

What single objects suggest of the difference
averages out over several views only."""

_SHARPEST_WRONG = 4.0
"""How far above others around it, in their standard deviations, wrong calibrations come at most; right ones reach 6."""

_AROUND, _NEARBY = 60, (3.0, 8.0)

_FARTHEST_ROTATION, _FARTHEST_SHIFT, _FARTHEST_LATER = np.radians(4.0), 0.5, 0.2
"""A repair beyond these [rad], [m], [s] is no repair: the search went astray, or the stated calibration is no start."""


def _held_out_gain(levels: Sequence[Level], held_out: BoolArray, free: Int64Array) -> float:
    """How much likelier frames are under what the others found than under the stated calibration."""
    start = np.zeros(COUNT)
    found = _search(levels, ~held_out, free, thinned=2)
    level = levels[-1].part(held_out)
    values = [
        float(
            (level.around(numbers, free).sums(np.zeros(len(free))).values.sum(axis=0) * found.weights).sum()
        )
        for numbers in (start, found.numbers)
    ]
    return values[1] - values[0]


def _sharpness_of(found: _Found) -> float:
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


def _judged(
    found: _Found, covariance: Float64Array, gains: Sequence[float], sharpness: float
) -> tuple[RefinementVerdict, str]:
    """Whether what was found is to be taken."""
    numbers = found.numbers
    sigma = float(np.degrees(np.sqrt(np.diagonal(covariance)[:3].max()) * UNITS[0]))
    if not found.weights.any() or not sharpness > _SHARPEST_WRONG:
        return RefinementVerdict.UNDETERMINED, (
            f"nothing stands out near the stated calibration: the best is {sharpness:.1f} standard deviations above "
            f"others around it; expected {_SHARPEST_WRONG:.0f} or more"
        )
    if sigma > np.degrees(_LOOSEST["rotation"]):
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


_TRAJECTORY, _ROTATION = 2.0, np.radians(6.0)
"""Beyond this trajectory [m] or rotation a view counts as another one."""


def views_of(frames: Sequence[CalibrationFrame]) -> Int64Array:
    """Number the views of frames in the order of their time, (F,) int64; unknown motion is none."""
    numbers, trajectory, rotation = [0], 0.0, 0.0
    for before, after in pairwise(frames):
        if before.twist_lidar is not None:
            seconds = abs(after.image_ns - before.image_ns) * 1e-9
            trajectory += float(np.linalg.norm(before.twist_lidar[3:])) * seconds
            rotation += float(np.linalg.norm(before.twist_lidar[:3])) * seconds
        new = trajectory > _TRAJECTORY or rotation > _ROTATION
        numbers.append(numbers[-1] + int(new))
        trajectory, rotation = (0.0, 0.0) if new else (trajectory, rotation)
    return np.array(numbers[: len(frames)], np.int64)


_Result = TypeVar("_Result")

DEFAULT = ("rotation", "translation", "time")

_LEAST_FRAMES = 4

_FOLDS = 3

_LEAST_CUES = 150
"""A frame with fewer points around its image is not used."""


def refine(
    frames: Sequence[CalibrationFrame],
    *,
    parameters: Sequence[str] = DEFAULT,
    progress: Progress | None = None,
) -> Refinement:
    """Refine the calibration of a camera against a lidar by frames of a drive.

    Args:
        frames: of one camera and one lidar, all with the same stated calibration.
        parameters: names out of `_GROUPS`; "rotation" is always among what is refined.
        progress: reported how many of the steps are done.

    Raises:
        OptionError: a parameter is unknown.
    """
    groups = _groups(parameters)
    if len(frames) < _LEAST_FRAMES:
        return _unable(
            frames, f"{len(frames)} frames; expected {_LEAST_FRAMES} or more, to refine and to judge by"
        )
    reported = _Reported(progress, len(frames) + len(WIDTHS_PX) + 2 + _FOLDS)
    cues = tuple(
        one for frame in frames if len((one := reported.after(find_cues(frame))).weights) >= _LEAST_CUES
    )
    problem = _why_not(frames, cues)
    if problem:
        return _unable(frames, problem)
    levels = tuple(reported.after(Level.of(cues, width)) for width in WIDTHS_PX)
    return _refined(_Drive(cues, levels, views_of([one.frame for one in cues])), groups, reported)


def _groups(parameters: Sequence[str]) -> tuple[str, ...]:
    unknown = [name for name in parameters if name not in _GROUPS]
    if unknown or not parameters:
        raise OptionError(f"parameters {', '.join(unknown) or 'none'}; expected some of {', '.join(_GROUPS)}")
    return tuple(name for name in _GROUPS if name == "rotation" or name in parameters)


@dataclass(slots=True)
class _Reported:
    """Counts what is done."""

    progress: Progress | None
    whole: int
    done: int = 0

    def after(self, result: _Result) -> _Result:
        """Report that something more is done."""
        self.done = min(self.done + 1, self.whole)
        if self.progress is not None:
            self.progress(self.done, self.whole)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    cues: tuple[Cues, ...]
    levels: tuple[Level, ...]
    views: Int64Array

    @property
    def all_frames(self) -> BoolArray:
        return np.ones(len(self.cues), np.bool_)

    @property
    def folds(self) -> list[BoolArray]:
        """Frames that are held out together: stretches of the drive, whole views where there are enough."""
        whole = self.views if self.views[-1] + 1 >= _FOLDS else np.arange(len(self.cues))
        return [whole * _FOLDS // (int(whole[-1]) + 1) == fold for fold in range(_FOLDS)]


def _why_not(frames: Sequence[CalibrationFrame], cues: Sequence[Cues]) -> str:
    """What speaks against even trying; "" for nothing."""
    if len(cues) < _LEAST_FRAMES:
        return (
            f"the camera sees enough of the cloud in {len(cues)} of {len(frames)} frames; expected {_LEAST_FRAMES}: "
            "does it look where the calibration says, and does the lidar see there?"
        )
    cameras = {(one.frame.camera.width, one.frame.camera.height, one.frame.camera.fx) for one in cues}
    if len(cameras) > 1:
        return "the camera model differs from image to image; expected one that is the same in all"
    if float(np.median([one.features.image.plainness for one in cues])) > 0.97:
        return "the images show next to nothing: black, covered or overexposed; expected edges to go by"
    return ""


def _unable(frames: Sequence[CalibrationFrame], reason: str) -> Refinement:
    if not frames:
        raise CalibrationError("no frames to refine a calibration by; expected some")
    return Refinement(
        RefinementVerdict.UNDETERMINED,
        reason,
        frames[0].camera_from_lidar,
        frames[0].camera,
        frames=len(frames),
    )


def _refined(drive: _Drive, groups: tuple[str, ...], reported: _Reported) -> Refinement:
    found, covariance, groups, held = _refine_best(drive, groups, reported)
    gains = tuple(reported.after(_held_out_gain(drive.levels, fold, found.free)) for fold in drive.folds)
    sharpness = _sharpness_of(found)
    verdict, reason = _judged(found, covariance, gains, sharpness)
    stated = drive.cues[0].frame
    change = Change.of(found.numbers)
    scale = UNITS[found.free]
    taken = change if verdict is RefinementVerdict.REFINED else Change()
    matrix = taken.camera_from_lidar(stated.camera_from_lidar.matrix)
    return Refinement(
        verdict,
        reason,
        RigidTransform.nearest(matrix)[0],
        focused(stated.camera, taken.numbers[Parameter.FOCAL]),
        taken.numbers[Parameter.LATER],
        change,
        groups,
        held,
        found.free,
        covariance * np.outer(scale, scale),
        gains,
        sharpness,
        len(drive.cues),
        int(drive.views[-1]) + 1,
    )


def _refine_best(
    drive: _Drive, groups: tuple[str, ...], reported: _Reported
) -> tuple[_Found, Float64Array, tuple[str, ...], tuple[str, ...]]:
    """Search for all groups, and again without those that the drive does not report."""
    held: list[str] = []
    count = int(drive.views[-1]) + 1
    if count < _LEAST_VIEWS:
        held = [
            f"{name}: {count} views; expected {_LEAST_VIEWS} or more" for name in groups if name != "rotation"
        ]
        groups = ("rotation",)
    while True:
        free = np.array([int(parameter) for name in groups for parameter in _GROUPS[name]], np.int64)
        found = reported.after(_search(drive.levels, drive.all_frames, free))
        covariance = _covariance_of(found, drive.views)
        sigmas = _sigmas(found.free, covariance, groups)
        loose = {
            name: sigma for name, sigma in sigmas.items() if sigma > _LOOSEST[name] and name != "rotation"
        }
        if not loose:
            return found, covariance, groups, tuple(held)
        held += [f"{name}: known within {_worded(name, sigma)} only" for name, sigma in loose.items()]
        groups = tuple(name for name in groups if name not in loose)


def _sigmas(free: Int64Array, covariance: Float64Array, groups: Sequence[str]) -> dict[str, float]:
    """The largest standard deviation of each group."""
    roots = np.sqrt(np.diagonal(covariance)) * UNITS[free]
    return {name: max(float(roots[free == int(k)][0]) for k in _GROUPS[name]) for name in groups}


def _worded(name: str, sigma: float) -> str:
    scale, unit = {
        "rotation": (np.degrees(1.0), "deg"),
        "translation": (100.0, "cm"),
        "time": (1e3, "ms"),
    }.get(name, (100.0, "%"))
    return f"{sigma * scale:.2g} {unit}"
