"""The jobs: fuse, colour, depth images, deskew, track, convert, edit, sync, calibrate.

Every name is imported when it is first used: a conversion needs nothing of a fusion, which takes long to import.
"""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.pipeline.colouring import ColourOutputs, ColourReport, ColourSettings, colour
    from sceneloom.pipeline.converting import ConversionReport, convert
    from sceneloom.pipeline.depth_images import DepthReport, write_depth_images
    from sceneloom.pipeline.deskewing import DeskewReport, deskew, deskewed_scene
    from sceneloom.pipeline.detection_lists import DetectionFiles, DetectionInput
    from sceneloom.pipeline.fusing import CameraReport, FusionOutputs, FusionReport, fuse, iter_fused
    from sceneloom.pipeline.fusing_detections import DetectionFusionReport, fuse_detections
    from sceneloom.pipeline.syncing import SyncReport, sync
    from sceneloom.pipeline.tracking import TrackingSettings, TrackOutputs, TrackReport, track_objects
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "CameraReport": "sceneloom.pipeline.fusing:CameraReport",
            "ColourOutputs": "sceneloom.pipeline.colouring:ColourOutputs",
            "ColourReport": "sceneloom.pipeline.colouring:ColourReport",
            "ColourSettings": "sceneloom.pipeline.colouring:ColourSettings",
            "ConversionReport": "sceneloom.pipeline.converting:ConversionReport",
            "DepthReport": "sceneloom.pipeline.depth_images:DepthReport",
            "DeskewReport": "sceneloom.pipeline.deskewing:DeskewReport",
            "DetectionFiles": "sceneloom.pipeline.detection_lists:DetectionFiles",
            "DetectionFusionReport": "sceneloom.pipeline.fusing_detections:DetectionFusionReport",
            "DetectionInput": "sceneloom.pipeline.detection_lists:DetectionInput",
            "FusionOutputs": "sceneloom.pipeline.fusing:FusionOutputs",
            "FusionReport": "sceneloom.pipeline.fusing:FusionReport",
            "SyncReport": "sceneloom.pipeline.syncing:SyncReport",
            "TrackOutputs": "sceneloom.pipeline.tracking:TrackOutputs",
            "TrackReport": "sceneloom.pipeline.tracking:TrackReport",
            "TrackingSettings": "sceneloom.pipeline.tracking:TrackingSettings",
            "colour": "sceneloom.pipeline.colouring:colour",
            "convert": "sceneloom.pipeline.converting:convert",
            "deskew": "sceneloom.pipeline.deskewing:deskew",
            "deskewed_scene": "sceneloom.pipeline.deskewing:deskewed_scene",
            "fuse": "sceneloom.pipeline.fusing:fuse",
            "fuse_detections": "sceneloom.pipeline.fusing_detections:fuse_detections",
            "iter_fused": "sceneloom.pipeline.fusing:iter_fused",
            "sync": "sceneloom.pipeline.syncing:sync",
            "track_objects": "sceneloom.pipeline.tracking:track_objects",
            "write_depth_images": "sceneloom.pipeline.depth_images:write_depth_images",
        },
    )

__all__ = [
    "CameraReport",
    "ColourOutputs",
    "ColourReport",
    "ColourSettings",
    "ConversionReport",
    "DepthReport",
    "DeskewReport",
    "DetectionFiles",
    "DetectionFusionReport",
    "DetectionInput",
    "FusionOutputs",
    "FusionReport",
    "SyncReport",
    "TrackOutputs",
    "TrackReport",
    "TrackingSettings",
    "colour",
    "convert",
    "deskew",
    "deskewed_scene",
    "fuse",
    "fuse_detections",
    "iter_fused",
    "sync",
    "track_objects",
    "write_depth_images",
]
