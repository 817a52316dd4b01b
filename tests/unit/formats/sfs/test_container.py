"""The container: what is read, where arrays land, and what is refused with its location."""

import json
import mmap

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.sfs import container
from sceneloom.formats.sfs.container import DTYPES, Container, RawBytes, format_keys
from sceneloom.formats.sfs.spec import has_scene_header

ARRAY = np.arange(6, dtype=np.float32).reshape(2, 3)


@pytest.fixture
def of_bytes(tmp_path):
    """Open a file of some bytes."""

    def open_content(content, **options):
        (tmp_path / "scene.sfs").write_bytes(content)
        return Container(tmp_path / "scene.sfs", **options)

    return open_content


@pytest.fixture
def opened(of_bytes, encode_sfs):
    """Open a file of a header with arrays, the fields of its items replaced."""
    return lambda header, **item_fields: of_bytes(encode_sfs(header, **item_fields))


def refused(opened, header, **item_fields):
    with pytest.raises(DataError) as caught:
        opened(header, **item_fields)
    return caught.value


def test_arrays_of_every_dtype_are_read_only_views_of_the_file_where_their_keys_lead(opened, of_bytes, encode_sfs):
    header = opened({"a": [{"b": ARRAY}, {"b": ARRAY + 1}], "c": "text"}).header
    assert header["c"] == "text"
    array = header["a"][1]["b"]
    np.testing.assert_array_equal(array, ARRAY + 1)
    assert not array.flags.writeable
    assert not array.flags.owndata
    # numeric text counts as the index of a list, and integers lead into objects, too
    np.testing.assert_array_equal(opened({"a": [{"b": ARRAY}]}, index_type=str).header["a"][0]["b"], ARRAY)
    text = b'{"a":{"7":""},"$items":[{"keys":["a",7],"offset":4,"length":1,"dtype":"uint8","shape":[1]}]}'
    np.testing.assert_array_equal(of_bytes(text + bytes(4) + b"\x05").header["a"]["7"], [5])
    # at an odd offset
    text = b'{"a":"","$items":[{"keys":["a"],"offset":5,"length":8,"dtype":"float64","shape":[1]}]}'
    assert of_bytes(text + bytes(5) + np.array([0.1]).tobytes()).header["a"].tolist() == [0.1]
    raw = opened({"a": ARRAY}, dtype=None, shape=None).header["a"]
    assert isinstance(raw, RawBytes)
    assert raw.tobytes() == ARRAY.tobytes()
    for name in (n for n in DTYPES if n[0] not in "<>|"):
        array = np.array([0, 1, 1], np.dtype(name))
        np.testing.assert_array_equal(opened({"a": array}).header["a"], array)
    assert opened({"a": np.array([1, 258], ">i4")}, dtype=">i4").header["a"].tolist() == [1, 258]
    assert opened({"a": np.zeros((0, 3), np.float32)}).header["a"].shape == (0, 3)
    assert opened({"a": np.array(2.5)}).header["a"].shape == ()
    # headers may lack a NUL, have blanks before it, and hold NaN
    assert of_bytes(b' {"version": "1.0"}  ').header == {"version": "1.0"}
    content = encode_sfs({"a": ARRAY})
    stop = content.index(b"\0")
    np.testing.assert_array_equal(of_bytes(content[:stop] + b" " * 4096 + content[stop:]).header["a"], ARRAY)
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


def test_faulty_items_name_their_paths_and_leave_nothing_in_their_locations(opened, of_bytes, encode_sfs):
    assert refused(opened, {"a": [{"b": ARRAY}]}, dtype="complex").location == "$items[0] (a[0].b)"
    overlapping = refused(opened, {"a": ARRAY, "b": ARRAY}, offset=4)
    assert (overlapping.location, "inside item 0" in overlapping.problem) == ("$items[1] (b)", True)
    assert "taken already" in refused(opened, {"a": ARRAY, "b": ARRAY}, keys=["a"]).problem
    assert "1000000 axes" in refused(opened, {"a": ARRAY}, shape=[2**62] * 1_000_000).problem
    content = encode_sfs({"a": [{"b": ARRAY}], "c": ARRAY, "d": ARRAY, "e": ARRAY})
    content = content.replace(b'"offset": 60', b'"offset": 40').replace(b'"shape": [2, 3]}]', b'"shape": [7]}]   ')
    faults = []
    header = of_bytes(content, faults=faults).header
    assert [(fault.number, fault.location) for fault in faults] == [(2, "$items[2] (d)"), (3, "$items[3] (e)")]
    assert faults[0].problem.startswith("starts at byte 40, inside item 1, which ends at 56")
    assert (header["d"], header["e"]) == (None, None)
    np.testing.assert_array_equal(header["a"][0]["b"], ARRAY)
    # and take no array from another
    item = {"keys": ["a"], "offset": 4, "length": 4, "dtype": "uint8"}
    items = [{**item, "shape": [4]}, {**item, "dtype": "text"}, 7]
    faults = []
    found = of_bytes(json.dumps({"a": "", "$items": items}).encode() + bytes(8), faults=faults)
    assert found.header["a"].tolist() == [0] * 4
    assert [fault.number for fault in faults] == [1, 2]
    assert found.item_number("a") == 0
    taken = []
    content = encode_sfs({"a": ARRAY, "text": "words"}, keys=["text"])
    assert of_bytes(content, faults=taken).header == {"a": "", "text": "words"}
    assert [fault.keys for fault in taken] == [("text",)]


def test_arrays_behind_four_gigabytes_are_read(tmp_path, monkeypatch):
    # a file of holes takes no room on disk; one without them would take minutes
    monkeypatch.setattr("sceneloom.formats.base.files.LARGEST_HOLES", 1e9)
    far = 5 * 2**30 + 3
    item = {"keys": ["a"], "offset": far, "length": 24, "dtype": "float32", "shape": [2, 3]}
    path = tmp_path / "scene.sfs"
    with path.open("wb") as file:
        text = json.dumps({"a": "", "$items": [item]}).encode()
        file.write(text + bytes(1))
        file.seek(len(text) + far)
        file.write(ARRAY.tobytes())
    np.testing.assert_array_equal(Container(path).header["a"], ARRAY)


def test_what_is_no_header_or_one_beyond_the_limit_is_refused(of_bytes, opened, monkeypatch):
    for content, problem in (
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
    ):
        with pytest.raises(DataError, match=problem):
            of_bytes(content)
    for limit in (100, 200):
        monkeypatch.setattr(container, "HEADER_LIMIT", limit)
        assert f"no NUL ends it within {limit} bytes" in refused(opened, {"a": ARRAY, "text": "x" * 300}).problem


def test_content_decides_what_is_recognised(tmp_path, encode_sfs):
    for name, content, expected in (
        ("scene.sfs", b"  {\n", True),
        ("scene.SFS", b"{", True),
        ("text.sfs", b"hello", False),
        ("empty.sfs", b"", False),
        ("other.bin", encode_sfs({"a": ARRAY}), True),
        ("lines.jsonl", b'{"time": 1.0}\n', False),
        ("other.json", b'{"items": 1}\0', False),
    ):
        (tmp_path / name).write_bytes(content)
        assert has_scene_header(tmp_path / name) is expected, name
    assert not has_scene_header(tmp_path)


def test_paths_are_written_as_in_messages_and_lead_to_their_items_and_folders_and_missing_files_are_refused(
    opened, tmp_path
):
    assert format_keys(["sensors", 3, "frames", 12, "points"]) == "sensors[3].frames[12].points"
    assert format_keys(["sensors", "3", "id"], {"sensors": []}) == "sensors[3].id"
    found = opened({"a": [{"b": ARRAY}, {"b": ARRAY}], "c": ARRAY})
    assert [found.item_number(path) for path in ("a[1].b", "c", "d")] == [1, 2, None]
    for path, problem in ((tmp_path, "not a file"), (tmp_path / "absent.sfs", "No such file")):
        with pytest.raises(DataError, match=problem):
            Container(path)


@pytest.mark.skipif(not hasattr(mmap, "MADV_DONTNEED"), reason="this system cannot let go of single pages")
def test_pages_are_let_go_now_and_then_and_still_state_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(container, "_MAPPED_AT_MOST", 1 << 20)
    path = tmp_path / "drive.sfs"
    path.write_bytes(np.arange(1 << 20, dtype=np.uint32).tobytes())
    file = container.LocalFile.of(path)
    whole = np.frombuffer(file.content, np.uint32)
    let_go = []
    monkeypatch.setattr(container.MappedFile, "madvise", lambda *what: let_go.append(what[1:]), raising=False)
    for k in range(4):
        piece = file.fetch({"points": {"positions": whole[k << 18 : (k + 1) << 18]}, "timestamp": 5})
        assert piece["points"]["positions"][1] == (k << 18) + 1
    assert let_go == [(mmap.MADV_DONTNEED,)] * 2
    monkeypatch.undo()
    file.content.madvise(mmap.MADV_DONTNEED)
    np.testing.assert_array_equal(whole[::4096], np.arange(1 << 20, dtype=np.uint32)[::4096])
