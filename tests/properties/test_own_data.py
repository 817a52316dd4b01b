"""Clouds of any columns, frames of any tree and timestamps of any length come back as they were."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial.transform import Rotation

from sceneloom.formats.base.text_tables import parse_timestamp
from sceneloom.formats.points.cloud import TYPES, FieldLayout
from sceneloom.formats.points.files import read_cloud
from sceneloom.formats.rig.reader import Edge, FrameTree, NamePattern
from sceneloom.geometry.rigid import RigidTransform

PCD_TYPES = {"f": "F", "i": "I", "u": "U"}
PLY_TYPES = {"float32": "float", "float64": "double", "int8": "char", "int16": "short", "int32": "int"}
PLY_TYPES |= {"uint8": "uchar", "uint16": "ushort", "uint32": "uint"}
NAMES = ["x", "y", "z", "intensity", "ring", "t", "label"]


@st.composite
def records(draw, types=TYPES):
    chosen = draw(st.lists(st.sampled_from(types), min_size=1, max_size=len(NAMES)))
    dtype = np.dtype([(name, f"<{np.dtype(kind).str[1:]}") for name, kind in zip(NAMES, chosen, strict=False)])
    return draw(arrays.arrays(dtype, st.integers(0, 30)))


@pytest.fixture(scope="module")
def location(tmp_path_factory):
    return tmp_path_factory.mktemp("clouds")


@given(written=records(tuple(PLY_TYPES)), text=st.booleans(), order=st.sampled_from(["little", "big"]))
def test_clouds_in_bin_npy_pcd_and_ply_files_come_back_bit_by_bit(location, written, text, order):
    names, kinds = written.dtype.names, [written.dtype[name] for name in written.dtype.names]
    (location / "a.bin").write_bytes(written.tobytes())
    np.save(location / "a.npy", written)
    sizes, types = " ".join(str(kind.itemsize) for kind in kinds), " ".join(PCD_TYPES[kind.kind] for kind in kinds)
    head = f"FIELDS {' '.join(names)}\nSIZE {sizes}\nTYPE {types}\n"
    head += f"WIDTH {len(written)}\nHEIGHT 1\nDATA {'ascii' if text else 'binary'}\n"
    lines = "".join(" ".join(repr(value.item()) for value in row) + "\n" for row in written)
    (location / "a.pcd").write_bytes(head.encode() + (lines.encode() if text else written.tobytes()))
    properties = "".join(f"property {PLY_TYPES[kind.name]} {name}\n" for name, kind in zip(names, kinds, strict=True))
    head = f"ply\nformat binary_{order}_endian 1.0\nelement vertex {len(written)}\n{properties}end_header\n"
    rotated = written.astype(written.dtype.newbyteorder(">" if order == "big" else "<"))
    (location / "a.ply").write_bytes(head.encode() + rotated.tobytes())
    layout = FieldLayout.parse([f"{name}:{kind.name}" for name, kind in zip(names, kinds, strict=True)])
    for name in ("a.bin", "a.npy", "a.pcd", "a.ply"):
        columns = read_cloud(location / name, **({"layout": layout} if name == "a.bin" else {})).columns
        assert [*columns] == list(names)
        for column, kind in zip(columns, kinds, strict=True):
            np.testing.assert_array_equal(columns[column], written[column])
            assert columns[column].dtype == kind


@given(st.integers(-9 * 10**18, 9 * 10**18))
def test_timestamps_of_any_length_lose_no_nanosecond(timestamp_ns):
    sign, (whole, rest) = "-" if timestamp_ns < 0 else "", divmod(abs(timestamp_ns), 10**9)
    assert parse_timestamp(f"{sign}{whole}.{rest:09d}", "seconds") == timestamp_ns
    assert parse_timestamp(str(timestamp_ns), "nanoseconds") == timestamp_ns
    if timestamp_ns >= 0:
        assert NamePattern("a_{s}_{ns}").read(f"a_{whole}_{rest}.bin") == timestamp_ns
        assert NamePattern("*-{ns}").read(f"x1-2-{timestamp_ns}.png") == timestamp_ns


@given(data=st.data(), count=st.integers(1, 8), seed=st.integers(0, 2**32 - 1))
def test_frames_of_any_tree_are_where_the_product_of_their_matrices_says(data, count, seed):
    rng = np.random.default_rng(seed)
    ego_from = {0: np.eye(4)}
    edges = []
    for frame in range(1, count + 1):
        parent = data.draw(st.integers(0, frame - 1))
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
        ego_from[frame] = ego_from[parent] @ matrix
        forward = data.draw(st.booleans())
        transform = RigidTransform(matrix[:3, :3], matrix[:3, 3])
        pair = (str(frame), str(parent)) if forward else (str(parent), str(frame))
        edges.append(Edge(*pair, transform if forward else transform.inverse(), ""))
    tree = FrameTree("0", data.draw(st.permutations(edges)))
    for frame, matrix in ego_from.items():
        # up to eight products in float64
        np.testing.assert_allclose(tree.ego_from(str(frame)).matrix, matrix, atol=1e-12)
