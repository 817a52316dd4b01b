"""The smoother: all measurements of a drive at once, and the noise that they show."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.motion.gnss_imu.carried_fixes import carried_fixes
from sceneloom.motion.gnss_imu.chain import Chain, RelativePoses, covariances
from sceneloom.motion.gnss_imu.fixes import GnssFixes
from sceneloom.motion.gnss_imu.knots import CLOSEST_NS, knot_times
from sceneloom.motion.gnss_imu.lidar_steps import led_by_lidar, lidar_steps
from sceneloom.motion.gnss_imu.preintegration import Preintegrated, preintegrated
from sceneloom.motion.gnss_imu.robust import Fit, fit_gently, fit_sternly, inertial_factors, rescaled
from sceneloom.motion.gnss_imu.samples import InertialSamples, noise_densities
from sceneloom.motion.gnss_imu.settings import SmootherSettings
from sceneloom.motion.gnss_imu.start import coasted, oriented, stationary_states
from sceneloom.motion.gnss_imu.stops import stops
from sceneloom.motion.gnss_imu.vehicle import misfit, vehicle_speeds
from sceneloom.scene.poses import Trajectory

_ROUNDS = 4
"""So often the noise is reported anew from the residuals."""
_CONTRADICTED = 3.0
"""Mean square misfit of what is known of wheels, in units of what it may be, from which on it does not hold."""


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
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
class Measurements:
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


def smoothed(drive: Measurements, settings: SmootherSettings) -> Smoothed:
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
    return Smoothed(fit, own, densities)


def _begun(drive: Measurements, chain: Chain) -> tuple[Fit, Chain]:
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
    fit: Fit, drive: Measurements, samples: InertialSamples, densities: Float64Array
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


def _chain(drive: Measurements, settings: SmootherSettings) -> tuple[Chain, Float64Array]:
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
