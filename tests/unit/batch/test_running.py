"""Runs: what is due, what failed, what is taken up again."""

import os
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from sceneloom.batch import State, run
from sceneloom.batch.record import FOLDER, Record
from sceneloom.errors import DataError, OutputError


def outputs(folder):
    return {path.name: path.read_text() for path in sorted(Path(folder).iterdir()) if path.is_file()}


def rows(folder):
    with Record.opened(folder) as record:
        return {Path(row.input).name: row for row in record.rows()}


def test_every_drive_has_its_output_and_its_row(tmp_path, drives, job, inline):
    out = tmp_path / "out"
    summary = run(job("copy", drives("a.sfs", "b.sfs")), out, executor=inline())
    assert (summary.done, summary.failed, summary.left) == (2, 0, 0)
    assert outputs(out) == {"a.txt": "a.sfs", "b.txt": "b.sfs"}
    assert {row.state for row in rows(out).values()} == {State.DONE}
    with Record.opened(out) as record:
        assert record.report(1) == {"size": 5}
        assert record.reported()["verb"] == "copy"
    assert not (out / FOLDER / "drafts").exists()


def test_a_drive_that_fails_stops_no_other_and_is_reported_with_its_error(tmp_path, drives, job, inline):
    summary = run(job("refuse", drives("a.sfs", "bad.sfs", "c.sfs")), tmp_path / "out", executor=inline())
    assert (summary.done, summary.failed) == (2, 1)
    assert outputs(tmp_path / "out") == {"a.txt": "a.sfs", "c.txt": "c.sfs"}
    failed = rows(tmp_path / "out")["bad.sfs"]
    assert (failed.state, failed.kind, failed.attempts) == (State.FAILED, "DataError", 1)
    assert "line 1: 7; expected 8" in failed.error


@pytest.mark.parametrize(
    ("name", "kind", "reported"),
    [("crash", "ZeroDivisionError", "Traceback"), ("forget", "Missing", "without")],
)
def test_faults_of_a_verb_are_failures_of_the_drive(tmp_path, drives, job, inline, name, kind, reported):
    assert run(job(name, drives("a.sfs")), tmp_path / "out", executor=inline()).failed == 1
    row = rows(tmp_path / "out")["a.sfs"]
    assert (row.kind, reported in row.error) == (kind, True)


def test_what_may_pass_is_tried_again_and_only_so_often(tmp_path, drives, job, inline, monkeypatch):
    monkeypatch.setattr("sceneloom.batch.running._PATIENCE_SECONDS", (0.0,))
    once = run(job("shake", drives("a.sfs"), options={"needed": 3}), tmp_path / "out", executor=inline())
    assert (once.done, once.retried) == (1, 2)
    often = run(job("shake", drives("b.sfs"), options={"needed": 9}), tmp_path / "two", executor=inline())
    assert (often.failed, often.retried, rows(tmp_path / "two")["b.sfs"].attempts) == (1, 2, 3)


def test_a_run_is_taken_up_where_it_was_left(tmp_path, drives, job, inline):
    out, locations = tmp_path / "out", drives("a.sfs", "bad.sfs", "c.sfs")
    run(job("refuse", locations), out, executor=inline())
    with pytest.raises(OutputError, match="--resume"):
        run(job("refuse", locations), out, executor=inline())
    Path(locations[2]).write_text("changed")
    os.utime(locations[2], ns=(1, 1))
    (out / "a.txt").unlink()
    more = drives("d.sfs")
    executor = inline()
    again = run(job("refuse", [*locations, *more]), out, executor=executor, resume=True)
    # the output of a is gone, bad failed, c changed, d is new
    assert [Path(task.location).name for task in executor.tasks] == ["a.sfs", "bad.sfs", "c.sfs", "d.sfs"]
    assert (again.total, again.skipped, again.done, again.failed) == (4, 0, 3, 1)
    executor = inline()
    last = run(job("refuse", [*locations, *more]), out, executor=executor, resume=True)
    assert [Path(task.location).name for task in executor.tasks] == ["bad.sfs"]
    assert last.skipped == 3
    assert outputs(out)["c.txt"] == "changed"


def test_other_options_make_everything_anew(tmp_path, drives, job, inline):
    locations = drives("a.sfs")
    run(job("copy", locations), tmp_path / "out", executor=inline())
    again = run(
        job("copy", locations, options={"more": "!"}), tmp_path / "out", executor=inline(), resume=True
    )
    assert (again.skipped, outputs(tmp_path / "out")) == (0, {"a.txt": "a.sfs!"})


def test_outputs_that_are_folders_replace_those_that_were_there(tmp_path, drives, job, inline):
    locations = drives("a.sfs")
    run(job("folder", locations, suffix=""), tmp_path / "out", executor=inline())
    Path(locations[0]).write_text("new")
    run(job("folder", locations, suffix=""), tmp_path / "out", executor=inline(), resume=True)
    assert (tmp_path / "out" / "a" / "a.txt").read_text() == "new"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [FOLDER, "a"]


def test_files_that_are_no_output_of_the_run_are_left_alone(tmp_path, drives, job, inline):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"a\.txt: exists already"):
        run(job("copy", drives("a.sfs")), tmp_path / "out", executor=inline())
    assert outputs(tmp_path / "out") == {"a.txt": "mine"}


def test_two_runs_do_not_share_a_folder(tmp_path, drives, job, inline):
    with Record.held(tmp_path / "out"), pytest.raises(OutputError, match="another run"):
        run(job("copy", drives("a.sfs")), tmp_path / "out", executor=inline())


def test_a_damaged_record_is_an_error_that_names_it(tmp_path, drives, job, inline):
    (tmp_path / "out" / FOLDER).mkdir(parents=True)
    (tmp_path / "out" / FOLDER / "record.sqlite").write_text("no database at all, but text " * 50)
    with pytest.raises(DataError, match=r"record\.sqlite"):
        run(job("copy", drives("a.sfs")), tmp_path / "out", executor=inline())
    with pytest.raises(DataError, match=r"record\.sqlite"), Record.opened(tmp_path / "out"):
        pass
    with pytest.raises(DataError, match="no record of a run"), Record.opened(tmp_path):
        pass


@pytest.mark.parametrize(
    ("damage", "reported"),
    [
        ("UPDATE drives SET state = 'odd'", "drives: 1: Invalid enum value 'odd'"),
        ("UPDATE drives SET part = '{'", "drives: 1: is no JSON"),
        ("UPDATE drives SET input = x'ff'", "drives: 1: Expected `str`"),
        ("UPDATE run SET value = '{'", "run: version: is no JSON"),
        ("DROP TABLE drives", "no such table"),
    ],
)
def test_a_damaged_row_of_a_record_is_named(tmp_path, damage, reported):
    with Record.held(tmp_path) as record:
        record.add([("a.sfs", {}, "a.txt")])
    with closing(sqlite3.connect(tmp_path / FOLDER / "record.sqlite")) as database:
        database.execute(damage)
        database.commit()
    with pytest.raises(DataError) as caught, Record.opened(tmp_path) as record:
        record.rows()
    assert f"record.sqlite: {reported}" in str(caught.value)


def test_a_lock_that_cannot_be_opened_is_an_error_of_the_output(tmp_path):
    (tmp_path / FOLDER / "lock.sqlite").mkdir(parents=True)
    with pytest.raises(OutputError, match="cannot be written"), Record.held(tmp_path):
        pass


def test_what_stops_a_run_leaves_no_half_output_and_no_lock(tmp_path, drives, job, inline):
    locations = drives("a.sfs", "b.sfs")

    def stopped(_summary, _outcome):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(job("copy", locations), tmp_path / "out", executor=inline(), reported=stopped)
    assert not (tmp_path / "out" / FOLDER / "drafts").exists()
    again = run(job("copy", locations), tmp_path / "out", executor=inline(), resume=True)
    assert (again.done, again.skipped) == (2, 1)
