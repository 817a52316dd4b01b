"""Files that a verb reads beside a drive: of all drives the same, or of each its own."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from sceneloom.batch import Input, run
from sceneloom.batch.jobs import FileOption, find_inputs, give_files
from sceneloom.errors import DataError, OptionError

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
    assert given.files == {
        "from_times": Path("mon/times"),
        "boxes": (Path("mon/cut.sfs.txt"), Path("far.txt")),
    }
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
        {
            "boxes": (beside["b.txt"], beside["c.txt"]),
            "from_times": beside["t"],
            "detectors": "simulated",
        },
        {"boxes": (beside["c.txt"],), "detectors": beside["t"]},
        {},
    ]
    with pytest.raises(OptionError, match=r"lists/a.sfs: named twice, with different files"):
        find_inputs(["lists/a.sfs"], [Path("lists/all.jsonl")], files=OPTIONS)


def test_files_for_other_verbs_are_left_out_by_name(made):
    made("lists/b.txt")
    Path("lists/all.jsonl").write_text(
        '{"path": "a.sfs", "boxes": "b.txt", "truth": "gone.tum"}\n{"path": "b.sfs", "truth": null}\n'
    )
    found = find_inputs([], [Path("lists/all.jsonl")], files=OPTIONS, others=("boxes", "truth"))
    assert [(dict(drive.files), drive.unread) for drive in found] == [
        ({"boxes": (Path("lists/b.txt"),)}, {"truth"}),
        ({}, frozenset()),
    ]


@pytest.mark.parametrize(
    ("stated", "reported"),
    [
        ('"boxes": 3', "line 1: boxes: 3; expected the path of a file, or a list of such"),
        ('"boxes": []', "boxes: []; expected the path"),
        ('"boxes": ["b.txt", ""]', "boxes: ['b.txt', '']; expected"),
        ('"from_times": ["b.txt"]', "from_times: ['b.txt']; expected the path of a file"),
        ('"boxes": "s3://bucket/b.txt"', "boxes: 's3://bucket/b.txt' is a URL; expected the path of a file"),
        ('"boxes": "gone.txt"', "line 1: boxes: lists/gone.txt: no such file or folder"),
        ('"detectors": "mine"', "lists/mine: no such file or folder; expected a file, or one of simulated"),
        ('"boxe": "b.txt"', "'boxe'; expected path, start, stop, boxes, from_times, detectors and reading"),
    ],
)
def test_faulty_files_of_a_line_are_named(made, stated, reported):
    made("lists/b.txt")
    Path("lists/all.jsonl").write_text(f'{{"path": "a.sfs", {stated}}}')
    with pytest.raises(DataError) as caught:
        find_inputs([], [Path("lists/all.jsonl")], files=OPTIONS)
    assert reported in str(caught.value)


def test_a_changed_file_lets_its_drives_be_done_anew(made, tmp_path, drives, job, inline):
    made("a.boxes", "b.boxes", "rig")
    locations = drives("a.sfs", "b.sfs")
    inputs = tuple(
        Input(location=location, files={"boxes": (Path(f"{name}.boxes"),)})
        for location, name in zip(locations, "ab", strict=True)
    )
    work = job("read", (), files={"rig": Path("rig")})

    def again(inputs=inputs):
        executor = inline()
        run(replace(work, inputs=inputs), tmp_path / "out", executor=executor, resume=True)
        return sorted({Path(task.location).stem for task in executor.tasks})

    assert [again(), again()] == [["a", "b"], []]
    Path("b.boxes").write_text("changed")
    assert [again(), again()] == [["b"], []]
    os.utime("rig", ns=(1, 1))
    assert [again(), again()] == [["a", "b"], []]
    other = Input(location=locations[0], files={"boxes": (Path("b.boxes"),)})
    assert again((other, inputs[1])) == ["a"]
    assert (tmp_path / "out" / "a.txt").read_text() == "changed"
