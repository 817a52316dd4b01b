"""Where boxes in space lie in an image, whatever the camera model: their edges as curves.

Cut at the image and the camera model.

A box is convex, and a camera model maps directions one to one, so the outline of a box in an image consists of its
edges; what is seen of it is bounded by the edges within the image, by where they cross its border, and by those corners
of the image that look at the box. An edge is followed through the directions that it covers, in equal angles: of an
edge that passes close by, equal lengths would be unequal steps in the image.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded, unproject
from sceneloom.geometry.boxes import EDGES
from sceneloom.kernels.box_outlines import (
    bound_edges,
    extend_bounds,
    extend_to_corners,
    halve_steps,
    sample_edges,
)

CENTRE_TO_CORNER = 0.5
"""Source: "pixels", READING in docs/CONVENTIONS.md: corner = centre + 0.5."""

_EDGES: Int64Array = read_only(EDGES, np.int64)


class Steps(NamedTuple):
    """How closely edges are followed.

    Attributes:
        limits: (L,) float64 [rad], rising: of a box whose longest edge covers up to so much …
        counts: (L,) int64, … each edge is cut in so many steps.
    """

    limits: Float64Array
    counts: Int64Array


FINE = Steps(read_only([0.05, 0.2, np.inf], np.float64), read_only([4, 12, 64], np.int64))
"""Within 0.1 px for all but what stands right before a bent camera model."""
COARSE = Steps(
    read_only([0.1, 0.2, 0.4, 0.8, 1.6, np.inf], np.float64), read_only([3, 5, 8, 14, 32, 64], np.int64)
)
"""Within 1 px, and three times as quick."""

ROUNDS = 24
"""How often the step in which an edge leaves the camera model is halved."""
_BORDER_STEPS = 33


@lru_cache(maxsize=256)
def widest_angle(camera: Camera) -> float:
    """The largest angle off the axis that the image shows [rad]; π where its border lies beyond the camera model."""
    along = np.linspace(0.0, 1.0, _BORDER_STEPS)
    u = np.concatenate([along, along, np.zeros_like(along), np.ones_like(along)]) * camera.width - 0.5
    v = np.concatenate([np.zeros_like(along), np.ones_like(along), along, along]) * camera.height - 0.5
    rays = unproject(camera, np.column_stack([u, v]))
    if not np.isfinite(rays).all():
        return float(np.pi)
    return float(np.arccos(np.clip(rays[:, 2], -1.0, 1.0)).max())


def box_extents(
    camera: Camera, corners_camera: Float64Array, *, steps: Steps = FINE
) -> tuple[Float64Array, Float64Array]:
    """Bound what an image shows of boxes.

    Args:
        camera: the camera model.
        corners_camera: (B, 8, 3) float64 [m], in the order of `geometry.boxes.CORNER_SIGNS`; none at the camera, no
            edge through it.
        steps: how closely edges are followed.

    Returns:
        extents: (B, 4) float64 [px], corner convention, left, top, right, bottom; infinities the wrong way round where
            nothing of a box is in the image.
        shares: (B,) float64, which share of its edges, in equal angles, is in the image; 1 where all of it is.

    Raises:
        CalibrationError: the camera model is unknown.
    """
    corners = np.ascontiguousarray(corners_camera)
    directions, starts = sample_edges(corners, _EDGES, steps.limits, steps.counts)
    pixels = project_unbounded(camera, directions)
    pixels += CENTRE_TO_CORNER
    width, height = float(camera.width), float(camera.height)
    extents, shares, leaving = bound_edges(pixels, starts, len(EDGES), width, height)
    if len(leaving):
        ends = _camera_model_limits(camera, directions[leaving[:, 1]], directions[leaving[:, 2]])
        extend_bounds(extents, leaving, pixels[leaving[:, 1]], ends, width, height)
    extend_to_corners(extents, corners, *image_corner_rays(camera))
    return extents, shares


def _camera_model_limits(camera: Camera, known: Float64Array, unknown: Float64Array) -> Float64Array:
    """Pixels (L, 2), corner convention, where steps leave the camera model between directions within and beyond it."""
    middles, pixels = known.copy(), np.zeros((len(known), 2))
    for _ in range(ROUNDS):
        halve_steps(known, unknown, middles, pixels)
        pixels = project_unbounded(camera, middles)
    halve_steps(known, unknown, middles, pixels)
    return project_unbounded(camera, known) + CENTRE_TO_CORNER


@lru_cache(maxsize=256)
def image_corner_rays(camera: Camera) -> tuple[Float64Array, Float64Array]:
    """Give the corners of the image (4, 2) [px], corner convention, and the rays (4, 3) that they look along."""
    corners = np.array([[0.0, 0.0], [camera.width, 0.0], [camera.width, camera.height], [0.0, camera.height]])
    return read_only(corners), read_only(unproject(camera, corners - CENTRE_TO_CORNER))
