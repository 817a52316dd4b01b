"""Read a log of Argoverse 2: poses and cuboids at once, points and images when they are asked for."""

import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.errors import CalibrationError, DataError, MissingExtraError, how_to_install
from sceneloom.formats.argoverse2.spec import ANNOTATIONS, CAMERA_MODELS, CAMERAS, LIDAR, LOGS_IN, MOUNTS, POSES
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import check_length, check_unpacked, file_faults, open_file
from sceneloom.formats.base.images import ImageReader
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.spec import as_flag, choose_drive
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.annotations import AttributePath, CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory, poses_along
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

Columns = Mapping[str, AnyArray]
_POSE = dict.fromkeys(("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"), np.float64)
_SIZE = dict.fromkeys(("length_m", "width_m", "height_m"), np.float64)
_DISTORTION = dict.fromkeys(("k1", "k2", "k3"), np.float64)

_COLUMNS: Mapping[str, Mapping[str, type[Any]]] = {
    POSES: {"timestamp_ns": np.int64, **_POSE},
    MOUNTS: {"sensor_name": str, **_POSE},
    CAMERA_MODELS: {
        "sensor_name": str,
        **dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px"), np.float64),
        **_DISTORTION,
        **dict.fromkeys(("height_px", "width_px"), np.int64),
    },
    ANNOTATIONS: {
        "timestamp_ns": np.int64,
        "track_uuid": str,
        "category": str,
        **_SIZE,
        **_POSE,
        "num_interior_pts": np.int64,
    },
    LIDAR: {**dict.fromkeys("xyz", np.float32), "intensity": np.uint8, "laser_number": np.uint8, "offset_ns": np.int32},
}
"""The columns that are read of each table, and what their values become; `str` for texts."""

_UP, _DOWN, _BOTH = "up_lidar", "down_lidar", "lidar"
_LASERS = {_UP: range(32), _DOWN: range(32, 64), _BOTH: range(256)}
"""The lasers of each lidar. That the first half belongs to the upper one shows in the data: seen from its own lidar,
and not from the other, every laser keeps its elevation."""

_CUBOID_ANGLES = MappingProxyType({"euler_unit": "degrees", "euler_order": "xyz"})


@dataclass(frozen=True, slots=True, eq=False)
class _Log:
    """A log that is being read."""

    folder: Path
    ledger: Ledger
    world_from_ego: Poses | None  # in the city frame; None in a lenient reading of a log without poses
    ego_from_sensor: Mapping[str, RigidTransform]  # by the sensor's name; none in a lenient reading without them

    def mount(self, sensor: str) -> RigidTransform | None:
        """Extrinsics of a sensor; None in a lenient reading without them."""
        if sensor not in self.ego_from_sensor:
            problem = f"no sensor {sensor!r}; it has {', '.join(self.ego_from_sensor) or 'none'}"
            self.ledger.fault("mountings-missing", DataError(self.folder / MOUNTS, "", problem))
        return self.ego_from_sensor.get(sensor)

    def poses(self, mount: RigidTransform | None, timestamps_ns: Int64Array) -> Poses | None:
        """Poses of a sensor along the trajectory."""
        if mount is None:
            return None
        return poses_along(self.world_from_ego, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)


def open_argoverse2(
    path: Path,
    *,
    sequence: str | None = None,
    one_lidar: bool | str = False,
    distorted: bool | str = False,
    lenient: bool = False,
) -> Scene:
    """Open a log; images and points are read when asked for, boxes and poses at once.

    Args:
        path: the folder of a log, or one of several logs.
        sequence: name of the log, where there are several.
        one_lidar: give the points of both lidars as those of one, `lidar`.
        distorted: use the coefficients of the camera models, for images that are not those of the data set.

    Raises:
        OptionError: there is no such log, none was chosen of several, or an option is neither true nor false.
        MissingExtraError: pyarrow is not installed.
    """
    joined, with_distortion = as_flag("one_lidar", one_lidar), as_flag("distorted", distorted)
    folder = choose_drive(path, LOGS_IN(path), sequence, called="log", expected=f"{POSES}, calibration/ and sensors/")
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        log = _Log(folder, ledger, _read_poses(folder, ledger), _read_mounts(folder, ledger))
        sensors: tuple[Sensor, ...] = (
            *_read_lidars(log, joined=joined),
            *_read_cameras(log, distorted=with_distortion),
        )
        cuboids = _read_cuboids(log)
        if (folder / "map").is_dir():
            ledger.note(WarningKind.SKIPPED, "maps-left-out", str(folder / "map"), "maps are left out")
    ego = log.world_from_ego
    trajectories = {}
    if ego is not None:
        trajectories["pose"] = Trajectory("pose", ego.timestamps_ns, ego.positions, ego.quaternions_xyzw)
    return Scene(
        sensors=sensors,
        annotations=cuboids,
        trajectories=MappingProxyType(trajectories),
        metadata=MappingProxyType({"argoverse2": {"log": folder.name}, "sceneloom": dict(_CUBOID_ANGLES)}),
        source=str(folder),
        format="argoverse2",
        warnings=ledger.warnings,
    )


def _read_poses(folder: Path, ledger: Ledger) -> Poses | None:
    """The trajectory of the ego, `world_from_ego`; None in a lenient reading of a log without it."""
    file = folder / POSES
    if not file.is_file():
        ledger.fault("poses-missing", DataError(file, "", "is not there; expected the poses of the ego"))
        return None
    columns = read_columns(file, _COLUMNS[POSES])
    positions, quaternions = _pose_columns(file, columns)
    if not len(positions):
        raise DataError(file, "", "no row; expected one pose at least")
    timestamps_ns, first = np.unique(columns["timestamp_ns"], return_index=True)
    repeated = len(positions) - len(timestamps_ns)
    if repeated:
        message = "further poses of a time that has one already are left out"
        ledger.note(WarningKind.SKIPPED, "poses-repeated", str(file), message, count=repeated)
    return Poses(timestamps_ns, positions[first], quaternions[first])


def _read_mounts(folder: Path, ledger: Ledger) -> dict[str, RigidTransform]:
    """`ego_from_sensor` by the sensor's name; {} in a lenient reading without them."""
    file = folder / MOUNTS
    try:
        columns = read_columns(file, _COLUMNS[MOUNTS])
        positions, quaternions = _pose_columns(file, columns)
    except DataError as error:
        ledger.fault("mountings-missing", error)
        return {}
    poses = map(RigidTransform.from_quaternion, positions, quaternions)
    return dict(zip(columns["sensor_name"].tolist(), poses, strict=True))


# Lidars: the points of both are in one file.


def _read_lidars(log: _Log, *, joined: bool) -> list[LidarSensor]:
    """The upper and the lower lidar, or one that stands for both; no points are read."""
    folder = log.folder / LIDAR
    files, timestamps_ns = _timestamped_files(folder, ".feather")
    if not files:
        raise DataError(folder, "", "no sweep; expected files such as 315966265259836000.feather")
    if joined:
        message = "points of two lidars are given as those of one, mounted where the upper one is"
        log.ledger.note(WarningKind.ASSUMED, "lidars-joined", str(folder), message)
    sensors = []
    for name in (_BOTH,) if joined else (_UP, _DOWN):
        mount = log.mount(_UP if name == _BOTH else name)
        sensors.append(
            LidarSensor(
                id=name,
                frames=LazyFrames(timestamps_ns, partial(_read_sweep, files, timestamps_ns, _LASERS[name])),
                poses=log.poses(mount, timestamps_ns),
                mount=mount,
                points_frame=PointsFrame.EGO,
            )
        )
    return sensors


def _read_sweep(files: tuple[Path, ...], timestamps_ns: Int64Array, lasers: range, k: int) -> LidarFrame:
    """Points of one lidar in sweep `k`, motion-compensated to its timestamp; `offset_ns` from it stays in `extras`."""
    columns = read_columns(files[k], _COLUMNS[LIDAR])
    numbers = columns["laser_number"]
    chosen = (numbers >= lasers.start) & (numbers < lasers.stop)
    own: dict[str, AnyArray] = {name: column[chosen] for name, column in columns.items()}
    timestamp_ns = int(timestamps_ns[k])
    points = LidarPoints(
        positions=read_only(np.stack([own[axis] for axis in "xyz"], axis=1)),
        intensities=read_only(own["intensity"]),
        timestamps_ns=read_only(np.full(len(own["x"]), timestamp_ns, np.int64)),
        rings=read_only(own["laser_number"], np.uint16),
        extras=MappingProxyType({"offset_ns": read_only(own["offset_ns"])}),
    )
    return LidarFrame(timestamp_ns, points, MappingProxyType({"file": f"{LIDAR}/{files[k].name}"}))


# Cameras


def _read_cameras(log: _Log, *, distorted: bool) -> list[CameraSensor]:
    """Cameras that have a model; `distorted`: with its coefficients, though images of the data set are undistorted."""
    file, folder, ledger = log.folder / CAMERA_MODELS, log.folder / CAMERAS, log.ledger
    with_images = sorted(child.name for child in folder.glob("*") if child.is_dir())
    if not file.is_file():
        if with_images:
            problem = f"is not there; expected the camera models of {', '.join(with_images)}"
            ledger.fault("camera-models-missing", DataError(file, "", problem), count=len(with_images))
        return []
    try:
        columns = read_columns(file, _COLUMNS[CAMERA_MODELS])
    except DataError as error:
        ledger.fault("camera-models-missing", error, count=len(with_images))
        return []
    names = columns["sensor_name"].tolist()
    unknown = sorted(set(with_images) - set(names))
    if unknown:
        problem = f"no camera {unknown[0]!r}; it has {', '.join(names) or 'none'}"
        ledger.fault("camera-models-missing", DataError(file, "", problem), count=len(unknown))
    without = [name for name in names if name not in with_images]
    if without:
        message = f"no images of {', '.join(without)}; only camera model and mounting are known"
        ledger.note(WarningKind.SKIPPED, "images-missing", str(folder), message, count=len(without))
    if not distorted:
        message = "images of this data set are undistorted: k1, k2 and k3 are in the cameras' extras and not used"
        ledger.note(WarningKind.ASSUMED, "undistorted", str(file), message, count=len(names))
    rows = ({key: column[k] for key, column in columns.items()} for k in range(len(names)))
    return [_camera(log, row, distorted=distorted) for row in rows]


def _camera(log: _Log, row: Mapping[str, Any], *, distorted: bool) -> CameraSensor:
    name = str(row["sensor_name"])
    mount = log.mount(name)
    width, height = int(row["width_px"]), int(row["height_px"])
    fx, fy, cx, cy = (float(row[f"{key}_px"]) for key in ("fx", "fy", "cx", "cy"))
    distortion = {key: float(row[key]) for key in _DISTORTION}
    model, coefficients = "pinhole", tuple[float, ...]()
    if distorted:
        model = "brown_conrady"
        coefficients = tuple(distortion.get(key, 0.0) for key in MODELS[model].coefficient_names)
    try:
        camera = Camera(model, width, height, fx, fy, cx, cy, coefficients)
    except CalibrationError as error:
        raise DataError(log.folder / CAMERA_MODELS, name, str(error)) from error
    files, timestamps_ns = _timestamped_files(log.folder / CAMERAS / name, ".jpg")
    names = tuple(f"{CAMERAS}/{name}/{file.name}" for file in files)
    return CameraSensor(
        id=name,
        camera=camera,
        images=LazyFrames(timestamps_ns, ImageReader(files, names, timestamps_ns, camera)),
        poses=log.poses(mount, timestamps_ns) if files else None,
        mount=mount,
        extras=MappingProxyType(distortion),
    )


# Annotations


def _read_cuboids(log: _Log) -> tuple[CuboidAnnotation, ...]:
    """A cuboid for each track, in the order in which they come up, moved from the ego frame into the world."""
    file = log.folder / ANNOTATIONS
    if not file.is_file():
        return ()
    columns = read_columns(file, _COLUMNS[ANNOTATIONS])
    values, known = _cuboid_values(log, file, columns)
    if not known.all():
        k = int(np.argmin(known))
        problem = f"row {k} is at {columns['timestamp_ns'][k]} ns; expected a time of which the ego's pose is known"
        error = DataError(file, "timestamp_ns", problem)
        log.ledger.fault("boxes-without-pose", error, count=int((~known).sum()))
    rows_of: dict[str, list[int]] = {}
    for row in np.flatnonzero(known).tolist():
        rows_of.setdefault(columns["track_uuid"][row], []).append(row)
    return tuple(_cuboid(file, track, rows, columns, values) for track, rows in rows_of.items())


def _cuboid_values(log: _Log, file: Path, columns: Columns) -> tuple[Float64Array, BoolArray]:
    """Rows `dx dy dz px py pz roll pitch yaw` in the world [m, deg], and which of them have a pose of the ego."""
    sizes = np.stack([columns[name] for name in _SIZE], axis=1)
    wrong = (sizes <= 0).any(axis=1)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(file, f"row {k}: {', '.join(_SIZE)}", f"{sizes[k].tolist()}; expected sizes above 0")
    if log.world_from_ego is None:
        raise DataError(file, "", "boxes are in the ego's frame, whose trajectory is not known")
    positions_ego, quaternions_ego = _pose_columns(file, columns)
    ego = log.world_from_ego.interpolate(columns["timestamp_ns"])
    known = ego.coverage == 0
    rotations = ego.quaternions_xyzw[known]
    values = np.full((len(sizes), 9), np.nan)
    values[:, :3] = sizes
    values[known, 3:6] = rotate_vectors(rotations, positions_ego[known]) + ego.positions[known]
    values[known, 6:] = CuboidAngles().from_quaternions(multiply_quaternions(rotations, quaternions_ego[known]))
    return values, known


def _cuboid(file: Path, track: str, rows: list[int], columns: Columns, values: Float64Array) -> CuboidAnnotation:
    order = np.array(rows)[np.argsort(columns["timestamp_ns"][rows], kind="stable")]
    timestamps_ns: Int64Array = columns["timestamp_ns"][order]
    repeated = np.flatnonzero(timestamps_ns[1:] == timestamps_ns[:-1])
    if len(repeated):
        problem = f"track {track!r} has two boxes at {timestamps_ns[repeated[0]]} ns; expected one"
        raise DataError(file, f"row {order[int(repeated[0]) + 1]}", problem)
    categories = columns["category"][order].tolist()
    counts = columns["num_interior_pts"][order].tolist()
    attributes = [AttributePath("num_interior_pts", tuple(counts), timestamps_ns)]
    if len(set(categories)) > 1:
        attributes.append(AttributePath("category", tuple(categories), timestamps_ns))
    return CuboidAnnotation(
        id=track, path=CuboidPath(timestamps_ns, values[order]), label=categories[0], attributes=tuple(attributes)
    )


# Files


def _timestamped_files(folder: Path, suffix: str) -> tuple[tuple[Path, ...], Int64Array]:
    """The files of a folder that are named after their timestamp, and these timestamps (N,) [ns], ascending."""
    found = []
    for file in folder.glob(f"*{suffix}"):
        if not (file.stem.isascii() and file.stem.isdigit() and len(file.stem) < 20 and int(file.stem) < 1 << 63):
            problem = f"expected files named after their time in nanoseconds, as 315966265259836000{suffix}"
            raise DataError(file, "", problem)
        found.append((int(file.stem), file))
    found.sort()
    return tuple(file for _, file in found), np.array([timestamp for timestamp, _ in found], np.int64)


def read_columns(path: Path, kinds: Mapping[str, type[Any]]) -> dict[str, AnyArray]:
    """Read columns of a feather file; those that are not asked for are passed over.

    Returns:
        (N,) arrays by name; texts as objects.

    Raises:
        DataError: the file is missing or no feather file, or a column is missing, of another kind, or has gaps.
        MissingExtraError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        from pyarrow import feather
    except ImportError as error:
        raise MissingExtraError(f"feather files need pyarrow: install it with {how_to_install('argoverse')}") from error
    if not path.exists():
        raise DataError(path, "", "is not there; expected a feather file")
    try:
        with file_faults(path):
            _check_unpacked(path)
        table = feather.read_table(os.fspath(path), memory_map=False)
        # without it a damaged file would be read beyond its end
        table.validate(full=True)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise DataError(path, "", f"is no whole feather file: {error}") from error
    missing = [name for name in kinds if name not in table.column_names]
    if missing:
        problem = f"no column {', '.join(missing)}; it has {', '.join(table.column_names) or 'none'}"
        raise DataError(path, "", problem)
    return {name: _column(path, table[name], name, kind) for name, kind in kinds.items()}


def _check_unpacked(path: Path) -> None:
    """Refuse a file whose compressed columns declare to become far more than its bytes."""
    # Source: Apache Arrow, columnar format, "Serialization and Interprocess Communication": messages follow eight bytes
    # at the beginning; a compressed buffer begins with its own length, int64, -1 for what is not compressed.
    import pyarrow as pa

    size, declared = check_length(path), 0
    with open_file(path) as file:
        file.seek(_MAGIC)
        # what is no message is left to the reader of the whole file, which says so
        with suppress(pa.ArrowException, StopIteration, OSError, struct.error, IndexError):
            messages = pa.ipc.MessageReader.open_stream(pa.PythonFile(file, mode="r"))
            while True:
                message = messages.read_next_message()
                body = memoryview(message.body or b"")
                for start, length in _buffers(memoryview(message.metadata)):
                    if length >= _LENGTH.size:
                        declared += max(*_LENGTH.unpack_from(body, start), length)
                        check_unpacked(path, "", size, declared)


_MAGIC, _LENGTH = 8, struct.Struct("<q")
_RECORD_BATCH, _DICTIONARY = 3, 2


def _buffers(head: memoryview) -> Iterator[tuple[int, int]]:
    """Where the compressed buffers of a message lie in its body: byte and length; nothing of other messages."""
    # Source: Apache Arrow, Message.fbs; FlatBuffers internals: a table begins with the distance back to its vtable: its
    # own size, the table's, and where each field is, 0 for one that is not there.

    def pointed(at: int) -> int:
        return at + int(struct.unpack_from("<I", head, at)[0])

    def field(table: int, number: int) -> int | None:
        vtable = table - struct.unpack_from("<i", head, table)[0]
        location = 4 + 2 * number
        if vtable < 0 or location >= struct.unpack_from("<H", head, vtable)[0]:
            return None
        offset = int(struct.unpack_from("<H", head, vtable + location)[0])
        return table + offset if offset else None

    root = pointed(0)
    kind, header = field(root, 1), field(root, 2)
    if kind is None or header is None or head[kind] not in {_RECORD_BATCH, _DICTIONARY}:
        return
    batch = pointed(header)
    if head[kind] == _DICTIONARY:
        data = field(batch, 1)
        if data is None:
            return
        batch = pointed(data)
    buffers, compression = field(batch, 2), field(batch, 3)
    if buffers is None or compression is None:
        return
    rows = pointed(buffers)
    for k in range(struct.unpack_from("<I", head, rows)[0]):
        start, length = struct.unpack_from("<qq", head, rows + 4 + 16 * k)
        if start < 0:
            return
        yield start, length


def _column(path: Path, column: Any, name: str, kind: type[Any]) -> AnyArray:
    if column.null_count:
        raise DataError(path, name, f"{column.null_count} values are missing; expected one in each row")
    values: AnyArray = column.to_numpy()
    fits = values.dtype.kind == "O" if kind is str else values.dtype.kind in _KINDS[np.dtype(kind).kind]
    if not fits:
        raise DataError(path, name, f"values of type {column.type}; expected {kind.__name__}")
    if kind is str:
        return values
    if np.dtype(kind).kind == "f" and not np.isfinite(values).all():
        raise DataError(path, name, f"row {int(np.argmin(np.isfinite(values)))} is not finite")
    return values.astype(kind)


_KINDS = {"f": "fiu", "i": "iu", "u": "iu"}
"""Kinds of columns that can be taken as floating point numbers, integers, and integers from 0 on."""


def _pose_columns(path: Path, columns: Columns) -> tuple[Float64Array, Float64Array]:
    """Positions (N, 3) [m] and unit quaternions (N, 4), scalar last, of the columns of poses."""
    positions = np.stack([columns[f"t{axis}_m"] for axis in "xyz"], axis=1)
    quaternions = np.stack([columns[f"q{axis}"] for axis in "xyzw"], axis=1)
    norms, is_off = lengths_of(quaternions)
    wrong = np.flatnonzero(is_off)
    if len(wrong):
        k = int(wrong[0])
        problem = f"{quaternions[k].tolist()} has the length {norms[k]:.4f}; expected 1"
        raise DataError(path, f"row {k}: qx, qy, qz, qw", problem)
    return positions, normalise_quaternion(quaternions) if len(quaternions) else quaternions
