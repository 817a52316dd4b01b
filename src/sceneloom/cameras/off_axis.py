"""Formulas of camera models in which the angle off the axis alone decides on the distance from the image's centre."""

import math
from typing import Any

from sceneloom.cameras.angles import angle_off_axis
from sceneloom.cameras.formulas import distance_at, pixel_of_plane


def pixel_off_axis(x: Any, y: Any, z: Any, camera_model: Any) -> Any:
    """Give the pixel of a point: in its direction from the centre, as far as `distance_at` says.

    Right ahead there is no direction: that point is seen only where the distance vanishes there.
    """
    side = math.sqrt(x * x + y * y)
    angle = angle_off_axis(side, z)
    distance, _ = distance_at(angle, camera_model)
    scale = distance / side if side > 0.0 else 0.0
    u, v = pixel_of_plane(x * scale, y * scale, camera_model)
    ahead = (side == 0.0) & (z > 0.0) & (distance == 0.0)
    known = (angle < camera_model.limit) & (((side > 0.0) & (distance > 0.0)) | ahead)
    return (u if known else math.nan), v
