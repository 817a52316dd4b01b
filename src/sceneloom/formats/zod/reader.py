"""Read a frame, a sequence or a drive of the Zenseact Open Dataset.

Source: the public development kit `zenseact/zod`: `data_classes/calibration.py`, `sensor.py`, `ego_motion.py` and
`anno/object.py`; its projection, Kannala and Brandt's with four coefficients, is OpenCV's fisheye model.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.images import ImageReader
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.spec import choose_drive
from sceneloom.formats.base.text_tables import TimestampError, parse_timestamp
from sceneloom.formats.points.files import read_cloud
from sceneloom.formats.zod.spec import CALIBRATION, CAMERAS, DRIVES_IN, EGO_MOTION, INFO, LIDAR, METADATA, OBJECTS
from sceneloom.geometry.rigid import RigidTransform, quaternion_from_matrix
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory, poses_along
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

_OFF, _LARGEST, _LATEST_S = 1e-3, 1e9, 9_000_000_000
_UNREAD = ("oxts.hdf5", "vehicle_data.hdf5", "radar_front")


class _FrontCamera(msgspec.Struct):
    """The entry `FC` of the calibration: poses on the ego, and Kannala and Brandt's model."""

    extrinsics: list[list[float]]
    lidar_extrinsics: list[list[float]]
    intrinsics: list[list[float]]
    distortion: list[float]
    image_dimensions: list[float]


class _Calibration(msgspec.Struct):
    camera: _FrontCamera = msgspec.field(name="FC")


class _EgoMotion(msgspec.Struct):
    """World from ego, and seconds since 1970."""

    poses: list[list[list[float]]]
    timestamps: list[float]


class _LidarEntry(msgspec.Struct):
    filepath: str
    is_compensated: bool | None = None


class _Info(msgspec.Struct):
    keyframe_time: str | None = None
    lidar_frames: dict[str, list[_LidarEntry]] = {}


class _Geometry(msgspec.Struct):
    coordinates: list[list[float]]


class _Location(msgspec.Struct):
    coordinates: list[float]


class _Properties(msgspec.Struct):
    """What is stated of an object; its box in space is in the frame of the lidar."""

    uuid: str = msgspec.field(name="annotation_uuid")
    kind: str = msgspec.field(name="class")
    type: str | None = None
    unclear: bool | None = None
    occlusion_ratio: str | None = None
    artificial: str | None = None
    location_3d: _Location | None = None
    size_3d_length: float | None = None
    size_3d_width: float | None = None
    size_3d_height: float | None = None
    orientation_3d_qw: float | None = None
    orientation_3d_qx: float | None = None
    orientation_3d_qy: float | None = None
    orientation_3d_qz: float | None = None


class _Object(msgspec.Struct):
    geometry: _Geometry
    properties: _Properties


def open_zod(path: Path, *, sequence: str | None = None, lenient: bool = False) -> Scene:
    """Open a frame, a sequence or a drive; images and points are read when asked for.

    Args:
        path: its folder, or one of several.
        sequence: name of the folder, where there are several.

    Raises:
        OptionError: there is no such folder, or none was chosen of several.
    """
    expected = f"{CALIBRATION}, {LIDAR}/ and {CAMERAS[0]}/"
    folder = choose_drive(path, DRIVES_IN(path), sequence, called="sequence", expected=expected)
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        return _Drive(folder, ledger).scene()


class _Drive:
    """A folder that is being read."""

    def __init__(self, folder: Path, ledger: Ledger) -> None:
        self.folder, self.ledger = folder, ledger
        self.calibration = read_json(folder / CALIBRATION, _Calibration).camera
        self.mount = self._pose("lidar_extrinsics", self.calibration.lidar_extrinsics)
        self.info = read_json(folder / INFO, _Info) if (folder / INFO).is_file() else _Info()
        self.sweeps, self.sweep_times = _timestamped_files(folder / LIDAR, ".npy")
        self.camera = next((name for name in CAMERAS if (folder / name).is_dir()), None)
        self.images: tuple[Path, ...] = ()
        self.image_times: Int64Array = np.zeros(0, np.int64)
        if self.camera is not None:
            self.images, self.image_times = _timestamped_files(folder / self.camera, ".jpg")
        if not self.sweeps and not self.images:
            raise DataError(folder, "", f"holds no {LIDAR}/*.npy and no {CAMERAS[0]}/*.jpg")

    def scene(self) -> Scene:
        for name in (*_UNREAD, *(name for name in CAMERAS if name != self.camera)):
            if (self.folder / name).exists():
                self.ledger.note(WarningKind.SKIPPED, "not-read", str(self.folder / name), f"{name} is not read")
        trajectory = self._trajectory()
        path = None if trajectory is None else trajectory.poses
        sensors: list[Sensor] = [*self._lidars(path), *self._cameras(path)]
        about = {"sequence": self.folder.name}
        if (self.folder / METADATA).is_file():
            stated: dict[str, Any] = read_json(self.folder / METADATA, dict)
            about |= {name: str(value) for name, value in stated.items()}
        return Scene(
            tuple(sensors),
            annotations=tuple(self._annotations(path)),
            trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
            metadata=MappingProxyType({"zod": about, "sceneloom": {"euler_unit": "degrees", "euler_order": "xyz"}}),
            source=str(self.folder),
            format="zod",
            warnings=self.ledger.warnings,
        )

    def _pose(self, name: str, rows: Any, *, file: str = CALIBRATION) -> RigidTransform:
        """A pose on the ego or in the world, of 4 rows of 4 numbers."""
        try:
            transform, error = RigidTransform.nearest(np.array(rows, np.float64))
        except (CalibrationError, ValueError) as fault:
            raise DataError(self.folder / file, name, f"{fault}") from fault
        if not error < _OFF or np.abs(transform.translation).max() > _LARGEST:
            raise DataError(self.folder / file, name, f"{rows}; expected a rigid transform")
        return transform

    def _trajectory(self) -> Trajectory | None:
        file = self.folder / EGO_MOTION
        if not file.is_file():
            message = f"no {EGO_MOTION}: the trajectory is not known"
            self.ledger.note(WarningKind.SKIPPED, "no-poses", str(file), message)
            return None
        found = read_json(file, _EgoMotion)
        if len(found.poses) != len(found.timestamps) or not found.poses:
            problem = f"{len(found.poses)} poses for {len(found.timestamps)} times; expected as many, and one at least"
            raise DataError(file, "", problem)
        wrong = [k for k, time in enumerate(found.timestamps) if not abs(time) < _LATEST_S]
        if wrong:
            raise DataError(file, f"timestamps[{wrong[0]}]", f"{found.timestamps[wrong[0]]:g}; expected seconds")
        poses = [self._pose(f"poses[{k}]", rows, file=EGO_MOTION) for k, rows in enumerate(found.poses)]
        times, rows = np.unique(np.rint(np.array(found.timestamps) * 1e9).astype(np.int64), return_index=True)
        rotations = np.stack([poses[k].rotation for k in rows.tolist()])
        positions = np.stack([poses[k].translation for k in rows.tolist()])
        return Trajectory("pose", read_only(times), read_only(positions), read_only(quaternion_from_matrix(rotations)))

    def _lidars(self, path: Poses | None) -> list[LidarSensor]:
        if not self.sweeps:
            self.ledger.note(WarningKind.SKIPPED, "lidar-missing", str(self.folder / LIDAR), "no sweeps")
            return []
        entries = [entry for entries in self.info.lidar_frames.values() for entry in entries]
        compensated = {entry.filepath.rpartition("/")[2] for entry in entries if entry.is_compensated}
        moved = tuple(file.name in compensated for file in self.sweeps)
        times, along = read_only(self.sweep_times), np.zeros(len(self.sweeps), np.int64)
        frames = LazyFrames(times, _Sweeps(self.sweeps, times, moved))
        return [LidarSensor(LIDAR, frames, poses_along(path, {0: self.mount}, along, times), self.mount)]

    def _cameras(self, path: Poses | None) -> list[CameraSensor]:
        file, stated = self.folder / CALIBRATION, self.calibration
        if not self.images or self.camera is None:
            self.ledger.note(WarningKind.SKIPPED, "images-missing", str(self.folder / CAMERAS[0]), "no images")
            return []
        k = np.array(stated.intrinsics[:3], dtype=object)
        if k.ndim != 2 or min(k.shape) < 3 or len(stated.distortion) != 4 or len(stated.image_dimensions) != 2:
            raise DataError(file, "FC", "expected 3 rows of intrinsics, 4 coefficients of distortion, width and height")
        focal = (float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
        try:
            width, height = map(int, stated.image_dimensions)
            camera = Camera("fisheye", width, height, *focal, tuple(stated.distortion))
        except (CalibrationError, OverflowError, ValueError) as error:
            raise DataError(file, "FC", str(error)) from error
        mount = self._pose("extrinsics", stated.extrinsics)
        times, names = read_only(self.image_times), tuple(f"{self.camera}/{file.name}" for file in self.images)
        images: LazyFrames[CameraImage] = LazyFrames(times, ImageReader(self.images, names, times, camera))
        poses = poses_along(path, {0: mount}, np.zeros(len(times), np.int64), times)
        return [CameraSensor("camera_front", camera, images, poses=poses, mount=mount)]

    # labels

    def _annotations(self, path: Poses | None) -> list[Annotation]:
        """Objects at the key frame: boxes in its image, and cuboids, moved from the lidar into the world."""
        file = self.folder / OBJECTS
        if not file.is_file():
            return []
        found: list[Annotation] = []
        objects = read_json(file, list[_Object])
        image_ns, sweep_ns = (self._key(times) for times in (self.image_times, self.sweep_times))
        world_from_lidar = self._lidar_at(path, sweep_ns)
        ids: set[str] = set()
        for k, one in enumerate(objects):
            stated = one.properties
            if stated.uuid in ids:
                problem = f"{stated.uuid!r} is there twice; expected it once"
                self.ledger.fault("objects-repeated", DataError(file, f"[{k}].properties.annotation_uuid", problem))
                continue
            ids.add(stated.uuid)
            if stated.location_3d is not None and world_from_lidar is not None and sweep_ns is not None:
                found.append(self._cuboid(f"[{k}].properties", stated, world_from_lidar, sweep_ns))
            if image_ns is not None:
                found.append(self._box(f"[{k}].geometry.coordinates", one, image_ns))
        if world_from_lidar is None and any(one.properties.location_3d for one in objects):
            message = "the trajectory at the key frame is not known: cuboids are left out"
            self.ledger.note(WarningKind.SKIPPED, "cuboids-without-pose", str(file), message)
        return found

    def _key(self, times_ns: Int64Array) -> int | None:
        """The time of the file nearest to the key frame; without such a time, of the only file."""
        if not len(times_ns):
            return None
        if self.info.keyframe_time is None:
            if len(times_ns) > 1:
                message = f"no keyframe_time in {INFO}: labels are taken as those of the middle frame"
                self.ledger.note(WarningKind.ASSUMED, "key-frame", str(self.folder), message)
            return int(times_ns[len(times_ns) // 2])
        try:
            key_ns = parse_timestamp(self.info.keyframe_time, None)
        except TimestampError as error:
            raise DataError(self.folder / INFO, "keyframe_time", str(error)) from None
        return int(times_ns[int(np.argmin(np.abs(times_ns - key_ns)))])

    def _lidar_at(self, path: Poses | None, timestamp_ns: int | None) -> RigidTransform | None:
        if path is None or timestamp_ns is None:
            return None
        at = path.interpolate(np.array([timestamp_ns], np.int64), mount=self.mount)
        if at.coverage[0]:
            return None
        return RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])

    def _cuboid(
        self, location: str, stated: _Properties, world_from_lidar: RigidTransform, timestamp_ns: int
    ) -> CuboidAnnotation:
        file = self.folder / OBJECTS
        center = np.array(stated.location_3d.coordinates if stated.location_3d else [], np.float64)
        sizes = [stated.size_3d_length, stated.size_3d_width, stated.size_3d_height]
        turned = [
            stated.orientation_3d_qx,
            stated.orientation_3d_qy,
            stated.orientation_3d_qz,
            stated.orientation_3d_qw,
        ]
        if center.shape != (3,) or any(value is None for value in (*sizes, *turned)):
            raise DataError(file, location, "expected location_3d of 3 numbers, size_3d_* and orientation_3d_*")
        size, quaternion = np.array(sizes, np.float64), np.array(turned, np.float64)
        if not (size > 0).all() or np.abs(center).max() > _LARGEST:
            raise DataError(file, location, f"size {size.tolist()} at {center.tolist()}; expected sizes above 0")
        if lengths_of(quaternion[None])[1].any():
            raise DataError(file, f"{location}.orientation_3d", f"x, y, z, w = {turned}; expected length 1")
        box = world_from_lidar @ RigidTransform.from_quaternion(center, quaternion)
        values = np.concatenate([size, box.translation, CuboidAngles().from_quaternions(box.quaternion_xyzw)])
        times = np.array([timestamp_ns], np.int64)
        return CuboidAnnotation(
            stated.uuid, CuboidPath(times, values[None]), label=stated.kind, attributes=_stated(stated, times)
        )

    def _box(self, location: str, one: _Object, timestamp_ns: int) -> Box2DAnnotation:
        """The box around the points in which an object touches the borders of its box."""
        corners = one.geometry.coordinates
        if not corners or any(len(corner) != 2 for corner in corners) or np.abs(np.array(corners)).max() > _LARGEST:
            raise DataError(self.folder / OBJECTS, location, f"{corners!r:.60}; expected points in the image")
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        times = np.array([timestamp_ns], np.int64)
        path = BoxPath(times, np.concatenate([low, high - low])[None].astype(np.float64))
        stated = one.properties
        name = f"{stated.uuid}:2d"
        return Box2DAnnotation(name, "camera_front", path, label=stated.kind, attributes=_stated(stated, times))


def _stated(stated: _Properties, times: Int64Array) -> tuple[AttributePath, ...]:
    values = {name: getattr(stated, name) for name in ("type", "unclear", "occlusion_ratio", "artificial")}
    texts = {name: str(value).lower() if isinstance(value, bool) else value for name, value in values.items()}
    return tuple(AttributePath(name, (text,), times) for name, text in texts.items() if text is not None)


@dataclass(frozen=True, slots=True, eq=False)
class _Sweeps:
    """Reads sweeps: records of x, y, z, timestamp [µs from the file's time], intensity and diode_index."""

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    compensated: tuple[bool, ...]

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`; points that were moved to the sweep's time have this time, their own are in `extras`."""
        columns = _columns(self.files[k])
        positions = np.stack([columns[axis].astype(np.float32) for axis in "xyz"], axis=1)
        if not np.isfinite(positions).all():
            row = int(np.argmin(np.isfinite(positions).all(axis=1)))
            raise DataError(self.files[k], f"point {row}", f"{positions[row].tolist()}; expected finite metres")
        micros = columns["timestamp"].astype(np.int64)
        if len(micros) and not -_LONGEST_US <= micros.min() <= micros.max() <= _LONGEST_US:
            raise DataError(self.files[k], "timestamp", f"expected microseconds within ±{_LONGEST_US}")
        timestamp_ns, moved = int(self.timestamps_ns[k]), self.compensated[k]
        times = timestamp_ns + (np.zeros_like(micros) if moved else 1000 * micros)
        points = LidarPoints(
            positions=read_only(positions),
            intensities=read_only(np.clip(columns["intensity"], 0, 255), np.uint8),
            timestamps_ns=read_only(times),
            rings=read_only(np.clip(columns["diode_index"], 0, 65535), np.uint16),
            extras=MappingProxyType({"timestamp": read_only(micros)} if moved else {}),
        )
        return LidarFrame(timestamp_ns, points, MappingProxyType({"file": f"{LIDAR}/{self.files[k].name}"}))


_LONGEST_US = 10_000_000
_COLUMNS = ("x", "y", "z", "timestamp", "intensity", "diode_index")


def _columns(file: Path) -> Mapping[str, AnyArray]:
    found = read_cloud(file).columns
    if any(name not in found or found[name].dtype.kind not in "fiu" for name in _COLUMNS):
        raise DataError(file, "", f"records of {', '.join(found)}; expected numbers {', '.join(_COLUMNS)}")
    return {name: found[name] for name in _COLUMNS}


def _timestamped_files(folder: Path, suffix: str) -> tuple[tuple[Path, ...], Int64Array]:
    """The files of a folder and their times (N,) int64 [ns], ascending, of names such as 000000_romeo_<time>.npy."""
    found: dict[int, Path] = {}
    for file in sorted(folder.glob(f"*{suffix}")) if folder.is_dir() else []:
        try:
            timestamp_ns = parse_timestamp(file.stem.rpartition("_")[2], None)
        except TimestampError as error:
            expected = f"expected a name such as 000000_romeo_2022-06-14T13:23:10.194720Z{suffix}"
            raise DataError(file, "", f"{error}; {expected}") from None
        if timestamp_ns in found:
            raise DataError(file, "", f"has the time of {found[timestamp_ns].name}; expected one file for each time")
        found[timestamp_ns] = file
    times = sorted(found)
    return tuple(found[time] for time in times), np.array(times, np.int64)
