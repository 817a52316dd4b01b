"""Groups of verbs that are imported when they are called."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import click


class VerbGroup(click.Group):
    """Imports a verb's module only when that verb is called, so that `--help` is quick."""

    def __init__(self, *arguments: Any, verbs: Mapping[str, str], room: str, **options: Any) -> None:
        """Hold the verbs with a line on each, and the package whose modules bear their names, `_` for `-`."""
        super().__init__(*arguments, **options)
        self.verbs, self.room = verbs, room

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Names of the verbs, in the order of the table."""
        return list(self.verbs)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import one verb."""
        if cmd_name not in self.verbs:
            return None
        name = cmd_name.replace("-", "_")
        command: click.Command = getattr(import_module(f"{self.room}.{name}"), name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """List the verbs from the table, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(self.verbs.items()))
