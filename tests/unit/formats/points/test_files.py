"""Clouds in files: read, and written in chunks and read by other programs."""

from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from pypcd4 import PointCloud

from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.points.cloud import NO_LABEL, WrittenPoints, parse_layout
from sceneloom.formats.points.files import open_cloud_writer, read_cloud

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


def test_plain_bin_files_are_read_as_kittis_or_nuscenes(read):
    columns = read("0.bin", ROWS.tobytes())
    assert np.stack([*columns.values()], axis=1).tolist() == ROWS.tolist()
    assert [*columns] == ["x", "y", "z", "intensity"]
    assert read("0.pcd.bin", np.arange(10, dtype="<f4").tobytes())["ring"].tolist() == [4, 9]


def test_a_layout_names_types_and_padding(read):
    layout = parse_layout(["x", "y", "z", "_:uint8", "ring:uint16", "t:uint64"], default="float64")
    record = np.dtype([("p", "<f8", 3), ("pad", "u1"), ("ring", "<u2"), ("t", "<u8")])
    columns = read("0.bin", np.array([((1, 2, 3), 255, 40, 2**63 + 1)], record).tobytes(), layout)
    found = {name: column.tolist() for name, column in columns.items()}
    assert found == {"x": [1.0], "y": [2.0], "z": [3.0], "ring": [40], "t": [2**63 + 1]}
    for fields in (["x:floot32"], ["x", "x"], ["x y"], []):
        with pytest.raises(OptionError):
            parse_layout(fields)


@pytest.mark.parametrize("name", ["points", "positions", "xyz"])
def test_rows_of_an_npz_file_are_cut_into_columns(read, name):
    columns = read("0.npz", ring=np.array([1, 2]), session=np.arange(7), **{name: ROWS})
    assert columns["intensity"].tolist() == [0.5, 0.25]
    assert columns["ring"].tolist() == [1, 2]
    assert "session" not in columns, "an array of another length says nothing of the points"


def test_columns_of_npz_and_npy_files_are_taken_by_name(read):
    assert read("0.npz", x=ROWS[:, 0], y=ROWS[:, 1], z=ROWS[:, 2])["z"].tolist() == [3.0, 6.0]
    assert read("0.npy", np.asfortranarray(ROWS.astype(">f8")))["x"].tolist() == [1.0, -4.0]
    named = np.array([(1, 2, 3, 9)], [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "u1")])
    assert read("1.npy", named)["ring"].tolist() == [9]
    # rows whose brightness is left out go with an array of it
    columns = read("2.npz", layout=parse_layout(["x", "y", "z", "_"]), points=ROWS, intensity=ROWS[:, 0])
    assert columns["intensity"].tolist() == [1.0, -4.0]


TWICE = "which another array gives, too; expected each column once"


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
    ],
)  # fmt: skip
def test_what_is_no_cloud_is_refused(read, name, content, problem):
    with pytest.raises(DataError, match=problem):
        read(name, **content) if isinstance(content, dict) else read(name, content)


START_NS = 1_700_000_000_123_456_789


def some_points(count: int = 500, *, at=(0.0, 0.0, 0.0)) -> WrittenPoints:
    random = np.random.default_rng(4)
    return WrittenPoints(
        random.uniform(-50, 50, (count, 3)) + at,
        random.integers(0, 256, (count, 3)).astype(np.uint8),
        random.integers(0, 256, count).astype(np.uint8),
        START_NS + np.arange(count) * 1000,
        random.choice([0, 7, 255, 300, NO_LABEL], count).astype(np.uint16),
        {"camera": random.integers(0, 255, count).astype(np.uint8)},
    )


def written(path: Path, points: WrittenPoints) -> Path:
    columns = (points.positions_world, points.colors, points.intensities, points.timestamps_ns, points.labels)
    with open_cloud_writer(path) as writer:
        for chosen in (slice(0, 123), slice(123, None)):
            extras = {name: column[chosen] for name, column in points.extras.items()}
            writer.add(WrittenPoints(*(column[chosen] for column in columns), extras))
    return path


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_is_read_by_laspy_as_it_was_written(tmp_path, suffix):
    points = some_points(at=(450_000.0, 5_400_000.0, 300.0))
    with laspy.open(written(tmp_path / f"map{suffix}", points)) as file:
        header, read = file.header, file.read()
    assert (header.version, header.point_format.id, header.point_count) == ("1.4", 7, len(points))
    np.testing.assert_allclose(np.asarray(read.xyz), points.positions_world, atol=0.00051)
    np.testing.assert_allclose(header.mins, points.positions_world.min(axis=0), atol=0.00051)
    np.testing.assert_allclose(header.maxs, points.positions_world.max(axis=0), atol=0.00051)
    colors = np.stack([read.red, read.green, read.blue], axis=1)
    assert (colors == points.colors.astype(np.uint16) * 257).all()
    assert (read.intensity == points.intensities.astype(np.uint16) * 257).all()
    np.testing.assert_allclose(read.gps_time, points.timestamps_ns * 1e-9, rtol=0, atol=3e-7)
    assert (read.label == points.labels).all()
    known = np.where(points.labels <= 255, points.labels, 0)
    assert (np.asarray(read.classification) == known).all()
    assert (read.camera == points.extras["camera"]).all()


def test_ply_is_read_by_trimesh_as_it_was_written(tmp_path):
    points = some_points(at=(450_000.0, 5_400_000.0, 300.0))
    read = trimesh.load(written(tmp_path / "map.ply", points), process=False)
    assert (np.asarray(read.vertices) == points.positions_world).all()
    assert (read.colors[:, :3] == points.colors).all()
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    assert (data["label"] == points.labels).all()
    assert (data["camera"] == points.extras["camera"]).all()
    np.testing.assert_allclose(data["time"], points.timestamps_ns * 1e-9, rtol=0, atol=3e-7)


def test_pcd_is_read_by_pypcd4_as_it_was_written(tmp_path):
    points = some_points()
    read = PointCloud.from_path(written(tmp_path / "map.pcd", points))
    np.testing.assert_allclose(read.numpy(("x", "y", "z")), points.positions_world, atol=1e-5)
    assert (PointCloud.decode_rgb(read.pc_data["rgb"]) == points.colors).all()
    assert (read.pc_data["label"] == points.labels).all()
    assert (read.pc_data["intensity"] == points.intensities).all()


def test_pcd_far_from_zero_counts_from_whole_metres_that_its_head_names(tmp_path):
    points = some_points(at=(450_000.0, 5_400_000.0, 300.0))
    path = written(tmp_path / "map.pcd", points)
    line = path.read_bytes().split(b"\n")[1].decode()
    origin = np.array(line.split(" from ")[1].split(",")[0].split(), float)
    read = PointCloud.from_path(path).numpy(("x", "y", "z"))
    np.testing.assert_allclose(read + origin, points.positions_world, atol=1e-4)


@pytest.mark.parametrize("suffix", [".las", ".laz", ".ply", ".pcd"])
def test_our_readers_read_what_we_write_also_of_no_points_and_of_one(tmp_path, suffix):
    points = some_points()
    cloud = read_cloud(written(tmp_path / f"map{suffix}", points))
    assert cloud.count == len(points)
    positions = np.stack([cloud.columns[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(positions, points.positions_world, atol=0.00051)
    np.testing.assert_allclose(cloud.columns["time"], points.timestamps_ns * 1e-9, rtol=0, atol=3e-7)
    assert (cloud.columns["label"] == points.labels).all()
    with open_cloud_writer(tmp_path / f"none{suffix}"):
        pass
    assert read_cloud(tmp_path / f"none{suffix}").count == 0
    with open_cloud_writer(tmp_path / f"one{suffix}") as writer:
        writer.add(WrittenPoints(np.array([[1.0, 2.0, 3.0]])))
    one = read_cloud(tmp_path / f"one{suffix}")
    assert [one.columns[axis].tolist() for axis in "xyz"] == [[1.0], [2.0], [3.0]]


def test_an_unknown_suffix_and_an_output_that_exists_are_refused(tmp_path):
    with pytest.raises(OptionError, match=r"'\.xyz'; expected one of \.las \.laz \.ply \.pcd"):
        open_cloud_writer(tmp_path / "map.xyz").__enter__()
    (tmp_path / "map.ply").touch()
    with pytest.raises(OutputError, match="exists already"):
        open_cloud_writer(tmp_path / "map.ply").__enter__()


def test_a_broken_write_leaves_nothing(tmp_path):
    with pytest.raises(DataError), open_cloud_writer(tmp_path / "map.las") as writer:
        writer.add(some_points(3))
        raise DataError("drive", "", "a sweep cannot be read")
    assert list(tmp_path.iterdir()) == []
