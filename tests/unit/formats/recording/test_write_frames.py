"""Images of several cameras share a line where they belong together."""

import numpy as np
import pytest

from sceneloom.formats.recording.write_images import group_images

MS = 1_000_000


def timestamps(*times_ms):
    return np.array(times_ms, np.int64) * MS


def test_cameras_in_step_share_every_line():
    rows = group_images([timestamps(0, 100, 200), timestamps(3, 99, 210), timestamps(-20, 90, 240)])
    assert rows.tolist() == [[0, 0, 0], [1, 1, 1], [2, 2, 2]]


def test_half_a_period_apart_is_no_longer_together():
    rows = group_images([timestamps(0, 100, 200), timestamps(50, 150, 250)])
    assert rows.tolist() == [[0, -1], [-1, 0], [1, -1], [-1, 1], [2, -1], [-1, 2]]


def test_a_missing_image_leaves_its_location_empty():
    rows = group_images([timestamps(0, 100, 200, 300), timestamps(0, 200, 300)])
    assert rows.tolist() == [[0, 0], [1, -1], [2, 1], [3, 2]]


def test_a_faster_camera_gets_lines_of_its_own():
    rows = group_images([timestamps(0, 100), timestamps(0, 50, 100)])
    assert rows.tolist() == [[0, 0], [-1, 1], [1, 2]]


def test_two_images_of_one_camera_never_share_a_line():
    rows = group_images([timestamps(0, 0, 0, 100), timestamps(0, 100)])
    assert rows.tolist() == [[0, -1], [1, -1], [2, 0], [3, 1]]


@pytest.mark.parametrize("times", [[], [7]])
def test_few_images_need_no_period(times):
    rows = group_images([timestamps(*times), timestamps(*times)])
    assert rows.tolist() == [[0, 0]] * len(times)


def test_every_image_is_in_one_line_and_lines_ascend():
    rng = np.random.default_rng(0)
    cameras = [np.sort(rng.integers(0, 10_000, size)).astype(np.int64) for size in (40, 55, 13)]
    rows = group_images(cameras)
    for camera, times in enumerate(cameras):
        column = rows[:, camera]
        assert column[column >= 0].tolist() == list(range(len(times)))
    earliest = [min(cameras[c][k] for c, k in enumerate(row) if k >= 0) for row in rows.tolist()]
    assert earliest == sorted(earliest)
