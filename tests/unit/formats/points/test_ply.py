"""PLY files, written here by hand from the format's description."""

import struct

import pytest

from sceneloom.errors import DataError
from sceneloom.formats.points.files import read_cloud

ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
POINTS = [(1.5, -2.0, 0.25, 200, 123456789), (4.0, 5.0, -6.0, 0, -7)]
VERTEX = (
    "element vertex 2\nproperty float x\nproperty float32 y\nproperty double z\nproperty uchar intensity\n"
    "property int t\n"
)


def head(form: str, *elements: str) -> bytes:
    return f"ply\nformat {form} 1.0\ncomment by hand\n{''.join(elements)}end_header\n".encode()


def rows(form: str) -> bytes:
    if form == "ascii":
        return "".join(" ".join(map(str, point)) + "\n" for point in POINTS).encode()
    return b"".join(struct.pack(f"{ORDERS[form]}ffdBi", *point) for point in POINTS)


@pytest.fixture(params=["ascii", *ORDERS])
def form(request):
    return request.param


def columns(tmp_path, content: bytes) -> dict[str, list[float]]:
    (tmp_path / "a.ply").write_bytes(content)
    return {name: column.tolist() for name, column in read_cloud(tmp_path / "a.ply").columns.items()}


EXPECTED = {"x": [1.5, 4.0], "y": [-2.0, 5.0], "z": [0.25, -6.0], "intensity": [200, 0], "t": [123456789, -7]}


def test_vertices_come_with_their_names_types_and_exact_values(tmp_path, form):
    comment = "comment end_header comes later\n"
    for content in (head(form, comment, VERTEX) + rows(form), head(form, VERTEX) + rows(form)):
        assert columns(tmp_path, content) == EXPECTED
    dtypes = [column.dtype.name for column in read_cloud(tmp_path / "a.ply").columns.values()]
    assert dtypes == ["float32", "float32", "float64", "uint8", "int32"]


FACES = "element face 2\nproperty list uchar int vertex_indices\nproperty uchar flag\n"


def faces(form: str) -> bytes:
    """Two faces, of three and of four corners."""
    if form == "ascii":
        return b"3 0 1 0 9\n4 0 1 1 0 8\n"
    order = ORDERS[form]
    return struct.pack(f"{order}B3iB", 3, 0, 1, 0, 9) + struct.pack(f"{order}B4iB", 4, 0, 1, 1, 0, 8)


def test_elements_with_lists_are_passed_over_before_and_after_the_vertices(tmp_path, form):
    assert columns(tmp_path, head(form, FACES, VERTEX) + faces(form) + rows(form)) == EXPECTED
    assert columns(tmp_path, head(form, VERTEX, FACES) + rows(form) + faces(form)) == EXPECTED


def test_lists_inside_vertices_are_passed_over(tmp_path, form):
    vertex = "element vertex 2\nproperty float x\nproperty list uchar short seen\nproperty float y\n"
    if form == "ascii":
        body = b"1.5 2 7 8 -2\n4 0 5\n"
    else:
        order = ORDERS[form]
        body = struct.pack(f"{order}fB2hf", 1.5, 2, 7, 8, -2) + struct.pack(f"{order}fBf", 4, 0, 5)
    assert columns(tmp_path, head(form, vertex) + body) == {"x": [1.5, 4.0], "y": [-2.0, 5.0]}


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (b"ply\n", b"plx\n", "does not begin with `ply`"),
        (b"format ascii", b"format asci", "line 2"),
        (b"property float x", b"property floot x", "line 5: 'property floot x'"),
        (b"element vertex", b"element corner", "elements: corner; expected one that is called vertex"),
        (b"vertex 2", b"vertex 3", "2 lines of vertex; expected 3"),
        (b"vertex 2", b"vertex 99999999999", "99999999999 points"),
        (b"end_header", b"end_hedder", "without `end_header`"),
        (b"4.0 ", b"", "line 12: 4 values; expected 5"),
    ],
)
def test_a_wrong_file_is_reported_with_its_location(tmp_path, old, new, problem):
    (tmp_path / "a.ply").write_bytes((head("ascii", VERTEX) + rows("ascii")).replace(old, new))
    with pytest.raises(DataError, match=problem):
        read_cloud(tmp_path / "a.ply")


def test_a_file_that_breaks_off_is_reported_with_its_bytes(tmp_path):
    (tmp_path / "a.ply").write_bytes(head("binary_big_endian", VERTEX) + rows("binary_big_endian")[:-1])
    with pytest.raises(DataError, match=r"41 bytes of vertex; expected 42: 2 of 21 bytes"):
        read_cloud(tmp_path / "a.ply")
