"""`sceneloom batch` and `catalog`: one verb over many drives, on disk and in stores, and their tables."""

import json
import shutil
import socket
import struct
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import click
import numpy as np
import pytest
from tests.malformed.mutants import mutant_of, sound_scene

import sceneloom
from sceneloom.cli.batch import BATCHED, verb_named
from sceneloom.formats.remote import stores
from sceneloom.scene.scene import time_span


def test_a_catalogue_is_built_updated_and_asked(call, recording, tmp_path):
    folder = tmp_path / "catalogue"
    outcome = call("catalog build", recording, tmp_path / "missing", "-o", folder)
    assert (outcome.code, "1 scene: 1 new, 1 failed" in outcome.out) == (1, True)
    assert f"failed: {tmp_path / 'missing'}: no such file or folder" in outcome.err
    assert "1 unchanged" in call("catalog update", folder).out
    reported = call("catalog query", folder, "--speed", 0, "inf", "--as", "list")
    assert [json.loads(line)["path"] for line in reported.out.splitlines()] == [str(recording)]
    rows = json.loads(call("catalog query", folder, "--sql", "SELECT sensor FROM sensors", "--json").out)
    assert {"sensor": "lidar"} in rows
    table = call("catalog query", folder, "--show", "drives").out.splitlines()
    assert table[0].split() == ["path", "seconds", "spans", "moments", "most"]
    lines = call("catalog query", folder, "--sql", "SELECT 1 AS one, NULL AS two", "--as", "csv").out
    assert lines == "one,two\n1,\n"


def test_filters_beside_sql_what_is_no_catalogue_and_outputs_in_lists_are_refused(refuses, recording, tmp_path):
    refuses(2, "--sql", "catalog query", tmp_path, "--sql", "SELECT 1", "--label", "car")
    refuses(1, "holds no catalogue", "catalog query", tmp_path, "--label", "car")
    refuses(2, "NAME=VALUE", "catalog query", tmp_path, "--attribute", "rain")
    line = {"path": str(recording), "reading": {"output": str(tmp_path / "elsewhere.sfs")}}
    (tmp_path / "list.jsonl").write_text(json.dumps(line))
    refuses(1, "'output'", "batch convert --list", tmp_path / "list.jsonl", "-o", tmp_path / "out", "--workers", 1)
    assert not (tmp_path / "elsewhere.sfs").exists()


def test_a_list_says_how_its_drives_are_opened(call, succeeds, recording, tmp_path):
    both, fleet = tmp_path / "kitti", tmp_path / "fleet"
    for name in ("0001", "0002"):
        how = ("--to", "kitti-tracking", "--output-option", f"sequence={name}")
        succeeds("convert", recording, tmp_path / name, *how)
        shutil.copytree(tmp_path / name, both, dirs_exist_ok=True)
    succeeds("catalog build", both, "-o", fleet, "--input-option", "sequence=0001")
    succeeds("catalog update", fleet, both, "--input-option", "sequence=0002")
    assert "2 scenes: 2 unchanged" in call("catalog update", fleet, both).out
    reported = call("catalog query", fleet, "--speed", 0, "inf", "--show", "drives", "--as", "list").out
    readings = [json.loads(line)["reading"] for line in reported.splitlines()]
    assert readings == [{"sequence": "0001"}, {"sequence": "0002"}]
    (tmp_path / "list.jsonl").write_text(reported)
    succeeds("batch convert --list", tmp_path / "list.jsonl", "-o", tmp_path / "out", "--workers", 1)
    names = sorted(file.name for file in (tmp_path / "out").glob("*.sfs"))
    assert names == ["kitti_0001.sfs", "kitti_0002.sfs"]
    again = call("batch convert", both, "-o", tmp_path / "out", "--workers", 1, "--resume")
    assert (again.code, "2 of them before and unchanged" in again.out) == (0, True), again.err
    assert f"{both}: 2 drives; --sequence chooses one\n" in again.err
    assert "2 unchanged" in call("catalog update", fleet, "--list", tmp_path / "list.jsonl").out
    saved = call("view --list", tmp_path / "list.jsonl", "--save", tmp_path / "both.rrd", "--json")
    roots = [drive["root"] for drive in json.loads(saved.out)["drives"]]
    assert (saved.code, roots) == (0, [r"/kitti\ 0001", r"/kitti\ 0002"])


def test_drives_are_checked_side_by_side_and_those_that_fail_are_named(call, refuses, reported, recording, tmp_path):
    missing, out = tmp_path / "missing", tmp_path / "out"
    stated = f"failed: {missing}: no such file or folder"
    outcome = refuses(1, stated, "batch validate", recording, missing, "-o", out, "--workers", 1, "--quick")
    assert "validate: 2 drives" in outcome.out
    assert "1 done, 1 failed" in outcome.out
    report = json.loads((out / f"{recording.name}.json").read_text())
    assert (report["source"], "stages" in report) == (str(recording), False)
    status = json.loads(call("batch status", out, "--json").out)
    assert [row["state"] for row in status["drives"]] == ["done", "failed"]
    assert set(status["stages"]) == {"opening", "checking", "everything else"}
    shown = call("batch status", out, "--html", tmp_path / "run.html").out
    assert "checking 0." in shown
    assert f"page: {tmp_path / 'run.html'}" in shown
    assert reported("batch validate", recording, "-o", out, "--quick", "--resume")["skipped"] == 1


@pytest.mark.usefixtures("inline")
def test_parts_of_drives_are_those_of_a_list_or_of_the_options(succeeds, reported, recording, tmp_path):
    parts = tmp_path / "parts.jsonl"
    with sceneloom.open(recording) as scene:
        times = scene.lidars[0].frames.timestamps_ns
        start = round(int(times[1] - time_span(scene)[0]) / 1e9, 3)
    parts.write_text(json.dumps({"path": str(recording), "start": start, "stop": start + 0.1}))
    succeeds("batch convert -o", tmp_path / "out", "--list", parts, "--workers", 1)
    with sceneloom.open(tmp_path / "out" / f"{recording.name}_start{start:g}_stop{start + 0.1:g}.sfs") as part:
        assert part.lidars[0].frames.timestamps_ns.tolist() == [times[1]]
    words = ("--start", start, "--stop", start + 0.1, "--quick")
    sensors = reported("report", recording, *words)["summary"]["sensors"]
    assert [sensor["count"] for sensor in sensors if sensor["type"] == "lidar"] == [1]
    checked = reported("validate", recording, *words)
    assert (checked["passed"], checked["profile"]) == (True, "sfs")


@pytest.mark.usefixtures("inline")
def test_what_is_written_beside_the_output_is_of_each_drive_its_own(succeeds, recording, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(recording, other)
    depth = ("--depth", tmp_path / "depth")
    succeeds("batch fuse", recording, other, "-o", tmp_path / "out", *depth, "--workers", 1)
    succeeds("fuse", recording, "--depth", tmp_path / "alone")

    def files(folder):
        return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    assert sorted(path.name for path in (tmp_path / "depth").iterdir()) == [recording.name, "other"]
    for name in (recording.name, "other"):
        assert files(tmp_path / "depth" / name) == files(tmp_path / "alone")


@pytest.mark.usefixtures("inline")
def test_each_drive_has_its_own_files(call, refuses, succeeds, tmp_path):
    poses = "1 0 0 {0} 0 1 0 0 0 0 1 0\n1 0 0 {0} 0 1 0 1 0 0 1 0\n"
    for k, name in enumerate(("a", "b")):
        (tmp_path / f"{name}.kitti").write_text(poses.format(k))
        (tmp_path / f"{name}.times").write_text(f"{k}.5\n{k}.75\n")
    words = ("-o", tmp_path / "out", "--suffix", ".tum", "--to", "tum", "--json")
    times = ("--from-times", "{folder}/{name}.times")
    succeeds("batch convert", tmp_path / "*.kitti", *times, *words)

    def beginning(name):
        lines = (tmp_path / "out" / f"{name}.tum").read_text().splitlines()
        return next([float(word) for word in line.split()[:2]] for line in lines if line[0] != "#")

    assert [beginning("a"), beginning("b")] == [[0.5, 0.0], [1.5, 1.0]]
    (tmp_path / "list").write_text('{"path": "a.kitti", "from_times": "b.times"}\n{"path": "b.kitti"}\n')
    listed = call("batch convert --list", tmp_path / "list", *times, *words, "--resume")
    assert [json.loads(listed.out)[name] for name in ("done", "skipped")] == [2, 1]
    assert beginning("a") == [1.5, 0.0]
    (tmp_path / "b.times").unlink()
    refuses(1, f"--from-times of {tmp_path}/b.kitti", "batch convert", tmp_path / "*.kitti", *times, *words, "--resume")


@pytest.mark.parametrize("name", BATCHED)
def test_every_file_that_a_verb_reads_or_writes_beside_a_drive_is_known_to_batches(name):
    batched, options = BATCHED[name], verb_named(name).params
    read = {option.name for option in options if isinstance(option.type, click.Path) or option.name == "detectors"}
    assert read == {*batched.beside}
    written = {option.name for option in options if option.type.name == "target"}
    assert written - {batched.output} == {*batched.folders, *batched.files}


def test_options_of_the_verb_are_those_of_the_run_and_the_record_is_found_by_the_address(
    call, refuses, succeeds, recording, tmp_path, monkeypatch
):
    reported = call("batch convert --help").out
    assert ("--images" in reported, "--overwrite" in reported) == (True, False)
    refuses(2, "aligned", "batch convert", tmp_path, "-o", tmp_path / "out", "--images", "aligned")
    refuses(2, "fits this pattern", "batch fuse", tmp_path / "*.sfs", "-o", tmp_path / "out")
    (tmp_path / "run1").mkdir()
    store = f"local://{tmp_path}/run1"
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    done = succeeds("batch validate", recording, "-o", store, "--workers", 1, "--quick")
    assert f"outputs: {store}" in done.out
    assert f"record: {tmp_path}/state/sceneloom/runs/run1-" in done.out
    assert {path.name for path in (tmp_path / "run1").iterdir()} == {".sceneloom-run", f"{recording.name}.json"}
    reported = call("batch status", store, "--json")
    assert [row["state"] for row in json.loads(reported.out)["drives"]] == ["done"]
    refuses(1, "web server", "batch validate", recording, "-o", "https://host/run", "--quick")


FAULTS = ("404", "500", "garbage", "short", "long", "stall", "loop", "reset", "none")


class Web:
    """A drive at every address: whole, or as the first part of the address says."""

    def __init__(self, content, forget):
        self.content, self.forget = content, forget
        self.free, self.well, self.mutants = threading.Event(), False, {}
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self.server.handle_error = lambda *_: None
        self.server.daemon_threads = True
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True)
        self.thread.start()

    def url(self, name):
        return f"http://127.0.0.1:{self.server.server_port}/{name}.sfs"

    def close(self):
        self.free.set()
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()

    def _handler(self):
        web = self

        class Handler(BaseHTTPRequestHandler):
            def do_HEAD(self):
                self._answer(reported=False)

            def do_GET(self):
                self._answer(reported=True)

            def _answer(self, *, reported):
                name = "whole" if web.well else self.path[1:].removesuffix(".sfs")
                self.close_connection = True
                if name in ("404", "500"):
                    self.send_error(int(name))
                elif name == "stall" and reported:
                    web.free.wait(30)
                elif name == "reset":
                    self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    self.connection.close()
                elif name == "loop":
                    self._head(302, {"Location": self.path, "Content-Length": "0"})
                else:
                    garbage = b"\x00garbage\xff" * 500
                    self._send(name, garbage if name == "garbage" else web.mutants.get(name, web.content), reported)

            def _head(self, code, headers):
                self.send_response(code)
                for header in headers.items():
                    self.send_header(*header)
                self.end_headers()

            def _send(self, name, content, reported):
                start, stop, ranges = 0, len(content), {} if name == "none" else {"Accept-Ranges": "bytes"}
                asked = self.headers.get("Range", "") if ranges else ""
                if asked.startswith("bytes="):
                    first, _, last = asked[6:].partition("-")
                    start, stop = int(first or 0), min(int(last or stop - 1) + 1, stop)
                if asked:
                    ranges["Content-Range"] = f"bytes {start}-{stop - 1}/{len(content)}"
                length = stop - start + (1000 if name == "long" else 0)
                self._head(206 if asked else 200, {**ranges, "Content-Length": str(length)})
                if reported:
                    self.wfile.write(content[start:stop][: (stop - start) // 2 if name == "short" else None])

            def log_message(self, *_):
                pass

        return Handler


@pytest.fixture
def web(tmp_path, monkeypatch):
    fsspec, _ = (pytest.importorskip(n, reason="the extra `cloud` is not installed") for n in ("fsspec", "aiohttp"))
    monkeypatch.setattr("sceneloom.formats.remote.stores.time.sleep", lambda _: None)
    quick = stores.Patience(tries=2, deadline=5.0, answer=0.3)
    monkeypatch.setattr("sceneloom.formats.remote.stores._PATIENCE", quick)
    sceneloom.write(sound_scene(), tmp_path / "drive.sfs")
    found = Web((tmp_path / "drive.sfs").read_bytes(), fsspec.filesystem("http").clear_instance_cache)
    yield found
    found.close()
    found.forget()


@pytest.mark.usefixtures("inline")
@pytest.mark.slow
def test_each_drive_of_a_hostile_server_fails_by_its_name_and_the_others_are_done(
    web, call, succeeds, tmp_path, monkeypatch
):
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    urls = [web.url(name) for name in ("first", *FAULTS, "last")]
    out = tmp_path / "out"
    words = ("batch", "convert", *urls, "-o", out, "--workers", 1, "--retries", 0, "--json")
    done = call(*words)
    assert done.code == 1, done.err
    rows = {row["input"]: row for row in json.loads(call("batch status", out, "--json").out)["drives"]}
    states = {url: row["state"] for url, row in rows.items()}
    assert states[urls[0]] == states[urls[-1]] == "done"
    failed = [url for url, state in states.items() if state == "failed"]
    assert set(failed) >= {web.url(name) for name in FAULTS if name != "none"}, states
    assert "Traceback" not in done.out + done.err + json.dumps([rows[url] for url in failed])
    assert [rows[url] for url in failed if url not in json.dumps(rows[url]["error"])] == []
    assert sorted(path.stem for path in out.glob("*.sfs")) == sorted(
        url.rpartition("/")[2].removesuffix(".sfs") for url, state in states.items() if state == "done"
    )
    assert list((tmp_path / "tmp").iterdir()) == []
    web.well = True
    web.forget()
    succeeds(*words, "--resume")
    assert len(list(out.glob("*.sfs"))) == len(urls)


@pytest.mark.usefixtures("inline")
@pytest.mark.parametrize("start", [0, *(pytest.param(start, marks=pytest.mark.slow) for start in range(8, 308, 8))])
def test_mutants_of_served_drives_are_checked_or_fail(web, call, tmp_path, start):
    names = {f"mutant{number}": number for number in range(start, start + 8)}
    for name, number in names.items():
        web.mutants[name] = mutant_of(web.content, np.random.default_rng(number))
    words = ("batch", "validate", *map(web.url, names), "-o", tmp_path / "out", "--workers", 1, "--quick")
    done = call(*words, "--retries", 0, "--json")
    assert (done.code in {0, 1}, "Traceback" in done.out + done.err) == (True, False)
    rows = json.loads(call("batch status", tmp_path / "out", "--json").out)["drives"]
    assert len(rows) == len(names)
    for row in rows:
        assert (row["state"] in {"done", "failed"}, "Traceback" in json.dumps(row)) == (True, False), row
