import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring.depth_completion import METHODS, complete_depth
from sceneloom.errors import ArrayError, OptionError

CAMERA = Camera("pinhole", 160, 120, 120.0, 120.0, 79.5, 59.5)


def directions(camera=CAMERA):
    row, column = np.mgrid[: camera.height, : camera.width]
    return (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy


def plane(normal, distance, camera=CAMERA):
    """Depth of the plane normal · p = distance in each pixel, 0 where the pixel does not see it."""
    x, y = directions(camera)
    inverse = (normal[0] * x + normal[1] * y + normal[2]) / distance
    return np.where(inverse > 0, 1 / np.maximum(inverse, 1e-9), 0).astype(np.float32)


def scanned(depths, rows=slice(5, None, 10), columns=slice(1, None, 2)):
    """What a lidar whose scan lines are ten rows apart would see of it."""
    sparse = np.zeros_like(depths)
    sparse[rows, columns] = depths[rows, columns]
    return sparse


def between_samples(sparse, margin):
    """Pixels with samples on all sides, this far from the outer ones."""
    rows, columns = np.nonzero(sparse)
    inner = np.zeros(sparse.shape, bool)
    inner[
        rows.min() + margin : rows.max() + 1 - margin, columns.min() + margin : columns.max() + 1 - margin
    ] = True
    return inner


SLANTED = {
    "wall": ((0.0, 0.0, 1.0), 12.0),
    "wall seen from the side": ((0.8, 0.0, 0.3), 4.0),
    "road": ((0.0, 1.0, 0.25), 1.65),
    "slope": ((0.3, 0.5, 0.4), 3.0),
}


@pytest.mark.parametrize("name", SLANTED)
def test_quality_gives_back_a_slanted_plane_between_its_samples_exactly(name):
    truth = plane(*SLANTED[name])
    truth[truth > 60] = 0
    sparse = scanned(truth)
    dense = complete_depth(sparse, CAMERA)
    inner = between_samples(sparse, 0) & (truth > 0) & (truth < 30)
    assert inner.sum() > 5000
    # seven digits of float32, over inverse depths of a few per mille
    np.testing.assert_allclose(dense.depths[inner], truth[inner], rtol=2e-4)


@pytest.mark.parametrize("name", SLANTED)
def test_fast_comes_near_to_a_slanted_plane(name):
    truth = plane(*SLANTED[name])
    truth[truth > 60] = 0
    sparse = scanned(truth)
    dense = complete_depth(sparse, CAMERA, method="fast")
    inner = between_samples(sparse, 3) & (truth > 0) & (truth < 30)
    # samples stand for two columns, and five pixels are averaged: a plane as steep as these bends by a few per cent
    assert np.abs(dense.depths[inner] / truth[inner] - 1).max() < 0.08


@pytest.mark.parametrize("method", METHODS)
def test_no_points_give_no_depths(method):
    dense = complete_depth(np.zeros((120, 160), np.float32), CAMERA, method=method)
    assert not dense.depths.any()
    assert not dense.confidence.any()


@pytest.mark.parametrize("method", METHODS)
def test_one_point_stays_one_point(method):
    sparse = np.zeros((120, 160), np.float32)
    sparse[40, 70] = 8.0
    dense = complete_depth(sparse, CAMERA, method=method)
    np.testing.assert_array_equal(dense.depths, sparse)
    assert (dense.confidence > 0).sum() == 1


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_depths_that_are_none_are_refused_with_their_location(method, value):
    sparse = np.zeros((120, 160), np.float32)
    sparse[7, 9] = value
    with pytest.raises(ArrayError, match=r"sparse\[7, 9\]"):
        complete_depth(sparse, CAMERA, method=method)


def test_an_image_of_another_size_than_the_camera_is_refused():
    with pytest.raises(ArrayError, match=r"rgb: \(120, 161, 3\)"):
        complete_depth(np.zeros((120, 160), np.float32), CAMERA, np.zeros((120, 161, 3), np.uint8))
    with pytest.raises(ArrayError, match=r"sparse: \(119, 160\)"):
        complete_depth(np.zeros((119, 160), np.float32), CAMERA)


def test_a_method_that_is_not_known_is_refused_with_those_that_are():
    with pytest.raises(OptionError, match="fast, quality"):
        complete_depth(np.zeros((120, 160), np.float32), CAMERA, method="best")


def test_a_depth_image_without_its_camera_is_refused():
    with pytest.raises(ArrayError, match="camera"):
        complete_depth(np.zeros((120, 160), np.float32))


def two_walls(edge=80, near=6.0, far=20.0):
    """A near wall left of an edge and a far one right of it, and their image."""
    truth = np.full((120, 160), far, np.float32)
    truth[:, :edge] = near
    rgb = np.full((120, 160, 3), 60, np.uint8)
    rgb[:, :edge] = 190
    return truth, rgb


def test_quality_puts_a_jump_where_the_image_has_its_edge():
    truth, rgb = two_walls()
    # samples eight columns apart leave the position of the edge open: they end 4 px before it and begin 4 px behind it
    sparse = scanned(truth, slice(5, None, 10), slice(4, None, 8))
    dense = complete_depth(sparse, CAMERA, rgb)
    rows = slice(10, 110)
    half = (6.0 + 20.0) / 2
    jumps = np.argmax(dense.depths[rows] > half, axis=1)
    assert np.abs(jumps - 80).max() <= 1
    # beyond three pixels nothing of the other wall is left but what no edge of an image is believed for
    assert np.abs(dense.depths[rows, 60:76] - 6).max() < 0.02
    assert np.abs(dense.depths[rows, 85:100] - 20).max() < 0.02


def test_quality_without_an_image_puts_the_jump_between_the_samples():
    truth, _ = two_walls()
    dense = complete_depth(scanned(truth, slice(5, None, 10), slice(4, None, 8)), CAMERA)
    jumps = np.argmax(dense.depths[10:110] > 13.0, axis=1)
    assert ((jumps > 76) & (jumps <= 84)).all()


@pytest.mark.parametrize("method", METHODS)
def test_the_confidence_falls_at_a_jump_and_beyond_the_last_samples(method):
    truth = np.full((120, 160), 20.0, np.float32)
    truth[80:] = 6.0
    dense = complete_depth(scanned(truth, slice(45, None, 10)), CAMERA, method=method)
    surface = dense.confidence[57:70, 20:140]
    assert surface.min() > dense.confidence[78:82, 20:140].max()
    assert surface.min() > dense.confidence[38:41, 20:140].max()
    assert ((dense.confidence > 0) == (dense.depths > 0)).all()
    assert not dense.depths[:30].any()  # nothing was measured near the sky


@pytest.mark.parametrize("method", METHODS)
def test_a_black_image_changes_nothing_of_a_plane(method):
    truth = plane(*SLANTED["wall"])
    black = np.zeros((120, 160, 3), np.uint8)
    with_image = complete_depth(scanned(truth), CAMERA, black, method=method)
    without = complete_depth(scanned(truth), CAMERA, method=method)
    np.testing.assert_array_equal(with_image.depths, without.depths)


def test_depths_below_a_confidence_are_taken_away():
    truth, rgb = two_walls()
    dense = complete_depth(scanned(truth), CAMERA, rgb)
    kept = dense.above(0.9)
    assert (kept[dense.confidence < 0.9] == 0).all()
    np.testing.assert_array_equal(kept[dense.confidence >= 0.9], dense.depths[dense.confidence >= 0.9])
