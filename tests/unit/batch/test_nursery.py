"""Where workers come from: forked from a process that has what they need, or started afresh."""

import multiprocessing.forkserver
import os
import sys

import pytest

from sceneloom.batch import run
from sceneloom.batch.nursery import Nursery
from sceneloom.batch.pool import ProcessPool

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux only")

MODULE = """
import os
PROCESS = os.getpid()


def imported(place, output, options):
    output.write_text(f"{PROCESS} {os.getpid()}")
"""


@pytest.fixture
def imported(tmp_path, job, monkeypatch):
    """Runs a verb that says which process imported it, and which one did it."""
    (tmp_path / "modules").mkdir(exist_ok=True)
    (tmp_path / "modules" / "imported_by_batches.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))
    # what a program adds to its own path is not told to that process by all versions of Python
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "modules"), prepend=os.pathsep)

    def told(places, out):
        from dataclasses import replace

        asked = replace(job("copy", places), call="imported_by_batches:imported")
        run(asked, out, executor=ProcessPool(2, ["imported_by_batches"]))
        return [tuple(path.read_text().split()) for path in sorted(out.glob("*.txt"))]

    return told


def test_modules_are_imported_once_for_all_workers(tmp_path, drives, imported):
    found = imported(drives("a.sfs", "b.sfs"), tmp_path / "out")
    assert len({by for by, _ in found}) == 1
    assert all(by != worker for by, worker in found)
    again = imported(drives("a.sfs"), tmp_path / "again")
    assert again[0][0] != found[0][0], "each run has a process of its own, with the environment of that time"


@pytest.mark.parametrize("why", ["long name", "in use"])
def test_workers_start_afresh_where_they_cannot_be_forked(tmp_path, drives, imported, monkeypatch, why):
    other = Nursery([])
    if why == "long name":
        monkeypatch.setattr("sceneloom.batch.nursery.get_temp_dir", lambda: "/" + "x" * 80)
    else:
        other.open()
    found = imported(drives("a.sfs"), tmp_path / "out")
    other.close()
    assert found[0][0] == found[0][1]
    assert multiprocessing.forkserver._forkserver._forkserver_pid is None
