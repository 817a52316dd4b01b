"""What is reported first, out of evidence that is made for it."""

import msgspec
import numpy as np
import pytest

from sceneloom.calibrate.health import Verdict as Health
from sceneloom.checks import validate
from sceneloom.pipeline.fusing import CameraReport
from sceneloom.report.annotations import Labels
from sceneloom.report.coverage import CloudCoverage, Coverage
from sceneloom.report.drive_report import DriveReport, Verdict, provenance_of
from sceneloom.report.fusion import CalibrationCheck, Fusion
from sceneloom.report.timing import Timing, stream_timing
from sceneloom.report.trajectory import Metrics, Trajectories
from sceneloom.scene import Finding, Scene, Severity
from sceneloom.scene.summary import summarise


def evidence(**parts):
    known = {
        "summary": summarise(Scene(())),
        "timing": Timing(streams=()),
        "trajectories": Trajectories(trajectories=()),
        "coverage": Coverage(),
        "calibration": (),
        "fusion": None,
        "labels": None,
        "metrics": Metrics(),
        "validation": None,
        "conversions": (),
        "losses": (),
        "warnings": (),
        "provenance": provenance_of(Scene(()), None, {}),
    }
    return DriveReport(name="drive", **{**known, **parts})


def titles(**parts):
    return [advice.title for advice in Verdict.of(evidence(**parts)).advices]


def test_nothing_wrong_is_in_order():
    found = Verdict.of(evidence())
    assert (found.state, found.advices) == ("sound", ())
    assert found.contents == "0.0 s in the format memory: no sensors. The ego trajectory is not known."


def findings(*severities):
    found = tuple(
        Finding(rule=f"rule-{k}", severity=severity, path=f"p[{k}]", message="m", remedy="do it")
        for k, severity in enumerate(severities)
    )
    return msgspec.structs.replace(validate(Scene(())), findings=found)


@pytest.mark.parametrize(
    ("severities", "state"),
    [
        ([Severity.HINT], "sound"),
        ([Severity.HINT, Severity.WARNING], "look"),
        ([Severity.WARNING, Severity.ERROR], "faulty"),
    ],
)
def test_the_worst_finding_decides_and_comes_first(severities, state):
    found = Verdict.of(evidence(validation=findings(*severities)))
    assert found.state == state
    order = list(Severity)
    assert [advice.severity for advice in found.advices] == sorted(severities, key=order.index)
    assert all(advice.remedy == "do it" for advice in found.advices)


def stream(count=30, lost=()):
    times = np.delete(np.arange(count, dtype=np.int64) * 100_000_000, list(lost))
    return stream_timing("camera0", "camera", times, start_ns=0)


def test_a_stream_with_gaps_is_reported_with_the_longest():
    (title,) = titles(timing=Timing(streams=(stream(lost=(5, 10, 11)),), overlap_share=1.0))
    assert title == "camera0 lacks 3 of 30"
    (advice,) = Verdict.of(evidence(timing=Timing(streams=(stream(lost=(5, 10, 11)),)))).advices
    assert advice.detail == "2 gaps; the longest gap is 0.30 s at 0.90 s"


def test_an_even_stream_is_not_reported():
    assert titles(timing=Timing(streams=(stream(),), overlap_share=1.0)) == []


@pytest.mark.parametrize(
    ("verdict", "state"), [("wrong", "faulty"), ("drifting", "look"), ("good", "sound"), ("cannot determine", "sound")]
)
def test_a_calibration_is_reported_where_it_is_off(verdict, state):
    assert verdict in {each.value for each in Health}
    check = CalibrationCheck(camera="camera0", lidar="lidar", verdict=verdict)
    assert Verdict.of(evidence(calibration=(check,))).state == state


def fusion(**camera):
    known = {
        "camera": "camera0", "images": 9, "paired": 9, "unpaired": 0, "unposed": 0, "in_image_percent": 20.0,
        "hidden_percent": 1.0, "coloured": 100,
    }  # fmt: skip
    return Fusion(
        trajectory=None, sweeps=9, of=9, points=900, coloured_percent=20.0, cameras=(CameraReport(**known | camera),)
    )


def test_a_camera_without_points_or_without_sweeps_is_reported():
    assert titles(fusion=fusion()) == []
    assert titles(fusion=fusion(in_image_percent=0.0)) == ["No point falls into the images of camera0"]
    assert titles(fusion=fusion(paired=0, unpaired=9)) == ["No image of camera0 goes with a sweep"]


def test_silent_rings_between_others_and_empty_sweeps_are_reported():
    points = {"points_mean": 5.0, "points_least": 0, "points_most": 9}
    cloud = CloudCoverage(sensor="lidar", type="lidar", sweeps=3, of=3, **points, rings=(4.0, 0.0))
    expected = ["lidar has sweeps without points", "1 ring of lidar without points"]
    assert titles(coverage=Coverage(clouds=(cloud,))) == expected
    begins_anywhere = msgspec.structs.replace(cloud, points_least=5, rings=(0.0, 0.0, 4.0))
    assert titles(coverage=Coverage(clouds=(begins_anywhere,))) == []


def test_boxes_without_points_are_reported():
    most = Labels(types={"cuboid": 9}, point_counts=(6, 3, 0, 0, 0, 0, 0))
    assert titles(labels=most) == ["Most boxes hold no point"]
    few = Labels(types={"cuboid": 9}, point_counts=(3, 6, 0, 0, 0, 0, 0))
    assert titles(labels=few) == []
