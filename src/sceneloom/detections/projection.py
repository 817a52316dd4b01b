"""Fusion of the boxes of a sweep with those of an image, by projecting the former into the image.

An object of the height h that is seen under the angle α from top to bottom is h / (2 tan(α / 2)) away. How much
heights differ within a class is how little is known of that distance; across the ray the image knows better.

The rays through a box in an image bound a frustum. What the middle of the box shows, its lowest part and with it the
ground left out, is mostly the object itself: of the points there, those of the boxes that the sweep has itself taken
away, the object's are the many at one distance, near to what its height in the image makes likely (`camera_only`).
Its middle lies behind them, by half of what it measures along the line of sight: how that is rotated is known by how
wide it appears. Too few points leave the object where its height puts it.

Source: Qi et al. 2018, "Frustum PointNets for 3D Object Detection from RGB-D Data", for frustums of boxes; there a
network looks into them, here two distributions do.

The state of a box is x = (middle, size), six numbers with the covariance P. The image gives three numbers z: the
middle of the partner across and upright, and its height. They are what the corners bound that the box has there,
h(x), but for noise with the variances R. With the slopes H of h Kalman's update is

    K = P Hᵀ (H P Hᵀ + R)⁻¹,   x' = x + K (z - h(x)),   P' = P - K H P,   the same as   P'⁻¹ = P⁻¹ + Hᵀ R⁻¹ H.

The width of the partner is not used: boxes of people in sweeps hold their arms and steps, those in images less.
Of a box that the border of the image may cut across, only what is upright counts, and the other way round.

Source: Kalman 1960, "A New Approach to Linear Filtering and Prediction Problems"; Thrun, Burgard and Fox 2005,
"Probabilistic Robotics", ch. 3.5 for the form with inverses.

What becomes of the boxes:

- A pair is one object: where and how large the sweep's box says, sharpened by the image's (`refinement`); with the
  class of the surer detector, the image's box, and the existence that both together make likely (`existence`).
- A box of the sweep alone stays an object. If the image shows its location openly, and its detector should have found
  it there, it becomes less likely.
- A box of the image alone stays an object too, at the distance that its height in the image and the usual height
  of its class give (`camera_only`), or that of the points of the sweep behind it, where these are given and report one
  (`frustum`); how little that is worth is in its covariance. Its heading is not known, and given as 0. Whoever wants
  measured objects alone takes those with a box in the sweep.

Boxes whose location or size is no number are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import float64, int64
from scipy.optimize import linear_sum_assignment

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, project_unbounded, unproject
from sceneloom.colouring.cuboid_projection import CENTRE_TO_CORNER, COARSE, box_extents
from sceneloom.detections.detectors import FAMILIES, SAYS_NOTHING, SIZES, kind_name, numbers_of, table_rows
from sceneloom.detections.results import NO_BOX, DetectionPair, FusedBoxes
from sceneloom.detections.settings import ProjectionSettings, box_covariances, image_sigmas, tables_of
from sceneloom.errors import OptionError
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels import existence, overlaps
from sceneloom.kernels.box_fusion import AGREED, boxes_with_area, boxes_with_position
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.overlaps import box_area, common_area
from sceneloom.kernels.signatures import IN_F32_2D, IN_F64_1D, IN_F64_2D, inlined, part, tuple_of
from sceneloom.scene.detections import Boxes2D, Boxes3D, ScoreForm
from sceneloom.scene.types import PointsFrame


@lru_cache(maxsize=4096)
def says_nothing(label: str) -> bool:
    """Whether a word leaves open what it is."""
    return kind_name(label) in SAYS_NOTHING


EDGES = (0.05, 2.0)
"""Deviation of an edge of a box: this share of its side, plus so many pixels."""

_BORDER_PX = 2.0  # a box that comes so near to the border of the image may be cut there [px]
_CUT_SIGMA = 0.5  # deviation of the distance of what the image cuts at top or bottom, as a share of it

_RAYS: Float64Array = read_only(
    np.array(
        [
            [0.5, 0.0, 0.5, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0, 0.0],
            [0.0, 0.5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.5],
            [0.5, 0.0, 0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0],
            [0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.5, 0.0, 0.5],
        ]
    )
)  # from the edges of a box to five pixels: the middle, those of its top and bottom, those of its left and right


class _Placed(NamedTuple):
    """Objects in space by one image: rows of boxes along which the model has rays; positions in the lidar frame."""

    rows: Int64Array  # (P,)
    centers: Float64Array  # (P, 3) [m]
    center_covariances: Float64Array  # (P, 3, 3) [m²]
    sizes_lwh: Float64Array  # (P, 3) [m], typical of the class
    size_covariances: Float64Array  # (P, 3, 3) [m²]
    ranges: Float64Array  # (P,) [m], from the camera


def position_by_height(
    camera: Camera, camera_from_lidar: RigidTransform, corners_xyxy: Float64Array, rows: Int64Array, kinds: Int64Array
) -> _Placed:
    """Estimate where objects are whose boxes in the image are all that is known.

    Args:
        corners_xyxy: (M, 4) float64 [px], boxes of the image, corner convention, with an area.
        rows: (L,) int64, which of them are asked for.
        kinds: (M,) int64, of `detectors.table_rows`.
    """
    pixels = (corners_xyxy[rows] @ _RAYS).reshape(-1, 2) - CENTRE_TO_CORNER
    rays = unproject(camera, pixels).reshape(len(rows), 5, 3)
    rotation, translation = camera_from_lidar.rotation, camera_from_lidar.translation
    sizes, height = SIZES[kinds], float(camera.height)
    found = _positions_by_height(
        corners_xyxy, rays, rows, sizes, rotation, translation, height, _BORDER_PX, *EDGES, _CUT_SIGMA
    )
    return _Placed(*found)


_LEAST_POINTS = 5  # fewer points at one distance state nothing

_CORE_ACROSS, _CORE_UPRIGHT = (0.2, 0.8), (0.05, 0.75)
"""The part of a box that is looked at, as shares of its width and of its height from the top."""

_SURFACE = 0.25  # the share of an object's points that lies before its surface in the middle of what is seen
_SURFACE_SIGMA = 0.15  # deviation of that surface [m]
_DEEPER = 0.4  # points of an object reach so much farther in depth than the mean of its length and width [m]
_IN_BOX = 0.15  # a point so near to a box of the sweep is of it [m]

_FREEDOM = 4.0
"""Degrees of freedom of the distances that heights report: Student's distribution forgives classes that are wrong."""

_LEAST_SHARE, _MOST_NEARER = 0.35, 0.35
"""Of the points in the middle of a box at least such a share is at the object's distance, and no larger one nearer:
else it may be hidden behind something, and points report that."""

_HIDDEN = 0.15
"""If a larger share of the points is nearer than the object, its box in the image is of what is not hidden."""

_HIDDEN_SIGMA = 0.25  # deviation of the middle of such a box, as a share of its sides

_CUT_ALONG, _CUT_SHARE = 0.25, 0.3
"""Deviation of the position of what the border of the image cuts, as shares of its length (height), along the ray and
across."""

_NEAR_SHIFT = 12.0
"""The middle of what is seen of a near object of length l is off by l² / (so many times its distance)."""

_SLIM, _BODY = 1.0, 0.25
"""Of what is slimmer [m] the middle shows a person, riding or not, whose middle is this share of its width behind its
surface."""

_MIDDLE_AND_CORNERS = np.array([[0.5, 0.5], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])

_LEAST_COSINE, _WIDER = 0.2, 0.999
"""Boxes that are wider than a cone of this cosine have no cone; those of others are a little wider than the boxes."""

_ANY_ROTATION = np.linspace(0.0, np.pi / 2.0, 16)

_SIDE_SHARE = 0.12  # deviation of how wide an object appears, as a share of it


def _position_by_points(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    points_lidar: FloatArray,
    corners_xyxy: Float64Array,
    kinds: Int64Array,
    boxes: Float64Array,
    placed: _Placed,
) -> tuple[_Placed, BoolArray]:
    """Put objects that an image shows where points of the sweep (P, 3) [m] are; and which of them that did, (L,)."""
    # `corners_xyxy` (M, 4) [px] and `kinds` (M,) of the image; `boxes` (N, 7) of the sweep: centre, size, heading
    measured = np.zeros(len(placed.rows), np.bool_)
    if len(measured) == 0 or len(points_lidar) == 0:
        return placed, measured
    origin = camera_from_lidar.inverse().translation
    corners = corners_xyxy[placed.rows]
    points = _near_boxes(camera, camera_from_lidar, points_lidar, corners, origin)
    pixels, visible = project(camera, camera_from_lidar.apply(points))
    points, pixels = points[visible], pixels[visible] + CENTRE_TO_CORNER
    moved = _Placed(*(column.copy() for column in placed))  # type: ignore[arg-type]
    observations = _observations(camera, corners)
    sides = corners[:, 2:] - corners[:, :2]
    for k in range(len(corners)):
        shares = (pixels - corners[k, :2]) / sides[k]
        inside = (shares[:, 0] >= _CORE_ACROSS[0]) & (shares[:, 0] <= _CORE_ACROSS[1])
        inside &= (shares[:, 1] >= _CORE_UPRIGHT[0]) & (shares[:, 1] <= _CORE_UPRIGHT[1])
        own = points[np.flatnonzero(inside)]
        own = own[~_in_boxes(own, boxes)]
        found = _Found.of(own, origin, placed, k, SIZES[kinds[placed.rows[k]]], observations[k])
        if found is not None:
            measured[k] = True
            ray = (placed.centers[k] - origin) / placed.ranges[k]
            outer = np.outer(ray, ray)
            moved.centers[k], moved.ranges[k] = origin + found.distance * ray, found.distance
            moved.center_covariances[k] = found.across * (np.eye(3) - outer) + found.along * outer
            moved.sizes_lwh[k, 2], moved.size_covariances[k, 2, 2] = found.height
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


def _in_boxes(points: Float64Array, boxes: Float64Array) -> BoolArray:
    """Which points are of a box of the sweep."""
    apart = points[:, None] - boxes[:, :3]
    cos, sin = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    along = np.abs(cos * apart[:, :, 0] + sin * apart[:, :, 1])
    across = np.abs(cos * apart[:, :, 1] - sin * apart[:, :, 0])
    halves = boxes[:, 3:6] / 2.0 + _IN_BOX
    inside = (along <= halves[:, 0]) & (across <= halves[:, 1]) & (np.abs(apart[:, :, 2]) <= halves[:, 2])
    return np.asarray(inside.any(axis=1))


class _Visibility(NamedTuple):
    """How an image sees an object."""

    upright: float  # under which angle [rad]
    across: float  # likewise [rad]
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
        placed: _Placed,
        k: int,
        size: Float64Array,
        visibility: _Visibility,
    ) -> "_Found | None":
        ray = (placed.centers[k] - origin) / placed.ranges[k]
        by_height = float(ray @ placed.center_covariances[k] @ ray)
        depths = np.sort((points - origin) @ ray)
        reach = float(np.sqrt(size[0] * size[1])) + _DEEPER
        first, last = _most_at_once(depths, reach, float(placed.ranges[k]), by_height)
        if last - first < max(_LEAST_POINTS, _LEAST_SHARE * len(depths)) or first > _MOST_NEARER * len(depths):
            return None
        surface = float(np.quantile(depths[first:last], _SURFACE))
        behind, behind_variance = _behind(surface, size, visibility)
        distance, visibility = surface + behind, visibility._replace(is_hidden=first > _HIDDEN * len(depths))
        across = (float(np.trace(placed.center_covariances[k])) - by_height) / 2.0
        across = across * (distance / placed.ranges[k]) ** 2 + _off_ray(distance, size, visibility)
        along = _SURFACE_SIGMA**2 + behind_variance + visibility.is_cut_across * (_CUT_ALONG * float(size[0])) ** 2
        return cls(distance, along, across, _height(distance, size, visibility))


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
    """How far the middle of an object is behind what is seen of it [m], and the variance of that [m²]."""
    # a box of length l and width w that is rotated by β from the line of sight appears l sin β + w cos β wide; from its
    # middle to its surface on the line of sight it is the less of l / (2 cos β) and w / (2 sin β)
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
    """Variance of where an object is across the ray through the middle of its box in the image [m²]."""
    # the middle of what is seen is not that of the object where it is near, cut off or hidden
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


_NEAR = 0.05  # a box nearer to the camera than this holds it, and has no outline [m]

_APART = 1.5
"""Boxes whose middles are nearer to each other than this along the ray are one object and hide no other [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """Boxes of a sweep as an image shows them.

    Attributes:
        corners_xyxy: (N, 4) float64 [px], corner convention, cut at the image; zeros where it does not show them.
        shown_shares: (N,) float64, which share of a box is in the image.
        seen_shares: (N,) float64, which share of it is there and not behind a nearer one.
        axes_camera: (N, 3, 3) float64, whose columns are the boxes' axes in the camera's frame.
        corners_camera: (N, 8, 3) float64 [m], in the order of `geometry.boxes.CORNER_SIGNS`.
    """

    corners_xyxy: Float64Array
    shown_shares: Float64Array
    seen_shares: Float64Array
    axes_camera: Float64Array
    corners_camera: Float64Array


def project_outlines(
    camera: Camera, camera_from_lidar: RigidTransform, boxes: Float64Array, *, likely: Float64Array | None = None
) -> Outlines:
    """Find where an image shows the boxes of a sweep.

    Args:
        boxes: (N, 7) float64, middle, size [m] and heading [rad] in the lidar's frame; finite.
        likely: (N,) float64, how likely it is that each exists, and so hides what is behind it; None for certain.

    Raises:
        CalibrationError: the camera model is unknown.
    """
    rotation, translation = camera_from_lidar.rotation, camera_from_lidar.translation
    axes, corners, distances, gaps = _boxes_from_eye(rotation, translation, CORNER_SIGNS, boxes)
    extents, shown = box_extents(camera, corners, steps=COARSE)
    shares = shown.copy()
    _hide_covered(extents, shares, distances, gaps, np.ones(len(boxes)) if likely is None else likely, _NEAR, _APART)
    return Outlines(extents, shown, shares, axes, corners)


def differences(corners: Float64Array, outlined: Float64Array) -> Float64Array:
    """Shifts of the middles of boxes (N, 4) from those of outlines, and logarithms of the factors of their sides."""
    sides, usual = corners[:, 2:] - corners[:, :2], outlined[:, 2:] - outlined[:, :2]
    shifts = ((corners[:, :2] + corners[:, 2:]) - (outlined[:, :2] + outlined[:, 2:])) / (2.0 * usual)
    return np.concatenate([shifts, np.log(sides / usual)], axis=1)


SAME_FAMILY = 0.8
"""What a pair of boxes is worth whose classes are taken for one another, of one with the same class."""

ONE_UNKNOWN = 0.6
"""What it is worth where a class is in no table."""

SURER = 1e-3
"""Of boxes that fit equally well, the surer one is worth so much more at most."""


def pair_gains(
    outlines_xyxy: Float64Array,
    corners_xyxy: Float64Array,
    classes_3d: Int64Array,
    classes_2d: Int64Array,
    probabilities_3d: Float64Array,
    probabilities_2d: Float64Array,
    *,
    least_iou: float,
) -> Float64Array:
    """Gains (N, M) of taking a box of the sweep and one of the image for one object, 0 where they cannot be.

    A gain is (1 + GIoU) / 2, which is 1 for equal boxes, times a factor for the classes (`detectors.numbers_of`);
    boxes that overlap by less than `least_iou` gain nothing.

    Source: Rezatofighi et al. 2019, "Generalized Intersection over Union".
    """
    gains: Float64Array = overlaps.pair_gains(
        outlines_xyxy,
        corners_xyxy,
        classes_3d,
        classes_2d,
        FAMILIES,
        probabilities_3d,
        probabilities_2d,
        least_iou,
        SAME_FAMILY,
        ONE_UNKNOWN,
        SURER,
    )
    return gains


def assign(gains: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Pair rows with columns so that the sum of their (N, M) gains is the largest; pairs without gain are none.

    Returns:
        (N,) int64, the column of each row, and (M,) int64, the row of each column; NO_BOX for none.
    """
    of_rows, of_columns, rows, columns = _pair_uncontested(gains)
    if len(rows):
        table = gains[rows][:, columns]
        first, second = linear_sum_assignment(table, maximize=True)
        paired = table[first, second] > 0.0
        rows, columns = rows[first[paired]], columns[second[paired]]
        of_rows[rows], of_columns[columns] = columns, rows
    return of_rows, of_columns


def assign_pairs(rows: Int64Array, columns: Int64Array, gains: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Choose of (K,) pairs, each once, so that the sum of gains is the largest, and none shares a row or a column.

    Pairs that compete with no other are taken as they are, since SciPy's time grows with the whole table. What gains
    nothing is no pair. Gives (P,) int64 rows, rising, and their columns.
    """
    worth = gains > 0.0
    rows, columns, gains = rows[worth], columns[worth], gains[worth]
    if not len(rows):
        return rows, columns
    taken = (np.bincount(rows)[rows] == 1) & (np.bincount(columns)[columns] == 1)
    rivals = np.flatnonzero(~taken)
    if len(rivals):
        # numbered from 0 without gaps, in the same order
        first, second = (
            (np.cumsum(np.bincount(numbers) > 0) - 1)[numbers] for numbers in (rows[rivals], columns[rivals])
        )
        table = np.zeros((first.max() + 1, second.max() + 1))
        table[first, second] = gains[rivals]
        partners = np.full(len(table), -1)
        chosen, partners_of_chosen = linear_sum_assignment(table, maximize=True)
        partners[chosen] = partners_of_chosen
        taken[rivals] = partners[first] == second
    order = np.argsort(rows[taken])
    return rows[taken][order], columns[taken][order]


FARTHEST = 3.0
"""A number of the image that is more deviations than this from where it is expected has another reason."""

_STEP = 1e-3  # slopes are of lines through locations so far to either side [m]
_PROJECTION_LEAST_SHARE = 0.1  # no size shrinks below this share of what it was


def refine(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    outlines: Outlines,
    boxes: Float64Array,
    covariances: Float64Array,
    partners: Int64Array,
    corners_xyxy: Float64Array,
    sigmas: Float64Array,
) -> None:
    """Update boxes by their partners, in place.

    Args:
        boxes: (N, 7), middle in the lidar's frame, length, width, height [m] and heading [rad]; changed.
        covariances: (N, 6, 6) [m²], of middles and sizes; changed.
        partners: (N,) int64, which box of the image is the same object, NO_BOX for none.
        corners_xyxy: (M, 4) [px], boxes of the image, corner convention.
        sigmas: (N, 6), how far off partners are, of `settings.image_sigmas`.
    """
    corners, count = outlines.corners_camera, len(boxes)
    pixels = project_unbounded(camera, corners.reshape(-1, 3)).reshape(count, 8, 2)
    pixels += CENTRE_TO_CORNER
    rows, sides, shifted = _shifted_sides(
        corners, pixels, partners, corners_xyxy, float(camera.width), float(camera.height), _BORDER_PX, _STEP
    )
    _update_by_sides(
        boxes,
        covariances,
        camera_from_lidar.rotation,
        outlines.axes_camera,
        CORNER_SIGNS,
        pixels,
        rows,
        sides,
        project_unbounded(camera, shifted).reshape(len(rows), 4, 6, 2),
        _STEP,
        partners,
        corners_xyxy,
        sigmas,
        FARTHEST,
        _PROJECTION_LEAST_SHARE,
    )


_FASTEST_BACKWARDS = 3.0  # what moves faster than this moves forward [m/s]: cars leave parking locations at 1 to 2 m/s
_AGAINST = -0.5  # cosine between heading and motion from which on one of them is wrong


def orient_by_motion(yaws: Float64Array, velocities: Float64Array | None) -> Float64Array:
    """Reverse the headings (N,) [rad] of objects that would move backwards too fast by their velocities (N, 3) [m/s].

    Velocities are over ground, in the frame of the headings. Detectors of sweeps know the axis of a box better than its
    front: 2 % of PointRCNN's cars on KITTI are rotated.
    """
    if velocities is None or not len(yaws):
        return yaws
    east, north = velocities[:, 0], velocities[:, 1]
    with np.errstate(invalid="ignore"):
        speeds, along = np.hypot(east, north), east * np.cos(yaws) + north * np.sin(yaws)
        backward = (speeds > _FASTEST_BACKWARDS) & (along < _AGAINST * speeds)
        return np.where(backward, (yaws + 2.0 * np.pi) % (2.0 * np.pi) - np.pi, yaws)


DEFAULTS = ProjectionSettings()


def fuse_by_projection(pair: DetectionPair, *, settings: ProjectionSettings = DEFAULTS) -> FusedBoxes:
    """Fuse the boxes of one sweep with those of one image.

    Returns:
        The objects: those of the boxes of the sweep in their order, then those of the other boxes of the image.

    Raises:
        CalibrationError: the camera model is unknown.
        OptionError: the boxes of the sweep are not in the lidar's frame, or there are no such detectors.
        DataError: the file of the detectors is faulty.

    Source: DB34/T 4101-2022, clause 5.7 and table 10 name what is asked for; how is ours.
    """
    three, camera, camera_from_lidar = pair.boxes_3d, pair.camera, pair.camera_from_lidar
    if three.frame is not PointsFrame.SENSOR:
        raise OptionError(f"boxes in the {three.frame} frame; expected the lidar's")
    tables = tables_of(settings)
    sweep, image = _seen(pair, tables.existence)
    outlines = project_outlines(camera, camera_from_lidar, sweep.numbers, likely=sweep.likely)
    gains = pair_gains(
        outlines.corners_xyxy,
        image.numbers,
        sweep.classes,
        image.classes,
        sweep.likely,
        image.likely,
        least_iou=settings.least_iou,
    )
    partners, taken = assign(gains)
    scores = existence.scores_of_sweep(
        outlines.corners_xyxy,
        outlines.seen_shares,
        partners,
        sweep.reported,
        sweep.odds,
        image.numbers,
        image.reported,
        sweep.kinds,
        tables.existence,
    )
    covariances, of_yaws = _refined(pair, sweep, image, outlines, partners, settings)
    alone = np.flatnonzero(taken == NO_BOX) if settings.keep_camera_only else np.zeros(0, np.int64)
    placed = position_by_height(camera, camera_from_lidar, image.numbers, alone, image.kinds)
    by_points = None
    if pair.points_lidar is not None:
        believed = sweep.numbers[sweep.likely >= _BELIEVED]
        placed, measured = _position_by_points(
            camera, camera_from_lidar, pair.points_lidar, image.numbers, image.kinds, believed, placed
        )
        by_points = np.concatenate([np.zeros(len(sweep.rows), np.bool_), measured])
    others = existence.scores_of_image(placed.rows, placed.ranges, image.odds, image.kinds, tables.existence)
    count = len(placed.rows)
    sources = np.concatenate([partners, placed.rows])
    shown = np.flatnonzero(sources != NO_BOX)
    corners = np.concatenate([outlines.corners_xyxy, np.empty((count, 4))])
    corners[shown] = image.numbers[sources[shown]]
    rows_2d = np.full(len(sources), NO_BOX)
    rows_2d[shown] = image.rows[sources[shown]]
    yaws, velocities = np.concatenate([sweep.numbers[:, 6], np.zeros(count)]), three.velocities
    if velocities is not None:
        velocities = np.concatenate([velocities[sweep.rows], np.zeros((count, 3))])
    return FusedBoxes(
        timestamp_ns=three.timestamp_ns,
        centers=np.concatenate([sweep.numbers[:, :3], placed.centers]),
        center_covariances=np.concatenate([covariances[:, :3, :3], placed.center_covariances]),
        sizes_lwh=np.concatenate([sweep.numbers[:, 3:6], placed.sizes_lwh]),
        size_covariances=np.concatenate([covariances[:, 3:, 3:], placed.size_covariances]),
        yaws=orient_by_motion(yaws, velocities),
        velocities=velocities,
        scores=np.concatenate([scores, others]),
        labels=(*_labels(sweep, image, partners), *(image.labels[k] for k in placed.rows.tolist())),
        corners_xyxy=corners,
        ids=np.arange(len(sources)),
        rows_3d=np.concatenate([sweep.rows, np.full(count, NO_BOX)]),
        rows_2d=rows_2d,
        yaw_variances=np.concatenate([of_yaws, np.full(count, _ANY_YAW)]),
        degrees_of_freedom=tables.degrees_of_freedom,
        by_points=by_points,
    )


_BELIEVED = 0.3  # points in a box of the sweep that is less likely than this may be another object's
_ANY_YAW = np.pi**2 / 3.0  # variance of a heading of which nothing is known [rad²]


class _Seen(NamedTuple):
    """The boxes of one detector that have a position."""

    numbers: Float64Array  # (N, 7) of `boxes_with_position`, or (N, 4) of `boxes_with_area`
    rows: Int64Array  # (N,), which of the detector's boxes these are
    labels: Sequence[str]
    classes: Int64Array  # (N,) of `detectors.numbers_of`
    kinds: Int64Array  # (N,), rows of tables
    reported: Float64Array  # (N,), logarithms of the odds that each exists; NaN for no numbers
    odds: Float64Array  # (N,), the same as they come true of that detector
    likely: Float64Array  # (N,), as probabilities


def _seen(pair: DetectionPair, table: Float64Array) -> tuple[_Seen, _Seen]:
    three, two = pair.boxes_3d, pair.boxes_2d
    numbers_3d, rows_3d = boxes_with_position(three.centers, three.sizes_lwh, three.yaws)
    numbers_2d, rows_2d = boxes_with_area(two.corners_xyxy)
    labels_3d, labels_2d = ([b.labels[k] for k in rows.tolist()] for b, rows in ((three, rows_3d), (two, rows_2d)))
    classes_3d, classes_2d = numbers_of(labels_3d, labels_2d)

    def seen(
        boxes: Boxes3D | Boxes2D, numbers: Float64Array, rows: Int64Array, labels: Sequence[str], classes: Int64Array
    ) -> _Seen:
        kinds, is_logit = table_rows(classes), boxes.score_form is ScoreForm.LOGIT
        odds = existence.reported_odds(boxes.scores, rows, is_logit, isinstance(boxes, Boxes2D), kinds, table)
        return _Seen(numbers, rows, labels, classes, kinds, *odds)

    sweep = seen(three, numbers_3d, rows_3d, labels_3d, classes_3d)
    return sweep, seen(two, numbers_2d, rows_2d, labels_2d, classes_2d)


def _refined(
    pair: DetectionPair,
    sweep: _Seen,
    image: _Seen,
    outlines: Outlines,
    partners: Int64Array,
    settings: ProjectionSettings,
) -> tuple[Float64Array, Float64Array]:
    """Sharpen a sweep's boxes by partners; covariances (N, 6, 6) [m²], yaw variances [rad²], as reported or usual."""
    table, stated, velocities = tables_of(settings).noise, pair.boxes_3d.covariances, pair.boxes_3d.velocities
    reported = np.zeros((0, 7, 7)) if stated is None else stated
    covariances, of_yaws, own = box_covariances(sweep.numbers, sweep.reported, reported, sweep.rows, sweep.kinds, table)
    off_px = pair.camera.fx * np.radians(settings.rotation_sigma_deg)
    sigmas = image_sigmas(table, sweep.kinds, added_px=off_px)
    numbers = sweep.numbers, covariances, partners, image.numbers, sigmas
    refine(pair.camera, pair.camera_from_lidar, outlines, *numbers)
    # the update makes them as small as if both sensors erred independently; those that a detector knows stay
    widened = np.flatnonzero((partners >= 0) & ~own)
    factors = np.sqrt(np.repeat(table[sweep.kinds[widened], AGREED : AGREED + 2], 3, axis=1))
    covariances[widened] *= factors[:, :, None] * factors[:, None]
    if settings.time_sigma > 0.0 and velocities is not None:
        moved = np.where(np.isfinite(velocities), velocities, 0.0)[sweep.rows] * settings.time_sigma
        covariances[:, :3, :3] += moved[:, :, None] * moved[:, None]
    return covariances, of_yaws


def _labels(sweep: _Seen, image: _Seen, partners: Int64Array) -> list[str]:
    """The classes of the objects of a sweep: of two detectors what the surer one says, if it says anything."""
    labels = list(sweep.labels)
    for row, partner in enumerate(partners.tolist()):
        if partner == NO_BOX or image.labels[partner] == labels[row]:
            continue
        other, surer = image.labels[partner], image.odds[partner] > sweep.odds[row]
        if says_nothing(labels[row]) or (surer and not says_nothing(other)):
            labels[row] = other
    return labels


@kernel(
    tuple_of(float64[:, :, ::1], float64[:, :, ::1], float64[::1], float64[::1])(
        IN_F64_2D, IN_F64_1D, IN_F64_2D, IN_F64_2D
    )
)
def _boxes_from_eye(
    rotation: Float64Array, translation: Float64Array, signs: Float64Array, boxes: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Take upright boxes (N, 7), middle, size [m] and heading [rad], into the frame of an eye.

    Returns their axes (N, 3, 3) as columns, their corners (N, 8, 3) [m] on the sides that `signs` (8, 3) names, and how
    far middles (N,) and boxes (N,) are from the eye [m].
    """
    count = len(boxes)
    axes, corners, distances, gaps = np.empty((count, 3, 3)), np.empty((count, 8, 3)), np.empty(count), np.empty(count)
    middle = np.empty(3)
    for n in range(count):
        cosine, sine, distance, gap = np.cos(boxes[n, 6]), np.sin(boxes[n, 6]), 0.0, 0.0
        for k in range(3):
            axes[n, k, 0] = rotation[k, 0] * cosine + rotation[k, 1] * sine
            axes[n, k, 1] = rotation[k, 1] * cosine - rotation[k, 0] * sine
            axes[n, k, 2] = rotation[k, 2]
            middle[k] = translation[k]
            for i in range(3):
                middle[k] += rotation[k, i] * boxes[n, i]
            distance += middle[k] * middle[k]
        for k in range(3):
            along = axes[n, 0, k] * middle[0] + axes[n, 1, k] * middle[1] + axes[n, 2, k] * middle[2]
            gap += max(abs(along) - boxes[n, 3 + k] / 2.0, 0.0) ** 2
        for c in range(8):
            for k in range(3):
                corners[n, c, k] = middle[k]
                for i in range(3):
                    corners[n, c, k] += signs[c, i] * boxes[n, 3 + i] / 2.0 * axes[n, k, i]
        distances[n], gaps[n] = np.sqrt(distance), np.sqrt(gap)
    return axes, corners, distances, gaps


@kernel(tuple_of(int64[::1], int64[::1], int64[::1], int64[::1])(float64[:, ::1]))
def _pair_uncontested(gains: Float64Array) -> tuple[Int64Array, Int64Array, Int64Array, Int64Array]:
    """Pair rows of (N, M) gains with columns that gain with no other row, nor the rows with another column.

    Returns:
        (N,) int64, the column of each row, and (M,) int64, the row of each column; -1 for none; and the rows and the
        columns, rising, that gain something, too, and are not paired.
    """
    partners, others = np.full(gains.shape[0], -1, np.int64), np.full(gains.shape[1], -1, np.int64)
    of_rows, of_columns = np.zeros(gains.shape[0], np.int64), np.zeros(gains.shape[1], np.int64)
    for i in range(gains.shape[0]):
        for j in range(gains.shape[1]):
            if gains[i, j] > 0.0:
                of_rows[i] += 1
                of_columns[j] += 1
                partners[i], others[j] = j, i
    for i in range(gains.shape[0]):
        if of_rows[i] != 1 or of_columns[partners[i]] != 1:
            partners[i] = -1
    for j in range(gains.shape[1]):
        if of_columns[j] != 1 or of_rows[others[j]] != 1:
            others[j] = -1
    return (
        partners,
        others,
        np.flatnonzero((partners < 0) & (of_rows > 0)),
        np.flatnonzero((others < 0) & (of_columns > 0)),
    )


@kernel(
    tuple_of(int64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[:, :, ::1], float64[::1])(
        float64[:, ::1],
        float64[:, :, ::1],
        int64[::1],
        IN_F64_2D,
        IN_F64_2D,
        IN_F64_1D,
        float64,
        float64,
        float64,
        float64,
        float64,
    )
)
def _positions_by_height(
    boxes_xyxy: Float64Array, rays: Float64Array, rows: Int64Array, sizes: Float64Array, rotation: Float64Array,
    translation: Float64Array, image_height: float, border: float, edge_share: float, edge_px: float, cut_sigma: float,
) -> tuple[Int64Array, Float64Array, Float64Array, Float64Array, Float64Array, Float64Array]:  # fmt: skip
    """Estimate where objects are by how high and wide an image shows them.

    Args:
        boxes_xyxy: (M, 4) [px].
        rays: (L, 5, 3), unit, of the middle of each box that is asked for, of its top, bottom, left and right; NaN
            where the camera model has none.
        rows: (L,), which boxes these are.
        sizes: (M, 6) [m], usual length, width and height of their classes, and the deviations of those.
        rotation, translation: camera from lidar, (3, 3) and (3,) [m].
        image_height: [px]; `border` [px], what comes so near to it may be cut.
        edge_share, edge_px: deviation of an edge, as a share of its side, plus so many pixels.
        cut_sigma: deviation of the distance of what may be cut at top or bottom, as a share of it.

    Returns:
        (P,) int64, boxes along which the camera model has rays; (P, 3) [m], positions in the lidar frame, (P, 3, 3)
        [m²], their covariances; (P, 3) [m] sizes, (P, 3, 3) [m²] of them, and (P,) [m], distances from the camera.
    """
    most = len(rows)
    kept, centers, spreads = np.empty(most, np.int64), np.empty((most, 3)), np.empty((most, 3, 3))
    own, of_sizes, ranges = np.empty((most, 3)), np.zeros((most, 3, 3)), np.empty(most)
    angles, ray, count = np.empty(2), np.empty(3), 0
    for m in range(most):
        box, size, five = boxes_xyxy[rows[m]], sizes[rows[m]], rays[m]
        for pair in range(2):
            chord = 0.0
            for k in range(3):
                chord += (five[1 + 2 * pair, k] - five[2 + 2 * pair, k]) ** 2
            angles[pair] = 2.0 * np.arcsin(min(np.sqrt(chord) / 2.0, 1.0)) if np.isfinite(chord) else 0.0
        if not (np.isfinite(five).all() and angles[0] > 0.0):
            continue
        distance = size[2] / (2.0 * np.tan(min(angles[0], 3.0) / 2.0)) + size[1] / 2.0
        # variances along the ray and across, as shares of the distance squared
        upright = (edge_share + edge_px / (box[3] - box[1])) ** 2
        sideways = (edge_share + edge_px / (box[2] - box[0])) ** 2
        along = (size[5] / size[2]) ** 2 + 2.0 * upright
        if box[1] < border or box[3] > image_height - border:
            along += cut_sigma**2
        across = max(sideways * angles[1] ** 2, upright * angles[0] ** 2)
        for k in range(3):
            ray[k] = five[0, 0] * rotation[0, k] + five[0, 1] * rotation[1, k] + five[0, 2] * rotation[2, k]
            eye = translation[0] * rotation[0, k] + translation[1] * rotation[1, k] + translation[2] * rotation[2, k]
            centers[count, k] = distance * ray[k] - eye
            own[count, k], of_sizes[count, k, k] = size[k], size[3 + k] ** 2
        for k in range(3):
            for i in range(3):
                spreads[count, k, i] = distance**2 * (along - across) * (ray[k] * ray[i])
            spreads[count, k, k] += distance**2 * across
        kept[count], ranges[count] = rows[m], distance
        count += 1
    return kept[:count], centers[:count], spreads[:count], own[:count], of_sizes[:count], ranges[:count]


@part
def _find_sides(pixels, n, box, limits, border, sides, m):  # type: ignore[no-untyped-def]
    """Fill in the corners that bound a box in an image, -1 for both of a pair of sides that it may cut."""
    seen = True
    for k in range(8):
        seen = seen and np.isfinite(pixels[n, k, 0]) and np.isfinite(pixels[n, k, 1])
    for axis in range(2):
        low, high, last = 0, 0, limits[axis] - border
        for k in range(1, 8):
            low = k if pixels[n, k, axis] < pixels[n, low, axis] else low
            high = k if pixels[n, k, axis] > pixels[n, high, axis] else high
        whole = pixels[n, low, axis] >= border and pixels[n, high, axis] <= last
        whole = whole and box[axis] >= border and box[axis + 2] <= last
        found = seen and whole
        sides[m, axis], sides[m, axis + 2] = (low, high) if found else (-1, -1)


@kernel(
    "Tuple((int64[::1], int64[:,::1], float64[:,::1]))(float64[:,:,::1], float64[:,:,::1], int64[::1], "
    "float64[:,::1], float64, float64, float64, float64)"
)
def _shifted_sides(
    corners: Float64Array, pixels: Float64Array, partners: Int64Array, boxes_xyxy: Float64Array, width: float,
    height: float, border: float, step: float,
) -> tuple[Int64Array, Int64Array, Float64Array]:  # fmt: skip
    """Find the corners that bound boxes in an image, where it cuts neither them nor their partners, and move them.

    Args:
        corners: (N, 8, 3) [m].
        pixels: (N, 8, 2) [px], of the corners; NaN for those that the camera model does not see.
        partners: (N,), which box of the image is a box's partner, -1 for none.
        boxes_xyxy: (M, 4) [px], boxes of the image.
        width, height: of the image [px].
        border: what comes so near to the border may be cut there [px].
        step: how far corners are moved [m].

    Returns:
        rows: (P,) int64, the boxes with a partner; then of these
        sides: (P, 4) int64, the corners at the left, top, right and bottom; -1 for both of a pair of sides that may be
            cut, and for all four where a corner is not seen;
        shifted: (P * 4 * 6, 3) float64 [m], of each of those corners, or any for -1, the location after a move along x,
            y, z of its frame, then back along x, y, z.
    """
    rows = np.flatnonzero(partners >= 0)
    sides, shifted = np.empty((len(rows), 4), np.int64), np.empty((len(rows) * 24, 3))
    for m in range(len(rows)):
        n = rows[m]
        _find_sides(pixels, n, boxes_xyxy[partners[n]], (width, height), border, sides, m)
        for side in range(4):
            for c in range(6):
                row = (m * 4 + side) * 6 + c
                for k in range(3):
                    shifted[row, k] = corners[n, max(sides[m, side], 0), k]
                shifted[row, c % 3] += step if c < 3 else -step
    return rows, sides, shifted


@inlined
def _add_slope(shifted, step, m, side, axis, rotation, axes, n, signs, weight, row):  # type: ignore[no-untyped-def]
    """Add to a row how a side moves with the middle of its box and its sizes, (6,), times a weight."""
    for c in range(3):
        along = weight * (shifted[m, side, c, axis] - shifted[m, side, c + 3, axis]) / (2.0 * step)
        for k in range(3):
            row[k] += along * rotation[c, k]
            row[k + 3] += along * axes[n, c, k] * signs[k] / 2.0


@inlined
def _update(states, covariances, n, row, residual, variance, gain):  # type: ignore[no-untyped-def]
    """One scalar update of a state and its covariance; `gain` is room for six numbers."""
    spread = variance
    for k in range(6):
        gain[k] = 0.0
        for i in range(6):
            gain[k] += covariances[n, k, i] * row[i]
        spread += row[k] * gain[k]
    for k in range(6):
        states[n, k] += gain[k] / spread * residual
    for k in range(6):
        for i in range(k, 6):
            changed = covariances[n, k, i] - gain[k] * gain[i] / spread
            covariances[n, k, i] = changed
            covariances[n, i, k] = changed


@inlined
def _deviation(box, number, sigmas, n):  # type: ignore[no-untyped-def]
    """Deviation of a number of the image: of the middle across or upright, or of the height [px]."""
    scale = box[2] - box[0] if number == 0 else box[3] - box[1]
    return sigmas[n, 2 * number] + sigmas[n, 2 * number + 1] * scale


@kernel(
    "void(float64[:,::1], float64[:,:,::1], Array(float64, 2, 'C', readonly=True), float64[:,:,::1], "
    "Array(float64, 2, 'C', readonly=True), float64[:,:,::1], int64[::1], int64[:,::1], float64[:,:,:,::1], float64, "
    "int64[::1], float64[:,::1], float64[:,::1], float64, float64)"
)
def _update_by_sides(
    states: Float64Array, covariances: Float64Array, rotation: Float64Array, axes: Float64Array, signs: Float64Array,
    pixels: Float64Array, rows: Int64Array, sides: Int64Array, shifted: Float64Array, step: float, partners: Int64Array,
    boxes_xyxy: Float64Array, sigmas: Float64Array, farthest: float, least_share: float,
) -> None:  # fmt: skip
    """Update boxes by the middle of their partners in the image, and by the height of those.

    Each of the three numbers z = h(state) + noise is taken by itself, one after the other, with the slopes H of h where
    the box was before all of them. One that is too far from what was expected there is left out.

    Args:
        states: (N, 6 or more) [m]: middle x, y, z, length, width, height; changed.
        covariances: (N, 6, 6) [m²]; changed.
        rotation: (3, 3), from the frame of the middles into the camera's.
        axes: (N, 3, 3), whose columns are the boxes' axes in the camera's frame.
        signs: (8, 3), on which side of the middle each corner lies.
        pixels: (N, 8, 2) [px], of the corners.
        rows, sides: (P,) and (P, 4) of `_shifted_sides`.
        shifted: (P, 4, 6, 2) [px], where its corners are in the image.
        step: [m].
        partners: (N,), of `_shifted_sides`.
        boxes_xyxy: (M, 4) [px], boxes of the image.
        sigmas: (N, 6), deviations of the middle across: [px], and beside that as a share of the box's width; of the
            middle upright and of the height likewise, as shares of the height.
        farthest: a number farther off than so many deviations is left out.
        least_share: no size shrinks below this share of what it was.

    Source: Kalman 1960, "A New Approach to Linear Filtering and Prediction Problems"; one number after the other:
    Bierman 1977, "Factorization Methods for Discrete Sequential Estimation", ch. II.
    """
    slopes, residuals, taken = np.empty((3, 6)), np.empty(3), np.empty(3, np.bool_)
    gain, before, variances = np.empty(6), np.empty(6), np.empty(3)
    for m in range(len(rows)):
        n, box = rows[m], boxes_xyxy[partners[rows[m]]]
        for number in range(3):
            axis = 0 if number == 0 else 1
            first, last = sides[m, axis], sides[m, axis + 2]
            taken[number] = first >= 0
            if not taken[number]:
                continue
            of_low, of_high = (0.5, 0.5) if number < 2 else (-1.0, 1.0)
            slope = slopes[number]
            slope[:] = 0.0
            _add_slope(shifted, step, m, axis, axis, rotation, axes, n, signs[first], of_low, slope)
            _add_slope(shifted, step, m, axis + 2, axis, rotation, axes, n, signs[last], of_high, slope)
            residuals[number] = of_low * (box[axis] - pixels[n, first, axis])
            residuals[number] += of_high * (box[axis + 2] - pixels[n, last, axis])
            variances[number] = _deviation(box, number, sigmas, n) ** 2
            spread = variances[number]
            for k in range(6):
                for i in range(6):
                    spread += slope[k] * covariances[n, k, i] * slope[i]
            # false for a NaN, too
            taken[number] = residuals[number] * residuals[number] <= farthest * farthest * spread
        for k in range(6):
            before[k] = states[n, k]
        for number in range(3):
            if taken[number]:
                residual = residuals[number]
                for k in range(6):
                    residual -= slopes[number, k] * (states[n, k] - before[k])
                _update(states, covariances, n, slopes[number], residual, variances[number], gain)
        for k in range(3, 6):
            states[n, k] = max(states[n, k], least_share * before[k])


# NumPy's sort takes the compiler two seconds
@part
def _nearest_first(shown: Int64Array, distances: Float64Array) -> Int64Array:
    """Sort the numbers of boxes by their distances.

    Source: Shell 1959, with the gaps of Ciura 2001.
    """
    order = shown.copy()
    for gap in (701, 301, 132, 57, 23, 10, 4, 1):
        for k in range(gap, len(order)):
            n, i = k, order[k]
            while n >= gap and not distances[order[n - gap]] <= distances[i]:
                order[n] = order[n - gap]
                n -= gap
            order[n] = i
    return order


@kernel("void(float64[:,::1], float64[::1], float64[::1], float64[::1], float64[::1], float64, float64)")
def _hide_covered(
    boxes: Float64Array, shares: Float64Array, distances: Float64Array, gaps: Float64Array, likely: Float64Array,
    near: float, margin: float,
) -> None:  # fmt: skip
    """Subtract from the visible `shares` (N,) of `boxes` (N, 4) [px] what a nearer one is likely to cover at the most.

    Each is `distances` (N,) [m] away and begins at `gaps` (N,) [m]: nearer than `near` [m] it is around the eye, and
    becomes 0. `likely` (N,): existence probability; boxes less than `margin` [m] nearer cover nothing.
    """
    for i in range(len(boxes)):
        if gaps[i] <= near or boxes[i, 2] <= boxes[i, 0] or boxes[i, 3] <= boxes[i, 1]:
            boxes[i], shares[i] = 0.0, 0.0
    shown = np.flatnonzero((boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1]))
    order = _nearest_first(shown, distances)
    lefts, rights = boxes[order, 0], boxes[order, 2]
    nearer = 0
    for k in range(len(order)):
        i, most = order[k], 0.0
        while distances[order[nearer]] < distances[i] - margin:
            nearer += 1
        for n in range(nearer):
            if lefts[n] < boxes[i, 2] and rights[n] > boxes[i, 0]:
                j = order[n]
                most = max(most, likely[j] * common_area(boxes, i, boxes, j) / box_area(boxes, i))
        shares[i] *= 1.0 - most


@kernel(int64[::1](IN_F32_2D, IN_F64_1D, IN_F64_2D, IN_F64_1D))
def points_in_cones(points: Float32Array, apex: Float64Array, axes: Float64Array, cosines: Float64Array) -> Int64Array:
    """Choose the points that lie in any of the cones.

    `points` (N, 3) [m]; those that are not finite lie in none; `apex` (3,) [m], where all cones begin; `axes` (L, 3),
    unit, where they lead; `cosines` (L,), of the angles between their axes and their sides, above 0. Returns (M,)
    int64, rising, which points.
    """
    kept, count = np.empty(len(points), np.int64), 0
    for n in range(len(points)):
        x, y, z = points[n, 0] - apex[0], points[n, 1] - apex[1], points[n, 2] - apex[2]
        square = x * x + y * y + z * z
        for k in range(len(axes)):
            along = x * axes[k, 0] + y * axes[k, 1] + z * axes[k, 2]
            if along > 0.0 and along * along >= cosines[k] * cosines[k] * square and square < np.inf:
                kept[count] = n
                count += 1
                break
    return kept[:count]
