"""Visualisations: points over images, depth images, coloured clouds, annotations and objects, by Pillow and NumPy."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.visualization.clouds import EgoPosition, draw_cloud_above, draw_cloud_perspective
    from sceneloom.visualization.colour_scales import DepthScale
    from sceneloom.visualization.fused_frames import (
        DriveCloud,
        contact_sheet,
        draw_depth_image,
        draw_overlay,
        iter_images,
        save_images,
    )
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "DepthScale": "sceneloom.visualization.colour_scales:DepthScale",
            "DriveCloud": "sceneloom.visualization.fused_frames:DriveCloud",
            "EgoPosition": "sceneloom.visualization.clouds:EgoPosition",
            "contact_sheet": "sceneloom.visualization.fused_frames:contact_sheet",
            "draw_cloud_above": "sceneloom.visualization.clouds:draw_cloud_above",
            "draw_cloud_perspective": "sceneloom.visualization.clouds:draw_cloud_perspective",
            "draw_depth_image": "sceneloom.visualization.fused_frames:draw_depth_image",
            "draw_overlay": "sceneloom.visualization.fused_frames:draw_overlay",
            "iter_images": "sceneloom.visualization.fused_frames:iter_images",
            "save_images": "sceneloom.visualization.fused_frames:save_images",
        },
    )

__all__ = [
    "DepthScale",
    "DriveCloud",
    "EgoPosition",
    "contact_sheet",
    "draw_cloud_above",
    "draw_cloud_perspective",
    "draw_depth_image",
    "draw_overlay",
    "iter_images",
    "save_images",
]
