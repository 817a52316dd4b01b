"""Clouds that other programs wrote and read: pypcd4 for PCD, trimesh for PLY, laspy for LAS and LAZ.

Open3D reads PCD and PLY, too, where `SCENELOOM_OPEN3D_PYTHON` names a Python that has it.
"""

import laspy
import numpy as np
import pytest
from tests.peers import python_with

from sceneloom.errors import DataError
from sceneloom.formats.base.registry import open_scene, write_scene
from sceneloom.formats.points.files import read_cloud
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, Scene

pypcd4 = pytest.importorskip("pypcd4")
trimesh = pytest.importorskip("trimesh")

RNG = np.random.default_rng(5)
COUNT = 5_000


@pytest.mark.parametrize("encoding", ["ASCII", "BINARY", "BINARY_COMPRESSED"])
def test_pcd_files_of_pypcd4_are_read_exactly(tmp_path, encoding):
    names = ("x", "y", "z", "intensity", "ring", "timestamp", "label")
    types = (np.float32, np.float32, np.float32, np.float32, np.uint16, np.float64, np.int8)
    arrays = [
        *RNG.normal(scale=30.0, size=(3, COUNT)).astype(np.float32),
        np.repeat(np.float32([0.0, 255.0]), COUNT // 2),  # long runs, so that the packer refers back
        RNG.integers(0, 128, COUNT).astype(np.uint16),
        1.5e9 + RNG.uniform(0, 0.1, COUNT),
        RNG.integers(-100, 100, COUNT).astype(np.int8),
    ]
    written = pypcd4.PointCloud.from_points(arrays, names, types)
    written.save(tmp_path / "a.pcd", encoding=pypcd4.Encoding[encoding])
    columns = read_cloud(tmp_path / "a.pcd").columns
    for name, array in zip(names, arrays, strict=True):
        assert columns[name].dtype == array.dtype
        if encoding == "ASCII":
            # it writes ten digits after the point; the eighth is the last that float32 has
            np.testing.assert_allclose(columns[name], array, rtol=1e-7, atol=1e-9)
        else:
            np.testing.assert_array_equal(columns[name], array)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply_files_of_trimesh_are_read_exactly(tmp_path, encoding):
    corners = RNG.normal(scale=30.0, size=(COUNT, 3)).astype(np.float32)
    faces = RNG.integers(0, COUNT, (40, 3))
    colors = RNG.integers(0, 256, (COUNT, 4)).astype(np.uint8)
    mesh = trimesh.Trimesh(corners, faces, vertex_colors=colors, process=False)
    content = mesh.export(file_type="ply", encoding=encoding.split("_")[0])
    (tmp_path / "a.ply").write_bytes(content)
    columns = read_cloud(tmp_path / "a.ply").columns
    # as text it writes eight digits after the point
    np.testing.assert_allclose(np.stack([columns[a] for a in "xyz"], axis=1), corners, rtol=0, atol=1e-6)
    found = np.stack([columns[name] for name in ("red", "green", "blue", "alpha")], axis=1)
    np.testing.assert_array_equal(found, colors)


def written_by_us(folder, kind, **options):
    timestamp_ns = 1_700_000_000_000_000_000
    points = LidarPoints(
        positions=RNG.normal(scale=30.0, size=(COUNT, 3)).astype(np.float32),
        intensities=RNG.integers(0, 256, COUNT).astype(np.uint8),
        colors=RNG.integers(0, 256, (COUNT, 3)).astype(np.uint8),
        timestamps_ns=timestamp_ns + RNG.integers(0, 10**8, COUNT),
        rings=np.repeat(np.arange(50), COUNT // 50).astype(np.uint16),
        extras={"range": RNG.uniform(0, 90, COUNT)},
    )
    lidar = LidarSensor("lidar", LazyFrames.of([LidarFrame(timestamp_ns, points)], [timestamp_ns]))
    write_scene(Scene((lidar,)), folder, format=kind, **options)
    return points, next(iter(folder.iterdir()))


def same_measurements(found, points):
    np.testing.assert_array_equal(found["intensity"], points.intensities)
    np.testing.assert_array_equal(found["ring"], points.rings)
    np.testing.assert_array_equal(found["range"], points.extras["range"])
    np.testing.assert_array_equal(found["offset_ns"], points.timestamps_ns - 1_700_000_000_000_000_000)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pypcd4_reads_our_pcd_files(tmp_path, encoding):
    points, file = written_by_us(tmp_path / "o", "pcd", encoding=encoding)
    found = pypcd4.PointCloud.from_path(file)
    columns = {name: found.pc_data[name] for name in found.fields}
    locations = np.stack([columns[axis] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(locations, points.positions)
    same_measurements(columns, points)
    np.testing.assert_array_equal(pypcd4.PointCloud.decode_rgb(columns["rgb"]), points.colors)


def test_trimesh_reads_our_ply_files(tmp_path):
    points, file = written_by_us(tmp_path / "o", "ply")
    found = trimesh.load(file)
    np.testing.assert_array_equal(np.asarray(found.vertices, np.float32), points.positions)
    np.testing.assert_array_equal(np.asarray(found.colors)[:, :3], points.colors)
    same_measurements(found.metadata["_ply_raw"]["vertex"]["data"], points)


OPEN3D = """
import json, sys
import numpy as np
import open3d as o3d
cloud = o3d.io.read_point_cloud(sys.argv[1])
table = o3d.t.io.read_point_cloud(sys.argv[1]).point
fields = {name: table[name].numpy().ravel().tolist() for name in table if name in ("intensity", "ring")}
colors = np.rint(np.asarray(cloud.colors) * 255).astype(int)
print(json.dumps({"points": np.asarray(cloud.points).tolist(), "colors": colors.tolist(), "fields": fields}))
"""


@pytest.mark.parametrize(
    ("kind", "options"),
    [*(("pcd", {"encoding": one}) for one in ("ascii", "binary", "binary_compressed")), ("ply", {})],
)
def test_open3d_reads_our_pcd_and_ply_files(tmp_path, ask, kind, options):
    python = python_with("open3d", "SCENELOOM_OPEN3D_PYTHON")
    points, file = written_by_us(tmp_path / "o", kind, **options)
    found = ask(python, OPEN3D, file)
    np.testing.assert_array_equal(np.array(found["points"], np.float32), points.positions)
    np.testing.assert_array_equal(found["colors"], points.colors)
    assert found["fields"]["intensity"] == points.intensities.tolist()
    # it skips columns of 16 bits in PLY files, and says so
    assert found["fields"].get("ring") == (None if kind == "ply" else points.rings.tolist())


@pytest.mark.parametrize("kind", ["las", "laz"])
def test_laspy_reads_our_las_files(tmp_path, kind):
    points, file = written_by_us(tmp_path / "o", kind)
    found = laspy.read(file)
    # whole steps of 0.01 mm
    np.testing.assert_allclose(found.xyz, points.positions, rtol=0, atol=0.5e-5 + 1e-9)
    columns = {name: np.asarray(found[name]) for name in ("ring", "range", "offset_ns")}
    same_measurements({**columns, "intensity": found.intensity // 257}, points)
    colors = np.stack([found.red, found.green, found.blue], axis=1)
    np.testing.assert_array_equal(colors // 257, points.colors)
    content = file.read_bytes()
    for part in (0.1, 0.5, 0.95):  # one that breaks off is an error with its name
        file.write_bytes(content[: int(len(content) * part)])
        with pytest.raises(DataError) as caught:
            open_scene(tmp_path / "o")
        assert file.name in caught.value.file


@pytest.mark.parametrize("kind", ["las", "laz"])
@pytest.mark.parametrize("point_format", [0, 1, 3, 6, 7, 8])
def test_las_files_of_laspy_are_read_in_every_point_format(tmp_path, kind, point_format):
    header = laspy.LasHeader(point_format=point_format, version="1.2" if point_format < 6 else "1.4")
    header.offsets, header.scales = [400_000, 5_000_000, 0], [0.001] * 3
    header.add_extra_dim(laspy.ExtraBytesParams("reflectance", np.float32))
    file = laspy.LasData(header)
    file.xyz = np.array([400_000, 5_000_000, 0]) + np.rint(RNG.uniform(0, 50_000, (COUNT, 3))) / 1000
    file.intensity, file.classification = RNG.integers(0, 2**16, COUNT), RNG.integers(0, 20, COUNT)
    file.reflectance = RNG.normal(size=COUNT)
    if point_format != 0 and point_format != 2:
        file.gps_time = 1.4e9 + np.sort(RNG.uniform(0, 1, COUNT))
    file.write(str(tmp_path / f"a.{kind}"))
    columns = read_cloud(tmp_path / f"a.{kind}").columns
    np.testing.assert_array_equal(np.stack([columns[a] for a in "xyz"], axis=1), file.xyz)
    for name in ("intensity", "classification", "reflectance"):
        np.testing.assert_array_equal(columns[name], np.asarray(file[name]))
    with open_scene(tmp_path / f"a.{kind}") as scene:
        frame = scene.lidars[0].frames[0]
        np.testing.assert_array_equal(frame.points.extras["intensity"], np.asarray(file.intensity))
        np.testing.assert_array_equal(frame.points.extras["reflectance"], np.asarray(file.reflectance))
        if "time" in columns:
            assert frame.timestamp_ns == round(1e9 * float(columns["time"].min()))
            np.testing.assert_allclose(frame.points.timestamps_ns, columns["time"] * 1e9, rtol=0, atol=300)
