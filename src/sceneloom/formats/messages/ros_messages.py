"""Messages of ROS: their types, and records read from them and written as them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from sceneloom.arrays import Float64Array
from sceneloom.errors import OptionError, OutputError
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.messages.records import (
    AnyRecord,
    Box2D,
    Box3D,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    CloudRecord,
    CompressedImageRecord,
    FixRecord,
    ImageRecord,
    Kind,
    NotesRecord,
    PackedField,
    PoseRecord,
    SampleRecord,
    TransformRecord,
)
from sceneloom.formats.messages.ros_bags import Connection

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


def _distros() -> tuple[str, ...]:
    """The distributions whose types are known."""
    return tuple(store.value.partition("_")[2] for store in Stores if "_" in store.value)


@cache
def distro_store(distro: str) -> Any:
    """Give the types of a distribution, and those that it lacks.

    Raises:
        OptionError: there is no such distribution.
    """
    found = [store for store in Stores if store.value.partition("_")[2] == distro]
    if not found:
        raise OptionError(f"distro {distro!r}; expected one of {', '.join(_distros())}")
    store = get_typestore(found[0])
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def store_of(connection: Connection, distro: str | None) -> Any:
    """Give the types that a connection's messages are read with: the bag's own definition counts.

    Raises:
        ValueError: the bag has no definition of the type, and the distribution does not know it either.
        OptionError: there is no such distribution.
    """
    if connection.definition:
        return _defined(connection.type, connection.definition, connection.form)
    store = distro_store(distro or _USUAL_DISTRO[connection.encoding])
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


_DATATYPES: Mapping[int, str] = MappingProxyType(
    {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
)
"""The types of `sensor_msgs/msg/PointField`."""

_MICROTESLA = 1e-6
_ZERO_CELSIUS = 273.15

_NO_FIX = -1
"""Status of fixes without reception."""


def _timestamp_ns(stamp: Any) -> int:
    """A time of a message [ns]."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _head(message: Any) -> tuple[int, str]:
    """Time and frame; names of frames begin with a slash in old bags."""
    return _timestamp_ns(message.header.stamp), _frame(message.header.frame_id)


def _frame(name: str) -> str:
    return name.lstrip("/")


def _vector(vector: Any) -> Float64Array:
    return np.array([vector.x, vector.y, vector.z])


def _rotation(quaternion: Any) -> Float64Array:
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])


def _bytes(data: Any) -> memoryview:
    return np.ascontiguousarray(data).data.cast("B")


def _transforms(message: Any) -> Iterable[TransformRecord]:
    for transform in getattr(message, "transforms", [message]):
        time_ns, parent = _head(transform)
        moved = transform.transform
        child = _frame(transform.child_frame_id)
        yield TransformRecord(time_ns, parent, child, _vector(moved.translation), _rotation(moved.rotation))


def _cloud(message: Any) -> Sequence[CloudRecord]:
    order: Literal["<", ">"] = ">" if message.is_bigendian else "<"
    fields = tuple(
        PackedField(
            field.name,
            int(field.offset),
            np.dtype(_DATATYPES[field.datatype]).newbyteorder(order),
            max(1, int(field.count)),
        )
        for field in message.fields
        if field.datatype in _DATATYPES
    )
    return [
        CloudRecord(
            *_head(message),
            fields,
            int(message.point_step),
            _bytes(message.data),
            int(message.width) * int(message.height),
            row_bytes=(int(message.row_step), int(message.width)) if message.height > 1 else None,
        )
    ]


def _image(message: Any) -> Sequence[ImageRecord]:
    return [
        ImageRecord(
            *_head(message),
            str(message.encoding),
            int(message.width),
            int(message.height),
            int(message.step),
            _bytes(message.data),
            bool(message.is_bigendian),
        )
    ]


def _compressed_image(message: Any) -> Sequence[CompressedImageRecord]:
    return [CompressedImageRecord(*_head(message), message.format.lower(), _bytes(message.data))]


def _video(message: Any) -> Sequence[CompressedImageRecord]:
    form = message.format.lower()
    return [
        CompressedImageRecord(_timestamp_ns(message.timestamp), _frame(message.frame_id), form, _bytes(message.data))
    ]


def _camera_model(message: Any) -> Sequence[CameraModelRecord]:
    numbers = {name: tuple(map(float, _either(message, name))) for name in "dkp"}
    return [
        CameraModelRecord(
            *_head(message),
            int(message.width),
            int(message.height),
            message.distortion_model,
            numbers["d"],
            numbers["k"],
            numbers["p"],
        )
    ]


def _either(message: Any, name: str) -> Any:
    """A field that ROS 1 writes in upper case."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())


def _pose(message: Any) -> Sequence[PoseRecord]:
    pose, covariance = message.pose, None
    if hasattr(pose, "pose"):
        spread = np.array(pose.covariance, np.float64).reshape(6, 6)
        pose, covariance = pose.pose, spread if spread.any() else None
    rotation, body = _rotation(pose.orientation), _frame(getattr(message, "child_frame_id", ""))
    reported = rotation if rotation.any() else None
    return [PoseRecord(*_head(message), _vector(pose.position), reported, body, covariance)]


def _point(message: Any) -> Sequence[PoseRecord]:
    return [PoseRecord(*_head(message), _vector(message.point), None)]


def _fix(message: Any) -> Sequence[FixRecord]:
    covariance = np.array(message.position_covariance, np.float64)
    variances = (float(covariance[0]), float(covariance[4]), float(covariance[8]))
    return [
        FixRecord(
            *_head(message),
            (float(message.latitude), float(message.longitude), float(message.altitude)),
            variances if message.position_covariance_type else None,
            received=message.status.status != _NO_FIX,
        )
    ]


def _imu(message: Any) -> Sequence[SampleRecord]:
    """Measurements; a first element -1 of their covariances says that there are none."""
    values: dict[str, tuple[float, ...]] = {}
    if message.linear_acceleration_covariance[0] != -1:
        values["accelerometer"] = tuple(_vector(message.linear_acceleration).tolist())
    if message.angular_velocity_covariance[0] != -1:
        values["gyroscope"] = tuple(_vector(message.angular_velocity).tolist())
    rotation = _rotation(message.orientation)
    if message.orientation_covariance[0] != -1 and not lengths_of(rotation[None])[1][0]:
        values["orientation"] = tuple(rotation.tolist())
    return [SampleRecord(*_head(message), values)]


def _magnetic(message: Any) -> Sequence[SampleRecord]:
    field = _vector(message.magnetic_field) / _MICROTESLA
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
                _vector(center.position),
                _rotation(center.orientation),
                _vector(detection.bbox.size),
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


def _notes(message: Any) -> Sequence[NotesRecord]:
    return [NotesRecord(0, message.data)]


_Reader = Callable[[Any], Iterable[AnyRecord]]

READERS: Mapping[str, tuple[Kind, _Reader]] = MappingProxyType(
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
        "std_msgs/msg/String": (Kind.NOTES, _notes),
    }
)
"""The types that are read, by name: what they state, and what reads them."""

NOT_READ: Mapping[str, str] = MappingProxyType(
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

_NUMBERS = {dtype: number for number, dtype in _DATATYPES.items()}
_DIAGONAL = 2
_GPS = 1
_VIDEOS = frozenset({"h264", "h265", "vp9", "av1"})
_LATEST_SECOND = 2**31 - 1
_Message = tuple[str, Any]


class Messages:
    """Makes messages with the types of a store; of ROS 1, headers have a number, and matrices upper-case names."""

    def __init__(self, store: Any, *, ros1: bool, shift_ns: int) -> None:
        """Begin.

        Args:
            store: of types.
            ros1: whether they are those of ROS 1.
            shift_ns: what is added to all times.
        """
        self._types, self._ros1, self._shift_ns = store.types, ros1, shift_ns

    def of(self, record: AnyRecord) -> _Message:
        """Give the type of a record's message, and the message.

        Raises:
            OutputError: there is no message for it, or its time is beyond what ROS can state.
        """
        make = _MAKERS.get(type(record))
        if make is None:
            raise OutputError(f"a {type(record).__name__}; there is no message for it")
        return make(self, record)

    def make(self, name: str, *arguments: Any, **fields: Any) -> Any:
        """Make a message of a type."""
        return self._types[name](*arguments, **fields)

    def time(self, time_ns: int) -> Any:
        """A time of a message."""
        seconds, nanoseconds = divmod(time_ns + self._shift_ns, 1_000_000_000)
        if not 0 <= seconds <= _LATEST_SECOND:
            raise OutputError(f"time {time_ns} ns; ROS holds times from 0 to 2^31 seconds: move the scene in time")
        return self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

    def header(self, time_ns: int, frame_id: str) -> Any:
        """The header of a message."""
        number = {"seq": 0} if self._ros1 else {}
        return self.make("std_msgs/msg/Header", **number, stamp=self.time(time_ns), frame_id=frame_id)

    def vector(self, values: Any) -> Any:
        """A vector."""
        return self.make("geometry_msgs/msg/Vector3", *map(float, values))

    def pose(self, position: Any, quaternion_xyzw: Any) -> Any:
        """A pose."""
        point = self.make("geometry_msgs/msg/Point", *map(float, position))
        return self.make("geometry_msgs/msg/Pose", point, self.rotation(quaternion_xyzw))

    def rotation(self, quaternion_xyzw: Any) -> Any:
        """A quaternion."""
        return self.make("geometry_msgs/msg/Quaternion", *map(float, quaternion_xyzw))

    def spread_pose(self, pose: Any, covariance: Any) -> Any:
        """A pose with its covariance, zeros for none."""
        numbers = np.zeros(36) if covariance is None else np.ascontiguousarray(covariance, np.float64).reshape(-1)
        return self.make("geometry_msgs/msg/PoseWithCovariance", pose, numbers)

    def transform(self, record: TransformRecord) -> _Message:
        """Where a frame is."""
        moved = self.make(
            "geometry_msgs/msg/Transform", self.vector(record.position), self.rotation(record.quaternion_xyzw)
        )
        head = self.header(record.timestamp_ns, record.parent)
        timestamped = self.make("geometry_msgs/msg/TransformStamped", head, record.child, moved)
        return "tf2_msgs/msg/TFMessage", self.make("tf2_msgs/msg/TFMessage", [timestamped])

    def cloud(self, record: CloudRecord) -> _Message:
        """Points."""
        fields = [
            self.make("sensor_msgs/msg/PointField", field.name, field.offset, _NUMBERS[field.dtype.str[1:]], 1)
            for field in record.fields
        ]
        count = record.count or 0
        name = "sensor_msgs/msg/PointCloud2"
        return name, self.make(
            name,
            header=self.header(record.timestamp_ns, record.frame_id),
            height=1,
            width=count,
            fields=fields,
            is_bigendian=False,
            point_step=record.stride,
            row_step=record.stride * count,
            data=np.frombuffer(record.data, np.uint8),
            is_dense=True,
        )

    def image(self, record: ImageRecord) -> _Message:
        """Pixels."""
        name = "sensor_msgs/msg/Image"
        return name, self.make(
            name,
            header=self.header(record.timestamp_ns, record.frame_id),
            height=record.height,
            width=record.width,
            encoding=record.encoding,
            is_bigendian=0,
            step=record.step,
            data=np.frombuffer(record.data, np.uint8),
        )

    def compressed_image(self, record: CompressedImageRecord) -> _Message:
        """An image's file, or a packet of a video."""
        data = np.frombuffer(record.data, np.uint8)
        if record.form in _VIDEOS:
            name = "foxglove_msgs/msg/CompressedVideo"
            return name, self.make(name, self.time(record.timestamp_ns), record.frame_id, data, record.form)
        name = "sensor_msgs/msg/CompressedImage"
        return name, self.make(name, self.header(record.timestamp_ns, record.frame_id), record.form, data)

    def camera_model(self, record: CameraModelRecord) -> _Message:
        """A camera model."""
        name = "sensor_msgs/msg/CameraInfo"
        numbers = {"d": record.coefficients, "k": record.k, "r": np.eye(3).reshape(-1), "p": record.p}
        named = {key.upper() if self._ros1 else key: np.array(row, np.float64) for key, row in numbers.items()}
        region = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, do_rectify=False)
        return name, self.make(
            name,
            header=self.header(record.timestamp_ns, record.frame_id),
            height=record.height,
            width=record.width,
            distortion_model=record.model,
            binning_x=0,
            binning_y=0,
            roi=region,
            **named,
        )

    def trajectory(self, record: PoseRecord) -> _Message:
        """Where a body was; a point, where its orientation is not known."""
        head = self.header(record.timestamp_ns, record.frame_id)
        if record.quaternion_xyzw is None:
            point = self.make("geometry_msgs/msg/Point", *map(float, record.position))
            return "geometry_msgs/msg/PointStamped", self.make("geometry_msgs/msg/PointStamped", head, point)
        pose = self.spread_pose(self.pose(record.position, record.quaternion_xyzw), record.covariance)
        still = self.make("geometry_msgs/msg/Twist", self.vector((0, 0, 0)), self.vector((0, 0, 0)))
        twist = self.make("geometry_msgs/msg/TwistWithCovariance", still, np.zeros(36))
        return "nav_msgs/msg/Odometry", self.make("nav_msgs/msg/Odometry", head, record.body, pose, twist)

    def fix(self, record: FixRecord) -> _Message:
        """Where a satellite receiver was."""
        known = record.variances is not None
        name = "sensor_msgs/msg/NavSatFix"
        return name, self.make(
            name,
            self.header(record.timestamp_ns, record.frame_id),
            self.make("sensor_msgs/msg/NavSatStatus", 0, _GPS),
            *record.lla,
            np.diag(record.variances or (0.0, 0.0, 0.0)).reshape(-1).astype(np.float64),
            _DIAGONAL if known else 0,
        )

    def sample(self, record: SampleRecord) -> _Message:
        """What an IMU measured; what it did not is marked by -1 in the covariance."""
        head, values = self.header(record.timestamp_ns, record.frame_id), record.values
        if "magnetometer" in values:
            field = self.vector(np.array(values["magnetometer"]) * _MICROTESLA)
            name = "sensor_msgs/msg/MagneticField"
            return name, self.make(name, head, field, np.zeros(9))
        if "imuTemperature" in values:
            name = "sensor_msgs/msg/Temperature"
            return name, self.make(name, head, values["imuTemperature"][0] - _ZERO_CELSIUS, 0.0)
        name, missing = "sensor_msgs/msg/Imu", np.array([-1.0, *np.zeros(8)])
        parts: list[Any] = [self.rotation((0, 0, 0, 1)), missing]
        for stream in ("gyroscope", "accelerometer"):
            parts += [
                self.vector(values.get(stream, (0, 0, 0))),
                np.zeros(9) if stream in values else missing,
            ]
        return name, self.make(name, head, *parts)

    def boxes_3d(self, record: Boxes3DRecord) -> _Message:
        """Boxes in space."""
        detections = [
            self.make(
                "vision_msgs/msg/Detection3D",
                self.header(record.timestamp_ns, box.frame_id),
                self._hypotheses(box.label),
                self.make(
                    "vision_msgs/msg/BoundingBox3D",
                    self.pose(box.center, box.quaternion_xyzw),
                    self.vector(box.size_lwh),
                ),
                box.id,
            )
            for box in record.boxes
        ]
        frame = record.boxes[0].frame_id if record.boxes else ""
        name = "vision_msgs/msg/Detection3DArray"
        return name, self.make(name, self.header(record.timestamp_ns, frame), detections)

    def boxes_2d(self, record: Boxes2DRecord) -> _Message:
        """Boxes in an image."""
        detections = []
        for box in record.boxes:
            left, top, width, height = box.box_ltwh
            point = self.make("vision_msgs/msg/Point2D", left + width / 2, top + height / 2)
            center = self.make("vision_msgs/msg/Pose2D", point, 0.0)
            detections.append(
                self.make(
                    "vision_msgs/msg/Detection2D",
                    self.header(record.timestamp_ns, record.frame_id),
                    self._hypotheses(box.label),
                    self.make("vision_msgs/msg/BoundingBox2D", center, width, height),
                    box.id,
                )
            )
        name = "vision_msgs/msg/Detection2DArray"
        return name, self.make(name, self.header(record.timestamp_ns, record.frame_id), detections)

    def _hypotheses(self, label: str | None) -> list[Any]:
        if label is None:
            return []
        reported = self.make("vision_msgs/msg/ObjectHypothesis", label, 1.0)
        nowhere = self.spread_pose(self.pose((0, 0, 0), (0, 0, 0, 1)), None)
        return [self.make("vision_msgs/msg/ObjectHypothesisWithPose", reported, nowhere)]

    def notes(self, record: NotesRecord) -> _Message:
        """What no message has a field for."""
        return "std_msgs/msg/String", self.make("std_msgs/msg/String", record.text)


_MAKERS: Mapping[type[Any], Callable[[Messages, Any], _Message]] = MappingProxyType(
    {
        TransformRecord: Messages.transform,
        CloudRecord: Messages.cloud,
        ImageRecord: Messages.image,
        CompressedImageRecord: Messages.compressed_image,
        CameraModelRecord: Messages.camera_model,
        PoseRecord: Messages.trajectory,
        FixRecord: Messages.fix,
        SampleRecord: Messages.sample,
        Boxes3DRecord: Messages.boxes_3d,
        Boxes2DRecord: Messages.boxes_2d,
        NotesRecord: Messages.notes,
    }
)
