"""The samples of an IMU that can be computed with, and between which of them some are missing."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.scene.motion import VectorSamples

GYROSCOPE, ACCELEROMETER = "gyroscope", "accelerometer"
"""Streams of an IMU, in the words of the recording format."""

MISSING_SAMPLES = 5
"""So many sample intervals without a sample are a gap: what the ego did then is not known."""

LARGEST_SAMPLE = 1e5
"""What is beyond it was never measured, in whatever unit [rad/s, m/s²]: it stems from a torn line."""


def measured_rows(values: Float64Array) -> BoolArray:
    """Which rows of (N, K) samples are numbers that a sensor may report, (N,) bool."""
    return np.asarray((np.abs(values) <= LARGEST_SAMPLE).all(axis=1), np.bool_)


def usable_samples(samples: VectorSamples) -> tuple[Int64Array, Float64Array, int]:
    """Take the samples that can be computed with.

    Returns:
        timestamps_ns: (N,) int64 [ns], strictly increasing.
        values: (N, 3) float64, in the stream's unit.
        left_out: samples that are no measurement, or of a time that was there before.
    """
    measured = np.flatnonzero(measured_rows(samples.values[:, :3]))
    times, first = np.unique(samples.timestamps_ns[measured], return_index=True)
    return times, samples.values[measured[first], :3], len(samples) - len(times)


def gaps_between(timestamps_ns: Int64Array) -> Int64Array:
    """The times before and after each gap in (N,) times [ns], (G, 2) int64 [ns]."""
    steps = np.diff(timestamps_ns)
    holes = (
        np.flatnonzero(steps > (MISSING_SAMPLES + 0.5) * np.median(steps)) if len(steps) else np.zeros(0, int)
    )
    return np.stack([timestamps_ns[holes], timestamps_ns[holes + 1]], axis=1)
