"""Drives by paths, patterns, URLs and lists, and what their outputs are called."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.batch.jobs import Input, find_inputs, output_names
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base import files
from sceneloom.formats.base.files import fingerprint, late_fingerprint


def test_patterns_and_lists_give_each_drive_once(tmp_path):
    for name in ("b.sfs", "a.sfs", "odd[1].sfs"):
        (tmp_path / name).touch()
    (tmp_path / "more.jsonl").write_text(
        '# chosen\na.sfs\n\n{"path": "b.sfs", "start": 1.5, "stop": 3}\ns3://bucket/c.sfs\n'
    )
    found = find_inputs(
        [str(tmp_path / "?.sfs"), str(tmp_path / "a.sfs"), str(tmp_path / "odd[1].sfs")],
        [tmp_path / "more.jsonl"],
    )
    names = [(drive.location.removeprefix(f"{tmp_path}/"), dict(drive.options)) for drive in found]
    assert names == [
        ("a.sfs", {}), ("b.sfs", {}), ("odd[1].sfs", {}), ("b.sfs", {"start": 1.5, "stop": 3}),
        ("s3://bucket/c.sfs", {}),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("line", "reported"),
    [
        ('{"path": 3}', "line 1: path 3; expected"),
        ('{"start": 3}', "line 1: path None"),
        ('{"path": "a", "start": "x"}', "start 'x'; expected seconds"),
        ('{"path": "a", "start": NaN}', "line 1: start nan; expected seconds"),
        ('{"path": "a", "stop": 1e999}', "stop inf; expected seconds"),
        ('{"path": "a", "start": -0.5}', "start -0.5; expected seconds from the beginning of the drive on"),
        (
            '{"path": "a", "reading": {"sequence": 3}}',
            "reading {'sequence': 3}; expected options by their names",
        ),
        ('{"path": "a", "stat": 3}', "line 1: 'stat'; expected path, start, stop and reading only"),
        ('{"path": ', "expected a path or an object"),
        pytest.param('{"path": ' + "[" * 100_000, "expected a path or an object", id="deep"),
    ],
)
def test_faulty_lines_of_a_list_are_named(tmp_path, line, reported):
    (tmp_path / "list.jsonl").write_text(line)
    with pytest.raises(DataError) as caught:
        find_inputs([], [tmp_path / "list.jsonl"])
    assert reported in str(caught.value)


def test_marks_of_windows_and_rare_ends_of_lines_are_no_part_of_the_format(tmp_path):
    (tmp_path / "list.jsonl").write_bytes('\ufeffa.sfs\r\n{"path": "b\u2028c.sfs"}\r\n'.encode())
    found = find_inputs([], [tmp_path / "list.jsonl"])
    assert [Path(drive.location).name for drive in found] == ["a.sfs", "b\u2028c.sfs"]


def test_nothing_to_do_is_refused(tmp_path):
    with pytest.raises(OptionError, match="fits this pattern"):
        find_inputs([str(tmp_path / "*.sfs")])
    with pytest.raises(OptionError, match="no drives"):
        find_inputs([])
    (tmp_path / "list").write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match="UTF-8"):
        find_inputs([], [tmp_path / "list"])


def test_names_state_which_drive_it_was():
    drives = [
        Input(location="monday/cut.sfs"), Input(location="tuesday/cut.sfs"), Input(location="drive_1/"),
        Input(location="s3://bucket/far%20away.sfs"), Input(location="x.sfs", options={"start": 1.5}),
    ]  # fmt: skip
    assert output_names(drives, ".html") == (
        "monday_cut.html", "tuesday_cut.html", "drive_1.html", "far away.html", "x_start1.5.html",
    )  # fmt: skip


@given(
    st.lists(
        st.lists(st.sampled_from(["a", "A", "b", "a.sfs", "ü", "..", "c d"]), min_size=1, max_size=4),
        max_size=12,
    )
)
def test_outputs_never_share_a_name(parts):
    locations = dict.fromkeys("/" + "/".join(part) for part in parts)
    names = output_names([Input(location=location) for location in locations], ".sfs")
    assert len({name.casefold() for name in names}) == len(locations)
    assert all("/" not in name and name.endswith(".sfs") for name in names)


def test_fingerprints_change_with_any_file(tmp_path):
    folder = tmp_path / "drive"
    (folder / "inner").mkdir(parents=True)
    (folder / "inner" / "a").write_text("1")
    seen = [fingerprint(str(folder))]
    (folder / "inner" / "b").write_text("2")
    seen.append(fingerprint(str(folder)))
    (folder / "inner" / "b").write_text("22")
    seen.append(fingerprint(str(folder)))
    (folder / "inner" / "b").rename(folder / "b")
    seen.append(fingerprint(str(folder)))
    assert len(set(seen)) == 4
    assert fingerprint(str(folder)) == seen[-1]
    assert fingerprint(str(tmp_path / "gone")) == ""


def test_only_what_takes_long_to_look_at_is_not_looked_at_anew(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("1")
    first = late_fingerprint(str(tmp_path))
    assert first == fingerprint(str(tmp_path))
    (tmp_path / "b").write_text("2")
    second = late_fingerprint(str(tmp_path))
    assert second == fingerprint(str(tmp_path)) != first
    monkeypatch.setattr(files, "_LONG_SECONDS", 0.0)
    monkeypatch.setattr(files, "_LASTING", 1e9)
    assert late_fingerprint(str(tmp_path)) == second
    (tmp_path / "b").unlink()
    assert late_fingerprint(str(tmp_path)) == second
    monkeypatch.setattr(files, "_LATE", {})
    assert late_fingerprint(str(tmp_path)) == first
