from dataclasses import replace

import numpy as np
import pytest

from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.deskew import points_to_world
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import LidarSpec, simulate_street
from sceneloom.simulate.lidar_radar import ScanningLidar
from sceneloom.simulate.objects import Material, Pattern

HEIGHT = 1.5
UPRIGHT = RigidTransform(np.eye(3), np.array([0.0, 0.0, HEIGHT]))
EXACT = LidarSpec(beams=16, steps=360, range_sigma=0.0, drop_rate=0.0, mount=UPRIGHT)
# float32 holds 120 m in steps of 7.6e-6 m, so each coordinate is off by at most half of that.
FLOAT32 = 1e-5


@pytest.fixture(scope="module")
def wall(street_of, stationary_path, box):
    """A wall whose face is 10 m ahead, before an ego that is stationary."""
    grey = Material(Pattern.PLAIN, ((128.0, 128.0, 128.0),) * 3, reflectivity=0.8)
    return street_of([box([11, 0, 10], [1, 40, 10], grey)], stationary_path)


@pytest.fixture(scope="module")
def sweep_of(wall, stationary_path):
    """A sweep of a lidar before the wall."""

    def make(spec, *, seed=0, k=2):
        starts = np.arange(4, dtype=np.int64) * spec.period_ns
        return ScanningLidar.of(spec, wall, stationary_path, seed=seed, timestamps_ns=starts).sweep(k)

    return make


def on_wall(positions):
    return positions[positions[:, 2] > -1.4]


def test_a_stationary_lidar_sees_the_wall_at_its_distance_and_the_ground_at_its_height(sweep_of):
    positions = sweep_of(EXACT).frame.points.positions.astype(np.float64)
    ahead = on_wall(positions)
    ahead = ahead[np.abs(ahead[:, 1]) < 30]
    assert len(ahead) > 500
    np.testing.assert_allclose(ahead[:, 0], 10.0, atol=FLOAT32)
    ground = positions[positions[:, 0] < 0]
    assert len(ground) > 1000
    np.testing.assert_allclose(ground[:, 2], -HEIGHT, atol=FLOAT32)


def test_range_noise_lies_along_the_rays_and_has_the_deviation_that_was_asked_for(sweep_of):
    sweep = sweep_of(replace(EXACT, range_sigma=0.05, steps=720))
    measured = sweep.frame.points.positions.astype(np.float64)
    error = np.linalg.norm(measured, axis=1) - sweep.ranges
    # 7000 returns know a deviation to 0.9 % and a mean to 1.2 % of it; five times that.
    assert error.std() == pytest.approx(0.05, rel=0.045)
    assert abs(error.mean()) < 0.06 * 0.05
    np.testing.assert_allclose(np.cross(measured, sweep.directions), 0.0, atol=2 * FLOAT32)


def test_every_sweep_and_every_seed_has_noise_of_its_own(sweep_of):
    spec = replace(EXACT, range_sigma=0.05)
    errors = [
        np.linalg.norm(sweep.frame.points.positions, axis=1) - sweep.ranges
        for sweep in (sweep_of(spec, k=1), sweep_of(spec, k=2), sweep_of(spec, k=2, seed=1))
    ]
    # 3000 independent pairs correlate by 0.02 at random; five times that.
    assert np.abs(np.corrcoef(errors) - np.eye(3)).max() < 0.1


@pytest.mark.parametrize("clockwise", [True, False])
def test_each_point_has_the_time_at_which_the_rotating_sensor_looked_its_trajectory(sweep_of, clockwise):
    spec = replace(EXACT, clockwise=clockwise, start_azimuth_deg=170.0)
    sweep = sweep_of(spec)
    points = sweep.frame.points
    times = points.timestamps_ns - sweep.frame.timestamp_ns
    assert points.timestamps_ns.dtype == np.int64
    assert times.min() >= 0
    assert times.max() < spec.period_ns
    assert (np.diff(times) >= 0).all()
    rotated = 170.0 + (-360.0 if clockwise else 360.0) * times / spec.period_ns
    positions = points.positions.astype(np.float64)  # arctan2 of float32 is 1.5e-5 degrees off by itself
    azimuths = np.degrees(np.arctan2(positions[:, 1], positions[:, 0]))
    # Timestamps are whole nanoseconds, 3.6e-6 degrees, and the nearest points are 3 m away in float32.
    np.testing.assert_allclose((azimuths - rotated + 180) % 360 - 180, 0.0, atol=2e-5)


def test_rings_count_the_lasers_from_the_lowest(sweep_of):
    points = sweep_of(replace(EXACT, elevations_deg=(-20.0, 10.0))).frame.points
    flat = np.hypot(points.positions[:, 0], points.positions[:, 1])
    elevations = np.degrees(np.arctan2(points.positions[:, 2], flat))
    assert points.rings.dtype == np.uint16
    np.testing.assert_allclose(elevations, -20.0 + 2.0 * points.rings, atol=1e-4)
    assert points.rings.max() == 15


def test_returns_are_lost_at_the_rate_that_was_asked_for(sweep_of):
    everything = len(sweep_of(EXACT).frame.points)
    left = len(sweep_of(replace(EXACT, drop_rate=0.3)).frame.points)
    # Four thousand coins: deviation 0.7 %; five times that.
    assert left / everything == pytest.approx(0.7, abs=0.035)
    assert len(sweep_of(replace(EXACT, drop_rate=1.0)).frame.points) == 0


def test_nothing_comes_back_from_nearer_or_farther_than_the_bounds(sweep_of):
    sweep = sweep_of(replace(EXACT, min_range=12.0, max_range=15.0))
    assert sweep.ranges.min() >= 12.0
    assert sweep.ranges.max() <= 15.0
    assert len(sweep.ranges) > 100


def test_a_slanting_surface_returns_less(sweep_of):
    sweep = sweep_of(EXACT)
    wall = (sweep.instances == 1) & (np.abs(sweep.points_world[:, 2] - HEIGHT) < 1)
    square = wall & (np.abs(sweep.points_world[:, 1]) < 2)
    slanting = wall & (np.abs(sweep.points_world[:, 1]) > 25)
    intensities = sweep.frame.points.intensities.astype(float)
    assert intensities.dtype == float
    assert intensities[square].mean() > 1.3 * intensities[slanting].mean() > 0


@pytest.mark.parametrize("k", [0, 7])
def test_clean_points_lie_on_the_surfaces_that_they_name(exact_drive, k):
    clean = exact_drive.truth.clean_points_world(k)
    packed = exact_drive.truth.street.shapes
    ground = clean.instances == 0
    np.testing.assert_allclose(clean.positions_world[ground, 2], 0.0, atol=1e-9)
    origins = exact_drive.truth.sweep(k).origins_world
    rays = clean.positions_world - origins
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # 0.1 mm before the point nothing is, 0.1 mm behind it the object; a ray that grazes a corner need not enter.
    before = _instances_inside(packed, clean.positions_world[~ground] - 1e-4 * rays[~ground])
    behind = _instances_inside(packed, clean.positions_world[~ground] + 1e-4 * rays[~ground])
    assert (before == 0).all()
    assert (behind == clean.instances[~ground]).mean() > 0.999


def _instances_inside(packed, points):
    """Number of an object that each point lies in, 0 for none."""
    found = np.zeros(len(points), np.int64)
    for k in range(len(packed)):
        near = np.flatnonzero(np.linalg.norm(points - packed.spheres[k, :3], axis=1) < packed.spheres[k, 3])
        local = points[near] @ packed.maps[k, :, :3].T + packed.maps[k, :, 3]
        x, y, z = np.abs(local).T
        inside = (
            (x < 1) & (y < 1) & (z < 1),
            (np.hypot(x, y) < 1) & (z < 1),
            np.linalg.norm(local, axis=1) < 1,
            (x < 1) & (z < 1) & (y < (1 - local[:, 2]) / 2),
        )[packed.kinds[k]]
        found[near[inside]] = packed.instances[k]
    return found


def test_points_taken_to_the_world_at_their_own_times_are_the_clean_ones(exact_drive):
    frame, clean = exact_drive.scene.lidars[0].frames[5], exact_drive.truth.clean_points_world(5)
    mount = exact_drive.truth.lidar.spec.mount
    states = exact_drive.truth.path.at(frame.points.timestamps_ns)
    in_ego = frame.points.positions.astype(np.float64) @ mount.rotation.T + mount.translation
    world = np.einsum("nij,nj->ni", states.rotations, in_ego) + states.positions
    np.testing.assert_allclose(world, clean.positions_world, atol=2 * FLOAT32)


def test_deskewing_by_the_trajectory_gives_the_clean_points_and_without_it_they_are_off(exact_drive):
    lidar = exact_drive.scene.lidars[0]
    frame, clean = lidar.frames[5], exact_drive.truth.clean_points_world(5)
    source = PoseSource(exact_drive.scene.trajectories["groundTruth"].poses, lidar.mount)
    world, extrapolated = points_to_world(frame, source)
    error = np.linalg.norm(world - clean.positions_world, axis=1)
    assert not extrapolated
    # The trajectory is sampled at 100 Hz: 0.1 mm and 1e-5 rad, which is 1 mm at 100 m.
    assert error.max() < 1.2e-3
    still = LidarSpec(beams=1).period_ns
    frozen = replace(
        frame, points=replace(frame.points, timestamps_ns=np.full(len(frame.points), frame.timestamp_ns))
    )
    skewed = np.linalg.norm(points_to_world(frozen, source)[0] - clean.positions_world, axis=1)
    speed = np.linalg.norm(exact_drive.truth.path.at(np.array([frame.timestamp_ns])).velocities)
    assert skewed.max() > 0.8 * speed * still * 1e-9
    assert skewed.max() > 0.3


def test_sweeps_are_the_same_in_whatever_order_they_are_asked_for():
    spec = LidarSpec(beams=8, steps=200)
    forwards, backwards = (simulate_street(5, frames=3, lidar=spec, cameras=()) for _ in range(2))
    first = [forwards.scene.lidars[0].frames[k].points for k in (0, 1, 2)]
    second = [backwards.scene.lidars[0].frames[k].points for k in (2, 1, 0)][::-1]
    for a, b in zip(first, second, strict=True):
        for name in ("positions", "intensities", "timestamps_ns", "rings"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert not np.array_equal(first[0].positions[:100], first[1].positions[:100])


def test_points_are_handed_out_read_only(drive):
    points = drive.scene.lidars[0].frames[0].points
    for name in ("positions", "intensities", "timestamps_ns", "rings"):
        assert not getattr(points, name).flags.writeable


@pytest.mark.parametrize(
    "wrong",
    [
        {"beams": 0},
        {"beams": 70000},
        {"steps": 0},
        {"period_ns": 0},
        {"drop_rate": 1.5},
        {"range_sigma": float("nan")},
        {"min_range": 50.0, "max_range": 10.0},
        {"elevations_deg": (2.0, -24.8)},
        {"elevations_deg": (float("nan"), 2.0)},
        {"start_azimuth_deg": float("nan")},
    ],
)
def test_devices_that_cannot_be_are_refused_by_name(wrong):
    with pytest.raises(OptionError, match="|".join(wrong)):
        LidarSpec(**wrong)


def test_lasers_may_each_have_an_elevation_of_their_own():
    elevations = (-20.0, -10.0, -5.0, -4.0, -3.5)
    spec = LidarSpec(beams=5, elevations_deg=elevations, steps=60, range_sigma=0.0)
    points = simulate_street(1, frames=1, lidar=spec).scene.lidars[0].frames[0].points
    x, y, z = points.positions.astype(float).T
    found = np.degrees(np.arctan2(z, np.hypot(x, y)))
    rings = points.rings
    for ring, elevation in enumerate(elevations):
        # float32 of some metres
        np.testing.assert_allclose(found[rings == ring], elevation, atol=1e-4)
    with pytest.raises(OptionError, match="3 angles; expected 2, or 5"):
        LidarSpec(beams=5, elevations_deg=(-3.0, -2.0, -1.0))
    with pytest.raises(OptionError, match=r"elevations_deg\[2\]"):
        LidarSpec(beams=3, elevations_deg=(-3.0, -1.0, -2.0))
