"""Which message shows which record, and which record stands in which message."""

from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.fusion.messages.array_bytes import bytes_of
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.foreign_pictures import image_of_file
from sceneloom.fusion.messages.foreign_values import ForeignMessage, ForeignRecord
from sceneloom.fusion.messages.foxglove_form.boxes import (
    annotations,
    read_boxes_2d,
    read_boxes_3d,
    write_boxes_2d,
    write_boxes_3d,
)
from sceneloom.fusion.messages.foxglove_form.message import FoxgloveMessage, time_content, time_of
from sceneloom.fusion.messages.foxglove_form.pictures import image_message, read_image, write_image
from sceneloom.fusion.messages.foxglove_form.points import points_message, read_points, write_points
from sceneloom.fusion.messages.fused import FusedDetections, SensorFusionData
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData
from sceneloom.fusion.messages.timestamps import Timestamp

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
        timestamp = time_of(content)
    # what is too large for 32 bits becomes infinite, which no record holds
    with np.errstate(over="ignore", invalid="ignore"):
        return cast(
            "ForeignRecord", read(content, {"sensor_id": sensor_id, "seq": seq, "timestamp": timestamp})
        )


def _write_fusion(record: SensorFusionData, frame_id: str, image_frame_id: str) -> dict[str, FoxgloveMessage]:
    """Show picture, depth image and points of a result."""
    time = record.timestamp if record.image_timestamp is None else record.image_timestamp
    size_hwc = record.height, record.width, record.image_channel
    depth = {
        "timestamp": time_content(time),
        "frame_id": image_frame_id,
        "height": record.height,
        "width": record.width,
        "encoding": "32FC1",
        "step": 4 * record.width,
        "data": bytes_of(record.image_depth),
    }
    return {
        "image": image_message(time, image_frame_id, record.encoding, size_hwc, bytes_of(record.image_data)),
        "depth": FoxgloveMessage("foxglove.RawImage", depth),
        "points": points_message(record.timestamp, frame_id, record.point_fields, record.points),
    }


def _write_detections(
    record: FusedDetections, frame_id: str, image_frame_id: str
) -> dict[str, FoxgloveMessage]:
    time = record.timestamp if record.image_timestamp is None else record.image_timestamp
    return {**write_boxes_3d(record, frame_id, image_frame_id), "boxes_2d": annotations(record, time)}


_WRITERS: Mapping[type[Any], Callable[[Any, str, str], dict[str, FoxgloveMessage]]] = {
    ImageData: write_image,
    PointCloudData: write_points,
    Boxes3d: write_boxes_3d,
    Boxes2d: write_boxes_2d,
    SensorFusionData: _write_fusion,
    FusedDetections: _write_detections,
}

_READERS: Mapping[str, Callable[[ForeignMessage, dict[str, Any]], Any]] = {
    "foxglove.RawImage": read_image,
    "foxglove.CompressedImage": image_of_file,
    "foxglove.PointCloud": read_points,
    "foxglove.SceneUpdate": read_boxes_3d,
    "foxglove.ImageAnnotations": read_boxes_2d,
}
