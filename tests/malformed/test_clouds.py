"""Whatever bytes a cloud is made of: it is read, or refused with one of our errors."""

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneloom.errors import DataError
from sceneloom.formats.clouds import PointMapping, PointTimes, parse_layout, points_of, read_cloud
from sceneloom.formats.clouds.points import SweepClock

POINTS = np.array([(1.5, -2.0, 0.25, 7, 3), (4.0, 5.0, -6.0, 0, 1)], "<f4,<f4,<f4,<u1,<u4")
PCD_HEAD = (
    b"VERSION 0.7\nFIELDS x y z intensity t\nSIZE 4 4 4 1 4\nTYPE F F F U U\nCOUNT 1 1 1 1 1\nWIDTH 2\nHEIGHT 1\n"
    b"POINTS 2\nDATA "
)
PLY_HEAD = (
    "ply\nformat {form} 1.0\nelement face 1\nproperty list uchar int corners\nelement vertex 2\nproperty float x\n"
    "property float y\nproperty float z\nproperty uchar intensity\nproperty uint t\nend_header\n"
)
TEXT = b"1.5 -2 0.25 7 3\n4 5 -6 0 1\n"


def packed() -> bytes:
    columns = b"".join(np.ascontiguousarray(POINTS[name]).tobytes() for name in POINTS.dtype.names)
    runs = b"".join(
        bytes([len(columns[k : k + 32]) - 1]) + columns[k : k + 32] for k in range(0, len(columns), 32)
    )
    return struct.pack("<II", len(runs), len(columns)) + runs


def npz() -> bytes:
    file = io.BytesIO()
    np.savez(file, points=np.ones((2, 3), np.float32), t=np.array([1, 2]))
    return file.getvalue()


FILES = {
    "text.pcd": PCD_HEAD + b"ascii\n" + TEXT,
    "binary.pcd": PCD_HEAD + b"binary\n" + POINTS.tobytes(),
    "packed.pcd": PCD_HEAD + b"binary_compressed\n" + packed(),
    "text.ply": PLY_HEAD.format(form="ascii").encode() + b"3 0 1 0\n" + TEXT,
    "binary.ply": PLY_HEAD.format(form="binary_little_endian").encode()
    + struct.pack("<B3i", 3, 0, 1, 0)
    + POINTS.tobytes(),
    "plain.bin": POINTS.tobytes(),
    "arrays.npz": npz(),
}
LAYOUT = parse_layout(["x", "y", "z", "intensity:uint8", "t:uint32"])
MAPPING = PointMapping(times=PointTimes("nanoseconds"))


def read(path: Path, content: bytes) -> bool:
    """Read a cloud as a lidar's points; say whether that went well."""
    path.write_bytes(content)
    try:
        cloud = read_cloud(path, layout=LAYOUT if path.suffix == ".bin" else None)
        points = points_of(cloud, MAPPING, SweepClock(0, 0, 0)).points
    except DataError as error:
        named = error.file
    else:
        assert points.positions.shape == (len(points), 3)
        return True
    assert named == str(path)
    return False


@pytest.fixture(params=FILES)
def name(request):
    """Each kind of file."""
    return request.param


def test_the_file_itself_is_read(tmp_path, name):
    assert read(tmp_path / name, FILES[name])


def test_a_file_cut_anywhere_is_read_or_refused(tmp_path, name):
    content = FILES[name]
    whole = [cut for cut in range(len(content)) if read(tmp_path / name, content[:cut])]
    # without its last line's end, or its last digits; a whole number of records; the archive's directory comes last
    assert all(cut > len(content) - 3 or cut % LAYOUT.dtype.itemsize == 0 for cut in whole)


def test_a_file_with_any_byte_flipped_is_read_or_refused(tmp_path, name):
    content = FILES[name]
    for place in range(0, len(content), 2 if name.endswith("npz") else 1):
        for flip in (0x01, 0xF0):
            broken = bytearray(content)
            broken[place] ^= flip
            read(tmp_path / name, bytes(broken))


@pytest.mark.parametrize("value", [b"0", b"-1", b"99999999999999999999", b"1e3", b"", b"nan", b"x" * 300])
def test_any_number_of_a_head_may_be_wrong(tmp_path, name, value):
    content = FILES[name]
    stop = content.find(b"DATA") if name.endswith("pcd") else content.find(b"end_header")
    for place in range(max(stop, 0)):
        if content[place : place + 1].isdigit():
            read(tmp_path / name, content[:place] + value + content[place + 1 :])


@settings(max_examples=60)
@given(junk=st.binary(max_size=200), name=st.sampled_from(sorted(FILES)))
def test_any_bytes_are_read_or_refused(tmp_path_factory, junk, name):
    path = tmp_path_factory.mktemp("junk") / name
    read(path, junk)
    read(path, FILES[name][:40] + junk)


@pytest.mark.parametrize("suffix", ["pcd", "ply", "bin", "npz", "npy"])
def test_folders_and_missing_files_are_refused(tmp_path, suffix):
    (tmp_path / f"a.{suffix}").mkdir()
    for path in (tmp_path / f"a.{suffix}", tmp_path / f"none.{suffix}"):
        with pytest.raises(DataError, match="cannot be read"):
            read_cloud(path)


def laz(path: Path) -> bytes:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    points = laspy.LasData(header)
    points.x = points.y = points.z = np.arange(300) / 7.0
    points.write(str(path))
    return path.read_bytes()


def test_no_byte_of_a_table_of_chunks_ends_the_process(tmp_path):
    whole = laz(tmp_path / "whole.laz")
    assert read_cloud(tmp_path / "whole.laz").count == 300
    start = struct.unpack_from("<I", whole, 96)[0]
    table = struct.unpack_from("<q", whole, start)[0]
    places = [start, start + 7, *range(table, len(whole))]
    for place, bit in ((place, bit) for place in places for bit in range(8)):
        content = bytearray(whole)
        content[place] ^= 1 << bit
        read(tmp_path / "changed.laz", bytes(content))
    many = bytearray(whole)
    struct.pack_into("<I", many, table + 4, 1_851_981_824)
    (tmp_path / "many.laz").write_bytes(bytes(many))
    with pytest.raises(DataError, match=rf"byte {table + 4}: 1851981824 chunks; expected"):
        read_cloud(tmp_path / "many.laz")
