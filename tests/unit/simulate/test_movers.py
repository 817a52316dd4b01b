"""What moves, met by rays at their own times: against walks and formulas that know nothing of frames or balls."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate.casting import Rays, bundles_by_direction, cast, instances_of, paint, velocities_of
from sceneloom.simulate.objects import (
    Material,
    Mover,
    MovingDesign,
    PackedShapes,
    Part,
    Pattern,
    Shape,
    ShapeKind,
    design_cyclist,
    design_moving_car,
    design_pedestrian,
    pack_movers,
)
from sceneloom.simulate.street import GroundMap, Lane, Street

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
        Mover(first_instance + k, design.label, design.size_lwh, *spans[k], False)
        for k, design in enumerate(designs)
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
    rays = Rays.bundled(
        directions, bundles_by_direction(directions, across=4), pose_of_ray=np.arange(len(directions))
    )
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
        centers = np.column_stack(
            [60.0 + velocity[0] * seconds, -6.0 + velocity[1] * seconds, np.full(600, 0.9)]
        )
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
            for frame, part in zip(
                slow_frames(movers, seconds), (p for d in designs for p in d.parts), strict=True
            )
            for shape in part.shapes
        ]
        middles = np.array([shape.pose.translation for shape in shapes])
        aims = middles + generator.normal(0, 0.08, middles.shape) - origin
        directions = aims / np.linalg.norm(aims, axis=1, keepdims=True)
        found, _, _ = cast_one_by_one(
            street, np.tile(origin, (len(aims), 1)), directions, np.full(len(aims), seconds)
        )
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
            locations = [
                list(slow_frames(movers, seconds + shift))[part].apply(local) for shift in (-step, 0, step)
            ]
            velocity = velocities_of(street, np.array([shape]), locations[1][None], at([seconds]))[0]
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
    still, driving = (
        straight_curve((8.0, 3.0), v, 0.4, w) for v, w in (((0.0, 0.0), 0.0), ((3.0, -1.0), 0.0))
    )
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
