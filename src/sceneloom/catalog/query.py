"""Asking a catalogue once, by SQL or by what is looked for."""

from pathlib import Path

from sceneloom.catalog.database import Result, opened
from sceneloom.catalog.selection import Selection, sql_of


def query(
    catalogue: str | Path,
    wanted: str | Selection,
    *,
    show: str = "spans",
    gap: float = 1.0,
    margin: float = 0.0,
    limit: int | None = None,
) -> Result:
    """Ask a catalogue.

    Args:
        catalogue: its folder.
        wanted: one SQL statement that reads, or what is looked for.
        show: of a selection: "spans", "drives" or "rows".
        gap: of a selection: moments no more than so many seconds apart are one span.
        margin: of a selection: spans are so many seconds longer at both ends.
        limit: at most so many rows; None for all.

    Raises:
        OptionError: the SQL is wrong, writes or wants other files, or the selection cannot be.
        DataError: there is no catalogue, or a file of it is damaged.
        MissingExtraError: duckdb or pyarrow is not installed.
    """
    with opened(catalogue) as database:
        if isinstance(wanted, str):
            return database.query(wanted, limit=limit)
        sql, values = sql_of(wanted, show=show, gap=gap, margin=margin)
        return _without_idle_options(database.query(sql, values, limit=limit))


def _without_idle_options(result: Result) -> Result:
    """Leave out how drives are read, where all are read as they come."""
    column = result.columns.index("options")
    if any(row[column] is not None for row in result.rows):
        return result
    columns = result.columns[:column] + result.columns[column + 1 :]
    return Result(columns, [row[:column] + row[column + 1 :] for row in result.rows])
