"""Which frame belongs to a time, against looking at all of them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.cameras.camera import Camera
from sceneloom.scene import CameraImage, LazyFrames, LidarFrame, LidarPoints
from sceneloom.scene.sampling import FramesByTimestamp, SweepsByReference

CAMERA_MODEL = Camera("pinhole", 4, 3, 2.0, 2.0, 1.5, 1.0)
PERIOD = 100
TIMESTAMPS = st.lists(st.integers(0, 60), max_size=12)


def images_at(timestamps):
    items = [
        CameraImage(timestamp, CAMERA_MODEL, lambda: np.zeros((3, 4, 3), np.uint8))
        for timestamp in timestamps
    ]
    return LazyFrames.of(items, timestamps)


def sweep_at(start, times):
    points = LidarPoints(np.zeros((len(times), 3), np.float32), timestamps_ns=np.array(times, np.int64))
    return LidarFrame(start, points)


def nearest_of_all(times, wanted, tolerance):
    """The oracle: the first of the least far, after a stable sort by time."""
    order = sorted(range(len(times)), key=lambda k: times[k])
    best = min(order, key=lambda k: abs(times[k] - wanted), default=None)
    return None if best is None or abs(times[best] - wanted) > tolerance else best


@given(TIMESTAMPS, st.integers(-5, 65), st.integers(0, 20))
def test_the_nearest_image_is_found_and_the_earlier_one_of_two(timestamps, wanted, tolerance):
    frames = images_at(timestamps)
    answer = FramesByTimestamp(frames).find(wanted, tolerance)
    expected = nearest_of_all(timestamps, wanted, tolerance)
    if expected is None:
        assert isinstance(answer, str)
    else:
        assert answer == (frames[expected], timestamps[expected])


@st.composite
def sweeps(draw):
    """Sweeps that begin one after another, whose median times come in the same order, some of them long or late."""
    gaps = draw(st.lists(st.integers(1, 40), min_size=1, max_size=8))
    starts = np.cumsum(gaps).tolist()
    lags = draw(st.lists(st.integers(0, 60), min_size=len(starts), max_size=len(starts)))
    references = np.maximum.accumulate(np.add(starts, lags)).tolist()
    # two times around the median keep it from being the timestamp where all are the same
    return [sweep_at(start, [mid - 1, mid, mid + 1]) for start, mid in zip(starts, references, strict=True)]


@given(sweeps(), st.lists(st.integers(-10, 400), min_size=1, max_size=5), st.integers(0, 200))
def test_the_nearest_sweep_is_found_by_its_own_reference_time_whatever_was_asked_before(
    frames, times, tolerance
):
    finder = SweepsByReference(LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]), PERIOD)
    references = [frame.reference_ns for frame in frames]
    for wanted in times:
        answer = finder.find(wanted, tolerance)
        expected = nearest_of_all(references, wanted, tolerance)
        if expected is None:
            assert isinstance(answer, str)
        else:
            # of sweeps with one reference time any is as near as the other
            assert answer[1] == references[expected]
            assert answer[0].reference_ns == references[expected]


def test_a_sweep_in_the_middle_of_its_image_is_read_once_and_no_other():
    asked = []
    frames = [sweep_at(k * PERIOD, [k * PERIOD + 49, k * PERIOD + 50, k * PERIOD + 51]) for k in range(20)]

    def read(k):
        asked.append(k)
        return frames[k]

    finder = SweepsByReference(LazyFrames(np.arange(20, dtype=np.int64) * PERIOD, read), PERIOD)
    assert finder.find(12 * PERIOD + 55, PERIOD) == (frames[12], 12 * PERIOD + 50)
    assert asked == [12]


def test_point_times_that_count_from_the_timestamp_are_put_right_before_they_report_the_moment():
    sweep = sweep_at(1000, [5, 6, 7])
    frame, reference_ns = SweepsByReference(LazyFrames.of([sweep], [1000]), PERIOD).read(0)
    assert reference_ns == 1006
    assert frame.points.timestamps_ns.tolist() == [1005, 1006, 1007]


def test_that_a_sensor_has_nothing_or_nothing_near_is_stated():
    assert FramesByTimestamp(images_at([])).find(0, 5) == "it has no frames"
    assert "0.000 s away" in FramesByTimestamp(images_at([9])).find(0, 5)
    empty = SweepsByReference(LazyFrames.of([], []), PERIOD)
    assert empty.find(0, 5) == "it has no frames"
