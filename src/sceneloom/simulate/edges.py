"""Where the outlines are in an image."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.simulate.camera import ImageTruth


def edge_mask(truth: ImageTruth, *, within_px: int = 2) -> BoolArray:
    """Mark the pixels near an outline.

    An outline lies between two neighbouring pixels that show different objects, or depths that differ by more than
    a plane could explain: 5 % of the depth and more than double the step on either side.

    Args:
        within_px: how far from an outline pixels are still marked, along rows, columns and diagonals.

    Returns:
        (H, W) bool.
    """
    edges = np.zeros(truth.depths.shape, np.bool_)
    for axis in (0, 1):
        instances, depths = (np.moveaxis(array, axis, 0) for array in (truth.instances, truth.depths))
        view = np.moveaxis(edges, axis, 0)
        change = (instances[1:] != instances[:-1]) | _jumps(depths.astype(np.float64))
        view[1:] |= change
        view[:-1] |= change
    return _grown(edges, within_px - 1)


def _jumps(depths: Float64Array) -> BoolArray:
    """Where the depth leaps between rows, (H - 1, W)."""
    steps = np.abs(np.diff(depths, axis=0))
    beside = np.zeros_like(steps)
    beside[1:] = steps[:-1]
    beside[:-1] = np.maximum(beside[:-1], steps[1:])
    leaps: BoolArray = (steps > 0.05 * np.minimum(depths[1:], depths[:-1])) & (steps > 2.0 * beside)
    return leaps


def _grown(mask: BoolArray, by_px: int) -> BoolArray:
    """The mask and all pixels at most `by_px` rows and columns from it."""
    grown = mask
    for axis in (0, 1):
        source = grown.copy()
        for step in range(1, by_px + 1):
            view, old = np.moveaxis(grown, axis, 0), np.moveaxis(source, axis, 0)
            view[step:] |= old[:-step]
            view[:-step] |= old[step:]
    return grown
