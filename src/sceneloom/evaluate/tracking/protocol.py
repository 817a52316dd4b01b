"""Which objects of a sequence count: KITTI's rules for boxes that are hidden, cut off, small or of a similar class."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import ArrayError
from sceneloom.evaluate.objects import ObjectTable
from sceneloom.evaluate.overlaps import FramePairs, Similarity, covered_by, similarities
from sceneloom.kernels import track_scores

_EPSILON = float(np.finfo(np.float64).eps)
"""What thresholds are wider by, as in TrackEval."""

NEIGHBOURS: Mapping[str, tuple[str, ...]] = MappingProxyType(
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
    neighbours: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: NEIGHBOURS)
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
    of_found, _ = track_scores.most_similar_pairs(alike, *pairs.locations, rules.least_similarity)
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
    return small | track_scores.reached_columns(shares, *pairs.locations, rules.most_in_region + _EPSILON)


def _scored(
    truth: ObjectTable,
    found: ObjectTable,
    pairs: FramePairs,
    alike: Float64Array,
    true_kept: BoolArray,
    found_kept: BoolArray,
) -> ScoredSequence:
    left = track_scores.kept_pairs(alike, *pairs.locations, true_kept, found_kept)
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
