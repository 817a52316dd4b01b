"""Colours and labels of several images become one, as means and by votes."""

import math

import cv2
import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import ExposureLinks, VisibilitySettings, blend_colours
from sceneloom.colouring.algorithms import view_points
from sceneloom.colouring.blending import NO_IMAGE_NS, colour_points
from sceneloom.colouring.exposure import _near_outlines
from sceneloom.colouring.labels import NO_LABEL, LabelCanvas, paint_labels
from sceneloom.colouring.results import FusedView
from sceneloom.errors import ArrayError, OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.projection import pixel_numbers
from sceneloom.pipeline import iter_fused
from sceneloom.simulate import CameraSpec, ExposureSpec, LidarSpec, camera_mount, simulate_street

CAMERA = Camera("pinhole", 101, 81, 100.0, 100.0, 50.0, 40.0)
PLAIN = VisibilitySettings(enabled=False)


def image(level):
    return np.full((81, 101, 3), level, np.uint8)


def view(points, rgb, *, x=0.0, camera_id="a", timestamp_ns=0, camera=CAMERA):
    points, pose = np.asarray(points, np.float64), RigidTransform(np.eye(3), np.array([x, 0.0, 0.0]))
    return view_points(points, camera, pose, rgb, camera_id=camera_id, timestamp_ns=timestamp_ns, visibility=PLAIN)


def test_colours_are_means_over_a_beam_and_points_that_no_image_shows_stay_white():
    rgb = np.random.default_rng(0).integers(0, 255, (81, 101, 3)).astype(np.uint8)
    u, v = np.array([10.25, 50.0, 99.9]), np.array([20.75, 40.5, 3.1])
    points = np.stack([(u - 50) / 100 * 5, (v - 40) / 100 * 5, np.full(3, 5.0)], axis=1)
    blended = blend_colours(points, [view(points, rgb)], [0])
    # 3 mrad are less than a pixel. A slow answer: the four pixels around, weighted by the areas opposite to them.
    column, row = np.floor([u, v]).astype(int)
    wanted = sum(
        (abs(1 - du - (u - column)) * abs(1 - dv - (v - row)))[:, None] * rgb[row + dv, column + du]
        for dv in (0, 1)
        for du in (0, 1)
    )
    np.testing.assert_allclose(blended.colors, wanted, atol=0.51)  # rounding to levels
    # 3 mrad of 1000 px are three pixels around a pixel's centre: OpenCV's box
    sharp = Camera("pinhole", 101, 81, 1000.0, 1000.0, 50.0, 40.0)
    columns, rows = np.array([7, 50, 93, 50]), np.array([60, 40, 2, 79])
    points = np.stack([(columns - 50) / 1000 * 5, (rows - 40) / 1000 * 5, np.full(4, 5.0)], axis=1)
    blended = blend_colours(points, [view(points, rgb, camera=sharp)], [0])
    boxed = cv2.blur(rgb.astype(np.float32), (3, 3))
    np.testing.assert_allclose(blended.colors, boxed[rows, columns], atol=0.52)
    # at the corner, of the pixels that there are
    corner = np.array([[-50 / 1000 * 5, -40 / 1000 * 5, 5.0]])
    blended = blend_colours(corner, [view(corner, rgb, camera=sharp)], [0])
    np.testing.assert_allclose(blended.colors[0], rgb[:2, :2].mean(axis=(0, 1)), atol=0.52)
    points = np.array([[0.0, 0.0, -5.0], [np.nan, 0.0, 1.0]])
    blended = blend_colours(points, [view(points, image(10))], [0])
    assert (blended.colors == 255).all()
    assert (blended.sources.camera_index == 255).all()
    assert (blended.sources.images_ns == NO_IMAGE_NS).all()
    assert np.isnan(blended.sources.pixels).all()
    assert blend_colours(points, [], []).colors.shape == (2, 3)


def test_images_count_by_their_nearness_in_time_and_gains_multiply_their_colours():
    points = np.array([[2.4, 0.0, 5.0]])
    views = [view(points, image(10)), view(points, image(200), x=1.2, camera_id="b", timestamp_ns=7)]
    blended = blend_colours(points, views, [3, 5])
    sources = blended.sources  # of equal ones the first
    assert (blended.colors.tolist(), sources.camera_index.tolist(), sources.images_ns.tolist()) == (
        [[105] * 3], [3], [0]
    )  # fmt: skip
    np.testing.assert_allclose(sources.pixels, [[98.0, 40.0]], atol=1e-4)
    # 50 ms away an image counts half, 0.15 s away a tenth: (40 + 0.5 * 100 + 0.1 * 240) / 1.6
    points = np.array([[0.0, 0.0, 5.0]])
    views = [
        view(points, image(level), timestamp_ns=time_ns)
        for level, time_ns in ((100, 50_000_000), (40, 0), (240, -150_000_000))
    ]
    blended = blend_colours(points, views, [0, 1, 2], timestamps_ns=np.array([0]))
    assert blended.colors.tolist() == [[71] * 3]
    assert (blended.sources.camera_index.tolist(), blended.sources.weights.tolist()) == ([1], [1.0])
    blended = blend_colours(points, [view(points, image(100))], [4], gains={4: np.array([0.5, 1.0, 3.0])})
    assert blended.colors.tolist() == [[50, 100, 255]]


def test_points_beside_an_outline_are_known_and_a_road_at_a_grazing_angle_is_none():
    u = np.arange(20, 81, 2.0)
    z = np.where(u < 50, 5.0, 12.0)  # a wall that ends before a farther one
    points = np.stack([(u - 50) / 100 * z, np.zeros(len(u)), z], axis=1)
    seen = view(points, image(100))
    beside = _near_outlines(seen)
    assert beside[np.abs(u - 49) < 2].all()
    assert not beside[np.abs(u - 50) > 8].any()
    z, x = (axis.ravel() for axis in np.meshgrid(np.linspace(5, 60, 60), np.linspace(-2, 2, 9)))
    points = np.stack([x, np.full(len(z), 1.6), z], axis=1)
    assert not _near_outlines(view(points, image(100))).any()


def make_view(point_ids, pixels, rgb, visible=None):
    (height, width), count = rgb.shape[:2], len(point_ids)
    pixels = np.array(pixels, np.float32).reshape(count, 2)
    return FusedView(
        "c", Camera("pinhole", width, height, 100.0, 100.0, 0.0, 0.0), 0, RigidTransform.identity(), rgb,
        np.array(point_ids, np.int64), pixels, pixel_numbers(pixels, width, height), np.ones(count, np.float32),
        np.ones(count, bool) if visible is None else np.array(visible, bool), np.zeros((height, width), np.float32),
        np.zeros((max(point_ids, default=-1) + 1, 3)),
    )  # fmt: skip


def plain(color, size=(4, 6)):
    return np.full((*size, 3), color, np.uint8)


def central(size, pixel, color):
    return make_view([0], [pixel], plain(color, size))


def test_points_have_the_colour_of_the_image_that_shows_them_most_centrally():
    for count, views, indices, colors, cameras in [
        (3, [make_view([1], [(2, 1)], plain((1, 2, 3)))], [4], [[255] * 3, [1, 2, 3], [255] * 3], [255, 4, 255]),
        (2, [], [], [[255] * 3] * 2, [255, 255]),
        (0, [make_view([], [], plain(0)), make_view([], [], plain(0))], [0, 1], [], []),
        # hidden points take no colour
        (2, [make_view([0, 1], [(1, 1), (1, 1)], plain(9), [False, True])], [0], [[255] * 3, [9] * 3], [255, 0]),
        (1, [make_view([0], [(2, 1)], plain(1), [False]), make_view([0], [(0, 0)], plain(2))], [0, 1], [[2] * 3], [1]),
        # 5 px off the centre of the small image are a fifth of its half diagonal, 40 px of the large one 0.16
        (1, [central((30, 40), (24.5, 14.5), 1), central((300, 400), (239.5, 149.5), 2)], [7, 8], [[2] * 3], [8]),
        (1, [central((30, 40), (24.5, 14.5), 1), central((300, 400), (259.5, 149.5), 2)], [7, 8], [[1] * 3], [7]),
        # of equally central views the first counts
        (1, [make_view([0], [(1, 2)], plain(color)) for color in (10, 20, 30)], [2, 1, 0], [[10] * 3], [2]),
    ]:
        found, camera_index = colour_points(count, views, indices)
        assert found.dtype == camera_index.dtype == np.uint8
        assert (found.shape, found.tolist(), camera_index.tolist()) == ((count, 3), colors, cameras)
    random, views, indices = np.random.default_rng(1), [], (5, 0, 254)
    for size in ((4, 6), (9, 5), (1, 1)):
        ids = np.sort(random.permutation(50)[:35])
        pixels = random.uniform(-0.5, np.array(size[::-1]) - 0.5, (35, 2))
        views.append(make_view(ids, pixels, random.integers(0, 255, (*size, 3), np.uint8), random.random(35) < 0.8))
    colors, camera_index = colour_points(50, views, indices)
    for k in range(50):
        best, expected = math.inf, ([255] * 3, 255)
        for one, index in zip(views, indices, strict=True):
            for i in np.flatnonzero((one.point_ids == k) & one.visible):
                (u, v), (height, width) = one.pixels[i].tolist(), one.rgb.shape[:2]
                off = math.hypot(u - (width - 1) / 2, v - (height - 1) / 2) / math.hypot(width, height)
                if off < best:
                    color = one.rgb[math.floor(v + 0.5), math.floor(u + 0.5)]
                    best, expected = off, (color.tolist(), index)
        assert (colors[k].tolist(), camera_index[k]) == expected
    rgb = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)
    pixels = [(0.49, 0), (0.5, 0), (4.2, 2.7), (-0.5, -0.5), (5.49, 3.49)]
    colors, _ = colour_points(5, [make_view(range(5), pixels, rgb)], [0])
    nearest = [rgb[0, 0], rgb[0, 1], rgb[3, 4], rgb[0, 0], rgb[3, 5]]
    np.testing.assert_array_equal(colors, nearest)
    rgb = np.random.default_rng(2).integers(0, 255, (4, 6, 3), np.uint8)
    upside_down = np.ascontiguousarray(rgb[::-1])[::-1]
    upside_down.flags.writeable = False
    one = make_view([0, 1], [(5, 3), (0, 2)], upside_down)
    np.testing.assert_array_equal(colour_points(2, [one], [0])[0], [rgb[3, 5], rgb[2, 0]])
    points = np.array([[0.0, 0.0, 5.0]])
    for indices, message in (([], "0 camera indices for 1 views"), ([255], "index 255")):
        with pytest.raises(OptionError, match=message):
            blend_colours(points, [view(points, image(1))], indices)
    for indices in [[], [0, 1], [255], [-1]]:
        with pytest.raises(OptionError, match="ind"):
            colour_points(1, [make_view([0], [(0, 0)], plain(0))], indices)


FRAMES = 6
CAMERA_MODEL = Camera("pinhole", 400, 260, 260.0, 260.0, 199.5, 129.5)


def rig(*yaws_deg, stops=0.5):
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


@pytest.mark.slow
def test_cameras_that_never_show_the_same_are_named_and_keep_their_brightness():
    drive = rig(0.0, 180.0)
    gains, _ = gathered(drive)
    assert gains.alone == (0, 1)
    assert np.isnan(gains.seam_before)
    for camera in (0, 1):
        np.testing.assert_allclose(gains.log_gains[camera].mean(axis=0), 0.0, atol=0.05)


def test_exposures_are_recovered_within_two_percent_seams_shrink_and_black_images_give_no_factors():
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
    assert (gains.alone, gains.for_views(frame.views, range(2))) == ((0, 1), {})
    drive = rig(0.0, 45.0)
    gains, frames = gathered(drive)
    for k in range(FRAMES):
        evened = [
            drive.truth.exposure(f"camera{c}", k) * gains.at(c, int(drive.scene.cameras[c].images.timestamps_ns[k]))
            for c in range(2)
        ]
        np.testing.assert_allclose(evened[0] / evened[1], 1.0, atol=0.02)
    assert gains.alone == ()
    logs = np.concatenate([gains.log_gains[c] for c in range(2)])
    # the mean is weighted by points, which images do not have alike
    np.testing.assert_allclose(logs.mean(axis=0), 0.0, atol=0.05)
    assert gains.seam_pairs > 200
    assert gains.seam_after < 0.25 * gains.seam_before
    assert gains.seam_after < 1.0  # level: what a pixel's own noise is
    ratios = []
    for k, frame in enumerate(frames):
        points, indices = frame.views[0].points_world, range(2)
        blended = blend_colours(points, frame.views, indices, gains=gains.for_views(frame.views, indices))
        seen = blended.sources.camera_index != 255
        truth = drive.truth.clean_points_world(k).colors[seen].astype(float)
        usable = (truth.min(axis=1) > 30) & (truth.max(axis=1) < 160)
        ratios.append(np.median(blended.colors[seen][usable] / truth[usable]))
    np.testing.assert_allclose(ratios, np.mean(ratios), rtol=0.02)


LABELLED_CAMERA = Camera("pinhole", 60, 40, 50.0, 50.0, 29.5, 19.5)


def labelled_view(points, **more):
    return view(points, np.zeros((40, 60, 3), np.uint8), camera=LABELLED_CAMERA, **more)


def labels(number, size=(40, 60)):
    return np.full(size, number, np.uint16)


def test_points_take_the_label_of_their_nearest_pixel_in_most_images_if_they_are_seen():
    image = np.arange(40 * 60, dtype=np.uint16).reshape(40, 60)
    u, v = np.array([10.4, 10.6, 0.0, 59.4]), np.array([20.4, 20.6, 0.0, 39.4])
    points = np.stack([(u - 29.5) / 50 * 4, (v - 19.5) / 50 * 4, np.full(4, 4.0)], axis=1)
    painted = paint_labels(points, [labelled_view(points)], [image])
    assert painted.tolist() == [20 * 60 + 10, 21 * 60 + 11, 0, 39 * 60 + 59]
    points = np.array([[0.0, 0.0, 5.0]])
    views = [labelled_view(points, x=x, camera_id=camera_id) for x, camera_id in ((0.0, "a"), (1.5, "b"), (-1.5, "c"))]
    assert paint_labels(points, views, [labels(1), labels(2), labels(2)]).tolist() == [2]
    assert paint_labels(points, views[:2], [labels(1), labels(2)]).tolist() == [1]
    assert paint_labels(points, views[:2], [None, labels(2)]).tolist() == [2]
    assert paint_labels(points, views, [labels(7), labels(8), labels(9)]).tolist() == [7]
    points = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 9.0], [0.0, 0.0, -5.0]])
    assert paint_labels(points, [labelled_view(points)], [labels(3)]).tolist() == [3, NO_LABEL, NO_LABEL]
    assert paint_labels(points, [labelled_view(points)], [None]).tolist() == [NO_LABEL] * 3
    assert paint_labels(np.zeros((0, 3)), [], []).tolist() == []
    for images, message in (([labels(0, (20, 30))], "label_image"), ([], "0 label images for 1 views")):
        with pytest.raises(ArrayError, match=message):
            paint_labels(points, [labelled_view(points)], images)


def test_labels_are_drawn_where_points_are_visible_the_nearest_counts_and_they_go_to_points_and_back_unchanged():
    points = np.array([[-0.01, -0.01, 5.0], [-0.02, -0.02, 8.0], [1.0, 0.5, 5.0]])
    seen, canvas = labelled_view(points), LabelCanvas.blank(60, 40)
    canvas.draw(seen, np.array([4, 5, 6], np.uint16))
    assert (canvas.labels[19, 29], sorted(np.unique(canvas.labels).tolist())) == (4, [0, 4, 6])
    assert (canvas.labels > 0).sum() == 2
    points, near = np.array([[0.0, 0.0, 8.0]]), np.array([[0.0, 0.0, 4.0]])
    canvas = LabelCanvas.blank(60, 40, radius_px=2)
    canvas.draw(labelled_view(points), np.array([5], np.uint16))
    assert (canvas.labels == 5).sum() == 25
    canvas.draw(labelled_view(near), np.array([NO_LABEL], np.uint16))
    assert (canvas.labels == 0).all()
    with pytest.raises(OptionError, match="radius_px"):
        LabelCanvas.blank(60, 40, radius_px=-1)
    random = np.random.default_rng(5)
    points = np.column_stack([random.uniform(-2, 2, 300), random.uniform(-1, 1, 300), np.full(300, 5.0)])
    image, seen = random.integers(1, 300, (40, 60)).astype(np.uint16), labelled_view(points)
    canvas = LabelCanvas.blank(60, 40)
    canvas.draw(seen, paint_labels(points, [seen], [image]))
    drawn = canvas.labels > 0
    assert drawn.sum() > 150
    assert (canvas.labels[drawn] == image[drawn]).all()
