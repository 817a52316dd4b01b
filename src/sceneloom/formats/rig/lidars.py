"""The lidars of a manifest: files of points, when each sweep began, and in which frame its points are."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, read_only
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.clouds import (
    CLOUD_SUFFIXES,
    Cloud,
    FieldLayout,
    IntensityScale,
    PointMapping,
    PointTimes,
    cloud_suffix,
    parse_layout,
    points_of,
    read_cloud,
)
from sceneloom.formats.clouds.bin import default_layout
from sceneloom.formats.clouds.points import ReadPoints, SweepClock, detect_scale
from sceneloom.formats.clouds.roles import ALIASES, ROW_ALIASES, find_roles
from sceneloom.formats.rig.drive import Drive, own_frame
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.times import Stamps
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, NoticeKind, PointsFrame

WORLD = "world"
FARTHEST_WORLD = 100_000.0
"""float32 resolves 8 mm there: points in the world beyond it need a nearer origin [m]."""

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

Source: Ouster's and Livox' drivers for ROS (t, offset_time: uint32 nanoseconds from the stamp), Velodyne's (time:
float32 seconds from the stamp), Hesai's and RoboSense's (timestamp: float64 seconds of the clock); Argoverse 2
(offset_ns).
"""


@dataclass(frozen=True, slots=True, eq=False)
class SweepReader:
    """Reads the sweeps of one lidar, each when it is asked for.

    Attributes:
        files: of each sweep.
        names: of the files, seen from their root.
        clocks_ns: (N, 2) int64 [ns]: the file's stamp and the sweep's start.
        timestamps_ns: (N,) int64 [ns], of the frames.
        zero_ns: what the sensor's own clock is ahead by [ns].
        layout: columns of files that do not say them.
        mapping: what the columns mean.
        turn: takes points of the files into the frame that they are given in, None where they are in it.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    clocks_ns: Int64Array
    timestamps_ns: Int64Array
    zero_ns: int
    layout: FieldLayout | None
    mapping: PointMapping
    turn: RigidTransform | None = None

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: its file is missing or wrong.
        """
        read = self.read(k)
        points = read.points if self.turn is None else _turned(read.points, self.turn)
        extras: dict[str, Any] = {"file": self.names[k]}
        counts = {"dropped_points": read.dropped, "clipped_intensities": read.clipped}
        extras.update({name: count for name, count in counts.items() if count})
        return LidarFrame(int(self.timestamps_ns[k]), points, MappingProxyType(extras))

    def read(self, k: int) -> ReadPoints:
        """Read the points of sweep `k` in the frame of the file."""
        stamp_ns, start_ns = self.clocks_ns[k].tolist()
        return points_of(self.cloud(k), self.mapping, SweepClock(stamp_ns, start_ns, self.zero_ns))

    def cloud(self, k: int) -> Cloud:
        """Read the columns of sweep `k`."""
        return read_cloud(self.files[k], layout=self.layout)


def _turned(points: LidarPoints, turn: RigidTransform) -> LidarPoints:
    return replace(points, positions=read_only(turn.apply(points.positions), np.float32))


def build_lidar(drive: Drive, record: Record, place: str) -> LidarSensor:
    """Build a lidar; its first file is read, to see what its columns are.

    Raises:
        DataError: files are missing or wrong, or the manifest contradicts them.
        CalibrationError: it is not known where the lidar, or the frame of its points, is.
    """
    mount = drive.mount(record)
    root = drive.root(record, place)
    files = root.files(record["files"], f"{place}.files")
    _check_suffixes(drive, files, place)
    stamps = drive.time_source(record, place).stamp_files(files)
    if not len(stamps.chosen):
        raise DataError(drive.manifest.path, f"{place}.files", "none of the files has a time")
    reader = SweepReader(
        files=tuple(files[k] for k in stamps.chosen),
        names=tuple(root.relative(files[k]) for k in stamps.chosen),
        clocks_ns=np.stack([stamps.timestamps_ns, stamps.timestamps_ns], axis=1),
        timestamps_ns=stamps.timestamps_ns,
        zero_ns=int(record.get("time_offset_s", 0)),
        layout=_layout(drive, record, place, files[0]),
        mapping=PointMapping(named=_named(drive, record, place)),
    )
    reader = _with_columns(drive, record, place, reader)
    reader = _with_clocks(drive, record, place, reader, stamps)
    points_frame, turn = _points_frame(drive, record, mount)
    reader = replace(reader, turn=turn)
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


def _check_suffixes(drive: Drive, files: list[Path], place: str) -> None:
    for path in files:
        if cloud_suffix(path) is None:
            problem = f"{path.name!r}; expected files that end with {' '.join(CLOUD_SUFFIXES)}"
            raise DataError(drive.manifest.path, f"{place}.files", problem)


def _layout(drive: Drive, record: Record, place: str, first: Path) -> FieldLayout | None:
    """The columns that the manifest says, or those that files without a head are taken to have."""
    if "fields" in record:
        try:
            return parse_layout(record["fields"], default=record.get("dtype", "float32"))
        except OptionError as error:
            raise DataError(drive.manifest.path, f"{place}.fields", str(error)) from None
    if "dtype" in record:
        raise DataError(drive.manifest.path, f"{place}.dtype", "says nothing without `fields`")
    if cloud_suffix(first) != ".bin":
        return None
    layout = default_layout(first)
    message = f"`fields` not said; the points are taken to be {layout}"
    drive.ledger.note(NoticeKind.ASSUMED, "fields-assumed", f"{drive.manifest.path}: {place}", message)
    return layout


def _named(drive: Drive, record: Record, place: str) -> Mapping[str, str]:
    named = record.get("use", {})
    for role in named:
        if role not in _ROLES:
            problem = (
                f"unknown; expected some of {', '.join(_ROLES)}; times of points go into point_times.field"
            )
            raise DataError(drive.manifest.path, f"{place}.use.{role}", problem)
    return MappingProxyType(named)


def _with_columns(drive: Drive, record: Record, place: str, reader: SweepReader) -> SweepReader:
    """Settle what brightness and times mean, looking at the first file where the manifest does not say it."""
    cloud = reader.cloud(0)
    columns = cloud.columns
    roles = find_roles(columns, reader.mapping.named)
    where = f"{drive.manifest.path}: {place}"
    scale = None
    if "intensity_max" in record:
        scale = IntensityScale(record["intensity_max"])
    elif roles.get("intensity") in columns:
        scale = _detected_scale(drive, place, cloud, roles["intensity"])
    times = _point_times(drive, record, where, columns, roles)
    mapping = PointMapping(reader.mapping.named, scale, times)
    return replace(reader, mapping=mapping)


def _detected_scale(drive: Drive, place: str, cloud: Cloud, name: str) -> IntensityScale:
    scale = detect_scale(cloud.columns[name])
    if scale is None:
        problem = f"up to {cloud.columns[name].max()}; say what becomes 255 with {place}.intensity_max"
        raise DataError(cloud.file, name, problem)
    if cloud.columns[name].dtype != np.uint8:
        message = (
            f"`intensity_max` not said; {name} of the first file goes up to {cloud.columns[name].max():g}"
        )
        message += f", so {scale.maximum:g} becomes 255" if len(cloud.columns[name]) else ""
        drive.ledger.note(NoticeKind.ASSUMED, "intensity-scale", f"{drive.manifest.path}: {place}", message)
    return scale


def _point_times(
    drive: Drive, record: Record, where: str, columns: Mapping[str, AnyArray],
    roles: dict[str, str],
) -> PointTimes | None:  # fmt: skip
    if record.get("deskewed", False):
        return None
    said = record.get("point_times")
    if said is not None:
        return PointTimes(said["unit"], said.get("relative_to", "stamp"), said.get("field"))
    name = roles.get("time")
    if name is None:
        return None
    known = _KNOWN_TIMES.get((name.lower(), columns[name].dtype.kind))
    if known is None:
        message = f"column {name!r} looks like times of points; say `point_times` to use it"
        drive.ledger.note(NoticeKind.SKIPPED, "point-times-not-used", where, message)
        return None
    message = (
        f"column {name!r} is taken for times of points: {known.unit} relative to the {known.relative_to}"
    )
    drive.ledger.note(NoticeKind.ASSUMED, "point-times-assumed", where, message)
    return replace(known, field=name)


def _with_clocks(
    drive: Drive, record: Record, place: str, reader: SweepReader, stamps: Stamps
) -> SweepReader:
    """Bring stamps that mean the middle or end of a sweep to its start.

    Points without times belong to one moment: the middle of the sweep, where it is known, else the stamp.
    """
    meant = record.get("stamp", "start")
    sweep_ns = record.get("sweep_s")
    if record.get("deskewed", False):
        return reader
    if sweep_ns is None and meant != "start":
        sweep_ns = _median_interval(drive, place, stamps)
    share = {"start": 0.0, "middle": 0.5, "end": 1.0}[meant]
    starts_ns = stamps.timestamps_ns - round((sweep_ns or 0) * share)
    times_ns = starts_ns if reader.mapping.times is not None else starts_ns + round((sweep_ns or 0) / 2)
    clocks = np.stack([stamps.timestamps_ns, starts_ns], axis=1)
    return replace(reader, clocks_ns=clocks, timestamps_ns=times_ns)


def _median_interval(drive: Drive, place: str, stamps: Stamps) -> int:
    if len(stamps.timestamps_ns) < 2:
        problem = "missing, and a single sweep has no interval; expected how long a sweep takes [s]"
        raise DataError(drive.manifest.path, f"{place}.sweep_s", problem)
    interval_ns = int(np.median(np.diff(stamps.timestamps_ns)))
    message = f"`sweep_s` not said; a sweep is taken to last as long as the median interval, {interval_ns / 1e9:g} s"
    drive.ledger.note(NoticeKind.ASSUMED, "sweep-length", f"{drive.manifest.path}: {place}", message)
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
    if name == WORLD and WORLD not in drive.tree.frames:
        return PointsFrame.WORLD, None
    return PointsFrame.SENSOR, mount.inverse() @ drive.tree.ego_from(name)


def _note_first_sweep(drive: Drive, reader: SweepReader, points_frame: PointsFrame) -> None:
    """Look at the points of the first sweep, and say what was left out of it."""
    read = reader.read(0)
    if read.dropped:
        message = "points that are not finite, or exactly at the origin, are no returns and are left out"
        place = str(reader.files[0])
        drive.ledger.note(NoticeKind.SKIPPED, "points-dropped", place, message, count=read.dropped)
    positions = read.points.positions
    if points_frame is PointsFrame.WORLD and len(positions) and np.abs(positions).max() > FARTHEST_WORLD:
        problem = f"points up to {np.abs(positions).max():.0f} m from the world's origin; expected {FARTHEST_WORLD:g} m"
        raise DataError(reader.files[0], "", f"{problem} at most: give points and trajectory a nearer origin")
