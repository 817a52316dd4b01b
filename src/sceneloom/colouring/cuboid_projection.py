"""Cuboids in images and lidar frames of a scene: 2D box, truncation and occlusion of each, and the points inside."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import (
    BoolArray,
    Float32Array,
    Float64Array,
    FloatArray,
    Int64Array,
    UInt32Array,
    check_array,
    hold_arrays,
    read_only,
)
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, project_unbounded, unproject
from sceneloom.colouring.rolling_shutter import ShutterDirection, pixels_by_lines, project_by_lines
from sceneloom.errors import OptionError, PoseError, check_choice
from sceneloom.geometry.boxes import EDGES, box_corners
from sceneloom.geometry.rigid import RigidTransform, conjugate_quaternion, multiply_quaternions, rotate_vectors
from sceneloom.kernels.boxes import find_points_in_boxes
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.poses import transform_by_path
from sceneloom.kernels.signatures import inlined
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    CuboidAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    Projection,
)
from sceneloom.scene.annotations_at import Boxes, BoxTable, cuboid_at
from sceneloom.scene.cameras import CameraSensor, Shutter
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.point_times import timed_frame
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.samples import ALL, WORLD, Choice, choose_ego, chosen_sensors, frame_of_points, locations_of
from sceneloom.scene.scene import Scene, check_camera_models, sweep_period_ns, usual_period_ns
from sceneloom.scene.types import Identifier, Progress, key_of
from sceneloom.warnings import skipped

CENTRE_TO_CORNER = 0.5
"""Source: "Pixels" in docs/CONVENTIONS.md: corner = centre + 0.5."""

_EDGES: Int64Array = read_only(EDGES, np.int64)


class _Steps(NamedTuple):
    """How finely edges are sampled."""

    limits: Float64Array  # (L,) float64 [rad], rising: of a box whose longest edge covers up to so much …
    counts: Int64Array  # (L,) int64, … each edge is divided into so many steps


FINE = _Steps(read_only([0.05, 0.2, np.inf], np.float64), read_only([4, 12, 64], np.int64))
"""Within 0.1 px for all but what is right before a camera with strong distortion."""

COARSE = _Steps(read_only([0.1, 0.2, 0.4, 0.8, 1.6, np.inf], np.float64), read_only([3, 5, 8, 14, 32, 64], np.int64))
"""Within 1 px, and three times as fast."""

_ROUNDS = 24  # how often the step in which an edge leaves the camera model is halved
_BORDER_STEPS = 33


@lru_cache(maxsize=256)
def widest_angle(camera: Camera) -> float:
    """The largest angle off the axis that the image shows [rad]; π where its border is beyond the camera model."""
    along = np.linspace(0.0, 1.0, _BORDER_STEPS)
    u = np.concatenate([along, along, np.zeros_like(along), np.ones_like(along)]) * camera.width - 0.5
    v = np.concatenate([np.zeros_like(along), np.ones_like(along), along, along]) * camera.height - 0.5
    rays = unproject(camera, np.column_stack([u, v]))
    if not np.isfinite(rays).all():
        return float(np.pi)
    return float(np.arccos(np.clip(rays[:, 2], -1.0, 1.0)).max())


@lru_cache(maxsize=256)
def _image_corner_rays(camera: Camera) -> tuple[Float64Array, Float64Array]:
    """The corners of the image (4, 2) [px], corner convention, and their rays (4, 3)."""
    corners = np.array([[0.0, 0.0], [camera.width, 0.0], [camera.width, camera.height], [0.0, camera.height]])
    return read_only(corners), read_only(unproject(camera, corners - CENTRE_TO_CORNER))


@dataclass(frozen=True, slots=True, eq=False)
class Rolling:
    """The motion while the lines of an image were taken.

    Attributes:
        trajectory: of the camera.
        drifts_world: (B, 8, 3) float64 [m], how far the corners of the boxes moved from the first line to the last.
    """

    trajectory: ShutterDirection
    drifts_world: Float64Array

    def __post_init__(self) -> None:
        check_array("rolling.drifts_world", self.drifts_world, (None, 8, 3), np.float64)


def box_extents(
    camera: Camera,
    corners_camera: Float64Array,
    *,
    steps: _Steps = FINE,
    drifts: Float64Array | None = None,
    shutter: ShutterDirection | None = None,
) -> tuple[Float64Array, Float64Array]:
    """Bound what an image shows of boxes.

    Args:
        camera: the camera model.
        corners_camera: (B, 8, 3) float64 [m], in the order of `geometry.boxes.CORNER_SIGNS`, in the frame of the camera
            at the image's time; none at the camera, no edge through it.
        steps: how finely edges are sampled.
        drifts: (B, 8, 3) float64 [m], how far the corners move in that frame from the first line to the last; needed
            with a shutter.
        shutter: poses of the camera, line by line; None where all lines were taken at once.

    Returns:
        extents: (B, 4) float64 [px], corner convention, left, top, right, bottom; infinities the wrong way round where
            nothing of a box is in the image.
        shares: (B,) float64, which share of its edges, in equal angles, is in the image; 1 where all of it is.

    Raises:
        CalibrationError: the camera model is unknown.
    """
    corners = np.ascontiguousarray(corners_camera)
    directions, starts = sample_edges(corners, _EDGES, steps.limits, steps.counts)
    width, height = float(camera.width), float(camera.height)
    edges = None
    if shutter is None or drifts is None:
        pixels = project_unbounded(camera, directions)
        pixels += CENTRE_TO_CORNER
    else:
        edges = _RolledEdges.of(corners, drifts, directions, starts, camera, shutter)
        pixels = edges.pixels(edges.shares)
    extents, shares, leaving = bound_edges(pixels, starts, len(_EDGES), width, height)
    if len(leaving):
        known, unknown = leaving[:, 1], leaving[:, 2]
        ends = (
            _limits(camera, directions[known], directions[unknown]) if edges is None else edges.limits(known, unknown)
        )
        extend_bounds(extents, leaving, pixels[known], ends, width, height)
    positions, rays = _image_corner_rays(camera)
    if shutter is None or drifts is None:
        extend_to_corners(extents, corners, positions, rays)
        return extents, shares
    # two corners of the image belong to the first line, two to the last
    at_end = positions[:, shutter.axis] > 0
    for chosen, line, share in ((~at_end, 0, -0.5), (at_end, -1, 0.5)):
        pose = shutter.lines_from_middle[line]
        there = (corners + share * drifts) @ pose[:, :3].T + pose[:, 3]
        some = np.flatnonzero(chosen)
        extend_to_corners(extents, np.ascontiguousarray(there), positions[some], rays[some])
    return extents, shares


def _limits(camera: Camera, known: Float64Array, unknown: Float64Array) -> Float64Array:
    """Pixels (L, 2), corner convention, where steps leave the camera model between directions within and beyond it."""
    middles, pixels = known.copy(), np.zeros((len(known), 2))
    for _ in range(_ROUNDS):
        halve_steps(known, unknown, middles, pixels)
        pixels = project_unbounded(camera, middles)
    halve_steps(known, unknown, middles, pixels)
    return project_unbounded(camera, known) + CENTRE_TO_CORNER


_PARALLEL = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class _RolledEdges:
    """Points on the edges of boxes as a rolling shutter sees them."""

    ends: Float64Array  # (P, 2, 3) [m], where each point's edge begins and ends
    drifts: Float64Array  # (P, 2, 3) [m], how far these move
    shares: Float64Array  # (P,) how far along its edge each point is
    camera: Camera
    shutter: ShutterDirection

    @classmethod
    def of(
        cls, corners: Float64Array, drifts: Float64Array, directions: Float64Array, starts: Int64Array, camera: Camera,
        shutter: ShutterDirection,
    ) -> "_RolledEdges":  # fmt: skip
        """Put the directions of `sample_edges` on their edges."""
        counts = np.diff(starts)
        boxes = np.repeat(np.arange(len(corners)), counts)
        samples = counts[boxes] // len(_EDGES)
        numbers = np.arange(len(directions)) - starts[boxes]
        joined = _EDGES[numbers // np.maximum(samples, 1)]
        ends, moves = corners[boxes[:, None], joined], drifts[boxes[:, None], joined]
        # where directions meet their edges; evenly spread where an edge points at the camera
        even = numbers % samples / np.maximum(samples - 1, 1)
        first, along = ends[:, 0], ends[:, 1] - ends[:, 0]
        normals = np.cross(first, ends[:, 1])
        above = (np.cross(first, directions) * normals).sum(axis=1)
        below = -(np.cross(along, directions) * normals).sum(axis=1)
        met = np.abs(below) > _PARALLEL * (first * first).sum(axis=1) * (along * along).sum(axis=1)
        shares = np.clip(np.where(met, above / np.where(met, below, 1.0), even), 0.0, 1.0)
        return cls(ends, moves, shares, camera, shutter)

    def pixels(self, shares: Float64Array) -> Float64Array:
        """Pixels (P, 2) [px], corner convention, of points so far along their edges."""
        first, second = 1.0 - shares[:, None], shares[:, None]
        points = first * self.ends[:, 0] + second * self.ends[:, 1]
        drifts = first * self.drifts[:, 0] + second * self.drifts[:, 1]
        return pixels_by_lines(points, drifts, self.camera, self.shutter) + CENTRE_TO_CORNER

    def limits(self, known: Int64Array, unknown: Int64Array) -> Float64Array:
        """Pixels (L, 2), corner convention, where steps leave the camera model between points within and beyond it."""
        steps = replace(self, ends=self.ends[known], drifts=self.drifts[known])
        within, beyond = self.shares[known].copy(), self.shares[unknown].copy()
        for _ in range(_ROUNDS):
            middle = 0.5 * (within + beyond)
            inside = np.isfinite(steps.pixels(middle)[:, 0])
            within, beyond = np.where(inside, middle, within), np.where(inside, beyond, middle)
        return steps.pixels(within)


_FLAT = 1e-12  # an edge that covers no more than this angle points at the camera [rad]


@inlined
def _unit(x, y, z):  # type: ignore[no-untyped-def]
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@inlined
def _arc(units, first, last):  # type: ignore[no-untyped-def]
    """Direction of an edge at a right angle to its beginning, and its angle [rad]."""
    ax, ay, az = units[first, 0], units[first, 1], units[first, 2]
    bx, by, bz = units[last, 0], units[last, 1], units[last, 2]
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    cosine, sine = ax * bx + ay * by + az * bz, np.sqrt(cx * cx + cy * cy + cz * cz)
    if sine > _FLAT:
        tx, ty, tz = (bx - cosine * ax) / sine, (by - cosine * ay) / sine, (bz - cosine * az) / sine
    else:
        tx, ty, tz = 0.0, 0.0, 0.0
    return tx, ty, tz, np.arctan2(sine, cosine)


@kernel(
    "Tuple((float64[:,::1], int64[::1]))(float64[:,:,::1], Array(int64, 2, 'C', readonly=True), "
    "Array(float64, 1, 'C', readonly=True), Array(int64, 1, 'C', readonly=True))"
)
def sample_edges(
    corners: Float64Array, edges: Int64Array, limits: Float64Array, steps: Int64Array
) -> tuple[Float64Array, Int64Array]:
    """Follow the edges of boxes in equal angles as seen from the origin.

    `corners` (B, 8, 3) [m], none at the origin, no edge through it; `edges` (E, 2), the corners that each edge joins;
    `limits` (L,) [rad], rising, and `steps` (L,): a box whose longest edge covers at most so much gets so many steps
    along each edge. Returns unit directions (P, 3), edge by edge of box by box, both ends included, and (B + 1,) int64,
    where those of each box begin.
    """
    boxes, count = len(corners), len(edges)
    starts = np.zeros(boxes + 1, np.int64)
    units, arcs = np.empty((boxes, 8, 3)), np.empty((boxes, count, 4))
    for b in range(boxes):
        for c in range(8):
            units[b, c, 0], units[b, c, 1], units[b, c, 2] = _unit(corners[b, c, 0], corners[b, c, 1], corners[b, c, 2])
        longest = 0.0
        for e in range(count):
            tx, ty, tz, angle = _arc(units[b], edges[e, 0], edges[e, 1])
            arcs[b, e, 0], arcs[b, e, 1], arcs[b, e, 2], arcs[b, e, 3] = tx, ty, tz, angle
            longest = max(longest, angle)
        k = 0
        while k < len(limits) - 1 and longest > limits[k]:
            k += 1
        starts[b + 1] = starts[b] + count * (steps[k] + 1)
    directions = np.empty((starts[boxes], 3))
    for b in range(boxes):
        samples = (starts[b + 1] - starts[b]) // count
        for e in range(count):
            first = edges[e, 0]
            ax, ay, az = units[b, first, 0], units[b, first, 1], units[b, first, 2]
            tx, ty, tz, angle = arcs[b, e, 0], arcs[b, e, 1], arcs[b, e, 2], arcs[b, e, 3]
            step_cosine, step_sine = np.cos(angle / (samples - 1)), np.sin(angle / (samples - 1))
            cosine, sine, row = 1.0, 0.0, starts[b] + e * samples
            for k in range(samples):
                directions[row + k, 0] = cosine * ax + sine * tx
                directions[row + k, 1] = cosine * ay + sine * ty
                directions[row + k, 2] = cosine * az + sine * tz
                cosine, sine = (cosine * step_cosine - sine * step_sine, sine * step_cosine + cosine * step_sine)
    return directions, starts


@inlined
def _extend(extents, b, u0, v0, u1, v1, width, height):  # type: ignore[no-untyped-def]
    """Let bounds hold the part of a segment that lies in the image (Liang and Barsky 1984)."""
    du, dv, enter, leave = u1 - u0, v1 - v0, 0.0, 1.0
    # a segment along a border is between that pair of borders for ever, or never
    if du == 0.0:
        if u0 < 0.0 or u0 > width:
            return
    else:
        low, high = -u0 / du, (width - u0) / du
        enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
    if dv == 0.0:
        if v0 < 0.0 or v0 > height:
            return
    else:
        low, high = -v0 / dv, (height - v0) / dv
        enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
    if enter <= leave:
        for share in (enter, leave):
            u, v = u0 + share * du, v0 + share * dv
            extents[b, 0], extents[b, 1] = min(extents[b, 0], u), min(extents[b, 1], v)
            extents[b, 2], extents[b, 3] = max(extents[b, 2], u), max(extents[b, 3], v)


@inlined
def _bulge(before, middle, after):  # type: ignore[no-untyped-def]
    """The vertex of a parabola through three positions; the middle one where there is none near it."""
    bend, slope = before - 2.0 * middle + after, (after - before) / 2.0
    if bend != 0.0 and abs(slope) <= abs(bend):
        return middle - slope * slope / (2.0 * bend)
    return middle


@kernel("Tuple((float64[:,::1], float64[::1], int64[:,::1]))(float64[:,::1], int64[::1], int64, float64, float64)")
def bound_edges(
    pixels: Float64Array, starts: Int64Array, count: int, width: float, height: float
) -> tuple[Float64Array, Float64Array, Int64Array]:
    """Bound the edges of boxes within the image.

    Args:
        pixels: (P, 2) [px], corner convention, of `sample_edges`; NaN beyond the camera model.
        starts: (B + 1,), where those of each box begin.
        count: edges of each box.
        width, height: of the image [px].

    Returns:
        extents: (B, 4) float64 [px], left, top, right, bottom; infinities the wrong way round where no edge is in the
            image.
        shares: (B,) float64, which share of the directions the image shows.
        leaving: (L, 3) int64, steps in which an edge leaves the camera model: the box, the row within and the row
            beyond.
    """
    boxes, lost = len(starts) - 1, 0
    extents, shares = np.empty((boxes, 4)), np.empty(boxes)
    leaving = np.empty((len(pixels), 3), np.int64)
    for b in range(boxes):
        extents[b, 0] = extents[b, 1] = np.inf
        extents[b, 2] = extents[b, 3] = -np.inf
        samples, inside = (starts[b + 1] - starts[b]) // count, 0
        for e in range(count):
            first = starts[b] + e * samples
            for k in range(first, first + samples):
                u, v = pixels[k, 0], pixels[k, 1]
                within = 0.0 <= u <= width and 0.0 <= v <= height
                inside += within
                if within and first < k < first + samples - 1:
                    # how far curved edges reach between their samples
                    rotation_u = _bulge(pixels[k - 1, 0], u, pixels[k + 1, 0])
                    rotation_v = _bulge(pixels[k - 1, 1], v, pixels[k + 1, 1])
                    extents[b, 0], extents[b, 2] = (min(extents[b, 0], rotation_u), max(extents[b, 2], rotation_u))
                    extents[b, 1], extents[b, 3] = (min(extents[b, 1], rotation_v), max(extents[b, 3], rotation_v))
                if k == first:
                    continue
                here, before = np.isfinite(u), np.isfinite(pixels[k - 1, 0])
                if here and before:
                    _extend(extents, b, pixels[k - 1, 0], pixels[k - 1, 1], u, v, width, height)
                elif here or before:
                    leaving[lost, 0] = b
                    leaving[lost, 1], leaving[lost, 2] = (k, k - 1) if here else (k - 1, k)
                    lost += 1
        shares[b] = inside / max(starts[b + 1] - starts[b], 1)
        extents[b, 0], extents[b, 1] = max(extents[b, 0], 0.0), max(extents[b, 1], 0.0)
        extents[b, 2], extents[b, 3] = min(extents[b, 2], width), min(extents[b, 3], height)
    return extents, shares, leaving[:lost].copy()


@kernel("void(float64[:,::1], int64[:,::1], float64[:,::1], float64[:,::1], float64, float64)")
def extend_bounds(
    extents: Float64Array, leaving: Int64Array, begin: Float64Array, end: Float64Array, width: float, height: float
) -> None:
    """Let bounds hold the last parts of edges that leave the camera model.

    `extents` (B, 4) [px], changed; `leaving` (L, 3) of `bound_edges`; `begin`, `end` (L, 2) [px], corner convention,
    where those parts begin and end; `width`, `height`: of the image [px].
    """
    for k in range(len(leaving)):
        _extend(extents, leaving[k, 0], begin[k, 0], begin[k, 1], end[k, 0], end[k, 1], width, height)


@kernel("void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1])")
def halve_steps(known: Float64Array, unknown: Float64Array, middles: Float64Array, pixels: Float64Array) -> None:
    """Take the half of each step in which it leaves the camera model, and give the middle of that.

    `known`, `unknown` (L, 3), changed: directions within the camera model and beyond it; `middles` (L, 3), unit,
    between them; changed; `pixels` (L, 2), where those are in the image; NaN beyond the camera model.
    """
    for k in range(len(known)):
        if np.isfinite(pixels[k, 0]):
            known[k] = middles[k]
        else:
            unknown[k] = middles[k]
        x, y, z = _unit(known[k, 0] + unknown[k, 0], known[k, 1] + unknown[k, 1], known[k, 2] + unknown[k, 2])
        middles[k, 0], middles[k, 1], middles[k, 2] = x, y, z


@kernel(
    "void(float64[:,::1], float64[:,:,::1], Array(float64, 2, 'C', readonly=True), "
    "Array(float64, 2, 'C', readonly=True))"
)
def extend_to_corners(
    extents: Float64Array, corners: Float64Array, locations: Float64Array, rays: Float64Array
) -> None:
    """Let bounds hold those corners of the image that look at a box.

    `extents` (B, 4) [px], changed; `corners` (B, 8, 3) [m], in the order of `geometry.boxes.CORNER_SIGNS`; `locations`
    (C, 2) [px], corner convention; `rays` (C, 3), along which they look; NaN for none.

    Source: Kay and Kajiya 1986, "Ray Tracing Complex Scenes": a ray is in a box while it is between all pairs of faces.
    """
    for b in range(len(extents)):
        for c in range(len(rays)):
            enter, leave = -np.inf, np.inf
            for axis in range(3):
                last = 1 if axis == 0 else (3 if axis == 1 else 4)
                along, middle, square = 0.0, 0.0, 0.0
                for k in range(3):
                    half = (corners[b, 0, k] - corners[b, last, k]) / 2.0
                    along += half * rays[c, k]
                    middle += half * (corners[b, 0, k] + corners[b, 6, k]) / 2.0
                    square += half * half
                first, second = (middle - square) / along, (middle + square) / along
                enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
            if enter <= leave and enter > 0.0 and np.isfinite(rays[c, 0]):
                extents[b, 0], extents[b, 2] = (
                    min(extents[b, 0], locations[c, 0]),
                    max(extents[b, 2], locations[c, 0]),
                )
                extents[b, 1], extents[b, 3] = (
                    min(extents[b, 1], locations[c, 1]),
                    max(extents[b, 3], locations[c, 1]),
                )


_LATEST_PERIODS = 2  # a sweep that began more than so many periods before an image is no evidence of it


@dataclass(slots=True)
class _SweptPoints:
    """The points of a lidar around a time; the last sweep is kept, since images follow each other."""

    lidar: LidarSensor  # the lidar
    source: PoseSource  # transforms its points as stored into the world
    _kept: tuple[int, FloatArray | None] = field(default=(-1, None))

    def at(self, time_ns: int) -> FloatArray | None:
        """The points (N, 3) [m] of the sweep that is under way at a time [ns]; None where there is none."""
        timestamps = self.lidar.frames.timestamps_ns
        index = int(np.searchsorted(timestamps, time_ns, side="right")) - 1
        period_ns = sweep_period_ns(self.lidar)
        if index < 0 or time_ns - int(timestamps[index]) > _LATEST_PERIODS * period_ns:
            return None
        if self._kept[0] != index:
            frame = timed_frame(self.lidar.frames[index], period_ns).frame
            self._kept = index, _points_in_world(self.source, frame.points.positions, frame.point_times_ns)
        return self._kept[1]


_NEAR = 0.05  # a box nearer to the camera than this contains the camera: it is not seen, and hides nothing [m]
_FARTHEST = 1e8  # boxes farther away, or larger, are not seen [m]

_ON_BOX = 0.2
"""A point so near to a box is on it [m]: boxes are drawn tightly, and objects move between sweep and image."""

_RAYS = ((8.0, 6), (32.0, 12), (np.inf, 24))
"""Rays along each side of a box in the image, by its length up to so many pixels, for the share that others hide."""

_CELLS = 24  # cells along each side of a face, for the share of a box that the image cuts off
_BOXES_AT_ONCE = 256  # boxes whose cells are processed together: enough to be fast, few enough for little memory
_AT_ONCE = np.zeros((0, 4))  # `lines` of images whose lines were taken at once


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The boxes that an image shows.

    Attributes:
        rows: (S,) int64, rising, which of the boxes they are.
        boxes_xyxy: (S, 4) float64 [px], left, top, right, bottom of what is in the image, corner convention.
        truncations: (S,) float64, which share of the box, of what the camera would see of it with an infinite image,
            is outside the image: a share of the solid angle, so that it means the same with every camera model.
        occlusions: (S,) float64, which share of its area in the image nearer boxes hide.
        evidences: (S, 2) int64, points of a lidar before it, as the camera sees it, and on it; 0 without one.
    """

    rows: Int64Array
    boxes_xyxy: Float64Array
    truncations: Float64Array
    occlusions: Float64Array
    evidences: Int64Array

    def __post_init__(self) -> None:
        shares = dict.fromkeys(("truncations", "occlusions"), (np.float64, "N"))
        boxes = {"rows": (np.int64, "N"), "boxes_xyxy": (np.float64, "N", 4)}
        hold_arrays(self, "", {**boxes, **shares, "evidences": (np.int64, "N", 2)})


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def observe_cuboids(
    camera: Camera,
    world_from_camera: RigidTransform,
    boxes: Boxes,
    *,
    hides: BoolArray | None = None,
    min_pixels: float = 1.0,
    points_world: FloatArray | None = None,
    rolling: Rolling | None = None,
) -> Observations:
    """Project boxes into a camera's image.

    Boxes with numbers that are not finite, without volume, or around the camera are not seen and hide nothing.

    Args:
        camera: the camera model; any model.
        world_from_camera: its pose.
        boxes: in the world.
        hides: (B,) bool, which of the boxes hide what is behind them; None for all.
        points_world: (N, 3) [m], points of a lidar at about that time, as evidence of what hides the boxes; or None.
        min_pixels: what is narrower or lower than this in the image is not seen, but hides [px].
        rolling: motion of camera and boxes while the lines were taken, `world_from_camera` and `boxes` being of the
            image's time; None where all lines were taken at once.

    Raises:
        CalibrationError: the camera model is unknown.
    """
    rows, near = _in_view(camera, world_from_camera, boxes, rolling)
    corners = box_corners(near.centers, near.sizes, near.quaternions)
    shutter = None if rolling is None else rolling.trajectory
    drifts = None if rolling is None else rolling.drifts_world[rows] @ world_from_camera.rotation
    extents, shares = box_extents(camera, corners, drifts=drifts, shutter=shutter)
    whole = shares == 1.0
    there = np.flatnonzero((extents[:, 2:] > extents[:, :2]).all(axis=1))
    rows, near, extents, whole = rows[there], near.some(there), extents[there], whole[there]
    solid = np.ones(len(rows), np.bool_) if hides is None else hides[rows]
    occlusions = _occlusions(camera, near, extents, solid, shutter)
    truncations = np.zeros(len(rows))
    truncations[~whole] = _truncations(camera, near.some(np.flatnonzero(~whole)), shutter)
    seen = np.flatnonzero((extents[:, 2:] - extents[:, :2] >= min_pixels).all(axis=1))
    evidences = np.zeros((len(rows), 2), np.int64)
    if points_world is not None:
        finite = points_world[np.isfinite(points_world).all(axis=1)].astype(np.float64)
        points, pixels, lines = _seen_points(camera, world_from_camera, finite, shutter)
        count_evidence(points, pixels, extents, *near.arrays, lines, near.drifts, _ON_BOX, evidences)
    return Observations(rows[seen], extents[seen], truncations[seen], occlusions[seen], evidences[seen])


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """Boxes in the camera's frame."""

    centers: Float64Array  # (B, 3) [m]
    sizes: Float64Array  # (B, 3) [m]
    quaternions: Float64Array  # (B, 4)
    axes: Float64Array  # (B, 3, 3)
    drifts: Float64Array  # (B, 3) [m], how far they move while the image is taken

    def some(self, rows: Int64Array) -> "_Near":
        return _Near(self.centers[rows], self.sizes[rows], self.quaternions[rows], self.axes[rows], self.drifts[rows])

    @property
    def arrays(self) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Centres, axes and half sizes, as the kernels take them."""
        return tuple(map(np.ascontiguousarray, (self.centers, self.axes, self.sizes / 2.0)))  # type: ignore[return-value]

    @property
    def cameras_box(self) -> Float64Array:
        """Position of the camera in the frame of each box, (B, 3) [m]."""
        return np.asarray(-np.einsum("bij,bi->bj", self.axes, self.centers), np.float64)


def _in_view(
    camera: Camera, world_from_camera: RigidTransform, boxes: Boxes, rolling: Rolling | None
) -> tuple[Int64Array, _Near]:
    """The boxes that may be in the image, in the camera's frame, and their rows."""
    placed = (np.abs(boxes.centers_world) < _FARTHEST).all(axis=1) & np.isfinite(boxes.quaternions_xyzw).all(axis=1)
    sized = ((boxes.sizes_lwh > 0) & (boxes.sizes_lwh < _FARTHEST)).all(axis=1)
    rows = np.flatnonzero(placed & sized)
    centers, sizes = world_from_camera.inverse().apply(boxes.centers_world[rows]), boxes.sizes_lwh[rows]
    distances, reaches = np.linalg.norm(centers, axis=1), np.linalg.norm(sizes, axis=1) / 2.0
    drifts, widest = np.zeros_like(centers), widest_angle(camera)
    if rolling is not None:
        moves, shutter = rolling.drifts_world[rows], rolling.trajectory
        drifts = moves.mean(axis=1) @ world_from_camera.rotation
        reaches = reaches + shutter.shift + np.linalg.norm(moves, axis=2).max(axis=1)
        widest += shutter.rotation
    off_axis = np.arccos(np.clip(centers[:, 2] / np.maximum(distances, _NEAR), -1.0, 1.0))
    spreads = np.arcsin(np.clip(reaches / np.maximum(distances, _NEAR), 0.0, 1.0))
    kept = np.flatnonzero((reaches >= distances) | (off_axis - spreads <= widest))
    rows = rows[kept]
    camera_from_world = conjugate_quaternion(world_from_camera.quaternion_xyzw)
    rotations = multiply_quaternions(camera_from_world, boxes.quaternions_xyzw[rows])
    axes = world_from_camera.rotation.T @ boxes.rotations_world[rows]
    near = _Near(centers[kept], sizes[kept], rotations, axes, drifts[kept])
    away = np.maximum(np.abs(near.cameras_box) - near.sizes / 2.0, 0.0)
    outside = np.flatnonzero(np.linalg.norm(away, axis=1) > _NEAR)
    return rows[outside], near.some(outside)


def _occlusions(
    camera: Camera, near: _Near, extents: Float64Array, solid: BoolArray, shutter: ShutterDirection | None
) -> Float64Array:
    """Which share of each box in the image others hide: rays through a grid over its extent in the image."""
    count = len(extents)
    if count == 0:
        return np.zeros(0)
    pixels, starts = _grids(extents)
    rays, lines = unproject(camera, pixels), _AT_ONCE
    if shutter is not None:
        rotations, lines = _eyes(camera, pixels, shutter)
        rays = np.einsum("nij,nj->ni", rotations, rays)
    rivals, rival_starts = _rivals(near, extents, solid)
    met, hidden = np.zeros(count, np.int64), np.zeros(count, np.int64)
    count_observations(rays, starts, *near.arrays, lines, near.drifts, rival_starts, rivals, met, hidden)
    return np.asarray(hidden / np.maximum(met, 1), np.float64)


def _eyes(camera: Camera, pixels: Float64Array, shutter: ShutterDirection) -> tuple[Float64Array, Float64Array]:
    """Rotations (R, 3, 3) at the lines of pixels, and `lines` (R, 4) of `count_observations`, camera frame."""
    lines = pixels[:, shutter.axis]
    poses = shutter.poses_at(lines, camera)
    rotations = np.ascontiguousarray(poses[:, :, :3].transpose(0, 2, 1))
    positions = -np.einsum("nij,nj->ni", rotations, poses[:, :, 3])
    shares = np.clip((lines + 0.5) / shutter.line_count(camera) - 0.5, -0.5, 0.5)
    return rotations, np.column_stack([positions, shares])


def _grids(extents: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Pixels of a grid over each box's extent in the image, (R, 2), and where those of each begin, (B + 1,)."""
    spans = extents[:, 2:] - extents[:, :2]
    sides = np.array([side for _, side in _RAYS])[np.searchsorted([px for px, _ in _RAYS], spans.max(axis=1))]
    starts = np.concatenate([[0], np.cumsum(sides**2)])
    grids = np.empty((int(starts[-1]), 2))
    for side in np.unique(sides).tolist():
        rows = np.flatnonzero(sides == side)
        v, u = (grid.ravel() for grid in np.mgrid[0:side, 0:side])
        shares = (np.column_stack([u, v]) + 0.5) / side
        pixels = extents[rows, None, :2] + shares * spans[rows, None] - CENTRE_TO_CORNER
        grids[(starts[rows, None] + np.arange(side * side)).ravel()] = pixels.reshape(-1, 2)
    return grids, starts


def _seen_points(
    camera: Camera, world_from_camera: RigidTransform, points_world: Float64Array, shutter: ShutterDirection | None
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """`points`, `pixels` and `lines` of `count_evidence`."""
    points = world_from_camera.inverse().apply(points_world)
    if shutter is None:
        pixels, visible = project(camera, points)
        return np.ascontiguousarray(points[visible]), pixels[visible] + CENTRE_TO_CORNER, _AT_ONCE
    rolled = project_by_lines(points_world, camera, world_from_camera, shutter)
    pixels = rolled.pixels.astype(np.float64)
    lines = _eyes(camera, pixels, shutter)[1]
    return np.ascontiguousarray(points[rolled.point_ids] - lines[:, :3]), pixels + CENTRE_TO_CORNER, lines


def _rivals(near: _Near, extents: Float64Array, solid: BoolArray) -> tuple[Int64Array, Int64Array]:
    """For each box the solid others that overlap it in the image and begin before it ends, one box after another."""
    distances, reaches = np.linalg.norm(near.centers, axis=1), np.linalg.norm(near.sizes, axis=1) / 2.0
    # only solid boxes, as columns, from the one that begins nearest: each box then tests only those before it
    solids = np.flatnonzero(solid)
    solids = solids[np.argsort((distances - reaches)[solids], kind="stable")]
    begins = (distances - reaches)[solids]
    lefts, tops, rights, bottoms = np.ascontiguousarray(extents[solids].T)
    counts = np.searchsorted(begins, distances + reaches, side="left")
    found = []
    for b, (count, (left, top, right, bottom)) in enumerate(zip(counts.tolist(), extents.tolist(), strict=True)):
        overlap = (lefts[:count] < right) & (rights[:count] > left)
        overlap &= (tops[:count] < bottom) & (bottoms[:count] > top)
        rivals = solids[:count][overlap]
        found.append(rivals[rivals != b])
    starts = np.concatenate([[0], np.cumsum([len(rows) for rows in found])]).astype(np.int64)
    return np.concatenate(found), starts


def _truncations(camera: Camera, near: _Near, shutter: ShutterDirection | None) -> Float64Array:
    """Which share of the solid angle of each box is outside the image: of the faces towards the camera."""
    all_of, inside_of = np.zeros(len(near.centers)), np.zeros(len(near.centers))
    sides = near.cameras_box / (near.sizes / 2.0)
    for axis in range(3):
        facing = np.flatnonzero(np.abs(sides[:, axis]) > 1.0)
        for begin in range(0, len(facing), _BOXES_AT_ONCE):
            rows = facing[begin : begin + _BOXES_AT_ONCE]
            some = near.some(rows)
            corners = _face_grids(some, axis, np.sign(sides[rows, axis]))
            angles = _solid_angles(corners)
            middles = (corners[:, :-1, :-1] + corners[:, 1:, 1:]).reshape(-1, 3) / 2.0
            if shutter is None:
                inside = project(camera, middles)[1]
            else:
                drifts = np.repeat(some.drifts, len(middles) // len(rows), axis=0)
                pixels = pixels_by_lines(middles, drifts, camera, shutter) + CENTRE_TO_CORNER
                inside = np.all((pixels >= 0.0) & (pixels <= (camera.width, camera.height)), axis=1)
            all_of[rows] += angles.sum(axis=1)
            inside_of[rows] += np.where(inside.reshape(angles.shape), angles, 0.0).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.clip(1.0 - inside_of / all_of, 0.0, 1.0)


def _face_grids(near: _Near, axis: int, sides: Float64Array) -> Float64Array:
    """Corners of the cells of one face of each box, (B, C + 1, C + 1, 3) [m], in the camera's frame."""
    steps = np.linspace(-0.5, 0.5, _CELLS + 1)
    spans = near.axes * near.sizes[:, None]
    middles = near.centers + spans[:, :, axis] * (sides / 2.0)[:, None]
    along = steps[:, None, None] * spans[:, None, None, :, (axis + 1) % 3]
    across = steps[:, None] * spans[:, None, None, :, (axis + 2) % 3]
    return np.asarray(middles[:, None, None] + along + across, np.float64)


def _solid_angles(corners: Float64Array) -> Float64Array:
    """Solid angles of the cells of faces, as seen from the origin, (B, C * C) [sr]."""
    # Source: Van Oosterom and Strackee 1983, "The Solid Angle of a Plane Triangle", of two triangles per cell
    a, b, c, d = corners[:, :-1, :-1], corners[:, 1:, :-1], corners[:, 1:, 1:], corners[:, :-1, 1:]
    return (_solid_angle(a, b, c) + _solid_angle(a, c, d)).reshape(len(corners), -1)


def _solid_angle(a: Float64Array, b: Float64Array, c: Float64Array) -> Float64Array:
    la, lb, lc = (np.linalg.norm(vertex, axis=-1) for vertex in (a, b, c))
    volume = np.abs((a * np.cross(b, c)).sum(axis=-1))
    spread = la * lb * lc + (a * b).sum(axis=-1) * lc + (b * c).sum(axis=-1) * la + (c * a).sum(axis=-1) * lb
    angle: Float64Array = 2.0 * np.arctan2(volume, spread)
    return angle


_SHARES = ("truncation", "occlusion", "occlusion_by_points")  # names of the attributes that hold the shares
_LEAST_POINTS = 5  # points before and on a cuboid that a share needs
_STATIONARY = 1e-9  # what moves less far than this while an image is taken is stationary [m]
_DECIMALS = 3  # of shares and pixels that are written: far below their accuracy


class _Observation(NamedTuple):
    """One cuboid in one image; its shares in the order of `_SHARES`."""

    image: int
    box_xyxy: tuple[float, ...]
    shares: tuple[float | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """The observations of one camera by row of the table, its images' times (F,) [ns], and those without a pose."""

    camera_id: Identifier
    timestamps_ns: Int64Array
    observations: dict[int, list[_Observation]]
    unplaced: int

    def add(self, image: int, found: Observations, rows: Int64Array) -> None:
        """Add the observations of an image, `rows` being those of its boxes."""
        for k, row in enumerate(rows[found.rows].tolist()):
            before, on = found.evidences[k].tolist()
            by_points = before / (before + on) if before + on >= _LEAST_POINTS else None
            shares = (float(found.truncations[k]), float(found.occlusions[k]), by_points)
            rounded = tuple(None if share is None else round(share, _DECIMALS) for share in shares)
            observation = _Observation(image, tuple(found.boxes_xyxy[k].tolist()), rounded)
            self.observations.setdefault(row, []).append(observation)

    def attributes(self, row: int) -> Iterator[AttributePath]:
        """The shares of a cuboid over time."""
        for k, name in enumerate(_SHARES):
            known = [found for found in self.observations[row] if found.shares[k] is not None]
            if known:
                times = self.timestamps_ns[[found.image for found in known]]
                yield AttributePath(name, tuple(found.shares[k] for found in known), times, sensor_id=self.camera_id)


def project_cuboids(
    scene: Scene,
    *,
    cameras: Choice = ALL,
    trajectory: str | EgoMotion | None = None,
    min_pixels: float = 1.0,
    see_through: Iterable[str] = (),
    lidar: Identifier | None = None,
    activations: bool = False,
    progress: Progress | None = None,
) -> Scene:
    """Project all cuboids into the images of a scene, and fill their `projections`.

    A cuboid gets a projection for each camera that ever sees it: one row per image while it is there, NaN where that
    image does not show it. Attributes `truncation` and `occlusion` of the camera give the share of it that is outside
    the image and the share of the rest that nearer cuboids hide, 0 to 1, at the images that show it. Existing values of
    these cameras are replaced, but for boxes that a person confirmed.

    Args:
        scene: with cuboids in its world. Images are not decoded.
        cameras: whose images: "all", an id, or several. With "all", cameras without poses are skipped.
        trajectory: name of the ego trajectory, as for `Scene.samples`.
        min_pixels: what is narrower or lower than this in an image is not seen in it [px].
        see_through: labels of what fills little of its box and shall hide nothing, such as trees.
        lidar: id of a lidar whose points are used, too: an attribute `occlusion_by_points` gives the share of its
            points before and on a cuboid, as the camera sees it, that are before it. They also show walls and trees
            without boxes.
        activations: compute anew when each camera sees a cuboid, by the paths; else only what is active for a camera
            is seen by it, by its own computed cuboids.
        progress: called after each image with how many are done, and of how many.

    Raises:
        OptionError: there is no such camera, lidar or trajectory, or no camera at all.
        CalibrationError: the formula of a camera model is unconfirmed, and using it was not asked for.
        PoseError: the pose of a chosen camera, or of all cameras, is unknown.
        DataError: an image cannot be read.
    """
    scene = scene.corrected()
    chosen = chosen_sensors(scene, "camera", scene.cameras, cameras)
    if not scene.cameras:
        raise OptionError(f"{scene.source}: has no camera that could see the cuboids")
    check_camera_models(scene, chosen)
    ego = choose_ego(scene, trajectory)
    locations = locations_of(scene, chosen, ego)
    swept = None
    if lidar is not None:
        (asked,) = chosen_sensors(scene, "lidar", scene.lidars, [lidar])
        swept = _SweptPoints(asked, _points_position(scene, asked, ego))
    placed = [(camera, source) for camera in chosen if (source := locations[camera.id].source) is not None]
    lost = [camera for camera in chosen if locations[camera.id].source is None]
    if lost and (not placed or cameras != ALL):
        raise PoseError(locations[lost[0].id].problem)
    table, views, done = BoxTable(scene), [], 0
    look = _Look(table, frozenset(see_through), min_pixels, swept, anew=activations)
    total = sum(len(camera.images) for camera, _ in placed)
    for camera, source in placed:
        times = camera.images.timestamps_ns
        unplaced = int((~np.isfinite(source.at(times).positions).all(axis=1)).sum())
        view = _View(camera.id, times, {}, unplaced)
        for k in range(len(times)):
            look.through(camera, source, k, view)
            done += 1
            if progress is not None:
                progress(done, total)
        views.append(view)
    unknown = "sees nothing: its pose is unknown"
    warnings = [skipped("camera-unplaced", "sensors", f"camera {camera.id!r} {unknown}") for camera in lost]
    for view in views:
        if view.unplaced:
            message = f"images of camera {view.camera_id!r} see nothing: they are beyond the ends of its trajectory"
            warnings.append(skipped("images-unplaced", "sensors", message, count=view.unplaced))
    rows = {key_of(annotation.id): row for row, annotation in enumerate(table.annotations)}
    writer = _Writer(views, rows, table, activations)
    annotations = tuple(writer.written(annotation) for annotation in scene.annotations)
    return replace(scene, annotations=annotations, warnings=(*scene.warnings, *warnings))


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """Looks at images; arguments of `project_cuboids`."""

    table: BoxTable
    see_through: Collection[str | None]
    min_pixels: float
    swept: _SweptPoints | None
    anew: bool

    def through(self, camera: CameraSensor, source: PoseSource, k: int, view: _View) -> None:
        """Add the observations of image `k`, if its pose is known, to a view."""
        image, time_ns = camera.images[k], int(camera.images.timestamps_ns[k])
        location = source.mounted(image.mount)
        world_from_camera = location.pose_at(time_ns)
        # the sensor by whose activations cuboids are there
        sensor_id = None if self.anew else camera.id
        rows, boxes = self.table.find(time_ns, sensor_id=sensor_id)
        if world_from_camera is None:
            return
        observations = observe_cuboids(
            image.camera,
            world_from_camera,
            boxes,
            hides=np.array([label not in self.see_through for label in boxes.labels], np.bool_),
            min_pixels=self.min_pixels,
            points_world=None if self.swept is None else self.swept.at(time_ns),
            rolling=self._rolling(Shutter.of(camera), time_ns, location, rows, sensor_id),
        )
        view.add(k, observations, rows)

    def _rolling(
        self, shutter: Shutter, time_ns: int, location: PoseSource, rows: Int64Array, sensor_id: Identifier | None
    ) -> Rolling | None:
        """The motion while an image was taken; None where there is none, or all lines were taken at once."""
        if shutter.seconds == 0.0 or len(rows) == 0:
            return None
        ends_ns = shutter.knots_ns(time_ns, 2).tolist()
        first, last = (self.table.placed(rows, end_ns, sensor_id=sensor_id) for end_ns in ends_ns)
        drifts = last.corners_world - first.corners_world
        trajectory = ShutterDirection.of(shutter, time_ns, location)
        if trajectory is None and not (np.abs(drifts) > _STATIONARY).any():
            return None
        return Rolling(trajectory or ShutterDirection.at_rest(shutter), drifts)


@dataclass(frozen=True, slots=True, eq=False)
class _Writer:
    """Writes the observations of the cameras into annotations; `rows` gives the row of a cuboid in the table."""

    views: Sequence[_View]
    rows: dict[tuple[type, Identifier], int]
    table: BoxTable
    activations: bool

    def written(self, annotation: Annotation) -> Annotation:
        row = self.rows.get(key_of(annotation.id))
        if not isinstance(annotation, CuboidAnnotation) or row is None:
            return annotation
        ids = [view.camera_id for view in self.views]
        keys = {key_of(camera_id) for camera_id in ids}
        projections = [each for each in annotation.projections if key_of(each.sensor_id) not in keys]
        activations: list[Activation | None] = [
            each for each in annotation.activations if key_of(each.sensor_id) not in keys
        ]
        attributes: list[AttributePath] = []
        for view in self.views:
            if row not in view.observations:
                continue
            sensor_id = None if self.activations else view.camera_id
            cuboids, there = cuboid_at(annotation, view.timestamps_ns, angles=self.table.angles, sensor_id=sensor_id)
            projections.append(_projection(annotation, row, view, cuboids, there))
            attributes += view.attributes(row)
            if self.activations:
                seen = np.zeros(len(view.timestamps_ns), np.bool_)
                seen[[found.image for found in view.observations[row]]] = True
                activations.append(activation_of(view.camera_id, view.timestamps_ns, seen, cuboids))
        written = _with_attributes(annotation, attributes, names=_SHARES, sensor_ids=ids)
        if self.activations:
            written = replace(written, activations=tuple(each for each in activations if each is not None))
        return replace(written, projections=tuple(projections))


def _projection(
    annotation: CuboidAnnotation, row: int, view: _View, cuboids: Float64Array, there: BoolArray
) -> Projection:
    """The boxes of a cuboid in the images of a camera; those that a person confirmed are kept."""
    boxes, confirmed = np.full((len(there), 4), np.nan), np.zeros(len(there), np.bool_)
    for found in view.observations[row]:
        left, top, right, bottom = found.box_xyxy
        boxes[found.image] = left, top, right - left, bottom - top
    boxes = np.round(boxes, _DECIMALS)
    for older in annotation.projections:
        if key_of(older.sensor_id) != key_of(view.camera_id) or older.boxes is None or older.confirmed is None:
            continue
        for time_ns, box, is_confirmed in zip(older.timestamps_ns.tolist(), older.boxes, older.confirmed, strict=True):
            if is_confirmed:
                images = view.timestamps_ns == time_ns
                boxes[images], confirmed[images] = box, True
    kept = there | confirmed
    flags = tuple(confirmed[kept].tolist()) if confirmed.any() else None
    return Projection(view.camera_id, view.timestamps_ns[kept], boxes[kept], flags, cuboids[kept])


_BEHIND = 1e-9  # of two boxes that begin at the same distance, up to this share of it, neither hides the other


@inlined
def _centre(k, b, centers, lines, drifts):  # type: ignore[no-untyped-def]
    """Position of a box relative to the origin of ray k, when the line of the ray was taken."""
    x, y, z = centers[b, 0], centers[b, 1], centers[b, 2]
    if len(lines):
        x += lines[k, 3] * drifts[b, 0] - lines[k, 0]
        y += lines[k, 3] * drifts[b, 1] - lines[k, 1]
        z += lines[k, 3] * drifts[b, 2] - lines[k, 2]
    return x, y, z


@inlined
def _crossing(x, y, z, centre, b, rotations, halves):  # type: ignore[no-untyped-def]
    """Where a ray from the origin enters and leaves a box, in lengths of the ray; the first is larger if it misses."""
    near, far = -np.inf, np.inf
    for axis in range(3):
        along = rotations[b, 0, axis] * x + rotations[b, 1, axis] * y + rotations[b, 2, axis] * z
        middle = (
            rotations[b, 0, axis] * centre[0] + rotations[b, 1, axis] * centre[1] + rotations[b, 2, axis] * centre[2]
        )
        if along == 0.0:
            if abs(middle) > halves[b, axis]:
                return 1.0, 0.0
            continue
        first, last = (middle - halves[b, axis]) / along, (middle + halves[b, axis]) / along
        near, far = max(near, min(first, last)), min(far, max(first, last))
    return near, far


@inlined
def _entry(x, y, z, centre, b, rotations, halves):  # type: ignore[no-untyped-def]
    """Where a ray from the origin enters a box, in lengths of the ray; infinity where it misses it or starts in it."""
    near, far = _crossing(x, y, z, centre, b, rotations, halves)
    if near <= far and near > 0.0:
        return near
    return np.inf


@kernel(
    "void(float64[:,::1], int64[::1], float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], "
    "float64[:,::1], int64[::1], int64[::1], int64[::1], int64[::1])"
)
def count_observations(
    rays: Float64Array, ray_starts: Int64Array, centers: Float64Array, rotations: Float64Array, halves: Float64Array,
    lines: Float64Array, drifts: Float64Array, rival_starts: Int64Array, rivals: Int64Array, met: Int64Array,
    hidden: Int64Array,
) -> None:  # fmt: skip
    """Count the rays that meet each box, and those of them that meet another one before.

    Args:
        rays: (R, 3) from the origin, or from where `lines` says; one with a NaN meets nothing.
        ray_starts: (B + 1,), which rays belong to each box.
        centers: (B, 3) [m].
        rotations: (B, 3, 3), whose columns are the boxes' axes.
        halves: (B, 3) [m], half of length, width and height.
        lines: (R, 4), of a rolling shutter, where each ray begins [m], and at which share of the time in which the
            image was taken, -0.5 to 0.5; (0, 4) where it was taken at once.
        drifts: (B, 3) [m], how far the boxes go in that time; of no account without `lines`.
        rival_starts: (B + 1,), which of `rivals` belong to each box.
        rivals: numbers of the boxes that may stand before it.
        met: (B,), filled.
        hidden: (B,), filled.

    Source: Kay and Kajiya 1986, "Ray Tracing Complex Scenes": a ray is in a box while it is between all pairs of faces.
    """
    for b in range(len(centers)):
        met[b] = hidden[b] = 0
        for k in range(ray_starts[b], ray_starts[b + 1]):
            x, y, z = rays[k, 0], rays[k, 1], rays[k, 2]
            own = _entry(x, y, z, _centre(k, b, centers, lines, drifts), b, rotations, halves)
            if not own < np.inf:
                continue
            met[b] += 1
            for r in range(rival_starts[b], rival_starts[b + 1]):
                rival = rivals[r]
                centre = _centre(k, rival, centers, lines, drifts)
                if _entry(x, y, z, centre, rival, rotations, halves) < own * (1.0 - _BEHIND):
                    hidden[b] += 1
                    break


@kernel(
    "void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1], "
    "float64[:,::1], float64[:,::1], float64, int64[:,::1])"
)
def count_evidence(
    points: Float64Array, pixels: Float64Array, extents: Float64Array, centers: Float64Array, rotations: Float64Array,
    halves: Float64Array, lines: Float64Array, drifts: Float64Array, margin: float, evidence: Int64Array,
) -> None:  # fmt: skip
    """Count the points that lie before each box, as the camera sees them, and those that lie on or in it.

    Args:
        points: (N, 3) [m], from where the camera saw them: the origin, or where `lines` says.
        pixels: (N, 2) [px], where they are in the image; NaN for those that are not.
        extents: (B, 4) [px], left, top, right, bottom of each box in the image.
        centers, rotations, halves, lines, drifts: as in `count_observations`, a ray being that to a point.
        margin: how far outside its faces a point still counts as on a box [m].
        evidence: (B, 2), filled: points before it, points on it.
    """
    evidence[:] = 0
    for i in range(len(points)):
        u, v = pixels[i, 0], pixels[i, 1]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        slack = margin / np.sqrt(x * x + y * y + z * z)
        for b in range(len(centers)):
            if extents[b, 0] <= u <= extents[b, 2] and extents[b, 1] <= v <= extents[b, 3]:
                centre = _centre(i, b, centers, lines, drifts)
                near, far = _crossing(x, y, z, centre, b, rotations, halves)
                if near <= far and far > 0.0:
                    if near - slack > 1.0:
                        evidence[b, 0] += 1
                    elif far + slack >= 1.0:
                        evidence[b, 1] += 1


_KNOT_NS = 10_000_000
"""With times of points, boxes are placed this often during a sweep [ns]; between, they move linearly."""

_MOST_KNOTS = 101
_FARTHEST_BOX = 1e8  # boxes farther away, or larger, have no points [m]: their numbers are meaningless
_NOTHING = np.zeros(0, np.int64)
_NO_POINTS = np.zeros(0, np.uint32)

_MEASURED = "measured_timestamps_ns"
"""The additional array of a deskewed sweep's points with the time when each was measured [ns]."""

_POINTS = "points"  # name of the attribute that holds the counts


class Moment(StrEnum):
    """The time at which boxes and sensor are placed."""

    FRAME = "frame"
    """The frame's timestamp: right for sweeps that were deskewed to it."""
    POINTS = "points"
    """Each point's own time: right for sweeps as measured, and for deskewed ones in the world."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameCounts:
    """The points of one lidar in the cuboids.

    Attributes:
        lidar_id: the lidar.
        timestamps_ns: (F,) int64 [ns], of its frames.
        counts: (F, A) int64, points in each cuboid; 0 where it is not there.
        there: (F, A) bool, whether the cuboid is there and the pose of the frame's points is known.
        point_ids: for each frame the rows (N,) uint32 of the points in a cuboid, by its number among the A, where there
            are any; None where not listed.
    """

    lidar_id: Identifier
    timestamps_ns: Int64Array
    counts: Int64Array
    there: BoolArray
    point_ids: Sequence[Mapping[int, UInt32Array]] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PointCounts:
    """The points in the cuboids of a scene.

    Attributes:
        annotation_ids: A ids of the cuboids that have a path, in the order of the scene.
        lidars: one entry per lidar.
        unplaced: frames that were not counted, because the pose of their sensor is unknown.
    """

    annotation_ids: tuple[Identifier, ...]
    lidars: tuple[FrameCounts, ...]
    unplaced: int = 0


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def count_points(
    scene: Scene,
    *,
    lidars: Choice = ALL,
    moment: Moment | str = Moment.FRAME,
    trajectory: str | EgoMotion | None = None,
    listed: bool = False,
    margin: float = 0.0,
    activations: bool = True,
    progress: Progress | None = None,
) -> PointCounts:
    """Count the points of each lidar frame in each cuboid; a point on a face counts, and in every cuboid it is in.

    Frames are read one after the other and not kept.

    Args:
        scene: with cuboids in its world.
        lidars: whose frames: "all", an id, or several.
        moment: the time at which boxes and sensor are placed.
        trajectory: name of the ego trajectory, as for `Scene.samples`.
        listed: also list the points.
        margin: how far outside its faces a cuboid still has points [m].
        activations: count cuboids whose activations name a lidar only while they are active for it, by its own
            computed cuboids; False: by their paths alone, as to compute activations anew.
        progress: called after each frame with how many are done, and of how many.

    Raises:
        OptionError: there is no such lidar, trajectory or moment, no lidar at all, or the margin is negative.
        PoseError: the pose of a lidar's points in the world is unknown.
        DataError: a frame cannot be read.
    """
    check_choice("moment", moment, Moment)
    if not 0.0 <= margin < _FARTHEST_BOX:
        raise OptionError(f"margin {margin} m; expected a number from 0 on")
    scene = scene.corrected()
    chosen = chosen_sensors(scene, "lidar", scene.lidars, lidars)
    if not scene.lidars:
        raise OptionError(f"{scene.source}: has no lidar whose points could be counted")
    table, ego = BoxTable(scene), choose_ego(scene, trajectory)
    found: list[FrameCounts] = []
    total, done, unplaced = sum(len(lidar.frames) for lidar in chosen), 0, 0
    for lidar in chosen:
        source = _points_position(scene, lidar, ego)
        counter = _Counter(table, lidar, source, Moment(moment), margin, listed, lidar.id if activations else None)
        shape = len(lidar.frames), len(table.annotations)
        counts, there = np.zeros(shape, np.int64), np.zeros(shape, np.bool_)
        lists: list[Mapping[int, UInt32Array]] = []
        for k, frame in enumerate(lidar.frames):
            counted = counter.count(frame)
            lists.append({})
            if counted is None:
                unplaced += 1
            else:
                rows, counts[k, counted[0]], point_ids = counted
                there[k, rows] = True
                lists[k] = {row: ids for row, ids in zip(rows.tolist(), point_ids, strict=False) if len(ids)}
            done += 1
            if progress is not None:
                progress(done, total)
        found.append(FrameCounts(lidar.id, lidar.frames.timestamps_ns, counts, there, lists if listed else None))
    return PointCounts(tuple(annotation.id for annotation in table.annotations), tuple(found), unplaced)


_Counted = tuple[Int64Array, Int64Array, Sequence[UInt32Array]]
"""Of one frame: rows of the cuboids that are there (B,), how many points each has (B,), and which."""


@dataclass(frozen=True, slots=True, eq=False)
class _Counter:
    """Counts the points of one lidar's frames."""

    table: BoxTable
    lidar: LidarSensor
    source: PoseSource  # transforms its points as stored into the world
    moment: Moment
    margin: float
    listed: bool
    sensor_id: Identifier | None  # the sensor by whose activations boxes are there; None for none

    def count(self, frame: LidarFrame) -> _Counted | None:
        """Count in one frame; None where the pose of its points is unknown."""
        if self.moment is Moment.POINTS:
            timed = timed_frame(frame, sweep_period_ns(self.lidar)).frame
            if timed.points.timestamps_ns is not None and len(timed.points):
                return self._at_points(timed, np.asarray(timed.points.timestamps_ns, np.int64))
        return self._at_frame(frame)

    def _at_frame(self, frame: LidarFrame) -> _Counted | None:
        """Transform the boxes into the frame of the points: there are fewer of them."""
        rows, boxes = self._find(frame, frame.timestamp_ns)
        pose = self.source.at(np.array([frame.timestamp_ns], np.int64))
        position, rotation = pose.positions[0], pose.quaternions_xyzw[0]
        if not np.isfinite(position).all():
            return None
        back = conjugate_quaternion(rotation)
        moved = replace(
            boxes,
            centers_world=rotate_vectors(back, boxes.centers_world - position),
            quaternions_xyzw=multiply_quaternions(back, boxes.quaternions_xyzw),
        )
        return rows, *self._inside([moved], np.zeros(0), frame.points.positions)

    def _at_points(self, frame: LidarFrame, times: Int64Array) -> _Counted | None:
        """Transform each point into the world at its own time, and the boxes to the times of the points."""
        positions = _points_in_world(self.source, frame.points.positions, times)
        if positions is None:
            return None
        measured = frame.points.extras.get(_MEASURED, times)
        first, last = int(measured.min()), int(measured.max())
        count = min(max(-(-(last - first) // _KNOT_NS) + 1, 2), _MOST_KNOTS)
        knots = np.rint(np.linspace(first, last, count)).astype(np.int64)
        rows, _ = self._find(frame, int(np.median(measured)))
        boxes = [self.table.placed(rows, int(knot), sensor_id=self.sensor_id) for knot in knots]
        locations = (measured - first) * ((count - 1) / max(last - first, 1))
        return rows, *self._inside(boxes, locations, positions)

    def _find(self, frame: LidarFrame, time_ns: int) -> tuple[Int64Array, Boxes]:
        """The boxes at a time that are active at any time of a frame."""
        times = frame.points.timestamps_ns
        last_ns = frame.timestamp_ns if times is None or not len(times) else int(times.max())
        return self.table.find(time_ns, sensor_id=self.sensor_id, window_ns=(frame.timestamp_ns, last_ns))

    def _inside(
        self, boxes: Sequence[Boxes], locations: Float64Array, points: FloatArray
    ) -> tuple[Int64Array, Sequence[UInt32Array]]:
        """Count the points in each of B boxes at K knots, and list them; `locations` of the points among the knots."""
        centers = np.stack([each.centers_world for each in boxes])
        rotations = np.stack([each.rotations_world for each in boxes])
        sizes = np.stack([each.sizes_lwh for each in boxes])
        halves = np.where(sizes >= 0.0, sizes / 2.0 + self.margin, np.nan)
        # boxes that have a size, and whose numbers are finite and plausible
        usable = ((np.abs(centers) < _FARTHEST_BOX) & (np.abs(halves) < _FARTHEST_BOX)).all(axis=(0, 2))
        rows = np.flatnonzero(usable & np.isfinite(rotations).all(axis=(0, 2, 3)))
        counts, lists = np.zeros(centers.shape[1], np.int64), [_NO_POINTS] * centers.shape[1]
        if len(rows) == 0:
            return counts, lists
        found, cloud = np.zeros(len(rows), np.int64), np.ascontiguousarray(points)
        moving = locations, centers[:, rows].copy(), rotations[:, rows].copy(), halves[:, rows].copy()
        find_points_in_boxes(cloud, *moving, found, _NOTHING)
        counts[rows] = found
        if self.listed:
            stops, ids = np.cumsum(found) - found, np.empty(int(found.sum()), np.int64)
            if len(ids):
                find_points_in_boxes(cloud, *moving, stops, ids)
            for row, part in zip(rows.tolist(), np.split(ids.astype(np.uint32), np.cumsum(found)[:-1]), strict=True):
                lists[row] = part
        return counts, lists


def _points_in_world(source: PoseSource, positions: Float32Array, timestamps_ns: Int64Array) -> FloatArray | None:
    """Transform points (N, 3) [m] into the world, each at its own time (N,) [ns]; None beyond the trajectory.

    Args:
        source: transforms the points as stored into the world; those that are there already stay as they are.
    """
    if source is WORLD or len(positions) == 0:
        return positions
    path, reach_ns = source.path, source.reach_ns
    first, last = int(timestamps_ns.min()), int(timestamps_ns.max())
    if not path.static and (first < path.start_ns - reach_ns or last > path.stop_ns + reach_ns):
        return None
    world = np.empty(positions.shape)
    transform_by_path(
        np.ascontiguousarray(positions), timestamps_ns, np.ascontiguousarray(source.mount.matrix[:3]),
        path.timestamps_ns, path.positions, path.quaternions_xyzw, world,
    )  # fmt: skip
    return world


def _points_position(scene: Scene, lidar: LidarSensor, ego: EgoMotion | None) -> PoseSource:
    """The poses that transform a lidar's points as stored into the world.

    Raises:
        PoseError: they are unknown.
    """
    location = frame_of_points(scene, lidar, ego)
    if location.source is None:
        raise PoseError(
            f"{scene.source}: the pose of the points of lidar {lidar.id!r} in the world is unknown; it needs poses "
            "of its own, or a mounting on the ego and a trajectory with orientations"
        )
    return location.source


def activation_of(
    sensor_id: Identifier, timestamps_ns: Int64Array, seen: BoolArray, cuboids: Float64Array | None = None
) -> Activation | None:
    """The times in which a sensor sees a cuboid; None where it never does.

    Each begins with a frame that sees it, and lasts until the next frame that does not; after the last frame of all, as
    long as the usual period of the frames.

    Args:
        sensor_id: the sensor.
        timestamps_ns: (F,) int64 [ns], its frames in order.
        seen: (F,) bool, which of them see the cuboid.
        cuboids: (F, 9) float64, the cuboid at each frame, to be included where each time begins.
    """
    steps = np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8))
    first, beyond = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    if len(first) == 0:
        return None
    end_ns = min(int(timestamps_ns[-1]) + int(usual_period_ns(timestamps_ns)), 2**63 - 1)
    stops = np.append(timestamps_ns, np.int64(end_ns))[beyond]
    durations = tuple((stops - timestamps_ns[first]).view(np.uint64).tolist())  # uint64 holds any difference
    return Activation(sensor_id, timestamps_ns[first], durations, None if cuboids is None else cuboids[first])


def _with_attributes(
    annotation: CuboidAnnotation,
    attributes: Iterable[AttributePath],
    *,
    names: Iterable[str],
    sensor_ids: Iterable[Identifier],
) -> CuboidAnnotation:
    """Give a cuboid new attributes instead of all of these names that it had of these sensors."""
    reported, sensors = set(names), {key_of(sensor_id) for sensor_id in sensor_ids}
    kept = [
        path
        for path in annotation.attributes
        if path.name not in reported or path.sensor_id is None or key_of(path.sensor_id) not in sensors
    ]
    return replace(annotation, attributes=(*kept, *attributes))


def _with_changed(scene: Scene, counts: PointCounts, change: Callable[[CuboidAnnotation, int], Annotation]) -> Scene:
    """The scene with each counted cuboid changed; `change` gets its number among the counts."""
    rows = {key_of(identifier): row for row, identifier in enumerate(counts.annotation_ids)}

    def changed(annotation: Annotation) -> Annotation:
        row = rows.get(key_of(annotation.id))
        return change(annotation, row) if isinstance(annotation, CuboidAnnotation) and row is not None else annotation

    return replace(scene, annotations=tuple(map(changed, scene.annotations)))


def with_counts(scene: Scene, counts: PointCounts) -> Scene:
    """Set an attribute `points` of each cuboid, per lidar: how many points it holds at each frame while it is there.

    Args:
        scene: the scene, or one with the same cuboids.
        counts: the result of `count_points`.
    """
    sensor_ids = [lidar.lidar_id for lidar in counts.lidars]

    def change(cuboid: CuboidAnnotation, row: int) -> CuboidAnnotation:
        paths = []
        for lidar in counts.lidars:
            frames = np.flatnonzero(lidar.there[:, row])
            if len(frames):
                values, times = tuple(lidar.counts[frames, row].tolist()), lidar.timestamps_ns[frames]
                paths.append(AttributePath(_POINTS, values, times, sensor_id=lidar.lidar_id))
        return _with_attributes(cuboid, paths, names=[_POINTS], sensor_ids=sensor_ids)

    return _with_changed(scene, counts, change)


def with_activations(scene: Scene, counts: PointCounts, *, min_points: int = 1) -> Scene:
    """Set when each lidar sees each cuboid: while frame after frame has points of it; older activations are replaced.

    Args:
        scene: the scene, or one with the same cuboids.
        counts: the result of `count_points`.
        min_points: a frame with fewer points does not see it.
    """
    keys = {key_of(lidar.lidar_id) for lidar in counts.lidars}

    def change(cuboid: CuboidAnnotation, row: int) -> CuboidAnnotation:
        kept = [activation for activation in cuboid.activations if key_of(activation.sensor_id) not in keys]
        found = [
            activation_of(lidar.lidar_id, lidar.timestamps_ns, lidar.counts[:, row] >= min_points)
            for lidar in counts.lidars
        ]
        return replace(cuboid, activations=(*kept, *(activation for activation in found if activation is not None)))

    return _with_changed(scene, counts, change)


def with_labeled_points(scene: Scene, counts: PointCounts) -> Scene:
    """Add an annotation of labelled points for each cuboid that holds any; the cuboid is its parent.

    Its id is that of the cuboid followed by ":points"; an annotation of that id is replaced if it is one of these.

    Args:
        scene: the scene, or one with the same cuboids and frames.
        counts: the result of `count_points`, with the points listed.

    Raises:
        OptionError: the points were not listed, or another annotation has such an id.
    """
    if any(lidar.point_ids is None for lidar in counts.lidars):
        raise OptionError("the points in the cuboids were counted, not listed; count with `listed=True`")
    cuboids = {key_of(each.id): each for each in scene.annotations if isinstance(each, CuboidAnnotation)}
    made = {}
    for row, identifier in enumerate(counts.annotation_ids):
        entries = tuple(
            LabeledPoints(lidar.lidar_id, lists[row], sensor_frame=k)
            for lidar in counts.lidars
            for k, lists in enumerate(lidar.point_ids or ())
            if row in lists
        )
        if entries:
            cuboid = cuboids[key_of(identifier)]
            own = f"{cuboid.id}:{_POINTS}"
            made[own] = LabeledPointsAnnotation(own, entries, label=cuboid.label, is_instance=True, parent_id=cuboid.id)
    kept = [
        each
        for each in scene.annotations
        if each.id not in made
        or not (isinstance(each, LabeledPointsAnnotation) and each.id == f"{each.parent_id}:{_POINTS}")
    ]
    return replace(scene, annotations=(*kept, *made.values()))
