"""Closing of gaps against loops that do what is stated, pixel by pixel.

Triangles in an image against SciPy's interpolation.
Smoothing against the linear systems that it stands for, solved whole.
Triangulation against what a triangulation is.
"""

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import depth_completion as completion
from sceneloom.colouring.depth_completion import METHODS, complete_depth
from sceneloom.errors import ArrayError, OptionError

CAMERA = Camera("pinhole", 160, 120, 120.0, 120.0, 79.5, 59.5)


def plane(normal, distance, camera=CAMERA):
    """Depth of the plane normal · p = distance in each pixel, 0 where the pixel does not see it."""
    row, column = np.mgrid[: camera.height, : camera.width]
    x, y = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
    inverse = (normal[0] * x + normal[1] * y + normal[2]) / distance
    return np.where(inverse > 0, 1 / np.maximum(inverse, 1e-9), 0).astype(np.float32)


def scanned(depths, rows=slice(5, None, 10), columns=slice(1, None, 2)):
    """What a lidar whose scan lines are ten rows apart would see of it."""
    sparse = np.zeros_like(depths)
    sparse[rows, columns] = depths[rows, columns]
    return sparse


SLANTED = {
    "wall": ((0.0, 0.0, 1.0), 12.0),
    "wall seen from the side": ((0.8, 0.0, 0.3), 4.0),
    "road": ((0.0, 1.0, 0.25), 1.65),
    "slope": ((0.3, 0.5, 0.4), 3.0),
}


@pytest.mark.parametrize("name", SLANTED)
@pytest.mark.parametrize(
    # Quality gives it back but for the seven digits of float32, over inverse depths of a few per mille. For fast,
    # samples stand for two columns, and five pixels are averaged: a plane as steep as these bends by a few per cent.
    ("method", "margin", "most"),
    [("quality", 0, 2e-4), ("fast", 3, 0.08)],
)
def test_a_slanted_plane_comes_back_between_its_samples(name, method, margin, most):
    truth = plane(*SLANTED[name])
    truth[truth > 60] = 0
    sparse = scanned(truth)
    # pixels with samples on all sides, this far from the outer ones
    (rows, columns), inner = np.nonzero(sparse), np.zeros(sparse.shape, bool)
    inner[rows.min() + margin : rows.max() + 1 - margin, columns.min() + margin : columns.max() + 1 - margin] = True
    inner &= (truth > 0) & (truth < 30)
    assert inner.sum() > 4000
    dense = complete_depth(sparse, CAMERA, method=method)
    np.testing.assert_allclose(dense.depths[inner], truth[inner], rtol=most)


def test_no_points_give_no_depths_wrong_ones_are_refused_and_the_confidence_falls_at_a_jump():
    for method in METHODS:
        sparse = np.zeros((120, 160), np.float32)
        dense = complete_depth(sparse, CAMERA, method=method)
        assert not dense.depths.any()
        assert not dense.confidence.any()
        sparse[7, 9] = 8.0
        dense = complete_depth(sparse, CAMERA, method=method)
        np.testing.assert_array_equal(dense.depths, sparse)
        assert (dense.confidence > 0).sum() == 1
        for value in (np.nan, np.inf, -1.0):
            sparse[7, 9] = value
            with pytest.raises(ArrayError, match=r"sparse\[7, 9\]"):
                complete_depth(sparse, CAMERA, method=method)
    for height, arguments, options, error, message in [
        (120, (CAMERA, np.zeros((120, 161, 3), np.uint8)), {}, ArrayError, r"rgb: \(120, 161, 3\)"),
        (119, (CAMERA,), {}, ArrayError, r"sparse: \(119, 160\)"),
        (120, (CAMERA,), {"method": "best"}, OptionError, "fast, quality"),
        (120, (), {}, ArrayError, "camera"),
    ]:
        with pytest.raises(error, match=message):
            complete_depth(np.zeros((height, 160), np.float32), *arguments, **options)
    for method in METHODS:
        truth = np.full((120, 160), 20.0, np.float32)
        truth[80:] = 6.0
        dense = complete_depth(scanned(truth, slice(45, None, 10)), CAMERA, method=method)
        surface = dense.confidence[57:70, 20:140]
        assert surface.min() > dense.confidence[78:82, 20:140].max()
        assert surface.min() > dense.confidence[38:41, 20:140].max()
        assert ((dense.confidence > 0) == (dense.depths > 0)).all()
        assert not dense.depths[:30].any()  # nothing was measured near the sky
    for method in METHODS:
        truth, black = plane(*SLANTED["wall"]), np.zeros((120, 160, 3), np.uint8)
        with_image = complete_depth(scanned(truth), CAMERA, black, method=method)
        without = complete_depth(scanned(truth), CAMERA, method=method)
        np.testing.assert_array_equal(with_image.depths, without.depths)


def test_quality_puts_a_jump_where_the_image_has_its_edge_and_without_between_the_samples():
    truth, rgb = np.full((120, 160), 20.0, np.float32), np.full((120, 160, 3), 60, np.uint8)
    truth[:, :80], rgb[:, :80] = 6.0, 190
    # samples eight columns apart leave the position of the edge open: they end 4 px before it and begin 4 px behind it
    sparse = scanned(truth, slice(5, None, 10), slice(4, None, 8))
    guided, alone = (complete_depth(sparse, CAMERA, image).depths[10:110] for image in (rgb, None))
    kept = (dense := complete_depth(sparse, CAMERA, rgb)).above(0.9)
    np.testing.assert_array_equal(kept, np.where(dense.confidence < 0.9, 0, dense.depths))
    jumps, between = (np.argmax(depths > (6.0 + 20.0) / 2, axis=1) for depths in (guided, alone))
    assert np.abs(jumps - 80).max() <= 1
    assert ((between > 76) & (between <= 84)).all()
    # beyond three pixels nothing of the other wall is left but what no edge of an image is believed for
    assert np.abs(guided[:, 60:76] - 6).max() < 0.02
    assert np.abs(guided[:, 85:100] - 20).max() < 0.02


SHAPE = (40, 30)
STEEPEST = 0.002


def sparse_image(seed, share=0.05):
    random = np.random.default_rng(seed)
    image = random.uniform(3, 60, SHAPE).astype(np.float32)
    image[random.random(SHAPE) > share] = 0
    return image


def joined(near, to_near, other, to_other):
    gap = to_near + to_other
    inverse = (to_other / near + to_near / other) / gap
    steepness = abs(1 / near - 1 / other) / (gap * STEEPEST)
    jump = min(1.0, max(0.0, (steepness - 0.85) / 0.45))
    return (1 - jump) / inverse + jump * (to_other * near + to_near * other) / gap


@pytest.mark.parametrize("slack", [0, 1, 3])
def test_samples_are_widened_to_the_nearer_one_within_their_row(slack):
    sparse = sparse_image(slack)
    widened = np.empty_like(sparse)
    completion.widen_samples(sparse, slack, widened)
    for row in range(SHAPE[0]):
        known = np.flatnonzero(sparse[row])
        for column in range(SHAPE[1]):
            distances = np.abs(known - column)
            near = known[distances == distances.min()] if len(known) else known
            if len(near) == 0 or distances.min() > slack:
                assert widened[row, column] == 0
            else:
                assert widened[row, column] in sparse[row, near]


def test_columns_and_where_it_is_the_shorter_way_rows_are_filled_between_samples_and_a_little_beyond():
    for seed in range(3):
        sparse, longest, reach = sparse_image(seed), 12.0, 3.0
        above, distances, depths, trusts, spreads, gaps = (np.empty_like(sparse) for _ in range(6))
        completion.look_up(sparse, above, distances)
        completion.fill_down(sparse, above, distances, longest, reach, STEEPEST, depths, trusts, spreads, gaps)
        for column in range(SHAPE[1]):
            known = np.flatnonzero(sparse[:, column])
            for row in range(SHAPE[0]):
                up, down = known[known <= row], known[known >= row]
                to_up, to_down = (row - up[-1] if len(up) else 1e6), (down[0] - row if len(down) else 1e6)
                if sparse[row, column] > 0:
                    expected = sparse[row, column]
                elif to_up + to_down <= longest:
                    expected = joined(sparse[up[-1], column], to_up, sparse[down[0], column], to_down)
                elif min(to_up, to_down) <= reach:
                    expected = sparse[up[-1] if to_up < to_down else down[0], column]
                else:
                    expected = 0
                assert depths[row, column] == pytest.approx(expected, rel=1e-5)  # seven digits of float32
        assert ((depths > 0) | (trusts == 0) | (gaps > longest)).all()
    sparse = np.zeros(SHAPE, np.float32)
    sparse[5, 3], sparse[5, 9] = 10, 20
    depths, trusts, spreads, gaps = (np.zeros_like(sparse) for _ in range(4))
    depths[5, 6], gaps[5, 6] = 7, 4
    depths[5, 7], gaps[5, 7] = 7, 30
    completion.fill_across(sparse, 8.0, STEEPEST, depths, trusts, spreads, gaps)
    between = [joined(10, k, 20, 6 - k) for k in range(1, 6)]
    assert depths[5, 4:9].tolist() == pytest.approx([*between[:2], 7, *between[3:]], rel=1e-5)
    assert np.count_nonzero(depths) == 5


MESH_SHAPE = (50, 70)


@pytest.fixture
def mesh():
    random = np.random.default_rng(4)
    pixels = random.uniform([-5, -5], [75, 55], (60, 2)).astype(np.float32)
    triangulation = Delaunay(pixels.astype(float))
    return pixels, random.uniform(4, 30, 60).astype(np.float32), triangulation, triangulation.simplices.astype(np.int32)


def filled(pixels, depths, triangles, trusts, *, slopes=None, lengths=None, images=None):
    """The images that `fill_triangles` writes, from empty ones."""
    count = len(triangles)
    images = [np.zeros(MESH_SHAPE, np.float32) for _ in range(4)] if images is None else images
    slopes = np.zeros_like(pixels) if slopes is None else slopes
    lengths = np.ones(count, np.float32) if lengths is None else lengths
    completion.fill_triangles(pixels, depths, slopes, triangles, np.ones(count, bool), trusts, lengths, *images)
    return images


@pytest.mark.parametrize("trust", [1.0, 0.0, 0.3])
def test_pixels_are_filled_as_scipy_interpolates(mesh, trust):
    pixels, depths, triangulation, triangles = mesh
    count = len(triangles)
    # without slopes, what corners report one another is missed by all there is
    trusts, lengths = np.full(count, trust, np.float32), np.full(count, 9, np.float32)
    images = filled(pixels, depths, triangles, trusts, lengths=lengths)
    rows, columns = np.mgrid[: MESH_SHAPE[0], : MESH_SHAPE[1]]
    surface = 1 / LinearNDInterpolator(triangulation, 1 / depths.astype(float))(columns, rows)
    between = LinearNDInterpolator(triangulation, depths.astype(float))(columns, rows)
    at = depths[triangles[triangulation.find_simplex(np.stack([columns, rows], axis=-1).astype(float))]]
    even = np.minimum(1, at.max(-1) / at.min(-1) - 1)
    expected = trust * ((1 - even) * surface + even * between) + (1 - trust) * between
    inside = np.isfinite(expected)
    off = np.abs(images[0][inside] / expected[inside] - 1)
    # float32; pixels on the border of two triangles are reported by either, or by both
    assert np.quantile(off, 0.99) < 1e-5
    assert off.max() < 0.02
    assert (images[3][inside] == 9).all()
    # a ten-thousandth of a triangle beside the hull
    assert (~inside & (images[0] > 0)).sum() <= 0.002 * inside.sum()


def test_triangles_are_measured_and_filled_with_what_bends_evenly_and_the_image_stays_across_jumps(mesh):
    pixels, depths, _, triangles = mesh
    images = [np.zeros(MESH_SHAPE, np.float32) for _ in range(4)]
    images[0][20:30] = 5.0
    filled(pixels, depths, triangles, np.zeros(len(triangles), np.float32), images=images)
    np.testing.assert_array_equal(images[0][20:30], 5.0)
    pixels, _, triangulation, triangles = mesh
    inverse, slopes = bent(pixels)
    depths, ones = (1 / inverse).astype(np.float32), np.ones(len(triangles), np.float32)
    depth_image = filled(pixels, depths, triangles, ones, slopes=slopes.astype(np.float32))[0]
    rows, columns = np.nonzero(depth_image)
    locations = np.stack([columns, rows], axis=1)
    reported, straight = bent(locations)[0], LinearNDInterpolator(triangulation, inverse)(locations)
    known = np.isfinite(straight)
    off = np.abs(1 / depth_image[rows, columns] - reported)[known]
    # float32 reports 1e-8 of 0.06; where a location leaves the range of its corners, and where depth is taken as linear
    assert np.median(off) < 2e-8
    assert np.median(off) < 0.1 * np.median(np.abs(straight - reported)[known])
    pixels, _, _, triangles = mesh
    inverse = (0.1 + 1e-4 * pixels[:, 0] - 3e-4 * pixels[:, 1]).astype(np.float32)
    slopes, room = np.empty_like(pixels), np.empty(len(pixels), np.float32)
    completion.measure_slopes(pixels, inverse, triangles, np.ones(len(triangles), np.float32), slopes, room)
    # differences of float32 numbers of a tenth over a pixel
    np.testing.assert_allclose(slopes, np.broadcast_to([1e-4, -3e-4], slopes.shape), atol=2e-6)
    completion.measure_slopes(pixels, inverse, triangles, np.zeros(len(triangles), np.float32), slopes, room)
    assert not slopes.any()
    pixels, depths, _, triangles = mesh
    measures = np.empty((len(triangles), 3), np.float32)
    completion.measure_triangles(pixels, 1 / depths, triangles, measures)
    for triangle, (area, longest, slope) in zip(triangles, measures, strict=True):
        a, b, c = pixels[triangle].astype(float)
        assert area == pytest.approx(abs(np.linalg.det([b - a, c - a])) / 2, rel=1e-3, abs=1e-3)
        assert longest == pytest.approx(np.linalg.norm([a - b, b - c, c - a], axis=1).max(), rel=1e-5)
        y = 1 / depths[triangle].astype(float)
        gradient = np.linalg.solve([b - a, c - a], y[1:] - y[0])
        assert slope == pytest.approx(np.linalg.norm(gradient), rel=1e-2)  # differences of float32


def bent(pixels):
    """An inverse depth that bends evenly, and its slopes."""
    u, v = pixels.astype(float).T
    inverse = 0.05 + 1e-5 * u + 2e-5 * v + 4e-8 * u * u - 3e-8 * u * v + 5e-8 * v * v
    return inverse, np.stack([1e-5 + 8e-8 * u - 3e-8 * v, 2e-5 - 3e-8 * u + 1e-7 * v], axis=1)


LINKED_SHAPE = (19, 23)


def solved_along_rows(image, links, strength):
    """Each row of x that minimises sum (x - value)² + strength sum link (x - next)²."""
    solved = np.empty(image.shape)
    for row in range(image.shape[0]):
        matrix = np.eye(image.shape[1])
        for k, link in enumerate(links[row, :-1].astype(float)):
            matrix[k : k + 2, k : k + 2] += strength * link * np.array([[1, -1], [-1, 1]])
        solved[row] = np.linalg.solve(matrix, image[row].astype(float))
    return solved


@pytest.mark.parametrize("strength", [0.0, 3.0, 500.0])
def test_rows_and_columns_are_smoothed_by_least_squares(strength):
    random = np.random.default_rng(1)
    first, second, links = (random.random(LINKED_SHAPE).astype(np.float32) for _ in range(3))
    links[:, -1] = 0
    expected = [solved_along_rows(image, links, strength) for image in (first, second)]
    down = [np.ascontiguousarray(image.T) for image in (first, second)]
    completion.smooth_rightward(links, strength, first, second)
    # float32, and systems whose condition grows with the strength
    np.testing.assert_allclose([first, second], expected, atol=2e-5)
    completion.smooth_downward(np.ascontiguousarray(links.T), strength, *down, np.empty(LINKED_SHAPE[::-1], np.float32))
    np.testing.assert_allclose([image.T for image in down], expected, atol=2e-5)


def test_filled_pixels_are_blended_linked_by_the_differences_of_channels_and_graded_by_doubt_and_gap():
    image = sparse_image(7, share=0.6)
    blended = np.empty_like(image)
    completion.blend_neighbours(image, np.empty((2, image.size), np.float32), blended)
    kernel = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1])
    for row in range(2, SHAPE[0] - 2):
        for column in range(2, SHAPE[1] - 2):
            window = image[row - 2 : row + 3, column - 2 : column + 3]
            weights = kernel * (window > 0)
            expected = (weights * window).sum() / weights.sum() if image[row, column] > 0 else 0
            assert blended[row, column] == pytest.approx(expected, rel=1e-5)
    random = np.random.default_rng(2)
    rgb = random.integers(0, 256, (*LINKED_SHAPE, 3), dtype=np.uint8)
    table = np.linspace(1, 0, 766).astype(np.float32)
    rightward, downward = np.empty(LINKED_SHAPE, np.float32), np.empty(LINKED_SHAPE, np.float32)
    completion.link_pixels(rgb, table, rightward, downward)
    wide = rgb.astype(int)
    np.testing.assert_array_equal(rightward[:, :-1], table[np.abs(np.diff(wide, axis=1)).sum(axis=2)])
    np.testing.assert_array_equal(downward[:-1], table[np.abs(np.diff(wide, axis=0)).sum(axis=2)])
    assert not rightward[:, -1].any()
    assert not downward[-1].any()
    random = np.random.default_rng(3)
    depths, trusts, spreads, gaps = (random.random((9, 11)).astype(np.float32) for _ in range(4))
    depths *= 40
    depths[2] = 0
    spreads *= 5
    doubt_steps, gap_steps = np.array([0.5, 1.0], np.float32), np.array([0.1, 0.2, 0.25], np.float32)
    table, confidence = random.random((3, 4)).astype(np.float32), np.empty_like(depths)
    completion.grade_depths(
        depths, trusts, spreads, gaps, 3.0, 0.5, 0.05, 0.1, doubt_steps, gap_steps, table, confidence
    )
    for location in np.ndindex(depths.shape):
        doubt = (1 - 0.9 * trusts[location]) * spreads[location] / max(0.5, 0.05 * depths[location])
        cell = (doubt >= doubt_steps).sum(), (gaps[location] / 3 >= gap_steps).sum()
        assert confidence[location] == (table[cell] if depths[location] > 0 else 0)


def triangulated(inner, extent=1000):
    corners = [[-extent, -extent], [2 * extent, -extent], [2 * extent, 2 * extent], [-extent, 2 * extent]]
    points = np.concatenate([np.array(corners, np.int64), np.asarray(inner, np.int64).reshape(-1, 2)])
    triangles = np.empty((2 * len(points), 3), np.int32)
    count = completion.triangulate(points, np.arange(4, len(points)), triangles)
    return points, triangles[:count]


def doubled_areas(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


@pytest.mark.parametrize("kind", ["any", "grid", "lines", "circle", "one line", "same point twice", "one", "none"])
def test_no_circumcircle_holds_another_point_and_no_location_is_left_out(kind):
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    inner = {
        "any": np.random.default_rng(0).integers(0, 1000, (80, 2)),
        "grid": np.stack(np.meshgrid(np.arange(0, 100, 10), np.arange(0, 100, 10)), -1).reshape(-1, 2),
        "lines": np.array([[2 * k, 10 * line + k % 2] for line in range(4) for k in range(20)]),
        "circle": np.rint(500 + 400 * np.stack([np.cos(angles), np.sin(angles)], 1)),
        "one line": np.array([[10 * k, 50] for k in range(20)]),
        "same point twice": np.array([[5, 5], [9, 3], [5, 5], [2, 8], [9, 3]]),
        "one": np.array([[7, 7]]),
        "none": np.zeros((0, 2)),
    }[kind]
    points, triangles = triangulated(inner)
    areas = doubled_areas(points, triangles)
    assert (areas > 0).all()
    assert areas.sum() == 2 * 3000 * 3000
    distinct = len(np.unique(np.asarray(inner).reshape(-1, 2), axis=0))
    assert len(triangles) == 2 + 2 * distinct
    for triangle in triangles:
        matrix = points[triangle].astype(object)
        for point in points.astype(object):
            rows = [[x - point[0], y - point[1]] for x, y in matrix]
            (ax, ay), (bx, by), (cx, cy) = rows
            a, b, c = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
            assert ax * (by * c - cy * b) - ay * (bx * c - cx * b) + a * (bx * cy - cx * by) <= 0


def test_the_curve_visits_every_location_once_and_numbers_stay_exact_at_the_largest_extent():
    side = 32
    locations = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2).astype(np.int64)
    codes = np.empty(len(locations), np.int64)
    completion.hilbert_codes(locations, codes)
    assert len(set(codes.tolist())) == len(locations)
    steps = np.abs(np.diff(locations[np.argsort(codes)], axis=0)).sum(axis=1)
    assert (steps == 1).all()
    side, random = completion.MOST_EXTENT // 3, np.random.default_rng(0)
    inner = np.concatenate([random.integers(0, side, (200, 2)), [[0, 0], [side, 0], [side, side], [0, side]]])
    points, triangles = triangulated(inner, side)
    assert doubled_areas(points, triangles).sum() == 2 * (3 * side) ** 2
    pixels = np.array([[10, 10], [50.5, 12], [30, 40.25]], np.float32)
    np.testing.assert_array_equal(np.sort(completion.triangles_between(pixels, 60, 80)), [[0, 1, 2]])
    assert completion.triangles_between(pixels[:2], 60, 80).shape == (0, 3)
