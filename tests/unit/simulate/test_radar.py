from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import PointsFrame, SensorType
from sceneloom.simulate import LidarSpec, RadarSpec, sensor_mount, simulate_street
from sceneloom.simulate.lidar_radar import FALSE_ALARM, SimulatedRadar
from sceneloom.simulate.objects import Mover, MovingDesign, PackedShapes, Part, Shape, ShapeKind, pack_movers
from sceneloom.simulate.street import GroundMap, Lane, Street
from sceneloom.simulate.trajectory import EgoPath

EXACT = RadarSpec(
    mount=sensor_mount(position=(3.0, 1.0, 0.7), yaw_deg=20.0),
    range_sigma=0.0,
    azimuth_sigma_deg=0.0,
    elevation_sigma_deg=0.0,
    speed_sigma=0.0,
    false_alarms=0.0,
)
SPEED = 8.0


@pytest.fixture(scope="module")
def moving_path():
    """An ego that drives along x at 8 m/s, at the origin at time zero."""
    along = SPEED * (np.arange(40) - 20.0)
    path = EgoPath(0, -17.0, np.column_stack([along, np.zeros(40)]), np.zeros((3, 1, 3)))
    shift = path.at_seconds(np.zeros(1)).positions[0, :2]
    return replace(path, control_points=path.control_points - shift)


@pytest.fixture(scope="module")
def wall(street_of, moving_path, box):
    return street_of([box([61, 0, 20], [1, 200, 20])], moving_path)


@pytest.fixture(scope="module")
def radar_of(wall, moving_path):
    def make(spec, *, seed=0, number=0):
        times = spec.period_ns * np.arange(20, dtype=np.int64)
        return SimulatedRadar(spec, wall, moving_path, seed, number, times)

    return make


@pytest.fixture(scope="module")
def radar_drive():
    """A drive with rotates and two radars, one exact."""
    return simulate_street(
        7, frames=20, lidar=LidarSpec(beams=1, steps=1), cameras=(), radars=(EXACT, RadarSpec())
    )


def test_a_wall_ahead_comes_nearer_at_the_speed_of_the_drive(radar_of):
    many = replace(EXACT, mount=sensor_mount(position=(0, 0, 1.0)), detections_per_object=300.0)
    radar = radar_of(many)
    points, truth = radar.frame(2).points, radar.frame_truth(2)
    on_wall = truth.instances == 1
    assert on_wall.sum() > 200
    positions = points.positions[on_wall].astype(np.float64)
    # The wall's face is at 60 m, the ego has driven 0.1 s.
    np.testing.assert_allclose(positions[:, 0], 60.0 - 0.1 * SPEED, atol=1e-4)
    cosines = positions[:, 0] / np.linalg.norm(positions, axis=1)
    np.testing.assert_allclose(points.lengths[on_wall], -SPEED * cosines, atol=1e-5)
    np.testing.assert_allclose(truth.ground_speeds, 0.0, atol=1e-12)
    ground = truth.instances == 0
    assert ground.any()
    np.testing.assert_allclose(points.positions[ground, 2], -1.0, atol=1e-5)


def test_speeds_are_the_change_of_the_ranges_in_rotations_too_with_the_lever_arm(radar_drive):
    radar, step_ns = radar_drive.truth.radars["radar0"], 1_000_000
    mount, path = radar.spec.mount, radar_drive.truth.path
    rotating = 0
    for k in range(0, len(radar.timestamps_ns), 3):
        truth = radar.frame_truth(k)
        around = truth.timestamp_ns + np.array([-step_ns, step_ns], np.int64)
        ego = path.at(around)
        rotated = Rotation.from_matrix(ego.rotations).apply(mount.translation.copy())
        before, after = ego.positions + rotated
        ranges = [np.linalg.norm(truth.positions_world - origin, axis=1) for origin in (before, after)]
        # Of the central difference over 1 ms: error h² / 6 times the third derivative, 1e-4 m/s at 3 m and 10 m/s.
        np.testing.assert_allclose(truth.speeds, (ranges[1] - ranges[0]) / (2e-9 * step_ns), atol=2e-4)
        rotating += abs(ego.angular_rates[0, 2]) > 0.15
        assert len(truth.speeds) > 20
    assert rotating > 2


@pytest.fixture(scope="module")
def passing(moving_path, box):
    """A radar on an ego at 8 m/s; a car-sized box ahead moves at (-3, 2) m/s and rotates by 0.5 rad/s."""
    body = box([0.0, 0.0, 0.8], [2.2, 0.9, 0.8])
    body = Shape(
        ShapeKind.BOX, RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.8])), body.half, body.material
    )
    seconds = 0.5 * np.arange(-10.0, 20.0)
    curve = np.column_stack([40.0 - 3.0 * seconds, -2.0 + 2.0 * seconds, 0.5 * seconds, np.zeros(30)])
    size = (4.4, 1.8, 1.6)
    movers = pack_movers(
        [Mover(1, "car", size, -(10**10), 10**10, stands=False)],
        [MovingDesign("car", (Part((body,)),), size)],
        curve[None],
        start_ns=0,
        first_knot=-4.0,
        knot_step=0.5,
    )
    ground = GroundMap.of(Lane.of(moving_path))
    street = Street((), PackedShapes.of([], []), ground, movers)
    spec = replace(EXACT, detections_per_object=30.0, ground_clutter=5.0)
    return SimulatedRadar(spec, street, moving_path, 0, 0, 100_000_000 * np.arange(15, dtype=np.int64))


def test_what_moves_has_the_radial_speed_of_its_own_motion_against_the_radars(passing):
    nanosecond, step = 1e-9, 1_000_000
    found = 0
    for k in range(15):
        truth = passing.frame_truth(k)
        own = truth.positions_world[truth.instances == 1]
        middle = truth.timestamp_ns * nanosecond
        ranges = []
        for moment in (-step * nanosecond, step * nanosecond):
            rotated = Rotation.from_euler("z", 0.5 * moment)
            center = np.array([40.0, -2.0, 0.0]) + (middle + moment) * np.array([-3.0, 2.0, 0.0])
            before = np.array([40.0, -2.0, 0.0]) + middle * np.array([-3.0, 2.0, 0.0])
            moved = rotated.apply(own - before) + center if len(own) else own
            radar = [SPEED * (middle + moment) + 3.0, 1.0, 0.7]
            ranges.append(np.linalg.norm(moved - radar, axis=1))
        speeds = (ranges[1] - ranges[0]) / (2 * step * nanosecond)
        # Of the central difference over 1 ms: below 1e-6 m/s beyond 5 m.
        np.testing.assert_allclose(truth.speeds[truth.instances == 1], speeds, atol=1e-5)
        ground = truth.instances == 0
        np.testing.assert_allclose(truth.ground_speeds[ground], 0.0, atol=1e-12)
        found += len(own)
    assert found > 150


def test_the_part_of_the_speed_over_ground_is_that_of_the_target(passing):
    truth = passing.frame_truth(0)
    car = truth.instances == 1
    in_world = passing.pose(0).rotate(truth.directions[car])
    away = truth.positions_world[car] - [40.0, -2.0, 0.0]
    velocities = np.array([-3.0, 2.0, 0.0]) + np.cross([0.0, 0.0, 0.5], away)
    np.testing.assert_allclose(truth.ground_speeds[car], (velocities * in_world).sum(axis=1), atol=1e-9)
    assert np.abs(truth.ground_speeds[car]).min() > 0.5


def test_positions_in_the_radars_frame_are_those_in_the_world(radar_drive):
    truth = radar_drive.truth.radars["radar0"].frame_truth(5)
    sensor = radar_drive.scene.sensor("radar0")
    frame = sensor.frames[5]
    assert sensor.type is SensorType.RADAR
    assert sensor.points_frame is PointsFrame.SENSOR
    ego = radar_drive.truth.path.at(np.array([frame.timestamp_ns]))
    rotation = Rotation.from_matrix(ego.rotations[0])
    in_ego = sensor.mount.apply(frame.points.positions)
    # float32 holds 150 m in steps of 1.5e-5 m.
    np.testing.assert_allclose(rotation.apply(in_ego) + ego.positions[0], truth.positions_world, atol=3e-5)
    np.testing.assert_array_equal(frame.points.timestamps_ns, frame.timestamp_ns)
    np.testing.assert_allclose(np.linalg.norm(frame.points.directions, axis=1), 1.0, atol=1e-6)
    ranges = np.linalg.norm(frame.points.positions, axis=1)
    np.testing.assert_allclose(frame.points.directions * ranges[:, None], frame.points.positions, atol=3e-5)


def test_returns_come_from_the_things_that_they_name(radar_drive):
    things = {thing.instance: thing for thing in radar_drive.truth.objects}
    seen = set()
    for k in range(0, 40, 5):
        truth = radar_drive.truth.radars["radar0"].frame_truth(k)
        np.testing.assert_allclose(truth.positions_world[truth.instances == 0, 2], 0.0, atol=1e-9)
        for instance, position in zip(truth.instances.tolist(), truth.positions_world, strict=True):
            if instance == 0:
                continue
            thing = things[instance]
            away = Rotation.from_euler("z", thing.yaw).inv().apply(position - thing.center_world)
            assert (np.abs(away) <= np.array(thing.size_lwh) / 2 + 1e-3).all()
            seen.add(thing.label)
    assert {"car", "building", "pole"} <= seen


@pytest.mark.slow
def test_noise_has_the_deviations_that_were_asked_for(radar_drive):
    radar = radar_drive.truth.radars["radar1"]
    errors = []
    for k in range(40):
        points, truth = radar.frame(k).points, radar.frame_truth(k)
        real = truth.real
        ranges = np.linalg.norm(points.positions[real].astype(np.float64), axis=1)
        measured, true = points.directions[real].astype(np.float64), truth.directions[real]
        azimuths = [np.degrees(np.arctan2(d[:, 1], d[:, 0])) for d in (measured, true)]
        elevations = [np.degrees(np.arcsin(d[:, 2].clip(-1, 1))) for d in (measured, true)]
        errors.append(
            np.column_stack(
                [
                    ranges - truth.ranges[real],
                    np.subtract(*azimuths),
                    np.subtract(*elevations),
                    points.lengths[real] - truth.speeds[real],
                ]
            )
        )
    errors = np.concatenate(errors)
    assert len(errors) > 2000
    # Two thousand values know a deviation to 1.6 % and a mean to 2.2 % of it; five times that.
    np.testing.assert_allclose(errors.std(axis=0), [0.12, 0.4, 1.0, 0.08], rtol=0.08)
    assert (np.abs(errors.mean(axis=0)) < 0.11 * errors.std(axis=0)).all()
    assert np.abs(np.corrcoef(errors.T) - np.eye(4)).max() < 0.11


def test_speed_over_ground_of_what_stands_is_nothing_after_taking_the_radars_own_away(radar_drive):
    radar = radar_drive.truth.radars["radar0"]
    for k in (3, 17, 33):
        points = radar.frame(k).points
        in_radar = radar.pose(k).rotation.T @ radar.velocity_world(k)
        np.testing.assert_allclose(points.lengths + points.directions @ in_radar, 0.0, atol=1e-5)
        assert np.abs(points.lengths).max() > 3.0


def test_as_many_false_returns_as_asked_for_lie_in_the_field_of_view(radar_of):
    spec = replace(EXACT, detections_per_object=0.0, ground_clutter=0.0, false_alarms=25.0, max_range=80.0)
    radar = radar_of(spec)
    frames = [radar.frame(k).points for k in range(20)]
    # Twenty Poisson numbers of mean 25 add up to 500 with a deviation of 22; five times that.
    assert sum(map(len, frames)) == pytest.approx(500, abs=112)
    positions = np.concatenate([points.positions for points in frames])
    ranges = np.linalg.norm(positions, axis=1)
    assert ranges.max() <= 80.0 + 1e-4
    assert np.abs(np.degrees(np.arctan2(positions[:, 1], positions[:, 0]))).max() <= 60.0 + 1e-4
    assert np.abs(np.degrees(np.arcsin(positions[:, 2] / ranges))).max() <= 10.0 + 1e-4
    assert (radar.frame_truth(0).instances == FALSE_ALARM).all()
    assert not radar.frame_truth(0).real.any()


def test_false_returns_have_no_other_truth_than_what_is_reported(radar_of):
    radar = radar_of(RadarSpec(false_alarms=30.0, detections_per_object=5.0))
    points, truth = radar.frame(1).points, radar.frame_truth(1)
    false = ~truth.real
    assert false.sum() > 10
    # float32 holds 150 m in steps of 1.5e-5 m.
    np.testing.assert_allclose(points.lengths[false], truth.speeds[false], atol=1e-5)
    np.testing.assert_allclose(points.directions[false], truth.directions[false], atol=1e-6)
    ranges = np.linalg.norm(points.positions[false], axis=1)
    np.testing.assert_allclose(ranges, truth.ranges[false], atol=3e-5)
    world = radar.pose(1).apply(points.positions[false])
    np.testing.assert_allclose(world, truth.positions_world[false], atol=3e-5)


def test_returns_come_by_their_range_so_that_their_order_states_nothing(radar_drive):
    for name in ("radar0", "radar1"):
        points = radar_drive.scene.sensor(name).frames[4].points
        ranges = np.linalg.norm(points.positions.astype(np.float64), axis=1)
        assert (np.diff(ranges) > -1e-5).all()
        assert len(ranges) > 20


def test_each_thing_gives_as_many_returns_as_asked_for_on_average(radar_of):
    spec = replace(EXACT, detections_per_object=40.0, ground_clutter=10.0)
    instances = np.concatenate([radar_of(spec).frame_truth(k).instances for k in range(20)])
    # Poisson totals 800 and 200: deviations 28 and 14; five times those.
    assert (instances == 1).sum() == pytest.approx(800, abs=142)
    assert (instances == 0).sum() == pytest.approx(200, abs=71)


def test_nothing_comes_back_from_nearer_or_farther_than_the_bounds(radar_drive):
    truth = radar_drive.truth
    spec = replace(EXACT, min_range=12.0, max_range=30.0, detections_per_object=20.0)
    radar = SimulatedRadar(spec, truth.street, truth.path, 0, 0, truth.radars["radar0"].timestamps_ns)
    ranges = np.concatenate([radar.frame_truth(k).ranges for k in range(0, 40, 8)])
    assert len(ranges) > 100
    assert 12.0 <= ranges.min() < ranges.max() <= 30.0


def test_frames_repeat_exactly_and_differ_between_times_seeds_and_radars(radar_of):
    spec = RadarSpec(detections_per_object=30.0)
    first, again = radar_of(spec), radar_of(spec)
    later = first.frame(7).points
    again.frame(2)
    for name in ("positions", "directions", "lengths", "timestamps_ns"):
        np.testing.assert_array_equal(getattr(again.frame(7).points, name), getattr(later, name))
        assert not getattr(later, name).flags.writeable
    others = [first.frame(8), radar_of(spec, seed=1).frame(7), radar_of(spec, number=1).frame(7)]
    for other in others:
        assert not np.array_equal(other.points.lengths[:10], later.lengths[:10])


@pytest.mark.parametrize(
    "wrong",
    [
        {"period_ns": 0},
        {"offset_ns": 50_000_000},
        {"azimuth_deg": (5.0, 5.0)},
        {"elevation_deg": (-95.0, 0.0)},
        {"speed_sigma": float("nan")},
        {"false_alarms": -1.0},
        {"min_range": 500.0},
    ],
)
def test_radars_that_cannot_be_are_refused_by_name(wrong):
    with pytest.raises(OptionError, match="|".join(wrong)):
        RadarSpec(**wrong)
