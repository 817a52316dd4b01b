"""How long the quaternions of a file are, whatever its numbers."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.formats.poses import GREATEST_NORM_ERROR


def lengths_of(quaternions: Float64Array) -> tuple[Float64Array, BoolArray]:
    """Lengths (N,) of quaternions (N, 4) in any order, and which of them are off 1 by too much."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(quaternions, axis=1)
    return lengths, ~(np.abs(lengths - 1.0) <= GREATEST_NORM_ERROR)
