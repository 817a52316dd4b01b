"""TUM: lines `timestamp tx ty tz qx qy qz qw`, seconds and metres.

Source: "File Formats" of the TUM RGB-D benchmark.
"""

from collections.abc import Iterable
from pathlib import Path

from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.loss import Loss
from sceneloom.formats.poses import PoseRows
from sceneloom.formats.recording.written_times import seconds_text
from sceneloom.formats.rig.csv_files import read_table
from sceneloom.formats.trajectories.content import Reading, TrajectoryFile, TrajectoryForm
from sceneloom.formats.trajectories.first_lines import first_values
from sceneloom.formats.trajectories.rows import further_losses, numbers_text, ordered, oriented

_HEADER = "# timestamp tx ty tz qx qy qz qw\n"


def _recognises(text: str) -> bool:
    values = first_values(text, None)
    return values is not None and len(values) == 8


def _read(path: Path, reading: Reading, ledger: Ledger) -> TrajectoryFile:
    table = read_table(path, named=False)
    if len(table.rows[0]) != 8:
        problem = f"{len(table.rows[0])} values; expected 8: timestamp tx ty tz qx qy qz qw"
        raise DataError(path, f"line {table.lines[0]}", problem)
    values = table.numbers(range(1, 8))
    rows = PoseRows(table.timestamps(0, reading.unit), values[:, :3], values[:, 3:], table.lines)
    return TrajectoryFile(ordered(path, reading.name or path.stem, rows, ledger)[0], FORM.name)


def _write(content: TrajectoryFile, path: Path, target: Path) -> Iterable[Loss]:
    trajectory, quaternions = oriented(content, target, FORM.name)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(_HEADER)
        rows = zip(
            trajectory.timestamps_ns.tolist(),
            trajectory.positions.tolist(),
            quaternions.tolist(),
            strict=True,
        )
        for time_ns, position, quaternion in rows:
            file.write(f"{seconds_text(time_ns)} {numbers_text((*position, *quaternion), ' ')}\n")
    return further_losses(content)


FORM = TrajectoryForm(
    "tum", (".tum", ".txt"), "lines of 8 numbers: timestamp tx ty tz qx qy qz qw", _recognises, _read, _write
)
