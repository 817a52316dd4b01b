"""A drive whose trajectory is not known: targets that place things in the world report the same of it."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.formats import write_scene
from sceneloom.formats.default_poses import standing_ego
from sceneloom.formats.loss import Fate
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    Picture,
    Scene,
)

TIMES = np.array([0, 100_000_000], np.int64)
MOUNT = RigidTransform.identity()


def drive():
    lens = Camera("pinhole", 8, 6, 6.0, 6.0, 4.0, 3.0)
    points = LidarPoints(np.ones((5, 3), np.float32))
    pictures = [Picture(int(time), lens, decode=lambda: np.zeros((6, 8, 3), np.uint8)) for time in TIMES]
    return Scene(
        (
            LidarSensor("lidar", LazyFrames(TIMES, lambda k: LidarFrame(int(TIMES[k]), points)), mount=MOUNT),
            CameraSensor("camera", lens, LazyFrames(TIMES, pictures.__getitem__), mount=MOUNT),
        )
    )


@pytest.mark.parametrize("name", ["nuscenes", "colmap", "nerfstudio"])
def test_targets_in_the_world_take_the_ego_as_standing_and_say_so_alike(name, tmp_path):
    # COLMAP and nerfstudio follow the lidar, and refuse where they cannot, unless they are asked to stand
    options = {} if name == "nuscenes" else {"trajectory": "identity"}
    losses = write_scene(drive(), tmp_path / "out", format=name, **options)
    assert [loss for loss in losses if loss.field == "trajectories.positions"] == [standing_ego()]


@pytest.mark.parametrize(
    "name",
    [
        "recording",
        "mcap",
        "ros2",
        "kitti-raw",
        "kitti-tracking",
        "kitti-odometry",
        "kitti-object",
        "npz",
        "pcd",
        "ply",
        "las",
        "laz",
        "kitti-bin",
        "nuscenes-bin",
        "openlabel",
        "d.bag",
        "d.sfs",
    ],
)
def test_targets_that_hold_data_where_the_sensors_are_need_no_poses(name, tmp_path):
    form, target = (None, name) if "." in name else (name, "out")
    losses = write_scene(drive(), tmp_path / target, format=form)
    assert not [loss for loss in losses if loss.fate is Fate.APPROXIMATED and "trajector" in loss.field]


@pytest.mark.parametrize("name", ["kitti-raw", "kitti-tracking", "kitti-object"])
def test_cuboids_in_the_world_are_seen_from_a_standing_ego_which_is_reported(name, tmp_path):
    path = CuboidPath(TIMES[:1], np.array([[4.0, 2.0, 1.5, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    losses = write_scene(
        replace(drive(), annotations=(CuboidAnnotation("box", path, "car"),)),
        tmp_path / "out",
        format=name,
    )
    assert [loss for loss in losses if loss.field == "trajectories.positions"] == [standing_ego()]
