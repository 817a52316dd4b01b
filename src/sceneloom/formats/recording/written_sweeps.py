"""The lidars: one binary of packed records per sweep, and the line that names it."""

import re
from collections.abc import Iterator, Mapping
from itertools import count
from math import radians
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.formats.loss import Loss, Support
from sceneloom.formats.recording.column_arrays import nanoseconds
from sceneloom.formats.recording.kept_texts import completed, rows_of
from sceneloom.formats.recording.lidar_files import XYZIRT
from sceneloom.formats.recording.lidar_words import LIDAR_MODELS
from sceneloom.formats.recording.merged_lines import LineStream, OneByOne, WrittenLine
from sceneloom.formats.recording.written_lines import make_line
from sceneloom.formats.recording.written_times import TimeWriter
from sceneloom.geometry.interpolation import OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import angle_between, conjugate_quaternion, rotate_vectors
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Coordinates, PointsFrame

LIDAR_MODEL = LIDAR_MODELS[0]
"""The one model that the format describes."""

_ABSENT = (
    ("intensities", "0 written: the source has none"),
    ("rings", "0 written: the source has none"),
    ("timestamps_ns", "the sweep's own time written: the source has none per point"),
)
_NO_POSITION = ("colors", "camera_index")
_OWN_EXTRAS = {"file_seconds", "dataFile"}
"""Further fields of a sweep that its line holds."""

_SAME_LOCATION, _SAME_ROTATION = 1e-3, radians(0.01)
"""How far poses may be from each other and still be the same [m], [rad]: as far as those of thinned paths are."""


def sweep_stream(sensor: LidarSensor, index: int) -> str:
    """The name under which more is kept of a lidar's lines."""
    return f"lidars.{sensor.extras.get('lidarInd', index)}"


class SweepWriter:
    """Writes the sweeps of one lidar.

    Attributes:
        losses: what could not be written.
    """

    def __init__(
        self,
        sensor: LidarSensor,
        index: int,
        mount: RigidTransform,
        ego_path: Poses | None,
        folder: Path,
        times: TimeWriter,
        further_keys: Mapping[str, str],
    ) -> None:
        """Begin.

        Args:
            sensor: the lidar.
            index: `lidarInd`.
            mount: `ego_from_lidar`.
            ego_path: `world_from_ego`, or None.
            folder: the recording that is being written.
            times: writes the times.
            further_keys: by key of a sweep, the text of a line that once stated more than it.

        Raises:
            PoseError: the points are in the world, and it is not known where the lidar was.
        """
        self.losses = _losses_of_all(sensor)
        self._sensor, self._index, self._mount = sensor, index, mount
        self._folder, self._times = folder, times
        self._names: set[str] = set()
        rows = rows_of(further_keys, sensor.frames.timestamps_ns)
        self._further = {row: further_keys[key] for key, row in rows.items()}
        self._subfolder = f"lidar{index + 1 if index else ''}"
        self._world = (
            _world_poses(sensor, mount, ego_path) if sensor.points_frame is PointsFrame.WORLD else None
        )

    def stream(self) -> LineStream:
        """The lines, each made after its file was written."""
        name = sweep_stream(self._sensor, self._index)
        return OneByOne(self._sensor.frames.timestamps_ns, self._lines(), name)

    def _lines(self) -> Iterator[WrittenLine]:
        (self._folder / self._subfolder).mkdir(exist_ok=True)
        for k, frame in enumerate(self._sensor.frames):
            name = self._file_name(k, frame)
            (self._folder / name).write_bytes(self._records(frame).tobytes())
            sweep: dict[str, Any] = {"model": LIDAR_MODEL, "dataFile": name}
            if self._index:
                sweep["lidarInd"] = self._index
            fields: dict[str, Any] = {"lidar": sweep}
            seconds = frame.extras.get("file_seconds")
            line = make_line(fields, frame.timestamp_ns, self._times, seconds)
            further = self._further.get(k)
            yield line if further is None else line._replace(text=completed(line.text, further))

    def _file_name(self, k: int, frame: LidarFrame) -> str:
        """The name that the file had in a recording, where that is free and in the lidar's folder; else a number."""
        name = frame.extras.get("dataFile")
        own = re.compile(rf"{self._subfolder}/\w[\w.-]*")
        if not isinstance(name, str) or not own.fullmatch(name) or name in self._names:
            name = next(
                n for n in (f"{self._subfolder}/{i:06d}.bin" for i in count(k)) if n not in self._names
            )
        self._names.add(name)
        return name

    def _records(self, frame: LidarFrame) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        points = frame.points
        self._note_losses(frame)
        records = np.zeros(len(points), XYZIRT)
        positions = self._in_sensor_frame(frame)
        for axis, name in enumerate("xyz"):
            records[name] = positions[:, axis]
        if points.intensities is not None:
            records["intensity"] = points.intensities
        if points.rings is not None:
            records["ring"] = points.rings
        records["timestamp"] = self._seconds(frame)
        return records

    def _seconds(self, frame: LidarFrame) -> Float64Array:
        """Times as numbers: those that the file had, where they still mean the same time."""
        timestamps = _point_times(frame)
        seconds: Float64Array = timestamps / 1e9
        before = frame.points.extras.get("file_seconds")
        if isinstance(before, np.ndarray) and before.shape == timestamps.shape:
            seconds = np.where(nanoseconds(before) == timestamps, before, seconds)
        inexact = int((nanoseconds(seconds) != timestamps).sum())
        self._lose("timestamps_ns", "rounded to what a 64-bit number of seconds holds", inexact)
        return seconds

    def _in_sensor_frame(self, frame: LidarFrame) -> Float32Array:
        positions = frame.points.positions
        if self._sensor.points_frame is PointsFrame.EGO:
            positions = self._mount.inverse().apply(positions).astype(np.float32)
        elif self._world is not None:
            positions = self._from_world(frame).astype(np.float32)
        return positions

    def _from_world(self, frame: LidarFrame) -> Float64Array:
        """Undo what brought each point into the world at its own time."""
        if self._world is None or not len(frame.points):
            return np.zeros((0, 3))
        samples = self._world.at(_point_times(frame))
        unknown = int(np.isnan(samples.positions[:, 0]).sum())
        if unknown:
            raise PoseError(
                f"lidar {self._sensor.id!r}: sweep at {frame.timestamp_ns} ns: no pose for {unknown} of its points, "
                "which are in the world and have to be brought back into the lidar's frame"
            )
        offsets = frame.points.positions.astype(np.float64) - samples.positions
        return rotate_vectors(conjugate_quaternion(samples.quaternions_xyzw), offsets)

    def _note_losses(self, frame: LidarFrame) -> None:
        points: LidarPoints = frame.points
        for name, what in _ABSENT:
            self._lose(name, what, len(points) if getattr(points, name) is None else 0)
        further = [name for name in _NO_POSITION if getattr(points, name) is not None]
        further += [name for name in points.extras if name != "file_seconds"]
        for name in further:
            self._lose(name, "left out: the format has none", len(points))
        for name in [name for name in frame.extras if name not in _OWN_EXTRAS]:
            field = f"sensors[{self._sensor.id}].frames[].{name}"
            self.losses.append(Loss(field=field, what="left out: the format has none", count=1))

    def _lose(self, name: str, what: str, count: int) -> None:
        if count:
            field = f"sensors[{self._sensor.id}].frames[].points.{name}"
            self.losses.append(Loss(field=field, what=what, count=count))


def _losses_of_all(sensor: LidarSensor) -> list[Loss]:
    """What holds for all sweeps of a lidar."""
    losses = []
    if sensor.model not in (None, LIDAR_MODEL):
        what = f"{sensor.model!r} written as {LIDAR_MODEL!r}, the one layout of files that the format has"
        losses.append(Loss(field=f"sensors[{sensor.id}].model", what=what))
    if sensor.points_frame is not PointsFrame.SENSOR:
        what = f"brought from the {sensor.points_frame} frame into the lidar's own, in which recordings keep points"
        losses.append(Loss(field=f"sensors[{sensor.id}].points_frame", what=what, support=Support.CONVERTED))
        what = f"rounded to float32 in the lidar's own frame, from the {sensor.points_frame} frame"
        field, count = f"sensors[{sensor.id}].frames[].points.positions", len(sensor.frames)
        losses.append(Loss(field=field, what=what, count=count, support=Support.CONVERTED))
    return losses


def _point_times(frame: LidarFrame) -> Int64Array:
    timestamps = frame.points.timestamps_ns
    return np.full(len(frame.points), frame.timestamp_ns, np.int64) if timestamps is None else timestamps


def _world_poses(sensor: LidarSensor, mount: RigidTransform, ego_path: Poses | None) -> PoseSource:
    """Where the lidar was: by its own poses in the world, else by the ego's and the mounting.

    Own poses may be few. Where the ego's with the mounting state the same, these report more of the time between.
    """
    timestamps = sensor.frames.timestamps_ns
    reach_ns = int(np.median(np.diff(timestamps))) if len(timestamps) > 1 else 0
    rider_association = None if ego_path is None else PoseSource(ego_path, mount, reach_ns)
    if sensor.poses is not None and sensor.coordinates is Coordinates.WORLD:
        if rider_association is not None and _agree(rider_association, sensor.poses):
            return rider_association
        return PoseSource(sensor.poses, RigidTransform.identity(), reach_ns)
    if rider_association is None:
        raise PoseError(
            f"lidar {sensor.id!r}: its points are in the world and have to be brought back into its own frame, "
            "but the scene says neither where it was nor where the ego was"
        )
    return rider_association


def _agree(rider_association: PoseSource, poses: Poses) -> bool:
    """Whether a source gives the poses of a path at all its times, but for rounding."""
    if poses.static:
        return False
    samples = rider_association.at(poses.timestamps_ns)
    if (samples.coverage == OUT_OF_REACH).any():
        return False
    distances = np.linalg.norm(samples.positions - poses.positions, axis=1)
    angles = angle_between(samples.quaternions_xyzw, poses.quaternions_xyzw)
    return bool(distances.max() <= _SAME_LOCATION and angles.max() <= _SAME_ROTATION)
