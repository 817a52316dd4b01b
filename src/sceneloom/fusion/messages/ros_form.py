"""Records as messages of ROS 2, which are mappings here: what a ROS library takes and gives field by field.

Pictures are `sensor_msgs/msg/Image` or `CompressedImage`, clouds `PointCloud2`, boxes `Detection3DArray` and
`Detection2DArray` of vision_msgs. These messages know neither sensor_id nor seq, so they are given on reading; speeds,
and the type and beams of a lidar, have no place in them.

Source: the message definitions of ROS 2, packages sensor_msgs and vision_msgs (4.1).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.errors import DataError, OptionError
from sceneloom.fusion.messages.array_bytes import bytes_of
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.encodings import ENCODINGS
from sceneloom.fusion.messages.foreign_pictures import image_of_file, image_of_rows
from sceneloom.fusion.messages.foreign_values import (
    ForeignMessage,
    ForeignRecord,
    direction_of_quaternion,
    quaternion_of_direction,
    rows_of_three,
)
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.packed_points import PackedField, rows_of, unpack_points
from sceneloom.fusion.messages.scene_form.boxes import whole_corners
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData
from sceneloom.fusion.messages.timestamps import Timestamp

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
DETECTIONS_3D = "vision_msgs/msg/Detection3DArray"
DETECTIONS_2D = "vision_msgs/msg/Detection2DArray"

DATATYPES: Mapping[int, str] = MappingProxyType(
    {1: "int8", 2: "uint8", 3: "int16", 4: "uint16", 5: "int32", 6: "uint32", 7: "float32", 8: "float64"}
)
"""The types of `sensor_msgs/msg/PointField`."""

_UNNAMED = {"8UC1": 1, "8UC2": 2, "8UC3": 3, "8UC4": 4}
"""Encodings that do not say what the values of a pixel mean, and how many there are."""

_LATEST_SECOND = 2**31 - 1


@dataclass(frozen=True, slots=True)
class RosMessage:
    """A message of ROS.

    Attributes:
        type: its type, "package/msg/Name".
        content: its fields by name; messages in it are mappings, arrays of uint8 are bytes.
    """

    type: str
    content: Mapping[str, Any]


RosRecord = ImageData | PointCloudData | Boxes3d | Boxes2d | FusedDetections
"""The records that have a message in ROS."""


def to_ros(record: RosRecord, *, frame_id: str) -> RosMessage:
    """Give the message of a record.

    Args:
        frame_id: the frame as ROS calls it.

    Raises:
        DataError: the time is beyond 2^31 seconds, which ROS cannot say.
        OptionError: there is no message for such records.
    """
    write = _WRITERS.get(type(record))
    if write is None:
        known = ", ".join(record_type.__name__ for record_type in _WRITERS)
        raise OptionError(f"a {type(record).__name__}; expected one of {known}")
    return write(record, _header(record.timestamp, frame_id))


def from_ros(message: RosMessage, *, sensor_id: int, seq: int) -> ForeignRecord:
    """Give the record of a message.

    Of each detection its likeliest class is taken; points without a finite position are left out.

    Args:
        sensor_id: of the sensor, which the message does not know.
        seq: of the record, likewise.

    Raises:
        DataError: a field is missing, of another type, or cannot stand in a record.
        OptionError: there is no record for such messages.
    """
    read = _READERS.get(message.type)
    if read is None:
        raise OptionError(f"a message {message.type!r}; expected one of {', '.join(_READERS)}")
    content = ForeignMessage(message.type, message.content)
    stamp = content.inner("header").inner("stamp").timestamp("sec", "nanosec")
    # what is too large for 32 bits becomes infinite, which no record holds
    with np.errstate(over="ignore", invalid="ignore"):
        return cast("ForeignRecord", read(content, {"sensor_id": sensor_id, "seq": seq, "timestamp": stamp}))


def _header(timestamp: Timestamp, frame_id: str) -> dict[str, Any]:
    if timestamp.s > _LATEST_SECOND:
        raise DataError("ROS header", "stamp.sec", f"{timestamp.s}; expected 0 to {_LATEST_SECOND}")
    return {"stamp": {"sec": timestamp.s, "nanosec": timestamp.ns}, "frame_id": frame_id}


def _write_image(record: ImageData, header: dict[str, Any]) -> RosMessage:
    data = bytes_of(record.data)
    if ENCODINGS[record.encoding].is_file:
        return RosMessage(COMPRESSED_IMAGE, {"header": header, "format": record.encoding, "data": data})
    encoding = f"8UC{record.channel}" if record.encoding == "raw" else record.encoding
    content = {
        "header": header,
        "height": record.height,
        "width": record.width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": record.width * record.channel,
        "data": data,
    }
    return RosMessage(IMAGE, content)


def _read_image(message: ForeignMessage, common: dict[str, Any]) -> ImageData:
    named = message.text("encoding")
    if named in _UNNAMED:
        return image_of_rows(message, "raw", _UNNAMED[named], common)
    known = ENCODINGS.get(named)
    if known is None or known.order is None:
        names = (*(name for name in ENCODINGS if ENCODINGS[name].order), *_UNNAMED)
        raise message.fault("encoding", f"{named!r}; expected one of {', '.join(names)}")
    return image_of_rows(message, named, min(known.channels), common)


def _write_points(record: PointCloudData, header: dict[str, Any]) -> RosMessage:
    stride = 4 * record.fields_number
    fields = [
        {"name": name, "offset": 4 * k, "datatype": 7, "count": 1} for k, name in enumerate(record.fields)
    ]
    content = {
        "header": header,
        "height": 1,
        "width": record.number,
        "fields": fields,
        "is_bigendian": False,
        "point_step": stride,
        "row_step": stride * record.number,
        "data": bytes_of(record.data),
        "is_dense": True,
    }
    return RosMessage(POINT_CLOUD, content)


def _read_points(message: ForeignMessage, common: dict[str, Any]) -> PointCloudData:
    height, width = message.whole("height"), message.whole("width")
    rows = rows_of(
        message.content_bytes("data"),
        count=height * width,
        stride=message.whole("point_step"),
        owner=message.owner,
        row=(height, message.whole("row_step")),
    )
    names, table = unpack_points(
        rows,
        [_field(field) for field in message.each("fields")],
        owner=message.owner,
        seconds=common["timestamp"].s,
        big_endian=bool(message.value("is_bigendian")),
    )
    return PointCloudData(number=len(table), fields=names, fields_number=len(names), data=table, **common)


def _field(field: ForeignMessage) -> PackedField:
    datatype = field.whole("datatype")
    if datatype not in DATATYPES:
        raise field.fault("datatype", f"{datatype}; expected 1 to 8")
    return PackedField(field.text("name"), field.whole("offset"), DATATYPES[datatype], field.whole("count"))


def _write_boxes_3d(record: Boxes3d | FusedDetections, header: dict[str, Any]) -> RosMessage:
    covariances = getattr(record, "center_covs", None)
    detections = []
    for k, number in enumerate(record.id.tolist()):
        if not record.directions[k].any():
            continue
        pose = {
            "position": dict(zip("xyz", record.centers[k].tolist(), strict=True)),
            "orientation": dict(
                zip("xyzw", quaternion_of_direction(record.directions[k]).tolist(), strict=True)
            ),
        }
        covariance = np.zeros((6, 6))
        if covariances is not None:
            covariance[:3, :3] = covariances[k]
        result = _result(record, k, pose, covariance)
        size = dict(zip("xyz", record.sizes_lwh[k].tolist(), strict=True))
        bbox = {"center": pose, "size": size}
        detections.append({"header": header, "results": [result], "bbox": bbox, "id": str(number)})
    return RosMessage(DETECTIONS_3D, {"header": header, "detections": detections})


def _result(record: Any, k: int, pose: dict[str, Any], covariance: Any) -> dict[str, Any]:
    hypothesis = {"class_id": record.class_names[k], "score": float(record.confidence[k])}
    return {"hypothesis": hypothesis, "pose": {"pose": pose, "covariance": covariance.reshape(-1).tolist()}}


def _read_boxes_3d(message: ForeignMessage, common: dict[str, Any]) -> Boxes3d:
    detections = message.each("detections")
    boxes = [detection.inner("bbox") for detection in detections]
    centers = [box.inner("center") for box in boxes]
    return Boxes3d(
        **common,
        **_named(detections),
        centers=rows_of_three([center.inner("position").vector("xyz") for center in centers]),
        sizes_lwh=rows_of_three([box.inner("size").vector("xyz") for box in boxes]),
        directions=rows_of_three(
            [direction_of_quaternion(center.inner("orientation")) for center in centers]
        ),
        velocities=np.zeros(len(boxes), np.float32),
    )


def _named(detections: list[ForeignMessage]) -> dict[str, Any]:
    """Ids, classes and probabilities: of each detection the likeliest class."""
    likeliest = [_likeliest(detection) for detection in detections]
    return {
        "id": np.array([_id(detection, k) for k, detection in enumerate(detections)], np.int32),
        "class_names": tuple(found.text("class_id") for found in likeliest),
        "confidence": np.array([found.number("score") for found in likeliest], np.float32),
    }


def _likeliest(detection: ForeignMessage) -> ForeignMessage:
    results = detection.each("results")
    if not results:
        raise detection.fault("results", "empty; expected a class")
    return max((result.inner("hypothesis") for result in results), key=lambda found: found.number("score"))


def _id(detection: ForeignMessage, k: int) -> int:
    """The number that stands in `id`, which is any text; the place in the list where it is no number."""
    text = detection.text("id")
    plain = text.removeprefix("-")
    whole = plain.isascii() and plain.isdigit() and len(plain) <= 10
    return int(text) if whole and -(2**31) <= int(text) < 2**31 else k


def _write_boxes_2d(record: Boxes2d, header: dict[str, Any]) -> RosMessage:
    nowhere = {"position": dict.fromkeys("xyz", 0.0), "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    detections = []
    for k, (x1, y1, x2, y2) in enumerate(record.corners_xyxy.tolist()):
        center = {"position": {"x": (x1 + x2) / 2, "y": (y1 + y2) / 2}, "theta": 0.0}
        bbox = {"center": center, "size_x": float(x2 - x1), "size_y": float(y2 - y1)}
        result = _result(record, k, nowhere, np.zeros((6, 6)))
        detections.append({"header": header, "results": [result], "bbox": bbox, "id": str(record.id[k])})
    return RosMessage(DETECTIONS_2D, {"header": header, "detections": detections})


def _read_boxes_2d(message: ForeignMessage, common: dict[str, Any]) -> Boxes2d:
    detections = message.each("detections")
    corners = np.array([_corners(detection.inner("bbox")) for detection in detections]).reshape(-1, 4)
    return Boxes2d(**common, **_named(detections), corners_xyxy=whole_corners(corners, None))


def _corners(box: ForeignMessage) -> list[float]:
    """Edges of the upright box around one that may be turned."""
    x, y = box.inner("center").inner("position").vector("xy")
    theta = box.inner("center").number("theta")
    width, height = box.number("size_x"), box.number("size_y")
    if width < 0 or height < 0:
        raise box.fault("size_x" if width < 0 else "size_y", f"{min(width, height)}; expected 0 or more")
    if theta != 0:
        across, along = abs(np.cos(theta)), abs(np.sin(theta))
        width, height = across * width + along * height, along * width + across * height
    return [x - width / 2, y - height / 2, x + width / 2, y + height / 2]


_WRITERS: Mapping[type[Any], Callable[[Any, dict[str, Any]], RosMessage]] = {
    ImageData: _write_image,
    PointCloudData: _write_points,
    Boxes3d: _write_boxes_3d,
    Boxes2d: _write_boxes_2d,
    FusedDetections: _write_boxes_3d,
}

_READERS: Mapping[str, Callable[[ForeignMessage, dict[str, Any]], Any]] = {
    IMAGE: _read_image,
    COMPRESSED_IMAGE: image_of_file,
    POINT_CLOUD: _read_points,
    DETECTIONS_3D: _read_boxes_3d,
    DETECTIONS_2D: _read_boxes_2d,
}
