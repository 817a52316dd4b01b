"""States that know what came later: from the last moment back to the first, by Rauch, Tung and Striebel.

Source: Rauch, Tung and Striebel 1965, "Maximum Likelihood Estimates of Linear Dynamic Systems".
"""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.tracking import motion


def smoothed(
    means: Float64Array,
    covariances: Float64Array,
    predicted_means: Float64Array,
    predicted_covariances: Float64Array,
    slopes: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Smooth the states of one object.

    A heading that was reversed on the way is taken as the last one says, all along.

    Args:
        means, covariances: (K, 11) and (K, 11, 11), with the boxes up to each moment.
        predicted_means, predicted_covariances: the same before the boxes of each moment were read; the first are not
            looked at.
        slopes: (K, 11, 11), of each moment's prediction with respect to the moment before.
    """
    later, spread = means.copy(), covariances.copy()
    for k in range(len(means) - 2, -1, -1):
        gain = np.linalg.solve(predicted_covariances[k + 1], slopes[k + 1] @ covariances[k]).T
        apart = later[k + 1] - predicted_means[k + 1]
        rotations = round(float(apart[motion.YAW]) / np.pi)
        apart[motion.YAW] -= rotations * np.pi
        later[k] = means[k] + gain @ apart
        later[k, motion.YAW] = motion.wrapped(later[k, motion.YAW] + (rotations % 2) * np.pi)
        spread[k] = covariances[k] + gain @ (spread[k + 1] - predicted_covariances[k + 1]) @ gain.T
        spread[k] = (spread[k] + spread[k].T) / 2.0
    return later, spread


def smoothed_walk(
    measures: Float64Array, noises: Float64Array, known: BoolArray, drifts: Float64Array, first: float
) -> Float64Array:
    """Smooth numbers that wander, each on its own.

    Args:
        measures, noises: (K, 4), with variances; looked at where `known`.
        known: (K,).
        drifts: (K,), variance that is added from the moment before to each.
        first: variance around 0 before anything is known.

    Returns:
        (K, 4) float64.
    """
    count = len(measures)
    means, variances = np.zeros_like(measures), np.zeros_like(measures)
    mean, variance = np.zeros(measures.shape[1]), np.full(measures.shape[1], first)
    for k in range(count):
        variance = variance + (drifts[k] if k else 0.0)
        if known[k]:
            gain = variance / (variance + noises[k])
            mean, variance = mean + gain * (measures[k] - mean), variance * (1.0 - gain)
        means[k], variances[k] = mean, variance
    for k in range(count - 2, -1, -1):
        means[k] += variances[k] / (variances[k] + drifts[k + 1]) * (means[k + 1] - means[k])
    return means
