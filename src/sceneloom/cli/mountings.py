"""Where a sensor sits on the ego and which way it looks, in words: what a wrong extrinsic shows itself by."""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.ego import EgoAxes
from sceneloom.scene.scene import Sensor

_SECTORS = ("ahead", "ahead left", "left", "back left", "back", "back right", "right", "ahead right")
_STEEP = np.cos(np.pi / 6)
"""An axis that stands nearer than 30 degrees to the vertical has no direction in the plane worth naming."""

_TILTED = np.cos(np.pi / 4)


_STANDARD = EgoAxes(np.eye(3), known=True)


def mounting_text(sensor: Sensor, axes: EgoAxes = _STANDARD) -> str | None:
    """Report where a sensor is in the ego's frame, and how it is rotated against the vehicle.

    Args:
        axes: where the vehicle's forward and upward directions are in the ego's frame.

    Returns:
        None where the mounting is not known.
    """
    mount: RigidTransform | None = getattr(sensor, "mount", None)
    if mount is None:
        return None
    rotation = axes.body_from_ego @ mount.matrix[:3, :3]
    x, y, z = mount.translation + 0.0
    delta_rotation = (
        _camera_rotation(rotation)
        if isinstance(sensor, CameraSensor | DepthCameraSensor)
        else _body_rotation(rotation)
    )
    location = "" if not np.abs(mount.translation).max() else f" at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    if delta_rotation and not axes.known:
        delta_rotation += " if the ego's x axis is ahead"
    return ", ".join(filter(None, [f"mounted on the ego{location}", delta_rotation]))


def _camera_rotation(ego_from_camera: Float64Array) -> str:
    """Name the optical axis (z), and the trajectory that the image's upper edge (-y) points."""
    forward, up = ego_from_camera[:, 2], -ego_from_camera[:, 1]
    if abs(forward[2]) > _STEEP:
        return f"looks {'up' if forward[2] > 0 else 'down'}"
    if abs(up[2]) < _TILTED * np.hypot(forward[0], forward[1]):
        return f"looks {_sector(forward)}, lying on its side"
    return f"looks {_sector(forward)}" + ("" if up[2] > 0 else ", upside down")


def _body_rotation(ego_from_sensor: Float64Array) -> str:
    """Name the trajectory that the x axis points where it is not ahead, and a z axis that is not upright."""
    forward, upright = ego_from_sensor[:, 0], ego_from_sensor[2, 2]
    if upright < -_TILTED:
        return "upside down"
    if upright < _TILTED:
        return "lying on its side"
    sector = _sector(forward)
    return "" if sector == _SECTORS[0] else f"its x axis points {sector}"


def _sector(direction: Float64Array) -> str:
    """The eighth of a circle around the ego that a direction is in."""
    delta_rotation = np.arctan2(direction[1], direction[0])
    return _SECTORS[round(float(delta_rotation) / (np.pi / 4)) % len(_SECTORS)]
