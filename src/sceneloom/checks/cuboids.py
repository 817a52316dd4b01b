"""Rules about cuboids: sizes that objects have, and motion that objects can make."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, read_only
from sceneloom.checks.annotation_table import PartTable, cuboid_paths, cuboid_rows
from sceneloom.checks.cuboid_angles import cuboid_headings, stated_reading
from sceneloom.checks.repairing import repaired_annotations
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.geometry.euler import AngleUnit
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.findings import Severity
from sceneloom.scene.scene import Scene

_LARGEST_M = 100.0
"""Beyond it even trams and ferries end; a building that long deserves a look."""

_SMALLEST_M = 0.01

_SIZE_FACTOR = 2.0
_SIZE_CHANGE_M = 0.5
"""Labels grow while more of an object is seen; doubling by more than this is another object."""

_SLACK_M = 2.0
_ACCELERATION = 20.0
"""Twice what tyres hold on a road [m/s²]; with the slack it bounds how far a keyframe lies off the trajectory."""

_FASTEST = 100.0
"""No vehicle on a road is faster [m/s]."""

_STATIONARY_M = 1.0

_ROTATION_DEG = 100.0
_ROTATION_WITHIN_NS = 600_000_000
"""Nothing on wheels rotates that far within this time."""


def _not_finite(subject: Subject) -> Iterator[Hit]:
    rows = cuboid_rows(subject)
    bad = _in_any(~np.isfinite(rows))
    yield from _hits(subject, bad, lambda row: f"{_numbers(rows[row])}; expected finite numbers")
    for path, annotation in subject.annotations():
        for k, activation in enumerate(getattr(annotation, "activations", ())):
            if activation.cuboids is None:
                continue
            seen = activation.cuboids
            # a cuboid that is not reported is null as a whole
            partly = ~np.isfinite(seen).all(axis=1) & ~np.isnan(seen).all(axis=1)
            for row in np.flatnonzero(partly).tolist():
                where = f"{path}.activations[{k}].cuboids[{row}]"
                yield Hit(where, f"{_numbers(seen[row])}; expected finite numbers")


def _hits(subject: Subject, bad: BoolArray, state: Callable[[int], str]) -> Iterator[Hit]:
    return cuboid_paths(subject).hits(subject, bad, state, within=".values")


def _in_any(bad: BoolArray) -> BoolArray:
    """(N,) bool: whether a row has a column at fault."""
    return np.asarray(bad.any(axis=1))


def _numbers(values: Float64Array) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values.tolist()) + "]"


def _negative_size(subject: Subject) -> Iterator[Hit]:
    sizes = cuboid_rows(subject)[:, :3]
    bad = _in_any(sizes < 0)
    return _hits(subject, bad, lambda row: f"size {_numbers(sizes[row])} m; expected positive lengths")


def _positive_sizes(scene: Scene) -> Scene:
    """Rotate negative lengths positive: a box is the same seen from its other side."""
    return repaired_annotations(scene, _with_positive_size)


def _with_positive_size(cuboid: Annotation) -> Annotation:
    if not isinstance(cuboid, CuboidAnnotation):
        return cuboid
    values = cuboid.path.values
    if not (values[:, :3] < 0).any():
        return cuboid
    positive = values.copy()
    positive[:, :3] = np.abs(positive[:, :3])
    return replace(cuboid, path=replace(cuboid.path, values=read_only(positive)))


def _no_size(subject: Subject) -> Iterator[Hit]:
    sizes = cuboid_rows(subject)[:, :3]
    bad = _in_any(sizes == 0)
    return _hits(subject, bad, lambda row: f"size {_numbers(sizes[row])} m; expected positive lengths")


def _absurd_size(subject: Subject) -> Iterator[Hit]:
    sizes = np.abs(cuboid_rows(subject)[:, :3])
    bad = _in_any(((sizes > 0) & (sizes < _SMALLEST_M)) | ((sizes > _LARGEST_M) & np.isfinite(sizes)))
    expected = f"expected {_SMALLEST_M:g} to {_LARGEST_M:g} m"
    return _hits(subject, bad, lambda row: f"size {_numbers(sizes[row])} m; {expected}")


def _size_changes(subject: Subject) -> Iterator[Hit]:
    table, sizes = cuboid_paths(subject), np.abs(cuboid_rows(subject)[:, :3])
    before, after = sizes[:-1], sizes[1:]
    smaller, larger = np.minimum(before, after), np.maximum(before, after)
    jumps = (larger > _SIZE_FACTOR * smaller) & (larger - smaller > _SIZE_CHANGE_M) & np.isfinite(larger)
    bad = _from_second(table, _in_any(jumps))
    return _hits(
        subject, bad, lambda row: f"size {_numbers(sizes[row])} m after {_numbers(sizes[row - 1])} m"
    )


def _from_second(table: PartTable, bad_steps: BoolArray) -> BoolArray:
    """Mark the later row of each step that is bad and inside one path."""
    bad = np.zeros(len(table.timestamps_ns), bool)
    bad[1:] = bad_steps & table.inner
    return bad


def _jumps(subject: Subject) -> Iterator[Hit]:
    """Find keyframes that no vehicle could reach, or that lie off the trajectory between their neighbours."""
    table, positions = cuboid_paths(subject), cuboid_rows(subject)[:, 3:6]
    seconds = np.diff(table.timestamps_ns) / 1e9
    forward = table.inner & (seconds > 0)
    trajectory = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    out_of_reach = _from_second(table, forward & (trajectory > _SLACK_M + _FASTEST * seconds))
    off = _off_the_trajectory(positions, seconds, forward)

    def state(row: int) -> str:
        if off[row]:
            return f"{off[row]:.1f} m off the trajectory between the keyframes before and after"
        return f"{trajectory[row - 1]:.1f} m from the keyframe before, in {seconds[row - 1]:.3f} s"

    bad = out_of_reach | (off > 0)
    return _hits(subject, bad, state)


def _off_the_trajectory(positions: Float64Array, seconds: Float64Array, forward: BoolArray) -> Float64Array:
    """How far keyframes lie off the trajectory between their neighbours, (R,) float64 [m]; 0 where an object may.

    One misplaced keyframe bends the trajectories of its neighbours, too: only the one that is farthest off is reported.
    """
    off = np.zeros(len(positions))
    if len(positions) < 3:
        return off
    whole = np.where(forward[:-1] & forward[1:], seconds[:-1] + seconds[1:], 1.0)
    share = (seconds[:-1] / whole)[:, None]
    between = positions[:-2] * (1 - share) + positions[2:] * share
    gaps = np.where(forward[:-1] & forward[1:], np.linalg.norm(positions[1:-1] - between, axis=1), 0.0)
    limit = _SLACK_M + _ACCELERATION / 2 * seconds[:-1] * seconds[1:]
    before, after = np.r_[0.0, gaps[:-1]], np.r_[gaps[1:], 0.0]
    off[1:-1] = np.where((gaps > limit) & (gaps >= before) & (gaps >= after), gaps, 0.0)
    return off


def _stationary_moves(subject: Subject) -> Iterator[Hit]:
    for path, annotation in subject.annotations():
        if isinstance(annotation, CuboidAnnotation) and annotation.stationary:
            positions = annotation.path.values[:, 3:6]
            spread = float(np.linalg.norm(np.ptp(positions, axis=0))) if len(positions) > 1 else 0.0
            if spread > _STATIONARY_M:
                yield Hit(f"{path}.stationary", f"true, yet the keyframes lie {spread:.1f} m apart")


def _rotations(subject: Subject) -> Iterator[Hit]:
    table, rows = cuboid_paths(subject), cuboid_rows(subject)
    steps = np.diff(table.timestamps_ns)
    reading = stated_reading(subject.scene)
    half_rotation = 180.0 if reading.unit == AngleUnit.DEGREES else np.pi
    reach = np.abs(np.diff(rows[:, 6:9], axis=0)).sum(axis=1) / half_rotation * 180.0
    # no cuboid rotates by more than its three angles do together
    may = table.inner & (steps > 0) & (steps <= _ROTATION_WITHIN_NS) & (reach > _ROTATION_DEG)
    steps_chosen = np.flatnonzero(may)
    before = cuboid_headings(rows[steps_chosen], reading)
    after = cuboid_headings(rows[steps_chosen + 1], reading)
    angles = np.degrees(np.arccos(np.sum(before * after, axis=1).clip(-1, 1)))
    bad = np.zeros(len(rows), bool)
    bad[steps_chosen[angles > _ROTATION_DEG] + 1] = True
    angle_of = dict(zip((steps_chosen + 1).tolist(), angles.tolist(), strict=True))
    return _hits(subject, bad, lambda row: f"rotated by {angle_of[row]:.0f}° in {steps[row - 1] / 1e9:.3f} s")


RULES: tuple[Rule, ...] = (
    Rule(
        "cuboid-not-finite",
        Severity.ERROR,
        "All numbers of a cuboid are finite.",
        "Take the keyframe out.",
        find=_not_finite,
    ),
    Rule(
        "cuboid-negative-size",
        Severity.ERROR,
        "No length of a cuboid is negative.",
        "Take the length without its sign: the box is the same.",
        find=_negative_size,
        fix=_positive_sizes,
    ),
    Rule(
        "cuboid-no-size",
        Severity.ERROR,
        "No length of a cuboid is zero.",
        "Draw the cuboid as large as the object.",
        find=_no_size,
    ),
    Rule(
        "cuboid-size-absurd",
        Severity.WARNING,
        f"Cuboids are {_SMALLEST_M:g} m to {_LARGEST_M:g} m long, wide and high.",
        "Look whether the lengths are in metres, and in the order length, width, height, position, angles.",
        find=_absurd_size,
    ),
    Rule(
        "cuboid-size-changes",
        Severity.WARNING,
        f"From keyframe to keyframe no length changes by more than {_SIZE_FACTOR:g} times and {_SIZE_CHANGE_M:g} m.",
        "Look whether one path joins two objects.",
        find=_size_changes,
    ),
    Rule(
        "cuboid-jump",
        Severity.WARNING,
        "Cuboids move as objects can: no keyframe lies off the trajectory between its neighbours or out of reach.",
        "Look whether one path joins two objects, or a keyframe is misplaced.",
        find=_jumps,
    ),
    Rule(
        "cuboid-rotation",
        Severity.WARNING,
        f"No cuboid rotates by more than {_ROTATION_DEG:g}° within {_ROTATION_WITHIN_NS / 1e9:g} s.",
        "Look whether front and back were mixed up in a keyframe.",
        find=_rotations,
    ),
    Rule(
        "cuboid-stationary-moves",
        Severity.WARNING,
        f"The keyframes of a stationary cuboid lie within {_STATIONARY_M:g} m.",
        "Take `stationary` out, or leave one keyframe.",
        find=_stationary_moves,
    ),
)
