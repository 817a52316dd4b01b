"""Rules about cuboids: unit and order of their angles, sizes and motion."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, read_only
from sceneloom.checks.annotation_table import annotation_parts, cuboid_rows, cuboids_at
from sceneloom.checks.point_frames import points_in_world
from sceneloom.checks.rule import (
    ERROR,
    HINT,
    WARNING,
    Find,
    FrameInHand,
    Hit,
    Rule,
    Subject,
    frames_spread,
    repaired_annotations,
)
from sceneloom.geometry.euler import ORDERS, AngleUnit, rotation_from_cuboid_angles
from sceneloom.scene.annotations import Annotation, CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.scene import Scene
from sceneloom.warnings import WarningKind

_LEAST_STEP_M, _LEAST_SPEED = 0.5, 2.0  # steps that are shorter or slower show no direction [m], [m/s]

_STRIDES, _ENOUGH_STEPS = (1, 4, 16), 50
"""Where so few keyframes show motion to the next one, those farther apart are compared."""

_LONGEST_S = 2.0  # over a longer time an object may rotate, so that its heading is not that of its whole step

_MOST_STEPS, _LEAST_STEPS = 5_000, 5
_OFF_DEG, _ALONG_DEG = 20.0, 10.0
"""A reading whose headings are so far off the motion is wrong if under another one they are along it, in the median."""

_LOOKED_AT, _KEPT_POINTS, _MOST_BOXES, _NEAR_M = 4, 60_000, 150, 60.0
_LEAST_POINTS, _MORE_POINTS, _OFF_GROUND_M = 50, 1.15, 0.2
_SAME_DEG, _SAME_SHARE = 1.0, 0.98
"""Of readings that are so nearly alike, the one that differs least from what is stated is named."""

_SMALLEST_M, _LARGEST_M = 0.01, 100.0  # beyond it even trams and ferries end; a building that long deserves a look

_SIZE_FACTOR, _SIZE_CHANGE_M = 2.0, 0.5
"""Labels grow while more of an object is seen; doubling by more than this is another object."""

_SLACK_M, _ACCELERATION = 2.0, 20.0
"""Twice what tyres hold on a road [m/s²]; with the slack it bounds how far a keyframe lies off the trajectory."""

_FASTEST = 100.0  # no vehicle on a road is faster [m/s]

_STATIONARY_M = 1.0
_ROTATION_DEG, _ROTATION_WITHIN_NS = 100.0, 600_000_000  # nothing on wheels rotates that far within this time


def _readings(stated: CuboidAngles) -> list[CuboidAngles]:
    """The stated reading of the angles, then all others, the likeliest mistakes first."""
    readings = [CuboidAngles(unit.value, order) for unit in AngleUnit for order in ORDERS]
    return sorted(readings, key=lambda one: (one != stated) + (one.order != stated.order))


def _rotations(reading: CuboidAngles, rows: Float64Array) -> Float64Array:
    """(N, 3, 3) `world_from_cuboid` of rows (N, 9); their first columns are the headings."""
    return rotation_from_cuboid_angles(rows[:, 6:9], unit=reading.unit, order=reading.order)


def _worded(reading: CuboidAngles) -> str:
    return f"{reading.unit} in the order {reading.order}"


@dataclass(slots=True, eq=False)
class _Evidence:
    """What the data show about the reading of angles."""

    stated: CuboidAngles  # the reading that the scene states, or is taken to state
    off_deg: dict[CuboidAngles, float]  # median angle of heading (or back) to motion; empty where too little moves
    steps: int  # of how many steps that is
    points: dict[CuboidAngles, int] = field(default_factory=dict)  # in boxes, by reading
    boxes: int = 0  # in which points were counted
    counted: set[str] = field(default_factory=set)  # frames


def _evidence(subject: Subject) -> _Evidence:
    return subject.table("evidence for the reading of angles", _motion_evidence)


def _motion_evidence(subject: Subject) -> _Evidence:
    stated, off_deg = CuboidAngles.of(subject.scene), {}
    rows, directions = _moving(subject)
    for reading in _readings(stated) if len(rows) >= _LEAST_STEPS else ():
        cosines = np.abs(np.sum(_rotations(reading, rows)[:, :, 0] * directions, axis=1)).clip(0, 1)
        off_deg[reading] = float(np.degrees(np.median(np.arccos(cosines))))
    return _Evidence(stated, off_deg, len(rows))


def _moving(subject: Subject) -> tuple[Float64Array, Float64Array]:
    """Some keyframes at which a cuboid moves, (K, 9), and the directions of motion there, (K, 3) unit vectors."""
    # labels of many keyframes a second move too little from one to the next: then those farther apart are compared
    found = _moving_over(subject, _STRIDES[0])
    for stride in _STRIDES[1:]:
        if len(found[0]) >= _ENOUGH_STEPS:
            break
        found = max(found, _moving_over(subject, stride), key=lambda steps: len(steps[0]))
    return found


def _moving_over(subject: Subject, stride: int) -> tuple[Float64Array, Float64Array]:
    """The same, from half the stride before a keyframe to half of it after."""
    table, rows = annotation_parts(subject, "cuboids"), cuboid_rows(subject)
    if len(rows) <= stride:
        return np.zeros((0, 9)), np.zeros((0, 3))
    owners, finite = table.owners, np.asarray(np.isfinite(rows).all(axis=1))
    seconds = (table.timestamps_ns[stride:] - table.timestamps_ns[:-stride]) / 1e9
    steps = rows[stride:, 3:6] - rows[:-stride, 3:6]
    lengths = np.linalg.norm(steps, axis=1)
    moves = (lengths > _LEAST_STEP_M) & (lengths > _LEAST_SPEED * seconds)
    moves &= (owners[stride:] == owners[:-stride]) & finite[stride:] & finite[:-stride]
    chosen = np.flatnonzero(moves & (seconds > 0) & (seconds <= _LONGEST_S))
    chosen = chosen[:: len(chosen) // _MOST_STEPS + 1]
    return rows[chosen + stride // 2], steps[chosen] / lengths[chosen, None]


def _count_in_boxes(subject: Subject, frame: FrameInHand) -> Iterator[Hit]:
    """Count the points in the boxes of a frame under each reading; what they show is reported at the end."""
    lidar, sweep, evidence = frame.sensor, frame.frame, _evidence(subject)
    if (
        isinstance(lidar, LidarSensor)
        and isinstance(sweep, LidarFrame)
        and len(cuboid_rows(subject))
        and frame.path not in evidence.counted
        and frame.number in frames_spread(len(lidar.frames), _LOOKED_AT)
    ):
        points_world = points_in_world(subject, lidar, sweep, _KEPT_POINTS)
        if points_world is not None and len(points_world):
            evidence.counted.add(frame.path)
            _count_points(evidence, points_world, cuboids_at(subject, sweep))
    return iter(())


def _count_points(evidence: _Evidence, points_world: Float64Array, rows: Float64Array) -> None:
    """Count the points in some boxes near the middle of a sweep, except for those just above their floors."""
    from scipy.spatial import cKDTree

    near = np.linalg.norm(rows[:, 3:6] - np.median(points_world, axis=0), axis=1) < _NEAR_M
    rows = rows[near & (rows[:, :3] > 0).all(axis=1)]
    rows = rows[:: len(rows) // _MOST_BOXES + 1]
    evidence.boxes += len(rows)
    lists = cKDTree(points_world).query_ball_point(rows[:, 3:6], np.linalg.norm(rows[:, :3], axis=1) / 2)
    boxes: Int64Array = np.repeat(np.arange(len(rows)), np.array([len(found) for found in lists], np.int64))
    ids = np.concatenate([np.zeros(0, np.int64), *(np.asarray(found, np.int64) for found in lists)])
    away, halves = points_world[ids] - rows[boxes, 3:6], rows[boxes, :3] / 2
    for reading in _readings(evidence.stated):
        points_box = np.einsum("nji,nj->ni", _rotations(reading, rows)[boxes], away)
        inside = (np.abs(points_box) <= halves).all(axis=1) & (points_box[:, 2] > _OFF_GROUND_M - halves[:, 2])
        evidence.points[reading] = evidence.points.get(reading, 0) + int(np.count_nonzero(inside))


def _against_motion(subject: Subject) -> Iterator[Hit]:
    found = _evidence(subject)
    stated, angles = found.stated, found.off_deg
    if not angles or angles[stated] < _OFF_DEG:
        return
    least = min(angles.values())
    best = next(reading for reading, angle in angles.items() if angle <= least + _SAME_DEG)
    if angles[best] < _ALONG_DEG:
        yield Hit(
            "annotations",
            f"read as {_worded(stated)} headings are {angles[stated]:.0f}° off the motion, read as {_worded(best)} "
            f"{angles[best]:.0f}° (median of {found.steps} steps)",
        )


def _against_points(subject: Subject) -> Iterator[Hit]:
    found = _evidence(subject)
    stated, angles, points = found.stated, found.off_deg, found.points
    if not points:
        return
    most = max(points.values())
    best = next(reading for reading, count in points.items() if count >= _SAME_SHARE * most)
    if points[best] < _LEAST_POINTS or points[best] < _MORE_POINTS * points[stated]:
        return
    if angles and angles[best] > max(angles[stated], _ALONG_DEG):
        return
    problem = (
        f"read as {_worded(stated)} {found.boxes} boxes hold {points[stated]} points, read as {_worded(best)} "
        f"{points[best]}"
    )
    if angles:
        problem += (
            f"; headings are {angles[stated]:.0f}° and {angles[best]:.0f}° off the motion, in the median of "
            f"{found.steps} steps"
        )
    yield Hit("annotations", problem)


def _unsaid(subject: Subject) -> Iterator[Hit]:
    """Where nothing states how the angles are meant, report what the data show about the reading that was taken."""
    assumed = {warning.code for warning in subject.notes if warning.kind is WarningKind.ASSUMED}
    if not assumed & {"euler-unit", "euler-order"}:
        return
    found = _evidence(subject)
    stated = found.stated
    other = CuboidAngles(next(unit.value for unit in AngleUnit if unit.value != stated.unit), stated.order)
    evidence = []
    if found.off_deg:
        evidence.append(
            f"headings are {found.off_deg[stated]:.0f}° off the motion in the median of {found.steps} steps, in "
            f"{other.unit} {found.off_deg[other]:.0f}°"
        )
    if found.points:
        held, in_other = found.points[stated], found.points[other]
        evidence.append(f"{found.boxes} boxes hold {held} points, in {other.unit} {in_other}")
    shown = "; ".join(evidence) or "neither motion nor points in the boxes show it"
    yield Hit("annotations", f"not stated; taken to be {_worded(stated)}: {shown}")


def _hits(subject: Subject, bad: Any, state: Callable[[int], str]) -> Iterator[Hit]:
    return annotation_parts(subject, "cuboids").hits(subject, bad, state, within=".values")


def _numbers(values: Float64Array) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values.tolist()) + "]"


def _from_second(subject: Subject, bad_steps: Any) -> BoolArray:
    """Mark the later row of each step that is bad and inside one path."""
    table = annotation_parts(subject, "cuboids")
    return np.concatenate([np.zeros(min(len(table.timestamps_ns), 1), np.bool_), bad_steps & table.inner])


def _not_finite(subject: Subject) -> Iterator[Hit]:
    rows = cuboid_rows(subject)
    bad = (~np.isfinite(rows)).any(axis=1)
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


def _size(is_bad: Callable[[Float64Array], BoolArray], expected: str) -> Find:
    """Find cuboids any length of which, (N, 3) [m], is bad."""

    def find(subject: Subject) -> Iterator[Hit]:
        sizes = cuboid_rows(subject)[:, :3]
        return _hits(
            subject, is_bad(sizes).any(axis=1), lambda row: f"size {_numbers(sizes[row])} m; expected {expected}"
        )

    return find


def _is_absurd(sizes: Float64Array) -> BoolArray:
    lengths = np.abs(sizes)
    return ((lengths > 0) & (lengths < _SMALLEST_M)) | ((lengths > _LARGEST_M) & np.isfinite(lengths))


def _positive_sizes(scene: Scene) -> Scene:
    """Make negative lengths positive: a box is the same seen from its other side."""

    def positive(cuboid: Annotation) -> Annotation:
        if not isinstance(cuboid, CuboidAnnotation) or not (cuboid.path.values[:, :3] < 0).any():
            return cuboid
        values = np.concatenate([np.abs(cuboid.path.values[:, :3]), cuboid.path.values[:, 3:]], axis=1)
        return replace(cuboid, path=replace(cuboid.path, values=read_only(values)))

    return repaired_annotations(scene, positive)


def _size_changes(subject: Subject) -> Iterator[Hit]:
    sizes = np.abs(cuboid_rows(subject)[:, :3])
    smaller, larger = np.minimum(sizes[:-1], sizes[1:]), np.maximum(sizes[:-1], sizes[1:])
    jumps = (larger > _SIZE_FACTOR * smaller) & (larger - smaller > _SIZE_CHANGE_M) & np.isfinite(larger)
    bad = _from_second(subject, jumps.any(axis=1))
    return _hits(subject, bad, lambda row: f"size {_numbers(sizes[row])} m after {_numbers(sizes[row - 1])} m")


def _jumps(subject: Subject) -> Iterator[Hit]:
    """Find keyframes that no vehicle could reach, or that lie off the trajectory between their neighbours."""
    table, positions = annotation_parts(subject, "cuboids"), cuboid_rows(subject)[:, 3:6]
    seconds = np.diff(table.timestamps_ns) / 1e9
    forward = table.inner & (seconds > 0)
    lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    out_of_reach = _from_second(subject, forward & (lengths > _SLACK_M + _FASTEST * seconds))
    off = _off_the_trajectory(positions, seconds, forward)

    def state(row: int) -> str:
        if off[row]:
            return f"{off[row]:.1f} m off the trajectory between the keyframes before and after"
        return f"{lengths[row - 1]:.1f} m from the keyframe before, in {seconds[row - 1]:.3f} s"

    return _hits(subject, out_of_reach | (off > 0), state)


def _off_the_trajectory(positions: Float64Array, seconds: Float64Array, forward: BoolArray) -> Float64Array:
    """How far keyframes lie off the trajectory between their neighbours, (R,) [m]; 0 where an object may."""
    # one misplaced keyframe bends the trajectories of its neighbours, too: only the one farthest off is reported
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
    for path, annotation in subject.annotations_of(CuboidAnnotation):
        positions = annotation.path.values[:, 3:6]
        if annotation.stationary and len(positions) > 1:
            spread = float(np.linalg.norm(np.ptp(positions, axis=0)))
            if spread > _STATIONARY_M:
                yield Hit(f"{path}.stationary", f"true, yet the keyframes lie {spread:.1f} m apart")


def _fast_rotations(subject: Subject) -> Iterator[Hit]:
    table, rows, reading = annotation_parts(subject, "cuboids"), cuboid_rows(subject), CuboidAngles.of(subject.scene)
    steps = np.diff(table.timestamps_ns)
    half_rotation = 180.0 if reading.unit == AngleUnit.DEGREES else np.pi
    reach = np.abs(np.diff(rows[:, 6:9], axis=0)).sum(axis=1) / half_rotation * 180.0
    # no cuboid rotates by more than its three angles do together
    chosen = np.flatnonzero(table.inner & (steps > 0) & (steps <= _ROTATION_WITHIN_NS) & (reach > _ROTATION_DEG))
    before, after = (_rotations(reading, rows[chosen + k])[:, :, 0] for k in (0, 1))
    angles = np.zeros(len(rows))
    angles[chosen + 1] = np.degrees(np.arccos(np.sum(before * after, axis=1).clip(-1, 1)))
    return _hits(
        subject, angles > _ROTATION_DEG, lambda row: f"rotated by {angles[row]:.0f}° in {steps[row - 1] / 1e9:.3f} s"
    )


_REMEDY = "Open the file with `--euler-unit` and `--euler-order` as the message says, and write it again."

# fmt: off
CUBOID_RULES: tuple[Rule, ...] = (
    Rule("cuboid-not-finite", ERROR, "All numbers of a cuboid are finite.", "Remove the keyframe.", find=_not_finite),
    Rule("cuboid-negative-size", ERROR, "No length of a cuboid is negative.",
         "Take the length without its sign: the box is the same.",
         find=_size(lambda sizes: sizes < 0, "positive lengths"), fix=_positive_sizes),
    Rule("cuboid-no-size", ERROR, "No length of a cuboid is zero.", "Draw the cuboid as large as the object.",
         find=_size(lambda sizes: sizes == 0, "positive lengths")),
    Rule("cuboid-size-absurd", WARNING, f"Cuboids are {_SMALLEST_M:g} m to {_LARGEST_M:g} m long, wide and high.",
         "Check that the lengths are in metres, and in the order length, width, height, position, angles.",
         find=_size(_is_absurd, f"{_SMALLEST_M:g} to {_LARGEST_M:g} m")),
    Rule("cuboid-size-changes", WARNING,
         f"From keyframe to keyframe no length changes by more than {_SIZE_FACTOR:g} times and {_SIZE_CHANGE_M:g} m.",
         "Check whether one path joins two objects.", find=_size_changes),
    Rule("cuboid-jump", WARNING,
         "Cuboids move as objects can: no keyframe lies off the trajectory between its neighbours or out of reach.",
         "Check whether one path joins two objects, or a keyframe is misplaced.", find=_jumps),
    Rule("cuboid-rotation", WARNING,
         f"No cuboid rotates by more than {_ROTATION_DEG:g}° within {_ROTATION_WITHIN_NS / 1e9:g} s.",
         "Check whether front and back were mixed up in a keyframe.", find=_fast_rotations),
    Rule("cuboid-stationary-moves", WARNING,
         f"The keyframes of a stationary cuboid lie within {_STATIONARY_M:g} m.",
         "Remove `stationary`, or leave one keyframe.", find=_stationary_moves),
    Rule("cuboid-heading-off-motion", WARNING,
         "Cuboids move along their headings under the unit and order of their angles that is stated.", _REMEDY,
         find=_against_motion),
    Rule("cuboid-angles-off-points", WARNING,
         "No other unit or order of their angles puts clearly more points into the cuboids.", _REMEDY,
         look=_count_in_boxes, conclude=_against_points),
    Rule("cuboid-angles-unsaid", HINT, "The scene says in which unit and order the angles of its cuboids are.",
         "Open the file with `--euler-unit` and `--euler-order`, and write it again, which records them.",
         look=_count_in_boxes, conclude=_unsaid),
)
# fmt: on
