"""The command `sceneloom eval` and the table of its verbs: an estimate and a reference in, figures out."""

from types import MappingProxyType

import click

from sceneloom.cli.verb_group import VerbGroup

VERBS = MappingProxyType(
    {
        "detection": "Report how good detections are.",
        "tracking": "Report how good a tracker is.",
        "trajectory": "Report how far a trajectory is from a reference.",
    }
)
"""Each verb stands in the module of its name, with `_` for `-`."""


@click.group(cls=VerbGroup, verbs=VERBS, room="sceneloom.cli.eval")
def eval() -> None:  # noqa: A001 - the verb's name
    """Report how good an estimate is, against a reference."""
