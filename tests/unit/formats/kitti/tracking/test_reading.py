"""Sequences of KITTI's tracking benchmark as scenes."""

import numpy as np
import pytest
from PIL import Image

from sceneloom.errors import DataError, OptionError
from sceneloom.formats import open_scene
from sceneloom.formats.base.registry import drives_of

CALIBRATION = """P2: 48 0 17 2.88 0 48 13 0.5 0 0 1 0.003
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27
Tr_imu_velo 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8

"""
OXTS = "49.0 8.0 110.0 0 0 0" + " 0" * 24 + "\n"
ROW = "{frame} {track} Car 0 1 -1.5 5 6 20 18 1.5 1.6 4.0 {x} 1.7 12.0 0.8\n"
LABELS = "".join(ROW.format(frame=k, track=4, x=k) for k in (0, 1, 3)) + ROW.format(frame=1, track=9, x=5)


@pytest.fixture
def folder(tmp_path):
    for name, text in {"calib": CALIBRATION, "oxts": OXTS * 4, "label_02": LABELS}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "0002.txt").write_text(text)
    (tmp_path / "image_02/0002").mkdir(parents=True)
    (tmp_path / "velodyne/0002").mkdir(parents=True)
    for k in (0, 1, 3):
        Image.new("RGB", (36, 28)).save(tmp_path / "image_02/0002" / f"{k:06d}.png")
        np.full((2, 4), k, np.float32).tofile(tmp_path / "velodyne/0002" / f"{k:06d}.bin")
    return tmp_path


def test_tracks_are_boxes_over_time_with_their_numbers_as_ids(folder):
    scene = open_scene(folder)
    assert scene.format == "kitti-tracking"
    four, nine = scene.annotations
    assert (four.id, nine.id) == (4, 9)
    assert four.path.timestamps_ns.tolist() == [0, 100_000_000, 300_000_000]
    assert four.projections[0].sensor_id == "camera2"
    assert {a.name for a in four.attributes} == {"truncated", "occluded", "alpha"}
    # the middle of the box is 12 m before the camera and 0.95 m below it: the ego is 0.27 + 0.8 m behind, 0.3 m aside
    np.testing.assert_allclose(
        four.path.values[0, 3:6], [12 + 0.27 + 0.8, -0.3, 0.8 - 0.08 - 0.95], atol=1e-9
    )


def test_files_are_of_the_frames_that_their_numbers_state(folder):
    scene = open_scene(folder)
    assert scene.sensor("velodyne").frames.timestamps_ns.tolist() == [0, 100_000_000, 300_000_000]
    assert scene.sensor("velodyne").frames[2].points.positions[0, 0] == 3


def test_several_sequences_are_listed_and_one_can_be_chosen(folder):
    (folder / "oxts/0005.txt").write_text(OXTS)
    (folder / "calib/0005.txt").write_text(CALIBRATION)
    with pytest.raises(
        OptionError, match=r"has several sequences: 0002, 0005; choose one with `--sequence NAME`"
    ):
        open_scene(folder)
    assert drives_of(folder) == ("0002", "0005")
    assert open_scene(folder, sequence="5").source.endswith("/0005")
    with pytest.raises(OptionError, match=r"sequence '7': .* has 0002, 0005"):
        open_scene(folder, sequence="7")


def test_without_oxts_boxes_are_placed_as_if_the_ego_stood(folder):
    (folder / "oxts/0002.txt").unlink()
    scene = open_scene(folder)
    assert list(scene.trajectories) == ["stationary"]
    assert "ego-stands" in [n.code for n in scene.warnings]


def test_boxes_beyond_the_trajectory_are_left_out_and_counted(folder):
    (folder / "oxts/0002.txt").write_text(OXTS * 2)
    scene = open_scene(folder)
    assert scene.annotations[0].path.timestamps_ns.tolist() == [0, 100_000_000]
    counts = {n.code: n.count for n in scene.warnings}
    assert counts["boxes-beyond-trajectory"] == 1


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("label_02", ROW.format(frame=0, track=4, x=0) * 2, "frame 0: track 4 stands in it twice"),
        ("label_02", "0 4 Car 0 1\n", "line 1: 5 values; expected 17 or 18"),
        ("calib", "P2: 1 0 0\n", "line 1: 4 values; expected 13"),
        ("oxts", "1 2\n", "line 1: 2 values; expected 30"),
    ],
)
def test_a_fault_is_reported_with_its_location(folder, name, text, problem):
    (folder / name / "0002.txt").write_text(text)
    with pytest.raises(DataError) as caught:
        open_scene(folder)
    assert problem in str(caught.value)


def test_a_sequence_without_calibration_is_reported_so(folder):
    (folder / "calib/0002.txt").unlink()
    with pytest.raises(DataError, match=r"without calibration: expected .*/calib/0000.txt for each"):
        open_scene(folder)
