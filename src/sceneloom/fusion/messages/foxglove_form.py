"""Records as messages of the Foxglove schemas, for MCAP viewers; mappings, from which the protobuf classes are made.

Pictures are `foxglove.RawImage` or `CompressedImage`, clouds `PointCloud`, boxes in space `SceneUpdate`, boxes in
pictures `ImageAnnotations`; points of annotations count from the picture's own corner, as table 8 does. Of a box,
what the drawing does not say stands in its metadata. The schemas know neither sensor_id nor seq, so they are given on
reading.

Source: the Foxglove schemas, package foxglove-schemas-protobuf 0.4.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.errors import OptionError
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
from sceneloom.fusion.messages.fused import FusedDetections, SensorFusionData
from sceneloom.fusion.messages.packed_points import PackedField, rows_of, unpack_points
from sceneloom.fusion.messages.scene_form.boxes import whole_corners
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData
from sceneloom.fusion.messages.shown_points import pack_shown, without_shown_names
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.geometry.rigid import RigidTransform

NUMERIC_TYPES: Mapping[int, str] = MappingProxyType(
    {1: "uint8", 2: "int8", 3: "uint16", 4: "int16", 5: "uint32", 6: "int32", 7: "float32", 8: "float64"}
)
"""The types of `foxglove.PackedElementField`."""

_RAW_NAMES = {1: "mono8", 3: "rgb8", 4: "rgba8"}
_READ_NAMES = {"8UC1": "mono8", "8UC3": "bgr8"}
_ALL_ENTITIES, _LINE_LOOP = 1, 2
_NUMBERS = {name: number for number, name in NUMERIC_TYPES.items()}
_FACES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 0.35}
_EDGES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 1.0}
_NO_TURN = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_NO_PLACE = {"x": 0.0, "y": 0.0, "z": 0.0}


@dataclass(frozen=True, slots=True)
class FoxgloveMessage:
    """A message of a Foxglove schema.

    Attributes:
        schema: its name, "foxglove.RawImage".
        content: its fields by name; messages in it are mappings, enumerations numbers.
    """

    schema: str
    content: Mapping[str, Any]


FoxgloveRecord = ImageData | PointCloudData | Boxes3d | Boxes2d | SensorFusionData | FusedDetections
"""The records that can be shown."""


def to_foxglove(
    record: FoxgloveRecord, *, frame_id: str, image_frame_id: str = ""
) -> dict[str, FoxgloveMessage]:
    """Give the messages that show a record: one, or for a result one for each part of it.

    Args:
        frame_id: the sensor's frame as viewers call it; of a result that of its points and boxes.
        image_frame_id: of a result the camera's frame; "" for the same.

    Returns:
        By part: image, depth, points, boxes_3d, boxes_2d.

    Raises:
        OptionError: there is no schema for such records.
    """
    write = _WRITERS.get(type(record))
    if write is None:
        known = ", ".join(record_type.__name__ for record_type in _WRITERS)
        raise OptionError(f"a {type(record).__name__}; expected one of {known}")
    return write(record, frame_id, image_frame_id or frame_id)


def from_foxglove(
    message: FoxgloveMessage, *, sensor_id: int, seq: int, timestamp: Timestamp | None = None
) -> ForeignRecord:
    """Give the record of a message.

    Args:
        sensor_id: of the sensor, which the message does not know.
        seq: of the record, likewise.
        timestamp: of boxes, where there is none to be taken from the message.

    Raises:
        DataError: a field is missing, of another type, or cannot stand in a record.
        OptionError: there is no record for such messages.
    """
    read = _READERS.get(message.schema)
    if read is None:
        raise OptionError(f"a message {message.schema!r}; expected one of {', '.join(_READERS)}")
    content = ForeignMessage(message.schema, message.content)
    if timestamp is None:
        timestamp = _time_of(content)
    # what is too large for 32 bits becomes infinite, which no record holds
    with np.errstate(over="ignore", invalid="ignore"):
        return cast(
            "ForeignRecord", read(content, {"sensor_id": sensor_id, "seq": seq, "timestamp": timestamp})
        )


def _time_of(message: ForeignMessage) -> Timestamp:
    """The time of a message, or of the first thing in it that has one."""
    if "timestamp" in message.content:
        return message.inner("timestamp").timestamp("seconds", "nanos")
    for name in ("deletions", "entities", "points"):
        inner = message.each(name) if name in message.content else []
        if inner:
            return inner[0].inner("timestamp").timestamp("seconds", "nanos")
    raise message.fault("timestamp", "missing")


def _time(timestamp: Timestamp) -> dict[str, int]:
    return {"seconds": timestamp.s, "nanos": timestamp.ns}


def _write_image(record: ImageData, frame_id: str, image_frame_id: str) -> dict[str, FoxgloveMessage]:
    del frame_id
    size_hwc = record.height, record.width, record.channel
    return {
        "image": _image(record.timestamp, image_frame_id, record.encoding, size_hwc, bytes_of(record.data))
    }


def _image(
    timestamp: Timestamp, frame_id: str, encoding: str, size_hwc: tuple[int, int, int], data: bytes
) -> FoxgloveMessage:
    content: dict[str, Any] = {"timestamp": _time(timestamp), "frame_id": frame_id, "data": data}
    if ENCODINGS[encoding].is_file:
        return FoxgloveMessage("foxglove.CompressedImage", {**content, "format": encoding})
    height, width, channel = size_hwc
    if encoding == "raw":
        if channel not in _RAW_NAMES:
            raise OptionError(f"raw pixels of {channel} values; expected 1, 3 or 4, to be shown")
        encoding = _RAW_NAMES[channel]
    content |= {"height": height, "width": width, "encoding": encoding, "step": width * channel}
    return FoxgloveMessage("foxglove.RawImage", content)


def _read_image(message: ForeignMessage, common: dict[str, Any]) -> ImageData:
    named = message.text("encoding")
    encoding = _READ_NAMES.get(named, named)
    known = ENCODINGS.get(encoding)
    if known is None or known.order is None:
        names = (*(name for name in ENCODINGS if ENCODINGS[name].order), *_READ_NAMES)
        raise message.fault("encoding", f"{named!r}; expected one of {', '.join(names)}")
    return image_of_rows(message, encoding, min(known.channels), common)


def _write_points(record: PointCloudData, frame_id: str, image_frame_id: str) -> dict[str, FoxgloveMessage]:
    del image_frame_id
    return {"points": _points(record.timestamp, frame_id, record.fields, record.points)}


def _points(
    timestamp: Timestamp, frame_id: str, names: Sequence[str], table: Float32Array
) -> FoxgloveMessage:
    fields, rows = pack_shown(names, table)
    content = {
        "timestamp": _time(timestamp),
        "frame_id": frame_id,
        "pose": {"position": _NO_PLACE, "orientation": _NO_TURN},
        "point_stride": rows.shape[1],
        "fields": [
            {"name": field.name, "offset": field.offset, "type": _NUMBERS[field.dtype]} for field in fields
        ],
        "data": rows.tobytes(),
    }
    return FoxgloveMessage("foxglove.PointCloud", content)


def _read_points(message: ForeignMessage, common: dict[str, Any]) -> PointCloudData:
    content, stride = message.content_bytes("data"), message.whole("point_stride")
    count = len(content) // stride if stride else 0
    fields = [_field(field) for field in message.each("fields")]
    names, table = unpack_points(
        rows_of(content, count=count, stride=stride, owner=message.owner),
        fields,
        owner=message.owner,
        seconds=common["timestamp"].s,
    )
    names, table = without_shown_names(names, table, fields)
    if "pose" in message.content:
        table = _moved(table, names, message.inner("pose"))
    return PointCloudData(number=len(table), fields=names, fields_number=len(names), data=table, **common)


def _moved(table: Float32Array, names: tuple[str, ...], pose: ForeignMessage) -> Float32Array:
    """Take points into the frame that the message names."""
    position, quaternion = pose.inner("position").vector("xyz"), pose.inner("orientation").vector("xyzw")
    if not position.any() and not quaternion[:3].any():
        return table
    if not 0 < np.linalg.norm(quaternion) < np.inf:
        raise pose.fault("orientation", f"{quaternion.tolist()}; expected a quaternion")
    columns = [names.index(axis) for axis in "xyz"]
    moved = table.copy()
    frame_from_points = RigidTransform.from_quaternion(position, quaternion)
    moved[:, columns] = frame_from_points.apply(table[:, columns].astype(np.float64))
    return moved


def _field(field: ForeignMessage) -> PackedField:
    kind = field.whole("type")
    if kind not in NUMERIC_TYPES:
        raise field.fault("type", f"{kind}; expected 1 to 8")
    return PackedField(field.text("name"), field.whole("offset"), NUMERIC_TYPES[kind])


def _write_boxes_3d(
    record: Boxes3d | FusedDetections, frame_id: str, image_frame_id: str
) -> dict[str, FoxgloveMessage]:
    """Draw boxes in place of those that the last message drew."""
    del image_frame_id
    time = _time(record.timestamp)
    entities = [
        {
            "timestamp": time,
            "frame_id": frame_id,
            "id": str(k),
            "frame_locked": True,
            "metadata": _metadata(record, k, velocity=record.velocities[k], direction=record.directions[k]),
            "cubes": [_cube(record, k)],
            "texts": [_label(record, k)],
        }
        for k in range(len(record))
        if record.directions[k].any()
    ]
    content = {"deletions": [{"timestamp": time, "type": _ALL_ENTITIES}], "entities": entities}
    return {"boxes_3d": FoxgloveMessage("foxglove.SceneUpdate", content)}


def _cube(record: Boxes3d | FusedDetections, k: int) -> dict[str, Any]:
    quaternion = quaternion_of_direction(record.directions[k])
    pose = {
        "position": dict(zip("xyz", record.centers[k].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", quaternion.tolist(), strict=True)),
    }
    return {
        "pose": pose,
        "size": dict(zip("xyz", record.sizes_lwh[k].tolist(), strict=True)),
        "color": _FACES,
    }


def _label(record: Boxes3d | FusedDetections, k: int) -> dict[str, Any]:
    x, y, z = record.centers[k].tolist()
    above = {"x": x, "y": y, "z": z + float(record.sizes_lwh[k, 2]) / 2 + 0.2}
    return {
        "pose": {"position": above, "orientation": _NO_TURN},
        "billboard": True,
        "font_size": 12.0,
        "scale_invariant": True,
        "color": _EDGES,
        "text": _text(record, k),
    }


def _text(record: Any, k: int) -> str:
    return f"{record.class_names[k]} {record.id[k]} {record.confidence[k]:.2f}"


def _metadata(record: Any, k: int, **further: Any) -> list[dict[str, str]]:
    values = {
        "class": record.class_names[k],
        "id": record.id[k],
        "confidence": record.confidence[k],
        **further,
    }
    return [
        {"key": key, "value": " ".join(map(str, value)) if isinstance(value, np.ndarray) else str(value)}
        for key, value in values.items()
    ]


def _read_boxes_3d(message: ForeignMessage, common: dict[str, Any]) -> Boxes3d:
    boxes = [
        (cube, _Told.of(entity))
        for entity in (message.each("entities") if "entities" in message.content else [])
        for cube in (entity.each("cubes") if "cubes" in entity.content else [])
    ]
    poses = [cube.inner("pose") for cube, _ in boxes]
    directions = [
        told.vector("direction") or direction_of_quaternion(pose.inner("orientation"))
        for pose, (_, told) in zip(poses, boxes, strict=True)
    ]
    return Boxes3d(
        **common,
        **_named([told for _, told in boxes]),
        centers=rows_of_three([pose.inner("position").vector("xyz") for pose in poses]),
        sizes_lwh=rows_of_three([cube.inner("size").vector("xyz") for cube, _ in boxes]),
        directions=rows_of_three(directions),
        velocities=np.array([told.number("velocity", 0.0) for _, told in boxes], np.float32),
    )


@dataclass(frozen=True, slots=True)
class _Told:
    """What the metadata of a drawing say."""

    message: ForeignMessage
    values: Mapping[str, str]

    @classmethod
    def of(cls, message: ForeignMessage) -> "_Told":
        pairs = message.each("metadata") if "metadata" in message.content else []
        return cls(message, {pair.text("key"): pair.text("value") for pair in pairs})

    def number(self, key: str, default: float) -> float:
        text = self.values.get(key)
        if text is None:
            return default
        try:
            return float(text)
        except ValueError:
            raise self.message.fault("metadata", f"{key} {text!r}; expected a number") from None

    def vector(self, key: str) -> list[float] | None:
        text = self.values.get(key)
        if text is None:
            return None
        try:
            numbers = [float(part) for part in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != 3:
            raise self.message.fault("metadata", f"{key} {text!r}; expected three numbers")
        return numbers

    def whole(self, key: str, default: int) -> int:
        number = self.number(key, float(default))
        if not (number.is_integer() and -(2**31) <= number < 2**31):
            raise self.message.fault("metadata", f"{key} {number}; expected an int32")
        return int(number)


def _named(told: list[_Told]) -> dict[str, Any]:
    return {
        "id": np.array([one.whole("id", k) for k, one in enumerate(told)], np.int32),
        "class_names": tuple(one.values.get("class", "object") for one in told),
        "confidence": np.array([one.number("confidence", 1.0) for one in told], np.float32),
    }


def _write_boxes_2d(record: Boxes2d, frame_id: str, image_frame_id: str) -> dict[str, FoxgloveMessage]:
    del frame_id, image_frame_id
    return {"boxes_2d": _annotations(record, record.timestamp)}


def _annotations(record: Boxes2d | FusedDetections, timestamp: Timestamp) -> FoxgloveMessage:
    time = _time(timestamp)
    points, texts = [], []
    for k, (x1, y1, x2, y2) in enumerate(record.corners_xyxy.tolist()):
        corners = ((x1, y1), (x2, y1), (x2, y2), (x1, y2))
        points.append(
            {
                "timestamp": time,
                "type": _LINE_LOOP,
                "points": [{"x": float(x), "y": float(y)} for x, y in corners],
                "outline_color": _EDGES,
                "thickness": 2.0,
                "metadata": _metadata(record, k),
            }
        )
        corner = {"x": float(x1), "y": float(y1)}
        text = {"timestamp": time, "position": corner, "text": _text(record, k), "font_size": 12.0}
        texts.append({**text, "text_color": _EDGES})
    return FoxgloveMessage("foxglove.ImageAnnotations", {"timestamp": time, "points": points, "texts": texts})


def _read_boxes_2d(message: ForeignMessage, common: dict[str, Any]) -> Boxes2d:
    loops = [
        loop
        for loop in (message.each("points") if "points" in message.content else [])
        if loop.whole("type") == _LINE_LOOP
    ]
    corners = np.array([_corners(loop) for loop in loops], np.float64).reshape(-1, 4)
    named = _named([_Told.of(loop) for loop in loops])
    return Boxes2d(**common, **named, corners_xyxy=whole_corners(corners, None))


def _corners(loop: ForeignMessage) -> list[float]:
    """Edges of the upright box around a loop of lines."""
    points = np.array([point.vector("xy") for point in loop.each("points")]).reshape(-1, 2)
    if len(points) == 0:
        raise loop.fault("points", "empty; expected the corners of a box")
    return [*points.min(axis=0), *points.max(axis=0)]


def _write_fusion(record: SensorFusionData, frame_id: str, image_frame_id: str) -> dict[str, FoxgloveMessage]:
    """Show picture, depth image and points of a result."""
    time = record.timestamp if record.image_timestamp is None else record.image_timestamp
    size_hwc = record.height, record.width, record.image_channel
    depth = {
        "timestamp": _time(time),
        "frame_id": image_frame_id,
        "height": record.height,
        "width": record.width,
        "encoding": "32FC1",
        "step": 4 * record.width,
        "data": bytes_of(record.image_depth),
    }
    return {
        "image": _image(time, image_frame_id, record.encoding, size_hwc, bytes_of(record.image_data)),
        "depth": FoxgloveMessage("foxglove.RawImage", depth),
        "points": _points(record.timestamp, frame_id, record.point_fields, record.points),
    }


def _write_detections(
    record: FusedDetections, frame_id: str, image_frame_id: str
) -> dict[str, FoxgloveMessage]:
    time = record.timestamp if record.image_timestamp is None else record.image_timestamp
    return {**_write_boxes_3d(record, frame_id, image_frame_id), "boxes_2d": _annotations(record, time)}


_WRITERS: Mapping[type[Any], Callable[[Any, str, str], dict[str, FoxgloveMessage]]] = {
    ImageData: _write_image,
    PointCloudData: _write_points,
    Boxes3d: _write_boxes_3d,
    Boxes2d: _write_boxes_2d,
    SensorFusionData: _write_fusion,
    FusedDetections: _write_detections,
}

_READERS: Mapping[str, Callable[[ForeignMessage, dict[str, Any]], Any]] = {
    "foxglove.RawImage": _read_image,
    "foxglove.CompressedImage": image_of_file,
    "foxglove.PointCloud": _read_points,
    "foxglove.SceneUpdate": _read_boxes_3d,
    "foxglove.ImageAnnotations": _read_boxes_2d,
}
