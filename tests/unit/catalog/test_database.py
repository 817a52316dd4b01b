"""SQL reads the catalogue, and can do nothing else; what is damaged is named."""

import shutil
from itertools import product

import numpy as np
import pytest

from sceneloom.catalog import TABLES, opened, query, update
from sceneloom.catalog.database import Database
from sceneloom.catalog.storage import read_part
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base import files as base_files


@pytest.fixture
def copied(catalogue, tmp_path):
    """A catalogue that may be spoiled."""
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
        "SELECT CAST('x' AS INTEGER)",
        "SELECT ?",
    ],
)
def test_sql_that_is_wrong_writes_or_looks_elsewhere_is_refused(copied, tmp_path, sql):
    (tmp_path / "secret.txt").write_text("secret")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(OptionError, match="SQL"):
        query(copied, sql.format(tmp_path, copied))
    assert sorted(tmp_path.rglob("*")) == before


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
        for around, sql, to in product(
            AROUND, WRITES, (part, "new.csv", f"file://{part}", "http://127.0.0.1/x")
        ):
            try:
                database.query(around.format(sql.format(to=to, folder=tmp_path / "new")))
            except OptionError:
                refused += 1
        assert content(tmp_path) == before
        assert refused > 300
        assert database.query("SELECT count(*) FROM scenes").rows == [(3,)]


def test_names_of_this_program_are_no_tables(catalogue):
    secret = [1, 2, 3]
    with pytest.raises(OptionError, match="secret"):
        query(catalogue, "SELECT * FROM secret")
    assert secret


def test_a_damaged_file_is_named_and_made_anew_by_an_update(copied, drives):
    files = sorted(copied.glob("annotations/*.parquet"))
    whole = query(copied, "SELECT count(*) FROM annotations").rows
    files[0].write_bytes(files[0].read_bytes()[:-7])
    with pytest.raises(DataError, match="no whole Parquet file") as refused:
        query(copied, "SELECT * FROM annotations")
    assert refused.value.file == str(files[0])
    report = update(copied)
    assert (len(report.changed), report.unchanged) == (3, 0)
    assert query(copied, "SELECT count(*) FROM annotations").rows == whole


def test_a_file_that_declares_far_more_rows_than_its_bytes_is_refused(copied, monkeypatch):
    monkeypatch.setattr(base_files, "ALWAYS_UNPACKED", 1)
    monkeypatch.setattr(base_files, "LARGEST_RATIO", 0)
    with pytest.raises(DataError, match="bytes that unpack to"):
        read_part(next(copied.glob("annotations/*.parquet")))


@pytest.mark.parametrize("content", [None, "", "{", "[]", '{"version": 99}'])
def test_a_folder_that_is_no_catalogue_is_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "catalog.json").write_text(content)
    with pytest.raises(DataError):
        query(tmp_path, "SELECT 1")
    with pytest.raises(DataError):
        update(tmp_path)


@pytest.mark.parametrize("table", ["annotations", "scenes"])
def test_files_with_wrong_bytes_give_rows_or_an_error_about_data(copied, table):
    file = next(copied.glob(f"{table}/*.parquet"))
    whole, random = file.read_bytes(), np.random.default_rng(1)
    refused = 0
    for _ in range(12):
        content = bytearray(whole)
        for location in random.integers(0, len(whole), 8).tolist():
            content[location] = int(random.integers(256))
        file.write_bytes(content)
        try:
            query(copied, "SELECT * FROM annotations JOIN scenes USING (scene)")
        except DataError:
            refused += 1
    assert refused


@pytest.mark.parametrize("table", TABLES)
def test_damage_inside_a_file_is_named_and_repaired(copied, table):
    (file,) = copied.glob(f"{table}/*.parquet")
    sql = f"SELECT * FROM {table} ORDER BY ALL"
    whole, right = file.read_bytes(), repr(query(copied, sql).rows)
    footer = int.from_bytes(whole[-8:-4], "little") + 8
    file.write_bytes(whole[:4] + bytes(len(whole) - footer - 4) + whole[-footer:])
    if table == "findings" and right == "[]":
        return  # nothing is in it
    with pytest.raises(DataError, match="delete the file") as refused:
        query(copied, sql)
    assert refused.value.file == str(file)
    file.unlink()
    assert len(update(copied).changed) == 3
    assert repr(query(copied, sql).rows) == right


@pytest.mark.parametrize("table", ["annotations", "scenes"])
@pytest.mark.few(1)
def test_updates_of_files_with_wrong_bytes_end_well_or_name_them(copied, drives, table):
    (file,) = copied.glob(f"{table}/*.parquet")
    whole, random = file.read_bytes(), np.random.default_rng(2)
    for length in [*random.integers(0, len(whole), 4).tolist(), *[len(whole)] * 8]:
        content = bytearray(whole[:length])
        for location in random.integers(0, max(length, 1), 8).tolist() if length == len(whole) else ():
            content[location] = int(random.integers(256))
        file.write_bytes(content)
        report = update(copied, drives[:1], checks="none")
        assert not report.failed
        assert not update(copied, drives, checks="none").failed
        assert query(copied, "SELECT count(*) FROM scenes").rows == [(3,)]
        assert query(copied, "SELECT count(*) FROM annotations").rows[0][0] > 200
