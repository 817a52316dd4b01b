"""The container: what is read, where arrays land, and what is refused with its location."""

import json

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.sfs import container as module
from sceneloom.formats.sfs.container import DTYPES, Container, RawBytes, format_keys
from sceneloom.formats.sfs.spec import has_scene_header


@pytest.fixture
def opened(tmp_path, encode_sfs):
    def open_header(header, **item_fields):
        path = tmp_path / "scene.sfs"
        path.write_bytes(encode_sfs(header, **item_fields))
        return Container(path)

    return open_header


def refused(opened, header, **item_fields):
    with pytest.raises(DataError) as caught:
        opened(header, **item_fields)
    return caught.value


ARRAY = np.arange(6, dtype=np.float32).reshape(2, 3)


def test_arrays_stand_where_their_keys_lead(opened):
    header = opened({"a": [{"b": ARRAY}, {"b": ARRAY + 1}], "c": "text"}).header
    assert header["c"] == "text"
    np.testing.assert_array_equal(header["a"][1]["b"], ARRAY + 1)


def test_numeric_text_counts_as_the_index_of_a_list(opened):
    header = opened({"a": [{"b": ARRAY}]}, index_type=str).header
    np.testing.assert_array_equal(header["a"][0]["b"], ARRAY)


def test_integer_keys_lead_into_objects_too(tmp_path):
    text = b'{"a":{"7":""},"$items":[{"keys":["a",7],"offset":4,"length":1,"dtype":"uint8","shape":[1]}]}'
    path = tmp_path / "scene.sfs"
    path.write_bytes(text + bytes(4) + b"\x05")
    np.testing.assert_array_equal(Container(path).header["a"]["7"], [5])


def test_arrays_are_read_only_views_of_the_file(opened):
    array = opened({"a": ARRAY}).header["a"]
    assert not array.flags.writeable
    assert not array.flags.owndata


def test_arrays_at_odd_offsets_are_read(tmp_path):
    text = b'{"a":"","$items":[{"keys":["a"],"offset":5,"length":8,"dtype":"float64","shape":[1]}]}'
    path = tmp_path / "scene.sfs"
    path.write_bytes(text + bytes(5) + np.array([0.1]).tobytes())
    assert Container(path).header["a"].tolist() == [0.1]


def test_an_item_without_dtype_gives_raw_bytes(opened):
    raw = opened({"a": ARRAY}, dtype=None, shape=None).header["a"]
    assert isinstance(raw, RawBytes)
    assert raw.tobytes() == ARRAY.tobytes()


@pytest.mark.parametrize("name", [n for n in DTYPES if n[0] not in "<>|"])
def test_every_dtype_by_numpys_name_comes_back(opened, name):
    array = np.array([0, 1, 1], np.dtype(name))
    np.testing.assert_array_equal(opened({"a": array}).header["a"], array)


def test_big_endian_items_have_their_values(opened):
    array = np.array([1, 258], ">i4")
    assert opened({"a": array}, dtype=">i4").header["a"].tolist() == [1, 258]


def test_arrays_without_values_and_shapes_are_kept(opened):
    assert opened({"a": np.zeros((0, 3), np.float32)}).header["a"].shape == (0, 3)
    assert opened({"a": np.array(2.5)}).header["a"].shape == ()


def test_a_header_without_arrays_needs_no_nul(tmp_path):
    path = tmp_path / "scene.sfs"
    path.write_bytes(b' {"version": "1.0"}  ')
    assert Container(path).header == {"version": "1.0"}


def test_blanks_before_the_nul_are_skipped(tmp_path, encode_sfs):
    content = encode_sfs({"a": ARRAY})
    stop = content.index(b"\0")
    path = tmp_path / "scene.sfs"
    path.write_bytes(content[:stop] + b" " * 4096 + content[stop:])
    np.testing.assert_array_equal(Container(path).header["a"], ARRAY)


def test_not_a_number_in_the_header_is_read_as_python_writes_it(opened):
    assert np.isnan(opened({"a": float("nan"), "b": ARRAY}).header["a"])


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"offset": 10_000}, "the file has"),
        ({"offset": 2**70}, "the file has"),
        ({"length": 10_000}, "the file has"),
        ({"offset": -4}, "offset -4"),
        ({"length": -24}, "length -24"),
        ({"offset": 4.0}, "offset 4.0"),
        ({"length": True}, "length True"),
        ({"length": 23}, "no whole number of float32"),
        ({"dtype": "object"}, "dtype 'object'; expected one of"),
        ({"dtype": "float32,float32"}, "dtype"),
        ({"dtype": "U4"}, "dtype"),
        ({"dtype": 7}, "dtype 7"),
        ({"shape": [7]}, "needs 7 values; the item holds 6"),
        ({"shape": [-2, -3]}, "shape [-2, -3]"),
        ({"shape": [2, 2**80]}, "needs"),
        ({"shape": [2] + [1] * 200 + [3]}, "beyond what an array can have"),
        ({"shape": "six"}, "shape 'six'"),
        ({"keys": []}, "keys []"),
        ({"keys": "a"}, "keys 'a'"),
        ({"keys": ["b"]}, "there is no b"),
        ({"keys": ["b", "c"]}, "there is no b"),
        ({"keys": ["list", 1]}, "there is no list[1]"),
        ({"keys": ["list", "-1"]}, "there is no list[-1]"),
        ({"keys": ["list", -1]}, "there is no list[-1]"),
        ({"keys": ["text", 0]}, "there is no text"),
        ({"keys": ["text"]}, "taken already"),
        ({"keys": [None]}, "there is no"),
    ],
)
def test_a_faulty_item_is_refused_with_its_number(opened, fields, problem):
    error = refused(opened, {"a": ARRAY, "text": "words", "list": [""]}, **fields)
    assert error.location.startswith("$items[0]")
    assert problem in error.problem


def test_the_position_of_an_item_names_its_path(opened):
    error = refused(opened, {"a": [{"b": ARRAY}]}, dtype="complex")
    assert error.location == "$items[0] (a[0].b)"


def test_items_that_overlap_are_refused(opened):
    error = refused(opened, {"a": ARRAY, "b": ARRAY}, offset=4)
    assert error.location == "$items[1] (b)"
    assert "inside item 0" in error.problem


def test_two_items_for_one_location_are_refused(opened):
    error = refused(opened, {"a": ARRAY, "b": ARRAY}, keys=["a"])
    assert "taken already" in error.problem


def test_all_faulty_items_are_collected_and_leave_nothing_in_their_locations(tmp_path, encode_sfs):
    path = tmp_path / "scene.sfs"
    content = encode_sfs({"a": [{"b": ARRAY}], "c": ARRAY, "d": ARRAY, "e": ARRAY})
    content = content.replace(b'"offset": 60', b'"offset": 40').replace(b'"shape": [2, 3]}]', b'"shape": [7]}]   ')
    path.write_bytes(content)
    faults = []
    header = Container(path, faults=faults).header
    assert [(fault.number, fault.path) for fault in faults] == [(2, "d"), (3, "e")]
    assert faults[0].problem.startswith("starts at byte 40, inside item 1, which ends at 56")
    assert faults[1].location == "$items[3] (e)"
    assert header["d"] is None
    assert header["e"] is None
    np.testing.assert_array_equal(header["a"][0]["b"], ARRAY)


def test_arrays_behind_four_gigabytes_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr("sceneloom.formats.base.files.LARGEST_HOLES", 1e9)  # a file without holes would take minutes
    """A file of holes takes no room on disk."""
    far = 5 * 2**30 + 3
    item = {"keys": ["a"], "offset": far, "length": 24, "dtype": "float32", "shape": [2, 3]}
    path = tmp_path / "scene.sfs"
    with path.open("wb") as file:
        text = json.dumps({"a": "", "$items": [item]}).encode()
        file.write(text + bytes(1))
        file.seek(len(text) + far)
        file.write(ARRAY.tobytes())
    np.testing.assert_array_equal(Container(path).header["a"], ARRAY)


@pytest.mark.parametrize("limit", [100, 200])
def test_a_header_beyond_the_limit_is_refused(tmp_path, encode_sfs, monkeypatch, limit):
    monkeypatch.setattr(module, "HEADER_LIMIT", limit)
    path = tmp_path / "scene.sfs"
    path.write_bytes(encode_sfs({"a": ARRAY, "text": "x" * 300}))
    with pytest.raises(DataError, match=f"no NUL ends it within {limit} bytes"):
        Container(path)


def test_a_shape_of_a_million_axes_is_refused_at_once(opened):
    error = refused(opened, {"a": ARRAY}, shape=[2**62] * 1_000_000)
    assert "1000000 axes" in error.problem


def test_items_are_found_by_the_location_that_they_fill(opened):
    container = opened({"a": [{"b": ARRAY}, {"b": ARRAY}], "c": ARRAY})
    assert container.item_number("a[1].b") == 1
    assert container.item_number("c") == 2
    assert container.item_number("d") is None


def test_an_item_at_fault_takes_no_array_from_another(tmp_path):
    items = [
        {"keys": ["a"], "offset": 4, "length": 4, "dtype": "uint8", "shape": [4]},
        {"keys": ["a"], "offset": 4, "length": 4, "dtype": "text"},
        7,
    ]
    path = tmp_path / "scene.sfs"
    path.write_bytes(json.dumps({"a": "", "$items": items}).encode() + bytes(8))
    faults = []
    container = Container(path, faults=faults)
    assert container.header["a"].tolist() == [0] * 4
    assert [fault.number for fault in faults] == [1, 2]
    assert container.item_number("a") == 0


def test_an_item_for_a_taken_location_leaves_what_stands_there(tmp_path, encode_sfs):
    path = tmp_path / "scene.sfs"
    path.write_bytes(encode_sfs({"a": ARRAY, "text": "words"}, keys=["text"]))
    faults = []
    assert Container(path, faults=faults).header == {"a": "", "text": "words"}
    assert [fault.keys for fault in faults] == [("text",)]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "is empty"),
        (b"\0\0\0\0", "no valid JSON"),
        (b"[1]\0\0\0\0", "expected an object"),
        (b'{"a": \xff}\0', "no valid JSON"),
        (b'{"a": "\xc3\x28"}\0', "no valid JSON"),
        (b'{"a": 1', "no valid JSON"),
        (b'{"$items": {}}\0', "expected a list"),
        (b'{"$items": [5]}\0', "a int; expected an object"),
        (b'{"a": ' + b"[" * 100_000 + b"\0", "nested too deeply"),
        (b'{"a": [NaN, ' + b"[" * 100_000 + b"\0", "nested too deeply"),
        (b'{"a": 1' + b"0" * 5000 + b"}\0", "no valid JSON"),
    ],
)
def test_what_is_no_header_is_refused(tmp_path, content, problem):
    path = tmp_path / "scene.sfs"
    path.write_bytes(content)
    with pytest.raises(DataError, match=problem.replace("[", r"\[")):
        Container(path)


def test_folders_and_missing_files_are_refused(tmp_path):
    with pytest.raises(DataError, match="not a file"):
        Container(tmp_path)
    with pytest.raises(DataError, match="No such file"):
        Container(tmp_path / "absent.sfs")


def test_content_decides_what_is_recognised(tmp_path, encode_sfs):
    cases = {
        "scene.sfs": (b"  {\n", True),
        "scene.SFS": (b"{", True),
        "text.sfs": (b"hello", False),
        "empty.sfs": (b"", False),
        "other.bin": (encode_sfs({"a": ARRAY}), True),
        "lines.jsonl": (b'{"time": 1.0}\n', False),
        "other.json": (b'{"items": 1}\0', False),
    }
    for name, (content, expected) in cases.items():
        path = tmp_path / name
        path.write_bytes(content)
        assert has_scene_header(path) is expected, name
    folder = tmp_path / "folder.sfs"
    folder.mkdir()
    assert not has_scene_header(folder)


def test_paths_are_written_as_in_messages():
    assert format_keys(["sensors", 3, "frames", 12, "points"]) == "sensors[3].frames[12].points"
    assert format_keys(["sensors", "3", "id"], {"sensors": []}) == "sensors[3].id"
