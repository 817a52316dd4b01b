"""The clocks of a whole drive: found, reported, corrected, and in step afterwards."""

from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.errors import OptionError, OutputError
from sceneloom.motion.clock.comparison import ClockVerdict
from sceneloom.pipeline import sync
from sceneloom.pipeline.syncing import AppliedCorrection, corrected_scene
from sceneloom.scene import Scene
from sceneloom.simulate import Faults, GnssSpec, LidarSpec, SensorFaults, inject, simulate_street

BLIND = LidarSpec(beams=1, steps=4, elevations_deg=(-1.0, 1.0))
CHEAP = ("imu", "groundTruth", "gnss")
"""Streams whose motion needs no sweeps."""


@pytest.fixture(scope="module")
def drive():
    return simulate_street(5, frames=300, lidar=BLIND, cameras=(), gnss=GnssSpec(horizontal_sigma=0.02))


@pytest.fixture(scope="module")
def wrong(drive):
    """The trajectory 30 ms late, the receiver 400 ms early and 150 ppm too fast."""
    faults = {"gnss": SensorFaults(time_offset_ns=-400_000_000, clock_skew_ppm=150.0)}
    scene = inject(drive, Faults(faults)).scene
    trajectory = scene.trajectories["groundTruth"]
    late = replace(trajectory, timestamps_ns=trajectory.timestamps_ns + 30_000_000)
    return replace(scene, trajectories={"groundTruth": late})


@pytest.fixture(scope="module")
def corrected(tmp_path_factory):
    """Where the corrected drive is written."""
    return tmp_path_factory.mktemp("corrected") / "right"


@pytest.fixture(scope="module")
def report(wrong, corrected):
    return sync(wrong, corrected, streams=CHEAP)


def test_injected_offsets_are_reported_against_the_imu_and_the_corrected_drive_is_in_step(report, drive, corrected):
    assert report.reference == "imu"
    assert set(report.off) == {"groundTruth", "gnss"}
    trajectory, receiver = (report.comparison(name).estimate for name in ("groundTruth", "gnss"))
    # asked for are 5 ms
    assert trajectory.offset_ns == pytest.approx(3e7, abs=2e6)
    assert abs(receiver.offset_ns + 4e8) < 4 * receiver.offset_sigma_ns
    besides = [c for c in report.comparisons if c.reference == "groundTruth"]
    assert [c.stream for c in besides] == ["gnss"]
    # against a trajectory that is 30 ms late
    assert besides[0].estimate.offset_ns == pytest.approx(-4.3e8 + 150e-6 * 1.5e10, abs=5e6)
    assert [c.stream for c in report.applied] == ["groundTruth", "gnss"]
    assert report.applied[1].through == "groundTruth"
    with sceneloom.open(corrected) as right:
        again = sync(right, streams=CHEAP)
        assert again.off == ()
        truth = drive.scene.sensor("gnss").timestamps_ns
        # the receiver is known to a millisecond through the trajectory, its skew to some tens of ppm over 30 s
        assert np.abs(right.sensor("gnss").timestamps_ns - truth).max() < 6_000_000
        found, true = (scene.trajectories["groundTruth"].timestamps_ns for scene in (right, drive.scene))
        assert np.abs(found - true).max() < 3_000_000


def test_corrections_stand_in_warnings_and_metadata_and_another_reference_rotates_their_signs(wrong):
    correction = AppliedCorrection(stream="groundTruth", offset_ns=3e7, skew_ppm=0.0, at_ns=0)
    changed = corrected_scene(wrong, [correction], reference="imu")
    warning = changed.warnings[-1]
    assert (warning.code, warning.location) == ("clock-corrected", "groundTruth")
    assert "-30.000 ms" in warning.message
    assert changed.metadata["sceneloom"]["clocks"][0]["offset_ns"] == 3e7
    assert corrected_scene(wrong, []) is wrong
    report = sync(wrong, reference="groundTruth", streams=("imu",))
    assert report.reference == "groundTruth"
    assert report.comparison("imu").estimate.offset_ns == pytest.approx(-3e7, abs=2e6)


def test_what_is_not_surely_off_is_not_corrected(wrong, tmp_path):
    report = sync(wrong, tmp_path / "same.sfs", streams=("imu", "groundTruth"), tolerance_ns=30_000_000)
    found = report.comparison("groundTruth").estimate
    assert found.verdict is ClockVerdict.CANNOT_TELL
    assert found.interval_ns[0] < 30_000_000 < found.interval_ns[1]
    assert (report.off, report.applied, report.tolerance_ns) == ((), (), 30_000_000)
    with pytest.raises(OptionError, match="tolerance"):
        sync(wrong, tolerance_ns=0)
    with pytest.raises(OptionError, match="reach: no option"):
        sync(wrong, reach=30.0)


def test_absent_streams_and_an_output_that_exists_are_refused_and_a_drive_without_streams_not(wrong, tmp_path):
    for more in ({"reference": "radar"}, {"streams": ("imu", "radar")}):
        with pytest.raises(OptionError, match=r"radar.*groundTruth"):
            sync(wrong, **more)
    with pytest.raises(OptionError, match="no stream 'x'"):
        corrected_scene(wrong, [AppliedCorrection(stream="x", offset_ns=0.0, skew_ppm=0.0, at_ns=0)])
    (tmp_path / "there.sfs").touch()
    with pytest.raises(OutputError, match="exists"):
        sync(wrong, tmp_path / "there.sfs", streams=CHEAP)
    report = sync(Scene(()))
    assert (report.reference, report.comparisons) == (None, ())


@pytest.mark.slow
def test_a_lidar_is_compared_by_its_odometry():
    faults = Faults({"lidar": SensorFaults(time_offset_ns=30_000_000)})
    lidar = LidarSpec(beams=24, steps=360)
    scene = simulate_street(2, frames=70, lidar=lidar, cameras=(), faults=faults).scene
    reported = []
    report = sync(scene, streams=("lidar",), progress=lambda done, total: reported.append((done, total)))
    found = report.comparison("lidar").estimate
    assert found.verdict is ClockVerdict.OFF
    # asked for are 5 ms
    assert found.offset_ns == pytest.approx(3e7, abs=5e6)
    assert reported[-1] == (70, 70)
