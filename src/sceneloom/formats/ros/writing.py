"""Records as messages of ROS.

Source: packages sensor_msgs, nav_msgs, geometry_msgs, tf2_msgs and vision_msgs of ROS 2.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.errors import OutputError
from sceneloom.formats.ros.reading import DATATYPES, MICROTESLA, ZERO_CELSIUS
from sceneloom.formats.topics.records import (
    AnyRecord,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    CloudRecord,
    CompressedImageRecord,
    FixRecord,
    ImageRecord,
    NotesRecord,
    PoseRecord,
    SampleRecord,
    TransformRecord,
)

_NUMBERS = {dtype: number for number, dtype in DATATYPES.items()}
_DIAGONAL = 2
_GPS = 1
_VIDEOS = frozenset({"h264", "h265", "vp9", "av1"})
_LATEST_SECOND = 2**31 - 1

Message = tuple[str, Any]


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

    def of(self, record: AnyRecord) -> Message:
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
            raise OutputError(
                f"time {time_ns} ns; ROS holds times from 0 to 2^31 seconds: move the scene in time"
            )
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
        numbers = (
            np.zeros(36) if covariance is None else np.ascontiguousarray(covariance, np.float64).reshape(-1)
        )
        return self.make("geometry_msgs/msg/PoseWithCovariance", pose, numbers)

    def transform(self, record: TransformRecord) -> Message:
        """Where a frame is."""
        moved = self.make(
            "geometry_msgs/msg/Transform", self.vector(record.position), self.rotation(record.quaternion_xyzw)
        )
        head = self.header(record.timestamp_ns, record.parent)
        timestamped = self.make("geometry_msgs/msg/TransformTimestamped", head, record.child, moved)
        return "tf2_msgs/msg/TFMessage", self.make("tf2_msgs/msg/TFMessage", [timestamped])

    def cloud(self, record: CloudRecord) -> Message:
        """Points."""
        fields = [
            self.make(
                "sensor_msgs/msg/PointField", field.name, field.offset, _NUMBERS[field.dtype.str[1:]], 1
            )
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

    def image(self, record: ImageRecord) -> Message:
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

    def compressed_image(self, record: CompressedImageRecord) -> Message:
        """An image's file, or a packet of a video."""
        data = np.frombuffer(record.data, np.uint8)
        if record.form in _VIDEOS:
            name = "foxglove_msgs/msg/CompressedVideo"
            return name, self.make(name, self.time(record.timestamp_ns), record.frame_id, data, record.form)
        name = "sensor_msgs/msg/CompressedImage"
        return name, self.make(name, self.header(record.timestamp_ns, record.frame_id), record.form, data)

    def camera_model(self, record: CameraModelRecord) -> Message:
        """A camera model."""
        name = "sensor_msgs/msg/CameraInfo"
        numbers = {"d": record.coefficients, "k": record.k, "r": np.eye(3).reshape(-1), "p": record.p}
        named = {
            key.upper() if self._ros1 else key: np.array(row, np.float64) for key, row in numbers.items()
        }
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

    def trajectory(self, record: PoseRecord) -> Message:
        """Where a body was; a point, where its orientation is not known."""
        head = self.header(record.timestamp_ns, record.frame_id)
        if record.quaternion_xyzw is None:
            point = self.make("geometry_msgs/msg/Point", *map(float, record.position))
            return "geometry_msgs/msg/PointTimestamped", self.make(
                "geometry_msgs/msg/PointTimestamped", head, point
            )
        pose = self.spread_pose(self.pose(record.position, record.quaternion_xyzw), record.covariance)
        still = self.make("geometry_msgs/msg/Twist", self.vector((0, 0, 0)), self.vector((0, 0, 0)))
        twist = self.make("geometry_msgs/msg/TwistWithCovariance", still, np.zeros(36))
        return "nav_msgs/msg/Odometry", self.make("nav_msgs/msg/Odometry", head, record.body, pose, twist)

    def fix(self, record: FixRecord) -> Message:
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

    def sample(self, record: SampleRecord) -> Message:
        """What an IMU measured; what it did not is marked by -1 in the covariance."""
        head, values = self.header(record.timestamp_ns, record.frame_id), record.values
        if "magnetometer" in values:
            field = self.vector(np.array(values["magnetometer"]) * MICROTESLA)
            name = "sensor_msgs/msg/MagneticField"
            return name, self.make(name, head, field, np.zeros(9))
        if "imuTemperature" in values:
            name = "sensor_msgs/msg/Temperature"
            return name, self.make(name, head, values["imuTemperature"][0] - ZERO_CELSIUS, 0.0)
        name, missing = "sensor_msgs/msg/Imu", np.array([-1.0, *np.zeros(8)])
        parts: list[Any] = [self.rotation((0, 0, 0, 1)), missing]
        for stream in ("gyroscope", "accelerometer"):
            parts += [
                self.vector(values.get(stream, (0, 0, 0))),
                np.zeros(9) if stream in values else missing,
            ]
        return name, self.make(name, head, *parts)

    def boxes_3d(self, record: Boxes3DRecord) -> Message:
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

    def boxes_2d(self, record: Boxes2DRecord) -> Message:
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

    def notes(self, record: NotesRecord) -> Message:
        """What no message has a location for."""
        return "std_msgs/msg/String", self.make("std_msgs/msg/String", record.text)


_MAKERS: Mapping[type[Any], Callable[[Messages, Any], Message]] = MappingProxyType(
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
