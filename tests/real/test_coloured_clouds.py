"""Coloured clouds of real drives: seams between cameras, and what moves."""

import laspy
import numpy as np
import pytest

import sceneloom
from sceneloom.pipeline import ColourSettings


@pytest.mark.slow
def test_the_seam_between_two_cameras_of_pandaset_is_evened_out(data_dir, tmp_path):
    with sceneloom.open(data_dir / "recordings" / "pandaset") as scene:
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
    seen = np.asarray(read.camera) != 255
    assert set(np.unique(np.asarray(read.camera)[seen]).tolist()) == {0, 1, 2}
