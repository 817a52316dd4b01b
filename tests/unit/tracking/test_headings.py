"""Which way round objects head, where boxes, motion and neighbours state different things."""

import numpy as np
import pytest

from sceneloom.tracking import track_drive

TIMES = np.arange(12) / 10.0
OFTEN_ROTATED = frozenset(k for k in range(12) if k % 5 in (1, 2, 4))


def crawling(t):
    return 14.0 + 0.5 * t, 3.0, 0.0


def driving(start, y=3.0):
    return lambda t: (start + 8.0 * t, y, 0.0)


def towards(t):
    return 60.0 - 8.0 * t, 3.2, np.pi


def last_yaw(tracks, near):
    return next(t.yaws[-1] for t in tracks if np.hypot(*(t.centers[-1, :2] - near)) < 1.0)


@pytest.mark.parametrize(
    ("others", "heads"),
    [
        ([], -1.0),  # nobody says otherwise
        ([driving(22.0), driving(35.0)], 1.0),
        ([driving(22.0, y=-9.0), driving(35.0, y=-9.0)], -1.0),  # not in its lane
        ([driving(22.0), towards], -1.0),  # of two opinions
    ],
)
def test_a_crawling_car_whose_boxes_are_rotated_heads_as_those_before_it_in_its_lane(
    street, actor, others, heads
):
    drive = street([actor(crawling), *map(actor, others)], rotated=OFTEN_ROTATED)
    yaw = last_yaw(track_drive(drive.observe(TIMES)), (14.5, 3.0))
    assert np.cos(yaw) == pytest.approx(heads, abs=0.1)  # boxes are off by 0.1 m, headings by less


def test_persons_do_not_head_as_their_neighbours(street, actor):
    person = actor(lambda t: (14.0, 3.0, 0.0), "Pedestrian")
    walkers = [actor(lambda t, x=x: (x + 2.0 * t, 3.0, 0.0), "Pedestrian") for x in (17.0, 20.0)]
    yaw = last_yaw(track_drive(street([person, *walkers], rotated=OFTEN_ROTATED).observe(TIMES)), (14.0, 3.0))
    assert np.cos(yaw) == pytest.approx(-1.0, abs=0.1)
