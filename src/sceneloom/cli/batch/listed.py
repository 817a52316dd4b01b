"""The drives that a command names, or lists of them, which many verbs may share."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sceneloom.cli import options
from sceneloom.cli.batch.one_drive import BATCHED

if TYPE_CHECKING:
    from sceneloom.batch.jobs import FileOption, Input


def find_listed(
    verb: str,
    locations: Sequence[str],
    lists: Sequence[Path],
    *,
    files: "Mapping[str, FileOption] | None" = None,
    reading: Mapping[str, Any] | None = None,
    stays: "Callable[[Input], bool]" = lambda _: False,
    quiet: bool = False,
) -> "tuple[Input, ...]":
    """Find the drives of a command, and state what of lists is for other verbs.

    Args:
        verb: what the command does.
        locations, lists, files: as of `find_inputs`.
        reading: options of the command, where each drive of a data set shall count for itself unless they name one.
        stays: which data sets do not count so, since the verb does all their drives at once.
        quiet: state nothing.
    """
    from sceneloom.batch.jobs import each_drive, find_inputs, flag_of

    others = {option for batched in BATCHED.values() for option in batched.beside}
    found = find_inputs(locations, lists, files=files or {}, others=others)
    unread = sorted({option for drive in found for option in drive.unread})
    if unread and not quiet:
        flags = ", ".join(map(flag_of, unread))
        click.echo(f"not read by {verb}: what the lists state for {flags}", err=True)
    if reading is None:
        return found
    reported = options.stated(**reading)
    if reported.get("sequence") or reported.get("sequences"):
        return found
    drives: list[Input] = []
    for one in found:
        several = (one,) if stays(one) else each_drive(one, read_as=reported.get("read_as"))
        if len(several) > 1 and not quiet:
            click.echo(f"{one.name}: {len(several)} drives; --sequence chooses one", err=True)
        drives += several
    return tuple(drives)
