"""What is fetched behind URLs: reported, bounded, and gone when the drive is closed."""

from pathlib import Path

import fsspec
import pytest

import sceneloom
from sceneloom.batch.jobs import find_inputs
from sceneloom.errors import DataError, OptionError, UnknownFormatError
from sceneloom.formats.remote import stores
from sceneloom.formats.remote.mirror import fetch
from sceneloom.formats.remote.uploads import MARKER

CLOUD = (
    "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    "WIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n{} 0 0\n"
)


@pytest.fixture
def memory():
    """A store in memory with a folder of five clouds and a marker."""
    files = fsspec.filesystem("memory")
    files.store.clear()
    for k in range(5):
        files.pipe(f"/bucket/clouds/{k}.pcd", CLOUD.format(k + 1).encode())
    files.pipe(f"/bucket/clouds/{MARKER}", b"")
    yield files
    files.store.clear()
    files.pseudo_dirs[:] = [""]


def location_of(scene):
    return Path(
        next(warning for warning in scene.warnings if warning.code == "fetched")
        .message.split(" to ")[1]
        .split(";")[0]
    )


def test_a_folder_opens_as_on_disk_and_goes_when_it_is_closed(memory):
    with sceneloom.open("memory://bucket/clouds") as scene:
        assert scene.source == "memory://bucket/clouds"
        assert [frame.points.positions[0, 0] for frame in scene.lidars[0].frames] == [1, 2, 3, 4, 5]
        location = location_of(scene)
        assert sorted(path.name for path in location.iterdir()) == [f"{k}.pcd" for k in range(5)]
    assert not location.parent.exists()


def test_a_folder_of_no_format_leaves_nothing_behind(memory, monkeypatch, tmp_path):
    memory.pipe("/bucket/other/readme.txt", b"nothing")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(UnknownFormatError):
        sceneloom.open("memory://bucket/other")
    assert list(tmp_path.iterdir()) == []


def test_more_than_may_be_fetched_is_refused_before_it_is(memory, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(stores.Store, "get", None)
    with pytest.raises(DataError, match=r"a file of 0\.0 GB is more than the 0\.0 GB that may be fetched"):
        fetch("memory://bucket/clouds", largest=100)
    assert list(tmp_path.iterdir()) == []


def test_files_that_come_short_are_fetched_again(memory, monkeypatch, waits):
    get, faults = stores.Store.get, [b"", b"half"]

    def short(self, target):
        if faults:
            target.write_bytes(faults.pop())
        else:
            get(self, target)

    monkeypatch.setattr(stores.Store, "get", short)
    fetched = fetch("memory://bucket/clouds")
    assert all((fetched.path / f"{k}.pcd").read_text() == CLOUD.format(k + 1) for k in range(5))
    assert len(waits) == 2
    fetched.remove()


def test_names_that_lead_out_of_the_folder_are_refused(memory, monkeypatch):
    walk = stores.Store.walk
    monkeypatch.setattr(
        stores.Store,
        "walk",
        lambda self: [*walk(self), stores.Facts("/bucket/clouds/../../evil.sh", 1, None, is_folder=False)],
    )
    with pytest.raises(DataError, match="leads out of its folder"):
        fetch("memory://bucket/clouds")


def test_patterns_find_drives_in_stores_for_batches(memory):
    found = find_inputs(
        ["memory://bucket/clouds/[13].pcd", "memory://bucket/*/0.pcd", "https://host/a*b.sfs?x=*"]
    )
    assert [drive.location for drive in found] == [
        "memory://bucket/clouds/1.pcd",
        "memory://bucket/clouds/3.pcd",
        "memory://bucket/clouds/0.pcd",
        "https://host/a*b.sfs?x=*",
    ]
    with pytest.raises(OptionError, match="no file or folder fits"):
        find_inputs(["memory://bucket/*.sfs"])
