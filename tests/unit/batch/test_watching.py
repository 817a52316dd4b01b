"""Figures of a run, the page of them, and text for Prometheus."""

import re
from html.parser import HTMLParser

import pytest

from sceneloom.batch import Outcome, RunSummary, run
from sceneloom.batch.jobs import State
from sceneloom.batch.record import Record
from sceneloom.batch.running import MetricsFile, format_metrics, read_figures, write_page
from sceneloom.errors import OutputError

SECOND = 10**9


@pytest.fixture
def folder(tmp_path):
    """A run of 9 drives, one each second for 2 s of its own, of which two failed alike; a tenth is waiting."""
    with Record.held(tmp_path / "out") as record:
        record.notify("verb", "fuse")
        record.notify("sceneloom", "1.2.3")
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
    figures = read_figures(folder)
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


class Reader(HTMLParser):
    """What a page shows, and what it would ask for."""

    def __init__(self):
        super().__init__()
        self.texts, self.asked, self.open = [], [], []

    def handle_starttag(self, tag, attrs):
        self.open += [tag] if tag != "meta" else []
        self.asked += [value for name, value in attrs if name in {"src", "href", "srcset", "data"}]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


def test_the_page_shows_them_and_asks_for_nothing(folder, tmp_path):
    write_page(read_figures(folder), tmp_path / "run.html")
    reader = Reader()
    text = (tmp_path / "run.html").read_text("utf-8")
    reader.feed(text)
    assert (reader.open, reader.asked) == ([], [])
    assert not re.search(r"url\(|@import|<script", text)
    shown = " ".join(reader.texts)
    for reported in ("fuse over 10 drives", "7 done, 2 failed", "10 tries", "54.0 drives a minute",
                 "DataError: in/4.sfs: line 4: <7>; expected 8", "host:1"):  # fmt: skip
        assert reported in shown
    assert "<td>in/5.sfs</td><td>3.0</td>" in text
    with pytest.raises(OutputError, match="exists already"):
        write_page(read_figures(folder), tmp_path / "run.html")


def test_a_run_that_has_only_begun_has_a_page(tmp_path):
    with Record.held(tmp_path / "out") as record:
        record.add([("a.sfs", {}, "a.sfs")])
    figures = read_figures(tmp_path / "out")
    assert (figures.seconds, figures.workers) == (0.0, ())
    write_page(figures, tmp_path / "run.html")
    assert "1 waiting" in (tmp_path / "run.html").read_text("utf-8")


def test_text_for_prometheus_has_a_type_for_each_figure_and_escaped_labels():
    summary = RunSummary(
        output='o"u\\t\n',
        record="r",
        verb="fuse",
        total=9,
        done=4,
        failed=1,
        retried=2,
        seconds=8.5,
        processor_seconds=16.0,
    )
    text = format_metrics(summary, peak_bytes=7, stages={'read"ing': 1.5}, now=12.0)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    run = r'verb="fuse",output="o\"u\\t\n"'
    assert f'sceneloom_batch_drives{{{run},state="left"}} 4' in lines
    assert f"sceneloom_batch_retries_total{{{run}}} 2" in lines
    assert rf'sceneloom_batch_stage_seconds_total{{{run},stage="read\"ing"}} 1.5' in lines
    assert f"sceneloom_batch_updated_timestamp_seconds{{{run}}} 12.0" in lines
    assert {line.split("{")[0] for line in lines} == set(re.findall(r"# TYPE (\S+) (?:gauge|counter)", text))


def test_the_file_of_metrics_ends_with_what_the_run_ended_with(tmp_path, drives, job, inline):
    file = MetricsFile(tmp_path / "batch.prom")
    run(
        job("refuse", drives("a.sfs", "bad.sfs", "c.sfs")),
        tmp_path / "out",
        executor=inline(),
        reported=file.reported,
    )
    text = (tmp_path / "batch.prom").read_text()
    assert 'state="done"} 2' in text
    assert 'state="failed"} 1' in text
    assert [path.name for path in tmp_path.glob("*.prom*")] == ["batch.prom"]
