"""Drives of KITTI's raw data, read and written, and scenes written as each of KITTI's folders."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats import open_scene, write_scene
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.registry import drives_of
from sceneloom.geometry.boxes import box_corners
from sceneloom.geometry.rigid import RigidTransform, rotate_vectors
from sceneloom.scene import CuboidAnnotation, LabeledPoints, LabeledPointsAnnotation, LazyFrames, PointsFrame, Scene
from sceneloom.scene.annotations_at import cuboid_poses
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import CameraSpec, GnssSpec, ImuSpec, LidarSpec, camera_mount, simulate_street

DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"

CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_02: 40 30
K_02: 50 0 19 0 51 14 0 0 1
D_02: -0.3 0.1 0.001 -0.002 -0.02
R_02: 0.9998 -0.02 0 0.02 0.9998 0 0 0 1
T_02: 0.06 0.01 -0.002
S_rect_02: 36 28
R_rect_00: 0.99995 0.01 0 -0.01 0.99995 0 0 0 1
R_rect_02: 1 0 0 0 1 0 0 0 1
P_rect_02: 48 0 17 2.88 0 48 13 0.5 0 0 1 0.003
"""
VELO_TO_CAM = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0.01 -0.08 -0.27\ndelta_f: 0 0\ndelta_c: 0 0\n"
IMU_TO_VELO = "calib_time: 25-May-2012 16:47:16\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n"
TIMESTAMPS = "2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.698214100\n"
STARTS = "2011-09-26 13:02:25.544360375\n2011-09-26 13:02:25.648214100\n"
ENDS = "2011-09-26 13:02:25.644360375\n2011-09-26 13:02:25.748214100\n"
OXTS = (
    "49.0 8.0 110.0 0.01 -0.02 {yaw} 1 2 3 4 5 0.1 0.2 9.8 0.3 0.4 9.7 0.01 0.02 0.03 0.04 0.05 0.06 "
    "0.5 0.07 4 10 5 4 0\n"
)
TRACKLETS = """<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization signature="serialization::archive" version="9">
<tracklets class_id="0" tracking_level="0" version="0"><count>1</count><item_version>1</item_version>
<item class_id="1" tracking_level="0" version="1"><objectType>Car</objectType><h>1.5</h><w>1.6</w><l>4</l>
<first_frame>0</first_frame><poses class_id="2" tracking_level="0" version="0"><count>2</count>
<item_version>2</item_version>
<item><tx>10</tx><ty>2</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.5</rz><state>2</state><occlusion>0</occlusion>
<occlusion_kf>0</occlusion_kf><truncation>1</truncation><amt_occlusion>-1</amt_occlusion></item>
<item><tx>9</tx><ty>2</ty><tz>-1.7</tz><rx>0</rx><ry>0</ry><rz>0.6</rz><state>1</state><occlusion>1</occlusion>
<occlusion_kf>0</occlusion_kf><truncation>0</truncation><amt_occlusion>-1</amt_occlusion></item>
</poses><finished>1</finished></item></tracklets></boost_serialization>
"""
SWEEP = np.array(
    [[-9, -0.001, 0, 0.1], [0, -5, 1, 0.25], [8, 0, -1, 0.5], [0, 6, 1, 0.75], [-7, 0.001, 0, 1.0]], np.float32
)
"""Behind on the right, right, ahead, left, behind on the left: in the order in which the scanner rotates."""

TEXTS = {
    "calib_cam_to_cam.txt": CAM_TO_CAM,
    "calib_velo_to_cam.txt": VELO_TO_CAM,
    "calib_imu_to_velo.txt": IMU_TO_VELO,
    "DRIVE/image_02/timestamps.txt": TIMESTAMPS,
    "DRIVE/velodyne_points/timestamps.txt": TIMESTAMPS,
    "DRIVE/velodyne_points/timestamps_start.txt": STARTS,
    "DRIVE/velodyne_points/timestamps_end.txt": ENDS,
    "DRIVE/oxts/timestamps.txt": TIMESTAMPS,
    "DRIVE/oxts/data/0000000000.txt": OXTS.format(yaw=0.3),
    "DRIVE/oxts/data/0000000001.txt": OXTS.format(yaw=0.4),
    "DRIVE/tracklet_labels.xml": TRACKLETS,
}


@pytest.fixture
def raw_folder(tmp_path):
    """Write the folder of the day's, some of its texts replaced or, with None, left out; the name of the drive too."""

    def write(changed=None, *, drive=DRIVE, size=(36, 28)):
        root = tmp_path / "kitti"
        for name, text in (TEXTS | (changed or {})).items():
            if text is not None:
                location = root / DAY / name.replace("DRIVE", drive)
                location.parent.mkdir(parents=True, exist_ok=True)
                location.write_text(text)
        folder = root / DAY / drive
        for kind in ("image_02", "velodyne_points"):
            (folder / kind / "data").mkdir(parents=True, exist_ok=True)
        for k in range(2):
            image = np.full((size[1], size[0], 3), 40 * k + np.arange(3), np.uint8)
            Image.fromarray(image).save(folder / "image_02" / "data" / f"{k:010d}.png")
            SWEEP.tofile(folder / "velodyne_points" / "data" / f"{k:010d}.bin")
        return root

    return write


FIRST_NS = 1_317_042_145_594_360_375
"""2011-09-26 13:02:25.594360375, of `date -u +%s` and the nine digits."""

POINTS = np.array([[12.0, 1.5, -0.6], [20.0, -3.0, 0.4], [7.0, 0.2, -1.0]])


def matrix(rotation, translation="0 0 0"):
    found = np.eye(4)
    found[:3, :3] = np.array(rotation.split(), float).reshape(3, 3)
    found[:3, 3] = np.array(translation.split(), float)
    return found


def nearest_rotation(rounded):
    """The files' numbers are rounded; a rotation is what is meant."""
    u, _, vt = np.linalg.svd(rounded)
    return u @ vt


VELO = matrix("0 -1 0 0 0 -1 1 0 0", "0.01 -0.08 -0.27")


def pixels_of(scene):
    """Where the first camera sees points of the lidar's frame."""
    camera, lidar = scene.cameras[0], scene.lidars[0]
    return project(camera.camera, (camera.mount.inverse() @ lidar.mount).apply(POINTS))[0]


def test_times_keep_their_nanoseconds_and_points_get_those_of_a_rotation_whose_ends_are_known(raw_folder):
    root = raw_folder()
    scene = open_scene(root)
    assert scene.format == "kitti-raw"
    assert scene.sensor("camera2").images.timestamps_ns.tolist() == [FIRST_NS, FIRST_NS + 103_853_725]
    assert scene.sensor("gnss").timestamps_ns[0] == FIRST_NS
    frame = scene.sensor("velodyne").frames[0]
    assert frame.timestamp_ns == scene.sensor("velodyne").frames.timestamps_ns[0] == FIRST_NS - 50_000_000
    np.testing.assert_array_equal(frame.points.positions, SWEEP[:, :3])
    assert frame.points.intensities.tolist() == [26, 64, 128, 191, 255]
    quarters = (frame.points.timestamps_ns - frame.timestamp_ns) / 25_000_000
    np.testing.assert_allclose(quarters, [0, 1, 2, 3, 4], atol=2e-4)  # the points behind are 0.001 m aside
    assert [n.code for n in scene.warnings] == ["point-times"]
    # without the mounting of the OXTS unit, the ego stands
    for name in (
        "calib_imu_to_velo.txt",
        *(f"{DRIVE}/velodyne_points/timestamps_{end}.txt" for end in ("start", "end")),
    ):
        (root / DAY / name).unlink()
    scene = open_scene(root)
    frame = scene.sensor("velodyne").frames[0]
    assert (frame.points.timestamps_ns, frame.timestamp_ns) == (None, FIRST_NS)
    assert {n.code for n in scene.warnings} >= {"sweep-start", "no-imu-mounting", "ego-stands"}
    assert list(scene.trajectories) == ["stationary"]
    np.testing.assert_allclose(scene.annotations[0].path.values[0, 3:6], [10, 2, -0.95])


def test_images_show_points_where_the_kits_formula_puts_them_and_as_recorded_distorted_as_opencv_does_it(raw_folder):
    delta_rotation = matrix("0.99995 0.01 0 -0.01 0.99995 0 0 0 1")
    delta_rotation[:3, :3] = nearest_rotation(delta_rotation[:3, :3])
    projection = np.array([[48, 0, 17, 2.88], [0, 48, 13, 0.5], [0, 0, 1, 0.003]])
    homogeneous = projection @ delta_rotation @ VELO @ np.column_stack([POINTS, np.ones(3)]).T
    found = pixels_of(open_scene(raw_folder()))
    np.testing.assert_allclose(found, (homogeneous[:2] / homogeneous[2]).T, atol=1e-9)
    root = raw_folder(drive="2011_09_26_drive_0001_extract", size=(40, 30))
    scene = open_scene(root, sequence="0001_extract")
    camera_from_camera0 = matrix("0.9998 -0.02 0 0.02 0.9998 0 0 0 1", "0.06 0.01 -0.002")
    camera_from_camera0[:3, :3] = nearest_rotation(camera_from_camera0[:3, :3])
    camera_from_velo = camera_from_camera0 @ VELO
    k = np.array([[50.0, 0, 19], [0, 51, 14], [0, 0, 1]])
    distortion = np.array([-0.3, 0.1, 0.001, -0.002, -0.02])
    delta_rotation, _ = cv2.Rodrigues(camera_from_velo[:3, :3])
    expected, _ = cv2.projectPoints(POINTS, delta_rotation, camera_from_velo[:3, 3], k, distortion)
    assert scene.sensor("camera2").camera.model == "brown_conrady"
    np.testing.assert_allclose(pixels_of(scene), expected[:, 0], atol=1e-9)


def test_oxts_lines_are_fixes_inertial_values_and_a_trajectory(raw_folder):
    scene = open_scene(raw_folder())
    imu, gnss, trajectory = scene.sensor("imu"), scene.sensor("gnss"), scene.trajectories["oxts"]
    assert imu.streams["accelerometer"].values.tolist() == [[0.1, 0.2, 9.8]] * 2
    assert imu.streams["gyroscope"].values.tolist() == [[0.01, 0.02, 0.03]] * 2
    assert imu.streams["oxtsStatus"].values[0].tolist() == [0.07, 4, 10, 5, 4, 0]
    assert gnss.positions_lla[0].tolist() == [49, 8, 110]
    assert gnss.accuracies.tolist() == [0.5, 0.5]
    # yaw 0.3 from the east to the north, nose down by the pitch of -0.02: positive is front down
    ahead = Rotation.from_quat(trajectory.quaternions_xyzw[0]).apply([1, 0, 0])
    expected = [np.cos(0.3) * np.cos(-0.02), np.sin(0.3) * np.cos(-0.02), -np.sin(-0.02)]
    np.testing.assert_allclose(ahead, expected, atol=1e-12)


def test_tracklets_stand_on_their_bottom_in_the_lidars_frame(raw_folder):
    scene = open_scene(raw_folder())
    (box,) = scene.annotations
    lidar = scene.sensor("velodyne")
    assert (box.id, box.label) == (0, "Car")
    poses = cuboid_poses(box, box.path.timestamps_ns)
    source = PoseSource(scene.trajectories["oxts"].poses, lidar.mount).at(box.path.timestamps_ns)
    world_from_lidar = RigidTransform.from_quaternion(source.positions[1], source.quaternions_xyzw[1])
    corners = box_corners(poses.centers_world[1], poses.sizes_lwh[1], poses.quaternions_xyzw[1])
    found = world_from_lidar.inverse().apply(corners)
    along, across = np.array([np.cos(0.6), np.sin(0.6)]), np.array([-np.sin(0.6), np.cos(0.6)])
    expected = [[9, 2] + along * dx + across * dy for dx, dy in ((2, 0.8), (-2, 0.8), (-2, -0.8), (2, -0.8))]
    np.testing.assert_allclose(found[:4, :2], expected, atol=1e-9)
    np.testing.assert_allclose(found[:, 2], [-1.7] * 4 + [-0.2] * 4, atol=1e-9)
    reported = {attribute.name: attribute.values for attribute in box.attributes}
    assert reported == {"state": (2, 1), "occlusion": (0, 1), "occlusion_kf": (0, 0), "truncation": (1, 0)}


def test_frames_that_are_missing_between_others_are_reported_at_the_end_or_cut_off_a_fault(raw_folder):
    root = raw_folder()
    data = next(root.glob("*/*_sync/velodyne_points/data"))
    whole = (data / "0000000000.bin").read_bytes()
    (data / "0000000000.bin").unlink()
    scene = open_scene(root)
    assert len(scene.sensor("velodyne").frames) == 1
    assert "frames-missing" in [n.code for n in scene.warnings]
    (data / "0000000000.bin").write_bytes(whole)
    (data / "0000000001.bin").unlink()
    with pytest.raises(DataError, match=r"1 files for 2 times of timestamps.txt.*number 1\)"):
        open_scene(root)
    assert len(open_scene(root, lenient=True).sensor("velodyne").frames) == 1
    (data / "0000000001.bin").write_bytes(whole[:-3])
    scene = open_scene(root)
    with pytest.raises(DataError, match=r"77 bytes are 4 points of 16 bytes"):
        scene.sensor("velodyne").frames[1]


def test_several_drives_are_listed_and_one_can_be_chosen(raw_folder):
    root = raw_folder()
    raw_folder(drive="2011_09_26_drive_0005_sync")
    with pytest.raises(OptionError, match=r"drive_0001_sync, 2011_09_26_drive_0005_sync; choose one"):
        open_scene(root)
    assert [drive.name[-9:] for drive in drives_of(root)] == ["0001_sync", "0005_sync"]
    assert open_scene(root, sequence="0005").source.endswith("0005_sync")
    with pytest.raises(OptionError, match=r"'0009'.*it has 2011_09_26_drive_0001_sync"):
        open_scene(root, sequence="0009")


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"calib_cam_to_cam.txt": None}, "calib_cam_to_cam.txt: is missing"),
        ({"calib_cam_to_cam.txt": CAM_TO_CAM.replace("R_rect_00", "R_rect_03")}, "no R_rect_00; it has"),
        ({"calib_velo_to_cam.txt": "R: 1 0 0\nT: 0 0 0\n"}, "line 1: 4 values; expected 10"),
        ({"calib_velo_to_cam.txt": "T: 0 0 0\n"}, "no R; it has T"),
        ({"DRIVE/image_02/timestamps.txt": None}, "image_02/timestamps.txt: is missing"),
        ({"DRIVE/image_02/timestamps.txt": "\n"}, "is empty; expected the time of each frame"),
        ({"DRIVE/image_02/timestamps.txt": "noon\nnight\n"}, "line 1: 'noon'; expected a number, or a date"),
        ({"DRIVE/image_02/timestamps.txt": "2011-09-26 13:02:25.5\n"}, "2 files up to number 1 for 1 times"),
        ({"DRIVE/oxts/data/0000000000.txt": "1 2 3\n"}, "line 1: 3 values; expected 30"),
        ({"DRIVE/velodyne_points/timestamps_end.txt": "2011-09-26 13:02:25.5\n"}, "1 times for 2 of timestamps"),
        ({"DRIVE/tracklet_labels.xml": "<a>"}, "is no XML"),
        ({"DRIVE/tracklet_labels.xml": "<a/>"}, "holds no `tracklets`"),
        ({"DRIVE/tracklet_labels.xml": "<!DOCTYPE a [<!ENTITY b 'c'>]><a/>"}, "declares entities"),
    ],
)
def test_a_fault_is_reported_with_its_location(raw_folder, changed, problem):
    with pytest.raises(DataError) as caught:
        open_scene(raw_folder(changed))
    assert problem in str(caught.value)


@pytest.mark.parametrize(("kind", "size"), [("sync", (36, 28)), ("extract", (40, 30))])
def test_a_drive_comes_back_file_by_file(raw_folder, tmp_path, kind, size):
    drive = f"2011_09_26_drive_0001_{kind}"
    root = raw_folder(drive=drive, size=size)
    before = open_scene(root)
    losses = write_scene(before, tmp_path / "out", format="kitti-raw")
    day, again = root / "2011_09_26", tmp_path / "out/2011_09_26"
    for name in (name.replace("DRIVE", drive) for name in TEXTS):
        if "oxts/data" not in name and "tracklet" not in name:
            assert (again / name).read_text() == (day / name).read_text(), name
    for k in range(2):
        image, sweep = f"{drive}/image_02/data/{k:010d}.png", f"{drive}/velodyne_points/data/{k:010d}.bin"
        assert (again / image).read_bytes() == (day / image).read_bytes()
        written, source = (np.fromfile(root / sweep, np.float32) for root in (again, day))
        np.testing.assert_allclose(written, source, atol=1 / 510)  # reflectance has 256 steps
        line = f"{drive}/oxts/data/{k:010d}.txt"
        np.testing.assert_allclose(*(np.loadtxt(root / line) for root in (again, day)), rtol=1e-12, atol=1e-14)
    assert not [loss for loss in losses if loss.field.startswith("sensors")]
    after = open_scene(tmp_path / "out")
    for one, other in zip(before.sensor("velodyne").frames, after.sensor("velodyne").frames, strict=True):
        assert other.timestamp_ns == one.timestamp_ns
        np.testing.assert_array_equal(other.points.timestamps_ns, one.points.timestamps_ns)
    (box,), (read,) = before.annotations, after.annotations
    np.testing.assert_array_equal(read.path.timestamps_ns, box.path.timestamps_ns)
    np.testing.assert_allclose(read.path.values, box.path.values, atol=1e-9)
    stated, expected = ({a.name: a.values for a in one.attributes} for one in (read, box))
    assert stated == expected


def test_a_changed_camera_model_makes_new_calibration_files(raw_folder, tmp_path):
    scene = open_scene(raw_folder())
    camera = scene.sensor("camera2")
    changed = replace(camera, camera=replace(camera.camera, fx=49.0))
    sensors = tuple(changed if s is camera else s for s in scene.sensors)
    write_scene(replace(scene, sensors=sensors), tmp_path / "out", format="kitti-raw")
    again = open_scene(tmp_path / "out").sensor("camera2")
    assert again.camera == changed.camera
    np.testing.assert_allclose(again.mount.matrix, camera.mount.matrix, atol=1e-12)


def test_boxes_of_the_last_sweep_lie_on_the_way(tmp_path):
    drive = simulate_street(4, frames=18, lidar=LidarSpec(beams=8, steps=450), cameras=())  # moments jitter by 0.2 ms
    write_scene(drive.scene, tmp_path / "out", format="kitti-raw")
    after = open_scene(tmp_path / "out")
    assert not [warning for warning in after.warnings if warning.code == "boxes-beyond-trajectory"]
    lidar = after.sensor("velodyne")
    np.testing.assert_array_equal(lidar.poses.timestamps_ns, lidar.frames.timestamps_ns)
    np.testing.assert_array_equal(after.trajectories["oxts"].timestamps_ns, lidar.frames.timestamps_ns)


FORMATS = ("kitti-raw", "kitti-object", "kitti-tracking", "kitti-odometry")
PINHOLE = Camera("pinhole", 80, 28, 45.0, 45.5, 39.5, 13.5)
BENT = Camera("brown_conrady", 80, 28, 45.0, 45.5, 39.5, 13.5, (-0.2, 0.05, 0.001, -0.002, 0.01))
WIDE = Camera("fisheye", 80, 40, 30.0, 30.0, 39.5, 19.5, (0.02, -0.004, 0.001, 0.0))


def street(*camera_models):
    """A drive whose sweeps and images are made once."""
    cameras = [CameraSpec(model, camera_mount(pitch_deg=1.0 + k)) for k, model in enumerate(camera_models)]
    lidar, imu = LidarSpec(beams=8, steps=90), ImuSpec(rate_hz=50.0)
    scene = simulate_street(3, frames=3, lidar=lidar, cameras=cameras, imu=imu, gnss=GnssSpec()).scene
    made = {}
    for lidar in scene.lidars:
        made[lidar.id] = {"frames": LazyFrames.of(list(lidar.frames), lidar.frames.timestamps_ns)}
    for camera in scene.cameras:
        images = [image.loaded() for image in camera.images]
        made[camera.id] = {"images": LazyFrames.of(images, camera.images.timestamps_ns)}
    return replace(scene, sensors=tuple(replace(sensor, **made.get(sensor.id, {})) for sensor in scene.sensors))


@pytest.fixture(scope="module")
def drive():
    return street(PINHOLE)


def first_pose(scene, sensor, time_ns):
    trajectory = next(iter(scene.trajectories.values())).poses
    at = PoseSource(trajectory, sensor.mount).at(np.array([time_ns], np.int64))
    return RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0])


@pytest.mark.parametrize("name", FORMATS)
def test_points_images_calibration_boxes_and_the_trajectory_but_for_its_world_come_back(drive, name, tmp_path):
    losses = write_scene(drive, tmp_path / "out", format=name)
    back = open_scene(tmp_path / "out")
    assert back.format == name
    for before, after in zip(drive.lidars[0].frames, back.lidars[0].frames, strict=True):
        np.testing.assert_array_equal(after.points.positions, before.points.positions)
        np.testing.assert_array_equal(after.points.intensities, before.points.intensities)
    for before, after in zip(drive.cameras[0].images, back.cameras[0].images, strict=True):
        np.testing.assert_array_equal(after.rgb, before.rgb)
    np.testing.assert_allclose(pixels_of(back), pixels_of(drive), atol=1e-9)
    if name != "kitti-object":
        times = back.lidars[0].frames.timestamps_ns[[0, -1]]
        ends = [[first_pose(scene, scene.lidars[0], time) for time in times] for scene in (drive, back)]
        before, after = (start.inverse() @ stop for start, stop in ends)
        # text has all digits, but east and north at the first location are rotated by 1e-6 against those at the origin
        np.testing.assert_allclose(after.matrix, before.matrix, atol=1e-6)
    if name == "kitti-odometry":
        return
    first = drive.lidars[0].frames[0]
    raw_times = drive.lidars[0].frames.timestamps_ns + first.reference_ns - first.timestamp_ns
    centers = []
    for scene, time in ((drive, raw_times[1]), (back, back.lidars[0].frames.timestamps_ns[1])):
        boxes = [a for a in scene.annotations if isinstance(a, CuboidAnnotation)]
        poses = [cuboid_poses(box, [time]) for box in boxes]
        there = [pose.centers_world[0] for pose in poses if pose.there[0]]
        centers.append(first_pose(scene, scene.lidars[0], time).inverse().apply(np.array(there)))
    before, after = centers
    assert len(after) == len(before) if name == "kitti-raw" else 0 < len(after) < len(before)
    nearest = np.linalg.norm(after[:, None] - before[None], axis=2).min(axis=1)
    assert nearest.max() < 2e-6  # labels have six decimals
    if name == "kitti-tracking":  # boxes that no image shows are reported
        boxes = [a for a in drive.annotations if isinstance(a, CuboidAnnotation)]
        (lost,) = [loss for loss in losses if loss.field == "annotations.cuboid"]
        assert (lost.support, lost.count) == (Support.DROPPED, len(boxes) - len(back.annotations))


def test_a_distorted_camera_model_stays_in_an_extract_and_is_resampled_for_a_sync(tmp_path):
    scene = street(BENT)
    write_scene(scene, tmp_path / "whole", format="kitti-raw")
    whole = open_scene(tmp_path / "whole").cameras[0]
    assert whole.camera.model == "brown_conrady"
    assert whole.camera.coefficients[:5] == BENT.coefficients
    losses = write_scene(scene, tmp_path / "flat", format="kitti-raw", kind="sync")
    flat = open_scene(tmp_path / "flat")
    assert flat.cameras[0].camera.model == "pinhole"
    assert "sensors.camera.images.rgb" in {loss.field for loss in losses if loss.support == Support.APPROXIMATED}
    assert (tmp_path / "flat/1970_01_01/1970_01_01_drive_0001_sync").is_dir()


@pytest.mark.slow
def test_camera_models_and_directions_that_a_folder_cannot_hold_are_reported(tmp_path):
    scene = street(WIDE, PINHOLE)
    losses = write_scene(scene, tmp_path / "out", format="kitti-tracking")
    back = open_scene(tmp_path / "out")
    assert [camera.id for camera in back.cameras] == ["camera2"]
    reported = {loss.what for loss in losses}
    assert any("rotated by 1° against camera 'camera0'" in what for what in reported)
    assert any("a fisheye camera model replaced by a pinhole" in what for what in reported)


def test_points_in_the_world_are_brought_back_into_the_lidars_frame(drive, tmp_path):
    lidar, frame = drive.lidars[0], drive.lidars[0].frames[1]
    trajectory = next(iter(drive.trajectories.values())).poses
    at = PoseSource(trajectory, lidar.mount).at(frame.points.timestamps_ns)
    world = rotate_vectors(at.quaternions_xyzw, frame.points.positions) + at.positions
    placed = replace(frame, points=replace(frame.points, positions=world.astype(np.float32)))
    frames = LazyFrames.of([placed], [frame.timestamp_ns])
    scene = replace(drive, sensors=(replace(lidar, frames=frames, points_frame=PointsFrame.WORLD),))
    losses = write_scene(scene, tmp_path / "out", format="kitti-odometry")
    after = open_scene(tmp_path / "out").lidars[0].frames[0].points
    np.testing.assert_allclose(after.positions, frame.points.positions, atol=2e-5)  # float32 at 100 m
    (reported,) = [loss for loss in losses if loss.field == "sensors.lidar.frames.points.positions"]
    assert reported.support == Support.CONVERTED


def test_labelled_points_get_semantic_kittis_numbers(drive, tmp_path):
    ids = np.arange(5, dtype=np.uint32)
    annotations = (
        LabeledPointsAnnotation("a", (LabeledPoints("lidar", ids, 1),), label="Road", is_instance=False),
        LabeledPointsAnnotation("b", (LabeledPoints("lidar", ids[3:], 1),), label="car", is_instance=True),
        LabeledPointsAnnotation("c", (LabeledPoints("lidar", ids[:2], 0),), label="spaceship"),
    )
    losses = write_scene(replace(drive, annotations=annotations), tmp_path / "out", format="kitti-odometry")
    found = np.fromfile(tmp_path / "out/sequences/00/labels/000001.label", "<u4")
    assert found[:6].tolist() == [40, 40, 40, 10 | 1 << 16, 10 | 1 << 16, 0]
    reported = {loss.field: loss for loss in losses}
    assert reported["annotations.labeled_points"].count == 2
    assert reported["annotations.labeled_points.labeled_points.point_ids"].count == 2
    assert {a.id for a in open_scene(tmp_path / "out").annotations} == {"road", "car 1"}


@pytest.mark.parametrize("name", FORMATS)
def test_images_alone_are_written_nothing_is_refused_and_other_peoples_folders_are_left_alone(drive, name, tmp_path):
    images = Scene(drive.cameras)
    for _ in range(2):
        write_scene(images, tmp_path / "own", format=name, overwrite=True)
    assert len(open_scene(tmp_path / "own").cameras[0].images) == 3
    with pytest.raises(OutputError, match=r"exists already"):
        write_scene(images, tmp_path / "own", format=name)
    with pytest.raises(DataError, match=r"holds (nothing that a folder of KITTI's could hold|neither sweeps nor)"):
        write_scene(Scene(()), tmp_path / "out", format=name)
    assert not (tmp_path / "out").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("dear")
    with pytest.raises(OutputError, match=r"holds 'letter.txt', so it is no folder of KITTI's"):
        write_scene(images, tmp_path / "mine", format=name, overwrite=True)


def test_times_before_1970_come_back(drive, tmp_path):
    times = [-1_500_000_001, -1, 7]
    shots = [replace(shot, timestamp_ns=time) for shot, time in zip(drive.cameras[0].images, times, strict=True)]
    early = replace(drive.cameras[0], images=LazyFrames.of(shots, times), poses=None)
    write_scene(Scene((early,)), tmp_path / "out", format="kitti-raw", kind="extract")
    assert open_scene(tmp_path / "out").cameras[0].images.timestamps_ns.tolist() == times


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("kitti-raw", {"kind": "both"}, "kind 'both'; expected one of sync, extract"),
        ("kitti-raw", {"sequence": "a"}, "sequence 'a'; expected up to four digits"),
        ("kitti-tracking", {"sequence": "12345"}, "sequence '12345'; expected four digits"),
        ("kitti-odometry", {"sequence": "x"}, "sequence 'x'; expected two digits"),
        ("kitti-object", {"sequence": "x"}, "option 'sequence'"),
    ],
)
def test_options_that_cannot_be_followed_are_refused(drive, tmp_path, name, options, problem):
    with pytest.raises(OptionError) as caught:
        write_scene(drive, tmp_path / "out", format=name, **options)
    assert problem in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", [*FORMATS, "kitti-bin", "nuscenes-bin"])
def test_points_without_a_location_are_left_out_of_files_of_bare_numbers(drive, name, tmp_path):
    lidar = drive.lidars[0]
    frames = list(lidar.frames)
    locations = frames[0].points.positions.copy()
    locations[::4] = np.nan
    frames[0] = replace(frames[0], points=replace(frames[0].points, positions=locations))
    holes = replace(lidar, frames=LazyFrames.of(frames, lidar.frames.timestamps_ns))
    road = LabeledPoints(lidar.id, np.arange(8, dtype=np.uint32), 0)
    labelled = LabeledPointsAnnotation("r", (road,), label="road")
    scene = replace(drive, sensors=(holes, *drive.cameras), annotations=(labelled,))
    losses = write_scene(scene, tmp_path / "out", format=name)
    assert any("not finite" in loss.what and loss.count == len(locations[::4]) for loss in losses)
    with open_scene(tmp_path / "out") as back:
        np.testing.assert_array_equal(back.lidars[0].frames[0].points.positions, locations[~np.isnan(locations[:, 0])])
        if name == "kitti-odometry":
            (reported,) = (labeled for found in back.annotations for labeled in found.labeled_points)
            np.testing.assert_array_equal(np.asarray(reported.point_ids), np.arange(6))
