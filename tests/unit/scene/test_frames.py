"""Lazy frames: timestamps at once, contents when asked for."""

import numpy as np
import pytest

from sceneloom.errors import ArrayError
from sceneloom.scene import LazyFrames


def counting_frames(count: int = 5) -> tuple[LazyFrames[int], list[int]]:
    asked: list[int] = []

    def read(index: int) -> int:
        asked.append(index)
        return index * 10

    return LazyFrames(np.arange(count, dtype=np.int64), read), asked


def test_nothing_is_read_before_it_is_asked_for_and_nothing_is_kept() -> None:
    frames, asked = counting_frames()
    assert len(frames) == 5
    assert asked == []
    assert (frames[2], frames[2], frames[-1]) == (20, 20, 40)
    assert asked == [2, 2, 4]


def test_a_slice_behaves_like_a_slice_of_a_list() -> None:
    frames, asked = counting_frames()
    everything = [0, 10, 20, 30, 40]
    for part in (slice(1, 4), slice(None, None, -2), slice(3, 1), slice(-2, None)):
        assert list(frames[part]) == everything[part]
        np.testing.assert_array_equal(frames[part].timestamps_ns, np.arange(5)[part])
    assert list(frames[1:][1:3]) == [20, 30]
    assert asked


def test_an_index_outside_ends_iteration_as_for_every_sequence() -> None:
    frames, _ = counting_frames()
    with pytest.raises(IndexError):
        frames[5]
    assert list(reversed(frames)) == [40, 30, 20, 10, 0]


def test_timestamps_cannot_be_written_and_have_one_axis() -> None:
    frames, _ = counting_frames()
    with pytest.raises(ValueError, match="read-only"):
        frames.timestamps_ns[0] = 7
    with pytest.raises(ArrayError, match=r"expected \(N\) int64"):
        LazyFrames(np.zeros((2, 2), np.int64), lambda index: index)
