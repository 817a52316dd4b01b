"""Verbs that cost nothing, and workers in this process."""

import os

import pytest

from sceneloom.batch import Input, Job, run
from sceneloom.batch.running import run_task

VERBS = '''
import os, signal
from pathlib import Path

def copy(location, output, options):
    Path(output).write_text(Path(location).read_text() + options.get("more", ""))
    return {"size": len(Path(location).read_text())}

def refuse(location, output, options):
    from sceneloom.errors import DataError

    if "bad" in location:
        raise DataError(location, "line 1", "7; expected 8")
    return copy(location, output, options)

def shake(location, output, options):
    """Fails as a network does until it has been tried often enough."""
    tries = Path(location + ".tries")
    count = int(tries.read_text()) + 1 if tries.exists() else 1
    tries.write_text(str(count))
    if count < options["needed"]:
        raise ConnectionResetError("cut")
    return copy(location, output, options)

def die(location, output, options):
    """Half an output, then the worker is killed; the second time it lives."""
    Path(output).write_text("half")
    if not Path(location + ".died").exists():
        Path(location + ".died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return copy(location, output, options)

def crash(location, output, options):
    return 1 / 0

def forget(location, output, options):
    return None

def read(location, output, options):
    """What is in the files beside the drive."""
    Path(output).write_text("".join(path.read_text() for path in (*options["boxes"], options["rig"])))

def folder(location, output, options):
    Path(output).mkdir()
    (Path(output) / "a.txt").write_text(Path(location).read_text())

def fetch(location, output, options):
    """What is behind a URL; reports its address with all secrets, and complains with them where it is asked to."""
    from urllib.request import urlopen

    if "bad" in location:
        raise OSError(f"{location} is bad")
    if "odd" in location:
        raise RuntimeError(location)
    Path(output).write_bytes(urlopen(location).read())
    return {"source": location, "inner": [{"reported": f"read {location}"}]}

def pair(location, output, options):
    """An output with another one beside it."""
    Path(output).with_suffix(".loss").write_text("none")
    return copy(location, output, options)

def more(location, output, options):
    """A folder and a file beside the output; then it may fail."""
    for name, inner in (("depth", "0.png"), ("loss", "")):
        if name in options:
            made = Path(options[name], inner) if inner else Path(options[name])
            made.parent.mkdir(exist_ok=True)
            made.write_text(Path(location).read_text())
    return refuse(location, output, {})

def environment(location, output, options):
    Path(output).write_text(os.environ.get("OMP_NUM_THREADS", "") + os.environ.get("NUMBA_NUM_THREADS", ""))
'''


class Inline:
    """Runs each task at once, in this process."""

    def __init__(self):
        self.ended, self.tasks = [], []

    @property
    def free(self):
        return 1 - len(self.ended)

    def submit(self, task):
        self.tasks.append(task)
        self.ended.append((task, run_task(task)))

    def finished(self, seconds):
        ended, self.ended = self.ended, []
        return ended

    def stop(self):
        self.ended.clear()


@pytest.fixture
def go(tmp_path):
    """Runs a job in this process, with the outputs in a folder of the test; `.drives` are those of its tasks."""

    def go(job, output="out", **settings):
        executor = Inline()
        try:
            return run(job, output if "://" in str(output) else tmp_path / output, executor=executor, **settings)
        finally:
            go.drives = [task.location.rpartition("/")[2] for task in executor.tasks]

    return go


@pytest.fixture
def drives(tmp_path):

    def make(*names):
        (tmp_path / "in").mkdir(exist_ok=True)
        for name in names:
            (tmp_path / "in" / name).write_text(name)
        return [str(tmp_path / "in" / name) for name in names]

    return make


@pytest.fixture
def job(tmp_path, monkeypatch):
    """Makes jobs of the verbs above, which workers find as a module."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "verbs_for_batches.py").write_text(VERBS)
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))

    def make(name, locations, **settings):
        inputs = tuple(Input(location=location) for location in locations)
        return Job(verb=name, call=f"verbs_for_batches:{name}", inputs=inputs, **{"suffix": ".txt", **settings})

    return make


@pytest.fixture(autouse=True)
def same_environment():
    """Workers state to libraries how many threads they may have; those of the next tests are not meant."""
    before = dict(os.environ)
    yield
    for name in os.environ.keys() - before.keys():
        del os.environ[name]
    os.environ.update(before)
