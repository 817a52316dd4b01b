"""Clouds as `foxglove.PointCloud`."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.fusion.messages.foreign_values import ForeignMessage
from sceneloom.fusion.messages.foxglove_form.message import NO_PLACE, NO_TURN, FoxgloveMessage, time_content
from sceneloom.fusion.messages.packed_points import PackedField, rows_of, unpack_points
from sceneloom.fusion.messages.sensor_data import PointCloudData
from sceneloom.fusion.messages.shown_points import pack_shown, without_shown_names
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.geometry.rigid import RigidTransform

NUMERIC_TYPES: Mapping[int, str] = MappingProxyType(
    {1: "uint8", 2: "int8", 3: "uint16", 4: "int16", 5: "uint32", 6: "int32", 7: "float32", 8: "float64"}
)
"""The types of `foxglove.PackedElementField`."""

_NUMBERS = {name: number for number, name in NUMERIC_TYPES.items()}


def write_points(record: PointCloudData, frame_id: str, image_frame_id: str) -> dict[str, FoxgloveMessage]:
    """Show a cloud."""
    del image_frame_id
    return {"points": points_message(record.timestamp, frame_id, record.fields, record.points)}


def points_message(
    timestamp: Timestamp, frame_id: str, names: Sequence[str], table: Float32Array
) -> FoxgloveMessage:
    """Make the message of points with their fields."""
    fields, rows = pack_shown(names, table)
    content = {
        "timestamp": time_content(timestamp),
        "frame_id": frame_id,
        "pose": {"position": NO_PLACE, "orientation": NO_TURN},
        "point_stride": rows.shape[1],
        "fields": [
            {"name": field.name, "offset": field.offset, "type": _NUMBERS[field.dtype]} for field in fields
        ],
        "data": rows.tobytes(),
    }
    return FoxgloveMessage("foxglove.PointCloud", content)


def read_points(message: ForeignMessage, common: dict[str, Any]) -> PointCloudData:
    """Read a cloud, in the frame that the message names."""
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
