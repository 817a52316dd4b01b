"""What a session takes the detectors for."""

import pytest
from tests.unit.fusion.sending import boxes_2d, boxes_3d, calibration

from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.types import Cause
from sceneloom.detections.detectors import detector_names


def confidence_with(detectors):
    with FusionInterface(inline=True) as fusion:
        assert fusion.set_calibration(calibration(), camera_id=1)
        assert fusion.set_property("detectors", detectors)
        assert fusion.send(boxes_2d(0, 0))
        assert fusion.send(boxes_3d(0, 0))
        fusion.flush()
        return fusion.get(1).record.confidence[0]


def test_confidence_is_that_of_the_detectors_that_are_named():
    found = {name: float(confidence_with(name)) for name in detector_names()}
    assert len(set(found.values())) == len(found) >= 3
    assert all(0.5 < confidence <= 1.0 for confidence in found.values())


@pytest.mark.parametrize("name", ["nobody", "", "/etc/passwd", "other.toml"])
def test_detectors_that_do_not_come_with_the_package_are_refused(name):
    with FusionInterface(inline=True) as fusion:
        outcome = fusion.set_property("detectors", name)
        assert outcome.cause is Cause.OUT_OF_RANGE
        assert "simulated" in outcome.reason
        assert fusion.get_property("detectors") == "simulated"
