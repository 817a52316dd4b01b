"""A scene as streams of records: sensors, trajectories, annotations, and notes of what messages cannot hold."""

import heapq
import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera, to_ros
from sceneloom.errors import check_choice
from sceneloom.formats.base.losses import Losses
from sceneloom.formats.messages.cameras import MILLIMETRE, OUR_PREFIX, UNKNOWN_MODEL
from sceneloom.formats.messages.points import DIRECTION_COLUMNS, OLD_TIME_COLUMN, SPEED_COLUMNS, TIME_COLUMNS
from sceneloom.formats.messages.records import (
    AnyRecord,
    Box2D,
    Box3D,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    CloudRecord,
    CompressedImageRecord,
    Dialect,
    FixRecord,
    ImageRecord,
    PackedField,
    PoseRecord,
    SampleRecord,
    Stated,
    TransformRecord,
)
from sceneloom.formats.messages.survey import ATTRIBUTE_PARTS, VERSION
from sceneloom.formats.points.cloud import unique_names
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations import AttributePath, Box2DAnnotation, CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, ShootingSensor, Shot, mounts_of_shots
from sceneloom.scene.clouds import LidarPoints, LidarSensor, PointsSensor, RadarSensor, grey_where_unseen
from sceneloom.scene.contents import KINDS
from sceneloom.scene.ego import check_one_ego
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, Trajectory, placed_along
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import Coordinates, PointsFrame


@dataclass(frozen=True, slots=True, eq=False)
class _Stream:
    """Records whose times are known before they are made; `make` is called once for each row, in their order."""

    times_ns: Int64Array  # ascending
    make: Callable[[int], Iterable[Stated]]


_Drawn = CuboidAnnotation | Box2DAnnotation


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """All rows of some annotations in the order of time: whose each is, and which of its own."""

    times_ns: Int64Array
    owners: Int64Array
    rows: Int64Array
    starts: Int64Array

    @classmethod
    def of(cls, annotations: Sequence[_Drawn]) -> "_Rows":
        lengths = [len(annotation.path.timestamps_ns) for annotation in annotations]
        times = np.concatenate([annotation.path.timestamps_ns for annotation in annotations])
        owners = np.repeat(np.arange(len(annotations)), lengths)
        rows = np.concatenate([np.arange(length) for length in lengths])
        order = np.lexsort((owners, times))
        moments, starts = np.unique(times[order], return_index=True)
        return cls(moments, owners[order], rows[order], np.append(starts, len(times)))

    def at(self, k: int) -> Iterator[tuple[int, int]]:
        part = slice(self.starts[k], self.starts[k + 1])
        return zip(self.owners[part].tolist(), self.rows[part].tolist(), strict=True)


def _cuboid_stream(
    annotations: Sequence[CuboidAnnotation], keys: Sequence[str], topic: str, frame_id: str, angles: CuboidAngles
) -> _Stream:
    """Draw cuboids at each of their times, and take them away at the first one after their last."""
    rows = _Rows.of(annotations)
    last = {int(owner): int(annotations[owner].path.timestamps_ns[-1]) for owner in range(len(annotations))}
    ends = sorted(last.items(), key=lambda row: row[1])
    location = 0

    def make(k: int) -> Iterator[Stated]:
        nonlocal location
        time_ns, gone = int(rows.times_ns[k]), []
        while location < len(ends) and ends[location][1] < time_ns:
            gone.append(keys[ends[location][0]])
            location += 1
        boxes = tuple(_cuboid(annotations[owner], keys[owner], row, frame_id, angles) for owner, row in rows.at(k))
        yield topic, Boxes3DRecord(time_ns, boxes, tuple(gone))

    return _Stream(rows.times_ns, make)


def _cuboid(annotation: CuboidAnnotation, key: str, row: int, frame_id: str, angles: CuboidAngles) -> Box3D:
    values = annotation.path.values[row]
    rotation = angles.quaternions(values[6:])
    return Box3D(key, frame_id, values[3:6], rotation, values[:3], annotation.label)


def _box_2d_stream(annotations: Sequence[Box2DAnnotation], keys: Sequence[str], topic: str, frame_id: str) -> _Stream:
    """Draw boxes into the images of a camera at each of their times."""
    rows = _Rows.of(annotations)

    def make(k: int) -> Iterator[Stated]:
        boxes = []
        for owner, row in rows.at(k):
            left, top, width, height = annotations[owner].path.values[row].tolist()
            boxes.append(Box2D(keys[owner], (left, top, width, height), annotations[owner].label))
        yield topic, Boxes2DRecord(int(rows.times_ns[k]), frame_id, tuple(boxes))

    return _Stream(rows.times_ns, make)


_POSITION_FIRST = np.array([3, 4, 5, 0, 1, 2])
"""Trajectories have covariances of rotation, then position; messages of position, then rotation."""

_IMAGES = ("copy", "jpeg", "png", "raw")
"""How images are written: files and videos as they are and the rest as JPEG; or all in one form."""

_JPEG_QUALITY = 95
_JPEG_START = b"\xff\xd8\xff"
_MOST_STEPS = 65535

_SAME_M, _SAME_ROTATION = 1e-9, 1e-9
"""Poses that differ from those along the ego trajectory by no more than rounding are not stated once more."""

_CUBOIDS_TOPIC = "/cuboids"
_FRAMES_TOPIC, FIXED_FRAMES_TOPIC = "/tf", "/tf_static"

_Note = dict[str, Any]
_NO_JSON = "values that JSON cannot state"


def check_images(images: str) -> None:
    """Refuse an unknown option for images.

    Raises:
        OptionError: there is no such way of writing images.
    """
    check_choice("images", images, _IMAGES)


def _stream(times_ns: Int64Array, topic: str, make: Callable[[int], AnyRecord]) -> _Stream:
    """A stream of one record on one topic at each time."""

    def stated(k: int) -> Iterator[Stated]:
        yield topic, make(k)

    return _Stream(times_ns, stated)


_Columns = dict[tuple[str, ...], AnyArray]
"""Columns of a message to be written, (N,), or several that lie side by side already, (N, k), by their k names."""


def _packed(columns: _Columns, count: int, timestamp_ns: int, frame_id: str) -> CloudRecord:
    """Lay columns side by side, little-endian, without gaps, in their order."""
    stride = sum(len(names) * column.itemsize for names, column in columns.items())
    table = np.empty((count, stride), np.uint8)
    fields: list[PackedField] = []
    offset = 0
    for names, column in columns.items():
        dtype = column.dtype.newbyteorder("<")
        fields += [PackedField(name, offset + k * dtype.itemsize, dtype) for k, name in enumerate(names)]
        items = column.astype(dtype, copy=False)
        if items.ndim > 1:  # several numbers as bytes are copied in a third of the time
            items = np.ascontiguousarray(items).view(f"V{items.shape[1] * items.itemsize}").reshape(-1)
        if count:  # no view may begin within an empty table
            np.ndarray((count,), items.dtype, table, offset, (stride,))[:] = items
        offset += items.itemsize
    return CloudRecord(timestamp_ns, frame_id, tuple(fields), stride, table.reshape(-1).data, count)


_HELD = frozenset(["u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"])


_MOST_NS = 2**32 - 1


def kept_record(points: LidarPoints, timestamp_ns: int) -> CloudRecord | None:
    """The message that points of a sweep of that time stand in, where it can be copied as it is."""
    record = getattr(points.packed_records(), "record", None)
    return record if isinstance(record, CloudRecord) and record.timestamp_ns == timestamp_ns else None


@dataclass(slots=True)
class _CloudWriter:
    """Makes the records of a sensor of points; counts what has no field in them."""

    topic: str
    frame_id: str
    field: str  # what the model calls the sensor's frames, for losses
    losses: Losses
    intensity: str = "u1"  # dtype

    def lidar(self, sensor: LidarSensor, k: int) -> Iterator[Stated]:
        """Make the record of sweep `k`."""
        frame = sensor.frames[k]
        points = frame.points
        kept = kept_record(points, frame.timestamp_ns)
        if kept is not None and self._is_as_written(kept):
            self._note_frame(frame.extras)
            yield self.topic, replace(kept, frame_id=self.frame_id)
            return
        columns: _Columns = {("x", "y", "z"): points.positions}
        if points.intensities is not None:
            columns["intensity",] = points.intensities.astype(self.intensity, copy=False)
        if points.rings is not None:
            columns["ring",] = points.rings
        if points.timestamps_ns is not None:
            columns |= _offsets(points.timestamps_ns, frame.timestamp_ns)
        if points.colors is not None:
            columns |= _colours(grey_where_unseen(points.colors, points.camera_index))
        if points.camera_index is not None:
            columns["camera_index",] = points.camera_index
        self._add_extras(columns, points.extras)
        self._note_frame(frame.extras)
        yield self.topic, _packed(columns, len(points), frame.timestamp_ns, self.frame_id)

    def radar(self, sensor: RadarSensor, k: int) -> Iterator[Stated]:
        """Make the record of cycle `k`."""
        frame = sensor.frames[k]
        points = frame.points
        columns: _Columns = {("x", "y", "z"): points.positions}
        if points.directions is not None:
            columns[DIRECTION_COLUMNS] = points.directions
        if points.lengths is not None:
            columns[SPEED_COLUMNS[0],] = points.lengths
        if points.timestamps_ns is not None:
            columns |= _offsets(points.timestamps_ns, frame.timestamp_ns)
        self._add_extras(columns, points.extras)
        self._note_frame(frame.extras)
        yield self.topic, _packed(columns, len(points), frame.timestamp_ns, self.frame_id)

    def map(self, sensor: PointsSensor, timestamp_ns: int) -> Iterator[Stated]:
        """Make the only record of a map."""
        columns: _Columns = {("x", "y", "z"): sensor.positions}
        if sensor.colors is not None:
            columns |= _colours(sensor.colors)
        yield self.topic, _packed(columns, len(sensor.positions), timestamp_ns, self.frame_id)

    def _is_as_written(self, record: CloudRecord) -> bool:
        """Whether a message of ours has the types that this one would have."""
        dtypes = {field.name: field.dtype.str[1:] for field in record.fields}
        return dtypes.get("intensity", self.intensity) == self.intensity and OLD_TIME_COLUMN not in dtypes

    def _add_extras(self, columns: _Columns, extras: Mapping[str, AnyArray]) -> None:
        taken = {name for names in columns for name in names}
        for name, column in extras.items():
            location, lower = f"{self.field}.points.extras.{name}", name.lower()
            is_taken = name in taken or lower in _TAKEN or (lower, column.dtype.str[1:]) in TIME_COLUMNS
            if column.ndim != 1 or is_taken or name.startswith("_"):
                self.losses.dropped(location, "not one number for each point, or of a name that means something else")
            elif column.dtype.str[1:] in _HELD:
                columns[name,] = column
            elif column.dtype.kind in "iufb":
                self._add_converted(columns, name, column, location)
            else:
                self.losses.dropped(location, f"values of type {column.dtype}")

    def _add_converted(self, columns: _Columns, name: str, column: AnyArray, location: str) -> None:
        numbers = column.astype(np.uint8 if column.dtype.kind == "b" else np.float64)
        error = float(np.abs(column.astype(np.longdouble) - numbers.astype(np.longdouble)).max(initial=0))
        what = f"values of type {column.dtype} written as {numbers.dtype}"
        (self.losses.approximated if error else self.losses.converted)(location, what, error=error)
        columns[name,] = numbers

    def _note_frame(self, extras: Mapping[str, object]) -> None:
        self.losses.dropped(f"{self.field}.extras", "unknown fields of a sweep", count=bool(extras))


_TAKEN = frozenset(
    {"x", "y", "z", "positions", "intensity", "ring", "red", "green", "blue", "rgb", "colors", OLD_TIME_COLUMN}
)


def _colours(colors: AnyArray) -> _Columns:
    """Colours as viewers know them, which ask for an alpha value beside the three."""
    return {("red", "green", "blue"): colors, ("alpha",): np.full(len(colors), 255, np.uint8)}


def _offsets(timestamps_ns: AnyArray, timestamp_ns: int) -> _Columns:
    """Times of points from their sweep's as other programs name them: `t` [ns], or `time` [s] beyond 32 bits."""
    count = len(timestamps_ns)
    if count and (timestamps_ns.min() < timestamp_ns or timestamps_ns.max() > timestamp_ns + _MOST_NS):
        return {("time",): (timestamps_ns - timestamp_ns).astype(np.float64) / 1e9}
    offsets = np.empty(count, np.uint32)
    np.subtract(timestamps_ns, timestamp_ns, out=offsets, casting="unsafe")
    return {("t",): offsets}


class SceneStreams:
    """What a scene becomes in a log.

    Attributes:
        notes: what no message has a field for, as JSON will have it.
        losses: what is lost; it grows while the streams are followed.
        start_ns, stop_ns: first and last time of all streams [ns].
    """

    def __init__(self, scene: Scene, dialect: Dialect, *, images: str) -> None:
        """Plan the streams; nothing is read but what is needed to know their times.

        Args:
            scene: the drive.
            dialect: the habits of the format.
            images: one of "copy", "jpeg", "png", "raw".
        """
        self.losses = Losses()
        self._streams: list[_Stream] = []
        self._scene, self._dialect, self._images = scene, dialect, images
        self._trajectory = _trajectory_of(scene)
        check_one_ego(scene, self._trajectory)
        times = [*map(frame_times, scene.sensors), *(t.timestamps_ns for t in scene.trajectories.values())]
        self._first_ns = min((int(known[0]) for known in times if len(known)), default=0)
        # parent, and place in it, of each frame that is fixed, or moves
        self._mounts: dict[str, tuple[str, RigidTransform]] = {}
        self._paths: dict[str, tuple[str, Poses]] = {}
        if self._trajectory is not None:
            self._paths[dialect.ego] = (dialect.world, self._trajectory)
        plain = sum(isinstance(sensor, PlainSensor) for sensor in scene.sensors)
        self.losses.dropped("sensors.plain", "sensors of a type that there are no messages for", count=plain)
        trajectories = self._trajectories()
        parts = unique_names([dialect.part(sensor.id) for sensor in scene.sensors], "_")
        pairs = zip(scene.sensors, parts, strict=True)
        sensors = [self._sensor(sensor, part) for sensor, part in pairs if not isinstance(sensor, PlainSensor)]
        self.notes: dict[str, Any] = {
            "version": VERSION,
            "frames": {"ego": dialect.ego, "world": dialect.world},
            "sensors": sensors,
            "trajectories": trajectories,
            "annotations": self._annotations(sensors),
            **self._free_fields(),
        }
        moving = [_transforms(child, *where) for child, where in self._paths.items()]
        streams = [self._fixed_frames(), *moving, *self._streams]
        self._streams = [stream for stream in streams if len(stream.times_ns)]
        self.start_ns = min((int(stream.times_ns[0]) for stream in self._streams), default=0)
        self.stop_ns = max((int(stream.times_ns[-1]) for stream in self._streams), default=0)

    def records(self) -> Iterator[tuple[int, str, AnyRecord]]:
        """Time, topic and record of all streams in the order of time; one is made at a time."""

        def rows(number: int) -> Iterator[tuple[int, int, int]]:
            return ((int(time_ns), number, k) for k, time_ns in enumerate(self._streams[number].times_ns))

        for time_ns, number, k in heapq.merge(*map(rows, range(len(self._streams)))):
            for topic, record in self._streams[number].make(k):
                yield time_ns, topic, record

    def _fixed_frames(self) -> _Stream:
        """Where frames are in others for good, stated once, at the beginning."""

        def make(_: int) -> Iterator[Stated]:
            for child, (parent, moved) in self._mounts.items():
                place = moved.translation, moved.quaternion_xyzw
                yield FIXED_FRAMES_TOPIC, TransformRecord(self._first_ns, parent, child, *place, fixed=True)

        return _Stream(np.full(1 if self._mounts else 0, self._first_ns, np.int64), make)

    def _trajectories(self) -> list[_Note]:
        """Report each trajectory on a topic of its own."""
        dialect, notes = self._dialect, []
        trajectories = self._scene.trajectories
        parts = unique_names([dialect.part(name) for name in trajectories], "_")
        for (name, trajectory), part in zip(trajectories.items(), parts, strict=True):
            if len(trajectory.timestamps_ns) == 0:
                self.losses.dropped("trajectories", f"trajectory {name!r} without a pose")
                continue
            topic, location = f"/trajectories/{part}", f"trajectories[{name}]"
            self._add_poses(trajectory, topic, dialect.world, dialect.ego)
            notes.append({"name": name, "topic": topic})
            self._drop_seconds(f"{location}.file_seconds", trajectory.file_seconds)
            held = dialect.covariances and trajectory.quaternions_xyzw is not None
            if trajectory.covariances is not None and not held:
                self.losses.dropped(f"{location}.covariances", "messages of poses have none")
        return notes

    def _add_poses(self, path: Poses | Trajectory, topic: str, parent: str, body: str) -> None:
        rotations = path.quaternions_xyzw
        covariances = path.covariances if isinstance(path, Trajectory) and self._dialect.covariances else None

        def make(k: int) -> PoseRecord:
            spread = None if covariances is None else covariances[k][_POSITION_FIRST][:, _POSITION_FIRST]
            rotation = None if rotations is None else rotations[k]
            return PoseRecord(int(path.timestamps_ns[k]), parent, path.positions[k], rotation, body, spread)

        self._streams.append(_stream(path.timestamps_ns, topic, make))

    def _sensor(self, sensor: Sensor, part: str) -> _Note:
        """Make the streams of a sensor, and give its note."""
        frame = f"{part}_sensor" if part in {self._dialect.world, self._dialect.ego} else part
        note: _Note = {"id": sensor.id, "type": str(sensor.type), "part": part, "frame": frame}
        if sensor.parent_id is not None:
            note["parent_id"] = sensor.parent_id
        extras = self._sayable(f"sensors.{sensor.type}.extras", getattr(sensor, "extras", {}))
        if extras:
            note["extras"] = extras
        self._makers[type(sensor)](self, sensor, note)
        return note

    def _sayable(self, field: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """The values that JSON can state."""
        kept, lost = {}, []
        for name, value in values.items():
            try:
                kept[name] = _as_json(value)
            except ValueError:
                lost.append(name)
        self.losses.dropped(field, f"{_NO_JSON}: {', '.join(lost)}", count=len(lost))
        return kept

    def _attributes(self, field: str, attributes: Iterable[AttributePath]) -> list[_Note]:
        """The attributes whose values JSON can state."""
        kept, lost = [], 0
        for attribute in attributes:
            note: _Note = {"name": attribute.name}
            try:
                note["values"] = _as_json(list(attribute.values))
                if attribute.extras:
                    note["extras"] = _as_json(attribute.extras)
            except ValueError:
                lost += 1
                continue
            if attribute.timestamps_ns is not None:
                note["timestamps_ns"] = attribute.timestamps_ns.tolist()
            note |= {name: value for name in ATTRIBUTE_PARTS if (value := getattr(attribute, name)) is not None}
            kept.append(note)
        self.losses.dropped(field, _NO_JSON, count=lost)
        return kept

    def _drop_seconds(self, field: str, seconds: Any) -> None:
        self.losses.dropped(field, "timestamps of the source", count=seconds is not None)

    def _posed(self, sensor: Any, note: _Note) -> None:
        """Report where a sensor is: mounted on the ego, along the ego trajectory, or on poses of its own."""
        frame, dialect, poses = note["frame"], self._dialect, sensor.poses
        note["coordinates"] = str(sensor.coordinates)
        own = mounts_of_shots(sensor) if isinstance(sensor, CameraSensor | DepthCameraSensor) else None
        if own is not None:
            self._mounted_each(sensor, own, note)
        elif sensor.mount is not None:
            note["mount"] = True
            self._mounts[frame] = (dialect.ego, sensor.mount)
        if poses is None:
            return
        if self._is_derived(sensor, poses, own):
            note["poses"] = "derived"
            return
        parent = dialect.ego if sensor.coordinates is Coordinates.EGO else dialect.world
        note |= {"poses": f"/{note['part']}/pose", "static": poses.static}
        self._add_poses(poses, note["poses"], parent, frame)
        if own is None and sensor.mount is None and poses.static:
            place = RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])
            self._mounts[frame] = (parent, place)
        elif own is None and sensor.mount is None:
            self._paths[frame] = (parent, poses)

    def _mounted_each(self, sensor: ShootingSensor, own: Sequence[RigidTransform | None], note: _Note) -> None:
        """Report where each image of a camera was on the ego: once if that is the same for all, else at its time."""
        kind, frame, first = f"sensors.{sensor.type}", note["frame"], own[0]
        if first is not None and all(mount is not None and np.array_equal(mount.matrix, first.matrix) for mount in own):
            note["mount"] = True
            self._mounts[frame] = (self._dialect.ego, first)
            what = "the camera's own mounting, which no image has"
            self.losses.dropped(f"{kind}.mount", what, count=sensor.mount is not None)
            return
        known = {
            int(t): mount for t, mount in zip(frame_times(sensor)[::-1], own[::-1], strict=True) if mount is not None
        }
        times = np.array(sorted(known), np.int64)
        mounts = [known[time] for time in times.tolist()]
        positions, quaternions = [m.translation for m in mounts], [m.quaternion_xyzw for m in mounts]
        self._paths[frame] = (self._dialect.ego, Poses(times, np.array(positions), np.array(quaternions)))
        note["mounts"] = "each"
        if sensor.mount is not None:
            note["own_mount"] = [*sensor.mount.translation.tolist(), *sensor.mount.quaternion_xyzw.tolist()]
        what = "mountings of single images, written as transforms at their times"
        name = "images" if isinstance(sensor, CameraSensor) else "frames"
        count = sum(mount is not None for mount in own)
        self.losses.converted(f"{kind}.{name}.mount", what, count=count)

    def _is_derived(self, sensor: Any, poses: Poses, own: Sequence[RigidTransform | None] | None) -> bool:
        """Whether poses are no more than what the mounting and the ego trajectory state."""
        if sensor.coordinates is not Coordinates.WORLD or poses.static:
            return False
        times = frame_times(sensor)
        along = placed_along(self._trajectory, [sensor.mount] * len(times) if own is None else own, times)
        if along is None or not np.array_equal(along.timestamps_ns, poses.timestamps_ns):
            return False
        rotated = 1 - np.abs((along.quaternions_xyzw * poses.quaternions_xyzw).sum(axis=1))
        return bool(np.abs(along.positions - poses.positions).max() <= _SAME_M and rotated.max() <= _SAME_ROTATION)

    def _cloud_writer(self, note: _Note, frames: str, sensor: LidarSensor | RadarSensor | None) -> _CloudWriter:
        """What writes the points of a sensor, or of a map, on its topic."""
        note["topic"] = f"/{note['part']}/points"
        frame_id = self._dialect.world
        if sensor is not None:
            note["points_frame"] = str(sensor.points_frame)
            ids = {PointsFrame.WORLD: self._dialect.world, PointsFrame.EGO: self._dialect.ego}
            frame_id = ids.get(sensor.points_frame) or str(note["frame"])
        intensity = self._dialect.intensity if isinstance(sensor, LidarSensor) else "u1"
        return _CloudWriter(note["topic"], frame_id, frames, self.losses, intensity)

    def _lidar(self, sensor: LidarSensor, note: _Note) -> None:
        self._posed(sensor, note)
        if sensor.model is not None:
            note["model"] = sensor.model
        writer = self._cloud_writer(note, "sensors.lidar.frames", sensor)
        self._streams.append(_Stream(sensor.frames.timestamps_ns, lambda k: writer.lidar(sensor, k)))

    def _radar(self, sensor: RadarSensor, note: _Note) -> None:
        self._posed(sensor, note)
        writer = self._cloud_writer(note, "sensors.radar.frames", sensor)
        self._streams.append(_Stream(sensor.frames.timestamps_ns, lambda k: writer.radar(sensor, k)))

    def _map(self, sensor: PointsSensor, note: _Note) -> None:
        writer, time_ns = self._cloud_writer(note, "sensors.points", None), self._first_ns
        self._streams.append(_Stream(np.full(1, time_ns, np.int64), lambda _: writer.map(sensor, time_ns)))

    def _shots(self, sensor: ShootingSensor, note: _Note, tail: str) -> "_ShotWriter":
        self._posed(sensor, note)
        if sensor.fps is not None:
            note["fps"] = sensor.fps
        note["topic"] = f"/{note['part']}/{tail}"
        note["camera_model_topic"] = f"/{note['part']}/{self._dialect.camera_model_topic}"
        note["camera_model"] = _camera_model_text(sensor.camera)
        location = f"sensors.{sensor.type}"
        if _written_model(sensor.camera, "")[0].startswith(OUR_PREFIX):
            what = f"model {sensor.camera.model}, which other programs do not know"
            self.losses.converted(f"{location}.camera", what)
        frames = f"{location}.{'images' if isinstance(sensor, CameraSensor) else 'frames'}"
        topics = note["topic"], note["camera_model_topic"], note["frame"]
        return _ShotWriter(*topics, frames, self.losses, self._dialect, self._images)

    def _camera(self, sensor: CameraSensor, note: _Note) -> None:
        """Write the images of a camera: its video packet by packet, or one by one."""
        times, packets = sensor.images.timestamps_ns, self._packets(sensor, note)
        if packets is not None:
            writer, contents, order = self._shots(sensor, note, "video"), iter(packets), packets.order
            form = {"hevc": "h265"}.get(packets.codec, packets.codec)
            # packets come in another order than they are shown in, so that no camera model holds until the next one
            each = packets.reordered and any(image.camera != sensor.camera for image in sensor.images)
            writer.each_camera_model |= each
            self._streams.append(_Stream(times, lambda k: writer.packet(sensor, int(order[k]), form, contents)))
            return
        writer = self._shots(sensor, note, "image" if self._images == "raw" else "image/compressed")
        self.losses.dropped("sensors.camera.video", "written as single images", count=sensor.video is not None)
        self._streams.append(_Stream(times, lambda k: writer.image(sensor, k)))

    def _packets(self, sensor: CameraSensor, note: _Note) -> Any:
        """The packets of a camera's video, if they are to be, and can be, handed on."""
        if sensor.video is None or not self._dialect.videos or self._images != "copy" or not len(sensor.images):
            return None
        from sceneloom.formats.video.writer import AnnexBPackets

        packets = AnnexBPackets(sensor.video, len(sensor.images), f"sensors[{sensor.id}].video")
        if packets.obstacle is not None:
            self.losses.approximated("sensors.camera.video", f"written as single images: {packets.obstacle}")
            return None
        if packets.reordered:
            what = (
                "images that need later ones (B frames) are kept; viewers that follow the schema show none: "
                "`--output-option images=jpeg` encodes each image by itself, and they show it"
            )
            self.losses.converted("sensors.camera.video", what)
        note["codec"] = packets.codec
        return packets

    def _depth_camera(self, sensor: DepthCameraSensor, note: _Note) -> None:
        writer = self._shots(sensor, note, "depth")
        self.losses.dropped("sensors.depth_camera.video", "written as single images", count=sensor.video is not None)
        self._streams.append(_Stream(sensor.frames.timestamps_ns, lambda k: writer.depth(sensor, k)))

    def _odometry(self, sensor: OdometrySensor, note: _Note) -> None:
        note |= {"topic": f"/{note['part']}/pose", "static": sensor.poses.static}
        self._add_poses(sensor.poses, note["topic"], self._dialect.world, note["frame"])

    def _gnss(self, sensor: GnssSensor, note: _Note) -> None:
        note["topic"], frame = f"/{note['part']}/fix", note["frame"]
        if sensor.mount is not None:
            note["mount"] = True
            self._mounts[frame] = (self._dialect.ego, sensor.mount)
        self._drop_seconds("sensors.gnss.file_seconds", sensor.file_seconds)

        def make(k: int) -> FixRecord:
            level, upright = float(sensor.accuracies[k]) ** 2, float(sensor.vertical_accuracies[k]) ** 2
            variances = None if np.isnan(level) and np.isnan(upright) else (level, level, upright)
            latitude, longitude, altitude = sensor.positions_lla[k].tolist()
            return FixRecord(int(sensor.timestamps_ns[k]), frame, (latitude, longitude, altitude), variances)

        self._streams.append(_stream(sensor.timestamps_ns, note["topic"], make))

    def _imu(self, sensor: ImuSensor, note: _Note) -> None:
        """Write the streams of an IMU, those with the same times together."""
        note["streams"] = [*sensor.streams]
        tails, groups = self._dialect.sample_topics, dict[tuple[str, bytes], list[str]]()
        for name, samples in sensor.streams.items():
            tail, location = tails.get(name, tails.get("", "")), f"sensors.imu.streams.{name}"
            if not tail or len(samples) == 0:
                self.losses.dropped(location, "a stream that there are no messages for, or without a value")
                continue
            groups.setdefault((tail, samples.timestamps_ns.tobytes()), []).append(name)
            self._drop_seconds(f"{location}.file_seconds", samples.file_seconds)
        note["topics"] = [f"/{note['part']}/{tail}" for tail in unique_names([tail for tail, _ in groups], "_")]
        for topic, names in zip(note["topics"], groups.values(), strict=True):
            self._streams.append(self._samples(sensor, names, topic))

    def _samples(self, sensor: ImuSensor, names: Sequence[str], topic: str) -> _Stream:
        times = sensor.streams[names[0]].timestamps_ns

        def make(k: int) -> SampleRecord:
            values = {name: tuple(sensor.streams[name].values[k].tolist()) for name in names}
            return SampleRecord(int(times[k]), self._dialect.ego, values)

        return _stream(times, topic, make)

    def _annotations(self, sensor_notes: Sequence[_Note]) -> list[_Note]:
        """Draw the boxes; of all other annotations nothing is held."""
        annotations = self._scene.annotations
        names = unique_names(str(a.id) or "annotation" for a in annotations)
        keys = dict(zip(map(id, annotations), names, strict=True))
        topics: dict[int, str] = {}
        cuboids = [a for a in annotations if isinstance(a, CuboidAnnotation) and len(a.path.timestamps_ns)]
        if cuboids:
            named, angles = [keys[id(annotation)] for annotation in cuboids], CuboidAngles.of(self._scene)
            self._streams.append(_cuboid_stream(cuboids, named, _CUBOIDS_TOPIC, self._dialect.world, angles))
            topics |= dict.fromkeys(map(id, cuboids), _CUBOIDS_TOPIC)
            what = "angles become unit quaternions, which do not report whole rotations"
            self.losses.converted("annotations.cuboid.path.values", what, count=len(cuboids))
        cameras = {(type(note["id"]), note["id"]): note for note in reversed(sensor_notes)}
        by_camera: dict[tuple[type, Any], list[Box2DAnnotation]] = {}
        for annotation in annotations:
            if isinstance(annotation, Box2DAnnotation) and len(annotation.path.timestamps_ns):
                by_camera.setdefault((type(annotation.sensor_id), annotation.sensor_id), []).append(annotation)
        for camera, boxes in by_camera.items():
            note = cameras.get(camera)
            if note is not None:
                topic = note["boxes_topic"] = f"/{note['part']}/annotations"
                named = [keys[id(annotation)] for annotation in boxes]
                self._streams.append(_box_2d_stream(boxes, named, topic, note["frame"]))
                topics |= dict.fromkeys(map(id, boxes), topic)
        notes = []
        for annotation in annotations:
            if isinstance(annotation, CuboidAnnotation | Box2DAnnotation) and id(annotation) in topics:
                notes.append(self._annotation_note(annotation, topics[id(annotation)], keys[id(annotation)]))
            else:
                self.losses.dropped(KINDS[type(annotation)], "annotations that there are no plots for")
        return notes

    def _annotation_note(self, annotation: CuboidAnnotation | Box2DAnnotation, topic: str, key: str) -> _Note:
        kind, path, losses = KINDS[type(annotation)], annotation.path, self.losses
        attributes = self._attributes(f"{kind}.attributes", annotation.attributes)
        extras = self._sayable(f"{kind}.extras", annotation.extras)
        repeated = len(path.timestamps_ns) - len(np.unique(path.timestamps_ns))
        losses.dropped(f"{kind}.path.extras", "unknown fields of a path", count=bool(path.extras))
        losses.dropped(f"{kind}.path.timestamps_ns", "rows with the time of another one", count=repeated)
        for name in ("activations", "projections"):
            count = len(getattr(annotation, name, ()))
            losses.dropped(f"{kind}.{name}", "there are no messages for them", count=count)
        note: _Note = {"topic": topic, "key": key, "id": annotation.id}
        reported = {name: getattr(annotation, name) for name in ("parent_id", "label", "stationary")}
        note |= {name: value for name, value in reported.items() if value is not None}
        return note | {k: v for k, v in (("attributes", attributes), ("extras", extras)) if v}

    def _free_fields(self) -> _Note:
        scene = self._scene
        metadata = self._sayable("metadata", scene.metadata)
        extras = self._sayable("extras", scene.extras)
        attributes = self._attributes("attributes", scene.attributes)
        if any(isinstance(annotation, CuboidAnnotation) for annotation in scene.annotations):
            ours = metadata.get("sceneloom")
            euler = {"euler_unit": "degrees", "euler_order": "xyz"}
            metadata["sceneloom"] = {**(ours if isinstance(ours, dict) else {}), **euler}
        fields = {"metadata": metadata, "extras": extras, "attributes": attributes}
        return {**fields, "time_offset_ns": scene.time_offset_ns}

    _makers: ClassVar[Mapping[type[Any], Callable[["SceneStreams", Any, _Note], None]]] = MappingProxyType({
        LidarSensor: _lidar, RadarSensor: _radar, PointsSensor: _map, CameraSensor: _camera,
        DepthCameraSensor: _depth_camera, OdometrySensor: _odometry, GnssSensor: _gnss, ImuSensor: _imu,
    })  # fmt: skip


@dataclass(slots=True)
class _ShotWriter:
    """Makes the records of a camera."""

    topic: str
    camera_model_topic: str
    frame_id: str
    field: str  # what the model calls its images, for losses
    losses: Losses
    dialect: Dialect
    images: str  # one of `_IMAGES`
    each_camera_model: bool = False  # with each image, and not only where it changes; as the format does by habit
    camera_model: Camera | None = None  # that was stated last

    def image(self, sensor: CameraSensor, k: int) -> Iterator[Stated]:
        """Make the records of image `k`."""
        image = sensor.images[k]
        yield from self._head(image)
        copied = image.encoded() if image.encoded is not None and self.images == "copy" else None
        if copied is not None and copied.startswith(_JPEG_START):
            yield self._file(image, "jpeg", copied)
        elif self.images == "raw":
            yield self._raw(image, "rgb8", image.rgb)
        elif self.images == "png":
            yield self._file(image, "png", _png(image.rgb))
        else:
            self.losses.approximated(f"{self.field}.rgb", f"encoded as JPEG of quality {_JPEG_QUALITY}")
            yield self._file(image, "jpeg", _jpeg(image.rgb))

    def packet(self, sensor: CameraSensor, k: int, form: str, contents: Iterator[bytes]) -> Iterator[Stated]:
        """Make the records of the next packet of the video, which shows image `k`."""
        image = sensor.images[k]
        yield from self._head(image)
        yield self._file(image, form, next(contents))

    def depth(self, sensor: DepthCameraSensor, k: int) -> Iterator[Stated]:
        """Make the records of depth image `k`: whole millimetres where the source has these, else floats."""
        frame = sensor.frames[k]
        yield from self._head(frame)
        depth = frame.depth
        steps = np.rint(depth.astype(np.float64) / MILLIMETRE)
        if frame.scale == MILLIMETRE and steps.max(initial=0) <= _MOST_STEPS:
            yield self._raw(frame, "16UC1", steps.astype("<u2"))
            return
        what = "steps of the source; depths are floats"
        self.losses.dropped(f"{self.field}.scale", what, count=frame.scale is not None)
        yield self._raw(frame, "32FC1", depth.astype("<f4", copy=False))

    def _head(self, shot: Shot) -> Iterator[Stated]:
        """Report the camera model where it is another one than before, and what of the image is lost."""
        if self.each_camera_model or self.dialect.each_camera_model or shot.camera != self.camera_model:
            self.camera_model = shot.camera
            record = camera_model_record(shot.camera, shot.timestamp_ns, self.frame_id, self.dialect.fisheye)
            yield self.camera_model_topic, record
        self.losses.dropped(f"{self.field}.extras", "unknown fields of an image", count=bool(shot.extras))

    def _file(self, shot: Shot, form: str, content: bytes) -> Stated:
        return self.topic, CompressedImageRecord(shot.timestamp_ns, self.frame_id, form, memoryview(content))

    def _raw(self, shot: Shot, encoding: str, rows: Any) -> Stated:
        height, width = rows.shape[:2]
        data: UInt8Array = np.ascontiguousarray(rows).view(np.uint8).reshape(-1)
        size = width, height, len(data) // height
        return self.topic, ImageRecord(shot.timestamp_ns, self.frame_id, encoding, *size, data.data)


def _as_json(value: Any) -> Any:
    """Give a value as JSON says it."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float) and math.isfinite(value):
        return float(value)
    if isinstance(value, np.integer | np.floating | np.bool_):
        return _as_json(value.item())
    if isinstance(value, Mapping) and all(isinstance(name, str) for name in value):
        return {str(name): _as_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    raise ValueError(f"a {type(value).__name__}")


def _jpeg(rgb: UInt8Array) -> bytes:
    from simplejpeg import encode_jpeg

    content: bytes = encode_jpeg(np.ascontiguousarray(rgb), _JPEG_QUALITY, "RGB", "444")
    return content


def _png(rgb: UInt8Array) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "PNG", compress_level=1)
    return file.getvalue()


def _trajectory_of(scene: Scene) -> Poses | None:
    """The ego trajectory by which sensors on it are placed: the default trajectory, if it has orientations."""
    default = next(iter(scene.trajectories.values()), None)
    if default is None or default.quaternions_xyzw is None or len(default.timestamps_ns) == 0:
        return None
    return default.poses


def _transforms(child: str, parent: str, path: Poses) -> _Stream:
    def make(k: int) -> TransformRecord:
        return TransformRecord(int(path.timestamps_ns[k]), parent, child, path.positions[k], path.quaternions_xyzw[k])

    return _stream(path.timestamps_ns, _FRAMES_TOPIC, make)


def _camera_model_text(camera: Camera) -> str:
    """A camera model as JSON, for notes of ours."""
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
    return json.dumps([camera.model, camera.width, camera.height, numbers, list(camera.coefficients)])


def camera_model_record(camera: Camera, timestamp_ns: int, frame_id: str, fisheye: str) -> CameraModelRecord:
    """Put a camera model into the words of calibrations; one that they do not know is named as only we understand.

    Args:
        fisheye: what the format calls an OpenCV fisheye camera model.
    """
    model, numbers = _written_model(camera, fisheye)
    k = tuple(float(value) for value in camera.matrix.reshape(-1))
    if camera.model == UNKNOWN_MODEL:
        k = (0.0,) * 9
    p = (*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0)
    return CameraModelRecord(timestamp_ns, frame_id, camera.width, camera.height, model, numbers, k, p)


def _written_model(camera: Camera, fisheye: str) -> tuple[str, tuple[float, ...]]:
    if camera.model == UNKNOWN_MODEL:
        return "plumb_bob", (0.0,) * 5
    return to_ros(camera, fisheye) or (f"{OUR_PREFIX}{camera.model}", camera.coefficients)
