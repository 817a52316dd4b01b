"""What moves, met by rays at their own times: against walks and formulas that know nothing of frames or balls.

A drive through traffic: what must hold of everyone in it, and of the truth about them.
"""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import CameraSpec, LidarSpec, PathSpec, Stop, TrafficSpec, camera_mount, simulate_street
from sceneloom.simulate.camera import RenderedCamera
from sceneloom.simulate.casting import Rays, bundles_by_direction, cast, instances_of, paint
from sceneloom.simulate.street import (
    NO_MOVERS,
    GroundMap,
    Lane,
    Material,
    Mover,
    MovingDesign,
    PackedShapes,
    Part,
    Pattern,
    Shape,
    ShapeKind,
    Street,
    build_street,
    design_cyclist,
    design_moving_car,
    design_pedestrian,
    pack_movers,
)
from sceneloom.simulate.trajectory import plan_path


@pytest.fixture(scope="module", params=[0, 1, 2])
def built(request):
    path = plan_path(np.random.default_rng(request.param), start_ns=0, duration=15.0)
    return path, build_street(np.random.default_rng(100 + request.param), path)


def in_any_shape(packed, points):
    """Which of (N, 3) world points lie in any shape; the unit bodies are written out once more."""
    inside = np.zeros(len(points), bool)
    for k in range(len(packed)):
        local = points @ packed.maps[k, :, :3].T + packed.maps[k, :, 3]
        x, y, z = np.abs(local).T
        rule = {
            ShapeKind.BOX: (x <= 1) & (y <= 1) & (z <= 1),
            ShapeKind.CYLINDER: (np.hypot(x, y) <= 1) & (z <= 1),
            ShapeKind.ELLIPSOID: np.linalg.norm(local, axis=1) <= 1,
            ShapeKind.GABLE: (x <= 1) & (z <= 1) & (y <= (1 - local[:, 2]) / 2),
        }[ShapeKind(packed.kinds[k])]
        inside |= rule
    return inside


@pytest.mark.few(1)
def test_nothing_stands_in_the_ego_trajectory(built):
    path, street = built
    states = path.at_seconds(np.arange(-1.0, 16.0, 0.1))
    left = states.rotations[:, :, 1]
    swept = [
        states.positions + across * left + [0, 0, height]
        for across in np.linspace(-1.1, 1.1, 5)
        for height in (0.1, 0.6, 1.2, 1.8, 2.2)
    ]
    assert not in_any_shape(street.shapes, np.concatenate(swept)).any()


def plan_corners(thing):
    length, width, _ = thing.size_lwh
    rotation = np.array([[np.cos(thing.yaw), -np.sin(thing.yaw)], [np.sin(thing.yaw), np.cos(thing.yaw)]])
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 9)), -1).reshape(-1, 2)
    return (grid * [length, width]) @ rotation.T + thing.center_world[:2]


def test_houses_cars_and_bins_do_not_stand_in_one_another(built):
    solid = [thing for thing in built[1].objects if thing.label in {"building", "car", "bin", "barrier"}]
    grids = {thing.instance: plan_corners(thing) for thing in solid}
    for a, b in combinations(solid, 2):
        apart = np.hypot(*np.subtract(a.center_world[:2], b.center_world[:2]))
        if apart > np.hypot(*a.size_lwh[:2]) / 2 + np.hypot(*b.size_lwh[:2]) / 2:
            continue
        cosine, sine = np.cos(b.yaw), np.sin(b.yaw)
        local = (grids[a.instance] - b.center_world[:2]) @ np.array([[cosine, -sine], [sine, cosine]])
        assert not (np.abs(local) < np.array(b.size_lwh[:2]) / 2).all(axis=1).any()


def test_the_box_of_an_object_holds_all_its_shapes(built):
    _, street = built
    generator = np.random.default_rng(0)
    on_ball = generator.normal(size=(400, 3))
    on_ball /= np.linalg.norm(on_ball, axis=1, keepdims=True)
    rim = on_ball[:, :2] / np.linalg.norm(on_ball[:, :2], axis=1, keepdims=True)
    samples = {
        ShapeKind.BOX: np.clip(on_ball * 2, -1, 1),
        ShapeKind.CYLINDER: np.column_stack([rim, np.sign(on_ball[:, 2])]),
        ShapeKind.ELLIPSOID: on_ball,
        ShapeKind.GABLE: np.column_stack([np.sign(on_ball[:, :2]), -np.ones(400)]),
    }
    for k in range(len(street.shapes)):
        thing = street.objects[street.shapes.instances[k] - 1]
        world_from_unit = np.linalg.inv(np.vstack([street.shapes.maps[k], [0, 0, 0, 1]]))
        local = samples[ShapeKind(street.shapes.kinds[k])]
        world = local @ world_from_unit[:3, :3].T + world_from_unit[:3, 3]
        cosine, sine = np.cos(thing.yaw), np.sin(thing.yaw)
        away = (world - thing.center_world) @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        assert (np.abs(away) <= np.array(thing.size_lwh) / 2 + 1e-9).all(), thing.label


def test_a_street_has_something_of_everything(built):
    labels = {thing.label for thing in built[1].objects}
    assert labels == {"building", "car", "tree", "pole", "bin", "barrier"}
    kinds = np.unique(built[1].shapes.kinds)
    assert kinds.tolist() == [0, 1, 2, 3]


def test_objects_are_numbered_from_one_in_their_order(built):
    assert [thing.instance for thing in built[1].objects] == list(range(1, len(built[1].objects) + 1))


def test_the_bounding_balls_hold_their_shapes(built):
    packed = built[1].shapes
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    for k in np.flatnonzero(packed.kinds == ShapeKind.BOX):
        world_from_unit = np.linalg.inv(np.vstack([packed.maps[k], [0, 0, 0, 1]]))
        world = corners @ world_from_unit[:3, :3].T + world_from_unit[:3, 3]
        assert np.linalg.norm(world - packed.spheres[k, :3], axis=1).max() <= packed.spheres[k, 3] + 1e-9


def test_the_same_seed_builds_the_same_street_and_another_one_another():
    path = plan_path(np.random.default_rng(0), start_ns=0, duration=3.0)
    first, again, other = (build_street(np.random.default_rng(seed), path) for seed in (7, 7, 8))
    assert first.objects == again.objects
    np.testing.assert_array_equal(first.shapes.maps, again.shapes.maps)
    assert first.objects != other.objects


def test_the_map_of_the_ground_knows_how_far_along_and_left_of_the_trajectory_its_nodes_lie():
    lane = Lane.of(plan_path(np.random.default_rng(3), start_ns=0, duration=10.0))
    ground = GroundMap.of(lane)
    along, left = ground.nodes[..., 0], ground.nodes[..., 1]
    drawn = np.argwhere((np.abs(left) < 10.0) & (along > lane.along[0] + 1) & (along < lane.along[-1] - 1))
    chosen = drawn[np.random.default_rng(0).choice(len(drawn), 500, replace=False)]
    for i, j in chosen:
        spot = lane.location(*map(float, ground.nodes[i, j, :2]))[:2]
        node = ground.corner + ground.cell * np.array([i, j])
        # Points of the lane are 25 cm apart; between them a bend of 15 m leaves its chord by 0.5 mm, and ten metres
        # to its side the rounding of the heading between them counts as millimetres.
        assert np.hypot(*(spot - node)) < 0.02


def test_far_from_the_trajectory_the_ground_is_only_grass():
    lane = Lane.of(plan_path(np.random.default_rng(3), start_ns=0, duration=5.0))
    ground = GroundMap.of(lane)
    nodes = ground.corner + ground.cell * np.argwhere(ground.nodes[..., 1] >= 14.0)
    nearest = [np.linalg.norm(lane.points - node, axis=1).min() for node in nodes[::37]]
    assert min(nearest) >= 13.9


PLAIN = Material(Pattern.PLAIN, ((100.0, 120.0, 140.0),) * 3, reflectivity=0.3)

STEP = 0.5

COUNT = 30

START_NS = 3_000_000

SKY = -2


# Bisection ends below 1e-12 m; the quadratics of round bodies lose half of float64's digits.
EXACT = 1e-7


def upright_box(half, center):
    return Shape(ShapeKind.BOX, RigidTransform(np.eye(3), np.array(center, float)), half, PLAIN)


def straight_curve(start, velocity, yaw, yaw_rate, gait_rate=0.0):
    """Control points of a straight motion: a B-spline whose control points lie on a line runs along it."""
    # Control point i weighs most at knot number i - 2, and the first knot is at 0 s.
    seconds = STEP * (np.arange(COUNT) - 2.0)
    x, y = (start[axis] + velocity[axis] * seconds for axis in range(2))
    return np.column_stack([x, y, yaw + yaw_rate * seconds, gait_rate * seconds])


def movers_of(designs, curves, *, spans=None, first_instance=1):
    last_ns = START_NS + int(STEP * (COUNT - 6) * 1e9)
    spans = spans or [(START_NS, last_ns)] * len(designs)
    things = [
        Mover(first_instance + k, design.label, design.size_lwh, *spans[k], False) for k, design in enumerate(designs)
    ]
    return pack_movers(things, designs, np.array(curves), start_ns=START_NS, first_knot=0.0, knot_step=STEP)


@pytest.fixture(scope="module")
def street_with(stationary_path):
    def build(movers, shapes=()):
        ground = GroundMap.of(Lane.of(stationary_path))
        return Street((), PackedShapes.of(list(shapes), [99] * len(shapes)), ground, movers)

    return build


def at(seconds):
    return np.asarray(START_NS + np.rint(np.asarray(seconds) * 1e9), np.int64)


def cast_one_by_one(street, origins, directions, seconds, reach=200.0):
    """Rays that each have an origin and a time of their own, in one bundle per direction."""
    rays = Rays.bundled(directions, bundles_by_direction(directions, across=4), pose_of_ray=np.arange(len(directions)))
    upright = np.tile(np.eye(3), (len(directions), 1, 1))
    return cast(street, rays, upright, origins, at(seconds), reach=reach), rays, upright


def range_to_box(center, half, yaw, origin, direction):
    """Range at which a ray enters a box rotated by yaw, by the three pairs of planes."""
    rotation = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    o, d = rotation @ (origin - center), rotation @ direction
    with np.errstate(divide="ignore"):
        low, high = (-half - o) / d, (half - o) / d
    near, far = np.minimum(low, high).max(), np.maximum(low, high).min()
    return near if 0 < near < far else np.inf


def test_a_box_that_drives_and_rotates_is_met_where_it_is_at_each_rays_time(street_with):
    half = np.array([2.0, 0.9, 0.7])
    design = MovingDesign("car", (Part((upright_box(tuple(half), (0, 0, 0.9)),)),), (4.0, 1.8, 1.6))
    velocity, yaw_rate = np.array([-8.0, 1.5]), 0.4
    street = street_with(movers_of([design], [straight_curve((60.0, -6.0), velocity, 0.3, yaw_rate)]))
    generator = np.random.default_rng(0)
    # As a lidar would: 600 rays within a tenth of a second, again and again.
    for begin in (0.0, 2.0, 6.0, 9.0):
        seconds = begin + np.sort(generator.uniform(0, 0.1, 600))
        origins = np.column_stack([8.0 * seconds, 0.1 * seconds, np.full(600, 1.8)])
        centers = np.column_stack([60.0 + velocity[0] * seconds, -6.0 + velocity[1] * seconds, np.full(600, 0.9)])
        aims = centers + generator.normal(0, [2.5, 1.5, 0.8], (600, 3)) - origins
        directions = aims / np.linalg.norm(aims, axis=1, keepdims=True)
        found, _, _ = cast_one_by_one(street, origins, directions, seconds)
        met = 0
        for k in range(600):
            box = range_to_box(centers[k], half, 0.3 + yaw_rate * seconds[k], origins[k], directions[k])
            down = -1.8 / directions[k, 2] if directions[k, 2] < 0 else np.inf
            expected = min(box, down)
            # Beyond the reach there is the sky, at range 0.
            expected = expected if expected < 200.0 else 0.0
            # A time is rounded to a nanosecond: 1e-8 m at 10 m/s.
            assert found.ranges[k] == pytest.approx(expected, abs=EXACT)
            met += box == expected
        assert met > 150


def slow_frames(movers, seconds):
    """World from part of every part at one time, from the definition: rotate about z, then swing about the hip."""
    states = movers.states(np.arange(len(movers)), at(np.full(len(movers), seconds)))
    for part, mover in enumerate(movers.mover_of_part):
        rotation = Rotation.from_euler("z", states.yaws[mover]).as_matrix()
        world = RigidTransform(rotation, states.positions[mover])
        angle = movers.swings[part] * np.sin(states.gaits[mover] + movers.leads[part])
        # Forwards: a foot below the hip goes to positive x, which is a rotation about -y.
        swing = Rotation.from_rotvec([0, -angle, 0]).as_matrix()
        hinge = movers.hinges[part]
        yield world @ RigidTransform(swing, hinge - swing @ hinge)


def test_people_and_cars_are_met_where_the_slow_walk_enters_them(street_with, slow_caster):
    generator = np.random.default_rng(4)
    designs = [design_pedestrian(generator), design_cyclist(generator), design_moving_car(generator)]
    curves = [
        straight_curve((9.0, -2.0), (0.9, 0.6), 0.6, 0.1, gait_rate=6.0),
        straight_curve((7.0, 4.0), (4.0, -1.0), -0.2, 0.05),
        straight_curve((22.0, 2.0), (-5.0, 0.0), np.pi, -0.1),
    ]
    movers = movers_of(designs, curves)
    street, origin = street_with(movers), np.array([0.0, 0, 1.7])
    met = set()
    for seconds in (0.2, 0.9, 1.6):
        shapes = [
            shape.moved(frame)
            for frame, part in zip(slow_frames(movers, seconds), (p for d in designs for p in d.parts), strict=True)
            for shape in part.shapes
        ]
        middles = np.array([shape.pose.translation for shape in shapes])
        aims = middles + generator.normal(0, 0.08, middles.shape) - origin
        directions = aims / np.linalg.norm(aims, axis=1, keepdims=True)
        found, _, _ = cast_one_by_one(street, np.tile(origin, (len(aims), 1)), directions, np.full(len(aims), seconds))
        for k, direction in enumerate(directions):
            expected, index = slow_caster.first_hit(shapes, origin, direction, 200.0)
            assert found.ranges[k] == pytest.approx(expected, abs=EXACT)
            # Where two bodies of one person meet a ray at the same location either may be named.
            if index < 0:
                assert found.shapes[k] == index
            else:
                assert movers.shapes.instances[found.shapes[k]] == movers.shapes.instances[index]
            met.add(index)
    assert len(met) > 25


def test_states_are_derivatives_of_each_other():
    generator = np.random.default_rng(1)
    curves = np.cumsum(generator.normal(0, 0.4, (3, COUNT, 4)), axis=1)
    movers = movers_of([design_cyclist(generator) for _ in range(3)], curves)
    which, seconds, step = generator.integers(0, 3, 100), generator.uniform(1, 11, 100), 1e-3
    before, states, after = (movers.states(which, at(seconds + shift)) for shift in (-step, 0.0, step))
    # h²/6 times a third derivative below 20, and two rounded nanoseconds of 1e-3 s at 2 m/s.
    near = {"atol": 1e-5}
    np.testing.assert_allclose((after.positions - before.positions) / (2 * step), states.velocities, **near)
    np.testing.assert_allclose((after.yaws - before.yaws) / (2 * step), states.yaw_rates, **near)
    np.testing.assert_allclose((after.gaits - before.gaits) / (2 * step), states.gait_rates, **near)


def test_points_of_a_walkers_legs_move_as_the_frames_of_the_legs_do(street_with):
    generator = np.random.default_rng(2)
    design = design_pedestrian(generator)
    movers = movers_of([design], [straight_curve((4.0, 1.0), (1.2, -0.3), -0.25, 0.2, gait_rate=5.0)])
    street, step = street_with(movers), 1e-4
    for shape in range(len(movers.shapes)):
        part = movers.part_of_shape[shape]
        for seconds in generator.uniform(1, 8, 5):
            local = generator.uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 1.6])
            locations = [list(slow_frames(movers, seconds + shift))[part].apply(local) for shift in (-step, 0, step)]
            velocity = street.movers.point_velocities(
                np.array([shape - len(street.shapes)]), locations[1][None], at([seconds])
            )[0]
            # h²/6 times a third derivative: 0.3 rad swing of 1 m at 5 rad/s give 40, so 7e-8; a nanosecond of
            # rounding in 1e-4 s at 2 m/s is 2e-5.
            np.testing.assert_allclose(velocity, (locations[2] - locations[0]) / (2 * step), atol=5e-5)


def test_what_is_not_in_the_street_is_not_met(street_with):
    design = MovingDesign("car", (Part((upright_box((2.0, 1.0, 1.0), (0, 0, 1.0)),)),), (4.0, 2.0, 2.0))
    curve = straight_curve((10.0, 0.0), (0.0, 0.0), 0.0, 0.0)
    span = (START_NS + 2_000_000_000, START_NS + 2_050_000_000)
    street = street_with(movers_of([design], [curve], spans=[span]))
    seconds = np.array([1.0, 1.99, 2.0, 2.03, 2.05, 2.06])
    origins, ahead = np.tile([0.0, 0, 1.0], (6, 1)), np.tile([1.0, 0, 0], (6, 1))
    found, _, _ = cast_one_by_one(street, origins, ahead, seconds)
    assert found.shapes.tolist() == [SKY, SKY, 0, 0, 0, SKY]
    np.testing.assert_allclose(found.ranges, [0, 0, 8, 8, 8, 0], atol=EXACT)


def test_movers_hide_what_stands_and_are_hidden_by_it(street_with, box):
    design = MovingDesign("car", (Part((upright_box((0.5, 1.0, 1.0), (0, 0, 1.0)),)),), (1.0, 2.0, 2.0))
    curve = straight_curve((5.0, 0.0), (10.0, 0.0), 0.0, 0.0)
    street = street_with(movers_of([design], [curve]), [box([20, 0, 1], [1, 1, 1])])
    origins, ahead = np.tile([0.0, 0, 1.0], (2, 1)), np.tile([1.0, 0, 0], (2, 1))
    found, _, _ = cast_one_by_one(street, origins, ahead, np.array([0.5, 2.5]))
    np.testing.assert_allclose(found.ranges, [9.5, 19.0], atol=EXACT)
    assert instances_of(street, found).tolist() == [1, 99]


def test_patterns_stick_to_what_moves_and_the_light_does_not(street_with):
    generator = np.random.default_rng(3)
    design = design_moving_car(generator)
    still, driving = (straight_curve((8.0, 3.0), v, 0.4, w) for v, w in (((0.0, 0.0), 0.0), ((3.0, -1.0), 0.0)))
    aims = np.array([8.0, 3.0, 0.8]) + generator.normal(0, [1.0, 1.0, 0.4], (500, 3)) - [0, 0, 1.7]
    directions = aims / np.linalg.norm(aims, axis=1, keepdims=True)
    looks = []
    for curve, offset in ((still, np.zeros(3)), (driving, np.array([6.0, -2.0, 0.0]))):
        street = street_with(movers_of([design], [curve]))
        origins = np.tile(offset + np.array([0.0, 0, 1.7]), (500, 1))
        found, rays, upright = cast_one_by_one(street, origins, directions, np.full(500, 2.0))
        looks.append((found.shapes >= 0, paint(street, rays, upright, origins, found)))
    (there, first), (also, second) = looks
    np.testing.assert_array_equal(there, also)
    # Two seconds on it has moved by 6 m and -2 m, and so has who looks: only rounding differs.
    difference = np.abs(first.colors[there].astype(int) - second.colors[there])
    assert there.sum() > 200
    assert (difference <= 1).mean() > 0.99
    rotated = street_with(movers_of([design], [straight_curve((8.0, 3.0), (0.0, 0.0), 0.4 + np.pi, 0.0)]))
    above = np.tile([8.0, 3.0, 10.0], (1, 1))
    sides = []
    for street in (street_with(movers_of([design], [still])), rotated):
        found, rays, upright = cast_one_by_one(street, above, np.array([[0.0, 0, -1.0]]), np.zeros(1))
        sides.append(paint(street, rays, upright, above, found).colors[0].astype(int))
    # The roof is as light whichever trajectory the car looks.
    np.testing.assert_allclose(sides[0], sides[1], atol=8)


@pytest.mark.parametrize("design", [design_pedestrian, design_cyclist, design_moving_car])
def test_the_box_of_what_moves_holds_it_through_all_its_gait_and_is_no_larger(design):
    generator = np.random.default_rng(5)
    made = design(generator)
    movers = movers_of([made], [straight_curve((0.0, 0.0), (0.0, 0.0), 0.0, 0.0, gait_rate=1.0)])
    ball = generator.normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    rim = ball[:, :2] / np.linalg.norm(ball[:, :2], axis=1, keepdims=True)
    surface = {
        ShapeKind.BOX: np.sign(ball),
        ShapeKind.CYLINDER: np.column_stack([rim, np.sign(ball[:, 2])]),
        ShapeKind.ELLIPSOID: ball,
    }
    reached = np.zeros(3)
    for seconds in np.linspace(0, 2 * np.pi, 25):
        for frame, part in zip(slow_frames(movers, seconds), made.parts, strict=True):
            for shape in part.shapes:
                points = frame.apply(shape.pose.apply(surface[shape.kind] * shape.half))
                reached = np.maximum(reached, np.abs(points).max(axis=0))
                assert points[:, 2].min() > -0.02
    half = np.array([made.size_lwh[0] / 2, made.size_lwh[1] / 2, made.size_lwh[2]])
    assert (reached <= half + 1e-9).all()
    # 3000 points and 25 phases come within 2 cm of the furthest location; a parked car's box is 2 cm wider.
    assert (reached > half - 0.03).all()


def test_the_balls_that_rays_are_culled_by_hold_their_bodies_at_all_times():
    generator = np.random.default_rng(6)
    designs = [design_pedestrian(generator), design_cyclist(generator), design_moving_car(generator)]
    curves = [
        straight_curve((9.0, -2.0), (1.4, 0.6), 0.6, 0.4, gait_rate=6.0),
        straight_curve((7.0, 4.0), (5.0, -1.0), -0.2, 0.3),
        straight_curve((22.0, 2.0), (-9.0, 0.0), np.pi, -0.8),
    ]
    movers = movers_of(designs, curves)
    ball = generator.normal(size=(200, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    rim = ball[:, :2] / np.linalg.norm(ball[:, :2], axis=1, keepdims=True)
    surface = {
        ShapeKind.BOX: np.sign(ball),
        ShapeKind.CYLINDER: np.column_stack([rim, np.sign(ball[:, 2])]),
        ShapeKind.ELLIPSOID: ball,
    }
    for first, last in ((2.0, 2.1), (3.0, 3.8)):
        placed = movers.placed(np.arange(3), at(np.linspace(first, last, 9)))
        balls = placed.spheres
        assert placed.shapes.tolist() == list(range(len(movers.shapes)))
        for seconds in np.linspace(first, last, 9):
            frames = list(slow_frames(movers, seconds))
            shapes = [
                (frame, shape)
                for frame, part in zip(frames, (p for d in designs for p in d.parts), strict=True)
                for shape in part.shapes
            ]
            for sphere, (frame, shape) in zip(balls, shapes, strict=True):
                points = frame.apply(shape.pose.apply(surface[shape.kind] * shape.half))
                assert np.linalg.norm(points - sphere[:3], axis=1).max() < sphere[3] + 1e-9
    # A car's body that moves by 9 m/s for a tenth of a second needs half a metre and its rotating more, not tens.
    near = movers.placed(np.arange(3), at(np.linspace(2.0, 2.1, 9))).spheres[:, 3]
    assert (near < movers.shapes.spheres[:, 3] + 1.5).all()


def test_only_those_who_could_be_near_are_looked_at():
    generator = np.random.default_rng(7)
    curves = [straight_curve((x, 0.0), (-10.0, 0.0), np.pi, 0.0) for x in (10.0, 60.0, 400.0)]
    movers = movers_of([design_moving_car(generator) for _ in curves], curves)
    assert movers.near(np.zeros(3), at([0.0, 0.1]), within=80.0).tolist() == [0, 1]
    assert movers.near(np.zeros(3), at([11.9, 12.0]), within=300.0).tolist() == [0, 1, 2]
    late = at([100.0])
    assert movers.near(np.zeros(3), late, within=1e4).tolist() == []


def test_what_moves_looks_like_the_same_thing_stationary_there(street_with, stationary_path):
    generator = np.random.default_rng(8)
    design = design_moving_car(generator)
    movers = movers_of([design], [straight_curve((9.0, 2.0), (-3.0, 1.0), 2.2, 0.3)])
    seconds = 1.3
    (frame,) = slow_frames(movers, seconds)
    bodies = [shape.moved(frame) for shape in design.parts[0].shapes]
    parked = Street((), PackedShapes.of(bodies, [1] * len(bodies)), GroundMap.of(Lane.of(stationary_path)))
    aims = frame.translation + generator.normal(0, [1.5, 1.5, 0.5], (800, 3)) + [0, 0, 0.8 - 1.7]
    directions = aims / np.linalg.norm(aims, axis=1, keepdims=True)
    origins = np.tile([0.0, 0, 1.7], (800, 1))
    looks = []
    for street in (street_with(movers), parked):
        found, rays, upright = cast_one_by_one(street, origins, directions, np.full(800, seconds))
        looks.append((found, paint(street, rays, upright, origins, found)))
    (moving, first), (stationary, second) = looks
    np.testing.assert_array_equal(moving.shapes, stationary.shapes)
    np.testing.assert_allclose(moving.ranges, stationary.ranges, atol=EXACT)
    np.testing.assert_allclose(first.facings, second.facings, atol=1e-5)
    # A level is lost to rounding, more where a ray ends within 1e-7 m of an edge.
    difference = np.abs(first.colors.astype(int) - second.colors).max(axis=1)
    assert (moving.shapes >= 0).sum() > 300
    assert (difference <= 1).mean() > 0.99


EXACT_LIDAR = LidarSpec(beams=32, steps=600, range_sigma=0.0, drop_rate=0.0)

SMALL = CameraSpec(Camera("pinhole", 320, 200, 200.0, 200.0, 159.5, 90.0), camera_mount(pitch_deg=2.0))

ROLLING = replace(SMALL, readout_ns=60_000_000, mount=camera_mount(yaw_deg=30.0))

BUSY = TrafficSpec(cars=4.0, cyclists=2.0, pedestrians=8.0)

SEED = 7


def drive_through(traffic, *, seed=SEED, frames=12, cameras=(SMALL, ROLLING), **options):
    return simulate_street(seed, frames=frames, lidar=EXACT_LIDAR, cameras=cameras, traffic=traffic, **options)


@pytest.fixture(scope="module")
def busy():
    return drive_through(BUSY)


@pytest.fixture(scope="module")
def empty():
    return drive_through(None)


def rotated(yaws):
    """Rotates about z by (N,) yaws, (N, 2, 2)."""
    rows = [[np.cos(yaws), -np.sin(yaws)], [np.sin(yaws), np.cos(yaws)]]
    return np.moveaxis(np.array(rows), 2, 0)


def in_box(points_world, centers, yaws, size_lwh):
    """How far outside a box at each point's own time points are [m], at most 0 inside."""
    apart = points_world - centers
    ahead = np.cos(yaws) * apart[:, 0] + np.sin(yaws) * apart[:, 1]
    left = np.cos(yaws) * apart[:, 1] - np.sin(yaws) * apart[:, 0]
    return (np.abs(np.column_stack([ahead, left, apart[:, 2]])) - np.array(size_lwh) / 2).max(axis=1)


def test_there_is_something_of_everything(busy):
    labels = [thing.label for thing in busy.truth.movers]
    assert set(labels) == {"car", "cyclist", "pedestrian"}
    assert sum(thing.stands for thing in busy.truth.movers) >= 1
    assert all(thing.label == "pedestrian" for thing in busy.truth.movers if thing.stands)
    first = len(busy.truth.objects) + 1
    assert [thing.instance for thing in busy.truth.movers] == list(range(first, first + len(labels)))


def test_traffic_changes_neither_the_trajectory_nor_what_stands(busy, empty):
    assert busy.truth.objects == empty.truth.objects
    np.testing.assert_array_equal(busy.truth.path.control_points, empty.truth.path.control_points)
    np.testing.assert_array_equal(busy.truth.street.shapes.maps, empty.truth.street.shapes.maps)
    assert empty.truth.movers == ()
    seen, bare = busy.truth.image("camera0", 3), empty.truth.image("camera0", 3)
    moving = seen.instances > len(busy.truth.objects)
    assert moving.mean() > 0.005
    np.testing.assert_array_equal(seen.colors[~moving], bare.colors[~moving])
    np.testing.assert_array_equal(seen.depths[~moving], bare.depths[~moving])
    assert (seen.depths[moving] <= np.where(bare.depths > 0, bare.depths, np.inf)[moving]).all()


def test_a_drive_without_traffic_has_the_annotations_of_what_stands(empty, busy):
    stands = [annotation for annotation in busy.scene.annotations if annotation.stationary]
    ids = {annotation.id for annotation in empty.scene.annotations}
    assert ids < {annotation.id for annotation in stands}
    assert all(annotation.stationary for annotation in empty.scene.annotations)


@pytest.mark.parametrize("k", [0, 7])
def test_points_on_movers_lie_in_their_boxes_at_the_points_own_times(busy, k):
    truth, frame = busy.truth, busy.scene.lidars[0].frames[k]
    clean, first = truth.clean_points_world(k), len(truth.objects) + 1
    assert (clean.instances >= first).sum() > 200
    for thing in truth.movers:
        own = np.flatnonzero(clean.instances == thing.instance)
        times = frame.points.timestamps_ns[own]
        states = truth.street.movers.states(np.full(len(own), thing.instance - first), times)
        centers = states.positions + np.array([0, 0, thing.size_lwh[2] / 2])
        assert (in_box(clean.positions_world[own], centers, states.yaws, thing.size_lwh) < 1e-9).all()


def test_points_move_with_what_they_are_on_and_stand_on_what_stands(busy):
    truth, k = busy.truth, 4
    clean, times = truth.clean_points_world(k), busy.scene.lidars[0].frames[k].points.timestamps_ns
    first = len(truth.objects) + 1
    assert (clean.velocities[clean.instances < first] == 0).all()
    cars = [thing for thing in truth.movers if thing.label != "pedestrian"]
    step = 1_000_000
    checked = 0
    for thing in cars:
        own = np.flatnonzero(clean.instances == thing.instance)
        if not len(own):
            continue
        which = np.full(len(own), thing.instance - first)
        before, now, after = (truth.street.movers.states(which, times[own] + t) for t in (-step, 0, step))
        # A point fixed to a rigid body, carried along by the body's poses.
        rotations = [Rotation.from_euler("z", states.yaws[:, None]) for states in (before, now, after)]
        local = rotations[1].inv().apply(clean.positions_world[own] - now.positions)
        moved = rotations[2].apply(local) + after.positions - rotations[0].apply(local) - before.positions
        # h²/6 times a jerk below 50 m/s³.
        np.testing.assert_allclose(moved / (2e-9 * step), clean.velocities[own], atol=1e-4)
        checked += len(own)
    assert checked > 200
    # Parts of a walker's leg swing at up to 0.3 rad x 7 rad/s x 0.9 m beside its 1.7 m/s.
    people = np.isin(clean.instances, [t.instance for t in truth.movers if t.label == "pedestrian"])
    assert np.linalg.norm(clean.velocities[people], axis=1).max(initial=0.0) < 4.0


@pytest.mark.parametrize(
    "options",
    [{}, {"seed": 1}, {"path": PathSpec(yaw_rate=1.0)}, {"path": PathSpec(stops=(Stop(1.0, 2.0),), ramp=1.0)}],
    ids=["default", "another seed", "fast rotates", "a stop"],
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

    moving = [-1, *range(count, count + len(truth.movers))]
    solid = [k for k in range(count) if boxes.labels[k] in {"building", "car", "bin", "barrier"}]
    assert len(moving) > 12
    for a, b in (*combinations(moving, 2), *((a, b) for a in moving for b in solid)):
        there = (a < 0 or boxes.present[:, a]) & (b < 0 or boxes.present[:, b])
        assert not touch(a, b, np.broadcast_to(there, len(times))), (a, b)
        assert not touch(b, a, np.broadcast_to(there, len(times))), (a, b)


def test_everyone_goes_at_the_speed_of_their_kind_and_looks_where_they_go(busy):
    times = np.arange(1_000_000_000, 2_200_000_000, 10_000_000)
    boxes = busy.truth.boxes(times)
    speeds = np.linalg.norm(boxes.velocities, axis=2)
    headings = np.arctan2(boxes.velocities[..., 1], boxes.velocities[..., 0])
    fastest = {"car": 12.0, "cyclist": 6.5, "pedestrian": 1.9}
    slowest = {"car": 3.0, "cyclist": 2.8, "pedestrian": 0.0}
    for k in range(len(busy.truth.objects), len(boxes.labels)):
        there, label = boxes.present[:, k], boxes.labels[k]
        assert (speeds[there, k] <= fastest[label]).all()
        assert (speeds[there, k] >= slowest[label]).all()
        goes = there & (speeds[:, k] > 0.3)
        off = np.angle(np.exp(1j * (headings[goes, k] - boxes.yaws[goes, k])))
        assert np.abs(off).max(initial=0.0) < 0.01


def test_in_the_egos_lane_cars_stop_and_go_with_it():
    drive = drive_through(BUSY, cameras=(), path=PathSpec(stops=(Stop(0.0, 4.0),)))
    first, times = len(drive.truth.objects), np.array([1_900_000_000, 2_100_000_000], np.int64)
    boxes = drive.truth.boxes(times)
    cars = [k for k in range(first, len(boxes.labels)) if boxes.labels[k] == "car"]
    speeds = np.linalg.norm(boxes.velocities[:, cars], axis=2)
    stationary = (speeds < 1e-6).all(axis=0)
    assert stationary.sum() >= 2
    assert (~stationary).sum() >= 2


def test_annotations_state_within_a_centimetre_and_a_tenth_of_a_degree_where_movers_are(busy):
    truth = busy.truth
    by_id = {annotation.id: annotation for annotation in busy.scene.annotations}
    first = len(truth.objects) + 1
    between = np.random.default_rng(0).integers(1_000_000_000, 2_200_000_000, 200)
    for thing in truth.movers:
        annotation = by_id[f"{thing.label}-{thing.instance}"]
        assert annotation.stationary == thing.stands
        timestamps, values = annotation.path.timestamps_ns, annotation.path.values
        assert (np.diff(timestamps) > 0).all()
        times = between if thing.stands else between[(between >= timestamps[0]) & (between <= timestamps[-1])]
        states = truth.street.movers.states(np.full(len(times), thing.instance - first), times)
        middle = states.positions + np.array([0, 0, thing.size_lwh[2] / 2])
        stated = np.column_stack([np.interp(times, timestamps, values[:, axis]) for axis in (3, 4, 5, 8)])
        assert np.abs(stated[:, :3] - middle).max(initial=0.0) < 0.01
        assert np.abs(stated[:, 3] - np.degrees(states.yaws)).max(initial=0.0) < 0.1
        assert (values[:, :3] == thing.size_lwh).all()


def alone(street, instance):
    """The street with one object in it."""
    shapes, movers = street.shapes, street.movers
    own = np.flatnonzero(shapes.instances == instance)
    if len(own):
        return Street(
            (), type(shapes)(*(getattr(shapes, name)[own] for name in shapes.__slots__)), street.ground, NO_MOVERS
        )
    nobody = type(shapes)(*(getattr(shapes, name)[:0] for name in shapes.__slots__))
    return Street(
        (),
        nobody,
        street.ground,
        replace(
            movers,
            things=tuple(
                thing if thing.instance == instance else replace(thing, first_ns=0, last_ns=-1)
                for thing in movers.things
            ),
        ),
    )


@pytest.mark.parametrize("camera_id", ["camera0", "camera1"])
def test_what_hides_an_object_is_what_an_image_of_it_alone_shows_more_of_it(busy, camera_id):
    truth, k = busy.truth, 2
    camera = truth.cameras[camera_id]
    occlusion, shown = truth.occlusion(camera_id, k), truth.instances(camera_id, k)
    assert (np.diff(occlusion.instances) > 0).all()
    moving = occlusion.instances > len(truth.objects)
    chosen = [*np.flatnonzero(moving)[:6], *np.flatnonzero(~moving)[::9]]
    assert moving.sum() >= 3
    for row in chosen:
        instance = int(occlusion.instances[row])
        single = RenderedCamera.of(
            camera.spec, alone(truth.street, instance), truth.path, timestamps_ns=camera.timestamps_ns
        )
        assert occlusion.alone_px[row] == (single.truth(k).instances == instance).sum()
        assert occlusion.visible_px[row] == (shown == instance).sum()
    assert set(np.unique(shown[shown > 0])) <= set(occlusion.instances.tolist())
    assert ((occlusion.hidden >= 0) & (occlusion.hidden <= 1)).all()
    assert occlusion.hidden.max() > 0.5


@pytest.mark.parametrize("camera_id", ["camera0", "camera1"])
def test_what_an_image_shows_of_movers_is_visible_at_its_time(busy, camera_id):
    truth, k = busy.truth, 5
    camera, image = truth.cameras[camera_id], truth.image(camera_id, k)
    rows, columns = np.nonzero(image.instances > len(truth.objects))
    assert len(rows) > 100
    camera_model = camera.spec.camera
    rays = (
        np.column_stack(
            [
                (columns - camera_model.cx) / camera_model.fx,
                (rows - camera_model.cy) / camera_model.fy,
                np.ones(len(rows)),
            ]
        )
        * image.depths[rows, columns].astype(np.float64)[:, None]
    )
    rotations, origins = camera.line_poses(k)
    line = rows if len(origins) > 1 else np.zeros(len(rows), np.int64)
    points = np.einsum("nij,nj->ni", rotations[line], rays) + origins[line]
    # float32 depths are off by 4e-6 m at 60 m; at an outline such a point may lie beside its object.
    assert truth.visible(camera_id, k, points).mean() > 0.99
    times = camera.line_times_ns(k)[line]
    first = len(truth.objects) + 1
    which = image.instances[rows, columns].astype(np.int64) - first
    states = truth.street.movers.states(which, times)
    sizes = np.array([thing.size_lwh for thing in truth.movers])[which]
    centers = states.positions + np.array([0, 0, 0.5]) * sizes
    apart = points - centers
    ahead = np.cos(states.yaws) * apart[:, 0] + np.sin(states.yaws) * apart[:, 1]
    left = np.cos(states.yaws) * apart[:, 1] - np.sin(states.yaws) * apart[:, 0]
    assert (np.abs(np.column_stack([ahead, left, apart[:, 2]])) < sizes / 2 + 1e-4).all()


def test_boxes_of_what_stands_are_there_at_all_times(busy):
    boxes = busy.truth.boxes([1_000_000_000, 1_700_000_000])
    stationary = len(busy.truth.objects)
    assert boxes.present[:, :stationary].all()
    assert not boxes.velocities[:, :stationary].any()
    for k, thing in enumerate(busy.truth.objects):
        assert boxes.instances[k] == thing.instance
        np.testing.assert_array_equal(boxes.centers_world[1, k], thing.center_world)
    assert len(boxes.labels) == stationary + len(busy.truth.movers)


def test_the_same_traffic_comes_whatever_is_asked_for_first(busy):
    again = drive_through(BUSY)
    np.testing.assert_array_equal(again.truth.instances("camera1", 8), busy.truth.instances("camera1", 8))
    for k in (9, 1, 4):
        first, second = (d.scene.lidars[0].frames[k].points for d in (again, busy))
        np.testing.assert_array_equal(first.positions, second.positions)
    other = drive_through(BUSY, seed=SEED + 1)
    assert len(other.truth.movers) != len(busy.truth.movers) or not np.array_equal(
        other.truth.street.movers.anchors, busy.truth.street.movers.anchors
    )


def test_nobody_moves_where_nobody_is_wanted():
    drive = drive_through(TrafficSpec(cars=0.0, cyclists=0.0, pedestrians=0.0), cameras=())
    assert drive.truth.movers == ()
    only = drive_through(TrafficSpec(cars=3.0, cyclists=0.0, pedestrians=0.0), cameras=())
    assert {thing.label for thing in only.truth.movers} == {"car"}


@pytest.mark.parametrize(
    "wrong", [{"cars": 7.0}, {"cyclists": -1.0}, {"pedestrians": float("nan")}, {"stationary": 1.5}, {"crossing": 0.9}]
)
def test_traffic_that_cannot_be_is_refused_by_name(wrong):
    with pytest.raises(OptionError, match=f"traffic.{next(iter(wrong))}"):
        TrafficSpec(**wrong)
