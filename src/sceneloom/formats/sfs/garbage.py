"""Keeping the garbage collector away while a header is taken apart or put together."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def collector_paused() -> Iterator[None]:
    """Pause the search for reference cycles.

    A header makes very many small objects that all stay and form no cycles: the collector would walk over them again
    and again and take more time than the parsing.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
