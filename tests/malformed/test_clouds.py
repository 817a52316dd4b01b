"""Whatever bytes a cloud is made of: it is read, or refused with one of our errors."""

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.malformed.damage import flipped

from sceneloom.errors import DataError
from sceneloom.formats import open_scene
from sceneloom.formats.points.cloud import FieldLayout
from sceneloom.formats.points.files import read_cloud
from sceneloom.formats.points.mapping import PointMapping, PointTimes, SweepClock, points_of

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
    runs = b"".join(bytes([len(columns[k : k + 32]) - 1]) + columns[k : k + 32] for k in range(0, len(columns), 32))
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
LAYOUT = FieldLayout.parse(["x", "y", "z", "intensity:uint8", "t:uint32"])
MAPPING = PointMapping(times=PointTimes("nanoseconds"))


def read(path: Path, content: bytes) -> bool:
    """Read a cloud as a lidar's points; report whether that went well."""
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
    return request.param


def test_a_file_is_read_and_one_that_is_cut_filled_up_or_counts_otherwise_is_read_or_refused(tmp_path, name):
    content = FILES[name]
    assert read(tmp_path / name, content)
    whole = [cut for cut in range(len(content)) if read(tmp_path / name, content[:cut])]
    # without its last line's end, or its last digits; a whole number of records; the archive's directory comes last
    assert all(cut > len(content) - 3 or cut % LAYOUT.dtype.itemsize == 0 for cut in whole)
    if not name.endswith(("bin", "npz")):  # zeros and blanks that fill a file up are no points
        for filling in (b"\n", b"\0" * 4000):
            assert read(tmp_path / name, content + (filling if "text" not in name else b"\n"))
    heads = {"pcd": (b"WIDTH 2", b"POINTS 2"), "ply": (b"element vertex 2",)}.get(name[-3:], ())
    for count in (b"0", b"1") if heads else ():  # points that the head does not count are not left out in silence
        changed = content
        for head in heads:
            assert head in changed
            changed = changed.replace(head, head[:-1] + count)
        assert not read(tmp_path / name, changed)


@pytest.mark.few(3)
def test_a_file_with_any_byte_flipped_is_read_or_refused(tmp_path, name):
    content = FILES[name]
    for location in range(0, len(content), 2 if name.endswith("npz") else 1):
        for flip in (0x01, 0xF0):
            read(tmp_path / name, flipped(content, location, flip))


@pytest.mark.parametrize("value", [b"0", b"-1", b"99999999999999999999", b"1e3", b"", b"nan", b"x" * 300])
def test_any_number_of_a_head_may_be_wrong(tmp_path, name, value):
    content = FILES[name]
    stop = content.find(b"DATA") if name.endswith("pcd") else content.find(b"end_header")
    for location in range(max(stop, 0)):
        if content[location : location + 1].isdigit():
            read(tmp_path / name, content[:location] + value + content[location + 1 :])


def test_folders_and_missing_files_are_refused(tmp_path):
    for suffix in ("pcd", "ply", "bin", "npz", "npy"):
        (tmp_path / f"a.{suffix}").mkdir()
        for path in (tmp_path / f"a.{suffix}", tmp_path / f"none.{suffix}"):
            with pytest.raises(DataError, match="cannot be read"):
                read_cloud(path)


@settings(max_examples=60)
@given(junk=st.binary(max_size=200), name=st.sampled_from(sorted(FILES)))
def test_any_bytes_are_read_or_refused(tmp_path_factory, junk, name):
    path = tmp_path_factory.mktemp("junk") / name
    read(path, junk)
    read(path, FILES[name][:40] + junk)


def las(path: Path, version: str = "1.4") -> bytes:
    """A file of 300 points, packed where its name ends so."""
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version=version, point_format=6 if version == "1.4" else 3)
    header.scales = np.full(3, 0.001)
    points = laspy.LasData(header)
    points.x = points.y = points.z = np.arange(300) / 7.0
    points.write(str(path))
    assert read_cloud(path).count == 300
    return path.read_bytes()


def refused(path: Path, content: bytes, reported: str) -> None:
    path.write_bytes(content)
    with pytest.raises(DataError, match=reported):
        read_cloud(path)


def with_number(content: bytes, form: str, location: int, *values: float) -> bytes:
    changed = bytearray(content)
    struct.pack_into(form, changed, location, *values)
    return bytes(changed)


def test_no_byte_of_a_table_of_chunks_ends_the_process(tmp_path):
    whole = las(tmp_path / "whole.laz")
    start = struct.unpack_from("<I", whole, 96)[0]
    table = struct.unpack_from("<q", whole, start)[0]
    locations = [start, start + 7, *range(table, len(whole))]
    for location, bit in ((location, bit) for location in locations for bit in range(8)):
        read(tmp_path / "changed.laz", flipped(whole, location, 1 << bit))
    many = with_number(whole, "<I", table + 4, 1_851_981_824)
    refused(tmp_path / "many.laz", many, rf"byte {table + 4}: 1851981824 chunks; expected")
    for count in (0, 50_001, 2**28):  # of the header, which does not agree with the table
        content = with_number(with_number(whole, "<Q", 247, count), "<I", 107, 0)
        refused(tmp_path / "changed.laz", content, "its 1 chunks hold 1 to 50000|bytes that unpack to")
    for layer in range(9):  # what unpacks one makes room for as many bytes as are declared
        content = with_number(whole, "<I", start + 8 + 30 + 4 + 4 * layer, 1 << 31)
        refused(tmp_path / "changed.laz", content, f"byte {start + 8}: layers of more bytes than their chunk")


LAS_FAULTS = [
    ("<I", 96, 1 << 31, "points begin at byte 2147483648; expected"),
    ("<I", 96, 100, "points begin at byte 100; expected"),  # in the header
    ("<I", 96, 400, "is the file cut off?"),  # a byte late
    ("<I", 100, 2**32 - 1, "4294967295 records of variable length"),
    ("<B", 104, 63, "point format 63; expected 0 to 10"),
    ("<H", 105, 12, "points of 12 bytes; expected"),
    ("<H", 105, 35, "is the file cut off?"),  # points a byte too long
    ("<d", 131, 0.0, "scale of x is 0.0; expected"),
    ("<d", 139, float("nan"), "scale of y is nan; expected"),
    ("<d", 147, 1e308, "scale of z is 1e[+]308; expected"),
    ("<d", 131, 1e-300, "scale of x is 1e-300; expected"),
    ("<d", 155, float("inf"), "offset of x is inf; expected"),
    ("<d", 163, -1e308, "offset of y is -1e[+]308; expected"),
]
COUNTS = [
    (0, "behind the last of 0 points"),
    (299, "behind the last of 299 points"),
    (301, "is the file cut off?"),
    (2**32 - 1, "4294967295 points; expected 0 to"),
]


@pytest.mark.parametrize(("version", "form", "at"), [("1.2", "<I", 107), ("1.4", "<Q", 247)])
def test_a_las_header_that_does_not_agree_with_the_content_is_refused(tmp_path, version, form, at):
    whole = las(tmp_path / "whole.las", version)
    for *number, reported in [*LAS_FAULTS, *((form, at, *count) for count in COUNTS)]:
        refused(tmp_path / "changed.las", with_number(whole, *number), reported)


def test_no_number_of_a_las_header_loses_points_in_silence(tmp_path):
    whole = las(tmp_path / "whole.las", "1.2")
    known = read_cloud(tmp_path / "whole.las").columns["x"]
    for location in range(94, 227):
        for value in (0, 1, 0x7F, 0xFF):
            (tmp_path / "changed.las").write_bytes(with_number(whole, "<B", location, value))
            try:
                cloud = read_cloud(tmp_path / "changed.las")
            except DataError:
                continue
            assert cloud.count == 300
            moved = np.abs(cloud.columns["x"] - known).max()
            # two steps are what bounds are rounded by
            assert moved < 0.002 or "other_bounds" in cloud.head
    (tmp_path / "moved.las").write_bytes(with_number(whole, "<d", 131, 0.01))
    with open_scene(tmp_path / "moved.las") as scene:
        (reported,) = [warning.message for warning in scene.warnings if warning.code == "other-bounds"]
    assert "x by 384.426 m" in reported


def test_records_and_bytes_behind_the_points_are_refused_but_for_zeros(tmp_path):
    whole = las(tmp_path / "whole.las")
    for start, count in ((len(whole) - 10, 1), (0, 1), (len(whole), 2**32 - 1)):
        refused(tmp_path / "changed.las", with_number(whole, "<QI", 235, start, count), "extended record")
    whole = las(tmp_path / "whole.las", "1.2")
    (tmp_path / "padded.las").write_bytes(whole + bytes(100))
    assert read_cloud(tmp_path / "padded.las").count == 300
    refused(tmp_path / "changed.las", whole + b"\0\0\1", "3 bytes behind the last of 300 points")
