"""`sceneloom edit` and its verbs, one module each, imported when it is called."""

from sceneloom.cli.edit.group import edit

__all__ = ["edit"]
