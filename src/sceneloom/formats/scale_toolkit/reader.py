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


def _frame_names(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """The files of a folder by their names without ending: whole numbers in their order, else as texts."""
    found: dict[str, Path] = {}
    files = [file for file in folder.iterdir() if file.suffix.lower() in suffixes] if folder.is_dir() else []
    for file in sorted(files):
        if file.stem in found:
            raise DataError(file, "", f"{found[file.stem].name} is of the same frame; expected one of both")
        found[file.stem] = file
    return {name: found[name] for name in sorted(found, key=_order)}


def _order(name: str) -> tuple[int, int, str]:
    return (0, int(name), name) if _is_number(name) else (1, 0, name)


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) < 20 and int(name) < 1 << 63


def _times_of(names: Sequence[str], rate_hz: float | None, location: Path, ledger: Ledger) -> Int64Array:
    """The times of frames [ns], by their names where these are times, else so many a second.

    Args:
        names: of the frames, in order.
        rate_hz: frames a second; None: 10, unless the names are times.
        location: the folder, for messages.
        ledger: takes what is assumed.
    """
    lengths = {len(name) for name in names}
    numbers = all(map(_is_number, names))
    if numbers and rate_hz is None and len(lengths) == 1:
        for low, high, unit_ns, word in _UNITS:
            if low <= min(lengths) < high:
                ledger.note(WarningKind.ASSUMED, "names-are-times", str(location), f"names of frames are {word}")
                return _ascending(np.array([int(name) * unit_ns for name in names], np.int64), names, location)
    period_ns = round(_SECOND / (10.0 if rate_hz is None else rate_hz))
    if rate_hz is None:
        message = "the folder has no times; 10 frames a second, from 0"
        ledger.note(WarningKind.ASSUMED, "nominal-times", str(location), message, count=len(names))
    counts = [int(name) - int(names[0]) for name in names] if numbers else range(len(names))
    if numbers and counts and counts[-1] > _LONGEST:
        raise DataError(location, names[-1], f"frame {names[-1]} after {names[0]}; expected numbers of frames")
    return _ascending(np.array(counts, np.int64) * period_ns, names, location)


_LONGEST = 10_000_000
"""No drive has more frames than this."""


def _ascending(timestamps_ns: Int64Array, names: Sequence[str], location: Path) -> Int64Array:
    same = np.flatnonzero(timestamps_ns[1:] <= timestamps_ns[:-1])
    if len(same):
        k = int(same[0])
        raise DataError(location, names[k + 1], f"stands for the same time as {names[k]}; expected another")
    return timestamps_ns


_CAMERA_MODEL = ("fx", "fy", "cx", "cy")
_RADAR_COLUMNS = 7

_LARGEST = 1e9
"""No location and no speed of a return is larger than this."""


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
    fits = isinstance(values, list) and len(values) == count
    if not (fits and all(isinstance(v, float | int) and not isinstance(v, bool) for v in values or ())):
        raise DataError(path, name, f"{values!r}; expected {count} numbers")
    return np.array(values, np.float64)


def _build_lidar(clouds: dict[str, Path], timestamps_ns: Int64Array, trajectory: Poses | None) -> LidarSensor:
    """Build the lidar; its points are in the ego's frame. The first file is read, to see how bright it is."""
    files = tuple(clouds.values())
    first = read_cloud(files[0])
    name = find_roles(first.columns, {}).get("intensity")
    scale = None if name is None else detect_scale(first.columns[name])
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
        poses=_placed(trajectory, RigidTransform.identity(), timestamps_ns),
        mount=RigidTransform.identity(),
        points_frame=PointsFrame.EGO,
        extras=MappingProxyType({} if scale is None else {"intensity_max": scale.maximum}),
    )


def _placed(trajectory: Poses | None, mount: RigidTransform, timestamps_ns: Int64Array) -> Poses | None:
    return poses_along(trajectory, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)


def _build_camera(folder: Path, times: dict[str, int], trajectory: Poses | None, ledger: Ledger) -> CameraSensor:
    """Build a camera; images of frames without a cloud are left out and reported."""
    found = _frame_names(folder, IMAGE_SUFFIXES)
    kept = {name: file for name, file in found.items() if name in times}
    _note_without(ledger, folder, "images", len(found) - len(kept))
    if not kept:
        raise DataError(folder, "", "no image with the name of a cloud; expected such as pointcloud/ has")
    files, timestamps_ns = tuple(kept.values()), np.array([times[name] for name in kept], np.int64)
    mount = _read_pose(folder / "extrinsics.json")
    record = read_json(folder / "intrinsics.json", dict[str, Any])
    camera = _camera_model(folder / "intrinsics.json", record, images_image_size(files[0]))
    further = {name: value for name, value in record.items() if name not in _CAMERA_MODEL}
    if further:
        message = f"{', '.join(further)}: kept in the camera's extras, and not used"
        ledger.note(WarningKind.SKIPPED, "camera-model-entries", str(folder / "intrinsics.json"), message)
    names = tuple(f"cameras/{folder.name}/{file.name}" for file in files)
    return CameraSensor(
        id=folder.name,
        camera=camera,
        images=LazyFrames(timestamps_ns, ImageReader(files, names, timestamps_ns, camera)),
        poses=_placed(trajectory, mount, timestamps_ns),
        mount=mount,
        extras=MappingProxyType(further),
    )


def _note_without(ledger: Ledger, folder: Path, what: str, count: int) -> None:
    if count:
        message = f"{what} of frames without a cloud are left out"
        ledger.note(WarningKind.SKIPPED, f"{what}-without-cloud", str(folder), message, count=count)


def _camera_model(path: Path, record: dict[str, Any], size: tuple[int, int]) -> Camera:
    values = [record.get(name) for name in _CAMERA_MODEL]
    if not all(isinstance(v, float | int) and not isinstance(v, bool) for v in values):
        raise DataError(path, "", f"fx, fy, cx, cy are {values}; expected numbers")
    fx, fy, cx, cy = (float(v) for v in values if v is not None)
    try:
        return Camera("pinhole", *size, fx, fy, cx, cy)
    except CalibrationError as error:
        raise DataError(path, "", str(error)) from error


@dataclass(frozen=True, slots=True, eq=False)
class CycleTexts:
    """Reads the cycles of the radar, which are lines of text.

    Attributes:
        files: of each cycle.
        timestamps_ns: (N,) int64 [ns].
    """

    files: tuple[Path, ...]
    timestamps_ns: Int64Array

    def __call__(self, k: int) -> RadarFrame:
        """Read cycle `k`: position, direction and size of each point.

        Raises:
            DataError: a line is no seven numbers.
        """
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


def _build_radar(folder: Path, times: dict[str, int], trajectory: Poses | None, ledger: Ledger) -> list[Sensor]:
    """Build the radar; [] where there are no points of one."""
    found = _frame_names(folder, (".txt",))
    kept = {name: file for name, file in found.items() if name in times}
    _note_without(ledger, folder, "radar-points", len(found) - len(kept))
    if not kept:
        return []
    timestamps_ns = np.array([times[name] for name in kept], np.int64)
    return [
        RadarSensor(
            id="radar",
            frames=LazyFrames(timestamps_ns, CycleTexts(tuple(kept.values()), timestamps_ns)),
            poses=_placed(trajectory, RigidTransform.identity(), timestamps_ns),
            mount=RigidTransform.identity(),
            points_frame=PointsFrame.EGO,
        )
    ]


_TRAJECTORY = "pose"


def open_scale_toolkit(path: Path, *, rate_hz: float | str | None = None, lenient: bool = False) -> Scene:
    """Open a folder; images and points are read when asked for.

    Args:
        path: with `pointcloud/`, `poses/` and `cameras/`.
        rate_hz: frames a second, where the names of the frames are no times; None: 10, which is reported.
        lenient: go without poses and cameras that are missing or wrong, and count them.

    Raises:
        DataError: a file is missing or wrong.
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
        trajectory = _trajectory(path, clouds, timestamps_ns, ledger)
        poses = None if trajectory is None else trajectory.poses
        times = dict(zip(clouds, timestamps_ns.tolist(), strict=True))
        sensors = [
            _build_lidar(clouds, timestamps_ns, poses),
            *_build_radar(path / "radar_points", times, poses, ledger),
        ]
        for folder in sorted(child for child in (path / "cameras").glob("*") if child.is_dir()):
            try:
                sensors.append(_build_camera(folder, times, poses, ledger))
            except DataError as error:
                ledger.fault("cameras", error)
    return Scene(
        sensors=tuple(sensors),
        trajectories=MappingProxyType({} if trajectory is None else {trajectory.name: trajectory}),
        source=str(path),
        format="scale-toolkit",
        warnings=ledger.warnings,
    )


def _trajectory(path: Path, clouds: dict[str, Path], timestamps_ns: Int64Array, ledger: Ledger) -> Trajectory | None:
    """The ego trajectory: a file for each cloud, world from ego."""
    known, rows = [], []
    for row, name in enumerate(clouds):
        try:
            known.append(_read_pose(path / "poses" / f"{name}.json"))
        except DataError as error:
            ledger.fault("poses", error)
        else:
            rows.append(row)
    if not known:
        return None
    return Trajectory(
        _TRAJECTORY,
        timestamps_ns[rows],
        np.array([pose.translation for pose in known]),
        np.array([pose.quaternion_xyzw for pose in known]),
    )
