"""A word to people before the first run is silent for a minute, since it compiles the inner loops."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import click

from sceneloom.kernels.cache import reporting_compiling


@contextmanager
def telling_of_compiling() -> Iterator[None]:
    """Report once on a terminal that kernels are compiled, if any are meanwhile."""
    if not sys.stderr.isatty():
        yield
        return
    compiled: list[str] = []

    def state(module: str) -> None:
        if not compiled:
            click.echo("compiling the inner loops for this machine; they are kept …", err=True)
        compiled.append(module)

    with reporting_compiling(state):
        yield
