"""All kinds of records: which class, which table, and of lists which columns.

The forms in which records travel go by this table.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any, cast

from sceneloom.errors import OptionError
from sceneloom.fusion.messages.boxes import COLUMNS_2D, COLUMNS_3D, Box2d, Box3d, Boxes2d, Boxes3d
from sceneloom.fusion.messages.calibration_data import CalibrationData
from sceneloom.fusion.messages.columns import Column
from sceneloom.fusion.messages.fused import COLUMNS_FUSED, FusedDetection, FusedDetections, SensorFusionData
from sceneloom.fusion.messages.rows import ARRAY_DTYPES, STREAM
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData, RawData
from sceneloom.fusion.messages.tables import (
    BOX_2D,
    BOX_3D,
    BOXES_2D,
    BOXES_3D,
    CALIBRATION,
    FUSED_DETECTION,
    FUSED_DETECTIONS,
    IMAGE,
    POINT_CLOUD,
    RAW,
    SENSOR_FUSION,
    Table,
)

SensorRecord = RawData | ImageData | PointCloudData
"""What sensors send."""

DetectionRecord = Boxes3d | Boxes2d | Box3d | Box2d
"""What detectors send."""

SentRecord = SensorRecord | DetectionRecord
"""What the fusion system receives, clause 5.6."""

ResultRecord = SensorFusionData | FusedDetections
"""What the fusion system gives, clause 5.7."""

Record = CalibrationData | SentRecord | ResultRecord | FusedDetection
"""Any record of tables 3 to 10."""


@dataclass(frozen=True, slots=True)
class ListLayout:
    """How a list of records of one table is kept as columns.

    Attributes:
        group: what the list is called.
        table: of one record of it.
        columns: the arrays.
        shared: fields of each record that are the list's own: name in the record to attribute of the list.
        ids: fields that some of the records have: name in the record to attribute of the list.
    """

    group: str
    table: Table
    columns: tuple[Column, ...]
    shared: Mapping[str, str]
    ids: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class RecordKind:
    """One kind of record.

    Attributes:
        name: as the messages of the service call it.
        record_type: its class.
        message_name: its message in the `.proto`.
        table: of its fields; of a list those that its records have in common.
        layout: of a list, else None.
    """

    name: str
    record_type: type[Any]
    message_name: str
    table: Table
    layout: ListLayout | None = None


_BOXES_3D = ListLayout(
    "boxes", BOX_3D, COLUMNS_3D, {"points_seq": "seq", "timestamp": "timestamp"}, MappingProxyType({})
)
_BOXES_2D = ListLayout(
    "boxes", BOX_2D, COLUMNS_2D, {"image_seq": "seq", "timestamp": "timestamp"}, MappingProxyType({})
)
_DETECTIONS = ListLayout(
    "detections",
    FUSED_DETECTION,
    COLUMNS_FUSED,
    {"timestamp": "timestamp"},
    MappingProxyType({"box_3d_id": "box_3d_ids", "box_2d_id": "box_2d_ids"}),
)

RECORD_KINDS: Mapping[str, RecordKind] = MappingProxyType(
    {
        kind.name: kind
        for kind in (
            RecordKind("raw", RawData, "RawData", RAW),
            RecordKind("image", ImageData, "ImageData", IMAGE),
            RecordKind("points", PointCloudData, "PointCloudData", POINT_CLOUD),
            RecordKind("boxes_3d", Boxes3d, "Boxes3d", BOXES_3D, _BOXES_3D),
            RecordKind("boxes_2d", Boxes2d, "Boxes2d", BOXES_2D, _BOXES_2D),
            RecordKind("box_3d", Box3d, "Box3d", BOX_3D),
            RecordKind("box_2d", Box2d, "Box2d", BOX_2D),
            RecordKind("calibration", CalibrationData, "Calibration", CALIBRATION),
            RecordKind("sensor_data", SensorFusionData, "SensorFusionData", SENSOR_FUSION),
            RecordKind("detections", FusedDetections, "FusedDetections", FUSED_DETECTIONS, _DETECTIONS),
            RecordKind("detection", FusedDetection, "FusedDetection", FUSED_DETECTION),
        )
    }
)
"""By name; those that can be sent and results have the names of the fields of SendRequest and GetReply."""


def size_of(record: Record) -> int:
    """How many bytes the arrays of a record have."""
    size = 0
    for name in _contents(cast("Any", type(record))):
        value = getattr(record, name)
        if value is not None:
            size += len(value) if isinstance(value, bytes) else value.nbytes
    return size


@cache
def _contents(record_type: type[Any]) -> tuple[str, ...]:
    """The attributes of a class of records that hold arrays or bytes."""
    kind = kind_of(record_type)
    if kind.layout is not None:
        return tuple(column.attribute for column in kind.layout.columns)
    return tuple(row.attribute for row in kind.table.rows if row.type in ARRAY_DTYPES or row.type == STREAM)


_KIND_OF = {kind.record_type: kind for kind in RECORD_KINDS.values()}


def kind_of(record: Record | type[Any]) -> RecordKind:
    """The kind of a record or of a class of records.

    Raises:
        OptionError: it is no record.
    """
    record_type = record if isinstance(record, type) else type(record)
    kind = _KIND_OF.get(record_type)
    if kind is None:
        known = ", ".join(known.__name__ for known in _KIND_OF)
        raise OptionError(f"a {record_type.__name__}; expected one of {known}")
    return kind
