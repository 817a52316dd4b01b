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
    """A structured array of up to seven columns and thirty points."""
    chosen = draw(st.lists(st.sampled_from(types), min_size=1, max_size=len(NAMES)))
    dtype = np.dtype([(name, f"<{np.dtype(kind).str[1:]}") for name, kind in zip(NAMES, chosen, strict=False)])
    return draw(arrays.arrays(dtype, st.integers(0, 30)))


@pytest.fixture(scope="module")
def location(tmp_path_factory):
    return tmp_path_factory.mktemp("clouds")


def check(path, written):
    layout = FieldLayout.parse([f"{name}:{written.dtype[name].name}" for name in written.dtype.names])
    columns = read_cloud(path, **({"layout": layout} if path.suffix == ".bin" else {})).columns
    assert [*columns] == list(written.dtype.names)
    for name, column in columns.items():
        np.testing.assert_array_equal(column, written[name])
        assert column.dtype == written.dtype[name]


@given(written=records())
def test_bin_and_npy_files_come_back_bit_by_bit(location, written):
    (location / "a.bin").write_bytes(written.tobytes())
    np.save(location / "a.npy", written)
    for name in ("a.bin", "a.npy"):
        check(location / name, written)


@given(written=records(), text=st.booleans())
def test_pcd_files_come_back_bit_by_bit(location, written, text):
    kinds = [written.dtype[name] for name in written.dtype.names]
    sizes, types = " ".join(str(kind.itemsize) for kind in kinds), " ".join(PCD_TYPES[kind.kind] for kind in kinds)
    head = f"FIELDS {' '.join(written.dtype.names)}\nSIZE {sizes}\nTYPE {types}\n"
    head += f"WIDTH {len(written)}\nHEIGHT 1\nDATA {'ascii' if text else 'binary'}\n"
    lines = "".join(" ".join(repr(value.item()) for value in row) + "\n" for row in written)
    (location / "a.pcd").write_bytes(head.encode() + (lines.encode() if text else written.tobytes()))
    check(location / "a.pcd", written)


@given(written=records(tuple(PLY_TYPES)), order=st.sampled_from(["little", "big"]))
def test_ply_files_come_back_bit_by_bit(location, written, order):
    properties = "".join(f"property {PLY_TYPES[written.dtype[n].name]} {n}\n" for n in written.dtype.names)
    head = f"ply\nformat binary_{order}_endian 1.0\nelement vertex {len(written)}\n{properties}end_header\n"
    rotated = written.astype(written.dtype.newbyteorder(">" if order == "big" else "<"))
    (location / "a.ply").write_bytes(head.encode() + rotated.tobytes())
    check(location / "a.ply", written)


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
