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
    from sceneloom.pipeline.fusing import fuse, iter_fused
    from sceneloom.pipeline.outputs import FusionOutputs
    from sceneloom.pipeline.report import CameraReport, FusionReport
    from sceneloom.pipeline.syncing import SyncReport, sync

__all__ = [
    "CameraReport",
    "ColourOutputs",
    "ColourReport",
    "ColourSettings",
    "ConversionReport",
    "DepthReport",
    "DeskewReport",
    "FusionOutputs",
    "FusionReport",
    "SyncReport",
    "colour",
    "convert",
    "deskew",
    "deskewed_scene",
    "fuse",
    "iter_fused",
    "sync",
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
    "FusionOutputs": "outputs",
    "FusionReport": "report",
    "SyncReport": "syncing",
    "colour": "colouring",
    "convert": "conversion",
    "deskew": "deskewing",
    "deskewed_scene": "deskewing",
    "fuse": "fusing",
    "iter_fused": "fusing",
    "sync": "syncing",
    "write_depth_images": "depth_images",
}
"""The module of everything that is imported when it is first asked for."""


def __getattr__(name: str) -> Any:
    if name not in _ON_FIRST_USE:
        raise AttributeError(f"module 'sceneloom.pipeline' has no attribute {name!r}")
    value = getattr(import_module(f"sceneloom.pipeline.{_ON_FIRST_USE[name]}"), name)
    globals()[name] = value
    return value
