"""Tests of drawn objects: where boxes, ellipses and ways lie."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import DetectionPair
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Boxes2D, Boxes3D, CameraImage, Support, TrackedObjects
from sceneloom.visualization.clouds import SIZE_PX, EgoPosition, layout_map
from sceneloom.visualization.figures import PALETTE
from sceneloom.visualization.objects import draw_objects_above, draw_objects_in_image, objects_of_fused

CAMERA = Camera("pinhole", 640, 400, 300.0, 300.0, 319.5, 199.5)
WORLD_FROM_CAMERA = RigidTransform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
BLACK = CameraImage.of(0, CAMERA, np.zeros((400, 640, 3), np.uint8))


def objects(support=Support.BOTH, sigma=0.5, **changes):
    """A cube of 2 m, 10 m ahead, that looks and drives along y."""
    covariances = np.zeros((1, 10, 10))
    covariances[0, :3, :3] = np.diag([sigma**2, (2.0 * sigma) ** 2, sigma**2])
    columns = {
        "ids": np.array([3]), "labels": ("car",), "centers": np.array([[10.0, 0.0, 0.0]]),
        "sizes_lwh": np.full((1, 3), 2.0), "yaws": np.array([np.pi / 2.0]), "yaw_rates": np.zeros(1),
        "velocities": np.array([[0.0, 12.0, 0.0]]), "covariances": covariances, "scores": np.array([0.9]),
        "supports": np.array([support], np.uint8),
    }  # fmt: skip
    return TrackedObjects(0, **{**columns, **changes})


def coloured(image, colour=PALETTE[3]):
    """Pixels of a colour, (N, 2) column and row."""
    return np.argwhere((np.asarray(image)[:, :, :3] == colour).all(axis=2))[:, ::-1]


def test_boxes_are_drawn_where_their_corners_or_images_have_them_and_ellipses_and_paths_on_the_map():
    pixels = coloured(draw_objects_in_image(BLACK, objects(), WORLD_FROM_CAMERA, "camera"))
    # the face nearest to the camera is 9 m away and 2 m wide and high
    half = 300.0 / 9.0
    seen = (pixels[:, 0].min(), pixels[:, 0].max(), pixels[:, 1].max())
    assert seen == pytest.approx((319.5 - half, 319.5 + half, 199.5 + half), abs=2)
    corners = {"camera": np.array([[100.0, 50.0, 200.0, 120.0]])}
    only = objects(Support.IMAGE, corners_xyxy=corners)
    pixels = coloured(draw_objects_in_image(BLACK, only, WORLD_FROM_CAMERA, "camera"))
    outline = pixels[pixels[:, 1] > 60]
    assert (outline[:, 0].min(), outline[:, 0].max(), outline[:, 1].max()) == pytest.approx((99, 199, 119), abs=1)
    assert len(coloured(draw_objects_in_image(BLACK, only, WORLD_FROM_CAMERA, "other"))) == 0
    drawn = draw_objects_in_image(BLACK, objects(Support.PREDICTED), WORLD_FROM_CAMERA, "camera")
    assert len(coloured(drawn)) == 0, "what rests on no box is darker"
    assert len(coloured(drawn, tuple(round(0.55 * part) for part in PALETTE[3]))) > 50
    layout = layout_map((10.0, 0.0), 20.0, SIZE_PX)

    def drawn(sigma, **options):
        ego = EgoPosition(np.array([10.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
        image = draw_objects_above(np.zeros((0, 3)), objects(sigma=sigma), ego=ego, reach=20.0, **options)
        return coloured(image) - [layout.left, layout.top]

    # 2.45 deviations of 3 m to both sides along y, up on the map; 1.5 m along x
    along, across = [10.0, 2.4477 * 3.0], [10.0 - 2.4477 * 1.5, 0.0]
    (_, top), (left, _), (_, ahead), (_, past) = layout.pixels(np.array([along, across, [10.0, 6.0], [10.0, -15.0]]))
    assert drawn(1.5).min(axis=0) == pytest.approx((left, top), abs=2)
    assert drawn(0.01)[:, 1].min() == pytest.approx(ahead, abs=2)
    trail = {3: np.array([[10.0, -15.0, 0.0], [10.0, 0.0, 0.0]])}
    assert drawn(0.5, trails=trail)[:, 1].max() == pytest.approx(past, abs=2)


def test_fused_boxes_are_objects_that_state_what_they_rest_on():
    centers = np.array([[10.0, 0.0, 0.0], [20.0, 6.0, 0.0]])
    sweep = Boxes3D(5, centers, np.full((2, 3), 2.0), np.zeros(2), np.full(2, 0.9), ("car",) * 2)
    outline = np.array([[286.0, 166.0, 353.0, 233.0], [20.0, 150.0, 60.0, 230.0]])
    image = Boxes2D(5, outline, np.full(2, 0.9), ("car", "pedestrian"))
    camera_from_lidar = WORLD_FROM_CAMERA.inverse()
    fused = fuse_by_projection(DetectionPair(sweep, image, CAMERA, camera_from_lidar))
    rotation = RigidTransform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2.0, 3.0]))
    drawn = objects_of_fused(fused, "camera", world_from_lidar=rotation)
    assert drawn.supports.tolist() == [Support.BOTH, Support.SWEEP, Support.IMAGE]
    assert np.isfinite(drawn.corners_xyxy["camera"]).all(axis=1).tolist() == [True, False, True]
    np.testing.assert_allclose(drawn.centers, rotation.apply(fused.centers))
    assert drawn.yaws[:2] == pytest.approx(fused.yaws[:2] + np.pi / 2.0)
    across = drawn.covariances[1, 0, 0], drawn.covariances[1, 1, 1]
    assert across == pytest.approx((fused.center_covariances[1, 1, 1], fused.center_covariances[1, 0, 0]))
    assert replace(drawn, ids=drawn.ids + 1).timestamp_ns == 5
