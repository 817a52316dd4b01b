"""Which pose of an estimate belongs to which pose of the reference, by their times."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import ArrayError, OptionError, PoseError
from sceneloom.formats.trajectories.rows import FARTHEST
from sceneloom.geometry.interpolation import interpolate_poses
from sceneloom.geometry.rotations import normalise_quaternion
from sceneloom.scene.poses import Trajectory

TOLERANCES_NS = {"interpolate": 100_000_000, "nearest": 10_000_000}
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
        return trajectory_along(self.reference.positions)


def trajectory_along(positions: Float64Array) -> Float64Array:
    """The trajectory up to each of (N, 3) positions, (N,) float64 [m]."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def checked_trajectory(trajectory: Trajectory) -> Trajectory:
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
        tolerance_ns: how far the nearest pose of the reference may be [ns]; None: `TOLERANCES_NS`.

    Raises:
        OptionError: `how` or the tolerance is wrong.
        PoseError: no pose has a partner.
    """
    if how not in TOLERANCES_NS:
        raise OptionError(f"association {how!r}; expected one of {', '.join(TOLERANCES_NS)}")
    tolerance_ns = TOLERANCES_NS[how] if tolerance_ns is None else tolerance_ns
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
        rows = rows[
            (times[rows] >= reference.timestamps_ns[0]) & (times[rows] <= reference.timestamps_ns[-1])
        ]
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
    rotations = (
        np.tile([0.0, 0.0, 0.0, 1.0], (len(reference.timestamps_ns), 1))
        if quaternions is None
        else quaternions
    )
    positions, rotations, _ = interpolate_poses(
        reference.timestamps_ns, reference.positions, rotations, times_ns
    )
    return MatchedPoses(positions, None if quaternions is None else rotations)


def _without_pairs(estimate: Trajectory, reference: Trajectory, away_ns: int, tolerance_ns: int) -> str:
    (a, b), (c, d) = (
        (int(trajectory.timestamps_ns[0]), int(trajectory.timestamps_ns[-1]))
        for trajectory in (estimate, reference)
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
