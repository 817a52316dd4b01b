"""Tests of what is flagged for a person to look at first."""

import numpy as np
import pytest

from sceneloom.scene import Support
from sceneloom.tracking.labels import FlagKind, flags_of, overlap_flags


def kinds(track):
    return {found.kind for found in flags_of(track)}


@pytest.fixture
def changed(a_track):
    """Make a track of which some rows of a column are changed."""

    def change(column, rows, values):
        whole = np.array(getattr(a_track(), column))
        whole[rows] = values
        return a_track(**{column: whole})

    return change


def test_a_good_track_has_no_flag(a_track):
    assert not flags_of(a_track())
    assert not flags_of(a_track(label="pedestrian", speed=0.0))


ZIGZAG = np.column_stack([0.8 * np.arange(21), 0.3 * (-1.0) ** np.arange(21), np.full(21, 0.8)])


@pytest.mark.parametrize(
    ("changes", "kind", "row"),
    [
        ({"count": 4}, FlagKind.SHORT, 0),
        ({"scores": np.full(21, 0.3)}, FlagKind.UNSURE, 0),
        (("supports", slice(3, 18), Support.INTERPOLATED), FlagKind.SPARSE, 10),
        ({"supports": np.full(21, Support.IMAGE, np.uint8)}, FlagKind.IMAGE_ONLY, 0),
        ({"centers": ZIGZAG}, FlagKind.JITTER, 1),
        (("centers", (slice(12, None), 1), 3.0), FlagKind.JUMP, 12),
        (("sizes_lwh", (5, 0), 6.0), FlagKind.SIZE, 5),
        (("yaws", slice(9, 10), np.pi), FlagKind.YAW_FLIP, 9),
        ({"yaws": np.radians(15.0) * (-1.0) ** np.arange(21)}, FlagKind.YAW_JITTER, 1),
        ({"yaws": np.full(21, np.pi)}, FlagKind.AGAINST_MOTION, 0),
    ],
)
def test_each_flaw_is_flagged_where_it_is(a_track, changed, changes, kind, row):
    track = a_track(**changes) if isinstance(changes, dict) else changed(*changes)
    (found,) = [one for one in flags_of(track) if one.kind is kind]
    assert found.timestamp_ns == track.timestamps_ns[row]
    assert found.urgency > 1.0


def test_one_jump_is_no_jitter_and_one_flip_is_no_jitter_of_the_heading(changed):
    assert FlagKind.JITTER not in kinds(changed("centers", (slice(12, None), 1), 3.0))
    assert FlagKind.YAW_JITTER not in kinds(changed("yaws", slice(9, 10), np.pi))


def test_a_heading_that_goes_round_the_half_rotation_is_no_flip(a_track):
    yaws = (np.linspace(2.9, 3.5, 21) + np.pi) % (2 * np.pi) - np.pi
    velocities = 8.0 * np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros(21)])
    centers = np.cumsum(velocities * 0.1, axis=0)
    assert not flags_of(a_track(yaws=yaws, velocities=velocities, centers=centers))


def test_of_two_objects_in_one_location_the_less_sure_one_is_flagged(a_track):
    sure, unsure = a_track(1), a_track(2, scores=np.full(21, 0.6))
    apart = a_track(3, centers=a_track().centers + np.array([0.0, 4.0, 0.0]))
    above = a_track(4, centers=a_track().centers + np.array([0.0, 0.0, 5.0]), scores=np.full(21, 0.5))
    (found,) = overlap_flags([sure, unsure, apart, above])
    assert (found.track, found.kind) == (2, FlagKind.OVERLAP)
    assert not overlap_flags([sure, unsure], {frozenset((1, 2))})


def test_objects_that_are_there_at_different_times_do_not_overlap(a_track):
    later = a_track(2, timestamps_ns=a_track().timestamps_ns + 10_000_000_000)
    assert not overlap_flags([a_track(1), later])
    assert not overlap_flags([])
