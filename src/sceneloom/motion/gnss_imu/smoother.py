"""The GNSS/IMU smoother of a whole drive: all measurements at once, slow GNSS errors, and the trajectory of a scene."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.geodesy import normal_gravity
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from sceneloom.kernels.imu_chain import preintegrate_until
from sceneloom.motion.ego_trajectory import gnss_receivers
from sceneloom.motion.gnss_imu.chain import Chain, RelativePoses, States, covariances, equations
from sceneloom.motion.gnss_imu.constraints import led_by_lidar, lidar_steps, misfit, stops, vehicle_speeds
from sceneloom.motion.gnss_imu.measurements import (
    CLOSEST_NS,
    DEFAULTS,
    GnssFixes,
    InertialSamples,
    Preintegrated,
    SmootherSettings,
    carried_fixes,
    check_times,
    gnss_fixes,
    inertial_samples,
    knot_times,
    noise_densities,
    preintegrated,
)
from sceneloom.motion.gnss_imu.robust import (
    Fit,
    coasted,
    fit_gently,
    fit_sternly,
    inertial_factors,
    oriented,
    rescaled,
    stationary_states,
)
from sceneloom.motion.imu import find_stationary
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.warnings import DataWarning, WarningKind

_ROUNDS = 4
"""So often the noise is reported anew from the residuals."""

_CONTRADICTED = 3.0
"""Mean square misfit of what is known of wheels, in units of what it may be, from which on it does not hold."""


@dataclass(frozen=True, slots=True, eq=False)
class _Smoothed:
    """What the smoother found.

    Attributes:
        fit: states at the knots, and what they fit.
        own: (K, 15, 15) covariances of the states, in the order of `kernels.motion_chain`.
        densities: (K - 1, 2) of the IMU's white noise, as found, (rad/s)²/Hz and (m/s²)²/Hz.
    """

    fit: Fit
    own: Float64Array
    densities: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _Measurements:
    """What a drive offers to the smoother.

    Attributes:
        fixes: at least two.
        samples: of the IMU, or None.
        lidar: the trajectory by lidar odometry, or None.
        gravity: [m/s²].
        gyroscope_bias: (3,) [rad/s] to begin with, or None.
    """

    fixes: GnssFixes
    samples: InertialSamples | None
    lidar: Trajectory | None
    gravity: float
    gyroscope_bias: Float64Array | None


def _smoothed(drive: _Measurements, settings: SmootherSettings) -> _Smoothed:
    """Find the states that fit everything best."""
    chain, densities = _chain(drive, settings)
    coasting, chain = _begun(drive, chain)
    if drive.samples is not None:
        fit, densities = _refined(oriented(chain, coasting.states), drive, drive.samples, densities)
    elif drive.lidar is not None:
        rotations = led_by_lidar(drive.lidar, chain.knots_ns, chain.fixes)
        fit = _cleaned(fit_gently(chain, replace(coasting.states, rotations=rotations)))
    else:
        fit = _cleaned(coasting)
    own, _ = covariances(fit.chain, fit.states, fit.weights)
    return _Smoothed(fit, own, densities)


def _begun(drive: _Measurements, chain: Chain) -> tuple[Fit, Chain]:
    """States by the fixes that have one alone, without an IMU, and the noise that these fixes show in the chain's."""
    unmeasured = np.zeros_like(chain.measured)
    fixes = carried_fixes(
        drive.fixes, chain.knots_ns, unmeasured, None, biases=chain.inertial.biases, gravity=drive.gravity
    )
    near = np.abs(fixes.seconds) <= CLOSEST_NS * 1e-9
    alone = replace(chain, measured=unmeasured, relative=(), fixes=fixes.chosen(near))
    coasting = coasted(alone, stationary_states(alone, drive.gyroscope_bias))
    sigmas = chain.fixes.sigmas.copy()
    for receiver in np.unique(fixes.receivers[near]):
        rows = fixes.receivers == receiver
        found = coasting.chain.fixes.sigmas[rows[near]]
        sigmas[rows] *= np.median(found / fixes.sigmas[near & rows], axis=0)
        sigmas[near & rows] = found
    return coasting, replace(chain, fixes=replace(chain.fixes, sigmas=sigmas))


def _cleaned(fit: Fit) -> Fit:
    """Fit again with fixes that jump left out and the noise as found."""
    fit = fit_sternly(fit, scaled=False)
    for _ in range(_ROUNDS):
        fit = fit_sternly(rescaled(fit)[0], scaled=True)
    return fit


def _refined(
    fit: Fit, drive: _Measurements, samples: InertialSamples, densities: Float64Array
) -> tuple[Fit, Float64Array]:
    """Fit again with biases and noise as found, fixes that jump left out, and what is known of wheels and stands."""
    lidar = fit.chain.relative
    fit = fit_sternly(fit, scaled=False)
    for number in range(_ROUNDS):
        densities = densities * inertial_factors(fit) ** 2
        fit, _ = rescaled(fit)
        begun = bool(fit.chain.speeds)
        chain = _knowing(fit, samples, lidar) if number >= _ROUNDS - 2 else fit.chain
        chain = _felt_anew(chain, drive.fixes, samples, fit.states.biases[:-1], densities)
        fit = replace(fit, chain=chain)
        if chain.speeds and not begun:
            # what bent the trajectory towards itself is seen against stiffer ways
            fit = fit_sternly(fit_gently(fit.chain, fit.states), scaled=False)
        else:
            fit = fit_sternly(fit, scaled=True)
    believed = tuple(one for one in fit.chain.speeds if misfit(one, fit.states) <= _CONTRADICTED)
    if len(believed) < len(fit.chain.speeds):
        fit = fit_sternly(
            replace(fit, chain=replace(fit.chain, speeds=believed, relative=lidar)), scaled=True
        )
    return fit, densities


def _felt_anew(
    chain: Chain, fixes: GnssFixes, samples: InertialSamples, biases: Float64Array, densities: Float64Array
) -> Chain:
    """The measurements with what the IMU felt summed up with other biases and noise."""
    knots = chain.knots_ns
    inertial = preintegrated(samples.timestamps_ns, samples.values, knots, biases=biases, densities=densities)
    carried = carried_fixes(
        fixes, knots, chain.measured, samples, biases=biases, gravity=chain.gravity, sigmas=chain.fixes.sigmas
    )
    return replace(chain, inertial=inertial, fixes=carried)


def _knowing(fit: Fit, samples: InertialSamples, lidar: tuple[RelativePoses, ...]) -> Chain:
    """The measurements with what is known of an ego on wheels and of one that stands, where the states show it."""
    own, _ = covariances(fit.chain, fit.states, fit.weights)
    wheels = vehicle_speeds(fit, own, samples, asked=fit.chain.settings.vehicle)
    still, unmoved = stops(fit, own, samples)
    speeds = still if wheels is None else (wheels, *still)
    return replace(fit.chain, speeds=speeds, relative=(*lidar, *unmoved))


def _chain(drive: _Measurements, settings: SmootherSettings) -> tuple[Chain, Float64Array]:
    fixes, samples, lidar = drive.fixes, drive.samples, drive.lidar
    further = np.empty(0, np.int64) if samples is not None or lidar is None else lidar.timestamps_ns
    knots = knot_times(fixes.timestamps_ns, samples, further, settings)
    count = len(knots) - 1
    biases = np.zeros((count, 6))
    if drive.gyroscope_bias is not None:
        biases[:, :3] = drive.gyroscope_bias
    if samples is None:
        measured, inertial, densities = np.zeros(count, np.bool_), _nothing_felt(biases), np.zeros((count, 2))
    else:
        measured = samples.is_measured(knots[:-1], knots[1:])
        densities = noise_densities(samples, (knots[:-1] + knots[1:]) // 2, settings)
        inertial = preintegrated(
            samples.timestamps_ns, samples.values, knots, biases=biases, densities=densities
        )
    carried = carried_fixes(fixes, knots, measured, samples, biases=biases, gravity=drive.gravity)
    relative = () if lidar is None else (lidar_steps(lidar, knots),)
    return Chain(knots, measured, inertial, carried, drive.gravity, settings, relative), densities


def _nothing_felt(biases: Float64Array) -> Preintegrated:
    count = len(biases)
    rotations = np.tile(np.eye(3), (count, 1, 1))
    covariance = np.tile(np.eye(9), (count, 1, 1))
    nothing = np.zeros((count, 3))
    return Preintegrated(rotations, nothing, nothing.copy(), np.zeros((count, 9, 6)), covariance, biases)


_LEAST_FIXES = 8

_ALIKE, _LEAST_ALIKE = 1.3, 0.3
"""Residuals of neighbours are alike where their correlation is above so many standard deviations of that of white
noise, 1/√n, and above the second number; those of a smoother with white noise are rather unlike."""

_MOST_ALIKE = 0.98

_FARTHEST = 3.0
"""Fixes further apart in time [s] are no neighbours."""

_AXES = (slice(0, 2), slice(2, 3))


@dataclass(frozen=True, slots=True, eq=False)
class _Wander:
    """The slow error of the fixes along some axes.

    Attributes:
        sigma: its standard deviation [m].
        seconds: the time after which it has forgotten itself but for 1/e.
        alike: correlation of neighbouring residuals.
        times_ns: (F,) int64 [ns] of the fixes that went in.
        values: (F, axes) [m], the slow error at each.
    """

    sigma: float
    seconds: float
    alike: float
    times_ns: Int64Array
    values: Float64Array

    def at(self, times_ns: Int64Array) -> Float64Array:
        """Give it at some times, (N, axes) [m]: the mean between and beyond the fixes.

        Source: Rasmussen and Williams 2006, "Gaussian Processes for Machine Learning", 4.2.1, the exponential
        covariance, whose process is that of Ornstein and Uhlenbeck 1930 and needs the two neighbours only.
        """
        after = np.searchsorted(self.times_ns, times_ns)
        before, after = np.clip(after - 1, 0, None), np.clip(after, None, len(self.times_ns) - 1)
        one = np.exp(-np.abs(times_ns - self.times_ns[before]) * 1e-9 / self.seconds)
        other = np.exp(-np.abs(self.times_ns[after] - times_ns) * 1e-9 / self.seconds)
        both = np.where(before == after, 0.0, one * other)
        left = np.maximum(1.0 - both**2, 1e-12)
        inside = times_ns <= self.times_ns[-1]
        weights = np.stack([one - both * other, other - both * one]) / left
        weights[:, before == after] = np.stack([one, 0.0 * one])[:, before == after]
        weights[:, ~inside] = np.stack(
            [0.0 * one, np.exp(-np.abs(times_ns - self.times_ns[-1]) * 1e-9 / self.seconds)]
        )[:, ~inside]
        found: Float64Array = (
            weights[0][:, None] * self.values[before] + weights[1][:, None] * self.values[after]
        )
        return found


def _wandering(fit: Fit) -> tuple[_Wander | None, _Wander | None]:
    """Find the slow error across and in height, where residuals of neighbouring fixes are alike."""
    fixes = fit.chain.fixes
    rows = np.flatnonzero(fit.weights > 0)
    if len(rows) < _LEAST_FIXES or len(np.unique(fixes.receivers)) > 1:
        return None, None
    residuals = -equations(fit.chain, fit.states, fit.weights).fix_residuals[rows]
    times = fixes.timestamps_ns[rows]
    across, height = (_wander(times, residuals[:, axes]) for axes in _AXES)
    return across, height


def _wander(times_ns: Int64Array, residuals: Float64Array) -> _Wander | None:
    steps = np.diff(times_ns) * 1e-9
    near = (steps > 0) & (steps <= max(_FARTHEST, 1.5 * float(np.median(steps))))
    variance = float((residuals**2).mean())
    if near.sum() < _LEAST_FIXES or variance == 0.0:
        return None
    alike = float((residuals[1:] * residuals[:-1])[near].mean()) / variance
    if alike < max(_LEAST_ALIKE, _ALIKE / np.sqrt(near.sum() * residuals.shape[1])):
        return None
    alike = min(alike, _MOST_ALIKE)
    seconds = -float(np.median(steps[near])) / np.log(alike)
    return _Wander(np.sqrt(variance), seconds, alike, times_ns, residuals)


_COASTING_STEP_NS = 100_000_000
"""Poses lie no farther apart where no IMU measured [ns]."""


@dataclass(frozen=True, slots=True, eq=False)
class _SmoothedTrajectory:
    """The motion at N times.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        rotations: (N, 3, 3) `world_from_body`.
        positions, velocities: (N, 3) [m] and [m/s], world.
        biases: (N, 6) of gyroscope [rad/s] and accelerometer [m/s²].
    """

    timestamps_ns: Int64Array
    rotations: Float64Array
    positions: Float64Array
    velocities: Float64Array
    biases: Float64Array


def _trajectory_times(chain: Chain, samples: InertialSamples | None) -> Int64Array:
    """The times of the states, of the IMU's samples between them, and some where it measured none."""
    times = [chain.knots_ns]
    if samples is not None:
        inside = samples.timestamps_ns
        times.append(inside[(inside >= chain.knots_ns[0]) & (inside <= chain.knots_ns[-1])])
    for k in np.flatnonzero(~chain.measured):
        start, stop = int(chain.knots_ns[k]), int(chain.knots_ns[k + 1])
        times.append(np.arange(start, stop, _COASTING_STEP_NS, dtype=np.int64))
    return np.unique(np.concatenate(times))


def _trajectory_between(
    chain: Chain, states: States, samples: InertialSamples | None, times_ns: Int64Array
) -> _SmoothedTrajectory:
    """Give the motion at some times from the first state to the last.

    From each state the IMU leads on; what is missing at the next one is spread over the time between: of the rotation
    evenly, of position and velocity by the cubic that is the likeliest for white errors of the acceleration.

    Source: the cubic is the mean of the integrated Brownian bridge, Barfoot 2017, "State Estimation for Robotics",
    11.1.4 (white noise on acceleration).
    """
    knots = np.clip(np.searchsorted(chain.knots_ns, times_ns, side="right") - 1, 0, len(chain.measured) - 1)
    delta_rotations, gains, trajectories = _felt(chain, states, samples, times_ns, knots)
    all_knots = np.arange(len(chain.measured))
    end_rotations, end_gains, end_trajectories = _felt(chain, states, samples, chain.knots_ns[1:], all_knots)
    elapsed = np.asarray((times_ns - chain.knots_ns[knots]) * 1e-9, np.float64)
    rotations, positions, velocities = _led(
        chain, states, knots, elapsed, delta_rotations, gains, trajectories
    )
    ends = _led(chain, states, all_knots, chain.seconds, end_rotations, end_gains, end_trajectories)
    missing_rotation = rotation_vector_from_quaternion(
        quaternion_from_matrix(np.swapaxes(ends[0], 1, 2) @ states.rotations[1:])
    )
    missing_trajectory, missing_speed = states.positions[1:] - ends[1], states.velocities[1:] - ends[2]
    length = chain.seconds[knots][:, None]
    share = elapsed[:, None] / length
    rotated = matrix_from_quaternion(quaternion_from_rotation_vector(share * missing_rotation[knots]))
    trajectory, speed = missing_trajectory[knots], missing_speed[knots]
    positions += share**2 * (3.0 - 2.0 * share) * trajectory + share**2 * (share - 1.0) * length * speed
    velocities += 6.0 * share * (1.0 - share) * trajectory / length + share * (3.0 * share - 2.0) * speed
    biases = states.biases[knots] + share * (states.biases[knots + 1] - states.biases[knots])
    return _SmoothedTrajectory(times_ns, rotations @ rotated, positions, velocities, biases)


def _felt(
    chain: Chain, states: States, samples: InertialSamples | None, times_ns: Int64Array, knots: Int64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """What the IMU measured from the knot to each time; nothing where there is none."""
    count = len(times_ns)
    delta_rotations, gains, trajectories = (
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
    )
    if samples is not None:
        preintegrate_until(
            samples.timestamps_ns, samples.values, chain.knots_ns, np.ascontiguousarray(states.biases[:-1]), times_ns,
            knots, delta_rotations, gains, trajectories, np.empty((0, 9, 6)),
        )  # fmt: skip
    unmeasured = ~chain.measured[knots]
    delta_rotations[unmeasured], gains[unmeasured], trajectories[unmeasured] = np.eye(3), 0.0, 0.0
    return delta_rotations, gains, trajectories


def _led(
    chain: Chain, states: States, knots: Int64Array, elapsed: Float64Array, delta_rotations: Float64Array,
    gains: Float64Array, trajectories: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:  # fmt: skip
    """Rotation, position and velocity to which what was felt leads from the knot."""
    pull = np.where(chain.measured[knots], -chain.gravity, 0.0)[:, None] * [0.0, 0.0, 1.0]
    start, t = states.rotations[knots], elapsed[:, None]
    speed = states.velocities[knots]
    positions = states.positions[knots] + t * speed + 0.5 * t**2 * pull
    positions += np.einsum("nij,nj->ni", start, trajectories)
    velocities = speed + t * pull + np.einsum("nij,nj->ni", start, gains)
    return start @ delta_rotations, positions, velocities


def _pose_covariances(
    chain: Chain, states: States, own: Float64Array, trajectory: _SmoothedTrajectory
) -> Float64Array:
    """Give the covariances of a small rotation [rad] and shift [m] about the world's axes, (N, 6, 6).

    They are those of the states; between two, which are at most a second apart, in proportion to the time.
    """
    axes = np.zeros((len(own), 6, 6))
    axes[:, :3, :3], axes[:, 3:, 3:] = states.rotations, np.eye(3)
    at_knots = axes @ own[:, :6, :6] @ np.swapaxes(axes, 1, 2)
    knots = np.clip(
        np.searchsorted(chain.knots_ns, trajectory.timestamps_ns, side="right") - 1, 0, len(own) - 2
    )
    share = ((trajectory.timestamps_ns - chain.knots_ns[knots]) * 1e-9 / chain.seconds[knots])[:, None, None]
    covariances: Float64Array = (1.0 - share) * at_knots[knots] + share * at_knots[knots + 1]
    return covariances


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
    drive = _Measurements(fixes, samples, lidar, gravity, bias)
    return _run(scene, drive, _smoothed(drive, settings))


def _stationary_bias(samples: InertialSamples) -> Float64Array | None:
    times, values = samples.timestamps_ns, samples.values
    stationary = find_stationary(times, values[:, :3], times, values[:, 3:])
    return None if stationary is None else stationary.rate


def _run(scene: Scene, drive: _Measurements, result: _Smoothed) -> GnssImuRun:
    fixes, samples = drive.fixes, drive.samples
    fit = result.fit
    estimated_trajectory = _trajectory_between(
        fit.chain, fit.states, samples, _trajectory_times(fit.chain, samples)
    )
    poses = _pose_covariances(fit.chain, fit.states, result.own, estimated_trajectory)
    offset = _common_offset(fixes, fit.chain.fixes.sigmas)
    positions = estimated_trajectory.positions
    if drive.lidar is None:
        positions, poses, offset = _with_wander(_wandering(fit), estimated_trajectory, poses, offset)
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
        trajectory, fixes.origin_lla, estimated_trajectory.velocities, estimated_trajectory.biases,
        fit.chain.knots_ns, result.own, fixes, used,
        fit.chain.fixes.sigmas, fixes.warnings,
    )  # fmt: skip
    return replace(run, warnings=(*fixes.warnings, *_notes(scene, run, drive, offset)))


def _with_wander(
    wander: tuple[_Wander | None, _Wander | None],
    estimated_trajectory: _SmoothedTrajectory,
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


def _notes(scene: Scene, run: GnssImuRun, drive: _Measurements, offset: Float64Array) -> list[DataWarning]:
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


def _how(location: str, run: GnssImuRun, drive: _Measurements) -> DataWarning:
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
