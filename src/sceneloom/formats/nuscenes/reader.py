"""Read one scene of a data set in the nuScenes schema, or in its dialect T4."""

import re
from base64 import b64decode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import OPENCV_LENGTHS, Camera, from_opencv
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import open_file, read_bytes
from sceneloom.formats.base.images import ImageFile, images_image_size, is_jpeg
from sceneloom.formats.base.json_files import NO_JSON, no_json
from sceneloom.formats.base.masks import MASKS, Mask
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.spec import as_flag
from sceneloom.formats.nuscenes.spec import table_folders
from sceneloom.formats.nuscenes.tables import KEY_FRAMES, MICROSECOND, NEEDED, T4_VECTORS, TABLES, Quaternion
from sceneloom.formats.points.cloud import NUSCENES, Cloud
from sceneloom.formats.points.files import read_bin, read_cloud
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
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

_PIECE = 1 << 23


_LONGEST_ROW = 1 << 16


_ROW_END = re.compile(rb"\}\s*,")


_FIELD = re.compile(r"\$\[(?P<row>\d+)\](?:\.(?P<field>\S+?))?`?$")


def iter_rows(folder: Path, table: str) -> Iterator[Any]:
    """Read the rows of one of `TABLES` one by one; a piece of the file is in memory at a time.

    Raises:
        DataError: the file is missing, no JSON, or a row lacks a field or has one of another type.
    """
    path = folder / f"{table}.json"
    rows_of_table: Any = list.__class_getitem__(TABLES[table])
    decoder: msgspec.json.Decoder[list[Any]] = msgspec.json.Decoder(rows_of_table)
    given = 0
    try:
        for piece in _chunks(path):
            try:
                rows = decoder.decode(piece)
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                # the piece ends inside a text, or is wrong: the whole file shows which
                yield from _decoded(path, decoder, read_bytes(path))[given:]
                return
            given += len(rows)
            yield from rows
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}; expected a table of the nuScenes schema"
        raise DataError(path, "", problem) from error


def _chunks(path: Path) -> Iterator[bytes]:
    """Cut a JSON list of objects into shorter lists of whole objects."""
    with open_file(path) as file:
        content = file.read(_PIECE)
        if len(content) < _PIECE:
            yield content
            return
        rest = content.lstrip().removeprefix(b"\xef\xbb\xbf").removeprefix(b"[")
        while content:
            for cut in [*_ROW_END.finditer(rest, max(0, len(rest) - _LONGEST_ROW))][-1:]:
                yield b"[" + rest[: cut.start() + 1] + b"]"
                rest = rest[cut.end() :]
            content = file.read(_PIECE)
            rest += content
        yield b"[" + rest


def _decoded(path: Path, decoder: "msgspec.json.Decoder[list[Any]]", content: bytes) -> list[Any]:
    try:
        return decoder.decode(content)
    except msgspec.ValidationError as error:
        problem, _, location = str(error).partition(" - at `")
        found = _FIELD.search(location)
        where = "" if found is None else ".".join(filter(None, (f"row {found['row']}", found["field"])))
        raise DataError(path, where, problem) from error
    except NO_JSON as error:
        raise no_json(path, content, error) from error


_MOST_NAMES = 20
_TRAJECTORY = "pose"
_KINDS = ("lidar", "radar", "camera")
_BOX_TABLES = ("sample_annotation", "instance", "category", "attribute", "visibility")
_LEFT_OUT = (
    ("map.json", "maps", "maps are left out"),
    ("panoptic.json", "panoptic", "panoptic labels of points are left out"),
    ("vehicle_state.json", "vehicle-states", "pedals, steering and indicators of the vehicle are left out"),
    ("../input_bag", "input-bag", "the bag that the data set was made of is left out; open it as a drive of its own"),
)
_EMPTY_TABLE = 4  # a file of so many bytes holds no row

_OF_FRAMES = {"file": "filename", "token": "token", "sample_token": "sample_token", "is_key_frame": "is_key_frame"}
"""Extra fields of frames, and the columns that they are in."""


def scene_names(path: Path) -> tuple[str, ...]:
    """Names of the scenes of a data set.

    Raises:
        DataError: a table is missing or wrong.
        OptionError: there are several sets of tables.
    """
    return tuple(row.name for row in iter_rows(_find_tables(path), "scene"))


def open_nuscenes(
    path: Path, *, sequence: str | None = None, keyframes: bool | str = False, lenient: bool = False
) -> Scene:
    """Open one scene; images and points are read when asked for, boxes and classes of points at once.

    Args:
        path: the folder of the data set, or that of its tables.
        sequence: name or token of the scene, where the tables have several.
        keyframes: leave out what was taken between the samples.

    Raises:
        OptionError: there is no such scene, or none was chosen of several.
    """
    tables = _find_tables(path)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Reader(tables, sequence, ledger, keyframes=as_flag("keyframes", keyframes)).scene(path)


def _find_tables(path: Path) -> Path:
    """The folder of the tables, `v1.0-mini` of the data set."""
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
    return folders[0]


@dataclass(frozen=True, slots=True)
class _SensorData:
    """Rows of one sensor and what it took in a scene, in the order of time."""

    sensor: Any
    id: str | int  # in the scene
    rows: tuple[Any, ...]  # of its images, sweeps or cycles
    poses: tuple[Any, ...]  # the ego's at each of them
    calibrations: tuple[Any, ...]  # mounting and intrinsics at each of them; usually one for all

    @property
    def timestamps_ns(self) -> Int64Array:
        return np.array([row.timestamp for row in self.rows], np.int64) * MICROSECOND


@dataclass(frozen=True, slots=True, eq=False)
class _Files:
    """The files of one sensor: their times [ns], and extra fields of each frame."""

    paths: tuple[Path, ...]
    timestamps_ns: Int64Array
    extras: tuple[Mapping[str, Any], ...]


class _Reader:
    """The rows of one scene, samples by token in the order of time, and how many `others` the tables have."""

    def __init__(self, tables: Path, sequence: str | None, ledger: Ledger, *, keyframes: bool) -> None:
        self.tables, self.ledger = tables, ledger
        scenes = list(iter_rows(tables, "scene"))
        self.row, self.others = _chosen(tables, scenes, sequence), len(scenes) - 1
        found = [row for row in iter_rows(tables, "sample") if row.scene_token == self.row.token]
        self.samples = {row.token: row for row in sorted(found, key=lambda row: row.timestamp)}
        location = f"scene {self.row.name}"
        if not self.samples:
            raise DataError(tables / "sample.json", location, "has no sample")
        if self.row.nbr_samples not in (0, len(self.samples)):
            problem = f"{len(self.samples)} samples; scene.json says {self.row.nbr_samples}: is the table cut off?"
            ledger.fault("samples-missing", DataError(tables / "sample.json", location, problem))
        self.log = self._log()
        self.sensors = self._sensor_data(keyframes=keyframes)

    def scene(self, path: Path) -> Scene:
        """Build the scene that was asked for by a path."""
        trajectory = self._trajectory()
        sensors = [sensor for data in self.sensors if (sensor := self._sensor(data)) is not None]
        annotations: tuple[Annotation, ...] = (
            *self._cuboids(),
            *self._boxes_2d(),
            *self._surfaces(),
            *self._labelled_points(),
        )
        for name, code, message in _LEFT_OUT:
            file = self.tables / name
            if file.is_dir() or (file.is_file() and file.stat().st_size > _EMPTY_TABLE):
                self.ledger.note(WarningKind.SKIPPED, f"{code}-left-out", str(file), message)
        if self.others:
            location = str(self.tables / "scene.json")
            message = "further scenes are left out"
            self.ledger.note(WarningKind.SKIPPED, "other-scenes", location, message, count=self.others)
        angles = CuboidAngles()
        about: dict[str, Any] = {
            "version": self.tables.name,
            "scene": msgspec.structs.asdict(self.row),
            **({} if self.log is None else {"log": msgspec.structs.asdict(self.log)}),
            "samples": [[row.token, row.timestamp] for row in self.samples.values()],
        }
        convention = {"euler_unit": str(angles.unit), "euler_order": angles.order}
        return Scene(
            sensors=tuple(sensors),
            annotations=annotations,
            trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
            metadata=MappingProxyType({"nuscenes": about, "sceneloom": convention}),
            source=f"{path}/{self.row.name}" if self.others else str(path),
            format="nuscenes",
            warnings=self.ledger.warnings,
        )

    # rows

    def _log(self) -> Any:
        """The row of the recording; None where it is missing and the reading is lenient."""
        if not (self.tables / "log.json").is_file():
            self.ledger.fault("table-missing", DataError(self.tables, "log.json", "missing"))
            return None
        log = next((row for row in iter_rows(self.tables, "log") if row.token == self.row.log_token), None)
        if log is None:
            self.ledger.fault("dangling-tokens", self._dangling("scene", self.row.token, "log", self.row.log_token))
        return log

    def _by_token(self, table: str, wanted: Iterable[str] | None = None) -> dict[str, Any]:
        """The rows of a table with these tokens, or all of them."""
        tokens = None if wanted is None else set(wanted)
        return {row.token: row for row in iter_rows(self.tables, table) if tokens is None or row.token in tokens}

    def _dangling(self, table: str, token: str, other: str, wanted: str) -> DataError:
        """The fault of a row that names a row of another table which is not there."""
        problem = f"{other}_token {wanted!r} leads to no row of {other}.json"
        return self._fault(table, token, problem)

    def _fault(self, table: str, token: str, problem: str) -> DataError:
        return DataError(self.tables / f"{table}.json", f"row {token}", problem)

    def _file(self, table: str, token: str, name: str) -> Path:
        """The path of a file that a table names; DataError if the name leads out of the data set."""
        parts = PurePosixPath(name).parts
        if not parts or PurePosixPath(name).is_absolute() or ".." in parts:
            raise self._fault(table, token, f"filename {name!r}; expected one inside the folder of the data set")
        return self.tables.parent.joinpath(*parts)

    def _sensor_data(self, *, keyframes: bool) -> list[_SensorData]:
        rows = [
            row
            for row in iter_rows(self.tables, "sample_data")
            if row.sample_token in self.samples and (row.is_key_frame or not keyframes)
        ]
        rows.sort(key=lambda row: row.timestamp)
        poses = self._by_token("ego_pose", (row.ego_pose_token for row in rows))
        calibrations, sensors = self._by_token("calibrated_sensor"), self._by_token("sensor")
        taken: dict[str, list[Any]] = {}
        for row in rows:
            calibration = calibrations.get(row.calibrated_sensor_token)
            if row.ego_pose_token not in poses:
                fault = self._dangling("sample_data", row.token, "ego_pose", row.ego_pose_token)
            elif calibration is None:
                wanted = row.calibrated_sensor_token
                fault = self._dangling("sample_data", row.token, "calibrated_sensor", wanted)
            elif calibration.sensor_token not in sensors:
                fault = self._dangling("calibrated_sensor", calibration.token, "sensor", calibration.sensor_token)
            else:
                if not row.is_valid:
                    location, message = str(self.tables / "sample_data.json"), "frames that are stated to be invalid"
                    self.ledger.note(WarningKind.SKIPPED, "frames-invalid", location, f"{message} are left out")
                elif self._is_there(row):
                    taken.setdefault(calibration.sensor_token, []).append(row)
                continue
            self.ledger.fault("dangling-tokens", fault)
        ids = {
            token: sensors[token].channel if sensors[token].sensor_id is None else sensors[token].sensor_id
            for token in taken
        }
        if len({key_of(sensor_id) for sensor_id in ids.values()}) < len(ids):
            ids = {token: sensors[token].channel for token in taken}
        found = [
            _SensorData(
                sensors[token],
                ids[token],
                tuple(own),
                tuple(poses[row.ego_pose_token] for row in own),
                tuple(calibrations[row.calibrated_sensor_token] for row in own),
            )
            for token, own in taken.items()
        ]
        order = {kind: rank for rank, kind in enumerate(_KINDS)}
        return sorted(found, key=lambda data: (order.get(data.sensor.modality, len(order)), str(data.id)))

    def _is_there(self, row: Any) -> bool:
        file = self._file("sample_data", row.token, row.filename)
        if file.is_file():
            return True
        hint = "" if row.is_key_frame else "; without the folder sweeps/, open the key frames only (`--keyframes`)"
        fault = DataError(file, "", f"is not there; sample_data.json names it{hint}")
        self.ledger.fault("files-missing", fault)
        return False

    # poses and sensors

    def _trajectory(self) -> Trajectory | None:
        """The ego trajectory: its poses at all frames of all sensors; None where there are none."""
        rows: dict[str, tuple[int, Any]] = {}
        for data in self.sensors:
            for frame, row in zip(data.rows, data.poses, strict=True):
                rows.setdefault(row.token, (frame.timestamp if row.timestamp is None else row.timestamp, row))
        if not rows:
            return None
        timed = sorted(rows.values(), key=lambda pair: pair[0])
        ordered = [row for _, row in timed]
        timestamps_ns = np.array([time for time, _ in timed], np.int64) * MICROSECOND
        times_ns, first = np.unique(timestamps_ns, return_index=True)
        positions = np.array([row.translation for row in ordered], np.float64)
        quaternions = self._quaternions("ego_pose", [(row.token, row.rotation) for row in ordered])
        kept = first[np.searchsorted(times_ns, timestamps_ns)]
        differing = int((positions != positions[kept]).any(axis=1).sum())
        if differing:
            message = "several positions at one time; the first one is taken"
            location = str(self.tables / "ego_pose.json")
            self.ledger.note(WarningKind.SKIPPED, "poses-repeated", location, message, count=differing)
        return Trajectory(_TRAJECTORY, times_ns, positions[first], quaternions[first])

    def _quaternions(self, table: str, rotations: Sequence[tuple[str, Quaternion]]) -> Float64Array:
        """Rotations `w x y z`, by tokens, as unit quaternions (N, 4), scalar last."""
        values = np.array([rotation for _, rotation in rotations], np.float64).reshape(-1, 4)
        norms, is_off = lengths_of(values)
        for k in np.flatnonzero(is_off)[:1].tolist():
            token, rotation = rotations[k]
            problem = f"rotation {list(rotation)} has the length {norms[k]:.4f}; expected w, x, y, z of length 1"
            raise self._fault(table, token, problem)
        return normalise_quaternion(values[:, [1, 2, 3, 0]])

    def _sensor(self, data: _SensorData) -> Sensor | None:
        """Build a lidar, radar or camera; None of another kind."""
        kind = data.sensor.modality
        if kind not in _KINDS:
            message = f"{data.sensor.channel} is a {kind!r}, which is not supported and left out"
            location = str(self.tables / "sensor.json")
            self.ledger.note(WarningKind.SKIPPED, "unknown-modality", location, message, count=len(data.rows))
            return None
        mounts = self._mounts(data)
        files = _Files(
            tuple(self._file("sample_data", row.token, row.filename) for row in data.rows),
            data.timestamps_ns,
            tuple(
                MappingProxyType({name: getattr(row, column) for name, column in _OF_FRAMES.items()})
                for row in data.rows
            ),
        )
        about = {
            "token": data.sensor.token,
            "calibrated_sensor_token": data.calibrations[0].token,
            KEY_FRAMES: tuple(row.timestamp for row in data.rows if row.is_key_frame),
        }
        common: dict[str, Any] = {
            "id": data.id,
            "poses": self._poses(data, mounts),
            "mount": mounts[0],
            "extras": MappingProxyType(about),
        }
        if kind == "lidar":
            return LidarSensor(frames=LazyFrames(files.timestamps_ns, partial(_read_sweep, files)), **common)
        if kind == "radar":
            return RadarSensor(frames=LazyFrames(files.timestamps_ns, partial(_read_cycle, files)), **common)
        cameras = self._cameras(data, files)
        own = tuple(None if mount is mounts[0] else mount for mount in mounts)
        images = LazyFrames(files.timestamps_ns, partial(_read_image, files, cameras, own))
        return CameraSensor(camera=cameras[0], images=images, **common)

    def _mounts(self, data: _SensorData) -> list[RigidTransform]:
        """`ego_from_sensor` at each frame; the same object for frames of one row."""
        found: dict[str, RigidTransform] = {}
        for row in data.calibrations:
            if row.token not in found:
                quaternion = self._quaternions("calibrated_sensor", [(row.token, row.rotation)])[0]
                try:
                    found[row.token] = RigidTransform.from_quaternion(np.array(row.translation), quaternion)
                except CalibrationError as error:
                    raise self._fault("calibrated_sensor", row.token, str(error)) from error
        return [found[row.token] for row in data.calibrations]

    def _poses(self, data: _SensorData, mounts: list[RigidTransform]) -> Poses:
        """`world_from_sensor` at each frame: the ego's pose that the frame names, and the mounting."""
        quaternions = self._quaternions("ego_pose", [(row.token, row.rotation) for row in data.poses])
        positions = np.array([row.translation for row in data.poses], np.float64)
        shifts = rotate_vectors(quaternions, np.array([mount.translation for mount in mounts]))
        rotations = multiply_quaternions(quaternions, np.array([mount.quaternion_xyzw for mount in mounts]))
        times_ns, first = np.unique(data.timestamps_ns, return_index=True)
        return Poses(times_ns, (shifts + positions)[first], rotations[first])

    def _cameras(self, data: _SensorData, files: _Files) -> tuple[Camera, ...]:
        """The camera model of each image; images of nuScenes are undistorted, those of T4 need not be."""
        known: dict[tuple[str, int, int], Camera] = {}
        cameras = []
        for row, calibration, path in zip(data.rows, data.calibrations, files.paths, strict=True):
            size = (row.width, row.height) if row.width and row.height else images_image_size(path)
            key = (calibration.token, *size)
            if key not in known:
                known[key] = self._camera(calibration, size)
            cameras.append(known[key])
        return tuple(cameras)

    def _camera(self, row: Any, size: tuple[int, int]) -> Camera:
        matrix = np.array(row.camera_intrinsic, np.float64)
        fault = f"camera_intrinsic {row.camera_intrinsic}; expected rows (fx, 0, cx), (0, fy, cy), (0, 0, 1)"
        if matrix.shape == (3, 3) and np.array_equal(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]):
            (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
            distortion = row.camera_distortion or []
            if len(distortion) not in OPENCV_LENGTHS:
                lengths = ", ".join(map(str, OPENCV_LENGTHS))
                problem = f"camera_distortion of {len(distortion)} numbers; expected {lengths} in OpenCV's order"
                raise self._fault("calibrated_sensor", row.token, problem)
            try:
                if any(distortion):
                    return Camera("brown_conrady", *size, fx, fy, cx, cy, from_opencv(distortion))
                return Camera("pinhole", *size, fx, fy, cx, cy)
            except CalibrationError as error:
                fault = str(error)
        raise self._fault("calibrated_sensor", row.token, fault)

    # annotations

    def _cuboids(self) -> list[CuboidAnnotation]:
        """A cuboid for each instance, in the order in which they come up."""
        for name in _BOX_TABLES:
            if not (self.tables / f"{name}.json").is_file():
                problem = "missing; expected the tables of boxes, be they empty"
                self.ledger.fault("table-missing", DataError(self.tables, f"{name}.json", problem))
                return []
        rows = [row for row in iter_rows(self.tables, "sample_annotation") if row.sample_token in self.samples]
        instances = self._by_token("instance", (row.instance_token for row in rows))
        names = {name: self._by_token(name) for name in ("category", "attribute", "visibility")}
        tracks: dict[str, list[Any]] = {}
        for row in rows:
            fault = self._dangling_box(row, instances, names)
            if fault is None:
                tracks.setdefault(row.instance_token, []).append(row)
            else:
                self.ledger.fault("dangling-tokens", fault)
        return [self._cuboid(instances[token], track, names) for token, track in tracks.items()]

    def _dangling_box(
        self, row: Any, instances: Mapping[str, Any], names: Mapping[str, Mapping[str, Any]]
    ) -> DataError | None:
        if row.instance_token not in instances:
            return self._dangling("sample_annotation", row.token, "instance", row.instance_token)
        category = instances[row.instance_token].category_token
        if category not in names["category"]:
            return self._dangling("instance", row.instance_token, "category", category)
        stated = [("visibility", row.visibility_token)] if row.visibility_token else []
        for table, token in (*stated, *(("attribute", token) for token in row.attribute_tokens)):
            if token not in names[table]:
                return self._dangling("sample_annotation", row.token, table, token)
        return None

    def _cuboid(self, instance: Any, track: list[Any], names: Mapping[str, Mapping[str, Any]]) -> CuboidAnnotation:
        rows = sorted(track, key=lambda row: self.samples[row.sample_token].timestamp)
        timestamps = [self.samples[row.sample_token].timestamp for row in rows]
        timestamps_ns = np.array(timestamps, np.int64) * MICROSECOND
        sizes_wlh, quaternions_wxyz = np.array([row.size for row in rows]), np.array([row.rotation for row in rows])
        wrong = lengths_of(quaternions_wxyz)[1] | (sizes_wlh <= 0).any(axis=1)
        if wrong.any():
            row = rows[int(np.argmax(wrong))]
            problem = f"size {list(row.size)}, rotation {list(row.rotation)}; expected sizes above 0, length 1"
            raise self._fault("sample_annotation", row.token, problem)
        angles = CuboidAngles().from_quaternions(quaternions_wxyz[:, [1, 2, 3, 0]])
        positions = np.array([row.translation for row in rows])
        values = np.concatenate([sizes_wlh[:, [1, 0, 2]], positions, angles], axis=1)
        attributes = [[names["attribute"][token].name for token in row.attribute_tokens] for row in rows]
        stated: dict[str, tuple[Any, ...]] = {
            "attributes": tuple(map(tuple, attributes)),
            "num_lidar_pts": tuple(row.num_lidar_pts for row in rows),
            "num_radar_pts": tuple(row.num_radar_pts for row in rows),
        }
        if any(row.visibility_token for row in rows):
            levels = (names["visibility"].get(row.visibility_token) for row in rows)
            stated["visibility"] = tuple("" if level is None else level.level for level in levels)
        for name in T4_VECTORS:
            if all(getattr(row, name) is not None for row in rows):
                stated[name] = tuple(getattr(row, name) for row in rows)
        if any(row.automatic_annotation for row in rows):
            stated["automatic_annotation"] = tuple(row.automatic_annotation for row in rows)
        extras = MappingProxyType({"tokens": tuple(row.token for row in rows)})
        return CuboidAnnotation(
            id=instance.token,
            path=CuboidPath(timestamps_ns, values, extras),
            label=names["category"][instance.category_token].name,
            attributes=tuple(AttributePath(name, values, timestamps_ns) for name, values in stated.items()),
        )

    def _drawn(self, table: str) -> list[tuple[_SensorData, int, Any, Mapping[str, Any] | None]]:
        """Rows of a table of T4 that draw on images of this scene: camera, number of the image, row and mask."""
        if not (self.tables / f"{table}.json").is_file():
            return []
        cameras = [data for data in self.sensors if data.sensor.modality == "camera"]
        images = {row.token: (data, k) for data in cameras for k, row in enumerate(data.rows)}
        found = []
        for row in iter_rows(self.tables, table):
            if row.sample_data_token not in images:
                continue
            data, k = images[row.sample_data_token]
            try:
                mask = None if row.mask is None else self._mask(table, row, data.rows[k])
            except DataError as error:
                self.ledger.fault("labels", error)
                continue
            found.append((data, k, row, mask))
        found.sort(key=lambda entry: entry[0].rows[entry[1]].timestamp)
        return found

    def _mask(self, table: str, row: Any, image: Any) -> Mapping[str, Any]:
        """A mask as COCO has it; of one whose sides are width and height the runs follow the rows of the image.

        Source: `RLEMask` of t4-devkit, of whose versions some transpose what they decode, and some do not. A square
        mask is taken as COCO's.
        """
        try:
            counts = b64decode(row.mask.counts, validate=True).decode("ascii")
            mask = Mask.of_record({"size": row.mask.size, "counts": counts})
        except ValueError as error:
            raise self._fault(table, row.token, f"mask: {error}") from error
        size = (image.height or mask.height, image.width or mask.width)
        if (mask.height, mask.width) == size:
            return mask.record()
        if (mask.width, mask.height) != size:
            problem = f"mask of {list(row.mask.size)}; expected the height and width of the image, {list(size)}"
            raise self._fault(table, row.token, problem)
        rows, columns = mask.pixels()
        return Mask.of_pixels(mask.width, mask.height, columns, rows).record()

    def _boxes_2d(self) -> list[Box2DAnnotation]:
        """A box for each instance and camera, the child of the instance's cuboid; those with masks apart."""
        names = {name: self._by_token(name) for name in ("category", "attribute")}
        tracks: dict[tuple[str, str, bool], list[Any]] = {}
        for entry in self._drawn("object_ann"):
            data, _, row, mask = entry
            missing = [(name, token) for name, token in _named(row) if token not in names[name]]
            if missing:
                self.ledger.fault("dangling-tokens", self._dangling("object_ann", row.token, *missing[0]))
                continue
            left, top, right, bottom = row.bbox
            if not (right >= left and bottom >= top):
                problem = f"bbox {list(row.bbox)}; expected left, top, right, bottom"
                self.ledger.fault("boxes", self._fault("object_ann", row.token, problem))
                continue
            tracks.setdefault((row.instance_token, data.sensor.token, mask is not None), []).append(entry)
        return [self._box_2d(token, track, names) for (token, _, _), track in tracks.items()]

    def _box_2d(self, instance: str, track: list[Any], names: Mapping[str, Mapping[str, Any]]) -> Box2DAnnotation:
        data, _, first, mask = track[0]
        timestamps_ns = np.array([one.rows[k].timestamp for one, k, _, _ in track], np.int64) * MICROSECOND
        corners = np.array([row.bbox for _, _, row, _ in track], np.float64)
        extras: dict[str, Any] = {"tokens": tuple(row.token for _, _, row, _ in track)}
        if mask is not None:
            extras[MASKS] = [found for _, _, _, found in track]
        stated: dict[str, tuple[Any, ...]] = {
            "attributes": tuple(
                tuple(names["attribute"][token].name for token in row.attribute_tokens) for _, _, row, _ in track
            )
        }
        for name, empty in (("automatic_annotation", False), ("orientation", None), ("number", None)):
            values = tuple(getattr(row, name) for _, _, row, _ in track)
            if any(value is not empty for value in values):
                stated[name] = values
        boxes = np.hstack([corners[:, :2], corners[:, 2:] - corners[:, :2]])
        return Box2DAnnotation(
            id=f"{instance}:{data.sensor.channel}{'' if mask is None else ':mask'}",
            sensor_id=data.id,
            path=BoxPath(timestamps_ns, boxes, MappingProxyType(extras)),
            label=names["category"][first.category_token].name,
            parent_id=instance,
            attributes=tuple(AttributePath(name, values, timestamps_ns) for name, values in stated.items()),
        )

    def _surfaces(self) -> list[Box2DAnnotation]:
        """A box with its mask for each area of an image; those without a mask are left out."""
        categories = self._by_token("category")
        found = []
        for data, k, row, mask in self._drawn("surface_ann"):
            if row.category_token not in categories:
                fault = self._dangling("surface_ann", row.token, "category", row.category_token)
                self.ledger.fault("dangling-tokens", fault)
                continue
            if mask is None:
                location, message = str(self.tables / "surface_ann.json"), "areas without a mask are left out"
                self.ledger.note(WarningKind.SKIPPED, "masks-missing", location, message)
                continue
            timestamps_ns = np.array([data.rows[k].timestamp], np.int64) * MICROSECOND
            path = BoxPath(timestamps_ns, Mask.of_record(mask).box()[None], MappingProxyType({MASKS: [mask]}))
            label = categories[row.category_token].name
            found.append(Box2DAnnotation(id=row.token, sensor_id=data.id, path=path, label=label))
        return found

    def _labelled_points(self) -> list[LabeledPointsAnnotation]:
        """An annotation for each class of points; none where the data set has no such labels."""
        if not (self.tables / "lidarseg.json").is_file():
            return []
        lidars = [data for data in self.sensors if data.sensor.modality == "lidar"]
        frames = {row.token: (data, k) for data in lidars for k, row in enumerate(data.rows)}
        categories = {row.index: row for row in iter_rows(self.tables, "category") if row.index is not None}
        found: dict[int, list[LabeledPoints]] = {}
        for row in iter_rows(self.tables, "lidarseg"):
            if row.sample_data_token not in frames:
                continue
            data, k = frames[row.sample_data_token]
            try:
                labels = self._labels(row, data.rows[k], categories)
            except DataError as error:
                self.ledger.fault("labels", error)
                continue
            order = np.argsort(labels, kind="stable").astype(np.uint32)
            classes, starts = np.unique(labels[order], return_index=True)
            for index, points in zip(classes.tolist(), np.split(order, starts[1:]), strict=True):
                found.setdefault(index, []).append(LabeledPoints(data.id, points, k))
        return [
            LabeledPointsAnnotation(
                id=f"lidarseg:{categories[index].name}",
                labeled_points=tuple(sorted(entries, key=lambda entry: entry.sensor_frame or 0)),
                label=categories[index].name,
                is_instance=False,
                extras=MappingProxyType({"index": index}),
            )
            for index, entries in sorted(found.items())
        ]

    def _labels(self, row: Any, sweep: Any, categories: Mapping[int, Any]) -> UInt8Array:
        """The class of each point of a sweep."""
        file = self._file("lidarseg", row.token, row.filename)
        labels = np.frombuffer(read_bytes(file), np.uint8)
        cloud = self._file("sample_data", sweep.token, sweep.filename)
        try:
            points = cloud.stat().st_size // NUSCENES.dtype.itemsize
        except OSError as error:
            raise DataError(cloud, "", f"cannot be read: {error.strerror or error}") from error
        if len(labels) != points:
            raise DataError(file, "", f"{len(labels)} labels; expected {points}, one for each point of {cloud.name}")
        unknown = sorted(set(np.unique(labels).tolist()) - set(categories))
        if unknown:
            raise DataError(file, "", f"class {unknown[0]}; expected an `index` of category.json")
        return labels


def _named(row: Any) -> list[tuple[str, str]]:
    """Tables and tokens that a row of object_ann.json names."""
    return [("category", row.category_token), *(("attribute", token) for token in row.attribute_tokens)]


def _chosen(tables: Path, scenes: list[Any], sequence: str | None) -> Any:
    names = [row.name for row in scenes]
    shown = ", ".join([*names[:_MOST_NAMES], *([f"… ({len(names)} in all)"] if len(names) > _MOST_NAMES else [])])
    if sequence is not None:
        match = [row for row in scenes if sequence in (row.name, row.token)]
        if len(match) != 1:
            raise OptionError(f"{tables}: no scene {sequence!r}; it has {shown or 'none'}")
        return match[0]
    if not scenes:
        raise DataError(tables / "scene.json", "", "no row; expected at least one scene")
    if len(scenes) > 1:
        raise OptionError(f"{tables}: {len(scenes)} scenes; choose one with `--sequence NAME`: {shown}")
    return scenes[0]


# frames


def _read_sweep(files: _Files, k: int) -> LidarFrame:
    """Read a lidar sweep; every row of a file stays a point, since labels count the rows."""
    file = files.paths[k]
    cloud = read_cloud(file) if file.suffix.lower() == ".pcd" else read_bin(file, layout=NUSCENES)
    extras: dict[str, AnyArray] = {}
    points = LidarPoints(
        positions=_positions(cloud),
        intensities=_whole(cloud, "intensity", np.uint8, extras),
        rings=_whole(cloud, "ring", np.uint16, extras),
        extras=MappingProxyType(extras),
    )
    return LidarFrame(int(files.timestamps_ns[k]), points, files.extras[k])


def _read_cycle(files: _Files, k: int) -> RadarFrame:
    """Read a radar cycle; without returns it has a row of NaN. Source: class RadarPointCloud of the development kit."""
    cloud = read_cloud(files.paths[k])
    first = [cloud.columns[axis][:1] for axis in "xyz" if axis in cloud.columns]
    if any(np.isnan(value).any() for value in first):
        cloud = Cloud(cloud.file, 0, {name: column[:0] for name, column in cloud.columns.items()})
    positions = _positions(cloud)
    extras = {name: read_only(column) for name, column in cloud.columns.items() if name not in "xyz"}
    points = RadarPoints(positions, *_velocities(cloud, positions), extras=MappingProxyType(extras))
    return RadarFrame(int(files.timestamps_ns[k]), points, files.extras[k])


def _read_image(
    files: _Files, cameras: tuple[Camera, ...], mounts: tuple[RigidTransform | None, ...], k: int
) -> CameraImage:
    """Make an image without decoding it; its mounting is None where it is the camera's."""
    camera = cameras[k]
    file = ImageFile(files.paths[k], camera.width, camera.height)
    encoded = file.encoded if is_jpeg(file.path) else None
    time_ns = int(files.timestamps_ns[k])
    return CameraImage(time_ns, camera, file, mounts[k], extras=files.extras[k], encoded=encoded)


def _positions(cloud: Cloud) -> Float32Array:
    missing = [axis for axis in "xyz" if axis not in cloud.columns]
    if missing:
        problem = f"no column {' or '.join(missing)}; it has {' '.join(cloud.columns) or 'none'}"
        raise DataError(cloud.file, "", problem)
    return read_only(np.stack([cloud.columns[axis] for axis in "xyz"], axis=1), np.float32)


def _whole(cloud: Cloud, name: str, dtype: type[Any], extras: dict[str, AnyArray]) -> Any:
    """A column as whole numbers; the column itself becomes an extra field where that changes it."""
    column = cloud.columns.get(name)
    if column is None:
        return None
    limit = np.iinfo(dtype)
    rounded = np.clip(np.rint(np.nan_to_num(column, nan=0.0)), limit.min, limit.max)
    if not np.array_equal(rounded, column):
        extras[name] = read_only(column)
    return read_only(rounded, dtype)


def _velocities(cloud: Cloud, positions: Float32Array) -> tuple[Float32Array | None, Float32Array | None]:
    """Direction and length of `vx`, `vy`; the direction of what does not move is the line of sight."""
    # Source: class RadarPointCloud of the development kit: vx and vy are measured, vx_comp and vy_comp compensated.
    if not {"vx", "vy"} <= cloud.columns.keys():
        return None, None
    velocities = np.zeros((cloud.count, 3))
    with np.errstate(invalid="ignore"):  # files hold numbers that are none
        velocities[:, 0], velocities[:, 1] = cloud.columns["vx"], cloud.columns["vy"]
    lengths = np.linalg.norm(velocities, axis=1)
    distances = np.linalg.norm(positions.astype(np.float64), axis=1)
    directions = np.tile([1.0, 0.0, 0.0], (cloud.count, 1))
    placed, moving = distances > 0, lengths > 0
    directions[placed] = positions[placed] / distances[placed, None]
    directions[moving] = velocities[moving] / lengths[moving, None]
    return read_only(directions, np.float32), read_only(lengths, np.float32)
