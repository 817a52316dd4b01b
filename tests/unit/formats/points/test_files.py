"""Clouds in files: made here by hand after the formats' descriptions; written in chunks and read by other programs."""

import pickle
import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from pypcd4 import PointCloud

from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.points.cloud import NO_LABEL, Cloud, FieldLayout, WrittenPoints
from sceneloom.formats.points.files import open_cloud_writer, read_cloud
from sceneloom.formats.points.mapping import (
    IntensityScale,
    PointMapping,
    PointTimes,
    SweepClock,
    detect_scale,
    points_of,
)

ROWS = np.array([[1.0, 2.0, 3.0, 0.5], [-4.0, 5.0, 6.0, 0.25]], np.float32)


@pytest.fixture
def read(tmp_path):
    """Read the columns of a file with such bytes, or of an `.npz` file with such arrays."""

    def read(name, content=b"", layout=None, **arrays):
        path = tmp_path / name
        if arrays:
            np.savez_compressed(path, **arrays)
        elif isinstance(content, np.ndarray):
            np.save(path, content)
        else:
            path.write_bytes(content)
        return read_cloud(path, layout=layout).columns

    return read


def values(columns):
    return {name: column.tolist() for name, column in columns.items()}


def types(columns):
    return [column.dtype.name for column in columns.values()]


def test_bin_files_are_read_as_kittis_or_nuscenes_or_as_a_layout_says(read):
    x, y, z, intensity = ROWS.T.tolist()
    assert values(read("0.bin", ROWS.tobytes())) == {"x": x, "y": y, "z": z, "intensity": intensity}
    assert read("0.pcd.bin", np.arange(10, dtype="<f4").tobytes())["ring"].tolist() == [4, 9]
    layout = FieldLayout.parse(["x", "y", "z", "_:uint8", "ring:uint16", "t:uint64"], default="float64")
    record = np.dtype([("p", "<f8", 3), ("pad", "u1"), ("ring", "<u2"), ("t", "<u8")])
    columns = read("1.bin", np.array([((1, 2, 3), 255, 40, 2**63 + 1)], record).tobytes(), layout)
    assert values(columns) == {"x": [1.0], "y": [2.0], "z": [3.0], "ring": [40], "t": [2**63 + 1]}
    for fields in (["x:floot32"], ["x", "x"], ["x y"], []):
        with pytest.raises(OptionError):
            FieldLayout.parse(fields)


def test_columns_of_npz_and_npy_files_are_taken_by_name_and_rows_cut_into_columns(read):
    for name in ("points", "positions", "xyz"):
        columns = read(f"{name}.npz", ring=np.array([1, 2]), session=np.arange(7), **{name: ROWS})
        # an array of another length says nothing of the points
        assert set(columns) == {"x", "y", "z", "intensity", "ring"}
        assert (columns["intensity"].tolist(), columns["ring"].tolist()) == ([0.5, 0.25], [1, 2])
    assert read("0.npz", x=ROWS[:, 0], y=ROWS[:, 1], z=ROWS[:, 2])["z"].tolist() == [3.0, 6.0]
    assert read("0.npy", np.asfortranarray(ROWS.astype(">f8")))["x"].tolist() == [1.0, -4.0]
    named = np.array([(1, 2, 3, 9)], [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "u1")])
    assert read("1.npy", named)["ring"].tolist() == [9]
    # rows whose brightness is left out go with an array of it
    columns = read("2.npz", layout=FieldLayout.parse(["x", "y", "z", "_"]), points=ROWS, intensity=ROWS[:, 0])
    assert columns["intensity"].tolist() == [1.0, -4.0]


PCD_HEAD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z intensity ring t
SIZE 4 4 4 4 2 8
TYPE F F F F U U
COUNT 1 1 1 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA {data}
"""
PCD_POINTS = [(1.5, -2.0, 0.25, 7.0, 3, 1532402927647951000), (4.0, 5.0, -6.0, 0.5, 31, 1532402927647951001)]


def pcd(data):
    head = PCD_HEAD.format(count=len(PCD_POINTS), data=data).encode()
    if data == "ascii":
        return head + "\n".join(" ".join(map(str, point)) for point in PCD_POINTS).encode() + b"\n"
    return head + b"".join(struct.pack("<ffffHQ", *point) for point in PCD_POINTS)


def test_pcd_fields_of_several_values_padding_and_repeated_names_and_empty_and_organised_clouds_are_read(read):
    """Others are read in the tests against pypcd4 and with records of any kind."""
    for data in ("ascii", "binary", "binary_compressed"):
        names = ("x", "y", "z", "intensity", "ring", "t")
        assert values(read("0.pcd", PCD_HEAD.format(count=0, data=data).encode())) == {name: [] for name in names}
    head = "FIELDS x _ y z n n\nSIZE 4 1 4 4 4 1\nTYPE F U F F F I\nCOUNT 1 3 1 1 2 1\nWIDTH 1\nHEIGHT 1\nDATA binary\n"
    columns = read("a.pcd", head.encode() + struct.pack("<f3B4fb", 1, 9, 9, 9, 2, 3, 4, 5, -1))
    assert values(columns) == {"x": [1.0], "y": [2.0], "z": [3.0], "n": [[4.0, 5.0]], "n~2": [-1]}
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 2\nDATA binary\n"
    columns = read("b.pcd", head.encode() + np.arange(18, dtype="<f4").tobytes())
    assert columns["z"].tolist() == [2, 5, 8, 11, 14, 17]


ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
PLY_POINTS = [(1.5, -2.0, 0.25, 200, 123456789), (4.0, 5.0, -6.0, 0, -7)]
VERTEX = (
    "element vertex 2\nproperty float x\nproperty float32 y\nproperty double z\nproperty uchar intensity\n"
    "property int t\n"
)
FACES = "element face 2\nproperty list uchar int vertex_indices\nproperty uchar flag\n"


def ply(form, *parts):
    """A file of elements with their rows: their types in struct's words after `<` or `>`, and the numbers of each."""
    head = f"ply\nformat {form} 1.0\ncomment by hand\n{''.join(element for element, _ in parts)}end_header\n".encode()
    if form == "ascii":
        lines = (" ".join(map(str, row[1:])) + "\n" for _, rows in parts for row in rows)
        return head + "".join(lines).encode()
    return head + b"".join(struct.pack(ORDERS[form] + row[0], *row[1:]) for _, rows in parts for row in rows)


VERTICES = VERTEX, [("ffdBi", *point) for point in PLY_POINTS]
TRIANGLES = FACES, [("B3iB", 3, 0, 1, 0, 9), ("B4iB", 4, 0, 1, 1, 0, 8)]
LISTED = (
    "element vertex 2\nproperty float x\nproperty list uchar short seen\nproperty float y\n",
    [("fB2hf", 1.5, 2, 7, 8, -2.0), ("fBf", 4.0, 0, 5.0)],
)


@pytest.mark.parametrize("form", ["ascii", *ORDERS])
def test_vertices_of_ply_files_come_exactly_and_lists_and_other_elements_are_passed_over(read, form):
    expected = {"x": [1.5, 4.0], "y": [-2.0, 5.0], "z": [0.25, -6.0], "intensity": [200, 0], "t": [123456789, -7]}
    for parts in ([VERTICES], [("comment end_header comes later\n", []), VERTICES], [TRIANGLES, VERTICES]):
        assert values(read("a.ply", ply(form, *parts))) == expected
    columns = read("a.ply", ply(form, VERTICES, TRIANGLES))
    assert (values(columns), types(columns)) == (expected, ["float32", "float32", "float64", "uint8", "int32"])
    assert values(read("a.ply", ply(form, LISTED))) == {"x": [1.5, 4.0], "y": [-2.0, 5.0]}


TWICE = "which another array gives, too; expected each column once"
PCD, PLY = pcd("ascii"), ply("ascii", VERTICES)


def packed(count, content, unfolded):
    head = PCD_HEAD.format(count=count, data="binary_compressed").encode()
    return head + struct.pack("<II", len(content), unfolded) + content


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("0.bin", ROWS.tobytes()[:-3], r"29 bytes are 1 points of 16 bytes .* and 13 bytes more"),
        ("0.npy", np.zeros((2, 6)), r"rows of 6 numbers; expected 3 or 4 .*; name them with `fields`"),
        ("0.e57", b"ASTM", r"expected one of \.pcd \.ply \.las \.laz \.bin \.npz \.npy"),
        ("a.npz", {"points": np.array([{"x": 1}], object)}, "Python objects, which are never loaded"),
        ("a.npz", {"points": np.ones((5, 3), "f4"), "intensity": np.ones(4, "f4"), "time": np.array([1.0])},
         r"a\.npz: intensity: 4 numbers for 5 points; expected one per point"),
        ("a.npz", {"range_image": np.ones((4, 5, 3), "f4")},
         r"holds range_image \(4, 5, 3\); expected arrays of numbers with a row per point"),
        ("a.npz", {"points": ROWS, "xyz": 2 * ROWS[:, :3]}, TWICE),
        ("a.npz", {"points": ROWS, "intensity": ROWS[:, 0]}, TWICE),
        ("a.pcd", PCD.replace(b"FIELDS", b"FELDS"), "line 3: 'FELDS'; expected one of"),
        ("a.pcd", PCD.replace(b"SIZE 4 4", b"SIZE 4"), "SIZE: 5 entries; expected 6"),
        ("a.pcd", PCD.replace(b"SIZE 4", b"SIZE 3"), "F3 for 'x'"),
        ("a.pcd", PCD.replace(b"POINTS 2", b"POINTS 3"), "POINTS: 3; WIDTH times HEIGHT is 2"),
        ("a.pcd", PCD.replace(b"POINTS 2", b"POINTS -2"), "POINTS: '-2'; expected a whole number"),
        ("a.pcd", PCD.replace(b"POINTS 2", b"POINTS 999999999999"), "WIDTH times HEIGHT is 2"),
        ("a.pcd", PCD.replace(b"DATA ascii", b"DATA asci"), "'asci'; expected ascii, binary, binary_compressed"),
        ("a.pcd", PCD.replace(b"-2.0", b"two"), "line 12: .*two"),
        ("a.pcd", PCD.replace(b" 31 ", b" "), "line 13: 5 values; expected 6: x y z intensity ring t"),
        ("a.pcd", pcd("binary")[:-5], r"47 bytes of points; expected 52: 2 points of 26 bytes"),
        ("a.pcd", packed(1_000_000, bytes(10), 26_000_000), "10 bytes that unfold to 26000000"),
        ("a.pcd", packed(2, b"\xe0" + bytes(53), 52), "damaged"),
        ("a.ply", PLY.replace(b"ply\n", b"plx\n"), "does not begin with `ply`"),
        ("a.ply", PLY.replace(b"format ascii", b"format asci"), "line 2"),
        ("a.ply", PLY.replace(b"property float x", b"property floot x"), "line 5: 'property floot x'"),
        ("a.ply", PLY.replace(b"element vertex", b"element corner"), "elements: corner; expected one .* called vertex"),
        ("a.ply", PLY.replace(b"vertex 2", b"vertex 3"), "2 lines of vertex; expected 3"),
        ("a.ply", PLY.replace(b"vertex 2", b"vertex 99999999999"), "99999999999 points"),
        ("a.ply", PLY.replace(b"end_header", b"end_hedder"), "without `end_header`"),
        ("a.ply", PLY.replace(b"4.0 ", b""), "line 12: 4 values; expected 5"),
        ("a.ply", ply("binary_big_endian", VERTICES)[:-1], r"41 bytes of vertex; expected 42: 2 of 21 bytes"),
    ],
)  # fmt: skip
def test_what_is_no_cloud_is_refused_with_its_location(read, name, content, problem):
    with pytest.raises(DataError, match=problem):
        read(name, **content) if isinstance(content, dict) else read(name, content)


START_NS = 1_700_000_000_123_456_789


def some_points(count=500, *, at=(0.0, 0.0, 0.0)):
    random = np.random.default_rng(4)
    return WrittenPoints(
        random.uniform(-50, 50, (count, 3)) + at,
        random.integers(0, 256, (count, 3)).astype(np.uint8),
        random.integers(0, 256, count).astype(np.uint8),
        START_NS + np.arange(count) * 1000,
        random.choice([0, 7, 255, 300, NO_LABEL], count).astype(np.uint16),
        {"camera": random.integers(0, 255, count).astype(np.uint8)},
    )


NEAR, FAR = some_points(), some_points(at=(450_000.0, 5_400_000.0, 300.0))


def written(path, points):
    columns = (points.positions_world, points.colors, points.intensities, points.timestamps_ns, points.labels)
    with open_cloud_writer(path) as writer:
        for chosen in (slice(0, 123), slice(123, None)):
            extras = {name: column[chosen] for name, column in points.extras.items()}
            writer.add(WrittenPoints(*(column[chosen] for column in columns), extras))
    return path


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_is_read_by_laspy_as_it_was_written(tmp_path, suffix):
    with laspy.open(written(tmp_path / f"map{suffix}", FAR)) as file:
        header, read = file.header, file.read()
    assert (header.version, header.point_format.id, header.point_count) == ("1.4", 7, len(FAR))
    np.testing.assert_allclose(np.asarray(read.xyz), FAR.positions_world, atol=0.00051)
    ends = [FAR.positions_world.min(axis=0), FAR.positions_world.max(axis=0)]
    np.testing.assert_allclose([header.mins, header.maxs], ends, atol=0.00051)
    wide = np.column_stack([FAR.colors, FAR.intensities]).astype(np.uint16) * 257
    assert (np.stack([read.red, read.green, read.blue, read.intensity], axis=1) == wide).all()
    np.testing.assert_allclose(read.gps_time, FAR.timestamps_ns * 1e-9, rtol=0, atol=3e-7)
    known = np.where(FAR.labels <= 255, FAR.labels, 0)
    found = np.stack([read.label, read.classification, read.camera])
    assert (found == [FAR.labels, known, FAR.extras["camera"]]).all()


def test_ply_is_read_by_trimesh_as_it_was_written(tmp_path):
    read = trimesh.load(written(tmp_path / "map.ply", FAR), process=False)
    assert (np.asarray(read.vertices) == FAR.positions_world).all()
    assert (read.colors[:, :3] == FAR.colors).all()
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    assert (data["label"] == FAR.labels).all()
    assert (data["camera"] == FAR.extras["camera"]).all()
    np.testing.assert_allclose(data["time"], FAR.timestamps_ns * 1e-9, rtol=0, atol=3e-7)


def test_pcd_is_read_by_pypcd4_as_it_was_written_and_far_from_zero_counts_from_whole_metres_in_its_head(tmp_path):
    read = PointCloud.from_path(written(tmp_path / "near.pcd", NEAR))
    np.testing.assert_allclose(read.numpy(("x", "y", "z")), NEAR.positions_world, atol=1e-5)
    assert (PointCloud.decode_rgb(read.pc_data["rgb"]) == NEAR.colors).all()
    assert (read.pc_data["label"] == NEAR.labels).all()
    assert (read.pc_data["intensity"] == NEAR.intensities).all()
    path = written(tmp_path / "far.pcd", FAR)
    origin = path.read_bytes().split(b"\n")[1].decode().split(" from ")[1].split(",")[0].split()
    read = PointCloud.from_path(path).numpy(("x", "y", "z"))
    np.testing.assert_allclose(read + np.array(origin, float), FAR.positions_world, atol=1e-4)


@pytest.mark.parametrize("suffix", [".las", ".laz", ".ply", ".pcd"])
def test_our_readers_read_what_we_write_also_of_no_points_and_of_one(tmp_path, suffix):
    cloud = read_cloud(written(tmp_path / f"map{suffix}", NEAR))
    assert cloud.count == len(NEAR)
    positions = np.stack([cloud.columns[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(positions, NEAR.positions_world, atol=0.00051)
    np.testing.assert_allclose(cloud.columns["time"], NEAR.timestamps_ns * 1e-9, rtol=0, atol=3e-7)
    assert (cloud.columns["label"] == NEAR.labels).all()
    with open_cloud_writer(tmp_path / f"none{suffix}"):
        pass
    assert read_cloud(tmp_path / f"none{suffix}").count == 0
    with open_cloud_writer(tmp_path / f"one{suffix}") as writer:
        writer.add(WrittenPoints(np.array([[1.0, 2.0, 3.0]])))
    one = read_cloud(tmp_path / f"one{suffix}")
    assert [one.columns[axis].tolist() for axis in "xyz"] == [[1.0], [2.0], [3.0]]


def test_an_unknown_suffix_and_an_output_that_exists_are_refused_and_a_broken_write_leaves_nothing(tmp_path):
    with pytest.raises(DataError), open_cloud_writer(tmp_path / "map.las") as writer:
        writer.add(some_points(3))
        raise DataError("drive", "", "a sweep cannot be read")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "map.ply").touch()
    for name, error, problem in (
        ("map.xyz", OptionError, r"'\.xyz'; expected one of \.las \.laz \.ply \.pcd"),
        ("map.ply", OutputError, "exists already"),
    ):
        with pytest.raises(error, match=problem):
            open_cloud_writer(tmp_path / name).__enter__()


COLOURS = ("red", "green", "blue")
XYZ = {axis: np.array([1.0, 2.0, 3.0], np.float32) for axis in "xyz"}
CLOCK = SweepClock(timestamp_ns=1_532_402_927_647_951_001, start_ns=1_532_402_927_597_951_001, zero_ns=7)


def mapped(columns, mapping=None):
    count = len(next(iter(columns.values())))
    return points_of(Cloud(Path("a.pcd"), count, columns), mapping or PointMapping(), CLOCK)


def test_names_are_found_whatever_their_case_points_without_a_return_dropped_and_arrays_read_only():
    columns = {axis: np.array([1, -2, 3], np.int16) for axis in "XYZ"}
    columns["Reflectivity"] = np.array([9, 8, 7], np.uint8)
    # which goes to other processes
    points = mapped(columns, pickle.loads(pickle.dumps(PointMapping(scale=IntensityScale(255.0))))).points
    assert (points.positions.dtype, points.positions[1].tolist()) == (np.float32, [-2, -2, -2])
    assert points.intensities.tolist() == [9, 8, 7]
    x = np.array([1.0, np.nan, 0.0, np.inf, 2.0], np.float32)
    found = mapped({"x": x, "y": x, "z": x, "ring": np.arange(5, dtype=np.uint8), "other": np.arange(5)})
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
    found = mapped({**XYZ, "intensity": values}, PointMapping(scale=IntensityScale(maximum)))
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
        found = mapped({**XYZ, "t": values}, mapping).points.timestamps_ns.tolist()
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
    assert mapped({**XYZ, **columns}).points.colors.tolist() == colors


def test_what_means_nothing_or_is_of_another_kind_is_kept():
    further = dict.fromkeys(COLOURS, np.array([0.0, 0.5, 1.0])) | {"ring": np.array([0.0, 1.5, 2.0])}
    further["near_ir"] = np.array([5, 6, 7], np.uint16)
    points = mapped({**XYZ, **further}).points
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
        mapped(columns, mapping)
