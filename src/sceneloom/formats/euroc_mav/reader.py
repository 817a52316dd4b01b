"""Read a drive in the EuRoC layout: cameras, IMUs, ground truth and a map."""

import os
import re
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.images import ImageReader, images_image_size
from sceneloom.formats.base.poses import default_poses
from sceneloom.formats.base.text_tables import Table, read_table
from sceneloom.formats.euroc_mav.spec import DESCRIPTION, TABLE, mav_folder
from sceneloom.formats.points.files import read_cloud
from sceneloom.formats.points.mapping import PointMapping, SweepClock, points_of
from sceneloom.formats.trajectories.text_formats import EUROC
from sceneloom.formats.trajectories.trajectory_file import Reading
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, rotate_vectors
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import PointsSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import ImuSensor, VectorSamples
from sceneloom.scene.poses import Poses, PoseSource, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.warnings import WarningKind

_ENTRY = re.compile(r"(?P<indent> *)(?P<key>[^\s:#][^:#]*):(?P<value>.*)")
_GREATEST_ERROR = 0.01

_MODELS = {
    ("radial-tangential", 4): "brown_conrady",
    ("radial-tangential", 5): "brown_conrady",
    ("radtan", 4): "brown_conrady",
    ("equidistant", 4): "fisheye",
    ("none", 0): "pinhole",
}
"""Our models by the distortion model and the count of its coefficients."""


def _read_sensor_yaml(path: Path) -> dict[str, Any]:
    """Read keys with texts, numbers, lists of them in brackets, and one level of keys below."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(path, f"byte {error.start}", "is no UTF-8 text") from error
    found: dict[str, Any] = {}
    above: dict[str, Any] = found
    for number, line in _lines(text):
        match = _ENTRY.fullmatch(line)
        if match is None:
            raise DataError(path, f"line {number}", f"{line.strip()[:60]!r}; expected `key: value`")
        value = match["value"].strip()
        target = above if match["indent"] else found
        if value:
            target[match["key"].strip()] = _value(value)
        else:
            above = found.setdefault(match["key"].strip(), {})
            if not isinstance(above, dict):
                raise DataError(path, f"line {number}", f"{match['key'].strip()!r} stands there twice")
    return found


def _lines(text: str) -> list[tuple[int, str]]:
    """The lines without comments; lists that go over several lines are put into one."""
    found: list[tuple[int, str]] = []
    for number, raw in enumerate(text.replace("\r\n", "\n").split("\n"), 1):
        line = re.sub(r"(^|\s)#.*$", "", raw).rstrip()
        if not line.strip() or line.startswith(("%", "---")):
            continue
        if found and found[-1][1].count("[") > found[-1][1].count("]"):
            found[-1] = (found[-1][0], f"{found[-1][1]} {line.strip()}")
        else:
            found.append((number, line))
    return found


def _value(text: str) -> Any:
    if text.startswith("[") and text.endswith("]"):
        return [_scalar(part.strip()) for part in text[1:-1].split(",") if part.strip()]
    return _scalar(text)


def _scalar(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text.strip("\"'")


def _body_from_sensor(path: Path, description: dict[str, Any]) -> RigidTransform | None:
    """The location of a sensor on the body, `T_BS`; None where it is not stated."""
    reported = description.get("T_BS")
    if reported is None:
        return None
    data = reported.get("data") if isinstance(reported, dict) else reported
    try:
        transform, error = RigidTransform.nearest(np.array(data, np.float64).reshape(4, 4))
    except (SceneloomError, ValueError, TypeError) as fault:
        raise DataError(path, "T_BS", f"{fault}; expected 16 numbers by rows") from fault
    if not error <= _GREATEST_ERROR:
        raise DataError(path, "T_BS", f"its rotation is off by {error:.2g}; expected 0.01 at most")
    return transform


def _camera_model(path: Path, description: dict[str, Any], size: tuple[int, int]) -> Camera:
    """The camera model of a camera, for images of a size: pixels are counted from the centre of the first one."""
    intrinsics = _numbers(path, description, "intrinsics")
    if description.get("camera_model", "pinhole") != "pinhole" or len(intrinsics) != 4:
        problem = f"{description.get('camera_model')!r} with {len(intrinsics)} numbers; expected pinhole with 4"
        raise DataError(path, "camera_model, intrinsics", problem)
    coefficients = _numbers(path, description, "distortion_coefficients", [])
    kind = str(description.get("distortion_model", "none")).lower()
    model = "pinhole" if not coefficients else _MODELS.get((kind, len(coefficients)))
    if model is None:
        known = ", ".join(f"{name} with {count}" for name, count in _MODELS)
        problem = f"{kind!r} with {len(coefficients)} coefficients; expected one of {known}"
        raise DataError(path, "distortion_model", problem)
    stated = _numbers(path, description, "resolution", [*size])
    try:
        fx, fy, cx, cy = intrinsics
        camera = Camera(model, int(stated[0]), int(stated[1]), fx, fy, cx, cy, tuple(coefficients))
        return camera if (camera.width, camera.height) == size else camera.resized(*size)
    except (SceneloomError, IndexError, ValueError, OverflowError) as error:
        raise DataError(path, "intrinsics, resolution", str(error)) from error


def _numbers(path: Path, description: dict[str, Any], name: str, default: Any = None) -> list[float]:
    values = description.get(name, default)
    if not isinstance(values, list) or not all(isinstance(value, int | float) for value in values):
        raise DataError(path, name, f"{values!r}; expected a list of numbers")
    return [float(value) for value in values]


_TRAJECTORIES = {"state_groundtruth_estimate0": "groundTruth", "vicon0": "vicon0", "leica0": "leica0"}
"""Folders of trajectories, the best first, and what these are called."""

_MAP = "pointcloud0"

_IMU_COLUMNS = {"gyroscope": (1, 2, 3), "accelerometer": (4, 5, 6)}
"""Source: the header lines of the files: `w_RS_S` in rad/s, then `a_RS_S` in m/s²."""


def read_euroc(path: Path, *, lenient: bool = False) -> Scene:
    """Open a folder.

    Raises:
        DataError: files are missing or wrong.
    """
    folder, ledger = mav_folder(path), Ledger(lenient=lenient)
    if folder is None:
        raise DataError(path, "", f"has neither cam0/{TABLE} nor imu0/{TABLE}, in itself or in mav0/")
    with ledger.telling():
        trajectories = _trajectories(folder, ledger)
        poses = default_poses(trajectories, str(path), ledger)
        sensors: list[Sensor] = [_camera(one, poses, ledger) for one in _sensor_folders(folder, "cam")]
        sensors += [_imu(one, ledger) for one in _sensor_folders(folder, "imu")]
        sensors += _maps(folder, ledger)
        _note_others(folder, ledger)
    return Scene(
        tuple(sensors),
        trajectories=MappingProxyType(trajectories),
        source=str(path),
        format="euroc-mav",
        warnings=ledger.warnings,
    )


def _camera(folder: Path, world_from_body: Poses | None, ledger: Ledger) -> CameraSensor:
    location = folder / DESCRIPTION
    if not location.is_file():
        raise DataError(location, "", "missing; expected the description of the sensor")
    description = _read_sensor_yaml(location)
    table = read_table(folder / TABLE)
    times, rows = _ordered(table, ledger)
    if not len(rows):
        raise DataError(folder / TABLE, "", "names no images")
    names = tuple(_file_name(table, row) for row in rows)
    if ledger.lenient:
        times, names = _those_there(folder, times, names, ledger)
    files = tuple(folder / "data" / name for name in names)
    size = _size_of_first(files, ledger) if files else _reported_size(location, description)
    camera = _camera_model(location, description, size)
    mount = _body_from_sensor(location, description)
    poses = None
    if world_from_body is not None and mount is not None:
        path = world_from_body
        samples = PoseSource(path, mount).at(path.timestamps_ns)
        poses = Poses(path.timestamps_ns, samples.positions, samples.quaternions_xyzw)
    rate = description.get("rate_hz")
    return CameraSensor(
        folder.name,
        camera,
        LazyFrames(times, ImageReader(files, names, times, camera)),
        poses=poses,
        mount=mount,
        fps=float(rate) if isinstance(rate, int | float) and 0 < rate < 1e9 else None,
        extras=_comment(description),
    )


def _file_name(table: Table, row: int) -> str:
    """The name of an image's file, which stays in its folder."""
    name = table.rows[row][-1]
    if not name or name in {".", ".."} or "/" in name or "\\" in name:
        raise DataError(table.path, f"line {table.lines[row]}", f"{name[:60]!r}; expected the name of a file")
    return name


def _those_there(
    folder: Path, times: Int64Array, names: tuple[str, ...], ledger: Ledger
) -> tuple[Int64Array, tuple[str, ...]]:
    """Leave out the images whose files are not there, and count them."""
    rows = [row for row, name in enumerate(names) if os.path.isfile(folder / "data" / name)]  # noqa: PTH113 - of any length
    there = set(rows)
    missing = [name for row, name in enumerate(names) if row not in there]
    if missing:
        fault = DataError(folder / "data" / missing[0], "", "is not there; expected the image of a row")
        ledger.fault("files-missing", fault, count=len(missing))
    return read_only(times[rows]), tuple(names[row] for row in rows)


def _reported_size(location: Path, description: dict[str, Any]) -> tuple[int, int]:
    """Width and height of images of which none is there [px]."""
    reported = description.get("resolution")
    if isinstance(reported, list) and len(reported) == 2 and all(isinstance(one, int) and one > 0 for one in reported):
        return reported[0], reported[1]
    raise DataError(location, "resolution", f"{reported!r}, and no image is there; expected [width, height]")


def _size_of_first(files: tuple[Path, ...], ledger: Ledger) -> tuple[int, int]:
    """Width and height of the first image that can be read [px]; in a lenient reading those before it count."""
    for path in files[:-1]:
        try:
            return images_image_size(path)
        except DataError as error:
            ledger.fault("unreadable-files", error)
    return images_image_size(files[-1])


def _comment(description: dict[str, Any]) -> Any:
    return MappingProxyType({"comment": description["comment"]} if description.get("comment") else {})


def _ordered(table: Table, ledger: Ledger) -> tuple[Int64Array, list[int]]:
    """The times of a table in order, each once, and the rows that have them."""
    timestamps = table.timestamps(0, "nanoseconds")
    order = np.argsort(timestamps, kind="stable")
    if (order[1:] < order[:-1]).any():
        reported = "rows run backwards in time; sorted by time"
        ledger.note(WarningKind.REPAIRED, "rows-sorted", str(table.path), reported)
    times = timestamps[order]
    repeated = np.flatnonzero(np.diff(times) == 0) + 1
    if len(repeated):
        row = int(order[repeated[0]])
        problem = f"the time {times[repeated[0]]} stands there twice; expected each once"
        fault = DataError(table.path, f"line {table.lines[row]}", problem)
        ledger.fault("repeated-times", fault, count=len(repeated))
        order, times = np.delete(order, repeated), np.delete(times, repeated)
    return read_only(times), order.tolist()


def _imu(folder: Path, ledger: Ledger) -> ImuSensor:
    table = read_table(folder / TABLE)
    width = len(table.rows[0]) if table.rows else 7
    if width != 7:
        problem = f"{width} values; expected 7: timestamp, angular rates, accelerations"
        raise DataError(folder / TABLE, f"line {table.lines[0]}", problem)
    times, rows = _ordered(table, ledger)
    description = _read_sensor_yaml(folder / DESCRIPTION) if (folder / DESCRIPTION).is_file() else {}
    mount = _body_from_sensor(folder / DESCRIPTION, description) or RigidTransform.identity()
    if np.abs(mount.translation).max() > 0:
        reported = "it is not at the body's origin: what the lever arm adds to accelerations stays in them"
        ledger.note(WarningKind.ASSUMED, "imu-lever-arm", str(folder), reported)
    streams = {}
    for name, columns in _IMU_COLUMNS.items():
        values = mount.rotate(table.numbers(columns)[rows]) if len(rows) else np.zeros((0, 3))
        streams[name] = VectorSamples(times, read_only(values))
    noises = {name: value for name, value in description.items() if "noise" in name or "random_walk" in name}
    extras = {**_comment(description), **({"noises": noises} if noises else {})}
    return ImuSensor(folder.name, MappingProxyType(streams), extras=MappingProxyType(extras))


def _trajectories(folder: Path, ledger: Ledger) -> dict[str, Trajectory]:
    found: dict[str, Trajectory] = {}
    for name, called in _TRAJECTORIES.items():
        table = folder / name / TABLE
        if not table.is_file():
            continue
        content = EUROC.read(table, Reading(name=called), ledger)
        if content.columns:
            reported = f"velocities and biases beside the poses are not read: {', '.join(content.columns)}"
            ledger.note(WarningKind.SKIPPED, "states-not-read", str(table), reported)
        description = folder / name / DESCRIPTION
        mount = _body_from_sensor(description, _read_sensor_yaml(description)) if description.is_file() else None
        found[called] = _of_body(content.trajectory, mount, str(table), ledger)
    return found


def _of_body(trajectory: Trajectory, mount: RigidTransform | None, location: str, ledger: Ledger) -> Trajectory:
    """The trajectory of the body that carries what was measured, `world_from_body`."""
    if mount is None or np.array_equal(mount.matrix, np.eye(4)):
        return trajectory
    if trajectory.quaternions_xyzw is None:
        reported = f"positions are those of a marker at {np.round(mount.translation, 4).tolist()} m of the body"
        ledger.note(WarningKind.ASSUMED, "marker-positions", location, reported)
        return trajectory
    sensor_from_body = mount.inverse()
    positions = rotate_vectors(trajectory.quaternions_xyzw, sensor_from_body.translation) + trajectory.positions
    rotations = multiply_quaternions(trajectory.quaternions_xyzw, sensor_from_body.quaternion_xyzw)
    return replace(trajectory, positions=read_only(positions), quaternions_xyzw=read_only(rotations))


def _maps(folder: Path, ledger: Ledger) -> list[PointsSensor]:
    """The cloud that was scanned of the room, in the world of the ground truth."""
    path = folder / _MAP / "data.ply"
    if not path.is_file():
        return []
    try:
        read = points_of(read_cloud(path), PointMapping(), SweepClock(0, 0, 0))
    except DataError as error:
        ledger.fault("unreadable-files", error)
        return []
    return [PointsSensor(_MAP, read.points.positions, read.points.colors)]


def _note_others(folder: Path, ledger: Ledger) -> None:
    """Report of folders that are not read."""
    folders = [one for one in folder.iterdir() if one.is_dir() and not one.name.startswith(".")]
    sensors = [one for one in folders if one.name.startswith(("cam", "imu")) and (one / TABLE).is_file()]
    others = sorted({one.name for one in folders} - {one.name for one in sensors} - {*_TRAJECTORIES, _MAP})
    if others:
        reported = f"folders that are not known: {', '.join(others)}"
        ledger.note(WarningKind.SKIPPED, "folders-not-read", str(folder), reported, count=len(others))


def _sensor_folders(folder: Path, kind: str) -> list[Path]:
    """The folders of the sensors of a kind that have a table, in the order of their numbers."""
    numbers = {one: one.name.removeprefix(kind) for one in folder.glob(f"{kind}*") if (one / TABLE).is_file()}
    return sorted((one for one, number in numbers.items() if number.isdigit()), key=lambda one: int(numbers[one]))
