"""`sceneloom doctor` and `completion`."""

import json
import subprocess
import sys

import pytest

from sceneloom.pipeline import installation
from sceneloom.pipeline.installation import Finding, InstallationReport, Status
from sceneloom.version import __version__


def test_doctor_says_what_is_there_and_ends_with_0(call):
    outcome = call("doctor")
    assert (outcome.code, outcome.err) == (0, "")
    for word in (__version__, "numpy", "processors", "compiled kernels", "H.264, read", "web browser"):
        assert word in outcome.out


def test_doctor_ends_with_1_where_something_needed_is_broken(call, monkeypatch):
    broken = Finding(group="packages", name="av", status=Status.BROKEN, stated="is gone", remedy="pip install av")
    good = Finding(group="packages", name="numpy", status=Status.GOOD, stated="2.0")
    monkeypatch.setattr(installation, "examine_installation", lambda: InstallationReport(findings=(broken, good)))
    outcome = call("doctor --quiet")
    assert (outcome.code, "BROKEN" in outcome.out, "pip install av" in outcome.out) == (1, True, True)
    assert "numpy" not in outcome.out
    assert "something that is needed is broken" in outcome.err
    reported = call("doctor --json")
    assert (reported.code, json.loads(reported.out)["sound"]) == (1, False)


def test_the_version_is_stated(call):
    outcome = call("--version")
    assert (outcome.code, outcome.out.strip()) == (0, f"sceneloom, version {__version__}")


@pytest.mark.parametrize(
    ("shell", "mark"), [("bash", "complete -o"), ("zsh", "#compdef sceneloom"), ("fish", "complete")]
)
def test_completion_prints_what_a_shell_takes_in(succeeds, shell, mark):
    outcome = succeeds("completion", shell)
    assert mark in outcome.out
    assert "_SCENELOOM_COMPLETE" in outcome.out


def test_completion_goes_by_the_shell_in_use_or_asks_for_it(call, refuses, monkeypatch):
    monkeypatch.setenv("SHELL", "/usr/bin/fish")
    assert "function" in call("completion").out
    monkeypatch.setenv("SHELL", "/bin/ksh")
    refuses(2, "expected one of bash, zsh, fish", "completion")


def test_bash_completes_verbs_and_options_with_it(tmp_path):
    words = {"COMP_WORDS": "sceneloom edit bl", "COMP_CWORD": "2", "_SCENELOOM_COMPLETE": "bash_complete"}
    command, environment = [sys.executable, "-m", "sceneloom"], {**words, "PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.stdout.split() == ["plain,blur"], done.stderr
