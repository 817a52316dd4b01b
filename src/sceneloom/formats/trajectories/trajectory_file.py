"""A trajectory file: its content, options, supported fields, order of poses, numbers as text."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError, PoseError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import KEPT, Holding, Loss, Support, Supports, converted, dropped
from sceneloom.formats.base.poses import GREATEST_NORM_ERROR, PoseRows
from sceneloom.formats.base.text_tables import seconds_text
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.types import NO_FIELDS
from sceneloom.warnings import DataWarning, WarningKind

_ELSE = dropped("the file holds one trajectory and nothing else")

_TRAJECTORY: dict[str, Holding] = {
    "": _ELSE,
    "trajectories": KEPT,
    "trajectories.name": dropped("the form has no field for it"),
    "trajectories.order": dropped("the file holds one trajectory"),
    "trajectories.covariances": dropped("the form has no field for them"),
    "trajectories.file_seconds": dropped("only the exact times are written"),
}

_HOLDS: Supports = MappingProxyType(_TRAJECTORY)  # of forms that hold poses with times, number for number

MATRICES: Supports = MappingProxyType(
    {**_TRAJECTORY, "trajectories.quaternions_xyzw": converted("as matrices of rotation, within 1e-14 rad")}
)
"""Of forms that hold poses as matrices."""

NAMED: Supports = MappingProxyType({**_TRAJECTORY, "trajectories.name": KEPT})
"""Of forms that hold the name of the trajectory."""

LOCATIONS: Supports = MappingProxyType(
    {
        **_TRAJECTORY,
        "trajectories.positions": converted("as latitude, longitude and altitude"),
        "trajectories.quaternions_xyzw": dropped("positions on earth have no orientation"),
    }
)
"""Of a trajectory in a form of positions on earth."""

FIXES: Supports = MappingProxyType(
    {
        "": _ELSE,
        "sensors.gnss.timestamps_ns": KEPT,
        "sensors.gnss.positions_lla": KEPT,
        "sensors.gnss.accuracies": KEPT,
        "sensors.gnss.vertical_accuracies": KEPT,
    }
)
"""Of what a satellite receiver reported, in a form of positions on earth."""

_METRES: Supports = MappingProxyType(
    {
        "": _ELSE,
        "sensors.gnss.timestamps_ns": KEPT,
        "sensors.gnss.positions_lla": converted("as metres east, north and up of the first fix"),
    }
)
"""Of what a satellite receiver reported, in a form of poses."""


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryFile:
    """A trajectory with all that its file says.

    Attributes:
        trajectory: the poses, device to world; positions of fixes are east, north and up of `origin_lla`.
        form: name of the form it was read from.
        fixes: what a satellite receiver reported, or None.
        origin_lla: (3,) float64: latitude [deg], longitude [deg], altitude [m] of the world's origin, or None.
        columns: (N, 3) float64 by name, what else a pose bears: "velocities" [m/s], "gyroscope_biases" [rad/s],
            "accelerometer_biases" [m/s²].
        warnings: what was assumed, repaired or left out.
    """

    trajectory: Trajectory
    form: str = "memory"
    fixes: GnssSensor | None = None
    origin_lla: Float64Array | None = None
    columns: Mapping[str, Float64Array] = field(default_factory=lambda: NO_FIELDS)
    warnings: tuple[DataWarning, ...] = ()

    @classmethod
    def of(cls, trajectory: "Trajectory | Poses | TrajectoryFile") -> "TrajectoryFile":
        """A trajectory or a path of poses with nothing besides; what a file stated as it is.

        Raises:
            PoseError: a path is one pose for all times.
        """
        if isinstance(trajectory, TrajectoryFile):
            return trajectory
        if isinstance(trajectory, Trajectory):
            return cls(trajectory)
        if trajectory.static:
            raise PoseError("a pose that holds at all times is no trajectory; expected poses with a time each")
        return cls(Trajectory("poses", trajectory.timestamps_ns, trajectory.positions, trajectory.quaternions_xyzw))


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """How a file of a trajectory is to be read.

    Attributes:
        name: which one of several, or how one without a name is to be called.
        times: a text file with one time per line, for a form without times.
        rate_hz: poses per second, from time 0 on, for a form without times.
        unit: of the times in a text file; None: seconds, or what the form says.
        origin_lla: (3,) float64: where positions of fixes are seen from; None: from the first one.
    """

    name: str | None = None
    times: Path | None = None
    rate_hz: float | None = None
    unit: str | None = None
    origin_lla: Float64Array | None = None


@dataclass(frozen=True, slots=True)
class TrajectoryForm:
    """One form of files, a row of the table.

    Attributes:
        name: by which it is chosen.
        suffixes: of paths that are written in it where nothing else is stated.
        looks_like: what a person recognises it by.
        recognises: whether the beginning of a file's text looks like it.
        read: gives the content of a file.
        write: puts a content into a new file, and reports what that has no field for. It is given the path to write to
            and, for messages, the one that will be the file's in the end.
        beside: where a second file stands that is written with it, or None.
        supports: what becomes of each field of a scene out of which a trajectory is written.
        fix_supports: the same where it is what a satellite receiver reported.
    """

    name: str
    suffixes: tuple[str, ...]
    looks_like: str
    recognises: Callable[[str], bool]
    read: Callable[[Path, Reading, Ledger], TrajectoryFile]
    write: Callable[[TrajectoryFile, Path, Path], Iterable[Loss]]
    beside: Callable[[Path], Path] | None = None
    supports: Supports = field(default_factory=lambda: _HOLDS)
    fix_supports: Supports = field(default_factory=lambda: _METRES)


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
        ledger.note(WarningKind.REPAIRED, "poses-sorted", location, "poses run backwards in time; sorted by time")
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
            wrong[k] = f"orientation {reported} (x, y, z, w) of length {norms[k]:.4g}; expected length 1 within 0.01"
    for k in sorted(wrong):
        ledger.fault("unusable-poses", DataError(path, f"line {rows.lines[k]}", wrong[k]))
    return np.delete(np.arange(len(rows.timestamps_ns)), sorted(wrong))


def _once(path: Path, rows: PoseRows, usable: Int64Array, ledger: Ledger) -> Int64Array:
    """Keep one pose per time: a body is in one position."""
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
        reported = Loss(field=field, what=what, count=len(content.fixes.timestamps_ns), support=Support.CONVERTED)
        losses.append(reported)
    return losses
