"""Clouds in files: made by hand after the formats' descriptions, written and read by other programs, and as scenes."""

import pickle
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from pypcd4 import PointCloud

import sceneloom
from sceneloom.errors import DataError, OptionError, OutputError, UnknownFormatError, UnknownOptionError
from sceneloom.formats.base.losses import Support
from sceneloom.formats.base.registry import find_format, open_scene, write_scene
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
from sceneloom.formats.points.reader import numbers_of_names, stem_of, times_of_names
from sceneloom.pipeline.converting import convert
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, PointsFrame, Poses, Scene, Trajectory

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


def test_bin_files_are_read_as_kittis_or_nuscenes_or_as_a_layout_says_and_those_of_numpy_by_name(read):
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
    # columns of npz and npy files are taken by name, and rows cut into columns
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


def test_copc_is_read_by_laspy_whole_in_part_and_coarsely(tmp_path):
    # a surface of 150,000 points, and more in one location than a cube holds
    grid = np.stack(np.meshgrid(np.arange(500.0), np.arange(300.0)), axis=-1).reshape(-1, 2) / 10
    positions = np.concatenate([np.c_[grid, np.sin(grid[:, 0])], np.tile([60.0, 5.0, 1.0], (60_000, 1))])
    positions += [450_000.0, 5_400_000.0, 300.0]
    count = len(positions)
    labels = np.arange(count).astype(np.uint16)
    path = tmp_path / "map.copc.laz"
    with open_cloud_writer(path) as writer:
        for chosen in np.array_split(np.random.default_rng(0).permutation(count), 5):
            writer.add(WrittenPoints(positions[chosen], None, None, 1_000_000_000 * chosen, labels[chosen]))
    assert [one.name for one in tmp_path.iterdir()] == ["map.copc.laz"]

    def xyz(record):
        return np.stack([record.x, record.y, record.z], axis=1)

    with laspy.CopcReader.open(str(path)) as reader:
        info, read = reader.copc_info, reader.query()
        found = xyz(read)
        assert (info.gps_min, info.gps_max) == (0.0, count - 1.0)
        order = np.argsort(read.gps_time)
        np.testing.assert_allclose(found[order], positions, atol=0.00051)
        assert (np.asarray(read.label)[order] == labels).all()
        assert np.abs(found - info.center).max() <= info.halfsize
        # a window holds what lies in it
        least, most = np.array([450_010.0, 5_400_005.0, 0.0]), np.array([450_012.0, 5_400_008.0, 400.0])
        inside = ((found >= least) & (found <= most)).all(axis=1)
        assert len(reader.query(bounds=laspy.copc.Bounds(least, most))) == inside.sum() > 500
        # the root has a point in each of its cells that has any
        coarse = xyz(reader.query(level=0))
        coarse_cells, cells = (
            np.unique((points - info.center + info.halfsize) // info.spacing, axis=0) for points in (coarse, found)
        )
        assert len(coarse) == len(coarse_cells) == len(cells) < count / 10
    with laspy.open(path) as file:
        assert file.header.number_of_points_by_return[0] == count


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


@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz", ".ply", ".pcd"])
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


def test_no_octree_is_made_of_points_whose_write_ended_with_an_error(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr("sceneloom.formats.points.files.write_copc", lambda *paths: made.append(paths))
    with pytest.raises(DataError), open_cloud_writer(tmp_path / "map.copc.laz") as writer:
        writer.add(some_points(3))
        raise DataError("drive", "", "a sweep cannot be read")
    assert made == list(tmp_path.iterdir()) == []


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


def test_brightness_is_scaled_rounded_and_clipped_and_its_scale_distinguished_from_the_values():
    for values, maximum, expected, clipped in (
        (np.array([0.0, 0.5, 1.0], np.float32), 1.0, [0, 128, 255], 0),
        (np.array([0.0, 99.4, 300.0], np.float32), 255.0, [0, 99, 255], 1),
        (np.array([0, 257, 65535], np.uint16), 65535.0, [0, 1, 255], 0),
        (np.array([np.nan, -1.0, np.inf], np.float32), 100.0, [0, 0, 255], 2),
    ):
        found = mapped({**XYZ, "intensity": values}, PointMapping(scale=IntensityScale(maximum)))
        assert (found.points.intensities.tolist(), found.clipped) == (expected, clipped)
    found = [
        detect_scale(np.array(values, dtype))
        for values, dtype in (
            ([0.0, 0.99], "f4"), ([0.0, 255.0], "f4"), ([3.0, np.nan, 4000.0], "f8"), ([1], "u2"), ([1000], "u2"),
            ([1], "u1"), ([1e6], "f8"),
        )
    ]  # fmt: skip
    assert found == [*map(IntensityScale, (1.0, 255.0, 65535.0, 255.0, 65535.0, 255.0)), None]


def test_times_count_from_what_they_are_relative_to_and_lose_no_nanosecond_and_what_cannot_be_points_is_refused():
    absolute = np.array([CLOCK.timestamp_ns + offset for offset in (0, 1, 99_999_999)], np.uint64)
    for unit, values, offsets_ns in (
        ("seconds", np.array([0.0, 0.05, 0.1]), [0, 50_000_000, 100_000_000]),
        ("microseconds", np.array([-3, 0, 50_000], np.int32), [-3_000, 0, 50_000_000]),
        ("milliseconds", np.array([0.0, 0.25, 100.0], np.float32), [0, 250_000, 100_000_000]),
        ("nanoseconds", absolute, absolute.tolist()),
    ):
        bases = {"clock": 7} if values is absolute else {"timestamp": CLOCK.timestamp_ns, "start": CLOCK.start_ns}
        for relative_to, base_ns in bases.items():
            mapping = PointMapping(times=PointTimes(unit, relative_to, "t"))
            found = mapped({**XYZ, "t": values}, mapping).points.timestamps_ns.tolist()
            assert found == [base_ns + offset for offset in offsets_ns]
    seconds = PointMapping(times=PointTimes("seconds", "timestamp", "t"))
    for columns, mapping, problem in (
        ({**XYZ, "t": np.array([0, 50_000_000, 100_000_000], np.uint32)}, seconds,
         r't\[1\]: 50000000 seconds .*unit = "nanoseconds", relative_to = "timestamp"'),
        ({**XYZ, "t": np.array([0.0, 0.1, np.nan])}, seconds, r"t\[2\]: nan"),
        (XYZ, PointMapping(named={"intensity": "reflex"}),
         "reflex: no such column for intensity; the file has x y z"),
        ({name: XYZ[name] for name in "xy"}, PointMapping(), "no column for z; the file has x y"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=problem):
            mapped(columns, mapping)


def test_colours_of_one_or_two_bytes_each_or_packed_are_taken_and_what_is_of_another_kind_kept():
    packed = np.array([0x00112233, 0xFF0000FF, 0], np.uint32)
    for columns, colors in (
        *(({"rgb": packed.view(dtype)}, [[0x11, 0x22, 0x33], [0, 0, 0xFF], [0, 0, 0]]) for dtype in ("<u4", "<f4")),
        ({name: np.array([k, 0, 255], np.uint8) for k, name in enumerate(COLOURS)},
         [[0, 1, 2], [0, 0, 0], [255, 255, 255]]),
        # of 16 bits, also where their writer put bytes into them
        (dict.fromkeys(COLOURS, np.array([0, 257, 65535], np.uint16)), [[0] * 3, [1] * 3, [255] * 3]),
        (dict.fromkeys(COLOURS, np.array([0, 128, 255], np.uint16)), [[0] * 3, [128] * 3, [255] * 3]),
    ):  # fmt: skip
        assert mapped({**XYZ, **columns}).points.colors.tolist() == colors
    further = dict.fromkeys(COLOURS, np.array([0.0, 0.5, 1.0])) | {"ring": np.array([0.0, 1.5, 2.0])}
    further["near_ir"] = np.array([5, 6, 7], np.uint16)
    points = mapped({**XYZ, **further}).points
    assert (points.colors, points.rings) == (None, None)
    found = {name: column.tolist() for name, column in points.extras.items()}
    assert found == {name: column.tolist() for name, column in further.items()}


RNG = np.random.default_rng(11)
COUNT = 400
TIMESTAMPS = (1_700_000_000_000_000_001, 1_700_000_000_100_000_003)
ENDINGS = {"kitti-bin": ".bin", "nuscenes-bin": ".pcd.bin"}
HOLD_ALL = ("pcd", "ply", "las", "laz", "npz")
ROUNDED = {"las": 1.3e-5, "laz": 1.3e-5}
"""LAS rounds to steps of 0.01 mm, and float32 of 80 m to 8 µm."""


def points(timestamp_ns, *, extras=None):
    return LidarPoints(
        positions=RNG.uniform(-80, 80, (COUNT, 3)).astype(np.float32),
        intensities=RNG.integers(0, 256, COUNT).astype(np.uint8),
        colors=RNG.integers(0, 256, (COUNT, 3)).astype(np.uint8),
        timestamps_ns=timestamp_ns + RNG.integers(0, 100_000_000, COUNT),
        rings=RNG.integers(0, 128, COUNT).astype(np.uint16),
        camera_index=RNG.integers(0, 3, COUNT).astype(np.uint8),
        extras=extras or {},
    )


def scene_of(frames, **fields):
    return Scene((LidarSensor("lidar", LazyFrames.of(frames, [frame.timestamp_ns for frame in frames]), **fields),))


@pytest.fixture
def scene():
    extras = {"range": RNG.uniform(0, 80, COUNT), "echo": RNG.integers(0, 3, COUNT).astype(np.int8)}
    return scene_of([LidarFrame(timestamp, points(timestamp, extras=extras)) for timestamp in TIMESTAMPS])


def same(frames, expected, *, tolerance=0.0):
    for frame, other in zip(frames, expected, strict=True):
        found, known = frame.points, other.points
        np.testing.assert_allclose(found.positions, known.positions, rtol=0, atol=tolerance)
        for name in ("intensities", "colors", "timestamps_ns", "rings", "camera_index"):
            np.testing.assert_array_equal(getattr(found, name), getattr(known, name), err_msg=name)
        for name, values in known.extras.items():
            assert found.extras[name].dtype == values.dtype
            np.testing.assert_array_equal(found.extras[name], values)


@pytest.mark.parametrize("kind", HOLD_ALL)
def test_a_folder_of_clouds_gives_back_all_that_its_points_bear_also_in_other_processes(tmp_path, scene, kind):
    losses = write_scene(scene, tmp_path / "clouds", format=kind)
    with open_scene(tmp_path / "clouds") as found:
        assert found.format == kind
        assert found.lidars[0].frames.timestamps_ns.tolist() == list(TIMESTAMPS)
        for frames in (found.lidars[0].frames, pickle.loads(pickle.dumps(found.lidars[0].frames))):
            same(frames, scene.lidars[0].frames, tolerance=ROUNDED.get(kind, 0.0))
    if kind in ROUNDED:
        (loss,) = losses
        assert loss.support is Support.APPROXIMATED
        assert 0 < loss.largest_error <= 0.5e-5 + 1e-12
    else:
        assert not losses


def test_pcd_files_of_every_encoding_hold_the_same_and_become_another_kind_without_loss(tmp_path, scene):
    for encoding in ("ascii", "binary", "binary_compressed"):
        first, second = tmp_path / encoding, tmp_path / f"{encoding} as ply"
        write_scene(scene, first, format="pcd", encoding=encoding)
        report = convert(first, second, to="ply", strict=True)
        assert not [support for support in report.fields if support.support in {Support.APPROXIMATED, Support.DROPPED}]
        for folder in (first, second):
            same(open_scene(folder).lidars[0].frames, scene.lidars[0].frames)


# KITTI counts brightness from 0 to 1, nuScenes from 0 to 255
@pytest.mark.parametrize(("kind", "columns", "full"), [("kitti-bin", 4, 1.0), ("nuscenes-bin", 5, 255.0)])
def test_packed_files_hold_the_locations_and_the_brightness_and_what_they_leave_out_is_reported(
    tmp_path, scene, kind, columns, full
):
    losses = write_scene(scene, tmp_path / "clouds", format=kind)
    rows = np.fromfile(tmp_path / "clouds" / f"{TIMESTAMPS[0]}{ENDINGS[kind]}", "<f4").reshape(-1, columns)
    expected = scene.lidars[0].frames[0].points
    np.testing.assert_array_equal(rows[:, :3], expected.positions)
    np.testing.assert_allclose(rows[:, 3], expected.intensities * (full / 255.0), rtol=1e-6)
    left = {"timestamps_ns", "colors", "camera_index", "extras.range", "extras.echo"}
    if kind == "nuscenes-bin":
        np.testing.assert_array_equal(rows[:, 4], expected.rings)
    else:
        left.add("rings")
    assert {loss.field.removeprefix("sensors[lidar].frames.points.") for loss in losses} == left
    assert {(loss.support, loss.count) for loss in losses} == {(Support.DROPPED, 2)}
    found = open_scene(tmp_path / "clouds").lidars[0].frames[0].points
    np.testing.assert_array_equal(found.positions, expected.positions)
    np.testing.assert_array_equal(found.intensities, expected.intensities)


@pytest.mark.parametrize("kind", [*HOLD_ALL, *ENDINGS])
def test_a_scene_of_one_frame_is_written_to_a_file(tmp_path, kind):
    one = scene_of([LidarFrame(0, replace(points(0), timestamps_ns=None))])
    target = tmp_path / f"one{ENDINGS.get(kind, f'.{kind}')}"
    write_scene(one, target, format=kind)
    assert find_format(target).name == kind
    found = open_scene(target).lidars[0].frames[0]
    assert found.timestamp_ns == 0
    np.testing.assert_allclose(found.points.positions, one.lidars[0].frames[0].points.positions, atol=1.3e-5)


def test_points_are_written_in_the_frame_that_is_asked_for_or_with_the_trajectory_of_the_ego_that_they_are_on(tmp_path):
    # a quarter rotation to the left at (10, 0, 0): what lies ahead of the sensor lies to the left in the world
    half = np.sqrt(0.5)
    timestamps = np.array(TIMESTAMPS)
    poses = Poses(timestamps, np.array([[10.0, 0.0, 0.0], [20.0, 0.0, 0.0]]), np.array([[0.0, 0.0, half, half]] * 2))
    ahead = LidarPoints(np.array([[5.0, 0.0, 0.0]], np.float32))
    frames = [LidarFrame(timestamp, ahead) for timestamp in TIMESTAMPS]
    one = scene_of(frames, poses=poses)
    write_scene(one, tmp_path / "world", format="ply", frame="world")
    found = open_scene(tmp_path / "world", points_frame="world").lidars[0]
    assert found.points_frame is PointsFrame.WORLD
    locations = [frame.points.positions[0] for frame in found.frames]
    np.testing.assert_allclose(locations, [[10, 5, 0], [20, 5, 0]], atol=1e-5)
    write_scene(one, tmp_path / "sensor", format="ply", frame="sensor")
    back = open_scene(tmp_path / "sensor").lidars[0]
    assert back.points_frame is PointsFrame.SENSOR
    np.testing.assert_array_equal(back.poses.timestamps_ns, timestamps)
    np.testing.assert_array_equal(back.poses.positions, poses.positions)
    # asked for at times of its own, a path gives its rotations normalised: the last digit may differ
    np.testing.assert_allclose(back.poses.quaternions_xyzw, poses.quaternions_xyzw, rtol=0, atol=1e-15)
    vio = Trajectory("vio", timestamps, np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([[0.0, 0, 0, 1]] * 2))
    on_ego = replace(scene_of(frames, points_frame=PointsFrame.EGO, poses=vio.poses), trajectories={"vio": vio})
    write_scene(on_ego, tmp_path / "ego", format="pcd")
    with open_scene(tmp_path / "ego") as found:
        assert found.lidars[0].points_frame is PointsFrame.EGO
        (trajectory,) = found.trajectories.values()
        np.testing.assert_array_equal(trajectory.positions, vio.positions)


def test_several_lidars_are_folders_of_their_own_and_frames_of_one_time_keep_their_order_which_is_reported(tmp_path):
    lidars = [LidarSensor(name, LazyFrames.of([LidarFrame(7, points(7))], [7])) for name in ("top left", "rear/1")]
    assert not write_scene(Scene(tuple(lidars)), tmp_path / "o", format="npz")
    found = {lidar.id: lidar.frames for lidar in open_scene(tmp_path / "o").lidars}
    assert set(found) == {"top left", "rear/1"}
    for lidar in lidars:
        same(found[lidar.id], lidar.frames)
    frames = [LidarFrame(5, points(5)) for _ in range(3)]
    (loss,) = write_scene(scene_of(frames), tmp_path / "p", format="pcd")
    assert (loss.support, loss.count, loss.largest_error) == (Support.APPROXIMATED, 2, 2.0)
    for one, other in zip(open_scene(tmp_path / "p").lidars[0].frames, frames, strict=True):
        np.testing.assert_array_equal(one.points.positions, other.points.positions)


def test_brightness_beyond_bytes_is_kept_beside_them_and_goes_on_to_other_kinds(tmp_path):
    rows = RNG.uniform(0, 1, (COUNT, 4)).astype(np.float32)
    (tmp_path / "in").mkdir()
    rows.tofile(tmp_path / "in" / "000000.bin")
    read = open_scene(tmp_path / "in")
    frame = read.lidars[0].frames[0]
    np.testing.assert_array_equal(frame.points.extras["intensity"], rows[:, 3])
    np.testing.assert_array_equal(frame.points.intensities, np.rint(rows[:, 3].astype(np.float64) * 255))
    write_scene(read, tmp_path / "out.ply")
    found = open_scene(tmp_path / "out.ply").lidars[0].frames[0].points
    np.testing.assert_array_equal(found.extras["intensity"], rows[:, 3])
    # and large coordinates are put on an origin near them
    corner = np.array([500_000.0, 5_400_000.0, 200.0])
    header = laspy.LasHeader(version="1.2", point_format=0)
    header.offsets, header.scales = corner, np.full(3, 0.001)
    file = laspy.LasData(header)
    file.xyz = corner + np.rint(RNG.uniform(0, 100, (COUNT, 3)) * 1000) / 1000
    file.write(str(tmp_path / "tile.las"))
    with open_scene(tmp_path / "tile.las") as scene:
        lidar = scene.lidars[0]
        assert "cloud-origin" in {warning.code for warning in scene.warnings}
        world = lidar.frames[0].points.positions.astype(np.float64) + lidar.poses.positions[0]
        # float32 of 50 m is exact to 4 µm
        np.testing.assert_allclose(world, np.asarray(file.xyz), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        ("1700000000000000001 1700000000100000003", list(TIMESTAMPS)),
        ("-0000000000000000005 0000000000000000007", [-5, 7]),
        ("-0000000000000000003", [-3]),
        ("1700000000.5 1700000000.6", [1_700_000_000_500_000_000, 1_700_000_000_600_000_000]),
        ("1700000000_000000001 1700000000_100000003", list(TIMESTAMPS)),
        ("a__LIDAR_TOP__1532402927647951", [1_532_402_927_647_951_000]),
        ("pc-1532402927647", [1_532_402_927_647_000_000]),
        ("0.1 0.25", [100_000_000, 250_000_000]),
        *((names, None) for names in ("000000 000001", "0000000005", "cloud", "1700000000 cloud")),
    ],
)
def test_names_that_are_times_are_distinguished_from_numbers(names, times):
    assert times_of_names(names.split()) == times


@pytest.fixture
def numbered(tmp_path):
    """Makes a folder with files of such names."""

    def make(*names):
        (tmp_path / "data").mkdir()
        for name in names:
            RNG.uniform(0, 1, (4, 4)).astype("<f4").tofile(tmp_path / "data" / f"{name}.bin")
        return tmp_path / "data"

    return make


def test_numbered_files_are_taken_at_ten_hertz_and_that_is_reported(numbered):
    assert numbers_of_names(["frame_000007", "frame_000009"]) == [7, 9]
    assert numbers_of_names(["a_1", "b_1"]) is None
    assert stem_of("x__1.pcd.bin") == "x__1"
    folder = numbered("000000", "000001", "000003")
    for options, times_ns, assumed in (
        ({}, [0, 100_000_000, 300_000_000], {"cloud-times-assumed", "cloud-frame-assumed"}),
        ({"rate_hz": 20.0}, [0, 50_000_000, 150_000_000], {"cloud-frame-assumed"}),
    ):
        scene = open_scene(folder, **options)
        assert scene.lidars[0].frames.timestamps_ns.tolist() == times_ns
        codes = {warning.code for warning in scene.warnings}
        assert codes & {"cloud-times-assumed", "cloud-frame-assumed"} == assumed
    # a list of times beside the files counts, and times are all different
    (folder / "000003.bin").unlink()
    times = folder.parent / "timestamps.txt"
    times.write_text("2011-09-26 13:02:25.5\n2011-09-26 13:02:25.600000001\n")
    assert np.diff(open_scene(folder).lidars[0].frames.timestamps_ns).tolist() == [100_000_001]
    times.write_text("2011-09-26 13:02:25.5\n")
    with pytest.raises(DataError, match="1 times for 2 files"):
        open_scene(folder)
    assert len(open_scene(folder, lenient=True).lidars[0].frames) == 1
    times.unlink()
    for file, name in zip(sorted(folder.iterdir()), ("a_1.5.bin", "b_1.5.bin"), strict=True):
        file.rename(folder / name)
    with pytest.raises(DataError, match="have the same time"):
        open_scene(folder)


def test_folders_with_other_files_or_two_kinds_and_other_bin_files_are_reported_to_be_no_clouds(
    tmp_path, scene, numbered
):
    folder = numbered("000000", "000001")
    (folder / "image.png").write_bytes(b"x")
    with pytest.raises(UnknownFormatError, match=r"2 .*\.bin.* but 'image.png', too"):
        open_scene(folder)
    assert len(open_scene(folder, format="kitti-bin").lidars[0].frames) == 2
    write_scene(scene, tmp_path / "o", format="pcd")
    write_scene(scene, tmp_path / "p", format="ply")
    shutil.copy(next((tmp_path / "p").iterdir()), tmp_path / "o")
    with pytest.raises(UnknownFormatError, match=r"more than one reader claims this: pcd, .*; ply, "):
        open_scene(tmp_path / "o")
    for content in (b"", bytes(17), np.arange(64, dtype="<i4").tobytes()):
        (tmp_path / "a.bin").write_bytes(content)
        with pytest.raises(UnknownFormatError, match="does not begin so" if content else "it is empty"):
            open_scene(tmp_path / "a.bin")


def test_a_file_that_is_torn_is_named_and_left_out_leniently_and_the_folder_recognised(tmp_path, scene):
    write_scene(scene, tmp_path / "o", format="laz")
    torn = tmp_path / "o" / f"{TIMESTAMPS[1]}.laz"
    torn.write_bytes(torn.read_bytes()[:-200])
    strict = open_scene(tmp_path / "o")
    with pytest.raises(DataError, match=f"{TIMESTAMPS[1]}.laz: points: the table of chunks is at byte"):
        strict.lidars[0].frames[1]
    lenient = open_scene(tmp_path / "o", lenient=True)
    assert lenient.lidars[0].frames.timestamps_ns.tolist() == [TIMESTAMPS[0]]
    assert [n.count for n in lenient.warnings if n.code == "unreadable-files"] == [1]
    write_scene(scene, tmp_path / "p", format="ply")
    (tmp_path / "p" / f"{TIMESTAMPS[0] - 5}.ply").touch()
    assert find_format(tmp_path / "p").name == "ply"
    with pytest.raises(DataError, match=r"does not begin with `ply`"):
        open_scene(tmp_path / "p")
    assert len(open_scene(tmp_path / "p", lenient=True).lidars[0].frames) == 2


def test_options_that_do_not_count_and_targets_that_cannot_be_are_refused(tmp_path, scene):
    rows = RNG.uniform(-9, 9, (7, 4)).astype(np.float32)
    np.save(tmp_path / "rows.npy", rows)
    one = open_scene(tmp_path / "rows.npy")
    np.testing.assert_array_equal(one.lidars[0].frames[0].points.positions, rows[:, :3])
    for source, name, error, problem, options in (
        (scene, "o", UnknownOptionError, ".", {"format": "pcd", "profile": "scale"}),
        (scene, "o", OptionError, ".", {"format": "pcd", "frame": "moon"}),
        (scene, "o", OptionError, ".", {"format": "pcd", "encoding": "zip"}),
        (scene, "o", OptionError, ".", {"format": "pcd", "lidar": "none"}),
        (scene, "one.pcd", OptionError, "one file for 2 frames", {}),
        (one, "out.npy", OptionError, r"written as \.npz only", {"format": "npz"}),
    ):
        with pytest.raises(error, match=problem):
            write_scene(source, tmp_path / name, **options)
    assert [path.name for path in tmp_path.iterdir()] == ["rows.npy"]
    write_scene(scene, tmp_path / "o", format="pcd")
    with pytest.raises(OutputError):
        write_scene(scene, tmp_path / "o", format="pcd")
    for options in ({"points_frame": "moon"}, {"rate_hz": 0.0}):
        with pytest.raises(OptionError):
            open_scene(tmp_path / "o", **options)


COLORS = np.array([[255, 255, 255], [255, 255, 255], [10, 20, 30], [1, 2, 3]], np.uint8)
SEEN_BY = np.array([255, 0, 1, 255], np.uint8)
"""A point that no camera saw, a white wall, another point, and a colour that came from elsewhere."""
GREY = [[128, 128, 128], *COLORS[1:].tolist()]


def colours_in(columns):
    if "rgb" in columns:
        packed = columns["rgb"].view(np.uint32)
        return np.column_stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255]).tolist()
    if "colors" in columns:
        return columns["colors"].tolist()
    found = np.column_stack([columns[name] for name in ("red", "green", "blue")])
    return (found // 257 if found.dtype == np.uint16 else found).tolist()


@pytest.mark.parametrize("suffix", [".sfs", ".ply", ".pcd", ".las", ".laz", ".npz", ".mcap", ".bag", ".ros2"])
def test_points_that_no_camera_saw_are_grey_in_files_with_a_column_that_says_so_and_white_again_in_the_model(
    tmp_path, suffix
):
    points = LidarPoints(np.eye(4, 3, dtype=np.float32) + 1, colors=COLORS, camera_index=SEEN_BY)
    poses = Poses([0], [[0, 0, 0]], [[0, 0, 0, 1]], static=True)
    frames = LazyFrames.of([LidarFrame(10**9, points)], [10**9])
    fused = Scene((LidarSensor("top", frames, poses=poses, points_frame=PointsFrame.WORLD),))
    path = tmp_path / f"cloud{suffix}"
    sceneloom.write(fused, path)
    with sceneloom.open(path) as scene:
        found = scene.lidars[0].frames[0].points
        assert (found.colors.tolist(), found.camera_index.tolist()) == (COLORS.tolist(), SEEN_BY.tolist())
    if suffix[1:] in HOLD_ALL:
        columns = read_cloud(path).columns
        assert (colours_in(columns), columns["camera_index"].tolist()) == (GREY, SEEN_BY.tolist())
    if suffix == ".mcap":
        reader = pytest.importorskip("mcap.reader")
        with path.open("rb") as file:
            messages = [(schema.name, one.data) for schema, _, one in reader.make_reader(file).iter_messages()]
        assert bytes([128, 128, 128]) in b"".join(data for name, data in messages if name == "foxglove.PointCloud")
