import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import ArrayError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Boxes2D, Boxes3D, PointsFrame, ScoreForm


@pytest.fixture
def boxes():
    generator = np.random.default_rng(5)
    spread = generator.normal(size=(4, 7, 7))
    return Boxes3D(
        7,
        generator.normal(scale=20, size=(4, 3)),
        generator.uniform(0.5, 5, (4, 3)),
        generator.uniform(-np.pi, np.pi, 4),
        generator.uniform(size=4),
        ("car", "car", "pedestrian", "cyclist"),
        velocities=generator.normal(size=(4, 3)),
        covariances=spread @ spread.transpose(0, 2, 1),
        ids=np.arange(4) * 10,
    )


def test_corners_are_those_of_the_box_rotated_about_the_z_axis(boxes):
    for k in range(len(boxes)):
        own = Rotation.from_euler("z", boxes.yaws[k]).inv().apply(boxes.corners[k] - boxes.centers[k])
        np.testing.assert_allclose(np.abs(own), np.tile(boxes.sizes_lwh[k] / 2, (8, 1)), atol=1e-12)
        assert own[0] == pytest.approx(boxes.sizes_lwh[k] / 2 * [1, 1, -1])


def test_speed_is_along_the_heading_and_negative_for_reversing():
    velocities = np.array([[1.0, 3.0, 0.0], [-2.0, 5.0, 0.0]])
    yaws, labels = np.array([np.pi / 2, 0.0]), ("car", "car")
    boxes = Boxes3D(0, np.zeros((2, 3)), np.ones((2, 3)), yaws, np.ones(2), labels, velocities=velocities)
    np.testing.assert_allclose(boxes.directions, [[0, 1, 0], [1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(boxes.speeds, [3.0, -2.0])


def test_boxes_in_another_frame_have_their_corners_velocities_and_spreads_there(boxes):
    rotation = Rotation.from_euler("z", 2.1)
    b_from_a = RigidTransform(rotation.as_matrix(), np.array([4.0, -3.0, 1.0]))
    moved = boxes.moved(b_from_a, PointsFrame.EGO)
    assert moved.frame is PointsFrame.EGO
    np.testing.assert_allclose(moved.corners, b_from_a.apply(boxes.corners), atol=1e-12)
    np.testing.assert_allclose(moved.velocities, rotation.apply(boxes.velocities.copy()), atol=1e-12)
    np.testing.assert_allclose(moved.speeds, boxes.speeds, atol=1e-12)
    np.testing.assert_allclose(
        moved.covariances[2, :3, :3], rotation.as_matrix() @ boxes.covariances[2, :3, :3] @ rotation.as_matrix().T
    )
    np.testing.assert_array_equal(moved.covariances[:, 3:, 3:], boxes.covariances[:, 3:, 3:])
    cross = rotation.as_matrix() @ boxes.covariances[1, :3, 6]
    np.testing.assert_allclose(moved.covariances[1, :3, 6], cross)


@pytest.mark.parametrize("rows", [[2, 0], np.array([True, False, True, False]), []])
def test_selected_boxes_keep_all_that_belongs_to_them(boxes, rows):
    some = boxes.select(rows)
    numbers = np.arange(4)[rows] if len(rows) else np.zeros(0, int)
    assert len(some) == len(numbers)
    assert some.labels == tuple(boxes.labels[k] for k in numbers)
    for name in ("centers", "sizes_lwh", "yaws", "scores", "velocities", "covariances", "ids"):
        np.testing.assert_array_equal(getattr(some, name), getattr(boxes, name)[numbers])


def test_boxes_in_an_image_are_edges_and_can_be_selected():
    boxes = Boxes2D(
        3, np.array([[0.0, 0, 1, 1], [2.0, 3, 6, 10]]), np.array([-4.0, 9.0]), ("a", "b"), score_form=ScoreForm.LOGIT
    )
    np.testing.assert_array_equal(boxes.sizes_wh, [[1, 1], [4, 7]])
    some = boxes.select([1])
    assert (len(some), some.labels, some.scores.tolist()) == (1, ("b",), [9.0])
    assert some.score_form is ScoreForm.LOGIT
    with pytest.raises(ArrayError, match="corners_xyxy"):
        Boxes2D(0, np.zeros((2, 3)), np.zeros(2), ("a", "b"))
    # a frame without detections has all its arrays
    assert len(Boxes3D.empty(5)) == len(Boxes2D.empty(5)) == 0
    assert Boxes3D.empty(5).corners.shape == (0, 8, 3)
    assert Boxes2D.empty(5, sensor_id="camera0").sensor_id == "camera0"


def test_boxes_cannot_be_edited_and_survive_pickling(boxes):
    with pytest.raises(ValueError, match="read-only"):
        boxes.centers[0, 0] = 1.0
    again = pickle.loads(pickle.dumps(boxes))
    np.testing.assert_array_equal(again.covariances, boxes.covariances)
    assert again.labels == boxes.labels


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sizes_lwh": np.ones((3, 3))}, r"sizes_lwh: \(3, 3\)"),
        ({"yaws": np.array(["0"] * 4)}, "yaws.*str"),
        ({"labels": ("car",)}, "labels: tuple of 1; expected a tuple of 4"),
        ({"labels": "cars"}, "labels: str"),
        ({"covariances": np.zeros((4, 3, 3))}, "covariances"),
        ({"ids": np.zeros(4)}, "ids"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_by_name(boxes, wrong, message):
    fields = {name: getattr(boxes, name) for name in ("centers", "sizes_lwh", "yaws", "scores", "labels")}
    with pytest.raises(ArrayError, match=message):
        Boxes3D(0, **{**fields, **wrong})
