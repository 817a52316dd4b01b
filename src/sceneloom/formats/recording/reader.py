"""A recording as a scene: IMU, GNSS and barometer, trajectories, unknown fields, and all faults of its files."""

from collections.abc import Callable, Mapping
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
from sceneloom.formats.recording.calibration import (
    CALIBRATION_FILE,
    PARAMETERS_FILE,
    Calibration,
    RecordingContents,
    read_calibration,
)
from sceneloom.formats.recording.cameras import (
    ALIGNMENTS,
    CAMERA_SHIFTS,
    ImageFiles,
    applied_shifts,
    build_cameras,
    frame_notes,
)
from sceneloom.formats.recording.lidars import build_lidars
from sceneloom.formats.recording.lines import (
    GPS_ORIGIN,
    Columns,
    Origin,
    RecordingColumns,
    SortedColumns,
    by_time,
    further_by_time,
    line_seconds,
    read_lines,
)
from sceneloom.formats.recording.spec import DATA_FILE
from sceneloom.formats.recording.zipped import is_zip, unpack
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

BAROMETER = "barometer"
"""Name of the stream of `barometer` lines [hPa]."""

RECEIVER = "gnss"
"""Id of the receiver of `gps` lines."""

RANKS: Mapping[str, int] = {"groundTruth": 0, "pose": 1, "externalPose": 1}
"""Which root keys are taken for the default trajectory before others."""

VIO_CONFIG_FILE = "vio_config.yaml"

_RESERVED_NAMES = {"gnss", "lidar", "identity"}
"""Names that stand for trajectories that are computed."""

_OPTIONS = {"altitude": ("wgs84", "msl"), "camera_shift": tuple(CAMERA_SHIFTS), "image_index": tuple(ALIGNMENTS)}
"""Options of reading, with their values; the first is the default."""


@dataclass(frozen=True, slots=True)
class _Location:
    """Where a recording is.

    Attributes:
        folder: where its files are.
        source: what messages call it.
        data_path: its lines.
        alone: whether these are a log by itself, as programs put out, and what lies beside it is somebody else's.
        remove: removes what was unpacked for it.
    """

    folder: Path
    source: str
    data_path: Path
    alone: bool = False
    remove: Callable[[], None] | None = None

    @classmethod
    def of(cls, path: Path) -> "_Location":
        """Find the folder of a recording that is named by its folder, its log or a zip archive of it."""
        if not path.is_dir() and is_zip(path):
            unpacked = unpack(path, DATA_FILE)
            return cls(unpacked.folder, str(path), unpacked.folder / DATA_FILE, remove=unpacked.remove)
        if path.is_file():
            alone = path.name != DATA_FILE
            return cls(path.parent, str(path if alone else path.parent), path, alone=alone)
        return cls(path, str(path), path / DATA_FILE)


@dataclass(frozen=True, slots=True, eq=False)
class _Closing:
    """Closes the images that a scene holds open, then removes what was unpacked for it."""

    images: list[ImageFiles]
    remove: Callable[[], None] | None

    def __call__(self) -> None:
        for files in self.images:
            files.close()
        if self.remove is not None:
            self.remove()


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
    options = {"altitude": altitude, "camera_shift": camera_shift, "image_index": image_index}
    _check_values(options)
    return _read_recording(_Location.of(path), Ledger(lenient=lenient), **options)[0]


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

    The arguments are those of `open_recording`.

    Raises:
        OptionError: a value is unknown.
    """
    options = {"altitude": altitude, "camera_shift": camera_shift, "image_index": image_index}
    _check_values(options)
    try:
        location = _Location.of(path)
    except SceneloomError as error:
        return RecordingExamination(None, (placed(error, "unreadable", str(path)),))
    ledger = FaultLedger(location.folder)
    try:
        scene, contents = _read_recording(location, ledger, **options)
    except SceneloomError as error:
        return RecordingExamination(None, (*ledger.faults, placed(error, "unreadable", str(location.folder))))
    return RecordingExamination(scene, ledger.faults, contents)


def _check_values(options: Mapping[str, str]) -> None:
    for name, value in options.items():
        if value not in _OPTIONS[name]:
            raise OptionError(f"{name} {value!r}; expected one of: {', '.join(_OPTIONS[name])}")


def _read_recording(
    location: _Location, ledger: Ledger, *, altitude: str, camera_shift: str, image_index: str
) -> tuple[Scene, RecordingContents]:
    """Read a recording with a ledger that decides what becomes of its faults."""
    closing = _Closing([], location.remove)
    try:
        with ledger.telling():
            contents = _read_contents(location, ledger, camera_shift, image_index)
            columns, calibration = contents.columns, contents.calibration
            sensors: tuple[Sensor, ...] = (
                *build_lidars(contents),
                *([] if contents.alone else build_cameras(contents, closing.images)),
                *_build_number_sensors(columns, calibration),
            )
            shifts = applied_shifts(calibration, camera_shift)
            metadata = {"altitude": altitude, **shifts, **_further_contents(contents)}
            scene = Scene(
                sensors=sensors,
                trajectories=MappingProxyType({t.name: t for t in contents.trajectories.values()}),
                metadata=MappingProxyType({"recording": metadata}),
                source=location.source,
                format="recording",
                warnings=ledger.warnings,
                on_close=closing,
            )
    except OSError as error:
        closing()
        raise DataError(location.source, "", f"cannot be read: {error}") from error
    except BaseException:
        closing()
        raise
    return scene, contents


def _read_contents(location: _Location, ledger: Ledger, camera_shift: str, image_index: str) -> RecordingContents:
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
        calibration = read_calibration(folder, ledger, data_path=data_path, other_lines=columns.other.texts)
    trajectories = _build_trajectories(columns.poses, data_path, ledger)
    return RecordingContents(
        folder=folder,
        data_path=data_path,
        data_file=data_file,
        alone=alone,
        columns=columns,
        calibration=calibration,
        trajectories=trajectories,
        ego_path=default_poses(trajectories, str(data_path), ledger),
        ledger=ledger,
        camera_shift=camera_shift,
        image_index=image_index,
    )


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
    sensors: list[Sensor] = []
    if streams := imu_streams(columns):
        samples = {}
        for name, stream in streams.items():
            rows = by_time(stream)
            samples[name] = VectorSamples(rows.timestamps_ns, rows.values, rows.seconds)
        sensors.append(ImuSensor("imu", MappingProxyType(samples)))
    gnss_from_imu = calibration.rig.gnss_from_imu
    for name, (_, stream) in receivers(columns).items():
        fixes = by_time(stream)
        sensors.append(
            GnssSensor(
                id=name,
                timestamps_ns=fixes.timestamps_ns,
                positions_lla=read_only(fixes.values[:, :3]),
                accuracies=read_only(fixes.values[:, 3]),
                vertical_accuracies=read_only(fixes.values[:, 4]),
                file_seconds=fixes.seconds,
                mount=None if gnss_from_imu is None or name != RECEIVER else gnss_from_imu.inverse(),
            )
        )
    return sensors


def _build_trajectories(poses: Mapping[Origin, Columns], path: Path, ledger: Ledger) -> dict[Origin, Trajectory]:
    """Build the trajectories, the default one first; their own names differ from each other."""
    trajectories: dict[Origin, Trajectory] = {}
    names = set(_RESERVED_NAMES)
    for origin in sorted(poses, key=lambda origin: RANKS.get(origin[0], 2)):
        root, name = origin
        free = name if name not in names else f"{root or 'root'}:{name}"
        samples = by_time(poses[origin])
        usable, oriented = _usable_poses(free, samples, path, ledger)
        if usable.any():
            names.add(free)
            trajectories[origin] = Trajectory(
                free,
                read_only(samples.timestamps_ns[usable]),
                read_only(samples.values[usable, :3]),
                read_only(samples.values[usable, 3:]) if oriented else None,
                read_only(samples.seconds[usable]),
            )
    return trajectories


def _usable_poses(name: str, samples: SortedColumns, path: Path, ledger: Ledger) -> tuple[BoolArray, bool]:
    """Which poses a trajectory gets, (N,) bool, and whether it has orientations."""
    quaternions, count = samples.values[:, 3:], len(samples.lines)
    missing = np.isnan(quaternions[:, 0])
    oriented = not missing.all()
    usable = np.ones(count, np.bool_)
    if oriented:
        with np.errstate(over="ignore"):
            error = np.abs(np.sqrt((quaternions * quaternions).sum(axis=1)) - 1.0)
        usable = error <= GREATEST_NORM_ERROR
        for row in np.flatnonzero(~usable & ~np.isnan(error)):
            shown = ", ".join(f"{number:.6g}" for number in quaternions[row].tolist())
            problem = f"{name}.orientation: {shown} (x, y, z, w); expected length 1 within 0.01"
            ledger.fault("unusable-orientations", DataError(path, f"line {samples.lines[row]}", problem))
        if missing.any():
            left_out = int(missing.sum())
            message = (
                f"{left_out} of {count} poses of {name!r} have no orientation, while others have one; they are left "
                "out of the trajectory"
            )
            location = f"{path}: line {samples.lines[missing.argmax()]}"
            ledger.note(WarningKind.SKIPPED, "poses-without-orientation", location, message, count=left_out)
    repeated = _repeated(samples, usable)
    if len(repeated):
        usable = usable.copy()
        usable[repeated] = False
        message = f"{name!r} has several poses at {samples.seconds[repeated[0]]} s; the first was kept"
        location = f"{path}: line {samples.lines[repeated[0]]}"
        ledger.note(WarningKind.SKIPPED, "repeated-poses", location, message, count=len(repeated))
    return usable, oriented


def _repeated(samples: SortedColumns, usable: BoolArray) -> Int64Array:
    """Rows with the time of the one before: a body is in one place at a time."""
    rows = np.flatnonzero(usable)
    repeated: Int64Array = rows[1:][np.diff(samples.timestamps_ns[rows]) == 0]
    return repeated


def _further_contents(contents: RecordingContents) -> dict[str, Any]:
    """Collect what the scene has no field for; what there is none of is left out.

    Returns:
        calibration: all of `calibration.json`.
        vio_config: the text of `vio_config.yaml`.
        parameters: the text of `parameters.txt`, which old recordings have.
        other_lines: the text of unknown lines, in the order of the file; and poses that repeat the time of another one
            of their trajectory, or lack the orientation that others have.
        other_seconds: by index in `other_lines`, the time of the line before [s], for lines without a time.
        further_keys: the text of lines that state more than the scene holds, by stream ("imu.accelerometer", "gnss",
            "gnss.rtkgps", "trajectories.output", "lidars.0") and by time [ns] as text; `TIME#1` is the second line of
            that time.
        trajectory_origins: by name of a trajectory, the root key of its lines ("" for poses at the root itself) and the
            name there, where these are not both the trajectory's name.
        receiver_origins: the same of all satellite receivers but that of `gps` lines.
        sensor_barometer: whether the air pressure comes in `sensor` lines, and not in `barometer` lines.
        frame_lines: what images do not report of their lines; `FrameNotes` describes it.
    """
    columns, folder = contents.columns, contents.folder
    texts, anchors = _other_lines(contents)
    further = {name: further_by_time(stream) for name, stream in _named_streams(contents).items() if stream.further}
    if further:
        message = f"lines of {', '.join(further)} have unknown keys, which are not used; their text is preserved"
        count = sum(map(len, further.values()))
        contents.ledger.note(WarningKind.SKIPPED, "further-keys-kept", str(folder), message, count=count)
    found = {
        "calibration": dict(contents.calibration.content),
        "vio_config": _text(contents, VIO_CONFIG_FILE),
        "parameters": _text(contents, PARAMETERS_FILE),
        "other_lines": texts,
        "other_seconds": anchors,
        "further_keys": further,
        "trajectory_origins": {
            trajectory.name: list(origin)
            for origin, trajectory in contents.trajectories.items()
            if origin != (trajectory.name, trajectory.name)
        },
        "receiver_origins": {
            name: list(origin) for name, (origin, _) in receivers(columns).items() if origin != GPS_ORIGIN
        },
        "sensor_barometer": BAROMETER in columns.sensors and not len(columns.barometer),
        "frame_lines": frame_notes(columns.frames, contents.data_path),
    }
    return {name: value for name, value in found.items() if value}


def _text(contents: RecordingContents, name: str) -> str | None:
    path = contents.folder / name
    if contents.alone or not path.is_file():
        return None
    try:
        return read_bytes(path).decode()
    except (OSError, UnicodeDecodeError) as error:
        contents.ledger.fault("unreadable-vio-config", DataError(path, "", f"cannot be read as text: {error}"))
        return None


def _named_streams(contents: RecordingContents) -> dict[str, Columns]:
    """Give the streams of numbers by the names under which more is kept of them."""
    columns = contents.columns
    fixes = receivers(columns).items()
    return {
        **{f"imu.{name}": stream for name, stream in imu_streams(columns).items()},
        **{name if name == RECEIVER else f"{RECEIVER}.{name}": stream for name, (_, stream) in fixes},
        **{f"trajectories.{t.name}": columns.poses[origin] for origin, t in contents.trajectories.items()},
        **{f"lidars.{index}": sweeps for index, sweeps in columns.lidars.items()},
    }


def _other_lines(contents: RecordingContents) -> tuple[list[str], dict[str, float]]:
    """Texts in the order of the file, and for those without a time that of the line before [s], by index."""
    columns, other = contents.columns, contents.columns.other
    found = [*zip(other.lines, other.texts, strict=True), *_poses_as_text(contents)]
    found.sort(key=lambda entry: entry[0])
    seconds = line_seconds(columns)
    timed = np.maximum.accumulate(np.where(np.isnan(seconds), -1, np.arange(len(seconds))))
    anchors = {
        str(k): float(seconds[timed[line - 1]])
        for k, (line, _) in enumerate(found)
        if np.isnan(seconds[line - 1]) and timed[line - 1] >= 0
    }
    return [text for _, text in found], anchors


def _poses_as_text(contents: RecordingContents) -> list[tuple[int, str]]:
    """Number and text of each pose that its trajectory does not have: repeated ones, and those without orientation."""
    found = []
    for (root, name), trajectory in contents.trajectories.items():
        columns = contents.columns.poses[root, name]
        samples = by_time(columns)
        lacks_rotation = np.isnan(samples.values[:, 3]) & (trajectory.quaternions_xyzw is not None)
        for row in [*np.flatnonzero(lacks_rotation).tolist(), *_repeated(samples, ~lacks_rotation).tolist()]:
            values, text = samples.values[row].tolist(), columns.further.get(int(samples.order[row]))
            pose: dict[str, Any] = {"name": name} if root == "pose" and name != "pose" else {}
            pose["position"] = dict(zip("xyz", values[:3], strict=True))
            if not lacks_rotation[row] and not np.isnan(values[3]):
                pose["orientation"] = dict(zip("xyzw", values[3:], strict=True))
            if root == "gnssEnu":
                pose = {"mean": values[:3]}
            line = {**({root: pose} if root else pose), "time": float(samples.seconds[row])}
            found.append((int(samples.lines[row]), text or msgspec.json.encode(line).decode()))
    return found
