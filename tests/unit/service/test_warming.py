"""What serving needs: kernels that are loaded before the first result, and the extra of the package."""

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from sceneloom.service import running
from sceneloom.service import running as service_running
from sceneloom.service.running import warm_up
from sceneloom.service.server import ServerSettings

REACHING = Path(__file__).with_name("reach_kernels.py")


def reached(*arguments):
    done = subprocess.run(
        [sys.executable, REACHING, *arguments], capture_output=True, text=True, check=False, timeout=1200
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.slow
def test_requests_reach_no_kernel_that_was_not_there_after_warming_up():
    assert reached() == {"events": 0, "later": []}


@pytest.mark.slow
def test_the_whole_conformance_kit_reaches_none_either():
    assert reached("all") == {"events": 0, "later": []}


def test_missing_kernels_are_compiled_side_by_side_and_reported(monkeypatch, caplog):
    missing, asked = [f"sceneloom.cameras.{name}" for name in ("pinhole", "fisheye", "cylindrical")], []

    class Compiler:
        def __init__(self, command, **_):
            self.stdout = [f"{name}\n" for name in command[3:]]
            asked.append(command[3:])

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(service_running, "lacks_kernels", lambda name: name in missing)
    monkeypatch.setattr(service_running, "find_kernel_cache", lambda: SimpleNamespace(writable=True))
    monkeypatch.setattr(service_running.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(service_running.subprocess, "Popen", Compiler)
    with caplog.at_level(logging.INFO, "sceneloom.service"):
        assert warm_up() == 2
    assert len(asked) == 2
    assert sorted(name for names in asked for name in names) == sorted(missing)
    assert sorted(record.fields["module"] for record in caplog.records) == sorted(missing)


def test_a_server_listens_only_when_it_is_warm(monkeypatch):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    seen = []

    def look(name):
        with socket.socket() as client:
            seen.append((name, client.connect_ex(("127.0.0.1", port)) == 0))

    def started(server):
        look("started")
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(running, "warm_up", lambda started: look("warming up"))
    monkeypatch.setattr(running.gc, "freeze", lambda: None)
    assert running.serve_until_ended(ServerSettings(port=port), started=started, quiet=True) == ()
    assert seen == [("warming up", False), ("started", True)]


def test_both_fusions_give_a_result():
    assert warm_up() == 2


WITHOUT_GRPC = """
import sys
sys.modules["grpc"] = None
from sceneloom.cli.main import main
main(["serve"])
"""


def test_without_the_extra_the_verb_says_how_to_get_it():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_GRPC], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert "pip install 'sceneloom[serve]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_server_that_is_reported_to_end_while_it_is_loading_does_so_at_once(monkeypatch):
    killed, here = [], threading.Event()

    def load(started):
        started(SimpleNamespace(kill=lambda: killed.append(True)))
        os.kill(os.getpid(), signal.SIGTERM)
        here.wait(60)

    monkeypatch.setattr(running, "warm_up", load)
    settings = running.ServerSettings(port=0)
    assert running.serve_until_ended(settings, started=lambda _: pytest.fail("it listens")) == ()
    assert killed == [True]
    here.set()
