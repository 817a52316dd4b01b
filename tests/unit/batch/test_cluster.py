"""Workers of dask: a lost one counts as a try of the run, whatever dask would do by itself."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import dask
import pytest
from distributed import LocalCluster

from sceneloom.batch import Task, run
from sceneloom.batch.cluster import DaskCluster, run_packed
from sceneloom.batch.record import Record
from sceneloom.batch.workers import OUTCOME
from sceneloom.errors import OptionError
from sceneloom.version import __version__

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of sockets to workers that were killed


@pytest.mark.slow
def test_killed_workers_of_dask_harm_one_try_of_a_drive_and_nothing_else(tmp_path, drives, job):
    # dask itself would give up a worker that is not there again at once
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1ms"}):
        summary = run(job("die", drives("a", "bc")), tmp_path / "out", executor=DaskCluster.local(1))
    assert (summary.done, summary.failed, summary.retried) == (2, 0, 2)
    found = {path.name: path.read_text() for path in (tmp_path / "out").glob("*.txt")}
    assert found == {"a.txt": "a", "bc.txt": "bc"}
    with Record.opened(tmp_path / "out") as record:
        assert [row.attempts for row in record.rows()] == [2, 2]


def test_drives_go_to_the_workers_of_a_running_scheduler(tmp_path, drives, job, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wanted = job("copy", drives("a", "bc"))
    with LocalCluster(n_workers=1, processes=False, dashboard_address=None) as workers:
        run(wanted, "out", executor=DaskCluster.at(workers.scheduler_address))
    assert [(tmp_path / "out" / f"{name}.txt").read_text() for name in ("a", "bc")] == ["a", "bc"]


@pytest.fixture
def task(tmp_path, drives, job):
    (tmp_path / "drafts").mkdir()
    (location,) = drives("a.sfs")
    draft = tmp_path / "drafts" / "1-1" / "a.txt"
    return Task(number=1, attempt=1, call=job("copy", []).call, location=location, draft=draft, options={})


def done(task, version=__version__):
    return json.loads(run_packed(version, pickle.dumps(task)))


def test_a_try_that_another_worker_has_begun_is_lost_and_not_done_again(task):
    assert done(task)["error"] == ""
    assert task.draft.read_text() == "a.sfs"
    task.draft.write_text("as the first left it")
    (task.draft.parent / OUTCOME).write_text('{"number": 1, "err')
    again = done(task)
    assert (again["kind"], again["passing"]) == ("Lost", True)
    assert task.draft.read_text() == "as the first left it"


def test_what_a_worker_came_to_that_went_before_anybody_heard_is_known_by_the_next_one(task):
    first = done(task)
    assert done(task) == first
    assert first["error"] == ""


def test_workers_without_the_folder_of_the_run_or_of_another_version_do_nothing(task):
    assert "expected the same" in done(task, "0.0.0")["error"]
    Path(task.draft.parent.parent).rmdir()
    assert "that all workers share" in done(task)["error"]
    assert not task.draft.parent.parent.exists()


def test_a_scheduler_that_is_not_there_is_named():
    with pytest.raises(OptionError, match=r"--cluster tcp://127\.0\.0\.1:9"):
        DaskCluster.at("tcp://127.0.0.1:9", seconds=0.1)


class Submitting:
    """A client of dask that keeps what it is given."""

    status = "running"

    def __init__(self):
        self.sent = []

    def nthreads(self):
        return {"tcp://one": 1, "tcp://two": 1, "tcp://wide": 4}

    def submit(self, function, version, packed, *, key, **how):
        self.sent.append(pickle.loads(packed))
        return Future(key, self)


class Future:
    def __init__(self, key, client):
        self.key = key

    def add_done_callback(self, function):
        pass


def test_workers_elsewhere_find_files_that_are_named_from_the_folder_of_the_run(task, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = {"boxes": (Path("a.jsonl"), Path("/b.jsonl")), "rig": Path("in/rig.toml"), "name": "a", "more": None}
    client = Submitting()
    DaskCluster(client).submit(replace(task, location="in/a.sfs", options=files, files={"own": (Path("b"),)}))
    (sent,) = client.sent
    assert (sent.location, sent.files) == (str(tmp_path / "in" / "a.sfs"), {"own": (tmp_path / "b",)})
    assert sent.options == {
        "boxes": (tmp_path / "a.jsonl", Path("/b.jsonl")),
        "rig": tmp_path / "in" / "rig.toml",
        "name": "a",
        "more": None,
    }


def test_workers_have_the_next_task_at_hand_unless_they_would_begin_it_beside_the_first(task):
    cluster = DaskCluster(Submitting())
    assert cluster.free == 5
    cluster.submit(task)
    assert cluster.free == 4
