"""Building, bringing up to date, and what stands in the tables."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.catalog import TABLES, Selection, build, query, update
from sceneloom.catalog.building import (
    Ego,
    Entry,
    Fresh,
    Parts,
    box_rows,
    distances,
    scene_name,
    scene_rows,
    track_rows,
    write_draft,
)
from sceneloom.catalog.storage import Layout
from sceneloom.errors import OptionError, OutputError
from sceneloom.scene import AttributePath, EventAnnotation, Poses, Scene

from .conftest import box, street, times_ns


@pytest.fixture
def copies(drives, tmp_path):
    return sorted(shutil.copytree(drives[0].parent, tmp_path / "drives").iterdir())


def timestamps(folder):
    return {file: (file.stat().st_ino, file.stat().st_mtime_ns) for file in folder.rglob("*.parquet")}


def all_rows(folder, where=""):
    """The rows of all tables as text: not-a-number is equal to itself."""
    return {table: repr(query(folder, f"SELECT * FROM {table} {where} ORDER BY ALL").rows) for table in TABLES}


def test_an_update_reads_and_writes_only_what_changed(copies, tmp_path, monkeypatch):
    folder = tmp_path / "catalogue"
    build(copies, folder)
    elsewhere = f"WHERE scene != '{scene_name(str(copies[2]), {})}'"
    before, others = timestamps(folder), all_rows(folder, elsewhere)
    assert update(folder).unchanged == 3
    assert timestamps(folder) == before
    sceneloom.write(street(seconds=4), copies[2], overwrite=True)
    report = update(folder)
    assert (report.changed, report.unchanged) == ((str(copies[2]),), 2)
    assert all_rows(folder, elsewhere) == others
    assert query(folder, "SELECT count(*) FROM scenes WHERE duration > 3.8 AND duration < 4").rows == [(1,)]
    assert not [*folder.rglob(".part*"), *folder.rglob(".drafts")]
    # scenes share parts up to a number of rows
    monkeypatch.setattr("sceneloom.catalog.building.PART_ROWS", 290)
    build(copies, folder, overwrite=True)  # of 200, 200 and 80 frames
    counts = "SELECT path, count(*) FROM frames JOIN scenes USING (scene) GROUP BY path ORDER BY path"
    assert [count for _, count in query(folder, counts).rows] == [200, 200, 80]
    assert [file.name for file in sorted(folder.glob("frames/*"))] == ["part-00000.parquet", "part-00001.parquet"]
    before = timestamps(folder)
    sceneloom.write(street(seconds=5), copies[1], overwrite=True)
    update(folder)
    after = timestamps(folder)
    assert {file.name for file in before if after[file] != before[file]} == {"part-00001.parquet"}
    assert [count for _, count in query(folder, counts).rows] == [200, 100, 80]


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
    assert all_rows(folder) == all_rows(whole)
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
    assert all_rows(tmp_path / "1") == all_rows(tmp_path / "2")


def test_drives_come_and_go_and_one_process_at_a_time_writes(copies, tmp_path):
    folder = tmp_path / "catalogue"
    build(copies[:2], folder, checks="none")
    with Layout.found(folder).held():
        for write in (lambda: update(folder), lambda: build(copies, folder, overwrite=True)):
            with pytest.raises(OutputError, match="another run"):
                write()
        assert query(folder, "SELECT count(*) FROM scenes").rows == [(2,)]
    report = update(folder, copies)
    assert (report.added, report.changed, report.unchanged) == ((str(copies[2]),), tuple(map(str, copies[:2])), 0)
    copies[0].unlink()
    assert update(folder).gone == (str(copies[0]),)
    assert update(folder).scenes == 3
    report = update(folder, prune=True)
    assert (report.removed, report.scenes) == ((str(copies[0]),), 2)
    with pytest.raises(OptionError):
        update(folder, copies, prune=True)


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


def test_a_drive_that_cannot_be_read_is_reported_and_scenes_of_a_damaged_file_are_read_again(copies, tmp_path):
    folder, torn, missing = tmp_path / "catalogue", tmp_path / "torn.sfs", tmp_path / "missing"
    torn.write_bytes(copies[0].read_bytes()[:200])
    report = build([torn, *copies, missing], folder)
    assert [failure.path for failure in report.failed] == [str(torn), str(missing)]
    assert (report.added, report.scenes) == (tuple(map(str, copies)), 3)
    (file,) = folder.glob("scenes/*.parquet")
    file.write_bytes(b"PAR1")
    assert len(update(folder, copies[:1]).changed) == 3  # those beside it in the file as well
    assert query(folder, "SELECT count(*) FROM scenes").rows == [(3,)]
    whole, annotated = copies[0].read_bytes(), "SELECT count(*) FROM annotations"
    before = query(folder, annotated).rows
    copies[0].write_bytes(b"{")
    assert [failure.path for failure in update(folder).failed] == [str(copies[0])]
    assert query(folder, annotated).rows == before != [(0,)]  # what stood of it before
    copies[0].write_bytes(whole)
    for file in folder.rglob("*.parquet"):
        file.write_bytes(b"PAR1")
    report = update(folder)
    assert (report.scenes, len(report.failed)) == (0, 1)
    assert "delete it" in report.failed[0].error


def test_nothing_else_is_replaced_and_addresses_with_secrets_are_not_kept(copies, tmp_path):
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
    for address in ("https://me:hush@host/a.sfs", "https://host/a.sfs?X-Amz-Signature=hush"):
        with pytest.raises(OptionError, match="holds a secret") as refused:
            build([address], tmp_path / "none")
        assert "hush" not in str(refused.value)
    assert not (tmp_path / "none").exists()


def test_names_of_scenes_mean_the_same_everywhere():
    for path in ("/a/b c.sfs", "/a/2024-01-01", "/", "s3://b/ü.sfs", "/x/'; DROP--", "/a/b\udcff"):
        name = scene_name(path, {})
        assert re.fullmatch("[A-Za-z0-9_]*-[A-Za-z0-9]+", name)
        assert name != scene_name(path, {"sequence": "2"})


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
    about = {"options": {}, "fingerprint": "", "size_bytes": None, "findings": ()}
    tables, empty = scene_rows(scene, path="x", **about), scene_rows(Scene(()), path="y", **about)
    layout = Layout.made(tmp_path / "catalogue", overwrite=False)
    assert query(layout.folder, "SELECT count(*) FROM scenes JOIN annotations USING (scene)").rows == [(0,)]
    assert query(layout.folder, Selection(labels=("car",))).rows == []
    fresh = []
    for name, rows in (("a", tables), ("b", empty)):
        draft = layout.drafts / name
        fresh.append(Fresh(name, Entry(name, {}, "?"), draft, write_draft(name, rows, draft)))
    with layout.held():
        assert not Parts(layout).put(fresh)
    sql = "SELECT track, annotation, boxes FROM tracks ORDER BY track"
    assert query(layout.folder, sql).rows == [(0, "'; DROP", 11), (1, "1", 1), (2, "1", 0), (3, "e", 0)]
    values = query(layout.folder, "SELECT value, number FROM attributes WHERE owner = 'annotation'").rows
    assert values == [(str(10**400), None), ("true", None), ("a", None), ("b", None), ('{"x": 1}', None)]
    assert query(layout.folder, Selection(types=("cuboid",))).rows[0][3:] == (12, 1)


def test_rows_report_where_boxes_and_the_ego_were_at_every_moment(catalogue, drives):
    def rows(what):
        return query(catalogue, what.format(where=f"JOIN scenes s USING (scene) WHERE s.path = '{drives[0]}'")).rows

    walker = rows("SELECT seconds, y, speed, a.annotation FROM annotations a {where} AND label LIKE 'ped%' ORDER BY 1")
    seconds, y, speed, names = zip(*walker, strict=True)
    assert seconds == pytest.approx(np.arange(2.0, 3.05, 0.1))
    assert y == pytest.approx(5 + 2 * np.arange(0, 1.05, 0.1))
    assert (speed, set(names)) == (pytest.approx([2.0] * 11), {"7"})
    car = rows("SELECT seconds, distance, ego_speed FROM annotations {where} AND label = 'Car' ORDER BY 1")
    t, distance, ego_speed = np.array(car).T
    east = np.where(t < 5, 5 * t, 25 + 15 * (t - 5))
    assert len(t) == 100
    assert distance == pytest.approx(np.hypot(50 - east, 10))
    steady = np.abs(t - 5) > 0.3  # a speed is that over half a second
    assert ego_speed[steady] == pytest.approx(np.where(t < 5, 5, 15)[steady])
    t = np.arange(2.0, 3.05, 0.1)
    nearest = np.hypot(20 - 5 * t, 5 + 2 * (t - 2)).min()
    (track,) = rows("SELECT t.start, t.stop, t.metres, nearest, t.boxes FROM tracks t {where} AND annotation = '7'")
    assert track == pytest.approx((2.0, 3.0, 2.0, nearest, 11))
    found = rows("SELECT f.latitude, f.longitude FROM frames f {where} AND reference ORDER BY frame")
    assert np.array(found) == pytest.approx(street().sensors[0].positions_lla[:, :2], abs=1e-9)
    (row,) = rows("SELECT s.duration, s.period, s.metres, s.tracks, s.boxes, s.frames FROM scenes {where}")
    assert row == pytest.approx((9.9, 0.1, 25 + 15 * 4.9, 2, 111, 200))


def test_the_ego_is_where_its_trajectory_fixes_and_the_stated_origin_put_it():
    scene = street()
    ego = scene.sensor("ego")
    rows = slice(0, 30)
    path = Poses(ego.poses.timestamps_ns[rows], ego.poses.positions[rows], ego.poses.quaternions_xyzw[rows])
    part = replace(scene, sensors=(replace(ego, poses=path),))
    boxes = box_rows(part, times_ns(100))
    nearest = track_rows(part, boxes, distances(part, Ego.of(part), boxes), 0)["nearest"]
    assert nearest == pytest.approx([np.hypot(50 - 5 * 2.9, 10), np.hypot(20 - 5 * 2.9, 7 - 0.2)], abs=0.5)
    whole = street()
    lla = whole.sensor("gnss").positions_lla.copy()
    lla[:, 2] = np.nan
    lla[50] = 0.0
    ego = Ego.of(replace(whole, sensors=(replace(whole.sensor("gnss"), positions_lla=lla),)))
    found = ego.positions_lla(times_ns(100))
    assert found[:, :2] == pytest.approx(whole.sensor("gnss").positions_lla[:, :2], abs=1e-5)
    assert ego.speeds(times_ns(100)).max() < 20.0
    origin = {"latitude": 48.0, "longitude": 11.0, "altitude": 500.0}
    for ours, known in (
        ({}, True),
        ({"world_from_file": np.eye(4).tolist()}, False),
        ({"enu_origin": {**origin, "latitude": 10**400}}, False),
    ):
        scene = replace(street(), sensors=street().sensors[1:], metadata={"sceneloom": {"enu_origin": origin, **ours}})
        assert np.isfinite(Ego.of(scene).positions_lla(times_ns(3))).all() == known


def test_every_table_has_its_columns_and_the_scene_and_the_page_about_catalogues_names_them(catalogue, request):
    page = (request.config.rootpath / "docs" / "catalogue.md").read_text("utf-8")
    for table, columns in TABLES.items():
        result = query(catalogue, f"SELECT * FROM {table} LIMIT 0")
        assert result.columns == ("scene", *(column.name for column in columns))
        reported = "; ".join(f"`{column.name}` {column.words}" for column in columns)
        assert f"| `{table}` | {reported} |" in page


@pytest.mark.parametrize("reader", ["pyarrow", "polars"])
def test_other_readers_find_the_same_rows_and_scenes(catalogue, reader):
    folder = str(catalogue / "annotations")
    if reader == "pyarrow":
        from pyarrow import dataset

        table = dataset.dataset(folder, partitioning="hive").to_table()
        found = (table.num_rows, len(set(table["scene"].to_pylist())))
    else:
        polars = pytest.importorskip("polars")
        frame = polars.scan_parquet(folder, hive_partitioning=True, glob=False).collect()
        found = (frame.height, frame["scene"].n_unique())
    assert found == query(catalogue, "SELECT count(*), count(DISTINCT scene) FROM annotations").rows[0]


def test_the_moments_of_a_drive_without_frames_are_the_timestamps_of_its_boxes(tmp_path):
    stands = replace(box("stands", "car", [0.0], [[1, 2, 0]]), stationary=True)
    boxes = (stands, box("goes", "car", [1.0, 2.0, 4.0], [[0, 0, 0], [2, 0, 0], [6, 0, 0]]))
    sceneloom.write(replace(street(annotations=boxes), sensors=()), tmp_path / "boxes.sfs")
    build([tmp_path / "boxes.sfs"], tmp_path / "catalogue")
    sql = "SELECT annotation, x FROM annotations ORDER BY timestamp_ns, track"
    rows = query(tmp_path / "catalogue", sql).rows
    assert rows[:1] == [("stands", 1.0)]
    assert rows[1:] == [(name, x) for goes in (0.0, 2.0, 6.0) for name, x in (("stands", 1.0), ("goes", goes))]
    assert query(tmp_path / "catalogue", Selection(labels=("car",), count=2), gap=5.0).rows[0][3:] == (3, 2)
