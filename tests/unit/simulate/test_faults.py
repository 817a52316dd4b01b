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


LIDAR = sim.LidarSpec(beams=8, steps=120, range_sigma=0.0, drop_rate=0.0)


@pytest.fixture(scope="module")
def right():
    cameras, radars = (sim.CameraSpec(CAMERA_MODEL, sim.camera_mount()),), (sim.RadarSpec(period_ns=SWEEP_NS),)
    return sim.simulate_street(4, frames=12, lidar=LIDAR, cameras=cameras, radars=radars)


def injected(drive, sensor_id, *, seed=0, **wrong):
    return inject(drive, Faults({sensor_id: SensorFaults(**wrong)}, seed=seed))


def test_faults_given_with_the_drive_are_injected_once_and_in_any_order_of_reading(right):
    assert dict(right.faults.sensors) == {}
    assert inject(right, Faults()).scene.sensors == right.scene.sensors
    with pytest.raises(OptionError, match="faults already"):
        injected(injected(right, "lidar", lost_frames=(1,)), "camera0", lost_frames=(1,))
    faults = Faults({"lidar": SensorFaults(lost_share=0.4, time_offset_ns=5, blind=((0, START_NS + SWEEP_NS),))})
    drive, same = sim.simulate_street(4, frames=12, lidar=LIDAR, cameras=(), faults=faults), inject(right, faults)
    assert drive.faults is faults
    frames, others = drive.scene.lidars[0].frames, same.scene.lidars[0].frames
    assert 0 < len(frames) < 12
    for k in reversed(range(len(frames))):
        np.testing.assert_array_equal(frames[k].points.positions, others[k].points.positions)
        np.testing.assert_array_equal(frames[k].points.timestamps_ns, others[k].points.timestamps_ns)
    assert same.scene.cameras[0].images is right.scene.cameras[0].images


@pytest.mark.parametrize("sensor_id", ["lidar", "camera0", "radar0"])
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


def test_points_miss_their_pixels_by_what_a_rotated_camera_explains_and_a_rotated_imu_measures_gravity_askew(right):
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
    # a rotated inertial unit measures gravity askew
    drive = injected(right, "imu", rotation_deg=(10.0, 0.0, 0.0))
    stated, true = (d.scene.sensor("imu").streams["accelerometer"].values for d in (drive, right))
    # The frame is stated as rotated by 10 degrees about x against where the unit is: it hangs 10 degrees the other way.
    np.testing.assert_allclose(stated, Rotation.from_euler("x", 10, degrees=True).apply(true.copy()), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(stated, axis=1), np.linalg.norm(true, axis=1))


def test_timestamps_and_point_times_are_late_by_the_offset_and_drift_by_the_skew(right):
    for sensor_id in ["lidar", "camera0", "radar0", "gnss", "imu"]:
        drive = injected(right, sensor_id, time_offset_ns=30_000_000, clock_skew_ppm=200.0)
        given, true = (times_of(d.scene.sensor(sensor_id)) for d in (drive, right))
        assert len(given) == len(true)
        expected = true + 30_000_000 + (true - true[0]) * 200e-6
        np.testing.assert_allclose(given - expected, 0.0, atol=0.51)  # whole nanoseconds
    # point times follow the clock of their sensor
    drive = injected(right, "lidar", time_offset_ns=-7_000, clock_skew_ppm=-1000.0)
    given, true = drive.scene.lidars[0].frames[9], right.scene.lidars[0].frames[9]
    expected = true.points.timestamps_ns - 7_000 - (true.points.timestamps_ns - START_NS) * 1e-3
    np.testing.assert_allclose(given.points.timestamps_ns - expected, 0.0, atol=0.51)
    assert given.timestamp_ns == drive.scene.lidars[0].frames.timestamps_ns[9]
    np.testing.assert_array_equal(given.points.positions, true.points.positions)
    # an offset of a sweep pairs each sweep with the image after
    for offset_ns, nearest in [(0, [4, 5, 6]), (SWEEP_NS, [5, 6, 7])]:
        scene = injected(right, "lidar", time_offset_ns=offset_ns).scene
        times, frames = scene.cameras[0].images.timestamps_ns, scene.lidars[0].frames
        assert [np.abs(times - frames[k].reference_ns).argmin() for k in (4, 5, 6)] == nearest


def times_of(sensor):
    if hasattr(sensor, "streams"):
        return sensor.streams["gyroscope"].timestamps_ns
    frames = getattr(sensor, "frames", getattr(sensor, "images", sensor))
    return frames.timestamps_ns


def test_frames_are_lost_in_drop_outs_stuck_and_swapped_as_listed_or_at_random_by_seed_and_sensor(right):
    drive = injected(right, "lidar", lost_frames=(2, 3, 11))
    kept = [0, 1, 4, 5, 6, 7, 8, 9, 10]
    assert drive.true_frames["lidar"].tolist() == kept
    assert len(drive.scene.lidars[0].frames) == 9
    for j, k in enumerate(kept):
        given, true = drive.scene.lidars[0].frames[j], right.scene.lidars[0].frames[k]
        assert given.timestamp_ns == true.timestamp_ns
        np.testing.assert_array_equal(given.points.positions, true.points.positions)
    assert len(drive.scene.cameras[0].images) == 12
    # no frame comes in a drop-out
    gap = (START_NS + 3 * SWEEP_NS, START_NS + 6 * SWEEP_NS)
    for sensor_id in ("lidar", "camera0"):
        drive = injected(right, sensor_id, drop_outs=(gap,))
        assert drive.true_frames[sensor_id].tolist() == [0, 1, 2, *range(6, 12)]
    times = injected(right, "imu", drop_outs=(gap,)).scene.sensor("imu").streams["gyroscope"].timestamps_ns
    assert not ((times >= gap[0]) & (times < gap[1])).any()
    assert np.diff(times).max() >= gap[1] - gap[0]
    # a stuck sensor repeats itself under new timestamps
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
    # swapped sweeps come out of order with their own timestamps
    drive = injected(right, "lidar", swapped=((4, 5), (8, 10)))
    order = [0, 1, 2, 3, 5, 4, 6, 7, 10, 9, 8, 11]
    frames = drive.scene.lidars[0].frames
    np.testing.assert_array_equal(frames.timestamps_ns, START_NS + SWEEP_NS * np.array(order))
    assert drive.true_frames["lidar"].tolist() == order
    np.testing.assert_array_equal(frames[8].points.positions, right.scene.lidars[0].frames[10].points.positions)
    # a share is lost at random
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


def test_blind_sensors_give_nothing_and_intensities_and_focal_lengths_are_scaled(right):
    blind = SensorFaults(blind=((START_NS + SWEEP_NS, START_NS + 2 * SWEEP_NS),))
    drive = inject(right, Faults({"lidar": blind, "camera0": blind, "radar0": blind}))
    lidar, camera, radar = drive.scene.lidars[0], drive.scene.cameras[0], drive.scene.sensor("radar0")
    for sensor in (lidar, radar):
        assert [len(sensor.frames[k].points) > 0 for k in range(3)] == [True, False, True]
    exact = right.scene.sensor("radar0").frames[0].points
    np.testing.assert_array_equal(radar.frames[0].points.lengths, exact.lengths)
    assert lidar.frames[1].points.timestamps_ns.shape == lidar.frames[1].points.rings.shape == (0,)
    assert lidar.frames[1].reference_ns == START_NS + SWEEP_NS
    assert [bool(camera.images[k].rgb.any()) for k in range(3)] == [True, False, True]
    assert camera.images[1].rgb.shape == (120, 160, 3)
    assert len(drive.truth.clean_points_world(1).ranges) > 100
    drive = injected(right, "lidar", intensity_scale=3.3)
    given, true = (one.scene.lidars[0].frames[0].points.intensities for one in (drive, right))
    assert (true > 80).any()
    np.testing.assert_array_equal(given, [min(255, round(3.3 * int(value))) for value in true])
    camera, exact = injected(right, "camera0", focal_scale=1.02).scene.cameras[0], right.scene.cameras[0]
    assert (camera.camera.fx, camera.camera.fy) == pytest.approx((153.0, 153.0))
    assert camera.images[0].camera == camera.camera
    assert camera.mount is exact.mount
    np.testing.assert_array_equal(camera.images[0].rgb, exact.images[0].rgb)


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


@pytest.mark.parametrize(
    ("sensor_id", "wrong", "message"),
    [
        ("lidar7", {}, "no sensor 'lidar7'; it has 'lidar', 'camera0', 'radar0', 'imu', 'gnss'"),
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
