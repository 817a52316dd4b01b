"""CSV whose first line names the columns: a time, x y z, and, where there are orientations, qx qy qz qw."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Loss
from sceneloom.formats.poses import PoseRows
from sceneloom.formats.rig.csv_files import TIME_COLUMNS, pick_columns, read_table
from sceneloom.formats.rig.trajectories import POSE_COLUMNS
from sceneloom.formats.trajectories.content import Reading, TrajectoryFile, TrajectoryForm
from sceneloom.formats.trajectories.first_lines import first_names
from sceneloom.formats.trajectories.rows import further_losses, numbers_text, ordered

_LOCATION, _ROTATION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")


def _recognises(text: str) -> bool:
    names = set(first_names(text) or ())
    wanted = [POSE_COLUMNS[role] for role in _LOCATION]
    return bool(names & set(TIME_COLUMNS)) and all(names & set(known) for known in wanted)


def _read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    table = read_table(path)
    columns = pick_columns(table, POSE_COLUMNS, {}, "", path)
    rotation = [role for role in _ROTATION if role in columns]
    missing = [role for role in ("time", *_LOCATION, *(_ROTATION if rotation else ())) if role not in columns]
    if missing:
        problem = f"no column for {', '.join(missing)} among {', '.join(table.names)}"
        raise DataError(path, "line 1", problem)
    values = table.numbers([columns[role] for role in (*_LOCATION, *rotation)])
    timestamps = table.timestamps(columns["time"], reading.unit)
    rows = PoseRows(timestamps, values[:, :3], values[:, 3:] if rotation else None, table.lines)
    return TrajectoryFile(ordered(path, reading.name or path.stem, rows, ledger)[0], FORM.name)


def _write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    del target
    trajectory = content.trajectory
    rotated = trajectory.quaternions_xyzw is not None
    parts = (
        [trajectory.positions]
        if trajectory.quaternions_xyzw is None
        else [trajectory.positions, trajectory.quaternions_xyzw]
    )
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(("timestamp_ns", *_LOCATION, *(_ROTATION if rotated else ()))) + "\n")
        values = np.concatenate(parts, axis=1).tolist()
        for time_ns, row in zip(trajectory.timestamps_ns.tolist(), values, strict=True):
            file.write(f"{time_ns},{numbers_text(row, ',')}\n")
    return further_losses(content)


FORM = TrajectoryForm(
    "csv",
    (),
    "CSV with columns of names such as timestamp_ns, x, y, z, qx, qy, qz, qw",
    _recognises,
    _read,
    _write,
)
