"""PCD files, written here by hand from the format's description."""

import struct

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.points.files import read_cloud

HEAD = """# .PCD v0.7 - Point Cloud Data file format
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
POINTS = [(1.5, -2.0, 0.25, 7.0, 3, 1532402927647951000), (4.0, 5.0, -6.0, 0.5, 31, 1532402927647951001)]


def literal_lzf(content: bytes) -> bytes:
    """Pack bytes as LZF in the slow, obvious way: literal runs of up to 32 bytes, no back references."""
    runs = [content[k : k + 32] for k in range(0, len(content), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def pcd(data: str) -> bytes:
    head = HEAD.format(count=len(POINTS), data=data).encode()
    if data == "ascii":
        return head + "\n".join(" ".join(map(str, point)) for point in POINTS).encode() + b"\n"
    if data == "binary":
        return head + b"".join(struct.pack("<ffffHQ", *point) for point in POINTS)
    codes = "ffffHQ"
    columns = b"".join(struct.pack(f"<2{code}", *(p[k] for p in POINTS)) for k, code in enumerate(codes))
    packed = literal_lzf(columns)
    return head + struct.pack("<II", len(packed), len(columns)) + packed


EACH_FORM = pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])


@EACH_FORM
def test_columns_come_with_their_names_types_and_exact_values(tmp_path, form):
    (tmp_path / "a.pcd").write_bytes(pcd(form))
    cloud = read_cloud(tmp_path / "a.pcd")
    assert cloud.count == 2
    floats = dict.fromkeys(("x", "y", "z", "intensity"), "float32")
    types = {name: column.dtype.name for name, column in cloud.columns.items()}
    assert types == {**floats, "ring": "uint16", "t": "uint64"}
    for k, column in enumerate(cloud.columns.values()):
        assert column.tolist() == [point[k] for point in POINTS]


def test_fields_with_several_values_padding_and_repeated_names_are_kept_apart(tmp_path):
    head = "FIELDS x _ y z n n\nSIZE 4 1 4 4 4 1\nTYPE F U F F F I\nCOUNT 1 3 1 1 2 1\nWIDTH 1\nHEIGHT 1\nDATA binary\n"
    body = struct.pack("<f3Bfffffb", 1, 9, 9, 9, 2, 3, 4, 5, 0, -1)[: 4 + 3 + 4 + 4 + 8] + b"\xff"
    (tmp_path / "a.pcd").write_bytes(head.encode() + body)
    columns = read_cloud(tmp_path / "a.pcd").columns
    assert [*columns] == ["x", "y", "z", "n", "n~2"]
    assert columns["n"].tolist() == [[4.0, 5.0]]
    assert columns["n~2"].tolist() == [-1]


@EACH_FORM
def test_organised_clouds_have_width_times_height_points_and_empty_ones_none(tmp_path, form):
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 2\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(head.encode() + np.arange(18, dtype="<f4").tobytes())
    assert read_cloud(tmp_path / "a.pcd").columns["z"].tolist() == [2, 5, 8, 11, 14, 17]
    (tmp_path / "a.pcd").write_bytes(HEAD.format(count=0, data=form).encode())
    cloud = read_cloud(tmp_path / "a.pcd")
    assert (cloud.count, len(cloud.columns["t"])) == (0, 0)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("FIELDS", "FELDS", "line 3: 'FELDS'; expected one of"),
        ("SIZE 4 4", "SIZE 4", "SIZE: 5 entries; expected 6"),
        ("SIZE 4", "SIZE 3", "F3 for 'x'"),
        ("POINTS 2", "POINTS 3", "POINTS: 3; WIDTH times HEIGHT is 2"),
        ("POINTS 2", "POINTS -2", "POINTS: '-2'; expected a whole number"),
        ("POINTS 2\n", "POINTS 999999999999\n", "WIDTH times HEIGHT is 2"),
        ("DATA ascii", "DATA asci", "'asci'; expected ascii, binary, binary_compressed"),
        ("-2.0", "two", "line 12: .*two"),
        (" 31 ", " ", "line 13: 5 values; expected 6: x y z intensity ring t"),
    ],
)
def test_a_wrong_file_is_reported_with_its_location(tmp_path, old, new, problem):
    (tmp_path / "a.pcd").write_text(pcd("ascii").decode().replace(old, new))
    with pytest.raises(DataError, match=problem):
        read_cloud(tmp_path / "a.pcd")


def test_points_that_break_off_claim_too_much_or_are_damaged_are_refused(tmp_path):
    head = HEAD.format(count=1_000_000, data="binary_compressed").encode()
    damaged = bytearray(pcd("binary_compressed"))
    damaged[damaged.index(b"binary_compressed\n") + len(b"binary_compressed\n") + 8] = 0xE0
    for content, problem in (
        (pcd("binary")[:-5], r"47 bytes of points; expected 52: 2 points of 26 bytes"),
        (head + struct.pack("<II", 10, 26_000_000) + bytes(10), "10 bytes that unfold to 26000000"),
        (bytes(damaged), "damaged"),
    ):
        (tmp_path / "a.pcd").write_bytes(content)
        with pytest.raises(DataError, match=problem):
            read_cloud(tmp_path / "a.pcd")
