"""How long the sweeps of a lidar take, reported by their timestamps."""

import numpy as np
import pytest

from sceneloom.scene.scene import NOMINAL_PERIOD_NS, usual_period_ns


@pytest.mark.parametrize(
    ("timestamps", "expected"),
    [
        ([0, 100, 200, 350], 100),
        ([200, 0, 350, 100], 100),
        ([0, 0, 0, 70], 70),
        ([5], NOMINAL_PERIOD_NS),
        ([5, 5], NOMINAL_PERIOD_NS),
        ([], NOMINAL_PERIOD_NS),
    ],
)
def test_the_usual_period_is_the_middle_one_of_the_steps_forward(timestamps, expected):
    assert usual_period_ns(np.array(timestamps, np.int64)) == expected
