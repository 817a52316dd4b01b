"""The table of projection models: what each is called, what its coefficients are, where it comes from."""

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple


class Chart(StrEnum):
    """What a model's domain is a disk of, and so what the last number of `intrinsics_vector` is the radius of."""

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
        on_request: whether what is assumed is so much that a camera model is computed with only where a user asks for
            it.
        pixel_axes: of coefficients in pixels, the axis of the image that they are measured along: "u", "v",
            or "uv" in all directions.
    """

    module: str
    coefficient_names: tuple[str, ...]
    chart: Chart
    source: str
    assumed: bool = False
    on_request: bool = False
    pixel_axes: Mapping[str, str] = MappingProxyType({})


def _row(
    module: str,
    names: str,
    chart: Chart,
    source: str,
    *,
    assumed: bool = False,
    on_request: bool = False,
    pixel_axes: Mapping[str, str] = MappingProxyType({}),
) -> Model:
    """Make a row from the names of its coefficients in one line."""
    path, coefficients = f"sceneloom.cameras.{module}", tuple(names.split())
    return Model(path, coefficients, chart, source, assumed, on_request, MappingProxyType(pixel_axes))


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
            pixel_axes={"dcx": "u", "dcy": "v"},
        ),
        "ftheta": _row(
            "ftheta",
            "k1 k2 k3 k4 k5",
            Chart.ANGLE,
            "after other camera models of the name",
            assumed=True,
            on_request=True,
            pixel_axes=dict.fromkeys(("k1", "k2", "k3", "k4", "k5"), "uv"),
        ),
        "kannala_brandt18": _row(
            "kannala_brandt18",
            "k0 k1 k2 k3 l1 l2 l3 i1 i2 i3 i4 m1 m2 m3 j1 j2 j3 j4",
            Chart.ANGLE,
            "Kannala and Brandt 2006",
        ),
        "omnidir": _row(
            "omnidir", "k1 k2 s xi p1 p2", Chart.SPHERE, f"OpenCV; {_MEI}", pixel_axes={"s": "u"}
        ),
    }
)
"""The projection models by name: those of the Sensor Fusion Scene format by its names, then others."""
