"""Where boxes in space lie in a picture, whatever the lens: their edges as curves, cut at the picture and the lens.

A box is convex, and a lens maps directions one to one, so the outline of a box in a picture consists of its edges; what
is seen of it is bounded by the edges within the picture, by where they cross its border, and by those corners of the
picture that look at the box. An edge is followed through the directions that it covers, in equal angles: of an edge
that passes close by, equal lengths would be unequal steps in the picture.
"""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded, unproject
from sceneloom.geometry.boxes import EDGES

CENTRE_TO_CORNER = 0.5
"""Source: "pixels", READING in docs/CONVENTIONS.md: corner = centre + 0.5."""

_STEPS = ((0.05, 4), (0.2, 12), (np.inf, 64))
"""So many steps along each edge of boxes whose longest edge covers up to so many radians."""
_ROUNDS = 24
"""How often the step in which an edge leaves the lens is halved."""
_BORDER_STEPS = 33


def widest_angle(camera: Camera) -> float:
    """The largest angle off the axis that the picture shows [rad]; π where its border lies beyond the lens."""
    along = np.linspace(0.0, 1.0, _BORDER_STEPS)
    u = np.concatenate([along, along, np.zeros_like(along), np.ones_like(along)]) * camera.width - 0.5
    v = np.concatenate([np.zeros_like(along), np.ones_like(along), along, along]) * camera.height - 0.5
    rays = unproject(camera, np.column_stack([u, v]))
    if not np.isfinite(rays).all():
        return float(np.pi)
    return float(np.arccos(np.clip(rays[:, 2], -1.0, 1.0)).max())


def picture_corner_rays(camera: Camera) -> tuple[Float64Array, Float64Array]:
    """The corners of the picture (4, 2) [px], corner convention, and the rays (4, 3) that they look along."""
    corners = np.array([[0.0, 0.0], [camera.width, 0.0], [camera.width, camera.height], [0.0, camera.height]])
    return corners, unproject(camera, corners - CENTRE_TO_CORNER)


def edge_extents(camera: Camera, corners_camera: Float64Array) -> tuple[Float64Array, BoolArray]:
    """Bound the edges of boxes within the picture.

    Args:
        camera: the lens.
        corners_camera: (B, 8, 3) [m], none at the camera, no edge through it.

    Returns:
        extents: (B, 4) float64 [px], corner convention, left, top, right, bottom; infinities the wrong way round where
            no edge is in the picture.
        whole: (B,) bool, whether the picture shows every edge from end to end.
    """
    first, last = np.array(EDGES).T
    directions = corners_camera / np.linalg.norm(corners_camera, axis=2, keepdims=True)
    start, stop = directions[:, first], directions[:, last]
    angles = np.arctan2(np.linalg.norm(np.cross(start, stop), axis=2), (start * stop).sum(axis=2))
    extents = np.tile([np.inf, np.inf, -np.inf, -np.inf], (len(start), 1))
    whole, longest, below = np.zeros(len(start), np.bool_), angles.max(axis=1, initial=0.0), -1.0
    for limit, steps in _STEPS:
        rows = np.flatnonzero((longest > below) & (longest <= limit))
        if len(rows):
            arcs = _Arcs(camera, start[rows], stop[rows], angles[rows])
            extents[rows], whole[rows] = arcs.extents(steps)
        below = limit
    return extents, whole


class _Arcs:
    """The edges of boxes as arcs of directions."""

    def __init__(self, camera: Camera, start: Float64Array, stop: Float64Array, angles: Float64Array) -> None:
        self.camera, self.start, self.stop = camera, start[:, :, None], stop[:, :, None]
        self.angles = angles[:, :, None, None]

    def pixels(self, shares: Float64Array) -> Float64Array:
        """Pixels (B, 12, S, 2), corner convention, at shares (…, S) of the arcs; NaN beyond the lens."""
        along = np.broadcast_to(shares, (*self.angles.shape[:2], shares.shape[-1]))[..., None]
        # sin(x) = x sinc(x): no division by zero for an edge that points at the camera
        before = (1.0 - along) * np.sinc((1.0 - along) * self.angles / np.pi)
        after = along * np.sinc(along * self.angles / np.pi)
        directions = (before * self.start + after * self.stop).reshape(-1, 3)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return project_unbounded(self.camera, directions).reshape(*along.shape[:3], 2) + CENTRE_TO_CORNER

    def extents(self, steps: int) -> tuple[Float64Array, BoolArray]:
        shares = np.linspace(0.0, 1.0, steps + 1)
        pixels = self.pixels(shares)
        size = np.array([self.camera.width, self.camera.height], np.float64)
        inside: BoolArray = np.all((pixels >= 0.0) & (pixels <= size), axis=3)
        begin, end = self._segments(pixels, shares)
        extents = _bounds(*_clipped(begin, end, size))
        bulging = _bulges(pixels, inside)
        extents[:, :2] = np.maximum(np.minimum(extents[:, :2], bulging[:, :2]), 0.0)
        extents[:, 2:] = np.minimum(np.maximum(extents[:, 2:], bulging[:, 2:]), size)
        return extents, np.all(inside, axis=(1, 2))

    def _segments(self, pixels: Float64Array, shares: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Both ends (B, 12 S, 2) of all steps; of one that leaves the lens, its part within."""
        begin, end = pixels[:, :, :-1].copy(), pixels[:, :, 1:].copy()
        begins, ends = np.isfinite(begin[..., 0]), np.isfinite(end[..., 0])
        box, edge, step = np.nonzero(begins != ends)
        if len(box):
            leaves = begins[box, edge, step]
            known, unknown = (
                shares[np.where(leaves, step, step + 1)],
                shares[np.where(leaves, step + 1, step)],
            )
            limits = self._limits(box, edge, known, unknown)
            end[box[leaves], edge[leaves], step[leaves]] = limits[leaves]
            begin[box[~leaves], edge[~leaves], step[~leaves]] = limits[~leaves]
        count = len(pixels)
        return begin.reshape(count, -1, 2), end.reshape(count, -1, 2)

    def _limits(
        self, box: Int64Array, edge: Int64Array, known: Float64Array, unknown: Float64Array
    ) -> Float64Array:
        """Pixels (L, 2) where edges leave the lens, between shares (L,) that it knows and others that it does not."""
        arcs = _Arcs(self.camera, self.start[box, edge], self.stop[box, edge], self.angles[box, edge, 0])
        for _ in range(_ROUNDS):
            middle = (known + unknown) / 2.0
            reached = np.isfinite(arcs.pixels(middle[:, None, None])[:, 0, 0, 0])
            known, unknown = np.where(reached, middle, known), np.where(reached, unknown, middle)
        return arcs.pixels(known[:, None, None])[:, 0, 0]


def _clipped(
    begin: Float64Array, end: Float64Array, size: Float64Array
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """The parts of segments (…, 2) within the picture: where they begin and end, and whether there are any.

    Source: Liang and Barsky 1984, "A New Concept and Method for Line Clipping".
    """
    way = end - begin
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = -begin / way, (size - begin) / way
    # a segment along a border is between that pair of borders for ever, or never
    within = (begin >= 0.0) & (begin <= size)
    still = way == 0.0
    enters = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(low, high))
    leaves = np.where(still, np.where(within, np.inf, -np.inf), np.maximum(low, high))
    # pairs of columns: reducing an axis of two is many times as slow
    enter = np.maximum(np.maximum(enters[..., 0], enters[..., 1]), 0.0)
    leave = np.minimum(np.minimum(leaves[..., 0], leaves[..., 1]), 1.0)
    there = (enter <= leave) & np.isfinite(way[..., 0]) & np.isfinite(way[..., 1])
    enter, leave = np.where(there, enter, 0.0)[..., None], np.where(there, leave, 0.0)[..., None]
    return begin + enter * way, begin + leave * way, there


def _bounds(begin: Float64Array, end: Float64Array, there: BoolArray) -> Float64Array:
    ends = np.concatenate([begin, end], axis=1)
    counts = np.concatenate([there, there], axis=1)[..., None]
    low, high = np.where(counts, ends, np.inf).min(axis=1), np.where(counts, ends, -np.inf).max(axis=1)
    return np.concatenate([low, high], axis=1)


def _bulges(pixels: Float64Array, inside: BoolArray) -> Float64Array:
    """How far curved edges reach between their samples, (B, 4): the vertices of parabolas through three of them."""
    extents = np.tile([np.inf, np.inf, -np.inf, -np.inf], (len(pixels), 1))
    before, middle, after = pixels[:, :, :-2], pixels[:, :, 1:-1], pixels[:, :, 2:]
    bend, slope = before - 2.0 * middle + after, (after - before) / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = middle - slope**2 / (2.0 * bend)
        near = (np.abs(slope) <= np.abs(bend)) & inside[:, :, 1:-1, None]
    low, high = near & (bend > 0.0), near & (bend < 0.0)
    extents[:, :2] = np.where(low, vertex, np.inf).min(axis=(1, 2))
    extents[:, 2:] = np.where(high, vertex, -np.inf).max(axis=(1, 2))
    return extents
