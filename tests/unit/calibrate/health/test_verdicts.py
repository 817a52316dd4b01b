"""From numbers to verdicts."""

import numpy as np
import pytest

from sceneloom.calibrate.health import Verdict, judge

NOTHING = np.zeros((3, 3))


@pytest.mark.parametrize(
    ("rotation_deg", "sigma_deg", "verdict"),
    [
        (0.0, 0.05, Verdict.GOOD),
        (0.35, 0.05, Verdict.GOOD),
        (0.7, 0.05, Verdict.DRIFTING),
        (0.7, 0.3, Verdict.UNDETERMINED),
        (1.5, 0.05, Verdict.WRONG),
        (0.0, 0.5, Verdict.UNDETERMINED),
        (1.5, 0.5, Verdict.UNDETERMINED),
    ],
)
def test_a_rotation_is_judged_by_its_size_and_by_how_sure_it_is(rotation_deg, sigma_deg, verdict):
    item = judge("rotation", np.radians([rotation_deg, 0.0, 0.0]), np.radians(sigma_deg) ** 2 * np.eye(3))
    assert item.verdict is verdict
    assert bool(item.reason) is (verdict is not Verdict.GOOD)


def test_numbers_come_in_the_units_that_they_name():
    item = judge("time_offset", np.array([0.03]), np.array([[0.003**2]]))
    # the deviation: 3 ms among replicates and 4 ms that the measures get wrong by themselves
    assert (item.unit, item.values, item.sigmas) == ("ms", (pytest.approx(30.0),), (pytest.approx(5.0),))
    assert item.verdict is Verdict.DRIFTING


def test_what_seems_off_but_may_be_chance_is_suspected():
    spread = np.diag([0.05, 0.05, 0.05]) ** 2
    assert not judge("translation", np.zeros(3), spread * 4).suspected
    assert judge("translation", np.array([0.5, 0.0, 0.0]), spread * 4).suspected
