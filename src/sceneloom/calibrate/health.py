"""Check of a camera-lidar calibration: by images and points, by detected boxes, and by motion.

The limits of the verdicts are lengths and angles that matter: see docs/calibration.md.

Search: quadratics are fitted to scores at random locations of a ball, and the next, smaller ball lies around the top.
Source: response surfaces, Box and Wilson 1951, "On the Experimental Attainment of Optimum Conditions".

From there calibrations are fitted as by a refinement, three times: the rotation alone, with the translation, and with
focal length and time. At one distance a translation looks like a rotation, and at one speed another time like a
translation ahead: near points tell the first apart, turns and other speeds the second. So the fewest numbers that
explain what is seen are judged, and more of them only where those are off by themselves. What misplaces all edges
alike, such as shadows behind them, is in no covariance: floors of 0.06 degrees, which are 2 cm at 20 m, stand for it.

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
distance. They judge what leads from the frame in which they are stated into the image, and nothing else: KITTI's boxes
are in the rectified camera's frame, and show of its calibration P2 alone.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
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
    Parameter,
)
from sceneloom.calibrate.refinement import CHANNELS, FARTHEST, Around, climbed, find_levels, polished, search, sum_maps
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.detections.results import BoxFrame, BoxRotation
from sceneloom.geometry.rigid import (
    RigidTransform,
    cross_matrix,
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, PointsFrame
from sceneloom.warnings import DataWarning

PARTS = ("rotation", "translation", "focal_length", "principal_point", "time_offset", "ego_from_lidar")
"""What images and points are asked about, in the order of the items."""

MOTION, _BOXES, _BOXES_ROLL = "motion", "boxes", "boxes_roll"
"""Further items: of rotation from image to image; of boxes, about the camera's x and y axes, and about its z axis."""

_PROJECTED, _PROJECTED_ROLL = "boxes_projection", "boxes_projection_roll"
"""Instead of those of boxes, where boxes do not come in the lidar's frame."""

_POINTS_JUDGE = {
    PointsFrame.SENSOR: "camera_from_lidar",
    PointsFrame.EGO: "camera_from_ego",
    PointsFrame.WORLD: "camera_from_world",
}  # what images and points are evidence of, by the frame in which the points are stated

_BOXES_JUDGE = {
    BoxFrame.LIDAR: "camera_from_lidar",
    BoxFrame.CAMERA: "camera model",
    BoxFrame.WORLD: "camera_from_world",
}
_CANCELS = {
    BoxFrame.CAMERA: "the camera's frame, as KITTI's are: they judge the camera model (P2), and what relates the lidar "
    "to it (R_rect, Tr_velo_cam, Tr_imu_velo) cancels",
    BoxFrame.WORLD: "world coordinates, as nuScenes' are: they judge the camera's extrinsics and model, and the "
    "lidar's extrinsics cancel",
}

_OF_PART = {
    "rotation": ROTATION,
    "translation": TRANSLATION,
    "focal_length": (Parameter.FOCAL,),
    "time_offset": (Parameter.LATER,),
}

_FINE, _WIDE = (EDGES, INFORMATION), MEASURES
_FAR_LOOKS, _FAR_DEG = 48, (2.5, 6.0)  # rotations so far away that images and clouds agree by nothing but chance

_SEED, _NO_DEVIATION = 0, 1e-6
_WIDE_RADII, _FINE_RADIUS = (20.0, 11.0, 6.0, 3.5), 2.4
"""Balls of rotations that are searched, one after another [units of a quarter degree]."""

_MANY, _MANY_RADIUS, _PROMISING = 150, 7.0, 2
"""So many rotations up to so far are scored, and so many followed up: peaks are narrower than wide balls show."""

_ROUGH_FROM = 3.0  # in wider balls some of the features show where to look next

_PROBES, _FARTHEST_DEG = 3000, 6.0
_LOOKS, _LOOKS_ROUGH = 28, 40  # of the ten numbers of a quadratic, near and far
_DISTINCT = 4.5
"""Deviations above chance from which on images and sweeps agree; the best of some hundred chances reaches 3.3."""

_OWN_VIEW_M, _OWN_VIEW_DEG = 2.0, 6.0
_LEAST_SEEN, _LEAST_EDGES = 200, 60
_PLAIN = 0.9  # images of which more shows nothing are dark, covered or fogged

_CURVATURE_STEP = 0.8  # of the blur's width
_TILES_ACROSS, _TILES_DOWN = 6, 3

_SURE = 2.5
"""Standard deviations by which a part must be off beyond what calibrations are known to."""

_LEAST_FRAMES = 4
"""Translation, focal length and time move pixels nearly as a rotation does: what single objects suggest of the
difference, from one side, averages out over several images only."""

_RESTATED = np.radians(1.0)  # a fit begins at the rotation that was found before if that is farther away

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
    known: float  # that well calibrations are known, published ones too
    good: float  # up to here
    wrong: float  # beyond this
    floor: float  # the error that the measures have by themselves, on each axis
    vague: float  # with a larger standard deviation in any direction it is not called good
    what: str = "images and sweeps agree"


_TOGETHER = "boxes of images and sweeps agree"
_DEG = 180.0 / np.pi
_OF_BOXES = _Limits("deg", _DEG, 0.1, 0.4, 1.0, 0.12, 0.35, _TOGETHER)
_OF_BOXES_ROLL = _Limits("deg", _DEG, 0.1, 1.0, 2.0, 0.4, 0.6, _TOGETHER)
_LIMITS = {
    "rotation": _Limits("deg", _DEG, 0.1, 0.3, 1.0, 0.06, 0.2),
    "translation": _Limits("m", 1.0, 0.02, 0.06, 0.3, 0.02, 0.04),
    "focal_length": _Limits("%", 100.0, 0.2, 1.0, 3.0, 0.2, 0.8),
    "time_offset": _Limits("ms", 1e3, 2.0, 15.0, 60.0, 4.0, 9.0),
    _BOXES: _OF_BOXES,
    _BOXES_ROLL: _OF_BOXES_ROLL,
    _PROJECTED: _OF_BOXES,
    _PROJECTED_ROLL: _OF_BOXES_ROLL,
    MOTION: _Limits("deg", _DEG, 0.1, 1.5, 3.0, 0.5, 0.8, "camera and lidar rotate alike"),
}


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """One part of a calibration.

    Attributes:
        name: one of `PARTS`, "boxes", "boxes_roll", "boxes_projection", "boxes_projection_roll" or "motion".
        verdict: its state.
        reason: why, where it is not good.
        unit: of the numbers.
        values: by how much it would have to be changed; empty where nothing was found.
        sigmas: their standard deviations, the errors that the measures have by themselves included.
        judged: the stated value that the evidence depends on.
    """

    name: str
    verdict: Verdict
    reason: str = ""
    unit: str = ""
    values: tuple[float, ...] = ()
    sigmas: tuple[float, ...] = ()
    judged: str = "camera_from_lidar"

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

    @property
    def extent(self) -> str:
        """Of which parts a good verdict is: "in rotation, focal length", as others may not be known; else ""."""
        names = [item.name.replace("_", " ") for item in self.items if item.verdict is Verdict.GOOD]
        return f"in {', '.join(names)}" if self.verdict is Verdict.GOOD else ""

    @classmethod
    def of_boxes(
        cls,
        found: BoxRotation | None,
        stated_in: Collection[BoxFrame],
        *,
        source: str,
        camera_id: Identifier,
        lidar_id: Identifier,
        frames: int,
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
        return untold.with_boxes(found, stated_in)

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

    def with_boxes(self, found: BoxRotation | None, stated_in: Collection[BoxFrame]) -> "CalibrationHealth":
        """Add the rotation that boxes show to the check by images and points.

        Boxes that are stated in the lidar's frame decide where images and points cannot; others never make a
        calibration good. Where one side calls good what the other clearly does not, the whole cannot be determined.
        """
        across, roll, *untold = judge_boxes(found, stated_in)
        verdicts = {self.verdict, across.verdict, roll.verdict}
        reason = _contradiction(self, across, roll)
        if reason:
            verdict, across = Verdict.UNDETERMINED, msgspec.structs.replace(across, reason=reason)
        elif verdicts & set(_OFF):
            verdict = next(off for off in _OFF if off in verdicts)
        elif self.verdict is Verdict.UNDETERMINED and (self.doubted or any(i.suspected for i in self.items)):
            verdict = Verdict.UNDETERMINED
        else:
            good = Verdict.GOOD in {self.verdict, across.verdict if across.name == _BOXES else self.verdict}
            verdict = Verdict.GOOD if good else Verdict.UNDETERMINED
        return msgspec.structs.replace(self, verdict=verdict, items=(*self.items, across, roll, *untold))

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
    views, judged = views_of(frames), _POINTS_JUDGE[frames[0].points_frame]

    def health(items: tuple[Item, ...], verdict: Verdict = Verdict.UNDETERMINED, **found: Any) -> CalibrationHealth:
        items = tuple(msgspec.structs.replace(item, judged=judged) for item in items)
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
    nothing = _why_nothing(agreement)
    if nothing:
        return health(tuple(Item.unknown(name, nothing) for name in PARTS))
    rotations = _Search(agreement)
    start = rotations.rotation()
    standing = rotations.standing(start)
    distinctness = standing["distinctness"]
    if distinctness < _DISTINCT:
        reason = (
            f"no calibration within 6 degrees makes images and sweeps agree better than by chance "
            f"({distinctness:.1f} deviations; expected {_DISTINCT:g}): it is far off, or they show too little"
        )
        return health(tuple(Item.unknown(name, reason) for name in PARTS), **standing)
    del agreement, rotations  # of the size of ten images a frame, as what is fitted by is
    fits = _fitted(frames, start)
    if fits is None:
        reason = "the points in the images are too few, or nowhere different from their surroundings"
        return health(tuple(Item.unknown(name, reason) for name in PARTS), **standing)
    few = "" if len(frames) >= _LEAST_FRAMES else f"{len(frames)} images; expected {_LEAST_FRAMES} or more"
    untimed = few or _why_no_time(frames)
    shifted = Item.unknown("translation", few) if few else fits.shifted.judged("translation")
    focal = Item.unknown("focal_length", few) if few else fits.whole.judged("focal_length")
    time = Item.unknown("time_offset", untimed) if untimed else fits.whole.judged("time_offset")
    best = fits.rotated
    if shifted.verdict in _OFF:
        best = fits.shifted
    if focal.verdict in _OFF or time.verdict in _OFF:
        best = fits.whole
        shifted = best.judged("translation")
    items = (
        _rotation_item(frames[0].camera, best, fits),
        shifted,
        focal,
        Item.unknown("principal_point", why_untold(frames[0].camera)),
        time,
        Item.unknown("ego_from_lidar", _why_no_ego(frames[0].points_frame)),
    )
    verdict = next((off for off in _OFF if any(item.verdict is off for item in items)), items[0].verdict)
    doubted = standing["stated_distinctness"] < _ALIKE * distinctness
    if verdict is Verdict.GOOD and (doubted or any(item.suspected for item in items)):
        verdict = Verdict.UNDETERMINED
    return health(items, verdict, **standing, change=tuple(best.change.tolist()))


def _why_no_ego(points_frame: PointsFrame) -> str:
    """Why images and points do not show the lidar's extrinsics."""
    if points_frame is PointsFrame.SENSOR:
        return (
            "camera and lidar are compared with one another, so that what is common to both (KITTI: Tr_imu_velo) "
            "cancels; --hand-eye estimates it"
        )
    return (
        f"the points are stated in {points_frame} coordinates, so that the lidar's extrinsics cancel: camera and "
        "points alone were judged; expected points in the lidar's own frame"
    )


def _why_nothing(agreement: Agreement) -> str:
    """Why frames cannot determine anything of a calibration; "" if they may."""
    features = agreement.features
    seen = sum(f.seen for f in features)
    if seen < _LEAST_SEEN:
        return f"{seen} points fall into {len(features)} images; expected {_LEAST_SEEN} at least"
    if np.median([image.plainness for image in agreement.images]) > _PLAIN:
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

    It is off where it is beyond what calibrations are known to by more than `_SURE` standard deviations, and by more
    than is good.

    Args:
        name: of an item but the principal point.
        values: (P,), in radians, metres, logarithms or seconds.
        covariance: (P, P), of the same.
    """
    limits = _LIMITS[name]
    found = values * limits.scale
    spread = covariance * limits.scale**2 + limits.floor**2 * np.eye(len(values))
    sigmas, size = np.sqrt(np.diag(spread)), float(np.linalg.norm(found))
    widest = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
    along = float(np.sqrt(found @ spread @ found)) / size if size > 0.0 else widest
    verdict, reason = Verdict.GOOD, ""
    if size > limits.good and size - _SURE * along > limits.known:
        verdict = Verdict.WRONG if size > limits.wrong else Verdict.DRIFTING
        reason = f"{limits.what} best {size:.2g} {limits.unit} away from it"
    elif widest > limits.vague:
        verdict = Verdict.UNDETERMINED
        unseen = max(limits.good, limits.known + _SURE * widest) + widest
        reason = f"known within {widest:.2g} {limits.unit} only: less than {unseen:.2g} {limits.unit} would not be seen"
    elif size > limits.good:
        verdict, reason = Verdict.UNDETERMINED, f"{size:.2g} {limits.unit} may be chance"
    return Item(
        name=name,
        verdict=verdict,
        reason=reason,
        unit=limits.unit,
        values=tuple(map(float, found)),
        sigmas=tuple(map(float, sigmas)),
    )


def _rotation_item(camera: Camera, best: "_Fit", fits: "_Fits") -> Item:
    """Judge the rotation, and name what else would look like it."""
    item = best.judged("rotation")
    if item.verdict not in _OFF:
        return item
    others = [instead_of_rotation(camera, best.change[:3])]
    if best is fits.rotated:
        there = fits.shifted.change
        rotation, shift = np.degrees(np.linalg.norm(there[:3])), 100.0 * np.linalg.norm(there[3:6])
        others.append(f"so do {rotation:.2g} deg with a translation of {shift:.2g} cm")
    return msgspec.structs.replace(item, reason="; ".join(filter(None, (item.reason, *others))))


def _why_no_time(frames: Sequence[CalibrationFrame]) -> str:
    """Why nothing shows when images were taken; "" if it may."""
    twists = [frame.twist_lidar for frame in frames if frame.twist_lidar is not None]
    if not twists:
        return "the ego's motion is not known"
    rotation, speed = np.linalg.norm(np.reshape(twists, (-1, 2, 3)), axis=2).max(axis=0).tolist()
    if speed < _LEAST_SPEED and rotation < _LEAST_ROTATION:
        return f"the ego hardly moved: {speed:.1f} m/s, {np.degrees(rotation):.1f} deg/s"
    return ""


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """The best calibration by some parameters of a change."""

    free: Int64Array  # (P,) which of the eight numbers were searched
    change: Float64Array  # (8,) from the stated calibration
    covariance: Float64Array  # (P, P), of those that were searched
    more: Float64Array  # (3,) [rad²], by which the floor of the rotation is too low here

    def judged(self, part: str) -> Item:
        """Judge a part of which the parameters were searched."""
        rows = [self.free.tolist().index(parameter) for parameter in _OF_PART[part]]
        covariance = self.covariance[np.ix_(rows, rows)]
        if part == "rotation":
            covariance = covariance + np.diag(self.more)
        return judge(part, self.change[self.free[rows]], covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _Fits:
    """The best calibrations by the rotation alone, with translation, and with all that can be searched."""

    rotated: _Fit
    shifted: _Fit
    whole: _Fit


def _fitted(frames: Sequence[CalibrationFrame], start: Float64Array) -> _Fits | None:
    """Fit calibrations as a refinement does, from a rotation that is near, (8,); None where there is too little.

    Their covariance is that of the pulls of the tiles of each view: frames that show nearly the same are no evidence of
    their own.
    """
    turned = np.eye(4)
    if float(np.linalg.norm(start[:3])) > _RESTATED:
        turned = Change.of(start).camera_from_lidar(turned)
    error = RigidTransform.nearest(turned)[0]
    size, camera = frames[0].grey.shape, frames[0].camera
    # what misplaces pixels by the floor of pitch and yaw misleads roll by so much more as pixels are near the axis
    arm = float(np.hypot(camera.width / camera.fx, camera.height / camera.fy)) / np.sqrt(12.0)
    share = max(_LEAST_FRAMES / len(frames), 1.0)
    floor = _LIMITS["rotation"].floor / _LIMITS["rotation"].scale
    more = floor**2 * (share * np.array([1.0, 1.0, max(arm**-2, 1.0)]) - 1.0)
    near = [replace(f, camera_from_lidar=error @ f.camera_from_lidar) for f in frames if f.grey.shape == size]
    levels = find_levels(near, _LEAST_EDGES)
    if not levels:
        return None
    cues = levels[0].cues
    views = views_of([one.frame for one in cues])
    whole = [k for k in Parameter if k is not Parameter.LATER or not _why_no_time(near)]
    found = search(levels, np.ones(len(cues), np.bool_), np.array(ROTATION, np.int64))
    fits = []
    for parameters in (ROTATION, (*ROTATION, *TRANSLATION), whole):
        free = np.array(parameters, np.int64)
        if len(free) > len(ROTATION):
            numbers = found.numbers
            for level in levels[1:]:
                numbers = climbed(level, free, numbers)
            found = polished(levels[-1], free, numbers)
        if not found.weights.any():
            return None
        change = found.numbers.copy()
        change[:6] = _screw(Change.of(found.numbers).camera_from_lidar(turned))
        steady = _Steady(found.level, free, found.numbers)
        fits.append(_Fit(free, change, steady.covariance(views) * np.outer(UNITS[free], UNITS[free]), more))
    return _Fits(*fits)


class _Steady(Around):
    """A fit of which curvature is taken over nearly the width of the blur: where few views agree, less shows pixels."""

    def inverse_curvature(self) -> Float64Array:
        """The inverse of minus the second derivatives, (P, P); flat directions are bounded by the prior."""
        gradients = [
            [self.downwards(sign * _CURVATURE_STEP * axis)[1] for sign in (1.0, -1.0)]
            for axis in np.eye(len(self.free))
        ]
        curvature = np.array([ahead - behind for ahead, behind in gradients]) / (2.0 * _CURVATURE_STEP)
        values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
        bounds = np.square(self.basis @ vectors / FARTHEST[self.free][:, None]).sum(axis=0)
        return np.asarray(vectors / np.maximum(values, bounds) @ vectors.T)

    def covariance(self, views: Int64Array) -> Float64Array:
        """The covariance (P, P) of the numbers, in units, by how differently tiles pull; `views` (F,) of the frames."""
        level, free = self.level, len(self.free)
        size = np.array(level.maps.shape[:0:-1])
        tiles = np.array([_TILES_ACROSS, _TILES_DOWN])
        tile = np.clip(np.nan_to_num(self.pixels) / size * tiles, 0, tiles - 1).astype(np.int64)
        clusters = (views[level.groups // len(CHANNELS)] * tiles[1] + tile[:, 1]) * tiles[0] + tile[:, 0]
        weights = (level.weights * self.weights[level.groups % len(CHANNELS)]).astype(np.float32)
        count = int(clusters.max(initial=0)) + 1
        pulls, rest = np.zeros((count, free)), np.zeros((2, count))
        sum_maps(
            self.pixels, self.slopes, np.zeros(free), weights, level.rows, clusters.astype(np.int32), level.maps,
            rest[0], rest[1], pulls,
        )  # fmt: skip
        pulling = int(pulls.any(axis=1).sum())
        spread = pulls.T @ pulls * (pulling / max(pulling - 1, 1)) + np.diag(FARTHEST[self.free] ** -2.0)
        inverse = self.basis @ self.inverse_curvature() @ self.basis.T
        return np.asarray(inverse @ spread @ inverse)


def _screw(matrix: Float64Array) -> Float64Array:
    """The rotation and translation, (6,), of which `Change.camera_from_lidar` makes a (4, 4) transform."""
    rotation = rotation_vector_from_quaternion(RigidTransform.nearest(matrix)[0].quaternion_xyzw)
    axes = [Change.of(np.array([*rotation, *axis, 0.0, 0.0])).camera_from_lidar(np.eye(4))[:3, 3] for axis in np.eye(3)]
    return np.concatenate([rotation, np.linalg.solve(np.column_stack(axes), matrix[:3, 3])])


class _Search:
    """Finds the rotation where the sum of the measures, each in deviations above chance, is highest."""

    def __init__(self, agreement: Agreement) -> None:
        """Measure chance around the stated calibration."""
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

    def _above_chance(self, values: Float64Array) -> Float64Array:
        """How far values (B, M) stand above chance; 0 where one is missing."""
        return np.asarray(np.nan_to_num((values - self.means) / self.deviations, nan=0.0))

    def height(self, location: Float64Array, measures: Collection[str], *, rough: bool = False) -> float:
        """Deviations above chance, summed over measures."""
        values = self.agreement.score(Change.of(location), measures, rough=rough).values()
        return float(self._above_chance(values[None])[0, _rows(measures)].sum())

    def standing(self, best: Float64Array) -> dict[str, Any]:
        """How far the stated calibration and another stand above chance, as fields of `CalibrationHealth`."""
        scores = np.array([self.agreement.score(change).values() for change in (Change(), Change.of(best))])
        heights = self._above_chance(scores)
        stated, there = (heights[:, _rows(_FINE)].sum(axis=1) / self.sum_deviation).tolist()
        pairs = dict(zip(MEASURES, zip(*heights.tolist(), strict=True), strict=True))
        return {"distinctness": there, "stated_distinctness": stated, "measures": pairs}

    def rotation(self) -> Float64Array:
        """Find the best rotation, as (8,) numbers: from far to near, near the stated one, and near some that agree."""
        stated = np.zeros(COUNT)
        wide = stated
        for radius in _WIDE_RADII:
            wide = self.climbed(wide, radius, _WIDE)
            wide[:3] *= min(1.0, np.radians(_FARTHEST_DEG) / max(float(np.linalg.norm(wide[:3])), 1e-12))
        starts = (wide, stated, *self._promising())
        near = [self.climbed(start, _FINE_RADIUS, _FINE) for start in starts]
        highest: Float64Array = near[int(np.argmax([self.height(location, _FINE) for location in near]))]
        return highest

    def _promising(self) -> list[Float64Array]:
        """Some of many rotations around the stated calibration that agree best, none near another."""
        rotations = _in_ball(_MANY, len(ROTATION), self.generator) * _MANY_RADIUS
        locations = np.zeros((_MANY, COUNT))
        locations[:, :3] = rotations * UNITS[:3]
        heights = np.array([self.height(location, _WIDE, rough=True) for location in locations])
        found: list[int] = []
        for row in np.argsort(-heights).tolist():
            if all(np.linalg.norm(rotations[row] - rotations[other]) > _FINE_RADIUS for other in found):
                found.append(row)
        return [locations[row] for row in found[:_PROMISING]]

    def climbed(self, middle: Float64Array, radius: float, measures: Collection[str]) -> Float64Array:
        """Go to the top of the quadratic through looks at a ball, or to the best look where that is higher."""
        rough, dimensions = radius > _ROUGH_FROM, len(ROTATION)
        ball = _in_ball(_LOOKS_ROUGH if rough else _LOOKS, dimensions, self.generator)
        ball[0] = 0.0
        probes = _in_ball(_PROBES, dimensions, self.generator)
        locations = np.tile(middle, (len(ball), 1))
        locations[:, :3] += radius * UNITS[:3] * ball
        heights = np.array([self.height(location, measures, rough=rough) for location in locations])
        top = middle.copy()
        top[:3] += radius * UNITS[:3] * probes[np.argmax(_terms(probes) @ (np.linalg.pinv(_terms(ball)) @ heights))]
        better = rough or self.height(top, measures) >= heights.max()
        return top if better else locations[int(np.argmax(heights))]


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


def judge_boxes(found: BoxRotation | None, stated_in: Collection[BoxFrame]) -> tuple[Item, ...]:
    """Judge the rotation that boxes of images and sweeps show: across the optical axis, and about it.

    Args:
        found: the rotation; None where hardly any boxes may be of one object.
        stated_in: the frames in which the boxes of sweeps were stated; unless that is the lidar's alone, they say
            nothing of its extrinsics, and a third item states that.
    """
    others: list[BoxFrame] = [frame for frame in BoxFrame if frame in stated_in and frame is not BoxFrame.LIDAR]
    names = (_PROJECTED, _PROJECTED_ROLL) if others else (_BOXES, _BOXES_ROLL)
    judged = " or ".join(_BOXES_JUDGE[frame] for frame in others or [BoxFrame.LIDAR])
    reason = ""
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
        parts = slice(0, 2), slice(2, 3)
        items = [judge(n, found.rotation[p], found.covariance[p, p]) for n, p in zip(names, parts, strict=True)]
    if found is None or reason:
        items = [Item.unknown(name, reason) for name in names]
    items = [msgspec.structs.replace(item, judged=judged) for item in items]
    why = "; ".join(f"the boxes of sweeps are stated in {_CANCELS[frame]}" for frame in others)
    needed = "expected sweeps with images, or boxes in the lidar's own frame"
    return (*items, *([Item.unknown(_BOXES, f"{why}; {needed}")] if others else []))


def _contradiction(health: CalibrationHealth, across: Item, roll: Item) -> str:
    """Why images and boxes cannot both be right; "" if they can."""
    off = [item for item in (across, roll) if item.verdict in _OFF]
    if health.verdict is Verdict.GOOD and off:
        return f"{off[0].reason}, but images and points agree with it"
    rotation = health.item("rotation")
    if rotation.verdict not in _OFF or across.verdict is not Verdict.GOOD or across.name != _BOXES:
        return ""
    apart = np.subtract(rotation.values[:2], across.values)
    variances = np.square(rotation.sigmas[:2]) + np.square(across.sigmas)
    far = float(np.linalg.norm(apart)) > _LIMITS[_BOXES].good
    differ = far and float(np.sum(apart**2 / variances)) > _SIGNIFICANT
    return f"boxes agree with it, but {rotation.reason}" if differ else ""
