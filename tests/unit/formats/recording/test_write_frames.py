"""Pictures of several cameras share a line where they belong together."""

import numpy as np
import pytest

from sceneloom.formats.recording.picture_rows import group_pictures

MS = 1_000_000


def stamps(*times_ms):
    return np.array(times_ms, np.int64) * MS


def test_cameras_in_step_share_every_line():
    rows = group_pictures([stamps(0, 100, 200), stamps(3, 99, 210), stamps(-20, 90, 240)])
    assert rows.tolist() == [[0, 0, 0], [1, 1, 1], [2, 2, 2]]


def test_half_a_period_apart_is_no_longer_together():
    rows = group_pictures([stamps(0, 100, 200), stamps(50, 150, 250)])
    assert rows.tolist() == [[0, -1], [-1, 0], [1, -1], [-1, 1], [2, -1], [-1, 2]]


def test_a_missing_picture_leaves_its_place_empty():
    rows = group_pictures([stamps(0, 100, 200, 300), stamps(0, 200, 300)])
    assert rows.tolist() == [[0, 0], [1, -1], [2, 1], [3, 2]]


def test_a_faster_camera_gets_lines_of_its_own():
    rows = group_pictures([stamps(0, 100), stamps(0, 50, 100)])
    assert rows.tolist() == [[0, 0], [-1, 1], [1, 2]]


def test_two_pictures_of_one_camera_never_share_a_line():
    rows = group_pictures([stamps(0, 0, 0, 100), stamps(0, 100)])
    assert rows.tolist() == [[0, -1], [1, -1], [2, 0], [3, 1]]


@pytest.mark.parametrize("times", [[], [7]])
def test_few_pictures_need_no_period(times):
    rows = group_pictures([stamps(*times), stamps(*times)])
    assert rows.tolist() == [[0, 0]] * len(times)


def test_every_picture_is_in_one_line_and_lines_ascend():
    rng = np.random.default_rng(0)
    cameras = [np.sort(rng.integers(0, 10_000, size)).astype(np.int64) for size in (40, 55, 13)]
    rows = group_pictures(cameras)
    for camera, times in enumerate(cameras):
        column = rows[:, camera]
        assert column[column >= 0].tolist() == list(range(len(times)))
    earliest = [min(cameras[c][k] for c, k in enumerate(row) if k >= 0) for row in rows.tolist()]
    assert earliest == sorted(earliest)
