"""Runs: order, tries, resuming, outputs in stores and further ones, damaged records, statistics, pages and secrets."""

import os
import re
import sqlite3
import threading
from contextlib import closing
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import dask
import pytest

from sceneloom.batch import Outcome, RunSummary, State, run
from sceneloom.batch.cluster import DaskCluster
from sceneloom.batch.figures import MetricsFile, RunFigures, format_metrics
from sceneloom.batch.jobs import Further
from sceneloom.batch.record import FOLDER, Record
from sceneloom.batch.running import CLAIM, ProcessPool
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.remote import stores


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


@pytest.fixture
def store(tmp_path):
    """A folder that fsspec takes for a store, which workers in other processes have, too."""
    (tmp_path / "store" / "run1").mkdir(parents=True)
    return f"local://{tmp_path}/store/run1/"


def contents(folder):
    root = Path(str(folder).removeprefix("local://"))
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.name != CLAIM)
    return {str(path.relative_to(root)): path.read_text() for path in files}


@pytest.fixture
def puts(monkeypatch):
    sent, put = [], stores.Store.put

    def noted(self, source):
        sent.append(self.path.rpartition("/")[2])
        Path(self.path).parent.mkdir(parents=True, exist_ok=True)  # stores have no folders
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", noted)
    return sent


def test_outputs_are_sent_once_and_the_record_stays_on_disk(tmp_path, drives, job, go, store, puts):
    locations, record = drives("a.sfs", "bad.sfs", "c.sfs"), tmp_path / "record"
    first = go(job("refuse", locations), store, record=record)
    assert (first.done, first.failed, first.output, first.record) == (2, 1, store, str(record))
    assert contents(store) == {"a.txt": "a.sfs", "c.txt": "c.sfs"}
    with pytest.raises(OutputError, match="--resume"):
        go(job("refuse", locations), store, record=record)
    Path(locations[2]).write_text("changed")
    os.utime(locations[2], ns=(1, 1))
    again = go(job("refuse", locations), store, record=record, resume=True)
    assert (again.skipped, again.done, again.failed) == (1, 2, 1)
    assert puts == ["a.txt", "c.txt", "c.txt"]
    assert contents(store)["c.txt"] == "changed"
    Path(store.removeprefix("local://"), "a.txt").unlink()
    go(job("refuse", locations[:1]), store, record=record, resume=True)
    assert puts[3:] == ["a.txt"]


def test_what_a_verb_writes_beside_its_output_or_further_is_sent_before_it(tmp_path, drives, job, go, store, puts):
    go(job("pair", drives("a.sfs")), store, record=tmp_path / "record")
    assert puts == ["a.loss", "a.txt"]
    for name in ("store/run1/more", "out", "depth/a"):
        (tmp_path / name).mkdir(parents=True)
    go(job("folder", drives("b.sfs"), suffix=""), f"{store}more", record=tmp_path / "two")
    assert puts[2:] == ["a.txt", "_SUCCESS"]
    further = (Further(option="depth", location=f"local://{tmp_path}/depth/", is_folder=True),)
    work, out = job("more", drives("a.sfs"), further=further), f"local://{tmp_path}/out"
    with pytest.raises(OutputError, match="depth/a: exists already"):
        go(work, out, record=tmp_path / "none")
    for name in ("depth/a", "depth"):
        (tmp_path / name).rmdir()
    (tmp_path / "out" / CLAIM).unlink()
    assert go(work, out, record=tmp_path / "three").done == 1
    assert contents(tmp_path / "depth") == {"a/0.png": "a.sfs", "a/_SUCCESS": ""}


def test_what_others_have_written_is_left_alone(tmp_path, drives, job, go, store):
    root = Path(store.removeprefix("local://"))
    go(job("copy", drives("a.sfs")), store, record=tmp_path / "record")
    b, held = job("copy", drives("b.sfs")), "holds the outputs of a run whose record is "
    for output, record, problem in (
        (store, "other", rf"{held}{tmp_path}/record on \S+"),
        (f"{store}deep", "record", "holds the record of a run with outputs in local://"),
    ):
        with pytest.raises(OutputError, match=problem):
            go(b, output, record=tmp_path / record, resume=record == "record")
    assert contents(store) == {"a.txt": "a.sfs"}
    (root / CLAIM).unlink()
    with pytest.raises(OutputError, match=r"run1/a\.txt: exists already"):
        go(job("copy", drives("a.sfs")), store, record=tmp_path / "one")
    (root / CLAIM).write_text("[")
    with pytest.raises(OutputError, match="is not the claim of a run"):
        go(b, store, record=tmp_path / "two")
    with pytest.raises(OutputError, match="web server"):
        go(b, "https://host/run1", record=tmp_path / "three")
    with pytest.raises(OptionError, match="have their record beside them"):
        go(b, record=tmp_path / "four")


def test_a_send_that_fails_is_tried_again_where_that_may_help(tmp_path, drives, job, go, store, monkeypatch):
    monkeypatch.setattr("sceneloom.batch.running._PATIENCE_SECONDS", (0.0,))
    put, faults = stores.Store.put, [PermissionError(13, "not you")]

    def failing(self, source):
        if faults:
            raise faults.pop()
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", failing)
    summary = go(job("copy", drives("a.sfs", "b.sfs")), store, record=tmp_path / "record")
    assert (summary.done, summary.failed) == (1, 1)
    with Record.opened(tmp_path / "record") as record:
        assert "a.txt: cannot be written: [Errno 13] not you" in record.rows()[0].error
    assert contents(store) == {"b.txt": "b.sfs"}


@pytest.mark.parametrize(("make", "workers"), [(ProcessPool, 2), (DaskCluster.local, 1)], ids=["pool", "dask"])
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of sockets to workers that were killed
@pytest.mark.few(1)
def test_a_killed_worker_harms_one_try_and_leaves_nothing_in_the_store_and_no_draft(
    tmp_path, drives, job, store, make, workers, monkeypatch
):
    (tmp_path / "drafts").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "drafts"))
    monkeypatch.setattr("tempfile.tempdir", None)
    # dask itself would give up a worker that is not there again at once
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1ms"}):
        work = job("die", drives("a.sfs", "b.sfs"))
        # what goes to a store dask itself tries again
        target, record = (store, tmp_path / "record") if make is ProcessPool else (tmp_path / "out", None)
        summary = run(work, target, record=record, executor=make(workers))
    assert (summary.done, summary.failed, summary.retried) == (2, 0, 2)
    made = {path.name: path.read_text() for path in (tmp_path / "out").glob("*.txt")} or contents(store)
    assert made == {"a.txt": "a.sfs", "b.txt": "b.sfs"}
    assert not list((tmp_path / "drafts").glob("sceneloom-*"))
    with Record.opened(record or target) as kept:
        assert [row.attempts for row in kept.rows()] == [2, 2]


def test_records_have_a_folder_of_their_own_for_each_location(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    found = Record.folder_for("s3://fused/run1/")
    assert found.parent == tmp_path / "sceneloom" / "runs"
    assert found.name.startswith("run1-")
    assert found == Record.folder_for("s3://fused/run1") != Record.folder_for("s3://other/run1")
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    assert Record.folder_for("s3://fused/run1").is_relative_to(Path.home() / ".local" / "state")


@pytest.fixture
def wanted(tmp_path):
    """A folder and a file, as of `--depth` and `--loss`."""
    return (
        Further(option="depth", location=str(tmp_path / "depth"), is_folder=True),
        Further(option="loss", location=str(tmp_path / "losses" / "loss.json"), is_folder=False),
    )


@pytest.mark.parametrize("far", [False, True])
def test_each_drive_has_its_own_in_the_position_of_all_on_another_disk_too(
    tmp_path, drives, job, go, wanted, far, monkeypatch
):
    stat = Path.stat

    def stat_far(self, **how):
        found = stat(self, **how)
        is_far = far and self in (tmp_path / "depth", tmp_path / "losses")
        return type(found)((*found[:2], found.st_dev + is_far, *found[3:])) if is_far else found

    monkeypatch.setattr(Path, "stat", stat_far)
    assert go(job("more", drives("a.sfs", "b.sfs"), further=wanted)).done == 2
    assert contents(tmp_path / "depth") == {"a/0.png": "a.sfs", "b/0.png": "b.sfs"}
    assert contents(tmp_path / "losses") == {"a.loss.json": "a.sfs", "b.loss.json": "b.sfs"}
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [FOLDER, "a.txt", "b.txt"]


def test_a_try_that_fails_leaves_none_and_what_is_gone_is_made_again(tmp_path, drives, job, go, wanted):
    locations = drives("a.sfs", "bad.sfs")
    first = go(job("more", locations, further=wanted))
    assert (first.done, first.failed) == (1, 1)
    assert list(contents(tmp_path / "depth")) == ["a/0.png"]
    assert go(job("more", locations[:1], further=wanted), resume=True).skipped == 1
    (tmp_path / "losses" / "a.loss.json").unlink()
    # the folder that is there gives way in one step
    (tmp_path / "depth" / "a" / "stale.png").write_text("of an earlier run")
    again = go(job("more", locations[:1], further=wanted), resume=True)
    assert (again.skipped, again.done) == (0, 1)
    assert [*contents(tmp_path / "depth"), *contents(tmp_path / "losses")] == ["a/0.png", "a.loss.json"]


def test_locations_that_cannot_be_are_refused_before_anything_is_done(tmp_path, drives, job, go, wanted):
    (tmp_path / "file").touch()
    twin = Further(option="images", location=wanted[0].location, is_folder=True)
    a_file = Further(option="depth", location=str(tmp_path / "file"), is_folder=True)
    in_a_store = Further(option="depth", location="local:///depth", is_folder=True)
    (tmp_path / "there" / "a").mkdir(parents=True)
    there = Further(option="depth", location=str(tmp_path / "there"), is_folder=True)
    for further, error, problem in (
        ((*wanted, twin), OptionError, "two outputs of one drive would go there"),
        ((a_file,), OutputError, "file: is a file"),
        ((in_a_store,), OptionError, "is in a store, and outputs go on disk"),
        ((there,), OutputError, "there/a: exists already"),
    ):
        with pytest.raises(error, match=problem):
            go(job("more", drives("a.sfs"), further=further))
        assert not list((tmp_path / "out").glob("*.txt"))
