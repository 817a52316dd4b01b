"""The main job: read, weave into one world, fuse, write.

Every name is imported when it is first used: a conversion or an edit needs nothing of what fuses, which takes long to
import.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sceneloom.pipeline.colour_report import ColourReport
    from sceneloom.pipeline.colour_settings import ColourOutputs, ColourSettings
    from sceneloom.pipeline.colouring import colour
    from sceneloom.pipeline.conversion import ConversionReport, convert
    from sceneloom.pipeline.depth_images import DepthReport, write_depth_images
    from sceneloom.pipeline.deskew_report import DeskewReport
    from sceneloom.pipeline.deskewing import deskew, deskewed_scene
    from sceneloom.pipeline.detected_scene import DetectionFiles
    from sceneloom.pipeline.detection_report import DetectionFusionReport
    from sceneloom.pipeline.found_objects import DetectionInput, fuse_detections, track_objects
    from sceneloom.pipeline.fusing import fuse, iter_fused
    from sceneloom.pipeline.outputs import FusionOutputs
    from sceneloom.pipeline.report import CameraReport, FusionReport
    from sceneloom.pipeline.syncing import SyncReport, sync
    from sceneloom.pipeline.track_report import TrackReport
    from sceneloom.pipeline.tracking import TrackingSettings

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

_ON_FIRST_USE = {
    "CameraReport": "report",
    "ColourOutputs": "colour_settings",
    "ColourReport": "colour_report",
    "ColourSettings": "colour_settings",
    "ConversionReport": "conversion",
    "DepthReport": "depth_images",
    "DeskewReport": "deskew_report",
    "DetectionFiles": "detected_scene",
    "DetectionFusionReport": "detection_report",
    "DetectionInput": "found_objects",
    "FusionOutputs": "outputs",
    "FusionReport": "report",
    "SyncReport": "syncing",
    "TrackReport": "track_report",
    "TrackingSettings": "tracking",
    "colour": "colouring",
    "convert": "conversion",
    "deskew": "deskewing",
    "deskewed_scene": "deskewing",
    "fuse": "fusing",
    "fuse_detections": "found_objects",
    "iter_fused": "fusing",
    "sync": "syncing",
    "track_objects": "found_objects",
    "write_depth_images": "depth_images",
}
"""The module of everything that is imported when it is first asked for."""


def __getattr__(name: str) -> Any:
    if name not in _ON_FIRST_USE:
        raise AttributeError(f"module 'sceneloom.pipeline' has no attribute {name!r}")
    value = getattr(import_module(f"sceneloom.pipeline.{_ON_FIRST_USE[name]}"), name)
    globals()[name] = value
    return value
