"""Boxes in images: plain cases by hand, all others against OpenCV and against very many rays and points."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, unproject
from sceneloom.colouring.cuboid_projection import observe_cuboids
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Boxes

HERE = RigidTransform.identity()
PINHOLE = Camera("pinhole", 800, 600, 500.0, 500.0, 399.5, 299.5)
BARREL = Camera("brown_conrady", 800, 600, 500.0, 500.0, 399.5, 299.5, (-0.3, 0.1, 0.001, -0.001, -0.01))
FISHEYE = Camera("fisheye", 800, 600, 260.0, 260.0, 399.5, 299.5, (0.03, -0.008, 0.002, -0.0004))
CYLINDER = Camera("cylindrical", 800, 600, 220.0, 220.0, 399.5, 299.5)
CAMERA_MODELS = {"pinhole": PINHOLE, "barrel": BARREL, "fisheye": FISHEYE, "cylinder": CYLINDER}

AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]).T
"""Columns: forward, left and up of a box that looks away from the camera, in the camera's frame."""

ON_GRID = 0.03
"""Shares are reported by grids of 24 steps: what a border does in one row or column of cells.

And chance in the oracle.
"""


def some_boxes(centers, sizes, quaternions=None):
    count = len(centers)
    rotations = Rotation.from_matrix(AXES).as_quat() if quaternions is None else quaternions
    return Boxes(
        tuple(range(count)),
        (None,) * count,
        np.array(centers, np.float64),
        np.array(sizes, np.float64),
        np.broadcast_to(rotations, (count, 4)).astype(np.float64),
    )


def surface(size, count=120):
    """Points on all faces of a box in its own frame."""
    steps = np.linspace(-0.5, 0.5, count)
    first, second = (grid.ravel() for grid in np.meshgrid(steps, steps))
    faces = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            face = np.empty((count * count, 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, first, second
            faces.append(face * size)
    return np.concatenate(faces)


def opencv_pixels(camera_model, points):
    """Pixels of points ahead of the camera as OpenCV has them."""
    matrix, ahead = camera_model.matrix, points[points[:, 2] > 0.01]
    if camera_model.model == "fisheye":
        return cv2.fisheye.projectPoints(
            ahead[:, None], np.zeros(3), np.zeros(3), matrix, np.array(camera_model.coefficients)
        )[0][:, 0]
    return cv2.projectPoints(
        ahead, np.zeros(3), np.zeros(3), matrix, np.array(camera_model.coefficients or (0.0,) * 4)
    )[0][:, 0]


def random_box(seed, ahead=1.0):
    generator = np.random.default_rng(seed)
    center = generator.uniform([-6, -2, ahead - 1], [6, 2, ahead + 14])
    return center, generator.uniform(0.3, 5.0, 3), Rotation.random(random_state=seed)


def holds_camera(center, size, rotation):
    away = np.abs(rotation.inv().apply(-center)) - size / 2
    return np.linalg.norm(np.maximum(away, 0.0)) < 0.1


def test_a_box_straight_ahead_is_where_its_front_is():
    # 2 m wide, 1 m high, front 8 m away: 500 / 8 pixels a metre around the image's middle (400, 300)
    seen = observe_cuboids(PINHOLE, HERE, some_boxes([[0.0, 0.0, 10.0]], [[4.0, 2.0, 1.0]]))
    np.testing.assert_allclose(seen.boxes_xyxy, [[337.5, 268.75, 462.5, 331.25]], atol=1e-9)
    assert seen.truncations.tolist() == [0.0]
    assert seen.occlusions.tolist() == [0.0]


def test_a_box_that_reaches_behind_the_camera_is_cut_at_the_image():
    # the left side of a wall 1 m to the right, from 20 m behind to 20 m ahead, 2 m high
    seen = observe_cuboids(PINHOLE, HERE, some_boxes([[1.5, 0.0, 0.0]], [[40.0, 1.0, 2.0]]))
    # its far end shows 25 pixels to the right of the middle and 25 above it; at the border 1 m stands at 1.25 m
    np.testing.assert_allclose(seen.boxes_xyxy, [[425.0, 0.0, 800.0, 600.0]], atol=1e-6)
    assert seen.truncations[0] > 0.9


def test_of_a_box_that_leaves_the_image_only_the_part_within_bounds_it():
    # a diamond in the upper left corner: the whole of it would reach further down and right than what is seen of it
    rotated = (Rotation.from_matrix(AXES) * Rotation.from_euler("x", 45, degrees=True)).as_quat()
    seen = observe_cuboids(PINHOLE, HERE, some_boxes([[-9.0, -4.0, 10.0]], [[0.001, 4.0, 4.0]], rotated))
    # a diamond of half diagonal 2.83 m -> 141.4 px around (-50, 100): the right tip is in the image, so are the
    # crossings of its left border
    np.testing.assert_allclose(
        seen.boxes_xyxy[0], [0.0, 100 - 91.4, 91.4, 100 + 91.4], atol=0.1
    )  # 1 mm of depth


@pytest.mark.parametrize("name", CAMERA_MODELS)
@pytest.mark.parametrize("part", range(4))
@pytest.mark.few(5)
def test_boxes_bound_all_points_of_their_surface_in_the_image_tightly(name, part):
    camera_model, compared = CAMERA_MODELS[name], 0
    for seed in range(part * 10, part * 10 + 10):
        center, size, rotation = random_box(seed, ahead=0.0)
        seen = observe_cuboids(
            camera_model, HERE, some_boxes([center], [size], rotation.as_quat()), min_pixels=0.0
        )
        if holds_camera(center, size, rotation):
            assert len(seen.rows) == 0
            continue
        pixels, visible = project(camera_model, rotation.apply(surface(size)) + center)
        pixels = pixels[visible] + 0.5
        if len(pixels) < 100:
            continue
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        box = seen.boxes_xyxy[0]
        slack = 0.02  # curved edges between samples, after their bulge is taken from parabolas
        assert (box[:2] <= low + slack).all()
        assert (box[2:] >= high - slack).all()
        steps = (
            4.0 * (high - low).max() / 120 + 1.0
        )  # the oracle's points are that far apart, more near the camera
        assert (box[:2] >= low - steps).all()
        assert (box[2:] <= high + steps).all()
        compared += 1
    assert compared >= 5


@pytest.mark.parametrize("name", ["pinhole", "barrel", "fisheye"])
def test_boxes_within_the_image_are_those_of_opencv(name):
    camera_model, compared = CAMERA_MODELS[name], 0
    for seed in range(30):
        center, size, rotation = random_box(seed, ahead=6.0)
        size = size / 3
        pixels = opencv_pixels(camera_model, rotation.apply(surface(size, 61)) + center) + 0.5
        if (pixels < 1).any() or (pixels > [799, 599]).any():
            continue
        seen = observe_cuboids(camera_model, HERE, some_boxes([center], [size], rotation.as_quat()))
        expected = [*pixels.min(axis=0), *pixels.max(axis=0)]
        # all edges are among OpenCV's points; a curved one may bulge by a part of the step between two of them
        np.testing.assert_allclose(seen.boxes_xyxy[0], expected, atol=0.01)
        compared += 1
    assert compared >= 8


def test_the_bulge_of_a_bent_edge_counts():
    # a straight bar above the middle of a barrel camera model: its ends are bent down, so that its middle is highest
    seen = observe_cuboids(BARREL, HERE, some_boxes([[0.0, -2.0, 5.0]], [[0.01, 6.0, 0.2]]))
    along = np.column_stack([np.linspace(-3, 3, 100_001), np.full(100_001, -2.1), np.full(100_001, 4.995)])
    curve = opencv_pixels(BARREL, along) + 0.5
    assert curve[:, 1].min() < curve[[0, -1], 1].min() - 10
    np.testing.assert_allclose(seen.boxes_xyxy[0, 1], curve[:, 1].min(), atol=1e-3)  # parabolas


@pytest.mark.parametrize("name", CAMERA_MODELS)
def test_the_share_outside_the_image_is_that_of_random_directions(name):
    camera_model, compared = CAMERA_MODELS[name], 0
    directions = np.random.default_rng(1).normal(size=(60_000, 3))
    _, inside = project(camera_model, directions)
    for seed in range(25):
        center, size, rotation = random_box(seed)
        seen = observe_cuboids(camera_model, HERE, some_boxes([center], [size], rotation.as_quat()))
        if holds_camera(center, size, rotation) or len(seen.rows) == 0:
            continue
        met = meets(directions, center, size, rotation)
        if met.sum() > 1_000:
            assert seen.truncations[0] == pytest.approx((met & ~inside).sum() / met.sum(), abs=0.05)
            compared += 1
    assert compared >= 5


def meets(directions, center, size, rotation):
    """Which rays from the origin meet a box ahead of them."""
    rays, origin = rotation.inv().apply(directions), rotation.inv().apply(-center)
    with np.errstate(divide="ignore"):
        first, last = (-size / 2 - origin) / rays, (size / 2 - origin) / rays
    enter, leave = np.minimum(first, last).max(axis=1), np.maximum(first, last).min(axis=1)
    return (enter <= leave) & (leave > 0)


def test_half_a_plate_before_another_hides_half_of_it():
    plates = some_boxes([[0.0, 0.0, 10.0], [0.5, 0.0, 5.0]], [[0.01, 2.0, 2.0], [0.01, 1.0, 1.0]])
    seen = observe_cuboids(PINHOLE, HERE, plates)
    # the nearer one covers 0 to 1 m at 5 m, which is 0 to 2 m at 10 m: the right half of -1 to 1 m
    np.testing.assert_allclose(seen.occlusions, [0.5, 0.0], atol=0.01)


def test_what_is_hidden_behind_several_boxes_is_hidden_once():
    plates = some_boxes(
        [[0.0, 0.0, 10.0], [0.5, 0.0, 5.0], [0.5, 0.0, 4.0]],
        [[0.01, 2.0, 2.0], [0.01, 1.0, 1.0], [0.01, 2.0, 2.0]],
    )
    seen = observe_cuboids(PINHOLE, HERE, plates)
    # the nearest covers -0.5 to 1.5 m at 4 m: all that the middle one shows, and -1.25 to 3.75 m at 10 m
    np.testing.assert_allclose(seen.occlusions, [1.0, 1.0, 0.0], atol=0.01)


@pytest.mark.parametrize("name", ["pinhole", "fisheye"])
def test_hidden_shares_are_those_of_a_fine_image(name):
    camera_model = CAMERA_MODELS[name]
    generator = np.random.default_rng(5)
    centers = generator.uniform([-8, -1, 4], [8, 1, 25], (25, 3))
    sizes, rotations = generator.uniform(1, 4, (25, 3)), Rotation.random(25, random_state=2)
    seen = observe_cuboids(camera_model, HERE, some_boxes(centers, sizes, rotations.as_quat()))
    v, u = (grid.ravel() for grid in np.mgrid[0:600:2, 0:800:2])
    rays = unproject(camera_model, np.column_stack([u, v]))
    depths = np.full((25, len(rays)), np.inf)
    for row, (center, size, rotation) in enumerate(zip(centers, sizes, rotations, strict=True)):
        directions, origin = rotation.inv().apply(rays), rotation.inv().apply(-center)
        first, last = (-size / 2 - origin) / directions, (size / 2 - origin) / directions
        enter, leave = np.minimum(first, last).max(axis=1), np.maximum(first, last).min(axis=1)
        there = (enter <= leave) & (enter > 0)
        depths[row, there] = enter[there]
    nearest = depths.min(axis=0)
    compared = 0
    for row, occlusion in zip(seen.rows, seen.occlusions, strict=True):
        met = np.isfinite(depths[row])
        if met.sum() > 500:
            assert occlusion == pytest.approx((depths[row, met] > nearest[met]).mean(), abs=ON_GRID)
            compared += 1
    assert compared > 10


def test_boxes_behind_the_camera_or_around_it_are_not_seen_and_hide_nothing():
    boxes = some_boxes(
        [[0.0, 0.0, -10.0], [0.0, 0.0, 0.0], [0.0, 0.0, 20.0]],
        [[2.0, 2.0, 2.0], [5.0, 2.0, 2.0], [4.0, 2.0, 2.0]],
    )
    seen = observe_cuboids(PINHOLE, HERE, boxes)
    assert seen.rows.tolist() == [2]
    assert seen.occlusions.tolist() == [0.0]


def test_a_fisheye_sees_what_stands_behind_the_plane_of_the_image():
    camera_model = Camera("fisheye", 1200, 1200, 300.0, 300.0, 599.5, 599.5)
    seen = observe_cuboids(camera_model, HERE, some_boxes([[5.0, 0.0, -1.0]], [[0.5, 0.5, 0.5]]))
    middle = (seen.boxes_xyxy[0, :2] + seen.boxes_xyxy[0, 2:]) / 2
    # 90 degrees and atan(1 / 5) off the axis, 300 pixels a radian
    np.testing.assert_allclose(middle, [600 + 300 * (np.pi / 2 + np.arctan(0.2)), 600.0], atol=2.0)


def test_boxes_of_no_volume_or_of_no_location_are_not_seen():
    boxes = some_boxes(
        [[0.0, 0.0, 9.0], [0.0, np.nan, 9.0], [0.0, 0.0, 9.0]],
        [[1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0]],
    )
    assert len(observe_cuboids(PINHOLE, HERE, boxes).rows) == 0
    assert len(observe_cuboids(PINHOLE, HERE, some_boxes(np.zeros((0, 3)), np.zeros((0, 3)))).rows) == 0


@pytest.mark.parametrize("strange", [np.inf, -np.inf, 1e300])
def test_boxes_out_of_this_world_are_not_seen(strange):
    centers, sizes = (
        [[0.0, 0.0, strange], *[[0.0, 0.0, 9.0]] * 2],
        [[1.0, 1, 1], [1, 1, abs(strange)], [1, 1, 1]],
    )
    boxes = some_boxes(centers, sizes)
    assert observe_cuboids(PINHOLE, HERE, boxes).rows.tolist() == [2]


def test_boxes_smaller_than_asked_for_are_left_out_but_hide():
    plates = some_boxes([[0.0, 0.0, 10.0], [0.0, 0.0, 5.0]], [[0.01, 2.0, 2.0], [0.01, 0.02, 2.0]])
    seen = observe_cuboids(PINHOLE, HERE, plates, min_pixels=4.0)
    assert seen.rows.tolist() == [0]
    assert seen.occlusions[0] == pytest.approx(0.02, abs=ON_GRID)


def test_the_pose_of_the_camera_counts():
    ahead = RigidTransform(AXES.T, np.array([1.0, 2.0, 3.0]))
    world = ahead.apply(np.array([[0.0, 0.0, 10.0]]))
    rotation = Rotation.from_matrix(ahead.rotation @ AXES).as_quat()
    seen = observe_cuboids(PINHOLE, ahead, some_boxes(world, [[4.0, 2.0, 1.0]], rotation))
    np.testing.assert_allclose(seen.boxes_xyxy, [[337.5, 268.75, 462.5, 331.25]], atol=1e-9)


def test_points_before_a_box_and_on_it_are_distinguished():
    box = some_boxes([[0.0, 0.0, 10.0]], [[4.0, 2.0, 2.0]])
    ahead = np.array([[0.0, 0.0, 1.0]])
    before, on, behind, beside, at_back = 5.0 * ahead, 7.9 * ahead, 20.0 * ahead, [[3.0, 0, 10]], -5.0 * ahead
    points = np.concatenate([before, 0.5 * before, on, 10.0 * ahead, 12.1 * ahead, behind, beside, at_back])
    seen = observe_cuboids(PINHOLE, HERE, box, points_world=points)
    # 7.9 and 12.1 m are within 0.2 m of its faces at 8 and 12 m
    assert seen.evidences.tolist() == [[2, 3]]
    assert observe_cuboids(PINHOLE, HERE, box).evidences.tolist() == [[0, 0]]


def test_points_that_are_not_finite_are_no_evidence():
    box = some_boxes([[0.0, 0.0, 10.0]], [[4.0, 2.0, 2.0]])
    points = np.array([[np.nan, 0.0, 1.0], [0.0, 0.0, np.inf], [0.0, 0.0, 0.0]])
    assert observe_cuboids(PINHOLE, HERE, box, points_world=points).evidences.tolist() == [[0, 0]]
