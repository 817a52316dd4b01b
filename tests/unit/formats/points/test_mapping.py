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


def read(columns, mapping=None, clock=CLOCK):
    count = len(next(iter(columns.values())))
    return points_of(Cloud(Path("a.pcd"), count, columns), mapping or PointMapping(), clock)


def test_positions_come_as_float32_from_any_type_and_names_are_found_whatever_their_case():
    columns = {axis: np.array([1, -2, 3], np.int16) for axis in "XYZ"}
    columns["Reflectivity"] = np.array([9, 8, 7], np.uint8)
    points = read(columns, PointMapping(scale=IntensityScale(255.0))).points
    assert points.positions.dtype == np.float32
    assert points.positions[1].tolist() == [-2, -2, -2]
    assert points.intensities.tolist() == [9, 8, 7]


def test_points_without_a_return_are_dropped_and_counted():
    x = np.array([1.0, np.nan, 0.0, np.inf, 2.0], np.float32)
    read_points = read({"x": x, "y": x, "z": x, "ring": np.arange(5, dtype=np.uint8)})
    assert read_points.dropped == 3
    assert read_points.points.rings.tolist() == [0, 4]


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
    assert found.points.intensities.tolist() == expected
    assert found.clipped == clipped


@pytest.mark.parametrize(
    ("values", "maximum"),
    [
        (np.array([0.0, 0.99], np.float32), 1.0),
        (np.array([0.0, 255.0], np.float32), 255.0),
        (np.array([3.0, np.nan, 4000.0]), 65535.0),
        (np.array([1], np.uint16), 255.0),
        (np.array([1000], np.uint16), 65535.0),
        (np.array([1], np.uint8), 255.0),
        (np.array([1e6]), None),
    ],
)
def test_the_scale_of_brightness_is_distinguished_from_the_values(values, maximum):
    assert detect_scale(values) == (maximum and IntensityScale(maximum))


def test_absolute_times_lose_no_nanosecond():
    timestamps = np.array([CLOCK.timestamp_ns, CLOCK.timestamp_ns + 1, CLOCK.timestamp_ns + 99_999_999], np.uint64)
    times = PointTimes("nanoseconds", "clock", "t")
    points = read({**XYZ, "t": timestamps}, PointMapping(times=times)).points
    assert points.timestamps_ns.tolist() == [int(timestamp) + 7 for timestamp in timestamps]


@pytest.mark.parametrize(
    ("unit", "values", "offsets_ns"),
    [
        ("seconds", np.array([0.0, 0.05, 0.1]), [0, 50_000_000, 100_000_000]),
        ("microseconds", np.array([-3, 0, 50_000], np.int32), [-3_000, 0, 50_000_000]),
        ("milliseconds", np.array([0.0, 0.25, 100.0], np.float32), [0, 250_000, 100_000_000]),
    ],
)
@pytest.mark.parametrize(("relative_to", "base_ns"), [("timestamp", CLOCK.timestamp_ns), ("start", CLOCK.start_ns)])
def test_relative_times_count_from_what_they_are_relative_to(unit, values, offsets_ns, relative_to, base_ns):
    mapping = PointMapping(times=PointTimes(unit, relative_to, "t"))
    points = read({**XYZ, "t": values}, mapping).points
    assert points.timestamps_ns.tolist() == [base_ns + offset for offset in offsets_ns]


COUNTS = np.array([0, 257, 65535], np.uint16)


@pytest.mark.parametrize(
    ("columns", "colors"),
    [
        *(({"rgb": packed.view(dtype)}, [[0x11, 0x22, 0x33], [0, 0, 0xFF], [0, 0, 0]])
          for packed in [np.array([0x00112233, 0xFF0000FF, 0], np.uint32)] for dtype in (np.uint32, np.float32)),
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
    colours = dict.fromkeys(COLOURS, np.array([0.0, 0.5, 1.0]))
    near_ir, ring = np.array([5, 6, 7], np.uint16), np.array([0.0, 1.5, 2.0])
    points = read({**XYZ, **colours, "near_ir": near_ir, "ring": ring}).points
    assert (points.colors, points.rings) == (None, None)
    assert {name: column.tolist() for name, column in points.extras.items()} == {
        "near_ir": [5, 6, 7], "ring": [0.0, 1.5, 2.0], **{name: [0.0, 0.5, 1.0] for name in COLOURS},
    }  # fmt: skip


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


def test_nothing_can_be_written_into_the_arrays():
    points = read({**XYZ, "ring": np.arange(3, dtype=np.uint8), "other": np.arange(3)}).points
    for array in (points.positions, points.rings, points.extras["other"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_a_mapping_goes_to_other_processes():
    mapping = PointMapping(scale=IntensityScale(1.0), times=PointTimes("seconds"))
    assert pickle.loads(pickle.dumps(mapping)).scale == mapping.scale
