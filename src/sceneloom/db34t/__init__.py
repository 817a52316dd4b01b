"""The data fusion interface of DB34/T 4101-2022: its records, and the formats in which they are sent."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.db34t.records import (
        ENCODINGS,
        RECORD_KINDS,
        Box2d,
        Box3d,
        Boxes2d,
        Boxes3d,
        CalibrationData,
        FusedDetections,
        ImageData,
        PointCloudData,
        RawData,
        SensorFusionData,
        kind_of,
    )
    from sceneloom.db34t.tables import TABLES
    from sceneloom.db34t.types import Timestamp
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ENCODINGS": "sceneloom.db34t.records:ENCODINGS",
            "RECORD_KINDS": "sceneloom.db34t.records:RECORD_KINDS",
            "TABLES": "sceneloom.db34t.tables:TABLES",
            "Box2d": "sceneloom.db34t.records:Box2d",
            "Box3d": "sceneloom.db34t.records:Box3d",
            "Boxes2d": "sceneloom.db34t.records:Boxes2d",
            "Boxes3d": "sceneloom.db34t.records:Boxes3d",
            "CalibrationData": "sceneloom.db34t.records:CalibrationData",
            "FusedDetections": "sceneloom.db34t.records:FusedDetections",
            "ImageData": "sceneloom.db34t.records:ImageData",
            "PointCloudData": "sceneloom.db34t.records:PointCloudData",
            "RawData": "sceneloom.db34t.records:RawData",
            "SensorFusionData": "sceneloom.db34t.records:SensorFusionData",
            "Timestamp": "sceneloom.db34t.types:Timestamp",
            "kind_of": "sceneloom.db34t.records:kind_of",
        },
    )

__all__ = [
    "ENCODINGS",
    "RECORD_KINDS",
    "TABLES",
    "Box2d",
    "Box3d",
    "Boxes2d",
    "Boxes3d",
    "CalibrationData",
    "FusedDetections",
    "ImageData",
    "PointCloudData",
    "RawData",
    "SensorFusionData",
    "Timestamp",
    "kind_of",
]
