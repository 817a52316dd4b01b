"""The lidars of a manifest: files of points, what their columns mean, the frame of the points.

And values that look like mistakes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Int64Array, read_only
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.points.cloud import ALIASES, ROW_ALIASES, Cloud, FieldLayout, find_roles, parse_layout
from sceneloom.formats.points.files import CLOUD_SUFFIXES, cloud_suffix, read_cloud
from sceneloom.formats.points.mapping import (
    IntensityScale,
    PointMapping,
    PointTimes,
    ReadPoints,
    SweepClock,
    detect_scale,
    points_of,
)
from sceneloom.formats.points.npz import default_layout
from sceneloom.formats.rig.manifest import Timestamps, drop_unreadable
from sceneloom.formats.rig.schema import Record
from sceneloom.formats.rig.transforms import Drive, own_frame
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Sensor, frame_times
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import WarningKind


@dataclass(frozen=True, slots=True, eq=False)
class SweepReader:
    """Reads the sweeps of one lidar, each when it is asked for.

    Attributes:
        files: of each sweep.
        names: of the files, seen from their root.
        clocks_ns: (N, 2) int64 [ns]: the file's timestamp and the sweep's start.
        timestamps_ns: (N,) int64 [ns], of the frames.
        zero_ns: what the sensor's own clock is ahead by [ns].
        layout: columns of files that do not state them.
        mapping: what the columns mean.
        rotation: takes points of the files into the frame that they are given in, None where they are in it.
        deskewed: whether the points are placed as at the timestamp, which then is the time of all of them.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    clocks_ns: Int64Array
    timestamps_ns: Int64Array
    zero_ns: int
    layout: FieldLayout | None
    mapping: PointMapping
    rotation: RigidTransform | None = None
    deskewed: bool = False

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing or wrong.
        """
        read = self.read(k)
        points = read.points if self.rotation is None else _rotated(read.points, self.rotation)
        if self.deskewed:
            times_ns = np.full(len(points), self.timestamps_ns[k], np.int64)
            points = replace(points, timestamps_ns=read_only(times_ns))
        extras: dict[str, Any] = {"file": self.names[k]}
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        extras.update({name: count for name, count in counts.items() if count})
        return LidarFrame(int(self.timestamps_ns[k]), points, MappingProxyType(extras))

    def read(self, k: int) -> ReadPoints:
        """Read the points of sweep `k` in the frame of the file."""
        timestamp_ns, start_ns = self.clocks_ns[k].tolist()
        return points_of(self.cloud(k), self.mapping, SweepClock(timestamp_ns, start_ns, self.zero_ns))

    def cloud(self, k: int) -> Cloud:
        """Read the columns of sweep `k`."""
        return read_cloud(self.files[k], layout=self.layout)


def _rotated(points: LidarPoints, rotation: RigidTransform) -> LidarPoints:
    return replace(points, positions=read_only(rotation.apply(points.positions), np.float32))


_LOOKED_AT = 10
"""Files that are looked through for one that is bright enough to report the scale of brightness."""

_ROLES = (*(role for role in ALIASES if role != "time"), *ROW_ALIASES)

_KNOWN_TIMES: dict[tuple[str, str], PointTimes] = {
    ("t", "u"): PointTimes("nanoseconds"),
    ("offset_time", "u"): PointTimes("nanoseconds"),
    ("offset_ns", "u"): PointTimes("nanoseconds"),
    ("offset_ns", "i"): PointTimes("nanoseconds"),
    ("time", "f"): PointTimes("seconds"),
    ("timestamp", "f"): PointTimes("seconds", "clock"),
}
"""What columns of point times mean that well-known drivers write, by name and kind of number.

Source: Ouster's and Livox' drivers for ROS (t, offset_time: uint32 nanoseconds from the timestamp), Velodyne's (time:
float32 seconds from the timestamp), Hesai's and RoboSense's (timestamp: float64 seconds of the clock); Argoverse 2
(offset_ns).
"""


def _choose_layout(drive: Drive, record: Record, location: str, first: Path) -> FieldLayout | None:
    """The columns that the manifest says, or those that files without a head are taken to have.

    Raises:
        DataError: the manifest's are none.
    """
    if "fields" in record:
        try:
            return parse_layout(record["fields"], default=record.get("dtype", "float32"))
        except OptionError as error:
            raise DataError(drive.manifest.path, f"{location}.fields", str(error)) from None
    if "dtype" in record:
        raise DataError(drive.manifest.path, f"{location}.dtype", "says nothing without `fields`")
    if cloud_suffix(first) != ".bin":
        return None
    layout = default_layout(first)
    message = f"`fields` not stated; the points are taken to be {layout}"
    drive.ledger.note(WarningKind.ASSUMED, "fields-assumed", f"{drive.manifest.path}: {location}", message)
    return layout


def _named_columns(drive: Drive, record: Record, location: str) -> Mapping[str, str]:
    """The columns that the manifest's `use` names, by role.

    Raises:
        DataError: a role is unknown.
    """
    named = record.get("use", {})
    for role in named:
        if role not in _ROLES:
            problem = (
                f"unknown; expected some of {', '.join(_ROLES)}; times of points go into point_times.field"
            )
            raise DataError(drive.manifest.path, f"{location}.use.{role}", problem)
    return MappingProxyType(named)


def _with_columns(drive: Drive, record: Record, location: str, reader: SweepReader) -> SweepReader:
    """Settle what brightness and times mean, looking at the first files where the manifest does not state it.

    Raises:
        DataError: the first file cannot be read, or its brightness fits no scale.
    """
    columns = reader.cloud(0).columns
    roles = find_roles(columns, reader.mapping.named)
    where = f"{drive.manifest.path}: {location}"
    scale = None
    if "intensity_max" in record:
        scale = IntensityScale(record["intensity_max"])
    elif roles.get("intensity") in columns:
        scale = _detected_scale(drive, location, _telling(reader, roles["intensity"]), roles["intensity"])
    times = _point_times(drive, record, where, columns, roles)
    settled = replace(reader, mapping=PointMapping(reader.mapping.named, scale, times))
    return (
        settled
        if times is None or "point_times" in record
        else _with_tried_times(drive, where, settled, times)
    )


def _telling(reader: SweepReader, name: str) -> Cloud:
    """The first of the first files that has any brightness in it, else the first of all."""
    first = reader.cloud(0)
    for k in range(min(len(reader.files), _LOOKED_AT)):
        cloud = first if k == 0 else reader.cloud(k)
        if name in cloud.columns and (cloud.columns[name] > 0).any():
            return cloud
    return first


def _with_tried_times(drive: Drive, where: str, reader: SweepReader, times: PointTimes) -> SweepReader:
    """Keep a guess at what the times of points mean only if the first sweep agrees with it."""
    try:
        reader.read(0)
    except DataError as error:
        if not error.location.startswith(f"{times.field}["):
            raise
        message = (
            f"column {times.field!r} looks like times of points, but {error.problem}; state "
            f"`point_times` to use it"
        )
        drive.ledger.note(WarningKind.SKIPPED, "point-times-not-used", where, message)
        return replace(reader, mapping=replace(reader.mapping, times=None))
    message = f"column {times.field!r} is taken for times of points: {times.unit} relative to the {times.relative_to}"
    drive.ledger.note(WarningKind.ASSUMED, "point-times-assumed", where, message)
    return reader


def _detected_scale(drive: Drive, location: str, cloud: Cloud, name: str) -> IntensityScale:
    scale = detect_scale(cloud.columns[name])
    if scale is None:
        problem = f"up to {cloud.columns[name].max()}; state what becomes 255 with {location}.intensity_max"
        raise DataError(cloud.file, name, problem)
    if cloud.columns[name].dtype != np.uint8:
        message = f"`intensity_max` not stated; {name} goes up to {cloud.columns[name].max():g}"
        message += f", so {scale.maximum:g} becomes 255" if len(cloud.columns[name]) else ""
        drive.ledger.note(
            WarningKind.ASSUMED, "intensity-scale", f"{drive.manifest.path}: {location}", message
        )
    return scale


def _point_times(
    drive: Drive, record: Record, where: str, columns: Mapping[str, AnyArray],
    roles: dict[str, str],
) -> PointTimes | None:  # fmt: skip
    if record.get("deskewed", False):
        return None
    stated = record.get("point_times")
    if stated is not None:
        return PointTimes(stated["unit"], stated.get("relative_to", "timestamp"), stated.get("field"))
    name = roles.get("time")
    if name is None:
        return None
    known = _KNOWN_TIMES.get((name.lower(), columns[name].dtype.kind))
    if known is None:
        message = f"column {name!r} looks like times of points; state `point_times` to use it"
        drive.ledger.note(WarningKind.SKIPPED, "point-times-not-used", where, message)
        return None
    return replace(known, field=name)


_FARTHEST_MOUNT = 30.0
"""A sensor that is mounted farther than this from the ego [m] is remarked: no vehicle is as long."""

_WITHIN_NS = 1_000_000_000
"""Streams that miss each other by less may well belong together."""

_FARTHEST_POINT = 10_000.0
"""No lidar measures as far [m]: numbers of another type give such points."""

_NEAREST_POINT = 1e-6

_ODD_SHARE = 0.01

_LEANING = 0.5
"""Cosine of 60 degrees: an ego whose z axis leans more than that is on its side or head."""


def _note_odd_points(
    path: Path, positions: Float32Array, columns: Mapping[str, AnyArray], ledger: Ledger
) -> None:
    """Note points that come out of columns which are not what they are taken for.

    Args:
        path: the file.
        positions: (N, 3) float32 [m], read from it.
        columns: of the file, by name.
        ledger: takes the warnings.
    """
    distances = np.linalg.norm(positions.astype(np.float64), axis=1)
    far, near = (distances > _FARTHEST_POINT).sum(), (distances < _NEAREST_POINT).sum()
    intensities = columns.get(find_roles(columns, {}).get("intensity", ""), positions[:0, 0])
    dark = int((intensities < 0).sum())
    odd = (
        (far, f"points farther than {_FARTHEST_POINT:g} m"),
        (near, f"points nearer than {_NEAREST_POINT:g} m"),
        (dark, "brightness below zero"),
    )
    for count, what in odd:
        if count > _ODD_SHARE * max(len(distances), 1):
            message = f"{what}; does the file have the columns and types that it is taken to have?"
            ledger.note(WarningKind.ASSUMED, "odd-points", str(path), message, count=int(count))


def _note_leaning(path: Path, name: str, trajectory: Trajectory, ledger: Ledger) -> None:
    """Note a trajectory on which the ego hardly ever stands upright, as another order of quaternions makes it."""
    if trajectory.quaternions_xyzw is None or not len(trajectory.timestamps_ns):
        return
    x, y = trajectory.quaternions_xyzw[:, 0], trajectory.quaternions_xyzw[:, 1]
    leaning = int((1.0 - 2.0 * (x * x + y * y) < _LEANING).sum())
    if leaning > len(trajectory.timestamps_ns) / 2:
        message = (
            f"trajectory {name!r} has the ego on its side or head in {leaning} of {len(trajectory.timestamps_ns)} "
            f"poses; "
            "are the quaternions x y z w, and is the world's z axis up?"
        )
        ledger.note(WarningKind.ASSUMED, "ego-leaning", str(path), message)


def note_doubts(
    path: Path, sensors: Sequence[Sensor], trajectories: Mapping[str, Trajectory], ledger: Ledger
) -> None:
    """Note what can hardly be meant.

    Args:
        path: the manifest.
        sensors: of the scene.
        trajectories: of the scene.
        ledger: takes the warnings.
    """
    for sensor in sensors:
        if isinstance(sensor, LidarSensor | CameraSensor) and sensor.mount is not None:
            distance = float(np.linalg.norm(sensor.mount.translation))
            if distance > _FARTHEST_MOUNT:
                message = f"sensor {sensor.id!r} is {distance:.5g} m from the ego; are these millimetres?"
                ledger.note(WarningKind.ASSUMED, "far-mount", str(path), message)
    for name, trajectory in trajectories.items():
        _note_leaning(path, name, trajectory, ledger)
    spans = [(f"sensor {sensor.id!r}", frame_times(sensor)) for sensor in sensors]
    spans += [(f"trajectory {name!r}", trajectory.timestamps_ns) for name, trajectory in trajectories.items()]
    ordered = sorted((int(times.min()), int(times.max()), name) for name, times in spans if len(times))
    latest = ordered[0][1] if ordered else 0
    for before, after in pairwise(ordered):
        latest = max(latest, before[1])
        if after[0] > latest + _WITHIN_NS:
            message = (
                f"{after[2]} begins {(after[0] - latest) / 1e9:.3f} s after {before[2]} and all before it end; "
                "are their clocks or units the same?"
            )
            ledger.note(WarningKind.ASSUMED, "clocks-apart", str(path), message)


_WORLD = "world"

FARTHEST_WORLD = 100_000.0
"""float32 resolves 8 mm there: points in the world beyond it need a nearer origin [m]."""

_LONGEST_SWEEP_NS = 60_000_000_000
"""A sweep that takes longer than this [ns] is none."""


def build_lidar(drive: Drive, record: Record, location: str) -> LidarSensor:
    """Build a lidar; its first file is read, to see what its columns are.

    Raises:
        DataError: files are missing or wrong, or the manifest contradicts them.
        CalibrationError: it is not known where the lidar, or the frame of its points, is.
    """
    mount = drive.mount(record)
    root = drive.root(record, location)
    files = root.files(record["files"], f"{location}.files")
    _check_suffixes(drive, files, location)
    timestamps = drive.time_source(record, location).timestamp_files(files)
    if not len(timestamps.chosen):
        raise DataError(drive.manifest.path, f"{location}.files", "none of the files has a time")
    layout = _choose_layout(drive, record, location, files[0])
    timestamps = drop_unreadable(timestamps, lambda k: read_cloud(files[k], layout=layout), drive.ledger)
    reader = SweepReader(
        files=tuple(files[k] for k in timestamps.chosen),
        names=tuple(root.relative(files[k]) for k in timestamps.chosen),
        clocks_ns=np.stack([timestamps.timestamps_ns, timestamps.timestamps_ns], axis=1),
        timestamps_ns=timestamps.timestamps_ns,
        zero_ns=int(record.get("time_offset_s", 0)),
        layout=layout,
        mapping=PointMapping(named=_named_columns(drive, record, location)),
    )
    reader = _with_columns(drive, record, location, reader)
    reader = _with_clocks(drive, record, location, reader, timestamps)
    points_frame, rotation = _points_frame(drive, record, mount)
    reader = replace(reader, rotation=rotation)
    _note_first_sweep(drive, reader, points_frame)
    scale = reader.mapping.scale
    return LidarSensor(
        id=record["id"],
        frames=LazyFrames(reader.timestamps_ns, reader),
        poses=drive.poses(mount, reader.timestamps_ns),
        mount=mount,
        points_frame=points_frame,
        model=record.get("model"),
        extras=MappingProxyType({} if scale is None else {"intensity_max": scale.maximum}),
    )


def _check_suffixes(drive: Drive, files: list[Path], location: str) -> None:
    for path in files:
        if cloud_suffix(path) is None:
            problem = f"{path.name!r}; expected files that end with {' '.join(CLOUD_SUFFIXES)}"
            raise DataError(drive.manifest.path, f"{location}.files", problem)


def _with_clocks(
    drive: Drive, record: Record, location: str, reader: SweepReader, timestamps: Timestamps
) -> SweepReader:
    """Bring timestamps that mean the middle or end of a sweep to its start.

    Points without times belong to one moment: the middle of the sweep, where it is known, else the timestamp.
    """
    meant = record.get("timestamp", "start")
    sweep_ns: int = record.get("sweep_s", 0)
    if record.get("deskewed", False):
        return replace(reader, deskewed=True)
    if not sweep_ns and meant != "start":
        sweep_ns = _median_interval(drive, location, timestamps)
    if sweep_ns > _LONGEST_SWEEP_NS:
        problem = (
            f"{sweep_ns / 1e9:g}; expected how long a sweep takes, at most {_LONGEST_SWEEP_NS // 10**9} s"
        )
        raise DataError(drive.manifest.path, f"{location}.sweep_s", problem)
    share = {"start": 0.0, "middle": 0.5, "end": 1.0}[meant]
    starts_ns = timestamps.timestamps_ns - round(sweep_ns * share)
    times_ns = starts_ns if reader.mapping.times is not None else starts_ns + round(sweep_ns / 2)
    clocks = np.stack([timestamps.timestamps_ns, starts_ns], axis=1)
    return replace(reader, clocks_ns=clocks, timestamps_ns=times_ns)


def _median_interval(drive: Drive, location: str, timestamps: Timestamps) -> int:
    if len(timestamps.timestamps_ns) < 2:
        problem = "missing, and a single sweep has no interval; expected how long a sweep takes [s]"
        raise DataError(drive.manifest.path, f"{location}.sweep_s", problem)
    interval_ns = int(np.median(np.diff(timestamps.timestamps_ns)))
    message = f"`sweep_s` not stated; a sweep is taken to last as long as the median interval, {interval_ns / 1e9:g} s"
    drive.ledger.note(WarningKind.ASSUMED, "sweep-length", f"{drive.manifest.path}: {location}", message)
    return interval_ns


def _points_frame(
    drive: Drive, record: Record, mount: RigidTransform
) -> tuple[PointsFrame, RigidTransform | None]:
    """The frame that the points will be in, and what takes them there if the file has them in another."""
    own = own_frame(record)
    name: str = record.get("points_in", own)
    if name == own:
        return PointsFrame.SENSOR, None
    if name == drive.tree.ego:
        return PointsFrame.EGO, None
    if name == _WORLD and _WORLD not in drive.tree.frames:
        return PointsFrame.WORLD, None
    return PointsFrame.SENSOR, mount.inverse() @ drive.tree.ego_from(name)


def _note_first_sweep(drive: Drive, reader: SweepReader, points_frame: PointsFrame) -> None:
    """Look at the points of the first sweep, and state what was left out of it."""
    read = reader.read(0)
    if read.dropped:
        message = "points that are not finite, or exactly at the origin, are no returns and are left out"
        location = str(reader.files[0])
        drive.ledger.note(WarningKind.SKIPPED, "points-dropped", location, message, count=read.dropped)
    positions = read.points.positions
    _note_odd_points(reader.files[0], positions, reader.cloud(0).columns, drive.ledger)
    if points_frame is PointsFrame.WORLD and len(positions) and np.abs(positions).max() > FARTHEST_WORLD:
        problem = f"points up to {np.abs(positions).max():.0f} m from the world's origin; expected {FARTHEST_WORLD:g} m"
        raise DataError(reader.files[0], "", f"{problem} at most: give points and trajectory a nearer origin")
