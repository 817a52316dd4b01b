"""Overlays, depth images, contact sheets, and the cloud of a drive."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from sceneloom import visualization as viz
from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import OptionError, OutputError
from sceneloom.scene import LidarPoints, Poses
from sceneloom.visualization import DepthScale, draw_depth_image, draw_overlay, save_images
from sceneloom.visualization.canvas import STRIP, Canvas
from sceneloom.visualization.colour_scales import colour_map, placed_ticks
from sceneloom.visualization.fused_frames import CUBE, NO_DEPTH, view_scale

SCALE = DepthScale(2.0, 50.0)


def _pixels(image):
    return np.asarray(image)


@pytest.mark.parametrize("draw", [draw_overlay, draw_depth_image])
def test_a_point_is_a_disc_in_the_colour_of_its_depth_at_its_pixel(make_view, draw):
    view = make_view([(60, 40, 2.0, True), (150, 90, 50.0, True), (100, 100, 10.0, True)])
    drawn = _pixels(draw(view, scale=SCALE))
    for u, v, depth in ((60, 40, 2.0), (150, 90, 50.0), (100, 100, 10.0)):
        share = np.log(depth / 2.0) / np.log(50.0 / 2.0)
        assert np.array_equal(drawn[v, u], colour_map("beacon").table[round(share * 255)])
    # the row of the strip that is as bright and colourful as only the scale bar is
    strip = drawn[view.camera.height :].astype(int)
    colourful = (strip.max(axis=2) - strip.min(axis=2)) > 60
    row = int(np.argmax(colourful.sum(axis=1)))
    bar = strip[row, np.flatnonzero(colourful[row])]
    # its outermost columns may be less colourful than what is looked for: 3 levels of 255
    assert np.abs(bar[[0, -1]] - drawn[[40, 90], [60, 150]]).max() <= 3
    drawn = _pixels(draw_overlay(make_view([(60, 40, depth, True) for depth in (40.0, 4.0, 20.0)]), scale=SCALE))
    assert np.array_equal(drawn[40, 60], SCALE.colours(np.array([4.0]))[0]), "near points cover far ones"


def test_hidden_points_are_crosses_on_request_and_what_is_below_is_darker(make_view):
    view = make_view([(60, 40, 10.0, True), (150, 90, 30.0, False)])
    without, crossed = _pixels(draw_overlay(view)), _pixels(draw_overlay(view, show_hidden=True))
    assert np.array_equal(without[90, 150], without[10, 10])
    changed = np.argwhere((without[: view.camera.height] != crossed[: view.camera.height]).any(axis=2))
    assert {(90, 150), (89, 149), (91, 151), (89, 151), (91, 149)} == {tuple(location) for location in changed.tolist()}
    assert np.ptp(crossed[90, 150].astype(int)) < 20
    view = make_view([])
    rgb = view.rgb.copy()
    rgb[:, :] = (200, 100, 40)
    below = _pixels(draw_overlay(replace(view, rgb=rgb)))[10, 10].astype(int)
    assert below.max() < 200
    assert np.ptp(below) < 160 * below.mean() / (340 / 3)
    assert below[0] > below[1] > below[2]
    view = make_view([(60, 40, 3.1, True), (100, 60, 44.0, True), (150, 90, 400.0, False)])
    overlay, depths = (_pixels(draw(view)) for draw in (draw_overlay, draw_depth_image))
    assert tuple(depths[100, 20]) == NO_DEPTH
    darkest = min(colour_map(name).table.max(axis=1).min() for name in ("beacon", "lagoon"))
    assert max(NO_DEPTH) < darkest / 4
    # both share the scale of the visible points
    scale = view_scale(view)
    assert (scale.near, scale.far) == (3.0, 50.0)
    assert np.array_equal(overlay[60, 100], depths[60, 100])


@pytest.mark.parametrize("size", [(1, 1), (1, 400), (400, 1), (97, 61), (641, 383), (1242, 375)])
@pytest.mark.parametrize("draw", [draw_overlay, draw_depth_image])
@pytest.mark.few(6)
def test_images_of_any_size_keep_their_pixels_and_cut_nothing_off(make_view, draw, size):
    width, height = size
    view = make_view([(width - 1, height - 1, 10.0, True)], width=width, height=height, camera_id="c" * 300)
    image = draw(view)
    assert image.width >= width
    assert image.height > height
    drawn = _pixels(image)
    assert np.array_equal(drawn[height - 1, width - 1], view_scale(view).colours(np.array([10.0]))[0])
    rim = np.concatenate([drawn[height:, :3], drawn[height:, -3:]], axis=1)
    assert (rim == STRIP).all()
    assert (drawn[-2:] == STRIP).all()


@pytest.mark.parametrize("draw", [draw_overlay, draw_depth_image])
def test_views_without_visible_points_are_drawn_too_and_drawing_twice_gives_the_same_image(make_view, draw):
    for points in ([], [(60, 40, 10.0, False)]):
        view = make_view(points)
        drawn = _pixels(draw(view))[: view.camera.height, : view.camera.width]
        assert (drawn == drawn[0, 0]).all()
    points = [(u, v, 3.0 + (u * v) % 40, True) for u in range(5, 195, 7) for v in range(5, 115, 5)]
    assert draw(make_view(points)).tobytes() == draw(make_view(points)).tobytes()


@pytest.mark.parametrize("width", [240, 640, 1920])
@pytest.mark.parametrize(("near", "far"), [(0.3, 0.4), (1.0, 2.0), (2.0, 80.0), (0.05, 600.0), (99.0, 101.0)])
def test_labels_of_the_scale_bar_do_not_touch_and_stay_on_the_canvas(near, far, width):
    canvas = Canvas.blank(width, 100, text_px=max(12, width // 70))
    first, last = width // 2, width - 2 * canvas.text_px
    ticks = placed_ticks(canvas, DepthScale(near, far), first, last)
    halves = [(middle, canvas.text_width(label, scale=0.86) / 2) for _, label, middle in ticks]
    spans = sorted((middle - half, middle + half) for middle, half in halves)
    assert all(right < left for (_, right), (left, _) in pairwise(spans))
    assert spans[0][0] > 0
    assert spans[-1][1] < width
    assert ticks[0][0] == near


def _frame(views, *, lidar_id="lidar"):
    rng = np.random.default_rng(2)
    positions = rng.normal(0, 10, (50, 3)).astype(np.float32)
    colors = rng.integers(0, 255, (50, 3), dtype=np.uint8)
    index = np.where(np.arange(50) < 20, 0, 255).astype(np.uint8)
    points = LidarPoints(positions, colors=colors, camera_index=index)
    return FusedFrame(lidar_id, 7, 0, 0, points, tuple(views))


def test_one_file_per_image_is_written_with_the_same_bytes_again_and_replaced_only_on_request(make_view, tmp_path):
    view = make_view([(60, 40, 10.0, True)])
    paths, again = (save_images(_frame([view]), tmp_path / name / "folder", 7) for name in ("once", "twice"))
    names = ["front_000007_overlay", "front_000007_depth", "cloud_lidar_000007_above", "cloud_lidar_000007_perspective"]
    assert [path.stem for path in paths] == names
    assert sorted(paths) == sorted((tmp_path / "once" / "folder").iterdir())
    assert [path.read_bytes() for path in paths] == [path.read_bytes() for path in again]
    for path in paths:
        with Image.open(path) as image:
            assert (path.suffix, image.mode) == (".png", "RGB")
            assert image.width >= view.camera.width
    frame = _frame([make_view([])])
    first = save_images(frame, tmp_path / "own", 0)[0]
    first.write_bytes(b"kept")
    with pytest.raises(OutputError, match="exists already"):
        save_images(frame, tmp_path / "own", 0)
    assert first.read_bytes() == b"kept"
    save_images(frame, tmp_path / "own", 0, overwrite=True)
    assert first.read_bytes().startswith(b"\x89PNG")
    bare = FusedFrame("lidar", 0, 0, 0, LidarPoints(np.zeros((0, 3), np.float32)), unfused="no pose")
    assert len(save_images(bare, tmp_path / "bare", 0)) == 2, "its cloud alone"
    (tmp_path / "file").write_text("")
    for name in ("file/folder", "file"):
        with pytest.raises(OutputError, match="file"):
            save_images(_frame([]), tmp_path / name, 0)


def test_the_cloud_is_drawn_around_the_ego_at_the_time_of_its_sweep(tmp_path):
    times = np.array([0, 10**9], np.int64)
    positions = np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0]])
    ego_poses = Poses(times, positions, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    for reference_ns, x in ((500_000_000, 20.0), (-1, 0.0), (3 * 10**9, 40.0)):
        frame = replace(_frame([]), reference_ns=reference_ns)
        ego = viz.EgoPosition(np.array([x, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
        drawn = dict(viz.iter_images(frame, 0, ego_poses=ego_poses))["cloud_lidar_000000_above"]()
        points, seen = frame.points, {"camera_index": frame.points.camera_index}
        around = viz.draw_cloud_above(points.positions, points.colors, **seen, ego=ego, ego_path=positions)
        # Only the captions differ.
        assert np.array_equal(np.asarray(drawn)[:800], np.asarray(around)[:800])


def test_no_id_leaves_the_folder_overwrites_another_or_is_too_long(make_view, tmp_path):
    long = ["街" * 100 + end for end in "ab"]
    cases = {
        ("../../etc/x", "a/b"): ("%2E.%2F..%2Fetc%2Fx", "a%2Fb"),
        (1, "1", 1): ("1", "1~2", "1~3"),
        ("a~2", "a", "a"): ("a%7E2", "a", "a~2"),
        tuple(long): None,
    }
    for number, (identifiers, stems) in enumerate(cases.items()):
        folder = tmp_path / "out" / str(number)
        paths = save_images(_frame([make_view([], camera_id=one) for one in identifiers], lidar_id="../up"), folder, 0)
        assert len(set(paths)) == len(list(folder.iterdir())) == 2 * len(identifiers) + 2
        assert {path.parent for path in paths} == {folder}
        assert max(len(path.name) for path in paths) < 200
        if stems is not None:
            assert [path.name for path in paths[:-2:2]] == [f"{stem}_000000_overlay.png" for stem in stems]


def test_a_contact_sheet_shows_every_image_in_its_column():
    sizes = {(200, 0, 0): (40, 20), (0, 200, 0): (80, 80), (0, 0, 200): (10, 5)}
    images = [Image.new("RGB", size, colour) for colour, size in sizes.items()]
    sheet = np.asarray(viz.contact_sheet(images, columns=2, width_px=340))
    # Gaps of 2 px: two columns of 167 px; the first row is as high as the square image.
    assert sheet.shape == (2 + 167 + 2 + round(167 / 2) + 2, 340, 3)
    assert [tuple(sheet[place]) for place in ((40, 80), (120, 250), (200, 80))] == list(sizes)
    for count, options in ((0, {}), (1, {"columns": 0}), (1, {"columns": 9, "width_px": 20})):
        with pytest.raises(OptionError, match="room"):
            viz.contact_sheet(images[:count], **options)


RED, BLUE = (250, 10, 10), (10, 10, 250)


def sweep(index, positions, color, *, seen=True):
    count = len(positions)
    index_of, colors = np.full(count, 0 if seen else 255, np.uint8), np.full((count, 3), color, np.uint8)
    points = LidarPoints(positions.astype(np.float32), colors=colors, camera_index=index_of)
    return FusedFrame("lidar", index, index, index, points)


def wall(x):
    y, z = (axis.ravel() for axis in np.mgrid[-2:2:0.05, 0:2:0.05])
    return np.column_stack([np.full(len(y), x), y, z])


def test_the_cloud_of_a_drive_has_all_sweeps_that_are_chosen_and_fused(tmp_path):
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    trajectory = Poses(np.arange(3) * 100_000_000, positions, np.tile([0.0, 0, 0, 1], (3, 1)))

    def drawn(*sweeps, poses=trajectory):
        cloud = viz.DriveCloud(frozenset(range(3)))
        for one in sweeps:
            cloud.add(one)
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        paths = cloud.save(folder, poses)
        assert [path.name for path in paths] == ["cloud_drive_above.png", "cloud_drive_perspective.png"][: len(paths)]
        if not paths:
            return None
        # whether some pixels show each hue clearly
        red, green, blue = np.moveaxis(np.asarray(Image.open(paths[1]).convert("RGB")).astype(int), 2, 0)
        return [bool((a > np.maximum(b, green) + 100).sum() > 50) for a, b in ((red, blue), (blue, red))]

    first = sweep(0, wall(6.0), RED)
    assert drawn(first) is None, "one alone is no drive"
    assert drawn(first, sweep(1, wall(3.0) + np.array([0, 5, 0]), BLUE)) == [True, True]
    unfused = replace(sweep(2, wall(4.0), BLUE), unfused="beyond the trajectory")
    assert drawn(first, sweep(1, wall(6.0), RED), sweep(5, wall(4.0), BLUE), unfused) == [True, False]
    # of points in one cube, the one that a camera saw is kept
    locations = wall(6.0) // CUBE * CUBE
    pair = [sweep(0, locations + share * CUBE, RED, seen=share > 0.1).points for share in (0.1, 0.2)]
    columns = {n: np.concatenate([getattr(one, n) for one in pair]) for n in ("positions", "colors", "camera_index")}
    both = FusedFrame("lidar", 0, 0, 0, LidarPoints(**columns))
    assert drawn(both, sweep(1, wall(60.0), BLUE, seen=False))[0]
    # without a trajectory, the cloud is drawn from its middle
    assert drawn(first, sweep(1, np.full((3, 3), np.nan), RED), poses=None) is not None
