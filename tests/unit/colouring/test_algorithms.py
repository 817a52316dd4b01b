import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import ALGORITHMS, ViewRequest, VisibilitySettings
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform

AHEAD = RigidTransform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
LEFT = RigidTransform(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3))
CAMERA_MODEL = Camera("pinhole", 20, 10, 10.0, 10.0, 9.5, 4.5)


def request(camera_id, camera_index, pose, color):
    return ViewRequest(
        camera_id=camera_id,
        camera_index=camera_index,
        camera=CAMERA_MODEL,
        timestamp_ns=camera_index,
        world_from_camera=pose,
        rgb=np.full((10, 20, 3), color, np.uint8),
    )


def test_projection_gives_views_in_order_and_colours_from_all_of_them():
    points = np.array([[5.0, 0, 0], [0, 5, 0], [-5, 0, 0], [5, 4, 0], [4, 5, 0]])
    requests = [request("ahead", 3, AHEAD, (1, 2, 3)), request("left", 1, LEFT, (4, 5, 6))]
    fused = ALGORITHMS["projection"](points, requests, VisibilitySettings())
    assert [view.camera_id for view in fused.views] == ["ahead", "left"]
    assert [view.point_ids.tolist() for view in fused.views] == [[0, 3], [1, 4]]
    assert fused.camera_index.tolist() == [3, 1, 255, 3, 1]
    assert fused.colors.tolist() == [[1, 2, 3], [4, 5, 6], [255] * 3, [1, 2, 3], [4, 5, 6]]


def test_what_is_hidden_in_one_image_takes_its_colour_from_another():
    points = np.array([[9.0, 8.0, 0], [4.5, 4.0, 0]])
    beside = RigidTransform(AHEAD.rotation, np.array([0.0, 8.0, 0.0]))
    requests = [request("ahead", 0, AHEAD, (1, 1, 1)), request("beside", 1, beside, (2, 2, 2))]
    fused = ALGORITHMS["projection"](points, requests, VisibilitySettings())
    assert fused.views[0].visible.tolist() == [False, True]
    assert fused.camera_index.tolist() == [1, 0]


def test_visibility_settings_are_passed_on():
    points = np.array([[9.0, 0, 0], [4.5, 0.005, 0]])
    plain = ALGORITHMS["projection"](points, [request("a", 0, AHEAD, 0)], VisibilitySettings(margin=10.0))
    assert plain.views[0].visible.tolist() == [True, True]


def test_without_images_nothing_has_a_colour():
    fused = ALGORITHMS["projection"](np.zeros((2, 3)), [], VisibilitySettings())
    assert fused.views == ()
    assert fused.camera_index.tolist() == [255, 255]


def test_a_camera_index_out_of_range_is_refused():
    with pytest.raises(OptionError, match="255"):
        ALGORITHMS["projection"](np.zeros((2, 3)), [request("a", 255, AHEAD, 0)], VisibilitySettings())


def test_blending_takes_colours_of_all_images_that_agree():
    points = np.array([[0.0, 0.0, 5.0]])
    rgb = [np.full((21, 21, 3), level, np.uint8) for level in (100, 110)]
    camera_model = Camera("pinhole", 21, 21, 20.0, 20.0, 10.0, 10.0)
    requests = [
        ViewRequest(
            camera_id=f"camera{k}", camera_index=k, camera=camera_model, timestamp_ns=0,
            world_from_camera=RigidTransform.identity(), rgb=image,
        )
        for k, image in enumerate(rgb)
    ]  # fmt: skip
    fused = ALGORITHMS["blending"](points, requests, VisibilitySettings())
    assert fused.colors.tolist() == [[105, 105, 105]]
    assert [view.camera_id for view in fused.views] == ["camera0", "camera1"]
    nothing = ALGORITHMS["blending"](points, [], VisibilitySettings())
    assert nothing.camera_index.tolist() == [255]
