"""Clouds that other programs wrote: pypcd4 for PCD, trimesh for PLY."""

import numpy as np
import pytest

from sceneloom.formats.clouds import read_cloud

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
