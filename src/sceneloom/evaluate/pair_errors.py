"""The errors of single pairs, behind the figures."""

from dataclasses import dataclass

from sceneloom.arrays import Float64Array
from sceneloom.evaluate.association import MatchedPoses, Pairs


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryErrors:
    """The errors of all pairs, for plots.

    Attributes:
        estimate_name, reference_name: of what was compared.
        pairs: poses as they were paired.
        aligned: (N,) poses of the estimate in the reference's world.
        reference_trajectory: (M, 3) float64 [m], all of the reference's positions.
        translation: (N,) float64 [m].
        rotation_deg: (N,) float64 [deg], or None.
    """

    estimate_name: str
    reference_name: str
    pairs: Pairs
    aligned: MatchedPoses
    reference_trajectory: Float64Array
    translation: Float64Array
    rotation_deg: Float64Array | None
