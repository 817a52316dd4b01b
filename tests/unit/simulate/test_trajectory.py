import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from sceneloom.simulate import trajectory as tr
from sceneloom.simulate.street import Lane, Street, _spline_grid, control_points_through

STEP = 1e-4


# A central difference of step h is off by h²/6 times the next derivative but one (below 100 here), and float64
# rounding of 100 m by 1e-14 / 1e-4: both under 1e-6.
DIFFERENCE = 1e-6
STOPPING = tr.PathSpec(stops=(tr.Stop(5.0, 3.0), tr.Stop(16.5, 2.0)))


def planned(seed, spec=None, duration=20.0):
    return (spec or tr.PathSpec()).plan(np.random.default_rng(seed), start_ns=5_000, duration=duration)


@pytest.fixture(scope="module", params=range(4))
def path(request):
    return planned(request.param)


@pytest.fixture(scope="module")
def seconds():
    return np.random.default_rng(0).uniform(-2, 22, 200)


def test_interpolated_samples_stay_within_a_millimetre_of_the_quintic_spline_of_the_control_points(path, seconds):
    count = len(path.control_points)
    knots = path.first_knot + np.arange(-5, count + 1.0)
    expected = BSpline(knots, path.control_points, 5)
    states = path.at_seconds(seconds)
    # Positions reach 300 m: float64 keeps 1e-12 of them through the sums.
    np.testing.assert_allclose(states.positions[:, :2], expected(seconds), atol=1e-10)
    np.testing.assert_allclose(states.velocities[:, :2], expected(seconds, 1), atol=1e-10)
    np.testing.assert_allclose(states.accelerations[:, :2], expected(seconds, 2), atol=1e-10)
    # interpolated samples at 100 Hz stay within a millimetre
    timestamps = np.arange(0, 20_000_000_001, 10_000_000) + 5_000
    between = np.random.default_rng(1).integers(timestamps[0], timestamps[-1], 2000)
    sampled, exact = path.poses(timestamps).interpolate(between), path.at(between)
    assert np.linalg.norm(sampled.positions - exact.positions, axis=1).max() < 1e-4
    rotated = Rotation.from_quat(sampled.quaternions_xyzw).inv() * Rotation.from_matrix(exact.rotations)
    # Slerp misses alpha dt²/8 of a rotating with angular acceleration alpha: below 1 mm at 100 m for 1e-5 rad.
    assert rotated.magnitude().max() < 1e-5


STOP_CORNERS = (1.0, 5.0, 8.0, 12.0, 12.5, 16.5, 18.5)


@pytest.mark.parametrize(
    ("spec", "corners"), [(None, np.arange(20.0)), (STOPPING, np.array(STOP_CORNERS))], ids=["free", "stops"]
)
def test_rates_are_the_slopes_of_the_motion_without_leaps_at_knots_and_stops(spec, corners, seconds):
    for seed in range(4):
        path = planned(seed, spec)
        before, states, after = (path.at_seconds(seconds + shift) for shift in (-STEP, 0.0, STEP))
        for name, rate in (("positions", "velocities"), ("velocities", "accelerations")):
            slope = (getattr(after, name) - getattr(before, name)) / (2 * STEP)
            np.testing.assert_allclose(slope, getattr(states, rate), atol=DIFFERENCE)
        rotated = Rotation.from_matrix(before.rotations).inv() * Rotation.from_matrix(after.rotations)
        np.testing.assert_allclose(rotated.as_rotvec() / (2 * STEP), states.angular_rates, atol=DIFFERENCE)
        before, after = path.at_seconds(corners - 1e-9), path.at_seconds(corners + 1e-9)
        # Jerk stays below 20 m/s³, so 2 ns change the acceleration by less than 4e-8.
        np.testing.assert_allclose(after.accelerations, before.accelerations, atol=1e-7)
        np.testing.assert_allclose(after.angular_rates, before.angular_rates, atol=1e-7)


def test_the_ego_begins_at_the_origin_upright_looks_where_it_goes_and_changes_speed_but_never_stops(path, seconds):
    states = path.at_seconds(seconds)
    along = states.velocities / np.linalg.norm(states.velocities, axis=1, keepdims=True)
    # Roll and pitch are tenths of a degree: the forward axis stays within 2 % of the direction of motion.
    np.testing.assert_allclose((states.rotations[:, :, 0] * along).sum(axis=1), 1.0, atol=0.02)
    assert (states.rotations[:, 2, 2] > 0.999).all()
    assert np.abs(states.positions[:, 2]).max() < 0.05
    np.testing.assert_allclose(path.at(np.array([5_000], np.int64)).positions[0, :2], 0.0, atol=1e-9)
    states = path.at_seconds(np.linspace(0, 20, 500))
    speeds = np.linalg.norm(states.velocities, axis=1)
    assert 3.0 < speeds.min() < speeds.max() - 1.0 < 11.0
    assert np.abs(states.angular_rates[:, 2]).max() > 0.1
    # The pavement on the left ends 10.4 m from the trajectory; a tighter bend would fold it over.
    assert np.abs(Lane.of(path).curvatures).max() < 1 / 13.0


def test_speeds_stay_in_their_range_angles_go_roll_pitch_yaw_and_a_car_that_stops_stands_truly_still():
    path, driving = planned(1, STOPPING), planned(1)
    stationary = path.at_seconds(np.linspace(5.0, 8.0, 301))
    assert np.ptp(stationary.positions, axis=0).max() == 0
    assert np.ptp(stationary.rotations, axis=0).max() == 0
    for rates in (stationary.velocities, stationary.accelerations, stationary.angular_rates):
        assert not rates.any()
    np.testing.assert_array_equal(path.control_points, driving.control_points)
    seconds = np.linspace(8.0, 20.0, 60)
    parameters, _, _ = path.warp.at(seconds)
    np.testing.assert_array_equal(path.at_seconds(seconds).positions, driving.at_seconds(parameters).positions)
    moving = np.linalg.norm(path.at_seconds(np.linspace(12.0, 12.5, 9)).velocities, axis=1)
    assert moving.min() > 3.0
    states = planned(0, tr.PathSpec(stops=(tr.Stop(0.0, 60.0),)), duration=60.0).at_seconds(np.linspace(0, 60, 999))
    assert not np.ptp(states.positions, axis=0).any()
    assert not states.velocities.any()
    states = planned(2, tr.PathSpec(speeds=(2.0, 4.0))).at_seconds(np.linspace(0, 20, 500))
    speeds = np.linalg.norm(states.velocities, axis=1)
    # A rotation of 0.21 rad/s needs 2.2 m/s so that it is no tighter than the street is wide; smoothing stays between.
    assert 1.9 < speeds.min() < speeds.max() < 4.1
    np.testing.assert_array_equal(planned(3, tr.PathSpec()).control_points, planned(3).control_points)
    roll, pitch, yaw = np.random.default_rng(0).uniform(-1, 1, (3, 20))
    expected = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_matrix()
    np.testing.assert_allclose(tr._rotation_from_angles(roll, pitch, yaw), expected, atol=1e-14)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.few(1)
def test_rotates_are_as_fast_as_asked_for_and_nothing_stands_in_their_trajectory(seed):
    path = planned(seed, tr.PathSpec(yaw_rate=1.0))
    rates = np.abs(path.at_seconds(np.linspace(0, 20, 2000)).angular_rates[:, 2])
    assert 0.9 < rates.max() < 1.1
    lane = Lane.of(path)
    assert np.abs(lane.curvatures).max() < 1 / 7.0
    street = Street.of(path, np.random.default_rng(seed))
    low = street.shapes.spheres[:, 2] - street.shapes.spheres[:, 3] < 2.0
    apart = np.linalg.norm(street.shapes.spheres[low, None, :2] - lane.points, axis=2)
    # Whatever reaches down to the height of a car keeps its middle beyond the side of one.
    assert apart.min() > 1.9


CONTROL = np.random.default_rng(0).normal(size=(3, 20, 2))
ALONG = np.random.default_rng(1).uniform(0, 15, 40)


def test_splines_are_those_of_scipy_and_the_warped_time_the_integral_of_the_pace_that_stands_during_stops():
    grid = _spline_grid(CONTROL, ALONG)
    for k in range(3):
        expected = BSpline(np.arange(-5.0, 21.0), CONTROL[k], 5)
        values, slopes = tr.spline_derivatives(CONTROL, np.full(40, k), ALONG, orders=2)
        # Sums of six products of numbers below 3.
        np.testing.assert_allclose(values, expected(ALONG), atol=1e-13)
        np.testing.assert_allclose(slopes, expected(ALONG, 1), atol=1e-13)
        np.testing.assert_allclose(grid[:, k], values, atol=1e-13)
    at = np.arange(20) - 2.0
    cubic = np.stack([0.3 * at**3 - 2 * at**2 + at, 5.0 - at], axis=1)[None]
    (values,) = tr.spline_derivatives(
        control_points_through(cubic), np.zeros(1, np.int64), np.arange(1.0, 14.0), orders=1
    )
    # The first and last control point keep their samples: two knots from either end nothing is left of that.
    np.testing.assert_allclose(values, cubic[0, 3:16], atol=1e-9)
    warp = tr.TimeWarp.of(STOPS, ramp=RAMP)
    corners = sorted({t for s in STOPS for t in (s.at_s - RAMP, s.at_s, s.at_s + s.for_s, s.at_s + s.for_s + RAMP)})
    for second in (-3.0, 0.0, 2.0, 3.9, 5.0, 7.3, 12.0, 18.5, 22.0, 26.0, 40.0):
        points = [t for t in corners if min(0, second) < t < max(0, second)] or None
        expected, _ = quad(slow_pace, 0.0, second, points=points, limit=200)
        time, pace, _ = warp.at(np.array([second]))
        # quad promises 1.5e-8.
        assert time[0] == pytest.approx(expected, abs=1e-7)
        assert pace[0] == pytest.approx(slow_pace(second), abs=1e-12)
    seconds, step = np.random.default_rng(0).uniform(-5, 40, 300), 1e-5
    before, middle, after = (warp.at(seconds + shift) for shift in (-step, 0.0, step))
    # h²/6 times a third derivative below 10 is 2e-10, rounding of 40 s over 2e-5 s 4e-10.
    np.testing.assert_allclose((after[0] - before[0]) / (2 * step), middle[1], atol=2e-9)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * step), middle[2], atol=2e-9)
    # during a stop it stands to the last bit
    for stop in STOPS:
        time, pace, slope = warp.at(np.linspace(stop.at_s, stop.at_s + stop.for_s, 999))
        assert np.unique(time).size == 1
        assert not np.any([pace, slope])
    seconds = np.random.default_rng(1).uniform(-100, 100, 50)
    for found, expected in zip(tr.TimeWarp.of((), ramp=2.0).at(seconds), (seconds, 1.0, 0.0), strict=True):
        np.testing.assert_array_equal(found, np.broadcast_to(expected, 50))
    for at in (-2.0, 0.0, 1.0):
        assert tr.TimeWarp.of([tr.Stop(at, 3.0)], ramp=2.0).at(np.zeros(1))[0][0] == 0.0


STOPS = (tr.Stop(20.0, 5.0), tr.Stop(4.0, 2.0))
RAMP = 3.0


def slow_pace(second):
    """Pace of a drive with the stops above, written from its description: 1, but 0 in stops, smooth in between."""
    pace = 1.0
    for stop in STOPS:
        if stop.at_s - RAMP < second < stop.at_s:
            x = (stop.at_s - second) / RAMP
        elif stop.at_s <= second <= stop.at_s + stop.for_s:
            x = 0.0
        elif stop.at_s + stop.for_s < second < stop.at_s + stop.for_s + RAMP:
            x = (second - stop.at_s - stop.for_s) / RAMP
        else:
            continue
        pace *= x**3 * (10 - 15 * x + 6 * x * x)
    return pace
