"""Where the range jumps in a sweep: the edges of what stands before something else.

Source: Levinson and Thrun 2013, "Automatic Online Calibration of Cameras and Lasers": range jumps to both sides, the
nearer point counts. Ours: jumps across the scan lines too, and their direction, which edges of pictures must share.
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
_NEIGHBOURS = 16
_ISOLATED = 3.0
_SURFACE_DISTANCE = 0.6
"""Surfaces pass the lidar no nearer [m]: along them inverse range changes by less than one over it for each radian, so
that ground seen at a grazing angle is no edge."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthEdges:
    """Points at the edges of what is near.

    Attributes:
        points_lidar: (N, 3) float64 [m], at the picture's time, as far away as the nearer of two points, halfway to the
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
        shares = np.ones(len(near))
    else:
        eye = np.zeros(3)
        near, far, shares = _jumps_in_scan(frame.scan, chosen, len(frame.points_lidar))
    inner, outer = frame.points_lidar[near] - eye, frame.points_lidar[far] - eye
    ranges_near, ranges_far = np.linalg.norm(inner, axis=1), np.linalg.norm(outer, axis=1)
    weights = (shares * np.minimum(ranges_far - ranges_near, _LARGEST_JUMP)).astype(np.float32)
    outer *= (ranges_near / ranges_far)[:, None]
    middle = inner + outer
    middle *= (ranges_near / np.linalg.norm(middle, axis=1))[:, None]
    return DepthEdges(np.ascontiguousarray(middle + eye), np.ascontiguousarray(outer + eye), weights)


def _is_jump(near: Float64Array, far: Float64Array, apart: Float64Array | float) -> BoolArray:
    """Whether the range jumps between two points, seen at an angle [rad] to one another."""
    with np.errstate(divide="ignore"):
        steep = 1.0 / near - 1.0 / far > apart / _SURFACE_DISTANCE
    return np.asarray((far - near > np.maximum(_LEAST_JUMP, _JUMP_SHARE * near)) & steep)


def _jumps_in_scan(
    scan: ScanOrder, chosen: Int64Array, count: int
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Jumps between neighbours on a line, and between lines; these count less, since lines lie farther apart."""
    wanted = np.zeros(count, np.bool_)
    wanted[chosen] = True
    rows = np.flatnonzero(wanted[scan.order])
    lines, azimuths, ranges = scan.lines[rows], scan.azimuths[rows], scan.ranges[rows]
    points = scan.order[rows]
    if len(rows) < 2:
        return points[:0], points[:0], np.zeros(0)
    same = np.diff(lines) == 0
    step = float(np.median(np.diff(azimuths)[same])) if same.any() else 0.0
    pairs = np.flatnonzero(same & (np.diff(azimuths) <= _GAP_STEPS * step))
    along = _directed(pairs, pairs + 1, ranges, step)
    upper = _above(lines, azimuths, scan.count, step)
    lower = np.flatnonzero(upper >= 0)
    spacing = _line_spacing(scan)
    across = _directed(lower, upper[lower], ranges, spacing)
    near, far = np.concatenate([along[0], across[0]]), np.concatenate([along[1], across[1]])
    share = min(step / spacing, 1.0) if spacing > 0 else 1.0
    return points[near], points[far], np.repeat([1.0, share], [len(along[0]), len(across[0])])


def _line_spacing(scan: ScanOrder) -> float:
    """Usual angle from line to line [rad]."""
    means = np.bincount(scan.lines, scan.elevations) / np.maximum(np.bincount(scan.lines), 1)
    return float(np.median(np.diff(means))) if len(means) > 1 else 0.0


def _directed(
    first: Int64Array, second: Int64Array, ranges: Float64Array, apart: float
) -> tuple[Int64Array, Int64Array]:
    """Of pairs those that jump, the nearer one first."""
    there = _is_jump(ranges[first], ranges[second], apart)
    back = _is_jump(ranges[second], ranges[first], apart)
    return np.concatenate([first[there], second[back]]), np.concatenate([second[there], first[back]])


def _above(lines: Int64Array, azimuths: Float64Array, count: int, step: float) -> Int64Array:
    """The point of the next line above at the same azimuth, by row; -1 for none."""
    turn = 8.0  # more than all azimuths span, so that lines follow one another
    keys = lines * turn + azimuths
    wanted = (lines + 1) * turn + azimuths
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
    """Jumps between neighbours in direction as seen from a place near the lidar, where no lines are known."""
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
