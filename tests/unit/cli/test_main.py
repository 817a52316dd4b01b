"""The program: how it starts, stops, and what its texts name."""

import ast
import os
import re
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from tests.unit.cli.conftest import commands

import sceneloom
from sceneloom.checks.validation import catalogue
from sceneloom.cli.main import reported_compiling
from sceneloom.cli.main import sceneloom as command_line
from sceneloom.version import __version__

FUSE: Any = import_module("sceneloom.pipeline.fusing")
"""The module that plays drives to the fusion."""


@pytest.mark.skipif(sys.platform == "win32", reason="has no such signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
def test_a_signal_in_the_middle_of_a_fusion_leaves_nothing_behind(call, recording, tmp_path, monkeypatch, number):
    seen = []

    def signalled(*_, **__):
        seen.extend(path.name for path in tmp_path.iterdir())
        os.kill(os.getpid(), number)
        yield

    monkeypatch.setattr(FUSE, "play", signalled)
    found = signal.getsignal(number)
    if found is signal.SIG_IGN:  # so `nohup` starts the tests, and a shell what it puts in the background
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    before = signal.getsignal(number)
    try:
        outcome = call("fuse", recording, "-o", tmp_path / "d.sfs", "--depth", tmp_path / "depth")
        after = signal.getsignal(number)
    finally:
        signal.signal(number, found)
    assert outcome.code == 128 + number
    assert "stopped; no partial output was left" in outcome.err
    assert seen, "there were drafts when the signal came"
    assert list(tmp_path.iterdir()) == []
    assert after == before


@pytest.mark.skipif(sys.platform == "win32", reason="has no such signals")
def test_a_signal_that_the_caller_ignores_stays_ignored(succeeds, recording, tmp_path, monkeypatch):
    played = FUSE.play

    def signalled(*arguments, **options):
        os.kill(os.getpid(), signal.SIGHUP)
        yield from played(*arguments, **options)

    monkeypatch.setattr(FUSE, "play", signalled)
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        succeeds("fuse", recording, "-o", tmp_path / "d.sfs")
    finally:
        signal.signal(signal.SIGHUP, before)


def test_the_package_can_be_run_as_a_program_and_help_does_not_import_the_pipeline():
    done = subprocess.run([sys.executable, "-m", "sceneloom", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"sceneloom, version {__version__}\n"
    check = (
        "import sys; from sceneloom.cli.main import sceneloom\n"
        "for verb in ('fuse', 'demo', 'convert', 'info'): sceneloom([verb, '--help'], standalone_mode=False)\n"
        "heavy = {'numba', 'scipy', 'av', 'PIL', 'sceneloom.pipeline'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


KERNELS = """
from numba import int64
from sceneloom.kernels.cache import kernel

@kernel(int64(int64))
def doubled(number):
    return 2 * number

@kernel([int64(int64, int64)], nogil=True)
def added(first, second):
    return doubled(first) + second
"""


def test_a_terminal_hears_once_of_compiling_and_not_when_kernels_are_kept(monkeypatch, capsys, tmp_path):
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, terminal, times in (("heard", True, 1), ("heard", True, 0), ("unheard", False, 0)):
        (tmp_path / f"kernels_{name}.py").write_text(KERNELS)
        monkeypatch.setattr(sys.stderr, "isatty", lambda terminal=terminal: terminal)
        with reported_compiling():
            module = import_module(f"kernels_{name}")
            assert not capsys.readouterr().err
            assert [module.added(2, 3), module.doubled(4)] == [7, 8]
        assert capsys.readouterr().err.count("compiling") == times
        sys.modules.pop(module.__name__)


SOURCES = Path(sceneloom.__file__).parent

OPTION = re.compile(r"(?<![\w(-])--[a-z][a-z0-9-]*(?![a-z0-9-]|\s*:)")
"""Colours and lengths of style sheets, as `--ink: #111` and `var(--ink)`, are none."""

OF_OTHER_PROGRAMS = frozenset({Path("view/viewer.py")})
"""Modules that start another program with its own options."""


COMMANDS = dict(commands(command_line))


def options_of(commands):
    return {"--help", "--help-all"} | {
        name for command in commands for option in command.params for name in option.opts
    }


def call_is_known(call):
    """Whether a call begins with a verb, and has only options of that verb."""
    words = call.split()
    verb = next((name for n in (2, 1) if (name := " ".join(words[:n])) in COMMANDS), None)
    return verb is not None and set(OPTION.findall(call)) <= options_of([COMMANDS[verb]])


MODULES = sorted(path.relative_to(SOURCES) for path in SOURCES.rglob("*.py"))


@pytest.mark.few(15)
@pytest.mark.parametrize("room", sorted({path.parts[0] for path in MODULES}))
def test_texts_name_no_option_and_no_verb_that_there_is_not(room):
    assert [call_is_known(call) for call in ("edit crop --start 3", "salvage --fix out", "repair it")] == [1, 0, 0]
    known = options_of(COMMANDS.values())
    texts = [(rule.id, f"{rule.summary} {rule.remedy}") for rule in catalogue()]
    for module in (path for path in MODULES if path.parts[0] == room and path not in OF_OTHER_PROGRAMS):
        nodes = ast.walk(ast.parse((SOURCES / module).read_text()))
        texts += [(module, n.value) for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    for where, text in texts:
        unknown = set(OPTION.findall(text)) - known
        assert not unknown, f"{where}: {unknown} in {text!r}"
        for call in re.findall(r"`sceneloom ([a-z][^`]*)`", text):
            assert call_is_known(call), f"{where}: sceneloom {call}"
