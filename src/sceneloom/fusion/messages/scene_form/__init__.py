"""Records of DB34/T 4101-2022 as objects of the scene model, and back."""

from sceneloom.fusion.messages.scene_form.boxes import (
    boxes_2d_of,
    boxes_2d_record,
    boxes_3d_of,
    boxes_3d_record,
)
from sceneloom.fusion.messages.scene_form.clouds import (
    COLOR_NAMES,
    fields_of,
    lidar_frame_of,
    lidar_frame_of_raw,
    lidar_frame_of_result,
    point_cloud_of,
    point_columns,
    points_of,
    result_fields,
)
from sceneloom.fusion.messages.scene_form.pictures import (
    image_data_of,
    image_of_raw,
    picture_of,
    picture_of_raw,
    picture_of_result,
    pixels_of_rgb,
    rgb_of_pixels,
)
from sceneloom.fusion.messages.scene_form.results import depth_frame_of, range_image, sensor_fusion_of

__all__ = [
    "COLOR_NAMES",
    "boxes_2d_of",
    "boxes_2d_record",
    "boxes_3d_of",
    "boxes_3d_record",
    "depth_frame_of",
    "fields_of",
    "image_data_of",
    "image_of_raw",
    "lidar_frame_of",
    "lidar_frame_of_raw",
    "lidar_frame_of_result",
    "picture_of",
    "picture_of_raw",
    "picture_of_result",
    "pixels_of_rgb",
    "point_cloud_of",
    "point_columns",
    "points_of",
    "range_image",
    "result_fields",
    "rgb_of_pixels",
    "sensor_fusion_of",
]
