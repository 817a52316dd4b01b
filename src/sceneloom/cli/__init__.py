"""The command line: parse, call, print."""

from sceneloom.cli.main import main

__all__ = ["main"]
