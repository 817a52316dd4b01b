"""Lidars: what timestamps mean, which frame points are in, what is stated about the first file."""

import numpy as np
import pytest

from sceneloom.scene import PointsFrame

from .conftest import FIELDS, FIRST_SENSOR, SCALE, START_NS, codes

POINT_TIMES = 'point_times = { field = "t", unit = "seconds" }'
BLOB = np.ones((4, 4), "<f4")


@pytest.fixture
def sweeps(folder):
    """Write the points of all sweeps, or of the first ones."""
    paths = sorted((folder / "top").iterdir())

    def write(points, count=3):
        for path in paths[:count]:
            path.write_bytes(points if isinstance(points, bytes) else np.asarray(points, "<f4").tobytes())

    return write


@pytest.fixture
def timed(sweeps):
    """Sweeps whose points have times from 0 to 0.09 s after the timestamp, as float32 seconds."""
    sweeps(np.column_stack([BLOB[:, :3], [0.0, 0.03, 0.06, 0.09]]))


def fields(*names):
    return (FIELDS, f"fields = [{', '.join(map(repr, names))}]".replace("'", '"'))


TIMED = fields("x", "y", "z", "t")


def test_a_frame_has_the_start_of_its_sweep_and_times_of_points_count_from_what_is_stated(opened, timed):
    for timestamp, relative_to, frame_before_ms, points_before_ms in (
        ("start", "timestamp", 0, 0), ("middle", "timestamp", 50, 0), ("end", "timestamp", 100, 0),
        ("end", "start", 100, 100),
    ):  # fmt: skip
        stated = f'{POINT_TIMES[:-2]}, relative_to = "{relative_to}" }}\ntimestamp = "{timestamp}"\nsweep_s = 0.1'
        frame = opened(TIMED, (SCALE, stated)).lidars[0].frames[0]
        first_ns = START_NS - points_before_ms * 1_000_000
        found = frame.timestamp_ns, frame.points.timestamps_ns[0]
        assert found == (START_NS - frame_before_ms * 1_000_000, first_ns), stated
        assert (frame.points.timestamps_ns - first_ns)[3] == pytest.approx(90_000_000, abs=10)
    # times that were used for deskewing are not used again: all are as if measured at the timestamp
    frame = opened(TIMED, (SCALE, f"{POINT_TIMES}\ndeskewed = true")).lidars[0].frames[0]
    assert set(frame.points.timestamps_ns.tolist()) == {frame.timestamp_ns}
    assert frame.points.extras["t"].tolist() == pytest.approx([0.0, 0.03, 0.06, 0.09])


def test_points_without_times_belong_to_the_middle_of_their_sweep(opened):
    for stated, after_ms, assumed in (
        ("", 0, False),
        ("sweep_s = 0.1", 50, False),
        ('timestamp = "middle"\nsweep_s = 0.1', 0, False),
        ('timestamp = "end"\nsweep_s = 0.1', -50, False),
        ('timestamp = "end"', -50, True),
        ('timestamp = "end"\ndeskewed = true', 0, False),
    ):
        scene = opened((SCALE, f"{SCALE}\n{stated}"))
        frames = scene.lidars[0].frames
        found = frames.timestamps_ns[0], frames[0].timestamp_ns, codes(scene)
        assert found == (*[START_NS + after_ms * 1_000_000] * 2, ["sweep-length"] * assumed), stated


@pytest.mark.parametrize(
    ("column", "first", "code", "message"),
    [
        ("time", 0.0, "point-times-assumed", "seconds relative to the timestamp"),
        ("timestamps", 0.0, "point-times-not-used", "looks like point times"),
        ("time", 5000.0, "point-times-not-used", "5000 s from the file's timestamp"),
    ],
)
def test_times_as_well_known_drivers_write_them_are_used_where_they_can_be_with_a_warning(
    opened, sweeps, column, first, code, message
):
    sweeps(np.column_stack([BLOB[:, :3], [first, 0.03, 0.06, 0.09]]))
    scene = opened(fields("x", "y", "z", column))
    assert (scene.lidars[0].frames[0].points.timestamps_ns is not None) == (code == "point-times-assumed")
    (warning,) = scene.warnings
    assert warning.code == code
    assert message in warning.message


def test_columns_may_be_named_and_what_is_taken_for_granted_is_stated(opened, sweeps):
    use = '\nuse = { x = "a", y = "b", z = "c", intensity = "d" }'
    scene = opened((FIELDS, fields("a", "b", "c", "d")[1] + use))
    assert scene.lidars[0].frames[0].points.intensities.tolist() == [3, 7, 11, 15]
    scene = opened((SCALE, ""), (FIELDS, ""))
    assert set(codes(scene)) == {"fields-assumed", "intensity-scale"}
    assert [one.lidars[0].extras["intensity_max"] for one in (scene, opened())] == [255.0] * 2
    # the scale is seen in the first file that has any brightness
    for first in (np.column_stack([BLOB[:, :3], np.zeros(4)]), b""):
        sweeps(first, count=1)
        assert opened((SCALE, "")).lidars[0].extras["intensity_max"] == 255.0


def test_points_stay_in_the_frame_of_ego_or_world_and_are_brought_to_the_sensor_from_others(opened):
    matrix = "[[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    odd = f'[[transforms]]\nfrom = "odd"\nto = "base"\nmatrix = {matrix}\n\n{FIRST_SENSOR}'
    for points_in, frame, first in (
        ("base", PointsFrame.EGO, [0.0, 1.0, 2.0]),
        ("world", PointsFrame.WORLD, [0.0, 1.0, 2.0]),
        # (0, 1, 2) of odd is (-1 + 5, 0, 2) of base, and (3, 0, 0) of the lidar at (1, 0, 2)
        ("odd", PointsFrame.SENSOR, [3.0, 0.0, 0.0]),
    ):
        lidar = opened((SCALE, f'{SCALE}\npoints_in = "{points_in}"'), (FIRST_SENSOR, odd)).lidars[0]
        found = lidar.points_frame, lidar.mount.translation.tolist(), lidar.frames[0].points.positions[0].tolist()
        assert found == (frame, [1.0, 0.0, 2.0], first)


@pytest.mark.parametrize(
    ("points", "changes", "problem"),
    [
        (None, [("top/*.bin", f"top/{START_NS}.bin"), (SCALE, f'{SCALE}\ntimestamp = "end"')],
         "a single sweep has no interval; expected the duration of a sweep"),
        ([[1.0, 1, 1, 0], [1, 1, 1, 0.03]],
         [TIMED, (SCALE, 'point_times = { field = "t", unit = "seconds", relative_to = "clock" }')],
         r't\[1\]: 0\.03.*expected within 10 s|unit = "seconds"'),
        ([[4e5] * 4], [(SCALE, f'{SCALE}\npoints_in = "world"')], "400000 m from the world's origin"),
        ([[1e6] * 4], [(SCALE, "")], r"set what becomes 255 by sensors\[0\]\.intensity_max"),
        (None, [("top/*.bin", "top/*")], r"'1.txt'; expected files that end with \.pcd"),
    ],
)  # fmt: skip
def test_what_makes_no_sweep_is_refused_when_the_drive_is_opened(refused, folder, sweeps, points, changes, problem):
    (folder / "top" / "1.txt").write_text("1")
    if points is not None:
        sweeps(points, count=1)
    refused(problem, *changes)


def test_points_that_are_dropped_are_counted_and_a_lenient_reading_begins_with_the_first_file_that_can_be_read(
    opened, refused, sweeps
):
    sweeps([[1, 2, 3, 4], [0, 0, 0, 9], [np.nan, 1, 1, 1]], count=1)
    scene = opened()
    assert [(n.code, n.count) for n in scene.warnings] == [("points-dropped", 2)]
    assert scene.lidars[0].frames[0].extras["dropped_points"] == 2
    assert scene.lidars[0].frames[1].extras == {"file": f"top/{START_NS + 100_000_000}.bin"}
    sweeps(b"torn", count=2)
    scene = opened(lenient=True)
    assert [frame.timestamp_ns for frame in scene.lidars[0].frames] == [START_NS + 200_000_000]
    assert [(n.count, n.kind) for n in scene.warnings if n.code == "unreadable-files"] == [(2, "skipped")]
    refused(f"{START_NS}.bin")


def test_columns_that_are_taken_for_others_are_remarked(opened, sweeps):
    sweeps(np.random.default_rng(5).uniform([-50, -50, -3, 0], [50, 50, -1, 255], (400, 4)))
    for names, reported in (
        (("x", "y", "z", "intensity"), None),
        (("x", "y", "intensity", "z"), "intensity below zero"),
        (("x:float64", "y:float64", "z:float64", "intensity:float64"), "points farther than 10000 m"),
    ):
        found = [warning.message for warning in opened(fields(*names)).warnings if warning.code == "odd-points"]
        assert found == [] if reported is None else any(message.startswith(reported) for message in found)
