"""Detections of simulated detectors in sweeps and in images, with errors of known size."""

import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.boxes import CORNER_SIGNS, EDGES
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.ego import sensor_source
from sceneloom.scene.types import Identifier, PointsFrame
from sceneloom.simulate.camera import LINE_ROUNDS, ImageTruth, RenderedCamera
from sceneloom.simulate.drive import SimulatedDrive
from sceneloom.simulate.parameters import Stream, check_bounds, generator_for
from sceneloom.simulate.street import Street, boxes_of

_SMALLEST = 1e-9  # scores keep this far from 0 and 1, so that their logits are finite


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
        check_bounds("scores", self, concentration=(0.01, 1e4), likeness=(1e-3, 1e3))
        check_bounds("scores", self, logit_scale=(1e-3, 1e3), logit_shift=(-1e3, 1e3))
        if self.form == ScoreForm.PROBABILITY and (self.logit_scale, self.logit_shift) != (1.0, 0.0):
            raise OptionError("scores: logit_scale and logit_shift are for logits; set form to ScoreForm.LOGIT")


class LooksLike(NamedTuple):
    """What the boxes of one class look like.

    Attributes:
        true_shares: (M,) float64, π_m: share of the boxes looking like object m that are true.
        false_shares: (M,) float64, share of the false boxes that look like object m; they sum to 1.
    """

    true_shares: Float64Array
    false_shares: Float64Array


def deal_out(chances: Float64Array, false_count: float, *, repeated: float = 0.0, likeness: float = 0.2) -> LooksLike:
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
    scores = np.clip(generator.beta(np.maximum(a, _SMALLEST), np.maximum(b, _SMALLEST)), _SMALLEST, 1.0 - _SMALLEST)
    if spec.form == ScoreForm.PROBABILITY:
        return scores
    logits: Float64Array = spec.logit_scale * np.log(scores / (1.0 - scores)) + spec.logit_shift
    return logits


_MANY = 1e6  # no number of a detector is larger: squares and products of them stay finite


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
        limits = {"half_evidence": (1e-6, _MANY), "false_rate": (0.0, 100.0), "size_lwh": (1e-3, 100.0)}
        check_bounds("detector.classes", self, **limits)


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
        check_bounds("detector.misses", self, recall=(1e-6, 1.0), steepness=(0.0, _MANY), hiding=(0.0, _MANY))

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

_SHARED_BOUNDS = {"lasting_share": (0.0, 1.0), "repeated": (0.0, 1.0), "seed": (0.0, float("inf"))}
"""Of the fields that both kinds of detector have."""


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
        check_bounds(
            "detector",
            self,
            center_sigmas=(0.0, 1e3),
            size_sigmas=(0.0, 1e3),
            yaw_sigma_deg=(0.0, 180.0),
            range_scale=(1e-3, float("inf")),
            few_points=(0.0, _MANY),
            flip_share=(0.0, 1.0),
            velocity_sigma=(0.0, 1e3),
            **_SHARED_BOUNDS,
        )

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
        own = {"corner_sigma_px": (0.0, 1e4), "corner_sigma_share": (0.0, 10.0)}
        check_bounds("detector", self, **own, **_SHARED_BOUNDS)


_Boxes = TypeVar("_Boxes", Boxes3D, Boxes2D)
FALSE = -1
"""The instance of a box where there is no object."""

_OBJECTS = 1 << 31  # numbers from here on stand for objects where those below stand for frames
_FALSE_WITHIN = 60.0
_FALSE_HEIGHTS = (0.2, 1.8)
"""False boxes are about things that are no farther from the sensor, and so high above the ground [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDetections(Generic[_Boxes]):
    """What a detector reports of one sweep or image, and what is known about it.

    Attributes:
        boxes: its report, the surest first.
        instances: (N,) int64, the object that each box is of, `FALSE` where there is none.
        duplicates: (N,) bool, another box is the one of that object.
        truth: the exact boxes of all objects that it could have found, with score 1.
        truth_instances: (M,) int64, which they are.
        evidence: (M,) float64, points on them, or pixels.
        occlusions: (M,) float64, share of them that is hidden behind something.
        chances: (M,) float64, to be found.
    """

    boxes: _Boxes
    instances: Int64Array
    duplicates: BoolArray
    truth: _Boxes
    truth_instances: Int64Array
    evidence: Float64Array
    occlusions: Float64Array
    chances: Float64Array

    @property
    def missed(self) -> Int64Array:
        """Objects that it could have found and did not."""
        missed: Int64Array = np.setdiff1d(self.truth_instances, self.instances)
        return missed


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What one frame shows."""

    stream: Stream  # of the detector, as the next two
    spec: Detector2dSpec | Detector3dSpec
    sensor_id: Identifier
    frame: int  # number of the true frame
    stated_ns: int  # its timestamp in the scene; of a sweep its reference time [ns]
    objects: Boxes3D  # boxes of the objects in it, in the world at the true time
    instances: Int64Array  # (M,) int64, which they are
    evidence: Float64Array  # (M,) float64, how many points or pixels show them
    occlusions: Float64Array  # (M,) float64, which share of them is hidden behind others, 0 in plain view to 1
    # (C, 3) float64, where a false box may be: points of the world [m], or column, row [px] and depth [m]
    clutter: Float64Array

    def generator(self, number: int) -> np.random.Generator:
        """Random numbers of the detector for one frame or object."""
        key = zlib.crc32(repr(self.sensor_id).encode()) << 32 | number
        return generator_for(self.spec.seed, self.stream, key)


@dataclass(slots=True, eq=False)
class _Draft(Generic[_Boxes]):
    """One frame before its boxes have scores; what is drawn for it is drawn in the order of these steps."""

    look: _Look  # what it shows
    generator: np.random.Generator = field(init=False)  # of the frame
    chances: Float64Array = field(init=False)  # (M,) float64, of its objects to be found
    found: int = field(init=False)  # how many are
    rows: Int64Array = field(init=False)  # (F,) int64, which they are, then those that are reported twice
    # expected false boxes by class, 0 where there is no room for them
    false_rates: Mapping[str, float] = field(init=False)
    # found boxes, duplicates and false ones, in this order, all with score 0
    report: SimulatedDetections[_Boxes] = field(init=False)

    def __post_init__(self) -> None:
        look, spec = self.look, self.look.spec
        self.generator = look.generator(look.frame)
        halves = np.array([spec.classes[label].half_evidence for label in look.objects.labels])
        self.chances = spec.misses.chances(look.evidence, look.occlusions, halves)
        found = np.flatnonzero(self.generator.random(len(self.chances)) < self.chances)
        again = found[self.generator.random(len(found)) < spec.repeated]
        self.found, self.rows = len(found), np.concatenate([found, again])
        self.false_rates = {name: own.false_rate if len(look.clutter) else 0.0 for name, own in spec.classes.items()}

    def false_labels(self) -> list[str]:
        """Draw the classes of the false boxes."""
        counts = {label: int(self.generator.poisson(rate)) for label, rate in self.false_rates.items()}
        return [label for label, count in counts.items() for _ in range(count)]

    def errors(self, false_count: int, *, columns: int) -> tuple[Int64Array, Float64Array]:
        """Draw the errors of found and false boxes, of which a part may be the same for an object in all frames.

        Returns:
            instances: (N,) int64, the object of each box, `FALSE` for none.
            normals: (N, columns) float64, each standard normal; `lasting_share` is the correlation of two frames.
        """
        instances = np.concatenate([self.look.instances[self.rows], np.full(false_count, FALSE)])
        normals, share = self.generator.standard_normal((len(instances), columns)), self.look.spec.lasting_share
        for row in np.flatnonzero(instances != FALSE) if share else ():
            own = self.look.generator(_OBJECTS | int(instances[row]))
            normals[row] = np.sqrt(1.0 - share) * normals[row] + np.sqrt(share) * own.standard_normal(columns)
        return instances, normals

    def reported(self, boxes: _Boxes, truth: _Boxes, instances: Int64Array) -> "_Draft[_Boxes]":
        """Put boxes with errors beside the exact ones."""
        numbers, look = np.arange(len(boxes)), self.look
        duplicates = (numbers >= self.found) & (numbers < len(self.rows))
        self.report = SimulatedDetections(
            boxes, instances, duplicates, truth, look.instances, look.evidence, look.occlusions, self.chances
        )
        return self


def _objects_at(street: Street, time_ns: int, labels: Collection[str]) -> tuple[Boxes3D, Int64Array]:
    """Give the exact boxes of all objects of some classes, in the world frame with score 1, and their instances."""
    every = boxes_of(street, np.array([time_ns], np.int64))
    wanted = np.array([label in labels for label in every.labels], np.bool_)
    rows = np.flatnonzero(wanted & every.present[0])
    boxes = Boxes3D(
        time_ns,
        every.centers_world[0, rows],
        every.sizes_lwh[rows],
        every.yaws[0, rows],
        np.ones(len(rows)),
        tuple(every.labels[row] for row in rows),
        velocities=every.velocities[0, rows],
        frame=PointsFrame.WORLD,
    )
    return boxes, every.instances[rows]


def _hidden_shares(seen: Float64Array, alone: Int64Array, instances: Int64Array) -> Float64Array:
    """Report which share of (N,) objects with (N,) points or pixels is hidden; they would have `alone` by instance."""
    shares: Float64Array = 1.0 - seen / np.maximum(1, alone[instances - 1])
    return np.clip(shares, 0.0, 1.0)


def _true_frame(drive: SimulatedDrive, sensor_id: Identifier, index: int) -> int:
    """Which frame of the truth a frame of the scene shows."""
    return int(drive.true_frames[sensor_id][index]) if sensor_id in drive.true_frames else index


def _is_blind(drive: SimulatedDrive, sensor_id: Identifier) -> bool:
    """Whether frames of a sensor may be empty by an injected fault."""
    wrong = drive.faults.sensors.get(sensor_id)
    return wrong is not None and bool(wrong.blind)


def _chosen(count: int, frames: Iterable[int] | None) -> list[int]:
    """The numbers of the frames to look at, all of them by default."""
    chosen = list(range(count) if frames is None else frames)
    beyond = [k for k in chosen if not 0 <= k < count]
    if beyond:
        raise OptionError(f"frame {beyond[0]}; expected 0 to {count - 1}")
    return chosen


def _with_scores(drafts: Sequence[_Draft[_Boxes]]) -> list[SimulatedDetections[_Boxes]]:
    """Give the boxes of all frames scores that are calibrated over these frames, class by class.

    False boxes of a class that has no object in any of the frames are left out: no score but 0 would be right.
    """
    if not drafts:
        return []
    spec = drafts[0].look.spec
    firsts = np.cumsum([0, *(len(draft.chances) for draft in drafts)])
    labels = np.array([label for draft in drafts for label in draft.look.objects.labels], np.str_)
    chances = np.concatenate([draft.chances for draft in drafts])
    looks: dict[str, tuple[Int64Array, LooksLike]] = {}
    for label in np.unique(labels).tolist():
        numbers = np.flatnonzero(labels == label)
        false_count = sum(draft.false_rates.get(label, 0.0) for draft in drafts)
        dealt = deal_out(chances[numbers], false_count, repeated=spec.repeated, likeness=spec.scores.likeness)
        looks[label] = numbers, dealt
    return [_scored(draft, int(first), looks) for draft, first in zip(drafts, firsts, strict=False)]


def _scored(
    draft: _Draft[_Boxes], first_number: int, looks: Mapping[str, tuple[Int64Array, LooksLike]]
) -> SimulatedDetections[_Boxes]:
    """Give the boxes of one frame scores, by the numbers of objects among those of all frames and what these look like.

    The first object of the frame has the number `first_number`.
    """
    report, spec = draft.report, draft.look.spec.scores
    number_of = {int(instance): first_number + k for k, instance in enumerate(report.truth_instances)}
    labels = np.array(report.boxes.labels, np.str_)
    true_shares = np.full(len(labels), np.nan)
    for label, (all_numbers, dealt) in looks.items():
        own, real = labels == label, report.instances != FALSE
        numbers = [number_of[int(instance)] for instance in report.instances[own & real]]
        true_shares[own & real] = dealt.true_shares[np.searchsorted(all_numbers, numbers)]
        drawn = draft.generator.random(int((own & ~real).sum()))
        like = np.searchsorted(np.cumsum(dealt.false_shares), drawn)
        true_shares[own & ~real] = dealt.true_shares[np.minimum(like, len(all_numbers) - 1)]
    kept = np.flatnonzero(np.isfinite(true_shares))
    true = (report.instances != FALSE) & ~report.duplicates
    scores = draw_scores(draft.generator, true_shares[kept], true[kept], spec)
    order = np.argsort(-scores, kind="stable")
    rows = kept[order]
    return replace(
        report,
        boxes=replace(report.boxes.select(rows), scores=scores[order], score_form=spec.form),
        instances=report.instances[rows],
        duplicates=report.duplicates[rows],
    )


_TRIES, _OVERLAP = 12, 0.2
"""So many positions are tried for a false box until it overlaps no object by more than this intersection over union."""

_SMALLEST_PX = 1.0


def detect_2d(
    drive: SimulatedDrive,
    camera_id: Identifier | None = None,
    spec: Detector2dSpec | None = None,
    *,
    frames: Iterable[int] | None = None,
) -> list[SimulatedDetections[Boxes2D]]:
    """Detect objects in the images of a camera, as the sensor got them: injected faults are in the answer.

    Args:
        drive: whose images.
        camera_id: by default the first camera.
        spec: the detector.
        frames: numbers of images of the scene, by default all. Errors of an image do not depend on the others,
            scores do, since they are calibrated over the images that are asked for.

    Returns:
        One report per image.

    Raises:
        OptionError: there is no such camera or image.
    """
    spec = spec or Detector2dSpec()
    if camera_id is None and not drive.scene.cameras:
        raise OptionError(f"{drive.scene.source}: has no camera")
    camera = drive.scene.cameras[0] if camera_id is None else drive.scene.sensor(camera_id)
    if not isinstance(camera, CameraSensor):
        raise OptionError(f"sensor {camera_id!r} is of type {camera.type}; expected a camera")
    chosen = _chosen(len(camera.images), frames)
    return _with_scores([_image_draft(drive, spec, camera, index) for index in chosen])


@dataclass(frozen=True, slots=True, eq=False)
class _ImageLook(_Look):
    """What one image shows."""

    corners_xyxy: Float64Array  # (M, 4) float64 [px], where the objects are in the image
    camera_model: Camera


def _look_at_image(drive: SimulatedDrive, spec: Detector2dSpec, camera: CameraSensor, index: int) -> _ImageLook:
    truth, number = drive.truth, _true_frame(drive, camera.id, index)
    rendered = truth.cameras[str(camera.id)]
    time_ns, camera_model = int(rendered.timestamps_ns[number]), rendered.spec.camera
    objects, instances = _objects_at(truth.street, time_ns, spec.classes)
    image = rendered.truth(number)
    black = _is_blind(drive, camera.id) and not camera.images[index].rgb.any()
    shown = np.full_like(image.instances, -1) if black else image.instances
    seen, extents, pixels = _extents(shown, instances)
    objects, instances = objects.select(seen), instances[seen]
    if spec.amodal:
        extents = _projected_boxes(_LineViews.of(rendered, number, instances), extents)
    return _ImageLook(
        Stream.DETECTIONS_2D,
        spec,
        camera.id,
        number,
        int(camera.images.timestamps_ns[index]),
        objects,
        instances,
        pixels,
        _hidden_shares(pixels, rendered.silhouettes(number), instances),
        _clutter(image, shown, instances, rendered.pose(number), camera_model),
        extents,
        camera_model,
    )


def _extents(shown: AnyArray, instances: Int64Array) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Which of some instances an image shows, and the edges (M, 4) and number (M,) of their pixels."""
    rows, columns = np.nonzero(np.isin(shown, instances))
    met, which = np.unique(shown[rows, columns], return_inverse=True)
    edges = np.empty((len(met), 4))
    edges[:, :2], edges[:, 2:] = np.inf, -np.inf
    for axis, pixels in enumerate((columns, rows)):
        np.minimum.at(edges[:, axis], which, pixels)
        np.maximum.at(edges[:, axis + 2], which, pixels + 1)
    seen = np.flatnonzero(np.isin(instances, met))
    own = np.searchsorted(met, instances[seen])
    return seen, edges[own], np.bincount(which, minlength=len(met)).astype(np.float64)[own]


def _clutter(
    image: ImageTruth, shown: AnyArray, instances: Int64Array, world_from_camera: RigidTransform, camera_model: Camera
) -> Float64Array:
    """Some of the pixels that show other things than the objects at their height: column, row, depth, (C, 3)."""
    other = (shown > 0) & ~np.isin(shown, instances) & (image.depths < _FALSE_WITHIN)
    rows, columns = (pixels[:: max(1, int(other.sum()) // 4000)] for pixels in np.nonzero(other))
    depths = image.depths[rows, columns].astype(np.float64)
    rays = unproject(camera_model, np.column_stack([columns, rows]))
    heights = world_from_camera.apply(rays * (depths / rays[:, 2])[:, None])[:, 2]
    low = (heights > _FALSE_HEIGHTS[0]) & (heights < _FALSE_HEIGHTS[1])
    return np.column_stack([columns[low], rows[low], depths[low]])


def _image_draft(drive: SimulatedDrive, spec: Detector2dSpec, camera: CameraSensor, index: int) -> _Draft[Boxes2D]:
    """Everything about an image but the scores."""
    look = _look_at_image(drive, spec, camera, index)
    draft: _Draft[Boxes2D] = _Draft(look)
    labels = look.objects.labels
    false, false_labels = _false_boxes_in_image(draft, spec, look)
    whose, normals = draft.errors(len(false), columns=4)
    exact = np.concatenate([look.corners_xyxy[draft.rows], false])
    boxes = Boxes2D(
        look.stated_ns,
        _with_errors_in_image(spec, look.camera_model, exact, normals),
        np.zeros(len(whose)),
        (*(labels[k] for k in draft.rows), *false_labels),
        sensor_id=camera.id,
    )
    ones = np.ones(len(labels))
    truth = Boxes2D(look.objects.timestamp_ns, look.corners_xyxy, ones, labels, sensor_id=camera.id)
    return draft.reported(boxes, truth, whose)


def _with_errors_in_image(
    spec: Detector2dSpec, camera_model: Camera, exact: Float64Array, normals: Float64Array
) -> Float64Array:
    """Exact boxes (N, 4) with errors out of standard normal numbers: in the image, and no smaller than a pixel."""
    sizes = exact[:, 2:] - exact[:, :2]
    sigmas = spec.corner_sigma_px + spec.corner_sigma_share * np.tile(sizes, 2)
    edges = _within_image(exact + sigmas * normals, camera_model)
    low, high = np.minimum(edges[:, :2], edges[:, 2:]), np.maximum(edges[:, :2], edges[:, 2:])
    low = np.minimum(low, np.array([camera_model.width, camera_model.height]) - _SMALLEST_PX)
    return np.column_stack([low, np.maximum(high, low + _SMALLEST_PX)])


def _false_boxes_in_image(
    draft: _Draft[Boxes2D], spec: Detector2dSpec, look: _ImageLook
) -> tuple[Float64Array, list[str]]:
    """Boxes as large as an object of their class would be, around pixels that show something else."""
    labels, generator = draft.false_labels(), draft.generator
    boxes = np.empty((len(labels), 4))
    for k, label in enumerate(labels):
        length, width, height = spec.classes[label].size_lwh
        for _ in range(_TRIES):
            column, row, depth = look.clutter[generator.integers(len(look.clutter))]
            half = look.camera_model.fx / depth * generator.uniform(width, max(width, length)) / 2
            tall = look.camera_model.fy / depth * height * np.exp(0.1 * generator.standard_normal()) / 2
            edges = np.array([[column - half, row - tall, column + half, row + tall]]) + 0.5
            boxes[k] = _within_image(edges, look.camera_model)[0]
            if _overlaps(boxes[k], look.corners_xyxy).max(initial=0.0) < _OVERLAP:
                break
    return boxes, labels


def _overlaps(box: Float64Array, others: Float64Array) -> Float64Array:
    """Intersection over union of a box with others, (N,)."""
    shared = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    shared_area = np.maximum(0.0, shared).prod(axis=1)
    areas = (others[:, 2:] - others[:, :2]).prod(axis=1) + (box[2:] - box[:2]).prod()
    overlaps: Float64Array = shared_area / np.maximum(1e-9, areas - shared_area)
    return overlaps


_CLEAR = 2.5  # how far from the middle of any object of the classes they are begun [m], beside its half diagonal
_REACH_NS = 10**9


def detect_3d(
    drive: SimulatedDrive,
    spec: Detector3dSpec | None = None,
    *,
    lidar_id: Identifier | None = None,
    frames: Iterable[int] | None = None,
    boxes_frame: PointsFrame = PointsFrame.SENSOR,
) -> list[SimulatedDetections[Boxes3D]]:
    """Detect objects in the sweeps of a lidar, as the sensor got them: injected faults are in the answer.

    Boxes are of the sweep's reference time, in the lidar's frame at that time, by the timestamps of the scene. Boxes in
    the ego's or the world's frame are placed by what the scene states about mounting and poses.

    Args:
        drive: whose sweeps.
        spec: the detector.
        lidar_id: by default the first lidar.
        frames: numbers of sweeps of the scene, by default all. Errors of a sweep do not depend on the others, scores
            do, since they are calibrated over the sweeps that are asked for.
        boxes_frame: the frame of the boxes.

    Returns:
        One report per sweep.

    Raises:
        OptionError: there is no such lidar or sweep.
        PoseError: the scene does not state what the frame of the boxes needs.
    """
    spec = spec or Detector3dSpec()
    lidar = drive.scene.lidars[0] if lidar_id is None else drive.scene.sensor(lidar_id)
    if not isinstance(lidar, LidarSensor):
        raise OptionError(f"sensor {lidar_id!r} is of type {lidar.type}; expected a lidar")
    chosen = _chosen(len(lidar.frames), frames)
    return _with_scores([_sweep_draft(drive, spec, lidar, index, boxes_frame) for index in chosen])


@dataclass(frozen=True, slots=True, eq=False)
class _SweepLook(_Look):
    """What one sweep shows."""

    world_from_ego: RigidTransform  # true pose at its reference time
    world_from_lidar: RigidTransform  # true pose at its reference time
    points_world: Float64Array  # (N, 3) float64 [m], all points

    def placed(self, boxes: Boxes3D, frame: PointsFrame) -> Boxes3D:
        """True boxes of the world in a frame, exactly."""
        if frame is PointsFrame.WORLD:
            return boxes
        body = self.world_from_lidar if frame is PointsFrame.SENSOR else self.world_from_ego
        return boxes.moved(body.inverse(), frame)


def _look_at_sweep(drive: SimulatedDrive, spec: Detector3dSpec, lidar: LidarSensor, index: int) -> _SweepLook:
    number = _true_frame(drive, lidar.id, index)
    device = drive.truth.lidars[str(lidar.id)]
    sweep = device.sweep(number)
    time_ns = sweep.frame.reference_ns
    ego = drive.truth.path.at(np.array([time_ns], np.int64))
    world_from_ego = RigidTransform(ego.rotations[0], ego.positions[0])
    objects, instances = _objects_at(drive.truth.street, time_ns, spec.classes)
    empty = _is_blind(drive, lidar.id) and len(lidar.frames[index].points) == 0
    rows = np.arange(0 if empty else len(sweep.instances))
    met, counts = np.unique(sweep.instances[rows], return_counts=True)
    seen = np.isin(instances, met)
    instances_seen = instances[seen]
    points = counts[np.searchsorted(met, instances_seen)].astype(np.float64)
    arrived = points / max(1e-9, 1.0 - device.spec.drop_rate)
    other = rows[(sweep.instances[rows] > 0) & ~np.isin(sweep.instances[rows], instances)]
    return _SweepLook(
        Stream.DETECTIONS_3D,
        spec,
        lidar.id,
        number,
        int(lidar.frames.timestamps_ns[index]) + time_ns - sweep.frame.timestamp_ns,
        objects.select(seen),
        instances_seen,
        points,
        _hidden_shares(arrived, device.silhouettes(number), instances_seen),
        _clear(sweep.points_world[other[sweep.ranges[other] < _FALSE_WITHIN]], objects),
        world_from_ego,
        world_from_ego @ device.spec.mount,
        sweep.points_world[rows],
    )


def _clear(points_world: Float64Array, objects: Boxes3D) -> Float64Array:
    """Some hundred of the points at most: at the height of objects, but away from them."""
    low = points_world[(points_world[:, 2] > _FALSE_HEIGHTS[0]) & (points_world[:, 2] < _FALSE_HEIGHTS[1])]
    some = low[:: max(1, len(low) // 500)]
    apart = some[:, None, :2] - objects.centers[:, :2]
    room = _CLEAR + np.linalg.norm(objects.sizes_lwh[:, :2], axis=1) / 2
    clear: Float64Array = some[((apart**2).sum(axis=2) > room**2).all(axis=1)]
    return clear


def _sweep_draft(
    drive: SimulatedDrive, spec: Detector3dSpec, lidar: LidarSensor, index: int, boxes_frame: PointsFrame
) -> _Draft[Boxes3D]:
    """Everything about a sweep but the scores."""
    look = _look_at_sweep(drive, spec, lidar, index)
    draft: _Draft[Boxes3D] = _Draft(look)
    false, false_points = _false_boxes_in_space(draft, spec, look)
    found = look.objects.select(draft.rows)
    names = ("centers", "sizes_lwh", "yaws", "scores", "velocities")
    both: dict[str, Any] = {name: np.concatenate([getattr(found, name), getattr(false, name)]) for name in names}
    exact = replace(found, **both, labels=found.labels + false.labels)
    points = np.concatenate([look.evidence[draft.rows], false_points])
    whose, normals = draft.errors(len(false), columns=7)
    boxes = _with_errors_in_space(draft.generator, spec, look, exact, points, normals)
    stated = _stated(drive, look, boxes, lidar, boxes_frame)
    return draft.reported(stated, look.placed(look.objects, boxes_frame), whose)


def _false_boxes_in_space(
    draft: _Draft[Boxes3D], spec: Detector3dSpec, look: _SweepLook
) -> tuple[Boxes3D, Float64Array]:
    """Boxes around returns of something else, world frame, and about how many points are in each."""
    labels, generator = tuple(draft.false_labels()), draft.generator
    count = len(labels)
    sizes = np.array([spec.classes[label].size_lwh for label in labels]).reshape(-1, 3)
    sizes = sizes * np.exp(0.1 * generator.standard_normal((count, 3)))
    begun = look.clutter[generator.integers(max(1, len(look.clutter)), size=count)]
    away = begun[:, :2] - look.world_from_lidar.translation[:2]
    away = away / np.maximum(1e-9, np.linalg.norm(away, axis=1))[:, None]
    middles = begun[:, :2] + away * sizes[:, 1:2] / 2
    boxes = Boxes3D(
        look.objects.timestamp_ns,
        np.column_stack([middles, sizes[:, 2] / 2]),
        sizes,
        generator.uniform(-np.pi, np.pi, count),
        np.zeros(count),
        labels,
        velocities=np.zeros((count, 3)),
        frame=PointsFrame.WORLD,
    )
    apart = np.linalg.norm(look.points_world[None, :, :2] - middles[:, None], axis=2)
    return boxes, (apart < sizes[:, 1:2]).sum(axis=1).astype(np.float64)


def _with_errors_in_space(
    generator: np.random.Generator,
    spec: Detector3dSpec,
    look: _SweepLook,
    exact: Boxes3D,
    points: Float64Array,
    normals: Float64Array,
) -> Boxes3D:
    """Exact boxes of the world with the detector's errors, which grow out of standard normal numbers (N, 7)."""
    count = len(exact)
    ranges = np.linalg.norm(exact.centers - look.world_from_lidar.translation, axis=1)
    sigmas = np.array([*spec.center_sigmas, *spec.size_sigmas, np.radians(spec.yaw_sigma_deg)])
    sigmas = sigmas * spec.growth(ranges, points)[:, None]
    errors = sigmas * normals
    flips = np.pi * (generator.random(count) < spec.flip_share)
    rotations = np.tile(np.eye(3), (count, 1, 1))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(exact.yaws)
    rotations[:, 1, 0] = np.sin(exact.yaws)
    rotations[:, 0, 1] = -rotations[:, 1, 0]
    covariances = None
    if spec.covariances:
        rotation = np.tile(np.eye(7), (count, 1, 1))
        rotation[:, :3, :3] = rotations
        covariances = rotation * sigmas[:, None] ** 2 @ rotation.transpose(0, 2, 1)
    velocities = None
    if spec.velocity_sigma is not None and exact.velocities is not None:
        level = generator.standard_normal((count, 3)) * [1.0, 1.0, 0.0]
        velocities = exact.velocities + spec.velocity_sigma * level
    return replace(
        exact,
        centers=exact.centers + np.einsum("nij,nj->ni", rotations, errors[:, :3]),
        sizes_lwh=np.maximum(exact.sizes_lwh / 5, exact.sizes_lwh + errors[:, 3:6]),
        yaws=exact.yaws + errors[:, 6] + flips,
        scores=np.zeros(count),
        velocities=velocities,
        covariances=covariances,
    )


def _stated(drive: SimulatedDrive, look: _SweepLook, boxes: Boxes3D, lidar: LidarSensor, frame: PointsFrame) -> Boxes3D:
    """Boxes of the world as a system that trusts the scene has them: by its timestamps, mounting and poses."""
    own = boxes.moved(look.world_from_lidar.inverse(), PointsFrame.SENSOR)
    own = replace(own, timestamp_ns=look.stated_ns, sensor_id=lidar.id)
    if frame is PointsFrame.SENSOR:
        return own
    if frame is PointsFrame.EGO:
        if lidar.mount is None:
            raise PoseError(f"{drive.scene.source}: the scene does not state how {lidar.id!r} is mounted")
        return own.moved(lidar.mount, frame)
    pose = sensor_source(drive.scene, lidar, None, reach_ns=_REACH_NS).at(np.array([look.stated_ns], np.int64))
    return own.moved(RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0]), frame)


_NEAREST_AHEAD = 0.05  # of a box beside the camera, what lies farther ahead than this is projected [m]
_ALONG_EDGES = 25  # points on each edge of a projected box: camera models bend edges


@dataclass(frozen=True, slots=True, eq=False)
class _LineViews:
    """Where a camera and the boxes of some objects are when each line of an image is taken."""

    camera_model: Camera
    left_to_right: bool  # whether the lines are columns, not rows
    rotations: Float64Array  # (L, 3, 3), of `world_from_camera` at each line's time
    origins: Float64Array  # (L, 3) float64 [m], of the same
    centers_world: Float64Array  # (L, M, 3) float64 [m]
    yaws: Float64Array  # (L, M) float64 [rad], counter-clockwise from the world's x
    sizes_lwh: Float64Array  # (M, 3) float64 [m]

    @classmethod
    def of(cls, camera: RenderedCamera, k: int, instances: Int64Array) -> "_LineViews":
        """See objects (M,) by their instance numbers in image k."""
        boxes = boxes_of(camera.street, camera.line_times_ns(k))
        rows = np.searchsorted(boxes.instances, instances)
        return cls(
            camera.spec.camera,
            camera.spec.left_to_right,
            *camera.line_poses(k),
            boxes.centers_world[:, rows],
            boxes.yaws[:, rows],
            boxes.sizes_lwh[rows],
        )

    def in_camera(self, which: int, lines: Int64Array, points_box: Float64Array) -> Float64Array:
        """Take points (N, 3) that are fixed to a box, from its middle and along its axes, to the lines' cameras."""
        rotated = _about_z(points_box, self.yaws[lines, which])
        from_camera = rotated + self.centers_world[lines, which] - self.origins[lines]
        points: Float64Array = np.einsum("nji,nj->ni", self.rotations[lines], from_camera)
        return points

    def on_box(self, which: int, lines: Int64Array, points_camera: Float64Array) -> Float64Array:
        """Take points (N, 3) of the lines' cameras to a box: the inverse of `in_camera`."""
        from_camera = np.einsum("nij,nj->ni", self.rotations[lines], points_camera)
        apart = from_camera + self.origins[lines] - self.centers_world[lines, which]
        return _about_z(apart, -self.yaws[lines, which])

    def lines_at(self, pixels: Float64Array) -> Int64Array:
        """The lines in which finite pixels (N, 2) lie, the first or last for those outside."""
        last = len(self.origins) - 1
        return np.clip(np.rint(pixels[:, 0 if self.left_to_right else 1]), 0, last).astype(np.int64)


def _projected_boxes(views: _LineViews, extents: Float64Array) -> Float64Array:
    """Edges (M, 4) of the projected boxes, clipped to the image; of a box out of the camera model, what is seen of it.

    Args:
        extents: (M, 4) float64 [px], edges of what is seen of each.
    """
    boxes = extents.copy()
    for which in range(len(boxes)):
        pixels = _outline_of(views, which) + 0.5
        if len(pixels):
            boxes[which] = *pixels.min(axis=0), *pixels.max(axis=0)
    return _within_image(boxes, views.camera_model)


def _within_image(boxes: Float64Array, camera_model: Camera) -> Float64Array:
    """Boxes (M, 4) [px] cut off at the edges of the image."""
    size = np.array([camera_model.width, camera_model.height] * 2, np.float64)
    cut: Float64Array = np.clip(boxes, 0.0, size)
    return cut


def _outline_of(views: _LineViews, which: int) -> Float64Array:
    """Pixels (N, 2) of points on the edges of a box, each as seen by the line that it falls on."""
    middle = len(views.origins) // 2
    corners = CORNER_SIGNS * views.sizes_lwh[which] / 2
    starts, stops = _parts_ahead(views.in_camera(which, np.full(len(corners), middle), corners))
    steps = np.linspace(0.0, 1.0, _ALONG_EDGES)[:, None, None]
    along = (starts + steps * (stops - starts)).reshape(-1, 3)
    lines = np.full(len(along), middle)
    on_box = views.on_box(which, lines, along)
    for _ in range(LINE_ROUNDS if len(views.origins) > 1 else 1):
        pixels = project_unbounded(views.camera_model, views.in_camera(which, lines, on_box))
        finite = np.isfinite(pixels).all(axis=1)
        lines, on_box, pixels = views.lines_at(pixels[finite]), on_box[finite], pixels[finite]
    return pixels


def _about_z(points: Float64Array, angles: Float64Array) -> Float64Array:
    """Points (N, 3) rotated about the z axis by (N,) angles [rad]."""
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y, z = points.T
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, z])


def _parts_ahead(corners: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The parts of a box's edges that lie ahead of the camera: where they start and stop, (E, 3) each."""
    first, last = np.array(EDGES).T
    deeper = corners[first, 2] > corners[last, 2]
    near, far = (corners[np.where(deeper, a, b)] for a, b in ((last, first), (first, last)))
    reaching = far[:, 2] > _NEAREST_AHEAD
    near, far = near[reaching], far[reaching]
    share = np.clip((_NEAREST_AHEAD - near[:, 2]) / np.maximum(1e-12, far[:, 2] - near[:, 2]), 0.0, 1.0)[:, None]
    return near + share * (far - near), far
