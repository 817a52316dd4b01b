"""Which objects and detections count: KITTI's difficulties, neighbouring classes and regions."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.errors import OptionError
from sceneloom.evaluate.objects import ObjectTable
from sceneloom.evaluate.overlaps import FramePairs, Similarity, covered_by, similarities
from sceneloom.evaluate.tracking.protocol import NEIGHBOURS
from sceneloom.kernels import track_scores


@dataclass(frozen=True, slots=True, kw_only=True)
class Difficulty:
    """Which true objects must be found.

    Attributes:
        least_height_px: those not higher in the image need not be found, and lower detections do not count [px].
        most_occlusion: those more hidden need not be found.
        most_truncation: nor those of which more is outside the image.
    """

    least_height_px: float
    most_occlusion: float
    most_truncation: float


DIFFICULTIES: Mapping[str, Difficulty] = MappingProxyType(
    {
        "easy": Difficulty(least_height_px=40, most_occlusion=0, most_truncation=0.15),
        "moderate": Difficulty(least_height_px=25, most_occlusion=1, most_truncation=0.3),
        "hard": Difficulty(least_height_px=25, most_occlusion=2, most_truncation=0.5),
        "all": Difficulty(least_height_px=-np.inf, most_occlusion=np.inf, most_truncation=np.inf),
    }
)
"""KITTI's three, and one in which every object must be found."""

LEAST_OVERLAPS: Mapping[str, float] = MappingProxyType({"car": 0.7, "pedestrian": 0.5, "cyclist": 0.5})
"""KITTI's overlaps, by class, from which a detection has found an object; other classes have `OTHER_OVERLAP`."""

OTHER_OVERLAP = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionRules:
    """What counts, of detections and of the truth; the defaults are those of KITTI's object benchmark in 3D.

    Attributes:
        similarity: what says how much two boxes overlap.
        least_overlap: what pairs must exceed. [default: that of `LEAST_OVERLAPS`]
        neighbours: by class, the classes whose objects neither count nor make a detection wrong.
        regions: class of the truth whose boxes in the image are regions in which detections are not wrong.
        regions_in_space: whether regions count also where boxes in space are compared, by the detections' boxes in the
            image; KITTI has them count in the image only.
    """

    similarity: Similarity = Similarity.SPACE
    least_overlap: float | None = None
    neighbours: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: NEIGHBOURS)
    regions: str = "DontCare"
    regions_in_space: bool = False

    def overlap_of(self, label: str) -> float:
        """What pairs of a class must exceed."""
        if self.least_overlap is not None:
            return self.least_overlap
        return LEAST_OVERLAPS.get(label.lower(), OTHER_OVERLAP)


@dataclass(frozen=True, slots=True, eq=False)
class ScoredDetections:
    """The true objects and the detections of one class, of all sequences, and what counts of them.

    Attributes:
        truth, found: in order of frames, those of neighbouring classes among the true ones.
        frame_starts: of the pairs.
        overlaps: (P,) float64, of the pairs.
        least_overlap: what pairs must exceed.
        true_ignored, found_ignored, excused: as `detection_scores.score_steps` takes them.
    """

    truth: ObjectTable
    found: ObjectTable
    pairs: FramePairs
    overlaps: Float64Array
    least_overlap: float
    true_ignored: BoolArray
    found_ignored: BoolArray
    excused: BoolArray

    @property
    def scores(self) -> Float64Array:
        """(N,) float64, of the detections."""
        scores = self.found.scores
        return np.zeros(0) if scores is None else np.require(scores, requirements=["C", "W"])


def pair_detections(
    found: Mapping[str, ObjectTable], truth: Mapping[str, ObjectTable], label: str, *, rules: DetectionRules
) -> ScoredDetections:
    """Take the objects and the detections of one class, and pair those of each frame.

    Every true object must be found and every detection counts until `at_difficulty` says otherwise.

    Raises:
        OptionError: detections have no scores, or one side lacks the boxes that `rules.similarity` needs.
    """
    truth_all, found_all = _joined(truth, found)
    regions = truth_all.select(truth_all.are(rules.regions))
    own = truth_all.are(label)
    wanted = own | truth_all.are(*rules.neighbours.get(label.lower(), ()))
    objects, others = truth_all.select(wanted), ~own[wanted]
    detections = found_all.select(found_all.are(label))
    if detections.scores is None and len(detections):
        raise OptionError("the results have no scores, by which detections are put in order")
    frames = 1 + max((int(t.frames[-1]) for t in (objects, detections, regions) if len(t)), default=-1)
    pairs = FramePairs.of(objects.frame_starts(frames), detections.frame_starts(frames))
    overlaps = similarities(objects, detections, pairs, rules.similarity) if pairs.starts[-1] else np.zeros(0)
    return ScoredDetections(
        objects,
        detections,
        pairs,
        overlaps,
        rules.overlap_of(label),
        others,
        np.zeros(len(detections), np.bool_),
        _excused(detections, regions, frames, rules, rules.overlap_of(label)),
    )


def at_difficulty(detections: ScoredDetections, difficulty: Difficulty) -> ScoredDetections:
    """Let only those objects count that are large and plain enough, and only detections that are high enough."""
    truth, found = detections.truth, detections.found
    true_ignored, found_ignored = detections.true_ignored.copy(), detections.found_ignored.copy()
    if truth.corners_xyxy is not None:
        heights = truth.corners_xyxy[:, 3] - truth.corners_xyxy[:, 1]
        true_ignored |= heights <= difficulty.least_height_px
    if truth.occlusions is not None:
        true_ignored |= truth.occlusions > difficulty.most_occlusion
    if truth.truncations is not None:
        true_ignored |= truth.truncations > difficulty.most_truncation
    if found.corners_xyxy is not None:
        heights = found.corners_xyxy[:, 3] - found.corners_xyxy[:, 1]
        found_ignored |= heights < difficulty.least_height_px
    return replace(detections, true_ignored=true_ignored, found_ignored=found_ignored)


def _excused(
    found: ObjectTable, regions: ObjectTable, frames: int, rules: DetectionRules, least: float
) -> BoolArray:
    in_image = rules.similarity is Similarity.IMAGE
    counts = in_image or rules.regions_in_space
    if not counts or not len(regions) or regions.corners_xyxy is None or found.corners_xyxy is None:
        return np.zeros(len(found), np.bool_)
    pairs = FramePairs.of(regions.frame_starts(frames), found.frame_starts(frames))
    shares = covered_by(found, regions.corners_xyxy, pairs)
    # a box in space is no image's box, whose own overlap would state when it is in a region
    return track_scores.reached_columns(shares, *pairs.locations, least if in_image else OTHER_OVERLAP)


def _joined(
    truth: Mapping[str, ObjectTable], found: Mapping[str, ObjectTable]
) -> tuple[ObjectTable, ObjectTable]:
    """Put the sequences behind one another, with frames that go on counting."""
    first, shifts = 0, {}
    for name in sorted(truth):
        shifts[name] = first
        first += 1 + max((int(s[name].frames.max()) for s in (truth, found) if len(s[name])), default=-1)
    return tuple(  # type: ignore[return-value]
        ObjectTable.joined([side[name].moved(shifts[name]).in_order() for name in sorted(truth)])
        for side in (truth, found)
    )
