from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.errors import OptionError
from sceneloom.scene import CameraSensor, GnssSensor, ImuSensor, LidarSensor, PointsFrame, SensorType
from sceneloom.simulate import CameraSpec, ImuSpec, LidarSpec, camera_mount, demo_drive, simulate_street

SMALL = LidarSpec(beams=8, steps=200)
TINY = Camera("pinhole", 40, 30, 30.0, 30.0, 19.5, 14.5)


def test_a_drive_has_the_sensors_of_a_recording(drive):
    scene = drive.scene
    assert scene.format == "simulated"
    assert [sensor.id for sensor in scene.sensors] == ["lidar", "camera0", "imu", "gnss"]
    assert [type(sensor) for sensor in scene.sensors] == [LidarSensor, CameraSensor, ImuSensor, GnssSensor]
    assert scene.lidars[0].points_frame is PointsFrame.SENSOR
    assert list(scene.trajectories) == ["groundTruth"]
    assert scene.sensor("imu").type is SensorType.IMU
    assert set(scene.sensor("imu").streams) == {"accelerometer", "gyroscope"}


def test_sweeps_and_images_follow_each_other_ten_times_a_second(drive):
    lidar, camera = drive.scene.lidars[0], drive.scene.cameras[0]
    np.testing.assert_array_equal(lidar.frames.timestamps_ns, 1_000_000_000 + 100_000_000 * np.arange(8))
    np.testing.assert_array_equal(camera.images.timestamps_ns - lidar.frames.timestamps_ns, 50_000_000)
    assert [frame.timestamp_ns for frame in lidar.frames] == lidar.frames.timestamps_ns.tolist()
    assert camera.images[3].timestamp_ns == camera.images.timestamps_ns[3]
    assert camera.fps == 10.0


def test_the_image_is_taken_when_the_lidar_looks_ahead(drive):
    frame, image = drive.scene.lidars[0].frames[2], drive.scene.cameras[0].images[2]
    ahead = frame.points.positions[:, 0] > 5 * np.abs(frame.points.positions[:, 1])
    # The sensor looks within 11 degrees of ahead for 6 ms of its rotation.
    assert np.abs(frame.points.timestamps_ns[ahead] - image.timestamp_ns).max() < 4_000_000


def test_poses_of_sensors_are_trajectory_and_mounting(drive):
    for sensor in (*drive.scene.lidars, *drive.scene.cameras):
        exact = drive.truth.path.at(sensor.poses.timestamps_ns)
        np.testing.assert_allclose(
            sensor.poses.positions, exact.positions + exact.rotations @ sensor.mount.translation, atol=1e-9
        )
        rotated = Rotation.from_quat(sensor.poses.quaternions_xyzw).as_matrix()
        np.testing.assert_allclose(rotated, exact.rotations @ sensor.mount.rotation, atol=1e-9)


def test_trajectory_imu_and_gnss_reach_beyond_every_sweep_and_image(drive):
    scene = drive.scene
    first, last = (
        scene.lidars[0].frames[0].timestamp_ns,
        scene.lidars[0].frames[-1].timestamp_ns + 100_000_000,
    )
    for times in (
        scene.trajectories["groundTruth"].timestamps_ns,
        scene.sensor("gnss").timestamps_ns,
        *(stream.timestamps_ns for stream in scene.sensor("imu").streams.values()),
    ):
        assert times[0] < first
        assert times[-1] > last
        assert (np.diff(times) > 0).all()


def test_the_imu_keeps_a_clock_of_its_own(drive):
    imu = set(drive.scene.sensor("imu").streams["gyroscope"].timestamps_ns.tolist())
    assert not imu & set(drive.scene.cameras[0].images.timestamps_ns.tolist())


def test_the_points_of_a_car_lie_in_its_box(exact_drive):
    clean = exact_drive.truth.clean_points_world(0)
    boxes = {annotation.id: annotation for annotation in exact_drive.scene.annotations}
    seen = 0
    for thing in exact_drive.truth.objects:
        if thing.label not in {"car", "bin", "tree", "pole"}:
            assert f"{thing.label}-{thing.instance}" not in boxes
            continue
        box = boxes[f"{thing.label}-{thing.instance}"]
        assert box.stationary
        row = box.path.values[0]
        own = clean.positions_world[clean.instances == thing.instance]
        away = Rotation.from_euler("z", row[8], degrees=True).inv().apply(own - row[3:6]) if len(own) else own
        assert (np.abs(away) <= row[:3] / 2 + 1e-9).all()
        seen += len(own)
    assert seen > 300


def test_ids_of_annotations_are_unique_and_angles_are_stated_to_be_degrees(drive):
    ids = [annotation.id for annotation in drive.scene.annotations]
    assert len(ids) == len(set(ids)) > 20
    ours = drive.scene.metadata["sceneloom"]
    assert (ours["euler_unit"], ours["euler_order"]) == ("degrees", "xyz")


def test_cars_point_along_the_street(drive):
    yaws = [np.radians(a.path.values[0, 8]) for a in drive.scene.annotations if a.label == "car"]
    headings = drive.truth.path.at_seconds(np.linspace(-10, 10, 50))
    yaw = np.arctan2(headings.rotations[:, 1, 0], headings.rotations[:, 0, 0])
    nearest = [
        np.abs((np.subtract.outer(yaw, angle) + np.pi / 2) % np.pi - np.pi / 2).min() for angle in yaws
    ]
    # Parked along the road, to either side, within 0.03 rad.
    assert np.max(nearest) < 0.05


def test_visible_points_fall_on_pixels_of_their_own_depth_and_object(exact_drive):
    truth, camera = exact_drive.truth, exact_drive.scene.cameras[0]
    for k in (0, 6):
        clean, image = truth.clean_points_world(k), truth.image("camera0", k)
        in_camera = truth.world_from_camera("camera0", k).inverse().apply(clean.positions_world)
        pixels, inside = project(camera.camera, in_camera)
        visible = truth.visible("camera0", k, clean.positions_world)
        column, row = np.rint(pixels[inside]).astype(int).T
        away = ~truth.edges("camera0", k)[row, column]
        depth, z = image.depths[row, column].astype(np.float64), in_camera[inside, 2]
        seen, hidden = away & visible[inside], away & ~visible[inside]
        assert seen.sum() > 1500
        # Half a pixel beside the point a slanting surface is nearer or farther: 3 % where it is met at 2 degrees.
        assert (np.abs(depth - z)[seen] < 0.03 * z[seen]).mean() > 0.999
        assert (image.instances[row, column] == clean.instances[inside])[seen].all()
        assert hidden.sum() > 5
        assert (depth[hidden] < z[hidden]).all()


def test_points_behind_a_wall_are_not_visible_and_those_on_it_are(drive):
    truth = drive.truth
    camera = truth.world_from_camera("camera0", 0)
    house = next(thing for thing in truth.objects if thing.label == "building" and thing.center_world[0] > 15)
    middle = np.array(house.center_world)
    beyond = camera.translation + 2.0 * (middle - camera.translation)
    assert truth.visible("camera0", 0, [middle, beyond]).tolist() == [False, False]
    ahead = camera.apply(np.array([[0.0, 0.5, 3.0], [0.0, 0.0, 2.0]]))
    assert truth.visible("camera0", 0, ahead).tolist() == [True, True]
    assert truth.visible("camera0", 0, np.zeros((0, 3))).shape == (0,)


def test_near_points_have_the_colour_that_the_image_shows(exact_drive):
    truth, camera = exact_drive.truth, exact_drive.scene.cameras[0]
    clean = truth.clean_points_world(3)
    in_camera = truth.world_from_camera("camera0", 3).inverse().apply(clean.positions_world)
    pixels, inside = project(camera.camera, in_camera)
    near = inside & truth.visible("camera0", 3, clean.positions_world) & (clean.ranges < 15)
    column, row = np.rint(pixels[near]).astype(int).T
    away = ~truth.edges("camera0", 3)[row, column]
    shown = camera.images[3].rgb[row, column].astype(int)
    difference = np.abs(shown - clean.colors[near]).max(axis=1)[away]
    # The nearest pixel is up to half a pixel beside the point: 1 cm at 15 m, on patterns with edges 2 cm soft.
    assert len(difference) > 500
    assert np.median(difference) <= 2
    assert np.percentile(difference, 90) <= 20


def test_several_cameras_and_camera_models_have_ids_in_their_order():
    cameras = [
        CameraSpec(TINY, camera_mount(yaw_deg=yaw), offset_ns=offset)
        for yaw, offset in ((0.0, 0), (120.0, 20_000_000), (-120.0, 80_000_000))
    ]
    drive = simulate_street(1, frames=2, lidar=SMALL, cameras=cameras)
    assert [camera.id for camera in drive.scene.cameras] == ["camera0", "camera1", "camera2"]
    offsets = [camera.images.timestamps_ns[0] - 1_000_000_000 for camera in drive.scene.cameras]
    assert offsets == [0, 20_000_000, 80_000_000]
    images = [camera.images[1].rgb for camera in drive.scene.cameras]
    assert not np.array_equal(images[0], images[1])


def test_a_drive_can_be_a_single_sweep_without_cameras():
    drive = simulate_street(1, frames=1, lidar=SMALL, cameras=(), start_ns=-5_000_000_000)
    assert drive.scene.cameras == ()
    frame = drive.scene.lidars[0].frames[0]
    assert frame.timestamp_ns == -5_000_000_000
    assert len(frame.points) > 500
    assert frame.points.timestamps_ns.max() < -4_900_000_000


def test_seeds_are_streets_of_their_own_and_repeat_exactly():
    first, again, other = (simulate_street(seed, frames=2, lidar=SMALL, cameras=()) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.truth.street.shapes.maps, again.truth.street.shapes.maps)
    for name in ("accelerometer", "gyroscope"):
        ours, theirs, others = (d.scene.sensor("imu").streams[name].values for d in (first, again, other))
        np.testing.assert_array_equal(ours, theirs)
        assert not np.array_equal(ours, others)
    np.testing.assert_array_equal(
        first.scene.sensor("gnss").positions_lla, again.scene.sensor("gnss").positions_lla
    )
    a, b, c = (d.scene.lidars[0].frames[1].points.positions for d in (first, again, other))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


def test_noise_of_one_sensor_does_not_depend_on_another():
    first = simulate_street(4, frames=2, lidar=SMALL, cameras=())
    other = simulate_street(4, frames=2, lidar=SMALL, cameras=(CameraSpec(TINY),), imu=ImuSpec(rate_hz=100))
    np.testing.assert_array_equal(
        first.scene.lidars[0].frames[1].points.positions, other.scene.lidars[0].frames[1].points.positions
    )


def test_the_demo_drive_has_two_camera_models_with_smooth_outlines():
    drive = demo_drive(0, frames=2)
    assert [camera.camera.model for camera in drive.scene.cameras] == ["brown_conrady", "fisheye"]
    image = drive.scene.cameras[1].images[0].rgb
    assert image.shape == (400, 640, 3)
    assert not np.array_equal(image, drive.truth.colors("camera1", 0))
    even = [camera.camera.width % 2 + camera.camera.height % 2 for camera in drive.scene.cameras]
    assert even == [0, 0]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"frames": 0}, "0 frames"),
        ({"trajectory_hz": 1.0}, "poses a second"),
        ({"cameras": (CameraSpec(TINY, offset_ns=10**9),)}, "expected -100000000 to 200000000"),
        ({"seed": -1}, "seed"),
    ],
)
def test_arguments_out_of_bounds_are_refused(wrong, message):
    with pytest.raises(OptionError, match=message):
        simulate_street(**{"lidar": SMALL, "cameras": (), **wrong})


def test_asking_for_a_camera_that_is_not_there_names_those_that_are(drive):
    with pytest.raises(OptionError, match="'camera7'; expected one of 'camera0'"):
        drive.truth.depth("camera7", 0)


def test_the_parts_of_the_truth_agree_with_the_whole(drive):
    image = drive.truth.image("camera0", 1)
    np.testing.assert_array_equal(drive.truth.depth("camera0", 1), image.depths)
    np.testing.assert_array_equal(drive.truth.instances("camera0", 1), image.instances)
    assert ((image.depths > 0) == (image.instances >= 0)).all()
    poses = drive.truth.world_from_ego(np.array([1_000_000_000, 1_500_000_000], np.int64))
    exact = drive.truth.path.at(poses.timestamps_ns)
    np.testing.assert_array_equal(poses.positions, exact.positions)
    same = replace(poses, quaternions_xyzw=exact.quaternions_xyzw)
    np.testing.assert_array_equal(poses.quaternions_xyzw, same.quaternions_xyzw)
