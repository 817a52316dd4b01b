"""Preintegrated IMU measurements, and what they report about two states, against GTSAM."""

import numpy as np
import pytest

from sceneloom.geometry.rigid import quaternion_from_matrix, rotation_vector_from_quaternion
from sceneloom.motion.gnss_imu import Chain, Fixes, InertialSamples, SmootherSettings, States, equations

gtsam = pytest.importorskip("gtsam", reason="needs gtsam")

GRAVITY, RATE, SECONDS = 9.81, 2000, 0.5
GYROSCOPE, ACCELEROMETER = 1e-3, 1e-2
BIAS = np.array([0.01, -0.02, 0.005, 0.1, -0.05, 0.08])


def samples() -> tuple[np.ndarray, np.ndarray]:
    seconds = np.arange(int(SECONDS * RATE) + 1) / RATE
    phases = np.arange(6) * 0.7
    values = np.sin(3.0 * seconds[:, None] + phases) * np.array([0.5, 0.4, 0.9, 1.0, 2.0, 0.5])
    values[:, 5] += GRAVITY
    return np.round(seconds * 1e9).astype(np.int64), values


def theirs(values: np.ndarray, bias: np.ndarray, *, parts: int = 1) -> "gtsam.PreintegratedImuMeasurements":
    """Summed up by steps of a sample, or of a part of one: the force of each rotated as at its beginning."""
    parameters = gtsam.PreintegrationParams.MakeSharedU(GRAVITY)
    parameters.setGyroscopeCovariance(np.eye(3) * GYROSCOPE**2)
    parameters.setAccelerometerCovariance(np.eye(3) * ACCELEROMETER**2)
    parameters.setIntegrationCovariance(np.eye(3) * 1e-20)
    summed = gtsam.PreintegratedImuMeasurements(parameters, gtsam.imuBias.ConstantBias(bias[3:], bias[:3]))
    steps = np.arange(parts * (len(values) - 1))
    shares = (steps % parts + 0.5)[:, None] / parts
    middles = values[steps // parts] * (1.0 - shares) + values[steps // parts + 1] * shares
    for middle in middles:
        summed.integrateMeasurement(middle[3:], middle[:3], 1.0 / RATE / parts)
    return summed


def ours(bias: np.ndarray):
    times, values = samples()
    densities = np.array([[GYROSCOPE**2, ACCELEROMETER**2]])
    gaps = np.empty((0, 2), np.int64)
    return InertialSamples(times, values, gaps).preintegrated(times[[0, -1]], biases=bias[None], densities=densities)


def test_rotation_gain_trajectory_and_covariance_are_the_same():
    found, coarse, fine = ours(BIAS), theirs(samples()[1], BIAS), theirs(samples()[1], BIAS, parts=2)
    # their error halves with the step, so twice the fine less the coarse one is free of it to the second order
    gain, trajectory = 2.0 * fine.deltaVij() - coarse.deltaVij(), 2.0 * fine.deltaPij() - coarse.deltaPij()
    assert np.abs(found.rotations[0] - fine.deltaRij().matrix()).max() < 1e-6
    assert np.abs(found.velocities[0] - gain).max() < 1e-6
    assert np.abs(found.positions[0] - trajectory).max() < 1e-6
    order = [0, 1, 2, 6, 7, 8, 3, 4, 5]  # theirs: rotate, trajectory, velocity
    covariance = coarse.preintMeasCov()[np.ix_(order, order)]
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    # theirs is that of the rotation written as a vector, whose slope differs from one by some hundredths at 0.4 rad
    assert np.abs((found.covariances[0] - covariance) / scale).max() < 0.05
    assert np.abs((found.covariances[0] - covariance)[3:, 3:] / scale[3:, 3:]).max() < 2e-3
    vector = np.array([0.3, -0.2, 0.9])
    found = rotation_vector_from_quaternion(quaternion_from_matrix(gtsam.Rot3.Expmap(vector).matrix()))
    assert np.abs(found - vector).max() < 1e-12


def test_a_change_of_the_bias_does_the_same():
    change = np.array([2e-4, -1e-4, 3e-4, 2e-3, 1e-3, -3e-3])
    moved, summed = ours(BIAS).slopes[0] @ change, theirs(samples()[1], BIAS)
    begin = gtsam.NavState(gtsam.Pose3(), np.zeros(3))
    before, after = (
        summed.predict(begin, gtsam.imuBias.ConstantBias(bias[3:], bias[:3])) for bias in (BIAS, BIAS + change)
    )
    rotation = before.attitude().matrix().T @ after.attitude().matrix()
    # second order in 2e-4 rad, and their steps of half a millisecond
    assert np.abs(rotation_vector_from_quaternion(quaternion_from_matrix(rotation)) - moved[:3]).max() < 1e-6
    assert np.abs(after.velocity() - before.velocity() - moved[3:6]).max() < 5e-6
    assert np.abs(after.position() - before.position() - moved[6:]).max() < 5e-6


def test_two_states_are_as_far_from_what_was_measured():
    rng = np.random.default_rng(0)
    start = gtsam.Pose3(gtsam.Rot3.Expmap(rng.standard_normal(3)), rng.standard_normal(3))
    speed = rng.standard_normal(3)
    summed = theirs(samples()[1], BIAS)
    bias = gtsam.imuBias.ConstantBias(BIAS[3:], BIAS[:3])
    there = summed.predict(gtsam.NavState(start, speed), bias)
    off = gtsam.Rot3.Expmap(1e-3 * rng.standard_normal(3)).matrix()
    stop = gtsam.Pose3(gtsam.Rot3(there.attitude().matrix() @ off), there.position() + 1e-3 * rng.standard_normal(3))
    after = there.velocity() + 1e-3 * rng.standard_normal(3)
    factor = gtsam.ImuFactor(0, 1, 2, 3, 4, summed)
    values = gtsam.Values()
    values.insert(0, start)
    values.insert(1, speed)
    values.insert(2, stop)
    values.insert(3, after)
    values.insert(4, bias)
    states = States(
        np.stack([start.rotation().matrix(), stop.rotation().matrix()]),
        np.stack([start.translation(), stop.translation()]),
        np.stack([speed, after]),
        np.tile(BIAS, (2, 1)),
    )
    assert our_cost(states) / 2.0 == pytest.approx(factor.error(values), rel=0.02)


def our_cost(states: States) -> float:
    """Of the IMU alone: what the priors cost is taken off."""
    times, _ = samples()
    nothing = Fixes(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.int64))
    chain = Chain(times[[0, -1]], np.array([True]), ours(BIAS), nothing, GRAVITY, SmootherSettings())
    settings = SmootherSettings()
    priors = (
        ((states.velocities[0] / 100.0) ** 2).sum()
        + ((BIAS[:3] / settings.gyroscope_bias) ** 2).sum()
        + ((BIAS[3:] / settings.accelerometer_bias) ** 2).sum()
    )
    return equations(chain, states, np.empty(0)).cost - float(priors)
