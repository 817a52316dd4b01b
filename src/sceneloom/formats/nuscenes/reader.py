"""Read one scene of a data set in the nuScenes schema."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError, OptionError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.images import ImageFile, images_image_size, is_jpeg
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.spec import as_flag
from sceneloom.formats.nuscenes.spec import table_folders
from sceneloom.formats.nuscenes.tables import (
    KEY_FRAMES,
    NEEDED,
    AnnotationRow,
    CalibratedSensorRow,
    CategoryRow,
    EgoPoseRow,
    InstanceRow,
    LidarsegRow,
    LogRow,
    Quaternion,
    SampleDataRow,
    SampleRow,
    SceneRow,
    SensorRow,
    iter_rows,
)
from sceneloom.formats.points.cloud import NUSCENES, Cloud
from sceneloom.formats.points.npz import read_bin
from sceneloom.formats.points.pcd import read_pcd
from sceneloom.geometry.euler import AngleUnit
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    LabeledPoints,
    LabeledPointsAnnotation,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor, RadarFrame, RadarPoints, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import key_of
from sceneloom.warnings import WarningKind

_Facts = tuple[tuple[str, Any], ...]
"""What the tables state about a file, as pairs of name and value."""


@dataclass(frozen=True, slots=True, eq=False)
class _FrameFiles:
    """The files of one sensor.

    Attributes:
        files: of each frame.
        timestamps_ns: (N,) int64 [ns].
        facts: of each frame, for its `extras`.
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    facts: tuple[_Facts, ...]

    def timestamp(self, k: int) -> int:
        """The time of frame `k` [ns]."""
        return int(self.timestamps_ns[k])

    def extras(self, k: int) -> MappingProxyType[str, Any]:
        """What the tables state about frame `k`."""
        return MappingProxyType(dict(self.facts[k]))


@dataclass(frozen=True, slots=True, eq=False)
class _SweepFiles:
    """Reads the sweeps of a lidar; every row of a file stays a point, since labels count the rows."""

    frames: _FrameFiles

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: the file is missing, cut off or no cloud.
        """
        return LidarFrame(self.frames.timestamp(k), _lidar_points(self.frames.files[k]), self.frames.extras(k))


@dataclass(frozen=True, slots=True, eq=False)
class _CycleFiles:
    """Reads the cycles of a radar."""

    frames: _FrameFiles

    def __call__(self, k: int) -> RadarFrame:
        """Read cycle `k`.

        Raises:
            DataError: the file is missing, cut off or no cloud.
        """
        cloud = _returns(read_pcd(self.frames.files[k]))
        positions = _positions(cloud)
        directions, lengths = _velocities(cloud, positions)
        further = {name: read_only(c) for name, c in cloud.columns.items() if name not in "xyz"}
        points = RadarPoints(positions, directions, lengths, extras=MappingProxyType(further))
        return RadarFrame(self.frames.timestamp(k), points, self.frames.extras(k))


@dataclass(frozen=True, slots=True, eq=False)
class _ImageFiles:
    """Reads the images of a camera.

    Attributes:
        cameras: camera model of each image.
        mounts: `ego_from_camera` of each image, None where it is the camera's.
    """

    frames: _FrameFiles
    cameras: tuple[Camera, ...]
    mounts: tuple[RigidTransform | None, ...]

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without decoding it."""
        camera = self.cameras[k]
        file = ImageFile(self.frames.files[k], camera.width, camera.height)
        encoded = file.encoded if is_jpeg(file.path) else None
        return CameraImage(
            self.frames.timestamp(k),
            camera,
            file,
            self.mounts[k],
            extras=self.frames.extras(k),
            encoded=encoded,
        )


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


def _find_location(path: Path) -> Location:
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
class _SensorData:
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
class _SceneTables:
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
    sensors: tuple[_SensorData, ...] = field(default_factory=tuple)
    others: int = 0


def _select(location: Location, sequence: str | None, ledger: Ledger, *, keyframes: bool = False) -> _SceneTables:
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
    return _SceneTables(
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
    return tuple(row.name for row in iter_rows(_find_location(path).tables, "scene"))


def _chosen(location: Location, scenes: list[SceneRow], sequence: str | None) -> SceneRow:
    names = [row.name for row in scenes]
    shown = ", ".join([*names[:_MOST_NAMES], *([f"… ({len(names)} in all)"] if len(names) > _MOST_NAMES else [])])
    if sequence is not None:
        match = [row for row in scenes if sequence in (row.name, row.token)]
        if len(match) != 1:
            raise OptionError(f"{location.tables}: no scene {sequence!r}; it has {shown or 'none'}")
        return match[0]
    if not scenes:
        raise DataError(location.tables / "scene.json", "", "no row; expected one scene at least")
    if len(scenes) > 1:
        raise OptionError(f"{location.tables}: {len(scenes)} scenes; choose one with `--sequence NAME`: {shown}")
    return scenes[0]


def _check_count(location: Location, scene: SceneRow, count: int, ledger: Ledger) -> None:
    if scene.nbr_samples not in (0, count):
        problem = f"{count} samples; scene.json says {scene.nbr_samples}: is the table cut off?"
        ledger.fault("samples-missing", DataError(location.tables / "sample.json", f"scene {scene.name}", problem))


def _log(location: Location, scene: SceneRow, ledger: Ledger) -> LogRow | None:
    if not (location.tables / "log.json").is_file():
        ledger.fault("table-missing", DataError(location.tables, "log.json", "missing"))
        return None
    log = next((row for row in iter_rows(location.tables, "log") if row.token == scene.log_token), None)
    if log is None:
        ledger.fault("dangling-tokens", _dangling_token(location, "scene", scene.token, "log", scene.log_token))
    return log


def _dangling_token(location: Location, table: str, token: str, other: str, wanted: str) -> DataError:
    """The fault of a row that names a row of another table which is not there."""
    problem = f"{other}_token {wanted!r} leads to no row of {other}.json"
    return DataError(location.tables / f"{table}.json", f"row {token}", problem)


def _rows_by_token(location: Location, table: str, wanted: Iterable[str] | None = None) -> dict[str, Any]:
    """The rows of a table with these tokens, or all of them."""
    if wanted is None:
        return {row.token: row for row in iter_rows(location.tables, table)}
    tokens = set(wanted)
    return {row.token: row for row in iter_rows(location.tables, table) if row.token in tokens}


def _sensors(
    location: Location, samples: Mapping[str, SampleRow], ledger: Ledger, *, keyframes: bool
) -> tuple[_SensorData, ...]:
    rows = [
        row
        for row in iter_rows(location.tables, "sample_data")
        if row.sample_token in samples and (row.is_key_frame or not keyframes)
    ]
    rows.sort(key=lambda row: row.timestamp)
    poses = _rows_by_token(location, "ego_pose", (row.ego_pose_token for row in rows))
    calibrations = _rows_by_token(location, "calibrated_sensor")
    sensors = _rows_by_token(location, "sensor")
    by_channel: dict[str, list[SampleDataRow]] = {}
    for row in rows:
        sensor = _followed(location, row, poses, calibrations, sensors, ledger)
        if sensor is not None and _is_there(location, row, ledger):
            by_channel.setdefault(sensor.token, []).append(row)
    if len({key_of(sensors[token].id) for token in by_channel}) < len(by_channel):
        for sensor in sensors.values():
            sensor.sensor_id = None
    return tuple(
        _SensorData(
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
        fault = _dangling_token(location, "sample_data", row.token, "ego_pose", row.ego_pose_token)
    elif calibration is None:
        wanted = row.calibrated_sensor_token
        fault = _dangling_token(location, "sample_data", row.token, "calibrated_sensor", wanted)
    elif calibration.sensor_token not in sensors:
        fault = _dangling_token(location, "calibrated_sensor", calibration.token, "sensor", calibration.sensor_token)
    if fault is not None or calibration is None:
        ledger.fault("dangling-tokens", fault or SceneloomError())
        return None
    return sensors[calibration.sensor_token]


def _is_there(location: Location, row: SampleDataRow, ledger: Ledger) -> bool:
    file = _file_of(location, "sample_data", row.token, row.filename)
    if file.is_file():
        return True
    hint = "" if row.is_key_frame else "; without the folder sweeps/, open the key frames only (`--keyframes`)"
    ledger.fault("files-missing", DataError(file, "", f"is not there; sample_data.json names it{hint}"))
    return False


def _file_of(location: Location, table: str, token: str, name: str) -> Path:
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


_MICROSECOND = 1000
"""Nanoseconds in the unit of all times of the tables."""

_TRAJECTORY = "pose"
"""The name of the ego trajectory."""


def _build_sensors(tables: _SceneTables, ledger: Ledger) -> tuple[Sensor, ...]:
    """Build lidars, radars and cameras.

    Raises:
        DataError: a calibration or a pose is wrong.
    """
    sensors = []
    for data in tables.sensors:
        build = _BUILDERS.get(data.sensor.modality)
        if build is None:
            location = str(tables.location.tables / "sensor.json")
            message = f"{data.sensor.channel} is a {data.sensor.modality!r}; of these nothing is read"
            ledger.note(WarningKind.SKIPPED, "unknown-modality", location, message, count=len(data.rows))
        else:
            sensors.append(build(tables, data))
    return tuple(sensors)


def _trajectory_of(tables: _SceneTables, ledger: Ledger) -> Trajectory | None:
    """The ego trajectory: its poses at all frames of all sensors; None where there are none.

    Raises:
        DataError: a pose is wrong.
    """
    rows = {row.token: row for data in tables.sensors for row in data.poses}
    if not rows:
        return None
    ordered = sorted(rows.values(), key=lambda row: row.timestamp)
    timestamps_ns = np.array([row.timestamp for row in ordered], np.int64) * _MICROSECOND
    times_ns, first = np.unique(timestamps_ns, return_index=True)
    positions = np.array([row.translation for row in ordered], np.float64)
    quaternions = _quaternions(tables, "ego_pose", [(row.token, row.rotation) for row in ordered])
    kept = first[np.searchsorted(times_ns, timestamps_ns)]
    differing = int((positions != positions[kept]).any(axis=1).sum())
    if differing:
        message = "poses of another location at a time that has one already; the first one is taken"
        location = str(tables.location.tables / "ego_pose.json")
        ledger.note(WarningKind.SKIPPED, "poses-repeated", location, message, count=differing)
    return Trajectory(_TRAJECTORY, times_ns, positions[first], quaternions[first])


def _quaternions(tables: _SceneTables, table: str, rotations: Sequence[tuple[str, Quaternion]]) -> Float64Array:
    """Rotate `w x y z` into unit quaternions (N, 4), scalar last.

    Raises:
        DataError: one is far from length 1.
    """
    values = np.array([rotation for _, rotation in rotations], np.float64).reshape(-1, 4)
    norms, is_off = lengths_of(values)
    wrong = np.flatnonzero(is_off)
    if len(wrong):
        token, rotation = rotations[int(wrong[0])]
        problem = f"rotation {list(rotation)} has the length {norms[wrong[0]]:.4f}; expected w, x, y, z of length 1"
        raise DataError(tables.location.tables / f"{table}.json", f"row {token}", problem)
    return normalise_quaternion(values[:, [1, 2, 3, 0]])


def _mount(tables: _SceneTables, row: CalibratedSensorRow) -> RigidTransform:
    """`ego_from_sensor`."""
    quaternion = _quaternions(tables, "calibrated_sensor", [(row.token, row.rotation)])[0]
    try:
        return RigidTransform.from_quaternion(np.array(row.translation), quaternion)
    except CalibrationError as error:
        file = tables.location.tables / "calibrated_sensor.json"
        raise DataError(file, f"row {row.token}", str(error)) from error


def _mounts(tables: _SceneTables, data: _SensorData) -> dict[str, RigidTransform]:
    rows = {row.token: row for row in data.calibrations}
    return {token: _mount(tables, row) for token, row in rows.items()}


def _files(tables: _SceneTables, data: _SensorData) -> _FrameFiles:
    location = tables.location
    return _FrameFiles(
        tuple(_file_of(location, "sample_data", row.token, row.filename) for row in data.rows),
        _timestamps(data),
        tuple(
            (
                ("file", row.filename),
                ("token", row.token),
                ("sample_token", row.sample_token),
                ("is_key_frame", row.is_key_frame),
            )
            for row in data.rows
        ),
    )


def _timestamps(data: _SensorData) -> Int64Array:
    return np.array([row.timestamp for row in data.rows], np.int64) * _MICROSECOND


def _poses(tables: _SceneTables, data: _SensorData, mounts: Mapping[str, RigidTransform]) -> Poses:
    """`world_from_sensor` at each frame: the ego's pose that the frame names, and the mounting."""
    quaternions = _quaternions(tables, "ego_pose", [(row.token, row.rotation) for row in data.poses])
    positions = np.array([row.translation for row in data.poses], np.float64)
    own = [mounts[row.token] for row in data.calibrations]
    shifts = np.array([mount.translation for mount in own])
    rotations = np.array([mount.quaternion_xyzw for mount in own])
    times_ns, first = np.unique(_timestamps(data), return_index=True)
    return Poses(
        times_ns,
        (rotate_vectors(quaternions, shifts) + positions)[first],
        multiply_quaternions(quaternions, rotations)[first],
    )


def _build_lidar(tables: _SceneTables, data: _SensorData) -> Sensor:
    mounts, files = _mounts(tables, data), _files(tables, data)
    return LidarSensor(
        id=data.sensor.id,
        frames=LazyFrames(files.timestamps_ns, _SweepFiles(files)),
        poses=_poses(tables, data, mounts),
        mount=mounts[data.calibrations[0].token],
        extras=_about(data),
    )


def _build_radar(tables: _SceneTables, data: _SensorData) -> Sensor:
    mounts, files = _mounts(tables, data), _files(tables, data)
    return RadarSensor(
        id=data.sensor.id,
        frames=LazyFrames(files.timestamps_ns, _CycleFiles(files)),
        poses=_poses(tables, data, mounts),
        mount=mounts[data.calibrations[0].token],
        extras=_about(data),
    )


def _build_camera(tables: _SceneTables, data: _SensorData) -> Sensor:
    mounts, files = _mounts(tables, data), _files(tables, data)
    camera_models = _camera_models(tables, data, files)
    common = mounts[data.calibrations[0].token]
    own = [mounts[row.token] for row in data.calibrations]
    reader = _ImageFiles(files, camera_models, tuple(None if mount is common else mount for mount in own))
    return CameraSensor(
        id=data.sensor.id,
        camera=camera_models[0],
        images=LazyFrames(files.timestamps_ns, reader),
        poses=_poses(tables, data, mounts),
        mount=common,
        extras=_about(data),
    )


def _about(data: _SensorData) -> Mapping[str, Any]:
    """What the tables state about a sensor that the model has no field for."""
    return MappingProxyType(
        {
            "token": data.sensor.token,
            "calibrated_sensor_token": data.calibrations[0].token,
            KEY_FRAMES: tuple(row.timestamp for row in data.rows if row.is_key_frame),
        }
    )


def _camera_models(tables: _SceneTables, data: _SensorData, files: _FrameFiles) -> tuple[Camera, ...]:
    """The camera model of each image; all images of nuScenes are undistorted."""
    known: dict[tuple[str, int, int], Camera] = {}
    camera_models = []
    for k, row in enumerate(data.rows):
        calibration = data.calibrations[k]
        size = (row.width or 0, row.height or 0)
        if not all(size):
            size = images_image_size(files.files[k])
        key = (calibration.token, *size)
        if key not in known:
            known[key] = _camera_model(tables, calibration, size)
        camera_models.append(known[key])
    return tuple(camera_models)


def _camera_model(tables: _SceneTables, row: CalibratedSensorRow, size: tuple[int, int]) -> Camera:
    matrix = np.array(row.camera_intrinsic, np.float64)
    fault = f"camera_intrinsic {row.camera_intrinsic}; expected rows (fx, 0, cx), (0, fy, cy), (0, 0, 1)"
    if matrix.shape == (3, 3) and np.array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]):
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        try:
            return Camera("pinhole", *size, fx, fy, cx, cy)
        except CalibrationError as error:
            fault = str(error)
    raise DataError(tables.location.tables / "calibrated_sensor.json", f"row {row.token}", fault)


_BUILDERS: Mapping[str, Callable[[_SceneTables, _SensorData], Sensor]] = MappingProxyType(
    {"lidar": _build_lidar, "radar": _build_radar, "camera": _build_camera}
)

_TABLES = ("sample_annotation", "instance", "category", "attribute", "visibility")


def _build_cuboids(tables: _SceneTables, ledger: Ledger) -> tuple[CuboidAnnotation, ...]:
    """Build a cuboid for each instance, in the order in which they come up.

    Raises:
        DataError: a table is missing or wrong, a token leads nowhere, or a box has no size.
    """
    location = tables.location
    for name in _TABLES:
        if not (location.tables / f"{name}.json").is_file():
            problem = "missing; expected the tables of boxes, be they empty"
            ledger.fault("table-missing", DataError(location.tables, f"{name}.json", problem))
            return ()
    rows = [row for row in iter_rows(location.tables, "sample_annotation") if row.sample_token in tables.samples]
    instances = _rows_by_token(location, "instance", (row.instance_token for row in rows))
    names = {name: _rows_by_token(location, name) for name in ("category", "attribute", "visibility")}
    tracks: dict[str, list[AnnotationRow]] = {}
    for row in rows:
        fault = _dangling(tables, row, instances, names)
        if fault is None:
            tracks.setdefault(row.instance_token, []).append(row)
        else:
            ledger.fault("dangling-tokens", fault)
    return tuple(_cuboid(tables, instances[token], track, names) for token, track in tracks.items())


def _dangling(
    tables: _SceneTables,
    row: AnnotationRow,
    instances: Mapping[str, InstanceRow],
    names: Mapping[str, Mapping[str, Any]],
) -> DataError | None:
    """What is wrong with the tokens of a row."""
    location, table = tables.location, "sample_annotation"
    if row.instance_token not in instances:
        return _dangling_token(location, table, row.token, "instance", row.instance_token)
    category = instances[row.instance_token].category_token
    if category not in names["category"]:
        return _dangling_token(location, "instance", row.instance_token, "category", category)
    if row.visibility_token and row.visibility_token not in names["visibility"]:
        return _dangling_token(location, table, row.token, "visibility", row.visibility_token)
    lost = next((token for token in row.attribute_tokens if token not in names["attribute"]), None)
    return None if lost is None else _dangling_token(location, table, row.token, "attribute", lost)


def _cuboid(
    tables: _SceneTables,
    instance: InstanceRow,
    track: Sequence[AnnotationRow],
    names: Mapping[str, Mapping[str, Any]],
) -> CuboidAnnotation:
    rows = sorted(track, key=lambda row: tables.samples[row.sample_token].timestamp)
    timestamps = [tables.samples[row.sample_token].timestamp for row in rows]
    timestamps_ns = np.array(timestamps, np.int64) * _MICROSECOND
    category: CategoryRow = names["category"][instance.category_token]
    return CuboidAnnotation(
        id=instance.token,
        path=CuboidPath(
            timestamps_ns,
            _values(tables, rows),
            MappingProxyType({"tokens": tuple(row.token for row in rows)}),
        ),
        label=category.name,
        attributes=_attributes(rows, timestamps_ns, names),
    )


def _values(tables: _SceneTables, rows: Sequence[AnnotationRow]) -> Float64Array:
    """`dx dy dz px py pz roll pitch yaw`: length, width, height; the angles as they are by default."""
    sizes_wlh = np.array([row.size for row in rows])
    quaternions_wxyz = np.array([row.rotation for row in rows])
    wrong = lengths_of(quaternions_wxyz)[1] | (sizes_wlh <= 0).any(axis=1)
    if wrong.any():
        row = rows[int(np.argmax(wrong))]
        problem = f"size {list(row.size)}, rotation {list(row.rotation)}; expected sizes above 0, length 1"
        raise DataError(tables.location.tables / "sample_annotation.json", f"row {row.token}", problem)
    angles = CuboidAngles().from_quaternions(quaternions_wxyz[:, [1, 2, 3, 0]])
    positions = np.array([row.translation for row in rows])
    return np.concatenate([sizes_wlh[:, [1, 0, 2]], positions, angles], axis=1)


def _attributes(
    rows: Sequence[AnnotationRow], timestamps_ns: Int64Array, names: Mapping[str, Mapping[str, Any]]
) -> tuple[AttributePath, ...]:
    """What is stated at each sample; of the visibility nothing, where nothing is stated at any."""
    stated: dict[str, tuple[Any, ...]] = {
        "attributes": tuple(tuple(names["attribute"][token].name for token in row.attribute_tokens) for row in rows),
        "num_lidar_pts": tuple(row.num_lidar_pts for row in rows),
        "num_radar_pts": tuple(row.num_radar_pts for row in rows),
    }
    levels = [names["visibility"].get(row.visibility_token) for row in rows]
    if any(levels):
        stated["visibility"] = tuple("" if level is None else level.level for level in levels)
    return tuple(AttributePath(name, values, timestamps_ns) for name, values in stated.items())


_ID_PREFIX = "lidarseg:"
"""What ids of the annotations begin with, before the name of the class."""


def _build_labelled_points(tables: _SceneTables, ledger: Ledger) -> tuple[LabeledPointsAnnotation, ...]:
    """Build an annotation for each class that occurs; () where the data set has no such labels.

    Raises:
        DataError: a file is missing or of another length than its sweep, or a class is in no row of category.json.
    """
    folder = tables.location.tables
    if not (folder / "lidarseg.json").is_file():
        return ()
    frames = {
        row.token: (data, k)
        for data in tables.sensors
        if data.sensor.modality == "lidar"
        for k, row in enumerate(data.rows)
    }
    categories = {row.index: row for row in iter_rows(folder, "category") if row.index is not None}
    found: dict[int, list[LabeledPoints]] = {}
    for row in iter_rows(folder, "lidarseg"):
        if row.sample_data_token in frames:
            data, k = frames[row.sample_data_token]
            try:
                labels = _labels(tables, row, data, k, categories)
            except DataError as error:
                ledger.fault("labels", error)
            else:
                _add(found, labels, data.sensor.id, k)
    return tuple(
        LabeledPointsAnnotation(
            id=f"{_ID_PREFIX}{categories[index].name}",
            labeled_points=tuple(sorted(entries, key=lambda entry: entry.sensor_frame or 0)),
            label=categories[index].name,
            is_instance=False,
            extras=MappingProxyType({"index": index}),
        )
        for index, entries in sorted(found.items())
    )


def _labels(
    tables: _SceneTables, row: LidarsegRow, data: _SensorData, k: int, categories: Mapping[int, CategoryRow]
) -> UInt8Array:
    file = _file_of(tables.location, "lidarseg", row.token, row.filename)
    labels = np.frombuffer(read_bytes(file), np.uint8)
    cloud = _file_of(tables.location, "sample_data", row.sample_data_token, data.rows[k].filename)
    points = _points_in(cloud)
    if len(labels) != points:
        raise DataError(file, "", f"{len(labels)} labels; expected {points}, one for each point of {cloud.name}")
    unknown = sorted(set(np.unique(labels).tolist()) - set(categories))
    if unknown:
        raise DataError(file, "", f"class {unknown[0]}; expected an `index` of category.json")
    return labels


def _points_in(cloud: Path) -> int:
    """How many whole points a file has, by its length."""
    try:
        return cloud.stat().st_size // NUSCENES.dtype.itemsize
    except OSError as error:
        raise DataError(cloud, "", f"cannot be read: {error.strerror or error}") from error


def _add(found: dict[int, list[LabeledPoints]], labels: UInt8Array, sensor_id: str | int, k: int) -> None:
    """Cut the points of one sweep into those of each class."""
    order = np.argsort(labels, kind="stable").astype(np.uint32)
    classes, starts = np.unique(labels[order], return_index=True)
    for index, rows in zip(classes.tolist(), np.split(order, starts[1:]), strict=True):
        found.setdefault(index, []).append(LabeledPoints(sensor_id, rows, k))


_LEFT_OUT = (
    ("map.json", "maps", "maps are left out"),
    ("panoptic.json", "panoptic", "panoptic labels of points are left out"),
)

_EMPTY_TABLE = 4
"""A file of so many bytes holds no row."""


def open_nuscenes(
    path: Path, *, sequence: str | None = None, keyframes: bool | str = False, lenient: bool = False
) -> Scene:
    """Open one scene; images and points are read when asked for, boxes and classes of points at once.

    Args:
        path: the folder of the data set, or that of its tables.
        sequence: name or token of the scene, where the tables have several.
        keyframes: leave out what was taken between the samples.
        lenient: leave out what is at fault and count it.

    Raises:
        DataError: a table or a file is missing or wrong.
        OptionError: there is no such scene, or none was chosen of several.
    """
    location = _find_location(path)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        tables = _select(location, sequence, ledger, keyframes=as_flag("keyframes", keyframes))
        trajectory = _trajectory_of(tables, ledger)
        sensors = _build_sensors(tables, ledger)
        annotations: tuple[Annotation, ...] = (
            *_build_cuboids(tables, ledger),
            *_build_labelled_points(tables, ledger),
        )
        _note_left_out(tables, ledger)
    return Scene(
        sensors=sensors,
        annotations=annotations,
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        metadata=_scene_metadata(tables),
        source=f"{path}/{tables.scene.name}" if tables.others else str(path),
        format="nuscenes",
        warnings=ledger.warnings,
    )


def _note_left_out(tables: _SceneTables, ledger: Ledger) -> None:
    for name, code, message in _LEFT_OUT:
        file = tables.location.tables / name
        if file.is_file() and file.stat().st_size > _EMPTY_TABLE:
            ledger.note(WarningKind.SKIPPED, f"{code}-left-out", str(file), message)
    if tables.others:
        location = str(tables.location.tables / "scene.json")
        ledger.note(WarningKind.SKIPPED, "other-scenes", location, "further scenes are left out", count=tables.others)


def _scene_metadata(tables: _SceneTables) -> MappingProxyType[str, Any]:
    """What the tables state that the model has no field for, and the convention of box angles."""
    rows = {"scene": tables.scene, "log": tables.log}
    about: dict[str, Any] = {
        "version": tables.location.tables.name,
        **{name: msgspec.structs.asdict(row) for name, row in rows.items() if row is not None},
        "samples": [[row.token, row.timestamp] for row in tables.samples.values()],
    }
    angles = {"euler_unit": str(AngleUnit.DEGREES), "euler_order": "xyz"}
    return MappingProxyType({"nuscenes": about, "sceneloom": angles})


def _lidar_points(file: Path) -> LidarPoints:
    is_pcd = file.suffix.lower() == ".pcd"
    cloud = read_pcd(file) if is_pcd else read_bin(file, layout=NUSCENES)
    extras: dict[str, AnyArray] = {}
    return LidarPoints(
        positions=_positions(cloud),
        intensities=_whole(cloud, "intensity", np.uint8, extras),
        rings=_whole(cloud, "ring", np.uint16, extras),
        extras=MappingProxyType(extras),
    )


def _positions(cloud: Cloud) -> Float32Array:
    missing = [axis for axis in "xyz" if axis not in cloud.columns]
    if missing:
        problem = f"no column {' or '.join(missing)}; it has {' '.join(cloud.columns) or 'none'}"
        raise DataError(cloud.file, "", problem)
    return read_only(np.stack([cloud.columns[axis] for axis in "xyz"], axis=1), np.float32)


def _whole(cloud: Cloud, name: str, dtype: type[Any], extras: dict[str, AnyArray]) -> Any:
    """A column as whole numbers; what that changes of it is kept beside it."""
    column = cloud.columns.get(name)
    if column is None:
        return None
    limit = np.iinfo(dtype)
    rounded = np.clip(np.rint(np.nan_to_num(column, nan=0.0)), limit.min, limit.max)
    if not np.array_equal(rounded, column):
        extras[name] = read_only(column)
    return read_only(rounded, dtype)


def _returns(cloud: Cloud) -> Cloud:
    """The returns of a cycle: one without any has a single row that is no number.

    Source: class RadarPointCloud of the development kit.
    """
    first = [cloud.columns[axis][:1] for axis in "xyz" if axis in cloud.columns]
    if not any(np.isnan(value).any() for value in first):
        return cloud
    return Cloud(cloud.file, 0, {name: column[:0] for name, column in cloud.columns.items()})


def _velocities(cloud: Cloud, positions: Float32Array) -> tuple[Float32Array | None, Float32Array | None]:
    """Direction and length of `vx`, `vy`; what does not move points along the line of sight.

    Source: class RadarPointCloud of the development kit: vx and vy are measured, vx_comp and vy_comp compensated.
    """
    if not {"vx", "vy"} <= cloud.columns.keys():
        return None, None
    velocities = np.zeros((cloud.count, 3))
    velocities[:, 0], velocities[:, 1] = cloud.columns["vx"], cloud.columns["vy"]
    lengths = np.linalg.norm(velocities, axis=1)
    distances = np.linalg.norm(positions.astype(np.float64), axis=1)
    directions = np.tile([1.0, 0.0, 0.0], (cloud.count, 1))
    placed, moving = distances > 0, lengths > 0
    directions[placed] = positions[placed] / distances[placed, None]
    directions[moving] = velocities[moving] / lengths[moving, None]
    return read_only(directions, np.float32), read_only(lengths, np.float32)
