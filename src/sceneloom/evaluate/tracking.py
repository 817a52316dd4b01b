"""Evaluation of a tracker: HOTA, CLEAR and identity metrics, comparison of files, plots.

All shares are 0 to 1; MOTA may be below 0. What is undefined without objects is 0, except for LocA, which is 1, and for
MOTA of several sequences together, which is minus the number of false boxes then.
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
from sceneloom.evaluate.object_files import read_both
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
from sceneloom.evaluate.plot import check_plot, save_plot
from sceneloom.kernels import scores as kernels
from sceneloom.warnings import DataWarning, skipped

CLASSES = ("car", "pedestrian")
"""The classes of KITTI's tracking benchmark."""

_EPSILON = float(np.finfo(np.float64).eps)  # what thresholds are wider by, as in TrackEval
_ALPHAS = tuple(k / 100 for k in range(5, 100, 5))  # the similarities from which HOTA takes two boxes for one object
_LEAST = 1e-10

_CURVES = {
    "hota": ("HOTA", "black", "-", 2.4),
    "deta": ("DetA", "tab:blue", "-", 1.4),
    "detre": ("DetRe", "tab:blue", "--", 1.0),
    "detpr": ("DetPr", "tab:blue", ":", 1.0),
    "assa": ("AssA", "tab:orange", "-", 1.4),
    "assre": ("AssRe", "tab:orange", "--", 1.0),
    "asspr": ("AssPr", "tab:orange", ":", 1.0),
    "loca": ("LocA", "tab:green", "-", 1.4),
}  # by metric: its name, colour, dashes and width in plots

_MOST_SEQUENCES = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingRules:
    """Which results and true objects count; the defaults are those of KITTI's tracking benchmark.

    Attributes:
        similarity: measure of the similarity of two boxes.
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


_KITTI_RULES = TrackingRules()  # those of KITTI's 2D tracking benchmark, as TrackEval's `kitti_2d_box` applies them


class _HotaScores(msgspec.Struct, frozen=True, kw_only=True):
    """HOTA and its parts (Luiten et al. 2021, "HOTA: …"), each the mean of its curve over `_ALPHAS`."""

    hota: float  # root of the product of `deta` and `assa`, at each similarity
    deta: float  # detection: accuracy
    assa: float  # association: accuracy
    loca: float  # mean similarity of the pairs
    detre: float  # recall
    detpr: float  # precision
    assre: float  # recall
    asspr: float  # precision
    curves: dict[str, tuple[float, ...]]  # by metric, value at each of `_ALPHAS`; `tp`, `fn`, `fp`: counts of boxes


class _ClearScores(msgspec.Struct, frozen=True, kw_only=True):
    """CLEAR MOT: Bernardin and Stiefelhagen 2008; Li et al. 2009 for `mt`, `ml` and `frag`."""

    mota: float  # 1 - (fn + fp + idsw) per true box
    motp: float  # mean similarity of the pairs
    recall: float
    precision: float
    tp: int  # boxes paired
    fn: int  # missed
    fp: int  # false
    idsw: int  # how often a true object changed the found one it is paired with
    frag: int  # how often a true object was found again after it had been lost
    mt: int  # true objects paired in more than 80 % of their frames
    pt: int  # in 20 to 80 %
    ml: int  # in less than 20 %
    similarity: float  # sum over the pairs


class _IdentityScores(msgspec.Struct, frozen=True, kw_only=True):
    """Identity metrics: how long the best found object of each true one is with it (Ristani et al. 2016, MTMC)."""

    idf1: float  # 2 idtp / (2 idtp + idfn + idfp)
    idp: float  # precision
    idr: float  # recall
    idtp: int  # boxes, as the next two
    idfn: int
    idfp: int


class TrackingScores(msgspec.Struct, frozen=True, kw_only=True):
    """The metrics of a tracker for one class, of one sequence or of several.

    Attributes:
        hota, clear, identity: the three families of metrics.
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
    """The metrics of one class: of all sequences together, and of each."""

    combined: TrackingScores
    sequences: dict[str, TrackingScores]


class TrackingReport(msgspec.Struct, frozen=True, kw_only=True):
    """One comparison.

    Attributes:
        results, truth: what was compared.
        similarity: measure of the similarity of two boxes.
        least_similarity: pairs from which CLEAR and identities take two boxes for one object.
        sequences: names, in order.
        classes: the metrics by class.
        warnings: about the numbers.
    """

    results: str
    truth: str
    similarity: str
    least_similarity: float
    sequences: tuple[str, ...]
    classes: dict[str, ClassTracking]
    warnings: tuple[DataWarning, ...] = ()


def compare_tracks(
    results: Path | str, truth: Path | str, *, classes: Sequence[str] = (), sequences: Sequence[str] = (),
    similarity: Similarity | str | None = None, least_similarity: float | None = None,
    rules: TrackingRules = _KITTI_RULES, lenient: bool = False, corrections: str = "apply",
) -> TrackingReport:  # fmt: skip
    """Evaluate tracks against the truth, by KITTI's rules.

    Args:
        results, truth: files or folders, as of `object_files.read_both`.
        classes: those to evaluate. [default: KITTI's of the truth, else all of the truth]
        sequences: those to take. [default: all of the truth]
        similarity: measure of the similarity of two boxes. [default: boxes of the image where both have them, else
            boxes in space]
        least_similarity: pairs from which CLEAR and identities take two boxes for one object. [default: 0.5]
        rules: all else that counts.
        lenient, corrections: as of `object_files.read_both`.

    Raises:
        DataError: a file is missing or has something wrong.
        OptionError: both sides cannot be compared, or not in this way, or results have no ids.
        ArrayError: an id occurs twice in a frame.
    """
    sides = read_both(results, truth, sequences=sequences, lenient=lenient, corrections=corrections)
    labels = sides.classes(classes, usual=CLASSES)
    warnings, ids = sides.warnings, np.concatenate([table.ids for table in sides.results.values()])
    if len(ids) and (ids < 0).all():
        raise OptionError(f"{results}: no object has an id, which tracks need; see `sceneloom eval detection`")
    if (ids < 0).any():
        message = "objects whose id is below 0 are left out"
        warnings = (*warnings, skipped("results-without-id", str(results), message, count=int((ids < 0).sum())))
    if similarity is None:
        chosen = Similarity.IMAGE if Similarity.IMAGE in sides.similarities else Similarity.SPACE
    else:
        chosen = similarity_named(similarity)
    sides.check_similarity(chosen)
    least = rules.least_similarity if least_similarity is None else least_similarity
    rules = replace(rules, similarity=chosen, least_similarity=least)
    return TrackingReport(
        results=str(results),
        truth=str(truth),
        similarity=chosen.value,
        least_similarity=least,
        sequences=tuple(sides.truth),
        classes=evaluate_tracking(sides.results, sides.truth, classes=labels, rules=rules),
        warnings=warnings,
    )


def evaluate_tracking(
    results: Mapping[str, ObjectTable],
    truth: Mapping[str, ObjectTable],
    *,
    classes: Sequence[str] = CLASSES,
    rules: TrackingRules = _KITTI_RULES,
) -> dict[str, ClassTracking]:
    """Evaluate tracks of some sequences against the truth.

    Args:
        results, truth: by name of the sequence; sequences without results have empty ones.
        classes: those to evaluate, each by itself.
        rules: what counts.

    Returns:
        By class.

    Raises:
        OptionError: sequences are not the same on both sides, or there is none, or boxes are missing.
        ArrayError: an id occurs twice in a frame.
    """
    check_sequences(results, truth)
    reported = {}
    for label in classes:
        sequences = {}
        for name in sorted(truth):
            try:
                sequences[name] = score_sequence(results[name], truth[name], label, rules=rules)
            except ArrayError as error:
                raise ArrayError(f"sequence {name}: {error}") from error
        reported[label] = ClassTracking(combined=_combined(list(sequences.values())), sequences=sequences)
    return reported


def score_sequence(
    found: ObjectTable, truth: ObjectTable, label: str, *, rules: TrackingRules = _KITTI_RULES
) -> TrackingScores:
    """Evaluate tracks of one class in one sequence against the truth.

    Raises:
        ArrayError: an id occurs twice in a frame.
        OptionError: boxes are missing.
    """
    sequence = _Sequence.of(found, truth, label, rules)
    return TrackingScores(
        hota=_score_hota(sequence),
        clear=_score_clear(sequence, rules.least_similarity),
        identity=_score_identity(sequence, rules.least_similarity),
        true_boxes=len(sequence.true_ids),
        found_boxes=len(sequence.found_ids),
        true_objects=sequence.true_count,
        found_objects=sequence.found_count,
    )


def _combined(parts: Sequence[TrackingScores]) -> TrackingScores:
    """Take several sequences as one, as TrackEval does: counts are added, association is weighted by paired boxes."""

    def added(family: str, names: Sequence[str]) -> dict[str, Any]:
        return {name: sum(getattr(getattr(part, family), name) for part in parts) for name in names}

    curves = [part.hota.curves for part in parts]
    located, *association = (
        np.sum([np.multiply(curve[name], curve["tp"]) for curve in curves], axis=0)
        for name in ("loca", "assa", "assre", "asspr")
    )
    tp, fn, fp = (np.sum([curve[name] for curve in curves], axis=0) for name in ("tp", "fn", "fp"))
    clear = ("tp", "fn", "fp", "idsw", "frag", "mt", "pt", "ml", "similarity")
    names = ("true_boxes", "found_boxes", "true_objects", "found_objects")
    return TrackingScores(
        hota=_hota(tp, fn, fp, located, np.array(association)),
        clear=_clear(**added("clear", clear)),
        identity=_identity(**added("identity", ("idtp", "idfn", "idfp"))),
        **{name: sum(getattr(part, name) for part in parts) for name in names},
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Sequence:
    """The objects of one sequence and one class that count."""

    pairs: FramePairs
    similarities: Float64Array  # (P,), of the pairs
    true_ids: Int64Array  # (T,), in order of frames, from 0 without gaps
    found_ids: Int64Array  # (E,), likewise
    true_count: int  # how many ids there are
    found_count: int

    @property
    def is_empty(self) -> bool:
        """Whether one side has nothing, so that nothing can be paired."""
        return not (len(self.true_ids) and len(self.found_ids))

    @property
    def columns(self) -> tuple[Float64Array, Int64Array, Int64Array, Int64Array, Int64Array, Int64Array]:
        """Similarities, pairs and ids, as kernels take them."""
        return self.similarities, *self.pairs.locations, self.true_ids, self.found_ids

    @classmethod
    def of(cls, found: ObjectTable, truth: ObjectTable, label: str, rules: TrackingRules) -> "_Sequence":
        """Select the objects that count (Geiger et al. 2012; TrackEval, `Kitti2DBox.get_preprocessed_seq_data`)."""
        # found objects most like a true one which does not count (hidden, cut off, of a neighbouring class) do not
        # count either; nor do those without a true one that are small or in a region
        truth, found = truth.in_order(), found.in_order()
        frames = 1 + max(int(objects.frames[-1]) if len(objects) else -1 for objects in (truth, found))
        regions = truth.select(truth.are(rules.regions))
        own = truth.are(label)
        wanted = (own | truth.are(*rules.neighbours.get(label.lower(), ()))) & (truth.ids >= 0)
        hidden = np.zeros(len(truth), np.bool_)
        if truth.occlusions is not None:
            hidden |= truth.occlusions > rules.most_occlusion
        if truth.truncations is not None:
            hidden |= truth.truncations > rules.most_truncation
        truth, counts = truth.select(wanted), (own & ~hidden)[wanted]
        found = found.select(found.are(label) & (found.ids >= 0))
        for side, objects in (("truth", truth), ("results", found)):
            _check_unique_ids(objects, side)
        pairs = FramePairs.of(truth.frame_starts(frames), found.frame_starts(frames))
        alike = similarities(truth, found, pairs, rules.similarity)
        of_found, _ = kernels.most_similar_pairs(alike, *pairs.locations, rules.least_similarity)
        kept = ~_may_be_missing(found, regions, frames, rules)
        kept[of_found >= 0] = counts[of_found[of_found >= 0]]
        true_names, true_ids = np.unique(truth.ids[counts], return_inverse=True)
        found_names, found_ids = np.unique(found.ids[kept], return_inverse=True)
        starts = [
            np.concatenate([[0], np.cumsum(rows)])[old].astype(np.int64)
            for rows, old in ((counts, pairs.true_starts), (kept, pairs.found_starts))
        ]
        return cls(
            FramePairs.of(*starts),
            kernels.kept_pairs(alike, *pairs.locations, counts, kept),
            true_ids.astype(np.int64),
            found_ids.astype(np.int64),
            len(true_names),
            len(found_names),
        )


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


def _may_be_missing(found: ObjectTable, regions: ObjectTable, frame_count: int, rules: TrackingRules) -> BoolArray:
    """Which found objects would not be false without a true one where they are."""
    small = np.zeros(len(found), np.bool_)
    if found.corners_xyxy is None:
        return small
    small |= found.corners_xyxy[:, 3] - found.corners_xyxy[:, 1] <= rules.least_height_px + _EPSILON
    if regions.corners_xyxy is None or not len(regions):
        return small
    pairs = FramePairs.of(regions.frame_starts(frame_count), found.frame_starts(frame_count))
    shares = covered_by(found, regions.corners_xyxy, pairs)
    return small | kernels.reached_columns(shares, *pairs.locations, rules.most_in_region + _EPSILON)


def _score_hota(sequence: _Sequence) -> _HotaScores:
    """HOTA over one sequence: boxes paired, sums of their similarities, and of A(c), recall, precision."""
    count = len(_ALPHAS)
    tp, located, association = np.zeros(count), np.zeros(count), np.zeros((3, count))
    if not sequence.is_empty:
        true_boxes = np.bincount(sequence.true_ids, minlength=sequence.true_count).astype(np.float64)
        found_boxes = np.bincount(sequence.found_ids, minlength=sequence.found_count).astype(np.float64)
        shared = kernels.shared_frames(*sequence.columns, sequence.true_count, sequence.found_count)
        aligned = shared / (true_boxes[:, None] + found_boxes[None] - shared)
        true_ids, found_ids, alike = kernels.aligned_pairs(*sequence.columns, aligned)
        couples, of_pair = np.unique(true_ids * sequence.found_count + found_ids, return_inverse=True)
        true_of, found_of = np.divmod(couples, sequence.found_count)
        for k, alpha in enumerate(_ALPHAS):
            paired = alike >= alpha - np.finfo(np.float64).eps
            together = np.bincount(of_pair[paired], minlength=len(couples)).astype(np.float64)
            tp[k], located[k] = np.count_nonzero(paired), alike[paired].sum()
            either = true_boxes[true_of] + found_boxes[found_of] - together
            for row, boxes in enumerate((either, true_boxes[true_of], found_boxes[found_of])):
                association[row, k] = (together * together / boxes).sum()
    return _hota(tp, len(sequence.true_ids) - tp, len(sequence.found_ids) - tp, located, association)


def _hota(
    tp: Float64Array, fn: Float64Array, fp: Float64Array, located: Float64Array, association: Float64Array
) -> _HotaScores:
    """HOTA from numbers of boxes and from sums over the pairs."""
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


def _score_clear(sequence: _Sequence, least_similarity: float) -> _ClearScores:
    """CLEAR over one sequence."""
    true_boxes, found_boxes = len(sequence.true_ids), len(sequence.found_ids)
    tp, idsw, alike, frag, tracked = 0, 0, 0.0, 0, np.zeros(sequence.true_count)
    if not sequence.is_empty:
        tp, idsw, alike, frames, begun = kernels.followed_pairs(
            *sequence.columns, sequence.true_count, least_similarity
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
        similarity=alike,
        frag=frag,
        mt=mt,
        pt=pt,
        ml=sequence.true_count - mt - pt,
    )
    # TrackEval says 0 of one sequence without true objects, and counts false boxes when it takes several as one
    return scores if true_boxes else msgspec.structs.replace(scores, mota=0.0)


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


def _score_identity(sequence: _Sequence, least_similarity: float) -> _IdentityScores:
    """Identity metrics over one sequence."""
    idtp = 0
    if not sequence.is_empty:
        together = kernels.similar_frames(
            *sequence.columns, sequence.true_count, sequence.found_count, least_similarity
        )
        # fewest boxes missed and false is the same as most boxes together, since their sums are given
        idtp = int(together[linear_sum_assignment(together, maximize=True)].sum())
    return _identity(idtp, len(sequence.true_ids) - idtp, len(sequence.found_ids) - idtp)


def _identity(idtp: int, idfn: int, idfp: int) -> _IdentityScores:
    return _IdentityScores(
        idf1=idtp / max(1.0, idtp + 0.5 * idfp + 0.5 * idfn),
        idp=idtp / max(1, idtp + idfp),
        idr=idtp / max(1, idtp + idfn),
        idtp=idtp,
        idfn=idfn,
        idfp=idfp,
    )


def plot_tracking(report: TrackingReport, path: Path, *, overwrite: bool = False) -> None:
    """Plot the metrics of a tracker into a file: HOTA's curves of each class, and bars of each sequence.

    Raises:
        OptionError: the suffix is none of `plot.SUFFIXES`.
        OutputError: the file exists, or cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    figure_of = check_plot(path, overwrite=overwrite)
    rows = max(1, len(report.classes))
    figure = figure_of(figsize=(13.0, 4.6 * rows))
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.0, 1.0))
    for row, (label, scores) in enumerate(report.classes.items()):
        _draw_curves(figure.add_subplot(grid[row, 0]), label, scores, report.similarity)
        _draw_sequences(figure.add_subplot(grid[row, 1]), scores)
    save_plot(figure, f"{report.results} against {report.truth}", path, overwrite=overwrite)


def _draw_curves(axes: Any, label: str, scores: ClassTracking, similarity: str) -> None:
    hota, clear, identity = scores.combined.hota, scores.combined.clear, scores.combined.identity
    for name, (shown, color, dashes, width) in _CURVES.items():
        reported = f"{shown} {100 * getattr(hota, name):.2f}"
        axes.plot(_ALPHAS, hota.curves[name], color=color, linestyle=dashes, linewidth=width, label=reported)
    title = f"{label}: MOTA {100 * clear.mota:.2f}, IDF1 {100 * identity.idf1:.2f}, IDSW {clear.idsw}"
    axes.set_title(title, fontsize=10)
    axes.set(xlabel=f"least similarity ({similarity})", ylabel="share", xlim=(0, 1), ylim=(0, 1.02))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="lower left", fontsize=8, ncols=2)


def _draw_sequences(axes: Any, scores: ClassTracking) -> None:
    """HOTA, MOTA and IDF1 of each sequence with objects, side by side."""
    there = [(name, one) for name, one in scores.sequences.items() if one.true_boxes]
    shown = dict(there[:_MOST_SEQUENCES])
    bars = {
        "HOTA": [one.hota.hota for one in shown.values()],
        "MOTA": [max(0.0, one.clear.mota) for one in shown.values()],
        "IDF1": [one.identity.idf1 for one in shown.values()],
    }
    for k, (name, values) in enumerate(bars.items()):
        axes.bar([location + 0.27 * (k - 1) for location in range(len(shown))], values, width=0.25, label=name)
    axes.set_xticks(range(len(shown)), list(shown), rotation=45 if len(shown) > 6 else 0)
    axes.set(ylim=(0, 1.15))
    axes.set_title("sequences", fontsize=10)
    axes.grid(visible=True, axis="y", alpha=0.3)
    axes.legend(loc="upper center", fontsize=8, ncols=3)
