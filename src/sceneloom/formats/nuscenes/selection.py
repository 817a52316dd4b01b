"""The rows of all tables that belong to one scene, joined by their tokens."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.nuscenes.spec import table_folders
from sceneloom.formats.nuscenes.tables import (
    NEEDED,
    CalibratedSensorRow,
    EgoPoseRow,
    LogRow,
    SampleDataRow,
    SampleRow,
    SceneRow,
    SensorRow,
    iter_rows,
)
from sceneloom.scene.types import key_of

_MOST_NAMES = 20


@dataclass(frozen=True, slots=True)
class Location:
    """Where a data set is.

    Attributes:
        root: the folder that the names of files begin at.
        tables: the folder of the tables, `v1.0-mini` of the root.
    """

    root: Path
    tables: Path


def find_location(path: Path) -> Location:
    """Find the tables of a data set.

    Raises:
        DataError: there are none, or one of those that are needed is missing.
        OptionError: there are several sets of tables.
    """
    folders = table_folders(path)
    if not folders:
        raise DataError(path, "", "no tables; expected a folder v1.0-mini or the like with sample_data.json")
    if len(folders) > 1:
        names = ", ".join(folder.name for folder in folders)
        raise OptionError(f"{path}: several sets of tables ({names}); open one of these folders itself")
    missing = [f"{name}.json" for name in NEEDED if not (folders[0] / f"{name}.json").is_file()]
    if missing:
        expected = ", ".join(f"{name}.json" for name in NEEDED)
        raise DataError(folders[0], ", ".join(missing), f"missing; expected the tables {expected}")
    return Location(folders[0].parent, folders[0])


@dataclass(frozen=True, slots=True)
class SensorData:
    """All that one sensor took in a scene, in the order of time.

    Attributes:
        sensor: name and kind.
        rows: images, sweeps or cycles.
        poses: of the ego at each of them.
        calibrations: of the sensor at each of them; usually one for all.
    """

    sensor: SensorRow
    rows: tuple[SampleDataRow, ...]
    poses: tuple[EgoPoseRow, ...]
    calibrations: tuple[CalibratedSensorRow, ...]


@dataclass(frozen=True, slots=True)
class SceneTables:
    """What the tables state about one scene.

    Attributes:
        location: where they are.
        scene: its row.
        log: that of the recording, if there is one.
        samples: by token, in the order of time.
        sensors: by name.
        others: how many further scenes the tables have.
    """

    location: Location
    scene: SceneRow
    log: LogRow | None
    samples: Mapping[str, SampleRow]
    sensors: tuple[SensorData, ...] = field(default_factory=tuple)
    others: int = 0


def select(
    location: Location, sequence: str | None, ledger: Ledger, *, keyframes: bool = False
) -> SceneTables:
    """Read the rows of one scene.

    Args:
        location: the data set.
        sequence: name or token of the scene; None where there is one only.
        ledger: takes what a lenient reading leaves out.
        keyframes: leave out what was taken between the samples.

    Raises:
        DataError: a table is wrong, or a token leads nowhere.
        OptionError: there is no such scene, or none was chosen of several.
    """
    scenes = list(iter_rows(location.tables, "scene"))
    scene = _chosen(location, scenes, sequence)
    found = [row for row in iter_rows(location.tables, "sample") if row.scene_token == scene.token]
    samples = {row.token: row for row in sorted(found, key=lambda row: row.timestamp)}
    if not samples:
        raise DataError(location.tables / "sample.json", f"scene {scene.name}", "has no sample")
    _check_count(location, scene, len(samples), ledger)
    return SceneTables(
        location,
        scene,
        _log(location, scene, ledger),
        samples,
        _sensors(location, samples, ledger, keyframes=keyframes),
        len(scenes) - 1,
    )


def scene_names(path: Path) -> tuple[str, ...]:
    """Names of the scenes of a data set.

    Raises:
        DataError: a table is missing or wrong.
        OptionError: there are several sets of tables.
    """
    return tuple(row.name for row in iter_rows(find_location(path).tables, "scene"))


def _chosen(location: Location, scenes: list[SceneRow], sequence: str | None) -> SceneRow:
    names = [row.name for row in scenes]
    shown = ", ".join(
        [*names[:_MOST_NAMES], *([f"… ({len(names)} in all)"] if len(names) > _MOST_NAMES else [])]
    )
    if sequence is not None:
        match = [row for row in scenes if sequence in (row.name, row.token)]
        if len(match) != 1:
            raise OptionError(f"{location.tables}: no scene {sequence!r}; it has {shown or 'none'}")
        return match[0]
    if not scenes:
        raise DataError(location.tables / "scene.json", "", "no row; expected one scene at least")
    if len(scenes) > 1:
        raise OptionError(
            f"{location.tables}: {len(scenes)} scenes; choose one with `--sequence NAME`: {shown}"
        )
    return scenes[0]


def _check_count(location: Location, scene: SceneRow, count: int, ledger: Ledger) -> None:
    if scene.nbr_samples not in (0, count):
        problem = f"{count} samples; scene.json says {scene.nbr_samples}: is the table cut off?"
        ledger.fault(
            "samples-missing", DataError(location.tables / "sample.json", f"scene {scene.name}", problem)
        )


def _log(location: Location, scene: SceneRow, ledger: Ledger) -> LogRow | None:
    if not (location.tables / "log.json").is_file():
        ledger.fault("table-missing", DataError(location.tables, "log.json", "missing"))
        return None
    log = next((row for row in iter_rows(location.tables, "log") if row.token == scene.log_token), None)
    if log is None:
        ledger.fault("dangling-tokens", dangling(location, "scene", scene.token, "log", scene.log_token))
    return log


def dangling(location: Location, table: str, token: str, other: str, wanted: str) -> DataError:
    """The fault of a row that names a row of another table which is not there."""
    problem = f"{other}_token {wanted!r} leads to no row of {other}.json"
    return DataError(location.tables / f"{table}.json", f"row {token}", problem)


def rows_by_token(location: Location, table: str, wanted: Iterable[str] | None = None) -> dict[str, Any]:
    """The rows of a table with these tokens, or all of them."""
    if wanted is None:
        return {row.token: row for row in iter_rows(location.tables, table)}
    tokens = set(wanted)
    return {row.token: row for row in iter_rows(location.tables, table) if row.token in tokens}


def _sensors(
    location: Location, samples: Mapping[str, SampleRow], ledger: Ledger, *, keyframes: bool
) -> tuple[SensorData, ...]:
    rows = [
        row
        for row in iter_rows(location.tables, "sample_data")
        if row.sample_token in samples and (row.is_key_frame or not keyframes)
    ]
    rows.sort(key=lambda row: row.timestamp)
    poses = rows_by_token(location, "ego_pose", (row.ego_pose_token for row in rows))
    calibrations = rows_by_token(location, "calibrated_sensor")
    sensors = rows_by_token(location, "sensor")
    by_channel: dict[str, list[SampleDataRow]] = {}
    for row in rows:
        sensor = _followed(location, row, poses, calibrations, sensors, ledger)
        if sensor is not None and _is_there(location, row, ledger):
            by_channel.setdefault(sensor.token, []).append(row)
    if len({key_of(sensors[token].id) for token in by_channel}) < len(by_channel):
        for sensor in sensors.values():
            sensor.sensor_id = None
    return tuple(
        SensorData(
            sensors[token],
            tuple(taken),
            tuple(poses[row.ego_pose_token] for row in taken),
            tuple(calibrations[row.calibrated_sensor_token] for row in taken),
        )
        for token, taken in sorted(by_channel.items(), key=lambda item: _order(sensors[item[0]]))
    )


def _followed(
    location: Location,
    row: SampleDataRow,
    poses: Mapping[str, EgoPoseRow],
    calibrations: Mapping[str, CalibratedSensorRow],
    sensors: Mapping[str, SensorRow],
    ledger: Ledger,
) -> SensorRow | None:
    """The sensor of a row; None where one of its tokens leads nowhere and the reading is lenient."""
    calibration = calibrations.get(row.calibrated_sensor_token)
    fault = None
    if row.ego_pose_token not in poses:
        fault = dangling(location, "sample_data", row.token, "ego_pose", row.ego_pose_token)
    elif calibration is None:
        wanted = row.calibrated_sensor_token
        fault = dangling(location, "sample_data", row.token, "calibrated_sensor", wanted)
    elif calibration.sensor_token not in sensors:
        fault = dangling(location, "calibrated_sensor", calibration.token, "sensor", calibration.sensor_token)
    if fault is not None or calibration is None:
        ledger.fault("dangling-tokens", fault or SceneloomError())
        return None
    return sensors[calibration.sensor_token]


def _is_there(location: Location, row: SampleDataRow, ledger: Ledger) -> bool:
    file = file_of(location, "sample_data", row.token, row.filename)
    if file.is_file():
        return True
    hint = (
        "" if row.is_key_frame else "; without the folder sweeps/, open the key frames only (`--keyframes`)"
    )
    ledger.fault("files-missing", DataError(file, "", f"is not there; sample_data.json names it{hint}"))
    return False


def file_of(location: Location, table: str, token: str, name: str) -> Path:
    """The path of a file that a table names.

    Raises:
        DataError: the name leads out of the data set.
    """
    parts = PurePosixPath(name).parts
    if not parts or PurePosixPath(name).is_absolute() or ".." in parts:
        problem = f"filename {name!r}; expected one inside the folder of the data set"
        raise DataError(location.tables / f"{table}.json", f"row {token}", problem)
    return location.root.joinpath(*parts)


_KINDS = ("lidar", "radar", "camera")


def _order(sensor: SensorRow) -> tuple[int, str]:
    """Lidars first, then radars, then cameras; of other kinds there is nothing to read."""
    return (_KINDS.index(sensor.modality) if sensor.modality in _KINDS else len(_KINDS)), str(sensor.id)
