"""The drives that a command names, or lists of them, which many verbs may share."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sceneloom.cli.batch.one_drive import BATCHED

if TYPE_CHECKING:
    from sceneloom.batch.inputs import FileOption
    from sceneloom.batch.jobs import Input


def find_listed(
    verb: str,
    places: Sequence[str],
    lists: Sequence[Path],
    *,
    files: "Mapping[str, FileOption] | None" = None,
    quiet: bool = False,
) -> "tuple[Input, ...]":
    """Find the drives of a command, and say which files of lists are for other verbs; as `find_inputs`."""
    from sceneloom.batch.files import flag_of
    from sceneloom.batch.inputs import find_inputs

    others = {option for batched in BATCHED.values() for option in batched.beside}
    found = find_inputs(places, lists, files=files or {}, others=others)
    unread = sorted({option for drive in found for option in drive.unread})
    if unread and not quiet:
        flags = ", ".join(map(flag_of, unread))
        click.echo(f"not read by {verb}: what the lists say for {flags}", err=True)
    return found
