"""A drive whose trajectory is not known: targets that location things in the world report the same of it."""

from dataclasses import replace

import numpy as np
import pytest
from tests.unit.formats.conftest import cameras_in_world

from sceneloom import convert, fuse
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.poses import STATIONARY_EGO
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


def of(times, sweep):
    """A lidar with such sweeps, and a camera."""
    camera_model = Camera("pinhole", 8, 6, 6.0, 6.0, 4.0, 3.0)
    images = [CameraImage(int(time), camera_model, decode=lambda: np.zeros((6, 8, 3), np.uint8)) for time in times]
    frames = LazyFrames(times, lambda k: LidarFrame(int(times[k]), LidarPoints(np.asarray(sweep(k), np.float32))))
    camera = CameraSensor("camera", camera_model, LazyFrames(times, images.__getitem__), mount=MOUNT)
    return Scene((LidarSensor("lidar", frames, mount=MOUNT), camera))


def drive():
    return of(TIMES, lambda k: np.ones((5, 3)))


def moving():
    """A drive along x through a hall, 2 m/s, whose sweeps report how it moved."""
    rng, walls = np.random.default_rng(4), np.array([[-12.0, -7.0, -1.0], [17.0, 9.0, 5.0]])
    hall, rows = rng.uniform(*walls, (6000, 3)), np.arange(6000)
    hall[rows, rows % 3] = np.where(rows % 2, *walls[:, rows % 3])
    return of(np.arange(6) * 100_000_000, lambda k: hall - (0.2 * k, 0.0, 0.0))


def reported(losses):
    return [loss for loss in losses if loss.field == "trajectories.positions"]


IN_WORLD = [("nuscenes", {}), ("colmap", {}), ("nerfstudio", {}), ("pcd", {"frame": "world"})]


def last_ego(name, folder):
    """Where the last frame was along x, as the target has it."""
    if name == "nuscenes":
        return open_scene(folder).trajectories["pose"].positions[-1, 0]
    if name in ("colmap", "nerfstudio"):
        return cameras_in_world(folder)[-1, 0, 3]
    first, *_, last = (frame.points.positions[:, 0].min() for frame in open_scene(folder).lidars[0].frames)
    return 1.0 + last - first


@pytest.mark.parametrize(("name", "options"), IN_WORLD)
def test_targets_in_the_world_follow_the_sweeps_where_they_can_and_stand_as_asked_and_report_it_alike(
    name, options, tmp_path
):
    for trajectory in (None, "lidar"):
        target = tmp_path / str(trajectory)
        (loss,) = reported(write_scene(moving(), target, format=name, trajectory=trajectory, **options))
        assert (loss.support, loss.what) == (Support.APPROXIMATED, "not known: computed by lidar odometry")
        assert last_ego(name, target) == pytest.approx(1.0, abs=0.03)
    losses = write_scene(moving(), tmp_path / "stands", format=name, trajectory="identity", **options)
    assert reported(losses) == [STATIONARY_EGO]
    # no trajectory can be computed
    (loss,) = reported(write_scene(drive(), tmp_path / "out", format=name, **options))
    assert loss.support is Support.APPROXIMATED
    assert loss.what.startswith(f"{STATIONARY_EGO.what}; none of 2 lidar sweeps has enough returns")
    if name != "pcd":
        losses = write_scene(replace(drive(), sensors=drive().cameras), tmp_path / "no lidar", format=name)
        assert reported(losses) == [STATIONARY_EGO]


@pytest.mark.parametrize(("name", "options"), IN_WORLD)
def test_the_drives_own_trajectory_comes_first_and_another_can_be_named(name, options, tmp_path):
    times, straight = np.array([0, 600_000_000]), np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    trajectories = {
        key: Trajectory(key, times, np.array([[0.0, 0.0, 0.0], [end, 0.0, 0.0]]), straight)
        for key, end in (("first", 6.0), ("second", 12.0))
    }
    for chosen, end in ((None, 5.0), ("second", 10.0)):
        target = tmp_path / str(chosen)
        losses = write_scene(
            replace(moving(), trajectories=trajectories), target, format=name, trajectory=chosen, **options
        )
        assert not [loss for loss in reported(losses) if "not known" in loss.what]
        assert last_ego(name, target) == pytest.approx(end, abs=1e-3)


def test_points_on_the_ego_need_its_mounting_only_and_no_poses_are_made_up(tmp_path):
    losses = write_scene(moving(), tmp_path / "out", format="pcd", frame="ego")
    assert not reported(losses)
    assert not list((tmp_path / "out").glob("*.tum"))
    with pytest.raises(OptionError, match="needs none; expected another frame"):
        write_scene(moving(), tmp_path / "other", format="pcd", trajectory="identity")


IN_SENSORS = (
    "recording mcap ros2 kitti-raw kitti-tracking kitti-odometry kitti-object npz pcd ply las laz kitti-bin "
    "nuscenes-bin openlabel d.bag d.sfs"
)


@pytest.mark.parametrize("name", IN_SENSORS.split())
def test_targets_that_hold_data_where_the_sensors_are_need_no_poses(name, tmp_path):
    form, target = (None, name) if "." in name else (name, "out")
    losses = write_scene(drive(), tmp_path / target, format=form)
    assert not [loss for loss in losses if loss.support is Support.APPROXIMATED and "trajector" in loss.field]


@pytest.mark.parametrize("name", ["kitti-raw", "kitti-tracking", "kitti-object"])
def test_cuboids_in_the_world_are_seen_from_a_stationary_ego_which_is_reported(name, tmp_path):
    path = CuboidPath(TIMES[:1], np.array([[4.0, 2.0, 1.5, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    scene = replace(drive(), annotations=(CuboidAnnotation("box", path, "car"),))
    assert reported(write_scene(scene, tmp_path / "out", format=name)) == [STATIONARY_EGO]


def drifted(*, recorded):
    """The drive with an adjustment: of a recorded trajectory that drifts aside, else from the ego to the world."""
    times = np.array([0, 600_000_000])
    straight, still = np.array([[0.0, 0.0, 0.0, 1.0]] * 2), np.zeros(2)
    drift = np.array([0.0, 0.9])
    if recorded:
        aside = np.stack([np.array([100.0, 101.2]), 50.0 + drift, still], axis=1)
        repair = Poses(times, np.stack([still, -drift, still], axis=1), straight)
        trajectories = {"recorded": Trajectory("recorded", times, aside, straight)}
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
    ends = open_scene(tmp_path / "out").trajectories["pose"].positions[[0, -1]]
    np.testing.assert_allclose(ends, [[100.0, 50.0, 0.0], [101.0, 50.0, 0.0]], atol=0.03)
    fuse(drifted(recorded=recorded), tmp_path / "fused.sfs", trajectory=trajectory)
    with open_scene(tmp_path / "fused.sfs") as scene:
        assert [one["id"] for one in scene.metadata["sceneloom"]["applied"]] == ["repair"]
        found = next(iter(scene.trajectories.values())).poses.interpolate(np.array([0, 500_000_000])).positions
        np.testing.assert_allclose(found[1] - found[0], [1.0, 0.0, 0.0], atol=0.03)
