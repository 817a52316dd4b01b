"""The top of a hill that is known by noisy looks at it: a quadratic fitted to them, again and again nearer to its top.

Source: response surfaces, Box and Wilson 1951, "On the Experimental Attainment of Optimum Conditions".
"""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array

_PROBES = 3000


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Fits quadratics to values at fixed locations of a ball, and finds their tops in it.

    Attributes:
        locations: (N, P) float64, within the unit ball, the first one its middle.
        solve: (Q, N) float64, values to coefficients by least squares.
        probes: (K, P) float64, where tops are looked for.
        probe_terms: (K, Q) float64, their terms.
    """

    locations: Float64Array
    solve: Float64Array
    probes: Float64Array
    probe_terms: Float64Array

    @classmethod
    def of(cls, count: int, dimensions: int, generator: np.random.Generator) -> "Surface":
        """Choose locations."""
        locations = in_ball(count, dimensions, generator)
        locations[0] = 0.0
        probes = in_ball(_PROBES, dimensions, generator)
        return cls(
            locations, np.asarray(np.linalg.pinv(_terms(locations)), np.float64), probes, _terms(probes)
        )

    def tops(self, values: Float64Array) -> Float64Array:
        """Give the tops, (B, P), of the quadratics through values (B, N)."""
        heights = values @ self.solve.T @ self.probe_terms.T
        tops: Float64Array = self.probes[np.argmax(heights, axis=1)]
        return tops


def coefficients(dimensions: int) -> int:
    """How many a quadratic has."""
    return (dimensions + 1) * (dimensions + 2) // 2


def _terms(locations: Float64Array) -> Float64Array:
    rows, columns = np.triu_indices(locations.shape[1])
    return np.hstack([np.ones((len(locations), 1)), locations, locations[:, rows] * locations[:, columns]])


def in_ball(count: int, dimensions: int, generator: np.random.Generator) -> Float64Array:
    """Draw locations evenly from the unit ball, (count, dimensions)."""
    directions = generator.normal(size=(count, dimensions))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = generator.random((count, 1)) ** (1.0 / dimensions)
    return np.asarray(directions * radii)
