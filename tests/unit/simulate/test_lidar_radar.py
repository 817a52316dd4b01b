"""Rotating and solid-state lidars, and radars: where, when and how often they measure, and with what noise."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.deskew import points_to_world
from sceneloom.scene import PointsFrame, SensorType
from sceneloom.scene.poses import PoseSource
from sceneloom.simulate import LidarSpec, RadarSpec, Raster, Rosette, SolidStateSpec, sensor_mount, simulate_street
from sceneloom.simulate.lidar_radar import FALSE_ALARM, ScanningLidar, SimulatedRadar
from sceneloom.simulate.street import Material, MovingDesign, Part, Pattern

from .scenery import STILL, box, in_box_axes, instances_inside, moving, path_at_speed, street_of, unit

HEIGHT = 1.5
UPRIGHT = RigidTransform(np.eye(3), np.array([0.0, 0.0, HEIGHT]))
EXACT = LidarSpec(beams=16, steps=360, range_sigma=0.0, drop_rate=0.0, mount=UPRIGHT)
PERIOD_NS = 100_000_000

# float32 holds 120 m in steps of 7.6e-6 m, so each coordinate is off by at most half of that.
FLOAT32 = 1e-5


def angles(positions):
    """Azimuths and elevations [deg]."""
    x, y, z = np.asarray(positions, np.float64).T  # arctan2 of float32 is 1.5e-5 degrees off by itself
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))


def ranges_of(points):
    return np.linalg.norm(points.positions.astype(np.float64), axis=1)


@pytest.fixture(scope="module")
def sweep_of():
    """A sweep of a lidar that is stationary before a wall whose face is 10 m ahead."""
    grey = Material(Pattern.PLAIN, ((128.0, 128.0, 128.0),) * 3, reflectivity=0.8)
    wall = street_of([box([11, 0, 10], [1, 40, 10], grey)])

    def make(spec, *, seed=0, k=2):
        return ScanningLidar(spec, wall, STILL, seed, 0, np.arange(4, dtype=np.int64) * spec.period_ns).sweep(k)

    return make


def test_a_stationary_lidar_sees_the_wall_at_its_distance_and_the_ground_at_its_height(sweep_of):
    sweep = sweep_of(EXACT)
    positions = sweep.frame.points.positions.astype(np.float64)
    ahead = positions[(positions[:, 2] > -1.4) & (np.abs(positions[:, 1]) < 30)]
    ground = positions[positions[:, 0] < 0]
    assert len(ahead) > 500
    assert len(ground) > 1000
    np.testing.assert_allclose(ahead[:, 0], 10.0, atol=FLOAT32)
    np.testing.assert_allclose(ground[:, 2], -HEIGHT, atol=FLOAT32)
    # a slanting surface returns less
    level = (sweep.instances == 1) & (np.abs(sweep.points_world[:, 2] - HEIGHT) < 1)
    aside, intensities = np.abs(sweep.points_world[:, 1]), sweep.frame.points.intensities
    assert intensities[level & (aside < 2)].mean() > 1.3 * intensities[level & (aside > 25)].mean() > 0
    left, nothing = (len(sweep_of(replace(EXACT, drop_rate=rate)).frame.points) for rate in (0.3, 1.0))
    # Four thousand coins: deviation 0.7 %; five times that.
    assert left / len(positions) == pytest.approx(0.7, abs=0.035)
    assert nothing == 0
    ranges = sweep_of(replace(EXACT, min_range=12.0, max_range=15.0)).ranges
    assert 12.0 <= ranges.min() < ranges.max() <= 15.0
    assert len(ranges) > 100


def test_points_have_time_ring_and_elevation_of_their_laser_and_noise_along_the_rays_as_asked_for(sweep_of):
    for clockwise in [True, False]:
        spec = replace(EXACT, clockwise=clockwise, start_azimuth_deg=170.0)
        sweep = sweep_of(spec)
        points = sweep.frame.points
        times = points.timestamps_ns - sweep.frame.timestamp_ns
        assert points.timestamps_ns.dtype == np.int64
        assert 0 <= times.min() < times.max() < spec.period_ns
        assert (np.diff(times) >= 0).all()
        rotated = 170.0 + (-360.0 if clockwise else 360.0) * times / spec.period_ns
        # Timestamps are whole nanoseconds, 3.6e-6 degrees, and the nearest points are 3 m away in float32.
        np.testing.assert_allclose((angles(points.positions)[0] - rotated + 180) % 360 - 180, 0.0, atol=2e-5)
    uneven = (-20.0, -10.0, -5.0, -4.0, -3.5)
    for spec, elevations in (
        (replace(EXACT, elevations_deg=(-20.0, 10.0)), np.linspace(-20.0, 10.0, 16)),
        (replace(EXACT, beams=5, elevations_deg=uneven), np.array(uneven)),
    ):
        points = sweep_of(spec).frame.points
        assert points.rings.dtype == np.uint16
        assert set(points.rings.tolist()) == set(range(len(elevations)))
        # float32 of some metres
        np.testing.assert_allclose(angles(points.positions)[1], elevations[points.rings], atol=1e-4)
    spec = replace(EXACT, range_sigma=0.05, steps=720)
    sweeps = [sweep_of(spec, k=1), sweep_of(spec, k=2), sweep_of(spec, k=2, seed=1)]
    errors = [ranges_of(sweep.frame.points) - sweep.ranges for sweep in sweeps]
    # 7000 returns know a deviation to 0.9 % and a mean to 1.2 % of it; five times that.
    assert errors[0].std() == pytest.approx(0.05, rel=0.045)
    assert abs(errors[0].mean()) < 0.06 * 0.05
    measured = sweeps[0].frame.points.positions.astype(np.float64)
    np.testing.assert_allclose(np.cross(measured, sweeps[0].directions), 0.0, atol=2 * FLOAT32)
    # 3000 independent pairs correlate by 0.02 at random; five times that.
    assert np.abs(np.corrcoef(errors) - np.eye(3)).max() < 0.1


def test_clean_points_lie_on_the_surfaces_that_they_name_and_are_the_points_taken_to_the_world(exact_drive):
    for k in [0, 7]:
        clean, packed = exact_drive.truth.clean_points_world(k), exact_drive.truth.street.shapes
        ground = clean.instances == 0
        np.testing.assert_allclose(clean.positions_world[ground, 2], 0.0, atol=1e-9)
        rays = unit(clean.positions_world - exact_drive.truth.sweep(k).origins_world)
        # 0.1 mm before the point nothing is, 0.1 mm behind it the object; a ray that grazes a corner need not enter.
        before, behind = (
            instances_inside(packed, clean.positions_world[~ground] + step * rays[~ground]) for step in (-1e-4, 1e-4)
        )
        assert (before == 0).all()
        assert (behind == clean.instances[~ground]).mean() > 0.999
    lidar = exact_drive.scene.lidars[0]
    frame, clean = lidar.frames[5], exact_drive.truth.clean_points_world(5)
    states = exact_drive.truth.path.at(frame.points.timestamps_ns)
    in_ego = exact_drive.truth.lidar.spec.mount.apply(frame.points.positions)
    world = np.einsum("nij,nj->ni", states.rotations, in_ego) + states.positions
    np.testing.assert_allclose(world, clean.positions_world, atol=2 * FLOAT32)
    source = PoseSource(exact_drive.scene.trajectories["groundTruth"].poses, lidar.mount)
    world, extrapolated = points_to_world(frame, source)
    assert not extrapolated
    # The trajectory is sampled at 100 Hz: 0.1 mm and 1e-5 rad, which is 1 mm at 100 m.
    assert np.linalg.norm(world - clean.positions_world, axis=1).max() < 1.2e-3
    frozen = replace(frame, points=replace(frame.points, timestamps_ns=np.full(len(frame.points), frame.timestamp_ns)))
    skewed = np.linalg.norm(points_to_world(frozen, source)[0] - clean.positions_world, axis=1)
    speed = np.linalg.norm(exact_drive.truth.path.at(np.array([frame.timestamp_ns])).velocities)
    assert skewed.max() > max(0.8 * speed * PERIOD_NS * 1e-9, 0.3)


SMALL = Raster(azimuth_deg=(-50, 50), elevation_deg=(-10, 8), rows=7, columns=10, channels=4, interleave=3)


def lidar_before_wall(pattern, **options):
    """A solid-state lidar 10 m before a wall that fills its view, above the ground, stationary."""
    street = street_of([box([11, 0, 30], [1, 80, 30])])
    spec = SolidStateSpec(pattern, mount=UPRIGHT, **{"range_sigma": 0.0, "drop_rate": 0.0, **options})
    return ScanningLidar(spec, street, STILL, 1, 0, 70_000_000 + PERIOD_NS * np.arange(4, dtype=np.int64))


def test_every_shot_ends_on_the_wall_or_on_the_ground_at_moments_spread_evenly_over_the_frame():
    for pattern in [SMALL, Raster(), Rosette()]:
        positions = lidar_before_wall(pattern).frame(1).points.positions.astype(np.float64)
        from_ground, from_wall = np.abs(positions[:, 2] + 1.5), np.abs(positions[:, 0] - 10.0)
        np.testing.assert_allclose(np.minimum(from_ground, from_wall), 0.0, atol=FLOAT32)
        assert 0.02 < (from_ground < from_wall).mean() < 0.6
    for pattern, expected in (
        (SMALL, np.repeat([k * PERIOD_NS // 70 for k in range(70)], 4)), (Rosette(), 10_000 * np.arange(10_000)),
    ):  # fmt: skip
        frame = lidar_before_wall(pattern).frame(2)
        assert frame.timestamp_ns == 70_000_000 + 2 * PERIOD_NS
        np.testing.assert_array_equal(frame.points.timestamps_ns - frame.timestamp_ns, expected)
        assert frame.points.timestamps_ns.dtype == np.int64
        rings = frame.points.rings
        assert (None if rings is None else rings.dtype) == (np.uint16 if pattern is SMALL else None)


def test_rasters_shoot_as_packets_hold_in_passes_from_the_top_and_rosettes_as_two_prisms_bend():
    shots = SolidStateSpec().plan_shots()(0)
    packets, moments_in_packet, channels = 630, 25, 5
    assert len(shots.moments) == packets * moments_in_packet * channels
    assert len(shots.offsets_ns) == packets * moments_in_packet
    azimuths, elevations = angles(shots.rays.spread())
    assert azimuths.max() - azimuths.min() == pytest.approx(120.0, abs=0.3)
    assert (elevations.min(), elevations.max()) == pytest.approx((-12.5, 12.5))
    shots = lidar_before_wall(SMALL).shots(0)
    azimuths, elevations = angles(shots.rays.spread())
    np.testing.assert_allclose(elevations, -10.0 + 3.0 * shots.rings, atol=1e-9)
    row_of_sweep = shots.rings.reshape(7, 40)
    assert (row_of_sweep == row_of_sweep[:, :1]).all()
    # Rows 0, 3, 6 from the top, then 1, 4, then 2, 5; counted from the lowest.
    assert row_of_sweep[:, 0].tolist() == [6, 3, 0, 5, 2, 4, 1]
    # 40 cells of 2.5 degrees from 50 degrees left; a channel is ten wide.
    expected = 48.75 - 2.5 * (np.arange(10)[:, None] + 10 * np.arange(4))
    for row, cells in ((0, expected), (1, expected[::-1]), (6, expected)):
        np.testing.assert_allclose(azimuths.reshape(7, 10, 4)[row], cells, atol=1e-9)
    pattern = Rosette(fov_deg=40.0, shots_per_second=20_000.0, rotations_per_minute=(6000.0, -1700.0), share=0.6)
    lidar = lidar_before_wall(pattern)
    for k in (0, 3):
        directions = lidar.shots(k).rays.spread()
        for shot in (0, 1, 17, 999, 1999):
            seconds = k * 0.1 + shot / 20_000.0
            first, second = (cmath.exp(2j * math.pi * turns / 60.0 * seconds) for turns in (6000.0, -1700.0))
            bend = math.radians(20.0) * (0.6 * first + 0.4 * second)
            aside = cmath.rect(math.sin(abs(bend)), cmath.phase(bend))
            # Times are whole nanoseconds: 6e-7 rad of the faster prism.
            np.testing.assert_allclose(directions[shot], [math.cos(abs(bend)), aside.real, aside.imag], atol=1e-6)
    plan = Rosette().plan_shots(PERIOD_NS)
    directions = [plan(k * PERIOD_NS).rays.spread() for k in range(12)]
    off_axis = np.degrees(np.arccos(directions[0][:, 0]))
    assert off_axis.max() == pytest.approx(19.2, abs=0.01)
    assert off_axis.min() < 0.2
    np.testing.assert_allclose(np.linalg.norm(directions[0], axis=1), 1.0, atol=1e-12)
    one, four, twelve = (
        len(np.unique(np.floor(np.concatenate(directions[:count])[:, 1:] * 100), axis=0)) for count in (1, 4, 12)
    )
    assert one < 0.75 * four
    # A disc of radius sin 19.2° holds 3400 cells of 0.01 x 0.01.
    assert twelve > 0.95 * 3400 > four


RADAR_EXACT = RadarSpec(
    mount=sensor_mount(position=(3.0, 1.0, 0.7), yaw_deg=20.0),
    range_sigma=0.0, azimuth_sigma_deg=0.0, elevation_sigma_deg=0.0, speed_sigma=0.0, false_alarms=0.0,
)  # fmt: skip
SPEED = 8.0
MOVING = path_at_speed(SPEED)


@pytest.fixture(scope="module")
def radar_of():
    """A radar on an ego at 8 m/s that drives towards a wall 60 m ahead."""
    wall = street_of([box([61, 0, 20], [1, 200, 20])], MOVING)

    def make(spec, *, seed=0, number=0):
        return SimulatedRadar(spec, wall, MOVING, seed, number, spec.period_ns * np.arange(20, dtype=np.int64))

    return make


@pytest.fixture(scope="module")
def radar_drive():
    """A drive with rotations and two radars, one exact."""
    radars = (RADAR_EXACT, RadarSpec())
    return simulate_street(7, frames=20, lidar=LidarSpec(beams=1, steps=1), cameras=(), radars=radars)


def test_a_wall_ahead_comes_nearer_at_the_speed_of_the_drive_by_as_many_returns_as_asked_for(radar_of):
    radar = radar_of(replace(RADAR_EXACT, mount=sensor_mount(position=(0, 0, 1.0)), detections_per_object=300.0))
    points, truth = radar.frame(2).points, radar.frame_truth(2)
    on_wall, ground = truth.instances == 1, truth.instances == 0
    assert on_wall.sum() > 200
    positions = points.positions[on_wall].astype(np.float64)
    # The ego has driven 0.1 s.
    np.testing.assert_allclose(positions[:, 0], 60.0 - 0.1 * SPEED, atol=1e-4)
    np.testing.assert_allclose(points.lengths[on_wall], -SPEED * unit(positions)[:, 0], atol=1e-5)
    np.testing.assert_allclose(truth.ground_speeds, 0.0, atol=1e-12)
    assert ground.any()
    np.testing.assert_allclose(points.positions[ground, 2], -1.0, atol=1e-5)
    spec = replace(RADAR_EXACT, detections_per_object=0.0, ground_clutter=0.0, false_alarms=25.0, max_range=80.0)
    radar = radar_of(spec)
    frames = [radar.frame(k).points for k in range(20)]
    # Twenty Poisson numbers of mean 25 add up to 500 with a deviation of 22; five times that.
    assert sum(map(len, frames)) == pytest.approx(500, abs=112)
    assert max(ranges_of(points).max() for points in frames) <= 80.0 + 1e-4
    azimuths, elevations = angles(np.concatenate([points.positions for points in frames]))
    assert np.abs(azimuths).max() <= 60.0 + 1e-4
    assert np.abs(elevations).max() <= 10.0 + 1e-4
    assert (radar.frame_truth(0).instances == FALSE_ALARM).all()
    assert not radar.frame_truth(0).real.any()
    # each thing gives as many returns as asked for
    radar = radar_of(replace(RADAR_EXACT, detections_per_object=40.0, ground_clutter=10.0))
    instances = np.concatenate([radar.frame_truth(k).instances for k in range(20)])
    # Poisson totals 800 and 200: deviations 28 and 14; five times those.
    assert (instances == 1).sum() == pytest.approx(800, abs=142)
    assert (instances == 0).sum() == pytest.approx(200, abs=71)


@pytest.fixture(scope="module")
def passing():
    """A radar on an ego at 8 m/s; a car-sized box ahead moves at (-3, 2) m/s and rotates by 0.5 rad/s."""
    seconds = 0.5 * np.arange(-10.0, 20.0)
    curve = np.column_stack([40.0 - 3.0 * seconds, -2.0 + 2.0 * seconds, 0.5 * seconds, np.zeros(30)])
    car = MovingDesign("car", (Part((box([0.0, 0.0, 0.8], [2.2, 0.9, 0.8]),)),), (4.4, 1.8, 1.6))
    street = street_of(path=MOVING, movers=moving([car], [curve]))
    spec = replace(RADAR_EXACT, detections_per_object=30.0, ground_clutter=5.0)
    return SimulatedRadar(spec, street, MOVING, 0, 0, PERIOD_NS * np.arange(15, dtype=np.int64))


def test_radial_speeds_are_the_change_of_ranges_in_rotations_too_and_of_what_moves(passing, radar_drive):
    step, found = 1e-3, 0
    for k in range(15):
        truth = passing.frame_truth(k)
        own, now = truth.positions_world[truth.instances == 1], truth.timestamp_ns * 1e-9
        center = np.array([40.0 - 3.0 * now, -2.0 + 2.0 * now, 0.0])
        ranges = []
        for away in (-step, step):
            moved = in_box_axes(own, center, -0.5 * away) + center + away * np.array([-3.0, 2.0, 0.0])
            ranges.append(np.linalg.norm(moved - [SPEED * (now + away) + 3.0, 1.0, 0.7], axis=1))
        # Of the central difference over 1 ms: below 1e-6 m/s beyond 5 m.
        speeds = (ranges[1] - ranges[0]) / (2 * step)
        np.testing.assert_allclose(truth.speeds[truth.instances == 1], speeds, atol=1e-5)
        np.testing.assert_allclose(truth.ground_speeds[truth.instances == 0], 0.0, atol=1e-12)
        found += len(own)
    assert found > 150
    # the part of the speed over ground is that of the target
    truth = passing.frame_truth(0)
    car = truth.instances == 1
    away = truth.positions_world[car] - [40.0, -2.0, 0.0]
    velocities = np.array([-3.0, 2.0, 0.0]) + np.cross([0.0, 0.0, 0.5], away)
    along = (velocities * passing.pose(0).rotate(truth.directions[car])).sum(axis=1)
    np.testing.assert_allclose(truth.ground_speeds[car], along, atol=1e-9)
    assert np.abs(along).min() > 0.5
    radar, path, step_ns = radar_drive.truth.radars["radar0"], radar_drive.truth.path, 1_000_000
    rotating = 0
    for k in range(0, len(radar.timestamps_ns), 3):
        truth = radar.frame_truth(k)
        ego = path.at(truth.timestamp_ns + np.array([-step_ns, step_ns], np.int64))
        origins = ego.positions + Rotation.from_matrix(ego.rotations).apply(radar.spec.mount.translation.copy())
        before, after = (np.linalg.norm(truth.positions_world - origin, axis=1) for origin in origins)
        # Of the central difference over 1 ms: error h² / 6 times the third derivative, 1e-4 m/s at 3 m and 10 m/s.
        np.testing.assert_allclose(truth.speeds, (after - before) / (2e-9 * step_ns), atol=2e-4)
        rotating += abs(ego.angular_rates[0, 2]) > 0.15
        assert len(truth.speeds) > 20
    assert rotating > 2
    # over ground of what stands nothing is left after taking the radar's own away
    radar = radar_drive.truth.radars["radar0"]
    for k in (3, 17, 33):
        points = radar.frame(k).points
        in_radar = radar.pose(k).rotation.T @ radar.velocity_world(k)
        np.testing.assert_allclose(points.lengths + points.directions @ in_radar, 0.0, atol=1e-5)
        assert np.abs(points.lengths).max() > 3.0


def test_returns_come_from_the_things_that_they_name_by_range_in_the_radars_frame_and_within_the_bounds(radar_drive):
    things, seen = {thing.instance: thing for thing in radar_drive.truth.objects}, set()
    for k in range(0, 40, 5):
        truth = radar_drive.truth.radars["radar0"].frame_truth(k)
        np.testing.assert_allclose(truth.positions_world[truth.instances == 0, 2], 0.0, atol=1e-9)
        for instance in set(truth.instances.tolist()) - {0}:
            thing, own = things[instance], truth.positions_world[truth.instances == instance]
            away = in_box_axes(own, thing.center_world, thing.yaw)
            assert (np.abs(away) <= np.array(thing.size_lwh) / 2 + 1e-3).all()
            seen.add(thing.label)
    assert {"car", "building", "pole"} <= seen
    # nothing comes back from nearer or farther than the bounds
    truth = radar_drive.truth
    spec = replace(RADAR_EXACT, min_range=12.0, max_range=30.0, detections_per_object=20.0)
    radar = SimulatedRadar(spec, truth.street, truth.path, 0, 0, truth.radars["radar0"].timestamps_ns)
    ranges = np.concatenate([radar.frame_truth(k).ranges for k in range(0, 40, 8)])
    assert len(ranges) > 100
    assert 12.0 <= ranges.min() < ranges.max() <= 30.0
    truth, sensor = radar_drive.truth.radars["radar0"].frame_truth(5), radar_drive.scene.sensor("radar0")
    frame = sensor.frames[5]
    points = frame.points
    assert (sensor.type, sensor.points_frame) == (SensorType.RADAR, PointsFrame.SENSOR)
    ego = radar_drive.truth.path.at(np.array([frame.timestamp_ns]))
    world = Rotation.from_matrix(ego.rotations[0]).apply(sensor.mount.apply(points.positions)) + ego.positions[0]
    # float32 holds 150 m in steps of 1.5e-5 m.
    np.testing.assert_allclose(world, truth.positions_world, atol=3e-5)
    np.testing.assert_array_equal(points.timestamps_ns, frame.timestamp_ns)
    np.testing.assert_allclose(np.linalg.norm(points.directions, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(points.directions * ranges_of(points)[:, None], points.positions, atol=3e-5)
    for name in ("radar0", "radar1"):
        ranges = ranges_of(radar_drive.scene.sensor(name).frames[4].points)
        assert (np.diff(ranges) > -1e-5).all()
        assert len(ranges) > 20
    mount = sensor_mount(position=(1.0, 2.0, 3.0), yaw_deg=90.0)
    np.testing.assert_allclose(mount.apply([1.0, 0.0, 0.0]), [1.0, 3.0, 3.0], atol=1e-15)
    down = sensor_mount(position=(0.0, 0.0, 0.0), pitch_deg=30.0)
    np.testing.assert_allclose(down.rotate([1.0, 0.0, 0.0]), [math.sqrt(0.75), 0.0, -0.5], atol=1e-15)


@pytest.mark.slow
def test_noise_has_the_deviations_that_were_asked_for(radar_drive):
    radar, errors = radar_drive.truth.radars["radar1"], []
    for k in range(40):
        points, truth = radar.frame(k).points, radar.frame_truth(k)
        real = truth.real
        off_angles = np.subtract(angles(points.directions[real]), angles(truth.directions[real]))
        off_ranges, off_speeds = ranges_of(points)[real] - truth.ranges[real], points.lengths[real] - truth.speeds[real]
        errors.append(np.column_stack([off_ranges, *off_angles, off_speeds]))
    errors = np.concatenate(errors)
    assert len(errors) > 2000
    # Two thousand values know a deviation to 1.6 % and a mean to 2.2 % of it; five times that.
    np.testing.assert_allclose(errors.std(axis=0), [0.12, 0.4, 1.0, 0.08], rtol=0.08)
    assert (np.abs(errors.mean(axis=0)) < 0.11 * errors.std(axis=0)).all()
    assert np.abs(np.corrcoef(errors.T) - np.eye(4)).max() < 0.11


def test_noise_has_the_deviations_asked_for_and_false_returns_no_other_truth_than_what_is_reported(radar_of):
    radar = radar_of(RadarSpec(false_alarms=30.0, detections_per_object=5.0))
    points, truth = radar.frame(1).points, radar.frame_truth(1)
    false = ~truth.real
    assert false.sum() > 10
    # float32 holds 150 m in steps of 1.5e-5 m.
    for found, expected, atol in (
        (points.lengths, truth.speeds, 1e-5),
        (points.directions, truth.directions, 1e-6),
        (ranges_of(points), truth.ranges, 3e-5),
        (radar.pose(1).apply(points.positions), truth.positions_world, 3e-5),
    ):
        np.testing.assert_allclose(found[false], expected[false], atol=atol)
