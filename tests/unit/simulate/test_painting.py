import numpy as np
import pytest
from numba import njit
from scipy.spatial.transform import Rotation

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate import painting
from sceneloom.simulate.casting import Rays, bundles_by_direction, cast, paint
from sceneloom.simulate.street import Lane, Material, Pattern, Shape, ShapeKind

BASE, SECOND, THIRD = (200.0, 60.0, 40.0), (30.0, 90.0, 200.0), (60.0, 200.0, 90.0)


@njit
def _bands(x, period, low, high, width):
    return painting.bands(x, period, low, high, width)


@njit
def _band(x, low, high, width):
    return painting.band(x, low, high, width)


@njit
def _noise(x, y, salt, width):
    return painting.noise(x, y, salt, width)


def look(street, origin, directions, *, pixel_angle=0.0, reach=300.0):
    rays = Rays.bundled(directions, bundles_by_direction(directions))
    poses = np.eye(3)[None], np.asarray(origin, np.float64)[None]
    hits = cast(street, rays, *poses, np.zeros(1, np.int64), reach=reach)
    return hits, paint(street, rays, *poses, hits, pixel_angle=pixel_angle)


@pytest.mark.parametrize("width", [0.05, 0.3, 1.0, 2.7])
def test_stripes_are_averaged_exactly_over_a_window(width):
    for x in np.random.default_rng(0).uniform(-5, 5, 40):
        window = x + width * (np.arange(20000) + 0.5) / 20000 - width / 2
        periodic = ((window % 1.1 >= 0.2) & (window % 1.1 < 0.7)).mean()
        single = ((window >= -0.4) & (window < 1.3)).mean()
        # 20000 samples see each of at most six borders to one sample.
        assert _bands(x, 1.1, 0.2, 0.7, width) == pytest.approx(periodic, abs=3e-4)
        assert _band(x, -0.4, 1.3, width) == pytest.approx(single, abs=3e-4)


def test_edges_of_stripes_are_two_centimetres_soft_at_least():
    assert _bands(0.2, 1.0, 0.2, 0.7, 0.0) == pytest.approx(0.5)
    assert _bands(0.189, 1.0, 0.2, 0.7, 0.0) == pytest.approx(0.0)
    assert _bands(0.211, 1.0, 0.2, 0.7, 0.0) == pytest.approx(1.0)


def test_noise_is_smooth_within_one_and_gone_where_a_pixel_is_as_wide_as_its_lattice():
    x = np.linspace(-20, 20, 40001)
    values = np.array([_noise(a, 0.3 * a + 7.0, 5, 0.0) for a in x])
    assert np.abs(values).max() <= 1.0
    assert values.std() > 0.3
    # Smoothstep rises by 1.5 per cell from -1 to 1 at most, along x and 0.3 times that along y.
    assert np.abs(np.diff(values)).max() < 4.0 * 1e-3
    assert _noise(0.4, 0.6, 5, 0.8) == 0.0
    assert _noise(0.4, 0.6, 5, 0.0) != _noise(0.4, 0.6, 6, 0.0)


def excess(kind, half, local):
    x, y, z = np.abs(local / half).T
    return {
        ShapeKind.BOX: np.maximum.reduce([x, y, z]),
        ShapeKind.CYLINDER: np.maximum(np.hypot(x, y), z),
        ShapeKind.ELLIPSOID: np.sqrt(x**2 + y**2 + z**2),
        ShapeKind.GABLE: np.maximum.reduce([x, y + 0.5 * local[:, 2] / half[2] + 0.5, -local[:, 2] / half[2]]),
    }[kind]


@pytest.mark.parametrize("kind", ShapeKind)
def test_the_angle_of_incidence_is_that_to_the_slope_of_the_surface(kind, street_of, stationary_path):
    generator = np.random.default_rng(int(kind))
    half = np.array([1.5, 0.8, 2.0]) if kind is not ShapeKind.CYLINDER else np.array([1.2, 1.2, 2.0])
    pose = RigidTransform(Rotation.random(random_state=generator).as_matrix(), np.array([9.0, 1.0, 8.0]))
    shape = Shape(kind, pose, tuple(half), Material(Pattern.PLAIN, (BASE, BASE, BASE)))
    aims = pose.translation + generator.normal(0, 0.6, (400, 3)) - [0, 0, 5.0]
    directions = aims / np.linalg.norm(aims, axis=1, keepdims=True)
    hits, seen = look(street_of([shape], stationary_path), [0, 0, 5.0], directions)
    met = hits.shapes == 0
    local = pose.inverse().apply([0, 0, 5.0] + hits.ranges[met][:, None] * directions[met])
    steps = 1e-6 * np.eye(3)
    slope = np.column_stack([excess(kind, half, local + s) - excess(kind, half, local - s) for s in steps])
    normals = slope / np.linalg.norm(slope, axis=1, keepdims=True) @ pose.rotation.T
    expected = np.abs((normals * directions[met]).sum(axis=1))
    # Central differences are good to 1e-9 but where two faces meet within their step.
    assert met.sum() > 150
    assert (np.abs(seen.facings[met] - expected) < 1e-4).mean() > 0.99


def test_a_plain_surface_has_its_colour_in_the_light_of_its_face(street_of, stationary_path, box):
    street = street_of([box([10, 0, 5], [2, 2, 2], Material(Pattern.PLAIN, (BASE, BASE, BASE)))], stationary_path)
    front = look(street, [0, 0, 5], np.array([[1.0, 0, 0.01]]))[1].colors[0].astype(float)
    top = look(street, [10, 0, 15], np.array([[0.0, 0, -1.0]]))[1].colors[0].astype(float)
    for color in (front, top):
        # Plain surfaces carry 3 % of noise; a level is 0.5 to 3 % of these colours.
        np.testing.assert_allclose(color / color.sum(), np.array(BASE) / sum(BASE), atol=0.01)
    assert top.sum() > 1.2 * front.sum()


@pytest.mark.parametrize("pattern", Pattern)
def test_every_pattern_only_mixes_the_colours_of_its_palette(pattern, street_of, stationary_path, box):
    material = Material(pattern, ((255.0, 0, 0), (0, 255.0, 0), (0, 0, 255.0)), (2.0, 2.5, 0.2))
    street = street_of([box([10, 0, 3], [1, 5, 3], material), box([8, 8, 0.5], [2, 1, 0.5], material)], stationary_path)
    aims = np.random.default_rng(0).uniform([9, -5, -1.5], [9, 9, 3], (4000, 3))
    hits, seen = look(street, [0, 0, 1.6], aims / np.linalg.norm(aims, axis=1, keepdims=True))
    colors = seen.colors[hits.shapes >= 0].astype(float)
    total = colors.sum(axis=1)
    # Shares add up to one, so what differs is the light alone: 0.5 to 1.3 times 255.
    assert len(colors) > 1000
    assert total.min() > 60
    assert total.max() < 340
    assert np.ptp(colors, axis=0).max() > (3 if pattern is Pattern.PLAIN else 20)


def test_the_ground_shows_road_paint_pavement_and_grass_where_they_belong(drive):
    lane = Lane.of(drive.truth.path)

    def color_at(along, left):
        x, y, _ = lane.location(along, left)
        return look(drive.truth.street, [x, y, 0.05], np.array([[0.0, 0, -1.0]]))[1].colors[0].astype(int)

    asphalt = np.array([color_at(s, 0.3) for s in np.arange(0.5, 18, 0.5)])
    assert np.ptp(asphalt, axis=1).max() < 25
    assert 80 < asphalt.mean() < 130
    # The dashes of the middle line cover the first three of every six metres.
    assert all(color_at(s, 1.75).min() > 200 for s in (1.0, 2.0, 7.5))
    assert all(color_at(s, 1.75).max() < 140 for s in (4.0, 5.0, 10.5))
    assert all(color_at(s, -5.5).min() > 110 for s in (1.0, 5.0, 9.0))
    grass = np.array([color_at(s, -7.3) for s in np.arange(0.5, 18, 0.5)])
    assert (grass[:, 1] > grass[:, 2] + 20).all()


def test_the_sky_is_blue_above_and_pale_at_the_horizon(drive):
    up = np.array([[0.3, 0.1, 0.95], [0.1, -0.3, 0.95], [1.0, 0, 0.12], [0, 1.0, 0.12]])
    colors = look(drive.truth.street, [0, 0, 400.0], up / np.linalg.norm(up, axis=1, keepdims=True))[1].colors
    assert (colors[:, 2] >= colors[:, 0]).all()
    assert colors[2:].astype(int).sum() > colors[:2].astype(int).sum()


def test_haze_only_begins_where_the_lidar_does_not_reach(drive):
    down = np.array([[1.0, 0, -0.02], [1.0, 0, -0.005]])
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    for row, hazy in ((0, False), (1, True)):
        # Rays of no width have no haze, rays of a tiny one differ by it alone.
        bare, seen = (
            look(drive.truth.street, [-60, 80, 2.0], down[row : row + 1], pixel_angle=angle, reach=900.0)
            for angle in (0.0, 1e-9)
        )
        assert (bare[0].ranges[0] > 120) == hazy
        assert (np.abs(bare[1].colors.astype(int) - seen[1].colors).max() > 10) == hazy
