"""The main job: read, weave into one world, fuse, write.

Every name is imported when it is first used: a conversion or an edit needs nothing of what fuses, which takes long to
import.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

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
    "CameraReport": "fusing.report",
    "ColourOutputs": "colouring.settings",
    "ColourReport": "colouring.report",
    "ColourSettings": "colouring.settings",
    "ConversionReport": "converting.report",
    "DepthReport": "depth_images",
    "DeskewReport": "deskewing.report",
    "DetectionFiles": "detections.detected_scene",
    "DetectionFusionReport": "detections.report",
    "DetectionInput": "found_objects",
    "FusionOutputs": "fusing.outputs",
    "FusionReport": "fusing.report",
    "SyncReport": "syncing",
    "TrackReport": "tracking.report",
    "TrackingSettings": "tracking.job",
    "colour": "colouring.job",
    "convert": "converting.job",
    "deskew": "deskewing.job",
    "deskewed_scene": "deskewing.job",
    "fuse": "fusing.job",
    "fuse_detections": "found_objects",
    "iter_fused": "fusing.job",
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
