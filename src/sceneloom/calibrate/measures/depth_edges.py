"""Where the range jumps in a sweep: the edges of what stands before something else.

Source: Levinson and Thrun 2013, "Automatic Online Calibration of Cameras and Lasers": range jumps to both sides, the
nearer point counts. Ours: jumps across the scan lines too, and their direction, which edges of images must share.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.calibrate.frames import CalibrationFrame
from sceneloom.calibrate.scan_order import ScanOrder

_LEAST_JUMP, _JUMP_SHARE, _LARGEST_JUMP = 0.4, 0.04, 3.0
"""A jump is larger than this [m], and than this share of the range; one larger than that counts no more [m]."""
_GAP_STEPS = 4.0
_SLANT_FACTOR = 2.0
"""A surface that slants so many times as much as where it was last seen explains a jump."""
_NEIGHBOURS = 16
_ISOLATED = 3.0
_SURFACE_DISTANCE = 0.6
"""Surfaces pass the lidar no nearer [m]: along them inverse range changes by less than one over it for each radian, so
that ground seen at a grazing angle is no edge."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthEdges:
    """Points at the edges of what is near.

    Attributes:
        points_lidar: (N, 3) float64 [m], at the image's time, as far away as the nearer of two points, halfway to the
            direction of the farther one: the edge is somewhere between the two.
        outwards_lidar: (N, 3) float64 [m], as far away, in the direction of the farther one.
        weights: (N,) float32, the jump [m], at most 3.
    """

    points_lidar: Float64Array
    outwards_lidar: Float64Array
    weights: Float32Array


def find_depth_edges(frame: CalibrationFrame, chosen: Int64Array) -> DepthEdges:
    """Find the edges among some points of a frame.

    Args:
        chosen: (M,) int64, the points that the camera may see.
    """
    if frame.scan is None:
        eye = frame.camera_from_lidar.inverse().translation
        near, far = _jumps_anywhere(frame.points_lidar, chosen, eye)
        shares, reaches = np.ones(len(near)), np.ones(len(near))
    else:
        eye = np.zeros(3)
        near, far, shares, reaches = _jumps_in_scan(frame.scan, chosen, len(frame.points_lidar))
    inner, outer = frame.points_lidar[near] - eye, frame.points_lidar[far] - eye
    ranges_near, ranges_far = np.linalg.norm(inner, axis=1), np.linalg.norm(outer, axis=1)
    weights = (shares * np.minimum(ranges_far - ranges_near, _LARGEST_JUMP)).astype(np.float32)
    outer *= (ranges_near / ranges_far)[:, None]
    middle = inner + outer
    middle *= (reaches * ranges_near / np.linalg.norm(middle, axis=1))[:, None]
    return DepthEdges(np.ascontiguousarray(middle + eye), np.ascontiguousarray(outer + eye), weights)


def _is_jump(near: Float64Array, far: Float64Array, apart: Float64Array | float) -> BoolArray:
    """Whether the range jumps between two points, seen at an angle [rad] to one another."""
    with np.errstate(divide="ignore"):
        steep = 1.0 / near - 1.0 / far > apart / _SURFACE_DISTANCE
    return np.asarray((far - near > _least_jump(near)) & steep)


def _least_jump(near: Float64Array) -> Float64Array:
    return np.maximum(_LEAST_JUMP, _JUMP_SHARE * near)


def _jumps_in_scan(
    scan: ScanOrder, chosen: Int64Array, count: int
) -> tuple[Int64Array, Int64Array, Float64Array, Float64Array]:
    """Jumps between neighbours on a line, and between lines; these count less, since lines lie farther apart.

    Returns:
        near, far: (N,) int64, the points.
        shares: (N,) what each counts.
        reaches: (N,) how far the edge is, as a multiple of the near point's range.
    """
    wanted = np.zeros(count, np.bool_)
    wanted[chosen] = True
    rows = np.flatnonzero(wanted[scan.order])
    lines, azimuths, ranges = scan.lines[rows], scan.azimuths[rows], scan.ranges[rows]
    points = scan.order[rows]
    if len(rows) < 2:
        return points[:0], points[:0], np.zeros(0), np.zeros(0)
    same = np.diff(lines) == 0
    step = float(np.median(np.diff(azimuths)[same])) if same.any() else 0.0
    spacing = _line_spacing(scan)
    after = np.full(len(rows), -1)
    pairs = np.flatnonzero(same & (np.diff(azimuths) <= _GAP_STEPS * step))
    after[pairs] = pairs + 1
    trajectories = [
        _jumps_along(trajectory, _reversed(trajectory), ranges, apart)
        for trajectory, apart in ((after, step), (rows_above(lines, azimuths, scan.count, step), spacing))
    ]
    near, far, reaches = (np.concatenate(parts) for parts in zip(*trajectories, strict=True))
    share = min(step / spacing, 1.0) if spacing > 0 else 1.0
    return (
        points[near],
        points[far],
        np.repeat([1.0, share], [len(trajectory[0]) for trajectory in trajectories]),
        reaches,
    )


def _reversed(ahead: Int64Array) -> Int64Array:
    """Of each row the one that it is ahead of; -1 for none."""
    behind = np.full(len(ahead), -1)
    behind[ahead[ahead >= 0]] = np.flatnonzero(ahead >= 0)
    return behind


def _jumps_along(
    ahead: Int64Array, behind: Int64Array, ranges: Float64Array, apart: float
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Jumps from each row to the one ahead and to the one behind: near rows, far rows, reaches."""
    found = []
    for onwards, back in ((ahead, behind), (behind, ahead)):
        near = np.flatnonzero(onwards >= 0)
        near = near[_is_jump(ranges[near], ranges[onwards[near]], apart)]
        far, before = onwards[near], back[near]
        slants, known = _slants(ranges, near, before)
        # a plane's inverse range changes evenly with the angle
        explained = 1.0 / ranges[near] - 1.0 / ranges[far] < _SLANT_FACTOR * slants
        kept = known & ~explained
        reaches = 1.0 / np.maximum(1.0 - 0.5 * slants * ranges[near], ranges[near] / ranges[far])
        found.append((near[kept], far[kept], reaches[kept]))
    return (
        np.concatenate([found[0][0], found[1][0]]),
        np.concatenate([found[0][1], found[1][1]]),
        np.concatenate([found[0][2], found[1][2]]),
    )


def _slants(ranges: Float64Array, near: Int64Array, before: Int64Array) -> tuple[Float64Array, BoolArray]:
    """How much inverse range falls towards an edge on the surface that ends there, and whether it is that surface.

    Where the surface is one point wide its slant counts as none; a point that itself lies behind an edge, or has none
    beside it, is no end of a surface that is known.
    """
    previous = np.where(before >= 0, ranges[before], ranges[near])
    same = np.abs(previous - ranges[near]) < _least_jump(ranges[near])
    slants = np.where(same, 1.0 / previous - 1.0 / ranges[near], 0.0)
    return slants, np.asarray((before >= 0) & (same | (previous > ranges[near])))


def _line_spacing(scan: ScanOrder) -> float:
    """Usual angle from line to line [rad]."""
    means = np.bincount(scan.lines, scan.elevations) / np.maximum(np.bincount(scan.lines), 1)
    return float(np.median(np.diff(means))) if len(means) > 1 else 0.0


def rows_above(lines: Int64Array, azimuths: Float64Array, count: int, step: float) -> Int64Array:
    """The point of the next line above at the same azimuth, by row; -1 for none.

    Args:
        lines, azimuths: (M,) of points in the order of a scan.
        count: number of lines.
        step: usual angle between points of a line [rad].
    """
    rotation = 8.0  # more than all azimuths span, so that lines follow one another
    keys = lines * rotation + azimuths
    wanted = (lines + 1) * rotation + azimuths
    after = np.clip(np.searchsorted(keys, wanted), 1, len(keys) - 1)
    nearer = np.where(np.abs(keys[after] - wanted) < np.abs(keys[after - 1] - wanted), after, after - 1)
    found: Int64Array = np.where(
        np.abs(keys[nearer] - wanted) <= _GAP_STEPS / 2 * max(step, 1e-4), nearer, -1
    )
    found[lines + 1 >= count] = -1
    return found


def _jumps_anywhere(
    points_lidar: Float64Array, chosen: Int64Array, eye_lidar: Float64Array
) -> tuple[Int64Array, Int64Array]:
    """Jumps between neighbours in direction as seen from a location near the lidar, where no lines are known."""
    if len(chosen) <= _NEIGHBOURS:
        return chosen[:0], chosen[:0]
    points = points_lidar[chosen] - eye_lidar
    ranges = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    directions = points / ranges[:, None]
    found = cKDTree(directions).query(directions, k=_NEIGHBOURS + 1)
    distances, others = np.asarray(found[0]), np.asarray(found[1], np.int64)
    usual = np.median(distances[:, -1])
    jumps = _is_jump(ranges[:, None], ranges[others], distances) & (distances < _ISOLATED * usual)
    nearest = np.argmax(jumps, axis=1)
    rows = np.flatnonzero(jumps.any(axis=1))
    return chosen[rows], chosen[others[rows, nearest[rows]]]
