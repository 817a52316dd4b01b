"""Lidars whose scan lines lie close together in one part of their view and far apart in another.

Many have lines a sixth of a degree apart in the middle and a degree or more above and below; rosettes are dense in the
middle. A reach for all of them would be too short for the sparse part, behind which everything shows through, or too
long for the dense one. How far a surface may go on beyond its last sample is a matter of the lines that hit it, so each
point hides with the reach of its own part of the lidar's view. There, spacings do not depend on what stands where: seen
from the camera the lines on a near thing lie between those on things far behind it.
"""

from dataclasses import dataclass
from math import cos, log, pi, radians, sin

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.colouring.scan_lines import SPARSEST, Neighbours, ScanLines, look_around
from sceneloom.kernels.spacing import measure_across

_UNEVEN = 2.5
"""How many times as far apart sparse neighbours are as dense ones. Where all lines lie alike, what stands before what
and the bending of a fisheye make that up to 2.1; lidars as above have 4.1 and more (simulated streets, PandaSet)."""
_DENSE, _SPARSE = 15.0, 93.0
_FEWEST = 64
_SPARSER_THAN = 1.5

_SAMPLES = 2048
_TILE_ACROSS, _TILE_ALONG = radians(1.0), radians(8.0)
_LEAST_IN_TILE = 2
_LEAST_KNOWN = 5
_STEP = log(2.0)
_LEAST_SHARE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Points whose scan lines lie alike.

    Attributes:
        lines: how.
        members: (M,) bool.
    """

    lines: ScanLines
    members: BoolArray


def are_uneven(neighbours: Neighbours) -> bool:
    """Report whether the lines around some points lie so differently that one reach does not fit all."""
    spacings = _around(neighbours)
    spacings.sort()
    known = spacings[: int(spacings.searchsorted(np.inf))]
    if len(known) < _FEWEST:
        return False
    return _percentile(known, _SPARSE) > _UNEVEN * _percentile(known, _DENSE)


def split_by_spacing(directions: Float32Array, inverse_ranges: Float32Array, lines: ScanLines) -> list[Part]:
    """Split a cloud by how far apart its scan lines are where its points lie.

    Args:
        directions: (2, M) float32 [rad], where the lidar saw the points, in the equal-area map.
        inverse_ranges: (M,) float32 [1/m]; 0 for a point that takes no part.
        lines: of the cloud as a whole, in case that too few points report how its sparse lines lie.

    Returns:
        Parts in which spacings are alike within a factor of two; less than a hundredth of the points makes no part.
    """
    neighbours = look_around(directions, inverse_ranges, samples=_SAMPLES)
    of_samples = _around(neighbours)
    lines = _sparse_lines(neighbours, of_samples, lines)
    tiles, columns = _tiles(directions, lines.angle)
    spacings = _spread(of_samples, tiles[neighbours.points], int(tiles.max()) // columns + 1, columns)
    # Tiles are few beside points: all is decided for them, each as often as it has points.
    counts = np.bincount(tiles, minlength=len(spacings))
    steps = np.rint(np.log(spacings / _median(spacings, counts)) / _STEP).astype(np.int64)
    parts = []
    for step in _filled(steps, counts):
        inside = steps == step
        across = _median(spacings[inside], counts[inside])
        parts.append(Part(ScanLines(across, lines.along, lines.angle), inside[tiles]))
    return parts


def _percentile(ordered: Float64Array, share: float) -> float:
    """Give the value below which so many per cent lie, linearly between two."""
    location = share / 100 * (len(ordered) - 1)
    below = int(location)
    above = min(below + 1, len(ordered) - 1)
    least, most = float(ordered[below]), float(ordered[above])
    return least + (location - below) * (most - least)


def _median(values: Float64Array, counts: Int64Array) -> float:
    """Give the median of values each of which is there so many times."""
    order = np.argsort(values)
    behind = np.cumsum(counts[order])
    middle = np.searchsorted(behind, [(behind[-1] - 1) // 2, behind[-1] // 2], side="right")
    return float(values[order][middle].mean())


def _sparse_lines(neighbours: Neighbours, spacings: Float64Array, lines: ScanLines) -> ScanLines:
    """Report how lines lie from where they are far apart: dense ones look much the same across and along."""
    known = spacings[np.isfinite(spacings)]
    sparse = spacings > _SPARSER_THAN * (np.median(known) if len(known) else np.inf)
    if np.count_nonzero(sparse) < _FEWEST:
        return lines
    found = neighbours.distances[sparse]
    distances = np.where(np.isnan(found), SPARSEST, found)
    half = distances.shape[1] // 2
    axes = np.median(np.concatenate([distances[:, :half], distances[:, half:]]), axis=0)
    along = int(np.argmin(axes))
    across = (along + half // 2) % half
    return ScanLines(float(axes[across]), float(axes[along]), across * pi / half)


def _filled(steps: Int64Array, counts: Int64Array) -> list[int]:
    """Give the steps that have enough points, and let those of the others join the nearest of them, in place."""
    found, which = np.unique(steps, return_inverse=True)
    points = np.bincount(which, weights=counts)
    kept = found[(points >= _LEAST_SHARE * counts.sum()) & (points > 0)]
    nearest = kept[np.argmin(np.abs(found[:, None] - kept), axis=1)]
    steps[:] = nearest[np.searchsorted(found, steps)]
    filled: list[int] = kept.tolist()
    return filled


def _around(neighbours: Neighbours) -> Float64Array:
    """Give the spacing of the lines around each point [rad], whichever trajectory they lie; NaN where few are in reach.

    Of eight sectors two look along the line, the others to the next lines: the upper quartile is across.
    """
    spacings = np.empty(len(neighbours.points))
    measure_across(neighbours.distances, _LEAST_KNOWN, spacings)
    return spacings


def _tiles(directions: Float32Array, angle: float) -> tuple[Int64Array, int]:
    """Number the tiles, long along the lines, that points lie in, (M,), and state how many lie side by side."""
    c, s = cos(angle), sin(angle)
    across = np.floor((c * directions[0] + s * directions[1]) / _TILE_ACROSS).astype(np.int64)
    along = np.floor((c * directions[1] - s * directions[0]) / _TILE_ALONG).astype(np.int64)
    columns = int(np.ptp(along)) + 1
    return (across - across.min()) * columns + along - along.min(), columns


def _spread(spacings: Float64Array, tiles: Int64Array, rows: int, columns: int) -> Float64Array:
    """Give each tile the median spacing of the samples in it; without, that of the nearest row of tiles."""
    field = np.full((rows, columns), np.nan)
    reported, medians = _medians(tiles, np.where(np.isnan(spacings), SPARSEST, spacings))
    field.ravel()[reported] = medians
    known = np.flatnonzero(np.isfinite(field).any(axis=1))
    if len(known) == 0:
        return np.full(field.size, SPARSEST)
    of_rows = np.nanmedian(field[known], axis=1)
    nearest = np.argmin(np.abs(np.arange(rows)[:, None] - known), axis=1)
    whole = np.where(np.isnan(field), of_rows[nearest][:, None], field)
    spread: Float64Array = whole.ravel()
    return spread


def _medians(groups: Int64Array, values: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Give the groups that have enough values, rising, and their medians."""
    order = np.lexsort((values, groups))
    found, first, counts = np.unique(groups[order], return_index=True, return_counts=True)
    medians = 0.5 * (values[order][first + (counts - 1) // 2] + values[order][first + counts // 2])
    enough = counts >= _LEAST_IN_TILE
    return found[enough], medians[enough]
