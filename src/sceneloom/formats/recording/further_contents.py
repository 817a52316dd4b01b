"""What a recording says and the scene has no place for: kept word by word in the scene's metadata."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.calibration import Calibration
from sceneloom.formats.recording.columns import Columns, RecordingColumns
from sceneloom.scene import NoticeKind, Trajectory

VIO_CONFIG_FILE = "vio_config.yaml"


@dataclass(frozen=True, slots=True, eq=False)
class RecordingContents:
    """All that was read from a recording but its pictures and points.

    Attributes:
        folder: the recording.
        columns: its lines.
        calibration: its `calibration.json`.
        trajectories: by root key and name of their lines.
    """

    folder: Path
    columns: RecordingColumns
    calibration: Calibration
    trajectories: Mapping[tuple[str, str], Trajectory]


def further_contents(contents: RecordingContents, ledger: Ledger, *, alone: bool = False) -> dict[str, Any]:
    """Collect what the scene has no place for; what there is none of is left out.

    Returns:
        calibration: all of `calibration.json`.
        vio_config: the text of `vio_config.yaml`.
        other_lines: the text of lines that nothing here computes with, in the order of the file.
        further_keys: the text of lines that say more than the scene holds, by stream ("imu.accelerometer", "gnss",
            "trajectories.output", "lidars.0") and by time [ns] as text.
        trajectory_origins: by name of a trajectory, the root key of its lines ("" for poses at the root itself) and the
            name there, where these are not both the trajectory's name.
    """
    origins = {
        trajectory.name: list(origin)
        for origin, trajectory in contents.trajectories.items()
        if origin != (trajectory.name, trajectory.name)
    }
    found = {
        "calibration": dict(contents.calibration.content),
        "vio_config": None if alone else _vio_config(contents.folder, ledger),
        "other_lines": list(contents.columns.other_lines),
        "further_keys": _further_keys(contents, ledger),
        "trajectory_origins": origins,
    }
    return {name: value for name, value in found.items() if value}


def _vio_config(folder: Path, ledger: Ledger) -> str | None:
    path = folder / VIO_CONFIG_FILE
    if not path.is_file():
        return None
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        ledger.fault("unreadable-vio-config", DataError(path, "", f"cannot be read as text: {error}"))
        return None


def _further_keys(contents: RecordingContents, ledger: Ledger) -> dict[str, dict[str, str]]:
    texts = {name: stream.further_by_time() for name, stream in _streams(contents).items() if stream.further}
    if texts:
        message = f"lines of {', '.join(texts)} say more than is computed with; their text is kept"
        count = sum(map(len, texts.values()))
        ledger.note(NoticeKind.SKIPPED, "further-keys-kept", str(contents.folder), message, count=count)
    return texts


def _streams(contents: RecordingContents) -> dict[str, Columns]:
    columns = contents.columns
    return {
        **{f"imu.{name}": stream for name, stream in columns.sensors.items()},
        "gnss": columns.gnss,
        **{
            f"trajectories.{t.name}": columns.poses[origin].samples
            for origin, t in contents.trajectories.items()
        },
        **{f"lidars.{index}": lidar.sweeps for index, lidar in columns.lidars.items()},
    }
