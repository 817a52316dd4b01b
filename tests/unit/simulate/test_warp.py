import numpy as np
import pytest
from scipy.integrate import quad

from sceneloom.errors import OptionError
from sceneloom.simulate import PathSpec, Stop
from sceneloom.simulate.trajectory import TimeWarp

STOPS = (Stop(20.0, 5.0), Stop(4.0, 2.0))
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


@pytest.fixture(scope="module")
def warp():
    return TimeWarp.of(STOPS, ramp=RAMP)


def test_the_warped_time_is_the_integral_of_the_pace(warp):
    corners = sorted(
        {t for s in STOPS for t in (s.at_s - RAMP, s.at_s, s.at_s + s.for_s, s.at_s + s.for_s + RAMP)}
    )
    for second in (-3.0, 0.0, 2.0, 3.9, 5.0, 7.3, 12.0, 18.5, 22.0, 26.0, 40.0):
        points = [t for t in corners if min(0, second) < t < max(0, second)] or None
        expected, _ = quad(slow_pace, 0.0, second, points=points, limit=200)
        time, pace, _ = warp.at(np.array([second]))
        # quad promises 1.5e-8.
        assert time[0] == pytest.approx(expected, abs=1e-7)
        assert pace[0] == pytest.approx(slow_pace(second), abs=1e-12)


def test_the_pace_and_its_slope_are_derivatives_of_the_warped_time(warp):
    seconds, step = np.random.default_rng(0).uniform(-5, 40, 300), 1e-5
    before, middle, after = (warp.at(seconds + shift) for shift in (-step, 0.0, step))
    # h²/6 times a third derivative below 10 is 2e-10, rounding of 40 s over 2e-5 s 4e-10.
    np.testing.assert_allclose((after[0] - before[0]) / (2 * step), middle[1], atol=2e-9)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * step), middle[2], atol=2e-9)


def test_during_a_stop_the_warped_time_is_the_same_to_the_last_bit(warp):
    for stop in STOPS:
        time, pace, slope = warp.at(np.linspace(stop.at_s, stop.at_s + stop.for_s, 999))
        assert np.unique(time).size == 1
        assert not pace.any()
        assert not slope.any()


def test_without_stops_nothing_is_warped():
    seconds = np.random.default_rng(1).uniform(-100, 100, 50)
    time, pace, slope = TimeWarp.of((), ramp=2.0).at(seconds)
    np.testing.assert_array_equal(time, seconds)
    assert (pace == 1).all()
    assert (slope == 0).all()


def test_time_zero_stays_zero_even_in_a_stop():
    for at in (-2.0, 0.0, 1.0):
        assert TimeWarp.of([Stop(at, 3.0)], ramp=2.0).at(np.zeros(1))[0][0] == 0.0


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: Stop(np.nan, 1.0),
        lambda: Stop(0.0, -1.0),
        lambda: PathSpec(stops=(Stop(0.0, 5.0), Stop(12.0, 1.0)), ramp=4.0),
        lambda: PathSpec(speeds=(9.0, 5.0)),
        lambda: PathSpec(speeds=(0.0, 5.0)),
        lambda: PathSpec(yaw_rate=2.0),
        lambda: PathSpec(yaw_rate=float("nan")),
        lambda: PathSpec(ramp=0.0),
    ],
)
def test_ways_that_nobody_can_drive_are_refused(wrong):
    with pytest.raises(OptionError, match="expected"):
        wrong()
