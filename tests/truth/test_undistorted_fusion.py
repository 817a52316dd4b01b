"""Points get the same colours from undistorted images as from those that the camera model took."""

import numpy as np

from sceneloom.cameras import Camera
from sceneloom.editing import convert_camera_models, undistort_scene
from sceneloom.pipeline import iter_fused
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street

CAMERA_MODELS = {
    "barrel": Camera("brown_conrady", 640, 400, 420.0, 430.0, 322.0, 195.0, (-0.28, 0.08, 1e-3, -5e-4, -0.01)),
    "fisheye": Camera("fisheye", 640, 400, 260.0, 260.0, 318.0, 202.0, (0.05, -0.02, 0.01, -0.003)),
}


def colours(scene):
    frame = next(iter_fused(scene))
    seen = frame.points.camera_index != 255
    return frame.points.colors.astype(int), seen


def test_fusing_undistorted_images_or_with_a_fitted_camera_model_gives_points_the_same_colours():
    for camera_model in CAMERA_MODELS.values():
        camera = CameraSpec(camera_model, supersampling=2)
        scene = simulate_street(2, frames=1, lidar=LidarSpec(beams=32, steps=900), cameras=(camera,)).scene
        before, seen_before = colours(scene)
        after, seen_after = colours(undistort_scene(scene, keep=1.0))
        both = seen_before & seen_after
        assert both.sum() > 0.95 * seen_before.sum()
        off = np.abs(before - after)[both].max(axis=1)
        # each takes the colour of the nearest pixel of its own grid, and outlines run between pixels
        assert np.median(off) <= 3
        assert np.mean(off > 30) < 0.1
    camera = CameraSpec(CAMERA_MODELS["fisheye"], supersampling=2)
    scene = simulate_street(2, frames=1, lidar=LidarSpec(beams=32, steps=900), cameras=(camera,)).scene
    before, seen_before = colours(scene)
    after, seen_after = colours(convert_camera_models(scene, "brown_conrady"))
    assert np.mean(seen_before != seen_after) < 1e-3
    both = seen_before & seen_after
    # a camera model that is off by less than 0.1 px has another nearest pixel for few points
    assert np.mean((before != after)[both].any(axis=1)) < 0.05
