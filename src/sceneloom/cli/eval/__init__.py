"""`sceneloom eval` and its verbs, one module each, imported when it is called."""

from sceneloom.cli.eval.group import eval  # noqa: A004 - the verb's name

__all__ = ["eval"]
