"""Clocks of the recordings that were made from real logs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sceneloom.formats.recording.spec import FORMAT
from sceneloom.motion.clock.comparison import ClockVerdict
from sceneloom.motion.clock.streams import gyroscope_against_trajectory
from sceneloom.pipeline import sync


def opened(data_dir: Path, name: str):
    folder = data_dir / "recordings" / name
    if not folder.is_dir():
        pytest.skip(f"no recording at {folder}")
    return FORMAT.open(folder)


def oxts(data_dir: Path):
    with opened(data_dir, "kitti_oxts_0000") as scene:
        return scene.sensor("imu").streams["gyroscope"], scene.trajectories["groundTruth"]


def test_rates_of_the_oxts_unit_are_means_over_the_sample_before(data_dir):
    """So they are half a sample late: the rotation from pose k to k + 1 is rate k + 1, not the mean of both."""
    gyroscope, trajectory = oxts(data_dir)
    found = gyroscope_against_trajectory(gyroscope, trajectory)
    assert found.offset_ns == pytest.approx(-5e7, abs=8e6)
    assert found.verdict is ClockVerdict.OFF


@pytest.mark.parametrize("offset_ns", [-1_000_000_000, -30_000_000, 30_000_000, 300_000_000, 1_000_000_000])
def test_an_injected_offset_comes_back_on_top_of_that(data_dir, offset_ns):
    gyroscope, trajectory = oxts(data_dir)
    late = replace(trajectory, timestamps_ns=trajectory.timestamps_ns + offset_ns, file_seconds=None)
    as_it_is = gyroscope_against_trajectory(gyroscope, trajectory).offset_ns
    # the same samples, cut a little differently at the ends
    assert gyroscope_against_trajectory(gyroscope, late).offset_ns - as_it_is == pytest.approx(offset_ns, abs=2e6)


def test_fixes_that_are_the_trajectory_are_in_step_with_it(data_dir):
    with opened(data_dir, "kitti_oxts_0000") as scene:
        report = sync(scene, reference="groundTruth", streams=("gnss",))
    found = report.comparison("gnss").estimate
    assert (found.verdict, abs(found.offset_ns) < 1e4) == (ClockVerdict.IN_STEP, True)


@pytest.mark.parametrize("name", ["pandaset"])
def test_half_a_second_is_too_short_to_report_anything(data_dir, name):
    with opened(data_dir, name) as scene:
        report = sync(scene, streams=("groundTruth", "camera0"))
    assert {c.estimate.verdict for c in report.comparisons} == {ClockVerdict.NOT_OBSERVABLE}
    assert all("samples" in c.estimate.reason for c in report.comparisons)


def test_rates_in_degrees_change_no_clock(data_dir):
    gyroscope, trajectory = oxts(data_dir)
    scaled = replace(gyroscope, values=np.degrees(gyroscope.values))
    found = gyroscope_against_trajectory(scaled, trajectory)
    assert found.verdict is ClockVerdict.NOT_OBSERVABLE or found.offset_ns == pytest.approx(-5e7, abs=2e7)
