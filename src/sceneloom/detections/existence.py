r"""How likely it is that an object exists which one detector or both report.

A score names the logarithm of odds x. What comes true of boxes with such scores is fitted to data with few numbers,
all of which grow with the scores (`detectors` names them, `fitting` fits them, `kernels.existence_probability`
computes):

    log odds(e | box of the sweep)       = a + b x
    log odds(e | boxes of both)          = a' + b' x + c' y + d' (IoU - 0.7)
    log odds(e | box of the sweep alone) = a + b x + log(1 - D v),

D the share of objects shown openly that the detector of images finds, v how openly the image shows the location: in
full from some height in pixels and some seen share on, not at all for what is tiny, hidden or out of the image. A
score that is no number states nothing.

A camera may be worse than it was when D was fitted: by night, in rain, or with another network behind it. So D is of
two kinds, with the odds w that an image is of the poor kind (recall D') or not, by all other objects of the sweep:
each sure one that has no box speaks for the poor kind, each one that has a box against it,

    log w = log w₀ + Σ_found p log(D' / D) + Σ_missed log[(1 - p D' v) / (1 - p D v)],

p how likely each object is by its sweep. With an empty image of many sure objects missing boxes state little at all.

Source: Platt 1999, "Probabilistic Outputs for Support Vector Machines", for scores as logistic functions; Thrun,
Burgard and Fox 2005, "Probabilistic Robotics", ch. 4.2, for log odds. `independent` derives the form from Bayes'
theorem.
"""

import math

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.detections.classes import KINDS
from sceneloom.detections.detectors import ClassStatistics, Detectors
from sceneloom.kernels import existence_probability as columns

_SUREST = 0.9995
"""No detector finds a larger share than this."""
_LEAST = 1e-3


def existence_table(
    detectors: Detectors, *, recall_2d: float | None = None, recall_3d: float | None = None
) -> Float64Array:
    """Give what detectors are like as the compiled formulas take it.

    Args:
        detectors: whose numbers.
        recall_2d, recall_3d: take the position of theirs; 0 where the other one's silence shall state nothing.

    Returns:
        (K + 1, COLUMNS) float64, a row for each class of `classes.KINDS` and a last one for whatever else there is; the
        columns are those of `kernels.existence_probability`.
    """
    rows = [_row(statistics_of(detectors, name), recall_2d, recall_3d) for name in (*KINDS, "")]
    return read_only(np.array(rows))


def statistics_of(detectors: Detectors, name: str) -> ClassStatistics:
    """Give the numbers of a class; where there are none, those of a class of its family, else of `otherwise`."""
    if name in detectors.classes:
        return detectors.classes[name]
    family = KINDS[name].family if name in KINDS else None
    relatives = [other for other in detectors.classes if other in KINDS and KINDS[other].family == family]
    return detectors.classes[relatives[0] if relatives else detectors.otherwise]


def _row(own: ClassStatistics, recall_2d: float | None, recall_3d: float | None) -> Float64Array:
    visibility, row = own.visibility, np.empty(columns.COLUMNS)
    found_2d = visibility.recall_2d if recall_2d is None else recall_2d
    poorly_2d = visibility.weak_recall_2d if recall_2d is None else recall_2d
    row[columns.PRIOR] = math.log(visibility.prior / (1.0 - visibility.prior))
    for first, reported in ((columns.SWEEP_LOW, own.sweep), (columns.IMAGE_LOW, own.image)):
        row[first : first + 4] = reported.low, reported.high, reported.base, reported.slope
    both = own.both
    row[columns.BOTH_BASE : columns.BOTH_OVERLAP + 1] = both.base, both.sweep, both.image, both.overlap
    row[columns.RECALL_2D] = min(found_2d, _SUREST)
    row[columns.WEAK_RECALL_2D] = min(poorly_2d, _SUREST)
    # silence that states nothing states nothing of how well the camera works, either
    row[columns.WEAK_SHARE] = visibility.weak_share if found_2d > poorly_2d else 0.0
    row[columns.LOW_PX], row[columns.HIGH_PX] = visibility.heights_px
    row[columns.SEEN_SHARE] = max(visibility.seen_share, _LEAST)
    row[columns.RECALL_3D] = min(visibility.recall_3d if recall_3d is None else recall_3d, _SUREST)
    row[columns.FARTHEST_3D] = visibility.farthest_3d
    return row
