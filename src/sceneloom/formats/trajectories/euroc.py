"""EuRoC: CSV of nanoseconds, position, orientation with w first, and often velocity and biases.

Source: Burri et al. 2016, "The EuRoC micro aerial vehicle datasets", and the header lines of its files.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from sceneloom.arrays import read_only
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Loss
from sceneloom.formats.poses import PoseRows
from sceneloom.formats.rig.csv_files import read_table
from sceneloom.formats.trajectories.content import Reading, TrajectoryFile, TrajectoryForm
from sceneloom.formats.trajectories.first_lines import first_values
from sceneloom.formats.trajectories.rows import further_losses, numbers_text, ordered, oriented

_FURTHER: Mapping[str, str] = {
    "velocities": "v_RS_R_{} [m s^-1]",
    "gyroscope_biases": "b_w_RS_S_{} [rad s^-1]",
    "accelerometer_biases": "b_a_RS_S_{} [m s^-2]",
}
"""What may follow the pose, three numbers each, in this order, and the names of the columns."""

_POSE = (
    "#timestamp",
    *(f"p_RS_R_{axis} [m]" for axis in "xyz"),
    *(f"q_RS_{axis} []" for axis in "wxyz"),
)
_WIDTHS = tuple(8 + 3 * count for count in range(len(_FURTHER) + 1))
_POSITIONS_ONLY = 4
"""Numbers a line of the position tracker's files, which have the same header without orientations."""

_EARLIEST_NS = 1e12
"""Less than this many nanoseconds, a quarter of an hour, is taken for seconds of another form when recognising."""


def _recognises(text: str) -> bool:
    if "p_RS_R_x" in text.split("\n", 1)[0]:
        return True
    values = first_values(text, ",")
    return (
        values is not None and len(values) in _WIDTHS and values[0].is_integer() and values[0] > _EARLIEST_NS
    )


def _read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    table = read_table(path, named=False)
    width = len(table.rows[0])
    if width not in (_POSITIONS_ONLY, *_WIDTHS):
        known = ", ".join(map(str, (_POSITIONS_ONLY, *_WIDTHS)))
        problem = (
            f"{width} values; expected {known}: timestamp, position, quaternion w x y z, velocity, biases"
        )
        raise DataError(path, f"line {table.lines[0]}", problem)
    values = table.numbers(range(1, width))
    timestamps = table.timestamps(0, reading.unit or "nanoseconds")
    quaternions = None if width == _POSITIONS_ONLY else values[:, [4, 5, 6, 3]]
    rows = PoseRows(timestamps, values[:, :3], quaternions, table.lines)
    trajectory, kept = ordered(path, reading.name or path.stem, rows, ledger)
    columns = {
        name: read_only(values[kept, 7 + 3 * k : 10 + 3 * k])
        for k, name in enumerate(_FURTHER)
        if 10 + 3 * k <= width - 1
    }
    return TrajectoryFile(trajectory, FORM.name, columns=columns)


def _write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    trajectory, quaternions = oriented(content, target, FORM.name)
    further = []
    for name in _FURTHER:
        if name not in content.columns:
            break
        further.append(name)
    names = [*_POSE, *(_FURTHER[name].format(axis) for name in further for axis in "xyz")]
    parts = [trajectory.positions, quaternions[:, [3, 0, 1, 2]], *(content.columns[name] for name in further)]
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(", ".join(names) + "\n")
        values = np.concatenate(parts, axis=1).tolist()
        for time_ns, row in zip(trajectory.timestamps_ns.tolist(), values, strict=True):
            file.write(f"{time_ns},{numbers_text(row, ',')}\n")
    return further_losses(content, kept=further)


FORM = TrajectoryForm(
    "euroc",
    (".csv",),
    "CSV that begins with #timestamp, p_RS_R_x …: nanoseconds, position, quaternion w x y z",
    _recognises,
    _read,
    _write,
)
