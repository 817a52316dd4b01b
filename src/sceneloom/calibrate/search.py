"""The search for the calibration that agrees best around the stated one, and how certain it is.

Source: response surfaces, Box and Wilson 1951, "On the Experimental Attainment of Optimum Conditions".
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.measures import (
    COUNT,
    EDGES,
    INFORMATION,
    MEASURES,
    ROTATION,
    TRANSLATION,
    UNITS,
    Agreement,
    Change,
    Parameter,
    Score,
)

_FINE = (EDGES, INFORMATION)

_WIDE = MEASURES

_FAR_LOOKS = 48

_FAR_DEG = (2.5, 6.0)
"""Rotates so far away that nothing but chance makes images and clouds agree."""

_REPLICATES = 100

_SEED = 0


@dataclass(frozen=True, slots=True, eq=False)
class Chance:
    """What the measures come to where nothing fits.

    Attributes:
        means, deviations: (M,) by measure; the deviation of one without a value is infinite, so that it counts nothing.
        sum_deviation: deviation of the sum over the fine measures, in units of theirs.
    """

    means: Float64Array
    deviations: Float64Array
    sum_deviation: float


class Objective:
    """The measures of an agreement, each as deviations above chance, added up.

    Attributes:
        agreement: what is scored.
        chance: what the measures come to far away from the stated calibration.
        replicates: (B, C), weights of the cells for bootstrap replicates.

    Source: bootstrap over blocks: Künsch 1989, "The Jackknife and the Bootstrap for General Stationary Observations".
    """

    def __init__(self, agreement: Agreement, *, seed: int = _SEED) -> None:
        """Measure chance around the stated calibration."""
        self.agreement = agreement
        self.generator = np.random.default_rng(seed)
        self.chance = self._measured_chance()
        self.replicates = self._drawn_cells()

    def stationary(
        self, score: Score, measures: Collection[str] = _FINE, *, replicated: bool = False
    ) -> Float64Array:
        """Deviations above chance, summed over measures: (1,), or (B,) for the replicates."""
        values = score.values(self.replicates) if replicated else score.values()[None]
        return np.asarray(self.deviations_of(values)[:, _rows(measures)].sum(axis=1))

    def deviations_of(self, values: Float64Array) -> Float64Array:
        """How far values (B, M) stand above chance; one that is missing stands nowhere."""
        return np.nan_to_num((values - self.chance.means) / self.chance.deviations, nan=0.0)

    def distinctness(self, score: Score) -> float:
        """How many deviations the fine measures together stand above chance."""
        return float(self.stationary(score)[0] / self.chance.sum_deviation)

    def _measured_chance(self) -> Chance:
        looks = []
        for _ in range(_FAR_LOOKS):
            direction = self.generator.normal(size=3)
            rotation = direction / np.linalg.norm(direction) * np.radians(self.generator.uniform(*_FAR_DEG))
            looks.append(self.agreement.score(Change.rotation(rotation)).values())
        values = np.array(looks)
        known = np.isfinite(values).sum(axis=0) >= _FAR_LOOKS // 2
        means, deviations = np.zeros(len(MEASURES)), np.full(len(MEASURES), np.inf)
        means[known], deviations[known] = (
            np.nanmean(values[:, known], axis=0),
            np.nanstd(values[:, known], axis=0),
        )
        deviations[deviations < _NOTHING] = np.inf
        fine = np.nan_to_num((values - means) / deviations)[:, _rows(_FINE)].sum(axis=1)
        return Chance(means, deviations, max(float(fine.std()), 1.0))

    def _drawn_cells(self) -> Float64Array:
        """Draw cells with replacement, of those that hold anything."""
        occupied = np.flatnonzero(self.agreement.score(Change(), by_cells=True).totals.sum(axis=0) > 0)
        weights = np.zeros((_REPLICATES, self.agreement.cells))
        if len(occupied):
            draws = self.generator.multinomial(
                len(occupied), np.full(len(occupied), 1 / len(occupied)), _REPLICATES
            )
            weights[:, occupied] = draws
        return weights


_NOTHING = 1e-6


def _rows(measures: Collection[str]) -> list[int]:
    return [row for row, name in enumerate(MEASURES) if name in measures]


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
        locations = _in_ball(count, dimensions, generator)
        locations[0] = 0.0
        probes = _in_ball(_PROBES, dimensions, generator)
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


def _in_ball(count: int, dimensions: int, generator: np.random.Generator) -> Float64Array:
    """Draw locations evenly from the unit ball, (count, dimensions)."""
    directions = generator.normal(size=(count, dimensions))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = generator.random((count, 1)) ** (1.0 / dimensions)
    return np.asarray(directions * radii)


_WIDE_RADII = (20.0, 11.0, 6.0, 3.5)

_FINE_RADII = (2.4, 1.6)
"""Balls of rotations that are looked at, one after another [units of a quarter degree]."""

_NEAR_RADII, _FAR_RADII = (4.0, 2.0), (10.0, 5.0, 2.0)

_MANY, _MANY_RADIUS, _PROMISING = 150, 7.0, 3
"""So many rotates up to so far are looked at, and so many followed up: hills are narrower than wide balls report."""

_FINE_FROM = 4.0

_ROUGH_FROM = 3.0
"""In wider balls some of the features report where to look next."""

_LOOKS_PER_COEFFICIENT = (4.0, 2.5)

_FARTHEST_DEG = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Top:
    """The best location that was found, by some parameters of a change.

    Attributes:
        parameters: which of the eight numbers were looked for.
        change: the location.
        replicates: (B, P) float64, the locations that bootstrap replicates found, in the parameters' own units.
        radius: (P,) float64, of the ball that was looked at last: what comes near to it was not found.
        height: deviations above chance.
        distinctness: the same by chance's own deviation.
        gain, gain_deviation: how much higher it is than where the search began, and the deviation of that among
            replicates.
    """

    parameters: tuple[Parameter, ...]
    change: Float64Array
    replicates: Float64Array
    radius: Float64Array
    height: float
    distinctness: float
    gain: float
    gain_deviation: float

    @property
    def covariance(self) -> Float64Array:
        """(P, P), of the parameters among the replicates."""
        return np.atleast_2d(np.cov(self.replicates.T))

    def number(self, parameter: Parameter) -> tuple[float, float]:
        """Value and standard deviation of a parameter."""
        column = self.parameters.index(parameter)
        return float(self.change[parameter]), float(np.sqrt(self.covariance[column, column]))


def find_rotation(objective: Objective) -> Top:
    """Find the best rotation: from far to near, near the stated one, and near some that agree; the highest counts."""
    begun = np.zeros(COUNT)
    wide = begun
    for radius in _WIDE_RADII:
        wide = _climb(objective, wide, ROTATION, radius, _WIDE)
        wide = _bounded(wide)
    starts = (wide, begun, *_promising(objective))
    locations = [_climb(objective, start, ROTATION, _FINE_RADII[0], _FINE) for start in starts]
    highest = _highest(objective, locations)
    return _top_around(objective, highest, highest, ROTATION, _FINE_RADII[1])


def _promising(objective: Objective) -> list[Float64Array]:
    """Some of many rotates, (8,), around the stated calibration that agree best, none near another."""
    columns = list(ROTATION)
    rotations = _in_ball(_MANY, len(columns), objective.generator) * _MANY_RADIUS
    locations = np.zeros((_MANY, COUNT))
    locations[:, columns] = rotations * UNITS[columns]
    scores = [objective.agreement.score(Change.of(location), _WIDE, rough=True) for location in locations]
    heights = np.array([objective.stationary(score, _WIDE)[0] for score in scores])
    found: list[int] = []
    for row in np.argsort(-heights).tolist():
        if all(np.linalg.norm(rotations[row] - rotations[other]) > _FINE_RADII[0] for other in found):
            found.append(row)
        if len(found) == _PROMISING:
            break
    return [locations[row] for row in found]


def find_group(objective: Objective, start: Float64Array, parameters: Sequence[Parameter]) -> Top:
    """Find the best location by several parameters, from near and from farther away; the higher of both counts."""
    locations = []
    for radii in (_NEAR_RADII, _FAR_RADII):
        location = start
        for radius in radii[:-1]:
            measures = _FINE if radius <= _FINE_FROM else _WIDE
            location = _climb(objective, location, parameters, radius, measures)
        locations.append(location)
    return _top_around(objective, _highest(objective, locations), start, parameters, _NEAR_RADII[-1])


def _highest(objective: Objective, locations: Sequence[Float64Array]) -> Float64Array:
    """The location, (8,), where images and sweeps agree best."""
    heights = [
        objective.stationary(objective.agreement.score(Change.of(location), _FINE))[0]
        for location in locations
    ]
    return locations[int(np.argmax(heights))]


def _top_around(
    objective: Objective,
    location: Float64Array,
    start: Float64Array,
    parameters: Sequence[Parameter],
    radius: float,
) -> Top:
    """Find the top in a ball, and what replicates make of it; `start` is what its gain is reported against."""
    location, replicates = _look_around(objective, location, parameters, radius, _FINE)
    there, here = (
        objective.agreement.score(Change.of(numbers), _FINE, by_cells=True) for numbers in (location, start)
    )
    gains = objective.stationary(there, replicated=True) - objective.stationary(here, replicated=True)
    return Top(
        tuple(parameters),
        location,
        replicates,
        radius * UNITS[list(parameters)],
        float(objective.stationary(there)[0]),
        objective.distinctness(there),
        float(objective.stationary(there)[0] - objective.stationary(here)[0]),
        float(gains.std()),
    )


def _climb(
    objective: Objective,
    middle: Float64Array,
    parameters: Sequence[Parameter],
    radius: float,
    measures: Sequence[str],
) -> Float64Array:
    """Go to the top of the quadratic through looks at a ball, (8,), or to the best look where that is higher."""
    columns = list(parameters)
    rough = radius > _ROUGH_FROM
    surface, scores = _looks(objective, middle, columns, radius, measures, rough=rough)
    values = np.array([objective.stationary(score, measures) for score in scores]).T
    top = middle.copy()
    top[columns] += radius * UNITS[columns] * surface.tops(values)[0]
    at_top = objective.agreement.score(Change.of(top), measures, rough=rough)
    if rough or objective.stationary(at_top, measures)[0] >= values.max():
        return top
    found = middle.copy()
    found[columns] += radius * UNITS[columns] * surface.locations[np.argmax(values[0])]
    return found


def _look_around(
    objective: Objective,
    middle: Float64Array,
    parameters: Sequence[Parameter],
    radius: float,
    measures: Sequence[str],
) -> tuple[Float64Array, Float64Array]:
    """Go to the top like `_climb`, and give those of the replicates, (B, P), too."""
    columns = list(parameters)
    surface, scores = _looks(objective, middle, columns, radius, measures, by_cells=True)
    values = np.array([objective.stationary(score, measures) for score in scores]).T
    replicated = np.array([objective.stationary(score, measures, replicated=True) for score in scores]).T
    found = middle.copy()
    found[columns] += radius * UNITS[columns] * surface.tops(values)[0]
    return found, middle[columns] + radius * UNITS[columns] * surface.tops(replicated)


def _looks(
    objective: Objective,
    middle: Float64Array,
    columns: list[Parameter],
    radius: float,
    measures: Sequence[str],
    *,
    by_cells: bool = False,
    rough: bool = False,
) -> tuple[Surface, list[Score]]:
    """Score locations in a ball; one number more to be found needs more of them.

    But not as many more as it has terms.
    """
    count = int(_LOOKS_PER_COEFFICIENT[len(columns) > len(ROTATION)] * coefficients(len(columns)))
    surface = Surface.of(count, len(columns), objective.generator)
    scores = []
    for location in surface.locations:
        numbers = middle.copy()
        numbers[columns] += radius * UNITS[columns] * location
        candidate = Change.of(numbers)
        scores.append(objective.agreement.score(candidate, measures, by_cells=by_cells, rough=rough))
    return surface, scores


def _bounded(numbers: Float64Array) -> Float64Array:
    """Stay within what counts as near."""
    angle = float(np.linalg.norm(numbers[:3]))
    bounded = numbers.copy()
    bounded[:3] *= min(1.0, np.radians(_FARTHEST_DEG) / max(angle, 1e-12))
    return bounded


GROUPS: dict[str, tuple[Parameter, ...]] = {
    "translation": (*ROTATION, *TRANSLATION),
    "focal_length": (*ROTATION, Parameter.FOCAL),
    "time_offset": (*ROTATION, Parameter.LATER),
}
"""What is looked for together with the rotation, by what the verdict is about."""
