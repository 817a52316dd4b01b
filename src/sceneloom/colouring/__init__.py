"""Sensor-data fusion: visibility, colours of points, depth images, cuboids in images and points in cuboids."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.colouring.algorithms import (
        ALGORITHMS,
        ColouredPoints,
        FusionAlgorithm,
        ViewRequest,
        fuse_by_projection,
    )
    from sceneloom.colouring.blending import (
        NO_CAMERA,
        BlendSettings,
        PointSources,
        blend_colours,
        colour_points,
        estimate_normals,
    )
    from sceneloom.colouring.cuboid_projection import (
        PointCounts,
        count_points,
        observe_cuboids,
        project_cuboids,
        with_activations,
        with_counts,
        with_labeled_points,
    )
    from sceneloom.colouring.depth_completion import METHODS, DenseDepth, complete_depth
    from sceneloom.colouring.exposure import ExposureGains, ExposureLinks
    from sceneloom.colouring.results import FusedFrame, FusedView, LidarTrajectory, PointVisibility
    from sceneloom.colouring.rolling_shutter import ShutterDirection
    from sceneloom.colouring.visibility import VisibilitySettings, find_visible
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "PointCounts": "sceneloom.colouring.cuboid_projection:PointCounts",
            "count_points": "sceneloom.colouring.cuboid_projection:count_points",
            "with_activations": "sceneloom.colouring.cuboid_projection:with_activations",
            "with_counts": "sceneloom.colouring.cuboid_projection:with_counts",
            "with_labeled_points": "sceneloom.colouring.cuboid_projection:with_labeled_points",
            "observe_cuboids": "sceneloom.colouring.cuboid_projection:observe_cuboids",
            "project_cuboids": "sceneloom.colouring.cuboid_projection:project_cuboids",
            "METHODS": "sceneloom.colouring.depth_completion:METHODS",
            "DenseDepth": "sceneloom.colouring.depth_completion:DenseDepth",
            "complete_depth": "sceneloom.colouring.depth_completion:complete_depth",
            "ALGORITHMS": "sceneloom.colouring.algorithms:ALGORITHMS",
            "NO_CAMERA": "sceneloom.colouring.blending:NO_CAMERA",
            "BlendSettings": "sceneloom.colouring.blending:BlendSettings",
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
        },
    )

__all__ = [
    "ALGORITHMS",
    "METHODS",
    "NO_CAMERA",
    "BlendSettings",
    "ColouredPoints",
    "DenseDepth",
    "ExposureGains",
    "ExposureLinks",
    "FusedFrame",
    "FusedView",
    "FusionAlgorithm",
    "LidarTrajectory",
    "PointCounts",
    "PointSources",
    "PointVisibility",
    "ShutterDirection",
    "ViewRequest",
    "VisibilitySettings",
    "blend_colours",
    "colour_points",
    "complete_depth",
    "count_points",
    "estimate_normals",
    "find_visible",
    "fuse_by_projection",
    "observe_cuboids",
    "project_cuboids",
    "with_activations",
    "with_counts",
    "with_labeled_points",
]
