"""Real, good data pass every rule: what is found in them is true of them."""

from pathlib import Path

import pytest

import sceneloom

KNOWN_FINDINGS = {
    "recordings/kitti_drive": {"ego-trajectory-known", "imu-there"},
    "recordings/kitti_oxts_0000": {"calibration-there", "stream-rate"},
    "recordings/pandaset": {"point-times-equal", "imu-there"},
    "real/sfs_reference/argoverse2_2frames_cuboids.sfs": {"reading-assumed", "cuboid-angles-unsaid"},
}
"""What is known of the data: no ego trajectory, no IMU or a slow one, times that are the frame's own, frame and angles
that are not stated."""


@pytest.mark.few(4)
@pytest.mark.parametrize("name", KNOWN_FINDINGS)
@pytest.mark.parametrize("profile", ["sfs", "scale"])
def test_real_data_give_the_findings_that_are_true_of_them_and_nothing_else(data_dir: Path, name, profile):
    report = sceneloom.validate(data_dir / name, profile=profile)
    found = [(f.severity, f.rule, f.path, f.message) for f in report.findings]
    assert report.passed, found
    assert {finding.rule for finding in report.findings} == KNOWN_FINDINGS[name], found


@pytest.mark.parametrize("name", ["recordings/kitti_drive", "real/sfs_reference/argoverse2_2frames_cuboids.sfs"])
def test_what_fixing_writes_of_real_data_is_as_good(data_dir: Path, tmp_path, name):
    target = tmp_path / "fixed.sfs"
    report = sceneloom.validate(data_dir / name, fix=target, strict=True)
    assert report.passed
    assert report.fixed == report.left_out == ()
