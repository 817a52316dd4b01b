r"""Which box is of which object: what a box says in space and in images, weighed together.

A box z is rather of an object whose location x is foreseen than of anything else by the logarithm of

    t(z - x; S) / λ · s / (1 - s) · t(1 - o; σ) / t(1 - o₀; σ).

S is the covariance of both on the ground, t a distribution with tails like Student's, since detectors are sometimes far
off; λ is how many boxes of other things lie around; the odds of the box's own score s count where they are below 1; o
is the overlap of the box in the image with the one that is foreseen there, and o₀ the one that says nothing. So an
object that was not seen for long, whose location is vague, does not take every box around. Of all ways to pair boxes
with objects the one is taken whose logarithms add up to the most; what is below 0 is no pair.

Source: Reid 1979, "An Algorithm for Tracking Multiple Targets", eq. 16 for the ratio with the density; Bar-Shalom, Li
and Kirubarajan 2001, ch. 2.6; Lange, Little and Taylor 1989, "Robust Statistical Modeling Using the t Distribution".
"""

from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.object_gains import add_gains_in_image, gains_in_space
from sceneloom.tracking.observations import Observations
from sceneloom.tracking.population import ByCamera, Population
from sceneloom.tracking.settings import TrackerSettings

OVERLAP_SIGMA = 0.25
"""Deviation of the share by which boxes in images fail to overlap that are one object's."""
USUAL_OVERLAP = 0.6
"""The overlap that speaks neither for nor against one object."""
LEAST_OVERLAP = 0.3
"""An object takes a box of an image alone that overlaps with its own by so much at least."""
LEAST_SIGMA = 0.3
"""No middle of a box is where it is expected to within less than this [m]."""
FREEDOM = 4.0
"""Degrees of freedom of what boxes are off."""


_AGREEMENT = 0.5 * (FREEDOM + 1.0) * float(np.log1p(((1.0 - USUAL_OVERLAP) / OVERLAP_SIGMA) ** 2 / FREEDOM))
"""What an image adds at most: where boxes are the same."""


class Candidates(NamedTuple):
    """Pairs of objects and boxes: (K,) int64 of both, and (K,) float64, how much likelier they are one than not."""

    rows: Int64Array
    columns: Int64Array
    gains: Float64Array


def candidates(
    objects: Population, foreseen: ByCamera, seen: Observations, settings: TrackerSettings
) -> Candidates:
    """Which boxes may be of which objects, and how much likelier that is than that they are of anything else.

    Args:
        objects: as they are expected at the time of the boxes.
        foreseen: by camera, (N, 4) [px], where they are expected in its image, NaN for nowhere.
        seen: the boxes.
        settings: what is taken for granted.
    """
    density = np.where(objects.vehicles, settings.vehicle_density, settings.person_density)
    found = Candidates(
        *gains_in_space(
            np.ascontiguousarray(objects.means[:, :3]),
            np.ascontiguousarray(objects.covariances[:, :3, :3]),
            objects.codes,
            np.log(density),
            np.ascontiguousarray(seen.measures[:, :3]),
            np.ascontiguousarray(seen.covariances[:, :3, :3]),
            seen.codes,
            np.minimum(seen.log_odds, 0.0),
            LEAST_SIGMA**2,
            FREEDOM,
            len(seen.corners_xyxy) * _AGREEMENT,
        )
    )
    for camera_id, corners in seen.corners_xyxy.items():
        if camera_id in foreseen:
            add_gains_in_image(
                *found,
                foreseen[camera_id],
                corners,
                seen.measured,
                OVERLAP_SIGMA,
                USUAL_OVERLAP,
                LEAST_OVERLAP,
                FREEDOM,
            )
    return found
