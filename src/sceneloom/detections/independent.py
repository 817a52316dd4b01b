r"""Two detectors whose scores are probabilities and who err independently of one another: nothing was fitted to data.

A location where a detector could report something holds an object (e) with the prior probability π. A score is what it
says: of the boxes with the score s the share s is true. By Bayes' theorem a box with the score s has reported

    P(box, s | e) / P(box, s | not e) = [s / (1 - s)] / [π / (1 - π)].

Given what is there, detectors err independently of one another, so the ratios of both multiply:

    odds(e | both) = odds(s_3d) odds(s_2d) / odds(π).

Two false boxes seldom fall on one location: the smaller π, the more an agreement says. A detector that had to see the
object and reports nothing reports too, with its chance D to find what is there:

    odds(e | box, none) = odds(s) (1 - D),

since where nothing is, it was all but certain to report nothing.

Source: Bayes' theorem under conditional independence: Chen et al. 2022, "Multimodal Object Detection via Probabilistic
Ensembling", eq. 4 for the agreement; Thrun, Burgard and Fox 2005, "Probabilistic Robotics", ch. 4.2 for log odds.
"""

import math
from types import MappingProxyType

from sceneloom.detections.classes import KINDS, Kind
from sceneloom.detections.detectors import (
    Agreement,
    BoxNoise,
    ClassStatistics,
    Detectors,
    ImageNoise,
    Reported,
    Visibility,
)

INDEPENDENT = "independent"

CENTER_SIGMAS = (0.05, 0.03)
"""Deviation of a middle along an axis of its box: this share of its usual size along that axis, plus so much [m]."""
SIZE_SIGMAS = (0.06, 0.04)
"""Deviation of a size: this share of the usual one, plus so much [m]."""
YAW_SIGMA = 0.1
"""Deviation of a heading [rad]."""
BY_RANGE = 0.5
"""Deviations grow with the root of the range."""
IMAGE_SIGMAS = ImageNoise(across=(2.0, 0.03), upright=(2.0, 0.03), height=(2.0, 0.06))
"""Clocks and calibration leave two pixels."""
SUREST = 14.0
"""Scores beyond these logarithms of odds report no more."""


def independent_detectors(
    *, prior: float = 0.1, recall_2d: float = 0.9, recall_3d: float = 0.5, least_height_px: float = 25.0
) -> Detectors:
    """Give detectors of whom nothing is known but what they find.

    Args:
        prior: share of the locations at which a detector could report something that hold an object.
        recall_2d, recall_3d: share of the objects in its view that the detector of images and that of sweeps finds.
        least_height_px: what is less high in the image need not have been found there [px].
    """
    visibility = Visibility(
        recall_2d=recall_2d,
        recall_3d=recall_3d,
        weak_recall_2d=recall_2d,
        heights_px=(least_height_px, least_height_px),
        prior=prior,
    )
    reported = Reported(low=-SUREST, high=SUREST, base=0.0, slope=1.0)
    both = Agreement(base=-math.log(prior / (1.0 - prior)), sweep=1.0, image=1.0, overlap=0.0)
    classes = {
        name: ClassStatistics(
            sweep=reported,
            image=reported,
            both=both,
            visibility=visibility,
            noise=_noise(kind),
            image_noise=IMAGE_SIGMAS,
        )
        for name, kind in KINDS.items()
    }
    provenance = MappingProxyType(
        {"data": "none: scores are taken for probabilities of independent detectors"}
    )
    return Detectors(
        name=INDEPENDENT, classes=MappingProxyType(classes), otherwise="car", provenance=provenance
    )


def _noise(kind: Kind) -> BoxNoise:
    length, width, height = kind.size_lwh
    return BoxNoise(
        scores=(0.0, 0.0),
        center_base=(
            _log(CENTER_SIGMAS, length),
            _log(CENTER_SIGMAS, width),
            _log(CENTER_SIGMAS, height),
        ),
        center_by_score=(0.0, 0.0, 0.0),
        center_by_range=(BY_RANGE, BY_RANGE, BY_RANGE),
        size_base=(_log(SIZE_SIGMAS, length), _log(SIZE_SIGMAS, width), _log(SIZE_SIGMAS, height)),
        size_by_score=(0.0, 0.0, 0.0),
        size_by_range=(BY_RANGE, BY_RANGE, BY_RANGE),
        yaw=(math.log(YAW_SIGMA), 0.0, 0.0),
    )


def _log(sigmas: tuple[float, float], side: float) -> float:
    return math.log(sigmas[0] * side + sigmas[1])
