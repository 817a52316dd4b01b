"""Where boxes lie in a picture whose lines were taken one after the other: each point by the time of its line.

The edges are followed as `outlines` does, but as points, not directions, since the camera goes on while lines are
taken, and so may the box: each corner goes straight and evenly meanwhile.
"""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, check_array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.boxes import EDGES
from sceneloom.kernels.box_outlines import bound_edges, extend_bounds, extend_to_corners, sample_edges
from sceneloom.visibility.outlines import CENTRE_TO_CORNER, FINE, ROUNDS, Steps, picture_corner_rays
from sceneloom.visibility.rolling_shutter import ShutterWay, pixels_by_lines

_EDGES: Int64Array = read_only(EDGES, np.int64)
_NOTHING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Rolling:
    """What happened while the lines of a picture were taken.

    Attributes:
        way: of the camera.
        drifts_world: (B, 8, 3) float64 [m], how far the corners of the boxes went from the first line to the last.
    """

    way: ShutterWay
    drifts_world: Float64Array

    def __post_init__(self) -> None:
        check_array("rolling.drifts_world", self.drifts_world, (None, 8, 3), np.float64)


def rolled_extents(
    camera: Camera,
    corners_camera: Float64Array,
    drifts: Float64Array,
    way: ShutterWay,
    *,
    steps: Steps = FINE,
) -> tuple[Float64Array, Float64Array]:
    """Bound what a picture of a rolling shutter shows of boxes.

    Args:
        camera: the lens.
        corners_camera: (B, 8, 3) float64 [m], as of `box_extents`, in the frame of the camera at the picture's time.
        drifts: (B, 8, 3) float64 [m], how far they go in that frame from the first line to the last.
        way: of the camera, line by line.
        steps: how closely edges are followed.

    Returns:
        extents, shares: as `box_extents`.

    Raises:
        CalibrationError: the lens is unknown.
    """
    corners = np.ascontiguousarray(corners_camera)
    directions, starts = sample_edges(corners, _EDGES, steps.limits, steps.counts)
    edges = _Edges.of(corners, drifts, directions, starts)
    pixels = edges.pixels(edges.shares, camera, way)
    width, height = float(camera.width), float(camera.height)
    extents, shares, leaving = bound_edges(pixels, starts, len(_EDGES), width, height)
    if len(leaving):
        ends = _lens_limits(edges, leaving, camera, way)
        extend_bounds(extents, leaving, pixels[leaving[:, 1]], ends, width, height)
    _extend_to_corners(extents, corners, drifts, camera, way)
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
        places = np.arange(len(directions)) - starts[boxes]
        joined = _EDGES[places // np.maximum(samples, 1)]
        ends, moves = corners[boxes[:, None], joined], drifts[boxes[:, None], joined]
        return cls(ends, moves, _shares(ends, directions, places % samples / np.maximum(samples - 1, 1)))

    def some(self, rows: Int64Array) -> "_Edges":
        return _Edges(self.ends[rows], self.drifts[rows], self.shares[rows])

    def pixels(self, shares: Float64Array, camera: Camera, way: ShutterWay) -> Float64Array:
        """Where points so far along their edges lie, (P, 2) [px], corner convention."""
        first, second = 1.0 - shares[:, None], shares[:, None]
        points = first * self.ends[:, 0] + second * self.ends[:, 1]
        drifts = first * self.drifts[:, 0] + second * self.drifts[:, 1]
        return pixels_by_lines(points, drifts, camera, way) + CENTRE_TO_CORNER


def _shares(ends: Float64Array, directions: Float64Array, even: Float64Array) -> Float64Array:
    """Tell how far along edges directions meet them, (P,); evenly spread where an edge points at the camera."""
    first, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    normals = np.cross(first, ends[:, 1])
    above = (np.cross(first, directions) * normals).sum(axis=1)
    below = -(np.cross(along, directions) * normals).sum(axis=1)
    scale = (first * first).sum(axis=1) * (along * along).sum(axis=1)
    met = np.abs(below) > _NOTHING * scale
    shares: Float64Array = np.clip(np.where(met, above / np.where(met, below, 1.0), even), 0.0, 1.0)
    return shares


def _lens_limits(edges: _Edges, leaving: Int64Array, camera: Camera, way: ShutterWay) -> Float64Array:
    """Pixels (L, 2), corner convention, where steps leave the lens between points within and beyond it."""
    steps = edges.some(leaving[:, 1])
    known, unknown = steps.shares.copy(), edges.shares[leaving[:, 2]].copy()
    for _ in range(ROUNDS):
        middle = 0.5 * (known + unknown)
        within = np.isfinite(steps.pixels(middle, camera, way)[:, 0])
        known, unknown = np.where(within, middle, known), np.where(within, unknown, middle)
    return steps.pixels(known, camera, way)


def _extend_to_corners(
    extents: Float64Array, corners: Float64Array, drifts: Float64Array, camera: Camera, way: ShutterWay
) -> None:
    """Let bounds hold those corners of the picture that look at a box: two at the first line, two at the last."""
    places, rays = picture_corner_rays(camera)
    at_end = places[:, way.axis] > 0
    for chosen, line, share in ((~at_end, 0, -0.5), (at_end, -1, 0.5)):
        pose = way.lines_from_middle[line]
        there = (corners + share * drifts) @ pose[:, :3].T + pose[:, 3]
        some = np.flatnonzero(chosen)
        extend_to_corners(extents, np.ascontiguousarray(there), places[some], rays[some])
