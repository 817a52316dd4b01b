"""The figures of trackers: HOTA, CLEAR and identities, of one sequence and of several together.

All shares are 0 to 1; MOTA may be below 0. What cannot be reported for want of objects is 0, but for LocA, which is 1,
and for MOTA of several sequences together, which is minus the number of false boxes then.
"""

from collections.abc import Sequence

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from sceneloom.arrays import Float64Array
from sceneloom.evaluate.tracking.protocol import ScoredSequence
from sceneloom.kernels import track_scores

ALPHAS = tuple(k / 100 for k in range(5, 100, 5))
"""The similarities from which HOTA takes two boxes for one object."""

_LEAST = 1e-10


class HotaScores(msgspec.Struct, frozen=True, kw_only=True):
    """HOTA and its parts, each the mean of its curve over `ALPHAS`.

    Attributes:
        hota: root of the product of `deta` and `assa`, at each similarity.
        deta, detre, detpr: of detection: accuracy, recall, precision.
        assa, assre, asspr: of association: accuracy, recall, precision.
        loca: mean similarity of what was paired.
        curves: by name of the figure, its value at each of `ALPHAS`; and `tp`, `fn`, `fp`, numbers of boxes.

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


class ClearScores(msgspec.Struct, frozen=True, kw_only=True):
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


class IdentityScores(msgspec.Struct, frozen=True, kw_only=True):
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


def score_hota(sequence: ScoredSequence) -> HotaScores:
    """Compute HOTA over one sequence."""
    count = len(ALPHAS)
    true_boxes, found_boxes = len(sequence.true_ids), len(sequence.found_ids)
    tp, located, association = np.zeros(count), np.zeros(count), np.zeros((3, count))
    if not sequence.is_empty:
        tp, located, association = _paired_at_alphas(sequence)
    return _hota(tp, true_boxes - tp, found_boxes - tp, located, association)


def combine_hota(parts: Sequence[HotaScores]) -> HotaScores:
    """Take several sequences as one: boxes are added, association is weighted by the boxes paired."""
    tp, fn, fp = (np.sum([part.curves[name] for part in parts], axis=0) for name in ("tp", "fn", "fp"))
    located, *association = (
        np.sum([np.multiply(part.curves[name], part.curves["tp"]) for part in parts], axis=0)
        for name in ("loca", "assa", "assre", "asspr")
    )
    return _hota(tp, fn, fp, located, np.array(association))


def _paired_at_alphas(sequence: ScoredSequence) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Boxes paired, sums of their similarities, and of A(c), recall and precision of association, over `ALPHAS`."""
    true_boxes = np.bincount(sequence.true_ids, minlength=sequence.true_count).astype(np.float64)
    found_boxes = np.bincount(sequence.found_ids, minlength=sequence.found_count).astype(np.float64)
    locations = (*sequence.pairs.locations, sequence.true_ids, sequence.found_ids)
    shared = track_scores.shared_frames(
        sequence.similarities, *locations, sequence.true_count, sequence.found_count
    )
    aligned = shared / (true_boxes[:, None] + found_boxes[None] - shared)
    true_ids, found_ids, alike = track_scores.aligned_pairs(sequence.similarities, *locations, aligned)
    couples, of_pair = np.unique(true_ids * sequence.found_count + found_ids, return_inverse=True)
    true_of, found_of = np.divmod(couples, sequence.found_count)
    tp, located, association = np.zeros(len(ALPHAS)), np.zeros(len(ALPHAS)), np.zeros((3, len(ALPHAS)))
    for k, alpha in enumerate(ALPHAS):
        paired = alike >= alpha - np.finfo(np.float64).eps
        together = np.bincount(of_pair[paired], minlength=len(couples)).astype(np.float64)
        tp[k], located[k] = np.count_nonzero(paired), alike[paired].sum()
        either = true_boxes[true_of] + found_boxes[found_of] - together
        for row, boxes in enumerate((either, true_boxes[true_of], found_boxes[found_of])):
            association[row, k] = (together * together / boxes).sum()
    return tp, located, association


def _hota(
    tp: Float64Array, fn: Float64Array, fp: Float64Array, located: Float64Array, association: Float64Array
) -> HotaScores:
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
    return HotaScores(**means, curves={name: tuple(curve.tolist()) for name, curve in reported.items()})


def score_clear(sequence: ScoredSequence, *, least_similarity: float = 0.5) -> ClearScores:
    """Compute CLEAR over one sequence."""
    true_boxes, found_boxes = len(sequence.true_ids), len(sequence.found_ids)
    tp, idsw, alike, frag, tracked = 0, 0, 0.0, 0, np.zeros(sequence.true_count)
    if not sequence.is_empty:
        tp, idsw, alike, frames, begun = track_scores.followed_pairs(
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


def combine_clear(parts: Sequence[ClearScores]) -> ClearScores:
    """Take several sequences as one: everything counted is added."""
    names = ("tp", "fn", "fp", "idsw", "frag", "mt", "pt", "ml", "similarity")
    return _clear(**{name: sum(getattr(part, name) for part in parts) for name in names})


def _clear(*, tp: int, fn: int, fp: int, idsw: int, similarity: float, **counts: int) -> ClearScores:
    return ClearScores(
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


def score_identity(sequence: ScoredSequence, *, least_similarity: float = 0.5) -> IdentityScores:
    """Compute the figures of identities over one sequence."""
    idtp = 0
    if not sequence.is_empty:
        together = track_scores.similar_frames(
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


def combine_identity(parts: Sequence[IdentityScores]) -> IdentityScores:
    """Take several sequences as one: boxes are added."""
    return _identity(*(sum(getattr(part, name) for part in parts) for name in ("idtp", "idfn", "idfp")))


def _identity(idtp: int, idfn: int, idfp: int) -> IdentityScores:
    return IdentityScores(
        idf1=idtp / max(1.0, idtp + 0.5 * idfp + 0.5 * idfn),
        idp=idtp / max(1, idtp + idfp),
        idr=idtp / max(1, idtp + idfn),
        idtp=idtp,
        idfn=idfn,
        idfp=idfp,
    )
