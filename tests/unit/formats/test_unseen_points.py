"""Points that no camera saw: grey in every written cloud, white in the model and in `.sfs`, named in a column."""

import numpy as np
import pytest

import sceneloom
from sceneloom.formats.points.files import read_cloud
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, PointsFrame, Poses, Scene
from sceneloom.scene.clouds import grey_where_unseen, white_where_unseen

COLORS = np.array([[255, 255, 255], [255, 255, 255], [10, 20, 30], [1, 2, 3]], np.uint8)
SEEN_BY = np.array([255, 0, 1, 255], np.uint8)
"""A point that no camera saw, a white wall, another point, and a colour that came from elsewhere."""
GREY = [[128, 128, 128], *COLORS[1:].tolist()]


@pytest.fixture
def fused():
    points = LidarPoints(np.eye(4, 3, dtype=np.float32) + 1, colors=COLORS, camera_index=SEEN_BY)
    poses = Poses([0], [[0, 0, 0]], [[0, 0, 0, 1]], static=True)
    frames = LazyFrames.of([LidarFrame(10**9, points)], [10**9])
    return Scene((LidarSensor("top", frames, poses=poses, points_frame=PointsFrame.WORLD),))


@pytest.mark.parametrize("suffix", [".sfs", ".ply", ".pcd", ".las", ".laz", ".npz", ".mcap", ".bag", ".ros2"])
def test_the_model_has_them_white_again(fused, tmp_path, suffix):
    sceneloom.write(fused, tmp_path / f"cloud{suffix}")
    with sceneloom.open(tmp_path / f"cloud{suffix}") as scene:
        points = scene.lidars[0].frames[0].points
        assert points.colors.tolist() == COLORS.tolist()
        assert points.camera_index.tolist() == SEEN_BY.tolist()


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".las", ".npz"])
def test_files_of_points_have_them_grey_with_a_column_that_says_so(fused, tmp_path, suffix):
    sceneloom.write(fused, tmp_path / f"cloud{suffix}")
    columns = read_cloud(tmp_path / f"cloud{suffix}").columns
    assert colours_in(columns) == GREY
    assert columns["camera_index"].tolist() == SEEN_BY.tolist()


def colours_in(columns):
    if "rgb" in columns:
        packed = columns["rgb"].view(np.uint32)
        return np.column_stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255]).tolist()
    if "colors" in columns:
        return columns["colors"].tolist()
    found = np.column_stack([columns[name] for name in ("red", "green", "blue")])
    return (found // 257 if found.dtype == np.uint16 else found).tolist()


def test_messages_have_them_grey(fused, tmp_path):
    reader = pytest.importorskip("mcap.reader")
    sceneloom.write(fused, tmp_path / "cloud.mcap")
    with (tmp_path / "cloud.mcap").open("rb") as file:
        data = b"".join(
            message.data
            for schema, _, message in reader.make_reader(file).iter_messages()
            if schema.name == "foxglove.PointCloud"
        )
    assert bytes([128, 128, 128]) in data


def test_only_what_no_camera_saw_changes():
    assert grey_where_unseen(COLORS, SEEN_BY).tolist() == GREY
    assert white_where_unseen(np.array(GREY, np.uint8), SEEN_BY).tolist() == COLORS.tolist()
    assert grey_where_unseen(COLORS, None) is COLORS
