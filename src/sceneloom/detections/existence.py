r"""How likely it is that an object exists which one detector or both report.

A place where a detector could report something holds an object (e) with the prior probability π. A score is what it
says: of the boxes with the score s the share s is true. By Bayes' theorem a box with the score s has told

    P(box, s | e) / P(box, s | not e) = [s / (1 - s)] / [π / (1 - π)].

Given what is there, detectors err independently of one another, so the ratios of both multiply:

    odds(e | both) = odds(s_3d) odds(s_2d) / odds(π).

Two false boxes seldom fall on one place: the smaller π, the more an agreement says. A detector that had to see the
object and reports nothing tells too, with its chance D to find what is there:

    odds(e | box, none) = odds(s) (1 - D),

since where nothing is, it was all but certain to report nothing. D falls with what the sensor can see of it. A score
that is no number tells nothing, and leaves the prior. The formulas are compiled: `kernels.existence_odds`.

Source: Bayes' theorem under conditional independence: Chen et al. 2022, "Multimodal Object Detection via Probabilistic
Ensembling", eq. 4 for the agreement; Thrun, Burgard and Fox 2005, "Probabilistic Robotics", ch. 4.2 for log odds.
"""

from functools import lru_cache

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.detections.classes import UNLISTED
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.kernels import existence_odds as columns


@lru_cache(maxsize=256)
def existence_table(settings: ProjectionSettings) -> Float64Array:
    """Give what detectors are like as the compiled formulas take it.

    Returns:
        (K + 1, COLUMNS) float64, a row for each class of `classes.KINDS` and a last one for whatever else there is; the
        columns are those of `kernels.existence_odds`.
    """
    row = np.empty(columns.COLUMNS)
    row[columns.PRIOR] = np.log(settings.prior / (1.0 - settings.prior))
    row[columns.RECALL_2D], row[columns.RECALL_3D] = settings.recall_2d, settings.recall_3d
    row[columns.LEAST_HEIGHT_PX], row[columns.FARTHEST_3D] = settings.least_height_px, settings.farthest_3d
    return read_only(np.tile(row, (UNLISTED + 1, 1)))
