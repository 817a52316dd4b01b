"""Refinement of camera-lidar extrinsics by the edges and intensities that image and points share.

Each channel compares its points with a map of the image that was blurred to some width and freed of structures that are
wider: a candidate that places points anywhere gets 0. If a point at its right location meets the mean value m of its
map, and the map's values vary by v, then m/v times the value is the logarithm of how much likelier the point's location
is than any other (both normal): channels are weighted by that, so the best-matching ones count most.

Source: edges of clouds against blurred edges of images: Levinson and Thrun 2013; intensity against brightness:
Pandey, McBride, Savarese and Eustice 2012; Gaussian scale space, coarse to fine: Witkin, Terzopoulos and Kass 1987.

A rotation about one axis moves pixels nearly as a translation, or another time, does: in these numbers the objective is
a long narrow ridge, along which the climb is slow and whose curvature differences do not show. In steps by the mean
square of how far pixels move it is round.

Source: preconditioning by a quadratic form, e.g. Nocedal and Wright 2006, "Numerical Optimization", 5.1.

The objective's slope at the solution is a sum over points. How differently they pull, through the objective's
curvature, is the covariance: the sandwich of M-estimators. Points of one object err together, in whatever frames they
are, and so do edges of one kind and direction, since those of a cloud lie between two beams and some of an image are
shadows: the scatter among objects and that among kinds are added up. Few objects know their own scatter badly, which
widens the region of changes that may be chance; so does the distance of the beams, of which other scenes of the same
sensors could not tell more.

Source: Huber 1967, "The behavior of maximum likelihood estimates under nonstandard conditions"; clusters: Liang and
Zeger 1986; of several kinds: Cameron, Gelbach and Miller 2011, "Robust inference with multiway clustering",
without the part that both share, so that it is an upper bound; regions of few samples: Hotelling 1931.

What is stated is a measurement too, good to `FARTHEST`, with which the solution is combined by least squares: where
the drive reports little, the stated numbers stay, and the covariance has what is not known of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import TypeVar

import numpy as np
from numba import float64, void
from scipy import ndimage, special

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame, ScanOrder
from sceneloom.calibrate.measures import (
    COUNT,
    DIRECTIONS,
    EDGES,
    UNITS,
    Change,
    FrameFeatures,
    Parameter,
    evened,
    extract,
    measured_image,
)
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F32_1D, IN_F32_2D, IN_F32_3D, IN_F64_1D, IN_I32_1D
from sceneloom.scene.types import Progress

DEFAULT = ("rotation", "translation", "time")
"""Groups that are refined unless others are asked for."""

_GROUPS: dict[str, tuple[Parameter, ...]] = {
    "rotation": (Parameter.PITCH, Parameter.YAW, Parameter.ROLL),
    "translation": (Parameter.RIGHT, Parameter.DOWN, Parameter.AHEAD),
    "time": (Parameter.LATER,),
    "focal": (Parameter.FOCAL,),
}  # what can be refined, by the words of the command line

_SCALES = {"translation": (100.0, "cm"), "time": (1e3, "ms"), "focal": (100.0, "%")}  # for messages
_UNDETERMINED, _LOOSEST = 0.6, np.radians(0.5)
"""A group known no better than this part of `FARTHEST` is held; a rotation known no better than this [rad] is none."""

CHANNELS = ("depth edges", "intensity edges", "contrasts")
"""What is compared with an image; contrasts of intensity are compared with its brightness, edges with its edges."""

_LEVEL_MAP = DIRECTIONS  # number of the map of brightness; those of edges come before it

_MAPS = _LEVEL_MAP + 1
_MOST_CONTRASTS, _MOST_EDGES = 3000, 1500
"""Points of a channel in a frame: the strongest contrasts, and edges evenly drawn."""

_BRIGHT_SHARE, _LEAST_STEP, _STRONGEST_STEP = 0.1, 6.0, 60.0
"""The greatest of the steps in intensity along the scan lines, so many, are edges."""

_SMOOTH_SHARE, _LEAST_SMOOTH, _GAP_STEPS = 0.02, 0.1, 2.5
"""Neighbours are of one surface where the range changes by less than this share, or this many metres."""

_SURROUNDINGS = 61
"""Where no lines are known: points in the order of the image whose intensities a point's own is compared with."""

_STEP_SHARE, _FOCAL_STEP = 1e-4, 1e-4
"""Derivatives of the camera model are taken over this part of a point's distance, and of the focal length."""

WIDTHS_PX = (6.0, 3.0, 1.0)  # how far images are blurred [px of the measured image], from the first look to the last

_STRIDES = {6.0: 3, 3.0: 2, 1.0: 1}
"""So many pixels of an image are one of the map: a wide blur leaves nothing between them."""

_WIDER = 4.0
_BRIGHTNESS_SHARE = 0.5
"""Contrasts are known where their points are, edges between two points: brightness is blurred less than edges."""

_CELL_WIDTHS = 2.0  # points of a channel within so many widths see the same of an image: they count as one

FARTHEST = np.array([6.0, 6.0, 6.0, 3.0, 3.0, 3.0, 2.0, 2.5])
"""How far a calibration is usually off, in units: 1.5 degrees, 15 cm, 2 % of the focal length, 50 ms."""

_CURVATURE_STEP = 0.4  # curvature is taken over this part of the blur's width: over less, single pixels show

_ROTATIONS, _STARTS, _SEED = np.arange(3), (200, 1500), 7
_STARTS_SPREAD, _MOST_STARTED = np.radians((0.75, 6.0)), 6000
"""So many rotations are tried, near the stated one (standard deviation) and within a ball of a radius [rad], by at most
so many points."""

_KEPT = (8, 3, 1)  # so many candidates are followed up after each look

_MOST_ROTATED, _MOST_MOVED = (12_000, 16_000, 24_000), (40_000, 160_000)
"""Points used at each stage, for the rotation alone and for all parameters: few suffice, since wide maps are smooth."""

_RIDGE_STARTS, _RIDGES_KEPT, _RIDGE_WIDTH = 800, 2, 1.0 / 3.0
"""So many translations and times are tried, with rotations that make up for them up to this part of what is usual; so
many are followed up."""

_ROUNDS, _LAST_STEPS, _MOST_STEPS = 2, 3, 10
_FIRST_STEP, _LONGEST_STEP, _SMALLEST_STEP, _FARTHEST_CLIMB = 0.3, 1.0, 0.01, 2.0
"""Of a climb, in widths of the blur; the maps are smooth over about so much."""

_OBJECT = 5.0
"""Points within such a square of the ground are of one object [m]: a car, a stretch of a facade."""

_RESOLVED, _NEAR = 12.0**-0.5, 10.0
"""An edge lies anywhere between two beams: its standard deviation is that share of their distance; for translations it
is that angle at so many metres."""

_SHARPEST_WRONG, _AROUND, _NEARBY = 5.0, 60, (3.0, 8.0)
"""How far above others around it, in their standard deviations, wrong calibrations come: the best of some 300,000 by
chance, as many as differ within 6 degrees and what translations and times are usual. Right ones reach 6."""

_FARTHEST_ROTATION, _FARTHEST_SHIFT, _FARTHEST_LATER = np.radians(8.0), 0.5, 0.2
"""A refinement beyond these [rad], [m], [s] is none: the search went astray, or the stated calibration is no start."""

_SEEN_ANEW = np.radians(2.0)
"""Beyond this rotation the camera sees other points than the stated calibration says: they are found again."""

_CONFIDENCE = 0.95
"""Of the region of changes that may be chance, and of the gain of objects in held-out frames."""

_LEAST_FRAMES, _FOLDS = 4, 3
_LEAST_CUES, _PLAIN = 150, 0.97
"""A frame with fewer points around its image is not used; images of which more is plain show nothing."""

_Result = TypeVar("_Result")


class RefinementVerdict(StrEnum):
    """The outcome of a refinement."""

    REFINED = "refined"
    KEPT = "kept"
    UNDETERMINED = "cannot determine"


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """The result of a refinement.

    Attributes:
        verdict: whether the calibration is another one now.
        reason: why.
        camera_from_lidar: the refined one; the stated one unless the verdict is `refined`.
        camera: the camera model with refined focal lengths, or the stated one.
        time_offset: seconds to be added to the camera's timestamps.
        change: what was found, whatever the verdict: rotation and translation about the camera's axes, focal length,
            time.
        parameters: the groups that were refined.
        held: groups that the drive does not determine, and how well it would; they stay as stated.
        free: (P,) int64, the numbers of the change that were searched.
        covariance: (P, P) of these, in rad, m, logarithm and s, whatever is held.
        gains: how much likelier the held-out frames of each fold are under the calibration that the others found.
        sharpness: how far the solution stands above others around it, in their standard deviations.
        frames: how many were used.
        objects: how many objects the result rests on, each counted by what it contributes.
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
    objects: float = 0.0

    @property
    def sigmas(self) -> dict[str, float]:
        """The standard deviation of each refined number, by its name in lower case: rad, m, logarithm, s."""
        roots = np.sqrt(np.diagonal(self.covariance))
        return {Parameter(k).name.lower(): float(root) for k, root in zip(self.free.tolist(), roots, strict=True)}

    @property
    def found_change(self) -> dict[str, float]:
        """What was found of each number that was searched, in the same units."""
        return {Parameter(k).name.lower(): self.change.numbers[k] for k in self.free.tolist()}


def refine(
    frames: Sequence[CalibrationFrame], *, parameters: Sequence[str] = DEFAULT, progress: Progress | None = None
) -> Refinement:
    """Refine the calibration of a camera against a lidar by frames of a drive.

    Args:
        frames: of one camera and one lidar, all with the same stated calibration.
        parameters: names out of `_GROUPS`; "rotation" is always among what is refined. Rotation, translation and
            time not named stay as stated, yet what is not known of them counts.
        progress: reported how many of the steps are done.

    Raises:
        OptionError: a parameter is unknown.
        CalibrationError: there are no frames.
    """
    result = _refined(frames, parameters, progress)
    far = float(np.linalg.norm(result.change.numbers[:3])) > _SEEN_ANEW
    if result.verdict is not RefinementVerdict.REFINED or not far:
        return result
    # the right one is found again from where it is; of others the drive does not know that much
    begun = [replace(frame, camera_from_lidar=result.camera_from_lidar) for frame in frames]
    again = _refined(begun, parameters)
    if again.verdict is not RefinementVerdict.UNDETERMINED:
        return result
    return replace(
        result,
        verdict=RefinementVerdict.UNDETERMINED,
        reason=f"far from the stated calibration one was found, but not again from there: {again.reason}",
        camera_from_lidar=frames[0].camera_from_lidar,
        camera=frames[0].camera,
        time_offset=0.0,
    )


def _refined(
    frames: Sequence[CalibrationFrame], parameters: Sequence[str], progress: Progress | None = None
) -> Refinement:
    """Refine without looking again from what is found."""
    unknown = [name for name in parameters if name not in _GROUPS]
    if unknown or not parameters:
        raise OptionError(f"parameters {', '.join(unknown) or 'none'}; expected some of {', '.join(_GROUPS)}")
    if not frames:
        raise CalibrationError("no frames to refine a calibration by; expected some")
    groups = tuple(name for name in _GROUPS if name == "rotation" or name in parameters)
    stated = Refinement(
        RefinementVerdict.UNDETERMINED, "", frames[0].camera_from_lidar, frames[0].camera, frames=len(frames)
    )
    if len(frames) < _LEAST_FRAMES:
        reason = f"{len(frames)} frames; expected {_LEAST_FRAMES} or more, to refine and to judge by"
        return replace(stated, reason=reason)
    if len({(frame.camera.width, frame.camera.height, frame.camera.fx) for frame in frames}) > 1:
        reason = "the camera model differs from image to image; expected one that is the same in all"
        return replace(stated, reason=reason)
    done, whole = 0, len(frames) + 2 + _FOLDS

    def after(result: _Result) -> _Result:
        nonlocal done
        done = min(done + 1, whole)
        if progress is not None:
            progress(done, whole)
        return result

    levels = find_levels(frames, _LEAST_CUES, after)
    cues = levels[0].cues if levels else ()
    problem = _why_not(frames, cues)
    if problem:
        return replace(stated, reason=problem)
    everything = np.ones(len(cues), np.bool_)
    free = _numbers_of([name for name in _GROUPS if name in groups or name in DEFAULT])
    found = after(search(levels, everything, free))
    if float(np.linalg.norm(found.numbers[:3])) > _SEEN_ANEW:
        cues = [_seen_anew(one, found.numbers) for one in cues]
        levels = [Level.of(cues, level.width, level.maps) for level in levels]
        found = search(levels, everything, free, begun=found.numbers)
    covariance, objects = _covariance_of(found)
    after(None)
    combined, known = _combined(found, covariance)
    roots = dict(zip(free.tolist(), np.sqrt(np.diagonal(known)).tolist(), strict=True))
    worst = {name: max(_GROUPS[name], key=lambda k: roots[k] / FARTHEST[k]) for name in groups}
    loose = [name for name, k in worst.items() if name in _SCALES and roots[k] > _UNDETERMINED * FARTHEST[k]]
    refined = _numbers_of([name for name in groups if name not in loose])
    numbers, known = _holding(combined, known, free, ~np.isin(free, refined))
    folds = [np.arange(len(cues)) * _FOLDS // len(cues) == fold for fold in range(_FOLDS)]
    of_points = _objects_of(levels[-1])
    gains = np.array([after(_held_out_gains(levels, fold, free, found.numbers, of_points)) for fold in folds])
    sharpness = _sharpness_of(found)
    asked = np.isin(free, _numbers_of(groups))
    verdict, reason = _judged(found, numbers, covariance, known, asked, objects, gains, sharpness)
    change = Change.of(numbers)
    taken = change if verdict is RefinementVerdict.REFINED else Change()
    first = cues[0].frame
    return Refinement(
        verdict=verdict,
        reason=reason,
        camera_from_lidar=RigidTransform.nearest(taken.camera_from_lidar(first.camera_from_lidar.matrix))[0],
        camera=_focused(first.camera, taken.numbers[Parameter.FOCAL]),
        time_offset=taken.numbers[Parameter.LATER],
        change=change,
        parameters=tuple(name for name in groups if name not in loose),
        held=tuple(
            f"{name}: known within {roots[worst[name]] * UNITS[worst[name]] * _SCALES[name][0]:.2g} "
            f"{_SCALES[name][1]} only, held as stated"
            for name in loose
        ),
        free=free[asked],
        covariance=(known * np.outer(UNITS[free], UNITS[free]))[np.ix_(asked, asked)],
        gains=tuple(gains[:, 0].sum(axis=1).tolist()),
        sharpness=sharpness,
        frames=len(cues),
        objects=objects,
    )


def _numbers_of(groups: Sequence[str]) -> Int64Array:
    """The numbers of some groups, (P,)."""
    return np.array([int(parameter) for name in groups for parameter in _GROUPS[name]], np.int64)


def _why_not(frames: Sequence[CalibrationFrame], cues: "Sequence[_Cues]") -> str:
    """Why a search would be useless; "" if it may not be."""
    if len(cues) < _LEAST_FRAMES:
        return (
            f"the camera sees enough of the cloud in {len(cues)} of {len(frames)} frames; expected {_LEAST_FRAMES}: "
            "does it look where the calibration says, and does the lidar see there?"
        )
    if float(np.median([one.plainness for one in cues])) > _PLAIN:
        return "the images show next to nothing: black, covered or overexposed; expected edges to go by"
    return ""


def _combined(found: "Around", covariance: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The solution and what is stated, combined: numbers in units, (P,), and their covariance, (P, P)."""
    information, step = np.linalg.inv(covariance), (found.numbers / UNITS)[found.free]
    known = np.linalg.inv(information + np.diag(FARTHEST[found.free] ** -2.0))
    return known @ information @ step, known


def _holding(
    combined: Float64Array, known: Float64Array, free: Int64Array, held: BoolArray
) -> tuple[Float64Array, Float64Array]:
    """The numbers, (8,), where those held, (P,) bool, are 0 and others what they most likely are then; covariance."""
    # Source: conditional mean of a normal distribution; how far it is from the mean adds to the covariance
    away = np.zeros(len(free))
    if held.any():
        away = known[:, held] @ np.linalg.solve(known[np.ix_(held, held)], combined[held])
    return _spread(free, np.where(held, 0.0, combined - away)), known + np.outer(away, away)


def _judged(
    found: "Around", numbers: Float64Array, covariance: Float64Array, known: Float64Array, asked: BoolArray,
    objects: float, gains: Float64Array, sharpness: float,
) -> tuple[RefinementVerdict, str]:  # fmt: skip
    """Whether the solution is to be taken."""
    rotation, shift = (float(np.linalg.norm(part)) for part in (numbers[:3], numbers[3:6]))
    later, undetermined = float(numbers[Parameter.LATER]), RefinementVerdict.UNDETERMINED
    sigma = float(np.sqrt(np.diagonal(known)[:3].max()) * UNITS[0])
    if not found.weights.any() or not sharpness > _SHARPEST_WRONG:
        return undetermined, (
            f"nothing stands out near the stated calibration: the best is {sharpness:.1f} standard deviations above "
            f"others around it; expected {_SHARPEST_WRONG:.0f} or more"
        )
    if sigma > _LOOSEST:
        return undetermined, f"the rotation is known within {np.degrees(sigma):.2g} deg only; expected 0.5 or better"
    if rotation > _FARTHEST_ROTATION or shift > _FARTHEST_SHIFT or abs(later) > _FARTHEST_LATER:
        return undetermined, (
            f"the best is {np.degrees(rotation):.1f} deg, {shift:.2f} m and {later * 1e3:.0f} ms away from the stated "
            "calibration, too far for a refinement; expected a start within a few degrees (`--target`, `--hand-eye` "
            "give one)"
        )
    worse, (of_objects, evidence) = int((gains[:, 0].sum(axis=1) <= 0.0).sum()), gains.sum(axis=0)
    # how unevenly objects gain for what they show (ratio estimator: Cochran 1977, "Sampling Techniques", 6.4)
    uneven = of_objects - evidence * (of_objects.sum() / max(float(evidence.sum()), 1e-12))
    gain = float(of_objects.sum()) / max(float(np.sqrt(np.square(uneven).sum())), 1e-12)
    least = float(special.ndtri(_CONFIDENCE))
    if worse or gain < least:
        return RefinementVerdict.KEPT, (
            f"held-out frames do not agree: {worse} of {len(gains)} held-out parts of the drive fit the stated "
            f"calibration better, and all together are {gain:.1f} standard deviations for the other one; expected "
            f"{least:.1f}"
        )
    step, count = (found.numbers / UNITS)[found.free][asked], int(asked.sum())
    resolved = covariance + np.diag((_RESOLVED * _resolution(found.level.cues, found.free)) ** 2)
    resolved = resolved[np.ix_(asked, asked)]
    distance = float(step @ np.linalg.solve(resolved, step)) / count
    if distance < special.fdtri(count, max(objects - 1.0, 1.0), _CONFIDENCE):
        return RefinementVerdict.KEPT, (
            f"the stated calibration is within the {_CONFIDENCE:.0%} region of the best one, scatter and distance of "
            "the beams included: as good as the drive can determine"
        )
    return RefinementVerdict.REFINED, (
        f"all {len(gains)} held-out parts of the drive fit better than the stated calibration, which is outside the "
        f"{_CONFIDENCE:.0%} region"
    )


def _held_out_gains(
    levels: "Sequence[Level]", held_out: BoolArray, free: Int64Array, begun: Float64Array, objects: AnyArray
) -> Float64Array:
    """How much likelier frames are under the calibration that others found, and than anywhere, by object: (2, G)."""
    found = search(levels, ~held_out, free, thinned=2, begun=begun)
    level = levels[-1].part(held_out)
    clusters, sums = objects[level.chosen], []
    for at in (np.zeros(COUNT), found.numbers):
        around, count = Around(level, free, at), int(objects.max()) + 1
        sums.append(_summed(around, _weighed(around, found.weights), clusters, count)[0])
    return np.stack([sums[1] - sums[0], np.maximum(sums[1], 0.0)])


def _sharpness_of(found: "Around") -> float:
    """How far the solution stands above others a degree or two around it, in their standard deviations."""
    rotations = np.flatnonzero(found.free < 3)
    drawn = np.random.default_rng(3).normal(size=(_AROUND, len(rotations)))
    sizes = np.random.default_rng(4).uniform(*_NEARBY, _AROUND)
    steps = np.zeros((_AROUND, len(found.free)))
    for step, direction, size in zip(steps, drawn, sizes, strict=True):
        step[rotations] = direction / np.linalg.norm(direction) * size
    values = [found.likelihood(step, found.weights) for step in steps]
    here = found.likelihood(np.zeros(len(found.free)), found.weights)
    return (here - float(np.mean(values))) / max(float(np.std(values)), 1e-12)


def _covariance_of(found: "Around") -> tuple[Float64Array, float]:
    """The covariance of the free numbers by the drive alone, (P, P), in units, and how many objects it rests on."""
    level, free = found.level, found.free
    weights = _weighed(found, found.weights)
    kinds = (level.groups % len(CHANNELS) * _MAPS + level.rows % _MAPS).astype(np.int32)
    spread, pulls = np.diag(FARTHEST[free] ** -2.0), np.zeros((0, len(free)))
    for clusters in (kinds, _objects_of(level)):
        _, pulls = _summed(found, weights, clusters, int(clusters.max(initial=0)) + 1)
        pulls = pulls[np.abs(pulls).sum(axis=1) > 0]
        spread += pulls.T @ pulls * (len(pulls) / max(len(pulls) - 1, 1))
    # as many objects, pulling equally, would pull as unevenly (Kish's effective size)
    shares = np.einsum("gp,pq,gq->g", pulls, np.linalg.inv(spread), pulls)
    counted = float(shares.sum() ** 2 / max(float(np.square(shares).sum()), 1e-12))
    inverse = found.basis @ found.inverse_curvature() @ found.basis.T
    return np.asarray(inverse @ spread @ inverse, np.float64), counted


def _weighed(around: "Around", weights: Float64Array) -> Float32Array:
    """What each point counts, (N,), by weights of the channels."""
    level = around.level
    return np.asarray(level.weights * weights[level.groups % len(CHANNELS)], np.float32)


def _summed(
    around: "Around", weights: Float32Array, clusters: AnyArray, count: int
) -> tuple[Float64Array, Float64Array]:
    """By cluster, of (N,) points: weighted sums of the maps' values, (G,), and of slopes, (G, P)."""
    sums, slopes = np.zeros(count), np.zeros((count, len(around.free)))
    sum_maps(
        around.pixels, around.slopes, np.zeros(len(around.free)), weights, around.level.rows, clusters,
        around.level.maps, sums, np.zeros(count), slopes,
    )  # fmt: skip
    return sums, slopes


def _objects_of(level: "Level") -> AnyArray:
    """Number the objects that points are of, (N,) int32; where motion is not known nothing moves."""
    cells = np.empty(len(level.chosen), np.int64)
    begins = np.cumsum([0, *(len(one.weights) for one in level.cues)])
    of = np.searchsorted(level.chosen, begins)
    for k, one in enumerate(level.cues):
        own = slice(of[k], of[k + 1])
        points, pose = one.points_lidar[level.chosen[own] - begins[k]], one.frame.world_from_lidar
        east, north = np.floor((points if pose is None else pose.apply(points))[:, :2].T / _OBJECT).astype(np.int64)
        cells[own] = (east << 32) + north
    return np.unique(cells, return_inverse=True)[1].astype(np.int32)


def _resolution(cues: "Sequence[_Cues]", free: Int64Array) -> Float64Array:
    """The distance of beams, or of pixels where it is larger, as rotations and translations, (P,) in units."""
    scan, pixel = cues[0].frame.scan, 1.0 / cues[0].camera.fx
    beside, above = (pixel, pixel) if scan is None else (max(scan.step, pixel), max(scan.spacing, pixel))
    numbers = np.zeros(COUNT)
    numbers[:6] = above, beside, beside, beside * _NEAR, above * _NEAR, above * _NEAR
    return np.asarray((numbers / UNITS)[free])


@dataclass(frozen=True, slots=True, eq=False)
class _Cues:
    """The points of one frame, all channels one after the other."""

    frame: CalibrationFrame
    camera: Camera  # of the measured image
    plainness: float  # share of the image that shows nothing
    points_lidar: Float64Array  # (N, 3) [m]
    weights: Float32Array  # (N,); of a channel they have the mean square 1
    maps: AnyArray  # (N,) int32, which of the image's maps counts for each
    channels: AnyArray  # (N,) int32, by `CHANNELS`


def find_cues(frame: CalibrationFrame, camera: Camera, plainness: float = 0.0) -> _Cues:
    """Find the points of a frame that are compared with its image, which was measured."""
    features = extract(frame, camera)
    bright, kinds, steps = _intensity_edges(features, camera)
    locations, contrasts = _contrasts(features)
    strongest = np.sort(np.argsort(-np.abs(contrasts), kind="stable")[:_MOST_CONTRASTS])
    contrasts = contrasts[strongest]
    parts: list[tuple[Float64Array, AnyArray, AnyArray, int]] = [
        (features.edge_points, np.sqrt(features.edge_weights), features.edge_kinds, _MOST_EDGES),
        (bright, steps, kinds, _MOST_EDGES),
        (locations[strongest], contrasts, np.full(len(contrasts), _LEVEL_MAP), _MOST_CONTRASTS),
    ]
    drawn = []
    for points, weights, maps, most in parts:
        rows = np.linspace(0, len(points) - 1, min(most, len(points))).astype(np.int64)
        chosen = np.asarray(weights[rows], np.float32)
        scale = float(np.sqrt(np.mean(np.square(chosen)))) if len(rows) else 1.0
        drawn.append((points[rows], chosen / np.float32(max(scale, 1e-6)), np.asarray(maps[rows], np.int32)))
    points, weights, maps = (np.concatenate(column) for column in zip(*drawn, strict=True))
    channels = np.repeat(np.arange(len(CHANNELS), dtype=np.int32), [len(part) for part, _, _ in drawn])
    return _Cues(frame, camera, plainness, points, weights, maps, channels)


def _seen_anew(cues: _Cues, numbers: Float64Array) -> _Cues:
    """Find the points of a frame that the camera sees under a candidate; numbers remain changes of the stated one."""
    changed = RigidTransform.nearest(Change.of(numbers).camera_from_lidar(cues.frame.camera_from_lidar.matrix))[0]
    found = find_cues(replace(cues.frame, camera_from_lidar=changed), cues.camera)
    return replace(found, frame=cues.frame)


def _contrasts(features: FrameFeatures) -> tuple[Float64Array, Float32Array]:
    """Points, and how much brighter each is than its neighbours on the same surface: (N, 3), (N,)."""
    # a point at the end of a surface is not compared along that direction: its brightness in the image is blurred with
    # that of what lies behind, which pulled drives of exact truth to one side
    frame, levels = features.frame, features.levels
    if frame.scan is None or frame.intensities is None or len(frame.scan.order) < 2:
        if len(levels):
            usual = ndimage.uniform_filter1d(levels, min(_SURROUNDINGS, len(levels)), mode="nearest")
            levels = np.asarray(levels - usual, np.float32)
        return features.level_points, levels
    points, along, across = _neighbours(frame.scan, features.visible)
    levels = frame.intensities[points].astype(np.float32)
    contrasts = np.zeros(len(levels), np.float32)
    for first, second in (along, across):
        steps, ahead, behind = levels[first] - levels[second], np.zeros_like(levels), np.zeros_like(levels)
        between = np.intersect1d(first, second)
        ahead[first], behind[second] = steps, steps
        contrasts[between] += ahead[between] - behind[between]
    return frame.points_lidar[points], contrasts


def _intensity_edges(features: FrameFeatures, camera: Camera) -> tuple[Float64Array, Int64Array, Float32Array]:
    """Where the intensity of one surface changes along a scan line: locations, kinds of edge, strengths."""
    frame, none = features.frame, (np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.float32))
    if frame.scan is None or frame.intensities is None or len(features.around) < 2:
        return none
    points, along, _ = _neighbours(frame.scan, features.around)
    first, second = (points[rows] for rows in along)
    if len(first) == 0:
        return none
    levels = frame.intensities.astype(np.float64)
    steps = np.minimum(np.abs(levels[second] - levels[first]), _STRONGEST_STEP)
    strong = steps > max(float(np.quantile(steps, 1.0 - _BRIGHT_SHARE)), _LEAST_STEP)
    ends = frame.points_lidar[first[strong]], frame.points_lidar[second[strong]]
    # which direction of the image leads from one point to the other
    a, b = (project_unbounded(camera, frame.camera_from_lidar.apply(end)) for end in ends)
    directions = np.arctan2(b[:, 1] - a[:, 1], b[:, 0] - a[:, 0])
    known = np.isfinite(directions)
    kinds = np.rint(directions[known] * DIRECTIONS / np.pi).astype(np.int64) % DIRECTIONS
    return 0.5 * (ends[0] + ends[1])[known], kinds, np.sqrt(steps[strong][known]).astype(np.float32)


_Pairs = tuple[Int64Array, Int64Array]


def _neighbours(scan: ScanOrder, wanted: Int64Array) -> tuple[Int64Array, _Pairs, _Pairs]:
    """The wanted points on lines (M,), and pairs of rows of these: successive on a line, and one above the other."""
    part = scan.part(wanted)
    first, step = part.along(_GAP_STEPS)
    upper = part.above(step)
    lower = np.flatnonzero(upper >= 0)
    return part.order, _smooth(first, first + 1, part.ranges), _smooth(lower, upper[lower], part.ranges)


def _smooth(first: Int64Array, second: Int64Array, ranges: Float64Array) -> _Pairs:
    """The pairs that are of one surface."""
    apart = np.abs(ranges[first] - ranges[second])
    kept = apart < np.maximum(_LEAST_SMOOTH, _SMOOTH_SHARE * ranges[second])
    return first[kept], second[kept]


def moving_pixels(
    cues: _Cues, chosen: AnyArray, numbers: Float64Array, free: AnyArray
) -> tuple[Float64Array, Float64Array]:
    """Give pixels (M, 2) [px of the measured image] of some points of a frame, and their derivatives (M, 2, P).

    Args:
        chosen: (M,) int64, which points.
        numbers: (8,) of the candidate.
        free: (P,) int64, the numbers by which derivatives are taken, each by its unit.
    """
    points, twist = cues.points_lidar[chosen], cues.frame.twist_lidar
    matrix = Change.of(numbers).camera_from_points(cues.frame)
    camera = _focused(cues.camera, float(numbers[Parameter.FOCAL]))
    seen = points @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = project_unbounded(camera, seen)
    steps = _STEP_SHARE * np.sqrt(np.einsum("ij,ij->i", seen, seen))
    ahead = np.tile(seen, (3, 1, 1))
    ahead[range(3), :, range(3)] += steps
    beside = project_unbounded(camera, ahead.reshape(-1, 3)).reshape(3, -1, 2) - pixels
    # (3, 2, N) [px/m]: NumPy is several times as fast along many points as along two directions
    by_x, by_y, by_z = by_location = np.ascontiguousarray(beside.transpose(0, 2, 1)) / steps
    x, y, z = np.ascontiguousarray(seen.T)
    # the order of the parameters: rotations, then translations
    moved = np.stack([y * by_z - z * by_y, z * by_x - x * by_z, x * by_y - y * by_x, *by_location])
    slopes = np.zeros((len(free), 2, len(points)))
    for row, k in enumerate(free.tolist()):
        if k == Parameter.FOCAL:
            slopes[row] = (project_unbounded(_focused(camera, _FOCAL_STEP), seen) - pixels).T / _FOCAL_STEP
        elif k != Parameter.LATER:
            slopes[row] = moved[k]
        elif twist is not None:
            rotation, velocity = matrix[:3, :3] @ twist[:3], matrix[:3, :3] @ twist[3:]
            screw = np.concatenate([rotation, velocity - np.cross(rotation, matrix[:3, 3])])
            slopes[row] = -np.einsum("k,kcn->cn", screw, moved)
        slopes[row] *= UNITS[k]
    return pixels, slopes.transpose(2, 1, 0)


def _focused(camera: Camera, logarithm: float) -> Camera:
    """The camera with focal lengths multiplied by a factor, of which the logarithm is given."""
    scale = float(np.exp(logarithm))
    return camera if scale == 1.0 else replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)


def _reduced(image: Float32Array, stride: int) -> Float32Array:
    """Average blocks of pixels; the remainder at the right and the bottom is cut."""
    height, width = (max(size // stride, 1) * min(stride, size) for size in image.shape)
    if stride == 1:
        return image
    blocks = [
        image[row:height:stride, column:width:stride]
        for row in range(min(stride, height))
        for column in range(min(stride, width))
    ]
    return np.asarray(sum(blocks[1:], start=blocks[0]) / np.float32(len(blocks)), np.float32)


def _band(image: Float32Array, width: float, output: Float32Array) -> None:
    """Blur, and subtract what a blur of several times the width leaves: two boxes are nearly a Gaussian."""
    box = 2 * round(_WIDER * width * np.sqrt(6.0) / 2.0) + 1
    ndimage.gaussian_filter(image, width, truncate=3.0, output=output)
    around = ndimage.uniform_filter(image, box, mode="nearest")
    output -= ndimage.uniform_filter(around, box, mode="nearest", output=around)


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """All frames at one width."""

    cues: Sequence[_Cues]
    width: float  # of the blur [px]
    maps: Float32Array  # (F K, H, W): edges by direction, then brightness, of each frame
    rows: AnyArray  # (N,) int32, the map of each point
    groups: AnyArray  # (N,) int32, frame and channel of each point
    weights: Float32Array  # (N,)
    chosen: AnyArray  # (N,) int64, number of each point among those of all frames

    @classmethod
    def of(cls, cues: Sequence[_Cues], width: float, maps: Float32Array) -> "Level":
        """Number the points of all frames."""
        weights = np.concatenate([one.weights for one in cues])
        return cls(
            cues,
            width,
            maps,
            np.concatenate([one.maps + _MAPS * k for k, one in enumerate(cues)]).astype(np.int32),
            np.concatenate([one.channels + len(CHANNELS) * k for k, one in enumerate(cues)]).astype(np.int32),
            weights,
            np.arange(len(weights)),
        )

    def part(self, frames: AnyArray, *, most: int | None = None) -> "Level":
        """Keep the points of some frames, (F,) bool, evenly drawn about so many of them; the maps are shared."""
        kept = np.flatnonzero(frames[self.groups // len(CHANNELS)])
        if most is not None:
            kept = kept[:: max(-(-len(kept) // most), 1)]
        return replace(
            self, rows=self.rows[kept], groups=self.groups[kept], weights=self.weights[kept], chosen=self.chosen[kept]
        )


def find_levels(
    frames: Sequence[CalibrationFrame], least: int = 1, after: Callable[[None], None] = lambda _: None
) -> list[Level]:
    """Blur the images of frames, which must be of one size, to all widths, and find the points that go with them.

    Args:
        least: frames with fewer points are left out; where none is left, there are no levels.
        after: called after each frame.
    """
    cues: list[_Cues] = []
    maps: list[Float32Array] = []
    for frame in frames:
        # what was measured of an image is let go before the next one: the maps are as large
        image = measured_image(frame.grey, frame.camera, (EDGES,))
        one = find_cues(frame, image.camera, image.plainness)
        if len(one.weights) >= least:
            sources = *image.maps[EDGES], evened(image.grey)
            widths = [(width, _STRIDES[width]) for width in WIDTHS_PX]
            if not maps:
                shapes = [_reduced(image.grey, stride).shape for _, stride in widths]
                maps = [np.empty((len(frames) * _MAPS, *shape), np.float32) for shape in shapes]
            for (width, stride), of_width in zip(widths, maps, strict=True):
                for number, source in enumerate(sources):
                    share = _BRIGHTNESS_SHARE if number == _LEVEL_MAP else 1.0
                    _band(_reduced(source, stride), share * width / stride, of_width[len(cues) * _MAPS + number])
            cues.append(one)
        after(None)
    return [Level.of(cues, width, of[: len(cues) * _MAPS]) for width, of in zip(WIDTHS_PX, maps, strict=False)]


class Around:
    """A level around a candidate: pixels move linearly with the numbers that are free."""

    # `free` (P,) which of the eight `numbers`; steps are (P,), in units, those of a climb in widths of the blur:
    # `basis` takes them into units; `pixels` (N, 2) [px of the maps]; `slopes` (N, 2, P) by unit

    def __init__(self, level: Level, free: AnyArray, numbers: Float64Array) -> None:
        self.level, self.free, self.numbers = level, free, numbers
        chosen, stride = level.chosen, _STRIDES[level.width]
        begins = np.cumsum([0, *(len(one.weights) for one in level.cues)])
        of = np.searchsorted(chosen, begins)
        self.pixels = np.empty((len(chosen), 2), np.float32)
        self.slopes = np.empty((len(chosen), 2, len(free)), np.float32)
        for k, one in enumerate(level.cues):
            own = slice(of[k], of[k + 1])
            if of[k] < of[k + 1]:
                pixels, slopes = moving_pixels(one, chosen[own] - begins[k], numbers, free)
                self.pixels[own] = (pixels + 0.5) / stride - 0.5
                self.slopes[own] = slopes / stride

    def _sums(self, step: Float64Array, *, sloping: bool = False) -> tuple[Float64Array, Float64Array, Float64Array]:
        """By channel at a step: weighted sums of the maps' values (C,), of squares (C,), slopes (F, C, P) if asked."""
        level, shape = self.level, (len(self.level.cues), len(CHANNELS))
        count = shape[0] * shape[1]
        values, squares, gradients = np.zeros(count), np.zeros(count), np.zeros((count, len(self.free) * sloping))
        sum_maps(
            self.pixels, self.slopes, np.ascontiguousarray(step, np.float64), level.weights,
            level.rows, level.groups, level.maps, values, squares, gradients,
        )  # fmt: skip
        return values.reshape(shape).sum(axis=0), squares.reshape(shape).sum(axis=0), gradients.reshape(*shape, -1)

    def likelihood(self, step: Float64Array, weights: Float64Array) -> float:
        """How much likelier the points are than anywhere, by weights (C,) of the channels."""
        return float((self._sums(step)[0] * weights).sum())

    def height(self, step: Float64Array) -> float:
        """How far the channels together stand above 0, in standard deviations; weights play no part, so it compares."""
        values, squares, _ = self._sums(step)
        return float((values / np.sqrt(np.maximum(squares, 1e-9))).sum())

    @cached_property
    def _inside(self) -> AnyArray:
        """Rows of the points in the images."""
        size = np.array(self.level.maps.shape[:0:-1])
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(((self.pixels >= 0.0) & (self.pixels < size - 1)).all(axis=1))

    @cached_property
    def weights(self) -> Float64Array:
        """What each channel counts, (C,): m/v of its values, times the share of points that add information."""
        # a channel whose points do not fit better than others would gets 0; points in one cell of a few widths add
        # nothing to one another
        level, channels = self.level, len(CHANNELS)
        cell = _CELL_WIDTHS * level.width / _STRIDES[level.width]
        groups = level.groups[self._inside]
        cells = (self.pixels[self._inside] / np.float32(cell)).astype(np.int32)
        across, down = (int(size / cell) + 1 for size in level.maps.shape[:0:-1])
        taken = np.zeros((len(level.cues), channels, across * down), np.bool_)
        taken.reshape(-1)[(groups * np.int64(down) + cells[:, 1]) * across + cells[:, 0]] = True
        distinct = taken.sum(axis=(0, 2)).astype(np.float64)
        counts = np.maximum(np.bincount(groups % channels, minlength=channels).astype(np.float64), 1.0)
        values, squares, _ = self._sums(np.zeros(len(self.free)))
        means = values / counts
        variances = np.maximum(squares / counts - means**2, 1e-12)
        return np.asarray(np.maximum(means, 0.0) / variances * distinct / counts, np.float64)

    @cached_property
    def form(self) -> Float64Array:
        """The mean square of how far a step moves pixels, in widths, and numbers, in what is usual: (P, P)."""
        form = np.diag(FARTHEST[self.free] ** -2.0)
        if len(self._inside):
            scale = np.float64(_STRIDES[self.level.width] / self.level.width)
            moved = scale * self.slopes[self._inside].reshape(2 * len(self._inside), -1)
            form += np.einsum("ip,iq->pq", moved, moved) / len(self._inside)
        return form

    @cached_property
    def basis(self) -> Float64Array:
        """Steps (P, P) in units that move pixels by the blur's width (root mean square), or as far as usual."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.form)).T)

    def downwards(self, step: Float64Array) -> tuple[float, Float64Array]:
        """Minus the objective, which speaks against going far, and its slope at a step in widths, (P,)."""
        in_units, reach = self.basis @ step, FARTHEST[self.free]
        values, _, gradients = self._sums(in_units, sloping=True)
        away = ((self.numbers / UNITS)[self.free] + in_units) / reach
        value = float((values * self.weights).sum() - 0.5 * away @ away)
        slope = away / reach - np.einsum("fcp,c->p", gradients, self.weights)
        return -value, self.basis.T @ slope

    def inverse_curvature(self) -> Float64Array:
        """The inverse of minus the second derivatives, (P, P); where the objective rises it counts as flat."""
        # flat directions are bounded by how far the numbers usually go
        rows = []
        for axis in np.eye(len(self.free)) * _CURVATURE_STEP:
            (_, ahead), (_, behind) = self.downwards(axis), self.downwards(-axis)
            rows.append((ahead - behind) / (2.0 * _CURVATURE_STEP))
        curvature = np.array(rows)
        values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
        bounds = np.square(self.basis @ vectors / FARTHEST[self.free][:, None]).sum(axis=0)
        return np.asarray(vectors / np.maximum(values, bounds) @ vectors.T)

    def stepped(self, step: Float64Array) -> Float64Array:
        """The numbers, (8,), at a step in widths."""
        return self.numbers + _spread(self.free, self.basis @ step)


def _spread(free: AnyArray, step: Float64Array) -> Float64Array:
    """A step in units as a change of all eight numbers."""
    numbers = np.zeros(COUNT)
    numbers[free] = step * UNITS[free]
    return numbers


def search(
    levels: Sequence[Level], frames: AnyArray, free: AnyArray, *, thinned: int = 1, begun: Float64Array | None = None
) -> Around:
    """Find the best candidate near the stated one at levels from wide to narrow; one point of `thinned` counts.

    Args:
        frames: (F,) bool, which count.
        free: (P,) int64, which of the eight numbers are searched.
        begun: where to begin instead, (8,).
    """
    wide, narrow = (
        level.part(frames, most=most // thinned) for level, most in zip(levels[1:], _MOST_MOVED, strict=True)
    )
    if begun is not None:
        return polished(narrow, free, climbed(narrow, free, climbed(wide, free, begun)))
    few, nothing = narrow.part(frames, most=_MOST_MOVED[0] // thinned), np.zeros(len(free))
    rotation = _best_rotation(levels, frames, thinned)
    beginnings = _along_ridges(wide.part(frames, most=_MOST_STARTED), free, rotation)
    tops = [climbed(few, free, climbed(wide, free, numbers)) for numbers in beginnings]
    best = max(tops, key=lambda numbers: Around(few, free, numbers).height(nothing))
    return polished(narrow, free, climbed(narrow, free, best))


def _along_ridges(level: Level, free: AnyArray, numbers: Float64Array) -> list[Float64Array]:
    """The numbers, (8,), and the best of many that differ from them by more than a climb goes."""
    hill, others = Around(level, free, numbers), free >= len(_ROTATIONS)
    # rotations make up for translations, times and focal lengths as well as they can, or nearly so
    steps = np.random.default_rng(_SEED).normal(size=(_RIDGE_STARTS, len(free))) * FARTHEST[free]
    made_up = np.linalg.solve(hill.form[np.ix_(~others, ~others)], hill.form[np.ix_(~others, others)])
    steps[:, ~others] = steps[:, ~others] * _RIDGE_WIDTH - steps[:, others] @ made_up.T
    best = np.argsort([-hill.height(step) for step in steps])[:_RIDGES_KEPT]
    return [numbers, *(numbers + _spread(free, steps[k]) for k in best)]


def _best_rotation(levels: Sequence[Level], frames: AnyArray, thinned: int) -> Float64Array:
    """The numbers, (8,), of the best rotation, from many beginnings: rotations move far points as well as near ones."""
    parts = [level.part(frames, most=most // thinned) for level, most in zip(levels, _MOST_ROTATED, strict=True)]
    generator = np.random.default_rng(_SEED)
    (near, far), (spread, radius) = _STARTS, _STARTS_SPREAD / UNITS[0]
    directions = generator.normal(size=(far, 3))
    directions *= (radius * np.cbrt(generator.random(far)) / np.linalg.norm(directions, axis=1))[:, None]
    drawn = np.concatenate([spread * generator.normal(size=(near, 3)), directions])
    stated = Around(parts[0].part(frames, most=_MOST_STARTED // thinned), _ROTATIONS, np.zeros(COUNT))
    best = np.argsort([-stated.height(step) for step in drawn])[: _KEPT[0] - 1]
    found = [np.zeros(COUNT), *(_spread(_ROTATIONS, drawn[k]) for k in best)]
    for level, kept in zip(parts, _KEPT, strict=True):
        tops = [climbed(level, _ROTATIONS, begun) for begun in found]
        heights = [Around(level, _ROTATIONS, numbers).height(np.zeros(len(_ROTATIONS))) for numbers in tops]
        found = [tops[k] for k in np.argsort(heights)[::-1]][:kept]
    return found[0]


def climbed(level: Level, free: AnyArray, numbers: Float64Array) -> Float64Array:
    """Go uphill at one level, with pixels linearised anew in each round."""
    for _ in range(_ROUNDS):
        hill = Around(level, free, numbers)
        step = _descended(hill)
        numbers = hill.stepped(step)
        if np.abs(step).max() < 0.05:
            break
    return numbers


def _descended(hill: Around) -> Float64Array:
    """Where a quasi-Newton descent of minus the objective ends; a library's would wake threads for eight numbers."""
    # Source: the BFGS update with halved steps (Nocedal and Wright 2006, algorithm 6.1)
    here = np.zeros(len(hill.free))
    value, slope = hill.downwards(here)
    inverse = np.eye(len(here)) * (_FIRST_STEP / max(float(np.sqrt((slope**2).sum())), 1e-12))
    for _ in range(_MOST_STEPS):
        direction = -(inverse * slope).sum(axis=1)
        direction *= min(1.0, _LONGEST_STEP / max(float(np.sqrt((direction**2).sum())), 1e-12))
        for share in (1.0, 0.5, 0.25, 0.125):
            ahead = here + share * direction
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


def polished(level: Level, free: AnyArray, numbers: Float64Array) -> Around:
    """Newton's steps to the top, which long narrow ridges need; none that leads down."""
    for _ in range(_LAST_STEPS):
        hill = Around(level, free, numbers)
        value, slope = hill.downwards(np.zeros(len(free)))
        step = np.clip(-hill.inverse_curvature() @ slope, -1.0, 1.0)
        share = next((part for part in (1.0, 0.5, 0.25) if hill.downwards(part * step)[0] < value), 0.0)
        numbers = hill.stepped(share * step)
        if np.abs(share * step).max() < _SMALLEST_STEP:
            break
    return Around(level, free, numbers)


@kernel(void(
    IN_F32_2D, IN_F32_3D, IN_F64_1D, IN_F32_1D, IN_I32_1D, IN_I32_1D, IN_F32_3D, float64[::1], float64[::1],
    float64[:, ::1]
))  # fmt: skip
def sum_maps(
    pixels: Float32Array, slopes: Float32Array, step: Float64Array, weights: Float32Array, rows: AnyArray,
    groups: AnyArray, maps: Float32Array, sums: Float64Array, squares: Float64Array, gradients: Float64Array,
) -> None:  # fmt: skip
    """Add up weighted values of maps at moved pixels, by group; beyond a map's outer pixels it says nothing.

    Args:
        pixels: (N, 2) [px of the maps].
        slopes: (N, 2, P), derivatives of the pixels by the parameters.
        step: (P,), change of the parameters.
        weights, rows, groups: (N,), and int32: the map that counts for each point, and the sum.
        maps: (K, H, W).
        sums, squares: (G,), of weight times value, and of squared values.
        gradients: (G, P), derivatives of `sums`, or (G, 0) where these are not wanted.
    """
    height, width = maps.shape[1], maps.shape[2]
    count = step.shape[0]
    for i in range(pixels.shape[0]):
        u, v = float64(pixels[i, 0]), float64(pixels[i, 1])
        for k in range(count):
            u += slopes[i, 0, k] * step[k]
            v += slopes[i, 1, k] * step[k]
        if not (0.0 <= u < width - 1 and 0.0 <= v < height - 1):
            continue
        column, row = int(u), int(v)
        a, b = u - column, v - row
        one = maps[rows[i]]
        upper, lower = one[row, column], one[row + 1, column]
        across_upper, across_lower = one[row, column + 1] - upper, one[row + 1, column + 1] - lower
        at_upper, at_lower = upper + a * across_upper, lower + a * across_lower
        value = at_upper + b * (at_lower - at_upper)
        by_u = across_upper + b * (across_lower - across_upper)
        by_v = at_lower - at_upper
        weight, group = float64(weights[i]), groups[i]
        sums[group] += weight * value
        squares[group] += value * value
        for k in range(gradients.shape[1]):
            gradients[group, k] += weight * (by_u * slopes[i, 0, k] + by_v * slopes[i, 1, k])
