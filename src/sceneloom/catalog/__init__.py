"""Many drives as tables: scenes, sensors, frames, annotations, tracks, attributes and findings, with SQL over them.

Every name is imported when it is first used: a query needs nothing of what reads drives, which takes long to import.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sceneloom.catalog.asking import query
    from sceneloom.catalog.building import CatalogReport, build, update
    from sceneloom.catalog.database import Database, Result, opened
    from sceneloom.catalog.drives import Checks, Drive
    from sceneloom.catalog.results import format_csv, iter_list, records
    from sceneloom.catalog.running import Failure
    from sceneloom.catalog.selection import SHOWN, Selection, sql_of
    from sceneloom.catalog.tables import TABLES, Column, Kind

__all__ = [
    "SHOWN",
    "TABLES",
    "CatalogReport",
    "Checks",
    "Column",
    "Database",
    "Drive",
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

_ON_FIRST_USE = {
    "SHOWN": "selection",
    "TABLES": "tables",
    "CatalogReport": "building",
    "Checks": "drives",
    "Column": "tables",
    "Database": "database",
    "Drive": "drives",
    "Failure": "running",
    "Kind": "tables",
    "Result": "database",
    "Selection": "selection",
    "build": "building",
    "format_csv": "results",
    "iter_list": "results",
    "opened": "database",
    "query": "asking",
    "records": "results",
    "sql_of": "selection",
    "update": "building",
}
"""The module of everything that is imported when it is first asked for."""


def __getattr__(name: str) -> Any:
    if name not in _ON_FIRST_USE:
        raise AttributeError(f"module 'sceneloom.catalog' has no attribute {name!r}")
    value = getattr(import_module(f"sceneloom.catalog.{_ON_FIRST_USE[name]}"), name)
    globals()[name] = value
    return value
