"""Where around the stated calibration images and clouds agree best, and how sure that location is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.health.objective import FINE, WIDE, Objective
from sceneloom.calibrate.health.surface import Surface, coefficients, in_ball
from sceneloom.calibrate.measures.agreement import Score
from sceneloom.calibrate.measures.candidate import COUNT, ROTATION, TRANSLATION, UNITS, Change, Parameter

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
        wide = _climb(objective, wide, ROTATION, radius, WIDE)
        wide = _bounded(wide)
    starts = (wide, begun, *_promising(objective))
    locations = [_climb(objective, start, ROTATION, _FINE_RADII[0], FINE) for start in starts]
    highest = _highest(objective, locations)
    return _top_around(objective, highest, highest, ROTATION, _FINE_RADII[1])


def _promising(objective: Objective) -> list[Float64Array]:
    """Some of many rotates, (8,), around the stated calibration that agree best, none near another."""
    columns = list(ROTATION)
    rotations = in_ball(_MANY, len(columns), objective.generator) * _MANY_RADIUS
    locations = np.zeros((_MANY, COUNT))
    locations[:, columns] = rotations * UNITS[columns]
    scores = [objective.agreement.score(Change.of(location), WIDE, rough=True) for location in locations]
    heights = np.array([objective.stationary(score, WIDE)[0] for score in scores])
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
            measures = FINE if radius <= _FINE_FROM else WIDE
            location = _climb(objective, location, parameters, radius, measures)
        locations.append(location)
    return _top_around(objective, _highest(objective, locations), start, parameters, _NEAR_RADII[-1])


def _highest(objective: Objective, locations: Sequence[Float64Array]) -> Float64Array:
    """The location, (8,), where images and sweeps agree best."""
    heights = [
        objective.stationary(objective.agreement.score(Change.of(location), FINE))[0]
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
    location, replicates = _look_around(objective, location, parameters, radius, FINE)
    there, here = (
        objective.agreement.score(Change.of(numbers), FINE, by_cells=True) for numbers in (location, start)
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
