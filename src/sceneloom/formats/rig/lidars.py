"""The lidars of a manifest: files of points, when each sweep began, and in which frame its points are."""

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.clouds.points import PointMapping
from sceneloom.formats.clouds.table import CLOUD_SUFFIXES, cloud_suffix, read_cloud
from sceneloom.formats.rig.doubts import note_odd_points
from sceneloom.formats.rig.drive import Drive, own_frame
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.sweep_columns import choose_layout, named_columns, with_columns
from sceneloom.formats.rig.sweep_reader import SweepReader
from sceneloom.formats.rig.times import Timestamps, drop_unreadable
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.types import PointsFrame
from sceneloom.scene.warnings import WarningKind

WORLD = "world"
FARTHEST_WORLD = 100_000.0
"""float32 resolves 8 mm there: points in the world beyond it need a nearer origin [m]."""

LONGEST_SWEEP_NS = 60_000_000_000
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
    layout = choose_layout(drive, record, location, files[0])
    timestamps = drop_unreadable(timestamps, lambda k: read_cloud(files[k], layout=layout), drive.ledger)
    reader = SweepReader(
        files=tuple(files[k] for k in timestamps.chosen),
        names=tuple(root.relative(files[k]) for k in timestamps.chosen),
        clocks_ns=np.stack([timestamps.timestamps_ns, timestamps.timestamps_ns], axis=1),
        timestamps_ns=timestamps.timestamps_ns,
        zero_ns=int(record.get("time_offset_s", 0)),
        layout=layout,
        mapping=PointMapping(named=named_columns(drive, record, location)),
    )
    reader = with_columns(drive, record, location, reader)
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
    if sweep_ns > LONGEST_SWEEP_NS:
        problem = (
            f"{sweep_ns / 1e9:g}; expected how long a sweep takes, at most {LONGEST_SWEEP_NS // 10**9} s"
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
    if name == WORLD and WORLD not in drive.tree.frames:
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
    note_odd_points(reader.files[0], positions, reader.cloud(0).columns, drive.ledger)
    if points_frame is PointsFrame.WORLD and len(positions) and np.abs(positions).max() > FARTHEST_WORLD:
        problem = f"points up to {np.abs(positions).max():.0f} m from the world's origin; expected {FARTHEST_WORLD:g} m"
        raise DataError(reader.files[0], "", f"{problem} at most: give points and trajectory a nearer origin")
