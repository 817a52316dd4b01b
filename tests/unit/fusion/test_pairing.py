"""Images are paired with sweeps as an exhaustive search over all images would."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.cameras.camera import Camera
from sceneloom.fusion.pairing import TimedQueue
from sceneloom.scene import CameraImage

CAMERA = Camera("pinhole", 2, 2, 1.0, 1.0, 0.5, 0.5)


def image(time_ns: int) -> CameraImage:
    return CameraImage.of(time_ns, CAMERA, np.zeros((2, 2, 3), np.uint8))


def queue_of(times_ns: list[int]) -> TimedQueue[CameraImage]:
    queue = TimedQueue("camera0")
    for time_ns in times_ns:
        queue.add(image(time_ns))
    return queue


def exhaustive(times_ns: list[int], time_ns: int, tolerance_ns: int) -> int | None:
    best: int | None = None
    for candidate in sorted(times_ns):
        if abs(candidate - time_ns) <= tolerance_ns and (
            best is None or abs(candidate - time_ns) < abs(best - time_ns)
        ):
            best = candidate
    return best


@given(st.lists(st.integers(-100, 100), max_size=20, unique=True), st.integers(-120, 120), st.integers(0, 50))
def test_the_nearest_image_is_found_and_ties_go_to_the_earlier(times: list[int], time: int, tolerance: int) -> None:
    near = queue_of(times).nearest(time, tolerance)
    assert (None if near is None else near.timestamp_ns) == exhaustive(times, time, tolerance)


@given(st.lists(st.integers(0, 100), min_size=1, max_size=20, unique=True), st.integers(0, 100), st.integers(0, 20))
def test_forgetting_changes_no_later_pair(times: list[int], start: int, later: int) -> None:
    queue = queue_of(times)
    queue.forget_before(start)
    near = queue.nearest(start + later, 1000)
    assert near is not None
    assert near.timestamp_ns == exhaustive(times, start + later, 1000)


def test_an_image_is_known_to_be_nearest_only_when_one_at_or_after_the_time_has_come() -> None:
    queue = queue_of([10])
    assert queue.reaches(10)
    assert not queue.reaches(11)
    assert not TimedQueue("camera0").reaches(0)
