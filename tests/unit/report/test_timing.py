"""Rates, jitter and gaps, held against timestamps that were made to have them."""

import numpy as np
import pytest

from sceneloom.report.timing import Timing, stream_timing
from sceneloom.scene import GnssSensor, Scene
from sceneloom.scene.scene import time_span

MS = 1_000_000


def timestamps(*milliseconds):
    return np.array([round(value * MS) for value in milliseconds], np.int64)


def test_gaps_that_were_injected_are_found_where_they_are_and_images_reported_against_the_sweeps(drive):
    start_ns = time_span(drive.scene)[0]
    timing = Timing.of(drive.scene, start_ns=start_ns)
    found = next(stream for stream in timing.streams if stream.sensor == "camera0")
    truth = drive.truth.cameras["camera0"].timestamps_ns
    assert (found.count, found.gap_count, found.missing) == (13, 2, 3)
    reported = [edge for gap in found.gaps for edge in (gap.start, gap.stop)]
    assert reported == pytest.approx(((truth[[3, 6, 10, 12]] - start_ns) / 1e9).tolist())
    assert found.missing_share == pytest.approx(3 / 16)
    sweeps, images = drive.scene.lidars[0].frames.timestamps_ns, drive.scene.cameras[0].images.timestamps_ns
    away = np.array([(t - sweeps[np.argmin(np.abs(sweeps - t))]) / 1e6 for t in images])
    phase = (found.phase.median_ms, found.phase.farthest_ms)
    assert (found.phase.reference, phase) == ("lidar", pytest.approx((np.median(away), np.abs(away).max())))


def test_jitter_repetitions_and_steps_back_are_those_of_the_timestamps():
    even = stream_timing("a", "lidar", timestamps(*range(0, 1000, 100)), start_ns=0)
    assert (even.jitter_ms, even.gap_count, even.missing) == (0.0, 0, 0)
    assert even.rate_hz == pytest.approx(10.0)
    uneven = stream_timing("a", "lidar", timestamps(0, 90, 200, 290, 400, 490, 600), start_ns=0)
    assert uneven.jitter_ms == pytest.approx(10.0)  # intervals of 90 and 110 ms
    found = stream_timing("a", "camera", timestamps(0, 100, 100, 200, 150, 300), start_ns=0)
    assert (found.repeated, found.backwards) == (1, 1)
    assert stream_timing("a", "camera", timestamps(), start_ns=0).start is None
    one = stream_timing("a", "camera", timestamps(5000), start_ns=timestamps(2000)[0])
    assert (one.start, one.rate_hz, one.bins) == (3.0, None, None)
    times = np.cumsum(np.random.default_rng(2).integers(5, 400, 500)) * MS
    assert sum(stream_timing("a", "imu", times.astype(np.int64), start_ns=0).bins.counts) == 499


def test_the_overlap_is_what_all_streams_share():
    def timing(*streams):
        sensors = (GnssSensor(str(t), t, np.zeros((len(t), 3)), *np.full((2, len(t)), np.nan)) for t in streams)
        return Timing.of(Scene(tuple(sensors)), start_ns=0)

    found = timing(timestamps(0, 1000, 4000), timestamps(3000, 3500, 8000))
    assert (found.overlap.start, found.overlap.stop, found.overlap_share) == (3.0, 4.0, pytest.approx(1 / 8))
    assert timing(timestamps(0, 1000), timestamps(3000, 3500)).overlap is None
