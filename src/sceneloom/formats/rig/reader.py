"""A folder with a `rig.toml` as a scene; IMU and GNSS receivers among its sensors."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import CalibrationError, DataError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.poses import default_poses
from sceneloom.formats.base.text_tables import TIME_COLUMNS, Table, pick_columns, read_table, shifted
from sceneloom.formats.rig.cameras import build_camera
from sceneloom.formats.rig.lidars import build_lidar, note_doubts
from sceneloom.formats.rig.manifest import Manifest, open_root, read_manifest
from sceneloom.formats.rig.schema import Faults, Record
from sceneloom.formats.rig.spec import MANIFEST, manifest_path
from sceneloom.formats.rig.transforms import (
    Drive,
    Edge,
    FrameTree,
    build_trajectory,
    own_frame,
    read_transform,
)
from sceneloom.formats.video.reader import VideoFile
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor, with_assumed_models
from sceneloom.warnings import WarningKind

_IMU_COLUMNS: Mapping[str, Sequence[str]] = {
    "time": TIME_COLUMNS,
    "ax": ("ax", "acc_x", "accel_x", "a_x", "accx", "linear_acceleration_x"),
    "ay": ("ay", "acc_y", "accel_y", "a_y", "accy", "linear_acceleration_y"),
    "az": ("az", "acc_z", "accel_z", "a_z", "accz", "linear_acceleration_z"),
    "gx": ("gx", "wx", "gyro_x", "gyr_x", "w_x", "angular_velocity_x", "omega_x"),
    "gy": ("gy", "wy", "gyro_y", "gyr_y", "w_y", "angular_velocity_y", "omega_y"),
    "gz": ("gz", "wz", "gyro_z", "gyr_z", "w_z", "angular_velocity_z", "omega_z"),
}

GNSS_COLUMNS: Mapping[str, Sequence[str]] = {
    "time": TIME_COLUMNS,
    "latitude": ("latitude", "lat", "latitude_deg"),
    "longitude": ("longitude", "lon", "lng", "long", "longitude_deg"),
    "altitude": ("altitude", "alt", "height", "altitude_m", "ellipsoidal_height"),
    "accuracy": ("accuracy", "horizontal_accuracy", "hacc", "accuracy_m"),
    "vertical_accuracy": ("vertical_accuracy", "vacc", "vertical_accuracy_m"),
}

_STREAMS = {"accelerometer": ("ax", "ay", "az"), "gyroscope": ("gx", "gy", "gz")}

_FACTORS = {"m/s2": 1.0, "g": 9.80665, "rad/s": 1.0, "deg/s": float(np.pi / 180.0)}
"""Source: the standard acceleration of the 3rd General Conference on Weights and Measures, 1901."""


def _build_imu(drive: Drive, record: Record, location: str) -> ImuSensor:
    """Read an IMU; its values are converted to the axes of the ego.

    Raises:
        DataError: the file is missing or wrong.
        CalibrationError: no transforms lead to its frame.
    """
    mount = drive.mount(record)
    table, columns = _open(drive, record, location, _IMU_COLUMNS)
    order, timestamps = _timestamps(drive, record, table, columns)
    units = {
        "accelerometer": record.get("accelerometer_unit", "m/s2"),
        "gyroscope": record.get("gyroscope_unit", "rad/s"),
    }
    streams = {}
    for stream, roles in _STREAMS.items():
        found = [columns[role] for role in roles if role in columns]
        if len(found) == 3:
            values = table.numbers(found)[order] * _FACTORS[units[stream]]
            streams[stream] = VectorSamples(timestamps, read_only(mount.rotate(values)))
    if not streams:
        problem = f"no columns ax ay az or gx gy gz among {', '.join(table.names)}; name them with `columns`"
        raise DataError(table.path, "line 1", problem)
    distance = float(np.linalg.norm(mount.translation))
    if distance > 0 and "accelerometer" in streams:
        message = (
            f"accelerations are converted to the ego's axes, but not carried over the {distance:.3g} m to it"
        )
        drive.ledger.note(WarningKind.ASSUMED, "imu-lever-arm", str(table.path), message)
    return ImuSensor(record["id"], MappingProxyType(streams))


def _build_gnss(drive: Drive, record: Record, location: str) -> GnssSensor:
    """Read a satellite receiver.

    Raises:
        DataError: the file is missing or wrong.
    """
    table, columns = _open(drive, record, location, GNSS_COLUMNS)
    missing = [role for role in ("latitude", "longitude", "altitude") if role not in columns]
    if missing:
        problem = (
            f"no column for {', '.join(missing)} among {', '.join(table.names)}; name them with `columns`"
        )
        raise DataError(table.path, "line 1", problem)
    order, timestamps = _timestamps(drive, record, table, columns)
    positions = table.numbers([columns[role] for role in ("latitude", "longitude", "altitude")])[order]
    _check_locations(table, positions, order)
    return GnssSensor(
        id=record["id"],
        timestamps_ns=timestamps,
        positions_lla=read_only(positions),
        accuracies=_optional(table, columns, "accuracy", order),
        vertical_accuracies=_optional(table, columns, "vertical_accuracy", order),
    )


def _open(
    drive: Drive, record: Record, location: str, wanted: Mapping[str, Sequence[str]]
) -> tuple[Table, dict[str, int]]:
    path: Path = drive.root(record, location).file(record["file"], f"{location}.file")
    table = read_table(path)
    named = record.get("columns", {})
    columns = pick_columns(table, wanted, named, f"{location}.columns", drive.manifest.path)
    if "time" not in columns:
        problem = f"no column of times among {', '.join(table.names)}; name it with `columns`"
        raise DataError(path, "line 1", problem)
    return table, columns


def _timestamps(
    drive: Drive, record: Record, table: Table, columns: Mapping[str, int]
) -> tuple[Int64Array, Int64Array]:
    """The rows in the order of time, and their times."""
    offset_ns = int(record.get("time_offset_s", 0))
    timestamps = shifted(table.timestamps(columns["time"], record.get("unit")), offset_ns, table.path, "")
    order = np.argsort(timestamps, kind="stable")
    back = int((timestamps[1:] < timestamps[:-1]).sum())
    if back:
        message = "times run backwards; sorted by time"
        drive.ledger.note(WarningKind.REPAIRED, "samples-sorted", str(table.path), message, count=back)
    return order, read_only(timestamps[order])


def _optional(table: Table, columns: Mapping[str, int], role: str, order: Int64Array) -> Float64Array:
    if role not in columns:
        return read_only(np.full(len(table.rows), np.nan))
    return read_only(table.numbers([columns[role]])[order, 0])


def _check_locations(table: Table, positions: Float64Array, order: Int64Array) -> None:
    outside = (np.abs(positions[:, 0]) > 90) | (np.abs(positions[:, 1]) > 180)
    if outside.any():
        k = int(np.flatnonzero(outside)[0])
        problem = (
            f"latitude {positions[k, 0]}, longitude {positions[k, 1]}; expected degrees within ±90 and ±180"
        )
        raise DataError(table.path, f"line {table.lines[int(order[k])]}", problem)


_BUILDERS: Mapping[str, Callable[[Drive, Record, str], Sensor]] = MappingProxyType(
    {"lidar": build_lidar, "camera": build_camera, "imu": _build_imu, "gnss": _build_gnss}
)

_RESERVED_NAMES = {"gnss", "lidar", "identity"}
"""Names of trajectories that stand for ways which are computed."""


def open_rig(path: Path, *, lenient: bool = False, assume_model: bool = False) -> Scene:
    """Open a folder with a `rig.toml`, or a manifest itself; images and points are read when asked for.

    Args:
        path: the folder, or the manifest.
        lenient: leave out sensors and trajectories that are at fault, files without time and times without file.
        assume_model: allow computing with camera models whose formulas nothing confirms.

    Raises:
        DataError: the manifest, or what it names, is at fault; all faults are reported at once.
    """
    manifest = read_manifest(manifest_path(path))
    ledger = Ledger(lenient=lenient)
    try:
        with ledger.telling():
            scene = _scene_from_rig_open(manifest, ledger)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error}") from error
    return with_assumed_models(scene) if assume_model else scene


def _scene_from_rig_open(manifest: Manifest, ledger: Ledger) -> Scene:
    faults = manifest.faults()
    tree = _frame_tree(manifest, faults, ledger)
    trajectories = _trajectories(manifest, tree, faults, ledger)
    drive = Drive(manifest, tree, default_poses(trajectories, str(manifest.path), ledger), ledger)
    closing = CloseVideos(drive.videos)
    sensors: list[Sensor] = []
    try:
        for location, record in manifest.records("sensors"):
            with _judging(location, faults, ledger):
                sensors.append(_BUILDERS[record["type"]](drive, record, location))
        faults.raise_all()
    except BaseException:
        closing()
        raise
    _note_frames_and_roots(drive)
    note_doubts(manifest.path, sensors, trajectories, ledger)
    return Scene(
        sensors=tuple(sensors),
        trajectories=MappingProxyType(trajectories),
        metadata=MappingProxyType({"rig": _about(manifest, tree)}),
        source=str(manifest.path.parent if manifest.path.name == MANIFEST else manifest.path),
        format="rig",
        warnings=ledger.warnings,
        on_close=closing,
    )


@dataclass(frozen=True, slots=True)
class CloseVideos:
    """Closes the videos of a scene."""

    videos: list[VideoFile]

    def __call__(self) -> None:
        """Close them all."""
        for video in self.videos:
            video.close()


@contextmanager
def _judging(location: str, faults: Faults, ledger: Ledger) -> Iterator[None]:
    """Note what goes wrong with one part; a lenient reading leaves the part out."""
    if not ledger.lenient:
        with faults.catching(location):
            yield
        return
    try:
        yield
    except SceneloomError as error:
        where, problem = location, str(error)
        if isinstance(error, DataError) and error.file == str(faults.file) and error.location:
            where, problem = error.location, error.problem
        message = f"left out: {problem}"
        ledger.note(WarningKind.SKIPPED, "parts-at-fault", f"{faults.file}: {where}", message)


def _frame_tree(manifest: Manifest, faults: Faults, ledger: Ledger) -> FrameTree:
    """Read all transforms; without a sound tree nothing else can be judged.

    Raises:
        DataError: naming all transforms that are at fault.
    """
    edges = []
    tables = [
        (location, record, record["from"], record["to"])
        for location, record in manifest.records("transforms")
    ]
    for location, sensor in manifest.records("sensors"):
        if "extrinsic" not in sensor:
            continue
        where, record, frame = f"{location}.extrinsic", sensor["extrinsic"], own_frame(sensor)
        if ("to" in record) == ("from" in record):
            found = "to and from" if "to" in record else "neither to nor from"
            faults.add(where, f"{found}; expected `to`: the frame that points of {frame!r} are taken into")
            continue
        tables.append((where, record, record.get("from", frame), record.get("to", frame)))
    for location, record, source, target in tables:
        with faults.catching(location):
            where = f"{manifest.path}: {location}"
            edges.append(Edge(source, target, read_transform(record, where, ledger), location))
    faults.raise_all()
    try:
        return FrameTree(manifest.ego, edges)
    except CalibrationError as error:
        raise DataError(manifest.path, "", str(error)) from None


def _trajectories(
    manifest: Manifest, tree: FrameTree, faults: Faults, ledger: Ledger
) -> dict[str, Trajectory]:
    trajectories = {}
    for location, record in manifest.records("trajectories"):
        name = record.get("name", "pose")
        if name in _RESERVED_NAMES:
            faults.add(
                f"{location}.name",
                f"{name!r} stands for a trajectory that is computed; expected another name",
            )
        elif name in trajectories:
            faults.add(f"{location}.name", f"a second trajectory {name!r}; expected different names")
        else:
            with _judging(location, faults, ledger):
                trajectories[name] = build_trajectory(manifest, record, location, tree, ledger)
    return trajectories


def _note_frames_and_roots(drive: Drive) -> None:
    path = drive.manifest.path
    if drive.tree.loose:
        message = f"frames {', '.join(map(repr, drive.tree.loose))} are not connected with {drive.tree.ego!r}; not used"
        drive.ledger.note(WarningKind.SKIPPED, "loose-frames", str(path), message)
    records = [drive.manifest.record, *(record for _, record in drive.manifest.records("sensors"))]
    for name in dict.fromkeys(record["root"] for record in records if "root" in record):
        root = open_root(path, [name], "root").folder
        if not root.is_relative_to(path.parent.resolve()):
            message = f"files are read from {root}, outside the manifest's folder"
            drive.ledger.note(WarningKind.ASSUMED, "root-elsewhere", str(path), message)


def _about(manifest: Manifest, tree: FrameTree) -> dict[str, Any]:
    """What the manifest says that the model has no other location for: its name, and `ego_from_frame` of all frames."""
    frames = {
        name: [*tree.ego_from(name).translation.tolist(), *tree.ego_from(name).quaternion_xyzw.tolist()]
        for name in tree.frames
        if name not in tree.loose
    }
    about: dict[str, Any] = {"ego": manifest.ego, "ego_from_frame": frames}
    return {**about, "name": manifest.record["name"]} if "name" in manifest.record else about
