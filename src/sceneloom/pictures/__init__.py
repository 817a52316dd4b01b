"""Pictures for people: points over the photograph, depths, and the coloured cloud, drawn with Pillow and NumPy."""

from sceneloom.pictures.cloud_above import draw_cloud_above
from sceneloom.pictures.cloud_perspective import draw_cloud_perspective
from sceneloom.pictures.colour_maps import ColourMap, colour_map
from sceneloom.pictures.depth_scale import DepthScale
from sceneloom.pictures.drive_cloud import DriveCloud
from sceneloom.pictures.ego import EgoPlace, find_ego
from sceneloom.pictures.sheets import contact_sheet, iter_pictures, save_pictures
from sceneloom.pictures.views import draw_depth_image, draw_overlay

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
