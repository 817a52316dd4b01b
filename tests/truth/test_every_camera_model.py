"""One street seen through a camera model of every model, coloured by the fusion system.

Held against what was really there.
"""

import numpy as np
import pytest

from sceneloom.cameras import MODELS, Camera, Chart
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.pipeline import iter_fused
from sceneloom.scene.scene import with_assumed_models
from sceneloom.simulate import CameraSpec, LidarSpec, SimulatedDrive, camera_mount, simulate_street

SIZE = (240, 160)
WIDE = (*SIZE, 68.0, 66.0, 121.3, 78.4)
PANORAMA = (*SIZE, SIZE[0] / (2 * np.pi), 40.0, 119.5, 79.5)
SIX = (0.02, -0.01, 0.003, -4e-4, 2e-5, -1e-6)
ASYMMETRIC = (0.01, 0.002, -0.001, 0.3, -0.2, 0.1, 0.4, 0.01, -0.02, 0.001, 0.2, 0.3, -0.1, 0.2)
CAMERA_MODELS = {
    "pinhole": Camera("pinhole", *WIDE),
    "brown_conrady": Camera(
        "brown_conrady", *WIDE, (0.4461, -0.1213, 1.7e-4, -2.5e-4, 0.0035, 0.8021, -0.0771, 0.011, 0.002, -0.001)
    ),
    "fisheye": Camera("fisheye", *WIDE, SIX[:4]),
    "mod_equi_fish": Camera("mod_equi_fish", *WIDE, (0.0, 0.02, -0.02, 0.003)),
    "mod_kannala": Camera("mod_kannala", *WIDE, (0.03, -0.02, 0.004)),
    "cylindrical": Camera("cylindrical", *PANORAMA),
    "equirectangular": Camera("equirectangular", *PANORAMA),
    "omnidirectional": Camera("omnidirectional", *WIDE, (-0.02, 0.003, 0, 0, 1e-3, -1e-3, 0.9, 0.002, -0.001)),
    "fisheye_rad_tan_prism": Camera("fisheye_rad_tan_prism", *WIDE, (*SIX, 1e-3, -1e-3, 5e-4, 1e-4, -1e-3, -1e-4)),
    "fisheye_radial_custom": Camera("fisheye_radial_custom", *WIDE, (*SIX, 1e-3, -1e-3, 2.5, -1.5)),
    "ftheta": Camera("ftheta", *WIDE, (0.0, 67.0, 1.0, -0.8, 0.05)),
    "ftheta_skewed": Camera("ftheta_skewed", *WIDE, (0.0, 0.015, -0.012, 0.001, 0.0, 1.0, -0.5)),
    "kannala_brandt18": Camera("kannala_brandt18", *WIDE, (*SIX[:4], *ASYMMETRIC)),
    "omnidir": Camera("omnidir", *WIDE, (-0.02, 0.003, 0.4, 1.1, 1e-3, -1e-3)),
}
SEES_BEHIND = [name for name in MODELS if MODELS[name].chart is not Chart.PERSPECTIVE]


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    """A sweep or two of a street, with one camera per model, all at the same location.

    Looking to the left and ahead.
    """
    mount = camera_mount(position=(0.4, 0.0, 1.7), yaw_deg=35.0)
    specs = tuple(CameraSpec(camera, mount) for camera in CAMERA_MODELS.values())
    return simulate_street(3, frames=2, lidar=LidarSpec(steps=900), cameras=specs)


@pytest.fixture(scope="module")
def frame(drive: SimulatedDrive) -> FusedFrame:
    """What the fusion system makes of the second sweep."""
    *_, last = iter_fused(with_assumed_models(drive.scene))
    return last


def view_of(frame: FusedFrame, model: str) -> FusedView:
    (view,) = [view for view in frame.views if view.camera.model == model]
    return view


@pytest.mark.parametrize("model", CAMERA_MODELS)
@pytest.mark.few(6)
def test_points_lie_in_the_pixels_that_show_them(drive, frame, model):
    view = view_of(frame, model)
    truth = drive.truth.image(f"camera{list(CAMERA_MODELS).index(model)}", 1)
    column, row = np.rint(view.pixels[view.visible]).astype(int).T
    shown, depths = truth.depths[row, column], view.depths[view.visible]
    assert len(depths) > 2000
    # a pixel is up to 1.5 degrees wide here, and the ground runs away within it; outlines take some points
    right = np.abs(shown - depths) < 0.3 + 0.1 * np.abs(depths)
    assert right.mean() > 0.93
    assert np.array_equal(view.rgb[row, column], truth.colors[row, column])


def test_points_have_the_colour_of_their_pixel_of_every_model_and_wide_ones_see_behind_the_camera(frame):
    assert set(CAMERA_MODELS) == set(MODELS)
    assert all(name == camera.model for name, camera in CAMERA_MODELS.items())
    for model in SEES_BEHIND:
        view = view_of(frame, model)
        assert (view.depths[view.visible] < 0).sum() > 100
    points = frame.points
    for view in frame.views:
        index = int(str(view.camera_id).removeprefix("camera"))
        mine = view.visible & (points.camera_index[view.point_ids] == index)
        column, row = np.floor(view.pixels[mine] + 0.5).astype(int).T
        assert np.array_equal(points.colors[view.point_ids[mine]], view.rgb[row, column])
    assert (points.camera_index != 255).mean() > 0.9  # the panoramas see nearly all points
