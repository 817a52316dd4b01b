"""What stands and what moves in a street and what rays meet there, against walks that know no frames and no balls."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numba import njit
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, LidarSpec, PathSpec, Stop, TrafficSpec, camera_mount, simulate_street
from sceneloom.simulate import street as streets
from sceneloom.simulate.camera import RenderedCamera
from sceneloom.simulate.casting import Rays, _band, _bands, _noise, bundles_by_direction, cast, instances_of, paint
from sceneloom.simulate.lidar_radar import reflectivities_of
from sceneloom.simulate.street import Lane, Material, Pattern, Shape, ShapeKind

from . import scenery
from .scenery import EXACT, GROUND, PLAIN, SKY, box, first_hit, in_box_axes, moving, street_of, surface_points, unit


@pytest.fixture(scope="module", params=[0, 1, 2])
def built(request):
    path = PathSpec().plan(np.random.default_rng(request.param), start_ns=0, duration=15.0)
    return path, streets.Street.of(path, np.random.default_rng(100 + request.param))


@pytest.mark.few(1)
def test_nothing_stands_in_the_ego_trajectory(built):
    path, street = built
    states = path.at_seconds(np.arange(-1.0, 16.0, 0.1))
    swept = [
        states.positions + across * states.rotations[:, :, 1] + [0, 0, height]
        for across in np.linspace(-1.1, 1.1, 5)
        for height in (0.1, 0.6, 1.2, 1.8, 2.2)
    ]
    assert not scenery.instances_inside(street.shapes, np.concatenate(swept)).any()


def test_shapes_lie_in_the_boxes_and_balls_of_their_objects_and_solid_ones_not_in_one_another(built):
    packed, objects = built[1].shapes, built[1].objects
    samples = surface_points(np.random.default_rng(0), 400)
    for k in range(len(packed)):
        thing = objects[packed.instances[k] - 1]
        world_from_unit = np.linalg.inv(np.vstack([packed.maps[k], [0, 0, 0, 1]]))
        world = samples[streets.ShapeKind(packed.kinds[k])] @ world_from_unit[:3, :3].T + world_from_unit[:3, 3]
        local = in_box_axes(world, thing.center_world, thing.yaw)
        assert (np.abs(local) <= np.array(thing.size_lwh) / 2 + 1e-9).all(), thing.label
        assert np.linalg.norm(world - packed.spheres[k, :3], axis=1).max() <= packed.spheres[k, 3] + 1e-9
    objects = built[1].objects
    assert {thing.label for thing in objects} == {"building", "car", "tree", "pole", "bin", "barrier"}
    assert np.unique(built[1].shapes.kinds).tolist() == [0, 1, 2, 3]
    assert [thing.instance for thing in objects] == list(range(1, len(objects) + 1))
    solid = [thing for thing in built[1].objects if thing.label in {"building", "car", "bin", "barrier"}]
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 9), 0), -1).reshape(-1, 3)
    for a, b in combinations(solid, 2):
        apart = np.hypot(*np.subtract(a.center_world[:2], b.center_world[:2]))
        if apart <= np.hypot(*a.size_lwh[:2]) / 2 + np.hypot(*b.size_lwh[:2]) / 2:
            plan = Rotation.from_euler("z", a.yaw).apply(grid * a.size_lwh) + a.center_world
            local = in_box_axes(plan, b.center_world, b.yaw)[:, :2]
            assert not (np.abs(local) < np.array(b.size_lwh[:2]) / 2).all(axis=1).any()


def test_the_map_of_the_ground_knows_how_far_along_and_left_its_nodes_lie_and_streets_are_those_of_their_seed():
    lane = streets.Lane.of(PathSpec().plan(np.random.default_rng(3), start_ns=0, duration=10.0))
    ground = streets.GroundMap.of(lane)
    along, left = ground.nodes[..., 0], ground.nodes[..., 1]
    drawn = np.argwhere((np.abs(left) < 10.0) & (along > lane.along[0] + 1) & (along < lane.along[-1] - 1))
    for i, j in drawn[np.random.default_rng(0).choice(len(drawn), 500, replace=False)]:
        spot = lane.location(*map(float, ground.nodes[i, j, :2]))[:2]
        # Points of the lane are 25 cm apart; between them a bend of 15 m leaves its chord by 0.5 mm, and ten metres
        # to its side the rounding of the heading between them counts as millimetres.
        assert np.hypot(*(spot - ground.corner - ground.cell * np.array([i, j]))) < 0.02
    # Far from the trajectory there is only grass.
    nodes = ground.corner + ground.cell * np.argwhere(left >= 14.0)
    assert min(np.linalg.norm(lane.points - node, axis=1).min() for node in nodes[::37]) >= 13.9
    path = PathSpec().plan(np.random.default_rng(0), start_ns=0, duration=3.0)
    first, again, other = (streets.Street.of(path, np.random.default_rng(seed)) for seed in (7, 7, 8))
    assert first.objects == again.objects != other.objects
    np.testing.assert_array_equal(first.shapes.maps, again.shapes.maps)


STEP, COUNT, START_NS = 0.5, 30, 3_000_000
LAST_NS = START_NS + int(STEP * (COUNT - 6) * 1e9)


def straight_curve(start, velocity, yaw, yaw_rate, gait_rate=0.0):
    """Control points of a straight motion: a B-spline whose control points lie on a line runs along it."""
    # Control point i weighs most at knot number i - 2, and the first knot is at 0 s.
    seconds = STEP * (np.arange(COUNT) - 2.0)
    x, y = (start[axis] + velocity[axis] * seconds for axis in range(2))
    return np.column_stack([x, y, yaw + yaw_rate * seconds, gait_rate * seconds])


def movers_of(designs, curves, *, spans=None):
    spans = spans or [(START_NS, LAST_NS)] * len(designs)
    return moving(designs, curves, start_ns=START_NS, first_knot=0.0, spans=spans)


def block(half, center):
    return streets.MovingDesign("car", (streets.Part((box(center, half),)),), tuple(2.0 * np.array(half)))


DESIGNS = streets.design_pedestrian, streets.design_cyclist, streets.design_moving_car


def at(seconds):
    return np.asarray(START_NS + np.rint(np.asarray(seconds) * 1e9), np.int64)


def cast_one_by_one(street, origins, directions, seconds, reach=200.0):
    """Rays that each have an origin and a time of their own, in one bundle per direction."""
    count = len(directions)
    rays = Rays.bundled(directions, bundles_by_direction(directions, across=4), pose_of_ray=np.arange(count))
    upright, origins = np.tile(np.eye(3), (count, 1, 1)), np.broadcast_to(origins, (count, 3)).copy()
    seconds = np.broadcast_to(seconds, count)
    found = cast(street, rays, upright, origins, at(seconds), reach=reach)
    return found, paint(street, rays, upright, origins, found)


def range_to_box(center, half, yaw, origin, direction):
    """Range at which a ray enters a box rotated by yaw, by the three pairs of planes."""
    rotation = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    o, d = rotation @ (origin - center), rotation @ direction
    with np.errstate(divide="ignore"):
        low, high = (-half - o) / d, (half - o) / d
    near, far = np.minimum(low, high).max(), np.maximum(low, high).min()
    return near if 0 < near < far else np.inf


def test_a_box_that_drives_and_rotates_is_met_where_it_is_at_each_rays_time():
    half, velocity, yaw_rate = np.array([2.0, 0.9, 0.7]), np.array([-8.0, 1.5]), 0.4
    movers = movers_of([block(half, (0, 0, 0.9))], [straight_curve((60.0, -6.0), velocity, 0.3, yaw_rate)])
    street, generator = street_of(movers=movers), np.random.default_rng(0)
    # As a lidar would: 600 rays within a tenth of a second, again and again.
    for begin in (0.0, 2.0, 6.0, 9.0):
        seconds = begin + np.sort(generator.uniform(0, 0.1, 600))
        origins = np.column_stack([8.0 * seconds, 0.1 * seconds, np.full(600, 1.8)])
        centers = np.column_stack([60.0 + velocity[0] * seconds, -6.0 + velocity[1] * seconds, np.full(600, 0.9)])
        directions = unit(centers + generator.normal(0, [2.5, 1.5, 0.8], (600, 3)) - origins)
        found, _ = cast_one_by_one(street, origins, directions, seconds)
        met = 0
        for k in range(600):
            in_box = range_to_box(centers[k], half, 0.3 + yaw_rate * seconds[k], origins[k], directions[k])
            expected = min(in_box, -1.8 / directions[k, 2] if directions[k, 2] < 0 else np.inf)
            # Beyond the reach there is the sky, at range 0.
            expected = expected if expected < 200.0 else 0.0
            # A time is rounded to a nanosecond: 1e-8 m at 10 m/s.
            assert found.ranges[k] == pytest.approx(expected, abs=EXACT)
            met += in_box == expected
        assert met > 150


def slow_frames(movers, seconds):
    """World from part of every part at one time, from the definition: rotate about z, then swing about the hip."""
    states = movers.states(np.arange(len(movers)), at(np.full(len(movers), seconds)))
    for part, mover in enumerate(movers.mover_of_part):
        world = RigidTransform(Rotation.from_euler("z", states.yaws[mover]).as_matrix(), states.positions[mover])
        angle = movers.swings[part] * np.sin(states.gaits[mover] + movers.leads[part])
        # Forwards: a foot below the hip goes to positive x, which is a rotation about -y.
        swing = Rotation.from_rotvec([0, -angle, 0]).as_matrix()
        hinge = movers.hinges[part]
        yield world @ RigidTransform(swing, hinge - swing @ hinge)


def placed_shapes(movers, designs, seconds):
    parts = (part for design in designs for part in design.parts)
    return [
        (frame, shape) for frame, part in zip(slow_frames(movers, seconds), parts, strict=True) for shape in part.shapes
    ]


def test_people_and_cars_are_met_where_the_slow_walk_enters_them_and_balls_hold_their_bodies_at_all_times():
    generator = np.random.default_rng(4)
    designs = [design(generator) for design in DESIGNS]
    curves = [
        straight_curve((9.0, -2.0), (0.9, 0.6), 0.6, 0.1, gait_rate=6.0),
        straight_curve((7.0, 4.0), (4.0, -1.0), -0.2, 0.05),
        straight_curve((22.0, 2.0), (-5.0, 0.0), np.pi, -0.1),
    ]
    movers, origin, met = movers_of(designs, curves), np.array([0.0, 0, 1.7]), set()
    for seconds in (0.2, 0.9, 1.6):
        shapes = [shape.moved(frame) for frame, shape in placed_shapes(movers, designs, seconds)]
        middles = np.array([shape.pose.translation for shape in shapes])
        directions = unit(middles + generator.normal(0, 0.08, middles.shape) - origin)
        found, _ = cast_one_by_one(street_of(movers=movers), origin, directions, seconds)
        for k, direction in enumerate(directions):
            expected, index = first_hit(shapes, origin, direction, 200.0)
            assert found.ranges[k] == pytest.approx(expected, abs=EXACT)
            # Where two bodies of one person meet a ray at the same location either may be named.
            if index < 0:
                assert found.shapes[k] == index
            else:
                assert movers.shapes.instances[found.shapes[k]] == movers.shapes.instances[index]
            met.add(index)
    assert len(met) > 25
    generator = np.random.default_rng(6)
    designs = [design(generator) for design in DESIGNS]
    curves = [
        straight_curve((9.0, -2.0), (1.4, 0.6), 0.6, 0.4, gait_rate=6.0),
        straight_curve((7.0, 4.0), (5.0, -1.0), -0.2, 0.3),
        straight_curve((22.0, 2.0), (-9.0, 0.0), np.pi, -0.8),
    ]
    movers, surface = movers_of(designs, curves), surface_points(generator, 200)
    for first, last in ((2.0, 2.1), (3.0, 3.8)):
        placed = movers.placed(np.arange(3), at(np.linspace(first, last, 9)))
        assert placed.shapes.tolist() == list(range(len(movers.shapes)))
        for seconds in np.linspace(first, last, 9):
            for sphere, (frame, shape) in zip(placed.spheres, placed_shapes(movers, designs, seconds), strict=True):
                points = frame.apply(shape.pose.apply(surface[shape.kind] * shape.half))
                assert np.linalg.norm(points - sphere[:3], axis=1).max() < sphere[3] + 1e-9
    # A car's body that moves by 9 m/s for a tenth of a second needs half a metre and its rotating more, not tens.
    near = movers.placed(np.arange(3), at(np.linspace(2.0, 2.1, 9))).spheres[:, 3]
    assert (near < movers.shapes.spheres[:, 3] + 1.5).all()


def test_states_are_derivatives_of_each_other_and_points_of_legs_move_as_the_frames_of_the_legs_do():
    generator = np.random.default_rng(1)
    curves = np.cumsum(generator.normal(0, 0.4, (3, COUNT, 4)), axis=1)
    movers = movers_of([streets.design_cyclist(generator) for _ in range(3)], curves)
    which, seconds, step = generator.integers(0, 3, 100), generator.uniform(1, 11, 100), 1e-3
    before, states, after = (movers.states(which, at(seconds + shift)) for shift in (-step, 0.0, step))
    for name, rate in (("positions", "velocities"), ("yaws", "yaw_rates"), ("gaits", "gait_rates")):
        slope = (getattr(after, name) - getattr(before, name)) / (2 * step)
        # h²/6 times a third derivative below 20, and two rounded nanoseconds of 1e-3 s at 2 m/s.
        np.testing.assert_allclose(slope, getattr(states, rate), atol=1e-5)
    generator, step = np.random.default_rng(2), 1e-4
    curve = straight_curve((4.0, 1.0), (1.2, -0.3), -0.25, 0.2, gait_rate=5.0)
    movers = movers_of([streets.design_pedestrian(generator)], [curve])
    for shape in range(len(movers.shapes)):
        part = movers.part_of_shape[shape]
        for seconds in generator.uniform(1, 8, 5):
            local = generator.uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 1.6])
            before, now, after = (
                list(slow_frames(movers, seconds + shift))[part].apply(local) for shift in (-step, 0, step)
            )
            velocity = movers.point_velocities(np.array([shape]), now[None], at([seconds]))[0]
            # h²/6 times a third derivative: 0.3 rad swing of 1 m at 5 rad/s give 40, so 7e-8; a nanosecond of
            # rounding in 1e-4 s at 2 m/s is 2e-5.
            np.testing.assert_allclose(velocity, (after - before) / (2 * step), atol=5e-5)


def test_what_moves_is_met_while_it_is_there_hides_what_stands_and_is_hidden_by_it_in_the_same_light():
    still, driving = (straight_curve((x, 0.0), (v, 0.0), 0.0, 0.0) for x, v in ((10.0, 0.0), (5.0, 10.0)))
    span = (START_NS + 2_000_000_000, START_NS + 2_050_000_000)
    movers = movers_of([block((2.0, 1.0, 1.0), (0, 0, 1.0))], [still], spans=[span])
    seconds = np.array([1.0, 1.99, 2.0, 2.03, 2.05, 2.06])
    found, _ = cast_one_by_one(street_of(movers=movers), [0.0, 0, 1.0], np.tile([1.0, 0, 0], (6, 1)), seconds)
    assert found.shapes.tolist() == [SKY, SKY, 0, 0, 0, SKY]
    np.testing.assert_allclose(found.ranges, [0, 0, 8, 8, 8, 0], atol=EXACT)
    movers = movers_of([block((0.5, 1.0, 1.0), (0, 0, 1.0))], [driving])
    street = street_of([box([20, 0, 1], [1, 1, 1])], movers=movers, instances=[99])
    found, _ = cast_one_by_one(street, [0.0, 0, 1.0], np.tile([1.0, 0, 0], (2, 1)), [0.5, 2.5])
    np.testing.assert_allclose(found.ranges, [9.5, 19.0], atol=EXACT)
    assert instances_of(street, found).tolist() == [1, 99]
    # the light does not move with what moves
    design = streets.design_moving_car(np.random.default_rng(3))
    sides = []
    for yaw in (0.4, 0.4 + np.pi):
        street = street_of(movers=movers_of([design], [straight_curve((8.0, 3.0), (0.0, 0.0), yaw, 0.0)]))
        sides.append(cast_one_by_one(street, [8.0, 3.0, 10.0], np.array([[0.0, 0, -1.0]]), 0.0)[1].colors[0])
    # The roof is as light whichever way the car looks.
    np.testing.assert_allclose(*(side.astype(int) for side in sides), atol=8)
    # only those who could be near are looked at
    generator = np.random.default_rng(7)
    curves = [straight_curve((x, 0.0), (-10.0, 0.0), np.pi, 0.0) for x in (10.0, 60.0, 400.0)]
    movers = movers_of([streets.design_moving_car(generator) for _ in curves], curves)
    for times, within, near in (([0.0, 0.1], 80.0, [0, 1]), ([11.9, 12.0], 300.0, [0, 1, 2]), ([100.0], 1e4, [])):
        assert movers.near(np.zeros(3), at(times), within=within).tolist() == near


@pytest.mark.parametrize("design", DESIGNS)
def test_the_box_of_what_moves_holds_it_through_all_its_gait_and_is_no_larger(design):
    generator = np.random.default_rng(5)
    made = design(generator)
    movers = movers_of([made], [straight_curve((0.0, 0.0), (0.0, 0.0), 0.0, 0.0, gait_rate=1.0)])
    surface, reached = surface_points(generator, 3000), np.zeros(3)
    for seconds in np.linspace(0, 2 * np.pi, 25):
        for frame, shape in placed_shapes(movers, [made], seconds):
            points = frame.apply(shape.pose.apply(surface[shape.kind] * shape.half))
            reached = np.maximum(reached, np.abs(points).max(axis=0))
            assert points[:, 2].min() > -0.02
    half = np.array(made.size_lwh) / [2, 2, 1]
    assert (reached <= half + 1e-9).all()
    # 3000 points and 25 phases come within 2 cm of the furthest location; a parked car's box is 2 cm wider.
    assert (reached > half - 0.03).all()


def test_what_moves_looks_like_the_same_thing_stationary_there():
    generator = np.random.default_rng(8)
    design, seconds = streets.design_moving_car(generator), 1.3
    movers = movers_of([design], [straight_curve((9.0, 2.0), (-3.0, 1.0), 2.2, 0.3)])
    (frame,) = slow_frames(movers, seconds)
    bodies = [shape.moved(frame) for shape in design.parts[0].shapes]
    parked = street_of(bodies, instances=[1] * len(bodies))
    directions = unit(frame.translation + generator.normal(0, [1.5, 1.5, 0.5], (800, 3)) + [0, 0, 0.8 - 1.7])
    (found, first), (stationary, second) = (
        cast_one_by_one(street, [0.0, 0, 1.7], directions, seconds) for street in (street_of(movers=movers), parked)
    )
    np.testing.assert_array_equal(found.shapes, stationary.shapes)
    np.testing.assert_allclose(found.ranges, stationary.ranges, atol=EXACT)
    np.testing.assert_allclose(first.facings, second.facings, atol=1e-5)
    # A level is lost to rounding, more where a ray ends within 1e-7 m of an edge.
    difference = np.abs(first.colors.astype(int) - second.colors).max(axis=1)
    assert (found.shapes >= 0).sum() > 300
    assert (difference <= 1).mean() > 0.99


EXACT_LIDAR = LidarSpec(beams=32, steps=600, range_sigma=0.0, drop_rate=0.0)
SMALL = CameraSpec(Camera("pinhole", 320, 200, 200.0, 200.0, 159.5, 90.0), camera_mount(pitch_deg=2.0))
ROLLING = replace(SMALL, readout_ns=60_000_000, mount=camera_mount(yaw_deg=30.0))
BUSY = TrafficSpec(cars=4.0, cyclists=2.0, pedestrians=8.0)


def drive_through(traffic, *, seed=7, frames=12, cameras=(SMALL, ROLLING), **options):
    return simulate_street(seed, frames=frames, lidar=EXACT_LIDAR, cameras=cameras, traffic=traffic, **options)


@pytest.fixture(scope="module")
def busy():
    return drive_through(BUSY)


@pytest.fixture(scope="module")
def empty():
    return drive_through(None)


def states_of(truth, instances, times):
    """States of movers at a time each, the middles of their boxes, and the sizes of these."""
    which = np.asarray(instances, np.int64) - len(truth.objects) - 1
    states, sizes = truth.street.movers.states(which, times), np.array([t.size_lwh for t in truth.movers])[which]
    return states, states.positions + [0, 0, 0.5] * sizes, sizes


def outside_boxes(points, centers, yaws, sizes):
    """How far outside a box at each point's own time points are [m], at most 0 inside."""
    return (np.abs(in_box_axes(points, centers, yaws[:, None])) - sizes / 2).max(axis=1)


def test_there_is_something_of_everything_that_moves_and_traffic_changes_nothing_of_what_stands(busy, empty):
    movers, count = busy.truth.movers, len(busy.truth.objects)
    assert {thing.label for thing in movers} == {"car", "cyclist", "pedestrian"}
    assert {thing.label for thing in movers if thing.stands} == {"pedestrian"}
    boxes = busy.truth.boxes([1_000_000_000, 1_700_000_000])
    assert boxes.instances.tolist() == [thing.instance for thing in (*busy.truth.objects, *movers)]
    assert boxes.instances.tolist() == list(range(1, count + len(movers) + 1))
    assert boxes.present[:, :count].all()
    assert not boxes.velocities[:, :count].any()
    np.testing.assert_array_equal(boxes.centers_world[1, :count], [t.center_world for t in busy.truth.objects])
    assert busy.truth.objects == empty.truth.objects
    np.testing.assert_array_equal(busy.truth.path.control_points, empty.truth.path.control_points)
    np.testing.assert_array_equal(busy.truth.street.shapes.maps, empty.truth.street.shapes.maps)
    assert empty.truth.movers == ()
    seen, bare = busy.truth.image("camera0", 3), empty.truth.image("camera0", 3)
    there = seen.instances > len(busy.truth.objects)
    assert there.mean() > 0.005
    np.testing.assert_array_equal(seen.colors[~there], bare.colors[~there])
    np.testing.assert_array_equal(seen.depths[~there], bare.depths[~there])
    assert (seen.depths[there] <= np.where(bare.depths > 0, bare.depths, np.inf)[there]).all()
    # the annotations of what stands are those of the drive without traffic, and of those who wait
    stands = {annotation.id for annotation in busy.scene.annotations if annotation.stationary}
    assert {annotation.id for annotation in empty.scene.annotations} < stands
    assert all(annotation.stationary for annotation in empty.scene.annotations)


def test_points_on_movers_lie_in_their_boxes_at_their_own_times_move_with_them_and_stand_on_what_stands(busy):
    for k in [0, 7]:
        clean = busy.truth.clean_points_world(k)
        own = np.flatnonzero(clean.instances > len(busy.truth.objects))
        times = busy.scene.lidars[0].frames[k].points.timestamps_ns[own]
        states, centers, sizes = states_of(busy.truth, clean.instances[own], times)
        assert len(own) > 200
        assert (outside_boxes(clean.positions_world[own], centers, states.yaws, sizes) < 1e-9).all()
    truth, k, step = busy.truth, 4, 1_000_000
    clean, times = truth.clean_points_world(k), busy.scene.lidars[0].frames[k].points.timestamps_ns
    assert (clean.velocities[clean.instances <= len(truth.objects)] == 0).all()
    people, cars = (
        np.isin(clean.instances, [t.instance for t in truth.movers if (t.label == "pedestrian") == walks])
        for walks in (True, False)
    )
    before, now, after = (states_of(truth, clean.instances[cars], times[cars] + t)[0] for t in (-step, 0, step))
    # A point fixed to a rigid body, carried along by the body's poses.
    local = in_box_axes(clean.positions_world[cars], now.positions, now.yaws[:, None])
    carried = [Rotation.from_euler("z", s.yaws[:, None]).apply(local) + s.positions for s in (before, after)]
    # h²/6 times a jerk below 50 m/s³.
    np.testing.assert_allclose((carried[1] - carried[0]) / (2e-9 * step), clean.velocities[cars], atol=1e-4)
    assert cars.sum() > 200
    # Parts of a walker's leg swing at up to 0.3 rad x 7 rad/s x 0.9 m beside its 1.7 m/s.
    assert np.linalg.norm(clean.velocities[people], axis=1).max(initial=0.0) < 4.0


@pytest.mark.parametrize(
    "options",
    [{}, {"seed": 1}, {"path": PathSpec(yaw_rate=1.0)}, {"path": PathSpec(stops=(Stop(1.0, 2.0),), ramp=1.0)}],
)
@pytest.mark.few(1)
def test_nobody_runs_into_anybody_or_anything(options):
    truth = drive_through(BUSY, frames=40, cameras=(), **options).truth
    times = np.arange(1_000_000_000, 5_000_000_000, 50_000_000)
    boxes, count = truth.boxes(times), len(truth.objects)
    ego = truth.path.at(times)
    ego_yaw = np.arctan2(ego.rotations[:, 1, 0], ego.rotations[:, 0, 0])
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 5)), -1).reshape(-1, 2)

    def plan(index):
        if index < 0:
            return ego.positions[:, :2], ego_yaw, np.array([4.5, 1.8])
        return boxes.centers_world[:, index, :2], boxes.yaws[:, index], boxes.sizes_lwh[index, :2]

    def rotated(yaws):
        return np.moveaxis(np.array([[np.cos(yaws), -np.sin(yaws)], [np.sin(yaws), np.cos(yaws)]]), 2, 0)

    def touch(a, b, there):
        """Whether a point of a grid over one ground plan lies in the other at any time that both are there."""
        (center_a, yaw_a, size_a), (center_b, yaw_b, size_b) = plan(a), plan(b)
        near = np.linalg.norm(center_a - center_b, axis=1) < (np.hypot(*size_a) + np.hypot(*size_b)) / 2
        rows = np.flatnonzero(near & there)
        if not len(rows):
            return False
        points = np.einsum("tij,gj->tgi", rotated(yaw_a[rows]), grid * size_a) + center_a[rows, None]
        local = np.einsum("tji,tgj->tgi", rotated(yaw_b[rows]), points - center_b[rows, None])
        return (np.abs(local) < size_b / 2).all(axis=2).any()

    movers = [-1, *range(count, count + len(truth.movers))]
    solid = [k for k in range(count) if boxes.labels[k] in {"building", "car", "bin", "barrier"}]
    assert len(movers) > 12
    for a, b in (*combinations(movers, 2), *((a, b) for a in movers for b in solid)):
        there = np.broadcast_to((a < 0 or boxes.present[:, a]) & (b < 0 or boxes.present[:, b]), len(times))
        assert not touch(a, b, there), (a, b)
        assert not touch(b, a, there), (a, b)


def test_everyone_goes_at_the_speed_of_their_kind_and_nobody_where_nobody_is_wanted(busy):
    boxes = busy.truth.boxes(np.arange(1_000_000_000, 2_200_000_000, 10_000_000))
    speeds = np.linalg.norm(boxes.velocities, axis=2)
    headings = np.arctan2(boxes.velocities[..., 1], boxes.velocities[..., 0])
    limits = {"car": (3.0, 12.0), "cyclist": (2.8, 6.5), "pedestrian": (0.0, 1.9)}
    for k in range(len(busy.truth.objects), len(boxes.labels)):
        there, (slowest, fastest) = boxes.present[:, k], limits[boxes.labels[k]]
        assert ((speeds[there, k] >= slowest) & (speeds[there, k] <= fastest)).all()
        goes = there & (speeds[:, k] > 0.3)
        off = np.angle(np.exp(1j * (headings[goes, k] - boxes.yaws[goes, k])))
        assert np.abs(off).max(initial=0.0) < 0.01
    # nobody moves where nobody is wanted
    for cars, labels in ((0.0, set()), (3.0, {"car"})):
        drive = drive_through(TrafficSpec(cars=cars, cyclists=0.0, pedestrians=0.0), cameras=())
        assert {thing.label for thing in drive.truth.movers} == labels
    # oncoming cars are as fast as is asked, but for their waves
    drive = drive_through(replace(BUSY, cyclists=0.0, pedestrians=0.0, oncoming=(25.0, 27.0)), cameras=())
    boxes = drive.truth.boxes([1_500_000_000])
    forward = drive.truth.path.at(np.array([1_500_000_000])).velocities[0]
    oncoming = (boxes.velocities[0] @ forward < 0.0) & boxes.present[0]
    assert np.linalg.norm(boxes.velocities[0, oncoming], axis=1) == pytest.approx(26.0, abs=3.5)
    assert oncoming.sum() > 2
    # in the ego's lane cars stop and go with it
    drive = drive_through(BUSY, cameras=(), path=PathSpec(stops=(Stop(0.0, 4.0),)))
    boxes = drive.truth.boxes(np.array([1_900_000_000, 2_100_000_000], np.int64))
    cars = [k for k in range(len(drive.truth.objects), len(boxes.labels)) if boxes.labels[k] == "car"]
    stationary = (np.linalg.norm(boxes.velocities[:, cars], axis=2) < 1e-6).all(axis=0)
    assert 2 <= stationary.sum() <= len(cars) - 2


def test_annotations_state_within_a_centimetre_and_a_tenth_of_a_degree_where_movers_are(busy):
    by_id = {annotation.id: annotation for annotation in busy.scene.annotations}
    between = np.random.default_rng(0).integers(1_000_000_000, 2_200_000_000, 200)
    for thing in busy.truth.movers:
        annotation = by_id[f"{thing.label}-{thing.instance}"]
        assert annotation.stationary == thing.stands
        timestamps, values = annotation.path.timestamps_ns, annotation.path.values
        assert (np.diff(timestamps) > 0).all()
        times = between if thing.stands else between[(between >= timestamps[0]) & (between <= timestamps[-1])]
        states, middle, _ = states_of(busy.truth, np.full(len(times), thing.instance), times)
        stated = np.column_stack([np.interp(times, timestamps, values[:, axis]) for axis in (3, 4, 5, 8)])
        assert np.abs(stated[:, :3] - middle).max(initial=0.0) < 0.01
        assert np.abs(stated[:, 3] - np.degrees(states.yaws)).max(initial=0.0) < 0.1
        assert (values[:, :3] == thing.size_lwh).all()


def alone(street, instance):
    shapes, movers = street.shapes, street.movers
    own = np.flatnonzero(shapes.instances == instance)
    kept = type(shapes)(*(getattr(shapes, name)[own] for name in shapes.__slots__))
    if len(own):
        return streets.Street((), kept, street.ground, streets.NO_MOVERS)
    things = (t if t.instance == instance else replace(t, first_ns=0, last_ns=-1) for t in movers.things)
    return streets.Street((), kept, street.ground, replace(movers, things=tuple(things)))


@pytest.mark.parametrize("camera_id", ["camera0", "camera1"])
def test_what_an_image_shows_of_movers_is_visible_and_one_of_a_single_thing_shows_what_is_hidden(busy, camera_id):
    truth, k = busy.truth, 2
    camera = truth.cameras[camera_id]
    occlusion, shown = truth.occlusion(camera_id, k), truth.instances(camera_id, k)
    assert (np.diff(occlusion.instances) > 0).all()
    there = occlusion.instances > len(truth.objects)
    assert there.sum() >= 3
    for row in (*np.flatnonzero(there)[:6], *np.flatnonzero(~there)[::9]):
        instance = int(occlusion.instances[row])
        street = alone(truth.street, instance)
        single = RenderedCamera.of(camera.spec, street, truth.path, timestamps_ns=camera.timestamps_ns).truth(k)
        assert occlusion.alone_px[row] == (single.instances == instance).sum()
        assert occlusion.visible_px[row] == (shown == instance).sum()
    assert set(np.unique(shown[shown > 0])) <= set(occlusion.instances.tolist())
    assert ((occlusion.hidden >= 0) & (occlusion.hidden <= 1)).all()
    assert occlusion.hidden.max() > 0.5
    k = 5
    camera, image = truth.cameras[camera_id], truth.image(camera_id, k)
    rows, columns = np.nonzero(image.instances > len(truth.objects))
    assert len(rows) > 100
    model = camera.spec.camera
    rays = np.column_stack([(columns - model.cx) / model.fx, (rows - model.cy) / model.fy, np.ones(len(rows))])
    rotations, origins = camera.line_poses(k)
    line = rows if len(origins) > 1 else 0 * rows
    in_camera = rays * image.depths[rows, columns].astype(np.float64)[:, None]
    points = np.einsum("nij,nj->ni", rotations[line], in_camera) + origins[line]
    # float32 depths are off by 4e-6 m at 60 m; at an outline such a point may lie beside its object.
    assert truth.visible(camera_id, k, points).mean() > 0.99
    states, centers, sizes = states_of(truth, image.instances[rows, columns], camera.line_times_ns(k)[line])
    assert (outside_boxes(points, centers, states.yaws, sizes) < 1e-4).all()


AHEAD = np.array([[1.0, 0, 0]])


def look(street, origin, directions, *, pixel_angle=None, reach=200.0, bundles=None):
    """What rays from one location meet, and how that looks if a pixel angle is given."""
    rays = Rays.bundled(directions, bundles_by_direction(directions) if bundles is None else bundles)
    poses = np.eye(3)[None], np.asarray(origin, np.float64)[None]
    hits = cast(street, rays, *poses, np.zeros(1, np.int64), reach=reach)
    return hits if pixel_angle is None else (hits, paint(street, rays, *poses, hits, pixel_angle=pixel_angle))


def test_a_whole_street_is_seen_as_the_slow_walk_sees_it_the_ground_at_height_over_slope_and_the_sky_nowhere(drive):
    packed = drive.truth.street.shapes
    rotations = np.linalg.inv(packed.maps[:, :, :3] * packed.halves[:, :, None])
    shapes = [
        Shape(ShapeKind(kind), RigidTransform(rotation, sphere[:3]), tuple(half), PLAIN)
        for kind, rotation, sphere, half in zip(packed.kinds, rotations, packed.spheres, packed.halves, strict=True)
    ]
    origin = np.array([0.0, 0.0, 1.7])
    directions = unit(np.random.default_rng(5).normal(0, [1, 1, 0.08], (60, 3)))
    found = look(drive.truth.street, origin, directions, reach=120.0)
    for k, direction in enumerate(directions):
        expected, index = first_hit(shapes, origin, direction, 120.0)
        assert found.shapes[k] == index
        assert found.ranges[k] == pytest.approx(expected, abs=EXACT)
    assert {GROUND, SKY} < set(found.shapes.tolist())
    street = street_of([box([0, 50, 2], [1, 1, 1])])
    directions = unit(np.array([[1.0, 0, -0.5], [1.0, 0, 0.5], [1.0, 0, 0.0], [1.0, 0, -0.001]]))
    found = look(street, [0.0, 0, 2.0], directions)
    assert found.shapes.tolist() == [GROUND, SKY, SKY, SKY]
    assert found.ranges[0] == pytest.approx(np.hypot(4, 2), abs=EXACT)
    assert found.ranges[1:].tolist() == [0, 0, 0]
    assert instances_of(street, found).tolist() == [0, -1, -1, -1]
    assert reflectivities_of(street, found)[1:].tolist() == [0, 0, 0]


def test_the_nearest_shape_wins_but_for_what_a_ray_starts_in_or_is_beyond_its_reach():
    near, far = box([10, 0, 2], [1, 2, 2]), box([20, 0, 2], [1, 9, 2])
    for shapes in ([near, far], [far, near]):
        street = street_of(shapes)
        found = look(street, [0.0, 0, 2.5], AHEAD)
        assert found.ranges[0] == pytest.approx(9.0, abs=EXACT)
        assert shapes[found.shapes[0]] is near
        assert instances_of(street, found).tolist() == [found.shapes[0] + 1]
        assert reflectivities_of(street, found).tolist() == [0.3]
    street = street_of([box([0, 0, 5], [2, 2, 2]), box([10, 0, 5], [1, 1, 1])])
    found = [look(street, [0.0, 0, 5.0], AHEAD, reach=reach).shapes.tolist() for reach in (200.0, 9.1, 8.9)]
    assert found == [[1], [1], [SKY]]
    # rays that are not finite or not there meet nothing
    directions = np.array([[1.0, 0, 0], [np.nan] * 3, [1.0, 0, 0]])
    found = look(street_of([box([10, 0, 2], [1, 9, 9])]), [0.0, 0, 2.0], directions, bundles=np.zeros(3, np.int64))
    assert (found.shapes.tolist(), found.ranges.tolist()) == ([0, SKY, 0], [9.0, 0.0, 9.0])
    assert look(street, np.zeros(3), np.zeros((0, 3))).shapes.shape == (0,)


def test_directions_of_a_bundle_lie_within_a_few_degrees_and_answers_do_not_depend_on_bundles_or_start_poses(drive):
    directions = unit(np.random.default_rng(0).normal(size=(20000, 3)))
    numbers = bundles_by_direction(directions)
    order = np.argsort(numbers, kind="stable")
    same = numbers[order][1:] == numbers[order][:-1]
    cosines = (directions[order][1:] * directions[order][:-1]).sum(axis=1)[same]
    # A cell of a cube's face is 2/64 wide; its diagonal in the middle of the face is the longest: 2.6 degrees.
    assert same.sum() > 3000
    assert np.degrees(np.arccos(cosines.min())) < 2.7
    directions = unit(np.random.default_rng(1).normal(0, [1, 1, 0.2], (4000, 3)))
    alone, *others = (
        look(drive.truth.street, [1.0, 0.3, 1.6], directions, bundles=bundles)
        for bundles in (np.arange(4000), np.zeros(4000, np.int64), None, np.arange(4000) // 100)
    )
    for together in others:
        np.testing.assert_array_equal(together.shapes, alone.shapes)
        np.testing.assert_array_equal(together.ranges, alone.ranges)
    # rays of one bundle can start from different poses
    street, generator = drive.truth.street, np.random.default_rng(2)
    directions = unit(generator.normal(0, [1, 1, 0.2], (300, 3)))
    origins = np.array([[0.0, 0, 1.6], [0.7, 0.1, 1.7], [1.5, -0.2, 1.8]])
    rotations = Rotation.from_rotvec([[0, 0, 0.0], [0, 0, 0.1], [0, 0, -0.2]]).as_matrix()
    pose_of_ray = generator.integers(0, 3, 300)
    mixed = Rays.bundled(directions, np.arange(300) // 64, pose_of_ray=pose_of_ray)
    found = cast(street, mixed, rotations, origins, np.zeros(3, np.int64), reach=120.0)
    for pose in range(3):
        own = pose_of_ray == pose
        expected = look(street, origins[pose], directions[own] @ rotations[pose].T, reach=120.0)
        np.testing.assert_array_equal(found.shapes[own], expected.shapes)
        np.testing.assert_allclose(found.ranges[own], expected.ranges, atol=EXACT)


BASE = (200.0, 60.0, 40.0)


# inner kernels are called by compiled functions only
bands = njit(lambda x, period, low, high, width: _bands(x, period, low, high, width))  # noqa: PLW0108
band = njit(lambda x, low, high, width: _band(x, low, high, width))  # noqa: PLW0108
noise = njit(lambda x, y, salt, width: _noise(x, y, salt, width))  # noqa: PLW0108


def test_stripes_are_averaged_exactly_over_a_window_and_noise_is_gone_where_a_pixel_is_as_wide_as_its_lattice():
    for width in (0.05, 0.3, 1.0, 2.7):
        for x in np.random.default_rng(0).uniform(-5, 5, 40):
            window = x + width * (np.arange(20000) + 0.5) / 20000 - width / 2
            periodic = ((window % 1.1 >= 0.2) & (window % 1.1 < 0.7)).mean()
            single = ((window >= -0.4) & (window < 1.3)).mean()
            # 20000 samples see each of at most six borders to one sample.
            assert bands(x, 1.1, 0.2, 0.7, width) == pytest.approx(periodic, abs=3e-4)
            assert band(x, -0.4, 1.3, width) == pytest.approx(single, abs=3e-4)
    # edges are two centimetres soft at least
    assert [bands(x, 1.0, 0.2, 0.7, 0.0) for x in (0.189, 0.2, 0.211)] == pytest.approx([0.0, 0.5, 1.0])
    values = np.array([noise(a, 0.3 * a + 7.0, 5, 0.0) for a in np.linspace(-20, 20, 40001)])
    assert np.abs(values).max() <= 1.0
    assert values.std() > 0.3
    # Smoothstep rises by 1.5 per cell from -1 to 1 at most, along x and 0.3 times that along y.
    assert np.abs(np.diff(values)).max() < 4.0 * 1e-3
    assert noise(0.4, 0.6, 5, 0.8) == 0.0
    assert noise(0.4, 0.6, 5, 0.0) != noise(0.4, 0.6, 6, 0.0)


@pytest.mark.parametrize("kind", ShapeKind)
def test_the_angle_of_incidence_is_that_to_the_slope_of_the_surface(kind):
    generator = np.random.default_rng(int(kind))
    half = np.array([1.2, 1.2, 2.0] if kind is ShapeKind.CYLINDER else [1.5, 0.8, 2.0])
    pose = RigidTransform(Rotation.random(random_state=generator).as_matrix(), np.array([9.0, 1.0, 8.0]))
    directions = unit(pose.translation + generator.normal(0, 0.6, (400, 3)) - [0, 0, 5.0])
    hits, seen = look(street_of([Shape(kind, pose, tuple(half), PLAIN)]), [0, 0, 5.0], directions, pixel_angle=0.0)
    met = hits.shapes == 0
    local = pose.inverse().apply([0, 0, 5.0] + hits.ranges[met][:, None] * directions[met])
    slope = np.column_stack(
        [scenery.excess(kind, (local + s) / half) - scenery.excess(kind, (local - s) / half) for s in 1e-6 * np.eye(3)]
    )
    expected = np.abs((unit(slope) @ pose.rotation.T * directions[met]).sum(axis=1))
    # Central differences are good to 1e-9 but where two faces meet within their step.
    assert met.sum() > 150
    assert (np.abs(seen.facings[met] - expected) < 1e-4).mean() > 0.99


def test_plain_surfaces_ground_sky_and_haze_have_their_colours(drive):
    street = street_of([box([10, 0, 5], [2, 2, 2], Material(Pattern.PLAIN, (BASE, BASE, BASE)))])
    front, top = (
        look(street, origin, np.array([direction]), pixel_angle=0.0)[1].colors[0].astype(float)
        for origin, direction in (([0, 0, 5], [1.0, 0, 0.01]), ([10, 0, 15], [0.0, 0, -1.0]))
    )
    for color in (front, top):
        # Plain surfaces carry 3 % of noise; a level is 0.5 to 3 % of these colours.
        np.testing.assert_allclose(color / color.sum(), np.array(BASE) / sum(BASE), atol=0.01)
    assert top.sum() > 1.2 * front.sum()
    lane = Lane.of(drive.truth.path)

    def color_at(along, left):
        x, y, _ = lane.location(along, left)
        seen = look(drive.truth.street, [x, y, 0.05], np.array([[0.0, 0, -1.0]]), pixel_angle=0.0)[1]
        return seen.colors[0].astype(int)

    asphalt = np.array([color_at(s, 0.3) for s in np.arange(0.5, 18, 0.5)])
    assert np.ptp(asphalt, axis=1).max() < 25
    assert 80 < asphalt.mean() < 130
    # The dashes of the middle line cover the first three of every six metres.
    assert all(color_at(s, 1.75).min() > 200 for s in (1.0, 2.0, 7.5))
    assert all(color_at(s, 1.75).max() < 140 for s in (4.0, 5.0, 10.5))
    assert all(color_at(s, -5.5).min() > 110 for s in (1.0, 5.0, 9.0))
    grass = np.array([color_at(s, -7.3) for s in np.arange(0.5, 18, 0.5)])
    assert (grass[:, 1] > grass[:, 2] + 20).all()
    up = unit(np.array([[0.3, 0.1, 0.95], [0.1, -0.3, 0.95], [1.0, 0, 0.12], [0, 1.0, 0.12]]))
    colors = look(drive.truth.street, [0, 0, 400.0], up, pixel_angle=0.0)[1].colors
    assert (colors[:, 2] >= colors[:, 0]).all()
    assert colors[2:].astype(int).sum() > colors[:2].astype(int).sum()
    for slope, hazy in ((-0.02, False), (-0.005, True)):
        # Rays of no width have no haze, rays of a tiny one differ by it alone.
        (hits, bare), (_, seen) = (
            look(drive.truth.street, [-60, 80, 2.0], unit(np.array([[1.0, 0, slope]])), pixel_angle=angle, reach=900.0)
            for angle in (0.0, 1e-9)
        )
        assert (hits.ranges[0] > 120) == hazy
        assert (np.abs(bare.colors.astype(int) - seen.colors).max() > 10) == hazy


@pytest.mark.parametrize("pattern", Pattern)
def test_every_pattern_only_mixes_the_colours_of_its_palette(pattern):
    material = Material(pattern, ((255.0, 0, 0), (0, 255.0, 0), (0, 0, 255.0)), (2.0, 2.5, 0.2))
    street = street_of([box([10, 0, 3], [1, 5, 3], material), box([8, 8, 0.5], [2, 1, 0.5], material)])
    aims = np.random.default_rng(0).uniform([9, -5, -1.5], [9, 9, 3], (4000, 3))
    hits, seen = look(street, [0, 0, 1.6], unit(aims), pixel_angle=0.0)
    colors = seen.colors[hits.shapes >= 0].astype(float)
    # Shares add up to one, so what differs is the light alone: 0.5 to 1.3 times 255.
    assert len(colors) > 1000
    assert 60 < colors.sum(axis=1).min() < colors.sum(axis=1).max() < 340
    assert np.ptp(colors, axis=0).max() > (3 if pattern is Pattern.PLAIN else 20)
