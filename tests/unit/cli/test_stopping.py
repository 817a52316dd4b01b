"""A program that is reported to end leaves nothing half written and says how it ended."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

Call = Callable[..., Any]

FUSE: Any = import_module("sceneloom.pipeline.fusing")
"""The module that plays drives to the fusion."""

_USUAL = {signal.SIGINT: signal.default_int_handler}


@pytest.mark.skipif(sys.platform == "win32", reason="has no such signals")
@pytest.mark.parametrize(
    "number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name
)
def test_a_signal_in_the_middle_of_a_fusion_leaves_nothing_behind(
    call: Call, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    seen = []

    def signalled(*_: object, **__: object) -> Iterator[None]:
        seen.extend(path.name for path in tmp_path.iterdir())
        os.kill(os.getpid(), number)
        yield

    monkeypatch.setattr(FUSE, "play", signalled)
    found = signal.getsignal(number)
    if found is signal.SIG_IGN:  # so `nohup` starts the tests, and a shell what it puts in the background
        signal.signal(number, _USUAL.get(number, signal.SIG_DFL))
    before = signal.getsignal(number)
    try:
        outcome = call("fuse", recording, "-o", tmp_path / "d.sfs", "--depth", tmp_path / "depth")
        after = signal.getsignal(number)
    finally:
        signal.signal(number, found)
    assert outcome.code == 128 + number
    assert "stopped; nothing was left half written" in outcome.err
    assert seen, "there were drafts when the signal came"
    assert list(tmp_path.iterdir()) == []
    assert after == before


@pytest.mark.skipif(sys.platform == "win32", reason="has no such signals")
def test_a_signal_that_the_caller_ignores_stays_ignored(
    call: Call, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played = FUSE.play

    def signalled(*arguments: Any, **options: Any) -> Iterator[Any]:
        os.kill(os.getpid(), signal.SIGHUP)
        yield from played(*arguments, **options)

    monkeypatch.setattr(FUSE, "play", signalled)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert call("fuse", recording, "-o", tmp_path / "d.sfs").code == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_help_does_not_import_the_pipeline() -> None:
    check = (
        "import sys; from sceneloom.cli.main import sceneloom\n"
        "for verb in ('fuse', 'demo', 'convert', 'info'): sceneloom([verb, '--help'], standalone_mode=False)\n"
        "heavy = {'numba', 'scipy', 'av', 'PIL', 'sceneloom.pipeline'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_package_can_be_run_as_a_program() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sceneloom", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("sceneloom, version ")
