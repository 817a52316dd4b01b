"""Objects of several cameras as one list, on a scene of two cameras whose answer is known."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.detections import DetectionPair
from sceneloom.detections.detectors import numbers_of
from sceneloom.detections.merging import DEFAULTS, merge_views
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import NO_BOX
from sceneloom.detections.settings import tables_of
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels import existence as columns
from sceneloom.scene.detections import Boxes2D, Boxes3D

CAMERA = Camera("pinhole", 1000, 600, 500.0, 500.0, 499.5, 299.5)
CAR, PERSON = (4.0, 2.0, 1.6), (0.8, 0.65, 1.72)


def looking(degrees, *, aside=0.0):
    """`camera_from_lidar` of a camera that is rotated to the left by so much and stands so far to the left [m]."""
    angle = np.radians(degrees)
    ahead, left = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    rotation = np.array([-left, [0, 0, -1], ahead])
    return RigidTransform(rotation, -rotation @ np.array([0.0, aside, 0.0]))


FRONT, LEFT, BACK = looking(0.0, aside=-0.5), looking(40.0, aside=0.5), looking(180.0)


def sweep(*rows, label="car", size=CAR):
    """Boxes that head along x: x, y, z and score of each."""
    numbers = np.array(rows, np.float64).reshape(-1, 4)
    count = len(numbers)
    return Boxes3D(7, numbers[:, :3], np.tile(size, (count, 1)), np.zeros(count), numbers[:, 3], (label,) * count)


def outline(camera_from_lidar, center, size=CAR):
    """What a pinhole shows of an upright box that heads along x, all of it in front."""
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 2
    points = camera_from_lidar.apply(np.array(center, np.float64) + signs * size)
    assert (points[:, 2] > 0).all()
    pixels = 500 * points[:, :2] / points[:, 2:] + (500, 300)
    box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    assert (box > 0).all()
    assert (box < (1000, 600, 1000, 600)).all()
    return box


def image(camera_from_lidar, *centers, label="car", size=CAR, score=0.8):
    corners = np.array([outline(camera_from_lidar, center, size) for center in centers]).reshape(-1, 4)
    return Boxes2D(9, corners, np.full(len(corners), score), (label,) * len(corners))


NOTHING = Boxes2D.empty(9)


def views(boxes_3d, **images):
    """What each camera's image gives: by name how the camera lies, and its boxes."""
    return {
        name: fuse_by_projection(DetectionPair(boxes_3d, boxes_2d, CAMERA, camera_from_lidar))
        for name, (camera_from_lidar, boxes_2d) in images.items()
    }


def log_odds(share):
    return np.log(share / (1 - share))


BOTH_SEE, ONLY_LEFT = (20.0, 7.0, -0.5), (10.0, 14.0, -0.5)


def test_a_box_of_the_sweep_is_one_object_to_which_each_image_that_shows_its_location_adds_its_evidence():
    boxes = sweep((*BOTH_SEE, 0.6), (*ONLY_LEFT, 0.7), (-15, 0, 0, 0.5))
    found = views(boxes, front=(FRONT, image(FRONT, BOTH_SEE)), left=(LEFT, image(LEFT, ONLY_LEFT, BOTH_SEE)))
    merged = merge_views(boxes, found)
    assert merged.objects.rows_3d.tolist() == [0, 1, 2]
    assert merged.rows["front"].tolist() == merged.rows["left"].tolist() == [0, 1, 2]
    assert merged.cameras.tolist()[1:] == [1, NO_BOX]
    # a camera that looks back at the first two cars states nothing of them
    of_sweep = log_odds(views(boxes, back=(BACK, NOTHING))["back"].scores[:2])
    front, left = (log_odds(found[name].scores[:2]) for name in ("front", "left"))
    np.testing.assert_allclose(log_odds(merged.objects.scores[0]), front[0] + left[0] - of_sweep[0], rtol=1e-9)
    np.testing.assert_allclose(merged.objects.scores[1], found["left"].scores[1], rtol=1e-9)
    assert merged.objects.scores[0] > max(found["front"].scores[0], found["left"].scores[0])
    boxes, seen = sweep((*BOTH_SEE, 0.6)), {"front": (FRONT, image(FRONT, BOTH_SEE))}
    front = merge_views(boxes, views(boxes, **seen)).objects
    blind = merge_views(boxes, views(boxes, **seen, back=(BACK, NOTHING))).objects
    missed = merge_views(boxes, views(boxes, **seen, left=(LEFT, NOTHING))).objects
    np.testing.assert_allclose(blind.scores, front.scores, rtol=1e-9)
    assert missed.scores[0] < front.scores[0]
    for name in ("centers", "center_covariances", "corners_xyxy", "rows_2d"):
        np.testing.assert_array_equal(getattr(missed, name), getattr(front, name))
    seen = {name: (how, image(how, BOTH_SEE)) for name, how in (("left", LEFT), ("front", FRONT))}
    found = views(boxes, **seen, back=(BACK, NOTHING))
    merged = merge_views(boxes, found)
    traces = {name: view.center_covariances[0].trace() for name, view in found.items()}
    best = min(("left", "front"), key=traces.__getitem__)
    assert merged.objects.center_covariances[0].trace() == traces[best]
    assert list(merged.rows)[merged.cameras[0]] == best
    np.testing.assert_array_equal(merged.objects.corners_xyxy, found[best].corners_xyxy)


def people(front, left, *, label_left="pedestrian"):
    """Two images of people without a box in the sweep, whose list has a car behind."""
    boxes, in_front = sweep((-15, 0, 0, 0.5)), image(FRONT, *front, label="pedestrian", size=PERSON)
    found = views(boxes, front=(FRONT, in_front), left=(LEFT, image(LEFT, *left, label=label_left, size=PERSON)))
    return found, merge_views(boxes, found)


SOMEBODY, ANOTHER = (12.0, 4.0, -0.6), (12.0, 8.0, -0.6)


def test_a_person_whom_two_images_alone_show_is_one_whose_odds_multiply():
    found, merged = people([SOMEBODY], [SOMEBODY])
    assert merged.objects.rows_3d.tolist() == [0, NO_BOX]
    assert merged.rows["front"].tolist() == merged.rows["left"].tolist() == [0, 1]
    singles = [view.scores[1] for view in found.values()]
    assert merged.objects.scores[1] > max(singles)
    assert np.linalg.norm(merged.objects.centers[1] - SOMEBODY) < 1.0
    volume = np.linalg.det(merged.objects.center_covariances[1])
    # two guesses by the same height are no surer than the better one where both look the same way
    assert volume <= min(np.linalg.det(view.center_covariances[1]) for view in found.values()) * 1.1
    shown = {
        name: (how, image(how, SOMEBODY, label="pedestrian", size=PERSON))
        for name, how in (("front", FRONT), ("left", LEFT))
    }
    without = {name: view.scores[0] for name, view in views(sweep(), **shown).items()}
    np.testing.assert_allclose([view.scores[1] for view in found.values()], list(without.values()), rtol=1e-12)
    gained = log_odds(merged.objects.scores[1]) - log_odds(without["front"])
    # the second image adds what it says beyond a location of which nobody says anything
    row = tables_of(DEFAULTS).existence[numbers_of(["pedestrian"], [])[0][0]]
    silent = row[columns.PRIOR] + np.log1p(-row[columns.RECALL_3D])
    assert gained == pytest.approx(log_odds(without["left"]) - silent, rel=1e-9)


def test_what_is_elsewhere_or_something_else_stays_two_and_the_same_reported_twice_is_no_better_known():
    for front, left, label in [([SOMEBODY], [ANOTHER], "pedestrian"), ([SOMEBODY], [SOMEBODY], "car")]:
        found, merged = people(front, left, label_left=label)
        assert (len(merged), merged.rows["front"].tolist()) == (3, [0, 1, NO_BOX])
        assert merged.rows["left"].tolist() == [0, NO_BOX, 1]
        np.testing.assert_array_equal(merged.objects.centers[2], found["left"].centers[1])
        np.testing.assert_allclose(merged.objects.scores[1], found["front"].scores[1], rtol=1e-9)
        _, merged = people([SOMEBODY, ANOTHER], [ANOTHER, SOMEBODY])  # each finds the own one
        assert {name: rows.tolist() for name, rows in merged.rows.items()} == {"front": [0, 1, 2], "left": [0, 2, 1]}
    boxes, box = sweep(), image(FRONT, SOMEBODY, label="pedestrian", size=PERSON)
    found = views(boxes, one=(FRONT, box), other=(FRONT, box))
    merged = merge_views(boxes, found)
    assert len(merged) == 1
    # rounding of inverses
    np.testing.assert_allclose(merged.objects.centers, found["one"].centers, rtol=1e-6)
    np.testing.assert_allclose(merged.objects.center_covariances, found["one"].center_covariances, rtol=1e-4, atol=1e-6)
    for boxes, rows in ((sweep(), []), (sweep((np.nan, 0, 0, 0.5), (*BOTH_SEE, np.nan)), [1])):
        merged = merge_views(boxes, views(boxes, front=(FRONT, NOTHING), left=(LEFT, NOTHING)))
        assert merged.objects.rows_3d.tolist() == rows
        assert {name: len(found) for name, found in merged.rows.items()} == {"front": len(rows), "left": len(rows)}
        assert np.isfinite(merged.objects.scores).all()
    with pytest.raises(OptionError, match="no views"):
        merge_views(sweep(), {})
