"""A recording as a scene: IMU, GNSS and barometer, trajectories, unknown fields, and all faults of its files."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Int64Array, read_only
from sceneloom.errors import DataError, OptionError, SceneloomError
from sceneloom.formats.base.diagnostics import FaultLedger, Ledger, PlacedFault, placed
from sceneloom.formats.base.files import FileIdentity, read_bytes
from sceneloom.formats.base.poses import GREATEST_NORM_ERROR, default_poses
from sceneloom.formats.recording.calibration import CALIBRATION_FILE, Calibration, read_calibration
from sceneloom.formats.recording.cameras import (
    ALIGNMENTS,
    CAMERA_SHIFTS,
    CameraSources,
    OpenImages,
    applied_shifts,
    build_cameras,
    frame_notes,
)
from sceneloom.formats.recording.legacy import PARAMETERS_FILE
from sceneloom.formats.recording.lidars import build_lidars
from sceneloom.formats.recording.lines import (
    TEXT,
    Columns,
    Origin,
    PoseColumns,
    RecordingColumns,
    SortedColumns,
    by_time,
    further_by_time,
    line_seconds,
    lines_of,
    read_lines,
    row_keys,
    view,
)
from sceneloom.formats.recording.spec import DATA_FILE
from sceneloom.formats.recording.zipped import is_zip, unpack
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

BAROMETER = "barometer"
"""Name of the stream of `barometer` lines [hPa]."""

GPS_ORIGIN: Origin = ("gps", "gps")

RECEIVER = "gnss"
"""Id of the receiver of `gps` lines."""


def imu_streams(columns: RecordingColumns) -> dict[str, Columns]:
    """Give the streams of the IMU by their names in the scene."""
    streams = dict(columns.sensors)
    if len(columns.barometer):
        if BAROMETER in streams:
            streams[f"sensor:{BAROMETER}"] = streams.pop(BAROMETER)
        streams[BAROMETER] = columns.barometer
    return streams


def receivers(columns: RecordingColumns) -> dict[str, tuple[Origin, Columns]]:
    """Give the satellite receivers by their ids, each with the root key and name of its lines."""
    found: dict[str, tuple[Origin, Columns]] = {}
    if len(columns.gnss):
        found[RECEIVER] = (GPS_ORIGIN, columns.gnss)
    for (root, name), stream in columns.receivers.items():
        taken = name in found or name in {RECEIVER, "imu"} or name.startswith(("camera", "lidar"))
        found[f"{root}:{name}" if taken else name] = ((root, name), stream)
    return found


def _build_number_sensors(columns: RecordingColumns, calibration: Calibration) -> list[Sensor]:
    """Build the IMU and the receivers; the mounting of the antenna is that of the `gps` lines' receiver."""
    streams = imu_streams(columns)
    sensors: list[Sensor] = []
    if streams:
        sensors.append(ImuSensor("imu", _samples(streams)))
    gnss_from_imu = calibration.rig.gnss_from_imu
    for name, (_, stream) in receivers(columns).items():
        fixes = by_time(stream)
        mount = None if gnss_from_imu is None or name != RECEIVER else gnss_from_imu.inverse()
        sensors.append(
            GnssSensor(
                id=name,
                timestamps_ns=fixes.timestamps_ns,
                positions_lla=read_only(fixes.values[:, :3]),
                accuracies=read_only(fixes.values[:, 3]),
                vertical_accuracies=read_only(fixes.values[:, 4]),
                file_seconds=fixes.seconds,
                mount=mount,
            )
        )
    return sensors


def _samples(streams: Mapping[str, Columns]) -> Mapping[str, VectorSamples]:
    sorted_streams = {name: by_time(stream) for name, stream in streams.items()}
    return MappingProxyType(
        {
            name: VectorSamples(stream.timestamps_ns, stream.values, stream.seconds)
            for name, stream in sorted_streams.items()
        }
    )


RANKS: Mapping[str, int] = {"groundTruth": 0, "pose": 1, "externalPose": 1}
"""Which root keys are taken for the default trajectory before others."""

_RESERVED_NAMES = {"gnss", "lidar", "identity"}
"""Names that stand for ways which are computed."""


def _build_trajectories(
    poses: Mapping[tuple[str, str], PoseColumns], path: Path, ledger: Ledger
) -> dict[tuple[str, str], Trajectory]:
    """Build the trajectories, the default one first.

    Args:
        poses: by root key and name.
        path: `data.jsonl`, for messages.

    Returns:
        The trajectories by root key and name as in `poses`; their own names differ from each other.

    Raises:
        DataError: an orientation is not of length 1, and the reading is not lenient.
    """
    trajectories: dict[tuple[str, str], Trajectory] = {}
    names = set(_RESERVED_NAMES)
    for origin in sorted(poses, key=lambda origin: RANKS.get(origin[0], 2)):
        root, name = origin
        free = name if name not in names else f"{root or 'root'}:{name}"
        trajectory = _trajectory(free, poses[origin], path, ledger)
        if trajectory is not None:
            trajectories[origin] = trajectory
            names.add(free)
    return trajectories


def _trajectory(name: str, columns: PoseColumns, path: Path, ledger: Ledger) -> Trajectory | None:
    samples = by_time(columns.samples)
    lines = np.asarray(columns.lines)[samples.order]
    quaternions = samples.values[:, 3:]
    missing = np.isnan(quaternions[:, 0])
    oriented = not missing.all()
    usable = np.ones(len(lines), np.bool_)
    if oriented:
        usable = _check_orientations(name, samples, lines, path, ledger)
        _note_missing(name, missing, lines, path, ledger)
    usable = _first_of_each_time(name, samples, usable, lines, path, ledger)
    if not usable.any():
        return None
    return Trajectory(
        name,
        read_only(samples.timestamps_ns[usable]),
        read_only(samples.values[usable, :3]),
        read_only(quaternions[usable]) if oriented else None,
        read_only(samples.seconds[usable]),
    )


def _check_orientations(name: str, samples: SortedColumns, lines: Int64Array, path: Path, ledger: Ledger) -> BoolArray:
    quaternions = samples.values[:, 3:]
    with np.errstate(over="ignore"):
        error = np.abs(np.sqrt((quaternions * quaternions).sum(axis=1)) - 1.0)
    usable: BoolArray = error <= GREATEST_NORM_ERROR
    for row in np.flatnonzero(~usable & ~np.isnan(error)):
        shown = ", ".join(f"{number:.6g}" for number in quaternions[row].tolist())
        problem = f"{name}.orientation: {shown} (x, y, z, w); expected length 1 within 0.01"
        ledger.fault("unusable-orientations", DataError(path, f"line {lines[row]}", problem))
    return usable


def _note_missing(name: str, missing: BoolArray, lines: Int64Array, path: Path, ledger: Ledger) -> None:
    """Report how many poses lack the orientation that others have: nothing is made up for them."""
    count = int(missing.sum())
    if count:
        message = (
            f"{count} of {len(missing)} poses of {name!r} have no orientation, while others have one; they are left "
            "out of the trajectory"
        )
        location = f"{path}: line {lines[np.flatnonzero(missing)[0]]}"
        ledger.note(WarningKind.SKIPPED, "poses-without-orientation", location, message, count=count)


def _first_of_each_time(
    name: str, samples: SortedColumns, usable: BoolArray, lines: Int64Array, path: Path, ledger: Ledger
) -> BoolArray:
    """Keep one pose per time: a body is in one location."""
    kept = usable.copy()
    rows = np.flatnonzero(usable)
    repeated = rows[1:][np.diff(samples.timestamps_ns[rows]) == 0]
    if len(repeated):
        kept[repeated] = False
        message = f"{name!r} has several poses at {samples.seconds[repeated[0]]} s; the first was kept"
        location = f"{path}: line {lines[repeated[0]]}"
        ledger.note(WarningKind.SKIPPED, "repeated-poses", location, message, count=len(repeated))
    return kept


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


def _further_contents(contents: RecordingContents, ledger: Ledger, *, alone: bool = False) -> dict[str, Any]:
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
    columns, streams = contents.columns, _named_streams(contents)
    as_texts = _poses_as_text(contents)
    texts, anchors = _other_lines(columns, as_texts)
    found = {
        "calibration": dict(contents.calibration.content),
        "vio_config": None if alone else _text(contents.folder / VIO_CONFIG_FILE, "unreadable-vio-config", ledger),
        "parameters": None if alone else _text(contents.folder / PARAMETERS_FILE, "unreadable-vio-config", ledger),
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


def _named_streams(contents: RecordingContents) -> dict[str, Columns]:
    """Give the streams of numbers by the names under which more is kept of them."""
    columns = contents.columns
    return {
        **{f"imu.{name}": stream for name, stream in imu_streams(columns).items()},
        **{
            name if name == RECEIVER else f"{RECEIVER}.{name}": stream
            for name, (_, stream) in receivers(columns).items()
        },
        **{f"trajectories.{t.name}": columns.poses[origin].samples for origin, t in contents.trajectories.items()},
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
            text = columns.samples.further.get(location) or _pose_text(origin, values, seconds)
            found[columns.lines[location]] = text
    if again:
        found |= {line: part.text for line, part in shared.items() if again.issuperset(part.rows)}
    return sorted(found.items())


def _pose_text(origin: tuple[str, str], values: list[float], seconds: float) -> str:
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


def _other_lines(columns: RecordingColumns, as_texts: list[tuple[int, str]]) -> tuple[list[str], dict[str, float]]:
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


_ALTITUDES = ("wgs84", "msl")


def _nothing() -> None:
    pass


@dataclass(frozen=True, slots=True)
class RecordingLocation:
    """A recording's folder.

    Attributes:
        folder: where its files are.
        source: what messages call it.
        data_path: its lines.
        alone: whether these are a log by itself, as programs put out, and what lies beside it is somebody else's.
        remove: takes away what was made for it.
    """

    folder: Path
    source: str
    data_path: Path
    alone: bool = False
    remove: Callable[[], None] = _nothing


@dataclass(frozen=True, slots=True, eq=False)
class Closing:
    """Closes what a scene holds open, then takes away what was made for it."""

    images: OpenImages
    remove: Callable[[], None]

    def __call__(self) -> None:
        """Close everything."""
        self.images.close()
        self.remove()


def _find_location(path: Path) -> RecordingLocation:
    """Find the folder of a recording that is named by its folder, its log or a zip archive of it.

    Raises:
        DataError: the archive is damaged, or holds something else or too much.
    """
    if path.is_dir():
        return RecordingLocation(path, str(path), path / DATA_FILE)
    if is_zip(path):
        unpacked = unpack(path, DATA_FILE)
        return RecordingLocation(unpacked.folder, str(path), unpacked.folder / DATA_FILE, remove=unpacked.remove)
    if path.name == DATA_FILE:
        return RecordingLocation(path.parent, str(path.parent), path)
    if path.is_file():
        return RecordingLocation(path.parent, str(path), path, alone=True)
    return RecordingLocation(path, str(path), path / DATA_FILE)


def open_recording(
    path: Path,
    *,
    lenient: bool = False,
    altitude: str = "wgs84",
    camera_shift: str = "ignore",
    image_index: str = "auto",
) -> Scene:
    """Open a recording; images and points are read when asked for.

    Args:
        path: the folder, the `data.jsonl` in it, a zip archive, which is unpacked until the scene is closed, or any
            other file of such lines, as methods put out; what lies beside that counts only if it has images or lidar.
        lenient: leave out and count what is wrong instead of raising.
        altitude: what the altitudes of `gps` lines are above: "wgs84", the ellipsoid, or "msl", mean sea level.
        camera_shift: what becomes of `imuToCameraShiftSeconds` of the calibration: "ignore"; "apply" adds it to the
            times of the camera's images, which are then on the IMU's clock; "subtract" takes it off them.
        image_index: which image of a video a `frames` line means: "number": `number` is its index; "first": `number`
            less the first one; "line": each line the next image; "auto": "first" where there are as many images as
            the numbers span, "line" where as many as lines, else that is open: an error.

    Raises:
        DataError: files are missing or wrong.
        CalibrationError: a camera model or a mounting is unusable.
        OptionError: a value is unknown.
    """
    _check_values(altitude, camera_shift, image_index)
    ledger = Ledger(lenient=lenient)
    return _read_recording(_find_location(path), altitude, ledger, camera_shift=camera_shift, image_index=image_index)[
        0
    ]


def _check_values(altitude: str, camera_shift: str, image_index: str = "auto") -> None:
    """Refuse reading options that have no such value.

    Raises:
        OptionError: there is none.
    """
    for name, value, known in (
        ("altitude", altitude, _ALTITUDES),
        ("camera_shift", camera_shift, tuple(CAMERA_SHIFTS)),
        ("image_index", image_index, tuple(ALIGNMENTS)),
    ):
        if value not in known:
            raise OptionError(f"{name} {value!r}; expected one of: {', '.join(known)}")


def _read_recording(
    location: RecordingLocation,
    altitude: str,
    ledger: Ledger,
    *,
    camera_shift: str = "ignore",
    image_index: str = "auto",
) -> tuple[Scene, RecordingContents]:
    """Read a recording with a ledger that decides what becomes of its faults; as `open_recording` else.

    Raises:
        DataError: it has a fault that the ledger does not take, or cannot be read.
    """
    try:
        with ledger.telling():
            return _read(location, altitude, camera_shift, image_index, ledger)
    except OSError as error:
        location.remove()
        raise DataError(location.source, "", f"cannot be read: {error}") from error
    except BaseException:
        location.remove()
        raise


def _read(
    location: RecordingLocation, altitude: str, camera_shift: str, image_index: str, ledger: Ledger
) -> tuple[Scene, RecordingContents]:
    folder, data_path = location.folder, location.data_path
    if not folder.is_dir():
        raise DataError(folder, "", "no such folder; expected a recording's folder")
    if not data_path.is_file():
        raise DataError(folder, "", f"holds no {DATA_FILE}; expected a recording's folder")
    data_file = FileIdentity.of(data_path)
    columns = read_lines(data_path, ledger)
    alone = location.alone and not (columns.frames.cameras or columns.lidars)
    calibration = Calibration(folder / CALIBRATION_FILE)
    if not alone:
        calibration = read_calibration(folder, ledger, data_path=data_path, other_lines=columns.other_lines)
    trajectories = _build_trajectories(columns.poses, data_path, ledger)
    ego_path = default_poses(trajectories, str(data_path), ledger)
    opened = OpenImages()
    with ExitStack() as stack:
        stack.callback(opened.close)
        sources = CameraSources(
            folder,
            data_path,
            data_file,
            calibration,
            columns.frames,
            ego_path,
            ledger,
            opened,
            camera_shift,
            image_index,
        )
        lidars = build_lidars(folder, data_path, columns.lidars, calibration, ego_path, ledger)
        cameras = [] if alone else build_cameras(sources)
        ego_sensors = _build_number_sensors(columns, calibration)
        contents = RecordingContents(folder, columns, calibration, trajectories, data_path.name, alone)
        metadata = {
            "altitude": altitude,
            **applied_shifts(calibration, camera_shift),
            **_further_contents(contents, ledger, alone=alone),
        }
        scene = Scene(
            sensors=(*lidars, *cameras, *ego_sensors),
            trajectories=MappingProxyType({trajectory.name: trajectory for trajectory in trajectories.values()}),
            metadata=MappingProxyType({"recording": metadata}),
            source=location.source,
            format="recording",
            warnings=ledger.warnings,
            on_close=Closing(opened, location.remove),
        )
        stack.pop_all()
        return scene, contents


@dataclass(frozen=True, slots=True, eq=False)
class RecordingExamination:
    """A recording with all that is wrong in it.

    Attributes:
        scene: what is sound, and what could be brought into order; None where nothing can be read.
        faults: in the order in which they came up.
        contents: what the files state, lines in the order of the file; None where nothing can be read.
    """

    scene: Scene | None
    faults: tuple[PlacedFault, ...]
    contents: RecordingContents | None = None


def examine_recording(
    path: Path, *, altitude: str = "wgs84", camera_shift: str = "ignore", image_index: str = "auto"
) -> RecordingExamination:
    """Read a recording as far as it is sound, and give every fault of it with its location; nothing is raised for them.

    Args:
        path: the folder, the `data.jsonl` in it, or a zip archive.
        altitude: what the altitudes of `gps` lines are above: "wgs84" or "msl".
        camera_shift: what becomes of `imuToCameraShiftSeconds`, as for `open_recording`.
        image_index: which image a `frames` line means, as for `open_recording`.

    Raises:
        OptionError: a value is unknown.
    """
    _check_values(altitude, camera_shift, image_index)
    try:
        location = _find_location(path)
    except SceneloomError as error:
        return RecordingExamination(None, (placed(error, "unreadable", str(path)),))
    ledger = FaultLedger(location.folder)
    try:
        scene, contents = _read_recording(
            location, altitude, ledger, camera_shift=camera_shift, image_index=image_index
        )
    except SceneloomError as error:
        return RecordingExamination(None, (*ledger.faults, placed(error, "unreadable", str(location.folder))))
    return RecordingExamination(scene, ledger.faults, contents)
