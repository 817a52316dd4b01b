"""Results of queries as text: JSON, CSV, and the list of drives that `sceneloom batch` takes with `--list`."""

import csv
import io
import json
import math
from collections.abc import Iterator
from decimal import Decimal
from typing import Any

from sceneloom.catalog.database import Result
from sceneloom.errors import OptionError

_SPAN = ("start", "stop")


def records(result: Result) -> list[dict[str, Any]]:
    """Give the rows as mappings that JSON can hold; numbers that are none are null, decimals are floats."""
    return [dict(zip(result.columns, map(_plain, row), strict=True)) for row in result.rows]


def format_csv(result: Result) -> str:
    """Write a line for each row after one with the columns' names; null is empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(result.columns)
    writer.writerows([_cell(value) for value in row] for row in result.rows)
    return text.getvalue()


def iter_list(result: Result) -> Iterator[str]:
    """Give a line of JSON for each drive, or time span of one, without what was stated before.

    Raises:
        OptionError: the result has no column `path`, or a row of it has none.
    """
    if "path" not in result.columns:
        raise OptionError(
            f"a list of drives needs the column `path`, and takes `start`, `stop` and `options`; the result has "
            f"{', '.join(result.columns)}"
        )
    seen: set[str] = set()
    for row in records(result):
        if not isinstance(row["path"], str):
            raise OptionError(f"path {row['path']!r}; expected the path of a drive in each row")
        part = {name: row[name] for name in _SPAN if row.get(name) is not None}
        line = json.dumps({"path": row["path"], **part, **_reading(row.get("options"))}, ensure_ascii=False)
        if line not in seen:
            seen.add(line)
            yield line


def _reading(options: Any) -> dict[str, Any]:
    """How a drive is to be opened, out of the column `options` of `scenes`."""
    try:
        stated = json.loads(options) if isinstance(options, str) else None
    except (ValueError, RecursionError) as error:
        raise OptionError(f"options {options!r}; expected an object of JSON, as in `scenes`") from error
    return {"reading": stated} if stated else {}


def format_cell(value: Any) -> str:
    """A value for people: numbers with three locations, null as nothing."""
    if isinstance(value, float):
        return f"{value:.3f}"
    return _cell(value)


def _cell(value: Any) -> str:
    plain = str(value) if isinstance(value, Decimal) else _plain(value)
    if plain is None:
        return ""
    return json.dumps(plain, ensure_ascii=False) if isinstance(plain, list | dict) else str(plain)


def _plain(value: Any) -> Any:
    if isinstance(value, float | Decimal):  # DuckDB's 0.5 is a decimal
        return float(value) if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    return value if value is None or isinstance(value, str | int) else str(value)
