"""Drives of a run, files beside them, and their lists."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.batch import running
from sceneloom.batch.jobs import FileOption, Input, find_inputs, give_files, output_names
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.files import fingerprint


def test_patterns_and_lists_give_each_drive_once(tmp_path):
    for name in ("b.sfs", "a.sfs", "odd[1].sfs"):
        (tmp_path / name).touch()
    # with the mark of Windows, its ends of lines, and a sign that only rarely ends a line
    text = '\ufeff# chosen\r\na.sfs\r\n\n{"path": "b.sfs", "start": 1.5, "stop": 3}\ns3://bucket/c.sfs\n'
    (tmp_path / "more.jsonl").write_bytes((text + '{"path": "b\u2028c.sfs"}\r\n').encode())
    patterns = [str(tmp_path / name) for name in ("?.sfs", "a.sfs", "odd[1].sfs")]
    found = find_inputs(patterns, [tmp_path / "more.jsonl"])
    names = [(drive.location.removeprefix(f"{tmp_path}/"), dict(drive.options)) for drive in found]
    assert names == [
        ("a.sfs", {}), ("b.sfs", {}), ("odd[1].sfs", {}), ("b.sfs", {"start": 1.5, "stop": 3}),
        ("s3://bucket/c.sfs", {}), ("b\u2028c.sfs", {}),
    ]  # fmt: skip


def test_names_state_which_drive_it_was():
    drives = [
        Input(location="monday/cut.sfs"), Input(location="tuesday/cut.sfs"), Input(location="drive_1/"),
        Input(location="s3://bucket/far%20away.sfs"), Input(location="x.sfs", options={"start": 1.5}),
    ]  # fmt: skip
    assert output_names(drives, ".html") == (
        "monday_cut.html", "tuesday_cut.html", "drive_1.html", "far away.html", "x_start1.5.html",
    )  # fmt: skip


@given(
    st.lists(st.lists(st.sampled_from(["a", "A", "b", "a.sfs", "ü", "..", "c d"]), min_size=1, max_size=4), max_size=12)
)
def test_outputs_never_share_a_name(parts):
    locations = dict.fromkeys("/" + "/".join(part) for part in parts)
    names = output_names([Input(location=location) for location in locations], ".sfs")
    assert len({name.casefold() for name in names}) == len(locations)
    assert all("/" not in name and name.endswith(".sfs") for name in names)


def test_fingerprints_change_with_any_file_unless_it_takes_long_to_look_at_them(tmp_path, monkeypatch):
    folder = tmp_path / "drive"
    (folder / "inner").mkdir(parents=True)
    seen = []
    for change in (
        lambda: (folder / "inner" / "a").write_text("1"),
        lambda: (folder / "inner" / "b").write_text("2"),
        lambda: (folder / "inner" / "b").write_text("22"),
        lambda: (folder / "inner" / "b").rename(folder / "b"),
    ):
        change()
        seen.append(fingerprint(str(folder)))
        assert running._late_fingerprint(str(folder)) == seen[-1] == fingerprint(str(folder))
    assert len(set(seen)) == 4
    assert fingerprint(str(tmp_path / "gone")) == ""
    monkeypatch.setattr(running, "_LONG_SECONDS", 0.0)
    monkeypatch.setattr(running, "_LASTING", 1e9)
    assert running._late_fingerprint(str(folder)) == seen[-1]
    (folder / "b").unlink()
    assert running._late_fingerprint(str(folder)) == seen[-1]
    monkeypatch.setattr(running, "_LATE", {})
    assert running._late_fingerprint(str(folder)) == fingerprint(str(folder)) != seen[-1]


OPTIONS = {
    "boxes": FileOption(several=True),
    "from_times": FileOption(),
    "detectors": FileOption(names=frozenset({"simulated"})),
}


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Makes files, in the folder that the user is in."""
    monkeypatch.chdir(tmp_path)

    def make(*names):
        for name in names:
            Path(name).parent.mkdir(parents=True, exist_ok=True)
            Path(name).write_text("")

    return make


def test_placeholders_give_each_drive_its_own(made):
    made("mon/cut.sfs", "tue/cut.sfs", "mon_cut.txt", "tue_cut.txt", "mon/times", "tue/times")
    made("far.txt", "other.txt", "mon/cut.sfs.txt")
    drives = [
        Input(location="mon/cut.sfs", options={"start": 1.0}), Input(location="mon/cut.sfs", options={"start": 5.0}),
        Input(location="tue/cut.sfs", files={"boxes": (Path("other.txt"),)}), Input(location="s3://bucket/far.sfs"),
    ]  # fmt: skip
    given, alike = give_files(drives, {"boxes": (Path("{name}.txt"),), "detectors": "simulated"}, OPTIONS)
    # parts of a drive have the files of the drive, and what a list says goes before
    names = ["mon_cut.txt", "mon_cut.txt", "other.txt", "far.txt"]
    assert [one.files["boxes"] for one in given] == [(Path(name),) for name in names]
    assert alike == {}
    stated = {"from_times": Path("{folder}/times"), "boxes": (Path("{drive}.txt"), Path("far.txt"))}
    (given,), _ = give_files(drives[:1], stated, OPTIONS)
    assert given.files == {"from_times": Path("mon/times"), "boxes": (Path("mon/cut.sfs.txt"), Path("far.txt"))}
    with pytest.raises(OptionError, match=r"s3://bucket/far.sfs is behind a URL.*expected \{name\} only"):
        give_files(drives[3:], stated, OPTIONS)


@pytest.mark.parametrize(
    ("stated", "reported"),
    [
        ({"boxes": (Path("{name}.txt"),)}, "b.txt: no such file or folder, for --boxes of b.sfs; so it is with 1 more"),
        ({"boxes": (Path("{nmae}.txt"),)}, "for --boxes; drives may differ by {name}, {drive}, {folder}"),
        ({"from_times": Path("t")}, "t: no such file or folder, for --from-times"),
        ({"detectors": "mine"}, "for --detectors; expected a file, or one of simulated"),
    ],
)  # fmt: skip
def test_files_that_are_not_there_are_reported_before_anything_begins(made, stated, reported):
    made("a.sfs", "b.sfs", "c.sfs", "a.txt")
    with pytest.raises(DataError) as caught:
        give_files(find_inputs(["?.sfs"]), stated, OPTIONS)
    assert reported in str(caught.value)


def test_lines_of_a_list_name_files_beside_it(made):
    made("lists/b.txt", "lists/c.txt", "lists/t")
    Path("lists/all.jsonl").write_text(
        '{"path": "a.sfs", "boxes": ["b.txt", "c.txt"], "from_times": "t", "detectors": "simulated"}\n'
        '{"path": "b.sfs", "boxes": "c.txt", "detectors": "t"}\n{"path": "c.sfs", "boxes": null}\n'
    )
    found = find_inputs([], [Path("lists/all.jsonl")], files=OPTIONS)
    beside = {name: Path("lists", name) for name in ("b.txt", "c.txt", "t")}
    assert [dict(drive.files) for drive in found] == [
        {"boxes": (beside["b.txt"], beside["c.txt"]), "from_times": beside["t"], "detectors": "simulated"},
        {"boxes": (beside["c.txt"],), "detectors": beside["t"]},
        {},
    ]
    elsewhere = find_inputs([], [Path("lists/all.jsonl")], files={"boxes": OPTIONS["boxes"]}, others=tuple(OPTIONS))
    assert [(set(drive.files), drive.unread) for drive in elsewhere] == [
        ({"boxes"}, {"from_times", "detectors"}), ({"boxes"}, {"detectors"}), (set(), frozenset()),
    ]  # fmt: skip
    with pytest.raises(OptionError, match=r"lists/a.sfs: named twice, with different files"):
        find_inputs(["lists/a.sfs"], [Path("lists/all.jsonl")], files=OPTIONS)


FAULTY_LINES = [
    ('{"path": 3}', "line 1: path 3; expected"),
    ('{"start": 3}', "line 1: path None"),
    ('{"path": "a", "start": "x"}', "start 'x'; expected seconds"),
    ('{"path": "a", "start": NaN}', "line 1: start nan; expected seconds"),
    ('{"path": "a", "stop": 1e999}', "stop inf; expected seconds"),
    ('{"path": "a", "start": -0.5}', "start -0.5; expected seconds from the beginning of the drive on"),
    ('{"path": "a", "reading": {"sequence": 3}}', "reading {'sequence': 3}; expected options by their names"),
    ('{"path": ', "expected a path or an object"),
    pytest.param('{"path": ' + "[" * 100_000, "expected a path or an object", id="deep"),
    ('{"path": "a", "boxe": "b"}', "'boxe'; expected path, start, stop, boxes, from_times, detectors and reading only"),
    ('{"path": "a", "boxes": 3}', "line 1: boxes: 3; expected the path of a file, or a list of such"),
    ('{"path": "a", "boxes": []}', "boxes: []; expected the path"),
    ('{"path": "a", "boxes": ["b.txt", ""]}', "boxes: ['b.txt', '']; expected"),
    ('{"path": "a", "from_times": ["b.txt"]}', "from_times: ['b.txt']; expected the path of a file"),
    ('{"path": "a", "boxes": "s3://c/b.txt"}', "boxes: 's3://c/b.txt' is a URL; expected the path of a file"),
    ('{"path": "a", "boxes": "gone.txt"}', "line 1: boxes: lists/gone.txt: no such file or folder"),
    ('{"path": "a", "detectors": "mine"}', "lists/mine: no such file or folder; expected a file, or one of simulated"),
]


@pytest.mark.parametrize(("line", "reported"), FAULTY_LINES)
def test_faulty_lines_of_a_list_are_named(made, line, reported):
    made("lists/b.txt")
    Path("lists/all.jsonl").write_text(line)
    with pytest.raises(DataError) as caught:
        find_inputs([], [Path("lists/all.jsonl")], files=OPTIONS)
    assert reported in str(caught.value)


def test_nothing_to_do_is_refused(tmp_path):
    (tmp_path / "list").write_bytes(b"\xff\xfe")
    for found, error, reported in (
        (([str(tmp_path / "*.sfs")],), OptionError, "fits this pattern"),
        (([],), OptionError, "no drives"),
        (([], [tmp_path / "list"]), DataError, "UTF-8"),
    ):
        with pytest.raises(error, match=reported):
            find_inputs(*found)


def test_a_changed_file_lets_its_drives_be_done_anew(made, tmp_path, drives, job, go):
    made("a.boxes", "b.boxes", "rig")
    locations = drives("a.sfs", "b.sfs")
    work = job("read", (), files={"rig": Path("rig")})

    def again(boxes="ab"):
        inputs = tuple(
            Input(location=location, files={"boxes": (Path(f"{name}.boxes"),)})
            for location, name in zip(locations, boxes, strict=True)
        )
        go(replace(work, inputs=inputs), resume=True)
        return sorted(go.drives)

    assert [again(), again()] == [["a.sfs", "b.sfs"], []]
    Path("b.boxes").write_text("changed")
    assert [again(), again()] == [["b.sfs"], []]
    os.utime("rig", ns=(1, 1))
    assert [again(), again()] == [["a.sfs", "b.sfs"], []]
    assert again("bb") == ["a.sfs"]
    assert (tmp_path / "out" / "a.txt").read_text() == "changed"
