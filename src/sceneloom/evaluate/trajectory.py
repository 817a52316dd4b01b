"""A trajectory compared with a reference, with warnings about what the metrics cannot tell."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec import structs

from sceneloom.arrays import Float64Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.evaluate.plot import check_plot
from sceneloom.evaluate.trajectory_plot import plot_errors
from sceneloom.evaluate.trajectory_errors import (
    AbsoluteErrors,
    Alignment,
    AlignmentReport,
    ErrorStatistics,
    MatchedPoses,
    Pairs,
    TrajectoryErrors,
    TrajectoryReport,
    align_pairs,
    associate_poses,
    checked_trajectory,
    covered_share,
    kitti_errors,
    parse_delta,
    relative_errors,
    trajectory_along,
)
from sceneloom.formats.trajectories.table import content_of, read_trajectory_file
from sceneloom.formats.trajectories.text_formats import of_fixes
from sceneloom.formats.trajectories.trajectory_file import TrajectoryFile
from sceneloom.geometry.rotations import (
    angle_between,
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
    quaternion_from_matrix,
)
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.warnings import DataWarning, WarningKind

_ROTATED_DEG = 5.0

_STEADY = 0.25
"""A mean rotation of the device's axes beyond so many degrees.

From which single ones stray by less than this share of it,
is taken for another choice of axes."""


def _doubts_of(alignment: Alignment, pairs: Pairs, aligned: MatchedPoses) -> list[DataWarning]:
    """What the shape of the trajectory, missing orientations or other axes of the device do to the numbers."""
    found = [_warning("doubtful-alignment", doubt) for doubt in alignment.doubts]
    ours, theirs = aligned.quaternions_xyzw, pairs.reference.quaternions_xyzw
    if ours is None or theirs is None:
        side = "estimate" if ours is None else "reference"
        message = (
            f"the {side} has no orientations: motions are compared in the aligned world, rotates not at all"
        )
        return [*found, _warning("no-orientations", message)]
    rotation, strays_deg = _rotation_of_axes(ours, theirs)
    # a trajectory that hardly reports the alignment's rotation states nothing about that of the axes, either
    if not found and rotation > _ROTATED_DEG and strays_deg < _STEADY * rotation:
        message = (
            f"the device's axes differ by a steady rotation of {rotation:.1f}° (single poses stray by "
            f"{strays_deg:.2g}°): if "
            "one side reports a camera's poses, state `--est-optical` or `--ref-optical`"
        )
        found.append(_warning("other-axes", message))
    return found


def _rotation_of_axes(ours: Float64Array, theirs: Float64Array) -> tuple[float, float]:
    """The mean rotation between the axes of both devices.

    And the mean angle by which single ones stray from it [deg].
    """
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
        parse_delta(delta)
    if plot is not None:
        check_plot(Path(plot), overwrite=overwrite)
    ours, theirs = _both(estimate, reference)
    report, errors = _compared(
        checked_trajectory(ours.trajectory),
        checked_trajectory(theirs.trajectory),
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
        plot_errors(errors, report, Path(plot), overwrite=overwrite)
    return report


def _both(
    estimate: _SmoothedTrajectory, reference: _SmoothedTrajectory
) -> tuple[TrajectoryFile, TrajectoryFile]:
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
) -> tuple[TrajectoryReport, TrajectoryErrors]:
    estimate = _shifted(estimate, offset_ns)
    # the whole reference is paired with, lest the poses at the part's ends have no neighbours
    whole = reference
    estimate, reference = _within(estimate, reference, *part)
    tolerance_ns = None if tolerance is None else _nanoseconds("tolerance", tolerance)
    pairs = associate_poses(estimate, whole, how=how, tolerance_ns=tolerance_ns)
    alignment = align_pairs(pairs, align, first=first)
    aligned = alignment.apply(pairs.estimate)
    absolute, errors = _absolute(estimate, reference, pairs, aligned)
    relative = {delta: relative_errors(pairs, aligned, delta) for delta in deltas}
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
        estimate_path_length=float(trajectory_along(pairs.estimate.positions)[-1]),
        alignment=_alignment_report(alignment, align, used),
        absolute=absolute,
        relative=tuple(errors for errors in relative.values() if errors is not None),
        kitti=kitti_errors(pairs, aligned),
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
) -> tuple[AbsoluteErrors, TrajectoryErrors]:
    away = aligned.positions - pairs.reference.positions
    lengths = np.linalg.norm(away, axis=1)
    degrees = None
    if aligned.quaternions_xyzw is not None and pairs.reference.quaternions_xyzw is not None:
        degrees = np.degrees(angle_between(aligned.quaternions_xyzw, pairs.reference.quaternions_xyzw))
    errors = TrajectoryErrors(
        estimate.name, reference.name, pairs, aligned, reference.positions, lengths, degrees
    )
    reported = AbsoluteErrors(
        translation=ErrorStatistics.of(lengths),
        horizontal=ErrorStatistics.of(np.hypot(away[:, 0], away[:, 1])),
        vertical=ErrorStatistics.of(np.abs(away[:, 2])),
        rotation_deg=None if degrees is None else ErrorStatistics.of(degrees),
    )
    return reported, errors


def _alignment_report(alignment: Alignment, kind: str, poses: int) -> AlignmentReport:
    x, y, z, w = quaternion_from_matrix(alignment.rotation).tolist()
    east, north, up = alignment.translation.tolist()
    return AlignmentReport(
        kind=kind,
        poses=0 if kind == "none" else 1 if kind == "origin" else poses,
        quaternion_xyzw=(x, y, z, w),
        translation=(east, north, up),
        scale=alignment.scale,
    )
