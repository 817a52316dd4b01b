"""Detection fusion: assignment, outlines, refinement, objects of images alone, and what boxes say of a calibration."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import unproject
from sceneloom.detections import DetectionPair, projection
from sceneloom.detections.detectors import KINDS, numbers_of, table_rows
from sceneloom.detections.residuals import BoxResiduals
from sceneloom.detections.results import NO_BOX
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import ArrayError, OptionError
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.box_fusion import boxes_with_area, boxes_with_position
from sceneloom.scene import Boxes2D, Boxes3D
from sceneloom.scene.types import PointsFrame
from sceneloom.simulate import CameraSpec, LidarSpec, TrafficSpec, detect_2d, simulate_street


def random_boxes(generator, count):
    corners = generator.uniform(0, 100, (count, 2))
    return np.hstack([corners, corners + generator.uniform(5, 60, (count, 2))])


def slow_gain(a, b, weight, surer, least_iou):
    """By the definition of GIoU, in areas of intersections, unions and hulls."""
    wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if wide <= 0 or high <= 0:
        return 0.0
    common = wide * high
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common
    hull = (max(a[2], b[2]) - min(a[0], b[0])) * (max(a[3], b[3]) - min(a[1], b[1]))
    iou = common / union
    giou = iou - (hull - union) / hull
    return (1 + giou) / 2 * weight * (1 + projection.SURER * surer) if iou >= least_iou else 0.0


def test_gains_are_those_of_the_definition():
    generator = np.random.default_rng(3)
    a, b = random_boxes(generator, 30), random_boxes(generator, 25)
    words_a = [("Car", "van", "Pedestrian", "dragon")[k % 4] for k in range(30)]
    words_b = [("car", "pedestrian", "unknown")[k % 3] for k in range(25)]
    weights = {("Car", "car"): 1.0, ("van", "car"): projection.SAME_FAMILY, ("Pedestrian", "pedestrian"): 1.0}
    weights |= dict.fromkeys([("Pedestrian", "car"), ("Car", "pedestrian"), ("van", "pedestrian")], 0.0)
    weight = [[weights.get((one, other), projection.ONE_UNKNOWN) for other in words_b] for one in words_a]
    p, q = generator.random(30), generator.random(25)
    found = projection.pair_gains(a, b, *numbers_of(words_a, words_b), p, q, least_iou=0.1)
    expected = [[slow_gain(a[i], b[j], weight[i][j], (p[i] + q[j]) / 2, 0.1) for j in range(25)] for i in range(30)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert (found > 0).sum() > 20


@pytest.mark.parametrize("share", [0.02, 0.1, 0.5])
def test_pairs_without_rivals_are_assigned_as_in_the_whole_table(share):
    rng = np.random.default_rng(3)
    for _ in range(100):
        shape = rng.integers(1, 40, 2)
        gains = np.where(rng.random(shape) < share, rng.normal(0.5, 0.5, shape), 0.0)
        rows, columns = linear_sum_assignment(np.maximum(gains, 0.0), maximize=True)
        expected = [(i, j) for i, j in zip(rows, columns, strict=True) if gains[i, j] > 0]
        found = projection.assign_pairs(*np.nonzero(gains), gains[gains != 0])
        assert list(zip(*found, strict=True)) == expected
        of_rows, of_columns = projection.assign(gains)
        assert [(i, j) for i, j in enumerate(of_rows) if j != NO_BOX] == expected
        assert sorted((i, j) for j, i in enumerate(of_columns) if i != NO_BOX) == expected
    partners, takers = projection.assign(np.array([[0.0, 0.0], [0.9, 0.8]]))
    assert (partners.tolist(), takers.tolist()) == ([NO_BOX, 0], [1, NO_BOX])


CAMERA_MODEL = (-0.12, 0.03, 5e-4, -3e-4, -2e-3)
CAMERA = Camera("brown_conrady", 1242, 375, 720.0, 721.0, 610.0, 173.0, CAMERA_MODEL)
LOOKING = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""How a camera that looks along the x axis of the lidar is rotated."""

CAMERA_FROM_LIDAR = RigidTransform(LOOKING, np.array([0.05, -0.1, -0.3]))


def about_z(yaw):
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])


def boxes_of(centers, sizes, yaws):
    return np.column_stack([np.asarray(v, np.float64) for v in (centers, sizes, yaws)])


def surface(center, size, yaw):
    """Points on the faces of a box, lidar frame."""
    along = np.linspace(-0.5, 0.5, 41)
    a, b = (grid.ravel() for grid in np.meshgrid(along, along))
    faces = [np.roll(np.column_stack([np.full(a.size, s), a, b]), k, axis=1) for s in (-0.5, 0.5) for k in range(3)]
    return np.vstack(faces) * size @ about_z(yaw).T + center


def cv2_pixels(points_lidar):
    points = points_lidar @ CAMERA_FROM_LIDAR.rotation.T + CAMERA_FROM_LIDAR.translation
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(CAMERA_MODEL))[0]
    return pixels[:, 0] + 0.5


def cv2_outline(points_lidar):
    pixels = cv2_pixels(points_lidar)
    seen = pixels[((pixels >= 0) & (pixels <= (CAMERA.width, CAMERA.height))).all(axis=1)]
    return np.concatenate([seen.min(axis=0), seen.max(axis=0)]) if len(seen) else np.zeros(4)


def test_outlines_bound_what_opencv_projects_as_far_as_the_image_and_nearer_boxes_show_it():
    generator = np.random.default_rng(1)
    centers = generator.uniform([9, -9, -1.5], [60, 9, 0.5], (60, 3))
    sizes, yaws = generator.uniform([1, 0.5, 1], [5, 2, 2], (60, 3)), generator.uniform(-3, 3, 60)
    found = projection.project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes_of(centers, sizes, yaws)).corners_xyxy
    expected = [cv2_outline(surface(*box)) for box in zip(centers, sizes, yaws, strict=True)]
    whole = np.all((np.array(expected)[:, :2] > 2) & (np.array(expected)[:, 2:] < (1240, 373)), axis=1)
    assert whole.sum() > 30
    # edges are followed coarsely
    np.testing.assert_allclose(found[whole], np.array(expected)[whole], atol=0.3)
    # of what the border cuts, the points of the surface lie up to a grid's step within it
    np.testing.assert_allclose(found[~whole], np.array(expected)[~whole], atol=12.0)
    boxes = boxes_of([[-20, 0, 0], [0.3, 0, 0]], [[4, 2, 1.5]] * 2, [0.3, 0.0])
    outlines = projection.project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes)
    assert not outlines.corners_xyxy.any()
    assert not outlines.seen_shares.any()
    # a wall 2 m to the left, from 30 m behind to 30 m ahead: 720 / 29.7 px a metre at its far end
    outlines = projection.project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes_of([[0, 2.5, 0]], [[60, 1, 2]], [0.0]))
    left, top, right, bottom = outlines.corners_xyxy[0]
    assert (left, bottom, top) == (0.0, pytest.approx(375.0), pytest.approx(0.0, abs=1e-6))
    assert right == pytest.approx(610.5 - 720 * 1.95 / 29.7, abs=0.3)  # the camera model bends it by less
    # the same location in the image, twice as far and half covered: 1 m wide at 10 m hides 2 m at 20 m
    centers, sizes = [[10.3, 0.5, 0], [20.5, 0, 0]], [[0.001, 1, 4], [0.001, 2, 1]]
    boxes = boxes_of(centers, sizes, [0.0, 0.0])
    shares = projection.project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes).seen_shares
    assert shares[1] == pytest.approx(0.5, abs=0.05)  # the camera model is 5 cm to the side
    doubtful = projection.project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes, likely=np.array([0.4, 1.0])).seen_shares
    assert doubtful[1] == pytest.approx(0.8, abs=0.02)
    twice = boxes_of([[20.3, 0.5, 0], [20.5, 0, 0]], sizes, [0.0, 0.0])
    assert projection.project_outlines(CAMERA, CAMERA_FROM_LIDAR, twice).seen_shares[1] == 1.0


ODD = (0.0, -1.0, np.nan, np.inf, -np.inf)


def spoilt(sound, values):
    """The sound row, and copies of which one column each has one of the values."""
    rows = np.tile(sound, (1 + len(sound) * len(values), 1))
    for k, (column, value) in enumerate((column, value) for column in range(len(sound)) for value in values):
        rows[k + 1, column] = value
    return rows


def test_boxes_have_a_location_or_an_area_where_all_numbers_are_finite_and_in_order():
    numbers, corners = spoilt(np.ones(7), ODD), spoilt(np.array([10.0, 20, 30, 40]), (*ODD, 30.0))
    parts = (np.ascontiguousarray(numbers[:, part]) for part in (slice(0, 3), slice(3, 6), 6))
    for given, found, sound in (
        (numbers, boxes_with_position(*parts), (numbers[:, 3:6] > 0).all(axis=1)),
        (corners, boxes_with_area(corners), (corners[:, 2:] > corners[:, :2]).all(axis=1)),
    ):
        expected = np.isfinite(given).all(axis=1) & sound
        boxes, rows = found
        np.testing.assert_array_equal(rows, np.flatnonzero(expected))
        np.testing.assert_array_equal(boxes, given[expected])
        assert 0 < expected.sum() < len(expected)


MIDDLE_SIGMAS, HEIGHT_SIGMAS = (2.0, 0.03), (2.0, 0.06)
SIGMAS = np.tile([*MIDDLE_SIGMAS, *MIDDLE_SIGMAS, *HEIGHT_SIGMAS], (2, 1))
CENTER, SIZE, YAW = np.array([30.0, 4.0, -0.8]), np.array([4.2, 1.8, 1.5]), 0.5
COVARIANCE = np.diag([0.3, 0.25, 0.2, 0.3, 0.15, 0.12]) ** 2


def bounds(state, yaw=YAW):
    """Left, top, right and bottom of the corners of a box, by OpenCV."""
    pixels = cv2_pixels(state[:3] + (CORNER_SIGNS * state[3:] / 2) @ about_z(yaw).T)
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def reported(box_xyxy):
    left, top, right, bottom = box_xyxy
    return np.array([(left + right) / 2, (top + bottom) / 2, bottom - top])


def sharpened(center, partner, covariance=COVARIANCE):
    """A box after its update, the second of two boxes whose first has no partner."""
    boxes = np.tile(np.hstack([center, SIZE, YAW]), (2, 1))
    covariances = np.array([COVARIANCE, covariance])
    outlines = projection.project_outlines(CAMERA, CAMERA_FROM_LIDAR, boxes)
    partners = np.array([NO_BOX, 0])
    projection.refine(CAMERA, CAMERA_FROM_LIDAR, outlines, boxes, covariances, partners, partner[None].copy(), SIGMAS)
    np.testing.assert_array_equal(boxes[0], np.hstack([center, SIZE, YAW]))
    np.testing.assert_array_equal(covariances[0], COVARIANCE)
    assert boxes[1, 6] == YAW
    return boxes[1, :6], covariances[1]


def test_the_update_is_that_of_the_information_form_with_errors_as_large_as_it_says():
    before = np.concatenate([CENTER, SIZE])
    partner, step = bounds(before) + np.array([1.5, -0.8, 2.4, 0.9]), 1e-4
    slopes = np.column_stack(
        [(reported(bounds(before + step * e)) - reported(bounds(before - step * e))) / (2 * step) for e in np.eye(6)]
    )
    wide, high = partner[2:] - partner[:2]
    least, share = np.array([MIDDLE_SIGMAS, MIDDLE_SIGMAS, HEIGHT_SIGMAS]).T
    noise = least + share * (wide, high, high)
    information = np.linalg.inv(COVARIANCE) + slopes.T @ np.diag(noise**-2) @ slopes
    expected, residual = np.linalg.inv(information), reported(partner) - reported(bounds(before))
    state, covariance = sharpened(CENTER, partner)
    # slopes by differences of OpenCV's pixels are good to six digits
    np.testing.assert_allclose(covariance, expected, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(state, before + expected @ slopes.T @ np.diag(noise**-2) @ residual, rtol=1e-6)
    for center, partner in [
        (CENTER, bounds(np.concatenate([CENTER, SIZE])) + np.array([60.0, 40.0, 60.0, 80.0])),  # it is elsewhere
        (np.array([0.5, 2.5, -0.8]), np.array([100.0, 100.0, 300.0, 300.0])),  # the box reaches behind the camera
    ]:
        state, covariance = sharpened(center, partner)
        np.testing.assert_array_equal(state, np.concatenate([center, SIZE]))
        np.testing.assert_array_equal(covariance, COVARIANCE)
    # the left side of this car is out of the image
    center = np.array([20.0, 17.5, -0.8])
    partner = np.array([0.0, *bounds(np.concatenate([center, SIZE]))[1:]])
    assert partner[2] > 10.0
    _, covariance = sharpened(center, partner)
    ahead, aside, up = np.diagonal(COVARIANCE)[:3] - np.diagonal(covariance)[:3]
    assert up > 0.3 * COVARIANCE[2, 2]
    assert aside < 0.05 * COVARIANCE[1, 1]
    assert ahead < 0.05 * COVARIANCE[0, 0]
    generator, truth = np.random.default_rng(4), np.concatenate([CENTER, SIZE])
    box = bounds(truth)
    wide, high = box[2:] - box[:2]
    squares = []
    for _ in range(400):
        start = generator.multivariate_normal(truth, COVARIANCE)[:3]
        # errors of the middle of the image's box, none of its size: sizes are right to begin with
        shift = generator.normal(size=2) * (MIDDLE_SIGMAS[0] + MIDDLE_SIGMAS[1] * np.array([wide, high]))
        state, covariance = sharpened(start, box + np.tile(shift, 2))
        error = state[:3] - CENTER
        squares.append(error @ np.linalg.solve(covariance[:3, :3], error))
    # three degrees of freedom; sizes without error make it smaller
    assert np.mean(squares) == pytest.approx(3.0, abs=0.6)


WIDE_CAMERA = Camera("pinhole", 1000, 600, 500.0, 500.0, 499.5, 299.5)
WIDE_CAMERA_FROM_LIDAR = RigidTransform(LOOKING, np.array([0.0, -0.2, -0.5]))
BENT = Camera("brown_conrady", 1000, 600, 500.0, 500.0, 499.5, 299.5, (-0.5, 0.0, 0.0, 0.0, 0.0))


def placed(corners, labels, *, rows=None, camera=WIDE_CAMERA):
    kinds, corners = table_rows(numbers_of(labels, [])[0]), np.array(corners, np.float64).reshape(-1, 4)
    rows = np.arange(len(corners)) if rows is None else np.array(rows)
    return projection.position_by_height(camera, WIDE_CAMERA_FROM_LIDAR, corners, rows, kinds)


def angle(one, other):
    return np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)


def slowly_placed(camera, camera_from_lidar, box, label):
    """One object step by step: its distance by its height, its covariance as one along the ray and one across."""
    left, top, right, bottom = box
    middle_u, middle_v = (left + right) / 2 - 0.5, (top + bottom) / 2 - 0.5
    pixels = [[middle_u, middle_v], [middle_u, top - 0.5], [middle_u, bottom - 0.5]]
    middle, up, down, *sides = unproject(camera, np.array([*pixels, [left - 0.5, middle_v], [right - 0.5, middle_v]]))
    kind = KINDS[label]
    high, wide = angle(up, down), angle(*sides)
    distance = kind.size_lwh[2] / (2 * np.tan(high / 2)) + kind.size_lwh[1] / 2
    of_width, of_height = (
        (projection.EDGES[0] + projection.EDGES[1] / (right - left)),
        (projection.EDGES[0] + projection.EDGES[1] / (bottom - top)),
    )
    relative = (kind.size_sigmas[2] / kind.size_lwh[2]) ** 2 + 2 * of_height**2
    if top < 2.0 or bottom > camera.height - 2.0:
        relative += 0.5**2
    across = max(of_width * wide, of_height * high) ** 2
    lidar_from_camera = camera_from_lidar.inverse()
    ray = lidar_from_camera.rotation @ middle
    along = np.outer(ray, ray)
    covariance = distance**2 * (relative * along + across * (np.eye(3) - along))
    return lidar_from_camera.apply(distance * middle), covariance


def test_boxes_are_placed_by_their_height_where_the_camera_model_has_rays_as_by_the_formulas():
    # 43 px high at 500 px focal length: 1.72 m at 20 m, to the middle of a body 0.65 m wide a third of a metre more
    found = placed([490.0, 278.5, 510.0, 321.5], ["pedestrian"])
    np.testing.assert_allclose(found.centers[0], [20.0 + 0.325 + 0.5, 0.0, -0.2], atol=0.02)
    assert found.sizes_lwh[0, 2] == 1.72
    # people differ by 9 % in height; the edges of the box are not sharper
    assert 0.09 < np.sqrt(np.linalg.eigvalsh(found.center_covariances[0])[2]) / found.ranges[0] < 0.25
    assert len(placed([], []).centers) == 0
    for label in ("car", "dragon", ""):
        found = placed([[-3e4, -2e4, -2.9e4, -1.9e4], [400.0, 100.0, 500.0, 200.0]], [label] * 2, camera=BENT)
        assert found.rows.tolist() == [1]
        assert (found.sizes_lwh > 0).all()
        assert np.isfinite(found.centers).all()
        assert np.isfinite(found.center_covariances).all()
    corners = np.array([[400.0, 100.0, 500.0, 200.0], [10.0, 20.0, 30.0, 90.0], [700.0, 100.0, 720.0, 300.0]])
    found = placed(corners, ["car", "bus", "pedestrian"], rows=[2, 0])
    assert found.rows.tolist() == [2, 0]
    np.testing.assert_array_equal(found.centers[0], placed(corners[2], ["pedestrian"]).centers[0])
    np.testing.assert_array_equal(found.centers[1], placed(corners[0], ["car"]).centers[0])
    generator = np.random.default_rng(5)
    bent = Camera("brown_conrady", 1000, 600, 500.0, 510.0, 480.0, 310.0, (-0.1, 0.02, 5e-4, -3e-4, 1e-3))
    how = RigidTransform.from_quaternion(generator.normal(size=3), generator.normal(size=4))
    corners = np.sort(generator.uniform(0, [1000, 600], (60, 2, 2)), axis=1).reshape(60, 4)
    corners[::7, 1] = 0.5
    labels = generator.choice(list(KINDS), 60).tolist()
    kinds = table_rows(numbers_of(labels, [])[0])
    found = projection.position_by_height(bent, how, corners, np.arange(60), kinds)
    assert len(found.rows) == 60
    slowly = [slowly_placed(bent, how, box, label) for box, label in zip(corners, labels, strict=True)]
    # the chord between rays and their cross product round differently
    np.testing.assert_allclose(found.centers, [center for center, _ in slowly], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.center_covariances, [covariance for _, covariance in slowly], rtol=1e-7, atol=1e-9)


FRUSTUM_CAMERA = Camera("pinhole", 1200, 400, 700.0, 700.0, 599.5, 199.5)
FRUSTUM_CAMERA_FROM_LIDAR = RigidTransform(LOOKING, np.zeros(3))
# what a pedestrian of 1.72 m shows who stands 15 m ahead with his feet 1.7 m below the camera
FEET, HEAD = 199.5 + 0.5 + 700.0 * 1.7 / 15.0, 199.5 + 0.5 - 700.0 * 0.02 / 15.0
PEDESTRIAN = np.array([[590.0, HEAD, 610.0, FEET]])


def pair_of(points, corners=PEDESTRIAN, label="pedestrian", boxes_3d=None):
    boxes_2d = Boxes2D(0, corners, np.full(len(corners), 0.9), (label,) * len(corners))
    points = None if points is None else np.asarray(points, np.float32)
    return DetectionPair(
        Boxes3D.empty(0) if boxes_3d is None else boxes_3d, boxes_2d, FRUSTUM_CAMERA, FRUSTUM_CAMERA_FROM_LIDAR, points
    )


def a_wall(distance, left=0.4, low=-1.7, high=0.3, count=9):
    """Points of a flat thing that faces the camera, (N, 3) [m], in the lidar's frame."""
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-left, left, count), np.linspace(low, high, count)))
    return np.column_stack([np.full(len(y), distance), y, z])


def test_an_object_is_behind_the_points_in_the_middle_of_its_box_if_these_are_its_own():
    behind = a_wall(30.0, left=10.0, count=60)
    points = np.concatenate([a_wall(14.0), behind[np.abs(behind[:, 1]) > 0.3]])
    fused = projection.fuse_by_projection(pair_of(points))
    assert fused.by_points.tolist() == [True]
    # a body is a quarter of the usual 0.65 m deep behind its surface; along a ray 5 degrees off the axis
    assert fused.centers[0, 0] == pytest.approx(14.16, abs=0.1)
    by_height = projection.fuse_by_projection(pair_of(None))
    assert by_height.by_points is None
    assert by_height.centers[0, 0] == pytest.approx(15.0, abs=0.5)
    assert fused.center_covariances[0, 0, 0] < by_height.center_covariances[0, 0, 0] / 10.0
    for points in [
        np.zeros((0, 3)),
        a_wall(14.0, count=2),  # too few
        np.full((50, 3), np.nan),
        np.column_stack([a_wall(14.0)[:, 0], a_wall(14.0)[:, 1:] + 8.0]),  # beside it
        np.concatenate([a_wall(14.0), a_wall(5.0, count=60)]),  # most of its box shows something nearer
    ]:
        fused, by_height = projection.fuse_by_projection(pair_of(points)), projection.fuse_by_projection(pair_of(None))
        assert fused.by_points.tolist() == [False]
        np.testing.assert_array_equal(fused.centers, by_height.centers)
        np.testing.assert_array_equal(fused.center_covariances, by_height.center_covariances)
    # a car that stands before the pedestrian and hides the lower part, and has a box of its own
    size = np.array([[4.2, 1.8, 1.5]])
    car = Boxes3D(0, np.array([[10.0, 0.0, -1.0]]), size, np.zeros(1), np.array([0.95]), ("car",))
    points = np.concatenate([a_wall(14.0), a_wall(8.0, low=-1.7, high=-0.3, count=14)])
    assert not projection.fuse_by_projection(pair_of(points)).by_points[0]
    fused = projection.fuse_by_projection(pair_of(points, boxes_3d=car))
    assert (fused.by_points.tolist(), fused.centers[1, 0]) == ([False, True], pytest.approx(14.16, abs=0.1))
    whole = np.array([[500.0, 150.0, 700.0, 260.0]])
    cut, sides = whole - [500.0, 0.0, 500.0, 0.0], a_wall(9.0, left=8.0, low=-1.0, high=0.6, count=60)
    seen, half_seen = (projection.fuse_by_projection(pair_of(sides, box, "car")) for box in (whole, cut))
    assert seen.by_points[0]
    assert half_seen.by_points[0]
    volumes = [np.linalg.det(one.center_covariances[0]) for one in (seen, half_seen)]
    assert volumes[1] > 4.0 * volumes[0]


def test_points_report_distances_several_times_better_than_heights_and_covariances_are_wide_enough():
    specs = (CameraSpec(Camera("pinhole", 620, 188, 360.0, 360.0, 309.5, 93.5)),)
    traffic = TrafficSpec(cars=4.0, cyclists=3.0, pedestrians=6.0)
    drive = simulate_street(21, frames=9, lidar=LidarSpec(steps=1200), cameras=specs, traffic=traffic)
    lidar, camera, frames, found = drive.truth.lidar, drive.scene.cameras[0], [0, 4, 8], []
    for k, detected in zip(frames, detect_2d(drive, frames=frames), strict=True):
        sweep = drive.scene.lidars[0].frames[k]
        ego = drive.truth.path.at(np.array([sweep.reference_ns]))
        world_from_lidar = RigidTransform(ego.rotations[0], ego.positions[0]) @ lidar.spec.mount
        camera_from_lidar = drive.truth.world_from_camera(camera.id, k).inverse() @ world_from_lidar
        pair = DetectionPair(Boxes3D.empty(0), detected.boxes, camera.camera, camera_from_lidar, sweep.points.positions)
        fused, by_height = (
            projection.fuse_by_projection(pair),
            projection.fuse_by_projection(replace(pair, points_lidar=None)),
        )
        truth = drive.truth.boxes(np.array([sweep.reference_ns]))
        centers = world_from_lidar.inverse().apply(truth.centers_world[0])
        origin = camera_from_lidar.inverse().translation
        for row, instance in enumerate(detected.instances[fused.rows_2d].tolist()):
            if instance > 0 and fused.by_points[row]:
                center = centers[truth.instances.tolist().index(instance)]
                off, ray = fused.centers[row] - center, (center - origin) / np.linalg.norm(center - origin)
                squared = off @ np.linalg.solve(fused.center_covariances[row], off)
                found.append((squared, abs(off @ ray), abs((by_height.centers[row] - center) @ ray)))
    squared, by_points, by_height = np.array(found).T
    assert len(found) > 15
    assert np.median(by_points) < np.median(by_height) / 4.0
    # of some dozens of objects; a few stand behind what fills their box, whatever the covariance says
    assert (squared < chi2.ppf(0.95, 3)).mean() > 0.85
    assert np.median(squared) < chi2.ppf(0.5, 3) * 1.5


CAR = (4.0, 2.0, 1.6)


def boxes_3d(*rows, labels=None, **more):
    """Boxes of cars that head along x: x, y, z and score of each."""
    numbers = np.array(rows, np.float64).reshape(-1, 4)
    count = len(numbers)
    sizes, labels = np.tile(CAR, (count, 1)), labels or ("Car",) * count
    return Boxes3D(7, numbers[:, :3], sizes, np.zeros(count), numbers[:, 3], labels, **more)


def boxes_2d(*rows, labels=None):
    """Boxes in the image: left, top, right, bottom and score of each."""
    numbers = np.array(rows, np.float64).reshape(-1, 5)
    return Boxes2D(9, numbers[:, :4], numbers[:, 4], labels or ("car",) * len(numbers))


def outline(x, y, z):
    """What a pinhole shows of a car that heads along x: the nearer face bounds it, or the farther one on its side."""
    corners = np.array([[x + i * 2.0, y + j * 1.0, z + k * 0.8] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    u, v = 500.0 - 500.0 * corners[:, 1] / corners[:, 0], 300.0 - 500.0 * corners[:, 2] / corners[:, 0]
    return u.min(), v.min(), u.max(), v.max()


def fused(three, two, **changes):
    pair = DetectionPair(three, two, WIDE_CAMERA, FRUSTUM_CAMERA_FROM_LIDAR)
    return projection.fuse_by_projection(pair, settings=ProjectionSettings(detectors="independent", **changes))


def test_boxes_of_both_detectors_become_one_object_whose_existence_multiplies_the_odds():
    three = boxes_3d((20, 3, -1, 0.6), (30, -5, -1, 0.7))
    two = boxes_2d((*outline(30, -5, -1), 0.8), (*outline(20, 3, -1), 0.5))
    result = fused(three, two)
    assert (result.rows_3d.tolist(), result.rows_2d.tolist()) == ([0, 1], [1, 0])
    assert np.array_equal(result.corners_xyxy, two.corners_xyxy[[1, 0]])
    odds = np.array([0.6 / 0.4 * 1.0, 0.7 / 0.3 * 0.8 / 0.2]) / (0.1 / 0.9)
    assert np.allclose(result.scores, odds / (1 + odds), rtol=1e-12)
    for count_2d in [0, 2]:
        for count_3d in [0, 2]:
            three = boxes_3d(*[(20, 3, -1, 0.6), (30, -5, -1, 0.7)][:count_3d])
            two = boxes_2d(*[(10, 10, 60, 60, 0.5), (900, 10, 990, 90, 0.5)][:count_2d])
            result = fused(three, two)
            assert (len(result), np.count_nonzero(result.rows_3d == NO_BOX)) == (count_3d + count_2d, count_2d)
            assert np.count_nonzero(result.rows_2d == NO_BOX) == count_3d
            assert len(set(result.ids.tolist())) == len(result)


HIDDEN = 0.6 * 0.91 / (0.6 * 0.91 + 0.4)
MISSED = 0.6 / 0.4 * (1 - 0.9)


def test_boxes_of_sweep_or_image_alone_become_less_likely_where_the_other_should_have_shown_them():
    for boxes, score, accuracy in [
        ([(-20, 3, -1, 0.6)], 0.6, 1e-3),  # behind the camera: it stays as likely
        ([(60, 3, -1, 0.6)], 0.6, 1e-3),  # tiny in the image
        ([(10, 0, 0, 0.9), (25, 0, 0, 0.6)], HIDDEN, 1e-3),  # hidden by a nearer one
        ([(20, 3, -1, 0.6)], MISSED / (1 + MISSED), 1e-12),  # the image should have shown it
    ]:
        result = fused(boxes_3d(*boxes), boxes_2d())
        assert result.scores[-1] == pytest.approx(score, abs=accuracy)
        assert result.corners_xyxy[-1].any() == (boxes[0][0] > 0)
        if boxes[0][0] > 0:
            np.testing.assert_allclose(result.corners_xyxy[-1], outline(*boxes[-1][:3]), atol=1e-9)
    two = boxes_2d((700, 250, 750, 350, 0.8), labels=("pedestrian",))
    result = fused(boxes_3d((-20, 0, 0, 0.5)), two)
    assert (result.rows_3d.tolist(), result.rows_2d.tolist()) == ([0, NO_BOX], [NO_BOX, 0])
    odds = 0.8 / 0.2 * (1 - 0.5)
    assert result.scores[1] == pytest.approx(odds / (1 + odds), rel=1e-12)
    # the middle of the box is at pixel (724.5, 299.5): 225 / 500 to the right
    assert result.centers[1, 1] / result.centers[1, 0] == pytest.approx(-225 / 500, rel=1e-9)
    assert result.centers[1, 2] == pytest.approx(0.0, abs=1e-9)
    assert (result.sizes_lwh[1] > 0).all()
    three, two = (
        boxes_3d((20, 3, -1, 0.6), velocities=np.array([[5.0, 1.0, 0.0]])),
        boxes_2d((700, 250, 750, 350, 0.8)),
    )
    assert fused(three, two).velocities.tolist() == [[5.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
    assert fused(boxes_3d((20, 3, -1, 0.6)), two).velocities is None
    assert len(fused(three, two, keep_camera_only=False)) == 1


def test_the_surer_detector_names_the_class_and_boxes_are_paired_one_to_one_within_a_family():
    for score_3d, label_3d, score_2d, label_2d, expected in [
        (0.6, "Car", 0.7, "Van", "Van"),
        (0.7, "Car", 0.6, "Van", "Car"),
        (0.6, "Car", 0.9, "Unknown", "Car"),
        (0.9, "unknown", 0.6, "Van", "Van"),
        (0.6, "Car", 0.6, "Van", "Car"),
    ]:
        three = boxes_3d((20, 3, -1, score_3d), labels=(label_3d,))
        result = fused(three, boxes_2d((*outline(20, 3, -1), score_2d), labels=(label_2d,)))
        assert (result.labels, result.rows_2d.tolist()) == ((expected,), [0])
    two = boxes_2d((*outline(20, 3, -1), 0.9), labels=("pedestrian",))
    assert len(fused(boxes_3d((20, 3, -1, 0.6), labels=("car",)), two)) == 2
    three = boxes_3d((20, 3, -1, 0.4), (20, 3, -1, 0.6))
    assert fused(three, boxes_2d((*outline(20, 3, -1), 0.5))).rows_2d.tolist() == [NO_BOX, 0]
    equal = fused(boxes_3d(*[(20, 3, -1, 0.5)] * 5), boxes_2d(*[(*outline(20, 3, -1), 0.5)] * 3))
    assert (len(equal), sorted(equal.rows_2d.tolist())) == (5, [NO_BOX, NO_BOX, 0, 1, 2])


def test_the_object_of_both_is_surer_across_the_line_of_sight_and_a_thousand_find_their_partners():
    three = boxes_3d((30, 3, -1, 0.6))
    alone, both = fused(three, boxes_2d()), fused(three, boxes_2d((*outline(30, 3, -1), 0.8)))
    np.testing.assert_allclose(both.centers, alone.centers, atol=1e-6)
    before, after = (result.center_covariances[0].diagonal() for result in (alone, both))
    # 1 px at 30 m is 6 cm, so 3 px are not much better than the sweep; along the visibility there is nothing to win
    assert (after[1:] < 0.95 * before[1:]).all()
    assert after[0] == pytest.approx(before[0], rel=0.05)
    assert (np.linalg.eigvalsh(both.size_covariances[0]) > 0).all()
    generator = np.random.default_rng(0)
    y, z = (grid.ravel() for grid in np.mgrid[-240:240:40j, -100:100:25j])
    locations = np.column_stack([np.full(1000, 300.0), y, z, np.full(1000, 0.5)])
    order = generator.permutation(1000)
    two = boxes_2d(*[(*outline(*locations[k, :3]), 0.5) for k in order])
    result = fused(boxes_3d(*locations), two)
    assert len(result) == 1000
    np.testing.assert_array_equal(order[result.rows_2d], np.arange(1000))


def test_boxes_that_are_no_numbers_or_in_another_frame_are_left_out_or_refused():
    three = boxes_3d((np.nan, 3, -1, 0.6), (20, 3, -1, 0.6), (np.inf, 0, 0, 0.5))
    two = boxes_2d((50, 50, 40, 60, 0.5), (*outline(20, 3, -1), 0.5), (0, 0, np.nan, 9, 0.5))
    result = fused(three, two)
    assert (result.rows_3d.tolist(), result.rows_2d.tolist()) == ([1], [1])
    three = boxes_3d((20, 3, -1, np.nan), (-20, 3, -1, np.nan))
    result = fused(three, boxes_2d((*outline(20, 3, -1), 0.8)))
    assert result.scores == pytest.approx([0.8, 0.1], rel=1e-12)
    with pytest.raises(OptionError, match="boxes in the world frame; expected the lidar's"):
        fused(boxes_3d((20, 3, -1, 0.6), frame=PointsFrame.WORLD), boxes_2d())
    with pytest.raises(ArrayError, match="points_lidar"):
        replace(pair_of(None), points_lidar=np.zeros((3, 3)))
    for wrong in ({"time_sigma": -1.0}, {"least_iou": np.nan}, {"recall_2d": 1.0}):
        with pytest.raises(OptionError, match=next(iter(wrong))):
            ProjectionSettings(**wrong)


def pairs(rotation_deg, *, count=40, seed=3):
    """Images of cars whose sweeps are taken with a camera that is rotated from where it is stated to be."""
    generator = np.random.default_rng(seed)
    rotation = RigidTransform(cv2.Rodrigues(np.radians(rotation_deg))[0], np.zeros(3))
    for _ in range(count):
        ahead = generator.uniform(12.0, 40.0, 5)
        centers = np.column_stack([ahead, ahead * generator.uniform(-0.6, 0.6, 5), generator.uniform(-1, 0, 5)])
        noisy = centers + 0.1 * generator.normal(size=(5, 3))
        corners = np.array([bounds(np.hstack([center, SIZE]), 0.0) for center in centers])
        corners += generator.normal(size=(5, 4))
        # a false box in each, and one car that the camera does not find
        corners[0] = [700.0, 150.0, 790.0, 200.0]
        three = Boxes3D(0, noisy, np.tile(SIZE, (5, 1)), np.zeros(5), np.ones(5), ("Car",) * 5)
        two = Boxes2D(0, corners, np.ones(5), ("car",) * 5)
        yield DetectionPair(three, two, CAMERA, rotation @ CAMERA_FROM_LIDAR)


def residuals_of(rotation_deg, **more):
    residuals = BoxResiduals()
    for pair in pairs(np.array(rotation_deg, np.float64), **more):
        residuals.add(pair)
    return residuals


def test_a_rotation_is_found_and_reported_and_nothing_of_a_right_calibration_or_few_or_other_boxes():
    for rotation in [(2.0, 0, 0), (0, -2.0, 0), (0, 0, 2.5), (1.2, 1.2, -1.2)]:
        residuals = residuals_of(rotation)
        # 200 cars, each known to a pixel or a tenth of a degree; about the axis of visibility ten times worse
        np.testing.assert_allclose(np.degrees(residuals.rotation().rotation), -np.array(rotation), atol=0.3)
        (warning,) = residuals.warnings("front")
        assert warning.location == "front"
    for rotation in [(0, 0, 0), (0.3, -0.3, 0)]:
        residuals = residuals_of(rotation)
        assert np.degrees(np.linalg.norm(residuals.rotation().rotation)) < 0.8
        assert residuals.warnings("front") == []
    assert residuals_of((2.0, 0, 0), count=2).warnings("front") == []
    residuals = BoxResiduals()
    for pair in pairs(np.zeros(3), count=3):
        two = pair.boxes_2d
        residuals.add(replace(pair, boxes_2d=Boxes2D.empty(0)))
        residuals.add(replace(pair, boxes_2d=replace(two, labels=("pedestrian",) * len(two))))
    assert residuals.rotation() is None
    residuals, shown = BoxResiduals(), list(pairs(np.zeros(3)))
    for pair, other in zip(shown, shown[20:] + shown[:20], strict=True):
        residuals.add(replace(pair, boxes_2d=other.boxes_2d))
    found = residuals.rotation()
    assert found is None or found.agreeing < max(40, 2 * found.by_chance)


def test_what_is_stated_for_its_uncertainty_is_how_rotates_scatter():
    rotations = [residuals_of((0.5, -0.5, 1.0), count=20, seed=seed).rotation() for seed in range(12)]
    injected = -np.radians([0.5, -0.5, 1.0])
    errors = np.array([found.rotation - injected for found in rotations])
    # what bounded boxes have in common is not chance, and not in the covariance
    errors -= errors.mean(axis=0)
    stated = np.sqrt(np.mean([np.diag(found.covariance) for found in rotations], axis=0))
    # twelve drives report a deviation to a fifth, and twenty blocks another fifth
    assert (np.abs(np.log(errors.std(axis=0) / stated)) < np.log(2.0)).all()
    assert all(found.agreeing > 5 * found.by_chance and found.images == 20 for found in rotations)
