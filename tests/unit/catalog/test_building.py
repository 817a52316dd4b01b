"""Building, and bringing up to date."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.catalog import TABLES, Selection, build, query, update
from sceneloom.catalog.building import scene_name, write_draft
from sceneloom.catalog.rows import scene_rows
from sceneloom.catalog.storage import Entry, Fresh, Layout, Parts
from sceneloom.errors import OptionError, OutputError
from sceneloom.scene import AttributePath, EventAnnotation, Scene

from .conftest import box, street


@pytest.fixture
def copies(drives, tmp_path):
    """Drives that may be changed."""
    return sorted(shutil.copytree(drives[0].parent, tmp_path / "drives").iterdir())


def timestamps(folder):
    return {file: (file.stat().st_ino, file.stat().st_mtime_ns) for file in folder.rglob("*.parquet")}


def rows_of_others(folder, path):
    return {
        table: query(folder, f"SELECT * FROM {table} WHERE scene != '{scene_name(path, {})}' ORDER BY ALL").rows
        for table in TABLES
    }


def put(layout, **scenes):
    """Put rows of scenes into a catalogue."""
    fresh = []
    for name, tables in scenes.items():
        draft = layout.drafts / name
        fresh.append(Fresh(name, Entry(name, {}, "?"), draft, write_draft(name, tables, draft)))
    with layout.held():
        assert not Parts(layout).put(fresh)


def test_an_update_reads_only_what_changed(copies, tmp_path):
    folder = tmp_path / "catalogue"
    build(copies, folder)
    before, others = timestamps(folder), rows_of_others(folder, str(copies[2]))
    assert update(folder).unchanged == 3
    assert timestamps(folder) == before
    sceneloom.write(street(seconds=4), copies[2], overwrite=True)
    report = update(folder)
    assert (report.changed, report.unchanged) == ((str(copies[2]),), 2)
    assert repr(rows_of_others(folder, str(copies[2]))) == repr(others)  # equal, not-a-number included
    assert query(folder, "SELECT count(*) FROM scenes WHERE duration > 3.8 AND duration < 4").rows == [(1,)]
    assert not [*folder.rglob(".part*"), *folder.rglob(".drafts")]


def test_scenes_share_parts_up_to_a_number_of_rows(copies, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneloom.catalog.storage.PART_ROWS", 250)
    folder = tmp_path / "catalogue"
    build(copies, folder)  # of 200, 200 and 40 frames
    counts = "SELECT path, count(*) FROM frames JOIN scenes USING (scene) GROUP BY path ORDER BY path"
    assert [count for _, count in query(folder, counts).rows] == [200, 200, 40]
    assert [file.name for file in sorted(folder.glob("frames/*"))] == ["part-00000.parquet", "part-00001.parquet"]
    before = timestamps(folder)
    sceneloom.write(street(seconds=4), copies[1], overwrite=True)
    update(folder)
    after = timestamps(folder)
    assert {file.name for file in before if after[file] != before[file]} == {"part-00001.parquet"}
    assert [count for _, count in query(folder, counts).rows] == [200, 80, 40]


@pytest.mark.parametrize("stopped_after", range(7))
@pytest.mark.few(2)
def test_an_update_that_is_stopped_anywhere_is_done_again(copies, tmp_path, monkeypatch, stopped_after):
    folder, files = tmp_path / "catalogue", []
    build(copies[:2], folder)
    sceneloom.write(street(seconds=4), copies[1], overwrite=True)

    def stops(self, target):
        if self.name.startswith(".part-"):
            if len(files) == stopped_after:
                raise KeyboardInterrupt
            files.append(target)
        return real(self, target)

    real = Path.replace
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", stops)
        with pytest.raises(KeyboardInterrupt):
            update(folder, copies)
    assert len(files) == stopped_after
    assert query(folder, "SELECT count(*) FROM annotations WHERE annotation = 'car 1'").rows[0][0] >= 100
    report = update(folder, copies)
    assert (len(report.added) + len(report.changed), report.failed) == (2, ())
    whole = tmp_path / "whole"
    build(copies, whole)
    for table in TABLES:
        sql = f"SELECT * FROM {table} ORDER BY ALL"
        assert repr(query(folder, sql).rows) == repr(query(whole, sql).rows)
    assert update(folder).unchanged == 3


@pytest.mark.slow
def test_workers_make_the_same_catalogue(copies, tmp_path):
    torn = tmp_path / "torn.sfs"
    torn.write_bytes(copies[0].read_bytes()[:200])
    reported = []
    reports = [
        build([*copies, torn], tmp_path / str(workers), workers=workers, progress=lambda *n: reported.append(n))
        for workers in (1, 2)
    ]
    assert [[failure.path for failure in report.failed] for report in reports] == [[str(torn)]] * 2
    assert sorted(reports[0].added) == sorted(reports[1].added) == sorted(map(str, copies))
    assert reported == [(1, 4), (2, 4), (3, 4), (4, 4)] * 2
    for table in TABLES:
        sql = f"SELECT * FROM {table} ORDER BY ALL"
        assert repr(query(tmp_path / "1", sql).rows) == repr(query(tmp_path / "2", sql).rows)


def test_one_process_at_a_time_writes(copies, tmp_path):
    folder = tmp_path / "catalogue"
    build(copies[:1], folder)
    with Layout.found(folder).held():
        for write in (lambda: update(folder), lambda: build(copies, folder, overwrite=True)):
            with pytest.raises(OutputError, match="another run"):
                write()
        assert query(folder, "SELECT count(*) FROM scenes").rows == [(1,)]
    assert update(folder).unchanged == 1


def test_a_run_that_is_stopped_leaves_what_was_read(copies, tmp_path):
    def stops(done, _):
        if done == 2:
            raise KeyboardInterrupt

    folder = tmp_path / "catalogue"
    with pytest.raises(KeyboardInterrupt):
        build(copies, folder, progress=stops)
    assert query(folder, "SELECT path FROM scenes ORDER BY path").rows == [(str(copy),) for copy in copies[:2]]
    report = update(folder, copies)
    assert (report.added, report.unchanged) == ((str(copies[2]),), 2)


def test_drives_come_and_go(copies, tmp_path):
    folder = tmp_path / "catalogue"
    build(copies[:2], folder, checks="none")
    report = update(folder, copies)
    assert (report.added, report.changed, report.unchanged) == ((str(copies[2]),), tuple(map(str, copies[:2])), 0)
    copies[0].unlink()
    assert update(folder).gone == (str(copies[0]),)
    assert update(folder).scenes == 3
    report = update(folder, prune=True)
    assert (report.removed, report.scenes) == ((str(copies[0]),), 2)
    with pytest.raises(OptionError):
        update(folder, copies, prune=True)


def test_a_drive_that_cannot_be_read_is_reported_and_the_others_go_on(copies, tmp_path):
    folder = tmp_path / "catalogue"
    torn = tmp_path / "torn.sfs"
    torn.write_bytes(copies[0].read_bytes()[:200])
    report = build([torn, copies[0], tmp_path / "missing"], folder)
    assert [failure.path for failure in report.failed] == [str(torn), str(tmp_path / "missing")]
    assert (report.added, report.scenes) == ((str(copies[0]),), 1)
    copies[0].write_bytes(b"{")
    report = update(folder)
    assert [failure.path for failure in report.failed] == [str(copies[0])]
    assert query(folder, "SELECT count(*) > 0 FROM annotations").rows == [(True,)]  # what stood of it before


def test_scenes_of_a_damaged_file_are_read_again(copies, tmp_path):
    folder = tmp_path / "catalogue"
    build(copies, folder)
    (file,) = folder.glob("scenes/*.parquet")
    file.write_bytes(b"PAR1")
    assert len(update(folder, copies[:1]).changed) == 3  # those beside it in the file as well
    assert query(folder, "SELECT count(*) FROM scenes").rows == [(3,)]
    for file in folder.rglob("*.parquet"):
        file.write_bytes(b"PAR1")
    report = update(folder)
    assert (report.scenes, len(report.failed)) == (0, 1)
    assert "delete it" in report.failed[0].error


def test_nothing_else_is_replaced(copies, tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "precious.txt").touch()
    with pytest.raises(OutputError, match="something else"):
        build(copies, tmp_path / "own", overwrite=True)
    build(copies, tmp_path / "catalogue")
    with pytest.raises(OutputError, match="already"):
        build(copies, tmp_path / "catalogue")
    assert build(copies[:1], tmp_path / "catalogue", overwrite=True).scenes == 1
    assert [file.name for file in (tmp_path / "own").iterdir()] == ["precious.txt"]
    with pytest.raises(OptionError):
        build([], tmp_path / "none")


@pytest.mark.parametrize("path", ["/a/b c.sfs", "/a/2024-01-01", "/", "s3://b/ü.sfs", "/x/'; DROP--", "/a/b\udcff"])
def test_names_of_scenes_mean_the_same_everywhere(path):
    name = scene_name(path, {})
    assert set(name) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")
    assert name.count("-") == 1
    assert name != scene_name(path, {"sequence": "2"})


@pytest.mark.parametrize("address", ["https://me:hush@host/a.sfs", "https://host/a.sfs?X-Amz-Signature=hush"])
def test_addresses_with_secrets_are_not_kept(tmp_path, address):
    with pytest.raises(OptionError, match="holds a secret") as refused:
        build([address], tmp_path / "catalogue")
    assert "hush" not in str(refused.value)
    assert not (tmp_path / "catalogue").exists()


def test_odd_scenes_are_catalogued_too(tmp_path):
    nan = float("nan")
    odd = AttributePath("size \n", (10**400, True, ("a", "b"), {"x": 1}), np.arange(4))
    boxes = (
        box("'; DROP", None, [0.0, 1.0], [[nan, 1e300, 0]] * 2, attributes=(odd,)),
        box(1, "ünï\ud800", [0.05], [[0, 0, 0]]),
        box("1", "", [], np.zeros((0, 3))),
        EventAnnotation("e", 5, label="rotation"),
    )
    scene = street(seconds=2, annotations=boxes)
    tables = scene_rows(scene, path="x", options={}, fingerprint="", size_bytes=None, findings=())
    empty = scene_rows(Scene(()), path="y", options={}, fingerprint="", size_bytes=None, findings=())
    layout = Layout.made(tmp_path / "catalogue", overwrite=False)
    assert query(layout.folder, "SELECT count(*) FROM scenes JOIN annotations USING (scene)").rows == [(0,)]
    assert query(layout.folder, Selection(labels=("car",))).rows == []
    put(layout, a=tables, b=empty)
    sql = "SELECT track, annotation, boxes FROM tracks ORDER BY track"
    assert query(layout.folder, sql).rows == [(0, "'; DROP", 11), (1, "1", 1), (2, "1", 0), (3, "e", 0)]
    values = query(layout.folder, "SELECT value, number FROM attributes WHERE owner = 'annotation'").rows
    assert values == [(str(10**400), None), ("true", None), ("a", None), ("b", None), ('{"x": 1}', None)]
    assert query(layout.folder, Selection(types=("cuboid",))).rows[0][3:] == (12, 1)
