"""Labels of images onto points and back: single pixels, votes, the same visibility."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import VisibilitySettings
from sceneloom.colouring.algorithms import view_points
from sceneloom.colouring.labels import NO_LABEL, LabelCanvas, paint_labels
from sceneloom.errors import ArrayError, OptionError
from sceneloom.geometry.rigid import RigidTransform

CAMERA = Camera("pinhole", 60, 40, 50.0, 50.0, 29.5, 19.5)


def view(points, *, x=0.0, camera_id="a"):
    where = RigidTransform(np.eye(3), np.array([x, 0.0, 0.0]))
    return view_points(
        np.asarray(points, np.float64), CAMERA, where, np.zeros((40, 60, 3), np.uint8), camera_id=camera_id,
        timestamp_ns=0, visibility=VisibilitySettings(enabled=False),
    )  # fmt: skip


def labels(number, size=(40, 60)):
    return np.full(size, number, np.uint16)


def test_points_take_the_label_of_their_nearest_pixel_in_most_images_if_they_are_seen():
    image = np.arange(40 * 60, dtype=np.uint16).reshape(40, 60)
    u, v = np.array([10.4, 10.6, 0.0, 59.4]), np.array([20.4, 20.6, 0.0, 39.4])
    points = np.stack([(u - 29.5) / 50 * 4, (v - 19.5) / 50 * 4, np.full(4, 4.0)], axis=1)
    painted = paint_labels(points, [view(points)], [image])
    assert painted.tolist() == [20 * 60 + 10, 21 * 60 + 11, 0, 39 * 60 + 59]
    points = np.array([[0.0, 0.0, 5.0]])
    views = [view(points), view(points, x=1.5, camera_id="b"), view(points, x=-1.5, camera_id="c")]
    assert paint_labels(points, views, [labels(1), labels(2), labels(2)]).tolist() == [2]
    assert paint_labels(points, views[:2], [labels(1), labels(2)]).tolist() == [1]
    assert paint_labels(points, views[:2], [None, labels(2)]).tolist() == [2]
    assert paint_labels(points, views, [labels(7), labels(8), labels(9)]).tolist() == [7]
    points = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 9.0], [0.0, 0.0, -5.0]])
    assert paint_labels(points, [view(points)], [labels(3)]).tolist() == [3, NO_LABEL, NO_LABEL]
    assert paint_labels(points, [view(points)], [None]).tolist() == [NO_LABEL] * 3
    assert paint_labels(np.zeros((0, 3)), [], []).tolist() == []
    for images, message in (([labels(0, (20, 30))], "label_image"), ([], "0 label images for 1 views")):
        with pytest.raises(ArrayError, match=message):
            paint_labels(points, [view(points)], images)


def test_labels_are_drawn_where_points_are_visible_and_the_nearest_counts_with_a_label_or_without():
    points = np.array([[-0.01, -0.01, 5.0], [-0.02, -0.02, 8.0], [1.0, 0.5, 5.0]])
    seen, canvas = view(points), LabelCanvas.blank(60, 40)
    canvas.draw(seen, np.array([4, 5, 6], np.uint16))
    assert (canvas.labels[19, 29], sorted(np.unique(canvas.labels).tolist())) == (4, [0, 4, 6])
    assert (canvas.labels > 0).sum() == 2
    points, near = np.array([[0.0, 0.0, 8.0]]), np.array([[0.0, 0.0, 4.0]])
    canvas = LabelCanvas.blank(60, 40, radius_px=2)
    canvas.draw(view(points), np.array([5], np.uint16))
    assert (canvas.labels == 5).sum() == 25
    canvas.draw(view(near), np.array([NO_LABEL], np.uint16))
    assert (canvas.labels == 0).all()
    with pytest.raises(OptionError, match="radius_px"):
        LabelCanvas.blank(60, 40, radius_px=-1)


def test_labels_go_to_points_and_back_unchanged():
    random = np.random.default_rng(5)
    points = np.column_stack([random.uniform(-2, 2, 300), random.uniform(-1, 1, 300), np.full(300, 5.0)])
    image, seen = random.integers(1, 300, (40, 60)).astype(np.uint16), view(points)
    canvas = LabelCanvas.blank(60, 40)
    canvas.draw(seen, paint_labels(points, [seen], [image]))
    drawn = canvas.labels > 0
    assert drawn.sum() > 150
    assert (canvas.labels[drawn] == image[drawn]).all()
