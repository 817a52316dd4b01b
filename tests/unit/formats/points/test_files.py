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


def test_plain_bin_files_are_read_as_kittis(tmp_path):
    (tmp_path / "0.bin").write_bytes(ROWS.tobytes())
    columns = read_cloud(tmp_path / "0.bin").columns
    assert np.stack([*columns.values()], axis=1).tolist() == ROWS.tolist()
    assert [*columns] == ["x", "y", "z", "intensity"]


def test_bin_files_with_nuscenes_ending_have_rings(tmp_path):
    (tmp_path / "0.pcd.bin").write_bytes(np.arange(10, dtype="<f4").tobytes())
    assert read_cloud(tmp_path / "0.pcd.bin").columns["ring"].tolist() == [4, 9]


def test_a_layout_names_types_and_padding(tmp_path):
    layout = parse_layout(["x", "y", "z", "_:uint8", "ring:uint16", "t:uint64"], default="float64")
    record = np.dtype([("p", "<f8", 3), ("pad", "u1"), ("ring", "<u2"), ("t", "<u8")])
    content = np.array([((1, 2, 3), 255, 40, 2**63 + 1)], record).tobytes()
    (tmp_path / "0.bin").write_bytes(content)
    columns = read_cloud(tmp_path / "0.bin", layout=layout).columns
    assert {name: column.tolist() for name, column in columns.items()} == {
        "x": [1.0],
        "y": [2.0],
        "z": [3.0],
        "ring": [40],
        "t": [2**63 + 1],
    }


@pytest.mark.parametrize("fields", [["x:floot32"], ["x", "x"], ["x y"], []])
def test_a_layout_that_is_none_is_refused(fields):
    with pytest.raises(OptionError):
        parse_layout(fields)


def test_a_bin_file_has_to_be_whole_points(tmp_path):
    (tmp_path / "0.bin").write_bytes(ROWS.tobytes()[:-3])
    with pytest.raises(DataError, match=r"29 bytes are 1 points of 16 bytes .* and 13 bytes more"):
        read_cloud(tmp_path / "0.bin")


@pytest.mark.parametrize("name", ["points", "positions", "xyz"])
def test_rows_of_an_npz_file_are_cut_into_columns(tmp_path, name):
    np.savez_compressed(tmp_path / "0.npz", **{name: ROWS}, ring=np.array([1, 2]), session=np.arange(7))
    cloud = read_cloud(tmp_path / "0.npz")
    assert cloud.columns["intensity"].tolist() == [0.5, 0.25]
    assert cloud.columns["ring"].tolist() == [1, 2]
    assert "session" not in cloud.columns, "an array of another length says nothing of the points"


def test_columns_of_an_npz_file_are_taken_by_name(tmp_path):
    np.savez(tmp_path / "0.npz", x=ROWS[:, 0], y=ROWS[:, 1], z=ROWS[:, 2])
    assert read_cloud(tmp_path / "0.npz").columns["z"].tolist() == [3.0, 6.0]


def test_npy_files_hold_rows_or_named_fields(tmp_path):
    np.save(tmp_path / "0.npy", np.asfortranarray(ROWS.astype(">f8")))
    assert read_cloud(tmp_path / "0.npy").columns["x"].tolist() == [1.0, -4.0]
    named = np.array([(1, 2, 3, 9)], [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "u1")])
    np.save(tmp_path / "1.npy", named)
    assert read_cloud(tmp_path / "1.npy").columns["ring"].tolist() == [9]


def test_rows_of_unknown_width_ask_for_their_fields(tmp_path):
    np.save(tmp_path / "0.npy", np.zeros((2, 6)))
    with pytest.raises(DataError, match=r"rows of 6 numbers; expected 3 or 4 .*; name them with `fields`"):
        read_cloud(tmp_path / "0.npy")


def test_pickled_objects_are_never_loaded(tmp_path):
    np.savez(tmp_path / "0.npz", points=np.array([{"x": 1}], object))
    with pytest.raises(DataError, match="Python objects, which are never loaded"):
        read_cloud(tmp_path / "0.npz")


def test_other_endings_are_refused_with_the_known_ones(tmp_path):
    (tmp_path / "0.e57").write_bytes(b"ASTM")
    with pytest.raises(DataError, match=r"expected one of \.pcd \.ply \.las \.laz \.bin \.npz \.npy"):
        read_cloud(tmp_path / "0.e57")


def test_a_column_that_is_too_short_is_refused_and_not_left_out(tmp_path):
    np.savez(tmp_path / "a.npz", points=np.ones((5, 3), "f4"), intensity=np.ones(4, "f4"), time=np.array([1.0]))
    with pytest.raises(DataError, match=r"a\.npz: intensity: 4 numbers for 5 points; expected one per point"):
        read_cloud(tmp_path / "a.npz")


def test_what_an_npz_file_holds_instead_of_points_is_reported_with_its_shape(tmp_path):
    np.savez(tmp_path / "a.npz", range_image=np.ones((4, 5, 3), "f4"))
    with pytest.raises(
        DataError, match=r"holds range_image \(4, 5, 3\); expected arrays of numbers with a row per point"
    ):
        read_cloud(tmp_path / "a.npz")


@pytest.mark.parametrize("other", [{"xyz": 2 * ROWS[:, :3]}, {"intensity": ROWS[:, 0]}])
def test_two_arrays_that_give_one_column_are_refused(tmp_path, other):
    np.savez(tmp_path / "0.npz", points=ROWS, **other)
    with pytest.raises(DataError, match="which another array gives, too; expected each column once"):
        read_cloud(tmp_path / "0.npz")


def test_rows_whose_brightness_is_left_out_go_with_an_array_of_it(tmp_path):
    np.savez(tmp_path / "0.npz", points=ROWS, intensity=ROWS[:, 0])
    cloud = read_cloud(tmp_path / "0.npz", layout=parse_layout(["x", "y", "z", "_"]))
    assert cloud.columns["intensity"].tolist() == [1.0, -4.0]


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


def rows(points: WrittenPoints, chosen: slice) -> WrittenPoints:
    columns = (points.colors, points.intensities, points.timestamps_ns, points.labels)
    extras = {name: column[chosen] for name, column in points.extras.items()}
    return WrittenPoints(points.positions_world[chosen], *(c[chosen] for c in columns), extras)


def written(path: Path, points: WrittenPoints) -> Path:
    with open_cloud_writer(path) as writer:
        writer.add(rows(points, slice(0, 123)))
        writer.add(rows(points, slice(123, None)))
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
def test_our_readers_read_what_we_write(tmp_path, suffix):
    points = some_points()
    cloud = read_cloud(written(tmp_path / f"map{suffix}", points))
    assert cloud.count == len(points)
    np.testing.assert_allclose(
        np.stack([cloud.columns[axis] for axis in "xyz"], axis=1), points.positions_world, atol=0.00051
    )
    np.testing.assert_allclose(cloud.columns["time"], points.timestamps_ns * 1e-9, rtol=0, atol=3e-7)
    assert (cloud.columns["label"] == points.labels).all()


@pytest.mark.parametrize("suffix", [".las", ".laz", ".ply", ".pcd"])
def test_a_cloud_of_no_points_and_one_of_one_are_files(tmp_path, suffix):
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
    def write_half() -> None:
        with open_cloud_writer(tmp_path / "map.las") as writer:
            writer.add(some_points(3))
            raise DataError("drive", "", "a sweep cannot be read")

    with pytest.raises(DataError):
        write_half()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_any_bytes_are_read_or_refused_with_a_reason(tmp_path, suffix):
    whole = written(tmp_path / f"map{suffix}", some_points(40)).read_bytes()
    random = np.random.default_rng(0)
    damaged = [whole[:n] for n in range(0, len(whole), max(1, len(whole) // 40))]
    for _ in range(60):
        flipped = bytearray(whole)
        flipped[random.integers(0, min(500, len(whole)))] ^= 1 << random.integers(0, 8)
        damaged.append(bytes(flipped))
    refused = 0
    for number, content in enumerate(damaged):
        path = tmp_path / f"{number}{suffix}"
        path.write_bytes(content)
        try:
            read_cloud(path)
        except DataError:
            refused += 1
    assert refused > 20
