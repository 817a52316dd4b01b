"""What is written of a drive names its files, and not the folders of the machine that it was written on."""

from dataclasses import replace

import pytest

import sceneloom
from sceneloom.errors import without_folders
from sceneloom.scene import DataWarning, WarningKind

TARGETS = {
    "sfs": ".sfs",
    "mcap": ".mcap",
    "openlabel": ".json",
    "ros2": "",
    "nuscenes": "",
    "kitti-raw": "",
    "kitti-object": "",
    "recording": "",
    "pcd": "",
    "ply": "",
}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """KITTI's frames: on reading them something is assumed of their folder."""
    folder = tmp_path_factory.mktemp("secret-home") / "drive"
    scene = sceneloom.simulate_street(3, frames=2).scene
    sceneloom.write(scene, folder.parent / "a.sfs")
    sceneloom.convert(folder.parent / "a.sfs", folder, to="kitti-object")
    return folder


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.few(5)
def test_no_target_holds_the_folder_of_its_source(source, target, tmp_path):
    out = tmp_path / f"out{TARGETS[target]}"
    sceneloom.convert(source, out, to=target, loss=tmp_path / "loss.json")
    files = [out] if out.is_file() else [path for path in out.rglob("*") if path.is_file()]
    for path in (*files, tmp_path / "loss.json"):
        assert b"secret-home" not in path.read_bytes(), path


def test_an_assumption_names_the_drive_alone_and_what_was_repaired_is_not_reported_again(source, tmp_path):
    repaired = DataWarning(
        kind=WarningKind.REPAIRED, code="poses-sorted", location=f"{source}/oxts.txt", message="sorted"
    )
    with sceneloom.open(source) as scene:
        reported = replace(scene, warnings=(*scene.warnings, repaired))
        sceneloom.write(reported, tmp_path / "b.sfs")
    with sceneloom.open(tmp_path / "b.sfs") as again:
        locations = [n.location for n in again.warnings if n.code == "frames-apart"]
        assert locations
        assert not any("secret-home" in location for location in locations)
        assert "poses-sorted" not in {n.code for n in again.warnings}


@pytest.mark.parametrize(
    ("text", "source", "expected"),
    [
        ("/x/me/drives/a/calib.txt: odd", "/x/me/drives/a", "a/calib.txt: odd"),
        ("drives/a: odd", "drives/a", "a: odd"),
        ("topic /lidar/points", "/x/me/a.mcap", "topic /lidar/points"),
        ("/x/a and /y/b", "/x/a + /y/b", "a and b"),
        ("s3://bucket/a.sfs", "s3://bucket/a.sfs", "s3://bucket/a.sfs"),
        ("a.sfs", "a.sfs", "a.sfs"),
    ],
)
def test_folders_above_the_source_are_left_out_and_nothing_else(text, source, expected):
    assert without_folders(text, source) == expected
