"""`sceneloom colour` from the command line."""

import laspy
import numpy as np
import pytest
from PIL import Image


def test_a_map_and_sweeps_are_written_and_missing_label_images_counted(succeeds, reported, recording, tmp_path):
    done = succeeds("colour", recording, "-o", tmp_path / "map.laz", "--voxel", "0.2", "--visualize", tmp_path / "look")
    assert ("coloured 3 of 3 sweeps" in done.out, "map.laz" in done.out) == (True, True)
    assert len(laspy.read(tmp_path / "map.laz")) > 50
    assert len(list((tmp_path / "look").glob("*.png"))) == 2
    report = reported("colour", recording, "--per-sweep", tmp_path / "sweeps", "--remove-moving")
    assert (report["files"], report["exposure"]["seam_before"]) == ({"sweeps": 3}, None)
    assert report["removed_by_rays"] + report["removed_in_boxes"] < 0.1 * report["points"]
    assert sorted(path.name for path in (tmp_path / "sweeps").iterdir()) == [f"00000{k}.ply" for k in range(3)]
    (tmp_path / "labels").mkdir()
    Image.fromarray(np.full((64, 96), 9, np.uint8)).save(tmp_path / "labels" / "1.png")
    done = succeeds("colour", recording, "-o", tmp_path / "map.las", "--labels", tmp_path / "labels")
    assert "labels: 1 image painted onto" in done.out
    assert "no label image of 2 images" in done.out
    assert set(np.unique(laspy.read(tmp_path / "map.las").label).tolist()) == {9, 65535}


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ((), 2, "nothing to write"),
        (("-o", "map.xyz"), 2, "expected one of .las .laz .ply .pcd"),
        (("-o", "map.las", "--voxel", "0"), 2, "expected a number above 0"),
        (("-o", "map.las", "--label-radius", "2"), 2, "--project-labels"),
        (("-o", "map.las", "--labels", "nowhere"), 1, "no such folder"),
        (("--project-labels", "back"), 1, "no labelled points"),
    ],
)
def test_what_cannot_be_done_is_one_clear_error(refuses, recording, tmp_path, monkeypatch, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    assert "Traceback" not in refuses(code, message, "colour", recording, *arguments).err
    assert list(tmp_path.iterdir()) == []
