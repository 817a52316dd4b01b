"""Images of several cameras share a line where they belong together."""

import numpy as np
import pytest

from sceneloom.formats.recording.write_images import group_images


@pytest.mark.parametrize(
    ("cameras", "rows"),
    [
        (((0, 100, 200), (3, 99, 210), (-20, 90, 240)), [[0, 0, 0], [1, 1, 1], [2, 2, 2]]),
        # half a period apart is no longer together
        (((0, 100, 200), (50, 150, 250)), [[0, -1], [-1, 0], [1, -1], [-1, 1], [2, -1], [-1, 2]]),
        # a missing image leaves its location empty, and a faster camera gets lines of its own
        (((0, 100, 200, 300), (0, 200, 300)), [[0, 0], [1, -1], [2, 1], [3, 2]]),
        (((0, 100), (0, 50, 100)), [[0, 0], [-1, 1], [1, 2]]),
        # two images of one camera never share a line
        (((0, 0, 0, 100), (0, 100)), [[0, -1], [1, -1], [2, 0], [3, 1]]),
        # few images need no period
        (((), ()), []),
        (((7,), (7,)), [[0, 0]]),
    ],
)
def test_images_of_cameras_in_step_share_lines(cameras, rows):
    assert group_images([np.array(times_ms, np.int64) * 1_000_000 for times_ms in cameras]).tolist() == rows


def test_every_image_is_in_one_line_and_lines_ascend():
    rng = np.random.default_rng(0)
    cameras = [np.sort(rng.integers(0, 10_000, size)).astype(np.int64) for size in (40, 55, 13)]
    rows = group_images(cameras)
    for camera, times in enumerate(cameras):
        column = rows[:, camera]
        assert column[column >= 0].tolist() == list(range(len(times)))
    earliest = [min(cameras[c][k] for c, k in enumerate(row) if k >= 0) for row in rows.tolist()]
    assert earliest == sorted(earliest)
