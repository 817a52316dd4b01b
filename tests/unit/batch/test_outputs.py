"""Outputs of a run in stores, and further outputs."""

import os
from pathlib import Path

import pytest

from sceneloom.batch import run
from sceneloom.batch.cluster import DaskCluster
from sceneloom.batch.jobs import Further
from sceneloom.batch.record import Record
from sceneloom.batch.running import CLAIM, record_folder
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
    with pytest.raises(OutputError, match=rf"holds the outputs of a run whose record is {tmp_path}/record on \S+"):
        run(job("copy", drives("b.sfs")), store, record=tmp_path / "other", executor=inline())
    with pytest.raises(OutputError, match="holds the record of a run with outputs in local://"):
        run(job("copy", drives("b.sfs")), f"{store}deep", record=tmp_path / "record", executor=inline(), resume=True)
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


def test_a_send_that_fails_is_tried_again_where_that_may_help(tmp_path, drives, job, inline, store, monkeypatch):
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
def test_a_killed_worker_leaves_nothing_in_the_store_and_no_draft(tmp_path, drives, job, store, make, monkeypatch):
    (tmp_path / "drafts").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "drafts"))
    monkeypatch.setattr("tempfile.tempdir", None)
    summary = run(job("die", drives("a.sfs", "b.sfs"), retries=9), store, record=tmp_path / "record", executor=make(2))
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


def contents(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def wanted(tmp_path):
    """A folder and a file, as of `--depth` and `--loss`."""
    return (
        Further(option="depth", location=str(tmp_path / "depth"), is_folder=True),
        Further(option="loss", location=str(tmp_path / "losses" / "loss.json"), is_folder=False),
    )


def test_each_drive_has_its_own_in_the_position_of_all(tmp_path, drives, job, inline, wanted):
    work = job("more", drives("a.sfs", "b.sfs"), further=wanted)
    assert run(work, tmp_path / "out", executor=inline()).done == 2
    assert contents(tmp_path / "depth") == {"a/0.png": "a.sfs", "b/0.png": "b.sfs"}
    assert contents(tmp_path / "losses") == {"a.loss.json": "a.sfs", "b.loss.json": "b.sfs"}
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [".sceneloom-run", "a.txt", "b.txt"]


def test_a_try_that_fails_leaves_none_and_what_is_gone_is_made_again(
    tmp_path, drives, job, inline, wanted, monkeypatch
):
    locations = drives("a.sfs", "bad.sfs")
    first = run(job("more", locations, further=wanted), tmp_path / "out", executor=inline())
    assert (first.done, first.failed) == (1, 1)
    assert list(contents(tmp_path / "depth")) == ["a/0.png"]
    same = run(job("more", locations[:1], further=wanted), tmp_path / "out", executor=inline(), resume=True)
    assert same.skipped == 1
    (tmp_path / "losses" / "a.loss.json").unlink()
    # the folder that is there gives way in one step
    (tmp_path / "depth" / "a" / "stale.png").write_text("of an earlier run")
    again = run(job("more", locations[:1], further=wanted), tmp_path / "out", executor=inline(), resume=True)
    assert (again.skipped, again.done) == (0, 1)
    assert list(contents(tmp_path / "depth")) == ["a/0.png"]
    assert list(contents(tmp_path / "losses")) == ["a.loss.json"]


def test_they_go_to_another_disk_too(tmp_path, drives, job, inline, wanted, monkeypatch):
    stat = Path.stat

    def far(self, **how):
        found = stat(self, **how)
        if self in (tmp_path / "depth", tmp_path / "losses"):
            return type(found)((*found[:2], found.st_dev + 1, *found[3:]))
        return found

    monkeypatch.setattr(Path, "stat", far)
    run(job("more", drives("a.sfs"), further=wanted), tmp_path / "out", executor=inline())
    assert contents(tmp_path / "depth") == {"a/0.png": "a.sfs"}
    assert contents(tmp_path / "losses") == {"a.loss.json": "a.sfs"}


def test_they_go_into_a_store_with_the_outputs(tmp_path, drives, job, inline):
    for name in ("out", "depth/a"):
        (tmp_path / "store" / name).mkdir(parents=True)
    store = f"local://{tmp_path}/store"
    further = (Further(option="depth", location=f"{store}/depth/", is_folder=True),)
    work = job("more", drives("a.sfs"), further=further)
    with pytest.raises(OutputError, match="depth/a: exists already"):
        run(work, f"{store}/out", record=tmp_path / "none", executor=inline())
    (tmp_path / "store" / "depth" / "a").rmdir()
    (tmp_path / "store" / "depth").rmdir()
    put_into_folders_of_a_disk = pytest.MonkeyPatch()
    from sceneloom.formats.remote import stores

    put = stores.Store.put

    def making(self, source):
        Path(self.path).parent.mkdir(parents=True, exist_ok=True)  # stores have no folders
        put(self, source)

    put_into_folders_of_a_disk.setattr(stores.Store, "put", making)
    (tmp_path / "store" / "out" / ".sceneloom-run").unlink()
    assert run(work, f"{store}/out", record=tmp_path / "record", executor=inline()).done == 1
    put_into_folders_of_a_disk.undo()
    assert contents(tmp_path / "store" / "depth") == {"a/0.png": "a.sfs", "a/_SUCCESS": ""}


def test_locations_that_cannot_be_are_refused_before_anything_is_done(tmp_path, drives, job, inline, wanted):
    locations = drives("a.sfs")

    def refused(*further, error=OptionError, match):
        with pytest.raises(error, match=match):
            run(job("more", locations, further=further), tmp_path / "out", executor=inline())
        assert not list((tmp_path / "out").glob("*.txt"))

    (tmp_path / "file").touch()
    twin = Further(option="images", location=wanted[0].location, is_folder=True)
    refused(*wanted, twin, match="two outputs of one drive would go there")
    refused(
        Further(option="depth", location=str(tmp_path / "file"), is_folder=True),
        error=OutputError, match="file: is a file",
    )  # fmt: skip
    refused(
        Further(option="depth", location="local:///depth", is_folder=True),
        match="is in a store, and outputs go on disk",
    )
    (tmp_path / "depth" / "a").mkdir(parents=True)
    refused(*wanted, error=OutputError, match="depth/a: exists already")
