"""Evaluation of detections: precision and recall by KITTI's rules, calibration of scores and covariances, plots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import ArrayError, OptionError, check_choice
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
from sceneloom.warnings import DataWarning

_CLASSES = ("car", "pedestrian", "cyclist")  # the classes of KITTI's object benchmark
_SIMILARITIES = (Similarity.IMAGE, Similarity.ABOVE, Similarity.SPACE)  # those of KITTI's object benchmark

_LEAST_OVERLAPS: Mapping[str, float] = MappingProxyType({"car": 0.7, "pedestrian": 0.5, "cyclist": 0.5})
"""KITTI's overlaps, by class, from which a detection has found an object; other classes have `_OTHER_OVERLAP`."""

_OTHER_OVERLAP = 0.5
_SAMPLES = 41  # thresholds at which KITTI looks at precision: one for recalls of 0, 1/40, …, 1

_BINS = 15
"""Bins of equal width into which scores are sorted. Source: Guo et al. 2017, "On Calibration of Modern Networks"."""

_LEVELS = (0.5, 0.9, 0.95, 0.99)  # the shares of errors that the regions promise to contain

_OVERLAP_OF_ERRORS = 0.3
"""Overlap in space from which errors of a detection are reported: such boxes are of one object beyond doubt."""

_PARTS = {"center": slice(0, 3), "size": slice(3, 6), "yaw": slice(6, 7)}  # parts of a box whose covariances are judged


@dataclass(frozen=True, slots=True, kw_only=True)
class _Difficulty:
    """Which true objects must be found."""

    least_height_px: float  # lower ones need not be found, and lower detections do not count
    most_occlusion: float  # those more hidden need not be found
    most_truncation: float  # nor those of which more is outside the image


DIFFICULTIES: Mapping[str, _Difficulty] = MappingProxyType(
    {
        "easy": _Difficulty(least_height_px=40, most_occlusion=0, most_truncation=0.15),
        "moderate": _Difficulty(least_height_px=25, most_occlusion=1, most_truncation=0.3),
        "hard": _Difficulty(least_height_px=25, most_occlusion=2, most_truncation=0.5),
        "all": _Difficulty(least_height_px=-np.inf, most_occlusion=np.inf, most_truncation=np.inf),
    }
)
"""KITTI's three, and one in which every object must be found."""

_KITTI_DIFFICULTIES = ("easy", "moderate", "hard")


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionRules:
    """Which detections and true objects count; the defaults are those of KITTI's object benchmark in 3D.

    Attributes:
        similarity: measure of the overlap of two boxes.
        least_overlap: what pairs must exceed. [default: that of `_LEAST_OVERLAPS`]
        neighbours: by class, the classes whose objects neither count nor make a detection wrong.
        regions: class of the truth whose boxes in the image are regions in which detections are not wrong.
        regions_in_space: whether regions count also where boxes in space are compared, by the detections' boxes in the
            image; KITTI has them count in the image only.
    """

    similarity: Similarity = Similarity.SPACE
    least_overlap: float | None = None
    neighbours: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: KITTI_NEIGHBOURS)
    regions: str = "DontCare"
    regions_in_space: bool = False

    def overlap_of(self, label: str) -> float:
        """What pairs of a class must exceed."""
        if self.least_overlap is not None:
            return self.least_overlap
        return _LEAST_OVERLAPS.get(label.lower(), _OTHER_OVERLAP)


_KITTI_IN_SPACE = DetectionRules()


class ReliabilityBin(msgspec.Struct, frozen=True, kw_only=True):
    """The detections with scores of one bin.

    Attributes:
        low, high: its bounds.
        count: how many detections it has.
        mean_score: of these, None of an empty bin.
        share_true: how many are true, of all, None of an empty bin.
    """

    low: float
    high: float
    count: int
    mean_score: float | None
    share_true: float | None


class _Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """Calibration of scores as probabilities."""

    count: int  # detections that are either true or false
    error: float  # expected calibration error: |mean score - share true| of the bins, weighted by their detections
    largest_error: float  # of a bin with at least 1 % of the detections
    brier: float  # mean square of score - (1 for true ones, 0 for false ones)
    bins: tuple[ReliabilityBin, ...]  # of equal width


class Coverage(msgspec.Struct, frozen=True, kw_only=True):
    """The share of errors in the regions of one level, which promise to contain `level`."""

    level: float
    share: float


class CovarianceScores(msgspec.Struct, frozen=True, kw_only=True):
    """Consistency of covariances.

    Attributes:
        count: errors.
        dimensions: numbers in each.
        nees: mean of eᵀ Σ⁻¹ e, which true covariances make `dimensions`.
        nees_low, nees_high: between which that mean lies for true Gaussian ones in 95 of 100 cases.
        degrees_of_freedom: of the Student distribution whose regions are used, None for a Gaussian.
        coverages: of the regions of `_LEVELS`.
        log_volume: mean of ½ log det Σ: small for covariances that promise much.
        root_mean_square: of the errors.
    """

    count: int
    dimensions: int
    nees: float
    nees_low: float
    nees_high: float
    degrees_of_freedom: float | None
    coverages: tuple[Coverage, ...]
    log_volume: float
    root_mean_square: float


class DetectionScores(msgspec.Struct, frozen=True, kw_only=True):
    """The metrics of detections of one class, at one difficulty.

    Attributes:
        ap40: average precision over the recalls 1/40, …, 1.
        ap11: over the recalls 0, 1/10, …, 1, as until 2019.
        max_f1: best F1 of all scores.
        threshold: the score at which it is reached, None without detections.
        precision, recall: there.
        true_objects: how many must be found.
        detections: how many are either right or wrong, of all scores.
        thresholds, recalls, precisions: at KITTI's up to 41 scores, falling; precisions as they are.
        calibration: of the scores, None where they are no probabilities or nothing counts.
    """

    ap40: float
    ap11: float
    max_f1: float
    threshold: float | None
    precision: float
    recall: float
    true_objects: int
    detections: int
    thresholds: tuple[float, ...]
    recalls: tuple[float, ...]
    precisions: tuple[float, ...]
    calibration: _Calibration | None


class ClassDetection(msgspec.Struct, frozen=True, kw_only=True):
    """The metrics of one class.

    Attributes:
        similarity: measure of the overlap of two boxes.
        least_overlap: what pairs must exceed.
        difficulties: the metrics, by difficulty.
        covariances: consistency of the covariances of `_PARTS`, of boxes that overlap in space by at least
            `_OVERLAP_OF_ERRORS`; None where detections have none, or nothing overlaps.
        headings_reversed: share of those boxes whose heading is off by more than 90°, None as above.
    """

    similarity: str
    least_overlap: float
    difficulties: dict[str, DetectionScores]
    covariances: dict[str, CovarianceScores] | None
    headings_reversed: float | None


class DetectionReport(msgspec.Struct, frozen=True, kw_only=True):
    """One comparison.

    Attributes:
        results, truth: what was compared.
        sequences: names, in order.
        classes: by class, the metrics of each similarity.
        warnings: about the numbers.
    """

    results: str
    truth: str
    sequences: tuple[str, ...]
    classes: dict[str, tuple[ClassDetection, ...]]
    warnings: tuple[DataWarning, ...] = ()


def compare_detections(
    results: Path | str, truth: Path | str, *, classes: Sequence[str] = (), sequences: Sequence[str] = (),
    similarities: Sequence[Similarity | str] = (), least_overlap: float | None = None,
    difficulties: Sequence[str] = (), degrees_of_freedom: float | None = None, rules: DetectionRules = _KITTI_IN_SPACE,
    lenient: bool = False, corrections: str = "apply",
) -> DetectionReport:  # fmt: skip
    """Evaluate detections against the truth, by KITTI's rules.

    Args:
        results, truth: files or folders, as of `object_files.read_both`.
        classes: those to evaluate. [default: KITTI's of the truth, else all of the truth]
        sequences: those to take. [default: all of the truth]
        similarities: measures of the overlap of two boxes. [default: all of `_SIMILARITIES` that both sides have]
        least_overlap: what pairs must exceed. [default: KITTI's, by class]
        difficulties: of `DIFFICULTIES`. [default: KITTI's three; `all` where the truth has no boxes in images]
        degrees_of_freedom: of the detections' errors, as of `judge_covariances`.
        rules: all else that counts.
        lenient, corrections: as of `object_files.read_both`.

    Raises:
        DataError: a file is missing or has something wrong.
        OptionError: both sides cannot be compared, or not in this way.
    """
    sides = read_both(results, truth, sequences=sequences, lenient=lenient, corrections=corrections)
    labels = sides.classes(classes, usual=_CLASSES)
    chosen = tuple(map(similarity_named, similarities)) or tuple(
        known for known in _SIMILARITIES if known in sides.similarities
    )
    for similarity in chosen or _SIMILARITIES[-1:]:
        if similarity is Similarity.DISTANCE:
            raise OptionError(f"similarity 'distance'; detections take {', '.join(_SIMILARITIES)}")
        sides.check_similarity(similarity)
    if not difficulties:
        in_images = any(len(table) and table.corners_xyxy is not None for table in sides.truth.values())
        difficulties = _KITTI_DIFFICULTIES if in_images else ("all",)
    reported = [
        evaluate_detection(
            sides.results,
            sides.truth,
            classes=labels,
            difficulties=difficulties,
            rules=replace(rules, similarity=similarity, least_overlap=least_overlap or rules.least_overlap),
            degrees_of_freedom=degrees_of_freedom,
        )
        for similarity in chosen
    ]
    return DetectionReport(
        results=str(results),
        truth=str(truth),
        sequences=tuple(sides.truth),
        classes={label: tuple(one[label] for one in reported) for label in labels},
        warnings=sides.warnings,
    )


def evaluate_detection(
    results: Mapping[str, ObjectTable],
    truth: Mapping[str, ObjectTable],
    *,
    classes: Sequence[str] = _CLASSES,
    difficulties: Sequence[str] = _KITTI_DIFFICULTIES,
    rules: DetectionRules = _KITTI_IN_SPACE,
    degrees_of_freedom: float | None = None,
) -> dict[str, ClassDetection]:
    """Evaluate detections of some sequences against the truth.

    Args:
        results, truth: by name of the sequence; sequences without detections have empty ones.
        classes: those to evaluate, each by itself.
        difficulties: of `DIFFICULTIES`.
        rules: what counts.
        degrees_of_freedom: of the detections' errors, as of `judge_covariances`.

    Returns:
        By class.

    Raises:
        OptionError: sequences are not the same on both sides, or there is none, or boxes or scores are missing, or a
            difficulty is unknown.
        ArrayError: a covariance is none.
    """
    check_sequences(results, truth)
    for name in difficulties:
        check_choice("difficulty", name, DIFFICULTIES)
    reported = {}
    for label in classes:
        pairs = pair_detections(results, truth, label, rules=rules)
        metrics = {name: score_detections(at_difficulty(pairs, DIFFICULTIES[name])) for name in difficulties}
        covariances, headings_reversed = _judge_boxes(results, truth, label, rules, degrees_of_freedom)
        reported[label] = ClassDetection(
            similarity=rules.similarity.value,
            least_overlap=pairs.least_overlap,
            difficulties=metrics,
            covariances=covariances,
            headings_reversed=headings_reversed,
        )
    return reported


@dataclass(frozen=True, slots=True, eq=False)
class ScoredDetections:
    """The true objects and the detections of one class, of all sequences, and which of them count.

    Attributes:
        truth, found: in order of frames, those of neighbouring classes among the true ones.
        pairs: of the objects of each frame.
        overlaps: (P,) float64, of the pairs.
        least_overlap: what pairs must exceed.
        true_ignored, found_ignored, excused: as `kernels.scores.score_steps` takes them.
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

    def surest_matches(self) -> Int64Array:
        """The true object of each detection, (N,) int64, -1 for none; of several the surest one has it."""
        return kernels.surest_matches(self.overlaps, *self.pairs.locations, self.scores, self.least_overlap)


def pair_detections(
    found: Mapping[str, ObjectTable], truth: Mapping[str, ObjectTable], label: str, *, rules: DetectionRules
) -> ScoredDetections:
    """Select the objects and the detections of one class, and pair those of each frame.

    Every true object must be found and every detection counts until `at_difficulty` says otherwise.

    Raises:
        OptionError: detections have no scores, or one side lacks the boxes that `rules.similarity` needs.
    """
    truth_all, found_all = _joined(truth, found)
    regions = truth_all.select(truth_all.are(rules.regions))
    own = truth_all.are(label)
    wanted = own | truth_all.are(*rules.neighbours.get(label.lower(), ()))
    objects, detections = truth_all.select(wanted), found_all.select(found_all.are(label))
    if detections.scores is None and len(detections):
        raise OptionError("the results have no scores, by which detections are put in order")
    frames = 1 + max((int(t.frames[-1]) for t in (objects, detections, regions) if len(t)), default=-1)
    pairs = FramePairs.of(objects.frame_starts(frames), detections.frame_starts(frames))
    return ScoredDetections(
        truth=objects,
        found=detections,
        pairs=pairs,
        overlaps=similarities(objects, detections, pairs, rules.similarity) if pairs.starts[-1] else np.zeros(0),
        least_overlap=rules.overlap_of(label),
        true_ignored=~own[wanted],
        found_ignored=np.zeros(len(detections), np.bool_),
        excused=_excused(detections, regions, frames, rules, rules.overlap_of(label)),
    )


def _joined(truth: Mapping[str, ObjectTable], found: Mapping[str, ObjectTable]) -> tuple[ObjectTable, ObjectTable]:
    """Put the sequences behind one another, with frames that go on counting."""
    first, shifts = 0, {}
    for name in sorted(truth):
        shifts[name] = first
        first += 1 + max((int(s[name].frames.max()) for s in (truth, found) if len(s[name])), default=-1)
    return tuple(  # type: ignore[return-value]
        ObjectTable.joined([side[name].moved(shifts[name]).in_order() for name in sorted(truth)])
        for side in (truth, found)
    )


def _excused(found: ObjectTable, regions: ObjectTable, frames: int, rules: DetectionRules, least: float) -> BoolArray:
    """Which detections are not wrong, since they are in a region."""
    in_image = rules.similarity is Similarity.IMAGE
    counts = in_image or rules.regions_in_space
    if not counts or not len(regions) or regions.corners_xyxy is None or found.corners_xyxy is None:
        return np.zeros(len(found), np.bool_)
    pairs = FramePairs.of(regions.frame_starts(frames), found.frame_starts(frames))
    shares = covered_by(found, regions.corners_xyxy, pairs)
    # the overlap of boxes in space does not apply to boxes in the image
    return kernels.reached_columns(shares, *pairs.locations, least if in_image else _OTHER_OVERLAP)


def at_difficulty(detections: ScoredDetections, difficulty: _Difficulty) -> ScoredDetections:
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


@dataclass(frozen=True, slots=True, eq=False)
class _ScoreCurve:
    """Right, wrong and missed detections of at least a score, for every score that there is."""

    thresholds: Float64Array  # (K,), falling
    tp: Int64Array  # (K,)
    fp: Int64Array  # (K,)
    fn: Int64Array  # (K,)
    true_count: int  # objects that must be found


def score_curve(detections: ScoredDetections) -> _ScoreCurve:
    """Count what is right, wrong and missed at each score.

    With each least score objects and detections are paired anew, as KITTI's development kit does at its 41 scores.
    """
    scores = detections.scores
    steps = kernels.score_steps(
        detections.overlaps,
        *detections.pairs.locations,
        detections.true_ignored,
        detections.found_ignored,
        detections.excused,
        scores,
        detections.least_overlap,
    )
    order = np.argsort(-scores, kind="stable")
    ends = np.flatnonzero(np.diff(scores[order], append=-np.inf))
    tp, fp, passed = np.cumsum(steps[order], axis=0)[ends].T
    true_count = int((~detections.true_ignored).sum())
    return _ScoreCurve(scores[order][ends], tp, fp, true_count - tp - passed, true_count)


def score_detections(detections: ScoredDetections) -> DetectionScores:
    """Compute the metrics of paired detections."""
    curve, scores, matches = score_curve(detections), detections.scores, detections.surest_matches()
    tp, fp, fn = curve.tp, curve.fp, curve.fn
    precisions, recalls = tp / np.maximum(1, tp + fp), tp / np.maximum(1, tp + fn)
    f1s = 2.0 * tp / np.maximum(1, 2 * tp + fp + fn)
    samples = _samples(detections, matches, curve)
    # the best precision at a recall or beyond it; 0 at recalls that are not reached
    sampled = np.zeros(_SAMPLES)
    sampled[: len(samples)] = precisions[samples]
    sampled = np.maximum.accumulate(sampled[::-1])[::-1]
    # of several detections of one object the surest one is true; those of ignored objects are neither true nor false
    matched = matches >= 0
    of_ignored = np.zeros(len(matches), np.bool_)
    of_ignored[matched] = detections.true_ignored[matches[matched]]
    counts = ~(detections.found_ignored | of_ignored | (detections.excused & ~matched))
    are_probabilities = counts.any() and scores.min() >= 0.0 and scores.max() <= 1.0
    best = int(f1s.argmax()) if len(f1s) else None
    return DetectionScores(
        ap40=float(sampled[1:].mean()),
        ap11=float(sampled[::4].mean()),
        max_f1=0.0 if best is None else float(f1s[best]),
        threshold=None if best is None else float(curve.thresholds[best]),
        precision=0.0 if best is None else float(precisions[best]),
        recall=0.0 if best is None else float(recalls[best]),
        true_objects=curve.true_count,
        detections=int(tp[-1] + fp[-1]) if len(tp) else 0,
        thresholds=tuple(curve.thresholds[samples].tolist()),
        recalls=tuple(recalls[samples].tolist()),
        precisions=tuple(precisions[samples].tolist()),
        calibration=judge_calibration(scores[counts], matched[counts]) if are_probabilities else None,
    )


def _samples(detections: ScoredDetections, matches: Int64Array, curve: _ScoreCurve) -> Int64Array:
    """Which of the thresholds have recalls nearest to 0, 1/40, …, 1, (S,) int64, S <= `_SAMPLES`."""
    # Source: the development kit of KITTI's object benchmark, `getThresholds`; Simonelli et al. 2019 for 40 recalls
    right = (matches >= 0) & ~detections.found_ignored
    right[right] = ~detections.true_ignored[matches[right]]
    scores = np.sort(detections.scores[right])[::-1]
    chosen, recall = [], 0.0
    for k, score in enumerate(scores.tolist()):
        here, after = (k + 1) / curve.true_count, (k + 2) / curve.true_count
        if k + 1 < len(scores) and after - recall < recall - here:
            continue
        chosen.append(score)
        recall += 1.0 / (_SAMPLES - 1)
    return np.searchsorted(-curve.thresholds, -np.array(chosen)).astype(np.int64)


def judge_calibration(probabilities: Float64Array, are_true: BoolArray) -> _Calibration:
    """Compare scores, (N,) in 0 to 1, N >= 1, with the share of true detections, (N,), in bins of equal width."""
    edges = np.linspace(0.0, 1.0, _BINS + 1)
    locations = np.clip(np.searchsorted(edges, probabilities, side="right") - 1, 0, _BINS - 1)
    counts = np.bincount(locations, minlength=_BINS)
    stated = np.bincount(locations, weights=probabilities, minlength=_BINS)
    came = np.bincount(locations, weights=are_true.astype(np.float64), minlength=_BINS)
    gaps = np.abs(stated - came)
    large = counts >= max(1.0, 0.01 * len(probabilities))
    columns = zip(pairwise(edges.tolist()), counts.tolist(), stated.tolist(), came.tolist(), strict=True)
    return _Calibration(
        count=len(probabilities),
        error=float(gaps.sum() / len(probabilities)),
        largest_error=float((gaps[large] / counts[large]).max()),
        brier=float(((probabilities - are_true) ** 2).mean()),
        bins=tuple(
            ReliabilityBin(
                low=low,
                high=high,
                count=count,
                mean_score=mean / count if count else None,
                share_true=true / count if count else None,
            )
            for (low, high), count, mean, true in columns
        ),
    )


def judge_covariances(
    errors: Float64Array, covariances: Float64Array, *, degrees_of_freedom: float | None = None
) -> CovarianceScores:
    """Compare covariances with the errors that were made.

    Args:
        errors: (N, K), estimated less true, N >= 1.
        covariances: (N, K, K), of the errors.
        degrees_of_freedom: ν > 2 of the Student distribution that errors have, with those covariances; infinite for a
            Gaussian, which is also the default. The regions are those of `detections.settings.radius_squared`.

    Raises:
        ArrayError: shapes do not fit, or a matrix is no covariance.
        OptionError: `degrees_of_freedom` is not above 2.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 5.4.
    """
    # importing these takes a second, which is spared where there are no covariances
    from scipy import stats

    from sceneloom.detections.settings import radius_squared

    count, dimensions = errors.shape
    if covariances.shape != (count, dimensions, dimensions):
        raise ArrayError(f"covariances: {covariances.shape}; expected {(count, dimensions, dimensions)}")
    freedom = np.inf if degrees_of_freedom is None else degrees_of_freedom
    if not freedom > 2.0:
        raise OptionError(f"degrees of freedom {freedom}; expected more than 2")
    signs, logs = np.linalg.slogdet(covariances)
    bad = np.flatnonzero(~(np.isfinite(logs) & (signs > 0))).tolist()
    if bad:
        raise ArrayError(f"covariances[{bad[0]}]: {covariances[bad[0]].tolist()}; expected a positive definite matrix")
    distances = (errors * np.linalg.solve(covariances, errors[..., None])[..., 0]).sum(axis=1)
    limits = {level: radius_squared(level, degrees_of_freedom=freedom, dimensions=dimensions) for level in _LEVELS}
    low, high = stats.chi2.ppf((0.025, 0.975), count * dimensions) / count
    return CovarianceScores(
        count=count,
        dimensions=dimensions,
        nees=float(distances.mean()),
        nees_low=float(low),
        nees_high=float(high),
        degrees_of_freedom=None if np.isinf(freedom) else freedom,
        coverages=tuple(
            Coverage(level=level, share=float((distances <= limit).mean())) for level, limit in limits.items()
        ),
        log_volume=float(logs.mean() / 2.0),
        root_mean_square=float(np.sqrt((errors**2).mean())),
    )


def _judge_boxes(
    results: Mapping[str, ObjectTable],
    truth: Mapping[str, ObjectTable],
    label: str,
    rules: DetectionRules,
    degrees_of_freedom: float | None,
) -> tuple[dict[str, CovarianceScores] | None, float | None]:
    """Judge covariances of boxes in space, whatever boxes the rest is judged by."""
    if all(table.covariances is None or table.boxes is None for table in results.values()):
        return None, None
    in_space = replace(rules, similarity=Similarity.SPACE, least_overlap=_OVERLAP_OF_ERRORS, neighbours={}, regions="")
    detections = pair_detections(results, truth, label, rules=in_space)
    if detections.found.covariances is None or not (detections.surest_matches() >= 0).any():
        return None, None
    errors, covariances = box_errors(detections)
    headings_reversed = float((np.abs(errors[:, 6]) > np.pi / 2).mean())
    # a reversed heading is an error of its own, which no covariance is meant to cover
    errors[:, 6] = (errors[:, 6] + np.pi / 2) % np.pi - np.pi / 2
    judged = {
        name: judge_covariances(errors[:, part], covariances[:, part, part], degrees_of_freedom=degrees_of_freedom)
        for name, part in _PARTS.items()
        if covariances[:, part, part].any()  # parts that nobody reported have variances of 0
    }
    return judged, headings_reversed


def box_errors(detections: ScoredDetections) -> tuple[Float64Array, Float64Array]:
    """Give the errors of the detections that have a true object, and their covariances.

    Returns:
        (K, 7) float64: middle, length, width, height [m], heading [rad] within ±π; (K, 7, 7) float64.

    Raises:
        OptionError: one side has no boxes in space, or detections no covariances.
    """
    found, truth = detections.found, detections.truth
    if found.boxes is None or truth.boxes is None or found.covariances is None:
        raise OptionError("errors of boxes need boxes in space on both sides and covariances of the results")
    matches = detections.surest_matches()
    matched = matches >= 0
    errors = found.boxes[matched] - truth.boxes[matches[matched]]
    errors[:, 6] = (errors[:, 6] + np.pi) % (2 * np.pi) - np.pi
    return errors, found.covariances[matched]


def plot_detection(report: DetectionReport, path: Path, *, overwrite: bool = False) -> None:
    """Plot the metrics of detections into a file: a row for each class, and only the panels that some class has.

    Raises:
        OptionError: the suffix is none of `plot.SUFFIXES`.
        OutputError: the file exists, or cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    figure_of = check_plot(path, overwrite=overwrite)
    reported = [one for of_class in report.classes.values() for one in of_class]
    count = max(map(len, report.classes.values()), default=0)
    panels = [(_draw_precision, number) for number in range(count)]
    if any(scores.calibration for one in reported for scores in one.difficulties.values()):
        panels.append((_draw_reliability, count - 1))
    if any(one.covariances for one in reported):
        panels.append((_draw_coverage, count - 1))
    rows, columns = max(1, len(report.classes)), max(1, len(panels))
    figure = figure_of(figsize=(4.6 * columns, 4.4 * rows))
    grid = figure.add_gridspec(rows, columns)
    for row, (label, of_class) in enumerate(report.classes.items()):
        for column, (draw, number) in enumerate(panels):
            axes = figure.add_subplot(grid[row, column])
            draw(axes, label, of_class[number])
            axes.grid(visible=True, alpha=0.3)
            if axes.get_legend_handles_labels()[0]:
                axes.legend(loc="lower left" if draw is _draw_precision else "upper left", fontsize=8)
    save_plot(figure, f"{report.results} against {report.truth}", path, overwrite=overwrite)


def _draw_precision(axes: Any, label: str, reported: ClassDetection) -> None:
    for name, scores in reported.difficulties.items():
        shown = f"{name}: AP40 {100 * scores.ap40:.2f}, F1 {100 * scores.max_f1:.2f}"
        (line,) = axes.plot(scores.recalls, scores.precisions, linewidth=1.6, label=shown)
        if scores.threshold is not None:
            axes.plot(scores.recall, scores.precision, marker="o", color=line.get_color(), markersize=5)
    axes.set_title(f"{label}, {reported.similarity} overlap above {reported.least_overlap:g}", fontsize=10)
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1.02), ylim=(0, 1.02))


def _draw_reliability(axes: Any, label: str, reported: ClassDetection) -> None:
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
    for name, difficulty in reported.difficulties.items():
        if difficulty.calibration is None:
            continue
        filled = [part for part in difficulty.calibration.bins if part.count]
        most = max(part.count for part in filled)
        scores, shares = [part.mean_score for part in filled], [part.share_true for part in filled]
        (line,) = axes.plot(scores, shares, linewidth=1.2, label=f"{name}: ECE {difficulty.calibration.error:.3f}")
        sizes = [12 + 100 * part.count / most for part in filled]
        axes.scatter(scores, shares, s=sizes, color=line.get_color(), alpha=0.6)
    axes.set_title(f"{label}, reliability of scores, {reported.similarity}", fontsize=10)
    axes.set(xlabel="score", ylabel="share that is true", xlim=(0, 1.02), ylim=(0, 1.02))


def _draw_coverage(axes: Any, label: str, reported: ClassDetection) -> None:
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
    for name, part in (reported.covariances or {}).items():
        levels, shares = zip(*((one.level, one.share) for one in part.coverages), strict=True)
        axes.plot(levels, shares, marker="o", linewidth=1.2, label=f"{name}: NEES {part.nees:.2f} of {part.dimensions}")
    axes.set_title(f"{label}, regions of covariances", fontsize=10)
    axes.set(xlabel="promised share", ylabel="share within", xlim=(0.4, 1.02), ylim=(0.4, 1.02))
