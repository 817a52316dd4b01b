"""Files are found below one folder, and nowhere else."""

import pytest

from sceneloom.errors import DataError

LIDAR = 'files = "top/*.bin"'


@pytest.mark.parametrize(
    "pattern", ["../top/*.bin", "/top/*.bin", "top/../../x/*.bin", "C:/top/*.bin", r"\\\\host\\top\\*.bin"]
)
def test_patterns_that_lead_out_are_refused(opened, pattern):
    with pytest.raises(DataError, match=r"expected a path below .*; name another folder with `root`"):
        opened((LIDAR, f'files = "{pattern}"'))


@pytest.mark.parametrize("pattern", ["a**b/*.bin", "[", "top/*.pcd", "nowhere/*.bin", "."])
def test_patterns_without_files_or_sense_are_reported(opened, pattern):
    with pytest.raises(DataError, match=r"sensors\[0\] \(top\)\.files: "):
        opened((LIDAR, f'files = "{pattern}"'))


def test_what_there_is_instead_of_a_missing_file_is_reported(opened):
    with pytest.raises(DataError, match=r"'top/\*\.pcd': no such files in .*; top has \*\.bin"):
        opened((LIDAR, 'files = "top/*.pcd"'))


def test_links_that_lead_out_are_refused_and_a_root_is_named_in_their_location(opened, folder, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("disk")
    (folder / "top").rename(elsewhere / "top")
    (folder / "top").symlink_to(elsewhere / "top")
    with pytest.raises(DataError, match=r"leads out of .* by a link, to .*; name the folder .* as `root`"):
        opened()
    scene = opened((LIDAR, f'{LIDAR}\nroot = "{elsewhere}"'))
    assert len(scene.lidars[0].frames) == 3
    assert [warning.code for warning in scene.warnings] == ["root-elsewhere"]


def test_a_single_file_may_not_be_a_link_that_leads_out(opened, folder, tmp_path_factory):
    outside = tmp_path_factory.mktemp("disk") / "poses.txt"
    (folder / "poses.txt").rename(outside)
    (folder / "poses.txt").symlink_to(outside)
    with pytest.raises(DataError, match=r"'poses.txt' leads out of"):
        opened()


def test_links_inside_the_folder_are_followed(opened, folder):
    (folder / "top").rename(folder / "kept")
    (folder / "top").symlink_to(folder / "kept")
    assert len(opened().lidars[0].frames) == 3


def test_all_files_may_lie_below_another_root(opened, folder):
    (folder / "raw").mkdir()
    for name in ("top", "front", "poses.txt"):
        (folder / name).rename(folder / "raw" / name)
    scene = opened(('ego = "base"', 'ego = "base"\nroot = "raw"'))
    assert len(scene.sensors) == 2
    assert scene.warnings == ()


def test_a_root_that_is_not_there_is_reported(opened):
    with pytest.raises(DataError, match="root: 'raw': no such folder"):
        opened(('ego = "base"', 'ego = "base"\nroot = "raw"'))


def test_files_of_several_patterns_are_each_taken_once(opened):
    assert len(opened((LIDAR, 'files = ["top/*.bin", "**/*0.bin"]')).lidars[0].frames) == 3


@pytest.mark.parametrize(
    ("pattern", "reported"),
    [
        ("'top\\*.bin'", "and the folders front, top; folders are separated by /"),
        ('"top[1]/*.bin"', r"and the folders front, top; \[ \] stand for a choice of characters: write \[\[\]"),
        ('"*.bin"', r"has \*\.toml, \*\.txt and the folders front, top$"),
    ],
)
def test_what_kept_a_pattern_from_fitting_is_reported(opened, pattern, reported):
    with pytest.raises(DataError, match=reported):
        opened(('"top/*.bin"', pattern))


def test_a_folder_without_folders_is_stated_to_have_none(opened, folder):
    (folder / "bare").mkdir()
    with pytest.raises(DataError, match="bare has no folders"):
        opened(('files = "top/*.bin"', 'files = "top/*.bin"\nroot = "bare"'))
