"""What columns mean: positions, brightness, lasers, times and colours of points."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.points.cloud import Cloud
from sceneloom.formats.points.mapping import (
    IntensityScale,
    PointMapping,
    PointTimes,
    SweepClock,
    detect_scale,
    points_of,
)

COLOURS = ("red", "green", "blue")
XYZ = {axis: np.array([1.0, 2.0, 3.0], np.float32) for axis in "xyz"}
CLOCK = SweepClock(timestamp_ns=1_532_402_927_647_951_001, start_ns=1_532_402_927_597_951_001, zero_ns=7)


def read(columns, mapping=None):
    count = len(next(iter(columns.values())))
    return points_of(Cloud(Path("a.pcd"), count, columns), mapping or PointMapping(), CLOCK)


def test_names_are_found_whatever_their_case_points_without_a_return_dropped_and_arrays_read_only():
    columns = {axis: np.array([1, -2, 3], np.int16) for axis in "XYZ"}
    columns["Reflectivity"] = np.array([9, 8, 7], np.uint8)
    # which goes to other processes
    points = read(columns, pickle.loads(pickle.dumps(PointMapping(scale=IntensityScale(255.0))))).points
    assert (points.positions.dtype, points.positions[1].tolist()) == (np.float32, [-2, -2, -2])
    assert points.intensities.tolist() == [9, 8, 7]
    x = np.array([1.0, np.nan, 0.0, np.inf, 2.0], np.float32)
    found = read({"x": x, "y": x, "z": x, "ring": np.arange(5, dtype=np.uint8), "other": np.arange(5)})
    assert (found.dropped, found.points.rings.tolist()) == (3, [0, 4])
    for array in (found.points.positions, found.points.rings, found.points.extras["other"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize(
    ("values", "maximum", "expected", "clipped"),
    [
        (np.array([0.0, 0.5, 1.0], np.float32), 1.0, [0, 128, 255], 0),
        (np.array([0.0, 99.4, 300.0], np.float32), 255.0, [0, 99, 255], 1),
        (np.array([0, 257, 65535], np.uint16), 65535.0, [0, 1, 255], 0),
        (np.array([np.nan, -1.0, np.inf], np.float32), 100.0, [0, 0, 255], 2),
    ],
)
def test_brightness_is_scaled_rounded_and_clipped(values, maximum, expected, clipped):
    found = read({**XYZ, "intensity": values}, PointMapping(scale=IntensityScale(maximum)))
    assert (found.points.intensities.tolist(), found.clipped) == (expected, clipped)


def test_the_scale_of_brightness_is_distinguished_from_the_values():
    found = [
        detect_scale(np.array(values, dtype))
        for values, dtype in (
            ([0.0, 0.99], "f4"), ([0.0, 255.0], "f4"), ([3.0, np.nan, 4000.0], "f8"), ([1], "u2"), ([1000], "u2"),
            ([1], "u1"), ([1e6], "f8"),
        )
    ]  # fmt: skip
    assert found == [*map(IntensityScale, (1.0, 255.0, 65535.0, 255.0, 65535.0, 255.0)), None]


ABSOLUTE = np.array([CLOCK.timestamp_ns, CLOCK.timestamp_ns + 1, CLOCK.timestamp_ns + 99_999_999], np.uint64)


@pytest.mark.parametrize(
    ("unit", "values", "offsets_ns"),
    [
        ("seconds", np.array([0.0, 0.05, 0.1]), [0, 50_000_000, 100_000_000]),
        ("microseconds", np.array([-3, 0, 50_000], np.int32), [-3_000, 0, 50_000_000]),
        ("milliseconds", np.array([0.0, 0.25, 100.0], np.float32), [0, 250_000, 100_000_000]),
        ("nanoseconds", ABSOLUTE, ABSOLUTE.tolist()),
    ],
)
def test_times_count_from_what_they_are_relative_to_and_lose_no_nanosecond(unit, values, offsets_ns):
    bases = {"clock": 7} if values is ABSOLUTE else {"timestamp": CLOCK.timestamp_ns, "start": CLOCK.start_ns}
    for relative_to, base_ns in bases.items():
        mapping = PointMapping(times=PointTimes(unit, relative_to, "t"))
        found = read({**XYZ, "t": values}, mapping).points.timestamps_ns.tolist()
        assert found == [base_ns + offset for offset in offsets_ns]


COUNTS = np.array([0, 257, 65535], np.uint16)
PACKED = np.array([0x00112233, 0xFF0000FF, 0], np.uint32)


@pytest.mark.parametrize(
    ("columns", "colors"),
    [
        *(({"rgb": PACKED.view(dtype)}, [[0x11, 0x22, 0x33], [0, 0, 0xFF], [0, 0, 0]]) for dtype in ("<u4", "<f4")),
        ({name: np.array([k, 0, 255], np.uint8) for k, name in enumerate(COLOURS)},
         [[0, 1, 2], [0, 0, 0], [255, 255, 255]]),
        # of 16 bits, also where their writer put bytes into them
        (dict.fromkeys(COLOURS, COUNTS), [[0] * 3, [1] * 3, [255] * 3]),
        (dict.fromkeys(COLOURS, np.array([0, 128, 255], np.uint16)), [[0] * 3, [128] * 3, [255] * 3]),
    ],
)  # fmt: skip
def test_colours_of_one_or_two_bytes_each_or_packed_are_taken(columns, colors):
    assert read({**XYZ, **columns}).points.colors.tolist() == colors


def test_what_means_nothing_or_is_of_another_kind_is_kept():
    further = dict.fromkeys(COLOURS, np.array([0.0, 0.5, 1.0])) | {"ring": np.array([0.0, 1.5, 2.0])}
    further["near_ir"] = np.array([5, 6, 7], np.uint16)
    points = read({**XYZ, **further}).points
    assert (points.colors, points.rings) == (None, None)
    found = {name: column.tolist() for name, column in points.extras.items()}
    assert found == {name: column.tolist() for name, column in further.items()}


SECONDS = PointMapping(times=PointTimes("seconds", "timestamp", "t"))


@pytest.mark.parametrize(
    ("columns", "mapping", "problem"),
    [
        ({**XYZ, "t": np.array([0, 50_000_000, 100_000_000], np.uint32)}, SECONDS,
         r't\[1\]: 50000000 seconds .*unit = "nanoseconds", relative_to = "timestamp"'),
        ({**XYZ, "t": np.array([0.0, 0.1, np.nan])}, SECONDS, r"t\[2\]: nan"),
        (XYZ, PointMapping(named={"intensity": "reflex"}),
         "reflex: no such column for intensity; the file has x y z"),
        ({name: XYZ[name] for name in "xy"}, PointMapping(), "no column for z; the file has x y"),
    ],
)  # fmt: skip
def test_what_cannot_be_points_is_refused(columns, mapping, problem):
    with pytest.raises(DataError, match=problem):
        read(columns, mapping)
