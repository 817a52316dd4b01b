"""The table of projection models, and projecting and unprojecting with whichever a camera has."""

from collections.abc import Callable, Mapping
from enum import StrEnum
from functools import lru_cache
from importlib import import_module
from types import MappingProxyType
from typing import NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, CalibrationError


class Chart(StrEnum):
    """What a model's domain is a disk of, and so what the last number of `lens_vector` is the radius of."""

    PERSPECTIVE = "perspective"
    """The plane z = 1."""
    ANGLE = "angle"
    """The angle off the axis [rad]."""
    SPHERE = "sphere"
    """The plane on which a shifted unit sphere is seen."""
    PANORAMA = "panorama"
    """The angle to each side [rad]; all directions but straight up and down."""


class Model(NamedTuple):
    """A row of the table of models.

    Attributes:
        module: where the model is; imported on first use, since it loads the compiler.
        coefficient_names: what the coefficients are called, in order.
        chart: what the domain is a disk of.
        source: where the formula comes from.
        assumed: whether no source confirms the formula.
        on_request: whether what is assumed is so much that a lens is computed with only where a user asks for it.
    """

    module: str
    coefficient_names: tuple[str, ...]
    chart: Chart
    source: str
    assumed: bool = False
    on_request: bool = False


def _row(
    module: str, names: str, chart: Chart, source: str, *, assumed: bool = False, on_request: bool = False
) -> Model:
    return Model(f"sceneloom.cameras.{module}", tuple(names.split()), chart, source, assumed, on_request)


_MEI = "Mei and Rives 2007"
_SFS = "Sensor Fusion Scene's own library"

MODELS: Mapping[str, Model] = MappingProxyType(
    {
        "pinhole": _row("pinhole", "", Chart.PERSPECTIVE, "Hartley and Zisserman 2004"),
        "brown_conrady": _row(
            "brown_conrady",
            "k1 k2 p1 p2 k3 k4 k5 k6 lx ly s1 s2 s3 s4 tx ty",
            Chart.PERSPECTIVE,
            "OpenCV",
        ),
        "fisheye": _row("fisheye", "k1 k2 k3 k4", Chart.ANGLE, "OpenCV; Kannala and Brandt 2006"),
        "mod_equi_fish": _row("mod_equi_fish", "k1 k2 k3 k4", Chart.ANGLE, _SFS),
        "mod_kannala": _row("mod_kannala", "k1 k2 k3 k4", Chart.ANGLE, _SFS),
        "cylindrical": _row(
            "cylindrical", "", Chart.PANORAMA, "the usual cylindrical panorama", assumed=True
        ),
        "equirectangular": _row(
            "equirectangular", "", Chart.PANORAMA, "the usual equirectangular panorama", assumed=True
        ),
        "omnidirectional": _row("omnidirectional", "k1 k2 k3 k4 p1 p2 xi lx ly", Chart.SPHERE, _MEI),
        "fisheye_rad_tan_prism": _row(
            "fisheye_rad_tan_prism",
            "k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4",
            Chart.ANGLE,
            "Project Aria, Fisheye624",
        ),
        "fisheye_radial_custom": _row(
            "fisheye_radial_custom",
            "k1 k2 k3 k4 k5 k6 p1 p2 dcx dcy",
            Chart.ANGLE,
            "after the models beside it",
            assumed=True,
            on_request=True,
        ),
        "ftheta": _row(
            "ftheta",
            "k1 k2 k3 k4 k5",
            Chart.ANGLE,
            "after other lenses of the name",
            assumed=True,
            on_request=True,
        ),
        "kannala_brandt18": _row(
            "kannala_brandt18",
            "k0 k1 k2 k3 l1 l2 l3 i1 i2 i3 i4 m1 m2 m3 j1 j2 j3 j4",
            Chart.ANGLE,
            "Kannala and Brandt 2006",
        ),
        "omnidir": _row("omnidir", "k1 k2 s xi p1 p2", Chart.SPHERE, f"OpenCV; {_MEI}"),
    }
)
"""The projection models by name: those of the Sensor Fusion Scene format by its names, then others."""

_LARGEST_COEFFICIENT = 1e12

ProjectionKernel = Callable[
    [Float64Array, Float64Array, Float64Array, int, int, Int64Array, Float32Array, Float32Array], int
]


class ModelModule(Protocol):
    """What the module of a model offers; `compiled` describes the functions."""

    project_into_picture: ProjectionKernel
    project_points: Callable[[Float64Array, Float64Array, Float64Array], None]
    unproject_pixels: Callable[[Float64Array, Float64Array, Float64Array], None]
    domain_limit: Callable[[tuple[float, ...]], float]


def _model(name: str) -> Model:
    if name not in MODELS:
        raise CalibrationError(f"camera model {name!r}; expected one of {', '.join(MODELS)}")
    return MODELS[name]


def _module(name: str) -> ModelModule:
    return cast("ModelModule", import_module(_model(name).module))


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


def projection_kernel(model: str) -> ProjectionKernel:
    """Give the compiled function that picks the points which fall into a picture; for tight loops.

    It is called with `points_world` (N, 3) float64 [m], `camera_from_world` (3, 4) float64,
    `lens_vector(camera)`, width and height [px], and three arrays with room for N points, which it fills:
    `point_ids` int64, `pixels` (N, 2) float32 [px], `depths` float32, z in the camera frame [m]. It returns
    how many points it kept; ids ascend. All arrays are C-contiguous. Points with a NaN are never kept.

    Raises:
        CalibrationError: there is no such model.
    """
    return _module(model).project_into_picture


@lru_cache(maxsize=256)
def lens_vector(camera: Camera) -> Float64Array:
    """Give the numbers of a lens as the compiled functions take them.

    Returns:
        Read-only float64: fx, fy, cx, cy, all coefficients of the model with zeros for those not given, and
        the limit of its domain, in the model's `Chart`.

    Raises:
        CalibrationError: the model is unknown or the coefficients are too many.
    """
    check_camera(camera)
    missing = len(MODELS[camera.model].coefficient_names) - len(camera.coefficients)
    coefficients = (*camera.coefficients, *(0.0,) * missing)
    limit = _module(camera.model).domain_limit(coefficients)
    return read_only((camera.fx, camera.fy, camera.cx, camera.cy, *coefficients, limit), np.float64)


def project_unbounded(camera: Camera, points_camera: ArrayLike) -> Float64Array:
    """Project points onto the plane of the picture, inside the picture or not.

    Args:
        camera: the lens.
        points_camera: (N, 3) float [m], camera frame.

    Returns:
        (N, 2) float64 [px]; NaN for points that are not finite, behind the camera or out of the domain.

    Raises:
        ArrayError: `points_camera` is not (N, 3).
        CalibrationError: the model is unknown or the coefficients are too many.
    """
    points = _rows("points_camera", points_camera, 3)
    pixels = np.empty((len(points), 2))
    _module(camera.model).project_points(points, lens_vector(camera), pixels)
    pixels[~np.isfinite(points).all(axis=1)] = np.nan
    return pixels


def project_beyond_domain(model: str, numbers: ArrayLike, points_camera: ArrayLike) -> Float64Array:
    """Project with the bare formulas of a model, beyond folds too: for those who search for a lens's numbers.

    Args:
        model: a name out of `MODELS`.
        numbers: fx, fy, cx, cy and all coefficients of the model.
        points_camera: (N, 3) float [m], camera frame, finite.

    Returns:
        (N, 2) float64 [px]; NaN for points that no lens of this model sees.
    """
    points = _rows("points_camera", points_camera, 3)
    pixels = np.empty((len(points), 2))
    _module(model).project_points(points, read_only((*np.asarray(numbers), np.inf), np.float64), pixels)
    return pixels


def project(camera: Camera, points_camera: ArrayLike) -> tuple[Float64Array, BoolArray]:
    """Project points into the picture.

    Args:
        camera: the lens.
        points_camera: (N, 3) float [m], camera frame.

    Returns:
        pixels: (N, 2) float64 [px]; NaN where not `visible`.
        visible: (N,) bool, in front of the camera, inside the model's domain and inside the picture, whose
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
        camera: the lens.
        pixels: (N, 2) float [px], inside the picture or not.

    Returns:
        (N, 3) float64, unit rays in the camera frame; NaN where no point of the model's domain has that
        pixel.

    Raises:
        ArrayError: `pixels` is not (N, 2).
        CalibrationError: the model is unknown or the coefficients are too many.
    """
    places = _rows("pixels", pixels, 2)
    rays = np.empty((len(places), 3))
    _module(camera.model).unproject_pixels(places, lens_vector(camera), rays)
    return rays


def _rows(name: str, values: ArrayLike, columns: int) -> Float64Array:
    rows = np.ascontiguousarray(values, np.float64)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise ArrayError(f"{name}: {rows.shape}; expected (N, {columns})")
    return rows
