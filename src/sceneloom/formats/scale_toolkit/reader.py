"""Read a folder of Scale's lidar toolkit: clouds, images and poses that share frame names."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.images import IMAGE_SUFFIXES, ImageReader, images_image_size
from sceneloom.formats.base.json_files import read_json
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.spec import as_positive
from sceneloom.formats.points.cloud import find_roles
from sceneloom.formats.points.files import read_cloud
from sceneloom.formats.points.mapping import PointMapping, SweepReader, detect_scale
from sceneloom.formats.scale_toolkit.spec import CLOUDS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarFrame, RadarPoints, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, Trajectory, poses_along
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind

_UNITS = ((18, 20, 1, "nanoseconds"), (15, 18, 1_000, "microseconds"), (12, 15, 1_000_000, "milliseconds"))
"""From so many digits up to so many a name is a time since 1970 in a unit of so many nanoseconds."""

_SECOND = 1_000_000_000
_MOST_FRAMES = 10_000_000  # no drive has more frames than this
_INTRINSICS = ("fx", "fy", "cx", "cy")
_RADAR_COLUMNS = 7
_LARGEST = 1e9  # no position and no speed of a return is larger than this


def open_scale_toolkit(path: Path, *, rate_hz: float | str | None = None, lenient: bool = False) -> Scene:
    """Open a folder; images and points are read on demand.

    Args:
        path: with `pointcloud/`, `poses/` and `cameras/`.
        rate_hz: frames a second, where the names of the frames are no times; None: 10, which is reported.
        lenient: go without poses and cameras that are missing or wrong, and count them.

    Raises:
        OptionError: the rate is no number above 0.
    """
    rate = None if rate_hz is None else as_positive("rate_hz", rate_hz)
    if not path.is_dir():
        raise DataError(path, "", "no such folder; expected one with pointcloud/, poses/ and cameras/")
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        clouds = _frame_names(path / "pointcloud", CLOUDS)
        if not clouds:
            raise DataError(path / "pointcloud", "", "no cloud; expected files such as 1.ply or 1.pcd")
        timestamps_ns = _times_of(list(clouds), rate, path / "pointcloud", ledger)
        trajectory = _read_trajectory(path, list(clouds), timestamps_ns, ledger)
        poses = None if trajectory is None else trajectory.poses
        drive = _Drive(dict(zip(clouds, timestamps_ns.tolist(), strict=True)), poses, ledger)
        sensors: list[Sensor] = [_build_lidar(drive, tuple(clouds.values()), timestamps_ns)]
        sensors += _build_radar(drive, path / "radar_points")
        for folder in sorted(child for child in (path / "cameras").glob("*") if child.is_dir()):
            try:
                sensors.append(_build_camera(drive, folder))
            except DataError as error:
                ledger.fault("cameras", error)
    return Scene(
        sensors=tuple(sensors),
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        source=str(path),
        format="scale-toolkit",
        warnings=ledger.warnings,
    )


@dataclass(frozen=True, slots=True)
class _Drive:
    """What the sensors of a folder share: the time of each frame by its name [ns], and the ego trajectory."""

    times_ns: dict[str, int]
    trajectory: Poses | None
    ledger: Ledger

    def files(self, folder: Path, suffixes: Sequence[str], what: str) -> tuple[tuple[Path, ...], Int64Array]:
        """The files of a folder that are of frames with a cloud, and their times; others are counted."""
        found = _frame_names(folder, suffixes)
        kept = {name: file for name, file in found.items() if name in self.times_ns}
        if len(kept) < len(found):
            message, count = f"{what} of frames without a cloud are left out", len(found) - len(kept)
            self.ledger.note(WarningKind.SKIPPED, f"{what}-without-cloud", str(folder), message, count=count)
        return tuple(kept.values()), np.array([self.times_ns[name] for name in kept], np.int64)

    def poses(self, mount: RigidTransform, timestamps_ns: Int64Array) -> Poses | None:
        """`world_from_sensor` at times."""
        return poses_along(self.trajectory, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)


def _frame_names(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """The files of a folder by their names without ending: whole numbers in their order, else as texts."""
    found: dict[str, Path] = {}
    files = [file for file in folder.iterdir() if file.suffix.lower() in suffixes] if folder.is_dir() else []
    for file in sorted(files):
        if file.stem in found:
            raise DataError(file, "", f"{found[file.stem].name} is of the same frame; expected one of both")
        found[file.stem] = file
    return dict(sorted(found.items(), key=lambda item: (0, int(item[0])) if _is_number(item[0]) else (1, 0)))


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) < 20 and int(name) < 1 << 63


def _times_of(names: Sequence[str], rate_hz: float | None, location: Path, ledger: Ledger) -> Int64Array:
    """The times of frames [ns], by their names where these are times, else so many a second (10 by default)."""
    lengths, numbers = {len(name) for name in names}, all(map(_is_number, names))
    if numbers and rate_hz is None and len(lengths) == 1:
        for low, high, unit_ns, word in _UNITS:
            if low <= min(lengths) < high:
                ledger.note(WarningKind.ASSUMED, "names-are-times", str(location), f"names of frames are {word}")
                return _ascending(np.array([int(name) * unit_ns for name in names], np.int64), names, location)
    if rate_hz is None:
        message = "the folder has no times; 10 frames a second, from 0"
        ledger.note(WarningKind.ASSUMED, "nominal-times", str(location), message, count=len(names))
    counts = [int(name) - int(names[0]) for name in names] if numbers else range(len(names))
    if numbers and counts and counts[-1] > _MOST_FRAMES:
        raise DataError(location, names[-1], f"frame {names[-1]} after {names[0]}; expected numbers of frames")
    period_ns = round(_SECOND / (10.0 if rate_hz is None else rate_hz))
    return _ascending(np.array(counts, np.int64) * period_ns, names, location)


def _ascending(timestamps_ns: Int64Array, names: Sequence[str], location: Path) -> Int64Array:
    same = np.flatnonzero(timestamps_ns[1:] <= timestamps_ns[:-1])
    if len(same):
        k = int(same[0])
        raise DataError(location, names[k + 1], f"stands for the same time as {names[k]}; expected another")
    return timestamps_ns


def _read_trajectory(path: Path, names: list[str], timestamps_ns: Int64Array, ledger: Ledger) -> Trajectory | None:
    """The ego trajectory: a file for each cloud, world from ego."""
    known: dict[int, RigidTransform] = {}
    for row, name in enumerate(names):
        try:
            known[row] = _read_pose(path / "poses" / f"{name}.json")
        except DataError as error:
            ledger.fault("poses", error)
    if not known:
        return None
    positions = np.array([pose.translation for pose in known.values()])
    quaternions = np.array([pose.quaternion_xyzw for pose in known.values()])
    return Trajectory("pose", timestamps_ns[list(known)], positions, quaternions)


def _read_pose(path: Path) -> RigidTransform:
    """Read `heading` [w, x, y, z] and `position` [x, y, z]."""
    record = read_json(path, dict[str, Any])
    heading, position = (_numbers(path, record, name, count) for name, count in (("heading", 4), ("position", 3)))
    norms, is_off = lengths_of(heading[None])
    if is_off[0]:
        raise DataError(path, "heading", f"{heading.tolist()} has the length {norms[0]:.4f}; expected w, x, y, z of 1")
    return RigidTransform.from_quaternion(position, heading[[1, 2, 3, 0]])


def _numbers(path: Path, record: dict[str, Any], name: str, count: int) -> Float64Array:
    values = record.get(name)
    if not (isinstance(values, list) and len(values) == count and all(map(_is_real, values))):
        raise DataError(path, name, f"{values!r}; expected {count} numbers")
    return np.array(values, np.float64)


def _is_real(value: object) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool)


def _build_lidar(drive: _Drive, files: tuple[Path, ...], timestamps_ns: Int64Array) -> LidarSensor:
    """Build the lidar; its points are in the ego's frame. The first file is read, to see how bright it is."""
    columns = read_cloud(files[0]).columns
    name = find_roles(columns, {}).get("intensity")
    scale = None if name is None else detect_scale(columns[name])
    reader = SweepReader(
        files=files,
        names=tuple(f"{file.parent.name}/{file.name}" for file in files),
        clocks_ns=np.stack([timestamps_ns, timestamps_ns], axis=1),
        timestamps_ns=timestamps_ns,
        zero_ns=0,
        layout=None,
        mapping=PointMapping(scale=scale),
    )
    return LidarSensor(
        id="lidar",
        frames=LazyFrames(timestamps_ns, reader),
        poses=drive.poses(RigidTransform.identity(), timestamps_ns),
        mount=RigidTransform.identity(),
        points_frame=PointsFrame.EGO,
        extras=MappingProxyType({} if scale is None else {"intensity_max": scale.maximum}),
    )


def _build_camera(drive: _Drive, folder: Path) -> CameraSensor:
    """Build a camera; images of frames without a cloud are left out and reported."""
    files, timestamps_ns = drive.files(folder, IMAGE_SUFFIXES, "images")
    if not files:
        raise DataError(folder, "", "no image with the name of a cloud; expected such as pointcloud/ has")
    mount, path = _read_pose(folder / "extrinsics.json"), folder / "intrinsics.json"
    record = read_json(path, dict[str, Any])
    size, values = images_image_size(files[0]), [record.pop(name, None) for name in _INTRINSICS]
    if not all(map(_is_real, values)):
        raise DataError(path, "", f"fx, fy, cx, cy are {values}; expected numbers")
    fx, fy, cx, cy = (float(value) for value in values if value is not None)
    try:
        camera = Camera("pinhole", *size, fx, fy, cx, cy)
    except CalibrationError as error:
        raise DataError(path, "", str(error)) from error
    if record:
        message = f"{', '.join(record)}: kept in the camera's extras, and not used"
        drive.ledger.note(WarningKind.SKIPPED, "camera-model-entries", str(path), message)
    names = tuple(f"cameras/{folder.name}/{file.name}" for file in files)
    return CameraSensor(
        id=folder.name,
        camera=camera,
        images=LazyFrames(timestamps_ns, ImageReader(files, names, timestamps_ns, camera)),
        poses=drive.poses(mount, timestamps_ns),
        mount=mount,
        extras=MappingProxyType(record),
    )


def _build_radar(drive: _Drive, folder: Path) -> list[Sensor]:
    """Build the radar; [] where there are no points of one."""
    files, timestamps_ns = drive.files(folder, (".txt",), "radar-points")
    radar = RadarSensor(
        id="radar",
        frames=LazyFrames(timestamps_ns, _RadarReader(files, timestamps_ns)),
        poses=drive.poses(RigidTransform.identity(), timestamps_ns),
        mount=RigidTransform.identity(),
        points_frame=PointsFrame.EGO,
    )
    return [radar] if files else []


@dataclass(frozen=True, slots=True, eq=False)
class _RadarReader:
    """Reads the cycles of the radar, lines of position, direction and speed of each point."""

    files: tuple[Path, ...]
    timestamps_ns: Int64Array

    def __call__(self, k: int) -> RadarFrame:
        rows = _radar_rows(self.files[k])
        norms = np.linalg.norm(rows[:, 3:6], axis=1)
        directions = np.where(norms[:, None] > 0, rows[:, 3:6], [1.0, 0.0, 0.0])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = RadarPoints(
            read_only(rows[:, :3], np.float32),
            read_only(directions, np.float32),
            read_only(np.where(norms > 0, rows[:, 6], 0.0), np.float32),
            extras=MappingProxyType({"direction_as_given": read_only(rows[:, 3:6])}),
        )
        name = MappingProxyType({"file": f"radar_points/{self.files[k].name}"})
        return RadarFrame(int(self.timestamps_ns[k]), points, name)


def _radar_rows(path: Path) -> Float64Array:
    rows = []
    for number, line in enumerate(read_bytes(path).decode("latin-1").splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            row = []
        if len(row) != _RADAR_COLUMNS or not np.abs(row).max() <= _LARGEST:
            raise DataError(path, f"line {number}", f"{line[:60]!r}; expected x, y, z, direction x, y, z, size")
        rows.append(row)
    return np.array(rows, np.float64).reshape(-1, _RADAR_COLUMNS)
