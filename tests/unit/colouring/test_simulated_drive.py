"""Visibility, depths and colours against the truth of a simulated drive."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import ViewRequest, VisibilitySettings, fuse_by_projection
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

CAMERA_MODELS = {
    "1242x375": CameraSpec(),
    "long": CameraSpec(Camera("pinhole", 1920, 1080, 1970.0, 1970.0, 959.5, 539.5)),
    "aside": CameraSpec(mount=camera_mount(yaw_deg=60.0, position=(0.3, 0.3, 1.4))),
    "fisheye": CameraSpec(Camera("fisheye", 960, 720, 300.0, 300.0, 479.5, 359.5, (0.01, 0.0, 0.0, 0.0))),
}


@pytest.mark.parametrize("name", CAMERA_MODELS)
@pytest.mark.few(1)
def test_fused_frames_agree_with_what_was_really_there(name):
    drive = simulate_street(1, frames=6, lidar=LidarSpec(range_sigma=0.02), cameras=[CAMERA_MODELS[name]])
    truth, k = drive.truth, 3
    sweep = truth.sweep(k)
    measured = np.linalg.norm(sweep.frame.points.positions.astype(np.float64), axis=1)
    points_world = (
        sweep.origins_world + (sweep.points_world - sweep.origins_world) * (measured / sweep.ranges)[:, None]
    )
    image = drive.scene.cameras[0].images[k]
    request = ViewRequest(
        camera_id="camera0",
        camera_index=0,
        camera=image.camera,
        timestamp_ns=image.timestamp_ns,
        world_from_camera=truth.world_from_camera("camera0", k),
        rgb=image.rgb,
    )
    fused = fuse_by_projection(points_world, [request], VisibilitySettings())
    view = fused.views[0]
    columns, rows = np.floor(view.pixels + 0.5).astype(int).T
    counted = ~truth.edges("camera0", k)[rows, columns]
    seen = truth.visible("camera0", k, sweep.points_world[view.point_ids], tolerance=0.03)
    assert (~view.visible & seen & counted).sum() < 0.03 * (seen & counted).sum()
    # Counts are small where lidar and camera are close: a handful of points may pass.
    assert (view.visible & ~seen & counted).sum() <= max(0.03 * (~seen & counted).sum(), 5)
    drawn = (view.depth_image[rows, columns] == view.depths) & counted & seen
    depths = truth.depth("camera0", k)[rows, columns]
    # The pixel's centre sees the surface up to 0.7 px beside the point; flat surfaces differ by little there.
    assert np.median(np.abs(view.depths - depths)[drawn]) < 0.03
    assert (fused.colors[view.point_ids[view.visible]] == image.rgb[rows, columns][view.visible]).all()
