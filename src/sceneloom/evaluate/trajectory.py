"""Evaluation of a trajectory: association, alignment, absolute, relative and KITTI errors, report and plot."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np
from msgspec import structs

from sceneloom.arrays import Float64Array, FloatArray, Int64Array
from sceneloom.errors import ArrayError, OptionError, PoseError
from sceneloom.evaluate.plot import check_plot
from sceneloom.formats.base.output import replacing
from sceneloom.formats.trajectories.table import content_of, read_trajectory_file
from sceneloom.formats.trajectories.text_formats import of_fixes
from sceneloom.formats.trajectories.trajectory_file import FARTHEST, TrajectoryFile
from sceneloom.geometry.interpolation import interpolate_poses
from sceneloom.geometry.rotations import (
    angle_between,
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
    normalise_quaternion,
    quaternion_from_matrix,
    rotate_vectors,
)
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.warnings import DataWarning, WarningKind


class ErrorStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Errors in a few numbers, in the unit of the errors.

    Attributes:
        count: how many errors.
        mean, median, min, max: of them.
        rms: root of the mean square.
        percentile_95: what 95 % of them do not exceed, linear between neighbours.
        std: standard deviation around the mean, of the errors themselves (divided by count).
    """

    count: int
    mean: float
    rms: float
    median: float
    percentile_95: float
    max: float
    min: float
    std: float

    @classmethod
    def of(cls, errors: FloatArray) -> "ErrorStatistics":
        """Sum up (N,) errors, N >= 1."""
        return cls(
            count=len(errors),
            mean=float(errors.mean()),
            rms=float(np.sqrt((errors**2).mean())),
            median=float(np.median(errors)),
            percentile_95=float(np.percentile(errors, 95)),
            max=float(errors.max()),
            min=float(errors.min()),
            std=float(errors.std()),
        )


class AlignmentReport(msgspec.Struct, frozen=True, kw_only=True):
    """How the estimate was laid onto the reference: p_reference = scale · R · p_estimate + translation.

    Attributes:
        kind: one of `ALIGNMENTS`.
        poses: how many poses it was found from.
        quaternion_xyzw: R.
        translation: [m].
        scale: 1 but for `sim3`.
    """

    kind: str
    poses: int
    quaternion_xyzw: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    scale: float


class AbsoluteErrors(msgspec.Struct, frozen=True, kw_only=True):
    """How far the aligned estimate is from the reference at the same times (ATE).

    Attributes:
        translation: [m].
        horizontal, vertical: [m], its parts along x and y, and along z, of the reference's world.
        rotation_deg: angle between the orientations [deg], None where one of both has none.
    """

    translation: ErrorStatistics
    horizontal: ErrorStatistics
    vertical: ErrorStatistics
    rotation_deg: ErrorStatistics | None


class RelativeErrors(msgspec.Struct, frozen=True, kw_only=True):
    """How far motions over equal steps differ (RPE).

    Attributes:
        delta: the step: "1s", "10m", "1f".
        seconds, metres: how long the steps are on the average, in time and along the reference.
        translation: [m].
        rotation_deg: [deg], None where one of both has no orientations.
        translation_percent: mean error per trajectory of the step [%], None where the reference stands.
        rotation_deg_per_m: the same of the rotation [deg/m].
        translation_per_s: mean error per second [m/s].
        rotation_deg_per_s: the same of the rotation [deg/s].
    """

    delta: str
    seconds: float
    metres: float
    translation: ErrorStatistics
    rotation_deg: ErrorStatistics | None
    translation_percent: float | None
    rotation_deg_per_m: float | None
    translation_per_s: float
    rotation_deg_per_s: float | None


class SegmentErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Mean errors over segments of one length, as in KITTI's odometry benchmark.

    Attributes:
        length: [m], None for all lengths together.
        segments: how many.
        translation_percent: error per length [%].
        rotation_deg_per_m: [deg/m].
    """

    length: float | None
    segments: int
    translation_percent: float
    rotation_deg_per_m: float


class KittiErrors(msgspec.Struct, frozen=True, kw_only=True):
    """The two numbers of KITTI's odometry benchmark, and what they are made of.

    Attributes:
        overall: over all segments.
        by_length: over those of each length.
    """

    overall: SegmentErrors
    by_length: tuple[SegmentErrors, ...]


class TrajectoryReport(msgspec.Struct, frozen=True, kw_only=True):
    """One comparison.

    Attributes:
        estimate, reference: names of what was compared.
        estimate_poses, reference_poses: how many each has within the time that was asked for.
        pairs: how many were compared.
        start_ns, stop_ns: times of the first and the last pair [ns], on the reference's clock.
        seconds: from the first pair to the last.
        coverage: share of the reference's time in which the estimate has poses, 0 to 1.
        path_length: [m], along the reference, over the pairs.
        estimate_path_length: [m], along the estimate as it was given, over the pairs.
        alignment: how the estimate was laid onto the reference.
        absolute: errors at the same times.
        relative: errors of motions, by step.
        kitti: KITTI's two numbers; None where the trajectory is shorter than its shortest segment, or has no
            orientations.
        warnings: what is to be known about the numbers.
    """

    estimate: str
    reference: str
    estimate_poses: int
    reference_poses: int
    pairs: int
    start_ns: int
    stop_ns: int
    seconds: float
    coverage: float
    path_length: float
    estimate_path_length: float
    alignment: AlignmentReport
    absolute: AbsoluteErrors
    relative: tuple[RelativeErrors, ...]
    kitti: KittiErrors | None
    warnings: tuple[DataWarning, ...] = ()


_TOLERANCES_NS = {"interpolate": 100_000_000, "nearest": 10_000_000}
"""By trajectory of association, how far the nearest pose of the reference may be where nothing else is stated [ns]."""

_SHORTEST_GAP_NS = 1_000_000_000
_GAP_SPACINGS = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPoses:
    """One side of the pairs.

    Attributes:
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64, unit, or None.
    """

    positions: Float64Array
    quaternions_xyzw: Float64Array | None

    def at(self, rows: Int64Array | slice) -> "MatchedPoses":
        """Some of them."""
        quaternions = self.quaternions_xyzw
        return MatchedPoses(self.positions[rows], None if quaternions is None else quaternions[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Poses of both at the same times.

    Attributes:
        timestamps_ns: (N,) int64 [ns], on the reference's clock, strictly increasing.
        estimate, reference: the poses, N each.
    """

    timestamps_ns: Int64Array
    estimate: MatchedPoses
    reference: MatchedPoses

    @property
    def seconds(self) -> Float64Array:
        """Times since the first pair, (N,) float64 [s]."""
        return np.asarray((self.timestamps_ns - self.timestamps_ns[0]) / 1e9)

    @property
    def distances(self) -> Float64Array:
        """The trajectory along the reference up to each pair, (N,) float64 [m]."""
        return _trajectory_along(self.reference.positions)


def _trajectory_along(positions: Float64Array) -> Float64Array:
    """The trajectory up to each of (N, 3) positions, (N,) float64 [m]."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _checked_trajectory(trajectory: Trajectory) -> Trajectory:
    """A trajectory that can be computed with, its orientations of length 1.

    Raises:
        ArrayError: it is empty, its times do not rise, or a number is not finite or of no location.
    """
    if not len(trajectory.timestamps_ns):
        raise ArrayError(f"trajectory {trajectory.name!r}: empty; expected at least one pose")
    for name in ("positions", "quaternions_xyzw"):
        values = getattr(trajectory, name)
        if values is not None and not (np.abs(values) <= FARTHEST).all():
            row = int(np.flatnonzero(~(np.abs(values) <= FARTHEST).all(axis=1))[0])
            raise ArrayError(
                f"trajectory {trajectory.name!r}: {name}[{row}]: {values[row].tolist()}; expected finite numbers, "
                f"metres "
                f"within ±{FARTHEST:g}"
            )
    back = np.flatnonzero(trajectory.timestamps_ns[1:] <= trajectory.timestamps_ns[:-1])
    if len(back):
        row = int(back[0]) + 1
        raise ArrayError(
            f"trajectory {trajectory.name!r}: timestamps_ns[{row}]: {trajectory.timestamps_ns[row]}; expected rising "
            f"times"
        )
    quaternions = trajectory.quaternions_xyzw
    return Trajectory(
        trajectory.name,
        trajectory.timestamps_ns,
        trajectory.positions,
        None if quaternions is None else normalise_quaternion(quaternions),
    )


def associate_poses(
    estimate: Trajectory, reference: Trajectory, *, how: str = "interpolate", tolerance_ns: int | None = None
) -> Pairs:
    """Pair poses by time, each with at most one other.

    Args:
        estimate: on the reference's clock.
        how: "interpolate": the reference is taken at the times of the estimate, between its poses; "nearest": the
            reference's own poses, where two are each other's nearest.
        tolerance_ns: how far the nearest pose of the reference may be [ns]; None: `_TOLERANCES_NS`.

    Raises:
        OptionError: `how` or the tolerance is wrong.
        PoseError: no pose has a partner.
    """
    if how not in _TOLERANCES_NS:
        raise OptionError(f"association {how!r}; expected one of {', '.join(_TOLERANCES_NS)}")
    tolerance_ns = _TOLERANCES_NS[how] if tolerance_ns is None else tolerance_ns
    if tolerance_ns < 0:
        raise OptionError(f"tolerance {tolerance_ns / 1e9:g} s; expected 0 or more")
    times = estimate.timestamps_ns
    nearest = _nearest(reference.timestamps_ns, times)
    away = np.abs(times - reference.timestamps_ns[nearest])
    rows = np.flatnonzero(away <= tolerance_ns)
    if how == "nearest":
        mutual = _nearest(times, reference.timestamps_ns)[nearest]
        rows = rows[mutual[rows] == rows]
        found = MatchedPoses(reference.positions, reference.quaternions_xyzw).at(nearest[rows])
    else:
        rows = rows[(times[rows] >= reference.timestamps_ns[0]) & (times[rows] <= reference.timestamps_ns[-1])]
        found = _interpolated(reference, times[rows])
    if not len(rows):
        raise PoseError(_without_pairs(estimate, reference, int(away.min()), tolerance_ns))
    return Pairs(times[rows], MatchedPoses(estimate.positions, estimate.quaternions_xyzw).at(rows), found)


def _nearest(timestamps_ns: Int64Array, query_ns: Int64Array) -> Int64Array:
    """Row of the nearest time to each time asked for, the earlier of two equally near, (M,) int64."""
    after = np.clip(np.searchsorted(timestamps_ns, query_ns), 0, len(timestamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(query_ns - timestamps_ns[before]) <= np.abs(timestamps_ns[after] - query_ns)
    return np.where(closer, before, after)


def _interpolated(reference: Trajectory, times_ns: Int64Array) -> MatchedPoses:
    quaternions = reference.quaternions_xyzw
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(reference.timestamps_ns), 1)) if quaternions is None else quaternions
    positions, rotations, _ = interpolate_poses(reference.timestamps_ns, reference.positions, rotations, times_ns)
    return MatchedPoses(positions, None if quaternions is None else rotations)


def _without_pairs(estimate: Trajectory, reference: Trajectory, away_ns: int, tolerance_ns: int) -> str:
    (a, b), (c, d) = (
        (int(trajectory.timestamps_ns[0]), int(trajectory.timestamps_ns[-1])) for trajectory in (estimate, reference)
    )
    spans = (
        f"no pose of {estimate.name!r} ({_text(a)} to {_text(b)} s) has a partner in {reference.name!r} "
        f"({_text(c)} to {_text(d)} s)"
    )
    if b < c or d < a:
        return (
            f"{spans}: they do not overlap in time; if both clocks started with the drive, add "
            f"{_text(c - a)} s to the estimate's times (`--offset {_text(c - a)}`)"
        )
    return (
        f"{spans} within {tolerance_ns / 1e9:g} s; the nearest one is {away_ns / 1e9:.6g} s away: "
        "allow more (`--tolerance`)"
    )


def _text(timestamp_ns: int) -> str:
    whole, rest = divmod(abs(timestamp_ns), 1_000_000_000)
    decimals = f"{rest:09d}".rstrip("0") or "0"
    return f"{'-' if timestamp_ns < 0 else ''}{whole}.{decimals}"


def covered_share(estimate_ns: Int64Array, reference_ns: Int64Array) -> float:
    """The share of the reference's time in which the estimate has poses, without its gaps.

    A gap is longer than a second and than five times the median distance of poses.
    """
    first, last = int(reference_ns[0]), int(reference_ns[-1])
    if first == last:
        return float(np.isin(first, estimate_ns))
    steps = np.diff(estimate_ns)
    longest = max(_SHORTEST_GAP_NS, _GAP_SPACINGS * float(np.median(steps)) if len(steps) else 0)
    starts, stops = np.clip(estimate_ns[:-1], first, last), np.clip(estimate_ns[1:], first, last)
    return float((stops - starts)[steps <= longest].sum() / (last - first))


@dataclass(frozen=True, slots=True, eq=False)
class _TrajectoryErrors:
    """The errors of all pairs, for plots.

    Attributes:
        estimate_name, reference_name: of what was compared.
        pairs: poses as they were paired.
        aligned: (N,) poses of the estimate in the reference's world.
        reference_trajectory: (M, 3) float64 [m], all of the reference's positions.
        translation: (N,) float64 [m].
        rotation_deg: (N,) float64 [deg], or None.
    """

    estimate_name: str
    reference_name: str
    pairs: Pairs
    aligned: MatchedPoses
    reference_trajectory: Float64Array
    translation: Float64Array
    rotation_deg: Float64Array | None


_POINT = 1e-12
"""Spread [m²] below which positions are one point, a micrometre wide."""

_LINE = 1e-9
"""Ratio of the second spread to the first (squared lengths) below which positions lie on a line."""

_WEIGHT = 1e-6
"""Of orientations beside positions that leave a rotation open: they decide that rotation, and bend nothing else."""

_THIN, _SMALL = 0.01, 0.1
"""Ratio of the second extent to the first, and extent [m].

Below which a fitted delta_rotation is reported to be doubtful.
"""


@dataclass(frozen=True, slots=True, eq=False)
class _Alignment:
    """`reference_from_estimate`: p_reference = scale · rotation · p_estimate + translation.

    Attributes:
        rotation: (3, 3) float64.
        translation: (3,) float64 [m].
        scale: of lengths.
        doubts: what the poses leave open, for people.
    """

    rotation: Float64Array
    translation: Float64Array
    scale: float = 1.0
    doubts: tuple[str, ...] = ()

    def apply(self, poses: MatchedPoses) -> MatchedPoses:
        """The poses as the reference would report them."""
        positions = self.scale * poses.positions @ self.rotation.T + self.translation
        if poses.quaternions_xyzw is None:
            return MatchedPoses(positions, None)
        return MatchedPoses(
            positions, multiply_quaternions(quaternion_from_matrix(self.rotation), poses.quaternions_xyzw)
        )


def umeyama(
    source: Float64Array, target: Float64Array, *, with_scale: bool = True
) -> tuple[Float64Array, Float64Array, float]:
    """The similarity that takes (N, D) points onto (N, D) others with the least sum of squares.

    Returns:
        rotation (D, D), translation (D,), scale: target = scale · rotation · source + translation.

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns", eq. 40-43.
    """
    covariance = _covariance(source, target)
    rotation = _nearest_rotation(covariance)
    variance = float(((source - source.mean(axis=0)) ** 2).sum(axis=1).mean())
    scale = float(np.trace(rotation.T @ covariance)) / variance if with_scale else 1.0
    return rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0), scale


def _covariance(source: Float64Array, target: Float64Array) -> Float64Array:
    centred: Float64Array = (target - target.mean(axis=0)).T @ (source - source.mean(axis=0)) / len(source)
    return centred


def _nearest_rotation(matrix: Float64Array) -> Float64Array:
    """The rotation R with the largest trace of Rᵀ·matrix. Source: Umeyama 1991, eq. 39 and 43."""
    u, _, vt = np.linalg.svd(matrix)
    signs = np.ones(len(matrix))
    signs[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    rotation: Float64Array = (u * signs) @ vt
    return rotation


def _mean_rotation(pairs: Pairs) -> Float64Array | None:
    """Mean of the matrices that take each orientation of the estimate to the reference's, (3, 3), or None."""
    ours, theirs = pairs.estimate.quaternions_xyzw, pairs.reference.quaternions_xyzw
    if ours is None or theirs is None:
        return None
    return np.asarray(
        np.einsum("nij,nkj->ik", matrix_from_quaternion(theirs), matrix_from_quaternion(ours)) / len(ours)
    )


def _none(pairs: Pairs) -> _Alignment:
    del pairs
    return _Alignment(np.eye(3), np.zeros(3))


def _origin(pairs: Pairs) -> _Alignment:
    """Lay the first pose onto the first pose."""
    first, delta_rotation = pairs.estimate.positions[0], _mean_rotation(_first(pairs, 1))
    if delta_rotation is None:
        raise PoseError(
            "alignment 'origin' lays the first pose onto the first pose and needs orientations on both sides; "
            "state `--align yaw` or `--align se3`"
        )
    rotation = _nearest_rotation(delta_rotation)
    return _Alignment(rotation, pairs.reference.positions[0] - rotation @ first)


def _yaw(pairs: Pairs) -> _Alignment:
    """Shift, and rotate about the vertical: what cameras with an IMU leave open.

    Source: Zhang and Scaramuzza 2018, "A Tutorial on Quantitative Trajectory Evaluation for Visual(-Inertial)
    Odometry", section IV: the angle whose rotation about z has the largest trace with the covariance.
    """
    covariance = _covariance(pairs.estimate.positions, pairs.reference.positions)
    delta_rotation = _mean_rotation(pairs)
    doubts: tuple[str, ...] = ()
    flat = covariance[:2, :2]
    extent = np.sqrt(_spread(pairs.reference.positions[:, :2]))
    if extent < _SMALL:
        doubts = (_kept_within(float(extent)),)
    if np.hypot(flat[0, 0] + flat[1, 1], flat[1, 0] - flat[0, 1]) <= _POINT:
        flat = np.eye(2) if delta_rotation is None else delta_rotation[:2, :2]
    yaw = float(np.arctan2(flat[1, 0] - flat[0, 1], flat[0, 0] + flat[1, 1]))
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    shift = pairs.reference.positions.mean(axis=0) - rotation @ pairs.estimate.positions.mean(axis=0)
    return _Alignment(rotation, shift, doubts=doubts)


def _se3(pairs: Pairs) -> _Alignment:
    return _fitted(pairs, with_scale=False)


def _sim3(pairs: Pairs) -> _Alignment:
    return _fitted(pairs, with_scale=True)


def _fitted(pairs: Pairs, *, with_scale: bool) -> _Alignment:
    source, target = pairs.estimate.positions, pairs.reference.positions
    if with_scale and _spread(source) <= _POINT:
        raise PoseError("the estimate is stationary, so that it has no scale; state `--align se3`")
    covariance, delta_rotation = _covariance(source, target), _mean_rotation(pairs)
    sizes = np.linalg.svd(covariance, compute_uv=False)
    weighed = covariance
    if delta_rotation is not None and sizes[0] <= _POINT:
        weighed = delta_rotation
    elif delta_rotation is not None and sizes[1] <= _LINE * sizes[0]:
        weighed = covariance + _WEIGHT * sizes[0] * delta_rotation
    rotation = _nearest_rotation(weighed)
    scale = float(np.trace(rotation.T @ covariance)) / _spread(source) if with_scale else 1.0
    shift = target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    return _Alignment(rotation, shift, scale, _doubts(target))


def _doubts(positions: Float64Array) -> tuple[str, ...]:
    """What the shape of the trajectory leaves open."""
    extents = np.sqrt(np.maximum(np.linalg.eigvalsh(np.atleast_2d(np.cov(positions.T, bias=True))), 0.0))
    if extents[2] < _SMALL:
        return (_kept_within(float(extents[2])),)
    if extents[1] < _THIN * extents[2]:
        reported = f"the reference is nearly straight ({extents[2]:.3g} m along, {extents[1]:.2g} m across)"
        return (
            f"{reported}, so that its positions hardly report the rotation about that line; `--align yaw` needs none",
        )
    return ()


def _kept_within(extent: float) -> str:
    return (
        f"the reference keeps within {extent:.2g} m, so that its positions hardly report the rotation; `--align "
        f"origin` "
        "takes it from the first poses"
    )


def _spread(positions: Float64Array) -> float:
    """Mean square distance from the mean [m²]."""
    return float(((positions - positions.mean(axis=0)) ** 2).sum(axis=1).mean())


_FEWEST: Mapping[str, int] = MappingProxyType({"none": 1, "origin": 1, "yaw": 2, "se3": 3, "sim3": 3})
"""How many pairs each kind of alignment needs."""

_ALIGNING: Mapping[str, Callable[[Pairs], _Alignment]] = MappingProxyType(
    {"none": _none, "origin": _origin, "yaw": _yaw, "se3": _se3, "sim3": _sim3}
)

ALIGNMENTS = tuple(_ALIGNING)
"""Kinds of alignment, from none to a similarity."""


def align_pairs(pairs: Pairs, kind: str, *, first: int | None = None) -> _Alignment:
    """Find the transform of that kind that lays the estimate onto the reference.

    Args:
        kind: one of `ALIGNMENTS`.
        first: find it from so many pairs from the first on; None: from all.

    Raises:
        OptionError: there is no such kind, or the count is not above 0.
        PoseError: the pairs are too few for it, or leave it open.
    """
    if kind not in _ALIGNING:
        raise OptionError(f"alignment {kind!r}; expected one of {', '.join(ALIGNMENTS)}")
    if first is not None and first < 1:
        raise OptionError(f"alignment on the first {first} poses; expected 1 or more")
    used = pairs if first is None else _first(pairs, first)
    count = len(used.timestamps_ns)
    if count < _FEWEST[kind]:
        enough = [name for name, fewest in _FEWEST.items() if fewest <= count]
        raise PoseError(
            f"{count} pairs of poses; alignment {kind!r} needs {_FEWEST[kind]}: state `--align {enough[-1]}`, or pair "
            "more (`--tolerance`, `--align-first`)"
        )
    return _ALIGNING[kind](used)


def _first(pairs: Pairs, count: int) -> Pairs:
    rows = slice(0, count)
    return Pairs(pairs.timestamps_ns[rows], pairs.estimate.at(rows), pairs.reference.at(rows))


_KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)

_KITTI_STEP = 10
"""Lengths [m] of the segments, and how many poses after each other they begin. Source: KITTI's development kit."""

_DELTA = re.compile(r"(?P<amount>\d+(?:\.\d+)?)\s*(?P<unit>[a-z]+)")
_LARGEST = 1e9

_SLACK = 0.75
"""Share of the median spacing of poses by which a step of time may be off: less than one, so that the last poses are
not taken for later ones."""

_Steps = tuple[Int64Array, Int64Array]
"""Rows of the first and the last pair of each step."""


def _by_time(pairs: Pairs, amount: float) -> _Steps:
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


def _by_trajectory(pairs: Pairs, amount: float) -> _Steps:
    """From each pair to the first that is more than so many metres further along the reference."""
    return _segments(pairs.distances, amount, 1)


def _by_count(pairs: Pairs, amount: float) -> _Steps:
    """From each pair to the one so many later."""
    count, many = int(amount), len(pairs.timestamps_ns)
    first = np.arange(max(many - count, 0))
    return first, first + count


_UNITS: Mapping[str, Callable[[Pairs, float], _Steps]] = MappingProxyType(
    {"s": _by_time, "m": _by_trajectory, "f": _by_count}
)


def _segments(distances: Float64Array, length: float, step: int) -> _Steps:
    """Rows of first and last pose of the segments of a length.

    Source: KITTI's development kit, evaluate_odometry: a segment ends at the first pose whose trajectory exceeds that
        of its
    first by more than the length.
    """
    first = np.arange(0, len(distances), step)
    last = np.searchsorted(distances, distances[first] + length, side="right")
    inside = last < len(distances)
    return first[inside], last[inside]


def _parse_delta(text: str) -> tuple[float, str]:
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
    positions: Float64Array, quaternions_xyzw: Float64Array, steps: _Steps
) -> tuple[Float64Array, Float64Array]:
    """Shift and rotate from the first to the last pose of each step, in the axes of the first."""
    first, last = steps
    back = conjugate_quaternion(quaternions_xyzw[first])
    shifts = rotate_vectors(back, positions[last] - positions[first])
    return shifts, multiply_quaternions(back, quaternions_xyzw[last])


def _step_errors(pairs: Pairs, aligned: MatchedPoses, steps: _Steps) -> tuple[Float64Array, Float64Array | None]:
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


def _relative_errors(pairs: Pairs, aligned: MatchedPoses, delta: str) -> RelativeErrors | None:
    """Errors over all steps of one kind, from each pose on; None where no step fits.

    Raises:
        OptionError: the step is none.
    """
    amount, unit = _parse_delta(delta)
    if len(pairs.timestamps_ns) < 2:
        return None
    steps = _UNITS[unit](pairs, amount)
    if not len(steps[0]):
        return None
    lengths, angles = _step_errors(pairs, aligned, steps)
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


def _kitti_errors(
    pairs: Pairs, aligned: MatchedPoses, *, lengths: Sequence[float] = _KITTI_LENGTHS, step: int = _KITTI_STEP
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
            shifts, angles = _step_errors(pairs, aligned, steps)
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


_SIZE_INCHES = (13.0, 6.5)
_DPI = 120
_MOST_LETTERS = 60


def _short(name: str) -> str:
    """A name that leaves room for the plot."""
    return name if len(name) <= _MOST_LETTERS else f"{name[: _MOST_LETTERS - 1]}…"


def _plot_errors(errors: _TrajectoryErrors, report: TrajectoryReport, path: Path, *, overwrite: bool = False) -> None:
    """Draw errors into a file, without touching what the caller does with matplotlib.

    Raises:
        OptionError: the suffix is none of `SUFFIXES`.
        OutputError: the file exists, or cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    figure_of = check_plot(path, overwrite=overwrite)
    # a figure of its own draws with Agg and is not known to pyplot
    figure = figure_of(figsize=_SIZE_INCHES, dpi=_DPI, layout="constrained")
    rows = 1 if errors.rotation_deg is None else 2
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.2, 1.0))
    _draw_map(figure, figure.add_subplot(grid[:, 0]), errors)
    seconds = errors.pairs.seconds
    statistics = report.absolute.translation
    top = figure.add_subplot(grid[0, 1])
    _draw_curve(top, seconds, errors.translation, "translation [m]", statistics.rms)
    if errors.rotation_deg is not None and report.absolute.rotation_deg is not None:
        below = figure.add_subplot(grid[1, 1], sharex=top)
        _draw_curve(below, seconds, errors.rotation_deg, "rotation [°]", report.absolute.rotation_deg.rms)
    figure.axes[-1].set_xlabel("time since the first pair [s]")
    figure.suptitle(_title(report), fontsize=11)
    with replacing(path, overwrite=overwrite) as draft:
        figure.savefig(draft, format=path.suffix[1:].lower())


def _draw_map(figure: Any, axes: Any, errors: _TrajectoryErrors) -> None:
    axes.plot(
        *errors.reference_trajectory[:, :2].T,
        color="0.6",
        linewidth=3,
        label=_short(errors.reference_name),
        zorder=1,
    )
    dots = axes.scatter(
        *errors.aligned.positions[:, :2].T,
        c=errors.translation,
        s=8,
        cmap="viridis",
        label=_short(errors.estimate_name),
        zorder=2,
    )
    axes.plot(*errors.reference_trajectory[0, :2], marker="s", color="black", linestyle="", label="start", zorder=3)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="best")
    figure.colorbar(dots, ax=axes, label="error of translation [m]")


def _draw_curve(axes: Any, seconds: Any, values: Any, label: str, rms: float) -> None:
    axes.plot(seconds, values, color="tab:blue", linewidth=1.2)
    axes.axhline(rms, color="tab:red", linestyle="--", linewidth=1, label=f"rms {rms:.4g}")
    axes.set(ylabel=f"error of {label}", ylim=(0, None))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="upper right")


def _title(report: TrajectoryReport) -> str:
    scale = f", scale {report.alignment.scale:.6g}" if report.alignment.kind == "sim3" else ""
    return (
        f"{report.estimate} against {report.reference}: {report.pairs} pairs, {report.path_length:.4g} m, "
        f"alignment {report.alignment.kind}{scale}"
    )


_ROTATED_DEG = 5.0

_STEADY = 0.25
"""Beyond `_ROTATED_DEG`, single rotations within this share of the mean one show another choice of axes."""


def _doubts_of(alignment: _Alignment, pairs: Pairs, aligned: MatchedPoses) -> list[DataWarning]:
    """What the shape of the trajectory, missing orientations or other axes of the device do to the numbers."""
    found = [_warning("doubtful-alignment", doubt) for doubt in alignment.doubts]
    ours, theirs = aligned.quaternions_xyzw, pairs.reference.quaternions_xyzw
    if ours is None or theirs is None:
        side = "estimate" if ours is None else "reference"
        message = f"the {side} has no orientations: motions are compared in the aligned world, rotates not at all"
        return [*found, _warning("no-orientations", message)]
    rotation, strays_deg = _rotation_of_axes(ours, theirs)
    # a trajectory that hardly determines the alignment's rotation does not determine that of the axes, either
    if not found and rotation > _ROTATED_DEG and strays_deg < _STEADY * rotation:
        message = (
            f"the device's axes differ by a steady rotation of {rotation:.1f}° (single poses stray by "
            f"{strays_deg:.2g}°): if "
            "one side reports a camera's poses, state `--est-optical` or `--ref-optical`"
        )
        found.append(_warning("other-axes", message))
    return found


def _rotation_of_axes(ours: Float64Array, theirs: Float64Array) -> tuple[float, float]:
    """The mean rotation between the axes of both devices, and the mean deviation from it [deg]."""
    rotations = multiply_quaternions(conjugate_quaternion(ours), theirs)
    mean, _ = nearest_rotation(matrix_from_quaternion(rotations).mean(axis=0))
    axes = quaternion_from_matrix(mean)
    angle = angle_between(axes, np.array([0.0, 0.0, 0.0, 1.0]))
    return float(np.degrees(angle)), float(np.degrees(angle_between(rotations, axes).mean()))


def _same_poses(estimate: Trajectory, reference: Trajectory) -> list[DataWarning]:
    """Report that both are one trajectory, be it by one file or by a copy: its errors state nothing."""
    pairs = [
        (getattr(estimate, name), getattr(reference, name))
        for name in ("timestamps_ns", "positions", "quaternions_xyzw")
    ]
    if not all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs):
        return []
    return [_warning("same-poses", "estimate and reference are the same poses at the same times")]


def _unmeasured(relative: Mapping[str, object]) -> list[DataWarning]:
    """The steps for which the trajectory is too short."""
    missing = [delta for delta, errors in relative.items() if errors is None]
    if not missing:
        return []
    return [_warning("no-steps", f"the trajectory is too short for steps of {', '.join(missing)}")]


def _warning(code: str, message: str) -> DataWarning:
    return DataWarning(kind=WarningKind.ASSUMED, code=code, location="", message=message)


RPE_DELTAS = ("1s", "5m", "10m", "50m")
"""Steps over which motions are compared where nothing else is stated."""

_SmoothedTrajectory = Trajectory | TrajectoryFile | Poses | str | Path
"""What can be compared: a trajectory, or a file or scene that holds one."""

_FARTHEST_NS = 9_200_000_000_000_000_000


def evaluate_trajectory(
    estimate: _SmoothedTrajectory,
    reference: _SmoothedTrajectory,
    *,
    align: str = "se3",
    align_first: int | None = None,
    associate: str = "interpolate",
    tolerance: float | None = None,
    offset_ns: int = 0,
    start: float | None = None,
    stop: float | None = None,
    rpe_deltas: Sequence[str] = RPE_DELTAS,
    plot: str | Path | None = None,
    overwrite: bool = False,
) -> TrajectoryReport:
    """Report how far a trajectory is from a reference.

    Args:
        estimate: what is judged.
        reference: what is taken for the truth.
        align: how the estimate is laid onto the reference first: "none", "origin" (first pose on first pose), "yaw"
            (shift and heading), "se3" (shift and rotate), "sim3" (and scale).
        align_first: by how many pairs from the first on; None: by all.
        associate: "interpolate" takes the reference between its poses at the estimate's times, "nearest" its own poses.
        tolerance: how far the reference's nearest pose may be [s]; None: 0.1 where interpolated, else 0.01.
        offset_ns: added to the estimate's times [ns].
        start, stop: compare this part only [s], counted from the reference's first pose.
        rpe_deltas: steps over which motions are compared: seconds, metres or poses, "1s", "10m", "1f".
        plot: an image to write: the trajectories from above, errors over time.
        overwrite: whether an image that exists may be replaced.

    Raises:
        OptionError: an argument is wrong.
        PoseError: the two do not overlap in time, or too little for the alignment.
        ArrayError: a trajectory holds a number that is not finite, or its times do not rise.
        DataError: a file is wrong.
        OutputError: the image exists, or cannot be written.
        MissingExtraError: what draws the image is not installed.

    Source: Sturm et al. 2012 for both errors, Zhang and Scaramuzza 2018 for alignments, KITTI's development kit.
    """
    for delta in rpe_deltas:
        _parse_delta(delta)
    if plot is not None:
        check_plot(Path(plot), overwrite=overwrite)
    ours, theirs = _both(estimate, reference)
    report, errors = _compared(
        _checked_trajectory(ours.trajectory),
        _checked_trajectory(theirs.trajectory),
        align=align,
        first=align_first,
        how=associate,
        tolerance=tolerance,
        offset_ns=offset_ns,
        part=(start, stop),
        deltas=rpe_deltas,
    )
    same = _same_poses(ours.trajectory, theirs.trajectory)
    report = structs.replace(report, warnings=(*ours.warnings, *theirs.warnings, *same, *report.warnings))
    if plot is not None:
        _plot_errors(errors, report, Path(plot), overwrite=overwrite)
    return report


def _both(estimate: _SmoothedTrajectory, reference: _SmoothedTrajectory) -> tuple[TrajectoryFile, TrajectoryFile]:
    """The two trajectories; fixes are seen from the other's origin, where that is known."""
    ours, theirs = _content(estimate), _content(reference)
    if ours.fixes is not None and theirs.origin_lla is not None:
        ours = _seen_from(ours, ours.fixes, theirs.origin_lla)
    elif theirs.fixes is not None and ours.origin_lla is not None:
        theirs = _seen_from(theirs, theirs.fixes, ours.origin_lla)
    return ours, theirs


def _seen_from(content: TrajectoryFile, fixes: GnssSensor, origin_lla: Float64Array) -> TrajectoryFile:
    there = of_fixes(fixes, origin_lla=origin_lla, name=content.trajectory.name)
    return replace(there, warnings=content.warnings)


def _content(trajectory: _SmoothedTrajectory) -> TrajectoryFile:
    return read_trajectory_file(trajectory) if isinstance(trajectory, str | Path) else content_of(trajectory)


def _compared(
    estimate: Trajectory,
    reference: Trajectory,
    *,
    align: str,
    first: int | None,
    how: str,
    tolerance: float | None,
    offset_ns: int,
    part: tuple[float | None, float | None],
    deltas: Sequence[str],
) -> tuple[TrajectoryReport, _TrajectoryErrors]:
    estimate = _shifted(estimate, offset_ns)
    # the whole reference is paired with, lest the poses at the part's ends have no neighbours
    whole = reference
    estimate, reference = _within(estimate, reference, *part)
    tolerance_ns = None if tolerance is None else _nanoseconds("tolerance", tolerance)
    pairs = associate_poses(estimate, whole, how=how, tolerance_ns=tolerance_ns)
    alignment = align_pairs(pairs, align, first=first)
    aligned = alignment.apply(pairs.estimate)
    absolute, errors = _absolute(estimate, reference, pairs, aligned)
    relative = {delta: _relative_errors(pairs, aligned, delta) for delta in deltas}
    used = len(pairs.timestamps_ns) if first is None else min(first, len(pairs.timestamps_ns))
    report = TrajectoryReport(
        estimate=estimate.name,
        reference=reference.name,
        estimate_poses=len(estimate.timestamps_ns),
        reference_poses=len(reference.timestamps_ns),
        pairs=len(pairs.timestamps_ns),
        start_ns=int(pairs.timestamps_ns[0]),
        stop_ns=int(pairs.timestamps_ns[-1]),
        seconds=float(pairs.seconds[-1]),
        coverage=covered_share(estimate.timestamps_ns, reference.timestamps_ns),
        path_length=float(pairs.distances[-1]),
        estimate_path_length=float(_trajectory_along(pairs.estimate.positions)[-1]),
        alignment=_alignment_report(alignment, align, used),
        absolute=absolute,
        relative=tuple(errors for errors in relative.values() if errors is not None),
        kitti=_kitti_errors(pairs, aligned),
        warnings=(*_doubts_of(alignment, pairs, aligned), *_unmeasured(relative)),
    )
    return report, errors


def _shifted(trajectory: Trajectory, offset_ns: int) -> Trajectory:
    ends = [int(trajectory.timestamps_ns[row]) + offset_ns for row in (0, -1)]
    if max(map(abs, ends)) > _FARTHEST_NS:
        raise OptionError(
            f"offset {offset_ns / 1e9:g} s; with it the times of {trajectory.name!r} are beyond the year 2261"
        )
    return replace(trajectory, timestamps_ns=trajectory.timestamps_ns + offset_ns)


def _within(
    estimate: Trajectory, reference: Trajectory, start: float | None, stop: float | None
) -> tuple[Trajectory, Trajectory]:
    """The parts of both in the time that was asked for."""
    if start is None and stop is None:
        return estimate, reference
    zero = int(reference.timestamps_ns[0])
    first = zero if start is None else zero + _nanoseconds("start", start)
    end = _FARTHEST_NS if stop is None else zero + _nanoseconds("stop", stop)
    return _cut(estimate, first, end), _cut(reference, first, end)


def _cut(trajectory: Trajectory, start_ns: int, stop_ns: int) -> Trajectory:
    inside = (trajectory.timestamps_ns >= start_ns) & (trajectory.timestamps_ns < stop_ns)
    if not inside.any():
        a, b = (int(trajectory.timestamps_ns[row]) / 1e9 for row in (0, -1))
        raise PoseError(
            f"{trajectory.name!r} ({a:.9g} to {b:.9g} s) has no pose from {start_ns / 1e9:.9g} to {stop_ns / 1e9:.9g} s"
        )
    quaternions = trajectory.quaternions_xyzw
    return Trajectory(
        trajectory.name,
        trajectory.timestamps_ns[inside],
        trajectory.positions[inside],
        None if quaternions is None else quaternions[inside],
    )


def _nanoseconds(name: str, seconds: float) -> int:
    if not (np.isfinite(seconds) and 0 <= seconds < 1e9):
        raise OptionError(f"{name} {seconds:g} s; expected 0 or more")
    return round(seconds * 1e9)


def _absolute(
    estimate: Trajectory, reference: Trajectory, pairs: Pairs, aligned: MatchedPoses
) -> tuple[AbsoluteErrors, _TrajectoryErrors]:
    away = aligned.positions - pairs.reference.positions
    lengths = np.linalg.norm(away, axis=1)
    degrees = None
    if aligned.quaternions_xyzw is not None and pairs.reference.quaternions_xyzw is not None:
        degrees = np.degrees(angle_between(aligned.quaternions_xyzw, pairs.reference.quaternions_xyzw))
    errors = _TrajectoryErrors(estimate.name, reference.name, pairs, aligned, reference.positions, lengths, degrees)
    reported = AbsoluteErrors(
        translation=ErrorStatistics.of(lengths),
        horizontal=ErrorStatistics.of(np.hypot(away[:, 0], away[:, 1])),
        vertical=ErrorStatistics.of(np.abs(away[:, 2])),
        rotation_deg=None if degrees is None else ErrorStatistics.of(degrees),
    )
    return reported, errors


def _alignment_report(alignment: _Alignment, kind: str, poses: int) -> AlignmentReport:
    x, y, z, w = quaternion_from_matrix(alignment.rotation).tolist()
    east, north, up = alignment.translation.tolist()
    return AlignmentReport(
        kind=kind,
        poses=0 if kind == "none" else 1 if kind == "origin" else poses,
        quaternion_xyzw=(x, y, z, w),
        translation=(east, north, up),
        scale=alignment.scale,
    )
