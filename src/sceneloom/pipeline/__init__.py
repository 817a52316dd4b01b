"""The main job: read, weave into one world, fuse, write."""

from sceneloom.pipeline.convert import ConversionReport, convert
from sceneloom.pipeline.deskew import deskew, deskewed_scene
from sceneloom.pipeline.deskew_report import DeskewReport
from sceneloom.pipeline.fuse import fuse, iter_fused
from sceneloom.pipeline.outputs import FusionOutputs
from sceneloom.pipeline.report import CameraReport, FusionReport

__all__ = [
    "CameraReport",
    "ConversionReport",
    "DeskewReport",
    "FusionOutputs",
    "FusionReport",
    "convert",
    "deskew",
    "deskewed_scene",
    "fuse",
    "iter_fused",
]
