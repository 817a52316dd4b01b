"""Trajectories as lines and tables of text: TUM, KITTI, EuRoC, named columns, and GNSS fixes."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from functools import partial
from itertools import takewhile
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss
from sceneloom.formats.base.poses import PoseRows
from sceneloom.formats.base.spec import first_bytes
from sceneloom.formats.base.text_tables import (
    FARTHEST_NS,
    GNSS_COLUMNS,
    POSE_COLUMNS,
    TIME_COLUMNS,
    Table,
    line_timestamps,
    pick_columns,
    read_table,
    seconds_text,
)
from sceneloom.formats.trajectories.trajectory_file import (
    FIXES,
    LOCATIONS,
    MATRICES,
    Reading,
    TrajectoryFile,
    TrajectoryForm,
    further_losses,
    ordered,
)
from sceneloom.geometry.geodesy import enu_from_geodetic, geodetic_from_enu
from sceneloom.geometry.rigid import GREATEST_ERROR, matrix_from_quaternion, quaternion_from_matrix
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.warnings import WarningKind

_POSITION, _ROTATION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_LLA = ("latitude", "longitude", "altitude")
_OPTIONAL = ("accuracy", "vertical_accuracy")

_EXTRA: Mapping[str, str] = {
    "velocities": "v_RS_R_{} [m s^-1]",
    "gyroscope_biases": "b_w_RS_S_{} [rad s^-1]",
    "accelerometer_biases": "b_a_RS_S_{} [m s^-2]",
}
"""What may follow a pose of EuRoC, three numbers each, in this order, and the names of the columns."""

_EUROC_POSE = ("#timestamp", *(f"p_RS_R_{axis} [m]" for axis in "xyz"), *(f"q_RS_{axis} []" for axis in "wxyz"))
_WIDTHS = tuple(8 + 3 * count for count in range(len(_EXTRA) + 1))
_POSITIONS_ONLY = 4  # numbers a line of the position tracker's files, which have the same header without orientations

_EARLIEST_NS = 1e12
"""Less than this many nanoseconds, a quarter of an hour, is taken for seconds of another form when recognising."""


def _number_lines(path: Path, widths: Sequence[int], meaning: str) -> Table:
    """A file of numbers without names of columns, so many a line."""
    table = read_table(path, named=False)
    if len(table.rows[0]) not in widths:
        problem = f"{len(table.rows[0])} values; expected {', '.join(map(str, widths))}: {meaning}"
        raise DataError(path, f"line {table.lines[0]}", problem)
    return table


def _named_table(path: Path, known: Mapping[str, Sequence[str]]) -> tuple[Table, dict[str, int]]:
    """A file with names of columns, and the columns by what they are."""
    table = read_table(path)
    return table, dict(pick_columns(table, known, {}, "", path))


def _check_columns(table: Table, columns: Mapping[str, int], wanted: Iterable[str]) -> None:
    missing = [role for role in wanted if role not in columns]
    if missing:
        problem = f"no column for {', '.join(missing)} among {', '.join(table.names)}"
        raise DataError(table.path, "line 1", problem)


def _write_rows(path: Path, head: str, times: Iterable[object], values: Float64Array, separator: str) -> None:
    """Write a time and numbers a line, with all their digits: the shortest texts that are read as the same numbers."""
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(head)
        for time, row in zip(times, values.tolist(), strict=True):
            file.write(separator.join([str(time), *map(repr, row)]) + "\n")


def _recognises_numbers(widths: Sequence[int], text: str) -> bool:
    values = _first_values(text, None)
    return values is not None and len(values) in widths


def _recognises_names(known: Mapping[str, Sequence[str]], roles: Sequence[str], text: str) -> bool:
    names = set(_first_names(text) or ())
    return bool(names & set(TIME_COLUMNS)) and all(names & set(known[role]) for role in roles)


# TUM


def _tum_read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    table = _number_lines(path, (8,), "timestamp tx ty tz qx qy qz qw")
    values = table.numbers(range(1, 8))
    rows = PoseRows(table.timestamps(0, reading.unit), values[:, :3], values[:, 3:], table.lines)
    return TrajectoryFile(ordered(path, reading.name or path.stem, rows, ledger)[0], TUM.name)


def _tum_write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    trajectory, quaternions = _oriented(content, target, TUM.name)
    times = map(seconds_text, trajectory.timestamps_ns.tolist())
    values = np.concatenate([trajectory.positions, quaternions], axis=1)
    _write_rows(path, "# timestamp tx ty tz qx qy qz qw\n", times, values, " ")
    return further_losses(content)


TUM = TrajectoryForm(
    "tum",
    (".tum", ".txt"),
    "lines of 8 numbers: timestamp tx ty tz qx qy qz qw",
    partial(_recognises_numbers, (8,)),
    _tum_read,
    _tum_write,
)


# KITTI


def _times_beside(path: Path) -> Path:
    """Where the times of a file of poses are written: `trajectory.kitti` has its in `trajectory.times.txt`."""
    return path.with_name(f"{path.stem}.times.txt")


def _kitti_read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    table = _number_lines(path, (12,), "three rows of [R t]")
    timestamps = _timestamps(path, len(table.rows), reading, ledger)
    matrices = table.numbers(range(12)).reshape(-1, 3, 4)
    quaternions = _quaternions(table, matrices[:, :, :3])
    rows = PoseRows(timestamps, matrices[:, :, 3].copy(), quaternions, table.lines)
    return TrajectoryFile(ordered(path, reading.name or path.stem, rows, ledger)[0], KITTI.name)


def _quaternions(table: Table, matrices: Float64Array) -> Float64Array:
    """The rotations nearest to (N, 3, 3) rounded matrices, as (N, 4) quaternions. Source: as `nearest_rotation`."""
    # elements beyond 2 would overflow in the products of the test
    small = np.abs(matrices).max(axis=(1, 2)) <= 2
    clipped = np.where(small[:, None, None], matrices, 0.0)
    errors = np.abs(clipped @ clipped.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero(~((errors <= GREATEST_ERROR) & (np.linalg.det(clipped) > 0)))
    if len(wrong):
        row = int(wrong[0])
        problem = f"{matrices[row].tolist()}; expected an orthonormal right-handed rotation within {GREATEST_ERROR:g}"
        raise DataError(table.path, f"line {table.lines[row]}", problem)
    # of all rotations U Vᵀ is nearest, and right-handed like the matrix
    u, _, vt = np.linalg.svd(clipped)
    return quaternion_from_matrix(u @ vt)


def _timestamps(path: Path, count: int, reading: Reading, ledger: Ledger) -> Int64Array:
    """The times of the poses: of a file that was named, by a rate, or of a file of times beside the poses."""
    if reading.times is not None and reading.rate_hz is not None:
        raise OptionError("times and a rate; expected one of both")
    if reading.rate_hz is not None:
        return _evenly(count, reading.rate_hz)
    beside = (_times_beside(path), path.with_name(f"{path.stem}_times.txt"), path.with_name("times.txt"))
    found = reading.times or next((one for one in beside if one.is_file() and one != path), None)
    if found is None:
        problem = (
            "a file of this form has no times; name a text file with one time per line (`--from-times FILE`, of "
            "`sceneloom eval trajectory` `--est-times`, `--ref-times`), or the poses per second (`--from-rate HZ`, "
            f"`--est-rate`, `--ref-rate`), or put {_times_beside(path).name} or times.txt beside it"
        )
        raise DataError(path, "", problem)
    if reading.times is None:
        ledger.note(WarningKind.ASSUMED, "times-beside", str(path), f"its times were taken from {found.name}")
    timestamps = line_timestamps(found, reading.unit)
    if len(timestamps) != count:
        raise DataError(found, "", f"{len(timestamps)} times for the {count} poses of {path.name}; expected as many")
    return timestamps


def _evenly(count: int, rate_hz: float) -> Int64Array:
    """Times of numbered poses, rounded once each, so that no error adds up."""
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise OptionError(f"rate {rate_hz:g} Hz; expected poses per second above 0")
    period_ns = Decimal(10**9) / Decimal(repr(float(rate_hz)))
    if period_ns * count > FARTHEST_NS:
        raise OptionError(f"rate {rate_hz:g} Hz; {count} poses would end beyond the year 2261")
    return np.array([int((k * period_ns).to_integral_value()) for k in range(count)], np.int64)


def _kitti_write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    trajectory, quaternions = _oriented(content, target, KITTI.name)
    matrices = np.concatenate([matrix_from_quaternion(quaternions), trajectory.positions[:, :, None]], axis=2)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{' '.join(map(repr, matrix))}\n" for matrix in matrices.reshape(-1, 12).tolist())
    with _times_beside(path).open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{seconds_text(time_ns)}\n" for time_ns in trajectory.timestamps_ns.tolist())
    return further_losses(content)


KITTI = TrajectoryForm(
    "kitti",
    (".kitti",),
    "lines of 12 numbers: three rows of [R t]",
    partial(_recognises_numbers, (12,)),
    _kitti_read,
    _kitti_write,
    _times_beside,
    MATRICES,
)


# EuRoC


def _euroc_recognises(text: str) -> bool:
    if "p_RS_R_x" in text.split("\n", 1)[0]:
        return True
    values = _first_values(text, ",")
    return values is not None and len(values) in _WIDTHS and values[0].is_integer() and values[0] > _EARLIEST_NS


def _euroc_read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    meaning = "timestamp, position, quaternion w x y z, velocity, biases"
    table = _number_lines(path, (_POSITIONS_ONLY, *_WIDTHS), meaning)
    width = len(table.rows[0])
    values = table.numbers(range(1, width))
    timestamps = table.timestamps(0, reading.unit or "nanoseconds")
    quaternions = None if width == _POSITIONS_ONLY else values[:, [4, 5, 6, 3]]
    rows = PoseRows(timestamps, values[:, :3], quaternions, table.lines)
    trajectory, kept = ordered(path, reading.name or path.stem, rows, ledger)
    starts = {name: 7 + 3 * k for k, name in enumerate(_EXTRA) if 10 + 3 * k <= width - 1}
    columns = {name: read_only(values[kept, start : start + 3]) for name, start in starts.items()}
    return TrajectoryFile(trajectory, EUROC.name, columns=columns)


def _euroc_write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    trajectory, quaternions = _oriented(content, target, EUROC.name)
    extra = list(takewhile(content.columns.__contains__, _EXTRA))
    names = [*_EUROC_POSE, *(_EXTRA[name].format(axis) for name in extra for axis in "xyz")]
    parts = [trajectory.positions, quaternions[:, [3, 0, 1, 2]], *(content.columns[name] for name in extra)]
    _write_rows(path, f"{', '.join(names)}\n", trajectory.timestamps_ns.tolist(), np.concatenate(parts, axis=1), ",")
    return further_losses(content, kept=extra)


EUROC = TrajectoryForm(
    "euroc",
    (".csv",),
    "CSV that begins with #timestamp, p_RS_R_x …: nanoseconds, position, quaternion w x y z",
    _euroc_recognises,
    _euroc_read,
    _euroc_write,
)


# columns with names


def _csv_read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    table, columns = _named_table(path, POSE_COLUMNS)
    rotation = _ROTATION if any(role in columns for role in _ROTATION) else ()
    _check_columns(table, columns, ("time", *_POSITION, *rotation))
    values = table.numbers([columns[role] for role in (*_POSITION, *rotation)])
    timestamps = table.timestamps(columns["time"], reading.unit)
    rows = PoseRows(timestamps, values[:, :3], values[:, 3:] if rotation else None, table.lines)
    return TrajectoryFile(ordered(path, reading.name or path.stem, rows, ledger)[0], NAMED_COLUMNS.name)


def _csv_write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    del target
    trajectory = content.trajectory
    names, values = ["timestamp_ns", *_POSITION], trajectory.positions
    if trajectory.quaternions_xyzw is not None:
        names, values = [*names, *_ROTATION], np.concatenate([values, trajectory.quaternions_xyzw], axis=1)
    _write_rows(path, f"{','.join(names)}\n", trajectory.timestamps_ns.tolist(), values, ",")
    return further_losses(content)


NAMED_COLUMNS = TrajectoryForm(
    "csv",
    (),
    "CSV with columns of names such as timestamp_ns, x, y, z, qx, qy, qz, qw",
    partial(_recognises_names, POSE_COLUMNS, _POSITION),
    _csv_read,
    _csv_write,
)


# GNSS fixes


_PLAIN = ("time", *_LLA, "north_deviation", "east_deviation", "down_deviation")
"""Columns of lines of seven numbers: GPS seconds of a week, degrees, metres. Source: KF-GINS' manual."""

_WEEK_SECONDS, _FIRST_LINES = 604_800.0, 4096  # the latter in bytes


def _gnss_recognises(text: str) -> bool:
    values = _first_values(text, None)
    if values is None:
        return _recognises_names(GNSS_COLUMNS, ("latitude", "longitude"), text)
    if len(values) != len(_PLAIN):
        return False
    seconds, latitude, longitude, _, *deviations = values
    return 0.0 <= seconds < _WEEK_SECONDS and abs(latitude) <= 90 and abs(longitude) <= 180 and min(deviations) > 0.0


def _gnss_read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    if _first_values(first_bytes(path, _FIRST_LINES).decode("utf-8", "replace"), None) is not None:
        return _plain_fixes(path, reading, ledger)
    table, columns = _named_table(path, GNSS_COLUMNS)
    _check_columns(table, columns, ("time", "latitude", "longitude"))
    if not table.rows:
        raise DataError(path, "", "holds no fixes; expected at least one")
    positions_lla = table.numbers([columns[role] for role in _LLA if role in columns])
    if "altitude" not in columns:
        ledger.note(WarningKind.ASSUMED, "altitude-zero", str(path), "no column of altitudes; taken as 0 m")
        positions_lla = np.concatenate([positions_lla, np.zeros((len(positions_lla), 1))], axis=1)
    _check_degrees(table, positions_lla)
    rows = PoseRows(table.timestamps(columns["time"], reading.unit), positions_lla, None, table.lines)
    trajectory, kept = ordered(path, reading.name or path.stem, rows, ledger)
    accuracies, vertical = (_accuracies(table, columns.get(name), kept) for name in _OPTIONAL)
    fixes = GnssSensor(trajectory.name, trajectory.timestamps_ns, trajectory.positions, accuracies, vertical)
    return replace(of_fixes(fixes, origin_lla=reading.origin_lla), form=GNSS.name)


def _check_degrees(table: Table, positions_lla: Float64Array) -> None:
    outside = (np.abs(positions_lla[:, 0]) > 90) | (np.abs(positions_lla[:, 1]) > 180)
    for k in np.flatnonzero(outside)[:1].tolist():
        problem = f"latitude {positions_lla[k, 0]}, longitude {positions_lla[k, 1]}"
        raise DataError(table.path, f"line {table.lines[k]}", f"{problem}; expected degrees within ±90 and ±180")


def _plain_fixes(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    table = _number_lines(path, (len(_PLAIN),), " ".join(_PLAIN))
    values = table.numbers(range(1, len(_PLAIN)))
    _check_degrees(table, values)
    if reading.unit is None:
        message = "times without a week; taken as seconds from 1970, as in other files of the same week"
        ledger.note(WarningKind.ASSUMED, "gnss-week-unknown", str(path), message)
    rows = PoseRows(table.timestamps(0, reading.unit or "seconds"), values[:, :3], None, table.lines)
    trajectory, kept = ordered(path, reading.name or path.stem, rows, ledger)
    across, down = np.sqrt((values[kept, 3:5] ** 2).mean(axis=1)), values[kept, 5]
    fixes = GnssSensor(
        trajectory.name, trajectory.timestamps_ns, trajectory.positions, read_only(across), read_only(down)
    )
    return replace(of_fixes(fixes, origin_lla=reading.origin_lla), form=GNSS.name)


def of_fixes(fixes: GnssSensor, *, origin_lla: Float64Array | None = None, name: str | None = None) -> TrajectoryFile:
    """The trajectory of a satellite receiver: metres east, north and up of an origin, else of its first fix."""
    origin = fixes.positions_lla[0] if origin_lla is None else origin_lla
    positions = read_only(enu_from_geodetic(fixes.positions_lla, origin))
    trajectory = Trajectory(name or str(fixes.id), fixes.timestamps_ns, positions)
    return TrajectoryFile(trajectory, fixes=fixes, origin_lla=read_only(origin))


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


def _gnss_write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    fixes, losses = content.fixes, further_losses(replace(content, fixes=None))
    if fixes is None:
        fixes = _fixes_of_trajectory(content, target)
        if content.trajectory.quaternions_xyzw is not None:
            field = f"trajectories[{content.trajectory.name}].quaternions_xyzw"
            losses.append(Loss(field=field, what="left out", count=len(fixes.timestamps_ns)))
    values = np.column_stack([fixes.positions_lla, fixes.accuracies, fixes.vertical_accuracies])
    names = (*_LLA, *_OPTIONAL)
    written = [k for k in range(5) if k < 3 or np.isfinite(values[:, k]).any()]
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(("time", *(names[k] for k in written))) + "\n")
        for time_ns, row in zip(fixes.timestamps_ns.tolist(), values.tolist(), strict=True):
            cells = ["" if np.isnan(row[k]) else repr(row[k]) for k in written]
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


GNSS = TrajectoryForm(
    "gnss",
    (),
    "CSV with columns of names such as time, latitude, longitude, altitude; or lines of 7 numbers as KF-GINS has them",
    _gnss_recognises,
    _gnss_read,
    _gnss_write,
    supports=LOCATIONS,
    fix_supports=FIXES,
)


def _first_values(text: str, delimiter: str | None) -> list[float] | None:
    """The numbers of the first line that is no comment; None where it holds anything else."""
    line = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    try:
        return [float(cell) for cell in line.split(delimiter)]
    except ValueError:
        return None


def _first_names(text: str) -> list[str] | None:
    """The names of columns in the first line, in lower case; None where it holds none."""
    line = next((line for line in text.splitlines() if line.strip()), "").lstrip("# \t")
    delimiter = next((sign for sign in ",;\t" if sign in line), None)
    names = [name.strip().strip('"').lower() for name in line.split(delimiter)]
    return None if any(not name or name[0] in "0123456789.-+{[" for name in names) else names


def _oriented(content: TrajectoryFile, target: Path, form: str) -> tuple[Trajectory, Float64Array]:
    """The trajectory with its orientations, for a form that cannot do without."""
    trajectory = content.trajectory
    if trajectory.quaternions_xyzw is None:
        raise OptionError(
            f"{target}: the trajectory {trajectory.name!r} has positions without orientations, and {form} needs both; "
            "choose the form csv or jsonl, or gnss for fixes"
        )
    return trajectory, trajectory.quaternions_xyzw
