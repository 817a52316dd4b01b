"""Exposures of cameras distinguished from surfaces that two images show."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import ExposureLinks, blend_colours
from sceneloom.pipeline import iter_fused
from sceneloom.simulate import CameraSpec, ExposureSpec, LidarSpec, camera_mount, simulate_street

FRAMES = 6
CAMERA_MODEL = Camera("pinhole", 400, 260, 260.0, 260.0, 199.5, 129.5)


def rig(*yaws_deg: float, stops: float = 0.5):
    """Cameras that look in these directions, each with an automatic of its own."""
    cameras = [
        CameraSpec(CAMERA_MODEL, camera_mount(yaw_deg=yaw), exposure=ExposureSpec(drift_stops=stops), supersampling=2)
        for yaw in yaws_deg
    ]
    return simulate_street(11, frames=FRAMES, lidar=LidarSpec(beams=48, steps=900), cameras=cameras)


def gathered(drive, links=None):
    links = ExposureLinks() if links is None else links
    frames = list(iter_fused(drive.scene))
    for frame in frames:
        links.add(frame.views[0].points_world, frame.views, range(len(frame.views)))
    return links.solve(), frames


@pytest.fixture(scope="module")
def overlapping():
    drive = rig(0.0, 45.0)
    return drive, *gathered(drive)


def test_exposures_of_cameras_are_recovered_within_two_percent(overlapping):
    drive, gains, _ = overlapping
    for k in range(FRAMES):
        evened = [
            drive.truth.exposure(f"camera{c}", k) * gains.at(c, int(drive.scene.cameras[c].images.timestamps_ns[k]))
            for c in range(2)
        ]
        np.testing.assert_allclose(evened[0] / evened[1], 1.0, atol=0.02)
    assert gains.alone == ()


def test_the_mean_brightness_stays(overlapping):
    _, gains, _ = overlapping
    logs = np.concatenate([gains.log_gains[c] for c in range(2)])
    # the mean is weighted by points, which images do not have alike
    np.testing.assert_allclose(logs.mean(axis=0), 0.0, atol=0.05)


def test_seams_between_cameras_shrink(overlapping):
    _, gains, _ = overlapping
    assert gains.seam_pairs > 200
    assert gains.seam_after < 0.25 * gains.seam_before
    assert gains.seam_after < 1.0  # level: what a pixel's own noise is


def test_evened_colours_are_the_surface_s_own_but_for_one_factor(overlapping):
    drive, gains, frames = overlapping
    ratios = []
    for k, frame in enumerate(frames):
        points, indices = frame.views[0].points_world, range(2)
        blended = blend_colours(points, frame.views, indices, gains=gains.for_views(frame.views, indices))
        seen = blended.sources.camera_index != 255
        truth = drive.truth.clean_points_world(k).colors[seen].astype(float)
        usable = (truth.min(axis=1) > 30) & (truth.max(axis=1) < 160)
        ratios.append(np.median(blended.colors[seen][usable] / truth[usable]))
    np.testing.assert_allclose(ratios, np.mean(ratios), rtol=0.02)


@pytest.mark.slow
def test_cameras_that_never_show_the_same_are_named_and_keep_their_brightness():
    drive = rig(0.0, 180.0)
    gains, _ = gathered(drive)
    assert gains.alone == (0, 1)
    assert np.isnan(gains.seam_before)
    for camera in (0, 1):
        np.testing.assert_allclose(gains.log_gains[camera].mean(axis=0), 0.0, atol=0.05)


def test_black_images_and_no_images_give_no_factors():
    links = ExposureLinks()
    assert links.solve().at(0, 0) is None
    drive = rig(0.0, 45.0, stops=0.0)
    frame = next(iter_fused(drive.scene))
    for view in frame.views:
        view.rgb.setflags(write=True)
        view.rgb[:] = 0
    links.add(frame.views[0].points_world, frame.views, range(2))
    gains = links.solve()
    assert gains.at(0, 0) is None
    assert gains.alone == (0, 1)
    assert gains.for_views(frame.views, range(2)) == {}
