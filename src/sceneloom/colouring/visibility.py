"""Which points of a sparse cloud a camera can see.

A z-buffer over the pixels removes almost nothing: points lie several pixels apart, so between two scan lines on a car
the street behind it shows through. What must be told is a gap between the samples of one surface from a gap between
two surfaces. The rule here rests on two facts.

**Inverse range is tame on a surface.** A plane at distance d from the camera, seen in the unit direction u, lies at
range ρ with 1/ρ = n·u / d. Between two directions an angle α apart, 1/ρ therefore changes by at most α/d, however
grazing the view. So a point Q can only hide a point P, α away, if

    1/ρ_Q - 1/ρ_P  >  α / surface_distance  +  m,      m = margin / ρ_P² + margin_share / ρ_P

where m is what Q must be nearer (in metres and as a share of the range, for noise and calibration). No surface whose
plane is at least `surface_distance` away from the camera hides itself: not the road seen at grazing angle, not the wall
along it.

**Hidden points lie within silhouettes.** P is hidden if such a Q is very near in direction (`near_deg`: less than the
samples of any surface are apart), or if two of them lie in opposite quadrants around P within a window. Q on one side
only is a neighbour beyond a silhouette: P is the background beside it and stays. The window must reach from scan line
to scan line; since lidars differ, and mountings turn and tilt them, it is measured from the cloud.

Directions are compared in Lambert's equal-area map around the optical axis, in which distances are nearly angles. The
rule therefore holds for every lens and resolution alike. To be fast, only the nearest point in each cell of a grid over
that map can hide others; cells are a quarter of the window, but at least `near_deg`, in size.
"""

from dataclasses import dataclass, fields
from math import isfinite, isnan, radians

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.errors import OptionError
from sceneloom.kernels.directions import map_directions
from sceneloom.kernels.occlusion import mark_unhidden
from sceneloom.kernels.spacing import measure_spacing

_USUAL_WINDOW_DEG = 0.5
_WINDOWS_DEG = (0.3, 2.5)
_WINDOW_PER_SPACING = 1.15
_CELLS_PER_WINDOW = 4
_MINIMUM_CELL = 1e-3
_SPACING_CELL = radians(0.1)
_SPACING_REACH = 25
_SPACING_SAMPLES = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilitySettings:
    """What counts as hidden behind a nearer surface.

    Attributes:
        enabled: False leaves a plain z-buffer over the pixels.
        window_deg: how far things on opposite sides of a point may be from it to hide it [deg]; None for 1.15 times
            the spacing of the scan lines, measured from the cloud, between 0.3 and 2.5.
        near_deg: within this one thing alone hides a point [deg].
        surface_distance: surfaces whose plane passes the camera farther away than this never hide themselves [m].
        margin: how much nearer than a point something must be to hide it [m] …
        margin_share: … plus this share of the point's range.

    Raises:
        OptionError: a number is negative, not finite, or 0 where it must not be.
    """

    enabled: bool = True
    window_deg: float | None = None
    near_deg: float = 0.16
    surface_distance: float = 1.2
    margin: float = 0.15
    margin_share: float = 0.01

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self) if field.name != "enabled"):
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value >= 0):
                raise OptionError(f"{name} {value}; expected a finite number that is not negative")
        if self.surface_distance == 0:
            raise OptionError("surface_distance 0; expected a positive distance in metres")
        if self.window_deg is not None and not 0 < self.window_deg <= 45:
            raise OptionError(f"window_deg {self.window_deg}; expected more than 0 and at most 45")


def find_visible(
    points_world: Float64Array,
    point_ids: Int64Array,
    camera_from_world: Float64Array,
    settings: VisibilitySettings,
) -> BoolArray:
    """Tell which of some points the camera sees, as far as these points themselves can say.

    Args:
        points_world: (N, 3) float64 [m], contiguous.
        point_ids: (M,) int64, those that fall into the picture; only they hide one another.
        camera_from_world: (3, 4) or (4, 4) float64, contiguous.
        settings: the rule's numbers; `enabled` is not looked at.

    Returns:
        (M,) bool.
    """
    directions = np.empty((2, len(point_ids)), np.float32)
    inverse_ranges = np.empty(len(point_ids), np.float32)
    visible = np.empty(len(point_ids), np.bool_)
    map_directions(points_world, point_ids, camera_from_world, directions, inverse_ranges)
    window = _window(directions, inverse_ranges, settings)
    near = min(radians(settings.near_deg), window)
    mark_unhidden(
        directions,
        inverse_ranges,
        max(window / _CELLS_PER_WINDOW, near, _MINIMUM_CELL),
        window,
        near,
        1.0 / settings.surface_distance,
        settings.margin,
        settings.margin_share,
        visible,
    )
    return visible


def _window(directions: Float32Array, inverse_ranges: Float32Array, settings: VisibilitySettings) -> float:
    """Give half the size of the window [rad]: the settings' or one that fits the cloud's scan lines."""
    if settings.window_deg is not None:
        return radians(settings.window_deg)
    spacing = measure_spacing(directions, inverse_ranges, _SPACING_CELL, _SPACING_REACH, _SPACING_SAMPLES)
    if isnan(spacing):
        return radians(_USUAL_WINDOW_DEG)
    least, most = _WINDOWS_DEG
    return min(max(_WINDOW_PER_SPACING * spacing, radians(least)), radians(most))
