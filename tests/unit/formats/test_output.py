"""An output is there whole, or not at all, and has a name that stays in its folder."""

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.errors import DataError, OutputError
from sceneloom.formats.base.output import FolderKind, Source, check_output, file_stem, file_stems, filling, replacing

KIND = FolderKind("folder of ours", (r"data\.jsonl", r"images/\d+\.png"), r"data\.jsonl")


def refused(target, problem, *, overwrite=True, folder=None):
    with pytest.raises(OutputError, match=problem), replacing(target, overwrite=overwrite, folder=folder):
        pytest.fail("must not be entered")


def write(folder, **files):
    """Make a folder with files: `_` stands for the point before an ending."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)
    return folder


def tree(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def test_a_file_takes_its_location_when_it_is_whole_and_replaces_no_target_of_another_kind(tmp_path):
    target = tmp_path / "drive.sfs"
    with replacing(target, overwrite=False) as draft:
        draft.write_text("whole")
        assert not target.exists()
    assert tree(tmp_path) == {"drive.sfs": "whole"}
    refused(target, "--overwrite", overwrite=False)
    with replacing(target, overwrite=True) as draft:
        draft.write_text("after")
    with pytest.raises(DataError), replacing(target, overwrite=True) as draft:
        draft.write_text("half")
        raise DataError("source", "line 3", "broken")
    # a fault of reading is not called a fault of writing
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "other.sfs", overwrite=False):
        (tmp_path / "source").read_text()
    assert tree(tmp_path) == {"drive.sfs": "after"}
    assert [path.name for path in tmp_path.iterdir()] == ["drive.sfs"]
    write(tmp_path / "folder.sfs")
    refused(tmp_path / "folder.sfs", "is a folder")
    refused(tmp_path / "nowhere" / "drive.sfs", r"nowhere does not exist", overwrite=False)
    refused(target / "a", r"drive.sfs is a file", overwrite=False)
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        refused(tmp_path / "pipe", "left alone")
        assert (tmp_path / "pipe").is_fifo()


def test_filling_keeps_other_files_in_a_folder_and_nothing_replaces_what_another_program_made_meanwhile(tmp_path):
    target = tmp_path / "drive"
    for kind in (None, KIND):
        with pytest.raises(OutputError, match="meanwhile"), replacing(target, overwrite=False, folder=kind) as draft:
            (draft / "data.jsonl" if kind else draft).write_text("ours")
            target.write_text("theirs")
        assert tree(tmp_path) == {"drive": "theirs"}
        assert list(tmp_path.iterdir()) == [target]
        target.unlink()
    folder = write(tmp_path / "images")
    with filling(folder, overwrite=False) as draft:
        write(draft / "camera0", **{"0_png": "new"})
    write(folder, mine_txt="mine")
    with pytest.raises(OutputError, match="--overwrite"), filling(folder, overwrite=False):
        pytest.fail("must not be entered")
    with filling(folder, overwrite=True) as draft:
        write(draft / "camera0", **{"0_png": "newer"})
    with pytest.raises(DataError), filling(tmp_path / "half", overwrite=False) as draft:
        write(draft, **{"0_png": "half"})
        raise DataError("source", "", "broken")
    with pytest.raises(OutputError, match=r"1\.png: .*meanwhile"), filling(tmp_path / "b", overwrite=False) as draft:
        write(draft, **{"0_png": "ours", "1_png": "ours"})
        write(tmp_path / "b", **{"1_png": "theirs"})
    assert tree(tmp_path) == {"images/camera0/0.png": "newer", "images/mine.txt": "mine", "b/1.png": "theirs"}
    assert {path.name for path in tmp_path.iterdir()} == {"images", "b"}


@pytest.mark.parametrize(
    ("there", "named"),
    [
        (["data.jsonl", "mine.txt"], "mine.txt"),
        (["data.jsonl", "images/0.png", "images/a.png"], "images/a.png"),
        (["data.jsonl", "images/deep/0.png"], "images/deep"),
        (["data.jsonl/0.png"], "data.jsonl"),
        (["data.jsonl", "empty/"], "empty"),
        (["images/0.png"], "holds no data"),
    ],
)
def test_a_folder_with_anything_foreign_in_it_is_left_alone(tmp_path, there, named):
    target = tmp_path / "home"
    for name in there:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).mkdir() if name.endswith("/") else (target / name).touch()
    before = tree(tmp_path)
    refused(target, f"{named}.* choose another name", folder=KIND)
    assert tree(tmp_path) == before
    (write(tmp_path / "linked") / "data.jsonl").symlink_to(tmp_path / "home")
    refused(tmp_path / "linked", r"data\.jsonl", folder=KIND)


@pytest.mark.parametrize("read", ["home", "home/images/0.png", "."])
def test_a_folder_that_holds_or_lies_in_what_is_read_is_left_alone(tmp_path, read):
    target = write(tmp_path / "home", data_jsonl="old")
    write(target / "images", **{"0_png": "old"})
    source = Source(tmp_path / read)
    refused(target, "is read", folder=KIND)
    assert source.path.exists()
    del source
    with replacing(target, overwrite=True, folder=KIND) as draft:
        write(draft, data_jsonl="new")
    assert tree(tmp_path) == {"home/data.jsonl": "new"}
    # and neither is a file replaced by any name of it
    write(tmp_path, drive_sfs="old")
    (tmp_path / "link").symlink_to(tmp_path / "drive.sfs")
    source = Source(tmp_path / "link")
    with pytest.raises(OutputError, match="is read"):
        check_output(tmp_path / "drive.sfs", overwrite=True)
    with pytest.raises(OutputError, match="is read"), filling(tmp_path, overwrite=True) as draft:
        write(draft, drive_sfs="new")
    assert source.path.read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.sfs", "home", "link"]


_KILLED = r"""
import os, sys
from contextlib import suppress
from pathlib import Path
from sceneloom.errors import OutputError
from sceneloom.formats.base import output
from sceneloom.formats.base.output import FolderKind, check_output, filling, on_trial, replacing, replacing_together

job, top, exchanges = sys.argv[1], Path(sys.argv[2]), sys.argv[3] == "exchange"
kind = FolderKind("folder", (r"\w",))
names = "abc"
if not exchanges:
    output._renameat2 = lambda *_: 38

def write(folder, text):
    for name in names:
        (folder / name).write_text(text)

def run(target, text, overwrite):
    if job == "file":
        with replacing(target, overwrite=overwrite) as draft:
            draft.write_text(text)
    elif job == "folder":
        with replacing(target, overwrite=overwrite, folder=kind) as draft:
            write(draft, text)
    elif job == "filling":
        with filling(target, overwrite=overwrite) as draft:
            write(draft, text)
            (draft / "inner").mkdir()
            write(draft / "inner", text)
    elif job == "trial":
        with on_trial(target / "a", overwrite=overwrite) as (draft, accept):
            write(draft.parent, text)
            assert accept()
    elif job == "together":
        with replacing_together([target / name for name in names], overwrite=overwrite) as drafts:
            for draft in drafts:
                draft.write_text(text)

def found(target):
    "The texts of what is at a target; None where a file of it is not there."
    if job == "file":
        return [target.read_text() if target.exists() else None]
    files = [path for path in target.rglob("*") if path.is_file() and ".sceneloom" not in str(path.relative_to(target))]
    length = len(names) * (2 if job == "filling" else 1)
    return [path.read_text() for path in files] + [None] * (length - len(files))

def dies_at(k, target, overwrite):
    "Whether a process that runs the job is dead before its k-th change to the file system."
    child = os.fork()
    if child == 0:
        left = [k]
        def counted(function):
            def call(*args, **named):
                left[0] -= 1
                if left[0] < 0:
                    os.kill(os.getpid(), 9)
                return function(*args, **named)
            return call
        for name in ("mkdir", "rename", "replace", "unlink", "rmdir", "open", "write"):
            setattr(os, name, counted(getattr(os, name)))
        output._renameat2 = counted(output._renameat2)
        run(target, "new", overwrite)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -9

deaths = 0
for overwrite in (False, True):
    for k in range(500):
        location = top / f"{overwrite}-{k}"
        target = location / "target"
        location.mkdir()
        if job in ("trial", "together"):
            target.mkdir()
        if overwrite:
            run(target, "old", False)
        died = dies_at(k, target, overwrite)
        deaths += died
        hidden = location / ".target.sceneloom"
        here = found(target)
        whole = {"old", "new"} if overwrite else {None, "new"}
        assert set(here) <= whole or (None in here and {*found(hidden / "replaced")} == {"old"}), (k, here)
        check = target / "a" if job in ("trial", "together") else target
        with suppress(OutputError):
            check_output(check, overwrite=True)
        here = found(target)
        assert here in [[word] * len(here) for word in whole], (k, here)
        assert [path for path in location.rglob(".*")] == [], (k, [*location.rglob("*")])
        run(target, "next", True)
        assert set(found(target)) == {"next"}, k
        assert [path for path in location.rglob(".*")] == [], k
        if not died:
            break
print(deaths)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork to have processes that can be killed")
@pytest.mark.parametrize("exchange", ["exchange", "two renames"])
@pytest.mark.parametrize("job", ["file", "folder", "filling", "trial", "together"])
@pytest.mark.few(4)
def test_old_or_new_survives_a_kill_between_any_two_system_calls(tmp_path, job, exchange):
    command = [sys.executable, "-c", _KILLED, job, str(tmp_path), exchange]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 20


@pytest.mark.parametrize("fault", [OSError(errno.EIO, "broken"), KeyboardInterrupt()], ids=["fault", "ctrl-c"])
def test_a_second_rename_that_fails_and_what_appears_meanwhile_leave_the_old_folder(tmp_path, monkeypatch, fault):
    target = write(tmp_path / "home", data_jsonl="old")
    with pytest.raises(OutputError, match=r"mine\.txt"), replacing(target, overwrite=True, folder=KIND) as draft:
        write(draft, data_jsonl="new")
        write(target, mine_txt="mine")
    assert tree(tmp_path) == {"home/data.jsonl": "old", "home/mine.txt": "mine"}
    (target / "mine.txt").unlink()
    monkeypatch.setattr("sceneloom.formats.base.output._renameat2", lambda *_: errno.EINVAL)
    rename = Path.rename

    def failing(path: Path, to: Path) -> Path:
        if to == target and "files" in path.parts:
            raise fault
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises((OSError, OutputError, type(fault))), replacing(target, overwrite=True, folder=KIND) as draft:
        write(draft, data_jsonl="new")
    assert tree(tmp_path) == {"home/data.jsonl": "old"}


def test_the_workplace_of_a_living_process_and_a_folder_that_only_has_such_a_name_are_left_alone(tmp_path):
    target = tmp_path / "drive.sfs"
    with replacing(target, overwrite=True) as first:
        first.write_text("first")
        with replacing(target, overwrite=True) as second:
            assert first.exists()
            second.write_text("second")
        assert target.read_text() == "second"
    assert target.read_text() == "first"
    assert list(tmp_path.iterdir()) == [target]
    write(tmp_path / ".other.sfs.sceneloom", mine_txt="mine")
    before = tree(tmp_path)
    with replacing(tmp_path / "other.sfs", overwrite=False) as draft:
        draft.write_text("new")
    assert tree(tmp_path) == {**before, "other.sfs": "new"}
    # that of another machine goes when nothing was written for an hour
    workplace = tmp_path / ".new.sfs.sceneloom"
    (workplace / "files").mkdir(parents=True)
    (workplace / "lock").write_text("another machine")
    for idle, goes in ((0.0, False), (7200.0, True)):
        then = time.time() - idle
        for path in (workplace / "files", workplace / "lock", workplace):
            os.utime(path, (then, then))
        check_output(tmp_path / "new.sfs", overwrite=False)
        assert workplace.exists() is not goes


@given(st.lists(st.one_of(st.integers(), st.text(st.characters(exclude_categories=["Cs"]), max_size=300)), max_size=8))
def test_names_of_ids_are_one_part_of_a_path_and_differ_even_where_case_does_not_count(identifiers):
    stems = file_stems(identifiers)
    assert len({stem.casefold() for stem in stems}) == len(stems) == len(identifiers)
    for stem in map(file_stem, identifiers):
        assert 0 < len(stem) <= 129
        assert stem.isascii()
        assert not set(stem) & set('/\\:*?"<>|\0')
        assert not stem.startswith(".")


def test_ids_keep_what_a_file_name_can_hold():
    for identifiers, stems in (
        ((1, "1"), ["1", "1~2"]),
        (("Front", "front"), ["Front", "front~2"]),
        (("", "%"), ["%", "%25"]),
        (("a/../b", "..", "camera 0"), ["a%2F..%2Fb", "%2E.", "camera 0"]),
    ):
        assert file_stems(identifiers) == stems
