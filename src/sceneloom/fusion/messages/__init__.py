"""The records of DB34/T 4101-2022, tables 1 and 3 to 10, and the forms in which they travel."""

from sceneloom.fusion.messages.basic_types import BasicType
from sceneloom.fusion.messages.boxes import Box2d, Box3d, Boxes2d, Boxes3d
from sceneloom.fusion.messages.calibration_data import CalibrationData
from sceneloom.fusion.messages.encodings import ENCODINGS, Encoding
from sceneloom.fusion.messages.fused import (
    DEPTH_KINDS,
    POINT_FRAMES,
    FusedDetection,
    FusedDetections,
    SensorFusionData,
)
from sceneloom.fusion.messages.records import (
    RECORD_KINDS,
    DetectionRecord,
    ListLayout,
    Record,
    RecordKind,
    ResultRecord,
    SensorRecord,
    SentRecord,
    kind_of,
)
from sceneloom.fusion.messages.rows import Row
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData, RawData
from sceneloom.fusion.messages.tables import TABLES, Table
from sceneloom.fusion.messages.timestamps import Timestamp
from sceneloom.fusion.messages.value_types import ValueForm, ValueType

__all__ = [
    "DEPTH_KINDS",
    "ENCODINGS",
    "POINT_FRAMES",
    "RECORD_KINDS",
    "TABLES",
    "BasicType",
    "Box2d",
    "Box3d",
    "Boxes2d",
    "Boxes3d",
    "CalibrationData",
    "DetectionRecord",
    "Encoding",
    "FusedDetection",
    "FusedDetections",
    "ImageData",
    "ListLayout",
    "PointCloudData",
    "RawData",
    "Record",
    "RecordKind",
    "ResultRecord",
    "Row",
    "SensorFusionData",
    "SensorRecord",
    "SentRecord",
    "Table",
    "Timestamp",
    "ValueForm",
    "ValueType",
    "kind_of",
]
