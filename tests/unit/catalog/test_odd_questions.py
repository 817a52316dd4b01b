"""Whatever is asked, the answer is rows or an error about the question: never a trace, and no blame for the files."""

import csv
import io
import json
import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sceneloom.catalog import (
    SHOWN,
    TABLES,
    Result,
    Selection,
    format_csv,
    iter_list,
    opened,
    query,
    records,
    sql_of,
)
from sceneloom.errors import OptionError

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
texts = st.text(st.characters(codec=None), max_size=8) | st.sampled_from(
    ["*", "[", "[!", "car", "Car", "'", "%"]
)
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
patient = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


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
@given(
    wanted=selections,
    show=st.sampled_from([*SHOWN]),
    gap=numbers,
    margin=numbers,
    limit=st.none() | st.integers(),
)
def test_any_filters_give_rows_or_are_refused(database, wanted, show, gap, margin, limit):
    try:
        sql, values = sql_of(Selection(**wanted), show=show, gap=gap, margin=margin)
        result = database.query(sql, values, limit=limit)
    except OptionError:
        return
    assert limit is None or len(result.rows) <= limit
    check(result)


@pytest.mark.parametrize(
    "wanted",
    [
        {"start": "nan"},
        {"stop": float("nan")},
        {"near": (0.0, 0.0, float("nan"))},
        {"near": (0.0, 0.0, -1.0)},
        {"count": 0},
        {"distance": (float("nan"), 1.0)},
    ],
)
def test_numbers_that_nothing_can_fit_are_refused(catalogue, wanted):
    with pytest.raises(OptionError):
        query(catalogue, Selection(**wanted))


def test_decimals_are_numbers_in_lists_and_json_and_exact_in_csv(catalogue):
    found = query(catalogue, "SELECT path, 0.5 AS start, 12345678901234567.25 AS stop FROM scenes LIMIT 1")
    assert (records(found)[0]["start"], json.loads(next(iter_list(found)))["start"]) == (0.5, 0.5)
    assert format_csv(found).endswith(",0.5,12345678901234567.25\n")


def test_gap_and_margin_may_be_without_bound(catalogue):
    rows = query(catalogue, Selection(labels=("car",)), gap=float("inf"), margin=float("inf"))
    assert [row[1] for row in rows.rows] == [0.0, 0.0]
    assert [json.loads(line).keys() for line in iter_list(rows)] == [{"path", "start"}] * 2
