"""One number for how well all frames agree with a candidate, in units of what chance makes of it."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.measures.agreement import (
    EDGES,
    INFORMATION,
    MEASURES,
    Agreement,
    Score,
)
from sceneloom.calibrate.measures.candidate import Change

FINE = (EDGES, INFORMATION)
WIDE = MEASURES

_FAR_LOOKS = 48
_FAR_DEG = (2.5, 6.0)
"""Rotates so far away that nothing but chance makes images and clouds agree."""
_REPLICATES = 100
SEED = 0


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

    def __init__(self, agreement: Agreement, *, seed: int = SEED) -> None:
        """Measure chance around the stated calibration."""
        self.agreement = agreement
        self.generator = np.random.default_rng(seed)
        self.chance = self._measured_chance()
        self.replicates = self._drawn_cells()

    def stationary(
        self, score: Score, measures: Collection[str] = FINE, *, replicated: bool = False
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
        fine = np.nan_to_num((values - means) / deviations)[:, _rows(FINE)].sum(axis=1)
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
