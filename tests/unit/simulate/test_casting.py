import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate.casting import Rays, bundles_by_direction, cast, instances_of
from sceneloom.simulate.lidar_radar import reflectivities_of
from sceneloom.simulate.street import Material, Pattern, Shape, ShapeKind

PLAIN = Material(Pattern.PLAIN, ((100.0, 100.0, 100.0),) * 3, reflectivity=0.3)
GROUND, SKY = -1, -2
# Bisection of the oracle ends below 1e-12 m, float64 at 100 m resolves 1e-14 m; the quadratics lose half the digits.
EXACT = 1e-7


def random_shape(generator, kind):
    pose = RigidTransform(Rotation.random(random_state=generator).as_matrix(), generator.uniform(-20, 20, 3))
    return Shape(kind, pose, tuple(generator.uniform(0.3, 3.0, 3)), PLAIN)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def rays_towards(generator, targets, origin, spread):
    return unit(targets + generator.normal(0, spread, targets.shape) - origin)


def cast_from(street, origin, directions, *, reach=200.0, bundles=None):
    bundles = bundles_by_direction(directions) if bundles is None else bundles
    return cast(
        street, Rays.bundled(directions, bundles), np.eye(3)[None], origin[None], np.zeros(1, np.int64), reach=reach
    )


@pytest.mark.parametrize("kind", ShapeKind)
@pytest.mark.few(1)
def test_the_first_hit_of_each_kind_of_body_is_where_the_slow_walk_enters_it(
    kind, street_of, stationary_path, slow_caster
):
    generator = np.random.default_rng(int(kind))
    hits = 0
    for _ in range(25):
        shape, origin = random_shape(generator, kind), generator.uniform(-30, 30, 3)
        street = street_of([shape], stationary_path)
        directions = rays_towards(generator, np.tile(shape.pose.translation, (4, 1)), origin, 0.8)
        found = cast_from(street, origin, directions)
        for k, direction in enumerate(directions):
            expected, index = slow_caster.first_hit([shape], origin, direction, 200.0)
            assert found.shapes[k] == index
            assert found.ranges[k] == pytest.approx(expected, abs=EXACT)
            hits += index == 0
    assert hits > 40


def test_a_whole_street_is_seen_as_the_slow_walk_sees_it(drive, slow_caster):
    street = drive.truth.street
    packed = street.shapes
    rotations = np.linalg.inv(packed.maps[:, :, :3] * packed.halves[:, :, None])
    poses = [RigidTransform(rotation, sphere[:3]) for rotation, sphere in zip(rotations, packed.spheres, strict=True)]
    shapes = [
        Shape(ShapeKind(kind), pose, tuple(half), PLAIN)
        for kind, pose, half in zip(packed.kinds, poses, packed.halves, strict=True)
    ]
    generator = np.random.default_rng(5)
    origin = np.array([0.0, 0.0, 1.7])
    directions = unit(generator.normal(0, [1, 1, 0.08], (60, 3)))
    found = cast_from(street, origin, directions, reach=120.0)
    for k, direction in enumerate(directions):
        expected, index = slow_caster.first_hit(shapes, origin, direction, 120.0)
        assert found.shapes[k] == index
        assert found.ranges[k] == pytest.approx(expected, abs=EXACT)
    assert {GROUND, SKY} < set(found.shapes.tolist())


def test_the_answers_do_not_depend_on_how_rays_are_bundled(drive):
    generator = np.random.default_rng(1)
    directions = unit(generator.normal(0, [1, 1, 0.2], (4000, 3)))
    origin = np.array([1.0, 0.3, 1.6])
    alone = cast_from(drive.truth.street, origin, directions, bundles=np.arange(4000))
    for bundles in (np.zeros(4000, np.int64), bundles_by_direction(directions), np.arange(4000) // 100):
        together = cast_from(drive.truth.street, origin, directions, bundles=bundles)
        np.testing.assert_array_equal(together.shapes, alone.shapes)
        np.testing.assert_array_equal(together.ranges, alone.ranges)


def test_rays_of_one_bundle_can_start_from_different_poses(drive):
    street = drive.truth.street
    generator = np.random.default_rng(2)
    directions = unit(generator.normal(0, [1, 1, 0.2], (300, 3)))
    origins = np.array([[0.0, 0, 1.6], [0.7, 0.1, 1.7], [1.5, -0.2, 1.8]])
    rotations = Rotation.from_rotvec([[0, 0, 0.0], [0, 0, 0.1], [0, 0, -0.2]]).as_matrix()
    pose_of_ray = generator.integers(0, 3, 300)
    mixed = Rays.bundled(directions, np.arange(300) // 64, pose_of_ray=pose_of_ray)
    found = cast(street, mixed, rotations, origins, np.zeros(3, np.int64), reach=120.0)
    for pose in range(3):
        own = pose_of_ray == pose
        expected = cast_from(street, origins[pose], directions[own] @ rotations[pose].T, reach=120.0)
        np.testing.assert_array_equal(found.shapes[own], expected.shapes)
        np.testing.assert_allclose(found.ranges[own], expected.ranges, atol=EXACT)


def test_the_nearest_of_several_shapes_wins_in_whatever_order_they_come(street_of, stationary_path, box):
    near, far = box([10, 0, 2], [1, 2, 2]), box([20, 0, 2], [1, 9, 2])
    origin, ahead = np.array([0.0, 0, 2.5]), np.array([[1.0, 0, 0]])
    for shapes in ([near, far], [far, near]):
        found = cast_from(street_of(shapes, stationary_path), origin, ahead)
        assert found.ranges[0] == pytest.approx(9.0, abs=EXACT)
        assert shapes[found.shapes[0]] is near


def test_the_ground_is_met_at_height_over_slope_and_the_sky_nowhere(street_of, stationary_path, box):
    street = street_of([box([0, 50, 2], [1, 1, 1])], stationary_path)
    directions = unit(np.array([[1.0, 0, -0.5], [1.0, 0, 0.5], [1.0, 0, 0.0], [1.0, 0, -0.001]]))
    found = cast_from(street, np.array([0.0, 0, 2.0]), directions)
    assert found.shapes.tolist() == [GROUND, SKY, SKY, SKY]
    assert found.ranges[0] == pytest.approx(np.hypot(4, 2), abs=EXACT)
    assert found.ranges[1:].tolist() == [0, 0, 0]
    assert instances_of(street, found).tolist() == [0, -1, -1, -1]
    assert reflectivities_of(street, found)[1:].tolist() == [0, 0, 0]


def test_hits_are_reported_by_the_number_of_their_object(street_of, stationary_path, box):
    street = street_of([box([0, 50, 2], [1, 1, 1], PLAIN), box([10, 0, 2], [1, 1, 1], PLAIN)], stationary_path)
    found = cast_from(street, np.array([0.0, 0, 2.0]), np.array([[1.0, 0, 0]]))
    assert instances_of(street, found).tolist() == [2]
    assert reflectivities_of(street, found).tolist() == [0.3]


def test_a_ray_that_starts_inside_a_shape_does_not_see_it(street_of, stationary_path, box):
    street = street_of([box([0, 0, 5], [2, 2, 2]), box([10, 0, 5], [1, 1, 1])], stationary_path)
    found = cast_from(street, np.array([0.0, 0, 5.0]), np.array([[1.0, 0, 0]]))
    assert found.shapes.tolist() == [1]


def test_nothing_is_met_beyond_the_reach(street_of, stationary_path, box):
    street = street_of([box([10, 0, 2], [1, 1, 1])], stationary_path)
    origin, ahead = np.array([0.0, 0, 2.0]), np.array([[1.0, 0, 0]])
    assert cast_from(street, origin, ahead, reach=8.9).shapes.tolist() == [SKY]
    assert cast_from(street, origin, ahead, reach=9.1).shapes.tolist() == [0]


def test_rays_that_are_not_finite_leave_their_slots_empty(street_of, stationary_path, box):
    street = street_of([box([10, 0, 2], [1, 9, 9])], stationary_path)
    directions = np.array([[1.0, 0, 0], [np.nan] * 3, [1.0, 0, 0]])
    found = cast_from(street, np.array([0.0, 0, 2.0]), directions, bundles=np.zeros(3, np.int64))
    assert found.shapes.tolist() == [0, SKY, 0]
    assert found.ranges.tolist() == [9.0, 0.0, 9.0]


def test_no_rays_at_all_meet_nothing(drive):
    found = cast_from(drive.truth.street, np.zeros(3), np.zeros((0, 3)))
    assert found.shapes.shape == (0,)


def test_directions_under_one_number_lie_within_a_few_degrees():
    directions = unit(np.random.default_rng(0).normal(size=(20000, 3)))
    numbers = bundles_by_direction(directions)
    order = np.argsort(numbers, kind="stable")
    same = numbers[order][1:] == numbers[order][:-1]
    cosines = (directions[order][1:] * directions[order][:-1]).sum(axis=1)[same]
    # A cell of a cube's face is 2/64 wide; its diagonal in the middle of the face is the longest: 2.6 degrees.
    assert same.sum() > 3000
    assert np.degrees(np.arccos(cosines.min())) < 2.7
