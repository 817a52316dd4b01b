"""Workers of their own, and what becomes of a run when they die."""

import multiprocessing.context

from sceneloom.batch import run
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


def test_a_worker_that_cannot_be_started_is_started_once_more(tmp_path, drives, job, monkeypatch):
    starts = []
    for process in (multiprocessing.context.ForkServerProcess, multiprocessing.context.SpawnProcess):

        def killed_once(process, start=process.start):
            starts.append(process)
            if len(starts) == 1:
                raise EOFError
            start(process)

        monkeypatch.setattr(process, "start", killed_once)
    summary = run(job("copy", drives("a.sfs")), tmp_path / "out", workers=1)
    assert (summary.done, summary.retried, len(starts)) == (1, 0, 2)


def test_a_fault_of_a_worker_that_is_no_outcome_is_one_of_its_task(tmp_path, drives, job, monkeypatch):
    monkeypatch.setattr("sceneloom.batch.workers.run_task", print_nothing)
    summary = run(job("copy", drives("a.sfs")), tmp_path / "out", workers=1)
    assert summary.failed == 1


def print_nothing(task):
    raise RuntimeError(task.location)


def test_what_workers_have_in_their_environment_is_that_of_the_run(tmp_path, drives, job, monkeypatch):
    for name, threads in (("first", "2"), ("second", "5")):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
        run(job("environment", drives("a.sfs")), tmp_path / name, workers=1)
        assert (tmp_path / name / "a.txt").read_text() == f"{threads}1"
