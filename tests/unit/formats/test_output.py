"""An output is there whole, or not at all."""

import os
from pathlib import Path

import pytest

from sceneloom.errors import DataError, OutputError
from sceneloom.formats.output import filling, replacing


def test_a_file_takes_its_place_when_it_is_whole(tmp_path: Path) -> None:
    target = tmp_path / "drive.sfs"
    with replacing(target, overwrite=False) as draft:
        draft.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert [path.name for path in tmp_path.iterdir()] == ["drive.sfs"]


def test_a_failure_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "drive.sfs"
    target.write_text("before")
    with pytest.raises(DataError), replacing(target, overwrite=True) as draft:
        draft.write_text("half")
        raise DataError("source", "line 3", "broken")
    assert target.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["drive.sfs"]


def test_an_existing_output_is_refused_with_the_remedy(tmp_path: Path) -> None:
    target = tmp_path / "drive.sfs"
    target.write_text("before")
    with pytest.raises(OutputError, match="--overwrite"), replacing(target, overwrite=False):
        pytest.fail("must not be entered")
    with replacing(target, overwrite=True) as draft:
        draft.write_text("after")
    assert target.read_text() == "after"


def test_a_folder_is_never_replaced_by_a_file(tmp_path: Path) -> None:
    (tmp_path / "drive.sfs").mkdir()
    with pytest.raises(OutputError, match="is a folder"), replacing(tmp_path / "drive.sfs", overwrite=True):
        pytest.fail("must not be entered")


def test_a_missing_parent_is_named(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError, match=r"nowhere does not exist"),
        replacing(tmp_path / "nowhere" / "drive.sfs", overwrite=False),
    ):
        pytest.fail("must not be entered")


def test_a_file_where_a_folder_is_expected_is_called_a_file(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("mine")
    with (
        pytest.raises(OutputError, match=r"taken is a file"),
        replacing(tmp_path / "taken" / "a", overwrite=False),
    ):
        pytest.fail("must not be entered")


@pytest.mark.parametrize("folder", [False, True], ids=["file", "folder"])
def test_what_another_program_made_meanwhile_is_not_replaced(tmp_path: Path, folder: bool) -> None:
    target = tmp_path / "drive"
    with (
        pytest.raises(OutputError, match="meanwhile"),
        replacing(target, overwrite=False, folder=folder) as draft,
    ):
        (draft / "data.jsonl" if folder else draft).write_text("ours")
        target.write_text("theirs")
    assert target.read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [target]


def test_filling_moves_nothing_where_another_program_was_quicker(tmp_path: Path) -> None:
    folder = tmp_path / "depth"
    with pytest.raises(OutputError, match=r"1\.png: .*meanwhile"), filling(folder, overwrite=False) as draft:
        (draft / "0.png").write_text("ours")
        (draft / "1.png").write_text("ours")
        folder.mkdir()
        (folder / "1.png").write_text("theirs")
    assert [path.name for path in folder.iterdir()] == ["1.png"]
    assert (folder / "1.png").read_text() == "theirs"


def test_a_fault_of_reading_is_not_called_a_fault_of_writing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "drive.sfs", overwrite=False):
        (tmp_path / "source").read_text()


def test_filling_keeps_the_strangers_in_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    with filling(folder, overwrite=False) as draft:
        (draft / "camera0").mkdir()
        (draft / "camera0" / "0.png").write_text("new")
    (folder / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"), filling(folder, overwrite=False):
        pytest.fail("must not be entered")
    with filling(folder, overwrite=True) as draft:
        (draft / "camera0").mkdir()
        (draft / "camera0" / "0.png").write_text("newer")
    assert (folder / "camera0" / "0.png").read_text() == "newer"
    assert (folder / "mine.txt").read_text() == "mine"


def test_a_failed_filling_leaves_no_trace(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    with pytest.raises(DataError), filling(folder, overwrite=False) as draft:
        (draft / "0.png").write_text("half")
        raise DataError("source", "", "broken")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a named pipe to try it on")
def test_what_is_neither_a_file_nor_a_folder_is_left_alone(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="left alone"), replacing(pipe, overwrite=True):
        pytest.fail("must not be entered")
    assert pipe.is_fifo()
