"""Lidars: what timestamps mean, which frame points are in, what is stated about the first file."""

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.scene import PointsFrame

from .conftest import FIELDS, FIRST_SENSOR, SCALE, START_NS, codes

TIMED = 'fields = ["x", "y", "z", "t"]'


@pytest.fixture
def timed(folder):
    """Sweeps whose points have times from 0 to 0.09 s after the timestamp, as float32 seconds."""
    for path in (folder / "top").iterdir():
        points = np.ones((4, 4), "<f4")
        points[:, 3] = [0.0, 0.03, 0.06, 0.09]
        path.write_bytes(points.tobytes())
    return folder


POINT_TIMES = 'point_times = { field = "t", unit = "seconds" }'


@pytest.mark.parametrize(("timestamp", "before_ms"), [("start", 0), ("middle", 50), ("end", 100)])
def test_a_frame_is_timestamped_with_the_start_of_its_sweep(opened, timed, timestamp, before_ms):
    stated = f'{POINT_TIMES}\ntimestamp = "{timestamp}"\nsweep_s = 0.1'
    frame = opened((FIELDS, TIMED), (SCALE, stated)).lidars[0].frames[0]
    assert frame.timestamp_ns == START_NS - before_ms * 1_000_000
    assert frame.points.timestamps_ns[0] == START_NS, "they count from the timestamp"
    assert (frame.points.timestamps_ns - START_NS)[3] == pytest.approx(90_000_000, abs=10)


def test_times_of_points_may_count_from_the_start_of_the_sweep(opened, timed):
    stated = f'timestamp = "end"\nsweep_s = 0.1\n{POINT_TIMES}'.replace(" }", ', relative_to = "start" }')
    frame = opened((FIELDS, TIMED), (SCALE, stated)).lidars[0].frames[0]
    assert frame.points.timestamps_ns[0] == frame.timestamp_ns == START_NS - 100_000_000


@pytest.mark.parametrize(
    ("stated", "after_ms"),
    [
        ("", 0),
        ("sweep_s = 0.1", 50),
        ('timestamp = "middle"\nsweep_s = 0.1', 0),
        ('timestamp = "end"\nsweep_s = 0.1', -50),
        ('timestamp = "end"', -50),
        ('timestamp = "end"\ndeskewed = true', 0),
    ],
)
def test_points_without_times_belong_to_the_middle_of_their_sweep(opened, stated, after_ms):
    lidar = opened((SCALE, f"{SCALE}\n{stated}")).lidars[0]
    assert lidar.frames.timestamps_ns[0] == START_NS + after_ms * 1_000_000
    assert lidar.frames[0].timestamp_ns == lidar.frames.timestamps_ns[0]


def test_the_length_of_a_sweep_is_distinguished_from_the_intervals_with_a_warning(opened):
    assert "sweep-length" in codes(opened((SCALE, f'{SCALE}\ntimestamp = "end"')))


def test_the_length_of_a_single_sweep_has_to_be_stated(refused):
    single = ("top/*.bin", f"top/{START_NS}.bin")
    refused(
        "a single sweep has no interval; expected the duration of a sweep",
        single,
        (SCALE, f'{SCALE}\ntimestamp = "end"'),
    )


def test_times_of_points_that_were_used_for_deskewing_are_not_used_again(opened, timed):
    scene = opened((FIELDS, TIMED), (SCALE, f"{POINT_TIMES}\ndeskewed = true"))
    frame = scene.lidars[0].frames[0]
    points = frame.points
    # all of them are as if measured at the timestamp, and nothing moves them a second time
    assert set(points.timestamps_ns.tolist()) == {frame.timestamp_ns}
    assert points.extras["t"].tolist() == pytest.approx([0.0, 0.03, 0.06, 0.09])


def test_times_as_well_known_drivers_write_them_are_recognised_with_a_warning(opened, timed):
    scene = opened((FIELDS, 'fields = ["x", "y", "z", "time"]'))
    assert scene.lidars[0].frames[0].points.timestamps_ns is not None
    assert "point-times-assumed" in codes(scene)
    left = opened((FIELDS, 'fields = ["x", "y", "z", "timestamps"]'))
    assert left.lidars[0].frames[0].points.timestamps_ns is None
    assert "point-times-not-used" in codes(left)


def test_a_column_that_only_looks_like_times_is_left_aside_with_a_warning(opened, folder):
    for path in (folder / "top").iterdir():
        path.write_bytes(np.full((4, 4), 5000.0, "<f4").tobytes())
    scene = opened((FIELDS, 'fields = ["x", "y", "z", "time"]'))
    assert scene.lidars[0].frames[0].points.timestamps_ns is None
    (warning,) = scene.warnings
    assert warning.code == "point-times-not-used"
    assert "5000 s from the file's timestamp" in warning.message


def test_the_scale_of_brightness_is_seen_in_the_first_file_that_has_any(opened, folder):
    first = min((folder / "top").iterdir())
    points = np.ones((4, 4), "<f4")
    points[:, 3] = 0.0
    first.write_bytes(points.tobytes())
    assert opened((SCALE, "")).lidars[0].extras["intensity_max"] == 255.0
    first.write_bytes(b"")
    assert opened((SCALE, "")).lidars[0].extras["intensity_max"] == 255.0


def test_times_of_the_wrong_unit_are_reported_when_the_drive_is_opened(refused, timed):
    of_clock = POINT_TIMES.replace('seconds"', 'seconds", relative_to = "clock"')
    refused(r't\[1\]: 0\.03.*expected within 10 s|unit = "seconds"', (FIELDS, TIMED), (SCALE, of_clock))


def test_points_in_the_frame_of_the_ego_stay_there(opened):
    scene = opened((SCALE, f'{SCALE}\npoints_in = "base"'))
    lidar = scene.lidars[0]
    assert lidar.points_frame is PointsFrame.EGO
    assert lidar.mount.translation.tolist() == [1.0, 0.0, 2.0]
    assert lidar.frames[0].points.positions[0].tolist() == [0.0, 1.0, 2.0]


def test_points_in_another_frame_are_brought_to_the_sensor(opened):
    matrix = "[[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    frame = f'[[transforms]]\nfrom = "odd"\nto = "base"\nmatrix = {matrix}\n\n{FIRST_SENSOR}'
    scene = opened((SCALE, f'{SCALE}\npoints_in = "odd"'), (FIRST_SENSOR, frame))
    # (0, 1, 2) of odd is (-1 + 5, 0, 2) of base, and (3, 0, 0) of the lidar at (1, 0, 2)
    assert scene.lidars[0].frames[0].points.positions[0].tolist() == [3.0, 0.0, 0.0]


def test_points_in_the_world_stay_there_unless_they_are_too_far_for_float32(refused, opened, folder):
    scene = opened((SCALE, f'{SCALE}\npoints_in = "world"'))
    assert scene.lidars[0].points_frame is PointsFrame.WORLD
    first = min((folder / "top").iterdir())
    first.write_bytes(np.full((1, 4), 4e5, "<f4").tobytes())
    refused("400000 m from the world's origin", (SCALE, f'{SCALE}\npoints_in = "world"'))


def test_what_was_taken_for_granted_is_stated(opened):
    scene = opened((SCALE, ""), (FIELDS, ""))
    assert set(codes(scene)) == {"fields-assumed", "intensity-scale"}
    assert scene.lidars[0].extras["intensity_max"] == 255.0
    assert opened().lidars[0].extras["intensity_max"] == 255.0


def test_brightness_beyond_all_scales_asks_for_one(refused, folder):
    first = min((folder / "top").iterdir())
    first.write_bytes(np.full((1, 4), 1e6, "<f4").tobytes())
    refused(r"state what becomes 255 with sensors\[0\]\.intensity_max", (SCALE, ""))


def test_points_that_are_dropped_are_counted(opened, folder):
    first = min((folder / "top").iterdir())
    first.write_bytes(np.array([[1, 2, 3, 4], [0, 0, 0, 9], [np.nan, 1, 1, 1]], "<f4").tobytes())
    scene = opened()
    assert [(n.code, n.count) for n in scene.warnings] == [("points-dropped", 2)]
    assert scene.lidars[0].frames[0].extras["dropped_points"] == 2
    assert scene.lidars[0].frames[1].extras == {"file": f"top/{START_NS + 100_000_000}.bin"}


def test_columns_may_be_named(opened):
    scene = opened((FIELDS, 'fields = ["a", "b", "c", "d"]\nuse = { x = "a", y = "b", z = "c", intensity = "d" }'))
    assert scene.lidars[0].frames[0].points.intensities.tolist() == [3, 7, 11, 15]


def test_files_of_another_kind_are_refused(refused, folder):
    (folder / "top" / "1.txt").write_text("1")
    refused(r"'1.txt'; expected files that end with \.pcd", ("top/*.bin", "top/*"))


@pytest.mark.parametrize("suffix", ["pcd", "npz"])
def test_every_kind_of_cloud_makes_a_lidar(opened, folder, suffix):
    rows = np.arange(12, dtype=np.float32).reshape(4, 3)
    for path in (folder / "top").iterdir():
        if suffix == "npz":
            np.savez(path.with_suffix(".npz"), xyz=rows, ring=np.arange(4))
        else:
            head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 4\nDATA binary\n"
            path.with_suffix(".pcd").write_bytes(head.encode() + rows.tobytes())
    scene = opened(("top/*.bin", f"top/*.{suffix}"), (SCALE, ""), (FIELDS, ""))
    assert scene.lidars[0].frames[1].points.positions.tolist() == rows.tolist()


def test_a_lenient_reading_begins_with_the_first_file_that_can_be_read(opened, folder):
    files = sorted((folder / "top").iterdir())
    files[0].write_bytes(b"cut")
    files[1].write_bytes(b"torn")
    lidar = (scene := opened(lenient=True)).lidars[0]
    assert [frame.timestamp_ns for frame in lidar.frames] == [START_NS + 200_000_000]
    (warning,) = (warning for warning in scene.warnings if warning.code == "unreadable-files")
    assert (warning.count, warning.kind) == (2, "skipped")
    with pytest.raises(DataError, match=files[0].name):
        opened()


@pytest.mark.parametrize(
    ("stated", "reported"),
    [
        ('["x", "y", "z", "intensity"]', None),
        ('["x", "y", "intensity", "z"]', "intensity below zero"),
        ('["x:float64", "y:float64", "z:float64", "intensity:float64"]', "points farther than 10000 m"),
    ],
)
def test_columns_that_are_taken_for_others_are_remarked(opened, folder, stated, reported):
    generator = np.random.default_rng(5)
    points = generator.uniform([-50, -50, -3, 0], [50, 50, -1, 255], (400, 4)).astype("<f4")
    for path in (folder / "top").iterdir():
        path.write_bytes(points.tobytes())
    scene = opened((FIELDS, f"fields = {stated}"))
    found = [warning.message for warning in scene.warnings if warning.code == "odd-points"]
    assert found == [] if reported is None else any(message.startswith(reported) for message in found)
