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
from sceneloom.errors import ArrayError, OptionError, PoseError, check_choice
from sceneloom.evaluate.plot import check_plot, save_plot
from sceneloom.formats.base.text_tables import seconds_text
from sceneloom.formats.trajectories.table import read_trajectory_file
from sceneloom.formats.trajectories.text_formats import of_fixes
from sceneloom.formats.trajectories.trajectory_file import FARTHEST, TrajectoryFile
from sceneloom.geometry.rigid import (
    angle_between,
    conjugate_quaternion,
    interpolate_poses,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
    normalise_quaternion,
    quaternion_from_matrix,
    rotate_vectors,
)
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.time_range import select_rows
from sceneloom.warnings import DataWarning, assumed

RPE_DELTAS = ("1s", "5m", "10m", "50m")
"""Steps over which motions are compared unless others are given."""

_Comparable = Trajectory | TrajectoryFile | Poses | str | Path
"""What can be compared: a trajectory, or a file or scene with one."""

_FARTHEST_NS = 9_200_000_000_000_000_000
_TOLERANCES_NS = {"interpolate": 100_000_000, "nearest": 10_000_000}
"""By kind of association, how far the nearest pose of the reference may be unless another tolerance is given [ns]."""

_SHORTEST_GAP_NS, _GAP_SPACINGS = 1_000_000_000, 5.0
_POINT = 1e-12  # spread [m²] below which positions are one point, a micrometre wide
_LINE = 1e-9  # ratio of the second spread to the first (squared lengths) below which positions lie on a line

_WEIGHT = 1e-6
"""Of orientations beside positions that leave a rotation open: they decide that rotation, and change nothing else."""

_THIN, _SMALL = 0.01, 0.1
"""Ratio of the second extent to the first, and extent [m], below which a fitted rotation is reported to be doubtful."""

_KITTI_LENGTHS, _KITTI_STEP = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0), 10
"""Lengths [m] of the segments, and how many poses after each other they begin. Source: KITTI's development kit."""

_DELTA, _LARGEST_DELTA = re.compile(r"(?P<amount>\d+(?:\.\d+)?)\s*(?P<unit>[a-z]+)"), 1e9
_SLACK = 0.75
"""Share of the median spacing of poses by which a step of time may be off: less than one, so that the last poses are
not taken for later ones."""

_ROTATED_DEG, _STEADY = 5.0, 0.25
"""Beyond this mean rotation, single rotations within this share of it show another choice of axes."""

_SIZE_INCHES, _MOST_LETTERS = (13.0, 6.5), 60


class ErrorStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Statistics of errors, in the unit of the errors.

    Attributes:
        count: how many errors.
        mean, median, min, max: of them.
        rms: root of the mean square.
        percentile_95: 95 % of them do not exceed it, linear between neighbours.
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
    """The alignment of the estimate to the reference: p_reference = scale · R · p_estimate + translation.

    Attributes:
        kind: one of `ALIGNMENTS`.
        poses: how many poses it was found from.
        quaternion_xyzw: R.
        translation: [m].
        scale: 1 except for `sim3`.
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
        seconds, metres: how long the steps are on average, in time and along the reference.
        translation: [m].
        rotation_deg: [deg], None where one of both has no orientations.
        translation_percent: mean error per length of the step [%], None where the reference is stationary.
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
    """The two numbers of KITTI's odometry benchmark: over all segments, and over those of each length."""

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
        alignment: of the estimate to the reference.
        absolute: errors at the same times.
        relative: errors of motions, by step.
        kitti: KITTI's two numbers; None where the trajectory is shorter than its shortest segment, or has no
            orientations.
        warnings: about the numbers.
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


def evaluate_trajectory(
    estimate: _Comparable,
    reference: _Comparable,
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
        align: how the estimate is aligned to the reference first: "none", "origin" (first pose to first pose), "yaw"
            (translation and heading), "se3" (translation and rotation), "sim3" (and scale).
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
        ArrayError: a trajectory has a number that is not finite, or its times do not rise.
        DataError: a file is wrong.
        OutputError: the image exists, or cannot be written.
        MissingExtraError: matplotlib is not installed.

    Source: Sturm et al. 2012 for both errors, Zhang and Scaramuzza 2018 for alignments, KITTI's development kit.
    """
    for delta in rpe_deltas:
        _parse_delta(delta)
    if plot is not None:
        check_plot(Path(plot), overwrite=overwrite)
    given, whole = _contents(estimate, reference)
    ours, theirs = _checked_trajectory(given.trajectory), _checked_trajectory(whole.trajectory)
    same = _same_poses(ours, theirs)
    ours = _shifted(ours, offset_ns)
    # the whole reference is paired with, lest the poses at the part's ends have no neighbours
    ours, part = (_within(one, int(theirs.timestamps_ns[0]), start, stop) for one in (ours, theirs))
    tolerance_ns = None if tolerance is None else _nanoseconds("tolerance", tolerance)
    pairs = associate_poses(ours, theirs, how=associate, tolerance_ns=tolerance_ns)
    alignment = align_pairs(pairs, align, first=align_first)
    aligned = alignment.apply(pairs.estimate)
    away = aligned.positions - pairs.reference.positions
    lengths, degrees = np.linalg.norm(away, axis=1), None
    if aligned.quaternions_xyzw is not None and pairs.reference.quaternions_xyzw is not None:
        degrees = np.degrees(angle_between(aligned.quaternions_xyzw, pairs.reference.quaternions_xyzw))
    relative = {delta: _relative_errors(pairs, aligned, delta) for delta in rpe_deltas}
    count = len(pairs.timestamps_ns)
    used = {"none": 0, "origin": 1}.get(align, count if align_first is None else min(align_first, count))
    report = TrajectoryReport(
        estimate=ours.name,
        reference=part.name,
        estimate_poses=len(ours.timestamps_ns),
        reference_poses=len(part.timestamps_ns),
        pairs=count,
        start_ns=int(pairs.timestamps_ns[0]),
        stop_ns=int(pairs.timestamps_ns[-1]),
        seconds=float(pairs.seconds[-1]),
        coverage=covered_share(ours.timestamps_ns, part.timestamps_ns),
        path_length=float(pairs.distances[-1]),
        estimate_path_length=float(_lengths_along(pairs.estimate.positions)[-1]),
        alignment=AlignmentReport(
            kind=align,
            poses=used,
            quaternion_xyzw=tuple(quaternion_from_matrix(alignment.rotation).tolist()),
            translation=tuple(alignment.translation.tolist()),
            scale=alignment.scale,
        ),
        absolute=AbsoluteErrors(
            translation=ErrorStatistics.of(lengths),
            horizontal=ErrorStatistics.of(np.hypot(away[:, 0], away[:, 1])),
            vertical=ErrorStatistics.of(np.abs(away[:, 2])),
            rotation_deg=None if degrees is None else ErrorStatistics.of(degrees),
        ),
        relative=tuple(errors for errors in relative.values() if errors is not None),
        kitti=_kitti_errors(pairs, aligned),
        warnings=(*given.warnings, *whole.warnings, *same, *_doubts_of(alignment, pairs, aligned)),
    )
    missing = [delta for delta, errors in relative.items() if errors is None]
    if missing:
        message = f"the trajectory is too short for steps of {', '.join(missing)}"
        report = structs.replace(report, warnings=(*report.warnings, assumed("no-steps", "", message)))
    if plot is not None:
        curves = [("translation [m]", lengths)] + ([] if degrees is None else [("rotation [°]", degrees)])
        _plot_errors(report, pairs, aligned, part.positions, curves, Path(plot), overwrite=overwrite)
    return report


def _contents(estimate: _Comparable, reference: _Comparable) -> tuple[TrajectoryFile, TrajectoryFile]:
    """The two trajectories; fixes are seen from the other's origin, where that is known."""
    ours, theirs = (
        read_trajectory_file(one) if isinstance(one, str | Path) else TrajectoryFile.of(one)
        for one in (estimate, reference)
    )

    def seen_from(content: TrajectoryFile, other: TrajectoryFile) -> TrajectoryFile:
        if content.fixes is None or other.origin_lla is None:
            return content
        there = of_fixes(content.fixes, origin_lla=other.origin_lla, name=content.trajectory.name)
        return replace(there, warnings=content.warnings)

    moved = seen_from(ours, theirs)
    return (ours, seen_from(theirs, ours)) if moved is ours else (moved, theirs)


def _checked_trajectory(trajectory: Trajectory) -> Trajectory:
    """A trajectory that can be computed with, its orientations of length 1."""
    name, times = f"trajectory {trajectory.name!r}", trajectory.timestamps_ns
    if not len(times):
        raise ArrayError(f"{name}: empty; expected at least one pose")
    for column in ("positions", "quaternions_xyzw"):
        values = getattr(trajectory, column)
        rows = [] if values is None else np.flatnonzero(~(np.abs(values) <= FARTHEST).all(axis=1)).tolist()
        if rows:
            raise ArrayError(
                f"{name}: {column}[{rows[0]}]: {values[rows[0]].tolist()}; expected finite numbers, metres within "
                f"±{FARTHEST:g}"
            )
    back = (np.flatnonzero(times[1:] <= times[:-1]) + 1).tolist()
    if back:
        raise ArrayError(f"{name}: timestamps_ns[{back[0]}]: {times[back[0]]}; expected rising times")
    quaternions = trajectory.quaternions_xyzw
    return replace(trajectory, quaternions_xyzw=None if quaternions is None else normalise_quaternion(quaternions))


def _shifted(trajectory: Trajectory, offset_ns: int) -> Trajectory:
    ends = [int(trajectory.timestamps_ns[row]) + offset_ns for row in (0, -1)]
    if max(map(abs, ends)) > _FARTHEST_NS:
        raise OptionError(
            f"offset {offset_ns / 1e9:g} s; with it the times of {trajectory.name!r} are beyond the year 2261"
        )
    return replace(trajectory, timestamps_ns=trajectory.timestamps_ns + offset_ns)


def _within(trajectory: Trajectory, zero_ns: int, start: float | None, stop: float | None) -> Trajectory:
    """The part from start to stop [s] after a time."""
    if start is None and stop is None:
        return trajectory
    start_ns = zero_ns if start is None else zero_ns + _nanoseconds("start", start)
    stop_ns = _FARTHEST_NS if stop is None else zero_ns + _nanoseconds("stop", stop)
    inside = (trajectory.timestamps_ns >= start_ns) & (trajectory.timestamps_ns < stop_ns)
    if not inside.any():
        a, b = (int(trajectory.timestamps_ns[row]) / 1e9 for row in (0, -1))
        raise PoseError(
            f"{trajectory.name!r} ({a:.9g} to {b:.9g} s) has no pose from {start_ns / 1e9:.9g} to {stop_ns / 1e9:.9g} s"
        )
    return select_rows(trajectory, inside)


def _nanoseconds(name: str, seconds: float) -> int:
    if not (np.isfinite(seconds) and 0 <= seconds < 1e9):
        raise OptionError(f"{name} {seconds:g} s; expected 0 or more")
    return round(seconds * 1e9)


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPoses:
    """One side of the pairs: (N, 3) float64 positions [m] and (N, 4) float64 unit quaternions, or None."""

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
        """The length of the reference up to each pair, (N,) float64 [m]."""
        return _lengths_along(self.reference.positions)

    def first(self, count: int) -> "Pairs":
        """So many from the first on."""
        rows = slice(0, count)
        return Pairs(self.timestamps_ns[rows], self.estimate.at(rows), self.reference.at(rows))


def _lengths_along(positions: Float64Array) -> Float64Array:
    """The length up to each of (N, 3) positions, (N,) float64 [m]."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


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
    check_choice("association", how, _TOLERANCES_NS)
    tolerance_ns = _TOLERANCES_NS[how] if tolerance_ns is None else tolerance_ns
    if tolerance_ns < 0:
        raise OptionError(f"tolerance {tolerance_ns / 1e9:g} s; expected 0 or more")
    times, known, quaternions = estimate.timestamps_ns, reference.timestamps_ns, reference.quaternions_xyzw
    nearest = _nearest(known, times)
    away = np.abs(times - known[nearest])
    rows = np.flatnonzero(away <= tolerance_ns)
    if how == "nearest":
        mutual = _nearest(times, known)[nearest]
        rows = rows[mutual[rows] == rows]
        found = MatchedPoses(reference.positions, quaternions).at(nearest[rows])
    else:
        rows = rows[(times[rows] >= known[0]) & (times[rows] <= known[-1])]
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(known), 1)) if quaternions is None else quaternions
        positions, rotations, _ = interpolate_poses(known, reference.positions, rotations, times[rows])
        found = MatchedPoses(positions, None if quaternions is None else rotations)
    if not len(rows):
        raise PoseError(_without_pairs(estimate, reference, int(away.min()), tolerance_ns))
    return Pairs(times[rows], MatchedPoses(estimate.positions, estimate.quaternions_xyzw).at(rows), found)


def _nearest(timestamps_ns: Int64Array, query_ns: Int64Array) -> Int64Array:
    """Row of the nearest time to each time asked for, the earlier of two equally near, (M,) int64."""
    after = np.clip(np.searchsorted(timestamps_ns, query_ns), 0, len(timestamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(query_ns - timestamps_ns[before]) <= np.abs(timestamps_ns[after] - query_ns)
    return np.where(closer, before, after)


def _without_pairs(estimate: Trajectory, reference: Trajectory, away_ns: int, tolerance_ns: int) -> str:
    (a, b), (c, d) = ([int(one.timestamps_ns[row]) for row in (0, -1)] for one in (estimate, reference))
    spans = (
        f"no pose of {estimate.name!r} ({seconds_text(a)} to {seconds_text(b)} s) has a partner in {reference.name!r} "
        f"({seconds_text(c)} to {seconds_text(d)} s)"
    )
    if b < c or d < a:
        return (
            f"{spans}: they do not overlap in time; if both clocks started with the drive, add "
            f"{seconds_text(c - a)} s to the estimate's times (`--offset {seconds_text(c - a)}`)"
        )
    return (
        f"{spans} within {tolerance_ns / 1e9:g} s; the nearest one is {away_ns / 1e9:.6g} s away: "
        "allow more (`--tolerance`)"
    )


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
class _Alignment:
    """`reference_from_estimate`: p_reference = scale · rotation · p_estimate + translation."""

    rotation: Float64Array  # (3, 3)
    translation: Float64Array  # (3,) [m]
    scale: float = 1.0
    doubts: tuple[str, ...] = ()  # what the poses leave open, for people

    def apply(self, poses: MatchedPoses) -> MatchedPoses:
        """The poses in the reference's world."""
        quaternions = poses.quaternions_xyzw
        if quaternions is not None:
            quaternions = multiply_quaternions(quaternion_from_matrix(self.rotation), quaternions)
        return MatchedPoses(self.scale * poses.positions @ self.rotation.T + self.translation, quaternions)


def umeyama(
    source: Float64Array, target: Float64Array, *, with_scale: bool = True, direction: Float64Array | None = None
) -> tuple[Float64Array, Float64Array, float]:
    """The similarity that takes (N, D) points to (N, D) others with the least sum of squares.

    Args:
        direction: (D, D), whose nearest rotation is taken; None: the covariance of the points.

    Returns:
        rotation (D, D), translation (D,), scale: target = scale · rotation · source + translation.

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns", eq. 40-43.
    """
    covariance = _covariance(source, target)
    rotation = _nearest_rotation(covariance if direction is None else direction)
    scale = float(np.trace(rotation.T @ covariance)) / _spread(source) if with_scale else 1.0
    return rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0), scale


def _covariance(source: Float64Array, target: Float64Array) -> Float64Array:
    centred: Float64Array = (target - target.mean(axis=0)).T @ (source - source.mean(axis=0)) / len(source)
    return centred


def _spread(positions: Float64Array) -> float:
    """Mean square distance from the mean [m²]."""
    return float(((positions - positions.mean(axis=0)) ** 2).sum(axis=1).mean())


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


def _origin(pairs: Pairs) -> _Alignment:
    """Align the first pose to the first pose."""
    between = _mean_rotation(pairs.first(1))
    if between is None:
        raise PoseError(
            "alignment 'origin' aligns the first pose to the first pose and needs orientations on both sides; "
            "use `--align yaw` or `--align se3`"
        )
    rotation = _nearest_rotation(between)
    return _Alignment(rotation, pairs.reference.positions[0] - rotation @ pairs.estimate.positions[0])


def _yaw(pairs: Pairs) -> _Alignment:
    """Translate, and rotate about the vertical: what cameras with an IMU leave open."""
    # Source: Zhang and Scaramuzza 2018, "A Tutorial on Quantitative Trajectory Evaluation for Visual(-Inertial)
    # Odometry", section IV: the angle whose rotation about z has the largest trace with the covariance
    source, target = pairs.estimate.positions, pairs.reference.positions
    flat = _covariance(source, target)[:2, :2]
    if np.hypot(flat[0, 0] + flat[1, 1], flat[1, 0] - flat[0, 1]) <= _POINT:
        between = _mean_rotation(pairs)
        flat = np.eye(2) if between is None else between[:2, :2]
    yaw = float(np.arctan2(flat[1, 0] - flat[0, 1], flat[0, 0] + flat[1, 1]))
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    extent = float(np.sqrt(_spread(target[:, :2])))
    doubts = (_within_words(extent),) if extent < _SMALL else ()
    return _Alignment(rotation, target.mean(axis=0) - rotation @ source.mean(axis=0), doubts=doubts)


def _fitted(pairs: Pairs, *, with_scale: bool) -> _Alignment:
    """Translate and rotate, and scale; orientations decide the rotations that the positions leave open."""
    source, target = pairs.estimate.positions, pairs.reference.positions
    if with_scale and _spread(source) <= _POINT:
        raise PoseError("the estimate is stationary, so that it has no scale; use `--align se3`")
    direction, between = _covariance(source, target), _mean_rotation(pairs)
    sizes = np.linalg.svd(direction, compute_uv=False)
    if between is not None and sizes[0] <= _POINT:
        direction = between
    elif between is not None and sizes[1] <= _LINE * sizes[0]:
        direction = direction + _WEIGHT * sizes[0] * between
    extents = np.sqrt(np.maximum(np.linalg.eigvalsh(np.atleast_2d(np.cov(target.T, bias=True))), 0.0))
    doubts: tuple[str, ...] = ()
    if extents[2] < _SMALL:
        doubts = (_within_words(float(extents[2])),)
    elif extents[1] < _THIN * extents[2]:
        straight = f"the reference is nearly straight ({extents[2]:.3g} m along, {extents[1]:.2g} m across)"
        doubts = (f"{straight}: its positions hardly determine the rotation about that line; `--align yaw` needs none",)
    return _Alignment(*umeyama(source, target, with_scale=with_scale, direction=direction), doubts)


def _within_words(extent: float) -> str:
    return (
        f"the reference stays within {extent:.2g} m, so that its positions hardly determine the rotation; "
        "`--align origin` takes it from the first poses"
    )


_ALIGNING: Mapping[str, tuple[int, Callable[[Pairs], _Alignment]]] = MappingProxyType(
    {
        "none": (1, lambda _: _Alignment(np.eye(3), np.zeros(3))),
        "origin": (1, _origin),
        "yaw": (2, _yaw),
        "se3": (3, lambda pairs: _fitted(pairs, with_scale=False)),
        "sim3": (3, lambda pairs: _fitted(pairs, with_scale=True)),
    }
)  # by kind of alignment, how many pairs it needs and what finds it

ALIGNMENTS = tuple(_ALIGNING)
"""Kinds of alignment, from none to a similarity."""


def align_pairs(pairs: Pairs, kind: str, *, first: int | None = None) -> _Alignment:
    """Find the transform of that kind that aligns the estimate to the reference.

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
    used = pairs if first is None else pairs.first(first)
    count, (fewest, find) = len(used.timestamps_ns), _ALIGNING[kind]
    if count < fewest:
        enough = [name for name, (least, _) in _ALIGNING.items() if least <= count]
        raise PoseError(
            f"{count} pairs of poses; alignment {kind!r} needs {fewest}: use `--align {enough[-1]}`, or pair "
            "more (`--tolerance`, `--align-first`)"
        )
    return find(used)


_Steps = tuple[Int64Array, Int64Array]  # rows of the first and the last pair of each step


def _by_time(pairs: Pairs, amount: float) -> _Steps:
    """From each pair to the one nearest to so many seconds later."""
    seconds = pairs.seconds
    wanted = seconds + amount
    after = np.clip(np.searchsorted(seconds, wanted), 1, len(seconds) - 1)
    last = np.where(wanted - seconds[after - 1] < seconds[after] - wanted, after - 1, after)
    near = np.abs(seconds[last] - wanted) <= _SLACK * float(np.median(np.diff(seconds)))
    chosen = np.flatnonzero(near & (last > np.arange(len(seconds))))
    return chosen, last[chosen]


def _segments(distances: Float64Array, length: float, step: int) -> _Steps:
    """Rows of first and last pose of the segments of a length."""
    # Source: KITTI's evaluate_odometry: a segment ends at the first pose farther from its first than the length
    first = np.arange(0, len(distances), step)
    last = np.searchsorted(distances, distances[first] + length, side="right")
    inside = last < len(distances)
    return first[inside], last[inside]


def _by_count(pairs: Pairs, amount: float) -> _Steps:
    """From each pair to the one so many later."""
    first = np.arange(max(len(pairs.timestamps_ns) - int(amount), 0))
    return first, first + int(amount)


_UNITS: Mapping[str, Callable[[Pairs, float], _Steps]] = MappingProxyType(
    {"s": _by_time, "m": lambda pairs, amount: _segments(pairs.distances, amount, 1), "f": _by_count}
)


def _parse_delta(text: str) -> tuple[float, str]:
    """Read a step: "1s", "0.5 s", "10m", "5f" (poses)."""
    match = _DELTA.fullmatch(text.strip())
    amount = float(match["amount"]) if match else 0.0
    if match is None or match["unit"] not in _UNITS or not 0 < amount < _LARGEST_DELTA:
        raise OptionError(f"step {text!r}; expected seconds, metres or poses, such as 1s, 10m, 1f")
    if match["unit"] == "f" and amount != int(amount):
        raise OptionError(f"step {text!r}; expected a whole number of poses")
    return amount, match["unit"]


def _step_errors(pairs: Pairs, aligned: MatchedPoses, steps: _Steps) -> tuple[Float64Array, Float64Array | None]:
    """How far the motions of each step differ: lengths [m], and angles, None without orientations."""
    # Source: Sturm et al. 2012, "A Benchmark for the Evaluation of RGB-D SLAM Systems", eq. 1: (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹
    # P_j), Q the reference; without orientations the difference of the translations in the aligned world
    first, last = steps
    if aligned.quaternions_xyzw is None or pairs.reference.quaternions_xyzw is None:
        ours, theirs = aligned.positions, pairs.reference.positions
        return np.linalg.norm(ours[last] - ours[first] - theirs[last] + theirs[first], axis=1), None
    motions = []
    for positions, quaternions in (
        (aligned.positions, aligned.quaternions_xyzw),
        (pairs.reference.positions, pairs.reference.quaternions_xyzw),
    ):
        back = conjugate_quaternion(quaternions[first])
        shifts = rotate_vectors(back, positions[last] - positions[first])
        motions.append((shifts, multiply_quaternions(back, quaternions[last])))
    (shifts, rotations), (true_shifts, true_rotations) = motions
    # rotating by Q⁻¹ does not change how long the difference is
    return np.linalg.norm(shifts - true_shifts, axis=1), angle_between(rotations, true_rotations)


def _relative_errors(pairs: Pairs, aligned: MatchedPoses, delta: str) -> RelativeErrors | None:
    """Errors over all steps of one kind, from each pose on; None where no step fits."""
    amount, unit = _parse_delta(delta)
    if len(pairs.timestamps_ns) < 2:
        return None
    first, last = steps = _UNITS[unit](pairs, amount)
    if not len(first):
        return None
    lengths, angles = _step_errors(pairs, aligned, steps)
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


def _kitti_errors(pairs: Pairs, aligned: MatchedPoses) -> KittiErrors | None:
    """Errors per length over segments of several lengths; None where there is none, or no orientations."""
    # Source: Geiger, Lenz and Urtasun 2012, and evaluate_odometry: errors by their segment's length, averaged
    distances = pairs.distances
    found: dict[float | None, list[Float64Array]] = {}
    for length in _KITTI_LENGTHS:
        steps = _segments(distances, length, _KITTI_STEP)
        if len(steps[0]):
            shifts, angles = _step_errors(pairs, aligned, steps)
            if angles is None:
                return None
            found[length] = [shifts / length, angles / length]
    if not found:
        return None
    found[None] = [np.concatenate(parts) for parts in zip(*found.values(), strict=True)]
    reported = [
        SegmentErrors(
            length=length,
            segments=len(shifts),
            translation_percent=100 * float(shifts.mean()),
            rotation_deg_per_m=float(np.degrees(angles.mean())),
        )
        for length, (shifts, angles) in found.items()
    ]
    return KittiErrors(overall=reported[-1], by_length=tuple(reported[:-1]))


def _doubts_of(alignment: _Alignment, pairs: Pairs, aligned: MatchedPoses) -> list[DataWarning]:
    """Warnings about the shape of the trajectory, missing orientations or other axes of the device."""
    found = [assumed("doubtful-alignment", "", doubt) for doubt in alignment.doubts]
    ours, theirs = aligned.quaternions_xyzw, pairs.reference.quaternions_xyzw
    if ours is None or theirs is None:
        side = "estimate" if ours is None else "reference"
        message = f"the {side} has no orientations: motions are compared in the aligned world, rotations not at all"
        return [*found, assumed("no-orientations", "", message)]
    rotations = multiply_quaternions(conjugate_quaternion(ours), theirs)
    mean, _ = nearest_rotation(matrix_from_quaternion(rotations).mean(axis=0))
    axes = quaternion_from_matrix(mean)
    rotated = float(np.degrees(angle_between(axes, np.array([0.0, 0.0, 0.0, 1.0]))))
    strays = float(np.degrees(angle_between(rotations, axes).mean()))
    # a trajectory that hardly determines the alignment's rotation does not determine that of the axes, either
    if not found and rotated > _ROTATED_DEG and strays < _STEADY * rotated:
        message = (
            f"the device's axes differ by a constant rotation of {rotated:.1f}° (single poses deviate by "
            f"{strays:.2g}°): if one side has the poses of a camera, use `--est-optical` or `--ref-optical`"
        )
        found.append(assumed("other-axes", "", message))
    return found


def _same_poses(estimate: Trajectory, reference: Trajectory) -> list[DataWarning]:
    """Warn if both are one trajectory, be it by one file or by a copy: its errors mean nothing."""
    names = ("timestamps_ns", "positions", "quaternions_xyzw")
    pairs = [(getattr(estimate, name), getattr(reference, name)) for name in names]
    if not all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs):
        return []
    return [assumed("same-poses", "", "estimate and reference are the same poses at the same times")]


def _plot_errors(
    report: TrajectoryReport,
    pairs: Pairs,
    aligned: MatchedPoses,
    reference_positions: Float64Array,
    curves: Sequence[tuple[str, Float64Array]],
    path: Path,
    *,
    overwrite: bool,
) -> None:
    """Draw the trajectories from above, coloured by the first of the errors, and curves of the errors."""
    figure = check_plot(path, overwrite=overwrite)(figsize=_SIZE_INCHES)
    grid = figure.add_gridspec(len(curves), 2, width_ratios=(1.2, 1.0))
    axes = figure.add_subplot(grid[:, 0])
    ours, theirs = (
        name if len(name) <= _MOST_LETTERS else f"{name[: _MOST_LETTERS - 1]}…"
        for name in (report.estimate, report.reference)
    )
    track = reference_positions[:, :2]
    axes.plot(*track.T, color="0.6", linewidth=3, label=theirs, zorder=1)
    dots = axes.scatter(*aligned.positions[:, :2].T, c=curves[0][1], s=8, cmap="viridis", label=ours, zorder=2)
    axes.plot(*track[0], marker="s", color="black", linestyle="", label="start", zorder=3)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="best")
    figure.colorbar(dots, ax=axes, label="translation error [m]")
    above: Any = None
    for row, (label, errors) in enumerate(curves):
        above = figure.add_subplot(grid[row, 1], sharex=above)
        rms = float(np.sqrt((errors**2).mean()))
        above.plot(pairs.seconds, errors, color="tab:blue", linewidth=1.2)
        above.axhline(rms, color="tab:red", linestyle="--", linewidth=1, label=f"rms {rms:.4g}")
        above.set(ylabel=f"error of {label}", ylim=(0, None))
        above.grid(visible=True, alpha=0.3)
        above.legend(loc="upper right")
    above.set_xlabel("time since the first pair [s]")
    scale = f", scale {report.alignment.scale:.6g}" if report.alignment.kind == "sim3" else ""
    title = (
        f"{report.estimate} against {report.reference}: {report.pairs} pairs, {report.path_length:.4g} m, "
        f"alignment {report.alignment.kind}{scale}"
    )
    save_plot(figure, title, path, overwrite=overwrite)
