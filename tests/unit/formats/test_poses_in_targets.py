"""Where targets have cameras and ego: of images that bring model and mounting along, and without a known trajectory.

Whatever the target, model and mounting are of one rig, that of the image. The numbers are those of the examples in the
recording format's description, whose `data.jsonl` and `calibration.json` are of different rigs: by the calibration the
first camera looks the other way.
"""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from PIL import Image
from tests.unit.formats.conftest import cameras_in_world

from sceneloom import convert, fuse
from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.poses import STATIONARY_EGO
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

SIZE = (83, 80)
CALIBRATED = [
    [-0.004028958399374893, -0.9999835791608805, 0.0040754021655989925, 0.00026667580381220524],
    [-0.9999788711605716, 0.004049663285094152, 0.0050850230782564345, 0.03338442163595494],
    [-0.005101443584432566, -0.004054828710638873, -0.9999787665933124, 0.0011383544698017876],
    [0.0, 0.0, 0.0, 1.0],
]
OF_LINES = [
    [0.01486, 0.9995, -0.02577, 0.06522],
    [-0.9998, 0.01496, 0.003756, -0.0207],
    [0.00414, 0.02571, 0.9996, -0.008054],
    [0, 0, 0, 1],
]
COUNT = 3
CALIBRATION = {
    "model": "pinhole", "focalLengthX": 54.7, "focalLengthY": 54.7, "principalPointX": 67.2, "principalPointY": 49.0,
    "imageWidth": 134, "imageHeight": 97, "imuToCamera": CALIBRATED,
}  # fmt: skip
CAMERA_MODEL = {
    "focalLengthX": 28.49, "focalLengthY": 28.52, "principalPointX": 41.6, "principalPointY": 39.6,
    "distortionModel": "pinhole",
}  # fmt: skip


def rotated(k):
    """The mounting of the lines, rotated by k times 10 degrees around the camera's axis."""
    c, s = np.cos(np.radians(10 * k)), np.sin(np.radians(10 * k))
    return (np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ np.array(OF_LINES)).tolist()


@pytest.fixture
def recording(tmp_path):
    """Make a recording whose lines bring camera models and mountings along, equal or different ones."""

    def make(*, different):
        folder = tmp_path / "recording"
        (folder / "frames1").mkdir(parents=True)
        (folder / "calibration.json").write_text(json.dumps({"cameras": [CALIBRATION]}))
        lines = []
        for k in range(10):
            rotation = {"w": np.cos(0.02 * k), "x": 0.0, "y": 0.0, "z": np.sin(0.02 * k)}
            pose = {"position": {"x": 0.1 * k, "y": 0.0, "z": 0.0}, "orientation": rotation}
            lines.append({"groundTruth": pose, "time": 0.1 * k})
        for k in range(COUNT):
            Image.new("RGB", SIZE, (10 * k, 0, 0)).save(folder / "frames1" / f"{k:08d}.png")
            camera_model = CAMERA_MODEL | {"focalLengthX": CAMERA_MODEL["focalLengthX"] + (k if different else 0)}
            entry = {"cameraInd": 0, "cameraParameters": camera_model, "imuToCamera": rotated(k if different else 0)}
            lines.append({"frames": [entry], "number": k, "time": 0.25 + 0.2 * k})
        lines.sort(key=lambda line: line["time"])
        (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return folder

    return make


def expected(different):
    """`ego_from_camera` and focal length of each image, straight from the numbers of the lines."""
    for k in range(COUNT):
        rotation, _ = RigidTransform.nearest(np.array(rotated(k if different else 0)))
        yield rotation.inverse(), CAMERA_MODEL["focalLengthX"] + (k if different else 0)


def world_from_images(scene):
    """Where each image was taken from, as whoever computes with the scene finds it."""
    (camera,), trajectory = scene.cameras, next(iter(scene.trajectories.values())).poses
    assert camera.coordinates is sc.Coordinates.WORLD
    for image in camera.images:
        own = image.mount or camera.mount
        samples = PoseSource(trajectory, own).at(np.array([image.timestamp_ns]))
        along = camera.poses.interpolate(np.array([image.timestamp_ns]))
        np.testing.assert_allclose(samples.positions, along.positions, atol=1e-6)
        yield own, image.camera


@pytest.mark.parametrize("different", [False, True], ids=["equal", "different"])
@pytest.mark.parametrize("name", ["drive.mcap", "drive.bag", "drive.ros2", "drive.sfs", "copy"])
def test_a_target_has_camera_model_and_mounting_of_each_image(recording, tmp_path, name, different):
    with open_scene(recording(different=different)) as scene:
        report = write_scene(scene, tmp_path / name)
    assert not [loss for loss in report.losses if loss.field.endswith("mount") and loss.support is Support.DROPPED]
    with open_scene(tmp_path / name) as read:
        found = list(world_from_images(read))
    assert len(found) == COUNT
    for (mount, camera_model), (ego_from_camera, focal_length) in zip(found, expected(different), strict=True):
        np.testing.assert_allclose(mount.matrix, ego_from_camera.matrix, atol=1e-9)
        assert camera_model.fx == pytest.approx(focal_length)
    if name == "drive.bag":
        # other programs find one fixed transform, or one at the time of each image
        rows = [row for row in transforms_of(tmp_path / name) if row[1] == "camera0"]
        moments = [("/tf", time) for time in (0.25, 0.45, 0.65)] if different else [("/tf_static", None)]
        assert [(topic, round(time, 6) if different else None) for topic, _, time, _ in rows] == moments
        for (_, _, _, rotation), (ego_from_camera, _) in zip(rows, expected(different), strict=False):
            found = [rotation.x, rotation.y, rotation.z, rotation.w]
            assert abs(np.dot(found, ego_from_camera.quaternion_xyzw)) == pytest.approx(1.0, abs=1e-12)


def transforms_of(path):
    """The transforms of a bag by topic and child, as another program reads them."""
    highlevel = pytest.importorskip("rosbags.highlevel")
    with highlevel.AnyReader([path]) as bag:
        for connection, _, raw in bag.messages():
            if connection.topic in ("/tf", "/tf_static"):
                for one in bag.deserialize(raw, connection.msgtype).transforms:
                    time = one.header.stamp.sec + one.header.stamp.nanosec * 1e-9
                    yield connection.topic, one.child_frame_id, time, one.transform.rotation


def test_openlabel_says_where_the_camera_was_at_each_image(recording, tmp_path):
    with open_scene(recording(different=True)) as scene:
        write_scene(scene, tmp_path / "drive.json", format="openlabel")
        poses = {image.timestamp_ns: image for image in scene.cameras[0].images}
        reported = json.loads((tmp_path / "drive.json").read_text())["openlabel"]
        assert "pose_wrt_parent" not in reported["coordinate_systems"]["camera0"]
        frames = list(reported["frames"].values())
        assert len(frames) == len(poses)
        for frame, image in zip(frames, poses.values(), strict=True):
            properties = frame["frame_properties"]
            matrix = properties["transforms"]["camera0_to_world"]["transform_src_to_dst"]["matrix4x4"]
            pose = scene.cameras[0].poses.interpolate(np.array([image.timestamp_ns]))
            np.testing.assert_allclose(np.reshape(matrix, (4, 4))[:3, 3], pose.positions[0], atol=1e-9)
            camera_model = properties["streams"]["camera0"]["stream_properties"].get("intrinsics_pinhole")
            fx = scene.cameras[0].camera.fx if camera_model is None else camera_model["camera_matrix_3x4"][0]
            assert fx == pytest.approx(image.camera.fx)


def test_one_mounting_for_all_refuses_different_ones_and_a_calibration_that_no_image_uses_is_reported(
    recording, tmp_path
):
    problem = "images have mountings of their own"
    with open_scene(recording(different=True)) as scene:
        for name in ("kitti-raw", "kitti-tracking", "kitti-odometry"):
            with pytest.raises(CalibrationError, match=problem):
                write_scene(scene, tmp_path / "out", format=name)
            assert not (tmp_path / "out").exists()
        messages = [warning.message for warning in scene.warnings if warning.code == "calibration-not-used"]
        camera = scene.cameras[0].camera
    assert len(messages) == 2
    assert "179 degrees" in messages[1]
    # parameters without a size are those of the images
    assert (camera.width, camera.height) == SIZE
    assert (camera.fx, camera.cx) == (CAMERA_MODEL["focalLengthX"], CAMERA_MODEL["principalPointX"])


def drifting():
    """A correction that drifts by 0.3 m and 11 degrees while five images are taken, reported at three times."""
    angles = np.array([-0.1, 0.0, 0.1])
    zeros = np.zeros(3)
    rotations = np.stack([zeros, np.sin(angles / 2), zeros, np.cos(angles / 2)], axis=1)
    times = np.array([1_050_000_000, 1_200_000_000, 1_400_000_000], np.int64)
    return sc.Poses(times, np.stack([np.array([0.0, 0.1, 0.3]), zeros, zeros], axis=1), rotations)


@cache
def street():
    camera_model = Camera("pinhole", 80, 48, 45.0, 45.0, 39.5, 23.5)
    drive = simulate_street(1, frames=5, lidar=LidarSpec(beams=8, steps=60), cameras=(CameraSpec(camera_model),)).scene
    return replace(drive, annotations=())


def corrected_over_time(kind):
    """A drive whose camera moves on the vehicle: by a correction, as its poses state, or as each image says."""
    drive = street()
    correction = sc.CameraCalibration("drift", "camera0", drifting())
    corrected = replace(drive, annotations=(correction,))
    (camera,) = corrected.corrected().cameras if kind == "poses" else drive.cameras
    shots, mount = drive.cameras[0].images, drive.cameras[0].mount
    if kind == "mountings":
        own = sc.LazyFrames(shots.timestamps_ns, lambda k: replace(shots[k], mount=mount))
        camera = replace(camera, images=own)
    sensors = tuple(camera if one.id == camera.id else one for one in drive.sensors)
    return replace(drive if kind == "poses" else corrected, sensors=sensors)


def mountings(scene, injected):
    """`ego_from_camera` at each image, (N, 4, 4), seen from the first one, whatever the ego's frame is."""
    (camera,) = scene.cameras
    timestamps = injected.cameras[0].images.timestamps_ns
    found = []
    for k, timestamp in enumerate(timestamps):
        own = camera.images[k].mount if len(camera.images) else None
        mount = own or camera.mount
        if mount is None:
            trajectories = scene.trajectories or injected.trajectories
            at = np.array([timestamp], np.int64)
            ego, there = (path.held(at) for path in (next(iter(trajectories.values())).poses, camera.poses))
            ego, there = (RigidTransform.from_quaternion(p.positions[0], p.quaternions_xyzw[0]) for p in (ego, there))
            mount = there if camera.coordinates is sc.Coordinates.EGO else ego.inverse() @ there
        found.append(mount.matrix)
    return np.linalg.inv(found[0]) @ np.array(found)


def expected_mountings():
    (camera,) = street().cameras
    held = drifting().held(camera.images.timestamps_ns)
    pairs = zip(held.positions, held.quaternions_xyzw, strict=True)
    matrices = [(camera.mount @ RigidTransform.from_quaternion(*pair)).matrix for pair in pairs]
    return np.linalg.inv(matrices[0]) @ np.array(matrices)


def of_poses(report, support):
    return [loss for loss in report if loss.field == "sensors[camera0].poses" and loss.support is support]


@pytest.mark.parametrize("kind", ["correction", "poses", "mountings"])
@pytest.mark.parametrize(
    ("name", "keeps"),
    [
        ("d.sfs", True), ("recording", True), ("d.mcap", True), ("d.bag", True), ("d.ros2", True),
        ("nuscenes", True), ("kitti-object", True), ("colmap", True), ("nerfstudio", True),
        ("kitti-raw", False), ("kitti-tracking", False), ("kitti-odometry", False),
    ],
)  # fmt: skip
@pytest.mark.few(15)
def test_a_camera_that_moves_on_the_vehicle_does_so_in_the_target_or_is_a_loss(name, keeps, kind, tmp_path):
    if name in ("d.bag", "d.ros2"):
        pytest.importorskip("rosbags")
    injected = corrected_over_time(kind)
    right = expected_mountings()
    assert np.abs(right - np.eye(4)).max() > 0.2
    np.testing.assert_allclose(mountings(injected.corrected(), injected), right, atol=1e-7)
    target = tmp_path / name
    form = None if "." in name else name
    if kind == "mountings" and not keeps:
        with pytest.raises(CalibrationError, match=r"images have mountings of their own, up to 0\.3 m and 11"):
            write_scene(injected, target, format=form)
        return
    report = write_scene(injected, target, format=form)
    lost = of_poses(report, Support.APPROXIMATED)
    if not keeps:
        (loss,) = lost
        assert loss.largest_error == pytest.approx(0.3)
        return
    assert not lost
    if name in ("colmap", "nerfstudio"):
        held = next(iter(injected.trajectories.values())).poses.held(injected.cameras[0].images.timestamps_ns)
        pairs = zip(held.positions, held.quaternions_xyzw, strict=True)
        egos = [RigidTransform.from_quaternion(*pair).matrix for pair in pairs]
        mounts = np.linalg.inv(egos) @ cameras_in_world(target)
        found = np.linalg.inv(mounts[0]) @ mounts
    else:
        with open_scene(target) as read:
            found = mountings(read.corrected(), injected)
    np.testing.assert_allclose(found, right, atol=1e-5)


@pytest.mark.parametrize("kind", ["correction", "poses", "mountings"])
def test_openlabel_lists_how_far_poses_at_its_frames_are_off_at_the_images_times(kind, tmp_path):
    injected = corrected_over_time(kind)
    report = write_scene(injected, tmp_path / "d.json", format="openlabel")
    (loss,) = of_poses(report, Support.APPROXIMATED)
    times = injected.cameras[0].images.timestamps_ns
    with open_scene(tmp_path / "d.json") as read:
        found = read.cameras[0].poses.interpolate(times)
    right = injected.corrected().cameras[0].poses.interpolate(times)
    off = np.linalg.norm(found.positions - right.positions, axis=1)
    assert loss.largest_error == pytest.approx(np.nanmax(off), abs=1e-9)
    assert loss.largest_error > 1e-3
    assert [one.count for one in of_poses(report, Support.DROPPED)] == [np.isnan(off).sum()] == [1]
    if kind == "poses":
        # with frames at the images' times it has their poses
        injected = replace(injected, sensors=injected.cameras)
        report = write_scene(injected, tmp_path / "e.json", format="openlabel")
        assert not of_poses(report, Support.APPROXIMATED)
        with open_scene(tmp_path / "e.json") as read:
            np.testing.assert_allclose(mountings(read, injected), expected_mountings(), atol=1e-7)


TIMES = np.array([0, 100_000_000], np.int64)
MOUNT = RigidTransform.identity()


def of(times, sweep):
    """A lidar with such sweeps, and a camera."""
    camera_model = Camera("pinhole", 8, 6, 6.0, 6.0, 4.0, 3.0)
    images = [sc.CameraImage(int(time), camera_model, decode=lambda: np.zeros((6, 8, 3), np.uint8)) for time in times]
    points = [sc.LidarPoints(np.asarray(sweep(k), np.float32)) for k in range(len(times))]
    frames = sc.LazyFrames(times, lambda k: sc.LidarFrame(int(times[k]), points[k]))
    camera = sc.CameraSensor("camera", camera_model, sc.LazyFrames(times, images.__getitem__), mount=MOUNT)
    return sc.Scene((sc.LidarSensor("lidar", frames, mount=MOUNT), camera))


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
        key: sc.Trajectory(key, times, np.array([[0.0, 0.0, 0.0], [end, 0.0, 0.0]]), straight)
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


def test_targets_that_hold_data_where_the_sensors_are_need_no_poses(tmp_path):
    names = "recording mcap ros2 kitti-raw kitti-tracking kitti-odometry kitti-object npz pcd ply las laz kitti-bin"
    for name in [*names.split(), "nuscenes-bin", "openlabel", "d.bag", "d.sfs"]:
        losses = write_scene(drive(), tmp_path / name, format=None if "." in name else name)
        assert not [loss for loss in losses if loss.support is Support.APPROXIMATED and "trajector" in loss.field], name


def test_cuboids_in_the_world_are_seen_from_a_stationary_ego_which_is_reported(tmp_path):
    path = sc.CuboidPath(TIMES[:1], np.array([[4.0, 2.0, 1.5, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0]]))
    scene = replace(drive(), annotations=(sc.CuboidAnnotation("box", path, "car"),))
    for name in ("kitti-raw", "kitti-tracking", "kitti-object"):
        assert reported(write_scene(scene, tmp_path / name, format=name)) == [STATIONARY_EGO]


def drifted(*, recorded):
    """The drive with an adjustment: of a recorded trajectory that drifts aside, else from the ego to the world."""
    times = np.array([0, 600_000_000])
    straight, still = np.array([[0.0, 0.0, 0.0, 1.0]] * 2), np.zeros(2)
    drift = np.array([0.0, 0.9])
    if recorded:
        aside = np.stack([np.array([100.0, 101.2]), 50.0 + drift, still], axis=1)
        repair = sc.Poses(times, np.stack([still, -drift, still], axis=1), straight)
        trajectories = {"recorded": sc.Trajectory("recorded", times, aside, straight)}
    else:
        repair, trajectories = sc.Poses(times, np.array([[100.0, 50.0, 0.0], [101.2, 50.0, 0.0]]), straight), {}
    return replace(moving(), trajectories=trajectories, annotations=(sc.LocalizationAdjustment("repair", repair),))


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
