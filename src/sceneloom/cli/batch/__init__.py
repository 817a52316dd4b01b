"""`sceneloom batch` and its verbs."""

from sceneloom.cli.batch.group import batch

__all__ = ["batch"]
