"""What `info` says of where cameras look, against what data sets call them."""

import pytest

from sceneloom.cli.info import mounting_text
from sceneloom.formats import open_scene
from sceneloom.scene.ego import ego_axes

KNOWN = {
    "recordings/pandaset": {"camera0": "ahead", "camera1": "ahead left", "camera2": "back"},
    "real/pandaset_scale_sample": {"front_camera": "ahead", "front_left_camera": "ahead left", "back_camera": "back"},
    "real/argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede": {
        "ring_front_center": "ahead",
        "ring_front_left": "ahead left",
        "ring_front_right": "ahead right",
        "ring_side_left": "left",
        "ring_side_right": "right",
        "ring_rear_left": "back left",
        "ring_rear_right": "back right",
        "stereo_front_left": "ahead",
    },
    "real/kitti_object": {"camera2": "ahead"},
}


@pytest.mark.parametrize("drive", KNOWN)
def test_cameras_look_where_their_names_state(data_dir, drive):
    with open_scene(data_dir / drive) as scene:
        axes = ego_axes(scene)
        found = {str(camera.id): mounting_text(camera, axes) for camera in scene.cameras}
    for name, direction in KNOWN[drive].items():
        assert found[name].endswith(f"looks {direction}"), (name, found[name])
