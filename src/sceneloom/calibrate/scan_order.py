"""How the points of a sweep follow one another along the scan lines of a rotating lidar."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt16Array

_LEAST_LINES, _MOST_LINES = 4, 512
_LEAST_POINTS = 64
_MOST_PEAKS = 160
_ORDERED_SHARE = 0.95
"""Of the steps in the order of a file that goes along its lines, so many rotate the same way."""
_JITTER = np.radians(5.0)
_BIN = np.radians(0.02)
_PEAKED_SHARE = 0.9
_PEAKED_BINS = 0.35
_FEW_SHARE = 0.1
_LEVEL_SHARE = 0.25
"""A line's elevations deviate by less than this part of the way to the next line."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanOrder:
    """The points of a sweep along its scan lines.

    Attributes:
        order: (M,) int64, the points line by line, each line by azimuth; points at the lidar itself are left out.
        lines: (M,) int64, the line of each of them, 0 for the lowest one.
        azimuths: (M,) float64 [rad], about the lidar's z axis where it was when it measured them, -π to π.
        elevations: (M,) float64 [rad].
        ranges: (M,) float64 [m].
        count: number of lines.
    """

    order: Int64Array
    lines: Int64Array
    azimuths: Float64Array
    elevations: Float64Array
    ranges: Float64Array
    count: int


def find_scan_order(measured_lidar: Float64Array, rings: UInt16Array | None) -> ScanOrder | None:
    """Find the scan lines of a sweep: by the rings it states, by its order, or by peaks among the elevations.

    Args:
        measured_lidar: (N, 3) float64 [m], each point as the lidar measured it, before any motion was undone.
        rings: (N,) index of the laser, or None.

    Returns:
        None where no lines can be reported: too few points, or a lidar that does not scan in lines.
    """
    ranges = np.sqrt(np.einsum("ij,ij->i", measured_lidar, measured_lidar))
    used = np.flatnonzero(ranges > 1e-3)
    if len(used) < _LEAST_POINTS:
        return None
    points, ranges = measured_lidar[used], ranges[used]
    azimuths = np.arctan2(points[:, 1], points[:, 0])
    elevations = np.arcsin(np.clip(points[:, 2] / ranges, -1.0, 1.0))
    lines = None if rings is None else _by_rings(rings[used].astype(np.int64))
    if lines is None:
        trajectories = [_by_file_order(azimuths, cut) for cut in (0.0, np.pi, float(azimuths[0]))]
        lines = _most_level(trajectories, elevations)
    if lines is None:
        lines = _most_level([_by_elevations(elevations)], elevations)
    if lines is None:
        return None
    numbers, count = _from_below(lines, elevations)
    rows = np.lexsort((azimuths, numbers))
    return ScanOrder(used[rows], numbers[rows], azimuths[rows], elevations[rows], ranges[rows], count)


def _by_rings(rings: Int64Array) -> Int64Array | None:
    found = len(np.unique(rings))
    return rings if _LEAST_LINES <= found <= _MOST_LINES else None


def _by_file_order(azimuths: Float64Array, cut: float) -> Int64Array | None:
    """Number the rotations of a file that holds one line after another, each beginning at the azimuth `cut`."""
    steps = np.mod(np.diff(azimuths) + np.pi, 2.0 * np.pi) - np.pi
    forward = np.mean(steps > 0) >= 0.5
    if np.mean(steps > 0 if forward else steps < 0) < _ORDERED_SHARE:
        return None
    # a gap may be wider than half a rotation; what seems a small step back is one
    ahead = np.mod(steps if forward else -steps, 2.0 * np.pi)
    ahead[ahead > 2.0 * np.pi - _JITTER] -= 2.0 * np.pi
    begun = np.mod(azimuths[0] - cut if forward else cut - azimuths[0], 2.0 * np.pi)
    rotations = np.floor((begun + np.concatenate([[0.0], np.cumsum(ahead)])) / (2.0 * np.pi)).astype(np.int64)
    lines: Int64Array = rotations - rotations.min()
    return lines if _LEAST_LINES <= lines.max() + 1 <= _MOST_LINES else None


def _by_elevations(elevations: Float64Array) -> Int64Array | None:
    """Report lines by the elevations at which most points lie, where these are few."""
    low = float(elevations.min())
    bins = ((elevations - low) / _BIN).astype(np.int64)
    counts = np.bincount(bins)
    full = np.sort(counts)[::-1]
    needed = int(np.searchsorted(np.cumsum(full), _PEAKED_SHARE * len(elevations))) + 1
    if needed > _PEAKED_BINS * len(counts):
        return None
    occupied = counts >= _FEW_SHARE * full[needed // 2]
    lines = np.cumsum(np.diff(occupied.astype(np.int64), prepend=0) == 1)
    count = int(lines[-1])
    if not _LEAST_LINES <= count <= _MOST_PEAKS:
        return None
    of_line = lines[bins[occupied[bins]]] - 1
    means = np.bincount(of_line, elevations[occupied[bins]]) / np.bincount(of_line)
    return np.searchsorted(0.5 * (means[1:] + means[:-1]), elevations).astype(np.int64)


def _most_level(trajectories: list[Int64Array | None], elevations: Float64Array) -> Int64Array | None:
    """Of several ways to number lines the one whose lines keep their elevations best; None where none does."""
    found = [(_unevenness(lines, elevations), lines) for lines in trajectories if lines is not None]
    unevenness, lines = min(found, key=lambda pair: pair[0], default=(np.inf, None))
    return lines if unevenness <= _LEVEL_SHARE else None


def _unevenness(lines: Int64Array, elevations: Float64Array) -> float:
    """How much the elevations within a line differ, as part of the way to the next line."""
    numbers, count = _from_below(lines, elevations)
    counts = np.maximum(np.bincount(numbers, minlength=count), 1)
    means = np.bincount(numbers, elevations, minlength=count) / counts
    deviations = np.bincount(numbers, np.abs(elevations - means[numbers]), minlength=count) / counts
    return float(np.median(deviations) / max(np.median(np.diff(means)), 1e-9))


def _from_below(lines: Int64Array, elevations: Float64Array) -> tuple[Int64Array, int]:
    """Number lines anew from the lowest to the highest."""
    _, inverse, counts = np.unique(lines, return_inverse=True, return_counts=True)
    means = np.bincount(inverse, elevations) / counts
    ranks = np.empty(len(counts), np.int64)
    ranks[np.argsort(means, kind="stable")] = np.arange(len(counts))
    return ranks[inverse], len(counts)
