"""Trying again what may pass: after waits that grow, up to a deadline."""

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from sceneloom.formats.remote.faults import may_pass

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Patience:
    """How long something is tried.

    Attributes:
        tries: how often at most.
        wait: before the second try [s]; each later wait is twice as long.
        longest_wait: of one wait [s].
        deadline: after which nothing is tried again [s].
        answer: how long one answer may take [s].
    """

    tries: int = 5
    wait: float = 0.25
    longest_wait: float = 8.0
    deadline: float = 120.0
    answer: float = 30.0

    def pause(self, number: int) -> float:
        """The wait after try `number`, from 0 [s]; uneven, so that many workers do not come back all at once."""
        whole = min(self.wait * 2.0**number, self.longest_wait)
        return whole * random.uniform(0.5, 1.0)  # noqa: S311 - nothing secret hangs on it


PATIENCE = Patience()
"""How long back ends are tried."""


def patiently(action: Callable[[], Result], patience: Patience | None = None) -> Result:
    """Do something, again where it fails with what may pass; the last error is raised as it is."""
    rule = patience or PATIENCE
    begun = time.monotonic()
    for number in range(rule.tries):
        try:
            return action()
        except Exception as error:
            pause = rule.pause(number)
            late = time.monotonic() - begun + pause > rule.deadline
            if number + 1 == rule.tries or late or not may_pass(error):
                raise
        time.sleep(pause)
    raise AssertionError("unreachable: the last try returns or raises")
