"""Queries of a catalogue: SQL, selections, and odd questions."""

import csv
import io
import json
import re
import shutil
from itertools import product

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymap3d import enu2geodetic
from pymap3d.vincenty import vdist

from sceneloom.batch.jobs import find_inputs
from sceneloom.catalog import SHOWN, TABLES, Result, Selection, format_csv, iter_list, opened, query, records, update
from sceneloom.catalog.database import Database, sql_of
from sceneloom.catalog.storage import read_part
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base import files as base_files


@pytest.fixture
def copied(catalogue, tmp_path):
    return shutil.copytree(catalogue, tmp_path / "catalogue")


@pytest.mark.parametrize(
    "sql",
    [
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
    ],
)
def test_sql_that_is_wrong_writes_or_looks_elsewhere_is_refused(copied, tmp_path, sql):
    (tmp_path / "secret.txt").write_text("secret")
    variable = [1, 2, 3]  # which DuckDB would take for a table
    before = sorted(tmp_path.rglob("*"))
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


def test_a_file_that_declares_far_more_rows_than_its_bytes_is_refused(copied, monkeypatch):
    monkeypatch.setattr(base_files, "ALWAYS_UNPACKED", 1)
    monkeypatch.setattr(base_files, "LARGEST_RATIO", 0)
    with pytest.raises(DataError, match="bytes that unpack to"):
        read_part(next(copied.glob("annotations/*.parquet")))


def test_a_folder_that_is_no_catalogue_is_refused(tmp_path):
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
        latitude, longitude, _ = enu2geodetic(east, 0 * t, 0 * t, *origin, 0)
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
        {"speed": (5.0, 1.0)},
        {"near": (91.0, 0.0, 1.0)},
        {"near": (0.0, 0.0, nan)},
        {"near": (0.0, 0.0, -1.0)},
        {"distance": (nan, 1.0)},
        {"start": "noon"},
        {"start": "nan"},
        {"stop": nan},
        {"count": 0},
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
