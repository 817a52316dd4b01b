"""`sceneloom batch` on drives behind HTTP whose server does anything: each has one error, the others are done."""

import json
import socket
import struct
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from tests.malformed.mutants import mutant_of, sound_scene

import sceneloom
from sceneloom.formats.remote import stores

fsspec = pytest.importorskip("fsspec", reason="the extra `cloud` is not installed")
pytest.importorskip("aiohttp", reason="the extra `cloud` is not installed")

FAULTS = ("404", "500", "garbage", "short", "long", "stall", "loop", "reset", "none")
FEW, MANY = 8, 300


class Web:
    """A drive at every address: whole, or as the first part of the address says."""

    def __init__(self, content):
        self.content, self.free, self.well, self.mutants = content, threading.Event(), False, {}
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
                content = web.mutants.get(name, web.content)
                if name in ("404", "500"):
                    self.send_error(int(name))
                    return
                if name == "stall" and reported:
                    web.free.wait(30)
                    return
                if name == "reset":
                    self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    self.connection.close()
                    self.close_connection = True
                    return
                if name == "loop":
                    self.send_response(302)
                    self.send_header("Location", self.path)
                    self.send_header("Content-Length", "0")
                    self.end_headers()
                    return
                content = b"\x00garbage\xff" * 500 if name == "garbage" else content
                start, stop, ranges = 0, len(content), name != "none"
                asked = self.headers.get("Range", "")
                if asked.startswith("bytes=") and ranges:
                    first, _, last = asked[6:].partition("-")
                    start, stop = int(first or 0), min(int(last or stop - 1) + 1, stop)
                self.send_response(206 if asked and ranges else 200)
                if asked and ranges:
                    self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{len(content)}")
                if ranges:
                    self.send_header("Accept-Ranges", "bytes")
                length = stop - start + (1000 if name == "long" else 0)
                self.send_header("Content-Length", str(length))
                self.end_headers()
                if reported:
                    self.wfile.write(content[start:stop][: (stop - start) // 2 if name == "short" else None])
                self.close_connection = True

            def log_message(self, *_):
                pass

        return Handler


@pytest.fixture
def web(tmp_path, monkeypatch):
    monkeypatch.setattr("sceneloom.formats.remote.stores.time.sleep", lambda _: None)
    quick = stores.Patience(tries=2, deadline=5.0, answer=0.3)
    monkeypatch.setattr("sceneloom.formats.remote.stores._PATIENCE", quick)
    sceneloom.write(sound_scene(), tmp_path / "drive.sfs")
    found = Web((tmp_path / "drive.sfs").read_bytes())
    yield found
    found.close()
    fsspec.filesystem("http").clear_instance_cache()


@pytest.mark.usefixtures("inline")
@pytest.mark.slow
def test_each_drive_of_a_hostile_server_fails_by_its_name_and_the_others_are_done(
    web, call, tmp_path, monkeypatch
):
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    urls = [web.url(name) for name in ("first", *FAULTS, "last")]
    out = tmp_path / "out"
    words = ("batch", "convert", *urls, "-o", out, "--workers", 1, "--retries", 0, "--json")
    done = call(*words)
    assert done.code == 1, done.err
    rows = {row["input"]: row for row in json.loads(call("batch", "status", out, "--json").out)["drives"]}
    states = {url: row["state"] for url, row in rows.items()}
    assert states[urls[0]] == states[urls[-1]] == "done"
    failed = [url for url, state in states.items() if state == "failed"]
    assert set(failed) >= {web.url(name) for name in FAULTS if name != "none"}, states
    assert "Traceback" not in done.out + done.err
    shown = json.dumps([rows[url] for url in failed])
    assert "Traceback" not in shown, shown
    assert all(url in json.dumps(rows[url]["error"]) for url in failed), shown
    assert sorted(path.stem for path in out.glob("*.sfs")) == sorted(
        url.rpartition("/")[2].removesuffix(".sfs") for url, state in states.items() if state == "done"
    )
    assert list((tmp_path / "tmp").iterdir()) == []
    web.well = True
    fsspec.filesystem("http").clear_instance_cache()
    again = call(*words, "--resume")
    assert again.code == 0, again.err
    assert len(list(out.glob("*.sfs"))) == len(urls)


def _try_mutants(web, call, folder, numbers):
    names = [f"mutant{number}" for number in numbers]
    for name, number in zip(names, numbers, strict=True):
        web.mutants[name] = mutant_of(web.content, np.random.default_rng(number))
    words = ("batch", "validate", *map(web.url, names), "-o", folder, "--workers", 1, "--quick")
    done = call(*words, "--retries", 0, "--json")
    assert done.code in {0, 1}
    assert "Traceback" not in done.out + done.err
    rows = json.loads(call("batch", "status", folder, "--json").out)["drives"]
    assert len(rows) == len(names)
    for row in rows:
        assert row["state"] in {"done", "failed"}, row
        assert "Traceback" not in json.dumps(row), row
    return [row["state"] for row in rows]


@pytest.mark.usefixtures("inline")
def test_mutants_of_served_drives_are_checked_or_fail(web, call, tmp_path):
    assert _try_mutants(web, call, tmp_path / "out", range(FEW))


@pytest.mark.slow
@pytest.mark.usefixtures("inline")
def test_many_mutants_of_served_drives_are_checked_or_fail(web, call, tmp_path):
    for start in range(FEW, FEW + MANY, 50):
        assert _try_mutants(web, call, tmp_path / f"out{start}", range(start, start + 50))
