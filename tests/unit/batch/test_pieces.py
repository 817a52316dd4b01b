"""Drives in pieces: what is done in which order, what is kept, what becomes of failures."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.batch import State, run
from sceneloom.batch.jobs import Parts
from sceneloom.batch.pieces import cut_times
from sceneloom.batch.record import FOLDER, Record
from sceneloom.errors import OptionError

PARTS = Parts(seconds=1.0)


def done(place):
    return Path(place + ".done").read_text().split()


def begin_anew(place):
    Path(place + ".done").unlink()


def rows(folder):
    with Record.opened(folder) as record:
        return record.rows(), [piece for row in record.rows() for piece in record.pieces(row.number)]


def test_pieces_are_done_stage_by_stage_then_joined_and_taken_away(tmp_path, drives, job, inline):
    (place,) = drives("ab")
    summary = run(job("letters", [place], parts=PARTS), tmp_path / "out", executor=inline())
    assert (tmp_path / "out" / "ab.txt").read_text() == "AABB"
    assert done(place) == ["plan", "large0", "large1", "twice0", "twice1", "join"]
    assert (summary.total, summary.done, summary.pieces, summary.pieces_done) == (1, 1, 4, 4)
    drives_told, pieces = rows(tmp_path / "out")
    assert [row.state for row in (*drives_told, *pieces)] == [State.DONE] * 5
    assert not any((tmp_path / "out" / FOLDER / "pieces").iterdir())


def test_a_drive_that_is_no_longer_than_a_part_is_done_in_one_piece(tmp_path, drives, job, inline):
    (place,) = drives("a")
    summary = run(job("letters", [place], parts=PARTS), tmp_path / "out", executor=inline())
    assert ((tmp_path / "out" / "a.txt").read_text(), summary.pieces, done(place)) == ("a", 0, ["plan"])


def test_a_piece_that_fails_fails_its_drive_and_no_other(tmp_path, drives, job, inline):
    bad, good = drives("bad", "xy")
    wanted = job("letters", [bad, good], parts=PARTS, options={"bad": "large1"})
    summary = run(wanted, tmp_path / "out", executor=inline())
    assert (summary.done, summary.failed) == (1, 1)
    assert not (tmp_path / "out" / "bad.txt").exists()
    assert (tmp_path / "out" / "xy.txt").read_text() == "XXYY"
    (failed, _), _ = rows(tmp_path / "out")
    assert (failed.state, failed.kind) == (State.FAILED, "DataError")
    assert failed.error == f"stage 1, part 2 (large): {bad}: letter 1: not to be read"
    # what was begun already ends; the next stage does not begin
    assert set(done(bad)) <= {"plan", "large0", "large1", "large2"}


def test_a_run_is_taken_up_with_the_pieces_that_are_done(tmp_path, drives, job, inline):
    (place,) = drives("bad")
    first = job("letters", [place], parts=PARTS, options={"bad": "twice1"})
    run(first, tmp_path / "out", executor=inline())
    begin_anew(place)
    again = run(first, tmp_path / "out", executor=inline(), resume=True)
    assert (done(place), again.failed) == (["plan", "twice1"], 1)
    begin_anew(place)
    (tmp_path / "out" / FOLDER / "pieces" / "000001" / "0-00002").unlink()
    Path(place).rename(tmp_path / "in" / "other")
    Path(place).write_text("bad")  # another time: nothing that was made of it counts
    whole = job("letters", [place], parts=PARTS)
    assert run(whole, tmp_path / "out", executor=inline(), resume=True).done == 1
    assert len(done(place)) == 8
    begin_anew(place)
    assert run(whole, tmp_path / "out", executor=inline(), resume=True).skipped == 1
    assert not Path(place + ".done").exists()


def test_pieces_of_another_plan_go(tmp_path, drives, job, inline):
    (place,) = drives("bad")
    options = {"bad": "twice0"}
    run(job("letters", [place], parts=PARTS, options=options), tmp_path / "out", executor=inline())
    run(job("letters", [place], parts=Parts(count=2), options=options), tmp_path / "out", executor=inline(),
        resume=True)  # fmt: skip
    _, pieces = rows(tmp_path / "out")
    folder = tmp_path / "out" / FOLDER / "pieces" / "000001"
    assert len(pieces) == 4
    assert (
        {"0-00000", "0-00001"}
        <= {path.name for path in folder.iterdir()}
        <= {"0-00000", "0-00001", "1-00001"}
    )


@pytest.mark.parametrize("at", ["large1", "twice0"])
@pytest.mark.slow
def test_a_worker_killed_in_the_middle_costs_its_piece_only(tmp_path, drives, job, at):
    (place,) = drives("abc")
    summary = run(job("letters", [place], parts=PARTS, options={"die": [at]}), tmp_path / "out", workers=2)
    assert (summary.done, summary.retried) == (1, 1)
    assert (tmp_path / "out" / "abc.txt").read_text() == "AABBCC"
    assert sorted(done(place)) == sorted(
        ["plan", "large0", "large1", "large2", "twice0", "twice1", "twice2", "join"]
    )


def test_the_same_drive_may_be_there_twice_with_different_spans(tmp_path, drives, job, inline):
    (place,) = drives("ab")
    wanted = job("letters", [place, place], parts=PARTS)
    first, second = wanted.inputs
    wanted = replace(
        wanted, inputs=(replace(first, options={"start": 0}), replace(second, options={"start": 1}))
    )
    assert run(wanted, tmp_path / "out", executor=inline()).done == 2
    assert [path.read_text() for path in sorted((tmp_path / "out").glob("*.txt"))] == ["AABB", "AABB"]


@given(
    steps=st.lists(st.integers(1, 10**9), min_size=1, max_size=40),
    seconds=st.floats(0.01, 100.0),
)
def test_every_frame_is_in_one_span_and_none_is_empty(steps, seconds):
    times = np.cumsum(np.array(steps, np.int64)) - 10**15
    spans = cut_times(times, seconds=seconds)
    counts = [int(((times >= start) & (times < stop)).sum()) for start, stop in spans]
    assert sum(counts) == len(times)
    assert len(spans) == 1 or min(counts) > 0
    assert all(before[1] == after[0] for before, after in pairwise(spans))


def test_spans_are_about_as_long_as_asked_for_and_not_too_short_by_number():
    times = np.arange(0, 601, dtype=np.int64) * 100_000_000
    lengths = [stop - start for start, stop in cut_times(times, seconds=20.0)[1:-1]]
    assert lengths == [20_000_000_000]
    assert len(cut_times(times, count=8)) == 2
    assert len(cut_times(times, count=1)) == len(cut_times(times, seconds=50.0)) == 1
    assert len(cut_times(times[:0], seconds=1.0)) == 1


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_parts_of_no_length_are_refused(tmp_path, drives, job, inline, seconds):
    with pytest.raises(OptionError, match="positive number of seconds"):
        run(job("letters", drives("ab"), parts=Parts(seconds=seconds)), tmp_path / "out", executor=inline())
