"""Many drives as tables: scenes, sensors, frames, annotations, tracks, attributes and findings, with SQL over them."""

from sceneloom.catalog.asking import query
from sceneloom.catalog.building import CatalogReport, Checks, Failure, build, update
from sceneloom.catalog.database import Database, Result, opened
from sceneloom.catalog.results import format_csv, iter_list, records
from sceneloom.catalog.selection import SHOWN, Selection, sql_of
from sceneloom.catalog.tables import TABLES, Column, Kind

__all__ = [
    "SHOWN",
    "TABLES",
    "CatalogReport",
    "Checks",
    "Column",
    "Database",
    "Failure",
    "Kind",
    "Result",
    "Selection",
    "build",
    "format_csv",
    "iter_list",
    "opened",
    "query",
    "records",
    "sql_of",
    "update",
]
