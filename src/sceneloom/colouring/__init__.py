"""Sensor-data fusion: which points an image shows, their colours, and the image's depths."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.colouring.algorithms import (
        ALGORITHMS,
        ColouredPoints,
        FusionAlgorithm,
        ViewRequest,
        fuse_by_projection,
        view_points,
    )
    from sceneloom.colouring.blending import (
        NO_CAMERA,
        BlendedPoints,
        BlendSettings,
        PointSources,
        blend_colours,
        colour_points,
        estimate_normals,
    )
    from sceneloom.colouring.exposure import ExposureGains, ExposureLinks
    from sceneloom.colouring.results import FusedFrame, FusedView, LidarTrajectory, PointVisibility
    from sceneloom.colouring.rolling_shutter import ShutterDirection
    from sceneloom.colouring.visibility import VisibilitySettings, find_visible
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ALGORITHMS": "sceneloom.colouring.algorithms:ALGORITHMS",
            "NO_CAMERA": "sceneloom.colouring.blending:NO_CAMERA",
            "BlendSettings": "sceneloom.colouring.blending:BlendSettings",
            "BlendedPoints": "sceneloom.colouring.blending:BlendedPoints",
            "ColouredPoints": "sceneloom.colouring.algorithms:ColouredPoints",
            "ExposureGains": "sceneloom.colouring.exposure:ExposureGains",
            "ExposureLinks": "sceneloom.colouring.exposure:ExposureLinks",
            "FusedFrame": "sceneloom.colouring.results:FusedFrame",
            "FusedView": "sceneloom.colouring.results:FusedView",
            "FusionAlgorithm": "sceneloom.colouring.algorithms:FusionAlgorithm",
            "LidarTrajectory": "sceneloom.colouring.results:LidarTrajectory",
            "PointVisibility": "sceneloom.colouring.results:PointVisibility",
            "PointSources": "sceneloom.colouring.blending:PointSources",
            "ShutterDirection": "sceneloom.colouring.rolling_shutter:ShutterDirection",
            "ViewRequest": "sceneloom.colouring.algorithms:ViewRequest",
            "VisibilitySettings": "sceneloom.colouring.visibility:VisibilitySettings",
            "blend_colours": "sceneloom.colouring.blending:blend_colours",
            "colour_points": "sceneloom.colouring.blending:colour_points",
            "estimate_normals": "sceneloom.colouring.blending:estimate_normals",
            "find_visible": "sceneloom.colouring.visibility:find_visible",
            "fuse_by_projection": "sceneloom.colouring.algorithms:fuse_by_projection",
            "view_points": "sceneloom.colouring.algorithms:view_points",
        },
    )

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
    "LidarTrajectory",
    "PointSources",
    "PointVisibility",
    "ShutterDirection",
    "ViewRequest",
    "VisibilitySettings",
    "blend_colours",
    "colour_points",
    "estimate_normals",
    "find_visible",
    "fuse_by_projection",
    "view_points",
]
