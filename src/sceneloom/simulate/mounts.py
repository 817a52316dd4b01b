"""Where sensors sit on the ego: mountings by location and angles."""

import numpy as np

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate.path import rotation_from_angles


def sensor_mount(
    *,
    position: tuple[float, float, float],
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
) -> RigidTransform:
    """Give `ego_from_sensor` of a lidar or radar, whose own axes are x ahead, y left, z up.

    Args:
        position: in the ego frame [m].
        yaw_deg, pitch_deg, roll_deg: rotates about the ego's z, y and x axis, roll first; a positive pitch looks down.
    """
    roll, pitch, yaw = np.radians([roll_deg, pitch_deg, yaw_deg])
    return RigidTransform(rotation_from_angles(roll, pitch, yaw), np.array(position, np.float64))
