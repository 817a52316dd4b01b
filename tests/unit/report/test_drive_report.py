"""What is reported first, out of evidence that is made for it."""

import msgspec
import numpy as np
import pytest

from sceneloom.calibrate.health import Verdict as Health
from sceneloom.checks import validate
from sceneloom.pipeline.fusing import CameraReport
from sceneloom.report.annotations import Labels
from sceneloom.report.coverage import CloudCoverage, Coverage
from sceneloom.report.drive_report import Verdict
from sceneloom.report.fusion import CalibrationCheck, Fusion
from sceneloom.report.page import ReportSettings, collect
from sceneloom.report.timing import Timing, stream_timing
from sceneloom.scene import Finding, Scene, Severity


def verdict(**parts):
    """The verdict on a drive of which nothing but these parts is known."""
    empty = collect(Scene(()), ReportSettings(quick=True)).report
    return Verdict.of(msgspec.structs.replace(empty, **{"validation": None, "left_out": {}, **parts}))


def titles(**parts):
    return [advice.title for advice in verdict(**parts).advices]


def test_the_worst_finding_decides_and_comes_first_and_nothing_wrong_is_in_order():
    found = verdict()
    assert (found.state, found.advices) == ("sound", ())
    assert found.contents == "0.0 s in the format memory: no sensors. The ego trajectory is not known."
    hint, warning, error = Severity.HINT, Severity.WARNING, Severity.ERROR
    for severities, state in (([hint], "sound"), ([hint, warning], "look"), ([warning, error], "faulty")):
        findings = tuple(
            Finding(rule=f"rule-{k}", severity=severity, path=f"p[{k}]", message="m", remedy="do it")
            for k, severity in enumerate(severities)
        )
        found = verdict(validation=msgspec.structs.replace(validate(Scene(())), findings=findings))
        assert found.state == state
        assert [advice.severity for advice in found.advices] == sorted(severities, key=list(Severity).index)
        assert all(advice.remedy == "do it" for advice in found.advices)


def test_a_stream_with_gaps_is_reported_with_the_longest_and_an_even_one_is_not():
    def timing(*lost):
        times = np.delete(np.arange(30, dtype=np.int64) * 100_000_000, lost)
        return Timing(streams=(stream_timing("camera0", "camera", times, start_ns=0),), overlap_share=1.0)

    (advice,) = verdict(timing=timing(5, 10, 11)).advices
    assert advice.title == "camera0 lacks 3 of 30"
    assert advice.detail == "2 gaps; the longest gap is 0.30 s at 0.90 s"
    assert titles(timing=timing()) == []


@pytest.mark.parametrize(
    ("health", "state"),
    [(Health.WRONG, "faulty"), (Health.DRIFTING, "look"), (Health.GOOD, "sound"), (Health.UNDETERMINED, "sound")],
)
def test_a_calibration_is_reported_where_it_is_off(health, state):
    check = CalibrationCheck(camera="camera0", lidar="lidar", verdict=health.value)
    assert verdict(calibration=(check,)).state == state


def test_what_cameras_and_lidars_miss_and_boxes_without_points_are_reported():
    def fusion(**camera):
        known = {
            "camera": "camera0", "images": 9, "paired": 9, "unpaired": 0, "unposed": 0, "in_image_percent": 20.0,
            "hidden_percent": 1.0, "coloured": 100,
        }  # fmt: skip
        cameras = (CameraReport(**known | camera),)
        return Fusion(trajectory=None, sweeps=9, of=9, points=900, coloured_percent=20.0, cameras=cameras)

    assert titles(fusion=fusion()) == []
    assert titles(fusion=fusion(in_image_percent=0.0)) == ["No point falls into the images of camera0"]
    assert titles(fusion=fusion(paired=0, unpaired=9)) == ["No image of camera0 goes with a sweep"]
    points = {"points_mean": 5.0, "points_least": 0, "points_most": 9}
    cloud = CloudCoverage(sensor="lidar", type="lidar", sweeps=3, of=3, **points, rings=(4.0, 0.0))
    expected = ["lidar has sweeps without points", "1 ring of lidar without points"]
    assert titles(coverage=Coverage(clouds=(cloud,))) == expected
    begins_anywhere = msgspec.structs.replace(cloud, points_least=5, rings=(0.0, 0.0, 4.0))
    assert titles(coverage=Coverage(clouds=(begins_anywhere,))) == []
    for counts, told in (((6, 3, 0, 0, 0, 0, 0), ["Most boxes hold no point"]), ((3, 6, 0, 0, 0, 0, 0), [])):
        assert titles(labels=Labels(types={"cuboid": 9}, point_counts=counts)) == told
