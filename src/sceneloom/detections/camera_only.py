"""Where objects are that only an image shows: by their height, or by the lidar points in their frustum.

An object of the height h that is seen under the angle α from top to bottom is h / (2 tan(α / 2)) away. How much
heights differ within a class is how little is known of that distance; across the ray the image knows better.

The rays through a box in an image bound a frustum. What the middle of the box shows, its lowest part and with it the
ground left out, is mostly the object itself: of the points there, those of the boxes that the sweep has itself taken
away, the object's are the many at one distance, near to what its height in the image makes likely (`camera_only`).
Its middle lies behind them, by half of what it measures along the line of sight: how that is rotated is known by how
    wide
it appears. Too few points leave the object where its height puts it.

Source: Qi et al. 2018, "Frustum PointNets for 3D Object Detection from RGB-D Data", for frustums of boxes; there a
network looks into them, here two distributions do.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, FloatArray, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, unproject
from sceneloom.colouring.box_outlines import CENTRE_TO_CORNER
from sceneloom.detections.detectors import SIZES
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.boxes import points_in_cones

EDGES = (0.05, 2.0)
"""Deviation of an edge of a box: this share of its side, plus so many pixels."""

_BORDER_PX = 2.0
"""A box that comes so near to the border of the image may be cut there [px]."""

_CUT_SIGMA = 0.5
"""Deviation of the distance of what the image cuts at top or bottom, as a share of it."""

_RAYS: Float64Array = read_only(
    np.array(
        [
            [0.5, 0.0, 0.5, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0, 0.0],
            [0.0, 0.5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.5],
            [0.5, 0.0, 0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0],
            [0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.5, 0.0, 0.5],
        ]
    )
)
"""From the edges of a box to five pixels: the middle, those of its top and bottom, those of its left and right."""


class Placed(NamedTuple):
    """Objects in space by one image.

    Attributes:
        rows: (P,) int64, which boxes: those asked for along which the camera model has rays.
        centers: (P, 3) float64 [m], lidar frame.
        center_covariances: (P, 3, 3) float64 [m²].
        sizes_lwh: (P, 3) float64 [m], typical of the class.
        size_covariances: (P, 3, 3) float64 [m²].
        ranges: (P,) float64 [m], from the camera.
    """

    rows: Int64Array
    centers: Float64Array
    center_covariances: Float64Array
    sizes_lwh: Float64Array
    size_covariances: Float64Array
    ranges: Float64Array


def position_by_height(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    corners_xyxy: Float64Array,
    rows: Int64Array,
    kinds: Int64Array,
) -> Placed:
    """Guess where objects are whose boxes in the image are all that is known.

    Args:
        camera: the camera model.
        camera_from_lidar: how it lies.
        corners_xyxy: (M, 4) float64 [px], boxes of the image, corner convention, with an area.
        rows: (L,) int64, which of them are asked for.
        kinds: (M,) int64, of `classes.table_rows`.
    """
    boxes = corners_xyxy[rows]
    pixels = (boxes @ _RAYS).reshape(-1, 2) - CENTRE_TO_CORNER
    rays = unproject(camera, pixels).reshape(len(rows), 5, 3)
    chords = rays[:, 1::2] - rays[:, 2::2]
    angles = 2.0 * np.arcsin(np.minimum(np.sqrt((chords * chords).sum(axis=2)) / 2.0, 1.0))
    seen = np.isfinite(rays).all(axis=(1, 2)) & (angles[:, 0] > 0.0)
    rows, boxes, sizes = rows[seen], boxes[seen], SIZES[kinds[rows[seen]]]
    angle_upright, angle_across = angles[seen].T
    distances = sizes[:, 2] / (2.0 * np.tan(np.minimum(angle_upright, 3.0) / 2.0)) + sizes[:, 1] / 2.0
    # variances along the ray and across, as shares of the distance squared
    upright = (EDGES[0] + EDGES[1] / (boxes[:, 3] - boxes[:, 1])) ** 2
    sideways = (EDGES[0] + EDGES[1] / (boxes[:, 2] - boxes[:, 0])) ** 2
    cut = (boxes[:, 1] < _BORDER_PX) | (boxes[:, 3] > camera.height - _BORDER_PX)
    along = (sizes[:, 5] / sizes[:, 2]) ** 2 + 2.0 * upright + np.where(cut, _CUT_SIGMA**2, 0.0)
    across = np.maximum(sideways * angle_across**2, upright * angle_upright**2)
    rays_lidar = rays[seen, 0] @ camera_from_lidar.rotation
    outer = rays_lidar[:, :, None] * rays_lidar[:, None]
    shares = across[:, None, None] * np.eye(3) + (along - across)[:, None, None] * outer
    return Placed(
        rows,
        distances[:, None] * rays_lidar - camera_from_lidar.translation @ camera_from_lidar.rotation,
        distances[:, None, None] ** 2 * shares,
        sizes[:, :3],
        sizes[:, 3:, None] ** 2 * np.eye(3),
        distances,
    )


_LEAST_POINTS = 5
"""Fewer points at one distance state nothing."""

_CORE_ACROSS, _CORE_UPRIGHT = (0.2, 0.8), (0.05, 0.75)
"""The part of a box that is looked at, as shares of its width and of its height from the top."""

_SURFACE = 0.25
"""The share of an object's points that lies before its surface in the middle of what is seen."""

_SURFACE_SIGMA = 0.15
"""Deviation of that surface [m]."""

_DEEPER = 0.4
"""Points of an object reach so much farther in depth than the mean of its length and width [m]."""

_IN_BOX = 0.15
"""A point so near to a box of the sweep is of it [m]."""

_FREEDOM = 4.0
"""Degrees of freedom of the distances that heights report: Student's distribution forgives classes that are wrong."""

_LEAST_SHARE, _MOST_NEARER = 0.35, 0.35
"""Of the points in the middle of a box at least such a share is at the object's distance, and no larger one nearer:
else it may be hidden behind something, and points report that."""

_HIDDEN = 0.15
"""If a larger share of the points is nearer than the object, its box in the image is of what is not hidden."""

_HIDDEN_SIGMA = 0.25
"""Deviation of the middle of such a box, as a share of its sides."""

_CUT_ALONG, _CUT_SHARE = 0.25, 0.3
"""Deviation of the position of what the border of the image cuts, as shares of its length (height), along the ray and
across."""

_NEAR_SHIFT = 12.0
"""The middle of what is seen of a near object of length l is off by l² / (so many times its distance)."""

_SLIM, _BODY = 1.0, 0.25
"""Of what is slimmer [m] the middle shows a person, rider association or not.

The middle of a body is this share of its width
behind its surface."""

_MIDDLE_AND_CORNERS = np.array([[0.5, 0.5], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])

_LEAST_COSINE, _WIDER = 0.2, 0.999
"""Boxes that are wider than a cone of this cosine have no cone; those of others are a little wider than the boxes."""

_ANY_ROTATION = np.linspace(0.0, np.pi / 2.0, 16)

_SIDE_SHARE = 0.12
"""Deviation of how wide an object appears, as a share of it."""


def position_by_points(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    points_lidar: FloatArray,
    corners_xyxy: Float64Array,
    kinds: Int64Array,
    boxes: Float64Array,
    placed: Placed,
) -> tuple[Placed, BoolArray]:
    """Put objects that an image shows where the points of the sweep are.

    Args:
        camera: the camera model.
        camera_from_lidar: how it lies.
        points_lidar: (P, 3) float [m], of the sweep.
        corners_xyxy: (M, 4) float64 [px], boxes of the image, corner convention.
        kinds: (M,) int64, of `classes.table_rows`.
        boxes: (N, 7) float64, boxes of the sweep: centre, size [m] and heading [rad].
        placed: where heights put the objects.

    Returns:
        The objects, and which of them points have placed, (L,) bool.
    """
    measured = np.zeros(len(placed.rows), np.bool_)
    if len(measured) == 0 or len(points_lidar) == 0:
        return placed, measured
    origin = camera_from_lidar.inverse().translation
    corners = corners_xyxy[placed.rows]
    points = _near_boxes(camera, camera_from_lidar, points_lidar, corners, origin)
    pixels, visible = project(camera, camera_from_lidar.apply(points))
    points, pixels = points[visible], pixels[visible] + CENTRE_TO_CORNER
    moved = Placed(*(column.copy() for column in placed))  # type: ignore[arg-type]
    observations = _observations(camera, corners)
    for k, inside in enumerate(_cores(pixels, corners)):
        own = points[inside]
        own = own[~_in_boxes(own, boxes)]
        found = _Found.of(own, origin, placed, k, SIZES[kinds[placed.rows[k]]], observations[k])
        if found is not None:
            measured[k] = True
            found.put(moved, k, origin)
    return moved, measured


def _near_boxes(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    points_lidar: FloatArray,
    corners: Float64Array,
    origin: Float64Array,
) -> Float64Array:
    """The points (N, 3) [m] in cones around boxes of the image: few of a sweep, of which the camera model is asked."""
    wide = corners[:, 2:] - corners[:, :2]
    locations = corners[:, None, :2] + _MIDDLE_AND_CORNERS * wide[:, None] - CENTRE_TO_CORNER
    rays = unproject(camera, locations.reshape(-1, 2)).reshape(-1, 5, 3)
    cosines = (rays[:, 1:] * rays[:, :1]).sum(axis=2).min(axis=1)
    known = np.isfinite(cosines)
    if not (cosines[known] > _LEAST_COSINE).all():
        return points_lidar[np.isfinite(points_lidar).all(axis=1)].astype(np.float64)
    axes = rays[known, 0] @ camera_from_lidar.rotation
    cloud = np.ascontiguousarray(points_lidar, np.float32)
    rows = points_in_cones(cloud, origin, np.ascontiguousarray(axes), cosines[known] * _WIDER)
    return points_lidar[rows].astype(np.float64)


def _cores(pixels: Float64Array, corners: Float64Array) -> Iterator[Int64Array]:
    """Which points lie in the middle of each box."""
    for left, top, right, bottom in corners.tolist():
        wide, high = right - left, bottom - top
        u, v = pixels[:, 0], pixels[:, 1]
        inside = (u >= left + _CORE_ACROSS[0] * wide) & (u <= left + _CORE_ACROSS[1] * wide)
        inside &= (v >= top + _CORE_UPRIGHT[0] * high) & (v <= top + _CORE_UPRIGHT[1] * high)
        yield np.flatnonzero(inside)


def _in_boxes(points: Float64Array, boxes: Float64Array) -> BoolArray:
    """Which points are of a box of the sweep."""
    apart = points[:, None] - boxes[:, :3]
    cos, sin = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    along = np.abs(cos * apart[:, :, 0] + sin * apart[:, :, 1])
    across = np.abs(cos * apart[:, :, 1] - sin * apart[:, :, 0])
    halves = boxes[:, 3:6] / 2.0 + _IN_BOX
    inside = (along <= halves[:, 0]) & (across <= halves[:, 1]) & (np.abs(apart[:, :, 2]) <= halves[:, 2])
    found = np.zeros(len(points), np.bool_)
    found[np.flatnonzero(inside.any(axis=1))] = True
    return found


class _Visibility(NamedTuple):
    """How an image sees an object.

    Attributes:
        upright, across: under which angles [rad].
        edge_shares: deviation of an edge across and upright, as shares of the sides of its box.
        is_cut_upright, is_cut_across: whether the border of the image cuts it.
        is_hidden: whether nearer things hide part of it.
    """

    upright: float
    across: float
    edge_shares: tuple[float, float]
    is_cut_upright: bool
    is_cut_across: bool
    is_hidden: bool = False


def _observations(camera: Camera, corners: Float64Array) -> list[_Visibility]:
    sides = np.array([[0.5, 0.0], [0.5, 1.0], [0.0, 0.5], [1.0, 0.5]])
    spans = corners[:, 2:] - corners[:, :2]
    locations = corners[:, None, :2] + sides * spans[:, None] - CENTRE_TO_CORNER
    rays = unproject(camera, locations.reshape(-1, 2)).reshape(-1, 2, 2, 3)
    angles = 2.0 * np.arcsin(np.clip(np.linalg.norm(rays[:, :, 0] - rays[:, :, 1], axis=2) / 2.0, 0.0, 1.0))
    near = corners < _BORDER_PX, corners > np.array([camera.width, camera.height] * 2) - _BORDER_PX
    cut = near[0][:, :2] | near[1][:, 2:]
    shares = EDGES[0] + EDGES[1] / spans
    return [
        _Visibility(float(upright), float(across), (float(wide), float(high)), bool(cut_v), bool(cut_u))
        for (upright, across), (wide, high), (cut_u, cut_v) in zip(angles, shares, cut, strict=True)
    ]


class _Found(NamedTuple):
    """An object that points have placed: its distance from the camera, variances along the ray and across, height."""

    distance: float
    along: float
    across: float
    height: tuple[float, float]

    @classmethod
    def of(
        cls,
        points: Float64Array,
        origin: Float64Array,
        placed: Placed,
        k: int,
        size: Float64Array,
        visibility: _Visibility,
    ) -> "_Found | None":
        ray = (placed.centers[k] - origin) / placed.ranges[k]
        by_height = float(ray @ placed.center_covariances[k] @ ray)
        depths = np.sort((points - origin) @ ray)
        reach = float(np.sqrt(size[0] * size[1])) + _DEEPER
        first, last = _most_at_once(depths, reach, float(placed.ranges[k]), by_height)
        if last - first < max(_LEAST_POINTS, _LEAST_SHARE * len(depths)) or first > _MOST_NEARER * len(
            depths
        ):
            return None
        surface = float(np.quantile(depths[first:last], _SURFACE))
        behind, behind_variance = _behind(surface, size, visibility)
        distance, visibility = surface + behind, visibility._replace(is_hidden=first > _HIDDEN * len(depths))
        across = (float(np.trace(placed.center_covariances[k])) - by_height) / 2.0
        across = across * (distance / placed.ranges[k]) ** 2 + _off_ray(distance, size, visibility)
        along = (
            _SURFACE_SIGMA**2
            + behind_variance
            + visibility.is_cut_across * (_CUT_ALONG * float(size[0])) ** 2
        )
        return cls(distance, along, across, _height(distance, size, visibility))

    def put(self, placed: Placed, k: int, origin: Float64Array) -> None:
        """Move object k there."""
        ray = (placed.centers[k] - origin) / placed.ranges[k]
        outer = np.outer(ray, ray)
        placed.centers[k], placed.ranges[k] = origin + self.distance * ray, self.distance
        placed.center_covariances[k] = self.across * (np.eye(3) - outer) + self.along * outer
        placed.sizes_lwh[k, 2], placed.size_covariances[k, 2, 2] = self.height


def _most_at_once(depths: Float64Array, reach: float, expected: float, variance: float) -> tuple[int, int]:
    """The run of points, not deeper than one object, that is most likely to be it: many, and where it is expected."""
    if len(depths) == 0:
        return 0, 0
    stops = np.searchsorted(depths, depths + reach, side="right")
    counts = stops - np.arange(len(depths))
    off = (depths + reach / 2.0 - expected) ** 2 / (variance + reach**2 / 12.0)
    likely = np.log(counts) - (_FREEDOM + 1.0) / 2.0 * np.log1p(off / _FREEDOM)
    best = int(likely.argmax())
    return best, int(stops[best])


def _behind(surface: float, size: Float64Array, visibility: _Visibility) -> tuple[float, float]:
    """How far the middle of an object is behind what is seen of it [m], and the variance of that [m²].

    A box of length l and width w that is rotated by β from the line of sight appears l sin β + w cos β wide; from its
    middle to its surface on the line of sight it is the less of l / (2 cos β) and w / (2 sin β).
    """
    if size[1] < _SLIM:
        return _BODY * float(size[1]), float(_BODY * size[1] / 2.0) ** 2
    length, width = float(size[0]), float(size[1])
    rotations = _ANY_ROTATION
    cos, sin = np.cos(rotations), np.sin(rotations)
    depths = np.minimum(length / 2.0 / np.maximum(cos, 1e-9), width / 2.0 / np.maximum(sin, 1e-9))
    weights = np.ones(len(rotations))
    if not visibility.is_cut_across:
        appears = 2.0 * (surface + depths / 2.0) * np.tan(min(visibility.across, 3.0) / 2.0)
        wide = length * sin + width * cos
        off = (appears - wide) / (np.hypot(_SIDE_SHARE, visibility.edge_shares[0]) * wide)
        weights = np.exp(-0.5 * np.minimum(off**2, 50.0))
    weights /= weights.sum()
    behind = float(weights @ depths)
    spread = float(weights @ (depths - behind) ** 2)
    own = float(weights @ ((depths / length * size[3]) ** 2))
    return behind, spread + own


def _off_ray(distance: float, size: Float64Array, visibility: _Visibility) -> float:
    """Variance of where an object is across the ray through the middle of its box in the image [m²].

    The middle of what is seen is not that of the object where it is near, cut off or hidden.
    """
    length, height = float(size[0]), float(size[2])
    variance = min(length**2 / (_NEAR_SHIFT * distance), length / 4.0) ** 2
    variance += visibility.is_cut_across * (_CUT_SHARE * length) ** 2
    variance += visibility.is_cut_upright * (_CUT_SHARE * height) ** 2
    if visibility.is_hidden:
        variance += (_HIDDEN_SIGMA * distance * max(visibility.upright, visibility.across)) ** 2
    return variance


def _height(distance: float, size: Float64Array, visibility: _Visibility) -> tuple[float, float]:
    """Height of an object [m] and its variance [m²]: what is usual, and what it appears at its distance."""
    usual, variance = float(size[2]), float(size[5]) ** 2
    if visibility.is_cut_upright or visibility.is_hidden:
        return usual, variance
    appears = 2.0 * distance * np.tan(min(visibility.upright, 3.0) / 2.0)
    # what is near is seen from its front to its back under angles that differ by as much as its depth
    off = 2.0 * visibility.edge_shares[1] ** 2 + (float(size[0]) / (4.0 * distance)) ** 2
    weight, weight_seen = 1.0 / variance, 1.0 / (off * appears**2)
    return (usual * weight + appears * weight_seen) / (weight + weight_seen), 1.0 / (weight + weight_seen)
