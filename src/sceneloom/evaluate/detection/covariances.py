"""Whether covariances are true: how often errors lie in the regions that they promise."""

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import ArrayError, OptionError

LEVELS = (0.5, 0.9, 0.95, 0.99)
"""The shares of errors that the regions promise to hold."""


class Coverage(msgspec.Struct, frozen=True, kw_only=True):
    """What the region of one level holds.

    Attributes:
        level: what it promises.
        share: what it holds.
    """

    level: float
    share: float


class CovarianceScores(msgspec.Struct, frozen=True, kw_only=True):
    """How true covariances are.

    Attributes:
        count: errors.
        dimensions: numbers in each.
        nees: mean of eᵀ Σ⁻¹ e, which true covariances make `dimensions`.
        nees_low, nees_high: between which that mean lies for true Gaussian ones in 95 of 100 cases.
        degrees_of_freedom: of the Student distribution whose regions are asked, None for a Gaussian.
        coverages: of the regions of `LEVELS`.
        log_volume: mean of ½ log det Σ: small for covariances that promise much.
        root_mean_square: of the errors.
    """

    count: int
    dimensions: int
    nees: float
    nees_low: float
    nees_high: float
    degrees_of_freedom: float | None
    coverages: tuple[Coverage, ...]
    log_volume: float
    root_mean_square: float


def judge_covariances(
    errors: Float64Array, covariances: Float64Array, *, degrees_of_freedom: float | None = None
) -> CovarianceScores:
    """Hold covariances against the errors that were made.

    Args:
        errors: (N, K), estimated less true, N >= 1.
        covariances: (N, K, K), of the errors.
        degrees_of_freedom: ν > 2 of the Student distribution that errors have, with those covariances; infinite for a
            Gaussian, which is also the default. The regions are those of `detections.noise.radius_squared`.

    Raises:
        ArrayError: shapes do not fit, or a matrix is no covariance.
        OptionError: `degrees_of_freedom` is not above 2.

    Source: Bar-Shalom, Li and Kirubarajan 2001, section 5.4.
    """
    # these take a second, which those who have no covariances need not wait
    from scipy import stats

    from sceneloom.detections.noise import radius_squared

    count, dimensions = errors.shape
    if covariances.shape != (count, dimensions, dimensions):
        raise ArrayError(f"covariances: {covariances.shape}; expected {(count, dimensions, dimensions)}")
    freedom = np.inf if degrees_of_freedom is None else degrees_of_freedom
    if not freedom > 2.0:
        raise OptionError(f"degrees of freedom {freedom}; expected more than 2")
    signs, logs = np.linalg.slogdet(covariances)
    if not (np.isfinite(logs).all() and (signs > 0).all()):
        row = int(np.flatnonzero(~(np.isfinite(logs) & (signs > 0)))[0])
        raise ArrayError(
            f"covariances[{row}]: {covariances[row].tolist()}; expected a positive definite matrix"
        )
    distances = (errors * np.linalg.solve(covariances, errors[..., None])[..., 0]).sum(axis=1)
    limits = {
        level: radius_squared(level, degrees_of_freedom=freedom, dimensions=dimensions) for level in LEVELS
    }
    low, high = stats.chi2.ppf((0.025, 0.975), count * dimensions) / count
    return CovarianceScores(
        count=count,
        dimensions=dimensions,
        nees=float(distances.mean()),
        nees_low=float(low),
        nees_high=float(high),
        degrees_of_freedom=None if np.isinf(freedom) else freedom,
        coverages=tuple(
            Coverage(level=level, share=float((distances <= limit).mean())) for level, limit in limits.items()
        ),
        log_volume=float(logs.mean() / 2.0),
        root_mean_square=float(np.sqrt((errors**2).mean())),
    )
