import numpy as np
import pytest

from sceneloom.errors import ArrayError
from sceneloom.scene import Support, Track, TrackedObjects, Tracks


def columns(count, **others):
    return {
        "centers": np.zeros((count, 3)),
        "sizes_lwh": np.ones((count, 3)),
        "yaws": np.zeros(count),
        "velocities": np.zeros((count, 3)),
        "yaw_rates": np.zeros(count),
        "covariances": np.tile(np.eye(10), (count, 1, 1)),
        "scores": np.ones(count),
        "supports": np.full(count, Support.SWEEP, np.uint8),
        **others,
    }


def track(number, times, **others):
    return Track(number, "car", np.array(times, np.int64), **columns(len(times), **others))


def test_a_track_cannot_be_written_to():
    corners = np.ones((2, 4))
    found = track(3, [0, 10], corners_xyxy={"left": corners})
    for array in (found.centers, found.supports, found.timestamps_ns, found.corners_xyxy["left"]):
        assert not array.flags.writeable
    assert corners.flags.writeable


@pytest.mark.parametrize("times", [[10, 10], [10, 0]])
def test_times_that_do_not_rise_are_refused(times):
    with pytest.raises(ArrayError, match="do not rise"):
        track(3, times)


@pytest.mark.parametrize("wrong", [{"yaws": np.zeros(3)}, {"corners_xyxy": {"left": np.zeros((2, 3))}}])
def test_columns_of_another_length_are_named(wrong):
    with pytest.raises(ArrayError, match=next(iter(wrong))):
        track(3, [0, 10], **wrong)


def test_objects_at_one_time_need_a_class_each():
    with pytest.raises(ArrayError, match="labels"):
        TrackedObjects(0, np.arange(2), ("car",), **columns(2))


def test_tracks_are_a_sequence():
    tracks = Tracks((track(1, [0]), track(4, [0, 5])))
    assert [one.id for one in tracks] == [1, 4]
    assert [len(one) for one in tracks] == [1, 2]
