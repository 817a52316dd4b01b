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
            "records": "ENCODINGS RECORD_KINDS Box2d Box3d Boxes2d Boxes3d CalibrationData FusedDetections ImageData "
            "PointCloudData RawData SensorFusionData kind_of",
            "tables": "TABLES",
            "types": "Timestamp",
        },
    )

__all__ = [
    "ENCODINGS", "RECORD_KINDS", "TABLES", "Box2d", "Box3d", "Boxes2d", "Boxes3d", "CalibrationData", "FusedDetections",
    "ImageData", "PointCloudData", "RawData", "SensorFusionData", "Timestamp", "kind_of",
]  # fmt: skip
