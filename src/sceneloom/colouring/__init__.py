"""Sensor-data fusion: which points a picture shows, their colours, and the picture's depths."""

from sceneloom.colouring.algorithms import (
    ALGORITHMS,
    ColouredPoints,
    FusionAlgorithm,
    ViewRequest,
    fuse_by_projection,
)
from sceneloom.colouring.colours import NO_CAMERA, colour_points
from sceneloom.colouring.lidar_way import LidarWay
from sceneloom.colouring.results import FusedFrame, FusedView, PointSight
from sceneloom.colouring.views import view_points
from sceneloom.colouring.visibility import VisibilitySettings, find_visible

__all__ = [
    "ALGORITHMS",
    "NO_CAMERA",
    "ColouredPoints",
    "FusedFrame",
    "FusedView",
    "FusionAlgorithm",
    "LidarWay",
    "PointSight",
    "ViewRequest",
    "VisibilitySettings",
    "colour_points",
    "find_visible",
    "fuse_by_projection",
    "view_points",
]
