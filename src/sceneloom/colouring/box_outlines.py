"""Outlines of boxes in an image for any camera model, with a global or a rolling shutter.

Cut at the image and the camera model.

A box is convex, and a camera model maps directions one to one, so the outline of a box in an image consists of its
edges; what is seen of it is bounded by the edges within the image, by where they cross its border, and by those corners
of the image that look at the box. An edge is followed through the directions that it covers, in equal angles: of an
edge that passes close by, equal lengths would be unequal steps in the image.

The edges are followed as `outlines` does, but as points, not directions, since the camera goes on while lines are
taken, and so may the box: each corner goes straight and evenly meanwhile.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, check_array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded, unproject
from sceneloom.colouring.rolling_shutter import ShutterDirection, pixels_by_lines
from sceneloom.geometry.boxes import EDGES
from sceneloom.kernels.boxes import bound_edges, extend_bounds, extend_to_corners, halve_steps, sample_edges

CENTRE_TO_CORNER = 0.5
"""Source: "pixels", READING in docs/CONVENTIONS.md: corner = centre + 0.5."""

_EDGES: Int64Array = read_only(EDGES, np.int64)


class _Steps(NamedTuple):
    """How closely edges are followed.

    Attributes:
        limits: (L,) float64 [rad], rising: of a box whose longest edge covers up to so much …
        counts: (L,) int64, … each edge is cut in so many steps.
    """

    limits: Float64Array
    counts: Int64Array


FINE = _Steps(read_only([0.05, 0.2, np.inf], np.float64), read_only([4, 12, 64], np.int64))
"""Within 0.1 px for all but what stands right before a bent camera model."""

COARSE = _Steps(
    read_only([0.1, 0.2, 0.4, 0.8, 1.6, np.inf], np.float64), read_only([3, 5, 8, 14, 32, 64], np.int64)
)
"""Within 1 px, and three times as quick."""

_ROUNDS = 24
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
    camera: Camera, corners_camera: Float64Array, *, steps: _Steps = FINE
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
    extend_to_corners(extents, corners, *_image_corner_rays(camera))
    return extents, shares


def _camera_model_limits(camera: Camera, known: Float64Array, unknown: Float64Array) -> Float64Array:
    """Pixels (L, 2), corner convention, where steps leave the camera model between directions within and beyond it."""
    middles, pixels = known.copy(), np.zeros((len(known), 2))
    for _ in range(_ROUNDS):
        halve_steps(known, unknown, middles, pixels)
        pixels = project_unbounded(camera, middles)
    halve_steps(known, unknown, middles, pixels)
    return project_unbounded(camera, known) + CENTRE_TO_CORNER


@lru_cache(maxsize=256)
def _image_corner_rays(camera: Camera) -> tuple[Float64Array, Float64Array]:
    """Give the corners of the image (4, 2) [px], corner convention, and the rays (4, 3) that they look along."""
    corners = np.array([[0.0, 0.0], [camera.width, 0.0], [camera.width, camera.height], [0.0, camera.height]])
    return read_only(corners), read_only(unproject(camera, corners - CENTRE_TO_CORNER))


_NOTHING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Rolling:
    """What happened while the lines of an image were taken.

    Attributes:
        trajectory: of the camera.
        drifts_world: (B, 8, 3) float64 [m], how far the corners of the boxes went from the first line to the last.
    """

    trajectory: ShutterDirection
    drifts_world: Float64Array

    def __post_init__(self) -> None:
        check_array("rolling.drifts_world", self.drifts_world, (None, 8, 3), np.float64)


def rolled_extents(
    camera: Camera,
    corners_camera: Float64Array,
    drifts: Float64Array,
    trajectory: ShutterDirection,
    *,
    steps: _Steps = FINE,
) -> tuple[Float64Array, Float64Array]:
    """Bound what an image of a rolling shutter shows of boxes.

    Args:
        camera: the camera model.
        corners_camera: (B, 8, 3) float64 [m], as of `box_extents`, in the frame of the camera at the image's time.
        drifts: (B, 8, 3) float64 [m], how far they go in that frame from the first line to the last.
        trajectory: of the camera, line by line.
        steps: how closely edges are followed.

    Returns:
        extents, shares: as `box_extents`.

    Raises:
        CalibrationError: the camera model is unknown.
    """
    corners = np.ascontiguousarray(corners_camera)
    directions, starts = sample_edges(corners, _EDGES, steps.limits, steps.counts)
    edges = _Edges.of(corners, drifts, directions, starts)
    pixels = edges.pixels(edges.shares, camera, trajectory)
    width, height = float(camera.width), float(camera.height)
    extents, shares, leaving = bound_edges(pixels, starts, len(_EDGES), width, height)
    if len(leaving):
        ends = _rolled_outlines_camera_model_limits(edges, leaving, camera, trajectory)
        extend_bounds(extents, leaving, pixels[leaving[:, 1]], ends, width, height)
    _extend_to_corners(extents, corners, drifts, camera, trajectory)
    return extents, shares


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """Points on the edges of boxes: where each edge begins and where it leads, (P, 2, 3) [m], with its drift.

    `shares` (P,) is how far along its edge each point lies.
    """

    ends: Float64Array
    drifts: Float64Array
    shares: Float64Array

    @classmethod
    def of(
        cls, corners: Float64Array, drifts: Float64Array, directions: Float64Array, starts: Int64Array
    ) -> "_Edges":
        """Put the directions of `sample_edges` on their edges."""
        counts = np.diff(starts)
        boxes = np.repeat(np.arange(len(corners)), counts)
        samples = counts[boxes] // len(_EDGES)
        locations = np.arange(len(directions)) - starts[boxes]
        joined = _EDGES[locations // np.maximum(samples, 1)]
        ends, moves = corners[boxes[:, None], joined], drifts[boxes[:, None], joined]
        return cls(ends, moves, _shares(ends, directions, locations % samples / np.maximum(samples - 1, 1)))

    def some(self, rows: Int64Array) -> "_Edges":
        return _Edges(self.ends[rows], self.drifts[rows], self.shares[rows])

    def pixels(self, shares: Float64Array, camera: Camera, trajectory: ShutterDirection) -> Float64Array:
        """Where points so far along their edges lie, (P, 2) [px], corner convention."""
        first, second = 1.0 - shares[:, None], shares[:, None]
        points = first * self.ends[:, 0] + second * self.ends[:, 1]
        drifts = first * self.drifts[:, 0] + second * self.drifts[:, 1]
        return pixels_by_lines(points, drifts, camera, trajectory) + CENTRE_TO_CORNER


def _shares(ends: Float64Array, directions: Float64Array, even: Float64Array) -> Float64Array:
    """Report how far along edges directions meet them, (P,); evenly spread where an edge points at the camera."""
    first, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    normals = np.cross(first, ends[:, 1])
    above = (np.cross(first, directions) * normals).sum(axis=1)
    below = -(np.cross(along, directions) * normals).sum(axis=1)
    scale = (first * first).sum(axis=1) * (along * along).sum(axis=1)
    met = np.abs(below) > _NOTHING * scale
    shares: Float64Array = np.clip(np.where(met, above / np.where(met, below, 1.0), even), 0.0, 1.0)
    return shares


def _rolled_outlines_camera_model_limits(
    edges: _Edges, leaving: Int64Array, camera: Camera, trajectory: ShutterDirection
) -> Float64Array:
    """Pixels (L, 2), corner convention, where steps leave the camera model between points within and beyond it."""
    steps = edges.some(leaving[:, 1])
    known, unknown = steps.shares.copy(), edges.shares[leaving[:, 2]].copy()
    for _ in range(_ROUNDS):
        middle = 0.5 * (known + unknown)
        within = np.isfinite(steps.pixels(middle, camera, trajectory)[:, 0])
        known, unknown = np.where(within, middle, known), np.where(within, unknown, middle)
    return steps.pixels(known, camera, trajectory)


def _extend_to_corners(
    extents: Float64Array,
    corners: Float64Array,
    drifts: Float64Array,
    camera: Camera,
    trajectory: ShutterDirection,
) -> None:
    """Let bounds hold those corners of the image that look at a box: two at the first line, two at the last."""
    locations, rays = _image_corner_rays(camera)
    at_end = locations[:, trajectory.axis] > 0
    for chosen, line, share in ((~at_end, 0, -0.5), (at_end, -1, 0.5)):
        pose = trajectory.lines_from_middle[line]
        there = (corners + share * drifts) @ pose[:, :3].T + pose[:, 3]
        some = np.flatnonzero(chosen)
        extend_to_corners(extents, np.ascontiguousarray(there), locations[some], rays[some])
