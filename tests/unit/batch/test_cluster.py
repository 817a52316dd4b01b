"""Workers of dask: a lost one counts as a try of the run, whatever dask would do by itself."""

import json
import pickle
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from distributed import LocalCluster

from sceneloom.batch import Task, run
from sceneloom.batch.cluster import DaskCluster, run_packed
from sceneloom.batch.running import OUTCOME
from sceneloom.errors import OptionError
from sceneloom.version import __version__

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of sockets to workers that were killed


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


def test_a_try_that_another_worker_has_begun_is_lost_and_one_that_ended_is_known(task):
    first = done(task)
    assert (first["error"], task.draft.read_text()) == ("", "a.sfs")
    assert done(task) == first
    task.draft.write_text("as the first left it")
    (task.draft.parent / OUTCOME).write_text('{"number": 1, "err')
    again = done(task)
    assert (again["kind"], again["passing"]) == ("Lost", True)
    assert task.draft.read_text() == "as the first left it"


def test_workers_without_the_folder_of_the_run_or_of_another_version_do_nothing(task):
    assert "expected the same" in done(task, "0.0.0")["error"]
    Path(task.draft.parent.parent).rmdir()
    assert "that all workers share" in done(task)["error"]
    assert not task.draft.parent.parent.exists()


def test_a_scheduler_that_is_not_there_is_named():
    with pytest.raises(OptionError, match=r"--cluster tcp://127\.0\.0\.1:9"):
        DaskCluster.at("tcp://127.0.0.1:9", seconds=0.1)


class Client:
    """A client of dask that keeps what it is given."""

    status = "running"

    def __init__(self):
        self.sent = []

    def nthreads(self):
        return {"tcp://one": 1, "tcp://two": 1, "tcp://wide": 4}

    def submit(self, function, version, packed, *, key, **how):
        self.sent.append(pickle.loads(packed))
        return SimpleNamespace(key=key, client=self, add_done_callback=lambda function: None)


def test_workers_elsewhere_have_the_next_task_at_hand_and_find_files_from_the_folder_of_the_run(
    task, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    files = {"boxes": (Path("a.jsonl"), Path("/b.jsonl")), "rig": Path("in/rig.toml"), "name": "a", "more": None}
    client = Client()
    cluster = DaskCluster(client)
    # none is at hand where it would begin beside the first
    assert cluster.free == 5
    cluster.submit(replace(task, location="in/a.sfs", options=files, files={"own": (Path("b"),)}))
    assert cluster.free == 4
    (sent,) = client.sent
    assert (sent.location, sent.files) == (str(tmp_path / "in" / "a.sfs"), {"own": (tmp_path / "b",)})
    absolute = {"boxes": (tmp_path / "a.jsonl", Path("/b.jsonl")), "rig": tmp_path / "in" / "rig.toml"}
    assert sent.options == {**files, **absolute}
