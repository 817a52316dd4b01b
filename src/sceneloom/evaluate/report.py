"""What the comparison of a trajectory with a reference reports."""

import msgspec
import numpy as np

from sceneloom.arrays import FloatArray
from sceneloom.scene.warnings import DataWarning


class ErrorStatistics(msgspec.Struct, frozen=True, kw_only=True):
    """Errors in a few numbers, in the unit of the errors.

    Attributes:
        count: how many errors.
        mean, median, min, max: of them.
        rms: root of the mean square.
        percentile_95: what 95 % of them do not exceed, linear between neighbours.
        std: standard deviation around the mean, of the errors themselves (divided by count).
    """

    count: int
    mean: float
    rms: float
    median: float
    percentile_95: float
    max: float
    min: float
    std: float

    @classmethod
    def of(cls, errors: FloatArray) -> "ErrorStatistics":
        """Sum up (N,) errors, N >= 1."""
        return cls(
            count=len(errors),
            mean=float(errors.mean()),
            rms=float(np.sqrt((errors**2).mean())),
            median=float(np.median(errors)),
            percentile_95=float(np.percentile(errors, 95)),
            max=float(errors.max()),
            min=float(errors.min()),
            std=float(errors.std()),
        )


class AlignmentReport(msgspec.Struct, frozen=True, kw_only=True):
    """How the estimate was laid onto the reference: p_reference = scale · R · p_estimate + translation.

    Attributes:
        kind: one of `ALIGNMENTS`.
        poses: how many poses it was found from.
        quaternion_xyzw: R.
        translation: [m].
        scale: 1 but for `sim3`.
    """

    kind: str
    poses: int
    quaternion_xyzw: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    scale: float


class AbsoluteErrors(msgspec.Struct, frozen=True, kw_only=True):
    """How far the aligned estimate is from the reference at the same times (ATE).

    Attributes:
        translation: [m].
        horizontal, vertical: [m], its parts along x and y, and along z, of the reference's world.
        rotation_deg: angle between the orientations [deg], None where one of both has none.
    """

    translation: ErrorStatistics
    horizontal: ErrorStatistics
    vertical: ErrorStatistics
    rotation_deg: ErrorStatistics | None


class RelativeErrors(msgspec.Struct, frozen=True, kw_only=True):
    """How far motions over equal steps differ (RPE).

    Attributes:
        delta: the step: "1s", "10m", "1f".
        seconds, metres: how long the steps are on the average, in time and along the reference.
        translation: [m].
        rotation_deg: [deg], None where one of both has no orientations.
        translation_percent: mean error per trajectory of the step [%], None where the reference stands.
        rotation_deg_per_m: the same of the rotation [deg/m].
        translation_per_s: mean error per second [m/s].
        rotation_deg_per_s: the same of the rotation [deg/s].
    """

    delta: str
    seconds: float
    metres: float
    translation: ErrorStatistics
    rotation_deg: ErrorStatistics | None
    translation_percent: float | None
    rotation_deg_per_m: float | None
    translation_per_s: float
    rotation_deg_per_s: float | None


class SegmentErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Mean errors over segments of one length, as in KITTI's odometry benchmark.

    Attributes:
        length: [m], None for all lengths together.
        segments: how many.
        translation_percent: error per length [%].
        rotation_deg_per_m: [deg/m].
    """

    length: float | None
    segments: int
    translation_percent: float
    rotation_deg_per_m: float


class KittiErrors(msgspec.Struct, frozen=True, kw_only=True):
    """The two numbers of KITTI's odometry benchmark, and what they are made of.

    Attributes:
        overall: over all segments.
        by_length: over those of each length.
    """

    overall: SegmentErrors
    by_length: tuple[SegmentErrors, ...]


class TrajectoryReport(msgspec.Struct, frozen=True, kw_only=True):
    """One comparison.

    Attributes:
        estimate, reference: names of what was compared.
        estimate_poses, reference_poses: how many each has within the time that was asked for.
        pairs: how many were compared.
        start_ns, stop_ns: times of the first and the last pair [ns], on the reference's clock.
        seconds: from the first pair to the last.
        coverage: share of the reference's time in which the estimate has poses, 0 to 1.
        path_length: [m], along the reference, over the pairs.
        estimate_path_length: [m], along the estimate as it was given, over the pairs.
        alignment: how the estimate was laid onto the reference.
        absolute: errors at the same times.
        relative: errors of motions, by step.
        kitti: KITTI's two numbers; None where the trajectory is shorter than its shortest segment, or has no
            orientations.
        warnings: what is to be known about the numbers.
    """

    estimate: str
    reference: str
    estimate_poses: int
    reference_poses: int
    pairs: int
    start_ns: int
    stop_ns: int
    seconds: float
    coverage: float
    path_length: float
    estimate_path_length: float
    alignment: AlignmentReport
    absolute: AbsoluteErrors
    relative: tuple[RelativeErrors, ...]
    kitti: KittiErrors | None
    warnings: tuple[DataWarning, ...] = ()
