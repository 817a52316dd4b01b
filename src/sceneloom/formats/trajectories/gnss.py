"""GNSS: CSV whose first line names the columns: time, latitude, longitude, altitude, and accuracies where known."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Loss
from sceneloom.formats.poses import PoseRows
from sceneloom.formats.recording.written_times import seconds_text
from sceneloom.formats.rig.csv_files import TIME_COLUMNS, Table, pick_columns, read_table
from sceneloom.formats.rig.motion_sensors import GNSS_COLUMNS
from sceneloom.formats.trajectories.content import Reading, TrajectoryFile, TrajectoryForm
from sceneloom.formats.trajectories.first_lines import first_names
from sceneloom.formats.trajectories.rows import further_losses, ordered
from sceneloom.formats.trajectories.supported_fields import FIXES, LOCATIONS
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.warnings import WarningKind

_LOCATION = ("latitude", "longitude", "altitude")


def _recognises(text: str) -> bool:
    names = set(first_names(text) or ())
    wanted = [GNSS_COLUMNS[role] for role in ("latitude", "longitude")]
    return bool(names & set(TIME_COLUMNS)) and all(names & set(known) for known in wanted)


def _read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    table = read_table(path)
    columns = pick_columns(table, GNSS_COLUMNS, {}, "", path)
    missing = [role for role in ("time", "latitude", "longitude") if role not in columns]
    if missing:
        raise DataError(path, "line 1", f"no column for {', '.join(missing)} among {', '.join(table.names)}")
    if not table.rows:
        raise DataError(path, "", "holds no fixes; expected at least one")
    positions_lla = table.numbers([columns[role] for role in _LOCATION if role in columns])
    if "altitude" not in columns:
        ledger.note(WarningKind.ASSUMED, "altitude-zero", str(path), "no column of altitudes; taken as 0 m")
        positions_lla = np.concatenate([positions_lla, np.zeros((len(positions_lla), 1))], axis=1)
    _check_locations(table, positions_lla)
    rows = PoseRows(table.timestamps(columns["time"], reading.unit), positions_lla, None, table.lines)
    trajectory, kept = ordered(path, reading.name or path.stem, rows, ledger)
    fixes = GnssSensor(
        trajectory.name,
        trajectory.timestamps_ns,
        trajectory.positions,
        _accuracies(table, columns.get("accuracy"), kept),
        _accuracies(table, columns.get("vertical_accuracy"), kept),
    )
    return replace(of_fixes(fixes, origin_lla=reading.origin_lla), form=FORM.name)


def of_fixes(
    fixes: GnssSensor, *, origin_lla: Float64Array | None = None, name: str | None = None
) -> TrajectoryFile:
    """The trajectory of a satellite receiver: metres east, north and up of an origin, else of its first fix."""
    origin = fixes.positions_lla[0] if origin_lla is None else origin_lla
    positions = read_only(enu_from_geodetic(fixes.positions_lla, origin))
    trajectory = Trajectory(name or str(fixes.id), fixes.timestamps_ns, positions)
    return TrajectoryFile(trajectory, fixes=fixes, origin_lla=read_only(origin))


def _check_locations(table: Table, positions_lla: Float64Array) -> None:
    outside = (np.abs(positions_lla[:, 0]) > 90) | (np.abs(positions_lla[:, 1]) > 180)
    if outside.any():
        k = int(np.flatnonzero(outside)[0])
        reported = f"latitude {positions_lla[k, 0]}, longitude {positions_lla[k, 1]}"
        problem = f"{reported}; expected degrees within ±90 and ±180"
        raise DataError(table.path, f"line {table.lines[k]}", problem)


def _accuracies(table: Table, column: int | None, kept: Int64Array) -> Float64Array:
    """A column in which a value may be absent, (N,) float64 [m]."""
    values = np.full(len(kept), np.nan)
    for k, row in enumerate(kept if column is not None else ()):
        text = table.rows[row][column or 0]
        try:
            values[k] = float(text) if text else np.nan
        except ValueError:
            values[k] = np.inf
        if np.isinf(values[k]):
            problem = f"{table.names[column or 0]}: {text[:40]!r}; expected metres, or nothing"
            raise DataError(table.path, f"line {table.lines[row]}", problem)
    return read_only(values)


def _write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    fixes, losses = content.fixes, further_losses(replace(content, fixes=None))
    if fixes is None:
        fixes = _fixes_of_trajectory(content, target)
        if content.trajectory.quaternions_xyzw is not None:
            field = f"trajectories[{content.trajectory.name}].quaternions_xyzw"
            losses.append(Loss(field=field, what="left out", count=len(fixes.timestamps_ns)))
    values = np.column_stack([fixes.positions_lla, fixes.accuracies, fixes.vertical_accuracies])
    optional = [k for k in (3, 4) if np.isfinite(values[:, k]).any()]
    names = ("latitude", "longitude", "altitude", "accuracy", "vertical_accuracy")
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(("time", *(names[k] for k in (0, 1, 2, *optional)))) + "\n")
        for time_ns, row in zip(fixes.timestamps_ns.tolist(), values.tolist(), strict=True):
            cells = ["" if np.isnan(row[k]) else repr(row[k]) for k in (0, 1, 2, *optional)]
            file.write(f"{seconds_text(time_ns)},{','.join(cells)}\n")
    return losses


def _fixes_of_trajectory(content: TrajectoryFile, target: Path) -> GnssSensor:
    if content.origin_lla is None:
        raise OptionError(
            f"{target}: where on earth the trajectory {content.trajectory.name!r} has its origin is not known; state "
            "latitude, longitude and altitude of it (`--origin`)"
        )
    trajectory = content.trajectory
    unknown = np.full(len(trajectory.timestamps_ns), np.nan)
    locations = geodetic_from_enu(trajectory.positions, content.origin_lla)
    return GnssSensor(trajectory.name, trajectory.timestamps_ns, locations, unknown, unknown)


FORM = TrajectoryForm(
    "gnss",
    (),
    "CSV with columns of names such as time, latitude, longitude, altitude",
    _recognises,
    _read,
    _write,
    supports=LOCATIONS,
    fix_supports=FIXES,
)
