"""Read a log of Argoverse 2: poses, two lidars in one file, cameras and cuboids, from feather tables."""

import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.errors import CalibrationError, DataError, MissingExtraError, how_to_install
from sceneloom.formats.argoverse2.spec import (
    ANNOTATIONS,
    CAMERA_MODELS,
    CAMERAS,
    LIDAR,
    MOUNTS,
    POSES,
    is_log,
)
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import check_length, check_unpacked, file_faults, open_file
from sceneloom.formats.base.images import ImageReader
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.spec import as_flag, choose_drive, drives_in
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.annotations import AttributePath, CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory, poses_along
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

Columns = Mapping[str, type[Any]]
"""Names of columns and what their values become; `str` for texts."""


def read_columns(path: Path, columns: Columns) -> dict[str, AnyArray]:
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
        raise MissingExtraError(
            f"feather files need pyarrow: install it with {how_to_install('argoverse')}"
        ) from error
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
    missing = [name for name in columns if name not in table.column_names]
    if missing:
        problem = f"no column {', '.join(missing)}; it has {', '.join(table.column_names) or 'none'}"
        raise DataError(path, "", problem)
    return {name: _column(path, table[name], name, kind) for name, kind in columns.items()}


def _check_unpacked(path: Path) -> None:
    """Refuse a file whose compressed columns declare to become far more than its bytes.

    Source: Apache Arrow, columnar format, "Serialization and Interprocess Communication": messages follow eight bytes
    at the beginning, and a compressed buffer begins with its own length, int64, -1 for what is not compressed.

    Raises:
        DataError: they do.
        OSError: it is no regular file, or cannot be opened.
    """
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
    """Where the compressed buffers of a message lie in its body: byte and length; nothing of other messages.

    Source: Apache Arrow, Message.fbs; FlatBuffers internals: a table begins with the distance back to its vtable, which
    holds its own size, the table's, and where each field is, 0 for one that is not there.
    """

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

POSE_COLUMNS: Columns = dict.fromkeys(("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"), np.float64)
"""The columns of a pose."""


def poses_of(path: Path, columns: Mapping[str, AnyArray]) -> tuple[Float64Array, Float64Array]:
    """Positions (N, 3) [m] and unit quaternions (N, 4), scalar last, of the columns of poses.

    Raises:
        DataError: a quaternion is far from length 1.
    """
    positions = np.stack([columns[f"t{axis}_m"] for axis in "xyz"], axis=1)
    quaternions = np.stack([columns[f"q{axis}"] for axis in "xyzw"], axis=1)
    norms, is_off = lengths_of(quaternions)
    wrong = np.flatnonzero(is_off)
    if len(wrong):
        k = int(wrong[0])
        problem = f"{quaternions[k].tolist()} has the length {norms[k]:.4f}; expected 1"
        raise DataError(path, f"row {k}: qx, qy, qz, qw", problem)
    return positions, normalise_quaternion(quaternions) if len(quaternions) else quaternions


_UP, _DOWN, _BOTH = "up_lidar", "down_lidar", "lidar"

_LASERS = {_UP: (0, 32), _DOWN: (32, 64), _BOTH: (0, 256)}
"""The numbers of the lasers of each lidar. That the first half is the upper one's shows in the data: seen from its
lidar, and not from the other, every laser keeps its elevation."""

_POINT_COLUMNS = {
    **dict.fromkeys("xyz", np.float32),
    "intensity": np.uint8,
    "laser_number": np.uint8,
    "offset_ns": np.int32,
}

_CAMERA_MODEL_COLUMNS = {
    "sensor_name": str,
    **dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3"), np.float64),
    **dict.fromkeys(("height_px", "width_px"), np.int64),
}


def _read_mounts(log: Path, ledger: Ledger) -> dict[str, RigidTransform]:
    """`ego_from_sensor` by the sensor's name; {} in a lenient reading without them.

    Raises:
        DataError: the file is missing or wrong.
    """
    path = log / MOUNTS
    try:
        columns = read_columns(path, {"sensor_name": str, **POSE_COLUMNS})
        positions, quaternions = poses_of(path, columns)
    except DataError as error:
        ledger.fault("mountings-missing", error)
        return {}
    return {
        name: RigidTransform.from_quaternion(positions[k], quaternions[k])
        for k, name in enumerate(columns["sensor_name"].tolist())
    }


@dataclass(frozen=True, slots=True, eq=False)
class SweepFiles:
    """Reads the sweeps of one lidar out of files that hold those of both.

    Points were moved to where the ego was at the timestamp, which therefore is the time of all of them; when each was
    measured stands in `extras` as `offset_ns` from the timestamp.

    Attributes:
        files: of each sweep.
        timestamps_ns: (N,) int64 [ns].
        sensor_id: whose points: `_UP`, `_DOWN` or `_BOTH`.
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array
    sensor_id: str

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing, cut off or has other columns.
        """
        columns = read_columns(self.files[k], _POINT_COLUMNS)
        low, high = _LASERS[self.sensor_id]
        chosen = (columns["laser_number"] >= low) & (columns["laser_number"] < high)
        own: dict[str, AnyArray] = {name: column[chosen] for name, column in columns.items()}
        timestamp_ns = int(self.timestamps_ns[k])
        points = LidarPoints(
            positions=read_only(np.stack([own[axis] for axis in "xyz"], axis=1)),
            intensities=read_only(own["intensity"]),
            timestamps_ns=read_only(np.full(int(chosen.sum()), timestamp_ns, np.int64)),
            rings=read_only(own["laser_number"], np.uint16),
            extras=MappingProxyType({"offset_ns": read_only(own["offset_ns"])}),
        )
        return LidarFrame(timestamp_ns, points, MappingProxyType({"file": f"{LIDAR}/{self.files[k].name}"}))


def _build_lidars(
    log: Path, mounts: Mapping[str, RigidTransform], path: Poses | None, *, one_lidar: bool, ledger: Ledger
) -> list[Sensor]:
    """Build the upper and the lower lidar, or one that stands for both.

    Raises:
        DataError: there is no sweep, or a mounting is missing.
    """
    found = _timestamped_files(log / LIDAR, ".feather")
    if not found:
        raise DataError(log / LIDAR, "", "no sweep; expected files such as 315966265259836000.feather")
    timestamps_ns = np.array([timestamp for timestamp, _ in found], np.int64)
    files = tuple(file for _, file in found)
    if one_lidar:
        message = "points of two lidars are given as those of one, mounted where the upper one is"
        ledger.note(WarningKind.ASSUMED, "lidars-joined", str(log / LIDAR), message)
    sensors: list[Sensor] = []
    for name in (_BOTH,) if one_lidar else (_UP, _DOWN):
        mount = _mount(log, mounts, _UP if one_lidar else name, ledger)
        sensors.append(
            LidarSensor(
                id=name,
                frames=LazyFrames(timestamps_ns, SweepFiles(files, timestamps_ns, name)),
                poses=_poses(path, mount, timestamps_ns),
                mount=mount,
                points_frame=PointsFrame.EGO,
            )
        )
    return sensors


def _mount(
    log: Path, mounts: Mapping[str, RigidTransform], name: str, ledger: Ledger
) -> RigidTransform | None:
    if name not in mounts:
        problem = f"no sensor {name!r}; it has {', '.join(mounts) or 'none'}"
        ledger.fault("mountings-missing", DataError(log / MOUNTS, "", problem))
    return mounts.get(name)


def _poses(path: Poses | None, mount: RigidTransform | None, timestamps_ns: Int64Array) -> Poses | None:
    if mount is None:
        return None
    return poses_along(path, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)


def _build_cameras(
    log: Path, mounts: Mapping[str, RigidTransform], path: Poses | None, *, distorted: bool, ledger: Ledger
) -> list[Sensor]:
    """Build the cameras that have a camera model, with their images as far as there are.

    () where no camera model is reported.

    Args:
        log: the folder.
        mounts: `ego_from_sensor`.
        path: `world_from_ego`.
        distorted: use the coefficients of the camera models, which the images, being undistorted, do not show any more.
        ledger: takes warnings.

    Raises:
        DataError: a file is wrong, or images have no camera model.
    """
    folders = sorted(child.name for child in (log / CAMERAS).glob("*") if child.is_dir())
    if not (log / CAMERA_MODELS).is_file():
        if folders:
            problem = f"is not there; expected the camera models of {', '.join(folders)}"
            ledger.fault(
                "camera-models-missing", DataError(log / CAMERA_MODELS, "", problem), count=len(folders)
            )
        return []
    try:
        columns = read_columns(log / CAMERA_MODELS, _CAMERA_MODEL_COLUMNS)
    except DataError as error:
        ledger.fault("camera-models-missing", error, count=len(folders))
        return []
    names = columns["sensor_name"].tolist()
    unknown = sorted(set(folders) - set(names))
    if unknown:
        problem = f"no camera {unknown[0]!r}; it has {', '.join(names) or 'none'}"
        ledger.fault("camera-models-missing", DataError(log / CAMERA_MODELS, "", problem), count=len(unknown))
    _note_cameras(log, names, folders, distorted=distorted, ledger=ledger)
    return [
        _camera(
            log,
            {key: column[k] for key, column in columns.items()},
            _mount(log, mounts, names[k], ledger),
            path,
            distorted=distorted,
        )
        for k in range(len(names))
    ]


def _note_cameras(
    log: Path, names: list[str], folders: list[str], *, distorted: bool, ledger: Ledger
) -> None:
    without = [name for name in names if name not in folders]
    if without:
        message = f"no images of {', '.join(without)}; only camera model and mounting are known"
        ledger.note(WarningKind.SKIPPED, "images-missing", str(log / CAMERAS), message, count=len(without))
    if not distorted:
        message = (
            "images of this data set are undistorted: k1, k2 and k3 are in the cameras' extras and not used"
        )
        ledger.note(WarningKind.ASSUMED, "undistorted", str(log / CAMERA_MODELS), message, count=len(names))


def _camera(
    log: Path,
    row: Mapping[str, Any],
    mount: RigidTransform | None,
    path: Poses | None,
    *,
    distorted: bool,
) -> CameraSensor:
    name = str(row["sensor_name"])
    fx, fy, cx, cy = (float(row[f"{key}_px"]) for key in ("fx", "fy", "cx", "cy"))
    size = int(row["width_px"]), int(row["height_px"])
    model = "brown_conrady" if distorted else "pinhole"
    try:
        camera_model = Camera(model, *size, fx, fy, cx, cy, _camera_model_numbers(row, distorted=distorted))
    except CalibrationError as error:
        raise DataError(log / CAMERA_MODELS, name, str(error)) from error
    found = _timestamped_files(log / CAMERAS / name, ".jpg")
    timestamps_ns = np.array([timestamp for timestamp, _ in found], np.int64)
    files = tuple(file for _, file in found)
    names = tuple(f"{CAMERAS}/{name}/{file.name}" for file in files)
    return CameraSensor(
        id=name,
        camera=camera_model,
        images=LazyFrames(timestamps_ns, ImageReader(files, names, timestamps_ns, camera_model)),
        poses=_poses(path, mount, timestamps_ns) if found else None,
        mount=mount,
        extras=MappingProxyType({name: float(row[name]) for name in ("k1", "k2", "k3")}),
    )


def _camera_model_numbers(row: Mapping[str, Any], *, distorted: bool) -> tuple[float, ...]:
    """Coefficients k1 k2 p1 p2 k3 … of `brown_conrady`, or none."""
    if not distorted:
        return ()
    known = {name: float(row[name]) for name in ("k1", "k2", "k3")}
    return tuple(known.get(name, 0.0) for name in MODELS["brown_conrady"].coefficient_names)


def _timestamped_files(folder: Path, suffix: str) -> list[tuple[int, Path]]:
    """The files of a folder that are named after their time [ns], in its order.

    Raises:
        DataError: one is named otherwise.
    """
    found = []
    for file in folder.glob(f"*{suffix}"):
        if not (
            file.stem.isascii() and file.stem.isdigit() and len(file.stem) < 20 and int(file.stem) < 1 << 63
        ):
            problem = f"expected files named after their time in nanoseconds, as 315966265259836000{suffix}"
            raise DataError(file, "", problem)
        found.append((int(file.stem), file))
    return sorted(found)


_SIZES = ("length_m", "width_m", "height_m")

_COLUMNS: Columns = {
    "timestamp_ns": np.int64,
    "track_uuid": str,
    "category": str,
    **dict.fromkeys(_SIZES, np.float64),
    **POSE_COLUMNS,
    "num_interior_pts": np.int64,
}


def _build_cuboids(log: Path, path: Poses | None, ledger: Ledger) -> tuple[CuboidAnnotation, ...]:
    """Build a cuboid for each track, in the order in which they come up; () where the log has no annotations.

    Args:
        log: the folder.
        path: `world_from_ego`.
        ledger: takes what a lenient reading leaves out.

    Raises:
        DataError: the file is wrong, or a box is at a time of which no pose is known.
    """
    file = log / ANNOTATIONS
    if not file.is_file():
        return ()
    columns = read_columns(file, _COLUMNS)
    sizes = np.stack([columns[name] for name in _SIZES], axis=1)
    _check_sizes(file, sizes)
    timestamps_ns = columns["timestamp_ns"]
    values, known = _values(file, sizes, poses_of(file, columns), timestamps_ns, path)
    if not known.all():
        k = int(np.argmin(known))
        problem = f"row {k} is at {timestamps_ns[k]} ns; expected a time of which the ego's pose is known"
        ledger.fault(
            "boxes-without-pose", DataError(file, "timestamp_ns", problem), count=int((~known).sum())
        )
    tracks: dict[str, list[int]] = {}
    for row in np.flatnonzero(known).tolist():
        tracks.setdefault(columns["track_uuid"][row], []).append(row)
    return tuple(_cuboid(file, name, rows, columns, values) for name, rows in tracks.items())


def _check_sizes(file: Path, sizes: Float64Array) -> None:
    wrong = (sizes <= 0).any(axis=1)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(file, f"row {k}: {', '.join(_SIZES)}", f"{sizes[k].tolist()}; expected sizes above 0")


def _values(
    file: Path,
    sizes: Float64Array,
    ego_from_box: tuple[Float64Array, Float64Array],
    timestamps_ns: Int64Array,
    path: Poses | None,
) -> tuple[Float64Array, BoolArray]:
    """Rows `dx dy dz px py pz roll pitch yaw` in the world, and which of them are known."""
    if path is None:
        raise DataError(file, "", "boxes are in the ego's frame, whose trajectory is not known")
    ego = path.interpolate(timestamps_ns)
    known = ego.coverage == 0
    positions, quaternions = ego_from_box
    values = np.full((len(sizes), 9), np.nan)
    values[:, :3] = sizes
    rotations = ego.quaternions_xyzw[known]
    values[known, 3:6] = rotate_vectors(rotations, positions[known]) + ego.positions[known]
    values[known, 6:] = CuboidAngles().from_quaternions(multiply_quaternions(rotations, quaternions[known]))
    return values, known


def _cuboid(
    file: Path, name: str, rows: Sequence[int], columns: dict[str, Any], values: Float64Array
) -> CuboidAnnotation:
    order = sorted(rows, key=lambda row: columns["timestamp_ns"][row])
    timestamps_ns = np.array(columns["timestamp_ns"][order], np.int64)
    repeated = np.flatnonzero(timestamps_ns[1:] == timestamps_ns[:-1])
    if len(repeated):
        problem = f"track {name!r} has two boxes at {timestamps_ns[repeated[0]]} ns; expected one"
        raise DataError(file, f"row {order[int(repeated[0]) + 1]}", problem)
    counts = tuple(columns["num_interior_pts"][order].tolist())
    labels = list(dict.fromkeys(columns["category"][order].tolist()))
    classes = (AttributePath("category", tuple(columns["category"][order].tolist()), timestamps_ns),)
    return CuboidAnnotation(
        id=name,
        path=CuboidPath(timestamps_ns, values[order]),
        label=labels[0],
        attributes=(
            AttributePath("num_interior_pts", counts, timestamps_ns),
            *(classes if len(labels) > 1 else ()),
        ),
    )


_TRAJECTORY = "pose"
"""The name of the ego trajectory."""

_ANGLES = MappingProxyType({"euler_unit": "degrees", "euler_order": "xyz"})


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
        lenient: leave out what is at fault and count it.

    Raises:
        DataError: a file is missing or wrong.
        OptionError: there is no such log, none was chosen of several, or an option is neither true nor false.
        MissingExtraError: pyarrow is not installed.
    """
    joined, bent = as_flag("one_lidar", one_lidar), as_flag("distorted", distorted)
    log = choose_drive(
        path,
        drives_in(path, is_log),
        sequence,
        called="log",
        expected=f"{POSES}, calibration/ and sensors/",
    )
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        trajectory = _trajectory(log, ledger)
        poses = None if trajectory is None else trajectory.poses
        mounts = _read_mounts(log, ledger)
        sensors = (
            *_build_lidars(log, mounts, poses, one_lidar=joined, ledger=ledger),
            *_build_cameras(log, mounts, poses, distorted=bent, ledger=ledger),
        )
        annotations = _build_cuboids(log, poses, ledger)
        if (log / "map").is_dir():
            ledger.note(WarningKind.SKIPPED, "maps-left-out", str(log / "map"), "maps are left out")
    return Scene(
        sensors=sensors,
        annotations=annotations,
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        metadata=MappingProxyType({"argoverse2": {"log": log.name}, "sceneloom": dict(_ANGLES)}),
        source=str(log),
        format="argoverse2",
        warnings=ledger.warnings,
    )


def _trajectory(log: Path, ledger: Ledger) -> Trajectory | None:
    """The ego trajectory in the city; None in a lenient reading of a log without it.

    Raises:
        DataError: the file is missing or wrong.
    """
    file = log / POSES
    if not file.is_file():
        ledger.fault("poses-missing", DataError(file, "", "is not there; expected the poses of the ego"))
        return None
    columns = read_columns(file, {"timestamp_ns": np.int64, **POSE_COLUMNS})
    timestamps_ns: Int64Array = columns["timestamp_ns"]
    if len(timestamps_ns) == 0:
        raise DataError(file, "", "no row; expected one pose at least")
    positions, quaternions = poses_of(file, columns)
    times_ns, first = np.unique(timestamps_ns, return_index=True)
    if len(times_ns) < len(timestamps_ns):
        message = "further poses of a time that has one already are left out"
        ledger.note(
            WarningKind.SKIPPED,
            "poses-repeated",
            str(file),
            message,
            count=len(timestamps_ns) - len(times_ns),
        )
    return Trajectory(_TRAJECTORY, times_ns, positions[first], quaternions[first])
