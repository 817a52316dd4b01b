"""Objects that an image knows alone."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import unproject
from sceneloom.detections.detectors import KINDS, numbers_of, table_rows
from sceneloom.detections.projection import EDGES, position_by_height
from sceneloom.geometry.rigid import RigidTransform

CAMERA = Camera("pinhole", 1000, 600, 500.0, 500.0, 499.5, 299.5)
CAMERA_FROM_LIDAR = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.0, -0.2, -0.5])
)


def placed(*corners, label="pedestrian"):
    return position_all(CAMERA, np.array(corners, np.float64), label)


def position_all(camera, corners, label):
    kinds = table_rows(numbers_of([label] * len(corners), [])[0])
    return position_by_height(camera, CAMERA_FROM_LIDAR, corners, np.arange(len(corners)), kinds)


def test_a_person_is_where_their_height_says():
    # 43 px high at 500 px focal length: 1.72 m at 20 m, to the middle of a body 0.65 m wide a third of a metre more
    found = placed([490.0, 278.5, 510.0, 321.5])
    np.testing.assert_allclose(found.centers[0], [20.0 + 0.325 + 0.5, 0.0, -0.2], atol=0.02)
    assert found.sizes_lwh[0, 2] == 1.72


def test_the_distance_is_less_certain_than_the_direction():
    found = placed([690.0, 278.5, 710.0, 321.5])
    values, vectors = np.linalg.eigh(found.center_covariances[0])
    camera_lidar = np.array([0.5, 0.0, -0.2])
    ray = (found.centers[0] - camera_lidar) / np.linalg.norm(found.centers[0] - camera_lidar)
    assert abs(vectors[:, 2] @ ray) > 0.999
    assert values[2] > 100 * values[1]
    # people differ by 9 % in height; the edges of the box are not sharper
    assert 0.09 < np.sqrt(values[2]) / found.ranges[0] < 0.25


def test_what_the_border_cuts_is_less_certain():
    whole, cut = placed([400.0, 100.0, 500.0, 300.0]), placed([400.0, 0.0, 500.0, 200.0])
    assert cut.center_covariances[0].trace() > 4 * whole.center_covariances[0].trace()


def test_without_boxes_there_is_nothing():
    assert len(position_all(CAMERA, np.zeros((0, 4)), "car").centers) == 0


@pytest.mark.parametrize("label", ["car", "dragon", ""])
def test_every_class_has_a_size(label):
    found = placed([400.0, 100.0, 500.0, 200.0], label=label)
    assert (found.sizes_lwh > 0).all()
    assert np.isfinite(found.center_covariances).all()


def test_what_the_camera_model_has_no_rays_for_is_not_known():
    bent = Camera("brown_conrady", 1000, 600, 500.0, 500.0, 499.5, 299.5, (-0.5, 0.0, 0.0, 0.0, 0.0))
    corners = np.array([[400.0, 100.0, 500.0, 200.0], [-3e4, -2e4, -2.9e4, -1.9e4]])
    found = position_all(bent, corners[::-1].copy(), "car")
    assert found.rows.tolist() == [1]
    assert np.isfinite(found.centers).all()


def test_only_the_boxes_asked_for_are_placed():
    corners = np.array([[400.0, 100.0, 500.0, 200.0], [10.0, 20.0, 30.0, 90.0], [700.0, 100.0, 720.0, 300.0]])
    kinds = table_rows(numbers_of(["car", "bus", "pedestrian"], [])[0])
    found = position_by_height(CAMERA, CAMERA_FROM_LIDAR, corners, np.array([2, 0]), kinds)
    assert found.rows.tolist() == [2, 0]
    np.testing.assert_array_equal(found.centers[0], placed(corners[2]).centers[0])
    np.testing.assert_array_equal(found.centers[1], placed(corners[0], label="car").centers[0])


def angle(one, other):
    return np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)


def slowly_placed(camera, camera_from_lidar, box, label):
    """One object step by step: its distance by its height, its covariance as one along the ray and one across."""
    left, top, right, bottom = box
    middle_u, middle_v = (left + right) / 2 - 0.5, (top + bottom) / 2 - 0.5
    pixels = [[middle_u, middle_v], [middle_u, top - 0.5], [middle_u, bottom - 0.5]]
    middle, up, down, *sides = unproject(
        camera, np.array([*pixels, [left - 0.5, middle_v], [right - 0.5, middle_v]])
    )
    kind = KINDS[label]
    high, wide = angle(up, down), angle(*sides)
    distance = kind.size_lwh[2] / (2 * np.tan(high / 2)) + kind.size_lwh[1] / 2
    of_width, of_height = (EDGES[0] + EDGES[1] / (right - left)), (EDGES[0] + EDGES[1] / (bottom - top))
    relative = (kind.size_sigmas[2] / kind.size_lwh[2]) ** 2 + 2 * of_height**2
    if top < 2.0 or bottom > camera.height - 2.0:
        relative += 0.5**2
    across = max(of_width * wide, of_height * high) ** 2
    lidar_from_camera = camera_from_lidar.inverse()
    ray = lidar_from_camera.rotation @ middle
    along = np.outer(ray, ray)
    covariance = distance**2 * (relative * along + across * (np.eye(3) - along))
    return lidar_from_camera.apply(distance * middle), covariance


def test_locations_are_those_of_the_formulas_for_bent_camera_models_and_rotated_cameras():
    generator = np.random.default_rng(5)
    bent = Camera("brown_conrady", 1000, 600, 500.0, 510.0, 480.0, 310.0, (-0.1, 0.02, 5e-4, -3e-4, 1e-3))
    how = RigidTransform.from_quaternion(generator.normal(size=3), generator.normal(size=4))
    corners = np.sort(generator.uniform(0, [1000, 600], (60, 2, 2)), axis=1).reshape(60, 4)
    corners[::7, 1] = 0.5
    labels = generator.choice(list(KINDS), 60).tolist()
    kinds = table_rows(numbers_of(labels, [])[0])
    found = position_by_height(bent, how, corners, np.arange(60), kinds)
    assert len(found.rows) == 60
    slowly = [slowly_placed(bent, how, box, label) for box, label in zip(corners, labels, strict=True)]
    # the chord between rays and their cross product round differently
    np.testing.assert_allclose(found.centers, [center for center, _ in slowly], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(
        found.center_covariances, [covariance for _, covariance in slowly], rtol=1e-7, atol=1e-9
    )
