"""Lidar odometry, of sweeps and of scenes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import ArrayError, DataError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion import odometry as odo
from sceneloom.motion.odometry import LidarOdometry, Outcome, lidar_odometry
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, PointsFrame
from sceneloom.simulate import LidarSpec, PathSpec, Stop, TrafficSpec, simulate_street

SPEC = LidarSpec(beams=24, elevations_deg=(-24.0, 10.0), steps=900)
FRAMES = 16
GAP = 10
Cloud = tuple[int, np.ndarray, np.ndarray | None]


@pytest.fixture(scope="module")
def drive():
    return simulate_street(3, frames=FRAMES + GAP, lidar=SPEC, cameras=())


def in_ego_frame(drive):
    frames = drive.scene.lidars[0].frames
    return [(f.timestamp_ns, SPEC.mount.apply(f.points.positions), f.points.timestamps_ns) for f in frames]


@pytest.fixture(scope="module")
def clouds(drive):
    return in_ego_frame(drive)


def follow(clouds):
    odometry = LidarOdometry()
    estimates = [odometry.add(*cloud) for cloud in clouds]
    return [estimate for estimate in estimates if estimate is not None]


def miss(estimate, first, drive):
    """How far an estimate is from the truth [m], as seen from the first."""
    states = drive.truth.path.at(np.array([first.state.timestamp_ns, estimate.state.timestamp_ns]))
    expected = states.rotations[0].T @ (states.positions[1] - states.positions[0])
    return float(np.linalg.norm(estimate.state.position - first.state.position - expected))


def spoilt(kind, cloud):
    timestamp, points, times = cloud
    if kind == "empty":
        return timestamp, np.zeros((0, 3)), np.zeros(0, np.int64)
    if kind == "nan":
        return timestamp, np.full_like(points, np.nan), times
    if kind == "few":
        return timestamp, points[:100], times[:100]
    generator = np.random.default_rng(0)
    return (timestamp, generator.uniform(-20, 20, (4000, 3)), np.linspace(times[0], times[-1], 4000).astype(np.int64))


@pytest.mark.parametrize(
    ("kind", "outcome"),
    [("empty", Outcome.TOO_FEW), ("nan", Outcome.TOO_FEW), ("few", Outcome.TOO_FEW), ("noise", Outcome.MISFIT)],
)
def test_a_sweep_that_states_nothing_is_predicted_less_surely_and_the_next_one_finds_back(clouds, drive, kind, outcome):
    estimates = follow([spoilt(kind, cloud) if k == 6 else cloud for k, cloud in enumerate(clouds[:10])])
    assert [estimate.outcome for estimate in estimates[5:8]] == [Outcome.FITTED, outcome, Outcome.FITTED]
    # a car accelerates by some m/s², so 0.1 s of prediction miss by centimetres
    assert miss(estimates[6], estimates[0], drive) < 0.1
    assert np.trace(estimates[6].covariance) > 2 * np.trace(estimates[5].covariance)
    assert miss(estimates[9], estimates[0], drive) < 0.03


def test_gaps_in_time_begin_a_new_map_and_points_that_are_no_numbers_change_nothing(clouds, drive):
    estimates = follow([*clouds[:8], *clouds[8 + GAP :]])
    assert [k for k, e in enumerate(estimates) if e.outcome is Outcome.RESTARTED] == [8]
    deviation = np.sqrt(np.diag(estimates[8].covariance)[3:])
    assert deviation.min() > 0.5
    assert miss(estimates[8], estimates[0], drive) < 3 * np.linalg.norm(deviation)
    after = miss(estimates[-1], estimates[8], drive)
    assert after < 0.5  # the heading is as uncertain as the rotating during a second, but the trajectory goes on
    timestamp, points, times = clouds[3]
    strange = np.array([[np.nan, 0, 0], [np.inf, 1, 1], [1e30, 0, 0], [0, 0, 0]])
    dirty = [*clouds[:3], (timestamp, np.vstack([points, strange]), np.concatenate([times, times[-4:]])), clouds[4]]
    for clean, found in zip(follow(clouds[:5]), follow(dirty), strict=True):
        np.testing.assert_array_equal(clean.state.position, found.state.position)
        np.testing.assert_array_equal(clean.state.rotation, found.state.rotation)
        np.testing.assert_array_equal(clean.covariance, found.covariance)
    estimates = follow([(timestamp, points, None) for timestamp, points, _ in clouds[:12]])
    assert {estimate.outcome for estimate in estimates[1:]} == {Outcome.FITTED}
    assert miss(estimates[-1], estimates[0], drive) < 0.5


def test_the_same_sweep_over_and_over_and_a_bare_plain_state_nothing_more_than_they_show(clouds):
    timestamp, points, times = clouds[0]
    estimates = follow([(timestamp + k * 10**8, points, times + k * 10**8) for k in range(20)])
    assert max(np.abs(estimate.state.position).max() for estimate in estimates) < 0.005
    odometry = LidarOdometry()
    for cloud in clouds[:4]:
        odometry.add(*cloud)
    assert odometry.add(*clouds[1]) is None
    after = odometry.add(*clouds[4])
    np.testing.assert_array_equal(after.state.position, follow(clouds[:5])[4].state.position)
    estimates = follow([spoilt("empty", clouds[0]), spoilt("nan", clouds[1]), *clouds[2:5]])
    outcomes = [Outcome.TOO_FEW, Outcome.TOO_FEW, Outcome.STARTED, Outcome.FITTED, Outcome.FITTED]
    assert [estimate.outcome for estimate in estimates] == outcomes
    np.testing.assert_array_equal(estimates[2].state.position, 0.0)
    generator, odometry = np.random.default_rng(0), LidarOdometry()
    for k in range(15):
        times = np.linspace(k * 10**8, k * 10**8 + 9 * 10**7, 8000).astype(np.int64)
        plain = np.column_stack([generator.uniform(-40, 40, (8000, 2)), np.full(8000, -1.0)])
        estimate = odometry.add(k * 10**8, plain, times)
    along_x, along_y, height = np.sqrt(np.diag(estimate.covariance)[3:])
    assert min(along_x, along_y) > 0.5
    assert height < 0.02


@pytest.mark.slow
def test_a_stationary_car_stays_where_it_is_while_others_pass():
    path, traffic = PathSpec(stops=(Stop(0.0, 12.0),)), TrafficSpec(cars=5.0, pedestrians=8.0)
    drive = simulate_street(5, frames=40, lidar=SPEC, cameras=(), path=path, traffic=traffic)
    estimates = follow(in_ego_frame(drive))
    # a centimetre is what 2 cm of range noise leave in the first sweep's surfaces
    assert max(np.linalg.norm(estimate.state.position) for estimate in estimates) < 0.015


SMALL = LidarSpec(beams=24, elevations_deg=(-24.0, 10.0), steps=720)
ASIDE = RigidTransform(np.eye(3), np.array([0.2, 0.7, 1.6]))
LEFT = replace(SMALL, beams=16, offset_ns=30_000_000, mount=ASIDE)
SWEEPS = 8


@pytest.fixture(scope="module")
def scene():
    return held(simulate_street(3, frames=SWEEPS, lidars=(SMALL, LEFT), cameras=()).scene)


@pytest.fixture(scope="module")
def alone(scene):
    return replace(scene, sensors=scene.lidars[:1])


@pytest.fixture(scope="module")
def sound(alone):
    return lidar_odometry(alone)


def run_of(scene, *lidars, **more):
    return lidar_odometry(replace(scene, sensors=lidars), **more)


def held(scene):
    """Only the lidars, with their sweeps in memory."""
    lidars = (with_frames(lidar, list(lidar.frames)) for lidar in scene.lidars)
    return replace(scene, sensors=tuple(lidars), trajectories={})


def with_frames(lidar, frames):
    return replace(lidar, frames=LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]))


def blind(lidar):
    nothing = LidarPoints(np.zeros((0, 3), np.float32), timestamps_ns=np.zeros(0, np.int64))
    return with_frames(lidar, [replace(frame, points=nothing) for frame in lidar.frames])


def last_position(run):
    return run.trajectory.positions[-1]


def codes(run):
    return {warning.code for warning in run.warnings}


def test_sweeps_of_one_period_make_one_cloud_of_which_one_blind_lidar_does_not_matter(scene, sound):
    sweeps, reported = odo.SceneSweeps.of(scene), []
    lidar_odometry(scene, progress=lambda done, total: reported.append((done, total)))
    assert reported == [(k, SWEEPS) for k in range(1, SWEEPS + 1)]
    clouds = [cloud for _, cloud in sweeps.clouds()]
    first, second = (list(lidar.frames) for lidar in scene.lidars)
    assert len(clouds) == SWEEPS
    for k, cloud in enumerate(clouds):
        assert cloud.timestamp_ns == first[k].timestamp_ns
        points = first[k].points, second[k].points
        parts = [lidar.mount.apply(p.positions) for lidar, p in zip(scene.lidars, points, strict=True)]
        np.testing.assert_allclose(cloud.positions_ego, np.concatenate(parts))
        np.testing.assert_array_equal(cloud.timestamps_ns, np.concatenate([p.timestamps_ns for p in points]))
    first, second = scene.lidars
    assert np.linalg.norm(last_position(sound)) > 3.0
    for run in (run_of(scene, first, blind(second)), run_of(scene, blind(first), second)):
        ((code, count),) = ((warning.code, warning.count) for warning in run.warnings)
        assert (code, count) == ("sweeps-without-returns", SWEEPS)
        # they end at other times: the second lidar begins 30 ms later
        shared_ns = first.frames.timestamps_ns[-1:] + 90_000_000
        found, expected = (one.trajectory.poses.interpolate(shared_ns).positions[0] for one in (run, sound))
        assert np.linalg.norm(found - expected) < 0.4  # the first point was measured 30 ms later: up to 0.3 m on


def test_points_in_the_ego_frame_need_no_mounting_and_scenes_that_cannot_be_followed_are_refused(alone, sound, scene):
    lidar = alone.lidars[0]
    clouds = [replace(f.points, positions=np.float32(lidar.mount.apply(f.points.positions))) for f in lidar.frames]
    frames = [replace(frame, points=cloud) for frame, cloud in zip(lidar.frames, clouds, strict=True)]
    run = run_of(alone, replace(with_frames(lidar, frames), mount=None, points_frame=PointsFrame.EGO))
    np.testing.assert_allclose(last_position(run), last_position(sound), atol=1e-3)
    assert run.warnings == ()
    bare = replace(lidar, mount=None)
    assert codes(run_of(alone, bare)) == {"lidar-is-the-ego"}
    assert codes(run_of(scene, bare, scene.lidars[1])) == {"lidar-left-out-of-odometry"}
    with pytest.raises(PoseError, match=r"no lidar sweeps.*--trajectory"):
        run_of(alone)
    with pytest.raises(PoseError, match="in world coordinates already"):
        run_of(alone, replace(lidar, points_frame=PointsFrame.WORLD))
    with pytest.raises(PoseError, match="none of 8 lidar sweeps has enough returns"):
        run_of(alone, blind(lidar))


def unreadable(lidar, broken):
    frames = list(lidar.frames)

    def read(k):
        if k == broken:
            raise DataError("sweep.bin", f"frames[{k}]", "17 bytes; expected a multiple of 23")
        return frames[k]

    return replace(lidar, frames=LazyFrames(lidar.frames.timestamps_ns, read))


def test_broken_sweeps_and_point_times_are_repaired_or_left_aside_and_single_or_repeated_ones_stand(alone, sound):
    broken = unreadable(alone.lidars[0], 4)
    with pytest.raises(DataError, match="17 bytes"):
        run_of(alone, broken)
    run = run_of(alone, broken, lenient=True)
    assert codes(run) == {"odometry-sweep-unreadable"}
    np.testing.assert_allclose(last_position(run), last_position(sound), atol=0.02)
    lidar = alone.lidars[0]
    frames = list(lidar.frames)
    run = run_of(alone, with_frames(lidar, [*frames[:3], frames[4], frames[3], *frames[5:], frames[7]]))
    assert codes(run) == {"sweeps-sorted", "sweeps-of-one-time"}
    np.testing.assert_array_equal(last_position(run), last_position(sound))
    for change, code, exact in [
        (lambda times, timestamp: times - timestamp, "relative-point-times", True),
        (lambda times, timestamp: times // 1000, "unit-of-point-times", False),
        (lambda times, timestamp: np.zeros_like(times), "times-of-points", None),
    ]:
        lidar = alone.lidars[0]
        clouds = [replace(f.points, timestamps_ns=change(f.points.timestamps_ns, f.timestamp_ns)) for f in lidar.frames]
        frames = [replace(frame, points=cloud) for frame, cloud in zip(lidar.frames, clouds, strict=True)]
        run = run_of(alone, with_frames(lidar, frames))
        assert code in codes(run)
        if exact is None:
            assert "odometry-without-point-times" in codes(run)
        else:
            np.testing.assert_allclose(last_position(run), last_position(sound), atol=0 if exact else 1e-3)
    lidar = alone.lidars[0]
    run = run_of(alone, with_frames(lidar, [lidar.frames[0]]))
    times = lidar.frames[0].points.timestamps_ns
    assert (run.trajectory.timestamps_ns[0], run.trajectory.timestamps_ns[-1]) == (times.min(), times.max())
    np.testing.assert_allclose(run.trajectory.positions, 0.0, atol=1e-12)
    assert codes(run) == {"odometry-without-motion"}
    # no one knows how fast it went: a road vehicle covers metres in a sweep
    assert np.sqrt(run.trajectory.covariances[-1, 3, 3]) > 0.3
    points = replace(lidar.frames[0].points, timestamps_ns=None)
    frames = [LidarFrame(timestamp, points) for timestamp in lidar.frames.timestamps_ns.tolist()]
    run = run_of(alone, with_frames(lidar, frames))
    assert {warning.code: warning.count for warning in run.warnings}["repeated-sweeps"] == SWEEPS - 1
    np.testing.assert_allclose(run.trajectory.positions, 0.0, atol=1e-3)
    frames = list(lidar.frames)
    nothing = replace(frames[0], points=blind(lidar).frames[0].points)
    run = run_of(alone, with_frames(lidar, [nothing, *frames[1:]]))
    assert codes(run) == {"odometry-too-few-points", "sweeps-without-returns"}
    times = np.array([frames[0].timestamp_ns, int(run.trajectory.timestamps_ns[-1])])
    expected, found = (one.trajectory.poses.interpolate(times).positions for one in (sound, run))
    assert abs(np.linalg.norm(np.diff(expected, axis=0)) - np.linalg.norm(np.diff(found, axis=0))) < 0.05


YAW_RATE, VELOCITY = np.array([0.05, -0.1, 0.8]), np.array([9.0, 2.0, -0.3])


def moved(points, seconds, rotation, position, yaw_rate, velocity):
    """World points and arms by SciPy's rotations."""
    rotated = Rotation.from_rotvec(seconds[:, None] * yaw_rate) * Rotation.from_matrix(rotation)
    arms, bend = rotated.apply(points), 0.5 * seconds[:, None] ** 2 * np.cross(yaw_rate, velocity)
    return position + seconds[:, None] * velocity + bend + arms, arms


def equations(local_map, points, seconds, change, scale):
    """Information, gradient and Σ w s² after a small rotation and shift of the ego, and changes of their rates."""
    rotation = Rotation.from_rotvec(change[:3]).as_matrix()
    world, arms = moved(points, seconds, rotation, change[3:6], YAW_RATE + change[6:9], VELOCITY + change[9:])
    information, gradient, sums = np.empty((3, 6, 6)), np.empty((2, 6)), np.empty(4)
    levels = [x for level in local_map.levels for x in (level.leaf, level.table, level.keys, level.surfaces)]
    odo.accumulate_normal_equations(world, arms, seconds, scale, *levels, information, gradient, sums)
    return information, gradient, sums


def on_ground(noise, z):
    """A map of level ground, and points above it."""
    generator, local_map = np.random.default_rng(2), odo.LocalMap(1.0, 0.02)
    local_map.insert(np.column_stack([generator.uniform(-30, 30, (60_000, 2)), generator.normal(-1.0, noise, 60_000)]))
    return local_map, np.column_stack([generator.uniform(-20, 20, (300, 2)), np.full(300, z)]), np.zeros(300)


def test_points_move_with_the_ego_the_gradient_is_that_of_half_the_squared_error_and_wrong_shapes_are_refused():
    generator = np.random.default_rng(1)
    points, seconds = generator.uniform(-30, 30, (200, 3)), generator.uniform(-0.05, 0.05, 200)
    rotation, position = Rotation.from_rotvec([0.1, 0.2, -0.5]).as_matrix(), np.array([5.0, -3.0, 1.0])
    found = np.empty_like(points), np.empty_like(points)
    odo.move_points(points, seconds, rotation, position, YAW_RATE, VELOCITY, *found)
    np.testing.assert_allclose(found, moved(points, seconds, rotation, position, YAW_RATE, VELOCITY), atol=1e-9)
    cloud, scale, step = on_ground(0.01, -0.99), 1e6, 1e-6
    # every weight is that of where the surface lies, so that the error is a sum of squares
    _, gradient, _ = equations(*cloud, np.zeros(12), scale)
    for axis in (0, 1, 5):  # roll, pitch and height: what a level ground reports
        change = step * (np.arange(12) == axis)
        ahead, behind = (equations(*cloud, sign * change, scale)[2][2] for sign in (1, -1))
        assert np.isclose(gradient[0, axis], (ahead - behind) / (4 * step), rtol=0.02)
    information, _, sums = equations(*on_ground(0.0, -1.0), np.zeros(12), 3.0)
    assert sums[0] == 300
    assert np.abs(information[0][3:5, 3:5]).max() < 1e-9 * information[0][5, 5]
    assert abs(information[0][2, 2]) < 1e-9 * information[0][0, 0]
    with pytest.raises(ArrayError, match="positions_ego"):
        LidarOdometry().add(0, np.zeros((4, 2)))
    with pytest.raises(ArrayError, match="timestamps_ns"):
        LidarOdometry().add(0, np.zeros((4, 3)), np.zeros(3, np.int64))
    with pytest.raises(OptionError, match="cube"):
        odo.OdometryConfiguration(cube=0.0)
    with pytest.raises(OptionError, match="farthest"):
        odo.OdometryConfiguration(farthest=1.0)


NOISE = 0.02


def level_of(points, leaf=2.0):
    level = odo.SurfaceLevel(leaf, NOISE)
    level.insert(np.ascontiguousarray(points, dtype=np.float64))
    return level


def square(xx_xy_xz_yy_yz_zz):
    xx, xy, xz, yy, yz, zz = xx_xy_xz_yy_yz_zz
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def tilted_patch(normal, count=50):
    """Points in the cube from 0 to 2 m, on a plane through its middle, one in each part at most."""
    generator, basis = np.random.default_rng(3), np.linalg.svd(normal[None])[2][1:]
    spots = generator.uniform(-0.9, 0.9, (4000, 2))
    points = 1.0 + spots @ basis + generator.normal(0, 0.01, (4000, 1)) * normal
    points = points[((points > 0) & (points < 2)).all(axis=1)]
    _, first = np.unique((points / 0.5).astype(int), axis=0, return_index=True)
    return points[first][:count]


def test_maps_of_flat_cubes_grow_inform_across_their_planes_and_forget_what_is_far_away():
    normal = np.array([0.6, 0.0, 0.8])
    points = tilted_patch(normal)
    level = level_of(points)
    assert level.count == 1
    np.testing.assert_allclose(level.surfaces[0, :3], points.mean(axis=0), atol=1e-12)
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    share = 1.0 - values[0] / (0.1 * values[2])
    expected = share / (values[0] + NOISE**2) * np.outer(vectors[:, 0], vectors[:, 0])
    np.testing.assert_allclose(square(level.surfaces[0, 3:9]), expected, atol=1e-6)
    along = sum(np.outer(vectors[:, k], vectors[:, k]) / values[k] for k in (1, 2))
    np.testing.assert_allclose(square(level.surfaces[0, 9:]), along, atol=1e-6)
    pole = np.column_stack([np.full(12, 1.0), np.full(12, 1.0), np.linspace(0.05, 1.95, 12)])
    for points in (pole[:, [2, 0, 1]], tilted_patch(np.array([0.0, 0.0, 1.0]), count=4)):
        assert (level_of(points).surfaces[0, 3:9] == 0.0).all()
    information = square(level_of(pole).surfaces[0, 3:9])
    np.testing.assert_allclose(np.diag(information)[:2], 1 / NOISE**2, rtol=1e-6)
    assert abs(information[2, 2]) < 1e-6
    points = tilted_patch(np.array([0.0, 0.0, 1.0]))
    level = level_of(points)
    for _ in range(5):
        level.insert(points + 0.001)
    before = level.surfaces[0].copy()
    level.insert(points + 0.01)
    np.testing.assert_array_equal(level.surfaces[0], before)
    generator = np.random.default_rng(5)
    points = generator.uniform(-200.0, 200.0, (120_000, 3))
    points[:, 2] *= 0.05
    level, cubes = level_of(points, leaf=1.0), np.unique(np.floor(points), axis=0)
    assert level.count == len(cubes)
    level.drop_beyond(np.zeros(3), 50.0)
    assert level.count == (((cubes + 0.5) ** 2).sum(axis=1) <= 50.0**2).sum()
    count = level.count
    level.insert(np.ascontiguousarray(cubes[((cubes + 0.5) ** 2).sum(axis=1) <= 49.0**2] + 0.5))
    assert level.count == count
