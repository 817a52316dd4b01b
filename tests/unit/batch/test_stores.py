"""Outputs in stores: whole, once, of one run; the record of it on disk."""

import os
from pathlib import Path

import pytest

from sceneloom.batch import run
from sceneloom.batch.cluster import DaskCluster
from sceneloom.batch.outputs import CLAIM, record_folder
from sceneloom.batch.record import Record
from sceneloom.batch.workers import ProcessPool
from sceneloom.errors import OptionError, OutputError
from sceneloom.formats.remote import stores

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of sockets to workers that were killed


@pytest.fixture
def store(tmp_path):
    """A folder that fsspec takes for a store, which workers in other processes have, too."""
    (tmp_path / "store" / "run1").mkdir(parents=True)
    return f"local://{tmp_path}/store/run1/"


def objects(store):
    root = Path(store.removeprefix("local://"))
    return {
        str(path.relative_to(root)): path.read_text()
        for path in root.rglob("*")
        if path.is_file() and path.name != CLAIM
    }


@pytest.fixture
def puts(monkeypatch):
    """Names of what was sent, in order."""
    sent, put = [], stores.Store.put

    def noted(self, source):
        sent.append(self.path.rpartition("/")[2])
        Path(self.path).parent.mkdir(exist_ok=True)  # stores have no folders
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", noted)
    return sent


def test_outputs_are_sent_once_and_the_record_stays_on_disk(tmp_path, drives, job, inline, store, puts):
    locations = drives("a.sfs", "bad.sfs", "c.sfs")
    first = run(job("refuse", locations), store, record=tmp_path / "record", executor=inline())
    assert (first.done, first.failed, first.output, first.record) == (2, 1, store, str(tmp_path / "record"))
    assert objects(store) == {"a.txt": "a.sfs", "c.txt": "c.sfs"}
    with pytest.raises(OutputError, match="--resume"):
        run(job("refuse", locations), store, record=tmp_path / "record", executor=inline())
    Path(locations[2]).write_text("changed")
    os.utime(locations[2], ns=(1, 1))
    again = run(job("refuse", locations), store, record=tmp_path / "record", executor=inline(), resume=True)
    assert (again.skipped, again.done, again.failed) == (1, 2, 1)
    assert puts == ["a.txt", "c.txt", "c.txt"]
    assert objects(store)["c.txt"] == "changed"
    Path(store.removeprefix("local://"), "a.txt").unlink()
    run(job("refuse", locations[:1]), store, record=tmp_path / "record", executor=inline(), resume=True)
    assert puts[3:] == ["a.txt"]


def test_what_a_verb_writes_beside_its_output_is_sent_before_it(tmp_path, drives, job, inline, store, puts):
    run(job("pair", drives("a.sfs")), store, record=tmp_path / "record", executor=inline())
    assert puts == ["a.loss", "a.txt"]
    Path(store.removeprefix("local://"), "more").mkdir()
    run(job("folder", drives("b.sfs"), suffix=""), f"{store}more", record=tmp_path / "two", executor=inline())
    assert puts[2:] == ["a.txt", "_SUCCESS"]


def test_another_record_does_not_write_where_a_run_has_been(tmp_path, drives, job, inline, store):
    run(job("copy", drives("a.sfs")), store, record=tmp_path / "record", executor=inline())
    with pytest.raises(
        OutputError, match=rf"holds the outputs of a run whose record is {tmp_path}/record on \S+"
    ):
        run(job("copy", drives("b.sfs")), store, record=tmp_path / "other", executor=inline())
    with pytest.raises(OutputError, match="holds the record of a run with outputs in local://"):
        run(
            job("copy", drives("b.sfs")),
            f"{store}deep",
            record=tmp_path / "record",
            executor=inline(),
            resume=True,
        )
    assert objects(store) == {"a.txt": "a.sfs"}


def test_objects_of_strangers_are_left_alone(tmp_path, drives, job, inline, store):
    root = Path(store.removeprefix("local://"))
    (root / "a.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"run1/a\.txt: exists already"):
        run(job("copy", drives("a.sfs")), store, record=tmp_path / "record", executor=inline())
    assert objects(store) == {"a.txt": "mine"}
    (root / CLAIM).write_text("[")
    with pytest.raises(OutputError, match="is not the claim of a run"):
        run(job("copy", drives("a.sfs")), store, record=tmp_path / "two", executor=inline())
    with pytest.raises(OutputError, match="web server"):
        run(job("copy", drives("a.sfs")), "https://host/run1", record=tmp_path / "three", executor=inline())
    with pytest.raises(OptionError, match="have their record beside them"):
        run(job("copy", drives("a.sfs")), root, record=tmp_path / "four", executor=inline())


def test_a_send_that_fails_is_tried_again_where_that_may_help(
    tmp_path, drives, job, inline, store, monkeypatch
):
    monkeypatch.setattr("sceneloom.batch.running._PATIENCE_SECONDS", (0.0,))
    put, faults = stores.Store.put, [PermissionError(13, "not you")]

    def failing(self, source):
        if faults:
            raise faults.pop()
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", failing)
    summary = run(job("copy", drives("a.sfs", "b.sfs")), store, record=tmp_path / "record", executor=inline())
    assert (summary.done, summary.failed) == (1, 1)
    with Record.opened(tmp_path / "record") as record:
        assert "a.txt: cannot be written: [Errno 13] not you" in record.rows()[0].error
    assert objects(store) == {"b.txt": "b.sfs"}


@pytest.mark.parametrize("make", [ProcessPool, DaskCluster.local], ids=["pool", "dask"])
@pytest.mark.few(1)
def test_a_killed_worker_leaves_nothing_in_the_store_and_no_draft(
    tmp_path, drives, job, store, make, monkeypatch
):
    (tmp_path / "drafts").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "drafts"))
    monkeypatch.setattr("tempfile.tempdir", None)
    summary = run(
        job("die", drives("a.sfs", "b.sfs"), retries=9), store, record=tmp_path / "record", executor=make(2)
    )
    assert (summary.done, summary.failed) == (2, 0)
    assert objects(store) == {"a.txt": "a.sfs", "b.txt": "b.sfs"}
    assert not list((tmp_path / "drafts").glob("sceneloom-*"))


def test_records_have_a_folder_of_their_own_for_each_location(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    found = record_folder("s3://fused/run1/")
    assert found.parent == tmp_path / "sceneloom" / "runs"
    assert found.name.startswith("run1-")
    assert found == record_folder("s3://fused/run1")
    assert found != record_folder("s3://other/run1")
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    assert record_folder("s3://fused/run1").is_relative_to(Path.home() / ".local" / "state")
