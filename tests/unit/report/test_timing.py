"""Rates, jitter and gaps, held against timestamps that were made to have them."""

import numpy as np
import pytest

from sceneloom.report.timing import Timing, stream_timing
from sceneloom.scene import GnssSensor, Scene
from sceneloom.scene.scene import time_span

MS = 1_000_000


def timestamps(*milliseconds):
    return np.array([round(value * MS) for value in milliseconds], np.int64)


def of_camera(drive):
    timing = Timing.of(drive.scene, start_ns=time_span(drive.scene)[0])
    return next(stream for stream in timing.streams if stream.sensor == "camera0")


def test_gaps_that_were_injected_are_found_where_they_are(drive):
    truth = drive.truth.cameras["camera0"].timestamps_ns
    start_ns = time_span(drive.scene)[0]
    found = of_camera(drive)
    assert (found.count, found.gap_count, found.missing) == (13, 2, 3)
    reported = [edge for gap in found.gaps for edge in (gap.start, gap.stop)]
    assert reported == pytest.approx(((truth[[3, 6, 10, 12]] - start_ns) / 1e9).tolist())
    assert found.missing_share == pytest.approx(3 / 16)


def test_an_even_stream_has_no_jitter_and_an_uneven_one_the_one_it_was_given():
    even = stream_timing("a", "lidar", timestamps(*range(0, 1000, 100)), start_ns=0)
    assert (even.jitter_ms, even.gap_count, even.missing) == (0.0, 0, 0)
    assert even.rate_hz == pytest.approx(10.0)
    uneven = stream_timing("a", "lidar", timestamps(0, 90, 200, 290, 400, 490, 600), start_ns=0)
    assert uneven.jitter_ms == pytest.approx(10.0)  # intervals of 90 and 110 ms


def test_what_repeats_or_runs_backwards_is_counted_and_every_interval_is_in_a_bin():
    found = stream_timing("a", "camera", timestamps(0, 100, 100, 200, 150, 300), start_ns=0)
    assert (found.repeated, found.backwards) == (1, 1)
    assert stream_timing("a", "camera", timestamps(), start_ns=0).start is None
    one = stream_timing("a", "camera", timestamps(5000), start_ns=timestamps(2000)[0])
    assert (one.start, one.rate_hz, one.bins) == (3.0, None, None)
    times = np.cumsum(np.random.default_rng(2).integers(5, 400, 500)) * MS
    assert sum(stream_timing("a", "imu", times.astype(np.int64), start_ns=0).bins.counts) == 499


def receiver(name, times_ns):
    none = np.full(len(times_ns), np.nan)
    return GnssSensor(name, times_ns, np.zeros((len(times_ns), 3)), none, none)


def test_the_overlap_is_what_all_streams_share():
    scene = Scene((receiver("a", timestamps(0, 1000, 4000)), receiver("b", timestamps(3000, 3500, 8000))))
    found = Timing.of(scene, start_ns=0)
    assert (found.overlap.start, found.overlap.stop) == (3.0, 4.0)
    assert found.overlap_share == pytest.approx(1 / 8)
    apart = Scene((receiver("a", timestamps(0, 1000)), receiver("b", timestamps(3000, 3500))))
    assert Timing.of(apart, start_ns=0).overlap is None


def test_images_are_reported_against_the_sweeps(drive):
    sweeps = drive.scene.lidars[0].frames.timestamps_ns
    images = drive.scene.cameras[0].images.timestamps_ns
    away = np.array([(t - sweeps[np.argmin(np.abs(sweeps - t))]) / 1e6 for t in images])
    found = of_camera(drive)
    assert found.phase.reference == "lidar"
    assert found.phase.median_ms == pytest.approx(np.median(away))
    assert found.phase.farthest_ms == pytest.approx(np.abs(away).max())
