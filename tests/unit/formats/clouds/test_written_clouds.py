"""Clouds written piece by piece, read by other people's programs."""

from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from pypcd4 import PointCloud

from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.points.cloud import NO_LABEL, WrittenPoints
from sceneloom.formats.points.files import open_cloud_writer, read_cloud

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
