"""Sensor-data fusion: which points a picture shows, their colours, and the picture's depths."""

from sceneloom.colouring.algorithms import (
    ALGORITHMS,
    ColouredPoints,
    FusionAlgorithm,
    ViewRequest,
    fuse_by_projection,
)
from sceneloom.colouring.blending import BlendedPoints, blend_colours
from sceneloom.colouring.colours import NO_CAMERA, colour_points
from sceneloom.colouring.exposure import ExposureGains, ExposureLinks
from sceneloom.colouring.lidar_way import LidarWay
from sceneloom.colouring.normals import estimate_normals
from sceneloom.colouring.provenance import PointSources
from sceneloom.colouring.results import FusedFrame, FusedView, PointSight
from sceneloom.colouring.views import view_points
from sceneloom.colouring.visibility import VisibilitySettings, find_visible
from sceneloom.colouring.weights import BlendSettings
from sceneloom.visibility.rolling_shutter import ShutterWay

__all__ = [
    "ALGORITHMS",
    "NO_CAMERA",
    "BlendSettings",
    "BlendedPoints",
    "ColouredPoints",
    "ExposureGains",
    "ExposureLinks",
    "FusedFrame",
    "FusedView",
    "FusionAlgorithm",
    "LidarWay",
    "PointSight",
    "PointSources",
    "ShutterWay",
    "ViewRequest",
    "VisibilitySettings",
    "blend_colours",
    "colour_points",
    "estimate_normals",
    "find_visible",
    "fuse_by_projection",
    "view_points",
]
