"""`sceneloom catalog` and its verbs."""

from sceneloom.cli.catalog.group import catalog

__all__ = ["catalog"]
