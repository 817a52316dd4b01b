"""What the forms share: poses put in order and judged, and numbers written so that they are read back equal."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.poses import GREATEST_NORM_ERROR, PoseRows
from sceneloom.formats.recording.written_times import seconds_text
from sceneloom.formats.trajectories.content import TrajectoryFile
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.warnings import WarningKind

FARTHEST = 1e12
"""Positions beyond it [m] are of no trajectory on or around the earth, and their squares leave no digits."""


def ordered(path: Path, name: str, rows: PoseRows, ledger: Ledger) -> tuple[Trajectory, Int64Array]:
    """Judge the poses, and sort them by time.

    Returns:
        The trajectory, and the row of the file that each of its poses was, (N,) int64.

    Raises:
        DataError: there are none, a position or an orientation is none, or two poses have the same time.
    """
    usable = _sound(path, rows, ledger)
    if not len(usable):
        raise DataError(path, "", "holds no poses; expected at least one")
    times = rows.timestamps_ns[usable]
    back = np.flatnonzero(times[1:] < times[:-1])
    if len(back):
        location = f"{path}: line {rows.lines[int(usable[back[0] + 1])]}"
        ledger.note(
            WarningKind.REPAIRED, "poses-sorted", location, "poses run backwards in time; sorted by time"
        )
    usable = usable[np.argsort(times, kind="stable")]
    kept = _once(path, rows, usable, ledger)
    quaternions = rows.quaternions_xyzw
    trajectory = Trajectory(
        name,
        read_only(rows.timestamps_ns[kept]),
        read_only(rows.positions[kept]),
        None if quaternions is None else read_only(quaternions[kept]),
    )
    return trajectory, kept


def _sound(path: Path, rows: PoseRows, ledger: Ledger) -> Int64Array:
    wrong: dict[int, str] = {}
    far = ~(np.abs(rows.positions) <= FARTHEST).all(axis=1)
    for k in np.flatnonzero(far).tolist():
        wrong[k] = f"position {rows.positions[k].tolist()}; expected metres within ±{FARTHEST:g}"
    if rows.quaternions_xyzw is not None:
        with np.errstate(over="ignore"):
            norms = np.sqrt((rows.quaternions_xyzw**2).sum(axis=1))
        for k in np.flatnonzero(~(np.abs(norms - 1.0) <= GREATEST_NORM_ERROR)).tolist():
            reported = rows.quaternions_xyzw[k].tolist()
            wrong[k] = (
                f"orientation {reported} (x, y, z, w) of length {norms[k]:.4g}; expected length 1 within 0.01"
            )
    for k in sorted(wrong):
        ledger.fault("unusable-poses", DataError(path, f"line {rows.lines[k]}", wrong[k]))
    return np.delete(np.arange(len(rows.timestamps_ns)), sorted(wrong))


def _once(path: Path, rows: PoseRows, usable: Int64Array, ledger: Ledger) -> Int64Array:
    """Keep one pose per time: a body is in one location."""
    times = rows.timestamps_ns[usable]
    repeated = np.flatnonzero(times[1:] == times[:-1]) + 1
    if not len(repeated):
        return usable
    k, before = int(usable[repeated[0]]), int(usable[repeated[0] - 1])
    problem = (
        f"the time {seconds_text(int(rows.timestamps_ns[k]))} s stands in line {rows.lines[before]} already; "
        "expected one pose per time"
    )
    ledger.fault("repeated-poses", DataError(path, f"line {rows.lines[k]}", problem), count=len(repeated))
    return np.delete(usable, repeated)


def oriented(content: TrajectoryFile, target: Path, form: str) -> tuple[Trajectory, Float64Array]:
    """The trajectory with its orientations, for a form that cannot do without.

    Raises:
        OptionError: it has none.
    """
    trajectory = content.trajectory
    if trajectory.quaternions_xyzw is None:
        raise OptionError(
            f"{target}: the trajectory {trajectory.name!r} has positions without orientations, and {form} needs both; "
            "choose the form csv or jsonl, or gnss for fixes"
        )
    return trajectory, trajectory.quaternions_xyzw


def numbers_text(values: Iterable[float], separator: str) -> str:
    """Write numbers with all their digits: the shortest texts that are read back as the same numbers."""
    return separator.join(map(repr, values))


def further_losses(content: TrajectoryFile, *, kept: Iterable[str] = ()) -> list[Loss]:
    """What poses bear besides, and a form of plain poses has no field for."""
    trajectory = content.trajectory
    losses = [
        Loss(field=f"trajectories[{trajectory.name}].{name}", what="left out", count=len(values))
        for name, values in content.columns.items()
        if name not in set(kept)
    ]
    if trajectory.covariances is not None:
        field = f"trajectories[{trajectory.name}].covariances"
        losses.append(Loss(field=field, what="left out", count=len(trajectory.covariances)))
    if content.fixes is not None:
        field, what = f"sensors[{content.fixes.id}]", "written as metres east, north and up of the first fix"
        reported = Loss(
            field=field, what=what, count=len(content.fixes.timestamps_ns), support=Support.CONVERTED
        )
        losses.append(reported)
    return losses
