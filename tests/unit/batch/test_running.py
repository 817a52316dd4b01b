"""Runs: order, tries, resuming, damaged records, statistics, pages, metrics and secrets."""

import os
import re
import sqlite3
import threading
from contextlib import closing
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from sceneloom.batch import Outcome, RunSummary, State
from sceneloom.batch.figures import MetricsFile, RunFigures, format_metrics
from sceneloom.batch.record import FOLDER, Record
from sceneloom.errors import DataError, OptionError, OutputError


def outputs(folder):
    return {path.name: path.read_text() for path in sorted(Path(folder).iterdir()) if path.is_file()}


def rows(folder):
    with Record.opened(folder) as record:
        return {Path(row.input).name: row for row in record.rows()}


def test_every_drive_has_its_output_or_its_error_and_its_row(tmp_path, drives, job, go):
    out, metrics = tmp_path / "out", MetricsFile(tmp_path / "batch.prom")
    summary = go(job("refuse", drives("a.sfs", "bad.sfs", "c.sfs")), reported=metrics.reported)
    assert (summary.done, summary.failed, summary.left) == (2, 1, 0)
    assert outputs(out) == {"a.txt": "a.sfs", "c.txt": "c.sfs"}
    found = rows(out)
    states = {name: row.state for name, row in found.items()}
    assert states == {"a.sfs": State.DONE, "bad.sfs": State.FAILED, "c.sfs": State.DONE}
    assert (found["bad.sfs"].kind, found["bad.sfs"].attempts) == ("DataError", 1)
    assert "line 1: 7; expected 8" in found["bad.sfs"].error
    with Record.opened(out) as record:
        assert (record.report(1), record.reported()["verb"]) == ({"size": 5}, "refuse")
    assert not (out / FOLDER / "drafts").exists()
    text = (tmp_path / "batch.prom").read_text()
    assert {("done", "2"), ("failed", "1")} <= set(re.findall(r'state="(\w+)"} (\d+)', text))
    assert [path.name for path in tmp_path.glob("*.prom*")] == ["batch.prom"]


def test_faults_of_a_verb_are_failures_and_what_may_pass_is_tried_again_only_so_often(
    tmp_path, drives, job, go, monkeypatch
):
    monkeypatch.setattr("sceneloom.batch.running._PATIENCE_SECONDS", (0.0,))
    for name, kind, reported in (("crash", "ZeroDivisionError", "Traceback"), ("forget", "Missing", "without")):
        assert go(job(name, drives("a.sfs")), name).failed == 1
        row = rows(tmp_path / name)["a.sfs"]
        assert (row.kind, reported in row.error) == (kind, True)
    once = go(job("shake", drives("a.sfs"), options={"needed": 3}))
    assert (once.done, once.retried) == (1, 2)
    often = go(job("shake", drives("b.sfs"), options={"needed": 9}), "two")
    assert (often.failed, often.retried, rows(tmp_path / "two")["b.sfs"].attempts) == (1, 2, 3)


def test_a_run_is_taken_up_where_it_was_left_and_made_anew_with_other_options(tmp_path, drives, job, go):
    out, locations = tmp_path / "out", drives("a.sfs", "bad.sfs", "c.sfs")
    go(job("refuse", locations))
    with pytest.raises(OutputError, match="--resume"):
        go(job("refuse", locations))
    Path(locations[2]).write_text("changed")
    os.utime(locations[2], ns=(1, 1))
    (out / "a.txt").unlink()
    every = [*locations, *drives("d.sfs")]
    again = go(job("refuse", every), resume=True)
    # the output of a is gone, bad failed, c changed, d is new
    assert go.drives == ["a.sfs", "bad.sfs", "c.sfs", "d.sfs"]
    assert (again.total, again.skipped, again.done, again.failed) == (4, 0, 3, 1)
    last = go(job("refuse", every), resume=True)
    assert (go.drives, last.skipped, outputs(out)["c.txt"]) == (["bad.sfs"], 3, "changed")
    other = go(job("refuse", every, options={"more": "!"}), resume=True)
    assert (other.skipped, outputs(out)["a.txt"]) == (0, "a.sfs!")


def test_files_and_folders_of_others_are_left_alone_and_folders_of_ours_replaced(tmp_path, drives, job, go):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.txt").write_text("mine")
    locations = drives("a.sfs")
    work = job("copy", locations)
    with pytest.raises(OutputError, match=r"a\.txt: exists already"):
        go(work)
    assert outputs(tmp_path / "out") == {"a.txt": "mine"}
    with Record.held(tmp_path / "two"), pytest.raises(OutputError, match="another run"):
        go(work, "two")
    (tmp_path / "three" / FOLDER / "lock.sqlite").mkdir(parents=True)
    with pytest.raises(OutputError, match="cannot be written"):
        go(work, "three")
    go(job("folder", locations, suffix=""), "four")
    Path(locations[0]).write_text("new")
    go(job("folder", locations, suffix=""), "four", resume=True)
    assert (tmp_path / "four" / "a" / "a.txt").read_text() == "new"
    assert sorted(path.name for path in (tmp_path / "four").iterdir()) == [FOLDER, "a"]


def test_what_stops_a_run_leaves_no_half_output_and_no_lock(tmp_path, drives, job, go):
    def stopped(_summary, _outcome):
        raise KeyboardInterrupt

    work = job("copy", drives("a.sfs", "b.sfs"))
    with pytest.raises(KeyboardInterrupt):
        go(work, reported=stopped)
    assert not (tmp_path / "out" / FOLDER / "drafts").exists()
    again = go(work, resume=True)
    assert (again.done, again.skipped) == (2, 1)


def test_a_damaged_or_missing_record_is_an_error_that_names_it(tmp_path, drives, job, go):
    out = tmp_path / "out"
    (out / FOLDER).mkdir(parents=True)
    (out / FOLDER / "record.sqlite").write_text("no database at all, but text " * 50)
    with pytest.raises(DataError, match=r"record\.sqlite"):
        go(job("copy", drives("a.sfs")))
    for folder, problem in ((out, r"record\.sqlite"), (tmp_path, "no record of a run")):
        with pytest.raises(DataError, match=problem), Record.opened(folder):
            pass
    for k, (damage, reported) in enumerate(
        (
            ("UPDATE drives SET state = 'odd'", "drives: 1: Invalid enum value 'odd'"),
            ("UPDATE drives SET part = '{'", "drives: 1: is no JSON"),
            ("UPDATE drives SET input = x'ff'", "drives: 1: Expected `str`"),
            ("UPDATE run SET value = '{'", "run: version: is no JSON"),
            ("DROP TABLE drives", "no such table"),
        )
    ):
        folder = tmp_path / str(k)
        with Record.held(folder) as record:
            record.add([("a.sfs", {}, "a.txt")])
        with closing(sqlite3.connect(folder / FOLDER / "record.sqlite")) as database:
            database.execute(damage)
            database.commit()
        with pytest.raises(DataError) as caught, Record.opened(folder) as record:
            record.rows()
        assert f"record.sqlite: {reported}" in str(caught.value)


SECOND = 10**9


@pytest.fixture
def folder(tmp_path):
    """A run of 9 drives, one each second for 2 s of its own, of which two failed alike; a tenth is waiting."""
    with Record.held(tmp_path / "out") as record:
        record.keep("verb", "fuse")
        record.keep("sceneloom", "1.2.3")
        record.add([(f"in/{k}.sfs", {}, f"{k}.sfs") for k in range(1, 11)])
        for k in range(1, 10):
            record.begin(k, 1 + (k == 3))
            failed = k in {4, 8}
            stages = {"stages": {"reading": 0.5, "fusing": 0.5}} if k == 9 else {}
            outcome = Outcome(
                number=k, seconds=2.0 + (k == 5), processor_seconds=1.5, peak_bytes=k * 10**6, worker=f"host:{k % 2}",
                kind="DataError" if failed else "", error=f"in/{k}.sfs: line {k}: <7>; expected 8" if failed else "",
                report=None if failed else {"seconds": 1.25} | stages,
            )  # fmt: skip
            record.end(outcome, State.FAILED if failed else State.DONE, finished_ns=(100 + k) * SECOND)
    return tmp_path / "out"


def test_figures_are_those_of_the_record(folder):
    figures = RunFigures.read(folder)
    assert figures.states == {"waiting": 1, "running": 0, "done": 7, "failed": 2}
    assert (figures.begun_ns, figures.ended_ns, figures.seconds) == (99 * SECOND, 109 * SECOND, 10.0)
    assert figures.tries == 10
    assert figures.slowest[0] == ("in/5.sfs", 3.0)
    (cause,) = figures.causes
    assert cause == ("DataError", "in/4.sfs: line 4: <7>; expected 8", ("in/4.sfs", "in/8.sfs"))
    assert figures.workers == (("host:0", 4, 8.0, 6.0, 8 * 10**6), ("host:1", 5, 11.0, 7.5, 9 * 10**6))
    # seven done: six of 1.25 s each at work, 0.75 s each beside it, and one of them a second more; one with its stages
    assert figures.stages == pytest.approx(
        {"the verb at work": 6 * 1.25, "everything else": 6 * 0.75 + 1.0 + 1.0, "reading": 0.5, "fusing": 0.5}
    )


def test_the_page_shows_them_and_asks_for_nothing(folder, tmp_path):
    with Record.held(tmp_path / "begun") as record:
        record.add([("a.sfs", {}, "a.sfs")])
    begun = RunFigures.read(tmp_path / "begun")
    assert (begun.seconds, begun.workers) == (0.0, ())
    begun.write_page(tmp_path / "begun.html")
    assert "1 waiting" in (tmp_path / "begun.html").read_text("utf-8")
    RunFigures.read(folder).write_page(tmp_path / "run.html")
    text = (tmp_path / "run.html").read_text("utf-8")
    asked, open_tags, texts, reader = [], [], [], HTMLParser()

    def end(tag):
        assert open_tags.pop() == tag

    def begin(tag, attributes):
        open_tags.extend([tag] if tag != "meta" else [])
        asked.extend(value for name, value in attributes if name in {"src", "href", "srcset", "data"})

    reader.handle_starttag, reader.handle_endtag, reader.handle_data = begin, end, texts.append
    reader.feed(text)
    assert (open_tags, asked) == ([], [])
    assert not re.search(r"url\(|@import|<script", text)
    shown = " ".join(texts)
    for reported in ("fuse over 10 drives", "7 done, 2 failed", "10 tries", "54.0 drives a minute",
                 "DataError: in/4.sfs: line 4: <7>; expected 8", "host:1"):  # fmt: skip
        assert reported in shown
    assert "<td>in/5.sfs</td><td>3.0</td>" in text
    with pytest.raises(OutputError, match="exists already"):
        RunFigures.read(folder).write_page(tmp_path / "run.html")


def test_text_for_prometheus_has_a_type_for_each_figure_and_escaped_labels():
    summary = RunSummary(
        output='o"u\\t\n', record="r", verb="fuse", total=9, done=4, failed=1, retried=2, seconds=8.5,
        processor_seconds=16.0,
    )  # fmt: skip
    text = format_metrics(summary, peak_bytes=7, stages={'read"ing': 1.5}, now=12.0)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    run = r'verb="fuse",output="o\"u\\t\n"'
    assert f'sceneloom_batch_drives{{{run},state="left"}} 4' in lines
    assert f"sceneloom_batch_retries_total{{{run}}} 2" in lines
    assert rf'sceneloom_batch_stage_seconds_total{{{run},stage="read\"ing"}} 1.5' in lines
    assert f"sceneloom_batch_updated_timestamp_seconds{{{run}}} 12.0" in lines
    assert {line.split("{")[0] for line in lines} == set(re.findall(r"# TYPE (\S+) (?:gauge|counter)", text))


@pytest.fixture
def web(tmp_path):
    """A web server over a folder, the requests to it, and addresses in it that a secret signs."""
    asked = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            asked.append((self.command, self.path))

    (tmp_path / "web").mkdir()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(tmp_path / "web")))
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()

    def signed(secret, *names):
        query = f"X-Amz-Signature={secret}&X-Amz-Date={secret}&Expires={secret}"
        return [f"http://127.0.0.1:{server.server_port}/{name}?{query}" for name in names]

    yield tmp_path / "web", asked, signed
    server.shutdown()
    server.server_close()
    thread.join()
    __import__("fsspec").filesystem("http").clear_instance_cache()


def test_no_secret_is_kept_or_reported_anywhere(tmp_path, job, go, web):
    folder, _, signed = web
    (folder / "a.sfs").write_text("one")
    reported, metrics = [], MetricsFile(tmp_path / "run.prom")
    locations = signed("hush", "a.sfs", "bad.sfs", "odd.sfs", "gone.sfs")

    def notify(summary, outcome):
        reported.append(repr((summary, outcome)))
        metrics.reported(summary, outcome)

    summary = go(job("fetch", locations, options={"truth": locations[0]}, retries=0), reported=notify)
    assert (summary.done, summary.failed) == (1, 3)
    assert (tmp_path / "out" / "a.txt").read_text() == "one"
    RunFigures.read(tmp_path / "out").write_page(tmp_path / "run.html")
    with Record.opened(tmp_path / "out") as record:
        reported += [repr((row, record.report(row.number))) for row in record.rows()]
        assert "X-Amz-Signature=***" in record.rows()[0].input
        assert record.report(1)["inner"][0]["reported"].startswith("read http")
    reported += [path.read_bytes().decode("latin-1") for path in tmp_path.rglob("*") if path.is_file()]
    assert len(reported) > 8
    assert not any("hush" in text for text in reported)
    with pytest.raises(OptionError, match="differ in secrets only") as caught:
        go(job("fetch", signed("one", "a.sfs") + signed("two", "a.sfs")), "other")
    assert "one" not in str(caught.value).replace("done", "")
    assert Record.folder_for("s3://me:hush@bucket/x?token=hush") == Record.folder_for(
        "s3://me:other@bucket/x?token=new"
    )
    assert "hush" not in str(Record.folder_for("s3://bucket/x?token=hush"))


def test_drives_are_known_again_when_they_are_signed_anew_and_looked_at_without_reading(tmp_path, job, go, web):
    folder, asked, signed = web
    for name in ("a.sfs", "b.sfs"):
        (folder / name).write_text(name)
    go(job("fetch", signed("first", "a.sfs", "b.sfs")))
    (folder / "b.sfs").write_text("other content")
    asked.clear()
    summary = go(job("fetch", signed("second", "a.sfs", "b.sfs")), resume=True)
    assert (summary.skipped, summary.done) == (1, 2)
    assert [drive.partition("&")[0] for drive in go.drives] == ["b.sfs?X-Amz-Signature=second"]
    assert {command for command, path in asked if path.startswith("/a.sfs")} == {"HEAD"}
    assert (tmp_path / "out" / "b.txt").read_text() == "other content"
