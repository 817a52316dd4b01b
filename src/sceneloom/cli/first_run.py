"""A word to people before the first run is silent for a minute, since it compiles the inner loops."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

import click

from sceneloom.kernels.cache import will_compile


class _Watch(MetaPathFinder):
    """Finds no module, but sees which ones are asked for."""

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,  # noqa: ARG002 - as importlib calls it
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        if will_compile(fullname):
            sys.meta_path.remove(self)
            click.echo("compiling the inner loops for this machine; they are kept …", err=True)
        return None


@contextmanager
def telling_of_compiling() -> Iterator[None]:
    """Say once on a terminal that kernels are compiled, if any are meanwhile."""
    if not sys.stderr.isatty():
        yield
        return
    watch = _Watch()
    sys.meta_path.insert(0, watch)
    try:
        yield
    finally:
        if watch in sys.meta_path:
            sys.meta_path.remove(watch)
