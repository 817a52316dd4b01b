"""Whole drives: sensors and clocks, truth, injected faults, files, and the numbers that a seed has always given."""

import math
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.unit.simulate.scenery import STILL, in_box_axes

import sceneloom
from sceneloom import simulate as sim
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project
from sceneloom.errors import OptionError
from sceneloom.geometry.geodesy import enu_from_geodetic
from sceneloom.motion.deskew import points_to_world
from sceneloom.scene import CameraSensor, GnssSensor, ImuSensor, LidarSensor, PointsFrame, RadarSensor, SensorType
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import Faults, SensorFaults, inject, simulate_street
from sceneloom.simulate.drive import gnss_sensor, imu_sensor, imu_truth

SMALL = sim.LidarSpec(beams=8, steps=200)
TINY = Camera("pinhole", 40, 30, 30.0, 30.0, 19.5, 14.5)


def test_a_drive_has_the_sensors_of_a_recording_and_poses_imu_and_gnss_reach_beyond_sweeps_and_images(drive, rich):
    scene = drive.scene
    assert scene.format == "simulated"
    assert [(sensor.id, type(sensor)) for sensor in scene.sensors] == [
        ("lidar", LidarSensor), ("camera0", CameraSensor), ("imu", ImuSensor), ("gnss", GnssSensor)
    ]  # fmt: skip
    (lidar,), (camera,) = scene.lidars, scene.cameras
    assert lidar.points_frame is PointsFrame.SENSOR
    assert list(scene.trajectories) == ["groundTruth"]
    assert scene.sensor("imu").type is SensorType.IMU
    assert set(scene.sensor("imu").streams) == {"accelerometer", "gyroscope"}
    np.testing.assert_array_equal(lidar.frames.timestamps_ns, 1_000_000_000 + 100_000_000 * np.arange(8))
    np.testing.assert_array_equal(camera.images.timestamps_ns - lidar.frames.timestamps_ns, 50_000_000)
    assert [frame.timestamp_ns for frame in lidar.frames] == lidar.frames.timestamps_ns.tolist()
    assert camera.fps == 10.0
    # The image is taken when the sensor looks ahead: within 11 degrees of it for 6 ms of its rotation.
    points, image_ns = lidar.frames[2].points, camera.images[2].timestamp_ns
    assert image_ns == camera.images.timestamps_ns[2]
    ahead = points.positions[:, 0] > 5 * np.abs(points.positions[:, 1])
    assert np.abs(points.timestamps_ns[ahead] - image_ns).max() < 4_000_000
    # The IMU keeps a clock of its own.
    imu_ns = scene.sensor("imu").streams["gyroscope"].timestamps_ns
    assert not np.isin(imu_ns, camera.images.timestamps_ns).any()
    for scene in (drive.scene, rich.scene):
        first = scene.lidars[0].frames[0].timestamp_ns
        last = max(int(lidar.frames[-1].points.timestamps_ns[-1]) for lidar in scene.lidars)
        streams = scene.trajectories["groundTruth"], scene.sensor("gnss"), *scene.sensor("imu").streams.values()
        for times in (stream.timestamps_ns for stream in streams):
            assert times[0] < first < last < times[-1]
            assert (np.diff(times) > 0).all()


def test_annotations_are_the_boxes_of_things_and_cars_point_along_the_street(drive):
    boxes = {annotation.id: annotation for annotation in drive.scene.annotations}
    things = [thing for thing in drive.truth.objects if thing.label in {"car", "bin", "tree", "pole"}]
    assert list(boxes) == [f"{thing.label}-{thing.instance}" for thing in things]
    assert all(annotation.stationary for annotation in boxes.values())
    found = np.array([annotation.path.values[0] for annotation in boxes.values()])
    expected = [[*thing.size_lwh, *thing.center_world, 0, 0, np.degrees(thing.yaw)] for thing in things]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    ours = drive.scene.metadata["sceneloom"]
    assert (ours["euler_unit"], ours["euler_order"]) == ("degrees", "xyz")
    yaws = [thing.yaw for thing in things if thing.label == "car"]
    headings = drive.truth.path.at_seconds(np.linspace(-10, 10, 50))
    yaw = np.arctan2(headings.rotations[:, 1, 0], headings.rotations[:, 0, 0])
    nearest = [np.abs((np.subtract.outer(yaw, angle) + np.pi / 2) % np.pi - np.pi / 2).min() for angle in yaws]
    # Parked along the road, to either side, within 0.03 rad.
    assert np.max(nearest) < 0.05


def in_image(drive, k):
    """The clean points of a sweep that fall into an image, away from edges: points, rows, columns, z and visibility."""
    truth = drive.truth
    clean = truth.clean_points_world(k)
    in_camera = truth.world_from_camera("camera0", k).inverse().apply(clean.positions_world)
    pixels, inside = project(drive.scene.cameras[0].camera, in_camera)
    column, row = np.rint(np.nan_to_num(pixels)).astype(int).T
    inside &= ~truth.edges("camera0", k)[row * inside, column * inside]
    kept = np.flatnonzero(inside)
    visible = truth.visible("camera0", k, clean.positions_world)[kept]
    return clean, kept, row[kept], column[kept], in_camera[kept, 2], visible


def test_visible_points_fall_on_pixels_of_their_own_depth_and_object_and_near_ones_have_its_colour(exact_drive):
    for k in (0, 6):
        clean, kept, row, column, z, visible = in_image(exact_drive, k)
        image = exact_drive.truth.image("camera0", k)
        depth = image.depths[row, column].astype(np.float64)
        assert visible.sum() > 1500
        # Half a pixel beside the point a slanting surface is nearer or farther: 3 % where it is met at 2 degrees.
        assert (np.abs(depth - z)[visible] < 0.03 * z[visible]).mean() > 0.999
        assert (image.instances[row, column] == clean.instances[kept])[visible].all()
        assert (~visible).sum() > 5
        assert (depth[~visible] < z[~visible]).all()
    # near points have the colour that the image shows
    clean, kept, row, column, _, visible = in_image(exact_drive, 3)
    near = visible & (clean.ranges[kept] < 15)
    shown = exact_drive.scene.cameras[0].images[3].rgb[row, column].astype(int)
    difference = np.abs(shown - clean.colors[kept]).max(axis=1)[near]
    # The nearest pixel is up to half a pixel beside the point: 1 cm at 15 m, on patterns with edges 2 cm soft.
    assert len(difference) > 500
    assert np.median(difference) <= 2
    assert np.percentile(difference, 90) <= 20


def test_several_sensors_have_ids_in_their_order_a_single_one_no_number_and_a_drive_can_be_a_single_sweep(rich):
    offsets = (0, 20_000_000, 80_000_000)
    cameras = [
        sim.CameraSpec(TINY, sim.camera_mount(yaw_deg=yaw), offset_ns=offset)
        for yaw, offset in zip((0.0, 120.0, -120.0), offsets, strict=True)
    ]
    found = simulate_street(1, frames=2, lidar=SMALL, cameras=cameras).scene.cameras
    assert [camera.id for camera in found] == ["camera0", "camera1", "camera2"]
    assert tuple(camera.images.timestamps_ns[0] - 1_000_000_000 for camera in found) == offsets
    assert not np.array_equal(found[0].images[1].rgb, found[1].images[1].rgb)
    scene = simulate_street(1, frames=1, lidar=SMALL, cameras=(), start_ns=-5_000_000_000).scene
    assert scene.cameras == ()
    frame = scene.lidars[0].frames[0]
    assert len(frame.points) > 500
    assert frame.timestamp_ns == -5_000_000_000
    assert frame.points.timestamps_ns.max() < -4_900_000_000
    ids = [sensor.id for sensor in rich.scene.sensors]
    assert ids == ["lidar0", "lidar1", "lidar2", "camera0", "radar0", "radar1", "imu", "gnss"]
    assert (list(rich.truth.lidars), list(rich.truth.radars)) == (ids[:3], ids[4:6])
    assert rich.truth.lidar is rich.truth.lidars["lidar0"]
    assert isinstance(rich.scene.sensor("radar1"), RadarSensor)
    with pytest.raises(OptionError, match="'camera7'; expected one of 'camera0'"):
        rich.truth.depth("camera7", 0)
    with pytest.raises(OptionError, match="'lidar'; expected one of 'lidar0', 'lidar1', 'lidar2'"):
        rich.truth.sweep(0, "lidar")
    one, listed = (
        simulate_street(4, frames=2, cameras=(), **given) for given in ({"lidar": RASTER}, {"lidars": (RASTER,)})
    )
    assert [lidar.id for lidar in (*one.scene.lidars, *listed.scene.lidars)] == ["lidar", "lidar"]
    a, b = (drive.scene.lidars[0].frames[1] for drive in (one, listed))
    assert a.timestamp_ns == 1_000_000_000 + 7_000_000 + 50_000_000
    np.testing.assert_array_equal(a.points.positions, b.points.positions)


def test_lidars_of_the_same_kind_have_noise_of_their_own_and_the_demo_drive_two_camera_models():
    drive = simulate_street(4, frames=1, lidars=(SMALL, SMALL), cameras=())
    sweeps = [drive.truth.sweep(0, lidar_id) for lidar_id in ("lidar0", "lidar1")]
    errors = [np.linalg.norm(sweep.frame.points.positions, axis=1) - sweep.ranges for sweep in sweeps]
    common = min(map(len, errors))
    # A thousand independent pairs correlate by 0.03 at random; five times that.
    assert common > 700
    assert abs(np.corrcoef(errors[0][:common], errors[1][:common])[0, 1]) < 0.18
    np.testing.assert_allclose(*(sweep.points_world.mean(axis=0) for sweep in sweeps), atol=0.5)
    drive = sim.demo_drive(0, frames=2)
    cameras = [camera.camera for camera in drive.scene.cameras]
    assert [camera.model for camera in cameras] == ["brown_conrady", "fisheye"]
    assert not any(camera.width % 2 or camera.height % 2 for camera in cameras)
    image = drive.scene.cameras[1].images[0].rgb
    assert image.shape == (400, 640, 3)
    assert not np.array_equal(image, drive.truth.colors("camera1", 0))


def test_arguments_out_of_bounds_are_refused():
    for wrong, message in [
        ({"frames": 0}, "0 frames"),
        ({"trajectory_hz": 1.0}, "poses a second"),
        ({"cameras": (sim.CameraSpec(TINY, offset_ns=10**9),)}, "expected -100000000 to 200000000"),
        ({"seed": -1}, "seed"),
        ({"lidars": (SMALL,)}, "both are given"),
        ({"lidar": None, "lidars": ()}, "lidars: none"),
        ({"lidar": None, "lidars": (SMALL, sim.SolidStateSpec(period_ns=10**9 + 1))}, "lidar1.period_ns"),
    ]:
        with pytest.raises(OptionError, match=message):
            simulate_street(**{"lidar": SMALL, "cameras": (), **wrong})


def test_the_parts_of_the_truth_agree_and_points_behind_a_wall_are_not_visible(drive):
    image = drive.truth.image("camera0", 1)
    np.testing.assert_array_equal(drive.truth.depth("camera0", 1), image.depths)
    np.testing.assert_array_equal(drive.truth.instances("camera0", 1), image.instances)
    assert ((image.depths > 0) == (image.instances >= 0)).all()
    poses = drive.truth.world_from_ego(np.array([1_000_000_000, 1_500_000_000], np.int64))
    exact = drive.truth.path.at(poses.timestamps_ns)
    np.testing.assert_array_equal(poses.positions, exact.positions)
    np.testing.assert_array_equal(poses.quaternions_xyzw, exact.quaternions_xyzw)
    # points behind a wall are not visible and those before it are
    truth = drive.truth
    camera = truth.world_from_camera("camera0", 0)
    house = next(thing for thing in truth.objects if thing.label == "building" and thing.center_world[0] > 15)
    middle = np.array(house.center_world)
    beyond = camera.translation + 2.0 * (middle - camera.translation)
    ahead = camera.apply(np.array([[0.0, 0.5, 3.0], [0.0, 0.0, 2.0]]))
    assert truth.visible("camera0", 0, [middle, beyond, *ahead]).tolist() == [False, False, True, True]
    assert truth.visible("camera0", 0, np.zeros((0, 3))).shape == (0,)


RASTER = sim.SolidStateSpec(
    sim.Raster(rows=20, columns=30, channels=3), period_ns=50_000_000, offset_ns=7_000_000, range_sigma=0.0,
    mount=sim.sensor_mount(position=(1.0, -0.6, 1.2), yaw_deg=-40.0, pitch_deg=3.0),
)  # fmt: skip
BUSY = sim.TrafficSpec(cars=4.0, cyclists=2.0, pedestrians=8.0)
ROSETTE = sim.SolidStateSpec(sim.Rosette(shots_per_second=20_000.0), period_ns=300_000_000, offset_ns=40_000_000)
RADAR = sim.RadarSpec(period_ns=70_000_000, offset_ns=10_000_000)
LIDARS = (SMALL, RASTER, ROSETTE)


@pytest.fixture(scope="module")
def rich():
    return simulate_street(4, frames=5, lidars=LIDARS, cameras=(sim.CameraSpec(TINY),), radars=(RADAR, sim.RadarSpec()))


def test_each_sensor_measures_on_its_own_clock_where_trajectory_and_mounting_say(rich):
    start, stop = 1_000_000_000, 1_500_000_000
    expected = {
        "lidar0": range(start, stop, 100_000_000),
        "lidar1": range(start + 7_000_000, stop, 50_000_000),
        "lidar2": range(start + 40_000_000, stop, 300_000_000),
        "radar0": range(start + 10_000_000, stop, 70_000_000),
        "radar1": range(start, stop, 50_000_000),
    }
    for name, times in expected.items():
        frames = rich.scene.sensor(name).frames
        assert frames.timestamps_ns.tolist() == [frame.timestamp_ns for frame in frames] == list(times)
    for lidar in rich.scene.lidars:
        for frame in lidar.frames:
            since = frame.points.timestamps_ns - frame.timestamp_ns
            assert 0 <= since.min() < since.max() < rich.truth.lidars[lidar.id].spec.period_ns
            assert (np.diff(since) >= 0).all()
    for name in ("lidar0", "lidar1", "lidar2", "camera0", "radar0"):
        poses, mount = rich.scene.sensor(name).poses, rich.scene.sensor(name).mount
        exact = rich.truth.path.at(poses.timestamps_ns)
        np.testing.assert_allclose(poses.positions, exact.positions + exact.rotations @ mount.translation, atol=1e-9)
        rotated = Rotation.from_quat(poses.quaternions_xyzw).as_matrix()
        np.testing.assert_allclose(rotated, exact.rotations @ mount.rotation, atol=1e-9)
    clouds = [rich.truth.clean_points_world(0, name) for name in ("lidar0", "lidar1")]
    things = [t for t in rich.truth.objects if all((t.instance == cloud.instances).any() for cloud in clouds)]
    assert len(things) > 3
    for thing, cloud in ((thing, cloud) for thing in things for cloud in clouds):
        away = in_box_axes(cloud.positions_world[cloud.instances == thing.instance], thing.center_world, thing.yaw)
        assert (np.abs(away) <= np.array(thing.size_lwh) / 2 + 1e-6).all()


def test_further_sensors_change_nothing_of_the_others_the_street_and_the_traffic(rich):
    plain = simulate_street(4, frames=5, lidar=SMALL, cameras=(sim.CameraSpec(TINY),), imu=sim.ImuSpec(rate_hz=100))
    for of in (
        lambda drive: drive.truth.sweep(0).frame.points.positions,
        lambda drive: drive.truth.sweep(4).frame.points.positions,
        lambda drive: drive.scene.cameras[0].images[2].rgb,
        lambda drive: drive.truth.street.shapes.maps,
    ):
        np.testing.assert_array_equal(of(rich), of(plain))
    slow = sim.SolidStateSpec(sim.Raster(rows=2, columns=4), period_ns=10**9, offset_ns=10**8 - 1)
    alone, more = (
        simulate_street(4, frames=1, lidars=lidars, radars=radars, cameras=(), traffic=sim.TrafficSpec())
        for lidars, radars in (((SMALL,), ()), ((SMALL, slow), (sim.RadarSpec(period_ns=10**10),)))
    )
    # The last shot of the slow one is 1.1 s after the start of the drive's only sweep of 0.1 s.
    ours, theirs = (d.truth.boxes(10**9 + np.arange(0, 1_100_000_000, 50_000_000)) for d in (alone, more))
    assert ours.present[:, len(alone.truth.objects) :].any()
    np.testing.assert_array_equal(ours.centers_world, theirs.centers_world)
    np.testing.assert_array_equal(ours.present, theirs.present)


@pytest.mark.parametrize("lidar_id", ["lidar1", "lidar2"])
def test_deskewing_a_solid_state_lidar_by_the_trajectory_gives_the_clean_points(rich, lidar_id):
    lidar = rich.scene.sensor(lidar_id)
    frame, clean = lidar.frames[1], rich.truth.clean_points_world(1, lidar_id)
    source = PoseSource(rich.scene.trajectories["groundTruth"].poses, lidar.mount)
    world, extrapolated = points_to_world(frame, source)
    assert not extrapolated
    error = np.linalg.norm(world - clean.positions_world, axis=1)
    sigma = rich.truth.lidars[lidar_id].spec.range_sigma
    # The trajectory is sampled at 100 Hz: 0.1 mm and 1e-5 rad, 1.5 mm at 150 m; then range noise.
    assert np.median(error) < 2e-4 + sigma
    assert np.percentile(error, 99) < 1.5e-3 + 3.0 * sigma
    assert len(error) > 1000


def arrays_of(drive, order):
    """What sensors of a drive measure in its first frames, asked for in an order, and what it goes through."""
    scene, found = drive.scene, {("street", 0, "maps"): drive.truth.street.shapes.maps}
    for sensor, k in ((sensor, k) for k in order for sensor in scene.sensors):
        if isinstance(sensor, CameraSensor):
            found[sensor.id, k, "rgb"] = sensor.images[k].rgb
        elif isinstance(sensor, ImuSensor):
            found |= {(sensor.id, 0, name): stream.values for name, stream in sensor.streams.items()}
        elif isinstance(sensor, GnssSensor):
            found[sensor.id, 0, "fixes"] = sensor.positions_lla
        else:
            points = sensor.frames[k].points
            fields = {name: getattr(points, name, None) for name in ("positions", "lengths", "timestamps_ns", "rings")}
            found |= {(sensor.id, k, name): array for name, array in fields.items() if array is not None}
    return found


def test_frames_are_the_same_in_whatever_order_and_process_they_are_asked_for_and_others_by_seed():
    cameras = sim.CameraSpec(TINY, readout_ns=20_000_000, exposure=sim.ExposureSpec()), sim.CameraSpec(TINY)
    options = {"frames": 10, "lidars": LIDARS, "cameras": cameras, "radars": (RADAR, RADAR), "traffic": BUSY}
    here, again, other = (simulate_street(seed, **options) for seed in (4, 4, 5))
    there = pickle.loads(pickle.dumps(here))
    first, by_other_seed = (arrays_of(drive, (0, 1, 2)) for drive in (here, other))
    for found in (arrays_of(here, (2, 0, 1)), arrays_of(again, (1, 2, 0)), arrays_of(there, (2, 1, 0))):
        assert found.keys() == first.keys()
        for key, array in found.items():
            np.testing.assert_array_equal(array, first[key])
    for (sensor, k, name), array in first.items():
        if name not in ("timestamps_ns", "rings"):
            assert not np.array_equal(array, by_other_seed[sensor, k, name])
            assert k == 0 or not np.array_equal(array, first[sensor, 0, name])
        assert name not in ("positions", "lengths", "timestamps_ns", "rings") or not array.flags.writeable
    assert not np.array_equal(first["radar0", 1, "lengths"], first["radar1", 1, "lengths"])


def test_files_keep_lidars_on_their_own_clocks_and_a_scene_file_radars_too(rich, tmp_path):
    sceneloom.write(rich.scene, tmp_path / "rich.sfs")
    with sceneloom.open(tmp_path / "rich.sfs") as again:
        ours, theirs = (scene.sensor("radar0").frames[3].points for scene in (rich.scene, again))
        np.testing.assert_array_equal(ours.lengths, theirs.lengths)
        np.testing.assert_array_equal(ours.directions, theirs.directions)
        assert again.sensor("lidar2").frames[0].points.rings is None
    report = sceneloom.write(rich.scene, tmp_path / "rich")
    assert {"sensors[radar0]", "sensors[radar1]"} <= {loss.field for loss in report.losses}
    for name in ("rich.sfs", "rich"):
        with sceneloom.open(tmp_path / name) as again:
            assert [lidar.id for lidar in again.lidars] == ["lidar0", "lidar1", "lidar2"]
            for ours, theirs in zip(rich.scene.lidars, again.lidars, strict=True):
                np.testing.assert_array_equal(theirs.frames.timestamps_ns, ours.frames.timestamps_ns)
                np.testing.assert_array_equal(theirs.frames[1].points.positions, ours.frames[1].points.positions)


GRAVITY = np.array([0.0, 0.0, -9.80665])


@pytest.fixture(scope="module")
def path():
    return sim.PathSpec().plan(np.random.default_rng(8), start_ns=0, duration=10.0)


def timestamps(seconds, rate_hz):
    return np.rint(np.arange(0.0, seconds, 1 / rate_hz) * 1e9).astype(np.int64)


def integrate(start, rotation, times_ns, forces, rates):
    """Plain strap-down integration: the rotation by the mean rate of each step, the force by the trapezium rule."""
    position, velocity = start.positions[0].copy(), start.velocities[0].copy()
    for k, dt in enumerate(np.diff(times_ns) * 1e-9):
        rotated = rotation * Rotation.from_rotvec(0.5 * (rates[k] + rates[k + 1]) * dt)
        before = rotation.apply(forces[k]) + GRAVITY
        after = rotated.apply(forces[k + 1]) + GRAVITY
        position += velocity * dt + (2 * before + after) * dt**2 / 6
        velocity += 0.5 * (before + after) * dt
        rotation = rotated
    return position, velocity, rotation


@pytest.mark.parametrize(
    # The trapezium rule at 1 kHz is off by dt²/12 times jerk or angular jerk: 1e-6 m/s and 1e-7 rad over 5 s. White
    # noise of density n gives n √(T³/3) of position and n √T of angle, in 3 s 3 mm and 0.2 mrad; the tilt adds g T²/2
    # times its size: 8 mm. Five times that.
    ("seconds", "rate_hz", "measured", "metres", "radians"),
    [(5.0, 1000, False, 1e-4, 1e-5), (3.0, 200, True, 0.05, 1e-3)],
)
def test_the_signals_without_their_bias_integrate_to_the_path(path, seconds, rate_hz, measured, metres, radians):
    times, spec = timestamps(seconds, rate_hz), sim.ImuSpec()
    truth = imu_truth(spec, path, times, seed=0)
    forces, rates = truth.specific_forces, truth.angular_rates
    if measured:
        streams = imu_sensor(spec, truth, seed=0).streams
        forces = streams["accelerometer"].values - truth.accelerometer_bias
        rates = streams["gyroscope"].values - truth.gyroscope_bias
    first, last = path.at(times[:1]), path.at(times[-1:])
    position, velocity, rotation = integrate(first, Rotation.from_matrix(first.rotations[0]), times, forces, rates)
    np.testing.assert_allclose(position, last.positions[0], atol=metres)
    np.testing.assert_allclose(velocity, last.velocities[0], atol=metres)
    assert (rotation.inv() * Rotation.from_matrix(last.rotations[0])).magnitude() < radians


def test_the_noise_has_the_density_and_the_bias_asked_for_by_seed_and_axis(path):
    times = timestamps(10.0, 400)
    spec = sim.ImuSpec(rate_hz=400, accelerometer_noise=0.01, gyroscope_noise=0.002)
    truth = imu_truth(spec, path, times, seed=4)
    streams = imu_sensor(spec, truth, seed=4).streams
    for name, clean, density, bias in (
        ("accelerometer", truth.specific_forces, 0.01, truth.accelerometer_bias),
        ("gyroscope", truth.angular_rates, 0.002, truth.gyroscope_bias),
    ):
        error = streams[name].values - clean
        # 4000 samples know a deviation to 1.1 % and a mean to 1.6 % of it; five times that.
        assert error.std(axis=0) == pytest.approx(density * np.sqrt(400), rel=0.06)
        np.testing.assert_allclose(error.mean(axis=0), bias, atol=0.08 * density * np.sqrt(400))
        np.testing.assert_array_equal(streams[name].timestamps_ns, times)
    # biases differ between seeds and axes and are not drawn from the numbers of the noise
    times, spec = timestamps(0.1, 100), sim.ImuSpec(rate_hz=100, accelerometer_noise=0.1, accelerometer_bias_sigma=1.0)
    truths = [imu_truth(spec, path, times, seed=seed) for seed in range(3)]
    assert len(np.unique([truth.accelerometer_bias for truth in truths])) == 9
    noise = imu_sensor(spec, truths[0], seed=0).streams["accelerometer"].values[0] - truths[0].specific_forces[0]
    bias = truths[0].accelerometer_bias
    assert not np.allclose(noise - bias, bias, rtol=0.01)
    # one that all but stands feels gravity upwards
    truth = imu_truth(sim.ImuSpec(), STILL, timestamps(1.0, 100), seed=0)
    np.testing.assert_allclose(truth.specific_forces, np.tile(-GRAVITY, (100, 1)), atol=1e-6)
    np.testing.assert_allclose(truth.angular_rates, 0.0, atol=1e-6)


def test_gnss_fixes_scatter_as_much_as_stated_north_in_latitude_and_east_in_longitude(path):
    spec, times = sim.GnssSpec(rate_hz=200, horizontal_sigma=0.5, vertical_sigma=2.0), timestamps(10.0, 200)
    fixes = gnss_sensor(spec, path, times, seed=1)
    error = enu_from_geodetic(fixes.positions_lla, np.array(spec.origin_lla)) - path.at(times).positions
    # 2000 fixes know a deviation to 1.6 %; five times that.
    assert error.std(axis=0) == pytest.approx([0.5, 0.5, 2.0], rel=0.08)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.25)
    assert set(fixes.accuracies) == {0.5}
    assert set(fixes.vertical_accuracies) == {2.0}
    spec = sim.GnssSpec(horizontal_sigma=0.0, vertical_sigma=0.0, origin_lla=(60.0, 25.0, 100.0))
    fix = gnss_sensor(spec, STILL, timestamps(0.1, 10), seed=0).positions_lla[0]
    np.testing.assert_allclose(fix, [60.0, 25.0, 100.0], atol=1e-6)
    exact = gnss_sensor(spec, path, timestamps(5.0, 10), seed=0).positions_lla
    east, north = path.at(timestamps(5.0, 10)).positions[:, :2].T
    # A degree of latitude is 111.41 km at 60 degrees north, one of longitude 55.80 km (Bomford, Geodesy).
    np.testing.assert_allclose((exact[:, 0] - 60.0) * 111_412, north, atol=0.01)
    np.testing.assert_allclose((exact[:, 1] - 25.0) * 55_800, east, atol=0.01)


def test_slow_errors_of_fixes_fade_by_their_time_constant_and_are_stated_with_the_noise(path):
    spec = sim.GnssSpec(horizontal_sigma=0.3, vertical_sigma=0.6, correlated_sigma=2.0, correlation_time=0.02)
    times, true = timestamps(10.0, 200), path.at(timestamps(10.0, 200)).positions
    fixes = [gnss_sensor(spec, path, times, seed=seed) for seed in range(10)]
    error = np.stack([enu_from_geodetic(one.positions_lla, np.array(spec.origin_lla)) - true for one in fixes])
    # 100 s are 2,500 independent draws, which know a variance to 3 %; five times that
    assert (error**2).mean(axis=(0, 1)) == pytest.approx([4.09, 4.09, 4.0 * 4.09], rel=0.15)
    for lag in (1, 4):
        alike = (error[:, lag:] * error[:, :-lag]).mean(axis=(0, 1))
        assert alike == pytest.approx(np.array([4.0, 4.0, 16.0]) * np.exp(-lag * 0.005 / 0.02), rel=0.2)
    assert (fixes[0].accuracies[0], fixes[0].vertical_accuracies[0]) == pytest.approx((4.09**0.5, 2.0 * 4.09**0.5))


NAN, PERIOD_NS = float("nan"), 100_000_000
REFUSED = {
    sim.ImuSpec: (
        *({"rate_hz": rate} for rate in (0.0, -5.0, NAN, 1e6)), {"gyroscope_noise": -1.0}, {"gyroscope_noise": NAN},
    ),
    sim.GnssSpec: (
        *({"rate_hz": rate} for rate in (0.0, -5.0, NAN, 1e6)), {"vertical_sigma": -1.0}, {"vertical_sigma": NAN},
        {"origin_lla": (500.0, 0.0, 0.0)}, {"correlated_sigma": -1.0}, {"correlation_time": 0.0},
    ),
    sim.ExposureSpec: (
        {"drift_stops": -1.0}, {"drift_period": 0.0}, {"recovery": 0.0}, {"vignetting": 1.5}, {"exposure_ns": -1},
        {"steps": ((1.0, 20.0),)}, {"steps": ((NAN, 1.0),)},
    ),
    sim.CameraSpec: ({"supersampling": 0}, {"readout_ns": -1}, {"readout_ns": 200_000_000}),
    sim.LidarSpec: (
        {"beams": 0}, {"beams": 70000}, {"steps": 0}, {"period_ns": 0}, {"drop_rate": 1.5}, {"range_sigma": NAN},
        {"min_range": 50.0, "max_range": 10.0}, {"elevations_deg": (2.0, -24.8)}, {"elevations_deg": (NAN, 2.0)},
        {"start_azimuth_deg": NAN}, {"beams": 5, "elevations_deg": (-3.0, -2.0, -1.0)},
        {"beams": 3, "elevations_deg": (-3.0, -1.0, -2.0)},
    ),
    sim.Raster: ({"rows": 0}, {"interleave": 0}, {"azimuth_deg": (10.0, -10.0)}, {"elevation_deg": (0.0, 91.0)}),
    sim.Rosette: ({"fov_deg": 0.0}, {"shots_per_second": NAN}, {"share": 1.5}),
    sim.SolidStateSpec: ({"offset_ns": PERIOD_NS}, {"drop_rate": -0.1}, {"min_range": 200.0}),
    sim.RadarSpec: (
        {"period_ns": 0}, {"offset_ns": 50_000_000}, {"azimuth_deg": (5.0, 5.0)}, {"elevation_deg": (-95.0, 0.0)},
        {"speed_sigma": NAN}, {"false_alarms": -1.0}, {"min_range": 500.0},
    ),
    sim.Detector2dSpec: ({"repeated": 2.0}, {"corner_sigma_px": -1.0}),
    sim.Detector3dSpec: (
        {"flip_share": 1.2}, {"center_sigmas": (0.1, -0.1, 0.1)}, {"range_scale": 0.0}, {"seed": -1},
        {"lasting_share": -0.1}, {"yaw_sigma_deg": NAN}, {"velocity_sigma": math.inf},
    ),
    sim.TrafficSpec: ({"cars": 7.0}, {"cyclists": -1.0}, {"pedestrians": NAN}, {"stationary": 1.5}, {"crossing": 0.9}),
    sim.Stop: ({"at_s": NAN, "for_s": 1.0}, {"at_s": 0.0, "for_s": -1.0}),
    sim.PathSpec: (
        {"stops": (sim.Stop(0.0, 5.0), sim.Stop(12.0, 1.0)), "ramp": 4.0}, {"speeds": (9.0, 5.0)},
        {"speeds": (0.0, 5.0)}, {"yaw_rate": 2.0}, {"yaw_rate": NAN}, {"ramp": 0.0},
    ),
}  # fmt: skip
"""What nobody can build or drive."""
WORDS = {
    "gyroscope_noise": r"imu.gyroscope_noise: .*expected 0.0 to",
    "vertical_sigma": r"gnss.vertical_sigma: .*expected 0.0 to",
    "origin_lla": r"origin_lla\[0\]",
    "center_sigmas": r"^detector.center_sigmas\[1\]",
    5: "3 angles; expected 2, or 5",
    3: r"elevations_deg\[2\]",
    **{name: f"traffic.{name}" for name in ("cars", "cyclists", "pedestrians", "stationary", "crossing")},
}


@pytest.mark.parametrize(("spec", "wrong"), [(spec, wrong) for spec, wrongs in REFUSED.items() for wrong in wrongs])
def test_what_cannot_be_is_refused_by_name(spec, wrong):
    name, value = next(iter(wrong.items()))
    usual = "expected" if spec in (sim.Stop, sim.PathSpec) else "|".join(wrong)
    with pytest.raises(OptionError, match=WORDS.get(value if name == "beams" else name, usual)):
        spec(**wrong)


def test_what_a_seed_means_stays():
    """Numbers that drives without further sensors, traffic or faults have had from the start."""
    drive = simulate_street(3, frames=3, lidar=sim.LidarSpec(beams=32, steps=600))
    truth, scene = drive.truth, drive.scene
    first, _, third = (frame.points for frame in scene.lidars[0].frames)
    bin_, trajectory, streams = truth.objects[100], scene.trajectories["groundTruth"], scene.sensor("imu").streams
    rgb, image = scene.cameras[0].images[1].rgb, truth.image("camera0", 1)
    assert (len(truth.objects), len(scene.annotations), bin_.label) == (143, 77, "bin")
    counted = first, third, trajectory.positions, streams["gyroscope"].values
    assert [len(one) for one in counted] == [18916, 18885, 72, 142]
    # Intensities are rounded, and rays graze edges: a few may fall to the other side on other processors, which may
    # round sines differently in the last place. 1e-11 degrees are a micrometre.
    for found, expected, atol in (
        (bin_.center_world, [19.919217841186637, 1.5572615535307204, 0.49], 1e-9),
        (bin_.yaw, 0.3745412551423274, 1e-9),
        (first.intensities.sum(dtype=np.int64), 1021471, 20),
        (third.intensities.sum(dtype=np.int64), 1015938, 20),
        (first.positions[5000], [0.7724280953407288, 8.171435356140137, -1.8492361307144165], 1e-5),
        (third.positions[5000], [1.3576304912567139, 14.362231254577637, -1.9017314910888672], 1e-5),
        (rgb.mean(axis=(0, 1)), [103.13753945249597, 109.5844938271605, 102.08610842726785], 1e-3),
        (rgb[200, 600].astype(float), [26, 73, 50], 1),
        (image.depths.mean(dtype=np.float64), 19.859321487794304, 1e-3),
        ((image.instances == 0).sum(), 126744, 5),
        (trajectory.positions[40], [1.3264224740243133, 0.5440577792995279, 0.006040737167391537], 1e-9),
        (streams["gyroscope"].values[50], [0.0032136599131289446, 0.005590593738119201, 0.11757726706541065], 1e-9),
        (streams["accelerometer"].values[50], [1.4936717650823574, 0.8771658277854153, 9.71216806560011], 1e-8),
        (scene.sensor("gnss").positions_lla[3], [60.17080314787866, 24.93751028275813, 14.995560078881681], 5e-10),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol)


def test_what_the_page_says_can_be_typed_in_from_its_top_to_its_end():
    page, typed = Path(__file__).parents[3] / "docs" / "simulation.md", {}
    for block in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        exec(block, typed)
    assert set(typed["wrong"].true_frames) == {"lidar", "camera0", "imu"}
    assert [len(typed[name]) for name in ("sweeps", "images")] == [3, 2]


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


def test_point_times_are_wrong_as_asked_for(right):
    frame = right.scene.lidars[0].frames[3]
    times, timestamp, kinds = frame.points.timestamps_ns, frame.timestamp_ns, sim.PointTimes
    for kind, expected in [
        (kinds.MISSING, None),
        (kinds.ZERO, 0 * times),
        (kinds.FRAME, 0 * times + timestamp),
        (kinds.RELATIVE, times - timestamp),
        (kinds.MICROSECONDS, times // 1000),
        (kinds.RELATIVE_MICROSECONDS, (times - timestamp) // 1000),
        (kinds.STRETCHED, timestamp + 1000 * (times - timestamp)),
    ]:
        given = injected(right, "lidar", point_times=kind).scene.lidars[0].frames[3]
        assert given.timestamp_ns == timestamp
        np.testing.assert_array_equal(given.points.timestamps_ns, expected)


def test_faults_that_cannot_be_are_refused(right):
    for sensor_id, wrong, message in [
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
    ]:
        with pytest.raises(OptionError, match=message):
            injected(right, sensor_id, **wrong)


def test_hardly_any_traffic_is_the_nearest_cars():
    traffic = sim.TrafficSpec(cars=1e-308, cyclists=1e-308, pedestrians=1e-308, stationary=1e-308)
    assert len(simulate_street(4, frames=1, lidar=SMALL, cameras=(), traffic=traffic).truth.street.movers) == 2
