"""The main job: read, weave into one world, fuse, write.

Every name is imported when it is first used: a conversion or an edit needs nothing of what fuses, which takes long to
import.
"""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.pipeline.colouring.job import colour
    from sceneloom.pipeline.colouring.report import ColourReport
    from sceneloom.pipeline.colouring.settings import ColourOutputs, ColourSettings
    from sceneloom.pipeline.converting.job import convert
    from sceneloom.pipeline.converting.report import ConversionReport
    from sceneloom.pipeline.depth_images import DepthReport, write_depth_images
    from sceneloom.pipeline.deskewing.job import deskew, deskewed_scene
    from sceneloom.pipeline.deskewing.report import DeskewReport
    from sceneloom.pipeline.detections.detected_scene import DetectionFiles
    from sceneloom.pipeline.detections.report import DetectionFusionReport
    from sceneloom.pipeline.found_objects import DetectionInput, fuse_detections, track_objects
    from sceneloom.pipeline.fusing.job import fuse, iter_fused
    from sceneloom.pipeline.fusing.outputs import FusionOutputs
    from sceneloom.pipeline.fusing.report import CameraReport, FusionReport
    from sceneloom.pipeline.syncing import SyncReport, sync
    from sceneloom.pipeline.tracking.job import TrackingSettings
    from sceneloom.pipeline.tracking.report import TrackReport
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "CameraReport": "sceneloom.pipeline.fusing.report:CameraReport",
            "ColourOutputs": "sceneloom.pipeline.colouring.settings:ColourOutputs",
            "ColourReport": "sceneloom.pipeline.colouring.report:ColourReport",
            "ColourSettings": "sceneloom.pipeline.colouring.settings:ColourSettings",
            "ConversionReport": "sceneloom.pipeline.converting.report:ConversionReport",
            "DepthReport": "sceneloom.pipeline.depth_images:DepthReport",
            "DeskewReport": "sceneloom.pipeline.deskewing.report:DeskewReport",
            "DetectionFiles": "sceneloom.pipeline.detections.detected_scene:DetectionFiles",
            "DetectionFusionReport": "sceneloom.pipeline.detections.report:DetectionFusionReport",
            "DetectionInput": "sceneloom.pipeline.found_objects:DetectionInput",
            "FusionOutputs": "sceneloom.pipeline.fusing.outputs:FusionOutputs",
            "FusionReport": "sceneloom.pipeline.fusing.report:FusionReport",
            "SyncReport": "sceneloom.pipeline.syncing:SyncReport",
            "TrackReport": "sceneloom.pipeline.tracking.report:TrackReport",
            "TrackingSettings": "sceneloom.pipeline.tracking.job:TrackingSettings",
            "colour": "sceneloom.pipeline.colouring.job:colour",
            "convert": "sceneloom.pipeline.converting.job:convert",
            "deskew": "sceneloom.pipeline.deskewing.job:deskew",
            "deskewed_scene": "sceneloom.pipeline.deskewing.job:deskewed_scene",
            "fuse": "sceneloom.pipeline.fusing.job:fuse",
            "fuse_detections": "sceneloom.pipeline.found_objects:fuse_detections",
            "iter_fused": "sceneloom.pipeline.fusing.job:iter_fused",
            "sync": "sceneloom.pipeline.syncing:sync",
            "track_objects": "sceneloom.pipeline.found_objects:track_objects",
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
