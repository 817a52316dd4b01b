"""What simulated cameras show: geometry by OpenCV's rays, exposure, rolling shutters, edges."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation
from tests.unit.simulate.scenery import STILL, box, in_box_axes, moving, path_at_speed, street_of

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project, unproject
from sceneloom.simulate import CameraSpec, ExposureSpec, ImageTruth, LidarSpec, camera_mount, simulate_street
from sceneloom.simulate.camera import Exposure, RenderedCamera
from sceneloom.simulate.drive import Truth, edge_mask
from sceneloom.simulate.street import MovingDesign, Part

PINHOLE = Camera("pinhole", 120, 80, 100.0, 110.0, 59.5, 38.0)
BROWN = Camera("brown_conrady", 120, 80, 80.0, 82.0, 58.0, 40.0, (-0.2, 0.05, 0.001, -0.002, -0.004))
FISHEYE = Camera("fisheye", 120, 80, 50.0, 51.0, 60.0, 39.0, (0.02, -0.01, 0.003, -0.001))
AHEAD = camera_mount(position=(0.5, 0.2, 1.6))


def camera_at(spec, street, path=STILL, times=(0,)):
    return RenderedCamera.of(spec, street, path, timestamps_ns=np.array(times, np.int64))


def camera_in(drive, spec):
    """Another camera in a drive, whose images are taken when sweeps begin."""
    return camera_at(spec, drive.truth.street, drive.truth.path, drive.truth.lidar.timestamps_ns)


def opencv_rays(camera):
    """Rays with z = 1 through all pixel centres, by OpenCV."""
    v, u = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2).astype(np.float64)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    exactly = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-14)
    if camera.model == "fisheye":
        flat = cv2.fisheye.undistortPoints(pixels, matrix, np.array(camera.coefficients), criteria=exactly)
    else:
        coefficients = np.array([*camera.coefficients, 0.0, 0.0, 0.0, 0.0][:5])
        flat = cv2.undistortPoints(pixels, matrix, coefficients, criteria=exactly)
    return np.concatenate([flat[:, 0], np.ones((len(flat), 1))], axis=1)


def test_a_wall_square_to_the_camera_has_one_depth_and_the_ground_that_of_its_ray():
    wall = street_of([box([11, 0, 10], [1, 40, 10])])
    truth = camera_at(CameraSpec(PINHOLE, AHEAD), wall).truth(0)
    rays = opencv_rays(PINHOLE).reshape(80, 120, 3)
    below = rays[..., 1] > 1.6 / 9.5
    expected = np.where(below, 1.6 / np.maximum(1e-9, rays[..., 1]), 9.5)
    # The ego moves a micrometre a second, float32 holds 10 m in steps of 1e-6 m.
    np.testing.assert_allclose(truth.depths, expected, atol=3e-6)
    np.testing.assert_array_equal(truth.instances, np.where(below, 0, 1))
    for rotated, axis, expected in (
        ({"yaw_deg": 90.0}, [0, 0, 1], [0, 1, 0]),
        ({"pitch_deg": 30.0}, [0, 0, 1], [np.sqrt(0.75), 0, -0.5]),
        ({}, [0, 1, 0], [0, 0, -1]),
    ):
        np.testing.assert_allclose(camera_mount(**rotated).rotation @ axis, expected, atol=1e-15)
    # Pixels that the camera model does not reach are black and empty: θ - 0.15 θ³ never exceeds 0.994, 40 px.
    folding = Camera("fisheye", 200, 100, 40.0, 40.0, 99.5, 49.5, (-0.15, 0.0, 0.0, 0.0))
    truth = camera_at(CameraSpec(folding, AHEAD), wall).truth(0)
    v, u = np.mgrid[:100, :200]
    outside = np.hypot(u - 99.5, v - 49.5) > 41
    for values, nothing in ((truth.depths, 0), (truth.instances, -1), (truth.colors, 0)):
        assert (values[outside] == nothing).all()
    assert (truth.instances[~outside] >= 0).mean() > 0.5


@pytest.mark.parametrize("camera", [PINHOLE, BROWN, FISHEYE], ids=lambda camera: camera.model)
def test_depths_along_the_rays_of_opencv_end_on_the_surfaces(drive, camera):
    rendered = camera_in(drive, CameraSpec(camera, AHEAD))
    image = rendered.truth(2)
    seen = (image.depths > 0) & (image.depths < 60)
    in_camera = opencv_rays(camera)[seen.ravel()] * image.depths[seen][:, None].astype(np.float64)
    world, instances = rendered.pose(2).apply(in_camera), image.instances[seen]
    # float32 holds 60 m in steps of 4e-6 m; the iterations of both unprojections end below 1e-6 of the ray.
    assert (instances == 0).sum() > 1000
    np.testing.assert_allclose(world[instances == 0, 2], 0.0, atol=1e-4)
    assert drive.truth.visible("camera0", 2, world).mean() > 0.9
    for thing in drive.truth.objects:
        away = in_box_axes(world[instances == thing.instance], thing.center_world, thing.yaw)
        assert (np.abs(away) <= np.array(thing.size_lwh) / 2 + 1e-3).all()


def test_images_are_the_true_colours_at_pixel_centres_and_supersampled_ones_the_mean_of_a_finer_image(drive):
    camera = drive.scene.cameras[0]
    rgb = camera.images[3].rgb
    assert (rgb.shape, rgb.dtype) == ((camera.camera.height, camera.camera.width, 3), np.uint8)
    np.testing.assert_array_equal(rgb, drive.truth.colors("camera0", 3))
    assert len(np.unique(rgb.reshape(-1, 3), axis=0)) > 1000
    times, mount = camera.images.timestamps_ns, camera.mount
    np.testing.assert_array_equal(times, drive.truth.lidar.timestamps_ns + 50_000_000)
    pose, ego = drive.truth.world_from_camera("camera0", 4), drive.truth.path.at(times[4:5])
    np.testing.assert_allclose(pose.translation, ego.rotations[0] @ mount.translation + ego.positions[0], atol=1e-12)
    np.testing.assert_allclose(pose.rotation, ego.rotations[0] @ mount.rotation, atol=1e-12)
    fine, smooth = (
        camera_in(drive, spec).render(1)
        for spec in (CameraSpec(PINHOLE.resized(240, 160), AHEAD), CameraSpec(PINHOLE, AHEAD, supersampling=2))
    )
    mean = fine.reshape(80, 2, 120, 2, 3).mean(axis=(1, 3))
    # Rounding of the mean, half a level; a ray through an edge may fall on its other side.
    assert (np.abs(smooth - mean) <= 0.5).mean() > 0.999
    # patterns are averaged over a pixel
    single, many = (
        camera_in(drive, CameraSpec(PINHOLE.resized(60, 40), AHEAD, supersampling=count)) for count in (1, 8)
    )
    inner = ~edge_mask(single.truth(1), within_px=1)
    difference = np.abs(single.render(1).astype(float) - many.render(1)).max(axis=-1)[inner]
    # Bare surface colours differ from the mean of 64 rays by up to 43 levels in 95 % of the pixels, filtered ones by
    # 13; the filter is a product of two stripes and not the true shape of a pixel on the surface, hence not by 0.
    assert np.median(difference) <= 3
    assert np.percentile(difference, 95) < 20


def test_pixels_near_a_change_of_object_or_a_leap_of_depth_are_marked_and_a_slope_or_the_bare_ground_is_not(drive):
    truth = drive.truth.image("camera0", 0)
    changes = np.zeros(truth.instances.shape, bool)
    down, right = (np.diff(truth.instances, axis=axis) != 0 for axis in (0, 1))
    changes[:-1] |= down
    changes[1:] |= down
    changes[:, :-1] |= right
    changes[:, 1:] |= right
    flat = replace(truth, depths=np.ones_like(truth.depths))
    for within_px in (1, 2, 4):
        expected = ndimage.binary_dilation(changes, np.ones((2 * within_px - 1,) * 2, bool))
        np.testing.assert_array_equal(edge_mask(flat, within_px=within_px), expected)
    slope = np.tile(np.linspace(5, 9, 40, dtype=np.float32), (30, 1))
    image = ImageTruth(slope, np.zeros((30, 40), np.int32), np.zeros((30, 40, 3), np.uint8))
    assert not edge_mask(image).any()
    marked = edge_mask(replace(image, depths=slope + np.where(np.arange(40) < 20, 0, 3).astype(np.float32)))
    assert marked[:, 18:22].all()
    assert not marked[:, [*range(18), *range(22, 40)]].any()
    ground = camera_at(CameraSpec(PINHOLE, camera_mount(pitch_deg=35.0)), street_of([box([-50, 0, 1], [1, 1, 1])]))
    assert not edge_mask(ground.truth(0)).any()


TINY = Camera("pinhole", 81, 61, 60.0, 60.0, 40.0, 30.0)
SMALL = LidarSpec(beams=2, steps=20)


def gains(spec, seconds, *, seed=0, camera=0):
    exposure = Exposure.of(spec, start_ns=5_000, seed=seed, camera=camera)
    return np.array([exposure.gain(5_000 + round(second * 1e9)) for second in seconds])


@pytest.fixture(scope="module")
def exposures():
    spec = ExposureSpec(drift_stops=0.5, steps=((0.25, 1.0),), vignetting=0.4, exposure_ns=6_000_000)
    return [
        simulate_street(
            2, frames=6, lidar=SMALL,
            cameras=[CameraSpec(TINY, exposure=exposure, supersampling=count) for count in (1, 2)],
        )
        for exposure in (None, spec)
    ]  # fmt: skip


def test_the_gain_wanders_smoothly_and_steps_at_the_times_of_the_light_by_seed_and_camera():
    stops = np.log2(gains(ExposureSpec(drift_stops=0.5, drift_period=7.0), np.linspace(0.0, 200.0, 40_001)))
    assert 0.4 < np.abs(stops).max() <= 0.5
    # Waves of 0.35 stops in 7 s and 0.15 stops in 2.67 s: 0.67 stops a second at most.
    assert np.abs(np.diff(stops)).max() <= 0.005 * 0.668
    assert abs(stops.mean()) < 0.02
    # steps of the light come at their times, add and are taken back, or stay
    spec = ExposureSpec(drift_stops=0.0, steps=((4.0, 1.5),), recovery=0.8)
    expected = [1.0, 2**1.5, 2 ** (1.5 / np.e), 1.0]
    assert gains(spec, [3.999, 4.0, 4.8, 30.0]) == pytest.approx(expected, abs=1e-9)
    spec = ExposureSpec(drift_stops=0.0, steps=((1.0, 1.0), (2.0, -3.0)), recovery=float("inf"))
    np.testing.assert_allclose(gains(spec, [0.5, 1.5, 100.0]), [1.0, 2.0, 0.25])
    # cameras and seeds drift on their own and repeat
    seconds, spec = np.linspace(0.0, 10.0, 50), ExposureSpec()
    first = gains(spec, seconds)
    np.testing.assert_array_equal(gains(spec, seconds), first)
    for other in (gains(spec, seconds, camera=1), gains(spec, seconds, seed=1)):
        assert np.abs(other - first).max() > 0.05
    np.testing.assert_array_equal(gains(ExposureSpec(drift_stops=0.0), seconds), 1.0)


def test_images_are_the_true_colours_times_the_gain_cut_off_and_say_how_long_they_were_exposed(exposures):
    plain, exposed = exposures
    truth, images = exposed.truth, exposed.scene.cameras[0].images
    v, u = np.mgrid[:61, :81]
    light = 1.0 - 0.4 * ((u - 40.0) ** 2 + (v - 30.0) ** 2) / (40.0**2 + 30.0**2)
    found = []
    for k in range(6):
        gain = truth.exposure("camera0", k)
        expected = np.floor(np.minimum(255.0, truth.colors("camera0", k) * (gain * light)[..., None]) + 0.5)
        # A product that falls on a half may round to either side.
        assert np.abs(images[k].rgb - expected).max() <= 1
        assert (images[k].rgb == expected).mean() > 0.999
        found.append(gain)
    assert found[2] > 1.5 * found[1]
    assert (images[2].rgb == 255).mean() > (images[1].rgb == 255).mean()
    for name in ("colors", "depths", "instances"):
        np.testing.assert_array_equal(*(getattr(d.truth.image("camera0", 3), name) for d in exposures))
    assert plain.truth.exposure("camera0", 3) == 1.0
    # supersampled images are exposed after the mean
    mean, bright = (drive.scene.cameras[1].images[1].rgb for drive in exposures)
    gain = truth.exposure("camera1", 1)
    assert gain != truth.exposure("camera0", 1)
    # No light is lost in the middle; a product that falls on a half may round to either side.
    for v, u, light in ((30, 40, 1.0), (0, 0, 0.6)):
        assert np.abs(bright[v, u] - np.minimum(255.0, mean[v, u] * gain * light)).max() <= 0.5 + 1e-9
    silent = CameraSpec(TINY, exposure=ExposureSpec(exposure_ns=0))
    drives = (*exposures, simulate_street(2, frames=1, lidar=SMALL, cameras=(silent,)))
    extras = [drive.scene.cameras[0].images[0].extras for drive in drives]
    assert extras == [{}, {"exposureTimeSeconds": 0.006}, {}]


ROLLED = Camera("pinhole", 160, 120, 100.0, 100.0, 79.5, 59.5)
READOUT_NS = 40_000_000
SPEED = 10.0
MOVING = path_at_speed(SPEED)
LEFT = camera_mount(position=(0.0, 0.0, 1.6), yaw_deg=90.0)


def seconds_of(rows):
    """When rows are taken, around the image's time."""
    return ((rows + 0.5) / 120 - 0.5) * READOUT_NS * 1e-9


def rolled_image(shapes, mount, **options):
    """The truth of one image, taken from the moving ego at time zero, of the given shapes."""
    return camera_at(CameraSpec(ROLLED, mount, **options), street_of(shapes, MOVING), MOVING).truth(0)


@pytest.fixture(scope="module")
def rolling_drive():
    cameras = [CameraSpec(ROLLED, camera_mount(yaw_deg=70.0), readout_ns=readout) for readout in (0, READOUT_NS)]
    return simulate_street(3, frames=4, lidar=LidarSpec(beams=32, steps=600), cameras=cameras)


def middles(truth):
    """Rows in which object 1 is seen, and the middle column there [px]."""
    seen = truth.instances == 1
    rows = np.flatnonzero(seen.any(axis=1))
    return rows, np.array([np.flatnonzero(seen[row]).mean() for row in rows])


def test_an_upright_pole_slants_by_the_way_driven_while_the_rows_are_read_and_so_does_what_moves():
    pole = box([0.0, 8.05, 5.0], [0.15, 0.05, 5.0])
    _, upright = middles(rolled_image([pole], LEFT))
    rows, slanted = middles(rolled_image([pole], LEFT, readout_ns=READOUT_NS))
    seconds = seconds_of(rows)
    # The face is 8 m away; a camera that drives to the right sees the pole move to the left, 125 px a second.
    # The middle of whole pixels is off by half a pixel at most.
    np.testing.assert_allclose(slanted, 79.5 - 100.0 * SPEED * seconds / 8.0, atol=0.5)
    assert slanted[0] - slanted[-1] == pytest.approx(125.0 * np.ptp(seconds), abs=1.0)
    assert np.ptp(seconds) > 0.02
    assert np.ptp(upright) < 1e-9
    times = 0.5 * np.arange(-10.0, 20.0)
    curve = np.column_stack([6.0 * times, np.full(30, 8.05), np.zeros(30), np.zeros(30)])
    moved = MovingDesign("car", (Part((box([0.0, 0.0, 5.0], [0.15, 0.05, 5.0]),)),), (0.3, 0.1, 10.0))
    street = street_of(movers=moving([moved], [curve]))
    passing, slanted = middles(camera_at(CameraSpec(ROLLED, LEFT, readout_ns=READOUT_NS), street).truth(0))
    assert min(len(rows), len(passing)) > 60
    # 6 m/s to the right at 8 m are 75 px a second.
    np.testing.assert_allclose(slanted, 79.5 + 75.0 * seconds_of(passing), atol=0.5)
    assert slanted[-1] - slanted[0] > 1.0


def test_what_hides_a_point_is_asked_from_the_line_that_would_see_it_and_passing_columns_make_it_narrower():
    wall = box([0.0, 9.0, 5.0], [3.0, 1.0, 5.0])
    still, seen = (
        (rolled_image([wall], LEFT, **options).instances[40] == 1).sum()
        for options in ({}, {"readout_ns": READOUT_NS, "left_to_right": True})
    )
    # An edge at x is seen in the column u with u = 79.5 + 12.5 (x - 10 t), t = ((u + 0.5) / 160 - 0.5) 0.04.
    pace = 12.5 * SPEED * 0.04 / 160
    assert still == pytest.approx(6 * 12.5, abs=1)
    assert seen == pytest.approx(6 * 12.5 / (1 + pace), abs=1)
    assert seen < still
    # each row's depth is that at the row's time
    wall = box([21.0, 0.0, 20.0], [1.0, 60.0, 20.0])
    depths = rolled_image([wall], camera_mount(position=(0.0, 0.0, 1.6)), readout_ns=READOUT_NS).depths
    expected = 20.0 - SPEED * seconds_of(np.arange(60))
    np.testing.assert_allclose(depths[:60], np.repeat(expected[:, None], 160, axis=1), atol=1e-5)
    # what hides a point is asked from the line that would see it
    street = street_of([box([0.0, 4.05, 5.0], [0.15, 0.05, 5.0]), box([0.0, 21.0, 10.0], [60.0, 1.0, 10.0])], MOVING)
    camera = camera_at(CameraSpec(ROLLED, LEFT, readout_ns=READOUT_NS), street, MOVING)
    row, column = np.nonzero(camera.truth(0).instances[:60] > 0)
    # A ray through a pixel of the line meets the wall, 20 m away, where nothing but the pole can stand before it.
    driven, along, down = SPEED * seconds_of(row), (column - 79.5) / 100.0, (row - 59.5) / 100.0
    on_wall = np.column_stack([driven + 20.0 * along, np.full(len(row), 20.0), 1.6 - 20.0 * down])
    low = on_wall[:, 2] < 19.0
    free = Truth(street, MOVING, {}, {"camera0": camera}, {}, None).visible("camera0", 0, on_wall[low])
    from_pole = np.abs(driven + 4.0 * along)[low]
    # The pole is 0.15 m to either side; the line is known to half a line, in which the camera drives 2 mm.
    sure = np.abs(from_pole - 0.15) > 0.003
    np.testing.assert_array_equal(free[sure], from_pole[sure] > 0.15)
    assert 300 < (~free).sum() < len(free) / 10


def test_line_poses_are_those_at_each_lines_time_and_a_point_lies_in_the_line_that_sees_it(rolling_drive):
    shown = rolling_drive.scene.cameras[1].images[3].rgb
    np.testing.assert_array_equal(shown, rolling_drive.truth.colors("camera1", 3))
    camera = rolling_drive.truth.cameras["camera1"]
    rotations, origins = camera.line_poses(2)
    timestamp = rolling_drive.scene.sensor("camera1").images.timestamps_ns[2]
    times = timestamp + np.rint(seconds_of(np.arange(120)) * 1e9).astype(np.int64)
    np.testing.assert_array_equal(camera.line_times_ns(2), times)
    ego, mount = rolling_drive.truth.path.at(times), camera_mount(yaw_deg=70.0)
    world_from_ego = Rotation.from_matrix(ego.rotations)
    composed = world_from_ego * Rotation.from_matrix(mount.rotation.copy())
    np.testing.assert_allclose(rotations, composed.as_matrix(), atol=1e-12)
    expected = world_from_ego.apply(mount.translation.copy()) + ego.positions
    np.testing.assert_allclose(origins, expected, atol=1e-12)
    # a global shutter takes the middle of a rolling one
    still, rolling = (rolling_drive.truth.image(f"camera{k}", 1) for k in (0, 1))
    # The rows 59 and 60 are taken 0.17 ms before and after the image's time: 2 mm on the way.
    first, *inner = ((still.instances[row] == rolling.instances[row]).mean() for row in (0, 59, 60))
    assert first < min(inner)
    assert min(inner) > 0.98
    assert rolling_drive.scene.sensor("camera0").extras == {}
    world, _, _ = seen_points(rolling_drive, 2, lambda truth: truth.instances == 0)
    assert len(world) > 3000
    # float32 holds 100 m in steps of 8e-6 m.
    np.testing.assert_allclose(world[:, 2], 0.0, atol=2e-5)
    world, row, column = seen_points(rolling_drive, 1, lambda truth: (truth.depths > 0) & (truth.depths < 60))
    np.testing.assert_array_equal(rolling_drive.truth.cameras["camera1"].lines_seeing(1, world), row)
    # A ray that grazes an edge may fall on its other side.
    assert rolling_drive.truth.visible("camera1", 1, world).mean() > 0.995
    middle = rolling_drive.truth.world_from_camera("camera1", 1)
    pixels, inside = project(ROLLED, middle.inverse().apply(world))
    assert np.nanmax(np.abs(pixels[inside] - np.column_stack([column, row])[inside])) > 3.0


def seen_points(drive, k, which):
    """World points of pixels of the rolling camera, by the poses of their lines; rows and columns."""
    camera, truth = drive.truth.cameras["camera1"], drive.truth.image("camera1", k)
    rotations, origins = camera.line_poses(k)
    row, column = np.nonzero(which(truth))
    rays = unproject(ROLLED, np.column_stack([column, row]).astype(np.float64))
    points = rays / rays[:, 2:] * truth.depths[row, column][:, None].astype(np.float64)
    return np.einsum("nij,nj->ni", rotations[row], points) + origins[row], row, column


@pytest.mark.parametrize("name", ["drive", "drive.sfs"])
def test_files_keep_the_roll_time_and_the_exposure_time(tmp_path, name):
    cameras = (
        CameraSpec(ROLLED, readout_ns=33_000_000, exposure=ExposureSpec(exposure_ns=4_000_000)),
        CameraSpec(ROLLED, readout_ns=20_000_000, left_to_right=True),
    )
    scene = simulate_street(1, frames=2, lidar=LidarSpec(beams=4, steps=50), cameras=cameras).scene
    sceneloom.write(scene, tmp_path / name)
    if name == "drive":
        entries = json.loads((tmp_path / "drive" / "calibration.json").read_text())["cameras"]
        assert [entry["shutterRollTimeSeconds"] for entry in entries] == [0.033, 0.02]
        assert [entry.get("rollingShutterLeftToRight") for entry in entries] == [None, True]
        assert entries[0]["model"] == "pinhole"
    with sceneloom.open(tmp_path / name) as again:
        first, second = again.cameras
        assert first.extras["calibration"]["shutterRollTimeSeconds"] == 0.033
        assert second.extras["calibration"]["rollingShutterLeftToRight"] is True
        assert first.images[1].extras["exposureTimeSeconds"] == 0.004
        assert "exposureTimeSeconds" not in second.images[1].extras
        np.testing.assert_array_equal(first.images.timestamps_ns, scene.cameras[0].images.timestamps_ns)
