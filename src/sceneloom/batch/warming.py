"""Compiled kernels before there are many workers: where some are missing, the first drive makes them for all."""

import time
from dataclasses import dataclass, field

from sceneloom.kernels.cache import find_kernel_cache

_PATIENCE_SECONDS = 10.0
"""After so long without a newly compiled module, what is left to the first drive is no compiling."""


@dataclass(slots=True)
class Warming:
    """Whether other drives should wait for the first one, which compiles what all of them need.

    Else each worker would compile the same; not all modules are needed by each verb, so what counts is whether more
    and more of them are there.
    """

    compiled: int = -1
    grown: float = field(default_factory=time.monotonic)
    over: bool = False

    def goes_on(self) -> bool:
        """Look once more."""
        if self.over:
            return False
        cache = find_kernel_cache()
        if cache.compiled > self.compiled:
            self.compiled, self.grown = cache.compiled, time.monotonic()
        stuck = time.monotonic() - self.grown > _PATIENCE_SECONDS
        self.over = cache.is_warm or not cache.writable or stuck
        return not self.over

    def end(self) -> None:
        """The first drive has ended."""
        self.over = True
