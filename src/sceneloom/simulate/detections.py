"""What simulated detectors hand out, and how their boxes get scores."""

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.types import Identifier
from sceneloom.simulate.drive import SimulatedDrive
from sceneloom.simulate.randomness import Stream, generator_for
from sceneloom.simulate.scores import ScoreSpec, deal_out, draw_scores

Boxes = TypeVar("Boxes", Boxes3D, Boxes2D)

FALSE = -1
"""The instance of a box where there is no object."""

_OBJECTS = 1 << 31
"""Numbers from here on stand for objects where those below stand for frames."""

FALSE_WITHIN = 60.0
FALSE_HEIGHTS = (0.2, 1.8)
"""False boxes are about things that are no farther from the sensor, and so high above the ground [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedDetections(Generic[Boxes]):
    """What a detector reports of one sweep or image, and what is known about it.

    Attributes:
        boxes: its report, the surest first.
        instances: (N,) int64, the object that each box is of, `FALSE` where there is none.
        duplicates: (N,) bool, another box is the one of that object.
        truth: the exact boxes of all objects that it could have found, with score 1.
        truth_instances: (M,) int64, which they are.
        evidence: (M,) float64, points on them, or pixels.
        occlusions: (M,) float64, share of them that is hidden behind something.
        chances: (M,) float64, to be found.
    """

    boxes: Boxes
    instances: Int64Array
    duplicates: BoolArray
    truth: Boxes
    truth_instances: Int64Array
    evidence: Float64Array
    occlusions: Float64Array
    chances: Float64Array

    @property
    def missed(self) -> Int64Array:
        """Objects that it could have found and did not."""
        missed: Int64Array = np.setdiff1d(self.truth_instances, self.instances)
        return missed


@dataclass(frozen=True, slots=True, eq=False)
class Draft(Generic[Boxes]):
    """One frame before its boxes have scores.

    Attributes:
        report: found boxes, duplicates and false ones, in this order, all with score 0.
        false_rates: expected false boxes by class, 0 where there is no field for them.
        generator: goes on with the scores.
    """

    report: SimulatedDetections[Boxes]
    false_rates: Mapping[str, float]
    generator: np.random.Generator


def frame_generator(stream: Stream, seed: int, sensor_id: Identifier, frame: int) -> np.random.Generator:
    """Random numbers of one detector for one frame of one sensor."""
    return generator_for(seed, stream, zlib.crc32(repr(sensor_id).encode()) << 32 | frame)


def lasting_normals(
    generator: np.random.Generator,
    stream: Stream,
    seed: int,
    sensor_id: Identifier,
    instances: Int64Array,
    *,
    columns: int,
    share: float,
) -> Float64Array:
    """Standard normal numbers of which a part is the same for an object in all frames.

    Args:
        generator: of the frame.
        stream, seed, sensor_id: of the detector.
        instances: (N,) int64, the object of each row, `FALSE` for none.
        columns: how many numbers for each row.
        share: share of the variance that lasts, which is the correlation between two frames.

    Returns:
        (N, columns) float64, each standard normal.
    """
    normals = generator.standard_normal((len(instances), columns))
    if share == 0.0:
        return normals
    for row in np.flatnonzero(instances != FALSE):
        own = frame_generator(stream, seed, sensor_id, _OBJECTS | int(instances[row]))
        normals[row] = np.sqrt(1.0 - share) * normals[row] + np.sqrt(share) * own.standard_normal(columns)
    return normals


def true_frame(drive: SimulatedDrive, sensor_id: Identifier, index: int) -> int:
    """Which frame of the truth a frame of the scene shows."""
    return int(drive.true_frames[sensor_id][index]) if sensor_id in drive.true_frames else index


def chosen_frames(count: int, frames: Iterable[int] | None) -> list[int]:
    """The numbers of the frames to look at, all of them by default.

    Raises:
        OptionError: one is beyond the last frame.
    """
    chosen = list(range(count) if frames is None else frames)
    beyond = [k for k in chosen if not 0 <= k < count]
    if beyond:
        raise OptionError(f"frame {beyond[0]}; expected 0 to {count - 1}")
    return chosen


def with_scores(
    drafts: Sequence[Draft[Boxes]], spec: ScoreSpec, *, repeated: float
) -> list[SimulatedDetections[Boxes]]:
    """Give the boxes of all frames scores that are calibrated over these frames, class by class.

    False boxes of a class that has no object in any of the frames are left out: no score but 0 would be right.
    """
    numbers = np.concatenate([[0], np.cumsum([len(draft.report.chances) for draft in drafts])])
    labels = np.array([label for draft in drafts for label in draft.report.truth.labels], np.str_)
    chances = np.concatenate([np.zeros(0), *(draft.report.chances for draft in drafts)])
    pools = {
        str(label): _Pool.of(
            np.flatnonzero(labels == label),
            chances,
            sum(draft.false_rates.get(str(label), 0.0) for draft in drafts),
            repeated=repeated,
            likeness=spec.likeness,
        )
        for label in np.unique(labels)
    }
    return [_scored(draft, int(numbers[k]), pools, spec) for k, draft in enumerate(drafts)]


@dataclass(frozen=True, slots=True, eq=False)
class _Pool:
    """The objects of one class in all frames.

    Attributes:
        first_like: (M,) float64, share of the false boxes that look like an object or one before it.
        numbers: (M,) int64, ascending, which they are among the objects of all classes.
        true_shares: (M,) float64, as in `LooksLike`.
    """

    first_like: Float64Array
    numbers: Int64Array
    true_shares: Float64Array

    @classmethod
    def of(cls, numbers: Int64Array, chances: Float64Array, false_count: float, **how: float) -> "_Pool":
        looks = deal_out(chances[numbers], false_count, **how)
        return cls(np.cumsum(looks.false_shares), numbers, looks.true_shares)

    def of_objects(self, numbers: Int64Array) -> Float64Array:
        """True shares of objects by their numbers."""
        shares: Float64Array = self.true_shares[np.searchsorted(self.numbers, numbers)]
        return shares

    def of_false_ones(self, generator: np.random.Generator, count: int) -> Float64Array:
        """True shares of the objects that some false boxes look like."""
        which = np.searchsorted(self.first_like, generator.random(count))
        shares: Float64Array = self.true_shares[np.minimum(which, len(self.true_shares) - 1)]
        return shares


def _scored(
    draft: Draft[Boxes], first_number: int, pools: Mapping[str, _Pool], spec: ScoreSpec
) -> SimulatedDetections[Boxes]:
    report = draft.report
    number_of = {int(instance): first_number + k for k, instance in enumerate(report.truth_instances)}
    labels = np.array(report.boxes.labels, np.str_)
    true_shares = np.full(len(labels), np.nan)
    for label, pool in pools.items():
        own, real = labels == label, report.instances != FALSE
        numbers = [number_of[int(instance)] for instance in report.instances[own & real]]
        true_shares[own & real] = pool.of_objects(np.array(numbers, np.int64))
        true_shares[own & ~real] = pool.of_false_ones(draft.generator, int((own & ~real).sum()))
    kept = np.flatnonzero(np.isfinite(true_shares))
    true = (report.instances != FALSE) & ~report.duplicates
    scores = draw_scores(draft.generator, true_shares[kept], true[kept], spec)
    order = np.argsort(-scores, kind="stable")
    rows = kept[order]
    return replace(
        report,
        boxes=replace(report.boxes.select(rows), scores=scores[order], score_form=spec.form),
        instances=report.instances[rows],
        duplicates=report.duplicates[rows],
    )
