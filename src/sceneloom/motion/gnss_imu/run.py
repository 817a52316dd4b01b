"""A scene's trajectory from its satellite fixes and its IMU."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.geodesy import normal_gravity
from sceneloom.geometry.rotations import quaternion_from_matrix
from sceneloom.motion.gnss_imu.fixes import GnssFixes, gnss_fixes
from sceneloom.motion.gnss_imu.samples import InertialSamples, inertial_samples
from sceneloom.motion.gnss_imu.settings import DEFAULTS, SmootherSettings
from sceneloom.motion.gnss_imu.smoother import Measurements, Smoothed, smoothed
from sceneloom.motion.gnss_imu.times import check_times
from sceneloom.motion.gnss_imu.trajectory import (
    SmoothedTrajectory,
    pose_covariances,
    trajectory_between,
    trajectory_times,
)
from sceneloom.motion.gnss_imu.wander import Wander, wandering
from sceneloom.motion.gnss_receivers import gnss_receivers
from sceneloom.motion.stationary import find_stationary
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import DataWarning, WarningKind

NAME = "gnss"
"""The trajectory's name."""

_UNSURE_HEADING = np.radians(15.0)
"""Standard deviation of the heading from which on it counts as not known."""


@dataclass(frozen=True, slots=True, eq=False)
class GnssImuRun:
    """What fixes and IMU report the ego trajectory.

    Attributes:
        trajectory: `world_from_ego` under the name "gnss", at the IMU's rate, with covariances; without orientations
            where there is no IMU. The world's axes are east, north and up at the origin.
        origin_lla: (3,) the first fix: latitude, longitude [deg], height above the ellipsoid [m].
        velocities: (N, 3) [m/s], world.
        biases: (N, 6) of gyroscope [rad/s] and accelerometer [m/s²], ego frame.
        knots_ns: (K,) [ns], times of the states.
        covariances: (K, 15, 15) of the states: rotate about the ego's axes, position, velocity, the two biases.
        fixes: which went in.
        used: (F,) bool, which of them were not left out as jumps.
        fix_sigmas: (F, 3) [m] east, north, up: their noise as found.
        warnings: what was assumed, repaired or left out.
    """

    trajectory: Trajectory
    origin_lla: Float64Array
    velocities: Float64Array
    biases: Float64Array
    knots_ns: Int64Array
    covariances: Float64Array
    fixes: GnssFixes
    used: BoolArray
    fix_sigmas: Float64Array
    warnings: tuple[DataWarning, ...]


def gnss_imu_motion(
    scene: Scene, *, lidar: Trajectory | None = None, settings: SmootherSettings = DEFAULTS
) -> GnssImuRun:
    """Find the ego trajectory from its satellite fixes, and from its IMU where it has one.

    Args:
        lidar: the trajectory by lidar odometry, whose steps are taken in, too.

    Raises:
        PoseError: fewer than two fixes are usable.
    """
    if not gnss_receivers(scene):
        raise PoseError(f"{scene.source}: no usable GNSS fixes in it; expected two or more")
    fixes = gnss_fixes(scene, settings)
    if len(fixes) < 2:
        raise PoseError(f"{scene.source}: {len(fixes)} usable GNSS fix; expected two or more")
    found = inertial_samples(scene)
    samples = None if found is None else found[1]
    gravity = settings.gravity or normal_gravity(float(fixes.origin_lla[0]), float(fixes.origin_lla[2]))
    check_times(scene.source, fixes, samples)
    bias = None if samples is None else _stationary_bias(samples)
    drive = Measurements(fixes, samples, lidar, gravity, bias)
    return _run(scene, drive, smoothed(drive, settings))


def _stationary_bias(samples: InertialSamples) -> Float64Array | None:
    times, values = samples.timestamps_ns, samples.values
    stationary = find_stationary(times, values[:, :3], times, values[:, 3:])
    return None if stationary is None else stationary.rate


def _run(scene: Scene, drive: Measurements, result: Smoothed) -> GnssImuRun:
    fixes, samples = drive.fixes, drive.samples
    fit = result.fit
    estimated_trajectory = trajectory_between(
        fit.chain, fit.states, samples, trajectory_times(fit.chain, samples)
    )
    poses = pose_covariances(fit.chain, fit.states, result.own, estimated_trajectory)
    offset = _common_offset(fixes, fit.chain.fixes.sigmas)
    positions = estimated_trajectory.positions
    if drive.lidar is None:
        positions, poses, offset = _with_wander(wandering(fit), estimated_trajectory, poses, offset)
    poses[:, 3:, 3:] += np.diag(offset**2)
    trajectory = Trajectory(
        NAME,
        estimated_trajectory.timestamps_ns,
        positions,
        None
        if samples is None and drive.lidar is None
        else quaternion_from_matrix(estimated_trajectory.rotations),
        covariances=poses,
    )
    used = fit.weights > 0.5
    run = GnssImuRun(
        trajectory, fixes.origin_lla, estimated_trajectory.velocities, estimated_trajectory.biases, fit.chain.knots_ns, result.own, fixes, used,
        fit.chain.fixes.sigmas, fixes.warnings,
    )  # fmt: skip
    return replace(run, warnings=(*fixes.warnings, *_notes(scene, run, drive, offset)))


def _with_wander(
    wander: tuple[Wander | None, Wander | None],
    estimated_trajectory: SmoothedTrajectory,
    poses: Float64Array,
    offset: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Positions as the receiver would report them, its slow errors included, and what these do to the covariances.

    Errors that are alike count as fewer: with a correlation ρ of neighbours, the variance of a mean is larger by
    (1 + ρ) / (1 - ρ). What fixes across report (location, orientation) grows by their factor, the height by its own.
    """
    positions, offset, growth = estimated_trajectory.positions.copy(), offset.copy(), np.ones(6)
    for slow, axes, grown in zip(wander, (slice(0, 2), slice(2, 3)), ([0, 1, 2, 3, 4], [5]), strict=True):
        if slow is None:
            continue
        positions[:, axes] += slow.at(estimated_trajectory.timestamps_ns)
        offset[axes] = np.maximum(offset[axes], slow.sigma)
        growth[grown] = np.sqrt((1.0 + slow.alike) / (1.0 - slow.alike))
    return positions, growth[:, None] * poses * growth, offset


def _common_offset(fixes: GnssFixes, sigmas: Float64Array) -> Float64Array:
    """(3,) [m] by which all fixes may be off together: what receivers report beyond the noise that is seen.

    Fixes wander slowly with satellites and air; that shows in the accuracy reported, not in how fixes agree.
    """
    if not fixes.reported.any():
        return np.zeros(3)
    reported, seen = (
        np.median(fixes.sigmas[fixes.reported], axis=0),
        np.median(sigmas[fixes.reported], axis=0),
    )
    rest = np.sqrt(np.maximum(reported**2 - seen**2, 0.0))
    offset: Float64Array = np.where(seen < 0.6 * reported, rest, 0.0)
    return offset


def _notes(scene: Scene, run: GnssImuRun, drive: Measurements, offset: Float64Array) -> list[DataWarning]:
    location, samples = scene.source, drive.samples
    reported = [_how(location, run, drive)]
    lost = int((~run.used).sum())
    if lost:
        message = f"{lost} of {len(run.used)} fixes left out, off the trajectory by more than the rest allows"
        reported.append(_warning(WarningKind.SKIPPED, "gnss-jumps", location, message, lost))
    if offset.any():
        message = (
            f"the fixes agree better with their neighbours than the accuracy that they report; those of some time may "
            f"be "
            f"off together by {offset[0]:.2f} m across and {offset[2]:.2f} m in height (one standard deviation), which "
            "stands in the covariances"
        )
        reported.append(_warning(WarningKind.ASSUMED, "gnss-common-offset", location, message))
    if samples is not None and len(samples.gaps_ns):
        message = "the IMU has gaps; in them the ego was taken to go on evenly between what is known"
        reported.append(_warning(WarningKind.ASSUMED, "imu-gaps", location, message, len(samples.gaps_ns)))
    if samples is not None and samples.left_out:
        message = "samples that are no numbers, or not later than the one before, were left out"
        reported.append(_warning(WarningKind.REPAIRED, "imu-samples", location, message, samples.left_out))
    heading = run.trajectory.covariances
    if samples is not None and heading is not None and np.sqrt(heading[:, 2, 2].min()) > _UNSURE_HEADING:
        message = (
            f"the ego moved too little to report its heading, which is known to "
            f"{np.degrees(np.sqrt(heading[:, 2, 2].min())):.0f} degrees at best; it was taken to look where it goes"
        )
        reported.append(_warning(WarningKind.ASSUMED, "heading-unknown", location, message))
    return reported


def _how(location: str, run: GnssImuRun, drive: Measurements) -> DataWarning:
    sigma = np.median(run.fix_sigmas[run.used], axis=0) if run.used.any() else run.fix_sigmas[0]
    latitude, longitude, height = run.origin_lla
    message = (
        f"{len(run.used)} fixes{_WITH[drive.samples is not None, drive.lidar is not None]} gave the trajectory of "
        f"the ego; noise of the fixes as found {sigma[0]:.2f} m across, {sigma[2]:.2f} m in height; the world's axes "
        f"are east, north and up at the first fix, {latitude:.7f}, {longitude:.7f}, {height:.2f} m"
    )
    return _warning(WarningKind.ASSUMED, "trajectory-from-gnss", location, message)


_WITH = {
    (False, False): " alone, without an IMU,",
    (True, False): " and the IMU",
    (False, True): " and the lidar's sweeps",
    (True, True): ", the IMU and the lidar's sweeps",
}


def _warning(kind: WarningKind, code: str, location: str, message: str, count: int = 1) -> DataWarning:
    return DataWarning(kind=kind, code=code, location=location, message=message, count=count)
