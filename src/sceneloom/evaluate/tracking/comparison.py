"""How good a tracker is: files of its results held against files of the truth."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec

from sceneloom.errors import OptionError
from sceneloom.evaluate.object_files import BothSides, check_classes, check_similarity, classes_of, read_both
from sceneloom.evaluate.overlaps import Similarity, similarity_named
from sceneloom.evaluate.tracking.evaluation import CLASSES, ClassTracking, evaluate_tracking
from sceneloom.evaluate.tracking.protocol import KITTI_RULES, TrackingRules
from sceneloom.scene.warnings import DataWarning, WarningKind


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
    rules: TrackingRules = KITTI_RULES,
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
        raise OptionError(
            f"{results}: no object has an id, which tracks need; see `sceneloom eval detection`"
        )
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
