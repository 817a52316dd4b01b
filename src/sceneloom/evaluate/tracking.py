"""Evaluation of a tracker: HOTA, CLEAR and identity metrics, comparison of files, plots.

All shares are 0 to 1; MOTA may be below 0. What cannot be reported for want of objects is 0, but for LocA, which is 1,
and for MOTA of several sequences together, which is minus the number of false boxes then.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import ArrayError, OptionError
from sceneloom.evaluate.object_files import BothSides, check_classes, check_similarity, classes_of, read_both
from sceneloom.evaluate.objects import (
    KITTI_NEIGHBOURS,
    FramePairs,
    ObjectTable,
    Similarity,
    check_sequences,
    covered_by,
    similarities,
    similarity_named,
)
from sceneloom.evaluate.plot import check_plot
from sceneloom.formats.base.output import replacing
from sceneloom.kernels import scores as kernels
from sceneloom.warnings import DataWarning, WarningKind

_EPSILON = float(np.finfo(np.float64).eps)
"""What thresholds are wider by, as in TrackEval."""


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
    neighbours: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: KITTI_NEIGHBOURS)
    most_occlusion: float = 2.0
    most_truncation: float = 0.0
    least_height_px: float = 25.0
    regions: str = "DontCare"
    most_in_region: float = 0.5


_KITTI_RULES = TrackingRules()
"""Those of KITTI's 2D tracking benchmark, as TrackEval's `kitti_2d_box` applies them."""


@dataclass(frozen=True, slots=True, eq=False)
class _ScoredSequence:
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


def _apply_rules(
    found: ObjectTable,
    truth: ObjectTable,
    label: str,
    *,
    rules: TrackingRules = _KITTI_RULES,
    frame_count: int | None = None,
) -> _ScoredSequence:
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
        _check_unique_ids(objects, side)
    pairs = FramePairs.of(truth.frame_starts(frame_count), found.frame_starts(frame_count))
    alike = similarities(truth, found, pairs, rules.similarity)
    of_found, _ = kernels.most_similar_pairs(alike, *pairs.locations, rules.least_similarity)
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


def _check_unique_ids(objects: ObjectTable, side: str) -> None:
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


def _may_be_missing(found: ObjectTable, regions: ObjectTable, frame_count: int, rules: TrackingRules) -> BoolArray:
    """Report which found objects would be nothing wrong if no true one is where they are."""
    small = np.zeros(len(found), np.bool_)
    if found.corners_xyxy is None:
        return small
    small |= found.corners_xyxy[:, 3] - found.corners_xyxy[:, 1] <= rules.least_height_px + _EPSILON
    if regions.corners_xyxy is None or not len(regions):
        return small
    pairs = FramePairs.of(regions.frame_starts(frame_count), found.frame_starts(frame_count))
    shares = covered_by(found, regions.corners_xyxy, pairs)
    return small | kernels.reached_columns(shares, *pairs.locations, rules.most_in_region + _EPSILON)


def _scored(
    truth: ObjectTable,
    found: ObjectTable,
    pairs: FramePairs,
    alike: Float64Array,
    true_kept: BoolArray,
    found_kept: BoolArray,
) -> _ScoredSequence:
    left = kernels.kept_pairs(alike, *pairs.locations, true_kept, found_kept)
    true_names, true_ids = np.unique(truth.ids[true_kept], return_inverse=True)
    found_names, found_ids = np.unique(found.ids[found_kept], return_inverse=True)
    starts = [
        np.concatenate([[0], np.cumsum(kept)])[old].astype(np.int64)
        for kept, old in ((true_kept, pairs.true_starts), (found_kept, pairs.found_starts))
    ]
    return _ScoredSequence(
        FramePairs.of(*starts),
        left,
        true_ids.astype(np.int64),
        found_ids.astype(np.int64),
        len(true_names),
        len(found_names),
    )


_ALPHAS = tuple(k / 100 for k in range(5, 100, 5))
"""The similarities from which HOTA takes two boxes for one object."""

_LEAST = 1e-10


class _HotaScores(msgspec.Struct, frozen=True, kw_only=True):
    """HOTA and its parts, each the mean of its curve over `_ALPHAS`.

    Attributes:
        hota: root of the product of `deta` and `assa`, at each similarity.
        deta, detre, detpr: of detection: accuracy, recall, precision.
        assa, assre, asspr: of association: accuracy, recall, precision.
        loca: mean similarity of what was paired.
        curves: by name of the figure, its value at each of `_ALPHAS`; and `tp`, `fn`, `fp`, numbers of boxes.

    Source: Luiten et al. 2021, "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking".
    """

    hota: float
    deta: float
    assa: float
    loca: float
    detre: float
    detpr: float
    assre: float
    asspr: float
    curves: dict[str, tuple[float, ...]]


class _ClearScores(msgspec.Struct, frozen=True, kw_only=True):
    """CLEAR MOT.

    Attributes:
        mota: 1 - (fn + fp + idsw) per true box.
        motp: mean similarity of what was paired.
        recall, precision: of boxes.
        tp, fn, fp: boxes paired, missed, false.
        idsw: how often a true object changed the found one it is paired with.
        frag: how often a true object was found again after it had been lost.
        mt, pt, ml: true objects paired in more than 80 %, in 20 to 80 %, in less than 20 % of their frames.
        similarity: the sum of similarities of what was paired.

    Source: Bernardin and Stiefelhagen 2008; Li et al. 2009 for `mt`, `ml` and `frag`.
    """

    mota: float
    motp: float
    recall: float
    precision: float
    tp: int
    fn: int
    fp: int
    idsw: int
    frag: int
    mt: int
    pt: int
    ml: int
    similarity: float


class _IdentityScores(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of identities: how long the best found object of each true one is with it.

    Attributes:
        idf1: 2 idtp / (2 idtp + idfn + idfp).
        idp, idr: precision and recall.
        idtp, idfn, idfp: boxes.

    Source: Ristani et al. 2016, "Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking".
    """

    idf1: float
    idp: float
    idr: float
    idtp: int
    idfn: int
    idfp: int


def _score_hota(sequence: _ScoredSequence) -> _HotaScores:
    """Compute HOTA over one sequence."""
    count = len(_ALPHAS)
    true_boxes, found_boxes = len(sequence.true_ids), len(sequence.found_ids)
    tp, located, association = np.zeros(count), np.zeros(count), np.zeros((3, count))
    if not sequence.is_empty:
        tp, located, association = _paired_at_alphas(sequence)
    return _hota(tp, true_boxes - tp, found_boxes - tp, located, association)


def _combine_hota(parts: Sequence[_HotaScores]) -> _HotaScores:
    """Take several sequences as one: boxes are added, association is weighted by the boxes paired."""
    tp, fn, fp = (np.sum([part.curves[name] for part in parts], axis=0) for name in ("tp", "fn", "fp"))
    located, *association = (
        np.sum([np.multiply(part.curves[name], part.curves["tp"]) for part in parts], axis=0)
        for name in ("loca", "assa", "assre", "asspr")
    )
    return _hota(tp, fn, fp, located, np.array(association))


def _paired_at_alphas(sequence: _ScoredSequence) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Boxes paired, sums of their similarities, and of A(c), recall and precision of association, over `_ALPHAS`."""
    true_boxes = np.bincount(sequence.true_ids, minlength=sequence.true_count).astype(np.float64)
    found_boxes = np.bincount(sequence.found_ids, minlength=sequence.found_count).astype(np.float64)
    locations = (*sequence.pairs.locations, sequence.true_ids, sequence.found_ids)
    shared = kernels.shared_frames(sequence.similarities, *locations, sequence.true_count, sequence.found_count)
    aligned = shared / (true_boxes[:, None] + found_boxes[None] - shared)
    true_ids, found_ids, alike = kernels.aligned_pairs(sequence.similarities, *locations, aligned)
    couples, of_pair = np.unique(true_ids * sequence.found_count + found_ids, return_inverse=True)
    true_of, found_of = np.divmod(couples, sequence.found_count)
    tp, located, association = np.zeros(len(_ALPHAS)), np.zeros(len(_ALPHAS)), np.zeros((3, len(_ALPHAS)))
    for k, alpha in enumerate(_ALPHAS):
        paired = alike >= alpha - np.finfo(np.float64).eps
        together = np.bincount(of_pair[paired], minlength=len(couples)).astype(np.float64)
        tp[k], located[k] = np.count_nonzero(paired), alike[paired].sum()
        either = true_boxes[true_of] + found_boxes[found_of] - together
        for row, boxes in enumerate((either, true_boxes[true_of], found_boxes[found_of])):
            association[row, k] = (together * together / boxes).sum()
    return tp, located, association


def _hota(
    tp: Float64Array, fn: Float64Array, fp: Float64Array, located: Float64Array, association: Float64Array
) -> _HotaScores:
    """Finish the figures from numbers of boxes and from sums over those paired."""
    curves = {
        "deta": tp / np.maximum(1.0, tp + fn + fp),
        "detre": tp / np.maximum(1.0, tp + fn),
        "detpr": tp / np.maximum(1.0, tp + fp),
        "loca": np.maximum(_LEAST, located) / np.maximum(_LEAST, tp),
    }
    for name, total in zip(("assa", "assre", "asspr"), association, strict=True):
        curves[name] = total / np.maximum(1.0, tp)
    curves["hota"] = np.sqrt(curves["deta"] * curves["assa"])
    means = {name: float(curve.mean()) for name, curve in curves.items()}
    reported = {**curves, "tp": tp, "fn": fn, "fp": fp}
    return _HotaScores(**means, curves={name: tuple(curve.tolist()) for name, curve in reported.items()})


def _score_clear(sequence: _ScoredSequence, *, least_similarity: float = 0.5) -> _ClearScores:
    """Compute CLEAR over one sequence."""
    true_boxes, found_boxes = len(sequence.true_ids), len(sequence.found_ids)
    tp, idsw, alike, frag, tracked = 0, 0, 0.0, 0, np.zeros(sequence.true_count)
    if not sequence.is_empty:
        tp, idsw, alike, frames, begun = kernels.followed_pairs(
            sequence.similarities,
            *sequence.pairs.locations,
            sequence.true_ids,
            sequence.found_ids,
            sequence.true_count,
            least_similarity,
        )
        tracked = frames / np.bincount(sequence.true_ids, minlength=sequence.true_count)
        frag = int(np.maximum(begun - 1, 0).sum())
    mt = int((tracked > 0.8).sum())
    pt = int((tracked >= 0.2).sum()) - mt
    scores = _clear(
        tp=tp,
        fn=true_boxes - tp,
        fp=found_boxes - tp,
        idsw=idsw,
        frag=frag,
        mt=mt,
        pt=pt,
        ml=sequence.true_count - mt - pt,
        similarity=alike,
    )
    # TrackEval says 0 of one sequence without true objects, and counts false boxes when it takes several as one
    return scores if true_boxes else msgspec.structs.replace(scores, mota=0.0)


def _combine_clear(parts: Sequence[_ClearScores]) -> _ClearScores:
    """Take several sequences as one: everything counted is added."""
    names = ("tp", "fn", "fp", "idsw", "frag", "mt", "pt", "ml", "similarity")
    return _clear(**{name: sum(getattr(part, name) for part in parts) for name in names})


def _clear(*, tp: int, fn: int, fp: int, idsw: int, similarity: float, **counts: int) -> _ClearScores:
    return _ClearScores(
        mota=(tp - fp - idsw) / max(1, tp + fn),
        motp=similarity / max(1, tp),
        recall=tp / max(1, tp + fn),
        precision=tp / max(1, tp + fp),
        tp=tp,
        fn=fn,
        fp=fp,
        idsw=idsw,
        similarity=similarity,
        **counts,
    )


def _score_identity(sequence: _ScoredSequence, *, least_similarity: float = 0.5) -> _IdentityScores:
    """Compute the figures of identities over one sequence."""
    idtp = 0
    if not sequence.is_empty:
        together = kernels.similar_frames(
            sequence.similarities,
            *sequence.pairs.locations,
            sequence.true_ids,
            sequence.found_ids,
            sequence.true_count,
            sequence.found_count,
            least_similarity,
        )
        # fewest boxes missed and false is the same as most boxes together, since their sums are given
        idtp = int(together[linear_sum_assignment(together, maximize=True)].sum())
    return _identity(idtp, len(sequence.true_ids) - idtp, len(sequence.found_ids) - idtp)


def _combine_identity(parts: Sequence[_IdentityScores]) -> _IdentityScores:
    """Take several sequences as one: boxes are added."""
    return _identity(*(sum(getattr(part, name) for part in parts) for name in ("idtp", "idfn", "idfp")))


def _identity(idtp: int, idfn: int, idfp: int) -> _IdentityScores:
    return _IdentityScores(
        idf1=idtp / max(1.0, idtp + 0.5 * idfp + 0.5 * idfn),
        idp=idtp / max(1, idtp + idfp),
        idr=idtp / max(1, idtp + idfn),
        idtp=idtp,
        idfn=idfn,
        idfp=idfp,
    )


CLASSES = ("car", "pedestrian")
"""The classes of KITTI's tracking benchmark."""


class TrackingScores(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a tracker for one class, of one sequence or of several.

    Attributes:
        hota, clear, identity: the three families of figures.
        true_boxes, found_boxes: how many counted.
        true_objects, found_objects: how many ids they have.
    """

    hota: _HotaScores
    clear: _ClearScores
    identity: _IdentityScores
    true_boxes: int
    found_boxes: int
    true_objects: int
    found_objects: int


class ClassTracking(msgspec.Struct, frozen=True, kw_only=True):
    """The figures for one class.

    Attributes:
        combined: of all sequences together.
        sequences: of each.
    """

    combined: TrackingScores
    sequences: dict[str, TrackingScores]


def evaluate_tracking(
    results: Mapping[str, ObjectTable],
    truth: Mapping[str, ObjectTable],
    *,
    classes: Sequence[str] = CLASSES,
    rules: TrackingRules = _KITTI_RULES,
    frame_counts: Mapping[str, int] | None = None,
) -> dict[str, ClassTracking]:
    """Hold what a tracker found in some sequences against the truth.

    Args:
        results, truth: by name of the sequence; sequences without results have empty ones.
        classes: those to evaluate, each by itself.
        rules: what counts.
        frame_counts: by name of the sequence. [default: up to the last frame in which there is an object]

    Returns:
        By class.

    Raises:
        OptionError: sequences are not the same on both sides, or there is none, or boxes are missing.
        ArrayError: an id comes twice in a frame, or a frame is beyond the sequence.
    """
    check_sequences(results, truth)
    counts = frame_counts or {}
    return {
        label: _evaluate_class(results, truth, label, rules, {name: counts.get(name) for name in truth})
        for label in classes
    }


def score_sequence(
    found: ObjectTable,
    truth: ObjectTable,
    label: str,
    *,
    rules: TrackingRules = _KITTI_RULES,
    frame_count: int | None = None,
) -> TrackingScores:
    """Hold what a tracker found of one class in one sequence against the truth.

    Raises:
        ArrayError: an id comes twice in a frame, or a frame is beyond the sequence.
        OptionError: boxes are missing.
    """
    sequence = _apply_rules(found, truth, label, rules=rules, frame_count=frame_count)
    return TrackingScores(
        hota=_score_hota(sequence),
        clear=_score_clear(sequence, least_similarity=rules.least_similarity),
        identity=_score_identity(sequence, least_similarity=rules.least_similarity),
        true_boxes=len(sequence.true_ids),
        found_boxes=len(sequence.found_ids),
        true_objects=sequence.true_count,
        found_objects=sequence.found_count,
    )


def combine_scores(parts: Sequence[TrackingScores]) -> TrackingScores:
    """Take several sequences as one, as TrackEval does."""
    names = ("true_boxes", "found_boxes", "true_objects", "found_objects")
    return TrackingScores(
        hota=_combine_hota([part.hota for part in parts]),
        clear=_combine_clear([part.clear for part in parts]),
        identity=_combine_identity([part.identity for part in parts]),
        **{name: sum(getattr(part, name) for part in parts) for name in names},
    )


def _evaluate_class(
    results: Mapping[str, ObjectTable],
    truth: Mapping[str, ObjectTable],
    label: str,
    rules: TrackingRules,
    frame_counts: Mapping[str, int | None],
) -> ClassTracking:
    sequences = {}
    for name in sorted(truth):
        try:
            sequences[name] = score_sequence(
                results[name], truth[name], label, rules=rules, frame_count=frame_counts[name]
            )
        except ArrayError as error:
            raise ArrayError(f"sequence {name}: {error}") from error
    return ClassTracking(combined=combine_scores(list(sequences.values())), sequences=sequences)


class TrackingReport(msgspec.Struct, frozen=True, kw_only=True):
    """One comparison.

    Attributes:
        results, truth: what was compared.
        similarity: what says how alike two boxes are.
        least_similarity: pairs from which CLEAR and identities take two boxes for one object.
        sequences: names, in order.
        classes: the figures by class.
        warnings: what is to be known about the numbers.
    """

    results: str
    truth: str
    similarity: str
    least_similarity: float
    sequences: tuple[str, ...]
    classes: dict[str, ClassTracking]
    warnings: tuple[DataWarning, ...] = ()


def compare_tracks(
    results: Path | str,
    truth: Path | str,
    *,
    classes: Sequence[str] = (),
    sequences: Sequence[str] = (),
    similarity: Similarity | str | None = None,
    least_similarity: float | None = None,
    rules: TrackingRules = _KITTI_RULES,
    lenient: bool = False,
    corrections: str = "apply",
) -> TrackingReport:
    """Hold what a tracker found against the truth, by KITTI's rules.

    Args:
        results, truth: files or folders, as of `object_files.read_both`.
        classes: those to evaluate. [default: KITTI's of the truth, else all of the truth]
        sequences: those to take. [default: all of the truth]
        similarity: what says how alike two boxes are. [default: boxes of the image where both have them, else boxes
            in space]
        least_similarity: pairs from which CLEAR and identities take two boxes for one object. [default: 0.5]
        rules: all else that counts.
        lenient, corrections: as of `object_files.read_both`.

    Raises:
        DataError: a file is missing or holds something wrong.
        OptionError: both sides cannot be compared, or not in this way, or results have no ids.
        ArrayError: an id comes twice in a frame.
    """
    sides = read_both(results, truth, sequences=sequences, lenient=lenient, corrections=corrections)
    check_classes(sides, classes)
    without = _check_ids(results, sides)
    usual = (Similarity.IMAGE, Similarity.SPACE)
    chosen = next((known for known in usual if known in sides.similarities), Similarity.SPACE)
    if similarity is not None:
        chosen = similarity_named(similarity)
    check_similarity(sides, chosen)
    least = rules.least_similarity if least_similarity is None else least_similarity
    reported = evaluate_tracking(
        sides.results,
        sides.truth,
        classes=classes or classes_of(sides, CLASSES),
        rules=replace(rules, similarity=chosen, least_similarity=least),
    )
    return TrackingReport(
        results=str(results),
        truth=str(truth),
        similarity=chosen.value,
        least_similarity=least,
        sequences=tuple(sides.truth),
        classes=reported,
        warnings=(*sides.warnings, *without),
    )


def _check_ids(results: Path | str, sides: BothSides) -> tuple[DataWarning, ...]:
    """Note results without an id, which are left out; refuse them where none has one."""
    count = sum(len(table) for table in sides.results.values())
    without = sum(int((table.ids < 0).sum()) for table in sides.results.values())
    if count and without == count:
        raise OptionError(f"{results}: no object has an id, which tracks need; see `sceneloom eval detection`")
    if not without:
        return ()
    return (
        DataWarning(
            kind=WarningKind.SKIPPED,
            code="results-without-id",
            location=str(results),
            message="objects whose id is below 0 are left out",
            count=without,
        ),
    )


_WIDTH_INCHES, _ROW_INCHES = 13.0, 4.6
_DPI = 120

_CURVES = {
    "hota": ("HOTA", "black", "-", 2.4),
    "deta": ("DetA", "tab:blue", "-", 1.4),
    "detre": ("DetRe", "tab:blue", "--", 1.0),
    "detpr": ("DetPr", "tab:blue", ":", 1.0),
    "assa": ("AssA", "tab:orange", "-", 1.4),
    "assre": ("AssRe", "tab:orange", "--", 1.0),
    "asspr": ("AssPr", "tab:orange", ":", 1.0),
    "loca": ("LocA", "tab:green", "-", 1.4),
}
"""By figure: its name, colour, dashes and width."""

_MOST_SEQUENCES = 40


def plot_tracking(report: TrackingReport, path: Path, *, overwrite: bool = False) -> None:
    """Draw the figures of a tracker into a file, without touching what the caller does with matplotlib.

    Raises:
        OptionError: the suffix is none of `plot.SUFFIXES`.
        OutputError: the file exists, or cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    figure_of = check_plot(path, overwrite=overwrite)
    rows = max(1, len(report.classes))
    figure = figure_of(figsize=(_WIDTH_INCHES, _ROW_INCHES * rows), dpi=_DPI, layout="constrained")
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.0, 1.0))
    for row, (label, scores) in enumerate(report.classes.items()):
        _draw_curves(figure.add_subplot(grid[row, 0]), label, scores, report.similarity)
        _draw_sequences(figure.add_subplot(grid[row, 1]), scores)
    figure.suptitle(f"{report.results} against {report.truth}", fontsize=11)
    with replacing(path, overwrite=overwrite) as draft:
        figure.savefig(draft, format=path.suffix[1:].lower())


def _draw_curves(axes: Any, label: str, scores: ClassTracking, similarity: str) -> None:
    hota = scores.combined.hota
    for name, (shown, color, dashes, width) in _CURVES.items():
        reported = f"{shown} {100 * getattr(hota, name):.2f}"
        axes.plot(_ALPHAS, hota.curves[name], color=color, linestyle=dashes, linewidth=width, label=reported)
    clear, identity = scores.combined.clear, scores.combined.identity
    axes.set_title(
        f"{label}: MOTA {100 * clear.mota:.2f}, IDF1 {100 * identity.idf1:.2f}, IDSW {clear.idsw}",
        fontsize=10,
    )
    axes.set(xlabel=f"least similarity ({similarity})", ylabel="share", xlim=(0, 1), ylim=(0, 1.02))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="lower left", fontsize=8, ncols=2)


def _draw_sequences(axes: Any, scores: ClassTracking) -> None:
    """HOTA, MOTA and IDF1 of each sequence with objects, side by side."""
    there = [name for name, one in scores.sequences.items() if one.true_boxes][:_MOST_SEQUENCES]
    bars = {
        "HOTA": [scores.sequences[name].hota.hota for name in there],
        "MOTA": [max(0.0, scores.sequences[name].clear.mota) for name in there],
        "IDF1": [scores.sequences[name].identity.idf1 for name in there],
    }
    for k, (shown, values) in enumerate(bars.items()):
        axes.bar([location + 0.27 * (k - 1) for location in range(len(there))], values, width=0.25, label=shown)
    axes.set_xticks(range(len(there)), there, rotation=45 if len(there) > 6 else 0)
    axes.set(ylim=(0, 1.15))
    axes.set_title("sequences", fontsize=10)
    axes.grid(visible=True, axis="y", alpha=0.3)
    axes.legend(loc="upper center", fontsize=8, ncols=3)
