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
            "building": "CatalogReport Drive build update",
            "database": "SHOWN Result Selection format_csv iter_list opened query records",
            "storage": "TABLES",
        },
    )

__all__ = [
    "SHOWN", "TABLES", "CatalogReport", "Drive", "Result", "Selection", "build", "format_csv", "iter_list", "opened",
    "query", "records", "update",
]  # fmt: skip
