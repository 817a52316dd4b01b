"""Check of a camera-lidar calibration: by images and points, by detected boxes, and by motion.

The limits of the verdicts are lengths and angles that matter, and the errors that the measures have by themselves on
simulated drives of other seeds than those of the tests: see docs/calibration.md.

Search: quadratics are fitted to scores at random locations of a ball, and the next, smaller ball lies around the top.
Source: response surfaces, Box and Wilson 1951, "On the Experimental Attainment of Optimum Conditions"; bootstrap over
blocks: Künsch 1989, "The Jackknife and the Bootstrap for General Stationary Observations".

Principal point: at the angle θ off the axis, a pinhole has u = f·tan θ + c. A rotation by a small angle a moves u by
f·a·(1 + tan² θ), and a principal point off by d moves it by d: to first order they are the same, d = f·a, at any
distance. What distinguishes them is of second order, d·tan² θ, and tangential distortion is of the same form: of a
camera model whose coefficients are not exact, nearly nothing is left.

Motion: from image to image the camera rotates by the vector c, and the lidar by l. With the true rotation X of
camera_from_lidar, C = X L X⁻¹, so c = X l. If X is the stated R after a small rotation w, c - R l = w × R l, which
determines w across the vehicle's axis of rotation, and not along it. A straight drive gives no information.
Source: Shiu and Ahmad 1989, "Calibration of Wrist-Mounted Robotic Sensors by Solving Homogeneous Transform Equations of
the Form AX = XB"; rotation vectors: Park and Martin 1994; sandwich by clusters: Liang and Zeger 1986.

Boxes: those of images and sweeps agree about one rotation. It is as exact as that of edges where there are many boxes,
and found from farther off. To boxes a translation of the camera looks like a rotation, by its length over their
distance.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.calibrate.frames import MOST, CalibrationFrame, calibration_frames
from sceneloom.calibrate.measures import (
    COUNT,
    EDGES,
    INFORMATION,
    MEASURES,
    ROTATION,
    TRANSLATION,
    UNITS,
    Agreement,
    Change,
    FrameFeatures,
    Parameter,
    Score,
)
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.detections.residuals import BoxRotation
from sceneloom.geometry.rigid import (
    cross_matrix,
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier
from sceneloom.warnings import DataWarning

PARTS = ("rotation", "translation", "focal_length", "principal_point", "time_offset")
"""What images and points are asked about, in the order of the items."""

MOTION, _BOXES, _BOXES_ROLL = "motion", "boxes", "boxes_roll"
"""Further items: of rotation from image to image; of boxes, about the camera's x and y axes, and about its z axis."""

_GROUPS: dict[str, tuple[Parameter, ...]] = {
    "translation": (*ROTATION, *TRANSLATION),
    "focal_length": (*ROTATION, Parameter.FOCAL),
    "time_offset": (*ROTATION, Parameter.LATER),
}  # parameters that are searched together with the rotation, by the part that the verdict is about

_FINE, _WIDE = (EDGES, INFORMATION), MEASURES
_FAR_LOOKS, _FAR_DEG = 48, (2.5, 6.0)  # rotations so far away that images and clouds agree by nothing but chance

_REPLICATES, _SEED, _NO_DEVIATION = 100, 0, 1e-6
_WIDE_RADII, _FINE_RADII = (20.0, 11.0, 6.0, 3.5), (2.4, 1.6)
"""Balls of rotations that are searched, one after another [units of a quarter degree]."""

_NEAR_RADII, _FAR_RADII = (4.0, 2.0), (10.0, 5.0, 2.0)
_MANY, _MANY_RADIUS, _PROMISING = 150, 7.0, 3
"""So many rotations up to so far are scored, and so many followed up: peaks are narrower than wide balls show."""

_FINE_FROM, _ROUGH_FROM = 4.0, 3.0
"""In wider balls the coarse measures count, too; in wider balls some of the features show where to look next."""

_PROBES, _LOOKS_PER_COEFFICIENT, _FARTHEST_DEG = 3000, (4.0, 2.5), 6.0
_DISTINCT = 4.5
"""Deviations above chance from which on images and sweeps agree; the best of some hundred chances reaches 3.3."""

_OWN_VIEW_M, _OWN_VIEW_DEG = 4.0, 15.0
_LEAST_SEEN, _LEAST_EDGES = 200, 60
_PLAIN = 0.9  # images of which more shows nothing are dark, covered or fogged

_BETTER, _BETTER_SIGMAS = 1.0, 3.0
"""A part counts as off only if changing it, too, makes images and sweeps agree better by this."""

_ALIKE = 0.8
"""A good calibration reaches this part of the height of the best one. On simulated drives true ones reach 0.9 and
more, those half a degree or 15 cm off below 0.5."""

_LEAST_SPEED, _LEAST_ROTATION = 1.0, 0.03  # slower than this [m/s, rad/s] nothing shows when an image was taken

_SIGNIFICANT = 16.0  # squared distance from nothing, in standard deviations, of what is more than chance

_COLUMNS, _ROWS, _STEP = 41, 25, 1e-4
"""Pixels of the grid, and the rotation [rad], by which a rotated camera is compared with a moved principal point."""

_MOSTLY = 0.5
"""A rotation of which more than this share is about the optical axis does not come from the principal point."""

_LEAST_STEPS, _LEAST_ROTATION_DEG, _BLOCKS, _ROUNDS = 20, 8.0, 10, 15
_LEAST_AGREEING, _LEAST_IMAGES, _ABOVE_CHANCE = 40, 10, 2.0
"""So many couples must agree, in so many images, and so many times as many as about other rotations: boxes of other
images reach 35, and less than twice as many."""


class Verdict(StrEnum):
    """The state of a calibration, or of one part of it."""

    GOOD = "good"
    DRIFTING = "drifting"
    WRONG = "wrong"
    UNDETERMINED = "cannot determine"


_OFF = (Verdict.WRONG, Verdict.DRIFTING)


@dataclass(frozen=True, slots=True)
class _Limits:
    """Limits of one part."""

    unit: str
    scale: float  # leads to the unit from radians, metres, logarithms and seconds
    good: float  # up to here
    wrong: float  # beyond this
    floor: float  # the error that the measures have by themselves, on each axis
    vague: float  # with a larger standard deviation on any axis nothing is stated
    what: str = "images and sweeps agree"


_TOGETHER = "boxes of images and sweeps agree"
_LIMITS = {
    "rotation": _Limits("deg", 180.0 / np.pi, 0.4, 1.0, 0.12, 0.35),
    "translation": _Limits("m", 1.0, 0.1, 0.3, 0.04, 0.06),
    "focal_length": _Limits("%", 100.0, 1.0, 3.0, 0.4, 0.8),
    "time_offset": _Limits("ms", 1e3, 15.0, 60.0, 4.0, 9.0),
    _BOXES: _Limits("deg", 180.0 / np.pi, 0.4, 1.0, 0.12, 0.35, _TOGETHER),
    _BOXES_ROLL: _Limits("deg", 180.0 / np.pi, 1.0, 2.0, 0.4, 0.6, _TOGETHER),
    MOTION: _Limits("deg", 180.0 / np.pi, 1.5, 3.0, 0.5, 0.8, "camera and lidar rotate alike"),
}


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """One part of a calibration.

    Attributes:
        name: one of `PARTS`, "boxes", "boxes_roll" or "motion".
        verdict: its state.
        reason: why, where it is not good.
        unit: of the numbers.
        values: by how much it would have to be changed; empty where nothing was found.
        sigmas: their standard deviations, the errors that the measures have by themselves included.
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
        limits = _LIMITS.get(self.name)
        if limits is None or self.verdict is not Verdict.UNDETERMINED or not self.values:
            return False
        return max(abs(v) - 2.0 * s for v, s in zip(self.values, self.sigmas, strict=True)) > limits.good

    @classmethod
    def unknown(cls, name: str, reason: str) -> "Item":
        """Report why nothing can be stated."""
        return cls(name=name, verdict=Verdict.UNDETERMINED, reason=reason)


class CalibrationHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The check of one camera-lidar calibration.

    Attributes:
        source: the drive.
        camera_id, lidar_id: whose calibration.
        verdict: of the whole: that of the worst part. It cannot be determined where the rotation cannot, where another
            part seems to be off but that may be chance, or where the stated calibration agrees clearly less than the
            best one.
        items: by part; with boxes of detectors and motion more, of the rotation that these show.
        frames, views: images that were looked at, and how many different views they show.
        distinctness, stated_distinctness: how far the best calibration around, and the stated one, stand above chance,
            in chance's own deviations.
        measures: how far each measure stands above chance, under the stated calibration and under the best one.
        change: from the stated calibration to the best one, as `Change.numbers`; zeros where that is not determined.
        corrections: warnings about the drive's corrections, which were applied before.
    """

    source: str
    camera_id: Identifier
    lidar_id: Identifier
    verdict: Verdict
    items: tuple[Item, ...]
    frames: int
    views: int
    distinctness: float = 0.0
    stated_distinctness: float = 0.0
    measures: dict[str, tuple[float, float]] = {}
    change: tuple[float, ...] = (0.0,) * COUNT
    corrections: tuple[DataWarning, ...] = ()

    def item(self, name: str) -> Item:
        """The part of that name."""
        return next(item for item in self.items if item.name == name)

    @classmethod
    def of_boxes(
        cls, found: BoxRotation | None, *, source: str, camera_id: Identifier, lidar_id: Identifier, frames: int
    ) -> "CalibrationHealth":
        """Check a calibration by boxes alone, without images and points; `frames` are the images with boxes."""
        nothing = "there are neither images nor points, but boxes alone"
        untold = cls(
            source=source,
            camera_id=camera_id,
            lidar_id=lidar_id,
            verdict=Verdict.UNDETERMINED,
            items=tuple(Item.unknown(name, nothing) for name in PARTS),
            frames=frames,
            views=0,
        )
        return untold.with_boxes(found)

    def with_coarse(self, item: Item) -> "CalibrationHealth":
        """Add a coarse measure: it never makes a calibration good, but it may make it doubtful or wrong.

        Where all else calls the calibration good and it does not, the whole cannot be determined.
        """
        verdict = self.verdict
        if item.verdict in _OFF:
            if verdict is Verdict.GOOD:
                verdict = Verdict.UNDETERMINED
                item = msgspec.structs.replace(item, reason=f"{item.reason}, but the rest agrees with it")
            elif verdict is not Verdict.WRONG:
                verdict = item.verdict
        return msgspec.structs.replace(self, verdict=verdict, items=(*self.items, item))

    def with_boxes(self, found: BoxRotation | None) -> "CalibrationHealth":
        """Add the rotation that boxes show to the check by images and points.

        Boxes decide where images and points cannot. Where one side calls good what the other clearly does not, the
        whole cannot be determined.
        """
        across, roll = judge_boxes(found)
        verdicts = {self.verdict, across.verdict, roll.verdict}
        reason = _contradiction(self, across, roll)
        if reason:
            verdict, across = Verdict.UNDETERMINED, msgspec.structs.replace(across, reason=reason)
        elif verdicts & set(_OFF):
            verdict = next(off for off in _OFF if off in verdicts)
        elif self.verdict is Verdict.UNDETERMINED and (self.doubted or any(i.suspected for i in self.items)):
            verdict = Verdict.UNDETERMINED
        else:
            good = Verdict.GOOD in {self.verdict, across.verdict}
            verdict = Verdict.GOOD if good else Verdict.UNDETERMINED
        return msgspec.structs.replace(self, verdict=verdict, items=(*self.items, across, roll))

    @property
    def doubted(self) -> bool:
        """Whether images and points agree much better elsewhere, where they determine the rotation at all."""
        return bool(self.item("rotation").values) and self.stated_distinctness < _ALIKE * self.distinctness


def check_calibration(
    scene: Scene, camera_id: Identifier | None = None, lidar_id: Identifier | None = None, *, most: int = MOST
) -> CalibrationHealth:
    """Check the stated calibration of a camera and a lidar by what both show.

    Args:
        camera_id, lidar_id: None for the scene's first ones.
        most: images to look at, at most.

    Raises:
        OptionError: there is no such camera or lidar.
        PoseError: the pose of the camera relative to the lidar is not known.
        DataError: an image or a sweep cannot be read.
    """
    scene = scene.corrected()
    health = check_frames(calibration_frames(scene, camera_id, lidar_id, most), source=scene.source)
    return msgspec.structs.replace(health, corrections=scene.correction_warnings)


def check_frames(frames: Sequence[CalibrationFrame], *, source: str = "frames") -> CalibrationHealth:
    """Check a calibration by frames of one camera and one lidar."""
    views = views_of(frames)

    def health(items: tuple[Item, ...], verdict: Verdict = Verdict.UNDETERMINED, **found: Any) -> CalibrationHealth:
        return CalibrationHealth(
            source=source,
            camera_id=frames[0].camera_id,
            lidar_id=frames[0].lidar_id,
            verdict=verdict,
            items=items,
            frames=len(frames),
            views=int(views.max()) + 1,
            **found,
        )

    agreement = Agreement(frames, views)
    nothing = _why_nothing(agreement.features)
    if nothing:
        return health(tuple(Item.unknown(name, nothing) for name in PARTS))
    search = _Search(agreement)
    rotation = search.rotation()
    if rotation.distinctness < _DISTINCT:
        reason = (
            f"no calibration within 6 degrees makes images and sweeps agree better than by chance "
            f"({rotation.distinctness:.1f} deviations; expected {_DISTINCT:g}): it is far off, or they show too little"
        )
        return health(tuple(Item.unknown(name, reason) for name in PARTS), **search.standing(rotation))
    joint = {name: search.group(rotation.change, group) for name, group in _GROUPS.items()}
    best = max((top for top in joint.values() if top.is_better), key=lambda top: top.gain, default=rotation)
    items = (
        _rotation_item(search, frames[0].camera, best, alone=best is rotation),
        _joint_item("translation", joint),
        _joint_item("focal_length", joint),
        Item.unknown("principal_point", why_untold(frames[0].camera)),
        _time_item(frames, joint),
    )
    standing = search.standing(best)
    verdict = next((off for off in _OFF if any(item.verdict is off for item in items)), items[0].verdict)
    doubted = standing["stated_distinctness"] < _ALIKE * standing["distinctness"]
    if verdict is Verdict.GOOD and (doubted or any(item.suspected for item in items)):
        verdict = Verdict.UNDETERMINED
    return health(items, verdict, **standing, change=tuple(best.change.tolist()))


def _why_nothing(features: Sequence[FrameFeatures]) -> str:
    """Why frames cannot determine anything of a calibration; "" if they may."""
    seen = sum(f.seen for f in features)
    if seen < _LEAST_SEEN:
        return f"{seen} points fall into {len(features)} images; expected {_LEAST_SEEN} at least"
    if np.median([f.image.plainness for f in features]) > _PLAIN:
        return "the images show nothing: dark, covered or fogged"
    if sum(len(f.edge_weights) for f in features) < _LEAST_EDGES:
        return "the sweeps show hardly any edges where the camera looks"
    return ""


def views_of(frames: Sequence[CalibrationFrame]) -> Int64Array:
    """Number frames by what they show: those from nearly the same location count as one view, (F,)."""
    views = np.zeros(len(frames), np.int64)
    begun = frames[0].world_from_lidar
    for row, frame in enumerate(frames[1:], start=1):
        here = frame.world_from_lidar
        views[row] = views[row - 1]
        if here is None or begun is None:
            continue
        step = begun.inverse() @ here
        rotation = 2.0 * np.degrees(np.arccos(np.clip(step.quaternion_xyzw[3], -1.0, 1.0)))
        if np.linalg.norm(step.translation) > _OWN_VIEW_M or rotation > _OWN_VIEW_DEG:
            views[row], begun = views[row] + 1, here
    return views


def judge(name: str, values: Float64Array, covariance: Float64Array) -> Item:
    """Judge the change that a part would need.

    Args:
        name: of an item but the principal point.
        values: (P,), in radians, metres, logarithms or seconds.
        covariance: (P, P), of the same.
    """
    limits = _LIMITS[name]
    found = values * limits.scale
    spread = covariance * limits.scale**2 + limits.floor**2 * np.eye(len(values))
    sigmas, size = np.sqrt(np.diag(spread)), float(np.linalg.norm(found))
    verdict, reason = Verdict.GOOD, ""
    significant = float(found @ np.linalg.solve(spread, found)) > _SIGNIFICANT
    if sigmas.max() > limits.vague:
        verdict = Verdict.UNDETERMINED
        reason = f"known within {sigmas.max():.2g} {limits.unit} only; expected {limits.vague:g} or better"
    elif size > limits.good and not significant:
        verdict, reason = Verdict.UNDETERMINED, f"{size:.2g} {limits.unit} may be chance"
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


def _rotation_item(search: "_Search", camera: Camera, best: "_Top", *, alone: bool) -> Item:
    item = judge("rotation", best.change[:3], best.covariance[:3, :3])
    if item.verdict is Verdict.GOOD and alone and search.height(np.zeros(COUNT), _FINE) < _ALIKE * best.height:
        reason = "images and sweeps agree much better a little away from it"
        return msgspec.structs.replace(item, verdict=Verdict.UNDETERMINED, reason=reason)
    instead = instead_of_rotation(camera, best.change[:3]) if item.verdict in _OFF else ""
    return msgspec.structs.replace(item, reason=f"{item.reason}; {instead}") if instead else item


def _joint_item(name: str, joint: dict[str, "_Top"]) -> Item:
    top = joint[name]
    item = judge(name, top.change[list(top.parameters[3:])], top.covariance[3:, 3:])
    if item.verdict in _OFF and not top.is_better:
        reason = "a change of it does not make images and sweeps agree better"
        return msgspec.structs.replace(item, verdict=Verdict.UNDETERMINED, reason=reason)
    return item


def _time_item(frames: Sequence[CalibrationFrame], joint: dict[str, "_Top"]) -> Item:
    twists = [frame.twist_lidar for frame in frames if frame.twist_lidar is not None]
    if not twists:
        return Item.unknown("time_offset", "the ego's motion is not known")
    rotation, speed = np.linalg.norm(np.reshape(twists, (-1, 2, 3)), axis=2).max(axis=0).tolist()
    if speed < _LEAST_SPEED and rotation < _LEAST_ROTATION:
        return Item.unknown("time_offset", f"the ego hardly moved: {speed:.1f} m/s, {np.degrees(rotation):.1f} deg/s")
    return _joint_item("time_offset", joint)


@dataclass(frozen=True, slots=True, eq=False)
class _Top:
    """The best location that was found, by some parameters of a change."""

    parameters: tuple[Parameter, ...]  # those searched
    change: Float64Array  # (8,) the location
    covariance: Float64Array  # (P, P), among bootstrap replicates
    height: float  # deviations above chance
    distinctness: float  # height by chance's own deviation
    gain: float  # how much higher it is than where the search began
    gain_deviation: float  # among replicates

    @property
    def is_better(self) -> bool:
        return self.gain > max(_BETTER, _BETTER_SIGMAS * self.gain_deviation)


class _Search:
    """Finds the change, (8,) numbers, where the sum of the measures, each in deviations above chance, is highest."""

    def __init__(self, agreement: Agreement) -> None:
        """Measure chance around the stated calibration, and draw cells with replacement for bootstrap replicates."""
        self.agreement = agreement
        self.generator = np.random.default_rng(_SEED)
        looks = []
        for _ in range(_FAR_LOOKS):
            direction = self.generator.normal(size=3)
            rotation = direction / np.linalg.norm(direction) * np.radians(self.generator.uniform(*_FAR_DEG))
            looks.append(agreement.score(Change.rotation(rotation)).values())
        values = np.array(looks)
        known = np.isfinite(values).sum(axis=0) >= _FAR_LOOKS // 2
        # a measure without a deviation, or without values, counts nothing
        self.means, self.deviations = np.zeros(len(MEASURES)), np.full(len(MEASURES), np.inf)
        self.means[known] = np.nanmean(values[:, known], axis=0)
        self.deviations[known] = np.nanstd(values[:, known], axis=0)
        self.deviations[self.deviations < _NO_DEVIATION] = np.inf
        self.sum_deviation = max(float(self._above_chance(values)[:, _rows(_FINE)].sum(axis=1).std()), 1.0)
        occupied = np.flatnonzero(agreement.score(Change(), by_cells=True).totals.sum(axis=0) > 0)
        self.replicates = np.zeros((_REPLICATES, agreement.cells))
        if len(occupied):
            shares = np.full(len(occupied), 1 / len(occupied))
            self.replicates[:, occupied] = self.generator.multinomial(len(occupied), shares, _REPLICATES)

    def _above_chance(self, values: Float64Array) -> Float64Array:
        """How far values (B, M) stand above chance; 0 where one is missing."""
        return np.asarray(np.nan_to_num((values - self.means) / self.deviations, nan=0.0))

    def _heights(self, score: Score, measures: Collection[str] = _FINE, *, replicated: bool = False) -> Float64Array:
        """Deviations above chance, summed over measures: (1,), or (B,) for the replicates."""
        values = score.values(self.replicates) if replicated else score.values()[None]
        return np.asarray(self._above_chance(values)[:, _rows(measures)].sum(axis=1))

    def height(self, location: Float64Array, measures: Collection[str], *, rough: bool = False) -> float:
        """Deviations above chance, summed over measures."""
        return float(self._heights(self.agreement.score(Change.of(location), measures, rough=rough), measures)[0])

    def standing(self, top: _Top) -> dict[str, Any]:
        """How far the stated and the best calibration stand above chance, as fields of `CalibrationHealth`."""
        stated, best = (self.agreement.score(change) for change in (Change(), Change.of(top.change)))
        pairs = np.stack([self._above_chance(score.values()[None])[0] for score in (stated, best)], axis=1).tolist()
        return {
            "distinctness": float(self._heights(best)[0] / self.sum_deviation),
            "stated_distinctness": float(self._heights(stated)[0] / self.sum_deviation),
            "measures": {name: (here, there) for name, (here, there) in zip(MEASURES, pairs, strict=True)},
        }

    def rotation(self) -> _Top:
        """Find the best rotation: from far to near, near the stated one, and near some that agree."""
        stated = np.zeros(COUNT)
        wide = stated
        for radius in _WIDE_RADII:
            wide = self._climbed(wide, ROTATION, radius, _WIDE)
            wide[:3] *= min(1.0, np.radians(_FARTHEST_DEG) / max(float(np.linalg.norm(wide[:3])), 1e-12))
        starts = (wide, stated, *self._promising())
        highest = self._highest([self._climbed(start, ROTATION, _FINE_RADII[0], _FINE) for start in starts])
        return self._top(highest, highest, ROTATION, _FINE_RADII[1])

    def group(self, start: Float64Array, parameters: Sequence[Parameter]) -> _Top:
        """Find the best location by several parameters, from near and from farther away; the higher of both counts."""
        locations = []
        for radii in (_NEAR_RADII, _FAR_RADII):
            location = start
            for radius in radii[:-1]:
                location = self._climbed(location, parameters, radius, _FINE if radius <= _FINE_FROM else _WIDE)
            locations.append(location)
        return self._top(self._highest(locations), start, parameters, _NEAR_RADII[-1])

    def _promising(self) -> list[Float64Array]:
        """Some of many rotations around the stated calibration that agree best, none near another."""
        columns = list(ROTATION)
        rotations = _in_ball(_MANY, len(columns), self.generator) * _MANY_RADIUS
        locations = np.zeros((_MANY, COUNT))
        locations[:, columns] = rotations * UNITS[columns]
        heights = np.array([self.height(location, _WIDE, rough=True) for location in locations])
        found: list[int] = []
        for row in np.argsort(-heights).tolist():
            if all(np.linalg.norm(rotations[row] - rotations[other]) > _FINE_RADII[0] for other in found):
                found.append(row)
        return [locations[row] for row in found[:_PROMISING]]

    def _highest(self, locations: Sequence[Float64Array]) -> Float64Array:
        highest: Float64Array = locations[int(np.argmax([self.height(location, _FINE) for location in locations]))]
        return highest

    def _climbed(
        self, middle: Float64Array, parameters: Sequence[Parameter], radius: float, measures: Collection[str]
    ) -> Float64Array:
        """Go to the top of the quadratic through looks at a ball, or to the best look where that is higher."""
        columns, rough = list(parameters), radius > _ROUGH_FROM
        locations, tops, scores = self._looks(middle, columns, radius, measures, rough=rough)
        values = np.array([self._heights(score, measures) for score in scores]).T
        top, best_look = middle.copy(), middle.copy()
        top[columns] = tops(values)[0]
        best_look[columns] = locations[np.argmax(values[0])]
        return top if rough or self.height(top, measures) >= values.max() else best_look

    def _top(self, middle: Float64Array, start: Float64Array, parameters: Sequence[Parameter], radius: float) -> _Top:
        """Find the top in a ball, and those of the replicates; `start` is what its gain is counted from."""
        columns = list(parameters)
        _, tops, scores = self._looks(middle, columns, radius, _FINE, by_cells=True)
        found = middle.copy()
        found[columns] = tops(np.array([self._heights(score) for score in scores]).T)[0]
        replicates = tops(np.array([self._heights(score, replicated=True) for score in scores]).T)
        there, here = (self.agreement.score(Change.of(at), _FINE, by_cells=True) for at in (found, start))
        height = float(self._heights(there)[0])
        gains = self._heights(there, replicated=True) - self._heights(here, replicated=True)
        return _Top(
            tuple(parameters),
            found,
            np.atleast_2d(np.cov(replicates.T)),
            height,
            height / self.sum_deviation,
            float(height - self._heights(here)[0]),
            float(gains.std()),
        )

    def _looks(
        self,
        middle: Float64Array,
        columns: list[Parameter],
        radius: float,
        measures: Collection[str],
        *,
        by_cells: bool = False,
        rough: bool = False,
    ) -> tuple[Float64Array, Callable[[Float64Array], Float64Array], list[Score]]:
        """Score locations in a ball (N, P); what finds tops (B, P) of quadratics through values (B, N); the scores."""
        # more locations for more parameters, but not as many more as a quadratic has coefficients
        dimensions = len(columns)
        looks_each = _LOOKS_PER_COEFFICIENT[dimensions > len(ROTATION)]
        ball = _in_ball(int(looks_each * ((dimensions + 1) * (dimensions + 2) // 2)), dimensions, self.generator)
        ball[0] = 0.0
        probes = _in_ball(_PROBES, dimensions, self.generator)
        solve, probe_terms = np.linalg.pinv(_terms(ball)), _terms(probes)
        middle_columns, scale = middle[columns], radius * UNITS[columns]
        locations = middle_columns + scale * ball

        def tops(values: Float64Array) -> Float64Array:
            best = np.argmax(values @ solve.T @ probe_terms.T, axis=1)
            return np.asarray(middle_columns + scale * probes[best])

        scores = []
        for location in locations:
            numbers = middle.copy()
            numbers[columns] = location
            scores.append(self.agreement.score(Change.of(numbers), measures, by_cells=by_cells, rough=rough))
        return locations, tops, scores


def _rows(measures: Collection[str]) -> list[int]:
    return [row for row, name in enumerate(MEASURES) if name in measures]


def _terms(locations: Float64Array) -> Float64Array:
    """The terms of a quadratic at locations (N, P)."""
    rows, columns = np.triu_indices(locations.shape[1])
    return np.hstack([np.ones((len(locations), 1)), locations, locations[:, rows] * locations[:, columns]])


def _in_ball(count: int, dimensions: int, generator: np.random.Generator) -> Float64Array:
    """Draw locations evenly from the unit ball, (count, dimensions)."""
    directions = generator.normal(size=(count, dimensions))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(directions * generator.random((count, 1)) ** (1.0 / dimensions))


def look_alikes(camera: Camera) -> tuple[Float64Array, Float64Array]:
    """Find the rotation of a camera that looks most like a moved principal point, and what distinguishes both.

    Returns:
        rotations: (2, 3) float64 [rad/px], the rotation vectors of the cloud about the camera's axes that move it as a
            principal point does that moves a pixel to the right, and a pixel down; the focal length may change, too.
        left: (2,) float64, what then is left over the image, as a share of the motion of the principal point (root
            of the mean square); NaN where the camera model sees nothing.
    """
    u, v = np.meshgrid(np.linspace(-0.5, camera.width - 0.5, _COLUMNS), np.linspace(-0.5, camera.height - 0.5, _ROWS))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = unproject(camera, pixels)

    def rotated(rotation: Float64Array) -> Float64Array:
        return project_unbounded(camera, rotate_vectors(quaternion_from_rotation_vector(rotation), rays))

    moves = [(rotated(step) - rotated(-step)) / (2.0 * _STEP) for step in _STEP * np.eye(3)]
    moves.append(pixels - (camera.cx, camera.cy))
    seen = np.isfinite(np.stack(moves)).all(axis=(0, 2)) & np.isfinite(rays).all(axis=1)
    if seen.sum() < len(moves):
        return np.full((2, 3), np.nan), np.full(2, np.nan)
    columns = np.column_stack([move[seen].ravel() for move in moves])
    shifts = np.tile(np.eye(2), (int(seen.sum()), 1))
    found, *_ = np.linalg.lstsq(columns, shifts, rcond=None)
    left = np.sqrt(((shifts - columns @ found) ** 2).sum(axis=0) / seen.sum())
    return np.ascontiguousarray(found[:3].T), left


def why_untold(camera: Camera) -> str:
    """Why the principal point of a camera cannot be determined: how little it differs from a rotation."""
    rotations, left = look_alikes(camera)
    if not np.isfinite(left).all():
        return "moving it looks like rotating the camera"
    moved = np.radians(1.0) / np.linalg.norm(rotations, axis=1)
    return (
        f"moving it by {moved[0]:.3g} px to the side looks like rotating the camera by 1 deg, except for "
        f"{moved[0] * left[0]:.2g} px; by {moved[1]:.3g} px upward or downward, except for "
        f"{moved[1] * left[1]:.2g} px"
    )


def instead_of_rotation(camera: Camera, rotation: Float64Array) -> str:
    """Which principal point would look like a rotation (3,) [rad] of the cloud; "" where none would."""
    rotations, left = look_alikes(camera)
    if not np.isfinite(left).all():
        return ""
    moved, *_ = np.linalg.lstsq(rotations.T, rotation, rcond=None)
    if np.linalg.norm(rotation - moved @ rotations) > _MOSTLY * np.linalg.norm(rotation):
        return ""
    unlike = float(np.hypot(*(moved * left)))
    return f"its principal point {np.hypot(*moved):.2g} px off looks the same within {unlike:.2g} px"


def judge_motion(camera_rotations: Float64Array, lidar_rotations: Float64Array, rotation: Float64Array) -> Item:
    """Judge a rotation by how camera and lidar rotate.

    Args:
        camera_rotations: (N, 3) [rad], rotation vectors from image to image in the camera's axes; NaN where unknown.
        lidar_rotations: (N, 3) [rad], of the same times, in the lidar's axes; NaN where unknown.
        rotation: (3, 3), of `camera_from_lidar` as stated.

    Returns:
        The item of the two axes across the axis of rotation; the first is the nearest to the camera's x axis.
    """
    known = np.isfinite(camera_rotations).all(axis=1) & np.isfinite(lidar_rotations).all(axis=1)
    seen, stated = camera_rotations[known], lidar_rotations[known] @ rotation.T
    size = float(np.degrees(np.linalg.norm(stated, axis=1).sum()))
    if len(seen) < _LEAST_STEPS or size < _LEAST_ROTATION_DEG:
        return Item.unknown(
            MOTION,
            f"{len(seen)} steps in which both are known to rotate, by {size:.1f} deg; expected {_LEAST_STEPS} and "
            f"{_LEAST_ROTATION_DEG:g} deg",
        )
    found, covariance, axis = _aligned(seen, stated)
    across = _across(axis)
    return judge(MOTION, across @ found, across @ covariance @ across.T)


def _aligned(seen: Float64Array, stated: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """The rotation (3,) from the stated to the observed extrinsics, its covariance (3, 3) and rotation axis (3,)."""
    u, _, vt = np.linalg.svd(seen.T @ stated)
    axis = u[:, 0]
    along = np.outer(axis, axis)
    found = _first_rotation(axis, vt[0])
    for _ in range(_ROUNDS):
        moved = stated @ matrix_from_quaternion(quaternion_from_rotation_vector(found)).T
        slopes, left = -cross_matrix(moved), seen - moved
        sizes = np.square(left).sum(axis=1)
        weights = 1.0 / (1.0 + sizes / max(4.0 * float(np.median(sizes)), 1e-16))
        normal = np.einsum("nki,n,nkj->ij", slopes, weights, slopes) + along * float(np.sum(stated**2))
        pulls = np.einsum("nki,n,nk->ni", slopes, weights, left)
        step = quaternion_from_rotation_vector(np.linalg.solve(normal, pulls.sum(axis=0)))
        found = rotation_vector_from_quaternion(multiply_quaternions(step, quaternion_from_rotation_vector(found)))
    blocks = np.zeros((_BLOCKS, 3))
    np.add.at(blocks, np.arange(len(seen)) * _BLOCKS // len(seen), pulls)
    inverse = np.linalg.inv(normal)
    return found, inverse @ (blocks.T @ blocks) @ inverse * _BLOCKS / (_BLOCKS - 2), axis


def _first_rotation(seen_axis: Float64Array, stated_axis: Float64Array) -> Float64Array:
    """The smallest rotation, (3,), that takes one axis to the other."""
    normal = np.cross(stated_axis, seen_axis)
    sine, cosine = float(np.linalg.norm(normal)), float(stated_axis @ seen_axis)
    if sine < 1e-9:
        return np.zeros(3) if cosine > 0 else np.pi * _across(seen_axis)[0]
    return np.asarray(normal / sine * np.arctan2(sine, cosine))


def _across(axis: Float64Array) -> Float64Array:
    """Two directions, (2, 3), across an axis; the first is the nearest to x, or to z where the axis is near x."""
    near = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 0.0, 1.0])
    first = near - axis * (near @ axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(first, axis)])


def judge_boxes(found: BoxRotation | None) -> tuple[Item, Item]:
    """Judge the rotation that boxes of images and sweeps show: across the optical axis, and about it.

    Args:
        found: the rotation; None where hardly any boxes may be of one object.
    """
    if found is None:
        reason = "hardly any boxes of images and sweeps may be of one object"
    elif found.agreeing < _LEAST_AGREEING or found.images < _LEAST_IMAGES:
        reason = (
            f"{found.agreeing} couples of boxes in {found.images} images agree about one rotation; "
            f"expected {_LEAST_AGREEING} in {_LEAST_IMAGES}"
        )
    elif found.agreeing < _ABOVE_CHANCE * found.by_chance:
        reason = (
            f"{found.agreeing} couples of boxes agree about one rotation, {found.by_chance} about another; "
            f"expected {_ABOVE_CHANCE:g} times as many"
        )
    else:
        across = judge(_BOXES, found.rotation[:2], found.covariance[:2, :2])
        return across, judge(_BOXES_ROLL, found.rotation[2:], found.covariance[2:, 2:])
    return Item.unknown(_BOXES, reason), Item.unknown(_BOXES_ROLL, reason)


def _contradiction(health: CalibrationHealth, across: Item, roll: Item) -> str:
    """Why images and boxes cannot both be right; "" if they can."""
    off = [item for item in (across, roll) if item.verdict in _OFF]
    if health.verdict is Verdict.GOOD and off:
        return f"{off[0].reason}, but images and points agree with it"
    rotation = health.item("rotation")
    if rotation.verdict not in _OFF or across.verdict is not Verdict.GOOD:
        return ""
    apart = np.subtract(rotation.values[:2], across.values)
    variances = np.square(rotation.sigmas[:2]) + np.square(across.sigmas)
    far = float(np.linalg.norm(apart)) > _LIMITS[_BOXES].good
    differ = far and float(np.sum(apart**2 / variances)) > _SIGNIFICANT
    return f"boxes agree with it, but {rotation.reason}" if differ else ""
