import pickle
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.motion.deskew import points_to_world
from sceneloom.scene import RadarSensor
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import (
    CameraSpec,
    ExposureSpec,
    LidarSpec,
    RadarSpec,
    Raster,
    Rosette,
    SolidStateSpec,
    TrafficSpec,
    sensor_mount,
    simulate_street,
)

SMALL = LidarSpec(beams=8, steps=200)
TINY = Camera("pinhole", 40, 30, 30.0, 30.0, 19.5, 14.5)
RASTER = SolidStateSpec(
    Raster(rows=20, columns=30, channels=3),
    period_ns=50_000_000,
    offset_ns=7_000_000,
    range_sigma=0.0,
    mount=sensor_mount(position=(1.0, -0.6, 1.2), yaw_deg=-40.0, pitch_deg=3.0),
)
ROSETTE = SolidStateSpec(Rosette(shots_per_second=20_000.0), period_ns=300_000_000, offset_ns=40_000_000)
RADAR = RadarSpec(period_ns=70_000_000, offset_ns=10_000_000)
LIDARS = (SMALL, RASTER, ROSETTE)


@pytest.fixture(scope="module")
def rich():
    """A drive with three lidars, two radars and a camera."""
    return simulate_street(
        4, frames=5, lidars=LIDARS, cameras=(CameraSpec(TINY),), radars=(RADAR, RadarSpec())
    )


def test_several_lidars_and_radars_have_ids_in_their_order(rich):
    ids = [sensor.id for sensor in rich.scene.sensors]
    assert ids == ["lidar0", "lidar1", "lidar2", "camera0", "radar0", "radar1", "imu", "gnss"]
    assert list(rich.truth.lidars) == ids[:3]
    assert list(rich.truth.radars) == ids[4:6]
    assert rich.truth.lidar is rich.truth.lidars["lidar0"]
    assert isinstance(rich.scene.sensor("radar1"), RadarSensor)


def test_a_single_lidar_has_no_number_however_it_is_given():
    one, listed = (
        simulate_street(4, frames=2, cameras=(), **given)
        for given in ({"lidar": RASTER}, {"lidars": (RASTER,)})
    )
    assert [lidar.id for lidar in (*one.scene.lidars, *listed.scene.lidars)] == ["lidar", "lidar"]
    a, b = (drive.scene.lidars[0].frames[1] for drive in (one, listed))
    assert a.timestamp_ns == 1_000_000_000 + 7_000_000 + 50_000_000
    np.testing.assert_array_equal(a.points.positions, b.points.positions)


def test_each_sensor_measures_on_its_own_clock_while_the_drive_lasts(rich):
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
        assert frames.timestamps_ns.tolist() == list(times)
        assert [frame.timestamp_ns for frame in frames] == list(times)


def test_frames_of_all_sensors_merge_into_one_stream(rich):
    lidars = [rich.scene.sensor(f"lidar{k}") for k in range(3)]
    timestamps = np.sort(np.concatenate([lidar.frames.timestamps_ns for lidar in lidars]))
    assert len(timestamps) == 5 + 10 + 2
    for lidar in lidars:
        spec = rich.truth.lidars[lidar.id].spec
        for frame in lidar.frames:
            times = frame.points.timestamps_ns - frame.timestamp_ns
            assert 0 <= times.min() < times.max() < spec.period_ns
            assert (np.diff(times) >= 0).all()


def test_further_sensors_change_nothing_of_the_first_lidar_the_street_and_the_camera(rich):
    plain = simulate_street(4, frames=5, lidar=SMALL, cameras=(CameraSpec(TINY),))
    for k in (0, 4):
        ours, theirs = (drive.truth.sweep(k) for drive in (rich, plain))
        np.testing.assert_array_equal(ours.frame.points.positions, theirs.frame.points.positions)
    images = [drive.scene.cameras[0].images[2].rgb for drive in (rich, plain)]
    np.testing.assert_array_equal(*images)
    np.testing.assert_array_equal(rich.truth.street.shapes.maps, plain.truth.street.shapes.maps)


def test_further_sensors_change_nothing_of_the_traffic_however_long_they_measure():
    slow = SolidStateSpec(Raster(rows=2, columns=4), period_ns=10**9, offset_ns=10**8 - 1)
    plain, rich = (
        simulate_street(4, frames=1, lidars=lidars, radars=radars, cameras=(), traffic=TrafficSpec())
        for lidars, radars in (((SMALL,), ()), ((SMALL, slow), (RadarSpec(period_ns=10**10),)))
    )
    # The last shot of the slow one is 1.1 s after the start of the drive's only sweep of 0.1 s.
    times = 1_000_000_000 + np.arange(0, 1_100_000_000, 50_000_000)
    ours, theirs = (drive.truth.boxes(times) for drive in (rich, plain))
    assert ours.present[:, len(rich.truth.objects) :].any()
    np.testing.assert_array_equal(ours.centers_world, theirs.centers_world)
    np.testing.assert_array_equal(ours.present, theirs.present)


def test_lidars_of_the_same_kind_have_noise_of_their_own():
    drive = simulate_street(4, frames=1, lidars=(SMALL, SMALL), cameras=())
    first, second = (drive.truth.sweep(0, lidar_id) for lidar_id in ("lidar0", "lidar1"))
    errors = [np.linalg.norm(s.frame.points.positions, axis=1) - s.ranges for s in (first, second)]
    common = min(map(len, errors))
    # A thousand independent pairs correlate by 0.03 at random; five times that.
    assert common > 700
    assert abs(np.corrcoef(errors[0][:common], errors[1][:common])[0, 1]) < 0.18
    mean = [s.points_world.mean(axis=0) for s in (first, second)]
    np.testing.assert_allclose(mean[0], mean[1], atol=0.5)


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


def test_poses_of_every_sensor_are_trajectory_and_mounting(rich):
    for name in ("lidar1", "lidar2", "radar0"):
        sensor = rich.scene.sensor(name)
        exact = rich.truth.path.at(sensor.poses.timestamps_ns)
        rotation = Rotation.from_matrix(exact.rotations)
        expected = rotation.apply(sensor.mount.translation.copy()) + exact.positions
        np.testing.assert_allclose(sensor.poses.positions, expected, atol=1e-9)
        away = rotation * Rotation.from_matrix(sensor.mount.rotation.copy())
        np.testing.assert_allclose(
            Rotation.from_quat(sensor.poses.quaternions_xyzw).as_matrix(), away.as_matrix(), atol=1e-9
        )


def test_trajectory_imu_and_gnss_outlast_the_last_shot(rich):
    last = max(int(lidar.frames[-1].points.timestamps_ns[-1]) for lidar in rich.scene.lidars)
    assert last > 1_600_000_000
    for times in (
        rich.scene.trajectories["groundTruth"].timestamps_ns,
        rich.scene.sensor("imu").streams["gyroscope"].timestamps_ns,
        rich.scene.sensor("gnss").timestamps_ns,
    ):
        assert times[-1] > last


def test_two_lidars_see_the_same_walls(rich):
    clouds = [rich.truth.clean_points_world(0, name) for name in ("lidar0", "lidar1")]
    shared = set(clouds[0].instances.tolist()) & set(clouds[1].instances.tolist()) - {0}
    assert len(shared) > 3
    things = {thing.instance: thing for thing in rich.truth.objects}
    for cloud in clouds:
        for instance in shared:
            own = cloud.positions_world[cloud.instances == instance]
            away = (
                Rotation.from_euler("z", things[instance].yaw)
                .inv()
                .apply(own - things[instance].center_world)
            )
            assert (np.abs(away) <= np.array(things[instance].size_lwh) / 2 + 1e-6).all()


def test_asking_for_a_lidar_that_is_not_there_names_those_that_are(rich):
    with pytest.raises(OptionError, match="'lidar'; expected one of 'lidar0', 'lidar1', 'lidar2'"):
        rich.truth.sweep(0, "lidar")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"lidar": SMALL, "lidars": (SMALL,)}, "both are given"),
        ({"lidars": ()}, "lidars: none"),
        ({"lidars": (SMALL, SolidStateSpec(period_ns=10**9 + 1))}, "lidar1.period_ns"),
    ],
)
def test_rigs_that_cannot_be_are_refused(wrong, message):
    with pytest.raises(OptionError, match=message):
        simulate_street(1, frames=1, cameras=(), **wrong)


def test_the_scene_goes_to_another_process_and_is_the_same_there():
    camera = CameraSpec(TINY, readout_ns=20_000_000, exposure=ExposureSpec())
    drive = simulate_street(4, frames=2, lidars=LIDARS, cameras=(camera,), radars=(RADAR,))
    there = pickle.loads(pickle.dumps(drive.scene))
    for name in ("lidar0", "lidar1", "lidar2"):
        np.testing.assert_array_equal(
            there.sensor(name).frames[0].points.positions, drive.scene.sensor(name).frames[0].points.positions
        )
    np.testing.assert_array_equal(
        there.sensor("radar0").frames[1].points.lengths, drive.scene.sensor("radar0").frames[1].points.lengths
    )
    np.testing.assert_array_equal(there.cameras[0].images[1].rgb, drive.scene.cameras[0].images[1].rgb)


def test_a_scene_file_keeps_lidars_and_radars(rich, tmp_path):
    sceneloom.write(rich.scene, tmp_path / "rich.sfs")
    with sceneloom.open(tmp_path / "rich.sfs") as again:
        for name in ("lidar1", "lidar2"):
            ours, theirs = rich.scene.sensor(name).frames[1], again.sensor(name).frames[1]
            np.testing.assert_array_equal(ours.points.positions, theirs.points.positions)
        assert again.sensor("lidar2").frames[0].points.rings is None
        radar, kept = (scene.sensor("radar0").frames[3].points for scene in (rich.scene, again))
        np.testing.assert_array_equal(radar.lengths, kept.lengths)
        np.testing.assert_array_equal(radar.directions, kept.directions)


def test_a_recording_keeps_several_lidars_on_their_own_clocks(rich, tmp_path):
    report = sceneloom.write(rich.scene, tmp_path / "rich")
    assert {"sensors[radar0]", "sensors[radar1]"} <= {loss.field for loss in report.losses}
    with sceneloom.open(tmp_path / "rich") as again:
        assert [lidar.id for lidar in again.lidars] == ["lidar0", "lidar1", "lidar2"]
        for lidar in again.lidars:
            ours = rich.scene.sensor(lidar.id)
            np.testing.assert_array_equal(lidar.frames.timestamps_ns, ours.frames.timestamps_ns)
            np.testing.assert_array_equal(lidar.frames[1].points.positions, ours.frames[1].points.positions)
        timestamps = [lidar.frames.timestamps_ns.tolist() for lidar in again.lidars]
        assert all(a != b for a, b in pairwise(timestamps))
