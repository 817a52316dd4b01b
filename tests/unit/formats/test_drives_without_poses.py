"""A drive whose trajectory is not known: targets that location things in the world report the same of it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sceneloom import convert, fuse
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.poses import stationary_ego
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import (
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    LocalizationAdjustment,
    Poses,
    Scene,
    Trajectory,
)

TIMES = np.array([0, 100_000_000], np.int64)
MOUNT = RigidTransform.identity()


def drive():
    camera_model = Camera("pinhole", 8, 6, 6.0, 6.0, 4.0, 3.0)
    points = LidarPoints(np.ones((5, 3), np.float32))
    images = [CameraImage(int(time), camera_model, decode=lambda: np.zeros((6, 8, 3), np.uint8)) for time in TIMES]
    return Scene(
        (
            LidarSensor("lidar", LazyFrames(TIMES, lambda k: LidarFrame(int(TIMES[k]), points)), mount=MOUNT),
            CameraSensor("camera", camera_model, LazyFrames(TIMES, images.__getitem__), mount=MOUNT),
        )
    )


def moving():
    """A drive along x through a hall, 2 m/s, whose sweeps report how it moved."""
    rng = np.random.default_rng(4)
    hall = rng.uniform((-12.0, -7.0, -1.0), (17.0, 9.0, 5.0), (6000, 3))
    hall[np.arange(6000), np.arange(6000) % 3] = np.where(
        np.arange(6000) % 2, *np.array([[-12.0, -7.0, -1.0], [17.0, 9.0, 5.0]])[:, np.arange(6000) % 3]
    )
    times = np.arange(6) * 100_000_000

    def sweep(k):
        return LidarFrame(int(times[k]), LidarPoints((hall - (0.2 * k, 0.0, 0.0)).astype(np.float32)))

    camera_model = Camera("pinhole", 8, 6, 6.0, 6.0, 4.0, 3.0)
    images = [CameraImage(int(time), camera_model, decode=lambda: np.zeros((6, 8, 3), np.uint8)) for time in times]
    return Scene(
        (
            LidarSensor("lidar", LazyFrames(times, sweep), mount=MOUNT),
            CameraSensor("camera", camera_model, LazyFrames(times, images.__getitem__), mount=MOUNT),
        )
    )


def reported(losses):
    return [loss for loss in losses if loss.field == "trajectories.positions"]


IN_WORLD = [("nuscenes", {}), ("colmap", {}), ("nerfstudio", {}), ("pcd", {"frame": "world"})]


def last_ego(name, folder):
    """Where the last frame was along x, as the target has it."""
    if name == "nuscenes":
        return open_scene(folder).trajectories["pose"].positions[-1, 0]
    if name == "colmap":
        lines = (folder / "sparse/0/images.txt").read_text().splitlines()
        last = next(line for line in lines if line.endswith("000005_500000000.jpg")).split()
        w, x, y, z = map(float, last[1:5])
        rotation = RigidTransform.from_quaternion(np.zeros(3), np.array([x, y, z, w]))
        return -rotation.inverse().apply(np.array([list(map(float, last[5:8]))]))[0, 0]
    if name == "nerfstudio":
        frames = json.loads((folder / "transforms.json").read_text())["frames"]
        return max(frame["transform_matrix"][0][3] for frame in frames)
    first, *_, last = (frame.points.positions[:, 0].min() for frame in open_scene(folder).lidars[0].frames)
    return 1.0 + last - first


@pytest.mark.parametrize(("name", "options"), IN_WORLD)
@pytest.mark.parametrize("trajectory", [None, "lidar"])
def test_targets_in_the_world_follow_the_sweeps_where_they_can_and_report_it_alike(name, options, trajectory, tmp_path):
    losses = write_scene(moving(), tmp_path / "out", format=name, trajectory=trajectory, **options)
    (loss,) = reported(losses)
    assert (loss.support, loss.what) == (Support.APPROXIMATED, "not known: computed by lidar odometry")
    assert last_ego(name, tmp_path / "out") == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(("name", "options"), IN_WORLD)
def test_targets_in_the_world_take_the_ego_as_stationary_as_asked_and_report_it_alike(name, options, tmp_path):
    losses = write_scene(moving(), tmp_path / "out", format=name, trajectory="identity", **options)
    assert reported(losses) == [stationary_ego()]


@pytest.mark.parametrize(("name", "options"), IN_WORLD)
def test_where_no_trajectory_can_be_computed_the_ego_stands_and_the_report_says_why(name, options, tmp_path):
    (loss,) = reported(write_scene(drive(), tmp_path / "out", format=name, **options))
    assert loss.support is Support.APPROXIMATED
    assert loss.what.startswith(f"{stationary_ego().what}; none of 2 lidar sweeps has enough returns")


@pytest.mark.parametrize("name", ["nuscenes", "colmap", "nerfstudio"])
def test_without_a_lidar_the_ego_stands(name, tmp_path):
    losses = write_scene(replace(drive(), sensors=drive().cameras), tmp_path / "out", format=name)
    assert reported(losses) == [stationary_ego()]


@pytest.mark.parametrize(("name", "options"), IN_WORLD)
def test_the_drives_own_trajectory_comes_first_and_another_can_be_named(name, options, tmp_path):
    times, straight = np.array([0, 600_000_000]), np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    trajectories = {
        estimated_trajectory: Trajectory(
            estimated_trajectory, times, np.array([[0.0, 0.0, 0.0], [end, 0.0, 0.0]]), straight
        )
        for estimated_trajectory, end in (("first", 6.0), ("second", 12.0))
    }
    scene = replace(moving(), trajectories=trajectories)
    for estimated_trajectory, end in ((None, 5.0), ("second", 10.0)):
        losses = write_scene(
            scene, tmp_path / str(estimated_trajectory), format=name, trajectory=estimated_trajectory, **options
        )
        assert not [loss for loss in reported(losses) if "not known" in loss.what]
        assert last_ego(name, tmp_path / str(estimated_trajectory)) == pytest.approx(end, abs=1e-3)


def test_points_on_the_ego_need_its_mounting_only_and_no_poses_are_made_up(tmp_path):
    losses = write_scene(moving(), tmp_path / "out", format="pcd", frame="ego")
    assert not reported(losses)
    assert not list((tmp_path / "out").glob("*.tum"))


def test_a_trajectory_that_would_count_for_nothing_is_refused(tmp_path):
    with pytest.raises(OptionError, match="needs none; expected another frame"):
        write_scene(moving(), tmp_path / "out", format="pcd", trajectory="identity")


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
    assert not [loss for loss in losses if loss.support is Support.APPROXIMATED and "trajector" in loss.field]


@pytest.mark.parametrize("name", ["kitti-raw", "kitti-tracking", "kitti-object"])
def test_cuboids_in_the_world_are_seen_from_a_stationary_ego_which_is_reported(name, tmp_path):
    path = CuboidPath(TIMES[:1], np.array([[4.0, 2.0, 1.5, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    losses = write_scene(
        replace(drive(), annotations=(CuboidAnnotation("box", path, "car"),)), tmp_path / "out", format=name
    )
    assert [loss for loss in losses if loss.field == "trajectories.positions"] == [stationary_ego()]


def drifted(*, recorded):
    """The drive with an adjustment: of a recorded trajectory that drifts aside, else from the ego to the world."""
    times = np.array([0, 600_000_000])
    straight, still = np.array([[0.0, 0.0, 0.0, 1.0]] * 2), np.zeros(2)
    drift = np.array([0.0, 0.9])
    if recorded:
        estimated_trajectory = np.stack([np.array([100.0, 101.2]), 50.0 + drift, still], axis=1)
        repair = Poses(times, np.stack([still, -drift, still], axis=1), straight)
        trajectories = {"recorded": Trajectory("recorded", times, estimated_trajectory, straight)}
    else:
        repair, trajectories = Poses(times, np.array([[100.0, 50.0, 0.0], [101.2, 50.0, 0.0]]), straight), {}
    return replace(moving(), trajectories=trajectories, annotations=(LocalizationAdjustment("repair", repair),))


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize("trajectory", ["lidar", None])
def test_lidar_odometry_begins_on_the_adjusted_trajectory_and_needs_no_adjustment_itself(
    trajectory, recorded, tmp_path
):
    write_scene(drifted(recorded=recorded), tmp_path / "drive.sfs")
    report = convert(tmp_path / "drive.sfs", tmp_path / "out", to="nuscenes", trajectory=trajectory)
    assert "correction-applied" in [warning.code for warning in report.warnings]
    computed = [loss.what for loss in reported(report.losses) if "not known" in loss.what]
    assert computed == (["not known: computed by lidar odometry"] if trajectory else [])
    estimated_trajectory = open_scene(tmp_path / "out").trajectories["pose"]
    np.testing.assert_allclose(
        estimated_trajectory.positions[[0, -1]], [[100.0, 50.0, 0.0], [101.0, 50.0, 0.0]], atol=0.03
    )
    fuse(drifted(recorded=recorded), tmp_path / "fused.sfs", trajectory=trajectory)
    with open_scene(tmp_path / "fused.sfs") as scene:
        estimated_trajectory = next(iter(scene.trajectories.values()))
        ours = scene.metadata["sceneloom"]
        assert [one["id"] for one in ours["applied"]] == ["repair"]
        found = estimated_trajectory.poses.interpolate(np.array([0, 500_000_000])).positions
        np.testing.assert_allclose(found[1] - found[0], [1.0, 0.0, 0.0], atol=0.03)
