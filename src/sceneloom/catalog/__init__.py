"""Many drives as tables: scenes, sensors, frames, annotations, tracks, attributes and findings, with SQL over them.

Every name is imported when it is first used: a query needs nothing of what reads drives, which takes long to import.
"""

from typing import TYPE_CHECKING

from sceneloom.lazy import names_on_first_use

if TYPE_CHECKING:
    from sceneloom.catalog.building import CatalogReport, Drive, build, update
    from sceneloom.catalog.database import SHOWN, Result, Selection, format_csv, iter_list, opened, query, records
    from sceneloom.catalog.storage import TABLES
else:
    __getattr__, __dir__ = names_on_first_use(
        __name__,
        {
            "SHOWN": "sceneloom.catalog.database:SHOWN",
            "TABLES": "sceneloom.catalog.storage:TABLES",
            "CatalogReport": "sceneloom.catalog.building:CatalogReport",
            "Drive": "sceneloom.catalog.building:Drive",
            "Result": "sceneloom.catalog.database:Result",
            "Selection": "sceneloom.catalog.database:Selection",
            "build": "sceneloom.catalog.building:build",
            "format_csv": "sceneloom.catalog.database:format_csv",
            "iter_list": "sceneloom.catalog.database:iter_list",
            "opened": "sceneloom.catalog.database:opened",
            "query": "sceneloom.catalog.database:query",
            "records": "sceneloom.catalog.database:records",
            "update": "sceneloom.catalog.building:update",
        },
    )

__all__ = [
    "SHOWN",
    "TABLES",
    "CatalogReport",
    "Drive",
    "Result",
    "Selection",
    "build",
    "format_csv",
    "iter_list",
    "opened",
    "query",
    "records",
    "update",
]
