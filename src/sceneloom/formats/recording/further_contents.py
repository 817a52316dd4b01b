"""What a recording says and the scene has no field for: kept word by word in the scene's metadata."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.recording.calibration import Calibration
from sceneloom.formats.recording.column_arrays import (
    by_time,
    further_by_time,
    line_seconds,
    lines_of,
    row_keys,
    view,
)
from sceneloom.formats.recording.columns import TEXT, Columns, RecordingColumns
from sceneloom.formats.recording.frame_notes import frame_notes
from sceneloom.formats.recording.number_sensors import BAROMETER, GPS_ORIGIN, RECEIVER, imu_streams, receivers
from sceneloom.formats.recording.old_forms import PARAMETERS_FILE
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.warnings import WarningKind

VIO_CONFIG_FILE = "vio_config.yaml"


@dataclass(frozen=True, slots=True, eq=False)
class RecordingContents:
    """All that was read from a recording but its images and points.

    Attributes:
        folder: the recording.
        columns: its lines.
        calibration: its `calibration.json`.
        trajectories: by root key and name of their lines.
        data_name: name of the file of the lines.
        alone: whether that file is all there is, and nothing beside it belongs to it.
    """

    folder: Path
    columns: RecordingColumns
    calibration: Calibration
    trajectories: Mapping[tuple[str, str], Trajectory]
    data_name: str = "data.jsonl"
    alone: bool = False


def further_contents(contents: RecordingContents, ledger: Ledger, *, alone: bool = False) -> dict[str, Any]:
    """Collect what the scene has no field for; what there is none of is left out.

    Returns:
        calibration: all of `calibration.json`.
        vio_config: the text of `vio_config.yaml`.
        parameters: the text of `parameters.txt`, which old recordings have.
        other_lines: the text of lines that nothing here computes with, in the order of the file; and poses that repeat
            the time of another one of their trajectory, or lack the orientation that others have.
        other_seconds: by index in `other_lines`, the time of the line before [s], for lines without a time.
        further_keys: the text of lines that state more than the scene holds, by stream ("imu.accelerometer", "gnss",
            "gnss.rtkgps", "trajectories.output", "lidars.0") and by time [ns] as text; `TIME#1` is the second line of
            that time.
        shared_lines: lines that several streams have a part in: `text`, and `records`, stream and time of each part.
        trajectory_origins: by name of a trajectory, the root key of its lines ("" for poses at the root itself) and the
            name there, where these are not both the trajectory's name.
        receiver_origins: the same of all satellite receivers but that of `gps` lines.
        sensor_barometer: whether the air pressure comes in `sensor` lines, and not in `barometer` lines.
        frame_lines: what images do not report their lines; `FrameNotes` describes it.
    """
    columns, streams = contents.columns, named_streams(contents)
    as_texts = _poses_as_text(contents)
    texts, anchors = _other_lines(columns, as_texts)
    found = {
        "calibration": dict(contents.calibration.content),
        "vio_config": None
        if alone
        else _text(contents.folder / VIO_CONFIG_FILE, "unreadable-vio-config", ledger),
        "parameters": None
        if alone
        else _text(contents.folder / PARAMETERS_FILE, "unreadable-vio-config", ledger),
        "other_lines": texts,
        "other_seconds": anchors,
        "further_keys": _further_keys(contents, streams, ledger),
        "shared_lines": _shared_lines(columns, streams),
        "trajectory_origins": {
            trajectory.name: list(origin)
            for origin, trajectory in contents.trajectories.items()
            if origin != (trajectory.name, trajectory.name)
        },
        "receiver_origins": {
            name: list(origin) for name, (origin, _) in receivers(columns).items() if origin != GPS_ORIGIN
        },
        "sensor_barometer": BAROMETER in columns.sensors and not len(columns.barometer),
        "frame_lines": frame_notes(columns.frames, contents.folder / contents.data_name),
    }
    return {name: value for name, value in found.items() if value}


def named_streams(contents: RecordingContents) -> dict[str, Columns]:
    """Give the streams of numbers by the names under which more is kept of them."""
    columns = contents.columns
    return {
        **{f"imu.{name}": stream for name, stream in imu_streams(columns).items()},
        **{
            name if name == RECEIVER else f"{RECEIVER}.{name}": stream
            for name, (_, stream) in receivers(columns).items()
        },
        **{
            f"trajectories.{t.name}": columns.poses[origin].samples
            for origin, t in contents.trajectories.items()
        },
        **{f"lidars.{index}": lidar.sweeps for index, lidar in columns.lidars.items()},
    }


def _poses_as_text(contents: RecordingContents) -> list[tuple[int, str]]:
    """Number and text of lines with a pose that its trajectory does not have.

    That is one of which it has another of the same time, or one without the orientation that others have.

    A line with other records beside such a pose is written for these; one of nothing but such poses is kept as it is.
    """
    shared = contents.columns.log.shared
    found: dict[int, str] = {}
    again: set[tuple[int, int]] = set()
    for origin, trajectory in contents.trajectories.items():
        columns = contents.columns.poses[origin]
        samples = by_time(columns.samples)
        rotated = ~np.isnan(samples.values[:, 3]) | (trajectory.quaternions_xyzw is None)
        rows = np.flatnonzero(rotated)
        again_rows = rows[1:][np.diff(samples.timestamps_ns[rows]) == 0]
        for row in [*np.flatnonzero(~rotated).tolist(), *again_rows.tolist()]:
            location = int(samples.order[row])
            again.add((columns.samples.code, location))
            if columns.lines[location] in shared:
                continue
            values, seconds = samples.values[row].tolist(), float(samples.seconds[row])
            text = columns.samples.further.get(location) or pose_text(origin, values, seconds)
            found[columns.lines[location]] = text
    if again:
        found |= {line: part.text for line, part in shared.items() if again.issuperset(part.rows)}
    return sorted(found.items())


def pose_text(origin: tuple[str, str], values: list[float], seconds: float) -> str:
    """Write the line of a pose: position, then the quaternion x y z w, NaN where there is none."""
    pose: dict[str, Any] = {"position": dict(zip("xyz", values[:3], strict=True))}
    if not np.isnan(values[3]):
        pose["orientation"] = dict(zip("xyzw", values[3:], strict=True))
    root, name = origin
    if root == "pose" and name != "pose":
        pose = {"name": name, **pose}
    if root == "gnssEnu":
        pose = {"mean": values[:3]}
    return msgspec.json.encode({**({root: pose} if root else pose), "time": seconds}).decode()


def _other_lines(
    columns: RecordingColumns, as_texts: list[tuple[int, str]]
) -> tuple[list[str], dict[str, float]]:
    """Texts in the order of the file, and for those without a time that of the line before."""
    seconds = line_seconds(columns)
    timed = np.maximum.accumulate(np.where(np.isnan(seconds), -1, np.arange(len(seconds))))
    seconds = np.where(timed >= 0, seconds[timed], -np.inf) if len(seconds) else seconds
    lines = lines_of(columns.log, TEXT).tolist()
    entries = sorted([*zip(lines, columns.other_lines, strict=True), *as_texts])
    untimed = set(np.asarray(lines, np.int64)[np.isnan(view(columns.other_seconds))].tolist())
    anchors = {
        str(k): float(seconds[line - 1])
        for k, (line, _) in enumerate(entries)
        if line in untimed and np.isfinite(seconds[line - 1])
    }
    return [text for _, text in entries], anchors


def _shared_lines(columns: RecordingColumns, streams: Mapping[str, Columns]) -> list[dict[str, Any]]:
    by_code = {stream.code: (name, stream) for name, stream in streams.items()}
    rows: dict[int, list[int]] = {}
    for shared in columns.log.shared.values():
        for code, row in shared.rows:
            rows.setdefault(code, []).append(row)
    keys = {
        code: dict(zip(found, row_keys(by_code[code][1], found), strict=True))
        for code, found in rows.items()
        if code in by_code
    }
    return [
        {
            "text": shared.text,
            "records": [[by_code[code][0], keys[code][row]] for code, row in shared.rows if code in by_code],
        }
        for shared in columns.log.shared.values()
    ]


def _text(path: Path, code: str, ledger: Ledger) -> str | None:
    if not path.is_file():
        return None
    try:
        return read_bytes(path).decode()
    except (OSError, UnicodeDecodeError) as error:
        ledger.fault(code, DataError(path, "", f"cannot be read as text: {error}"))
        return None


def _further_keys(
    contents: RecordingContents, streams: Mapping[str, Columns], ledger: Ledger
) -> dict[str, dict[str, str]]:
    texts = {name: further_by_time(stream) for name, stream in streams.items() if stream.further}
    if texts:
        message = f"lines of {', '.join(texts)} state more than is computed with; their text is kept"
        count = sum(map(len, texts.values()))
        ledger.note(WarningKind.SKIPPED, "further-keys-kept", str(contents.folder), message, count=count)
    return texts
