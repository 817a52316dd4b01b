"""`sceneloom depth`: what it writes, what it says, what it refuses."""

import json

import numpy as np
import pytest
from PIL import Image


@pytest.mark.parametrize("method", ["sparse", "fast", "quality"])
def test_each_sweep_and_image_gets_a_depth_image(reported, recording, tmp_path, method):
    words = ("--method", method, "--visualize", tmp_path / "look", *(("--confidence",) if method != "sparse" else ()))
    (camera,) = reported("depth", recording, "-o", tmp_path / "out", *words)["cameras"]
    folder = tmp_path / "out" / "camera0"
    names = ["000000.png", "000001.png", "000002.png"]
    assert (camera["images"], sorted(path.name for path in folder.glob("*.png"))) == (3, names)
    lines = (tmp_path / "out" / "index.jsonl").read_text().splitlines()
    assert [json.loads(line)["file"] for line in lines] == [f"camera0/{name}" for name in names]
    assert len(list((tmp_path / "look" / "camera0").iterdir())) == 3
    steps = np.array(Image.open(folder / "000001.png"))
    assert (steps.shape, steps.dtype, steps.any()) == ((64, 96), np.uint16, True)
    if method != "sparse":
        grey = np.array(Image.open(folder / "confidence" / "000000.png"))
        assert (grey.dtype, grey.shape, 0 < camera["confidence"] <= 1) == (np.uint8, (64, 96), True)


def test_dense_images_keep_the_pixels_of_sparse_ones_nearly(refuses, succeeds, recording, tmp_path):
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
    succeeds("depth", recording, "-o", tmp_path / "png", "--confidence")
    grey = np.array(Image.open(tmp_path / "png" / "camera0" / "confidence" / "000000.png"))
    assert (grey.dtype, grey.tolist()) == (np.uint8, np.rint(confidence * 255).tolist())
    assert "camera0" in refuses(2, "'roof'", "depth", recording, "-o", tmp_path / "out", "--camera", "roof").err
