"""Boxes of objects in images: the outline of the box in space, and how the detector's boxes differ from it.

A detector's box is not the outline of the box in space: arms and shadows, sizes and locations that are a little off.
How it differs changes slowly: its middle by shares of the outline's sides, its sides by factors. These four numbers are
filtered, so that the box in the next image is foreseen well, and so that one image's noise does not count in full.
"""

from dataclasses import fields

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.detections.outlines import Outlines, project_outlines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.tracking.observation import View
from sceneloom.visibility.outlines import widest_angle

EDGE_PX, EDGE_SHARE = 1.0, 0.02
"""Deviation of an edge of a detector's box: so many pixels, plus so much of its side."""
DRIFTS = (0.05, 0.3)
"""How much a box comes to differ from the outline, as shares of its sides: of vehicles and people [after a second]."""
UNKNOWN = 0.15**2
"""Variance of how they differ before anything is known of it."""


def outlines(
    numbers: Float64Array, likely: Float64Array, world_from_lidar: RigidTransform, view: View
) -> Outlines:
    """Where an image shows boxes of the world.

    Args:
        numbers: (N, 7), middle, length, width, height [m] and heading [rad].
        likely: (N,), how likely each is there, and hides what is behind it.
        world_from_lidar: where the lidar is.
        view: the camera.
    """
    rotation = world_from_lidar.rotation
    cosines, sines = np.cos(numbers[:, 6]), np.sin(numbers[:, 6])
    boxes = numbers.copy()
    boxes[:, :3] = (numbers[:, :3] - world_from_lidar.translation) @ rotation
    boxes[:, 6] = np.arctan2(
        rotation[0, 1] * cosines + rotation[1, 1] * sines, rotation[0, 0] * cosines + rotation[1, 0] * sines
    )
    in_view = _in_view(boxes, view)
    if in_view.all():
        return project_outlines(view.camera, view.camera_from_lidar, boxes, likely=likely)
    found = project_outlines(view.camera, view.camera_from_lidar, boxes[in_view], likely=likely[in_view])
    return Outlines(*(_spread(getattr(found, f.name), in_view) for f in fields(found)))


def _in_view(boxes: Float64Array, view: View) -> BoolArray:
    """Which boxes may be in the image: not those whose ball lies outside the cone that it shows.

    To find where such a box leaves the camera model, which it never enters, is slow.
    """
    middles = boxes[:, :3] @ view.camera_from_lidar.rotation.T + view.camera_from_lidar.translation
    away = np.sqrt((middles**2).sum(axis=1))
    reach = np.sqrt((boxes[:, 3:6] ** 2).sum(axis=1)) / 2.0
    angles = np.arctan2(np.hypot(middles[:, 0], middles[:, 1]), middles[:, 2])
    balls = np.arcsin(np.minimum(reach / np.maximum(away, 1e-9), 1.0))
    in_view: BoolArray = (angles - balls < widest_angle(view.camera)) | (reach >= away)
    return in_view


def _spread(rows: Float64Array, chosen: BoolArray) -> Float64Array:
    """Rows in their locations among all, zeros between them."""
    every = np.zeros((len(chosen), *rows.shape[1:]))
    every[chosen] = rows
    return every


def filtered(
    differing: Float64Array, variances: Float64Array, corners: Float64Array, outlined: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Read how boxes of an image differ from outlines.

    Args:
        differing, variances: (N, 4), what is known of it, NaN where nothing is.
        corners: (N, 4) [px], boxes of the detector, NaN where there are none.
        outlined: (N, 4) [px], zeros where there are none.
    """
    fresh = np.isnan(differing)
    means, variances = np.where(fresh, 0.0, differing), np.where(fresh, UNKNOWN, variances)
    seen = np.flatnonzero(has_area(corners) & has_area(outlined))
    apart = differences(corners[seen], outlined[seen])
    gains = variances[seen] / (variances[seen] + noises(corners[seen]))
    means[seen] += gains * (apart - means[seen])
    variances[seen] *= 1.0 - gains
    return means, variances


def differences(corners: Float64Array, outlined: Float64Array) -> Float64Array:
    """Shifts of the middles of boxes (N, 4) from those of outlines, and logarithms of the factors of their sides."""
    sides, usual = corners[:, 2:] - corners[:, :2], outlined[:, 2:] - outlined[:, :2]
    shifts = ((corners[:, :2] + corners[:, 2:]) - (outlined[:, :2] + outlined[:, 2:])) / (2.0 * usual)
    return np.concatenate([shifts, np.log(sides / usual)], axis=1)


def noises(corners: Float64Array) -> Float64Array:
    """Variances (N, 4) of the differences of a detector's boxes: of a middle half, of a side twice those of an edge."""
    edges = (EDGE_PX / (corners[:, 2:] - corners[:, :2]) + EDGE_SHARE) ** 2
    return np.concatenate([edges / 2.0, edges * 2.0], axis=1)


def applied(differing: Float64Array, outlined: Float64Array, width: int, height: int) -> Float64Array:
    """The boxes that differ so from outlines, cut at the image; NaN where there is no outline.

    Args:
        differing: (N, 4), NaN where nothing is known of it.
        outlined: (N, 4) [px].
        width, height: of the image [px].
    """
    known = np.where(np.isnan(differing), 0.0, differing)
    sides = outlined[:, 2:] - outlined[:, :2]
    middles = (outlined[:, :2] + outlined[:, 2:]) / 2.0 + known[:, :2] * sides
    halves = sides * np.exp(known[:, 2:]) / 2.0
    corners = np.concatenate([middles - halves, middles + halves], axis=1)
    corners = np.clip(corners, 0.0, (width, height, width, height))
    corners[~(has_area(outlined) & has_area(corners))] = np.nan
    boxes: Float64Array = corners
    return boxes


def has_area(corners: Float64Array) -> BoolArray:
    """Which boxes (N, 4) have an area; those with NaN have none."""
    area: BoolArray = (corners[:, 2] > corners[:, 0]) & (corners[:, 3] > corners[:, 1])
    return area
