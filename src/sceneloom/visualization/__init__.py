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
            "clouds": "EgoPosition draw_cloud_above draw_cloud_perspective",
            "colour_scales": "DepthScale",
            "fused_frames": "DriveCloud contact_sheet draw_depth_image draw_overlay iter_images save_images",
        },
    )

__all__ = [
    "DepthScale", "DriveCloud", "EgoPosition", "contact_sheet", "draw_cloud_above", "draw_cloud_perspective",
    "draw_depth_image", "draw_overlay", "iter_images", "save_images",
]  # fmt: skip
