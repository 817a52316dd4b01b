"""Real recordings that are written again, at once or through a scene file, state the same line by line."""

import json

import pytest

import sceneloom

NAMES = ("kitti_drive", "pandaset", "kitti_oxts_0000")


def lines_of(folder):
    lines = [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]
    return sorted(lines, key=lambda line: (line["time"], json.dumps(line, sort_keys=True)))


def files_of(folder):
    """The files that are a recording's own; a README says where it is from."""
    found = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return sorted(path for path in found if path.name != "README.txt")


@pytest.mark.parametrize("name", NAMES)
def test_a_real_recording_that_is_written_again_is_the_same(data_dir, tmp_path, name):
    source = data_dir / "recordings" / name
    report = sceneloom.convert(source, tmp_path / "again")
    assert {loss.field for loss in report.losses} <= {"replay"}
    assert lines_of(tmp_path / "again") == lines_of(source)
    assert files_of(tmp_path / "again") == files_of(source)
    for file in files_of(source):
        if file.suffix == ".json":
            assert json.loads((tmp_path / "again" / file).read_text()) == json.loads((source / file).read_text())
        elif file.name != "data.jsonl":
            assert (tmp_path / "again" / file).read_bytes() == (source / file).read_bytes(), file


@pytest.mark.parametrize("name", ["pandaset", "kitti_oxts_0000"])
def test_a_scene_file_keeps_all_that_a_real_recording_says(data_dir, tmp_path, name):
    source = data_dir / "recordings" / name
    sceneloom.convert(source, tmp_path / "scene.sfs")
    sceneloom.convert(tmp_path / "scene.sfs", tmp_path / "again")
    assert lines_of(tmp_path / "again") == lines_of(source)
    for file in files_of(source):
        if file.suffix == ".json":
            assert json.loads((tmp_path / "again" / file).read_text()) == json.loads((source / file).read_text())
        elif file.suffix == ".bin":
            assert (tmp_path / "again" / file).read_bytes() == (source / file).read_bytes(), file


def test_times_below_a_microsecond_are_all_that_a_scene_file_takes_from_a_drive(data_dir, tmp_path):
    source = data_dir / "recordings" / "kitti_drive"
    sceneloom.convert(source, tmp_path / "scene.sfs")
    sceneloom.convert(tmp_path / "scene.sfs", tmp_path / "again")
    for line, again in zip(lines_of(source), lines_of(tmp_path / "again"), strict=True):
        # sweeps begin with their earliest point, rounded down to a microsecond
        assert abs(line.pop("time") - again.pop("time")) <= 2.5e-6
        assert line == again
