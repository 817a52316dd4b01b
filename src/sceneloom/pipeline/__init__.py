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
            "colouring": "ColourOutputs ColourReport ColourSettings colour",
            "converting": "ConversionReport convert",
            "depth_images": "DepthReport write_depth_images",
            "deskewing": "DeskewReport deskew deskewed_scene",
            "detection_lists": "DetectionFiles DetectionInput",
            "fusing": "CameraReport FusionOutputs FusionReport fuse iter_fused",
            "fusing_detections": "DetectionFusionReport fuse_detections",
            "syncing": "SyncReport sync",
            "tracking": "TrackOutputs TrackReport TrackingSettings track_objects",
        },
    )

__all__ = [
    "CameraReport", "ColourOutputs", "ColourReport", "ColourSettings", "ConversionReport", "DepthReport",
    "DeskewReport", "DetectionFiles", "DetectionFusionReport", "DetectionInput", "FusionOutputs", "FusionReport",
    "SyncReport", "TrackOutputs", "TrackReport", "TrackingSettings", "colour", "convert", "deskew", "deskewed_scene",
    "fuse", "fuse_detections", "iter_fused", "sync", "track_objects", "write_depth_images",
]  # fmt: skip
