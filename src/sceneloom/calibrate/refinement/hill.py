"""The objective around a candidate, in steps of which each moves pixels about as far as any other.

A rotation about one axis moves pixels nearly as a shift, or as another time, does: in these numbers the objective is a
    long
narrow ridge, along which one climbs slowly and whose curvature differences do not report. By the mean square of how far
pixels move it is round.

Source: preconditioning by a quadratic form, e.g. Nocedal and Wright 2006, "Numerical Optimization", 5.1.
"""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.calibrate.measures.candidate import UNITS
from sceneloom.calibrate.refinement.objective import Level, Linearised

FARTHEST = np.array([6.0, 6.0, 6.0, 3.0, 3.0, 3.0, 2.0, 2.5])
"""How far a calibration is usually off, in units: 1.5 degrees, 15 cm, 2 % of the focal length, 50 ms."""
_CURVATURE_STEP = 0.4
"""Curvature is taken over this part of the blur's width: over less, single pixels show."""


@dataclass(frozen=True, slots=True, eq=False)
class Hill:
    """What the channels state around a candidate, and what speaks against going far.

    Attributes:
        linearised: the channels.
        weights: (C,), what each counts.
        reach: (P,), how far the numbers usually go, in units.
        offset: (P,), the candidate, in units.
        basis: (P, P), steps of the length 1, in units: they move pixels by the width of the blur (root mean square), or
            the numbers as far as they usually go.
    """

    linearised: Linearised
    weights: Float64Array
    reach: Float64Array
    offset: Float64Array
    basis: Float64Array

    @classmethod
    def around(cls, level: Level, free: AnyArray, numbers: Float64Array) -> "Hill":
        """Stand at a candidate, (8,) numbers, of which some are free, (P,)."""
        linearised = level.around(numbers, free)
        weights = linearised.channel_weights(np.zeros(len(free)))
        form = linearised.motion_form() + np.diag(FARTHEST[free] ** -2.0)
        basis = np.linalg.inv(np.linalg.cholesky(form)).T
        return cls(linearised, weights, FARTHEST[free], (numbers / UNITS)[free], basis)

    def downwards(self, step: Float64Array) -> tuple[float, Float64Array]:
        """Minus the objective and its slope at a step, (P,)."""
        in_units = self.basis @ step
        sums = self.linearised.sums(in_units)
        away = (self.offset + in_units) / self.reach
        value = float((sums.values.sum(axis=0) * self.weights).sum() - 0.5 * away @ away)
        slope = away / self.reach - np.einsum("fcp,c->p", sums.gradients, self.weights)
        return -value, self.basis.T @ slope

    def inverse_curvature(self) -> Float64Array:
        """The inverse of minus the second derivatives, (P, P); where the objective rises it counts as flat.

        What is flat is bounded by how far the numbers usually go.
        """
        rows = []
        for axis in np.eye(len(self.reach)) * _CURVATURE_STEP:
            (_, ahead), (_, behind) = self.downwards(axis), self.downwards(-axis)
            rows.append((ahead - behind) / (2.0 * _CURVATURE_STEP))
        curvature = np.array(rows)
        values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
        bounds = np.square(self.basis @ vectors / self.reach[:, None]).sum(axis=0)
        inverse: Float64Array = vectors / np.maximum(values, bounds) @ vectors.T
        return inverse
