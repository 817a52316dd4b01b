"""Where points fall in an image under a candidate calibration, and how that changes with its numbers."""

from dataclasses import replace

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.calibrate.measures.candidate import UNITS, Change, Parameter
from sceneloom.calibrate.refinement.cues import Cues
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded

_STEP_SHARE = 1e-4
"""Derivatives of the camera model are taken over this part of a point's distance."""
_FOCAL_STEP = 1e-4
_SHIFTS = range(Parameter.RIGHT, Parameter.AHEAD + 1)


def moving_pixels(
    cues: Cues, chosen: AnyArray, numbers: Float64Array, free: AnyArray
) -> tuple[Float64Array, Float64Array]:
    """Give pixels (M, 2) [px of the measured image] of some points of a frame, and their derivatives (M, 2, P).

    Args:
        chosen: (M,) int64, which points.
        numbers: (8,) of the candidate.
        free: (P,) int64, the numbers by which derivatives are taken, each by its unit.
    """
    points = cues.points_lidar[chosen]
    change = Change.of(numbers)
    matrix = change.camera_from_points(cues.frame)
    camera = focused(cues.features.image.camera, float(numbers[Parameter.FOCAL]))
    seen = points @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = project_unbounded(camera, seen)
    by_location = _by_location(camera, seen, pixels)
    slopes = np.empty((len(points), 2, len(free)))
    for column, k in enumerate(free.tolist()):
        if k == Parameter.FOCAL:
            wider = project_unbounded(focused(camera, _FOCAL_STEP), seen)
            slopes[:, :, column] = (wider - pixels) * (UNITS[k] / _FOCAL_STEP)
        elif k in _SHIFTS:
            slopes[:, :, column] = by_location[k - Parameter.RIGHT].T * UNITS[k]
        else:
            velocity = _velocity(cues, k, seen, points, matrix) * UNITS[k]
            slopes[:, :, column] = np.einsum("cin,nc->ni", by_location, velocity)
    return pixels, slopes


def focused(camera: Camera, logarithm: float) -> Camera:
    """The camera with focal lengths multiplied by a factor, of which the logarithm is given."""
    scale = float(np.exp(logarithm))
    return camera if scale == 1.0 else replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)


def _by_location(camera: Camera, seen: Float64Array, pixels: Float64Array) -> Float64Array:
    """How pixels change with the points' locations in the camera frame, (3, 2, M) [px/m], by axis."""
    steps = _STEP_SHARE * np.sqrt(np.einsum("ij,ij->i", seen, seen))
    trajectories = np.empty((3, 2, len(seen)))
    for axis in range(3):
        ahead = seen.copy()
        ahead[:, axis] += steps
        trajectories[axis] = ((project_unbounded(camera, ahead) - pixels) / steps[:, None]).T
    return trajectories


def _velocity(
    cues: Cues, parameter: int, seen: Float64Array, points_lidar: Float64Array, matrix: Float64Array
) -> Float64Array:
    """How the points move in the camera frame as a rotation or the time grows, (M, 3)."""
    if parameter < Parameter.RIGHT:
        return _across(np.eye(3)[parameter], seen)
    twist = cues.frame.twist_lidar
    if twist is None:
        return np.zeros_like(seen)
    moved: Float64Array = -(_across(twist[:3], points_lidar) + twist[3:]) @ matrix[:3, :3].T
    return moved


def _across(rotation: Float64Array, points: Float64Array) -> Float64Array:
    """The cross product of a vector with points, (M, 3): a product with a matrix is several times as fast."""
    x, y, z = rotation
    crossed: Float64Array = points @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    return crossed
