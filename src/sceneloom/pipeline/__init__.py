"""The main job: read, weave into one world, fuse, write."""

from sceneloom.pipeline.convert import ConversionReport, convert
from sceneloom.pipeline.fuse import FusionOutputs, fuse, iter_fused
from sceneloom.pipeline.report import CameraReport, FusionReport

__all__ = [
    "CameraReport",
    "ConversionReport",
    "FusionOutputs",
    "FusionReport",
    "convert",
    "fuse",
    "iter_fused",
]
