"""Formulas that all lenses share in which the angle off the axis alone decides on the distance from the centre."""

import math
from typing import Any

from sceneloom.cameras.angles import angle_off_axis
from sceneloom.cameras.formulas import distance_at


def pixel_off_axis(x: Any, y: Any, z: Any, lens: Any) -> Any:
    """Give the pixel of a point: in its direction from the centre, as far as `distance_at` says.

    Right ahead there is no direction: that point is seen only where the distance vanishes there.
    """
    side = math.sqrt(x * x + y * y)
    angle = angle_off_axis(side, z)
    distance, _ = distance_at(angle, lens)
    scale = distance / side if side > 0.0 else 0.0
    ahead = (z > 0.0) & (distance == 0.0)
    known = (angle < lens.limit) & (distance >= 0.0) & ((side > 0.0) | ahead)
    return (lens.fx * (x * scale) + lens.cx if known else math.nan), lens.fy * (y * scale) + lens.cy


def plane_of_centred_pixel(u: Any, v: Any, lens: Any) -> Any:
    """Take the principal point and the focal lengths off a pixel."""
    return (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
