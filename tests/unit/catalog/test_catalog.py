"""Catalogues of drives whose every number is known: building them, what stands in their tables, and queries."""

import csv
import io
import json
import re
import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymap3d.vincenty import vdist

import sceneloom
from sceneloom import scene as sc
from sceneloom.batch.jobs import find_inputs
from sceneloom.catalog import TABLES, Result, Selection, build, building, opened, query, records, update
from sceneloom.catalog.database import SHOWN, Database, format_csv, iter_list, sql_of
from sceneloom.catalog.storage import Layout, read_part
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.base import files as base_files

ORIGIN = (48.0, 11.0, 500.0)


def times_ns(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.int64) * 100_000_000


def box(identifier, label, timestamps_s, centers, *, attributes=()) -> sc.CuboidAnnotation:
    values = np.column_stack([np.tile([4.0, 2.0, 1.5], (len(centers), 1)), centers, np.zeros((len(centers), 3))])
    timestamps = np.round(np.asarray(timestamps_s) * 1e9).astype(np.int64)
    return sc.CuboidAnnotation(identifier, sc.CuboidPath(timestamps, values), label, attributes=attributes)


def street(*, seconds: int = 10, origin=ORIGIN, annotations=None) -> sc.Scene:
    """An ego that goes east by 5 m/s, and from half-time on by 15 m/s, with fixes at 10 Hz.

    A car stands 50 m east and 10 m north, a walker is there from 2 s to 3 s and goes north by 2 m/s from (20, 5); it
    rains from 4 s on.
    """
    times = times_ns(seconds * 10)
    t, half = times / 1e9, seconds / 2
    east = np.where(t < half, 5.0 * t, 5.0 * half + 15.0 * (t - half))
    points = np.stack([east, np.zeros_like(t), np.zeros_like(t)], axis=-1)
    lla = np.stack(pymap3d.enu2geodetic(east, 0.0 * t, 0.0 * t, *origin), axis=-1)
    unknown = np.full(len(times), np.nan)
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    rain = sc.AttributePath("weather", ("dry", "Rain"), np.array([0, 4_000_000_000]))
    if annotations is None:
        colour = sc.AttributePath("colour", ("red",), static=True)
        annotations = (
            box("car 1", "Car", [0.0, seconds - 0.1], [[50, 10, 0]] * 2, attributes=(colour,)),
            box(7, "pedestrian.adult", [2.0, 3.0], [[20, 5, 0], [20, 7, 0]]),
        )
    ego = sc.OdometrySensor("ego", sc.Poses(times, points, rotations))
    sensors = (sc.GnssSensor("gnss", times, lla, unknown, unknown), ego)
    return sc.Scene(sensors, annotations=tuple(annotations), attributes=(rain,))


@pytest.fixture(scope="session")
def drives(tmp_path_factory):
    """Three drives: the street in one town, in another, and one in which nothing is annotated."""
    folder = tmp_path_factory.mktemp("drives")
    other = street(origin=(-33.9, 179.9999, 20.0))
    sceneloom.write(street(), folder / "north.sfs")
    sceneloom.write(replace(other, attributes=()), folder / "o'south [x].sfs")
    shared = sc.AttributePath("odd", ("a", "b"), np.array([0, 1, 2], np.int64))  # a timestamp more than values
    short = street(seconds=2, annotations=())
    sceneloom.write(replace(short, attributes=(shared,)), folder / "short.sfs")
    return sorted(folder.iterdir())


@pytest.fixture(scope="session")
def catalogue(drives, tmp_path_factory):
    """The catalogue of the drives, in a folder whose name means much to shells, SQL and patterns."""
    folder = tmp_path_factory.mktemp("catalogues") / "o'c [a] *"
    report = build(drives, folder)
    assert (report.scenes, report.failed) == (3, ())
    return folder


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
    elsewhere = f"WHERE scene != '{building.scene_name(str(copies[2]), {})}'"
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


def test_drives_come_and_go_one_process_at_a_time_writes_and_a_stopped_run_leaves_what_was_read(copies, tmp_path):
    folder, stopped = tmp_path / "catalogue", tmp_path / "stopped"

    def stops(done, _):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(copies, stopped, progress=stops)
    assert query(stopped, "SELECT path FROM scenes ORDER BY path").rows == [(str(copy),) for copy in copies[:2]]
    report = update(stopped, copies)
    assert (report.added, report.unchanged) == ((str(copies[2]),), 2)
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


def test_odd_scenes_are_catalogued_too_by_names_that_mean_the_same_everywhere(tmp_path):
    for path in ("/a/b c.sfs", "/a/2024-01-01", "/", "s3://b/ü.sfs", "/x/'; DROP--", "/a/b\udcff"):
        name = building.scene_name(path, {})
        assert re.fullmatch("[A-Za-z0-9_]*-[A-Za-z0-9]+", name)
        assert name != building.scene_name(path, {"sequence": "2"})
    nan = float("nan")
    odd = sc.AttributePath("size \n", (10**400, True, ("a", "b"), {"x": 1}), np.arange(4))
    boxes = (
        box("'; DROP", None, [0.0, 1.0], [[nan, 1e300, 0]] * 2, attributes=(odd,)),
        box(1, "ünï\ud800", [0.05], [[0, 0, 0]]),
        box("1", "", [], np.zeros((0, 3))),
        sc.EventAnnotation("e", 5, label="rotation"),
    )
    scene = street(seconds=2, annotations=boxes)
    about = {"options": {}, "fingerprint": "", "size_bytes": None, "findings": ()}
    tables, empty = building.scene_rows(scene, path="x", **about), building.scene_rows(sc.Scene(()), path="y", **about)
    layout = Layout.made(tmp_path / "catalogue", overwrite=False)
    assert query(layout.folder, "SELECT count(*) FROM scenes JOIN annotations USING (scene)").rows == [(0,)]
    assert query(layout.folder, Selection(labels=("car",))).rows == []
    fresh = []
    for name, rows in (("a", tables), ("b", empty)):
        draft = layout.drafts / name
        written = building.write_draft(name, rows, draft)
        fresh.append(building.Fresh(name, building.Entry(name, {}, "?"), draft, written))
    with layout.held():
        assert not building.Parts(layout).put(fresh)
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
    path = sc.Poses(ego.poses.timestamps_ns[rows], ego.poses.positions[rows], ego.poses.quaternions_xyzw[rows])
    part = replace(scene, sensors=(replace(ego, poses=path),))
    boxes = building.box_rows(part, times_ns(100))
    nearest = building.track_rows(part, boxes, building.distances(part, building.Ego.of(part), boxes), 0)["nearest"]
    assert nearest == pytest.approx([np.hypot(50 - 5 * 2.9, 10), np.hypot(20 - 5 * 2.9, 7 - 0.2)], abs=0.5)
    whole = street()
    lla = whole.sensor("gnss").positions_lla.copy()
    lla[:, 2] = np.nan
    lla[50] = 0.0
    ego = building.Ego.of(replace(whole, sensors=(replace(whole.sensor("gnss"), positions_lla=lla),)))
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
        assert np.isfinite(building.Ego.of(scene).positions_lla(times_ns(3))).all() == known


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


@pytest.fixture
def copied(catalogue, tmp_path):
    return shutil.copytree(catalogue, tmp_path / "catalogue")


WRONG = (
    "COPY scenes TO '{0}/stolen.csv'",
    "CREATE TABLE t AS SELECT 1",
    "DROP VIEW scenes",
    "ATTACH '{0}/other.db'",
    "INSTALL httpfs",
    "SET enable_external_access = true",
    "SELECT 1; SELECT 2",
    "",
    "SELECT * FROM read_text('{0}/secret.txt')",
    "SELECT * FROM '{0}/secret.txt'",
    "SELECT * FROM glob('{0}/*')",
    "SELECT * FROM read_csv('https://127.0.0.1/x.csv')",
    "SELECT * FROM read_text('{1}/../secret.txt')",
    "SELEC",
    "SELECT nothing FROM scenes",
    "SELECT * FROM nowhere",
    "SELECT * FROM variable",
    "SELECT CAST('x' AS INTEGER)",
    "SELECT ?",
)


def test_sql_that_is_wrong_writes_or_looks_elsewhere_is_refused(copied, tmp_path):
    (tmp_path / "secret.txt").write_text("secret")
    variable = [1, 2, 3]  # which DuckDB would take for a table
    before = sorted(tmp_path.rglob("*"))
    for sql in WRONG:
        with pytest.raises(OptionError, match="SQL"):
            query(copied, sql.format(tmp_path, copied))
    assert sorted(tmp_path.rglob("*")) == before
    assert variable


WRITES = (
    "COPY scenes TO '{to}'",
    "COPY scenes TO '{to}' (FORMAT parquet)",
    "COPY (SELECT 1) TO '{to}' (FORMAT csv)",
    "COPY scenes TO '{folder}' (FORMAT parquet, PARTITION_BY scene, OVERWRITE)",
    "WITH x AS (COPY scenes TO '{to}') SELECT 1",
    "WITH x AS (COPY scenes TO '{to}') SELECT * FROM x",
    "PREPARE x AS COPY scenes TO '{to}'",
    "EXECUTE x",
    "EXPORT DATABASE '{folder}'",
    "ATTACH '{to}' AS other",
    "CREATE TABLE t AS SELECT * FROM scenes",
    "CREATE PERSISTENT SECRET s (TYPE http)",
    "DROP VIEW scenes",
    "CREATE OR REPLACE VIEW scenes AS SELECT 1",
    "INSTALL httpfs",
    "LOAD '{to}'",
    "CHECKPOINT",
    "SET temp_directory = '{folder}'",
    "SET lock_configuration = false",
    "RESET disabled_filesystems",
    "SET secret_directory = '{folder}'",
    "SET extension_directory = '{folder}'",
    "PRAGMA profiling_output = '{to}'",
    "PRAGMA enable_profiling = 'json'",
    "CALL enable_logging(storage = 'file', storage_path = '{folder}')",
    "SELECT * FROM enable_logging(storage = 'file', storage_path = '{folder}')",
    "SELECT write_log('x')",
    "SELECT * FROM query('COPY scenes TO ''{to}''')",
    "SELECT * FROM checkpoint()",
    "FROM read_blob('{to}')",
    "SELECT * FROM annotations ORDER BY ALL",
)
AROUND = ("{}", "EXPLAIN {}", "EXPLAIN ANALYZE {}", "EXPLAIN (ANALYZE, FORMAT json) {}")


def content(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize("guarded", [True, False], ids=["by the verb", "by the settings alone"])
@pytest.mark.few(10)
def test_no_statement_writes_anything_anywhere(copied, tmp_path, monkeypatch, guarded):
    home = tmp_path / "home"
    (home / "here").mkdir(parents=True)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(home / "here")
    if not guarded:
        monkeypatch.setattr(Database, "_check", lambda *_: None)
    (part,) = copied.glob("scenes/*.parquet")
    before, refused = content(tmp_path), 0
    with opened(copied) as database:
        for around, sql, to in product(AROUND, WRITES, (part, "new.csv", f"file://{part}", "http://127.0.0.1/x")):
            try:
                database.query(around.format(sql.format(to=to, folder=tmp_path / "new")))
            except OptionError:
                refused += 1
        assert content(tmp_path) == before
        assert refused > 300
        assert database.query("SELECT count(*) FROM scenes").rows == [(3,)]


def test_a_folder_that_is_no_catalogue_and_more_rows_than_bytes_are_refused(catalogue, tmp_path, monkeypatch):
    monkeypatch.setattr(base_files, "ALWAYS_UNPACKED", 1)
    monkeypatch.setattr(base_files, "LARGEST_RATIO", 0)
    with pytest.raises(DataError, match="bytes that unpack to"):
        read_part(next(catalogue.glob("annotations/*.parquet")))
    for content in (None, "", "{", "[]", '{"version": 99}'):
        if content is not None:
            (tmp_path / "catalog.json").write_text(content)
        for use in (lambda: query(tmp_path, "SELECT 1"), lambda: update(tmp_path)):
            with pytest.raises(DataError):
                use()


@pytest.mark.parametrize("table", TABLES)
def test_damage_inside_a_file_is_named_and_repaired(copied, table):
    (file,) = copied.glob(f"{table}/*.parquet")
    sql = f"SELECT * FROM {table} ORDER BY ALL"
    whole, right = file.read_bytes(), repr(query(copied, sql).rows)
    footer = int.from_bytes(whole[-8:-4], "little") + 8
    damages = [(whole[:-7], "no whole Parquet file")]
    if right != "[]":  # something is in it
        damages.append((whole[:4] + bytes(len(whole) - footer - 4) + whole[-footer:], "delete the file"))
    for content, problem in damages:
        file.write_bytes(content)
        with pytest.raises(DataError, match=problem) as refused:
            query(copied, sql)
        assert refused.value.file == str(file)
        if problem == "delete the file":
            file.unlink()
        report = update(copied)
        assert (len(report.changed), report.unchanged) == (3, 0)
        assert repr(query(copied, sql).rows) == right


@pytest.mark.parametrize("table", ["annotations", "scenes"])
@pytest.mark.few(1)
def test_queries_and_updates_of_files_with_wrong_bytes_end_well_or_name_them(copied, drives, table):
    (file,) = copied.glob(f"{table}/*.parquet")
    whole, random, refused = file.read_bytes(), np.random.default_rng(2), 0
    for length in [*random.integers(0, len(whole), 4).tolist(), *[len(whole)] * 8]:
        content = bytearray(whole[:length])
        for location in random.integers(0, max(length, 1), 8).tolist() if length == len(whole) else ():
            content[location] = int(random.integers(256))
        file.write_bytes(content)
        try:
            query(copied, "SELECT * FROM annotations JOIN scenes USING (scene)")
        except DataError:
            refused += 1
        report = update(copied, drives[:1], checks="none")
        assert not report.failed
        assert not update(copied, drives, checks="none").failed
        assert query(copied, "SELECT count(*) FROM scenes").rows == [(3,)]
        assert query(copied, "SELECT count(*) FROM annotations").rows[0][0] > 200
    assert refused


def spans(catalogue, drive, **wanted):
    result = query(catalogue, Selection(**wanted))
    return [(row[1], row[2]) for row in result.rows if row[0] == str(drive)]


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ({"labels": ("PEDESTRIAN*",)}, [(2.0, 3.1)]),
        ({"labels": ("car",), "start": 8.0}, [(8.0, 10.0)]),
        ({"labels": ("car",), "stop": "1970-01-01T00:00:01"}, [(0.0, 1.0)]),
        ({"count": 2}, [(2.0, 3.1)]),
        ({"count": 3}, []),
        ({"labels": ("nothing",)}, []),
        ({"types": ("box_2d",)}, []),
        ({"speed": (0.0, 6.0)}, [(0.0, 4.9)]),  # of half a second, no more than 0.05 s at 15 m/s
        ({"attributes": (("Weather", "rain"),)}, [(4.0, 10.0)]),
        ({"attributes": (("weather", "dry"),), "labels": ("car",)}, [(0.0, 4.0)]),
        ({"attributes": (("colour", "red"),), "count": 1}, [(0.0, 10.0)]),
        ({"attributes": (("colour", "red"),), "labels": ("ped*",)}, []),
        ({"findings": ("no-such-rule",)}, []),
        ({"distance": (0.0, 15.0), "labels": ("car",)}, [(6.0, 7.5)]),  # 11.2 m east or west of it
        ({}, [(0.0, 10.0)]),
    ],
    ids=str,
)
def test_spans_are_those_in_which_all_holds(catalogue, drives, wanted, expected):
    found = spans(catalogue, drives[0], **wanted)
    assert np.array(found).reshape(-1) == pytest.approx(np.array(expected).reshape(-1))


def test_locations_are_found_by_metres_on_the_ellipsoid_also_across_the_date_line(catalogue, drives):
    t = np.arange(100) / 10
    east = np.where(t < 5, 5 * t, 25 + 15 * (t - 5))
    for drive, origin in ((drives[0], (48.0, 11.0)), (drives[1], (-33.9, 179.9999))):
        latitude, longitude, _ = pymap3d.enu2geodetic(east, 0 * t, 0 * t, *origin, 0)
        away = np.array([vdist(*origin, *p)[0] for p in zip(latitude, longitude, strict=True)])
        found = spans(catalogue, drive, near=(*origin, 40.0))
        assert found == [(0.0, pytest.approx(t[away <= 40.0][-1] + 0.1))]


def test_findings_choose_drives_rows_are_the_boxes_and_decimals_are_exact_in_csv(catalogue, drives):
    rules = query(catalogue, "SELECT DISTINCT rule, path FROM findings JOIN scenes USING (scene)").rows
    assert rules, "the drives state less than the rules want"
    rule = rules[0][0]
    chosen = query(catalogue, Selection(findings=(rule,)), show="drives")
    assert [row[0] for row in chosen.rows] == sorted(path for name, path in rules if name == rule)
    result = query(catalogue, Selection(labels=("ped*",)), show="rows")
    mine = [row for row in records(result) if row["path"] == str(drives[0])]
    assert (len(mine), mine[0]["left_px"]) == (11, None)
    assert format_csv(result).count("\n") == len(result.rows) + 1
    found = query(catalogue, "SELECT path, 0.5 AS start, 12345678901234567.25 AS stop FROM scenes LIMIT 1")
    assert (records(found)[0]["start"], json.loads(next(iter_list(found)))["start"]) == (0.5, 0.5)
    assert format_csv(found).endswith(",0.5,12345678901234567.25\n")


def test_a_gap_joins_spans_a_margin_widens_them_and_lists_are_what_a_batch_takes(catalogue, drives, tmp_path):
    rows = query(catalogue, Selection(labels=("car",)), gap=float("inf"), margin=float("inf"))
    assert [row[1] for row in rows.rows] == [0.0, 0.0]
    assert [json.loads(line).keys() for line in iter_list(rows)] == [{"path", "start"}] * 2
    wanted = Selection(labels=("car",), distance=(10.2, 15.0))
    both = [row[1:3] for row in query(catalogue, wanted, gap=0.2).rows if row[0] == str(drives[0])]
    assert len(both) == 2
    one = [row[1:3] for row in query(catalogue, wanted, gap=2.0, margin=0.5).rows if row[0] == str(drives[0])]
    assert one == [pytest.approx((both[0][0] - 0.5, both[1][1] + 0.5))]
    lines = list(iter_list(query(catalogue, Selection(labels=("ped*",)))))
    (tmp_path / "found.jsonl").write_text("\n".join(lines))
    inputs = find_inputs((), (tmp_path / "found.jsonl",))
    assert [drive.location for drive in inputs] == list(map(str, drives[:2]))
    assert inputs[0].options == {"start": 2.0, "stop": json.loads(lines[0])["stop"]}
    with pytest.raises(OptionError, match="needs the column `path`"):
        list(iter_list(query(catalogue, "SELECT 1 AS start")))


def test_bounds_and_times_that_nothing_can_fit_are_refused(catalogue):
    nan = float("nan")
    for wanted in (
        *({"near": near} for near in ((91.0, 0.0, 1.0), (0.0, 0.0, nan), (0.0, 0.0, -1.0))),
        *({"speed": (5.0, 1.0)}, {"distance": (nan, 1.0)}, {"count": 0}),
        *({"start": "noon"}, {"start": "nan"}, {"stop": nan}),
    ):
        with pytest.raises(OptionError, match="'noon'" if wanted.get("start") == "noon" else None):
            query(catalogue, Selection(**wanted))
    with pytest.raises(OptionError, match="rows"):
        query(catalogue, Selection(), show="all")


ODD = (
    "SELECT '\ud800'",
    "SELECT 1\0",
    "SELECT DATE '290000-01-01'",
    "SELECT 'infinity'::DATE",
    "SELECT INTERVAL 99999999 YEAR",
    "SELECT now()",
    "SELECT TIMESTAMP_NS '2024-01-01 00:00:00.123456789'",
    "SELECT 170141183460469231731687303715884105727::HUGEINT, 'nan'::DOUBLE, '-inf'::DOUBLE",
    "SELECT [1, NULL], {'a': 'x'}, MAP{1: 2}, '\\xAA'::BLOB, TIME '24:00:00', '101'::BIT",
    "SELECT [DATE '2024-01-01', NULL], {'a': 'nan'::DOUBLE}, MAP{[1]: 2}",
    "SELECT path, path, path AS path_1 FROM scenes",
    "SELECT error('x')",
    "SELECT 9223372036854775807 + 1",
    "SELECT COLUMNS('(') FROM scenes",
    "SELECT path, 'nan'::DOUBLE AS start, 'x' AS stop FROM scenes",
    "EXPLAIN ANALYZE SELECT * FROM scenes",
    "DESCRIBE scenes",
    "PREPARE x AS SELECT 1",
    "SELECT $name",
    "/*",
    "'",
)
WORDS = (
    *("SELECT", "FROM", "WHERE", "GROUP BY", "ORDER BY", "LIMIT", "UNION", "JOIN", "USING", "(scene)", "AS", "WITH"),
    *("count(*)", "min(distance)", "any_value(label)", "*", ",", "(", ")", "'", '"', ";", "--", "=", "<", "IN", "NOT"),
    *("NULL", "1", "-1", "1e400", "'x'", "'[a'", "true", "?", "$1", "::INTEGER", "::TIMESTAMP", "::JSON", "%", "||"),
    *TABLES,
    *("label", "seconds", "timestamp_ns", "nothing", "a.b", "x[1]", "{'k': 1}", "[1]", "CASE", "END", "OVER ()"),
)  # fmt: skip
numbers = st.floats() | st.integers(-5, 5).map(float)
texts = st.text(st.characters(codec=None), max_size=8) | st.sampled_from(["*", "[", "[!", "car", "Car", "'", "%"])
pairs = st.tuples(numbers, numbers)
selections = st.fixed_dictionaries(
    {},
    optional={
        "labels": st.lists(texts, max_size=3).map(tuple),
        "types": st.lists(st.sampled_from(["cuboid", "box_2d"]) | texts, max_size=2).map(tuple),
        "start": numbers | texts | st.datetimes().map(str),
        "stop": numbers | texts,
        "near": st.tuples(numbers | st.just(48.0), numbers | st.just(11.0), numbers),
        "speed": pairs,
        "distance": pairs,
        "count": st.integers() | st.just(1),
        "attributes": st.lists(st.tuples(texts, texts), max_size=2).map(tuple),
        "findings": st.lists(texts, max_size=2).map(tuple),
    },
)
patient = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def database(catalogue):
    with opened(catalogue) as database:
        yield database


def check(result: Result) -> None:
    """What was found can be written in all forms."""
    assert json.loads(json.dumps(records(result), allow_nan=False)) == records(result)
    assert all(len(row) == len(result.columns) for row in records(result))
    assert len(list(csv.reader(io.StringIO(format_csv(result))))) >= 1
    try:
        assert all(json.loads(line)["path"] for line in iter_list(result))
    except OptionError as error:
        assert "path" in str(error)  # noqa: PT017 - many results are no lists


@pytest.mark.parametrize("sql", ODD)
def test_odd_sql_gives_rows_or_is_refused(catalogue, sql):
    try:
        result = query(catalogue, sql)
    except OptionError as error:
        assert re.fullmatch("SQL(?!.*Traceback).*", str(error))  # noqa: PT017 - the one or the other
    else:
        check(result)


@patient
@given(words=st.lists(st.sampled_from(WORDS) | texts, max_size=12))
def test_words_in_any_order_give_rows_or_are_refused(database, words):
    try:
        result = database.query(" ".join(["SELECT", *words]), limit=20)
    except OptionError:
        return
    check(result)


@patient
@given(wanted=selections, show=st.sampled_from([*SHOWN]), gap=numbers, margin=numbers, limit=st.none() | st.integers())
def test_any_filters_give_rows_or_are_refused(database, wanted, show, gap, margin, limit):
    try:
        sql, values = sql_of(Selection(**wanted), show=show, gap=gap, margin=margin)
        result = database.query(sql, values, limit=limit)
    except OptionError:
        return
    assert limit is None or len(result.rows) <= limit
    check(result)
