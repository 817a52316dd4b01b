"""Which objects count: KITTI's rules for tracking and detection."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import ArrayError, OptionError
from sceneloom.evaluate.objects import FramePairs, ObjectTable, Similarity, covered_by, similarities
from sceneloom.kernels import scores
from sceneloom.kernels import scores as kernels_scores

_EPSILON = float(np.finfo(np.float64).eps)
"""What thresholds are wider by, as in TrackEval."""

_NEIGHBOURS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"car": ("van",), "pedestrian": ("person", "person_sitting")}
)
"""Classes whose objects may be found or not: who looks for the first may take them for it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingRules:
    """What counts, of results and of the truth; the defaults are those of KITTI's tracking benchmark.

    Attributes:
        similarity: what says how alike two boxes are.
        least_similarity: pairs from which CLEAR, identities and the ignoring of boxes take two boxes for one object.
        neighbours: by class, the classes whose objects neither count nor make a found one false.
        most_occlusion, most_truncation: objects of the truth beyond them neither count nor make a found one false.
        least_height_px: found boxes without a true one that are not higher in the image do not count [px].
        regions: class of the truth whose boxes are regions in which found boxes without a true one do not count.
        most_in_region: share of a found box from which it lies in a region.
    """

    similarity: Similarity = Similarity.IMAGE
    least_similarity: float = 0.5
    neighbours: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: _NEIGHBOURS)
    most_occlusion: float = 2.0
    most_truncation: float = 0.0
    least_height_px: float = 25.0
    regions: str = "DontCare"
    most_in_region: float = 0.5


KITTI_RULES = TrackingRules()
"""Those of KITTI's 2D tracking benchmark, as TrackEval's `kitti_2d_box` applies them."""


@dataclass(frozen=True, slots=True, eq=False)
class ScoredSequence:
    """What counts of one sequence, for one class.

    Attributes:
        pairs: of the objects that count.
        similarities: (P,) float64, of the pairs.
        true_ids, found_ids: (T,) and (E,) int64, of the objects in order of frames, from 0 without gaps.
        true_count, found_count: how many ids there are.
    """

    pairs: FramePairs
    similarities: Float64Array
    true_ids: Int64Array
    found_ids: Int64Array
    true_count: int
    found_count: int

    @property
    def is_empty(self) -> bool:
        """Whether one side has nothing, so that nothing can be paired."""
        return not (len(self.true_ids) and len(self.found_ids))


def apply_rules(
    found: ObjectTable,
    truth: ObjectTable,
    label: str,
    *,
    rules: TrackingRules = KITTI_RULES,
    frame_count: int | None = None,
) -> ScoredSequence:
    """Take what counts of one sequence for one class.

    Found objects that are most like a true one which does not count (hidden, cut off, of a neighbouring class) do not
    count either; nor do those without a true one that are small or in a region.

    Args:
        frame_count: of the sequence. [default: up to the last frame in which there is an object]

    Raises:
        ArrayError: an id comes twice in a frame, or a frame is beyond the sequence.
        OptionError: one side lacks the boxes that `rules.similarity` needs.

    Source: Geiger et al. 2012; Luiten et al., TrackEval, `Kitti2DBox.get_preprocessed_seq_data`.
    """
    truth, found = truth.in_order(), found.in_order()
    frame_count = _frame_count(truth, found, frame_count)
    regions = truth.select(truth.are(rules.regions))
    own = truth.are(label)
    wanted = (own | truth.are(*rules.neighbours.get(label.lower(), ()))) & (truth.ids >= 0)
    truth, counts = truth.select(wanted), (own & ~_is_hidden(truth, rules))[wanted]
    found = found.select(found.are(label) & (found.ids >= 0))
    for side, objects in (("truth", truth), ("results", found)):
        _check_ids(objects, side)
    pairs = FramePairs.of(truth.frame_starts(frame_count), found.frame_starts(frame_count))
    alike = similarities(truth, found, pairs, rules.similarity)
    of_found, _ = scores.most_similar_pairs(alike, *pairs.locations, rules.least_similarity)
    kept = ~_may_be_missing(found, regions, frame_count, rules)
    kept[of_found >= 0] = counts[of_found[of_found >= 0]]
    return _scored(truth, found, pairs, alike, counts, kept)


def _frame_count(truth: ObjectTable, found: ObjectTable, frame_count: int | None) -> int:
    last = [int(objects.frames[-1]) if len(objects) else -1 for objects in (truth, found)]
    if frame_count is None:
        return max(last) + 1
    for side, frame in zip(("truth", "results"), last, strict=True):
        if frame >= frame_count:
            raise ArrayError(f"{side}: frame {frame}; the sequence has {frame_count} frames, from 0")
    return frame_count


def _check_ids(objects: ObjectTable, side: str) -> None:
    """Refuse an object that is in two locations at once."""
    order = np.lexsort((objects.ids, objects.frames))
    frames, ids = objects.frames[order], objects.ids[order]
    twice = np.flatnonzero((frames[1:] == frames[:-1]) & (ids[1:] == ids[:-1]))
    if len(twice):
        k = int(twice[0])
        raise ArrayError(
            f"{side}: frame {frames[k]}: two boxes of {objects.labels[int(order[k])]} with id {ids[k]}; expected one"
        )


def _is_hidden(truth: ObjectTable, rules: TrackingRules) -> BoolArray:
    hidden = np.zeros(len(truth), np.bool_)
    if truth.occlusions is not None:
        hidden |= truth.occlusions > rules.most_occlusion
    if truth.truncations is not None:
        hidden |= truth.truncations > rules.most_truncation
    return hidden


def _may_be_missing(
    found: ObjectTable, regions: ObjectTable, frame_count: int, rules: TrackingRules
) -> BoolArray:
    """Report which found objects would be nothing wrong if no true one is where they are."""
    small = np.zeros(len(found), np.bool_)
    if found.corners_xyxy is None:
        return small
    small |= found.corners_xyxy[:, 3] - found.corners_xyxy[:, 1] <= rules.least_height_px + _EPSILON
    if regions.corners_xyxy is None or not len(regions):
        return small
    pairs = FramePairs.of(regions.frame_starts(frame_count), found.frame_starts(frame_count))
    shares = covered_by(found, regions.corners_xyxy, pairs)
    return small | scores.reached_columns(shares, *pairs.locations, rules.most_in_region + _EPSILON)


def _scored(
    truth: ObjectTable,
    found: ObjectTable,
    pairs: FramePairs,
    alike: Float64Array,
    true_kept: BoolArray,
    found_kept: BoolArray,
) -> ScoredSequence:
    left = scores.kept_pairs(alike, *pairs.locations, true_kept, found_kept)
    true_names, true_ids = np.unique(truth.ids[true_kept], return_inverse=True)
    found_names, found_ids = np.unique(found.ids[found_kept], return_inverse=True)
    starts = [
        np.concatenate([[0], np.cumsum(kept)])[old].astype(np.int64)
        for kept, old in ((true_kept, pairs.true_starts), (found_kept, pairs.found_starts))
    ]
    return ScoredSequence(
        FramePairs.of(*starts),
        left,
        true_ids.astype(np.int64),
        found_ids.astype(np.int64),
        len(true_names),
        len(found_names),
    )


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

_LEAST_OVERLAPS: Mapping[str, float] = MappingProxyType({"car": 0.7, "pedestrian": 0.5, "cyclist": 0.5})
"""KITTI's overlaps, by class, from which a detection has found an object; other classes have `_OTHER_OVERLAP`."""

_OTHER_OVERLAP = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionRules:
    """What counts, of detections and of the truth; the defaults are those of KITTI's object benchmark in 3D.

    Attributes:
        similarity: what says how much two boxes overlap.
        least_overlap: what pairs must exceed. [default: that of `_LEAST_OVERLAPS`]
        neighbours: by class, the classes whose objects neither count nor make a detection wrong.
        regions: class of the truth whose boxes in the image are regions in which detections are not wrong.
        regions_in_space: whether regions count also where boxes in space are compared, by the detections' boxes in the
            image; KITTI has them count in the image only.
    """

    similarity: Similarity = Similarity.SPACE
    least_overlap: float | None = None
    neighbours: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: _NEIGHBOURS)
    regions: str = "DontCare"
    regions_in_space: bool = False

    def overlap_of(self, label: str) -> float:
        """What pairs of a class must exceed."""
        if self.least_overlap is not None:
            return self.least_overlap
        return _LEAST_OVERLAPS.get(label.lower(), _OTHER_OVERLAP)


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
    return kernels_scores.reached_columns(shares, *pairs.locations, least if in_image else _OTHER_OVERLAP)


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
