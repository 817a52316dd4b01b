"""Bags of ROS 1 and ROS 2: messages as records, a bag as a log of topics, as a scene, and written by rosbags."""

import json
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.messages.reader import scene_from_topics
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
    Kind,
    NotesRecord,
    PackedField,
    PoseRecord,
    SampleRecord,
    Topic,
    TransformRecord,
    merged,
    rotation_of,
    vector_of,
)
from sceneloom.formats.messages.ros_bags import Bag, Connection, open_bags
from sceneloom.formats.messages.writer import FIXED_FRAMES_TOPIC, SceneStreams, check_images
from sceneloom.scene.scene import Scene, with_assumed_models
from sceneloom.warnings import WarningKind

_NOTES_TOPIC = "/sceneloom/scene"  # the topic of what no message has a field for

_TIMESTAMPS = {"cdr": (4, "iI"), "ros1": (4, "II")}
"""Byte and form of the time in a header: behind the byte order in CDR, behind a counter of messages in ROS 1."""

_FIXED = "tf_static"

_FAULTS = (
    *(SerdeError, AssertionError, ValueError, IndexError, KeyError),
    *(AttributeError, OverflowError, TypeError, struct.error, MemoryError),
)
"""What rosbags and the readers of messages raise for bytes that are no message of their type."""


def _open_bag(
    path: Path,
    *,
    form: str,
    lenient: bool = False,
    assume_model: bool = False,
    timestamps: str | None = None,
    ego: str | None = None,
    world: str | None = None,
    distro: str | None = None,
) -> Scene:
    """Open a bag: its index and all small messages are read, images and points when they are asked for.

    Args:
        path: a `.bag`, a folder of ROS 2, or a file of it.
        form: name of the format.
        lenient: read what is whole of a bag that was not closed, is cut off or damaged; leave out topics and messages
            that are at fault; go by receive times where timestamps are of another clock.
        assume_model: allow computing with camera models whose formulas nothing confirms.
        timestamps: which time of a message counts: "header" or "receive"; None: that of its header.
        ego, world: names of the frames that are to be the ego and the world; None: chosen from the transforms.
        distro: of ROS, "humble", "noetic", …: whose types count where the bag does not define its own.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        bags = open_bags(path, ledger)
        try:
            log = _log_of(str(path), bags, distro)
            _note_not_read(log, ledger)
        except BaseException:
            for bag in bags:
                bag.close()
            raise
        scene = scene_from_topics(log, ledger, form=form, metadata={}, timestamps=timestamps, ego=ego, world=world)
    return with_assumed_models(scene) if assume_model else scene


open_ros1, open_ros2 = partial(_open_bag, form="ros1"), partial(_open_bag, form="ros2")
"""As `_open_bag`."""


@dataclass(frozen=True, slots=True, eq=False)
class _RosLog:
    """The topics of a bag, each with its connections by file; `distro` has the types that the bag does not define."""

    name: str
    bags: tuple[Bag, ...]
    topics: tuple[Topic, ...]
    parts: Mapping[int, tuple[tuple[int, int, int], ...]]
    distro: str | None
    notes: str | None = None

    def receive_times(self, topic: Topic) -> Int64Array:
        """When each message was recorded, (N,) int64 [ns]."""
        parts = [self.bags[file].received(number) for file, number, _ in self.parts[topic.number]]
        return np.concatenate([np.zeros(0, np.int64), *parts])

    def timestamps(self, topic: Topic) -> tuple[Int64Array, bool]:
        """The time that each message says itself; all of them are looked at."""
        found: list[int] = []
        for file, number, _ in self.parts[topic.number]:
            location, form = _TIMESTAMPS[self.bags[file].connections[number].encoding]
            cdr = self.bags[file].connections[number].encoding == "cdr"
            for k, head in enumerate(self.bags[file].heads(number, location + 8)):
                if len(head) < location + 8:
                    raise DataError(self.name, f"{topic.name}[{k}]", f"{len(head)} bytes; expected a message")
                order = "<" if not cdr or head[1] & 1 else ">"
                seconds, nanoseconds = struct.unpack_from(order + form, head, location)
                found.append(seconds * 1_000_000_000 + nanoseconds)
        return np.array(found, np.int64), True

    def read(self, topic: Topic, k: int) -> Sequence[AnyRecord]:
        """What message `k` says."""
        file, number, first = next(part for part in reversed(self.parts[topic.number]) if k >= part[2])
        connection = self.bags[file].connections[number]
        content = self.bags[file].data(number, k - first)
        try:
            store, kind = _store_of(connection, self.distro), connection.type
            parse = store.deserialize_cdr if connection.encoding == "cdr" else store.deserialize_ros1
            message = parse(content, kind)
            records = list(_READERS[connection.type][1](message))
        except _FAULTS as error:
            raise DataError(self.name, f"{topic.name}[{k}]", f"no {connection.type}: {error}") from error
        if topic.name.endswith(_FIXED):
            return [replace(one, fixed=True) if isinstance(one, TransformRecord) else one for one in records]
        return records

    def close(self) -> None:
        """Release the files."""
        for bag in self.bags:
            bag.close()


def _log_of(name: str, bags: Sequence[Bag], distro: str | None) -> _RosLog:
    """Put the files of a bag together: connections of one topic and type are one topic."""
    groups: dict[tuple[str, str, str], list[tuple[int, int]]] = {}
    for file, bag in enumerate(bags):
        for number, connection in enumerate(bag.connections):
            key = connection.topic, connection.type, connection.encoding
            groups.setdefault(key, []).append((file, number))
    topics, parts = [], {}
    for identifier, locations in enumerate(groups.values()):
        rows, count = [], 0
        for file, number in locations:
            rows.append((file, number, count))
            count += len(bags[file].received(number))
        parts[identifier] = tuple(rows)
        connection = bags[locations[0][0]].connections[locations[0][1]]
        topics.append(_topic(identifier, connection, count, distro))
    log = _RosLog(name, tuple(bags), tuple(topics), MappingProxyType(parts), distro)
    noted = next((topic for topic in topics if topic.kind is Kind.NOTES and topic.count), None)
    return log if noted is None else replace(log, notes=getattr(log.read(noted, 0)[0], "text", None))


def _topic(number: int, connection: Connection, count: int, distro: str | None) -> Topic:
    named = connection.topic, connection.type
    if connection.encoding not in _TIMESTAMPS:
        why = f"in the encoding {connection.encoding!r}; expected {' or '.join(_TIMESTAMPS)}"
        return Topic(number, *named, None, count, why)
    known = _READERS.get(connection.type)
    if known is None or (known[0] is Kind.NOTES and connection.topic != _NOTES_TOPIC):
        return Topic(number, *named, None, count)
    try:
        _store_of(connection, distro)
    except ValueError as error:
        return Topic(number, *named, None, count, f"{error}; name the ROS distribution with distro=")
    return Topic(number, *named, known[0], count)


def _note_not_read(log: _RosLog, ledger: Ledger) -> None:
    """Report what is left out of messages that are read."""
    if log.notes is not None:
        return
    for topic in log.topics:
        if topic.kind is not None and topic.count and topic.schema in _NOT_READ:
            message = f"{_NOT_READ[topic.schema]} in messages {topic.schema} are not read"
            location = f"{log.name}: {topic.name}"
            ledger.note(WarningKind.SKIPPED, "fields-not-read", location, message, count=topic.count)


_STORAGES = ("sqlite3", "mcap")  # what files of ROS 2 bags can be

_SECOND_NS = 1_000_000_000


def _dialect(*, videos: bool) -> Dialect:
    return Dialect(
        name="ROS",
        world="map",
        ego="base_link",
        part=_ros_part,
        fisheye="equidistant",
        camera_model_topic="camera_info",
        sample_topics=MappingProxyType(
            {"accelerometer": "data", "gyroscope": "data", "magnetometer": "mag", "imuTemperature": "temperature"}
        ),
        videos=videos,
        covariances=True,
        each_camera_model=True,
        intensity="f4",
    )


_KIND = FolderKind("bag of ROS 2", (r"metadata\.yaml", r"(?P<one>.+)\.(mcap|db3)"), r"metadata\.yaml")


def write_ros1(
    scene: Scene, path: Path, *, overwrite: bool = False, images: str = "jpeg", distro: str = "noetic"
) -> LossReport:
    """Write a `.bag`; one message is in memory at a time.

    Args:
        scene: the drive.
        path: of the file.
        overwrite: whether a file that is there may be replaced.
        images: see `write_ros2`.
        distro: of ROS 1, whose types are written.

    Raises:
        OptionError: there is no such distribution, or way of writing images.
        OutputError: the file exists, or cannot be written.
    """
    from rosbags.rosbag1 import Writer

    with replacing(path, overwrite=overwrite) as draft, Writer(draft) as bag:
        return _write(scene, bag, distro, images, ros1=True)


def write_ros2(
    scene: Scene,
    path: Path,
    *,
    overwrite: bool = False,
    storage: str = "mcap",
    images: str = "jpeg",
    distro: str = "humble",
) -> LossReport:
    """Write a folder with `metadata.yaml`; one message is in memory at a time.

    Args:
        scene: the drive.
        path: of the folder.
        overwrite: whether a folder that is there may be replaced.
        storage: "mcap" or "sqlite3".
        images: "jpeg" and "copy" write JPEG files, copied where the scene has them, "png" and "raw" lose nothing,
            "video" hands on videos packet by packet as messages of foxglove_msgs.
        distro: of ROS 2, whose types are written.

    Raises:
        OptionError: there is no such storage, distribution, or way of writing images.
        OutputError: the folder exists, or cannot be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    if storage not in _STORAGES:
        raise OptionError(f"storage {storage!r}; expected one of {', '.join(_STORAGES)}")
    plugin = StoragePlugin[storage.upper()]
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        draft.rmdir()
        with Writer(draft, version=9, storage_plugin=plugin) as bag:
            return _write(scene, bag, distro, images, ros1=False)


def _write(scene: Scene, bag: Any, distro: str, images: str, *, ros1: bool) -> LossReport:
    videos = images == "video"
    form = "copy" if videos or images == "jpeg" else images
    check_images(form)
    plan = SceneStreams(scene, _dialect(videos=videos), images=form)
    shift_ns = -(plan.start_ns // _SECOND_NS) * _SECOND_NS if plan.start_ns < 0 else 0
    store = _distro_store(distro)
    header = store.fielddefs.get("std_msgs/msg/Header")
    if header is not None and any(name == "seq" for name, _ in header[1]) is not ros1:
        raise OptionError(f"distro {distro!r}; expected one of ROS {1 if ros1 else 2}")
    if shift_ns:
        plan.notes["time_shift_ns"] = shift_ns
        what = f"times begin {shift_ns // _SECOND_NS} s later: ROS knows none before 0"
        plan.losses.converted("time_offset_ns", what)
    records = _Records(bag, store, _Messages(store, ros1=ros1, shift_ns=shift_ns), shift_ns, ros1=ros1)
    records.add(plan.start_ns, _NOTES_TOPIC, NotesRecord(0, json.dumps(plan.notes)))
    for time_ns, topic, record in merged(plan.streams):
        records.add(time_ns, topic, record)
    return LossReport.of(plan.losses.all)


class _Records:
    """Writes records to a bag; connections are added when they are first needed."""

    def __init__(self, bag: Any, store: Any, messages: "_Messages", shift_ns: int, *, ros1: bool) -> None:
        self._bag, self._store, self._messages, self._shift_ns = bag, store, messages, shift_ns
        self._ros1 = ros1
        self._connections: dict[tuple[str, str], Any] = {}

    def add(self, time_ns: int, topic: str, record: AnyRecord) -> None:
        kind, message = self._messages.of(record)
        serialise = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        try:
            self._bag.write(self._connection(topic, kind), time_ns + self._shift_ns, serialise(message, kind))
        except (OverflowError, ValueError) as error:
            raise OutputError(f"{topic}: {kind} cannot be written: {error}") from error

    def _connection(self, topic: str, kind: str) -> Any:
        known = self._connections.get((topic, kind))
        if known is None:
            further: dict[str, Any] = {}
            if topic in {FIXED_FRAMES_TOPIC, _NOTES_TOPIC}:
                further = {"latching": 1} if self._ros1 else {"offered_qos_profiles": [_latched()]}
            known = self._bag.add_connection(topic, kind, typestore=self._store, **further)
            self._connections[topic, kind] = known
        return known


def _latched() -> Any:
    """The quality of service of topics whose last message late subscribers get, too."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        avoid_ros_namespace_conventions=False,
    )


def _ros_part(identifier: str | int) -> str:
    """An id as one part of a ROS topic's name, of letters, digits and underscores; several ids may become one."""
    part = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in str(identifier)) or "_"
    return f"_{part}" if part[0].isdigit() else part


DEFINITIONS: Mapping[str, str] = MappingProxyType(
    {
        "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
        "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
        "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
        "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
        "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
        "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
        "vision_msgs/msg/ObjectHypothesisWithPose": (
            "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
        ),
        "vision_msgs/msg/Detection2D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            "vision_msgs/BoundingBox2D bbox\nstring id\n"
        ),
        "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
        "vision_msgs/msg/Detection3D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            "vision_msgs/BoundingBox3D bbox\nstring id\n"
        ),
        "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
        "foxglove_msgs/msg/CompressedVideo": (
            "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
        ),
    }
)
"""Definitions of types that rosbags does not have, by name; those that others use come before them.

Source: packages vision_msgs (4.0), tf2_msgs and foxglove_msgs of ROS 2.
"""

_USUAL_DISTRO = {"ros1": "noetic", "cdr": "humble"}
"""The distribution whose types are taken where nothing is stated, by the encoding of messages."""


@cache
def _distro_store(distro: str) -> Any:
    """Give the types of a distribution, and those that it lacks."""
    known = {store.value.partition("_")[2]: store for store in Stores if "_" in store.value}
    if distro not in known:
        raise OptionError(f"distro {distro!r}; expected one of {', '.join(known)}")
    store = get_typestore(known[distro])
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def _store_of(connection: Connection, distro: str | None) -> Any:
    """Give the types that a connection's messages are read with: the bag's own definition counts."""
    if connection.definition:
        return _defined(connection.type, connection.definition, connection.form)
    store = _distro_store(distro or _USUAL_DISTRO[connection.encoding])
    if connection.type not in store.fielddefs:
        raise ValueError(f"the bag does not define {connection.type}, and neither does ROS {distro or 'by itself'}")
    return store


@cache
def _defined(name: str, definition: str, form: str) -> Any:
    """The types that a text defines."""
    store = get_typestore(Stores.EMPTY)
    try:
        if form == "ros2idl":
            store.register(get_types_from_idl(definition))
        else:
            store.register(get_types_from_msg(definition, name))
    except (TypesysError, KeyError, ValueError) as error:
        raise ValueError(f"a definition of {name} that cannot be read: {error}") from error
    if name not in store.fielddefs:
        raise ValueError(f"the bag's definition of {name} does not define it")
    return store


_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""The types of `sensor_msgs/msg/PointField`."""

_NUMBERS = {dtype: number for number, dtype in _DATATYPES.items()}
_MICROTESLA = 1e-6
_ZERO_CELSIUS = 273.15

_NO_FIX = -1  # status of fixes without reception


def _timestamp_ns(stamp: Any) -> int:
    """A time of a message [ns]."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _head(message: Any) -> tuple[int, str]:
    """Time and frame."""
    return _timestamp_ns(message.header.stamp), _frame(message.header.frame_id)


def _frame(name: str) -> str:
    """Names of frames begin with a slash in old bags."""
    return name.lstrip("/")


def _bytes(data: Any) -> memoryview:
    return np.ascontiguousarray(data).data.cast("B")


def _transforms(message: Any) -> Iterable[TransformRecord]:
    for transform in getattr(message, "transforms", [message]):
        time_ns, parent = _head(transform)
        moved = transform.transform
        child = _frame(transform.child_frame_id)
        yield TransformRecord(time_ns, parent, child, vector_of(moved.translation), rotation_of(moved.rotation))


def _cloud(message: Any) -> Sequence[CloudRecord]:
    order = ">" if message.is_bigendian else "<"
    fields = tuple(
        PackedField(
            field.name, int(field.offset), np.dtype(order + _DATATYPES[field.datatype]), max(1, int(field.count))
        )
        for field in message.fields
        if field.datatype in _DATATYPES
    )
    width, height = int(message.width), int(message.height)
    rows = (int(message.row_step), width) if height > 1 else None
    data, stride = _bytes(message.data), int(message.point_step)
    return [CloudRecord(*_head(message), fields, stride, data, width * height, row_bytes=rows)]


def _image(message: Any) -> Sequence[ImageRecord]:
    size = int(message.width), int(message.height), int(message.step)
    return [
        ImageRecord(*_head(message), str(message.encoding), *size, _bytes(message.data), bool(message.is_bigendian))
    ]


def _compressed_image(message: Any) -> Sequence[CompressedImageRecord]:
    return [CompressedImageRecord(*_head(message), message.format.lower(), _bytes(message.data))]


def _video(message: Any) -> Sequence[CompressedImageRecord]:
    head = _timestamp_ns(message.timestamp), _frame(message.frame_id)
    return [CompressedImageRecord(*head, message.format.lower(), _bytes(message.data))]


def _camera_model(message: Any) -> Sequence[CameraModelRecord]:
    # ROS 1 writes their names in upper case
    rows = (getattr(message, name if hasattr(message, name) else name.upper()) for name in "dkp")
    numbers = (tuple(map(float, row)) for row in rows)
    size = int(message.width), int(message.height)
    return [CameraModelRecord(*_head(message), *size, message.distortion_model, *numbers)]


def _pose(message: Any) -> Sequence[PoseRecord]:
    pose, covariance = message.pose, None
    if hasattr(pose, "pose"):
        spread = np.array(pose.covariance, np.float64).reshape(6, 6)
        pose, covariance = pose.pose, spread if spread.any() else None
    rotation, body = rotation_of(pose.orientation), _frame(getattr(message, "child_frame_id", ""))
    reported = rotation if rotation.any() else None
    return [PoseRecord(*_head(message), vector_of(pose.position), reported, body, covariance)]


def _point(message: Any) -> Sequence[PoseRecord]:
    return [PoseRecord(*_head(message), vector_of(message.point), None)]


def _fix(message: Any) -> Sequence[FixRecord]:
    east, north, up = np.array(message.position_covariance, np.float64)[[0, 4, 8]].tolist()
    lla = float(message.latitude), float(message.longitude), float(message.altitude)
    variances = (east, north, up) if message.position_covariance_type else None
    return [FixRecord(*_head(message), lla, variances, received=message.status.status != _NO_FIX)]


def _imu(message: Any) -> Sequence[SampleRecord]:
    """Measurements; a first element -1 of their covariances says that there are none."""
    values: dict[str, tuple[float, ...]] = {}
    if message.linear_acceleration_covariance[0] != -1:
        values["accelerometer"] = tuple(vector_of(message.linear_acceleration).tolist())
    if message.angular_velocity_covariance[0] != -1:
        values["gyroscope"] = tuple(vector_of(message.angular_velocity).tolist())
    rotation = rotation_of(message.orientation)
    if message.orientation_covariance[0] != -1 and not lengths_of(rotation[None])[1][0]:
        values["orientation"] = tuple(rotation.tolist())
    return [SampleRecord(*_head(message), values)]


def _magnetic(message: Any) -> Sequence[SampleRecord]:
    field = vector_of(message.magnetic_field) / _MICROTESLA
    return [SampleRecord(*_head(message), {"magnetometer": tuple(field.tolist())})]


def _temperature(message: Any) -> Sequence[SampleRecord]:
    return [SampleRecord(*_head(message), {"imuTemperature": (float(message.temperature) + _ZERO_CELSIUS,)})]


def _label(detection: Any) -> tuple[str | None, dict[str, str]]:
    """Class and score of the likeliest hypothesis; packages before vision_msgs 4 have both in the result itself."""
    best, label = None, None
    for result in detection.results:
        hypothesis = getattr(result, "hypothesis", result)
        if best is None or hypothesis.score > best:
            best = float(hypothesis.score)
            label = str(getattr(hypothesis, "class_id", getattr(hypothesis, "id", "")))
    return label or None, {} if best is None else {"score": repr(best)}


def _boxes_3d(message: Any) -> Sequence[Boxes3DRecord]:
    time_ns, frame = _head(message)
    boxes = []
    for detection in message.detections:
        label, reported = _label(detection)
        center = detection.bbox.center
        boxes.append(
            Box3D(
                str(getattr(detection, "id", "")),
                _frame(detection.header.frame_id) or frame,
                vector_of(center.position),
                rotation_of(center.orientation),
                vector_of(detection.bbox.size),
                label,
                MappingProxyType(reported),
            )
        )
    return [Boxes3DRecord(time_ns, tuple(boxes))]


def _boxes_2d(message: Any) -> Sequence[Boxes2DRecord]:
    time_ns, frame = _head(message)
    boxes, rotated = [], 0
    for detection in message.detections:
        label, reported = _label(detection)
        box = detection.bbox
        center = getattr(box.center, "position", box.center)
        if box.center.theta != 0:
            rotated += 1
            continue
        width, height = float(box.size_x), float(box.size_y)
        corner = float(center.x) - width / 2, float(center.y) - height / 2
        named = str(getattr(detection, "id", ""))
        boxes.append(Box2D(named, (*corner, width, height), label, MappingProxyType(reported)))
    return [Boxes2DRecord(time_ns, frame, tuple(boxes), rotated)]


_Reader = Callable[[Any], Iterable[AnyRecord]]

_READERS: Mapping[str, tuple[Kind, _Reader]] = MappingProxyType(
    {
        "tf2_msgs/msg/TFMessage": (Kind.TRANSFORM, _transforms),
        "tf/msg/tfMessage": (Kind.TRANSFORM, _transforms),
        "geometry_msgs/msg/TransformStamped": (Kind.TRANSFORM, _transforms),
        "sensor_msgs/msg/PointCloud2": (Kind.CLOUD, _cloud),
        "sensor_msgs/msg/Image": (Kind.IMAGE, _image),
        "sensor_msgs/msg/CompressedImage": (Kind.COMPRESSED_IMAGE, _compressed_image),
        "foxglove_msgs/msg/CompressedVideo": (Kind.VIDEO, _video),
        "sensor_msgs/msg/CameraInfo": (Kind.CAMERA_MODEL, _camera_model),
        "nav_msgs/msg/Odometry": (Kind.POSE, _pose),
        "geometry_msgs/msg/PoseStamped": (Kind.POSE, _pose),
        "geometry_msgs/msg/PoseWithCovarianceStamped": (Kind.POSE, _pose),
        "geometry_msgs/msg/PointStamped": (Kind.POSE, _point),
        "sensor_msgs/msg/NavSatFix": (Kind.FIX, _fix),
        "sensor_msgs/msg/Imu": (Kind.SAMPLE, _imu),
        "sensor_msgs/msg/MagneticField": (Kind.SAMPLE, _magnetic),
        "sensor_msgs/msg/Temperature": (Kind.SAMPLE, _temperature),
        "vision_msgs/msg/Detection3DArray": (Kind.BOXES_3D, _boxes_3d),
        "vision_msgs/msg/Detection2DArray": (Kind.BOXES_2D, _boxes_2d),
        "std_msgs/msg/String": (Kind.NOTES, lambda message: [NotesRecord(0, message.data)]),
    }
)
"""The types that are read, by name: what they state, and what reads them."""

_NOT_READ: Mapping[str, str] = MappingProxyType(
    {
        "nav_msgs/msg/Odometry": "velocities",
        "sensor_msgs/msg/Imu": "covariances",
        "sensor_msgs/msg/MagneticField": "covariances",
        "sensor_msgs/msg/Temperature": "variances",
        "vision_msgs/msg/Detection3DArray": "hypotheses but the likeliest, and their poses,",
        "vision_msgs/msg/Detection2DArray": "hypotheses but the likeliest, and their poses,",
    }
)
"""What is left out of messages that are read."""

_DIAGONAL, _GPS = 2, 1
_VIDEOS = frozenset({"h264", "h265", "vp9", "av1"})
_LATEST_SECOND = 2**31 - 1
_Message = tuple[str, Mapping[str, Any] | tuple[Any, ...]]  # the type of a message, and its fields by name or in order


class _Messages:
    """Makes messages with the types of a store; of ROS 1, headers have a number, and matrices upper-case names."""

    def __init__(self, store: Any, *, ros1: bool, shift_ns: int) -> None:
        """Begin; `shift_ns` is added to all times."""
        self._types, self._ros1, self._shift_ns = store.types, ros1, shift_ns

    def of(self, record: AnyRecord) -> tuple[str, Any]:
        """Give the type of a record's message, and the message."""
        make = self._makers.get(type(record))
        if make is None:
            raise OutputError(f"a {type(record).__name__}; there is no message for it")
        name, fields = make(self, record)
        return name, self._types[name](**fields) if isinstance(fields, Mapping) else self._types[name](*fields)

    def _make(self, name: str, *arguments: Any, **fields: Any) -> Any:
        return self._types[name](*arguments, **fields)

    def _time(self, time_ns: int) -> Any:
        seconds, nanoseconds = divmod(time_ns + self._shift_ns, 1_000_000_000)
        if not 0 <= seconds <= _LATEST_SECOND:
            raise OutputError(f"time {time_ns} ns; ROS holds times from 0 to 2^31 seconds: move the scene in time")
        return self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

    def _header(self, time_ns: int, frame_id: str) -> Any:
        number = {"seq": 0} if self._ros1 else {}
        return self._make("std_msgs/msg/Header", **number, stamp=self._time(time_ns), frame_id=frame_id)

    def _of_geometry(self, name: str, numbers: Iterable[Any]) -> Any:
        """A point, vector or quaternion."""
        return self._make(f"geometry_msgs/msg/{name}", *map(float, numbers))

    def _pose(self, position: Any, quaternion_xyzw: Any) -> Any:
        parts = self._of_geometry("Point", position), self._of_geometry("Quaternion", quaternion_xyzw)
        return self._make("geometry_msgs/msg/Pose", *parts)

    def _spread_pose(self, position: Any, quaternion_xyzw: Any, covariance: Any = None) -> Any:
        """A pose with its covariance, zeros for none."""
        numbers = np.zeros(36) if covariance is None else np.ascontiguousarray(covariance, np.float64).reshape(-1)
        return self._make("geometry_msgs/msg/PoseWithCovariance", self._pose(position, quaternion_xyzw), numbers)

    def _transform(self, record: TransformRecord) -> _Message:
        place = self._of_geometry("Vector3", record.position), self._of_geometry("Quaternion", record.quaternion_xyzw)
        moved = self._make("geometry_msgs/msg/Transform", *place)
        head = self._header(record.timestamp_ns, record.parent)
        timestamped = self._make("geometry_msgs/msg/TransformStamped", head, record.child, moved)
        return "tf2_msgs/msg/TFMessage", ([timestamped],)

    def _cloud(self, record: CloudRecord) -> _Message:
        count = record.count or 0
        return "sensor_msgs/msg/PointCloud2", {
            "header": self._header(record.timestamp_ns, record.frame_id),
            "height": 1,
            "width": count,
            "fields": [
                self._make("sensor_msgs/msg/PointField", field.name, field.offset, _NUMBERS[field.dtype.str[1:]], 1)
                for field in record.fields
            ],
            "is_bigendian": False,
            "point_step": record.stride,
            "row_step": record.stride * count,
            "data": np.frombuffer(record.data, np.uint8),
            "is_dense": True,
        }

    def _image(self, record: ImageRecord) -> _Message:
        return "sensor_msgs/msg/Image", {
            "header": self._header(record.timestamp_ns, record.frame_id),
            "height": record.height,
            "width": record.width,
            "encoding": record.encoding,
            "is_bigendian": 0,
            "step": record.step,
            "data": np.frombuffer(record.data, np.uint8),
        }

    def _file(self, record: CompressedImageRecord) -> _Message:
        """An image's file, or a packet of a video."""
        data = np.frombuffer(record.data, np.uint8)
        if record.form in _VIDEOS:
            fields = self._time(record.timestamp_ns), record.frame_id, data, record.form
            return "foxglove_msgs/msg/CompressedVideo", fields
        head = self._header(record.timestamp_ns, record.frame_id)
        return "sensor_msgs/msg/CompressedImage", (head, record.form, data)

    def _camera_model(self, record: CameraModelRecord) -> _Message:
        numbers = {"d": record.coefficients, "k": record.k, "r": np.eye(3).reshape(-1), "p": record.p}
        return "sensor_msgs/msg/CameraInfo", {
            "header": self._header(record.timestamp_ns, record.frame_id),
            "height": record.height,
            "width": record.width,
            "distortion_model": record.model,
            "binning_x": 0,
            "binning_y": 0,
            "roi": self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, do_rectify=False),
            **{key.upper() if self._ros1 else key: np.array(row, np.float64) for key, row in numbers.items()},
        }

    def _posed(self, record: PoseRecord) -> _Message:
        """Where a body was; a point, where its orientation is not known."""
        head = self._header(record.timestamp_ns, record.frame_id)
        if record.quaternion_xyzw is None:
            return "geometry_msgs/msg/PointStamped", (head, self._of_geometry("Point", record.position))
        pose = self._spread_pose(record.position, record.quaternion_xyzw, record.covariance)
        still = self._make("geometry_msgs/msg/Twist", *(self._of_geometry("Vector3", (0, 0, 0)) for _ in range(2)))
        twist = self._make("geometry_msgs/msg/TwistWithCovariance", still, np.zeros(36))
        return "nav_msgs/msg/Odometry", (head, record.body, pose, twist)

    def _fix(self, record: FixRecord) -> _Message:
        spread = np.diag(record.variances or (0.0, 0.0, 0.0)).reshape(-1).astype(np.float64)
        status = self._make("sensor_msgs/msg/NavSatStatus", 0, _GPS)
        head, known = self._header(record.timestamp_ns, record.frame_id), record.variances is not None
        return "sensor_msgs/msg/NavSatFix", (head, status, *record.lla, spread, _DIAGONAL if known else 0)

    def _sample(self, record: SampleRecord) -> _Message:
        """What an IMU measured; what it did not is marked by -1 in the covariance."""
        head, values = self._header(record.timestamp_ns, record.frame_id), record.values
        if "magnetometer" in values:
            field = self._of_geometry("Vector3", np.array(values["magnetometer"]) * _MICROTESLA)
            return "sensor_msgs/msg/MagneticField", (head, field, np.zeros(9))
        if "imuTemperature" in values:
            return "sensor_msgs/msg/Temperature", (head, values["imuTemperature"][0] - _ZERO_CELSIUS, 0.0)
        missing = np.array([-1.0, *np.zeros(8)])
        parts: list[Any] = [self._of_geometry("Quaternion", (0, 0, 0, 1)), missing]
        for stream in ("gyroscope", "accelerometer"):
            vector = self._of_geometry("Vector3", values.get(stream, (0, 0, 0)))
            parts += [vector, np.zeros(9) if stream in values else missing]
        return "sensor_msgs/msg/Imu", (head, *parts)

    def _boxes_3d(self, record: Boxes3DRecord) -> _Message:
        detections = []
        for box in record.boxes:
            place = self._pose(box.center, box.quaternion_xyzw), self._of_geometry("Vector3", box.size_lwh)
            bounds = self._make("vision_msgs/msg/BoundingBox3D", *place)
            head = self._header(record.timestamp_ns, box.frame_id)
            parts = head, self._hypotheses(box.label), bounds, box.id
            detections.append(self._make("vision_msgs/msg/Detection3D", *parts))
        frame = record.boxes[0].frame_id if record.boxes else ""
        return "vision_msgs/msg/Detection3DArray", (self._header(record.timestamp_ns, frame), detections)

    def _boxes_2d(self, record: Boxes2DRecord) -> _Message:
        detections, head = [], self._header(record.timestamp_ns, record.frame_id)
        for box in record.boxes:
            left, top, width, height = box.box_ltwh
            point = self._make("vision_msgs/msg/Point2D", left + width / 2, top + height / 2)
            center = self._make("vision_msgs/msg/Pose2D", point, 0.0)
            bounds = self._make("vision_msgs/msg/BoundingBox2D", center, width, height)
            parts = head, self._hypotheses(box.label), bounds, box.id
            detections.append(self._make("vision_msgs/msg/Detection2D", *parts))
        return "vision_msgs/msg/Detection2DArray", (head, detections)

    def _hypotheses(self, label: str | None) -> list[Any]:
        if label is None:
            return []
        reported = self._make("vision_msgs/msg/ObjectHypothesis", label, 1.0)
        pose = self._spread_pose((0, 0, 0), (0, 0, 0, 1))
        return [self._make("vision_msgs/msg/ObjectHypothesisWithPose", reported, pose)]

    def _notes(self, record: NotesRecord) -> _Message:
        return "std_msgs/msg/String", (record.text,)

    _makers: ClassVar[Mapping[type[Any], Callable[["_Messages", Any], _Message]]] = MappingProxyType(
        {
            TransformRecord: _transform,
            CloudRecord: _cloud,
            ImageRecord: _image,
            CompressedImageRecord: _file,
            CameraModelRecord: _camera_model,
            PoseRecord: _posed,
            FixRecord: _fix,
            SampleRecord: _sample,
            Boxes3DRecord: _boxes_3d,
            Boxes2DRecord: _boxes_2d,
            NotesRecord: _notes,
        }
    )
