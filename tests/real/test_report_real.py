"""Reports of real drives, whose figures are known from elsewhere."""

import pytest

from sceneloom.report import ReportSettings, write_report


def test_a_drive_of_fixes_has_its_length_and_its_north(data_dir):
    found = write_report(data_dir / "recordings" / "kitti_oxts_0000")
    (trajectory,) = found.trajectories.trajectories
    assert trajectory.metres == pytest.approx(69.4, abs=0.1)
    assert found.trajectories.fixes[0].usable == 154
    # its ground truth is the fixes themselves in axes east, north, up
    assert found.trajectories.north.direction_deg == pytest.approx(90.0, abs=0.1)
    assert found.trajectories.north.rms < 0.05


@pytest.mark.slow
def test_shares_of_points_in_images_are_the_known_ones(data_dir):
    found = write_report(data_dir / "recordings" / "pandaset", settings=ReportSettings(quick=True))
    shares = [camera.in_image_percent for camera in found.fusion.cameras]
    assert shares == pytest.approx([40.0, 21.8, 14.5], abs=0.15)
    headings = [camera.heading_deg for camera in found.coverage.cameras]
    assert abs(headings[0]) < 5.0  # ahead
    assert 45.0 < headings[1] < 75.0  # ahead left
    assert abs(headings[2]) > 170.0  # back


@pytest.mark.slow
def test_the_page_of_a_drive_of_kitti_is_made_whole(data_dir, tmp_path):
    page = tmp_path / "report.html"
    found = write_report(data_dir / "recordings" / "kitti_drive", page)
    assert [check.verdict for check in found.calibration] == ["good"]
    assert found.left_out == {}
    assert page.stat().st_size < 1_500_000
