import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import OptionError
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.simulate import GnssSpec, ImuSpec
from sceneloom.simulate.gnss_imu import gnss_sensor, imu_sensor, imu_truth
from sceneloom.simulate.trajectory import plan_path

GRAVITY = np.array([0.0, 0.0, -9.80665])


@pytest.fixture(scope="module")
def path():
    return plan_path(np.random.default_rng(8), start_ns=0, duration=10.0)


def timestamps(seconds, rate_hz):
    return np.rint(np.arange(0.0, seconds, 1 / rate_hz) * 1e9).astype(np.int64)


def integrate(start, rotation, times_ns, forces, rates):
    """Plain strap-down integration: the rotation by the mean rate of each step, the force by the trapezium rule."""
    position, velocity = start.positions[0].copy(), start.velocities[0].copy()
    for k, dt in enumerate(np.diff(times_ns) * 1e-9):
        rotated = rotation * Rotation.from_rotvec(0.5 * (rates[k] + rates[k + 1]) * dt)
        before = rotation.apply(forces[k]) + GRAVITY
        after = rotated.apply(forces[k + 1]) + GRAVITY
        position += velocity * dt + (2 * before + after) * dt**2 / 6
        velocity += 0.5 * (before + after) * dt
        rotation = rotated
    return position, velocity, rotation


def test_the_true_signals_integrate_to_the_path(path):
    times = timestamps(5.0, 1000)
    truth = imu_truth(ImuSpec(), path, times, seed=0)
    first, last = path.at(times[:1]), path.at(times[-1:])
    position, velocity, rotation = integrate(
        first, Rotation.from_matrix(first.rotations[0]), times, truth.specific_forces, truth.angular_rates
    )
    # The trapezium rule at 1 kHz is off by dt²/12 times jerk or angular jerk: 1e-6 m/s and 1e-7 rad over 5 s.
    np.testing.assert_allclose(position, last.positions[0], atol=1e-4)
    np.testing.assert_allclose(velocity, last.velocities[0], atol=1e-4)
    assert (rotation.inv() * Rotation.from_matrix(last.rotations[0])).magnitude() < 1e-5


def test_the_measured_signals_without_their_bias_integrate_to_the_path_as_well_as_noise_allows(path):
    times, spec = timestamps(3.0, 200), ImuSpec()
    truth = imu_truth(spec, path, times, seed=0)
    streams = imu_sensor(spec, truth, seed=0).streams
    first, last = path.at(times[:1]), path.at(times[-1:])
    position, _, rotation = integrate(
        first,
        Rotation.from_matrix(first.rotations[0]),
        times,
        streams["accelerometer"].values - truth.accelerometer_bias,
        streams["gyroscope"].values - truth.gyroscope_bias,
    )
    # White noise of density n gives n √(T³/3) of position and n √T of angle: 3 mm and 0.2 mrad; the tilt adds
    # g T²/2 times its size: 8 mm. Five times that.
    np.testing.assert_allclose(position, last.positions[0], atol=0.05)
    assert (rotation.inv() * Rotation.from_matrix(last.rotations[0])).magnitude() < 1e-3


def test_an_imu_that_all_but_stands_feels_gravity_upwards(stationary_path):
    truth = imu_truth(ImuSpec(), stationary_path, timestamps(1.0, 100), seed=0)
    np.testing.assert_allclose(truth.specific_forces, np.tile(-GRAVITY, (100, 1)), atol=1e-6)
    np.testing.assert_allclose(truth.angular_rates, 0.0, atol=1e-6)


def test_the_noise_has_the_density_and_the_bias_that_were_asked_for(path):
    times = timestamps(10.0, 400)
    spec = ImuSpec(rate_hz=400, accelerometer_noise=0.01, gyroscope_noise=0.002)
    truth = imu_truth(spec, path, times, seed=4)
    streams = imu_sensor(spec, truth, seed=4).streams
    for name, clean, density, bias in (
        ("accelerometer", truth.specific_forces, 0.01, truth.accelerometer_bias),
        ("gyroscope", truth.angular_rates, 0.002, truth.gyroscope_bias),
    ):
        error = streams[name].values - clean
        # 4000 samples know a deviation to 1.1 % and a mean to 1.6 % of it; five times that.
        assert error.std(axis=0) == pytest.approx(density * np.sqrt(400), rel=0.06)
        np.testing.assert_allclose(error.mean(axis=0), bias, atol=0.08 * density * np.sqrt(400))
        np.testing.assert_array_equal(streams[name].timestamps_ns, times)


def test_biases_differ_between_seeds_and_axes(path):
    biases = [
        imu_truth(ImuSpec(), path, timestamps(0.1, 100), seed=seed).accelerometer_bias for seed in range(3)
    ]
    assert len(np.unique(np.concatenate(biases))) == 9


def test_the_bias_is_not_drawn_from_the_numbers_of_the_noise(path):
    times, spec = (
        timestamps(0.1, 100),
        ImuSpec(rate_hz=100, accelerometer_noise=0.1, accelerometer_bias_sigma=1.0),
    )
    truth = imu_truth(spec, path, times, seed=0)
    noise = imu_sensor(spec, truth, seed=0).streams["accelerometer"].values[0] - truth.specific_forces[0]
    assert not np.allclose(noise - truth.accelerometer_bias, truth.accelerometer_bias, rtol=0.01)


def test_gnss_fixes_scatter_around_the_path_as_much_as_stated(path):
    spec, times = GnssSpec(rate_hz=200, horizontal_sigma=0.5, vertical_sigma=2.0), timestamps(10.0, 200)
    fixes = gnss_sensor(spec, path, times, seed=1)
    error = enu_from_geodetic(fixes.positions_lla, np.array(spec.origin_lla)) - path.at(times).positions
    # 2000 fixes know a deviation to 1.6 %; five times that.
    assert error.std(axis=0) == pytest.approx([0.5, 0.5, 2.0], rel=0.08)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.25)
    assert set(fixes.accuracies) == {0.5}
    assert set(fixes.vertical_accuracies) == {2.0}


def test_gnss_counts_north_in_latitude_and_east_in_longitude(stationary_path):
    spec = GnssSpec(horizontal_sigma=0.0, vertical_sigma=0.0, origin_lla=(60.0, 25.0, 100.0))
    fix = gnss_sensor(spec, stationary_path, timestamps(0.1, 10), seed=0).positions_lla[0]
    np.testing.assert_allclose(fix, [60.0, 25.0, 100.0], atol=1e-6)
    moved = plan_path(np.random.default_rng(8), start_ns=0, duration=10.0)
    exact = gnss_sensor(spec, moved, timestamps(5.0, 10), seed=0).positions_lla
    east, north = moved.at(timestamps(5.0, 10)).positions[:, :2].T
    # A degree of latitude is 111.41 km at 60 degrees north, one of longitude 55.80 km (Bomford, Geodesy).
    np.testing.assert_allclose((exact[:, 0] - 60.0) * 111_412, north, atol=0.01)
    np.testing.assert_allclose((exact[:, 1] - 25.0) * 55_800, east, atol=0.01)


@pytest.mark.parametrize("rate", [0.0, -5.0, float("nan"), 1e6])
def test_rates_that_no_sensor_has_are_refused(rate):
    with pytest.raises(OptionError, match="rate_hz"):
        ImuSpec(rate_hz=rate)
    with pytest.raises(OptionError, match="rate_hz"):
        GnssSpec(rate_hz=rate)


@pytest.mark.parametrize("sigma", [-1.0, float("nan")])
def test_deviations_that_no_sensor_has_are_refused_by_name(sigma):
    with pytest.raises(OptionError, match=r"imu.gyroscope_noise: .*expected 0.0 to"):
        ImuSpec(gyroscope_noise=sigma)
    with pytest.raises(OptionError, match=r"gnss.vertical_sigma: .*expected 0.0 to"):
        GnssSpec(vertical_sigma=sigma)


def test_the_receiver_starts_on_the_earth():
    with pytest.raises(OptionError, match="origin_lla"):
        GnssSpec(origin_lla=(500.0, 0.0, 0.0))
