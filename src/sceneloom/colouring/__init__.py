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
    from sceneloom.colouring.blending import NO_CAMERA, PointSources, blend_colours, colour_points
    from sceneloom.colouring.cuboid_projection import (
        PointCounts,
        count_points,
        observe_cuboids,
        project_cuboids,
        with_activations,
        with_counts,
        with_labeled_points,
    )
    from sceneloom.colouring.depth_completion import DenseDepth, complete_depth
    from sceneloom.colouring.exposure import ExposureGains, ExposureLinks
    from sceneloom.colouring.results import FusedFrame, FusedView, LidarTrajectory, PointVisibility
    from sceneloom.colouring.rolling_shutter import ShutterDirection
    from sceneloom.colouring.visibility import VisibilitySettings, find_visible
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "algorithms": "ALGORITHMS ColouredPoints FusionAlgorithm ViewRequest fuse_by_projection",
            "blending": "NO_CAMERA PointSources blend_colours colour_points",
            "cuboid_projection": "PointCounts count_points observe_cuboids project_cuboids with_activations "
            "with_counts with_labeled_points",
            "depth_completion": "DenseDepth complete_depth",
            "exposure": "ExposureGains ExposureLinks",
            "results": "FusedFrame FusedView LidarTrajectory PointVisibility",
            "rolling_shutter": "ShutterDirection",
            "visibility": "VisibilitySettings find_visible",
        },
    )

__all__ = [
    "ALGORITHMS", "NO_CAMERA", "ColouredPoints", "DenseDepth", "ExposureGains",
    "ExposureLinks", "FusedFrame", "FusedView", "FusionAlgorithm", "LidarTrajectory", "PointCounts", "PointSources",
    "PointVisibility", "ShutterDirection", "ViewRequest", "VisibilitySettings", "blend_colours", "colour_points",
    "complete_depth", "count_points", "find_visible", "fuse_by_projection", "observe_cuboids",
    "project_cuboids", "with_activations", "with_counts", "with_labeled_points",
]  # fmt: skip
