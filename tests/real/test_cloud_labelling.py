"""A project of Supervisely by others, and real drives as tasks of every tool and back."""

import numpy as np
import pytest

from sceneloom.cameras import project
from sceneloom.formats import open_scene, write_scene
from sceneloom.geometry.boxes import points_in_box
from sceneloom.geometry.rigid import angle_between
from sceneloom.scene import CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles, cuboid_poses

LYFT = "real/strangers/supervisely_lyft"
TOOLS = ["supervisely", "segments", "scale-task", "sustechpoints"]


def test_all_boxes_of_a_project_of_others_hold_points_and_cameras_see_the_clouds(drive):
    with open_scene(drive(LYFT)) as scene:
        cuboids = [one for one in scene.annotations if isinstance(one, CuboidAnnotation)]
        assert len(cuboids) == 54
        assert sum(len(one.path.timestamps_ns) for one in cuboids) == 3039
        assert scene.metadata["supervisely"]["project_type"] == "point_cloud_episodes"
        sample = scene.samples()[0]
        positions = sample.sweep.points.positions.astype(np.float64)
        boxes = sample.boxes
        counts = [
            int(points_in_box(positions, *box).sum())
            for box in zip(boxes.centers_world, boxes.sizes_lwh, boxes.quaternions_xyzw, strict=True)
        ]
        assert (len(counts), min(counts), max(counts)) == (33, 5, 4751)  # as its own README states
        seen = {
            name: int(project(sample.cameras[name], camera_from_points.apply(positions))[1].sum())
            for name, camera_from_points in sample.camera_from_points.items()
        }
        assert len(seen) == 7
        assert all(1600 <= count <= 13_500 for count in seen.values())


def boxes_of(scene):
    """Centres, rotations and sizes of the cuboids at the sweeps, in the world, by id and sweep."""
    lidar = scene.lidars[0]
    found = {}
    for one in scene.annotations:
        if isinstance(one, CuboidAnnotation):
            poses = cuboid_poses(one, lidar.frames.timestamps_ns, angles=CuboidAngles.of(scene), sensor_id=lidar.id)
            for k in np.flatnonzero(poses.there).tolist():
                found[one.id, k] = poses.centers_world[k], poses.quaternions_xyzw[k], poses.sizes_lwh[k]
    return found


@pytest.mark.parametrize("tool", TOOLS)
@pytest.mark.parametrize("name", ["real/argoverse2", "real/kitti_object"])
def test_a_drive_goes_to_each_tool_and_back(drive, name, tool, tmp_path):
    with open_scene(drive(name)) as scene:
        options = {"points_frame": "world"} if tool == "supervisely" else {}
        write_scene(scene, tmp_path / "task", format=tool, **options)
        expected = boxes_of(scene)
    with open_scene(tmp_path / "task") as read:
        found = boxes_of(read)
    assert found.keys() == expected.keys()
    for key, (center, rotation, size) in expected.items():
        np.testing.assert_allclose(found[key][0], center, atol=1e-3)
        np.testing.assert_allclose(found[key][2], size, atol=1e-6)
        if tool != "scale-task":  # which has upright boxes only
            assert np.degrees(angle_between(found[key][1], rotation)) < 0.01
