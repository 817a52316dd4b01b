"""Blocks of numbers and times become the text that they become one by one; lines of many streams come in order."""

from decimal import Decimal

import msgspec
import numpy as np
import pytest

from sceneloom.formats.base.text_tables import TimeWriter, exact_seconds, means, seconds_text, seconds_texts
from sceneloom.formats.recording.writer import LineStream, group_images, merged_lines, row_texts

SPANS = {
    "around zero": (-(10**7), 10**7),
    "minutes": (-(10**12), 10**12),
    "weeks": (-(10**15), 10**15),
    "where numbers stop to hold nanoseconds": (-(2**54), 2**54),
    "just beyond": (8 * 10**15, 10**16),
    "today": (17 * 10**17, 17 * 10**17 + 10**15),
    "everything": (-9 * 10**18, 9 * 10**18),
}


def some_times(span):
    low, high = SPANS[span]
    rng = np.random.default_rng(low % 1000)
    # whole milliseconds, and multiples of 2^-9 s, which lie halfway between two numbers in locations
    steps = [rng.integers(low // step, high // step, 300) * step for step in (1, 10**6, 1_953_125, 10**9)]
    return np.concatenate(steps).astype(np.int64)


@pytest.mark.parametrize("span", SPANS)
def test_times_are_written_exactly_without_zeros_at_the_end_and_the_nearest_numbers_are_those_that_reading_gives(span):
    timestamps = some_times(span)
    exact = [Decimal(timestamp).scaleb(-9) for timestamp in timestamps.tolist()]
    texts = seconds_texts(timestamps, None)
    assert list(map(Decimal, texts)) == exact
    assert all("e" not in text and (text.endswith(".0") or not text.endswith("0")) for text in texts)
    assert exact_seconds(timestamps).tolist() == list(map(float, exact))


def test_a_time_has_as_many_digits_as_it_needs_or_is_the_number_that_it_came_from_where_it_still_means_it():
    seconds = np.array([1.444770263671875, 0.1 + 0.2, np.nan, np.inf, 1e300, 1700000000.1234567, -2.5])
    timestamps = np.array([1_444_770_264, 300_000_000, 7, 8, 9, 1_700_000_000_123_456_717, -2_400_000_000])
    texts = seconds_texts(timestamps, seconds)
    assert [float(texts[k]) for k in (0, 1, 5)] == [seconds[k] for k in (0, 1, 5)]
    assert [texts[k] for k in (2, 3, 4, 6)] == ["0.000000007", "0.000000008", "0.000000009", "-2.4"]
    for text in ["0.0", "0.000000001", "-0.000000001", "0.1", "-1.5", "1.444770263", "1700000000.123456789", "7.0"]:
        assert seconds_text(int(Decimal(text) * 10**9)) == text
    for seconds in (1.444770263671875, 0.1 + 0.2, 1e-7, -3.25, 1700000000.1234567, 5.0):
        assert float(seconds_text(round(seconds * 1e9), seconds)) == seconds
    for no_longer in (1.5, float("nan"), float("inf")):
        assert not means(no_longer, 2_000_000_000)
        assert seconds_text(2_000_000_000, no_longer) == "2.0"
    # other numbers are read as they were
    numbers = np.concatenate([np.random.default_rng(0).normal(size=200) * 10.0 ** np.arange(-100, 100), [0.0, -0.0]])
    assert [float(text) for text in row_texts(numbers[:, None])] == numbers.tolist()
    rows = numbers[:201].reshape(-1, 3)
    assert [msgspec.json.decode(f"[{text}]") for text in row_texts(rows)] == rows.tolist()
    assert row_texts(np.zeros((0, 3))) == []


def test_times_that_a_64_bit_number_cannot_hold_are_counted_in_blocks_as_one_by_one():
    times = TimeWriter()
    assert times.text(123_456_789) == "0.123456789"
    assert times.inexact == 0
    assert times.text(1_700_000_000_123_456_789) == "1700000000.123456789"
    assert times.inexact == 1
    # neighbouring numbers near 1.7e9 are 2^-22 s apart
    assert 0 < times.worst_ns <= 2**-22 / 2 * 1e9 + 128
    timestamps = some_times("today")
    block, single = TimeWriter(), TimeWriter()
    assert block.texts(timestamps, None) == [single.text(timestamp) for timestamp in timestamps.tolist()]
    assert (block.inexact, block.worst_ns) == (single.inexact, single.worst_ns)
    assert block.inexact > 0


def test_lines_come_by_time_then_by_stream_each_asked_for_when_its_turn_comes():
    asked: list[str] = []

    def lines(name, timestamps):
        for timestamp in timestamps:
            asked.append(name)
            yield f"{name} {timestamp}"

    rng = np.random.default_rng(3)
    times = {name: sorted(rng.integers(0, 500, count).tolist()) for name, count in (("a", 7000), ("b", 300), ("c", 0))}
    streams = [LineStream(np.array(found, np.int64), lines(name, found)) for name, found in times.items()]
    merged = [line.split() for block in merged_lines(streams) for line in block]
    keys = [(int(timestamp), name) for name, timestamp in merged]
    assert keys == sorted(keys)
    assert (len(keys), asked) == (7300, [name for name, _ in merged])


def test_images_of_cameras_in_step_share_lines_which_ascend_and_every_image_is_in_one():
    for cameras, rows in (
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
    ):
        assert group_images([np.array(times_ms, np.int64) * 1_000_000 for times_ms in cameras]).tolist() == rows
    rng = np.random.default_rng(0)
    cameras = [np.sort(rng.integers(0, 10_000, size)).astype(np.int64) for size in (40, 55, 13)]
    rows = group_images(cameras)
    for camera, times in enumerate(cameras):
        column = rows[:, camera]
        assert column[column >= 0].tolist() == list(range(len(times)))
    earliest = [min(cameras[c][k] for c, k in enumerate(row) if k >= 0) for row in rows.tolist()]
    assert earliest == sorted(earliest)
