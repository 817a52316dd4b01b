"""How good a tracker is: its results of several sequences held against the truth."""

from collections.abc import Mapping, Sequence

import msgspec

from sceneloom.errors import ArrayError
from sceneloom.evaluate.objects import ObjectTable
from sceneloom.evaluate.sequences import check_sequences
from sceneloom.evaluate.tracking.protocol import KITTI_RULES, TrackingRules, apply_rules
from sceneloom.evaluate.tracking.scores import (
    ClearScores,
    HotaScores,
    IdentityScores,
    combine_clear,
    combine_hota,
    combine_identity,
    score_clear,
    score_hota,
    score_identity,
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

    hota: HotaScores
    clear: ClearScores
    identity: IdentityScores
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
    rules: TrackingRules = KITTI_RULES,
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
    rules: TrackingRules = KITTI_RULES,
    frame_count: int | None = None,
) -> TrackingScores:
    """Hold what a tracker found of one class in one sequence against the truth.

    Raises:
        ArrayError: an id comes twice in a frame, or a frame is beyond the sequence.
        OptionError: boxes are missing.
    """
    sequence = apply_rules(found, truth, label, rules=rules, frame_count=frame_count)
    return TrackingScores(
        hota=score_hota(sequence),
        clear=score_clear(sequence, least_similarity=rules.least_similarity),
        identity=score_identity(sequence, least_similarity=rules.least_similarity),
        true_boxes=len(sequence.true_ids),
        found_boxes=len(sequence.found_ids),
        true_objects=sequence.true_count,
        found_objects=sequence.found_count,
    )


def combine_scores(parts: Sequence[TrackingScores]) -> TrackingScores:
    """Take several sequences as one, as TrackEval does."""
    names = ("true_boxes", "found_boxes", "true_objects", "found_objects")
    return TrackingScores(
        hota=combine_hota([part.hota for part in parts]),
        clear=combine_clear([part.clear for part in parts]),
        identity=combine_identity([part.identity for part in parts]),
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
