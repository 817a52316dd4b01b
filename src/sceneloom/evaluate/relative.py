"""Errors of motions: over steps of time, trajectory or poses (RPE), and over the segments of KITTI's benchmark."""

import re
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.evaluate.association import MatchedPoses, Pairs
from sceneloom.evaluate.report import ErrorStatistics, KittiErrors, RelativeErrors, SegmentErrors
from sceneloom.geometry.rotations import (
    angle_between,
    conjugate_quaternion,
    multiply_quaternions,
    rotate_vectors,
)

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_STEP = 10
"""Lengths [m] of the segments, and how many poses after each other they begin. Source: KITTI's development kit."""

_DELTA = re.compile(r"(?P<amount>\d+(?:\.\d+)?)\s*(?P<unit>[a-z]+)")
_LARGEST = 1e9
_SLACK = 0.75
"""Share of the median spacing of poses by which a step of time may be off: less than one, so that the last poses are
not taken for later ones."""

Steps = tuple[Int64Array, Int64Array]
"""Rows of the first and the last pair of each step."""


def _by_time(pairs: Pairs, amount: float) -> Steps:
    """From each pair to the one nearest to so many seconds later."""
    seconds = pairs.seconds
    wanted = seconds + amount
    after = np.clip(np.searchsorted(seconds, wanted), 1, len(seconds) - 1)
    last = np.where(wanted - seconds[after - 1] < seconds[after] - wanted, after - 1, after)
    spacing = float(np.median(np.diff(seconds)))
    first = np.arange(len(seconds))
    near = np.abs(seconds[last] - wanted) <= _SLACK * spacing
    chosen = np.flatnonzero(near & (last > first))
    return chosen, last[chosen]


def _by_trajectory(pairs: Pairs, amount: float) -> Steps:
    """From each pair to the first that is more than so many metres further along the reference."""
    return _segments(pairs.distances, amount, 1)


def _by_count(pairs: Pairs, amount: float) -> Steps:
    """From each pair to the one so many later."""
    count, many = int(amount), len(pairs.timestamps_ns)
    first = np.arange(max(many - count, 0))
    return first, first + count


_UNITS: Mapping[str, Callable[[Pairs, float], Steps]] = MappingProxyType(
    {"s": _by_time, "m": _by_trajectory, "f": _by_count}
)


def _segments(distances: Float64Array, length: float, step: int) -> Steps:
    """Rows of first and last pose of the segments of a length.

    Source: KITTI's development kit, evaluate_odometry: a segment ends at the first pose whose trajectory exceeds that
        of its
    first by more than the length.
    """
    first = np.arange(0, len(distances), step)
    last = np.searchsorted(distances, distances[first] + length, side="right")
    inside = last < len(distances)
    return first[inside], last[inside]


def parse_delta(text: str) -> tuple[float, str]:
    """Read a step: "1s", "0.5 s", "10m", "5f" (poses).

    Raises:
        OptionError: it is none.
    """
    match = _DELTA.fullmatch(text.strip())
    amount = float(match["amount"]) if match else 0.0
    if match is None or match["unit"] not in _UNITS or not 0 < amount < _LARGEST:
        raise OptionError(f"step {text!r}; expected seconds, metres or poses, such as 1s, 10m, 1f")
    if match["unit"] == "f" and amount != int(amount):
        raise OptionError(f"step {text!r}; expected a whole number of poses")
    return amount, match["unit"]


def _motions(
    positions: Float64Array, quaternions_xyzw: Float64Array, steps: Steps
) -> tuple[Float64Array, Float64Array]:
    """Shift and rotate from the first to the last pose of each step, in the axes of the first."""
    first, last = steps
    back = conjugate_quaternion(quaternions_xyzw[first])
    shifts = rotate_vectors(back, positions[last] - positions[first])
    return shifts, multiply_quaternions(back, quaternions_xyzw[last])


def step_errors(
    pairs: Pairs, aligned: MatchedPoses, steps: Steps
) -> tuple[Float64Array, Float64Array | None]:
    """How far the motions of each step differ: lengths [m], and angles, None without orientations.

    With orientations, the error is (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j), Q the reference and P the estimate; without, the
    difference of the shifts as the aligned world sees them.

    Source: Sturm et al. 2012, "A Benchmark for the Evaluation of RGB-D SLAM Systems", eq. 1.
    """
    ours, theirs = aligned.positions, pairs.reference.positions
    if aligned.quaternions_xyzw is None or pairs.reference.quaternions_xyzw is None:
        first, last = steps
        lengths = np.linalg.norm(ours[last] - ours[first] - theirs[last] + theirs[first], axis=1)
        return lengths, None
    shifts, rotations = _motions(ours, aligned.quaternions_xyzw, steps)
    true_shifts, true_rotations = _motions(theirs, pairs.reference.quaternions_xyzw, steps)
    # rotating by Q⁻¹ does not change how long the difference is
    return np.linalg.norm(shifts - true_shifts, axis=1), angle_between(rotations, true_rotations)


def relative_errors(pairs: Pairs, aligned: MatchedPoses, delta: str) -> RelativeErrors | None:
    """Errors over all steps of one kind, from each pose on; None where no step fits.

    Raises:
        OptionError: the step is none.
    """
    amount, unit = parse_delta(delta)
    if len(pairs.timestamps_ns) < 2:
        return None
    steps = _UNITS[unit](pairs, amount)
    if not len(steps[0]):
        return None
    lengths, angles = step_errors(pairs, aligned, steps)
    first, last = steps
    seconds = float((pairs.seconds[last] - pairs.seconds[first]).mean())
    metres = float((pairs.distances[last] - pairs.distances[first]).mean())
    degrees = None if angles is None else np.degrees(angles)
    moved = metres > 1e-3
    return RelativeErrors(
        delta=delta,
        seconds=seconds,
        metres=metres,
        translation=ErrorStatistics.of(lengths),
        rotation_deg=None if degrees is None else ErrorStatistics.of(degrees),
        translation_percent=100 * float(lengths.mean()) / metres if moved else None,
        rotation_deg_per_m=float(degrees.mean()) / metres if degrees is not None and moved else None,
        translation_per_s=float(lengths.mean()) / seconds,
        rotation_deg_per_s=None if degrees is None else float(degrees.mean()) / seconds,
    )


def kitti_errors(
    pairs: Pairs, aligned: MatchedPoses, *, lengths: Sequence[float] = KITTI_LENGTHS, step: int = KITTI_STEP
) -> KittiErrors | None:
    """Errors per length over segments of several lengths; None where there is none, or no orientations.

    Source: Geiger, Lenz and Urtasun 2012, and evaluate_odometry of the development kit: each error is divided by the
    length of its segment, then all are averaged.
    """
    if aligned.quaternions_xyzw is None or pairs.reference.quaternions_xyzw is None:
        return None
    distances = pairs.distances
    found: dict[float, tuple[Float64Array, Float64Array]] = {}
    for length in lengths:
        steps = _segments(distances, length, step)
        if len(steps[0]):
            shifts, angles = step_errors(pairs, aligned, steps)
            found[length] = (shifts / length, np.zeros(0) if angles is None else angles / length)
    if not found:
        return None
    together = tuple(np.concatenate(parts) for parts in zip(*found.values(), strict=True))
    return KittiErrors(
        overall=_segment_errors(None, *together),
        by_length=tuple(_segment_errors(length, *errors) for length, errors in found.items()),
    )


def _segment_errors(length: float | None, shifts: Float64Array, angles: Float64Array) -> SegmentErrors:
    return SegmentErrors(
        length=length,
        segments=len(shifts),
        translation_percent=100 * float(shifts.mean()),
        rotation_deg_per_m=float(np.degrees(angles.mean())),
    )
