from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sceneloom.colouring.results import FusedFrame
from sceneloom.errors import OptionError, OutputError
from sceneloom.scene import LidarPoints, Poses
from sceneloom.visualization import EgoPosition, contact_sheet, draw_cloud_above, iter_images, save_images


def _frame(views, *, lidar_id="lidar"):
    rng = np.random.default_rng(2)
    positions = rng.normal(0, 10, (50, 3)).astype(np.float32)
    colors = rng.integers(0, 255, (50, 3), dtype=np.uint8)
    index = np.where(np.arange(50) < 20, 0, 255).astype(np.uint8)
    points = LidarPoints(positions, colors=colors, camera_index=index)
    return FusedFrame(lidar_id, 7, 0, 0, points, tuple(views))


def test_one_file_per_image_is_written_and_named(make_view, tmp_path):
    view = make_view([(60, 40, 10.0, True)])
    paths = save_images(_frame([view]), tmp_path / "new" / "folder", 7)
    assert [path.name for path in paths] == [
        "front_000007_overlay.png",
        "front_000007_depth.png",
        "cloud_lidar_000007_above.png",
        "cloud_lidar_000007_perspective.png",
    ]
    assert sorted(paths) == sorted((tmp_path / "new" / "folder").iterdir())
    for path in paths:
        with Image.open(path) as image:
            assert image.mode == "RGB"
            assert image.width >= view.camera.width


def test_the_cloud_is_drawn_around_the_ego_at_the_time_of_its_sweep(tmp_path):
    times = np.array([0, 10**9], np.int64)
    positions = np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0]])
    ego_poses = Poses(times, positions, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    for reference_ns, x in ((500_000_000, 20.0), (-1, 0.0), (3 * 10**9, 40.0)):
        frame = replace(_frame([]), reference_ns=reference_ns)
        ego = EgoPosition(np.array([x, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
        drawn = dict(iter_images(frame, 0, ego_poses=ego_poses))["cloud_lidar_000000_above"]()
        points = frame.points
        around = draw_cloud_above(
            points.positions, points.colors, camera_index=points.camera_index, ego=ego, ego_path=positions
        )
        # Only the captions differ.
        assert np.array_equal(np.asarray(drawn)[:800], np.asarray(around)[:800])


def test_a_frame_without_views_and_colours_has_images_of_its_cloud(tmp_path):
    frame = FusedFrame("lidar", 0, 0, 0, LidarPoints(np.zeros((0, 3), np.float32)), unfused="no pose")
    assert len(save_images(frame, tmp_path, 0)) == 2


@pytest.mark.parametrize(
    ("identifiers", "stems"),
    [
        (("../../etc/x", "a/b"), ("%2E.%2F..%2Fetc%2Fx", "a%2Fb")),
        ((1, "1", 1), ("1", "1~2", "1~3")),
        (("a~2", "a", "a"), ("a%7E2", "a", "a~2")),
    ],
)
def test_no_id_leaves_the_folder_or_overwrites_another(make_view, tmp_path, identifiers, stems):
    views = [make_view([], camera_id=identifier) for identifier in identifiers]
    paths = save_images(_frame(views, lidar_id="../up"), tmp_path / "out", 0)
    assert len(set(paths)) == 2 * len(views) + 2
    assert {path.parent for path in paths} == {tmp_path / "out"}
    assert [path.name for path in paths[:-2:2]] == [f"{stem}_000000_overlay.png" for stem in stems]
    assert len(list((tmp_path / "out").iterdir())) == len(paths)


def test_existing_images_are_replaced_only_on_request(make_view, tmp_path):
    frame = _frame([make_view([])])
    first = save_images(frame, tmp_path, 0)[0]
    first.write_bytes(b"kept")
    with pytest.raises(OutputError, match="exists already"):
        save_images(frame, tmp_path, 0)
    assert first.read_bytes() == b"kept"
    save_images(frame, tmp_path, 0, overwrite=True)
    assert first.read_bytes().startswith(b"\x89PNG")


def test_a_folder_that_cannot_be_made_is_an_output_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        save_images(_frame([]), tmp_path / "file" / "folder", 0)
    with pytest.raises(OutputError, match="file"):
        save_images(_frame([]), tmp_path / "file", 0)


def test_ids_too_long_for_a_file_name_are_cut_but_stay_apart(make_view, tmp_path):
    views = [make_view([], camera_id="街" * 100 + end) for end in "ab"]
    paths = save_images(_frame(views), tmp_path, 0)
    assert len({path.name for path in paths}) == 6
    assert max(len(path.name) for path in paths) < 200


def test_the_same_frame_gives_the_same_bytes(make_view, tmp_path):
    frame = _frame([make_view([(60, 40, 10.0, True)])])
    once, twice = (save_images(frame, tmp_path / name, 3) for name in ("once", "twice"))
    assert [path.read_bytes() for path in once] == [path.read_bytes() for path in twice]


def test_a_contact_sheet_shows_every_image_in_its_column():
    colours = [(200, 0, 0), (0, 200, 0), (0, 0, 200)]
    images = [
        Image.new("RGB", size, colour)
        for size, colour in zip([(40, 20), (80, 80), (10, 5)], colours, strict=True)
    ]
    sheet = np.asarray(contact_sheet(images, columns=2, width_px=340))
    # Gaps of 2 px: two columns of 167 px; the first row is as high as the square image.
    assert sheet.shape == (2 + 167 + 2 + round(167 / 2) + 2, 340, 3)
    assert tuple(sheet[40, 80]) == colours[0]
    assert tuple(sheet[120, 250]) == colours[1]
    assert tuple(sheet[200, 80]) == colours[2]


@pytest.mark.parametrize(
    ("count", "options"), [(0, {}), (1, {"columns": 0}), (1, {"columns": 9, "width_px": 20})]
)
def test_a_sheet_without_room_is_refused(count, options):
    with pytest.raises(OptionError, match="room"):
        contact_sheet([Image.new("RGB", (5, 5))] * count, **options)
