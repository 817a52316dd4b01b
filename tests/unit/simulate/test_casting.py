"""What rays meet, against a slow walk along each of them, and which colours surfaces have there."""

import numpy as np
import pytest
from numba import njit
from scipy.spatial.transform import Rotation
from tests.unit.simulate.scenery import EXACT, GROUND, PLAIN, SKY, box, excess, first_hit, street_of, unit

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import casting
from sceneloom.simulate.casting import Rays, bundles_by_direction, cast, instances_of, paint
from sceneloom.simulate.lidar_radar import reflectivities_of
from sceneloom.simulate.street import Lane, Material, Pattern, Shape, ShapeKind

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


def test_the_answers_do_not_depend_on_how_rays_are_bundled_which_may_start_from_different_poses(drive):
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


def test_directions_under_one_number_lie_within_a_few_degrees():
    directions = unit(np.random.default_rng(0).normal(size=(20000, 3)))
    numbers = bundles_by_direction(directions)
    order = np.argsort(numbers, kind="stable")
    same = numbers[order][1:] == numbers[order][:-1]
    cosines = (directions[order][1:] * directions[order][:-1]).sum(axis=1)[same]
    # A cell of a cube's face is 2/64 wide; its diagonal in the middle of the face is the longest: 2.6 degrees.
    assert same.sum() > 3000
    assert np.degrees(np.arccos(cosines.min())) < 2.7


BASE = (200.0, 60.0, 40.0)


@njit
def _bands(x, period, low, high, width):
    return casting._bands(x, period, low, high, width)


@njit
def _band(x, low, high, width):
    return casting._band(x, low, high, width)


@njit
def _noise(x, y, salt, width):
    return casting._noise(x, y, salt, width)


def test_stripes_are_averaged_exactly_over_a_window_and_noise_is_gone_where_a_pixel_is_as_wide_as_its_lattice():
    for width in (0.05, 0.3, 1.0, 2.7):
        for x in np.random.default_rng(0).uniform(-5, 5, 40):
            window = x + width * (np.arange(20000) + 0.5) / 20000 - width / 2
            periodic = ((window % 1.1 >= 0.2) & (window % 1.1 < 0.7)).mean()
            single = ((window >= -0.4) & (window < 1.3)).mean()
            # 20000 samples see each of at most six borders to one sample.
            assert _bands(x, 1.1, 0.2, 0.7, width) == pytest.approx(periodic, abs=3e-4)
            assert _band(x, -0.4, 1.3, width) == pytest.approx(single, abs=3e-4)
    # edges are two centimetres soft at least
    assert [_bands(x, 1.0, 0.2, 0.7, 0.0) for x in (0.189, 0.2, 0.211)] == pytest.approx([0.0, 0.5, 1.0])
    values = np.array([_noise(a, 0.3 * a + 7.0, 5, 0.0) for a in np.linspace(-20, 20, 40001)])
    assert np.abs(values).max() <= 1.0
    assert values.std() > 0.3
    # Smoothstep rises by 1.5 per cell from -1 to 1 at most, along x and 0.3 times that along y.
    assert np.abs(np.diff(values)).max() < 4.0 * 1e-3
    assert _noise(0.4, 0.6, 5, 0.8) == 0.0
    assert _noise(0.4, 0.6, 5, 0.0) != _noise(0.4, 0.6, 6, 0.0)


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
        [excess(kind, (local + s) / half) - excess(kind, (local - s) / half) for s in 1e-6 * np.eye(3)]
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
