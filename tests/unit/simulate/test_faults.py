import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom import simulate as sim
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.errors import OptionError
from sceneloom.simulate import Faults, SensorFaults, inject

SWEEP_NS = 100_000_000
START_NS = 1_000_000_000
CAMERA_MODEL = Camera("pinhole", 160, 120, 150.0, 150.0, 79.5, 59.5)


@pytest.fixture(scope="module")
def right():
    """A drive of twelve sweeps without faults."""
    lidar = sim.LidarSpec(beams=8, steps=120, range_sigma=0.0, drop_rate=0.0)
    return sim.simulate_street(4, frames=12, lidar=lidar, cameras=(sim.CameraSpec(CAMERA_MODEL, sim.camera_mount()),))


def injected(drive, sensor_id, *, seed=0, **wrong):
    """The drive with faults of one sensor."""
    return inject(drive, Faults({sensor_id: SensorFaults(**wrong)}, seed=seed))


def test_a_drive_without_faults_says_so_and_faults_are_injected_once(right):
    assert dict(right.faults.sensors) == {}
    assert inject(right, Faults()).scene.sensors == right.scene.sensors
    with pytest.raises(OptionError, match="faults already"):
        injected(injected(right, "lidar", lost_frames=(1,)), "camera0", lost_frames=(1,))


@pytest.mark.parametrize("sensor_id", ["lidar", "camera0"])
def test_the_stated_mounting_is_off_by_the_injected_error_and_the_truth_is_not(right, sensor_id):
    drive = injected(right, sensor_id, rotation_deg=(0.4, -1.5, 0.7), shift=(0.02, -0.05, 0.11))
    assert drive.truth is right.truth
    stated, true = drive.scene.sensor(sensor_id), right.scene.sensor(sensor_id)
    error = np.linalg.inv(true.mount.matrix) @ stated.mount.matrix
    np.testing.assert_allclose(Rotation.from_matrix(error[:3, :3]).as_rotvec(degrees=True), [0.4, -1.5, 0.7], atol=1e-9)
    np.testing.assert_allclose(error[:3, 3], [0.02, -0.05, 0.11], atol=1e-12)
    for k in (0, -1):
        exact, wrong = (Rotation.from_quat(sensor.poses.quaternions_xyzw[k].copy()) for sensor in (true, stated))
        np.testing.assert_allclose(wrong.as_matrix(), exact.as_matrix() @ error[:3, :3], atol=1e-9)
        moved = stated.poses.positions[k] - true.poses.positions[k]
        np.testing.assert_allclose(moved, exact.apply(error[:3, 3]), atol=1e-9)


def test_points_miss_their_pixels_by_what_a_rotated_camera_explains(right):
    drive = injected(right, "camera0", rotation_deg=(0.0, 1.0, 0.0))
    clean = drive.truth.clean_points_world(5).positions_world
    ego = drive.truth.path.at(right.scene.cameras[0].images.timestamps_ns[5:6])
    in_ego = (clean - ego.positions[0]) @ ego.rotations[0]
    pixels, inside = project(CAMERA_MODEL, drive.scene.cameras[0].mount.inverse().apply(in_ego))
    exact, exactly_inside = project(CAMERA_MODEL, drive.truth.world_from_camera("camera0", 5).inverse().apply(clean))
    both = inside & exactly_inside
    assert both.sum() > 50
    # A rotation by 1 degree about the downward axis moves what lies at the angle a off the axis from f tan(a) to
    # f tan(a - 1 degree): 2.6 px in the middle of the image.
    found, true = pixels[both, 0] - CAMERA_MODEL.cx, exact[both, 0] - CAMERA_MODEL.cx
    expected = CAMERA_MODEL.fx * np.tan(np.arctan(true / CAMERA_MODEL.fx) - np.radians(1.0))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(true - found)[np.abs(true) < 15] == pytest.approx(2.62, abs=0.05)


def test_a_rotated_inertial_unit_measures_gravity_askew(right):
    drive = injected(right, "imu", rotation_deg=(10.0, 0.0, 0.0))
    stated, true = (d.scene.sensor("imu").streams["accelerometer"].values for d in (drive, right))
    # The frame is stated as rotated by 10 degrees about x against where the unit is: it hangs 10 degrees the other way.
    np.testing.assert_allclose(stated, Rotation.from_euler("x", 10, degrees=True).apply(true.copy()), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(stated, axis=1), np.linalg.norm(true, axis=1))


@pytest.mark.parametrize("sensor_id", ["lidar", "camera0", "gnss", "imu"])
def test_timestamps_are_late_by_the_offset_and_drift_by_the_skew(right, sensor_id):
    drive = injected(right, sensor_id, time_offset_ns=30_000_000, clock_skew_ppm=200.0)
    given, true = (times_of(d.scene.sensor(sensor_id)) for d in (drive, right))
    assert len(given) == len(true)
    expected = true + 30_000_000 + (true - true[0]) * 200e-6
    np.testing.assert_allclose(given - expected, 0.0, atol=0.51)  # whole nanoseconds


def times_of(sensor):
    """The timestamps of a sensor of any kind."""
    if hasattr(sensor, "streams"):
        return sensor.streams["gyroscope"].timestamps_ns
    frames = getattr(sensor, "frames", getattr(sensor, "images", sensor))
    return frames.timestamps_ns


def test_point_times_follow_the_clock_of_their_sensor(right):
    drive = injected(right, "lidar", time_offset_ns=-7_000, clock_skew_ppm=-1000.0)
    given, true = drive.scene.lidars[0].frames[9], right.scene.lidars[0].frames[9]
    expected = true.points.timestamps_ns - 7_000 - (true.points.timestamps_ns - START_NS) * 1e-3
    np.testing.assert_allclose(given.points.timestamps_ns - expected, 0.0, atol=0.51)
    assert given.timestamp_ns == drive.scene.lidars[0].frames.timestamps_ns[9]
    np.testing.assert_array_equal(given.points.positions, true.points.positions)


@pytest.mark.parametrize(("offset_ns", "nearest"), [(0, [4, 5, 6]), (SWEEP_NS, [5, 6, 7])])
def test_an_offset_of_a_sweep_pairs_each_sweep_with_the_image_after(right, offset_ns, nearest):
    scene = injected(right, "lidar", time_offset_ns=offset_ns).scene
    times, frames = scene.cameras[0].images.timestamps_ns, scene.lidars[0].frames
    assert [np.abs(times - frames[k].reference_ns).argmin() for k in (4, 5, 6)] == nearest


def test_listed_frames_are_lost_and_the_others_are_what_they_were(right):
    drive = injected(right, "lidar", lost_frames=(2, 3, 11))
    kept = [0, 1, 4, 5, 6, 7, 8, 9, 10]
    assert drive.true_frames["lidar"].tolist() == kept
    assert len(drive.scene.lidars[0].frames) == 9
    for j, k in enumerate(kept):
        given, true = drive.scene.lidars[0].frames[j], right.scene.lidars[0].frames[k]
        assert given.timestamp_ns == true.timestamp_ns
        np.testing.assert_array_equal(given.points.positions, true.points.positions)
    assert len(drive.scene.cameras[0].images) == 12


def test_a_share_is_lost_at_random_by_seed_and_by_sensor(right):
    lost = Faults({"imu": SensorFaults(lost_share=0.3), "gnss": SensorFaults(lost_share=0.3)}, seed=2)
    drive, other = inject(right, lost), inject(right, replace(lost, seed=3))
    count = len(right.scene.sensor("imu").streams["gyroscope"])
    kept = len(drive.scene.sensor("imu").streams["gyroscope"])
    # A binomial of some 330 samples: four standard deviations are 10 %.
    assert kept / count == pytest.approx(0.7, abs=0.1)
    assert drive.true_frames["imu"].tolist() == inject(right, lost).true_frames["imu"].tolist()
    assert drive.true_frames["imu"].tolist() != other.true_frames["imu"].tolist()
    alone = injected(right, "gnss", lost_share=0.3, seed=2)
    assert alone.true_frames["gnss"].tolist() == drive.true_frames["gnss"].tolist()
    streams = drive.scene.sensor("imu").streams
    np.testing.assert_array_equal(streams["gyroscope"].timestamps_ns, streams["accelerometer"].timestamps_ns)


def test_no_frame_comes_in_a_drop_out(right):
    gap = (START_NS + 3 * SWEEP_NS, START_NS + 6 * SWEEP_NS)
    for sensor_id in ("lidar", "camera0"):
        drive = injected(right, sensor_id, drop_outs=(gap,))
        assert drive.true_frames[sensor_id].tolist() == [0, 1, 2, *range(6, 12)]
    times = injected(right, "imu", drop_outs=(gap,)).scene.sensor("imu").streams["gyroscope"].timestamps_ns
    assert not ((times >= gap[0]) & (times < gap[1])).any()
    assert np.diff(times).max() >= gap[1] - gap[0]


def test_a_blind_lidar_gives_sweeps_without_points_and_a_blind_camera_black_images(right):
    blind = SensorFaults(blind=((START_NS + SWEEP_NS, START_NS + 2 * SWEEP_NS),))
    drive = inject(right, Faults({"lidar": blind, "camera0": blind}))
    lidar, camera = drive.scene.lidars[0], drive.scene.cameras[0]
    assert [len(lidar.frames[k].points) > 0 for k in range(3)] == [True, False, True]
    assert lidar.frames[1].points.timestamps_ns.shape == lidar.frames[1].points.rings.shape == (0,)
    assert lidar.frames[1].reference_ns == START_NS + SWEEP_NS
    assert [bool(camera.images[k].rgb.any()) for k in range(3)] == [True, False, True]
    assert camera.images[1].rgb.shape == (120, 160, 3)
    assert len(drive.truth.clean_points_world(1).ranges) > 100


def test_a_stuck_sensor_repeats_itself_under_new_timestamps(right):
    interval = (START_NS + 2 * SWEEP_NS, START_NS + 5 * SWEEP_NS)
    drive = injected(right, "lidar", stuck=(interval,))
    assert drive.true_frames["lidar"].tolist() == [0, 1, 2, 2, 2, 5, 6, 7, 8, 9, 10, 11]
    first, last = drive.scene.lidars[0].frames[2], drive.scene.lidars[0].frames[4]
    np.testing.assert_array_equal(first.points.positions, last.points.positions)
    assert last.timestamp_ns - first.timestamp_ns == 2 * SWEEP_NS
    np.testing.assert_array_equal(last.points.timestamps_ns - first.points.timestamps_ns, 2 * SWEEP_NS)
    values = injected(right, "imu", stuck=(interval,)).scene.sensor("imu").streams["gyroscope"]
    inside = (values.timestamps_ns >= interval[0]) & (values.timestamps_ns < interval[1])
    assert len(np.unique(values.values[inside], axis=0)) == 1
    assert len(np.unique(values.values, axis=0)) == (~inside).sum() + 1


def test_swapped_sweeps_come_out_of_order_with_their_own_timestamps(right):
    drive = injected(right, "lidar", swapped=((4, 5), (8, 10)))
    order = [0, 1, 2, 3, 5, 4, 6, 7, 10, 9, 8, 11]
    frames = drive.scene.lidars[0].frames
    np.testing.assert_array_equal(frames.timestamps_ns, START_NS + SWEEP_NS * np.array(order))
    assert drive.true_frames["lidar"].tolist() == order
    np.testing.assert_array_equal(frames[8].points.positions, right.scene.lidars[0].frames[10].points.positions)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (sim.PointTimes.MISSING, lambda times, timestamp: None),
        (sim.PointTimes.ZERO, lambda times, timestamp: 0 * times),
        (sim.PointTimes.FRAME, lambda times, timestamp: 0 * times + timestamp),
        (sim.PointTimes.RELATIVE, lambda times, timestamp: times - timestamp),
        (sim.PointTimes.MICROSECONDS, lambda times, timestamp: times // 1000),
        (sim.PointTimes.RELATIVE_MICROSECONDS, lambda times, timestamp: (times - timestamp) // 1000),
        (sim.PointTimes.STRETCHED, lambda times, timestamp: timestamp + 1000 * (times - timestamp)),
    ],
)
def test_point_times_are_wrong_as_asked_for(right, kind, expected):
    given = injected(right, "lidar", point_times=kind).scene.lidars[0].frames[3]
    true = right.scene.lidars[0].frames[3]
    assert given.timestamp_ns == true.timestamp_ns
    np.testing.assert_array_equal(given.points.timestamps_ns, expected(true.points.timestamps_ns, true.timestamp_ns))


def test_intensities_are_scaled_within_a_byte_and_a_stated_camera_model_is_longer_for_the_same_image(right):
    drive = injected(right, "lidar", intensity_scale=3.3)
    given, true = (one.scene.lidars[0].frames[0].points.intensities for one in (drive, right))
    assert (true > 80).any()
    np.testing.assert_array_equal(given, [min(255, round(3.3 * int(value))) for value in true])
    camera, exact = injected(right, "camera0", focal_scale=1.02).scene.cameras[0], right.scene.cameras[0]
    assert (camera.camera.fx, camera.camera.fy) == pytest.approx((153.0, 153.0))
    assert camera.images[0].camera == camera.camera
    assert camera.mount is exact.mount
    np.testing.assert_array_equal(camera.images[0].rgb, exact.images[0].rgb)


def test_a_radar_and_a_second_lidar_can_be_wrong_as_well():
    small, blind = sim.LidarSpec(beams=4, steps=60), (START_NS + 2 * SWEEP_NS, START_NS + 3 * SWEEP_NS)
    right = sim.simulate_street(
        4, frames=4, lidars=(small, small), cameras=(), radars=(sim.RadarSpec(),), traffic=sim.TrafficSpec()
    )
    wrong = SensorFaults(rotation_deg=(0.0, 0.0, -3.0), lost_frames=(1,), time_offset_ns=11, blind=(blind,))
    drive = inject(right, Faults({"radar0": wrong, "lidar1": wrong}))
    for name in ("radar0", "lidar1"):
        stated, true, kept = drive.scene.sensor(name), right.scene.sensor(name), drive.true_frames[name]
        error = true.mount.inverse() @ stated.mount
        assert Rotation.from_matrix(error.rotation).as_rotvec(degrees=True) == pytest.approx([0, 0, -3.0])
        assert 1 not in kept
        for j, k in enumerate(kept):
            given, exact = stated.frames[j], true.frames[int(k)]
            assert given.timestamp_ns == exact.timestamp_ns + 11
            assert len(given.points) == (0 if blind[0] <= exact.timestamp_ns < blind[1] else len(exact.points))
    radar, exact = (one.scene.sensor("radar0").frames[0].points for one in (drive, right))
    np.testing.assert_array_equal(radar.lengths, exact.lengths)
    assert drive.scene.sensor("lidar0").frames is right.scene.sensor("lidar0").frames


def test_faults_can_be_given_with_the_drive_and_do_not_depend_on_the_order_of_reading(right):
    faults = Faults({"lidar": SensorFaults(lost_share=0.4, time_offset_ns=5, blind=((0, START_NS + SWEEP_NS),))})
    lidar = sim.LidarSpec(beams=8, steps=120, range_sigma=0.0, drop_rate=0.0)
    drive = sim.simulate_street(4, frames=12, lidar=lidar, cameras=(), faults=faults)
    same = inject(right, faults)
    assert drive.faults is faults
    frames, others = drive.scene.lidars[0].frames, same.scene.lidars[0].frames
    assert 0 < len(frames) < 12
    for k in reversed(range(len(frames))):
        np.testing.assert_array_equal(frames[k].points.positions, others[k].points.positions)
        np.testing.assert_array_equal(frames[k].points.timestamps_ns, others[k].points.timestamps_ns)


def test_faulty_sensors_go_to_another_process(right):
    faulty = SensorFaults(lost_frames=(1,), time_offset_ns=9, blind=((START_NS, START_NS + 1),))
    scene = inject(right, Faults({"lidar": faulty, "camera0": faulty})).scene
    lidar, camera = (pickle.loads(pickle.dumps(scene.sensor(name))) for name in ("lidar", "camera0"))
    times = right.scene.lidars[0].frames[2].points.timestamps_ns
    np.testing.assert_array_equal(lidar.frames[1].points.timestamps_ns, times + 9)
    np.testing.assert_array_equal(camera.images[0].rgb, scene.cameras[0].images[0].rgb)


@pytest.mark.parametrize(
    ("sensor_id", "wrong", "message"),
    [
        ("lidar7", {}, "no sensor 'lidar7'; it has 'lidar', 'camera0', 'imu', 'gnss'"),
        ("lidar", {"focal_scale": 1.1}, "focal_scale; a sensor of type lidar can have"),
        ("camera0", {"point_times": sim.PointTimes.ZERO}, "point_times; a sensor of type camera can have"),
        ("camera0", {"intensity_scale": 2.0}, "intensity_scale"),
        ("imu", {"shift": (0.0, 0.0, 1.0)}, "shift; a sensor of type imu can have"),
        ("gnss", {"blind": ((0, 1),)}, "blind"),
        ("lidar", {"lost_frames": (12,)}, "of sensor 'lidar': frame 12; expected 0 to 11"),
        ("lidar", {"swapped": ((-1, 3),)}, "frame -1"),
        ("lidar", {"lost_share": 1.5}, "lost_share: 1.5; expected 0.0 to 1.0"),
        ("lidar", {"rotation_deg": (0.0, float("nan"), 0.0)}, "rotation_deg"),
        ("lidar", {"blind": ((5, 5),)}, "blind"),
        ("lidar", {"swapped": ((1, 2), (2, 3))}, "swapped"),
        ("camera0", {"focal_scale": 0.0}, "focal_scale"),
        ("lidar", {"clock_skew_ppm": 1e6}, "clock_skew_ppm"),
    ],
)
def test_faults_that_cannot_be_are_refused(right, sensor_id, wrong, message):
    with pytest.raises(OptionError, match=message):
        injected(right, sensor_id, **wrong)
