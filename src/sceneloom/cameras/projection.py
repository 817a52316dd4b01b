"""Projection and unprojection with whichever model a camera has."""

import math
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, read_only
from sceneloom.cameras.camera import MODELS, Camera, Chart, Model
from sceneloom.errors import ArrayError, CalibrationError


class PointsInImage(NamedTuple):
    """Room for the points of a cloud that fall into an image, as many rows as the cloud has points.

    Attributes:
        point_ids: (N,) int64, ascending.
        pixels: (N, 2) float32 [px].
        pixel_numbers: (N,) int32, the nearest pixel, counted row by row.
        depths: (N,) float32, z in the camera frame [m].
        rightward, downward: (N,) float32, direction in the equal-area map of `kernels.directions`.
        inverse_ranges: (N,) float32 [1/m], 0 for a point so near or so far that it has no direction.
    """

    point_ids: Int64Array
    pixels: Float32Array
    pixel_numbers: Int32Array
    depths: Float32Array
    rightward: Float32Array
    downward: Float32Array
    inverse_ranges: Float32Array

    @classmethod
    def room(cls, count: int) -> "PointsInImage":
        """Make room for so many points."""
        ids, pixels = np.empty(count, np.int64), np.empty((count, 2), np.float32)
        # arrays of their own: what keeps one of them shall not hold the others
        return cls(ids, pixels, np.empty(count, np.int32), *(np.empty(count, np.float32) for _ in range(4)))

    def part(self, start: int, stop: int) -> "PointsInImage":
        """Give some rows of all."""
        return PointsInImage._make(rows[start:stop] for rows in self)


_LARGEST_COEFFICIENT = 1e12
_ProjectionKernel = Callable[[Float64Array, Float64Array, Float64Array, int, int, PointsInImage], int]


class CompiledModel(NamedTuple):
    """The functions of a camera model; where they take a camera, it is its `intrinsics_vector`.

    Attributes:
        project_into_image: as `projection_kernel` describes it.
        project_points: takes points_camera (N, 3), the camera and pixels (N, 2), which it writes; NaN outside the
            domain.
        unproject_pixels: takes pixels (N, 2), the camera and unit rays (N, 3), which it writes; NaN where there
            is none.
        domain_limit: computes the limit of the domain from all coefficients.
    """

    project_into_image: _ProjectionKernel
    project_points: Callable[[Float64Array, Float64Array, Float64Array], None]
    unproject_pixels: Callable[[Float64Array, Float64Array, Float64Array], None]
    domain_limit: Callable[[tuple[float, ...]], float]


def _model(name: str) -> Model:
    if name not in MODELS:
        raise CalibrationError(f"camera model {name!r}; expected one of {', '.join(MODELS)}")
    return MODELS[name]


@lru_cache(maxsize=64)
def _compiled(name: str) -> CompiledModel:
    return cast("CompiledModel", getattr(import_module(_model(name).module), name.upper()))


def check_camera(camera: Camera) -> None:
    """Check that the table knows the camera's model, and that its coefficients are not too many or too large.

    Raises:
        CalibrationError: naming the known models, or the coefficients that the model has.
    """
    names = _model(camera.model).coefficient_names
    if len(camera.coefficients) > len(names):
        raise CalibrationError(
            f"{len(camera.coefficients)} distortion coefficients; "
            f"{camera.model} has {len(names)}{': ' if names else ''}{' '.join(names)}"
        )
    if any(abs(value) > _LARGEST_COEFFICIENT for value in camera.coefficients):
        raise CalibrationError(
            f"distortion coefficients {camera.coefficients}; expected no more than {_LARGEST_COEFFICIENT:g}"
        )


def projection_kernel(model: str) -> _ProjectionKernel:
    """Give the compiled function that picks the points which fall into an image; for tight loops.

    It is called with `points_world` (N, 3) float64 [m], `camera_from_world` (3, 4) float64,
    `intrinsics_vector(camera)`, width and height [px], and `PointsInImage` with room for N points, which it fills.
    It returns how many points it kept; in rows beyond these anything may stand. All arrays are C-contiguous.
    Points with a NaN are never kept.

    Raises:
        CalibrationError: there is no such model.
    """
    return _compiled(model).project_into_image


@lru_cache(maxsize=256)
def intrinsics_vector(camera: Camera) -> Float64Array:
    """Give the numbers of a camera model as the compiled functions take them.

    Returns:
        Read-only float64: fx, fy, cx, cy, all coefficients of the model with zeros for those not given, and
        the limit of its domain, in the model's `Chart`.

    Raises:
        CalibrationError: the model is unknown or the coefficients are too many.
    """
    check_camera(camera)
    missing = len(MODELS[camera.model].coefficient_names) - len(camera.coefficients)
    coefficients = (*camera.coefficients, *(0.0,) * missing)
    limit = _compiled(camera.model).domain_limit(coefficients)
    return read_only((camera.fx, camera.fy, camera.cx, camera.cy, *coefficients, limit), np.float64)


def domain_angle(camera: Camera) -> float:
    """Give the angle off the axis [rad] within which a camera model has a pixel for every direction, π at most.

    A panorama has one for all directions but straight up and down; its angle is π. An `ftheta` camera model whose k1 is
    not 0 has none right ahead.

    Raises:
        CalibrationError: the model is unknown or the coefficients are too many.
    """
    limit = float(intrinsics_vector(camera)[-1])
    match MODELS[camera.model].chart:
        case Chart.PERSPECTIVE:
            return math.atan(limit)
        case Chart.SPHERE:
            names = MODELS[camera.model].coefficient_names
            return _angle_on_sphere(limit, dict(zip(names, camera.coefficients, strict=False)).get("xi", 0.0))
        case _:
            return limit


def _angle_on_sphere(limit: float, xi: float) -> float:
    """The angle off the axis of a location on the plane of the sphere that is seen from xi behind its centre."""
    if math.isinf(limit):
        return math.acos(-min(xi, 1.0))
    scale = (xi + math.sqrt(max(0.0, 1.0 + (1.0 - xi * xi) * limit * limit))) / (1.0 + limit * limit)
    return math.atan2(scale * limit, scale - xi) if limit > 0.0 else 0.0


def project_unbounded(camera: Camera, points_camera: ArrayLike) -> Float64Array:
    """Project points onto the plane of the image, inside the image or not.

    Args:
        camera: the camera model.
        points_camera: (N, 3) float [m], camera frame.

    Returns:
        (N, 2) float64 [px]; NaN for points that are not finite, behind the camera or out of the domain.

    Raises:
        ArrayError: `points_camera` is not (N, 3).
        CalibrationError: the model is unknown or the coefficients are too many.
    """
    points = _rows("points_camera", points_camera, 3)
    pixels = np.empty((len(points), 2))
    _compiled(camera.model).project_points(points, intrinsics_vector(camera), pixels)
    return pixels


def project_beyond_domain(model: str, numbers: ArrayLike, points_camera: ArrayLike) -> Float64Array:
    """Project with the bare formulas of a model, beyond folds too: for those who search for a camera model's numbers.

    Args:
        model: a name out of `MODELS`.
        numbers: fx, fy, cx, cy and all coefficients of the model.
        points_camera: (N, 3) float [m], camera frame, finite.

    Returns:
        (N, 2) float64 [px]; NaN for points that no camera model of this model sees.
    """
    points = _rows("points_camera", points_camera, 3)
    pixels = np.empty((len(points), 2))
    _compiled(model).project_points(points, read_only((*np.asarray(numbers), np.inf), np.float64), pixels)
    return pixels


def project(camera: Camera, points_camera: ArrayLike) -> tuple[Float64Array, BoolArray]:
    """Project points into the image.

    Args:
        camera: the camera model.
        points_camera: (N, 3) float [m], camera frame.

    Returns:
        pixels: (N, 2) float64 [px]; NaN where not `visible`.
        visible: (N,) bool, in front of the camera, inside the model's domain and inside the image, whose
            edges are at -0.5 (inclusive) and width - 0.5 (exclusive), likewise for the height.

    Raises:
        ArrayError: `points_camera` is not (N, 3).
        CalibrationError: the model is unknown or the coefficients are too many.
    """
    pixels = project_unbounded(camera, points_camera)
    size = np.array([camera.width, camera.height])
    visible: BoolArray = np.all((pixels >= -0.5) & (pixels < size - 0.5), axis=1)
    pixels[~visible] = np.nan
    return pixels, visible


def unproject(camera: Camera, pixels: ArrayLike) -> Float64Array:
    """Give the directions that pixels look into; the inverse of `project_unbounded`.

    Args:
        camera: the camera model.
        pixels: (N, 2) float [px], inside the image or not.

    Returns:
        (N, 3) float64, unit rays in the camera frame; NaN where no point of the model's domain has that
        pixel.

    Raises:
        ArrayError: `pixels` is not (N, 2).
        CalibrationError: the model is unknown or the coefficients are too many.
    """
    locations = _rows("pixels", pixels, 2)
    rays = np.empty((len(locations), 3))
    _compiled(camera.model).unproject_pixels(locations, intrinsics_vector(camera), rays)
    return rays


def _rows(name: str, values: ArrayLike, columns: int) -> Float64Array:
    rows = np.ascontiguousarray(values, np.float64)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise ArrayError(f"{name}: {rows.shape}; expected (N, {columns})")
    return rows
