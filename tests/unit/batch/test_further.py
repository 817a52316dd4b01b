"""Further outputs of verbs: each drive has its own, whole, moved or sent before the output itself."""

from pathlib import Path

import pytest

from sceneloom.batch import run
from sceneloom.batch.jobs import Further
from sceneloom.errors import OptionError, OutputError


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
