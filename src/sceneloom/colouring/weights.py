"""How far the colours that an image gives to points are to be trusted."""

from dataclasses import dataclass
from math import isfinite, radians

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.colouring.results import FusedView
from sceneloom.errors import OptionError
from sceneloom.kernels.image_samples import mark_outlines, weigh_samples

_OUTLINE_CELL_DEG = 0.25
"""Points beside an outline: their gap in the image is a few scan lines at most."""
_SURFACE_DISTANCE = 1.2
"""Surfaces pass the camera at this distance or more [m], nearly all: roads at the height of the camera."""
_REACH_CELLS = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BlendSettings:
    """How the colours of several images become one.

    A colour is off by what its point falls beside its true location: by noise of the lidar, which does not depend on
        the
    distance, and by angles of mountings, which do. Both are equal at `even_distance`: 3 cm and a tenth of a degree meet
    at 17 m. With time they are off by what moves meanwhile, the ego trajectory included.

    Attributes:
        mode: "best", the colour with the greatest weight, or "weighted", the mean of all that agree with it.
        even_distance: where a weight is half of what it is nearby [m].
        even_seconds: time between point and image at which it is half [s].
        border_share: how wide the border of an image is in which weights fall, as a share of its shorter side.
        border_least: what is left of a weight at the very border.
        least_cosine: what is left of a weight where a surface is seen along itself.
        outline_factor: what is left of a weight beside the outline of something nearer or farther, where a pixel's
            colour may be that of the other.
        agreement: colours that differ from the best one by more than so many levels in a channel are left out of the
            mean: one of them is not of this surface.

    Raises:
        OptionError: a number is out of bounds, or the mode is none of these.
    """

    mode: str = "weighted"
    even_distance: float = 20.0
    even_seconds: float = 0.05
    border_share: float = 0.08
    border_least: float = 0.05
    least_cosine: float = 0.1
    outline_factor: float = 0.1
    agreement: float = 32.0

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise OptionError(f"mode {self.mode!r}; expected one of {', '.join(MODES)}")
        for name in ("even_distance", "even_seconds", "agreement"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise OptionError(f"{name} {value}; expected a finite number above 0")
        for name in ("border_share", "border_least", "least_cosine", "outline_factor"):
            value = getattr(self, name)
            if not 0 < value <= 1:
                raise OptionError(f"{name} {value}; expected more than 0 and at most 1")


MODES = ("best", "weighted")
"""How several colours become one."""


def view_weights(
    points_world: Float64Array,
    view: FusedView,
    settings: BlendSettings,
    *,
    normals_world: Float32Array | None = None,
    timestamps_ns: Int64Array | None = None,
) -> Float32Array:
    """Report how far the colours of the points in an image are to be trusted.

    Args:
        points_world: (N, 3) float64 [m], contiguous.
        view: the points in the image.
        settings: the numbers of the weights.
        normals_world: (N, 3) float32 unit vectors, 0 where not known; None: of no point.
        timestamps_ns: (N,) int64 [ns], when each point was measured; None: with the image.

    Returns:
        (M,) float32, one for each of `view.point_ids`; 0 for points that are not visible.
    """
    weights = np.empty(len(view.point_ids), np.float32)
    numbers = np.array(
        [
            settings.even_distance,
            settings.even_seconds,
            settings.border_share,
            settings.border_least,
            settings.least_cosine,
            settings.outline_factor,
        ]
    )
    weigh_samples(
        points_world,
        view.point_ids,
        view.pixels,
        view.visible,
        near_outlines(view),
        np.zeros((0, 3), np.float32) if normals_world is None else normals_world,
        np.zeros(0, np.int64) if timestamps_ns is None else timestamps_ns,
        view.world_from_camera.matrix,
        view.camera.width,
        view.camera.height,
        view.timestamp_ns,
        numbers,
        weights,
    )
    return weights


def near_outlines(view: FusedView) -> BoolArray:
    """Which points of an image lie beside an outline of something nearer or farther, (M,) bool."""
    found = np.empty(len(view.point_ids), np.bool_)
    focal_px = max(min(view.camera.fx, view.camera.fy), 1.0)
    cell_px = max(radians(_OUTLINE_CELL_DEG) * focal_px, 2.0)
    mark_outlines(
        view.pixels,
        view.depths,
        view.visible,
        view.camera.width,
        view.camera.height,
        cell_px,
        _REACH_CELLS * cell_px / focal_px / _SURFACE_DISTANCE,
        _OUTLINE_STEP,
        found,
    )
    return found


_OUTLINE_STEP = 0.3
"""What counts as a step in depth [m]."""
