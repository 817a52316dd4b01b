"""Axes of a sensor that were exchanged or negated, found from what it should have measured."""

from itertools import permutations, product

import numpy as np

from sceneloom.arrays import Float64Array

_ALIKE = 0.005
"""Correlations this near to each other do not choose between axes."""


def _signed(order: tuple[int, ...], signs: tuple[float, ...]) -> Float64Array:
    axes = np.zeros((3, 3))
    axes[range(3), order] = signs
    return axes


_AXES = tuple(
    _signed(order, signs) for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)
)


def best_axes(measured: Float64Array, told: Float64Array) -> tuple[Float64Array, float]:
    """Find the exchange of axes that takes told rates to measured ones best, of equals the least strange.

    Args:
        measured, told: (M, 3), without their means.

    Returns:
        (3, 3) of 0, 1 and -1, and the correlation.
    """
    products, length = measured.T @ told, np.sqrt((measured * measured).sum() * (told * told).sum())
    scores = np.array([(axes * products).sum() / length for axes in _AXES])
    near = [axes for axes, score in zip(_AXES, scores, strict=True) if score > scores.max() - _ALIKE]
    best = max(near, key=lambda axes: (float(np.trace(axes)), float(np.linalg.det(axes))))
    return best, float(scores.max())


def axes_in_words(axes: Float64Array) -> str:
    """`-y, x, z`: what stands in place of x, y, z; `axes` is (3, 3), in each row one ±1 and else 0."""
    columns = np.abs(axes).argmax(axis=1)
    return ", ".join(
        f"{'-' if axes[row, column] < 0 else ''}{'xyz'[column]}" for row, column in enumerate(columns)
    )
