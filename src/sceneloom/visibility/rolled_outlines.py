"""Where boxes lie in an image whose lines were taken one after the other: each point by the time of its line.

The edges are followed as `outlines` does, but as points, not directions, since the camera goes on while lines are
taken, and so may the box: each corner goes straight and evenly meanwhile.
"""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, check_array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.boxes import EDGES
from sceneloom.kernels.box_outlines import bound_edges, extend_bounds, extend_to_corners, sample_edges
from sceneloom.visibility.outlines import CENTRE_TO_CORNER, FINE, ROUNDS, Steps, image_corner_rays
from sceneloom.visibility.rolling_shutter import ShutterDirection, pixels_by_lines

_EDGES: Int64Array = read_only(EDGES, np.int64)
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
    steps: Steps = FINE,
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
        ends = _camera_model_limits(edges, leaving, camera, trajectory)
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


def _camera_model_limits(
    edges: _Edges, leaving: Int64Array, camera: Camera, trajectory: ShutterDirection
) -> Float64Array:
    """Pixels (L, 2), corner convention, where steps leave the camera model between points within and beyond it."""
    steps = edges.some(leaving[:, 1])
    known, unknown = steps.shares.copy(), edges.shares[leaving[:, 2]].copy()
    for _ in range(ROUNDS):
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
    locations, rays = image_corner_rays(camera)
    at_end = locations[:, trajectory.axis] > 0
    for chosen, line, share in ((~at_end, 0, -0.5), (at_end, -1, 0.5)):
        pose = trajectory.lines_from_middle[line]
        there = (corners + share * drifts) @ pose[:, :3].T + pose[:, 3]
        some = np.flatnonzero(chosen)
        extend_to_corners(extents, np.ascontiguousarray(there), locations[some], rays[some])
