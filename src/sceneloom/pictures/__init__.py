"""Pictures for people: points over the photograph, depths, and the coloured cloud, drawn with Pillow and NumPy."""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.pictures.cloud_above import draw_cloud_above
    from sceneloom.pictures.cloud_perspective import draw_cloud_perspective
    from sceneloom.pictures.colour_maps import ColourMap, colour_map
    from sceneloom.pictures.depth_scale import DepthScale
    from sceneloom.pictures.drive_cloud import DriveCloud
    from sceneloom.pictures.ego import EgoPlace, find_ego
    from sceneloom.pictures.sheets import contact_sheet, iter_pictures, save_pictures
    from sceneloom.pictures.views import draw_depth_image, draw_overlay
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "ColourMap": "sceneloom.pictures.colour_maps:ColourMap",
            "DepthScale": "sceneloom.pictures.depth_scale:DepthScale",
            "DriveCloud": "sceneloom.pictures.drive_cloud:DriveCloud",
            "EgoPlace": "sceneloom.pictures.ego:EgoPlace",
            "colour_map": "sceneloom.pictures.colour_maps:colour_map",
            "contact_sheet": "sceneloom.pictures.sheets:contact_sheet",
            "draw_cloud_above": "sceneloom.pictures.cloud_above:draw_cloud_above",
            "draw_cloud_perspective": "sceneloom.pictures.cloud_perspective:draw_cloud_perspective",
            "draw_depth_image": "sceneloom.pictures.views:draw_depth_image",
            "draw_overlay": "sceneloom.pictures.views:draw_overlay",
            "find_ego": "sceneloom.pictures.ego:find_ego",
            "iter_pictures": "sceneloom.pictures.sheets:iter_pictures",
            "save_pictures": "sceneloom.pictures.sheets:save_pictures",
        },
    )

__all__ = [
    "ColourMap",
    "DepthScale",
    "DriveCloud",
    "EgoPlace",
    "colour_map",
    "contact_sheet",
    "draw_cloud_above",
    "draw_cloud_perspective",
    "draw_depth_image",
    "draw_overlay",
    "find_ego",
    "iter_pictures",
    "save_pictures",
]
