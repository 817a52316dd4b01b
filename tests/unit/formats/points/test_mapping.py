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

XYZ = {axis: np.array([1.0, 2.0, 3.0], np.float32) for axis in "xyz"}
CLOCK = SweepClock(timestamp_ns=1_532_402_927_647_951_001, start_ns=1_532_402_927_597_951_001, zero_ns=7)


def read(columns, mapping=None, clock=CLOCK):
    count = len(next(iter(columns.values())))
    return points_of(Cloud(Path("a.pcd"), count, columns), mapping or PointMapping(), clock)


def test_positions_come_as_float32_from_any_type():
    points = read({axis: np.array([1, -2, 3], np.int16) for axis in "xyz"}).points
    assert points.positions.dtype == np.float32
    assert points.positions[1].tolist() == [-2, -2, -2]


def test_names_are_found_whatever_their_case():
    columns = {"X": np.ones(1), "Y": np.ones(1), "Z": np.ones(1), "Reflectivity": np.array([9], np.uint8)}
    points = read(columns, PointMapping(scale=IntensityScale(255.0))).points
    assert points.intensities.tolist() == [9]


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
    ],
)
def test_the_scale_of_brightness_is_distinguished_from_the_values(values, maximum):
    assert detect_scale(values) == IntensityScale(maximum)


def test_brightness_beyond_all_scales_is_not_guessed():
    assert detect_scale(np.array([1e6])) is None


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


def test_times_of_the_wrong_unit_are_refused_and_the_right_one_is_named():
    mapping = PointMapping(times=PointTimes("seconds", "timestamp", "t"))
    with pytest.raises(DataError, match=r't\[1\]: 50000000 seconds .*unit = "nanoseconds", relative_to = "timestamp"'):
        read({**XYZ, "t": np.array([0, 50_000_000, 100_000_000], np.uint32)}, mapping)


def test_a_time_that_is_no_number_is_refused():
    mapping = PointMapping(times=PointTimes("seconds", "timestamp", "t"))
    with pytest.raises(DataError, match=r"t\[2\]: nan"):
        read({**XYZ, "t": np.array([0.0, 0.1, np.nan])}, mapping)


def test_packed_colours_are_taken_apart():
    packed = np.array([0x00112233, 0xFF0000FF, 0], np.uint32)
    for column in (packed, packed.view(np.float32)):
        points = read({**XYZ, "rgb": column}).points
        assert points.colors.tolist() == [[0x11, 0x22, 0x33], [0, 0, 0xFF], [0, 0, 0]]


def test_colours_of_one_byte_each_are_taken_and_others_are_left():
    channels = {name: np.array([k, 0, 255], np.uint8) for k, name in enumerate(("red", "green", "blue"))}
    assert read({**XYZ, **channels}).points.colors.tolist() == [[0, 1, 2], [0, 0, 0], [255, 255, 255]]
    floats = {name: column / 255.0 for name, column in channels.items()}
    left = read({**XYZ, **floats}).points
    assert left.colors is None
    assert {"red", "green", "blue"} <= set(left.extras)


def test_columns_that_mean_nothing_are_kept():
    points = read({**XYZ, "near_ir": np.array([5, 6, 7], np.uint16)}).points
    assert points.extras["near_ir"].tolist() == [5, 6, 7]
    assert set(points.extras) == {"near_ir"}


def test_lasers_that_are_no_whole_numbers_are_left_as_they_are():
    points = read({**XYZ, "ring": np.array([0.0, 1.5, 2.0])}).points
    assert points.rings is None
    assert points.extras["ring"].tolist() == [0.0, 1.5, 2.0]


def test_a_column_that_was_named_but_is_not_there_is_reported():
    with pytest.raises(DataError, match="reflex: no such column for intensity; the file has x y z"):
        read(XYZ, PointMapping(named={"intensity": "reflex"}))


def test_a_cloud_without_positions_is_refused():
    with pytest.raises(DataError, match="no column for z; the file has x y"):
        read({name: XYZ[name] for name in "xy"})


def test_nothing_can_be_written_into_the_arrays():
    points = read({**XYZ, "ring": np.arange(3, dtype=np.uint8), "other": np.arange(3)}).points
    for array in (points.positions, points.rings, points.extras["other"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_a_mapping_goes_to_other_processes():
    mapping = PointMapping(scale=IntensityScale(1.0), times=PointTimes("seconds"))
    assert pickle.loads(pickle.dumps(mapping)).scale == mapping.scale


def test_colours_of_16_bits_become_bytes_also_where_their_writer_put_bytes_into_them():
    wide = {name: np.array([0, 257, 65535], np.uint16) for name in ("red", "green", "blue")}
    assert read({**XYZ, **wide}).points.colors.tolist() == [[0] * 3, [1] * 3, [255] * 3]
    narrow = {name: np.array([0, 128, 255], np.uint16) for name in ("red", "green", "blue")}
    assert read({**XYZ, **narrow}).points.colors.tolist() == [[0] * 3, [128] * 3, [255] * 3]
