from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage

from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.simulate import CameraSpec, ImageTruth, camera_mount
from sceneloom.simulate.camera import RenderedCamera, edge_mask
from sceneloom.simulate.objects import Material, Pattern

PINHOLE = Camera("pinhole", 120, 80, 100.0, 110.0, 59.5, 38.0)
BROWN = Camera("brown_conrady", 120, 80, 80.0, 82.0, 58.0, 40.0, (-0.2, 0.05, 0.001, -0.002, -0.004))
FISHEYE = Camera("fisheye", 120, 80, 50.0, 51.0, 60.0, 39.0, (0.02, -0.01, 0.003, -0.001))
AHEAD = camera_mount(position=(0.5, 0.2, 1.6))


def plain(color):
    return Material(Pattern.PLAIN, (color,) * 3)


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


@pytest.fixture(scope="module")
def wall_camera(street_of, stationary_path, box):
    """A camera half a metre ahead of an ego that stands 10 m before a wall."""

    def make(**options):
        street = street_of([box([11, 0, 10], [1, 40, 10], plain((200.0, 100.0, 50.0)))], stationary_path)
        spec = CameraSpec(PINHOLE, AHEAD, **options)
        times = np.array([0, 100_000_000], np.int64) + spec.offset_ns
        return RenderedCamera.of(spec, street, stationary_path, timestamps_ns=times)

    return make


def test_a_wall_square_to_the_camera_has_one_depth_and_the_ground_that_of_its_ray(wall_camera):
    truth = wall_camera().truth(0)
    rays = opencv_rays(PINHOLE).reshape(80, 120, 3)
    below = rays[..., 1] > 1.6 / 9.5
    expected = np.where(below, 1.6 / np.maximum(1e-9, rays[..., 1]), 9.5)
    # The ego moves a micrometre a second, float32 holds 10 m in steps of 1e-6 m.
    np.testing.assert_allclose(truth.depths, expected, atol=3e-6)
    np.testing.assert_array_equal(truth.instances, np.where(below, 0, 1))


@pytest.mark.parametrize("camera", [PINHOLE, BROWN, FISHEYE], ids=lambda camera: camera.model)
def test_depths_along_the_rays_of_opencv_end_on_the_surfaces(drive, camera):
    truth = drive.truth
    rendered = RenderedCamera.of(
        CameraSpec(camera, AHEAD), truth.street, truth.path, timestamps_ns=truth.lidar.timestamps_ns
    )
    image = rendered.truth(2)
    seen = (image.depths > 0) & (image.depths < 60)
    pose = rendered.pose(2)
    world = pose.apply(opencv_rays(camera)[seen.ravel()] * image.depths[seen][:, None].astype(np.float64))
    instances = image.instances[seen]
    # float32 holds 60 m in steps of 4e-6 m; the iterations of both unprojections end below 1e-6 of the ray.
    assert (instances == 0).sum() > 1000
    np.testing.assert_allclose(world[instances == 0, 2], 0.0, atol=1e-4)
    free = truth.visible("camera0", 2, world)
    assert free.mean() > 0.9
    for thing in truth.objects:
        own = world[instances == thing.instance]
        cosine, sine = np.cos(thing.yaw), np.sin(thing.yaw)
        away = (own - thing.center_world) @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        assert (np.abs(away) <= np.array(thing.size_lwh) / 2 + 1e-3).all()


def test_left_is_left_and_up_is_up_in_the_image(street_of, stationary_path, box):
    colors = {"left": (250.0, 20.0, 20.0), "right": (20.0, 20.0, 250.0), "up": (20.0, 250.0, 20.0)}
    shapes = [
        box([20, 5, 1.6], [1, 2, 1], plain(colors["left"])),
        box([20, -5, 1.6], [1, 2, 1], plain(colors["right"])),
        box([20, 0, 7], [1, 2, 1], plain(colors["up"])),
    ]
    spec = CameraSpec(PINHOLE, camera_mount(position=(0, 0, 1.6)))
    truth = RenderedCamera.of(
        spec, street_of(shapes, stationary_path), stationary_path, timestamps_ns=np.zeros(1, np.int64)
    ).truth(0)
    middles = [np.argwhere(truth.instances == number).mean(axis=0) for number in (1, 2, 3)]
    (_, left), (_, right), (top, middle) = middles
    assert left < middle < right
    assert top < PINHOLE.cy - 10
    for number, channel in ((1, 0), (2, 2), (3, 1)):
        assert truth.colors[truth.instances == number].mean(axis=0).argmax() == channel


def test_rotated_mounts_look_left_and_down():
    mount = camera_mount(yaw_deg=90.0)
    np.testing.assert_allclose(mount.rotation @ [0, 0, 1], [0, 1, 0], atol=1e-15)
    down = camera_mount(pitch_deg=30.0)
    np.testing.assert_allclose(down.rotation @ [0, 0, 1], [np.sqrt(0.75), 0, -0.5], atol=1e-15)
    np.testing.assert_allclose(camera_mount().rotation @ [0, 1, 0], [0, 0, -1], atol=1e-15)


def test_the_image_is_the_true_colour_at_pixel_centres(drive):
    camera = drive.scene.cameras[0]
    rgb = camera.images[3].rgb
    assert rgb.shape == (camera.camera.height, camera.camera.width, 3)
    assert rgb.dtype == np.uint8
    np.testing.assert_array_equal(rgb, drive.truth.colors("camera0", 3))
    assert len(np.unique(rgb.reshape(-1, 3), axis=0)) > 1000


def test_supersampling_is_the_mean_of_a_finer_image(drive):
    truth = drive.truth
    times = truth.lidar.timestamps_ns
    fine = RenderedCamera.of(
        CameraSpec(PINHOLE.resized(240, 160), AHEAD), truth.street, truth.path, timestamps_ns=times
    ).render(1)
    smooth = RenderedCamera.of(
        CameraSpec(PINHOLE, AHEAD, supersampling=2), truth.street, truth.path, timestamps_ns=times
    ).render(1)
    mean = fine.reshape(80, 2, 120, 2, 3).mean(axis=(1, 3))
    # Rounding of the mean, half a level; a ray through an edge may fall on its other side.
    assert (np.abs(smooth - mean) <= 0.5).mean() > 0.999


def test_patterns_are_averaged_over_a_pixel(drive):
    truth = drive.truth
    times = truth.lidar.timestamps_ns
    coarse = PINHOLE.resized(60, 40)

    def image(supersampling):
        spec = CameraSpec(coarse, AHEAD, supersampling=supersampling)
        return RenderedCamera.of(spec, truth.street, truth.path, timestamps_ns=times)

    single, many = image(1), image(8)
    inner = ~edge_mask(single.truth(1), within_px=1)
    difference = np.abs(single.render(1).astype(float) - many.render(1)).max(axis=-1)[inner]
    # Bare surface colours differ from the mean of 64 rays by up to 43 levels in 95 % of the pixels, filtered ones by
    # 13; the filter is a product of two stripes and not the true shape of a pixel on the surface, hence not by 0.
    assert np.median(difference) <= 3
    assert np.percentile(difference, 95) < 20


def test_pixels_that_the_camera_model_does_not_reach_are_black_and_empty(wall_camera, stationary_path):
    camera = wall_camera()
    folding = Camera("fisheye", 200, 100, 40.0, 40.0, 99.5, 49.5, (-0.15, 0.0, 0.0, 0.0))
    spec = CameraSpec(folding, AHEAD)
    truth = RenderedCamera.of(
        spec, camera.street, stationary_path, timestamps_ns=np.zeros(1, np.int64)
    ).truth(0)
    # θ - 0.15 θ³ never exceeds 0.994: no pixel beyond 40 px from the axis is reached.
    v, u = np.mgrid[:100, :200]
    outside = np.hypot(u - 99.5, v - 49.5) > 41
    assert (truth.depths[outside] == 0).all()
    assert (truth.instances[outside] == -1).all()
    assert (truth.colors[outside] == 0).all()
    assert (truth.instances[~outside] >= 0).mean() > 0.5


def test_the_shutter_opens_at_the_offset_where_the_ego_is_then(drive):
    times = drive.scene.cameras[0].images.timestamps_ns
    np.testing.assert_array_equal(times, drive.truth.lidar.timestamps_ns + 50_000_000)
    pose, ego = drive.truth.world_from_camera("camera0", 4), drive.truth.path.at(times[4:5])
    mount = drive.scene.cameras[0].mount
    np.testing.assert_allclose(
        pose.translation, ego.rotations[0] @ mount.translation + ego.positions[0], atol=1e-12
    )
    np.testing.assert_allclose(pose.rotation, ego.rotations[0] @ mount.rotation, atol=1e-12)


def test_images_are_the_same_in_whatever_order_they_are_asked_for(drive):
    images = drive.scene.cameras[0].images
    later = images[6].rgb
    assert not np.array_equal(images[0].rgb, later)
    np.testing.assert_array_equal(images[6].rgb, later)


def image_of(depths, instances):
    depths = np.asarray(depths, np.float32)
    return ImageTruth(depths, np.asarray(instances, np.int32), np.zeros((*depths.shape, 3), np.uint8))


def slow_edges(truth, within_px):
    """Pixels at most so many rows and columns from one whose neighbour is another object."""
    instances = truth.instances
    edges = np.zeros(instances.shape, bool)
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        beside = np.roll(instances, step, axis)
        index = [slice(None)] * 2
        index[axis] = 0 if step == 1 else -1
        change = beside != instances
        change[tuple(index)] = False
        edges |= change
    square = np.ones((2 * within_px - 1,) * 2, bool)
    return ndimage.binary_dilation(edges, square)


@pytest.mark.parametrize("within_px", [1, 2, 4])
def test_pixels_near_a_change_of_object_are_marked(drive, within_px):
    truth = drive.truth.image("camera0", 0)
    flat = replace(truth, depths=np.ones_like(truth.depths))
    np.testing.assert_array_equal(edge_mask(flat, within_px=within_px), slow_edges(truth, within_px))


def test_a_leap_of_depth_inside_one_object_is_marked_and_a_slope_is_not():
    depths = np.tile(np.linspace(5, 9, 40), (30, 1))
    assert not edge_mask(image_of(depths, np.zeros((30, 40)))).any()
    depths[:, 20:] += 3.0
    marked = edge_mask(image_of(depths, np.zeros((30, 40))))
    assert marked[:, 18:22].all()
    assert not marked[:, :18].any()
    assert not marked[:, 22:].any()


def test_the_bare_ground_has_no_edges(street_of, stationary_path, box):
    street = street_of([box([-50, 0, 1], [1, 1, 1])], stationary_path)
    spec = CameraSpec(PINHOLE, camera_mount(pitch_deg=35.0))
    camera = RenderedCamera.of(spec, street, stationary_path, timestamps_ns=np.zeros(1, np.int64))
    assert not edge_mask(camera.truth(0)).any()


def test_cameras_that_cannot_be_are_refused():
    with pytest.raises(OptionError, match="supersampling"):
        CameraSpec(supersampling=0)
    with pytest.raises(CalibrationError, match="pinhole"):
        CameraSpec(replace(PINHOLE, model="pinhole9"))
