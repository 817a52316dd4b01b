"""Rules about the steps from pose to pose: no vehicle moves or rotates so fast."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.checks.poses import (
    FASTEST,
    FASTEST_ROTATION_DEG,
    ROTATION_FACTOR,
    ROTATION_MARGIN_DEG,
    STEP_FACTOR,
    STEP_MARGIN,
    beyond_neighbours,
)
from sceneloom.checks.recordings.rotating import finite_rows
from sceneloom.checks.recordings.streams import Kind, Stream, location, streams_of_kind
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.formats.poses import GREATEST_NORM_ERROR
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.findings import Severity


def _of_own_time(stream: Stream, usable: BoolArray) -> Int64Array:
    """The usable poses that are the first of their time, (M,) int64."""
    rows = np.flatnonzero(usable)
    first: Int64Array = rows[np.diff(stream.seconds[rows], prepend=-np.inf) > 0]
    return first


def _first_of_each(wrong: BoolArray) -> Iterator[int]:
    """Steps that are wrong; of those that follow each other, as to a wrong pose and back, the first."""
    later = np.concatenate([[False], wrong[:-1]])
    yield from np.flatnonzero(wrong & ~later).tolist()


def _jumps(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.POSES):
        positions = stream.values[:, :3]
        rows = _of_own_time(stream, finite_rows(positions))
        times = np.diff(stream.seconds[rows])
        steps = np.linalg.norm(np.diff(positions[rows], axis=0), axis=1)
        wrong = beyond_neighbours(steps, times, FASTEST, STEP_FACTOR, STEP_MARGIN)
        for k in _first_of_each(wrong):
            row = int(rows[k + 1])
            problem = (
                f"{stream.at(row)} is {steps[k]:.2f} m from the pose {times[k]:.3f} s before, "
                f"{steps[k] / times[k]:.1f} m/s, unlike the steps beside it"
            )
            yield Hit(location(stream, row), problem)


def _rotations(subject: Subject) -> Iterator[Hit]:
    for stream in streams_of_kind(subject, Kind.POSES):
        quaternions_xyzw = stream.values[:, 3:]
        norms = np.sqrt((quaternions_xyzw * quaternions_xyzw).sum(axis=1))
        is_unit: BoolArray = np.abs(norms - 1.0) <= GREATEST_NORM_ERROR
        rows = _of_own_time(stream, is_unit)
        if len(rows) < 2:
            continue
        times = np.diff(stream.seconds[rows])
        rotations = np.degrees(angle_between(quaternions_xyzw[rows[:-1]], quaternions_xyzw[rows[1:]]))
        wrong = beyond_neighbours(
            rotations, times, FASTEST_ROTATION_DEG, ROTATION_FACTOR, ROTATION_MARGIN_DEG
        )
        for k in _first_of_each(wrong):
            row = int(rows[k + 1])
            problem = (
                f"{stream.at(row)} is rotated by {rotations[k]:.1f} degrees against the pose {times[k]:.3f} s before, "
                "unlike the steps beside it"
            )
            yield Hit(location(stream, row), problem)


RULES: tuple[Rule, ...] = (
    Rule(
        "pose-steps",
        Severity.WARNING,
        "Poses of a recording move at up to 150 m/s, and no step is 3 times as fast as those beside it and 1 m more.",
        "See whether the trajectory was pieced together, or tracking was lost and found again.",
        find=_jumps,
    ),
    Rule(
        "pose-rotations",
        Severity.WARNING,
        "Poses of a recording rotate by up to 720 degrees a second, and no step is 3 times as fast as those beside it "
        "and 15 degrees more.",
        "See whether the signs or the order of the quaternion's numbers change.",
        find=_rotations,
    ),
)
