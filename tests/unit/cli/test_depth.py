"""`sceneloom depth`: what it writes, what it says, what it refuses."""

import json

import numpy as np
import pytest
from PIL import Image


@pytest.mark.parametrize("method", ["sparse", "fast", "quality"])
def test_each_sweep_and_image_gets_a_depth_image(succeeds, recording, tmp_path, method):
    succeeds("depth", recording, "-o", tmp_path / "out", "--method", method)
    images = sorted(path.name for path in (tmp_path / "out" / "camera0").iterdir())
    assert images == ["000000.png", "000001.png", "000002.png"]
    lines = (tmp_path / "out" / "index.jsonl").read_text().splitlines()
    assert [json.loads(line)["file"] for line in lines] == [f"camera0/{name}" for name in images]
    steps = np.array(Image.open(tmp_path / "out" / "camera0" / "000001.png"))
    assert steps.shape == (64, 96)
    assert steps.dtype == np.uint16
    assert steps.any()


def test_dense_images_keep_the_pixels_of_sparse_ones_nearly(call, recording, tmp_path):
    for method in ("sparse", "quality"):
        call("depth", recording, "-o", tmp_path / method, "--method", method, "--form", "npz")
    sparse = np.load(tmp_path / "sparse" / "camera0" / "000000.npz")["depth"]
    dense = np.load(tmp_path / "quality" / "camera0" / "000000.npz")["depth"]
    measured = sparse > 0
    assert (dense > 0).sum() > 2 * measured.sum()
    differences = np.abs(dense[measured] / sparse[measured] - 1)
    assert np.median(differences) < 0.03  # points lie beside the centres of pixels, which are large here


def test_npz_files_hold_depth_and_confidence(call, recording, tmp_path):
    call("depth", recording, "-o", tmp_path / "out", "--form", "npz")
    with np.load(tmp_path / "out" / "camera0" / "000000.npz") as arrays:
        assert set(arrays) == {"depth", "confidence"}
        assert arrays["depth"].dtype == arrays["confidence"].dtype == np.float32
        assert ((arrays["confidence"] > 0) == (arrays["depth"] > 0)).all()


def test_confidence_and_images_go_where_they_were_asked_for(call, recording, tmp_path):
    outcome = call(
        "depth", recording, "-o", tmp_path / "out", "--confidence", "--visualize", tmp_path / "look", "--json"
    )
    report = json.loads(outcome.out)
    assert report["cameras"][0]["images"] == 3
    assert 0 < report["cameras"][0]["confidence"] <= 1
    grey = np.array(Image.open(tmp_path / "out" / "camera0" / "confidence" / "000000.png"))
    assert grey.dtype == np.uint8
    assert grey.shape == (64, 96)
    assert len(list((tmp_path / "look" / "camera0").iterdir())) == 3


def test_a_camera_that_is_not_there_is_reported_with_those_that_are(call, recording, tmp_path):
    outcome = call("depth", recording, "-o", tmp_path / "out", "--camera", "roof")
    assert outcome.code == 2
    assert "'roof'" in outcome.err
    assert "camera0" in outcome.err
    assert not (tmp_path / "out").exists()


def test_a_folder_with_something_in_it_is_left_alone(call, recording, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    outcome = call("depth", recording, "-o", tmp_path / "out")
    assert outcome.code == 1
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]
