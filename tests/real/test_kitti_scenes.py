"""KITTI's own frames and sequences as scenes: what is known of them from elsewhere.

And the trajectory there and back.
"""

import numpy as np
import pytest

from sceneloom.cameras.projection import project
from sceneloom.colouring.cuboid_projection import box_extents
from sceneloom.formats import open_scene, write_scene
from sceneloom.geometry.boxes import box_corners, points_in_box
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CuboidAnnotation
from sceneloom.scene.annotations_at import cuboid_poses
from sceneloom.scene.poses import PoseSource


@pytest.fixture(scope="module")
def frames(data_dir):
    return open_scene(data_dir / "real" / "kitti_object")


def test_a_sixth_of_the_points_of_each_frame_is_in_its_image(frames):
    lidar, camera = frames.sensor("velodyne"), frames.sensor("camera2")
    for frame, image in zip(lidar.frames, camera.images, strict=True):
        points = image.mount.inverse().apply(frame.points.positions)
        _, visible = project(image.camera, points)
        assert 0.14 < visible.mean() < 0.19


def test_labelled_boxes_hold_points_and_look_as_their_boxes_in_images(frames):
    lidar, camera = frames.sensor("velodyne"), frames.sensor("camera2")
    empty, overlaps = [], []
    for box in (a for a in frames.annotations if isinstance(a, CuboidAnnotation)):
        poses = cuboid_poses(box, box.path.timestamps_ns)
        at = poses.centers_world[0], poses.sizes_lwh[0], poses.quaternions_xyzw[0]
        row = int(np.searchsorted(lidar.frames.timestamps_ns, box.path.timestamps_ns[0]))
        if not points_in_box(lidar.frames[row].points.positions, *at, margin=0.05).any():
            empty.append(box.id)
        image = camera.images[row]
        corners = image.mount.inverse().apply(box_corners(*at))
        extents, _ = box_extents(image.camera, corners[None])
        left, top, width, height = box.projections[0].boxes[0]
        overlaps.append(overlap(extents[0], (left, top, left + width, top + height)))
    assert len(empty) <= 1  # one object of frame 114 has no points
    assert np.median(overlaps) > 0.85


def overlap(a, b):
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    both = max(width, 0) * max(height, 0)
    return both / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both)


def test_frames_come_back_as_they_were(frames, data_dir, tmp_path):
    frames_folder = data_dir / "real" / "kitti_object"
    losses = write_scene(frames, tmp_path / "out", format="kitti-object")
    assert len(losses) == 0
    back = open_scene(tmp_path / "out")
    assert [a.id for a in back.annotations] == [a.id for a in frames.annotations]
    for before, after in zip(frames.annotations, back.annotations, strict=True):
        np.testing.assert_allclose(after.path.values, before.path.values, atol=1e-5)
    before = (frames_folder / "calib/000114.txt").read_text().split()
    after = (tmp_path / "out/training/calib/000114.txt").read_text().split()
    assert [float(word) for word in after if ":" not in word] == [float(word) for word in before if ":" not in word]
    for before, after in zip(frames.cameras[0].images, back.cameras[0].images, strict=True):
        assert after.camera == before.camera
        np.testing.assert_array_equal(after.mount.matrix, before.mount.matrix)


@pytest.mark.parametrize("name", [pytest.param("0000", marks=pytest.mark.slow), "0012"])
def test_tracks_come_back_and_stand_where_images_show_them(data_dir, name, tmp_path):
    scene = open_scene(data_dir / "real" / "kitti_tracking", sequence=name)
    camera = scene.sensor("camera2")
    source = PoseSource(scene.trajectories["oxts"].poses, camera.mount)
    overlaps = []
    for box in (a for a in scene.annotations if isinstance(a, CuboidAnnotation)):
        poses = cuboid_poses(box, box.path.timestamps_ns)
        at = source.at(box.path.timestamps_ns)
        for k in range(0, len(box.path.timestamps_ns), 10):
            world_from_camera = RigidTransform.from_quaternion(at.positions[k], at.quaternions_xyzw[k])
            corners = world_from_camera.inverse().apply(
                box_corners(poses.centers_world[k], poses.sizes_lwh[k], poses.quaternions_xyzw[k])
            )
            extents, _ = box_extents(camera.camera, corners[None])
            left, top, width, height = box.projections[0].boxes[k]
            overlaps.append(overlap(extents[0], (left, top, left + width, top + height)))
    assert np.median(overlaps) > 0.8
    write_scene(scene, tmp_path / "out", format="kitti-tracking")
    back = open_scene(tmp_path / "out")
    found = {a.id: a for a in back.annotations}
    assert set(found) == {a.id for a in scene.annotations}
    for before in scene.annotations:
        after = found[before.id]
        np.testing.assert_array_equal(after.path.timestamps_ns, before.path.timestamps_ns)
        np.testing.assert_allclose(after.path.values, before.path.values, atol=1e-4)  # degrees of six decimals
