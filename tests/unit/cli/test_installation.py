"""`sceneloom doctor` and `completion`."""

import json
import subprocess
import sys

from sceneloom.pipeline import installation
from sceneloom.pipeline.installation import Finding, InstallationReport, Status
from sceneloom.version import __version__


def test_doctor_says_what_is_there_and_ends_with_1_where_something_needed_is_broken(call, monkeypatch):
    outcome = call("doctor")
    assert (outcome.code, outcome.err) == (0, "")
    for word in (__version__, "numpy", "processors", "compiled kernels", "H.264, read", "web browser"):
        assert word in outcome.out
    broken = Finding(group="packages", name="av", status=Status.BROKEN, stated="is gone", remedy="pip install av")
    good = Finding(group="packages", name="numpy", status=Status.GOOD, stated="2.0")
    monkeypatch.setattr(installation, "examine_installation", lambda: InstallationReport(findings=(broken, good)))
    outcome = call("doctor --quiet")
    assert (outcome.code, "BROKEN" in outcome.out, "pip install av" in outcome.out) == (1, True, True)
    assert "numpy" not in outcome.out
    assert "something that is needed is broken" in outcome.err
    reported = call("doctor --json")
    assert (reported.code, json.loads(reported.out)["sound"]) == (1, False)


def test_completion_is_of_the_shell_and_bash_completes_verbs(call, refuses, succeeds, tmp_path, monkeypatch):
    for shell, mark in {"bash": "complete -o", "zsh": "#compdef sceneloom", "fish": "complete"}.items():
        out = succeeds("completion", shell).out
        assert (mark in out, "_SCENELOOM_COMPLETE" in out) == (True, True)
    monkeypatch.setenv("SHELL", "/usr/bin/fish")
    assert "function" in call("completion").out
    monkeypatch.setenv("SHELL", "/bin/ksh")
    refuses(2, "expected one of bash, zsh, fish", "completion")
    words = {"COMP_WORDS": "sceneloom edit bl", "COMP_CWORD": "2", "_SCENELOOM_COMPLETE": "bash_complete"}
    command, environment = [sys.executable, "-m", "sceneloom"], {**words, "PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.stdout.split() == ["plain,blur"], done.stderr
