"""How far two arrays are apart."""

from math import prod

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.editing.differences.tolerances import DEGREES, METRES
from sceneloom.geometry.rotations import angle_between, normalise_quaternion, quaternion_from_matrix


def apart(a: AnyArray, b: AnyArray, unit: str) -> Float64Array | None:
    """Give by how much the rows of two arrays of one shape differ; None where that is no number.

    NaN and NaN are equal, NaN and a number infinitely far apart. Rows of locations are apart by their distance, those
    of quaternions and rotation matrices by the angle between them, all others by their largest difference of a number.

    Args:
        a: (N, …).
        b: the same shape.
        unit: what they are counted in.

    Returns:
        (N,) float64.
    """
    if not (_is_number(a) and _is_number(b)):
        return None
    if a.ndim == 0:
        a, b = a[None], b[None]
    if unit == DEGREES:
        return _rotated(a, b)
    difference = _difference(a, b)
    columns = prod(difference.shape[1:])
    if unit == METRES and difference.ndim > 1 and difference.shape[-1] % 3 == 0:
        locations = difference.reshape(len(difference), columns // 3, 3)
        distances: Float64Array = np.linalg.norm(locations, axis=2).max(axis=1, initial=0.0)
        return distances
    largest: Float64Array = np.abs(difference).reshape(len(difference), columns).max(axis=1, initial=0.0)
    return largest


def _is_number(array: AnyArray) -> bool:
    return array.dtype.kind in "biuf"


def _difference(a: AnyArray, b: AnyArray) -> Float64Array:
    if a.dtype.kind in "iu" and b.dtype.kind in "iu" and max(a.itemsize, b.itemsize) == 8:
        # differences of timestamps since 1970 are exact in integers, and not in float64
        low, high = np.minimum(a, b), np.maximum(a, b)
        return (high - low).astype(np.float64)
    first, second = a.astype(np.float64), b.astype(np.float64)
    with np.errstate(invalid="ignore"):
        difference = first - second
    difference[(first == second) | (np.isnan(first) & np.isnan(second))] = 0.0
    difference[np.isnan(difference)] = np.inf
    return difference


def _rotated(a: AnyArray, b: AnyArray) -> Float64Array:
    if a.shape[-2:] == (3, 3):
        a, b = quaternion_from_matrix(a)[None], quaternion_from_matrix(b)[None]
    known = np.isfinite(a).all(axis=-1) & np.isfinite(b).all(axis=-1)
    usable = known & (np.abs(a).max(axis=-1) > 0) & (np.abs(b).max(axis=-1) > 0)
    angles = np.where(_difference(a, b).any(axis=-1), np.inf, 0.0)
    rotations = angle_between(normalise_quaternion(a[usable]), normalise_quaternion(b[usable]))
    angles[usable] = np.where(angles[usable] == 0.0, 0.0, np.degrees(rotations))
    return angles
