"""Detection fusion by projection, on scenes whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.detections import DetectionPair
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import NO_BOX
from sceneloom.detections.settings import ProjectionSettings
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.types import PointsFrame

CAMERA = Camera("pinhole", 1000, 600, 500.0, 500.0, 499.5, 299.5)
CAMERA_FROM_LIDAR = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3)
)
CAR = (4.0, 2.0, 1.6)
SETTINGS = ProjectionSettings(detectors="independent")


def boxes_3d(*rows, labels=None, **more):
    """Boxes of cars that head along x: x, y, z and score of each."""
    numbers = np.array(rows, np.float64).reshape(-1, 4)
    count = len(numbers)
    return Boxes3D(
        7,
        numbers[:, :3],
        np.tile(CAR, (count, 1)),
        np.zeros(count),
        numbers[:, 3],
        labels or ("Car",) * count,
        **more,
    )


def boxes_2d(*rows, labels=None):
    """Boxes in the image: left, top, right, bottom and score of each."""
    numbers = np.array(rows, np.float64).reshape(-1, 5)
    return Boxes2D(9, numbers[:, :4], numbers[:, 4], labels or ("car",) * len(numbers))


def outline(x, y, z):
    """What a pinhole shows of a car that heads along x: the nearer face bounds it, or the farther one on its side."""
    corners = np.array(
        [[x + i * 2.0, y + j * 1.0, z + k * 0.8] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
    )
    u = 500.0 - 500.0 * corners[:, 1] / corners[:, 0]
    v = 300.0 - 500.0 * corners[:, 2] / corners[:, 0]
    return u.min(), v.min(), u.max(), v.max()


def fused(three, two):
    return fuse_by_projection(DetectionPair(three, two, CAMERA, CAMERA_FROM_LIDAR), settings=SETTINGS)


def test_boxes_of_both_detectors_become_one_object_whose_existence_multiplies_the_odds():
    three = boxes_3d((20, 3, -1, 0.6), (30, -5, -1, 0.7))
    two = boxes_2d((*outline(30, -5, -1), 0.8), (*outline(20, 3, -1), 0.5))
    result = fused(three, two)
    assert result.rows_3d.tolist() == [0, 1]
    assert result.rows_2d.tolist() == [1, 0]
    assert np.array_equal(result.corners_xyxy, two.corners_xyxy[[1, 0]])
    odds = np.array([0.6 / 0.4 * 1.0, 0.7 / 0.3 * 0.8 / 0.2]) / (0.1 / 0.9)
    assert np.allclose(result.scores, odds / (1 + odds), rtol=1e-12)


@pytest.mark.parametrize("count_3d", [0, 2])
@pytest.mark.parametrize("count_2d", [0, 2])
def test_missing_boxes_on_either_side_are_no_fault(count_3d, count_2d):
    three = boxes_3d(*[(20, 3, -1, 0.6), (30, -5, -1, 0.7)][:count_3d])
    two = boxes_2d(*[(10, 10, 60, 60, 0.5), (900, 10, 990, 90, 0.5)][:count_2d])
    result = fused(three, two)
    assert len(result) == count_3d + count_2d
    assert np.count_nonzero(result.rows_3d == NO_BOX) == count_2d
    assert np.count_nonzero(result.rows_2d == NO_BOX) == count_3d
    assert len(set(result.ids.tolist())) == len(result)


def test_a_box_behind_the_camera_is_kept_as_it_is():
    result = fused(boxes_3d((-20, 3, -1, 0.6)), boxes_2d())
    assert result.scores[0] == pytest.approx(0.6, rel=1e-12)
    assert not result.corners_xyxy.any()


def test_a_box_of_the_sweep_that_the_image_should_have_shown_becomes_less_likely():
    result = fused(boxes_3d((20, 3, -1, 0.6)), boxes_2d())
    odds = 0.6 / 0.4 * (1 - 0.9)
    assert result.scores[0] == pytest.approx(odds / (1 + odds), rel=1e-12)
    np.testing.assert_allclose(result.corners_xyxy[0], outline(20, 3, -1), atol=1e-9)


def test_a_box_of_the_sweep_that_is_tiny_in_the_image_stays_as_likely():
    result = fused(boxes_3d((60, 3, -1, 0.6)), boxes_2d())
    assert result.scores[0] == pytest.approx(0.6, rel=1e-12)


def test_a_box_of_the_sweep_that_a_nearer_one_hides_stays_as_likely():
    result = fused(boxes_3d((10, 0, 0, 0.9), (25, 0, 0, 0.6)), boxes_2d())
    assert result.scores[1] == pytest.approx(0.6 * 0.91 / (0.6 * 0.91 + 0.4), rel=1e-12)


def test_a_box_of_the_image_alone_has_its_ray_and_less_existence():
    two = boxes_2d((700, 250, 750, 350, 0.8), labels=("pedestrian",))
    result = fused(boxes_3d((-20, 0, 0, 0.5)), two)
    assert result.rows_3d.tolist() == [0, NO_BOX]
    assert result.rows_2d.tolist() == [NO_BOX, 0]
    odds = 0.8 / 0.2 * (1 - 0.5)
    assert result.scores[1] == pytest.approx(odds / (1 + odds), rel=1e-12)
    # the middle of the box is at pixel (724.5, 299.5): 225 / 500 to the right
    assert result.centers[1, 1] / result.centers[1, 0] == pytest.approx(-225 / 500, rel=1e-9)
    assert result.centers[1, 2] == pytest.approx(0.0, abs=1e-9)
    assert (result.sizes_lwh[1] > 0).all()


def test_boxes_of_the_image_alone_are_left_out_on_request():
    pair = DetectionPair(
        boxes_3d((20, 3, -1, 0.6)), boxes_2d((700, 250, 750, 350, 0.8)), CAMERA, CAMERA_FROM_LIDAR
    )
    assert len(fuse_by_projection(pair)) == 2
    assert len(fuse_by_projection(pair, settings=replace(SETTINGS, keep_camera_only=False))) == 1


@pytest.mark.parametrize(
    ("score_3d", "label_3d", "score_2d", "label_2d", "expected"),
    [
        (0.6, "Car", 0.7, "Van", "Van"),
        (0.7, "Car", 0.6, "Van", "Car"),
        (0.6, "Car", 0.9, "Unknown", "Car"),
        (0.9, "unknown", 0.6, "Van", "Van"),
        (0.6, "Car", 0.6, "Van", "Car"),
    ],
)
def test_the_surer_detector_names_the_class(score_3d, label_3d, score_2d, label_2d, expected):
    three = boxes_3d((20, 3, -1, score_3d), labels=(label_3d,))
    result = fused(three, boxes_2d((*outline(20, 3, -1), score_2d), labels=(label_2d,)))
    assert result.labels == (expected,)
    assert result.rows_2d.tolist() == [0]


def test_a_car_and_a_person_are_never_one_object():
    three = boxes_3d((20, 3, -1, 0.6), labels=("car",))
    result = fused(three, boxes_2d((*outline(20, 3, -1), 0.9), labels=("pedestrian",)))
    assert len(result) == 2


def test_of_two_boxes_on_one_location_the_surer_one_gets_the_partner():
    three = boxes_3d((20, 3, -1, 0.4), (20, 3, -1, 0.6))
    assert fused(three, boxes_2d((*outline(20, 3, -1), 0.5))).rows_2d.tolist() == [NO_BOX, 0]


def test_equal_boxes_with_equal_scores_are_paired_one_to_one():
    three = boxes_3d(*[(20, 3, -1, 0.5)] * 5)
    result = fused(three, boxes_2d(*[(*outline(20, 3, -1), 0.5)] * 3))
    assert len(result) == 5
    assert sorted(result.rows_2d.tolist()) == [NO_BOX, NO_BOX, 0, 1, 2]


def test_boxes_without_a_location_are_left_out_and_rows_count_them():
    three = boxes_3d((np.nan, 3, -1, 0.6), (20, 3, -1, 0.6), (np.inf, 0, 0, 0.5))
    two = boxes_2d((50, 50, 40, 60, 0.5), (*outline(20, 3, -1), 0.5), (0, 0, np.nan, 9, 0.5))
    result = fused(three, two)
    assert result.rows_3d.tolist() == [1]
    assert result.rows_2d.tolist() == [1]


def test_scores_that_are_no_numbers_leave_numbers():
    three = boxes_3d((20, 3, -1, np.nan), (-20, 3, -1, np.nan))
    result = fused(three, boxes_2d((*outline(20, 3, -1), 0.8)))
    assert result.scores[0] == pytest.approx(0.8, rel=1e-12)
    assert result.scores[1] == pytest.approx(0.1, rel=1e-12)


def test_velocities_come_from_the_sweep_and_are_zero_for_the_image_alone():
    three = boxes_3d((20, 3, -1, 0.6), velocities=np.array([[5.0, 1.0, 0.0]]))
    result = fused(three, boxes_2d((700, 250, 750, 350, 0.8)))
    assert result.velocities.tolist() == [[5.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
    assert fused(boxes_3d((20, 3, -1, 0.6)), boxes_2d((700, 250, 750, 350, 0.8))).velocities is None


def test_the_object_of_both_is_surer_across_the_line_of_sight_than_the_sweep_alone():
    three = boxes_3d((30, 3, -1, 0.6))
    alone, both = fused(three, boxes_2d()), fused(three, boxes_2d((*outline(30, 3, -1), 0.8)))
    np.testing.assert_allclose(both.centers, alone.centers, atol=1e-6)
    before, after = (result.center_covariances[0].diagonal() for result in (alone, both))
    # 1 px at 30 m is 6 cm, so 3 px are not much better than the sweep; along the visibility there is nothing to win
    assert (after[1:] < 0.95 * before[1:]).all()
    assert after[0] == pytest.approx(before[0], rel=0.05)
    assert (np.linalg.eigvalsh(both.size_covariances[0]) > 0).all()


def test_a_thousand_boxes_on_each_side_find_their_partners():
    generator = np.random.default_rng(0)
    locations = np.column_stack(
        [
            np.full(1000, 300.0),
            *(grid.ravel() for grid in np.mgrid[-240:240:40j, -100:100:25j]),
            np.full(1000, 0.5),
        ]
    )
    order = generator.permutation(1000)
    two = boxes_2d(*[(*outline(*locations[k, :3]), 0.5) for k in order])
    result = fused(boxes_3d(*locations), two)
    assert len(result) == 1000
    np.testing.assert_array_equal(order[result.rows_2d], np.arange(1000))


def test_boxes_in_another_frame_are_refused():
    three = boxes_3d((20, 3, -1, 0.6), frame=PointsFrame.WORLD)
    with pytest.raises(OptionError, match="boxes in the world frame; expected the lidar's"):
        fused(three, boxes_2d())


@pytest.mark.parametrize("wrong", [{"time_sigma": -1.0}, {"least_iou": np.nan}, {"recall_2d": 1.0}])
def test_settings_out_of_bounds_are_refused(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong))):
        ProjectionSettings(**wrong)
