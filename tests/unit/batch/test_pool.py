"""Workers of their own, and what becomes of a run when they die."""

import multiprocessing.context
import sys

import pytest

from sceneloom.batch import run
from sceneloom.batch.pool import ProcessPool
from sceneloom.batch.record import Record


def test_a_killed_worker_harms_one_try_and_nothing_else(tmp_path, drives, job):
    names = [f"{k}.sfs" for k in range(4)]
    summary = run(job("die", drives(*names)), tmp_path / "out", workers=2)
    assert (summary.done, summary.failed, summary.retried) == (4, 0, 4)
    found = {path.name: path.read_text() for path in (tmp_path / "out").glob("*.txt")}
    assert found == {f"{k}.txt": f"{k}.sfs" for k in range(4)}
    with Record.opened(tmp_path / "out") as record:
        assert all(row.attempts == 2 for row in record.rows())


def test_workers_have_one_thread_unless_the_user_says_otherwise(tmp_path, drives, job, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "3")
    run(job("environment", drives("a.sfs")), tmp_path / "out", workers=1)
    assert (tmp_path / "out" / "a.txt").read_text() == "13"


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux only")
def test_a_killed_fork_server_is_started_anew(monkeypatch):
    pool = ProcessPool(1)
    starts = []
    start = multiprocessing.context.ForkServerProcess.start

    def killed_once(process):
        starts.append(process)
        if len(starts) == 1:
            raise EOFError
        start(process)

    monkeypatch.setattr(multiprocessing.context.ForkServerProcess, "start", killed_once)
    monkeypatch.setattr(multiprocessing.context.SpawnProcess, "start", killed_once)
    try:
        worker = pool._start()
        assert (len(starts), worker.process.is_alive()) == (2, True)
    finally:
        pool.stop()
