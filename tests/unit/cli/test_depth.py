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


def test_dense_images_keep_the_pixels_of_sparse_ones_nearly(succeeds, recording, tmp_path):
    for method in ("sparse", "quality"):
        succeeds("depth", recording, "-o", tmp_path / method, "--method", method, "--form", "npz")
    sparse = np.load(tmp_path / "sparse" / "camera0" / "000000.npz")["depth"]
    with np.load(tmp_path / "quality" / "camera0" / "000000.npz") as arrays:
        dense, confidence = arrays["depth"], arrays["confidence"]
    assert dense.dtype == confidence.dtype == np.float32
    assert ((confidence > 0) == (dense > 0)).all()
    measured = sparse > 0
    assert (dense > 0).sum() > 2 * measured.sum()
    differences = np.abs(dense[measured] / sparse[measured] - 1)
    assert np.median(differences) < 0.03  # points lie beside the centres of pixels, which are large here


def test_confidence_and_images_go_where_they_were_asked_for(reported, succeeds, recording, tmp_path):
    how = ("--confidence", "--visualize", tmp_path / "look")
    (camera,) = reported("depth", recording, "-o", tmp_path / "out", *how)["cameras"]
    assert (camera["images"], 0 < camera["confidence"] <= 1) == (3, True)
    grey = np.array(Image.open(tmp_path / "out" / "camera0" / "confidence" / "000000.png"))
    succeeds("depth", recording, "-o", tmp_path / "exact", "--form", "npz")
    with np.load(tmp_path / "exact" / "camera0" / "000000.npz") as arrays:
        assert (grey.dtype, grey.tolist()) == (np.uint8, np.rint(arrays["confidence"] * 255).tolist())
    assert len(list((tmp_path / "look" / "camera0").iterdir())) == 3


def test_a_camera_that_is_not_there_is_reported_and_a_folder_with_something_in_it_left_alone(
    refuses, recording, tmp_path
):
    assert "camera0" in refuses(2, "'roof'", "depth", recording, "-o", tmp_path / "out", "--camera", "roof").err
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    refuses(1, "", "depth", recording, "-o", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]
