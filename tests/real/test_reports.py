"""Real, good data pass every rule, and reports, coloured clouds and remote folders of them have known figures."""

import laspy
import numpy as np
import pytest
from tests.unit.formats.conftest import digest

import sceneloom
from sceneloom.formats.remote import stores
from sceneloom.pipeline import ColourSettings
from sceneloom.report import ReportSettings, write_report

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
def test_real_data_give_the_findings_that_are_true_of_them_and_what_fixing_writes_is_as_good(
    drive, tmp_path, name, profile
):
    report = sceneloom.validate(drive(name), profile=profile)
    found = [(f.severity, f.rule, f.path, f.message) for f in report.findings]
    assert report.passed, found
    assert {finding.rule for finding in report.findings} == KNOWN_FINDINGS[name], found
    if name.endswith(("kitti_drive", ".sfs")):
        report = sceneloom.validate(drive(name), fix=tmp_path / "fixed.sfs", strict=True)
        assert (report.passed, report.fixed, report.left_out) == (True, (), ())


def test_a_drive_of_fixes_has_its_length_and_its_north(drive):
    found = write_report(drive("recordings/kitti_oxts_0000"))
    (trajectory,) = found.trajectories.trajectories
    assert trajectory.metres == pytest.approx(69.4, abs=0.1)
    assert found.trajectories.fixes[0].usable == 154
    # its ground truth is the fixes themselves in axes east, north, up
    assert found.trajectories.north.direction_deg == pytest.approx(90.0, abs=0.1)
    assert found.trajectories.north.rms < 0.05


@pytest.mark.slow
def test_pages_of_drives_are_made_whole_with_known_shares_of_points_in_images(drive, tmp_path):
    found = write_report(drive("recordings/pandaset"), settings=ReportSettings(quick=True))
    shares = [camera.in_image_percent for camera in found.fusion.cameras]
    assert shares == pytest.approx([40.0, 21.8, 14.5], abs=0.15)
    headings = [camera.heading_deg for camera in found.coverage.cameras]
    assert abs(headings[0]) < 5.0  # ahead
    assert 45.0 < headings[1] < 75.0  # ahead left
    assert abs(headings[2]) > 170.0  # back
    found = write_report(drive("recordings/kitti_drive"), tmp_path / "report.html")
    assert [check.verdict for check in found.calibration] == ["good"]
    assert found.left_out == {}
    assert (tmp_path / "report.html").stat().st_size < 1_500_000


@pytest.mark.slow
def test_the_seam_between_two_cameras_of_pandaset_is_evened_out(drive, tmp_path):
    with sceneloom.open(drive("recordings/pandaset")) as scene:
        report = sceneloom.colour(scene, tmp_path / "map.laz", settings=ColourSettings(voxel=0.1, remove_moving=True))
    found = report.exposure
    assert found.seam_points > 500
    assert found.seam_after < 0.5 * found.seam_before
    assert found.alone == ("camera2",)  # which looks back
    assert 60 < report.coloured_percent < 72  # of 40 + 21.8 + 14.6 % in the images, some in two of them
    assert 0 < report.removed_by_rays < 0.05 * report.points
    assert report.removed_in_boxes == 0
    read = laspy.read(tmp_path / "map.laz")
    assert len(read) == report.written
    assert set(np.unique(np.asarray(read.camera)).tolist()) == {0, 1, 2, 255}


@pytest.mark.parametrize(
    ("name", "options", "share"),
    [
        ("recordings/kitti_drive", {}, 0.05),
        ("recordings/pandaset", {}, 0.15),
        ("real/argoverse2", {}, 0.3),
        ("real/kitti_object", {}, 0.3),
        ("real/kitti_tracking", {"sequence": "0013"}, 1.0),
        ("real/pandaset_scale_sample", {}, 0.7),
    ],
)
@pytest.mark.few(3)
def test_folders_behind_urls_hold_what_they_hold_on_disk_and_opening_takes_a_part(
    drive, monkeypatch, name, options, share
):
    fetched, get = [], stores.Store.get

    def noted(self, target):
        get(self, target)
        fetched.append(target.stat().st_size)

    monkeypatch.setattr(stores.Store, "get", noted)
    folder = drive(name)
    whole = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    with sceneloom.open(folder, **options) as local, sceneloom.open(f"local://{folder}", **options) as remote:
        assert sum(fetched) <= share * whole
        assert digest(remote) == digest(local)
