"""The records of DB34/T 4101-2022, tables 1 and 3 to 10, and the forms in which they travel."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
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
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "DEPTH_KINDS": "sceneloom.fusion.messages.fused:DEPTH_KINDS",
            "ENCODINGS": "sceneloom.fusion.messages.encodings:ENCODINGS",
            "POINT_FRAMES": "sceneloom.fusion.messages.fused:POINT_FRAMES",
            "RECORD_KINDS": "sceneloom.fusion.messages.records:RECORD_KINDS",
            "TABLES": "sceneloom.fusion.messages.tables:TABLES",
            "BasicType": "sceneloom.fusion.messages.basic_types:BasicType",
            "Box2d": "sceneloom.fusion.messages.boxes:Box2d",
            "Box3d": "sceneloom.fusion.messages.boxes:Box3d",
            "Boxes2d": "sceneloom.fusion.messages.boxes:Boxes2d",
            "Boxes3d": "sceneloom.fusion.messages.boxes:Boxes3d",
            "CalibrationData": "sceneloom.fusion.messages.calibration_data:CalibrationData",
            "DetectionRecord": "sceneloom.fusion.messages.records:DetectionRecord",
            "Encoding": "sceneloom.fusion.messages.encodings:Encoding",
            "FusedDetection": "sceneloom.fusion.messages.fused:FusedDetection",
            "FusedDetections": "sceneloom.fusion.messages.fused:FusedDetections",
            "ImageData": "sceneloom.fusion.messages.sensor_data:ImageData",
            "ListLayout": "sceneloom.fusion.messages.records:ListLayout",
            "PointCloudData": "sceneloom.fusion.messages.sensor_data:PointCloudData",
            "RawData": "sceneloom.fusion.messages.sensor_data:RawData",
            "Record": "sceneloom.fusion.messages.records:Record",
            "RecordKind": "sceneloom.fusion.messages.records:RecordKind",
            "ResultRecord": "sceneloom.fusion.messages.records:ResultRecord",
            "Row": "sceneloom.fusion.messages.rows:Row",
            "SensorFusionData": "sceneloom.fusion.messages.fused:SensorFusionData",
            "SensorRecord": "sceneloom.fusion.messages.records:SensorRecord",
            "SentRecord": "sceneloom.fusion.messages.records:SentRecord",
            "Table": "sceneloom.fusion.messages.tables:Table",
            "Timestamp": "sceneloom.fusion.messages.timestamps:Timestamp",
            "ValueForm": "sceneloom.fusion.messages.value_types:ValueForm",
            "ValueType": "sceneloom.fusion.messages.value_types:ValueType",
            "kind_of": "sceneloom.fusion.messages.records:kind_of",
        },
    )

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
