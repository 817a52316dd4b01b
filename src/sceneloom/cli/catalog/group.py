"""The verbs of `sceneloom catalog`, each imported when it is called."""

from types import MappingProxyType

import click

from sceneloom.cli.verb_group import VerbGroup

VERBS = MappingProxyType(
    {
        "build": "Make a catalogue of drives.",
        "update": "Bring a catalogue up to date: only what changed is read.",
        "query": "Ask a catalogue, by SQL or by ready filters.",
    }
)


@click.group(cls=VerbGroup, verbs=VERBS, room="sceneloom.cli.catalog")
def catalog() -> None:
    """Put many drives into tables (Parquet), and find drives and moments in them."""
