"""Images for people: points over the image, depths, and the coloured cloud, drawn with Pillow and NumPy."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.images.cloud_above import draw_cloud_above
    from sceneloom.images.cloud_perspective import draw_cloud_perspective
    from sceneloom.images.colour_maps import ColourMap, colour_map
    from sceneloom.images.depth_scale import DepthScale
    from sceneloom.images.drive_cloud import DriveCloud
    from sceneloom.images.ego import EgoPosition, find_ego
    from sceneloom.images.sheets import contact_sheet, iter_images, save_images
    from sceneloom.images.views import draw_depth_image, draw_overlay
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ColourMap": "sceneloom.images.colour_maps:ColourMap",
            "DepthScale": "sceneloom.images.depth_scale:DepthScale",
            "DriveCloud": "sceneloom.images.drive_cloud:DriveCloud",
            "EgoPosition": "sceneloom.images.ego:EgoPosition",
            "colour_map": "sceneloom.images.colour_maps:colour_map",
            "contact_sheet": "sceneloom.images.sheets:contact_sheet",
            "draw_cloud_above": "sceneloom.images.cloud_above:draw_cloud_above",
            "draw_cloud_perspective": "sceneloom.images.cloud_perspective:draw_cloud_perspective",
            "draw_depth_image": "sceneloom.images.views:draw_depth_image",
            "draw_overlay": "sceneloom.images.views:draw_overlay",
            "find_ego": "sceneloom.images.ego:find_ego",
            "iter_images": "sceneloom.images.sheets:iter_images",
            "save_images": "sceneloom.images.sheets:save_images",
        },
    )

__all__ = [
    "ColourMap",
    "DepthScale",
    "DriveCloud",
    "EgoPosition",
    "colour_map",
    "contact_sheet",
    "draw_cloud_above",
    "draw_cloud_perspective",
    "draw_depth_image",
    "draw_overlay",
    "find_ego",
    "iter_images",
    "save_images",
]
