"""Triangles in an image against SciPy's interpolation, and votes across jumps against sums in double precision.

Triangulation against what a triangulation is, and its neighbours against SciPy's.
"""

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay
from scipy.special import expit

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import depth_completion as completion
from sceneloom.colouring.depth_completion import complete_depth
from sceneloom.errors import ArrayError

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
def test_a_slanted_plane_comes_back_between_its_samples(name):
    truth = plane(*SLANTED[name])
    truth[truth > 60] = 0
    sparse = scanned(truth)
    # pixels with samples on all sides
    (rows, columns), inner = np.nonzero(sparse), np.zeros(sparse.shape, bool)
    inner[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = True
    inner &= (truth > 0) & (truth < 30)
    assert inner.sum() > 4000
    dense = complete_depth(sparse, CAMERA)
    # the seven digits of float32, over inverse depths of a few per mille
    np.testing.assert_allclose(dense.depths[inner], truth[inner], rtol=2e-4)


def test_no_points_give_no_depths_wrong_ones_are_refused_and_the_confidence_falls_at_a_jump():
    sparse = np.zeros((120, 160), np.float32)
    dense = complete_depth(sparse, CAMERA)
    assert not dense.depths.any()
    assert not dense.confidence.any()
    sparse[7, 9] = 8.0
    dense = complete_depth(sparse, CAMERA)
    np.testing.assert_array_equal(dense.depths, sparse)
    assert (dense.confidence > 0).sum() == 1
    for value in (np.nan, np.inf, -1.0):
        sparse[7, 9] = value
        with pytest.raises(ArrayError, match=r"sparse\[7, 9\]"):
            complete_depth(sparse, CAMERA)
    for height, arguments, message in [
        (120, (CAMERA, np.zeros((120, 161, 3), np.uint8)), r"rgb: \(120, 161, 3\)"),
        (119, (CAMERA,), r"sparse: \(119, 160\)"),
        (120, (), "camera"),
    ]:
        with pytest.raises(ArrayError, match=message):
            complete_depth(np.zeros((height, 160), np.float32), *arguments)
    truth = np.full((120, 160), 20.0, np.float32)
    truth[80:] = 6.0
    dense = complete_depth(scanned(truth, slice(45, None, 10)), CAMERA)
    surface = dense.confidence[57:64, 20:140]
    assert surface.min() > dense.confidence[78:82, 20:140].max()
    assert ((dense.confidence > 0) == (dense.depths > 0)).all()
    assert not dense.depths[:45].any()  # nothing was measured in the sky
    truth, black = plane(*SLANTED["wall"]), np.zeros((120, 160, 3), np.uint8)
    with_image, without = complete_depth(scanned(truth), CAMERA, black), complete_depth(scanned(truth), CAMERA)
    np.testing.assert_array_equal(with_image.depths, without.depths)


def test_a_jump_is_where_the_image_has_its_edge_if_colours_tell_surfaces_apart_and_else_between_the_samples():
    truth, rgb = np.full((120, 160), 20.0, np.float32), np.full((120, 160, 3), 60, np.uint8)
    truth[:, :80], rgb[:, :80] = 6.0, 190
    # samples leave the position of the edge open: they end 7 px before it and begin 1 px behind it
    columns = np.r_[1:80:8, 81:160:8]
    sparse = np.zeros_like(truth)
    sparse[5::5, columns] = truth[5::5, columns]
    noise = np.random.default_rng(0).integers(0, 256, rgb.shape, dtype=np.uint8)
    guided, alone, misled = (complete_depth(sparse, CAMERA, image).depths[10:110] for image in (rgb, None, noise))
    kept = (dense := complete_depth(sparse, CAMERA, rgb)).above(0.9)
    np.testing.assert_array_equal(kept, np.where(dense.confidence < 0.9, 0, dense.depths))
    beside_edge = np.abs(guided - truth[10:110])[:, 74:80]
    assert beside_edge.mean() < 0.5 * np.abs(alone - truth[10:110])[:, 74:80].mean()
    # an image that tells nothing changes little
    assert np.abs(misled - alone).mean() < 0.2
    np.testing.assert_allclose(guided[:, 2:72], 6, atol=0.02)  # a thousandth of the votes is of the wall 14 m behind
    np.testing.assert_allclose(guided[:, 90:150], 20, atol=0.01)


def test_a_hole_is_filled_where_its_rims_are_of_one_surface_and_stays_empty_between_two():
    def filled_between(last, first, left):
        """Near samples up to a column, a wall at 20 m from another one on."""
        truth = np.full((120, 160), 20.0, np.float32)
        truth[:, :80] = left
        columns = np.r_[1 : last + 1 : 2, first:160:2]
        sparse = np.zeros_like(truth)
        sparse[5::10, columns] = truth[5::10, columns]
        return complete_depth(sparse, CAMERA).depths[15:105]

    np.testing.assert_allclose(filled_between(61, 97, 20.0)[:, 1:-2], 20, rtol=1e-5)  # a hole of 3.6 spacings
    assert not filled_between(61, 97, 2.5)[:, 66:93].any()
    assert filled_between(61, 81, 2.5)[:, 1:-2].all()  # two spacings


MESH_SHAPE = (50, 70)


@pytest.fixture
def mesh():
    random = np.random.default_rng(4)
    pixels = random.uniform([-5, -5], [75, 55], (60, 2)).astype(np.float32)
    triangulation = Delaunay(pixels.astype(float))
    return pixels, random.uniform(4, 30, 60).astype(np.float32), triangulation, triangulation.simplices.astype(np.int32)


RGB = np.random.default_rng(5).integers(0, 256, (*MESH_SHAPE, 3), dtype=np.uint8)
LIKENESS = np.linspace(2, 0.1, 766).astype(np.float32)
UNIT = 1.5


def points_beyond(mesh):
    """The point beyond the side opposite each corner of each triangle, -1 for none."""
    _, _, triangulation, triangles = mesh
    beyond = np.full_like(triangles, -1)
    for t, neighbours in enumerate(triangulation.neighbors):
        for k, other in enumerate(neighbours):
            if other >= 0:
                beyond[t, k] = next(iter(set(triangles[other].tolist()) - set(triangles[t].tolist())))
    return beyond


def filled(mesh, *, planar):
    """The images that `fill_triangles` writes, and the colours of the points."""
    pixels, depths, _, triangles = mesh
    images = [np.zeros(MESH_SHAPE, np.float32) for _ in range(3)]
    colours = np.random.default_rng(6).integers(0, 256, (len(pixels), 3), dtype=np.uint8)
    count = len(triangles)
    completion.fill_triangles(
        pixels, depths, triangles, points_beyond(mesh), np.ones(count, bool), np.full(count, planar), RGB, colours,
        LIKENESS, UNIT, 0.5, 0.05, *images,
    )  # fmt: skip
    return images, colours


def voted(mesh, voters, colours, location):
    """The depth that points vote for in a pixel, the votes without colours and the votes, in double precision."""
    pixels, depths = mesh[0].astype(float), mesh[1].astype(float)
    row, column = location
    du, dv = (pixels[voters] - [column, row]).T
    off, du, dv = dv / 0.3, du / UNIT, dv / UNIT
    plain = 1 / (du**2 + 1 + (0.5 * dv) ** 2) ** 1.5 + 600 / ((du**2 + 1) ** 3 * (1 + off**4))
    votes = plain * LIKENESS[np.abs(RGB[row, column].astype(int) - colours[voters].astype(int)).sum(axis=1)]
    order = np.argsort(depths[voters])
    median = depths[voters][order][np.searchsorted(np.cumsum(votes[order]), votes.sum() / 2)]
    return 0.85 * (votes @ depths[voters]) / votes.sum() + 0.15 * median, plain / plain.sum(), votes / votes.sum()


def test_surfaces_are_filled_as_scipy_interpolates_and_jumps_by_the_votes_of_six_points(mesh):
    _, depths, triangulation, triangles = mesh
    rows, columns = np.mgrid[: MESH_SHAPE[0], : MESH_SHAPE[1]]
    expected = 1 / LinearNDInterpolator(triangulation, 1 / depths.astype(float))(columns, rows)
    inside = np.isfinite(expected)
    (found, supports, _), _ = filled(mesh, planar=True)
    off = np.abs(found[inside] / expected[inside] - 1)
    # float32; pixels on the border of two triangles are of either
    assert np.quantile(off, 0.99) < 1e-5
    assert off.max() < 0.02
    # a ten-thousandth of a triangle beside the hull
    assert (~inside & (found > 0)).sum() <= 0.002 * inside.sum()
    assert (supports[inside] == 2).all()
    of_pixel = triangulation.find_simplex(np.stack([columns, rows], axis=-1).astype(float))
    (jumps, shares, spreads), colours = filled(mesh, planar=False)
    beyond, missed = points_beyond(mesh), 0
    for location in zip(*np.nonzero(inside), strict=True):
        t = of_pixel[location]
        voters = np.array([*triangles[t], *(other for other in beyond[t] if other >= 0)])
        depth, plain, votes = voted(mesh, voters, colours, location)
        off, allowed = depths[voters] - jumps[location], max(0.5, 0.05 * jumps[location])
        near, spread = plain[np.abs(off) < allowed].sum(), np.sqrt(votes @ off**2) / allowed
        measured = [jumps[location], shares[location], spreads[location]]
        missed += not np.allclose(measured, [depth, near, spread], rtol=1e-4, atol=1e-4)
    assert missed <= 0.01 * inside.sum()  # on borders of triangles, and where half of the votes is reached by rounding


def test_triangles_are_measured_and_know_the_points_beyond_their_sides(mesh):
    pixels, _, _, triangles = mesh
    random = np.random.default_rng(9)
    depths = (1 / (0.1 + pixels @ [0.0004, 0.0007] + random.choice([0, 0.03], 60, p=[0.8, 0.2]))).astype(np.float32)
    measures, beyond = np.empty((len(triangles), 5), np.float32), points_beyond(mesh)
    completion.measure_triangles(pixels, depths, triangles, beyond, 0.5, 0.05, measures)
    assert len(np.unique(measures[:, 4])) > 3  # none, some and all of them are in the plane
    for triangle, sides, (area, longest, shortest, slope, planar) in zip(triangles, beyond, measures, strict=True):
        a, b, c = pixels[triangle].astype(float)
        assert area == pytest.approx(abs(np.linalg.det([b - a, c - a])) / 2, rel=1e-3, abs=1e-3)
        assert longest == pytest.approx(np.linalg.norm([a - b, b - c, c - a], axis=1).max(), rel=1e-5)
        assert shortest == pytest.approx(np.linalg.norm([a - b, b - c, c - a], axis=1).min(), rel=1e-5)
        y = 1 / depths[triangle].astype(float)
        gradient = np.linalg.solve([b - a, c - a], y[1:] - y[0])
        assert slope == pytest.approx(np.linalg.norm(gradient), rel=1e-2, abs=1e-6)  # differences of float32
        others = sides[sides >= 0]
        inverse = y[0] + (pixels[others] - a) @ gradient
        near = np.abs(1 / inverse - depths[others]) < np.maximum(0.5, 0.05 * depths[others])
        assert planar == pytest.approx((near & (inverse > 0)).mean() if len(others) else 1, abs=1e-6)
    pixels = np.random.default_rng(8).uniform(0, [70, 50], (60, 2)).astype(np.float32)
    triangulation = Delaunay(pixels.astype(float))
    theirs = {}
    for corners, neighbours in zip(triangulation.simplices, triangulation.neighbors, strict=True):
        for k, other in enumerate(neighbours):
            side = frozenset(np.delete(corners, k).tolist())
            point = set(triangulation.simplices[other].tolist()) - side if other >= 0 else {-1}
            theirs[corners[k], side] = point.pop()
    ours = {
        (corners[k], frozenset(np.delete(corners, k).tolist())): points[k]
        for corners, points in zip(*completion.triangles_between(pixels, 50, 70), strict=True)
        for k in range(3)
    }
    # flat triangles at the hull may be inside for one and outside for the other
    assert len(ours.keys() & theirs.keys()) > 0.97 * len(theirs)
    assert sum(ours[key] == theirs[key] for key in ours.keys() & theirs.keys()) > 0.97 * len(theirs)


def test_the_likeness_of_colours_is_measured_across_jumps_and_pixels_are_graded_by_their_votes():
    depths = np.tile(np.array([5.0, 5.1, 9.0], np.float32), 200)
    colours = np.tile(np.array([[100] * 3, [101] * 3, [180] * 3], np.uint8), (200, 1))
    triangles = np.arange(600, dtype=np.int32).reshape(-1, 3)
    likeness = completion._likeness(depths, colours, triangles)
    assert likeness.shape == (766,)
    assert (np.diff(likeness) <= 0).all()
    assert likeness[3] > 10 * likeness[240]
    np.testing.assert_allclose(completion._likeness(depths, colours * 0, triangles), 1, rtol=1e-5)
    np.testing.assert_allclose(completion._likeness(depths, colours, triangles[:0]), 1, rtol=1e-5)
    random = np.random.default_rng(3)
    depths = random.random((9, 11)).astype(np.float32) * 40
    supports = random.choice([0, 0.05, 0.3, 0.9, 1, 2], (9, 11)).astype(np.float32)
    spreads = random.choice([0, 0.3, 4, 200], (9, 11)).astype(np.float32)
    depths[2] = 0
    weights, planes, confidence = np.array([0.5, 0.7, -0.9, -0.2], np.float32), 0.95, np.empty_like(depths)
    completion.grade_depths(depths, supports, spreads, weights, planes, confidence)
    share = supports.astype(float).clip(0.02, 0.98)
    parts = [np.log(share / (1 - share)), np.log(spreads.clip(0.01, 100)), np.log(depths.clip(10) / 10)]
    expected = np.where(supports == 2, planes, expit(weights[0] + np.tensordot(weights[1:], parts, 1)))
    np.testing.assert_allclose(confidence, np.where(depths > 0, expected, 0), atol=1e-6)


def triangulated(inner, extent=1000):
    corners = [[-extent, -extent], [2 * extent, -extent], [2 * extent, 2 * extent], [-extent, 2 * extent]]
    points = np.concatenate([np.array(corners, np.int64), np.asarray(inner, np.int64).reshape(-1, 2)])
    triangles, beside = (np.full((2 * len(points), 3), -1, np.int32) for _ in range(2))
    count = completion.triangulate(points, np.arange(4, len(points)), triangles, beside)
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
    np.testing.assert_array_equal(np.sort(completion.triangles_between(pixels, 60, 80)[0]), [[0, 1, 2]])
    assert completion.triangles_between(pixels[:2], 60, 80)[0].shape == (0, 3)
