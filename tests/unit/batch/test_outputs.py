"""Outputs of a run in stores, and further outputs."""

import os
from pathlib import Path

import dask
import pytest

from sceneloom.batch import run
from sceneloom.batch.cluster import DaskCluster
from sceneloom.batch.jobs import Further
from sceneloom.batch.record import FOLDER, Record
from sceneloom.batch.running import CLAIM, ProcessPool
from sceneloom.errors import OptionError, OutputError
from sceneloom.formats.remote import stores

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of sockets to workers that were killed


@pytest.fixture
def store(tmp_path):
    """A folder that fsspec takes for a store, which workers in other processes have, too."""
    (tmp_path / "store" / "run1").mkdir(parents=True)
    return f"local://{tmp_path}/store/run1/"


def contents(folder):
    root = Path(str(folder).removeprefix("local://"))
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.name != CLAIM)
    return {str(path.relative_to(root)): path.read_text() for path in files}


@pytest.fixture
def puts(monkeypatch):
    sent, put = [], stores.Store.put

    def noted(self, source):
        sent.append(self.path.rpartition("/")[2])
        Path(self.path).parent.mkdir(parents=True, exist_ok=True)  # stores have no folders
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", noted)
    return sent


def test_outputs_are_sent_once_and_the_record_stays_on_disk(tmp_path, drives, job, go, store, puts):
    locations, record = drives("a.sfs", "bad.sfs", "c.sfs"), tmp_path / "record"
    first = go(job("refuse", locations), store, record=record)
    assert (first.done, first.failed, first.output, first.record) == (2, 1, store, str(record))
    assert contents(store) == {"a.txt": "a.sfs", "c.txt": "c.sfs"}
    with pytest.raises(OutputError, match="--resume"):
        go(job("refuse", locations), store, record=record)
    Path(locations[2]).write_text("changed")
    os.utime(locations[2], ns=(1, 1))
    again = go(job("refuse", locations), store, record=record, resume=True)
    assert (again.skipped, again.done, again.failed) == (1, 2, 1)
    assert puts == ["a.txt", "c.txt", "c.txt"]
    assert contents(store)["c.txt"] == "changed"
    Path(store.removeprefix("local://"), "a.txt").unlink()
    go(job("refuse", locations[:1]), store, record=record, resume=True)
    assert puts[3:] == ["a.txt"]


def test_what_a_verb_writes_beside_its_output_or_further_is_sent_before_it(tmp_path, drives, job, go, store, puts):
    go(job("pair", drives("a.sfs")), store, record=tmp_path / "record")
    assert puts == ["a.loss", "a.txt"]
    for name in ("store/run1/more", "out", "depth/a"):
        (tmp_path / name).mkdir(parents=True)
    go(job("folder", drives("b.sfs"), suffix=""), f"{store}more", record=tmp_path / "two")
    assert puts[2:] == ["a.txt", "_SUCCESS"]
    further = (Further(option="depth", location=f"local://{tmp_path}/depth/", is_folder=True),)
    work, out = job("more", drives("a.sfs"), further=further), f"local://{tmp_path}/out"
    with pytest.raises(OutputError, match="depth/a: exists already"):
        go(work, out, record=tmp_path / "none")
    for name in ("depth/a", "depth"):
        (tmp_path / name).rmdir()
    (tmp_path / "out" / CLAIM).unlink()
    assert go(work, out, record=tmp_path / "three").done == 1
    assert contents(tmp_path / "depth") == {"a/0.png": "a.sfs", "a/_SUCCESS": ""}


def test_what_others_have_written_is_left_alone(tmp_path, drives, job, go, store):
    root = Path(store.removeprefix("local://"))
    go(job("copy", drives("a.sfs")), store, record=tmp_path / "record")
    b, held = job("copy", drives("b.sfs")), "holds the outputs of a run whose record is "
    for output, record, problem in (
        (store, "other", rf"{held}{tmp_path}/record on \S+"),
        (f"{store}deep", "record", "holds the record of a run with outputs in local://"),
    ):
        with pytest.raises(OutputError, match=problem):
            go(b, output, record=tmp_path / record, resume=record == "record")
    assert contents(store) == {"a.txt": "a.sfs"}
    (root / CLAIM).unlink()
    with pytest.raises(OutputError, match=r"run1/a\.txt: exists already"):
        go(job("copy", drives("a.sfs")), store, record=tmp_path / "one")
    (root / CLAIM).write_text("[")
    with pytest.raises(OutputError, match="is not the claim of a run"):
        go(b, store, record=tmp_path / "two")
    with pytest.raises(OutputError, match="web server"):
        go(b, "https://host/run1", record=tmp_path / "three")
    with pytest.raises(OptionError, match="have their record beside them"):
        go(b, record=tmp_path / "four")


def test_a_send_that_fails_is_tried_again_where_that_may_help(tmp_path, drives, job, go, store, monkeypatch):
    monkeypatch.setattr("sceneloom.batch.running._PATIENCE_SECONDS", (0.0,))
    put, faults = stores.Store.put, [PermissionError(13, "not you")]

    def failing(self, source):
        if faults:
            raise faults.pop()
        put(self, source)

    monkeypatch.setattr(stores.Store, "put", failing)
    summary = go(job("copy", drives("a.sfs", "b.sfs")), store, record=tmp_path / "record")
    assert (summary.done, summary.failed) == (1, 1)
    with Record.opened(tmp_path / "record") as record:
        assert "a.txt: cannot be written: [Errno 13] not you" in record.rows()[0].error
    assert contents(store) == {"b.txt": "b.sfs"}


@pytest.mark.parametrize(("make", "workers"), [(ProcessPool, 2), (DaskCluster.local, 1)], ids=["pool", "dask"])
@pytest.mark.few(1)
def test_a_killed_worker_harms_one_try_and_leaves_nothing_in_the_store_and_no_draft(
    tmp_path, drives, job, store, make, workers, monkeypatch
):
    (tmp_path / "drafts").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "drafts"))
    monkeypatch.setattr("tempfile.tempdir", None)
    # dask itself would give up a worker that is not there again at once
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1ms"}):
        work = job("die", drives("a.sfs", "b.sfs"))
        summary = run(work, store, record=tmp_path / "record", executor=make(workers))
    assert (summary.done, summary.failed, summary.retried) == (2, 0, 2)
    assert contents(store) == {"a.txt": "a.sfs", "b.txt": "b.sfs"}
    assert not list((tmp_path / "drafts").glob("sceneloom-*"))
    with Record.opened(tmp_path / "record") as record:
        assert [row.attempts for row in record.rows()] == [2, 2]


def test_records_have_a_folder_of_their_own_for_each_location(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    found = Record.folder_for("s3://fused/run1/")
    assert found.parent == tmp_path / "sceneloom" / "runs"
    assert found.name.startswith("run1-")
    assert found == Record.folder_for("s3://fused/run1") != Record.folder_for("s3://other/run1")
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    assert Record.folder_for("s3://fused/run1").is_relative_to(Path.home() / ".local" / "state")


@pytest.fixture
def wanted(tmp_path):
    """A folder and a file, as of `--depth` and `--loss`."""
    return (
        Further(option="depth", location=str(tmp_path / "depth"), is_folder=True),
        Further(option="loss", location=str(tmp_path / "losses" / "loss.json"), is_folder=False),
    )


@pytest.mark.parametrize("far", [False, True])
def test_each_drive_has_its_own_in_the_position_of_all_on_another_disk_too(
    tmp_path, drives, job, go, wanted, far, monkeypatch
):
    stat = Path.stat

    def stat_far(self, **how):
        found = stat(self, **how)
        is_far = far and self in (tmp_path / "depth", tmp_path / "losses")
        return type(found)((*found[:2], found.st_dev + is_far, *found[3:])) if is_far else found

    monkeypatch.setattr(Path, "stat", stat_far)
    assert go(job("more", drives("a.sfs", "b.sfs"), further=wanted)).done == 2
    assert contents(tmp_path / "depth") == {"a/0.png": "a.sfs", "b/0.png": "b.sfs"}
    assert contents(tmp_path / "losses") == {"a.loss.json": "a.sfs", "b.loss.json": "b.sfs"}
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [FOLDER, "a.txt", "b.txt"]


def test_a_try_that_fails_leaves_none_and_what_is_gone_is_made_again(tmp_path, drives, job, go, wanted):
    locations = drives("a.sfs", "bad.sfs")
    first = go(job("more", locations, further=wanted))
    assert (first.done, first.failed) == (1, 1)
    assert list(contents(tmp_path / "depth")) == ["a/0.png"]
    assert go(job("more", locations[:1], further=wanted), resume=True).skipped == 1
    (tmp_path / "losses" / "a.loss.json").unlink()
    # the folder that is there gives way in one step
    (tmp_path / "depth" / "a" / "stale.png").write_text("of an earlier run")
    again = go(job("more", locations[:1], further=wanted), resume=True)
    assert (again.skipped, again.done) == (0, 1)
    assert [*contents(tmp_path / "depth"), *contents(tmp_path / "losses")] == ["a/0.png", "a.loss.json"]


def test_locations_that_cannot_be_are_refused_before_anything_is_done(tmp_path, drives, job, go, wanted):
    (tmp_path / "file").touch()
    twin = Further(option="images", location=wanted[0].location, is_folder=True)
    a_file = Further(option="depth", location=str(tmp_path / "file"), is_folder=True)
    in_a_store = Further(option="depth", location="local:///depth", is_folder=True)
    (tmp_path / "there" / "a").mkdir(parents=True)
    there = Further(option="depth", location=str(tmp_path / "there"), is_folder=True)
    for further, error, problem in (
        ((*wanted, twin), OptionError, "two outputs of one drive would go there"),
        ((a_file,), OutputError, "file: is a file"),
        ((in_a_store,), OptionError, "is in a store, and outputs go on disk"),
        ((there,), OutputError, "there/a: exists already"),
    ):
        with pytest.raises(error, match=problem):
            go(job("more", drives("a.sfs"), further=further))
        assert not list((tmp_path / "out").glob("*.txt"))
