"""Workers of dask: a lost one counts as a try of the run, whatever dask would do by itself."""

import json
import pickle
from pathlib import Path

import pytest

from sceneloom.batch import Task, run
from sceneloom.batch.cluster import DaskCluster, run_packed
from sceneloom.batch.record import Record
from sceneloom.errors import OptionError
from sceneloom.version import __version__

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of sockets to workers that were killed


def test_a_killed_worker_of_dask_harms_one_try_and_nothing_else(tmp_path, drives, job):
    cluster = DaskCluster.local(1)
    summary = run(job("die", drives("a.sfs", "b.sfs")), tmp_path / "out", executor=cluster)
    assert (summary.done, summary.failed, summary.retried) == (2, 0, 2)
    found = {path.name: path.read_text() for path in (tmp_path / "out").glob("*.txt")}
    assert found == {"a.txt": "a.sfs", "b.txt": "b.sfs"}
    with Record.opened(tmp_path / "out") as record:
        assert [row.attempts for row in record.rows()] == [2, 2]


@pytest.fixture
def task(tmp_path, drives, job):
    (tmp_path / "drafts").mkdir()
    (place,) = drives("a.sfs")
    draft = tmp_path / "drafts" / "1-1" / "a.txt"
    return Task(number=1, attempt=1, call=job("copy", []).call, place=place, draft=draft, options={})


def done(task, version=__version__):
    return json.loads(run_packed(version, pickle.dumps(task)))


def test_a_try_that_another_worker_has_begun_is_lost_and_not_done_again(task):
    assert done(task)["error"] == ""
    assert task.draft.read_text() == "a.sfs"
    task.draft.write_text("as the first left it")
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
