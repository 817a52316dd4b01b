"""Units of timestamps out of rates and dates."""

import numpy as np
import pytest

from sceneloom.calibrate.conventions import UNITS_NS, time_units

RATES = {
    "lidar": (5, 10, 20),
    "camera": (10, 30, 60),
    "radar": (13, 20),
    "imu": (100, 200, 400),
    "gnss": (1, 10),
}
STARTS_S = (0.0, -3.0, 12.5, 1_317_000_000.0)


@pytest.mark.parametrize(("kind", "rate"), [(kind, rate) for kind, rates in RATES.items() for rate in rates])
@pytest.mark.parametrize("unit", UNITS_NS)
@pytest.mark.parametrize("start", STARTS_S)
def test_usual_sensors_report_their_unit(kind, rate, unit, start):
    timestamps = (start + np.arange(50) / rate) * 1e9 / UNITS_NS[unit]
    assert time_units(timestamps, kind) == (unit,)


def test_a_gap_and_repeated_timestamps_change_nothing():
    timestamps = [0, 0, 100, 200, 300, 5000, 5100, 5100, 5200]
    assert time_units(timestamps, "lidar") == ("milliseconds",)


@pytest.mark.parametrize("timestamps", [[], [1.0], [2.0, 2.0], [np.nan, np.inf]])
def test_too_few_timestamps_state_nothing(timestamps):
    assert time_units(timestamps, "lidar") == ()


def test_a_rate_that_no_sensor_has_fits_no_unit():
    # 9,091 Hz in microseconds, 9.1 Hz in milliseconds: too fast and too slow for an IMU
    assert time_units(np.arange(10) * 110.0, "imu") == ()
