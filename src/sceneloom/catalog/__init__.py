"""Many drives as tables: scenes, sensors, frames, annotations, tracks, attributes and findings, with SQL over them.

Every name is imported when it is first used: a query needs nothing of what reads drives, which takes long to import.
"""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.catalog.building import CatalogReport, Checks, Drive, Failure, build, update
    from sceneloom.catalog.database import (
        SHOWN,
        Database,
        Result,
        Selection,
        format_csv,
        iter_list,
        opened,
        query,
        records,
        sql_of,
    )
    from sceneloom.catalog.tables import TABLES, Column, Kind
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "SHOWN": "sceneloom.catalog.database:SHOWN",
            "TABLES": "sceneloom.catalog.tables:TABLES",
            "CatalogReport": "sceneloom.catalog.building:CatalogReport",
            "Checks": "sceneloom.catalog.building:Checks",
            "Column": "sceneloom.catalog.tables:Column",
            "Database": "sceneloom.catalog.database:Database",
            "Drive": "sceneloom.catalog.building:Drive",
            "Failure": "sceneloom.catalog.building:Failure",
            "Kind": "sceneloom.catalog.tables:Kind",
            "Result": "sceneloom.catalog.database:Result",
            "Selection": "sceneloom.catalog.database:Selection",
            "build": "sceneloom.catalog.building:build",
            "format_csv": "sceneloom.catalog.database:format_csv",
            "iter_list": "sceneloom.catalog.database:iter_list",
            "opened": "sceneloom.catalog.database:opened",
            "query": "sceneloom.catalog.database:query",
            "records": "sceneloom.catalog.database:records",
            "sql_of": "sceneloom.catalog.database:sql_of",
            "update": "sceneloom.catalog.building:update",
        },
    )

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
