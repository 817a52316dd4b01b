"""One cloud fitted onto another, from a start near enough."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import small_gicp

from sceneloom.arrays import Float64Array

_SPACING = 0.4
_NEIGHBOURS = 15


@dataclass(frozen=True, slots=True, eq=False)
class CloudFit:
    """How a cloud fits onto another.

    Attributes:
        matrix: (4, 4) `target_from_source`.
        information: (6, 6) of a small rotation, then a small shift, in the source's own axes.
        overlap: share of the source's points that found a partner.
        misfit: mean squared distance of these.
    """

    matrix: Float64Array
    information: Float64Array
    overlap: float
    misfit: float


class PreparedCloud:
    """A cloud thinned to one point per cell, with the shape of the surface around each."""

    def __init__(self, points: Float64Array, *, spacing: float = _SPACING) -> None:
        """Prepare (N, 3) points [m]."""
        self.points, self.tree = small_gicp.preprocess_points(
            np.ascontiguousarray(points, np.float64), spacing, _NEIGHBOURS, 1
        )

    def __len__(self) -> int:
        return int(self.points.size())


def fit_cloud(
    target: PreparedCloud, source: PreparedCloud, start: Float64Array, reaches: Sequence[float]
) -> CloudFit:
    """Fit a cloud onto another.

    Args:
        start: (4, 4) `target_from_source` to begin with.
        reaches: points farther apart than this [m] do not belong together, from the first round to the last.

    Source: Segal, Haehnel and Thrun 2009, "Generalized-ICP"; Koide 2024, "small_gicp".
    """
    matrix, found = np.asarray(start, np.float64), None
    for reach in reaches:
        found = small_gicp.align(
            target.points,
            source.points,
            target.tree,
            matrix,
            registration_type="GICP",
            max_correspondence_distance=reach,
            num_threads=1,
        )
        matrix = np.asarray(found.T_target_source, np.float64)
    if found is None:
        return CloudFit(matrix, np.zeros((6, 6)), 0.0, np.inf)
    return CloudFit(
        matrix.copy(),
        np.asarray(found.H, np.float64),
        found.num_inliers / max(len(source), 1),
        float(found.error) / max(found.num_inliers, 1),
    )
