"""What the images of clouds share: which points are drawn in which colours, and how far out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, UInt8Array, check_array
from sceneloom.errors import ArrayError, OptionError
from sceneloom.images.canvas import count_text, leave_out
from sceneloom.images.depth_scale import round_up
from sceneloom.images.ego import EgoPosition

UNSEEN = 255
"""`camera_index` of a point that no camera saw."""
_DARKEST_GREY, _LIGHTEST_GREY = 78.0, 138.0
_LIFT, _LIFT_POWER = 24.0, 0.8
_GREY_TINT = np.array([0.93, 0.98, 1.06])
_HEIGHT_ENDS_PERCENT = (2.0, 96.0)
_NEAREST_REACH = 2.0
_LEAST_SIZE_PX = (320, 240)
_MOST_SAMPLES = 200_000
"""Bounds the work for an ego path of any length."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnCloud:
    """The finite points of a cloud with the colours that they are drawn in.

    Attributes:
        points_world: (N, 3) float64 [m].
        colours: (N, 3) uint8.
        seen: how many of them a camera coloured.
        left_out: how many more points are not finite.
    """

    points_world: Float64Array
    colours: UInt8Array
    seen: int
    left_out: int = 0


def drawn_cloud(
    points_world: FloatArray, colors: UInt8Array | None, camera_index: UInt8Array | None
) -> DrawnCloud:
    """Give seen points their colours, and points that no camera saw a grey that grows lighter with height.

    Args:
        points_world: (N, 3) float [m]; rows that are not finite are left out.
        colors: (N, 3) uint8, or None where no point has a colour.
        camera_index: (N,) uint8, 255 for a point that no camera saw; None where all of `colors` hold.

    Raises:
        ArrayError: the arrays do not fit together.
    """
    if points_world.ndim != 2 or points_world.shape[1] != 3:
        raise ArrayError(f"points_world: {points_world.shape}; expected (N, 3)")
    check_array("colors", colors, (len(points_world), 3), np.uint8, optional=True)
    check_array("camera_index", camera_index, (len(points_world),), np.uint8, optional=True)
    finite = np.isfinite(points_world).all(axis=1)
    left_out = int(np.count_nonzero(~finite))
    leave_out("points", left_out)
    points = points_world[finite].astype(np.float64)
    seen = np.full(len(points), colors is not None)
    if camera_index is not None:
        seen &= camera_index[finite] != UNSEEN
    drawn = height_greys(points[:, 2])
    if colors is not None:
        drawn[seen] = lifted(colors[finite][seen])
    return DrawnCloud(points, drawn, int(seen.sum()), left_out)


def lifted(colors: UInt8Array) -> UInt8Array:
    """Make colours a little lighter, the dark ones most, so that black cars stand out from a dark ground."""
    return np.asarray(np.rint(_LIFT + (255.0 - _LIFT) * (colors / 255.0) ** _LIFT_POWER), np.uint8)


def height_greys(heights: Float64Array) -> UInt8Array:
    """Give (N, 3) muted greys, the lighter the higher, for (N,) heights [m]."""
    if len(heights) == 0:
        return np.zeros((0, 3), np.uint8)
    lowest, highest = np.percentile(heights, _HEIGHT_ENDS_PERCENT)
    share = np.clip((heights - lowest) / max(highest - lowest, 0.1), 0.0, 1.0)
    greys = _DARKEST_GREY + share * (_LIGHTEST_GREY - _DARKEST_GREY)
    return np.asarray(greys[:, None] * _GREY_TINT, np.uint8)


def choose_reach(
    asked: float | None,
    points_world: Float64Array,
    location: EgoPosition,
    *,
    percent: float,
    farthest: float,
    aspect: float = 1.0,
) -> float:
    """Give the distance [m] that was asked for, or a round one from the ego that holds most points.

    Args:
        asked: what the caller wants, or None.
        percent: share of the points that the chosen distance holds.
        farthest: the largest distance that is chosen [m].
        aspect: how much farther the points may be along x of the world than along y.

    Raises:
        OptionError: the distance asked for is not positive and finite.
    """
    if asked is not None:
        if not 0.0 < asked < float("inf"):
            raise OptionError(f"reach {asked} m; expected a positive length")
        return asked
    if len(points_world) == 0:
        return farthest
    offsets = np.abs(points_world[:, :2] - location.position_world[:2]) / (aspect, 1.0)
    reach = float(np.percentile(offsets.max(axis=1), percent))
    return farthest if reach >= farthest else round_up(max(reach, _NEAREST_REACH))


def check_size(size_px: tuple[int, int]) -> None:
    """Refuse an image too small for its labels.

    Raises:
        OptionError: it is smaller than 320x240.
    """
    if size_px[0] < _LEAST_SIZE_PX[0] or size_px[1] < _LEAST_SIZE_PX[1]:
        least = "x".join(str(length) for length in _LEAST_SIZE_PX)
        raise OptionError(f"image of {size_px[0]}x{size_px[1]} px; expected at least {least}")


_HUGE = 1e100
"""Squares of larger numbers need not be finite."""


def sample_polyline(corners: FloatArray, step: float) -> Float64Array:
    """Give points along a line through (K, D) corners, at most `step` apart; corners not finite are left out."""
    known = corners[np.isfinite(corners).all(axis=1)].astype(np.float64)
    if len(known) < 2:
        return known
    largest = float(np.abs(known).max())
    unit = largest if largest > _HUGE else 1.0
    known /= unit
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(known, axis=0), axis=1))])
    with np.errstate(over="ignore"):
        count = int(min(np.ceil(lengths[-1] / step * unit) + 1, _MOST_SAMPLES))
    at = np.linspace(0.0, lengths[-1], max(count, 2))
    return np.column_stack([np.interp(at, lengths, column) for column in known.T]) * unit


def cloud_caption(lines: Sequence[str], cloud: DrawnCloud) -> list[str]:
    """Give the caption's title and what the cloud holds."""
    count = len(cloud.points_world)
    share = f"{100.0 * cloud.seen / count:.0f} % coloured, the others grey" if cloud.seen else "none coloured"
    held = f"{count_text(count, 'point')}, {share}" if count else "no points"
    return [*lines, held + (f"; {cloud.left_out:,} not finite" if cloud.left_out else "")][:2]
