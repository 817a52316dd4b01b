"""How good detections are: files of them held against files of the truth."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec

from sceneloom.errors import OptionError
from sceneloom.evaluate.detection.evaluation import (
    CLASSES,
    KITTI_DIFFICULTIES,
    KITTI_IN_SPACE,
    ClassDetection,
    evaluate_detection,
)
from sceneloom.evaluate.detection.rules import DetectionRules
from sceneloom.evaluate.object_files import BothSides, check_classes, check_similarity, classes_of, read_both
from sceneloom.evaluate.overlaps import Similarity, similarity_named
from sceneloom.scene.warnings import DataWarning

SIMILARITIES = (Similarity.IMAGE, Similarity.ABOVE, Similarity.SPACE)
"""Those of KITTI's object benchmark."""


class DetectionReport(msgspec.Struct, frozen=True, kw_only=True):
    """One comparison.

    Attributes:
        results, truth: what was compared.
        sequences: names, in order.
        classes: by class, the figures of each similarity.
        warnings: what is to be known about the numbers.
    """

    results: str
    truth: str
    sequences: tuple[str, ...]
    classes: dict[str, tuple[ClassDetection, ...]]
    warnings: tuple[DataWarning, ...] = ()


def compare_detections(
    results: Path | str,
    truth: Path | str,
    *,
    classes: Sequence[str] = (),
    sequences: Sequence[str] = (),
    similarities: Sequence[Similarity | str] = (),
    least_overlap: float | None = None,
    difficulties: Sequence[str] = (),
    degrees_of_freedom: float | None = None,
    rules: DetectionRules = KITTI_IN_SPACE,
    lenient: bool = False,
    corrections: str = "apply",
) -> DetectionReport:
    """Hold detections against the truth, by KITTI's rules.

    Args:
        results, truth: files or folders, as of `object_files.read_both`.
        classes: those to evaluate. [default: KITTI's of the truth, else all of the truth]
        sequences: those to take. [default: all of the truth]
        similarities: what says how much two boxes overlap. [default: all of `SIMILARITIES` that both sides have]
        least_overlap: what pairs must exceed. [default: KITTI's, by class]
        difficulties: of `DIFFICULTIES`. [default: KITTI's three; `all` where the truth has no boxes in images]
        degrees_of_freedom: of the detections' errors, as of `judge_covariances`.
        rules: all else that counts.
        lenient, corrections: as of `object_files.read_both`.

    Raises:
        DataError: a file is missing or holds something wrong.
        OptionError: both sides cannot be compared, or not in this way.
    """
    sides = read_both(results, truth, sequences=sequences, lenient=lenient, corrections=corrections)
    check_classes(sides, classes)
    chosen = tuple(map(similarity_named, similarities)) or tuple(
        known for known in SIMILARITIES if known in sides.similarities
    )
    for similarity in chosen or SIMILARITIES[-1:]:
        if similarity is Similarity.DISTANCE:
            raise OptionError(f"similarity 'distance'; detections take {', '.join(SIMILARITIES)}")
        check_similarity(sides, similarity)
    labels = tuple(classes) or classes_of(sides, CLASSES)
    reported = [
        evaluate_detection(
            sides.results,
            sides.truth,
            classes=labels,
            difficulties=difficulties or _usual_difficulties(sides),
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


def _usual_difficulties(sides: BothSides) -> tuple[str, ...]:
    in_images = any(len(table) and table.corners_xyxy is not None for table in sides.truth.values())
    return KITTI_DIFFICULTIES if in_images else ("all",)
