"""No decoder is open while a process forks: the child would have its file, at one common location, but not its threads.

A decoder whose threads are gone hangs when it is used or closed, and even when its process ends.
"""

import os
from typing import Protocol
from weakref import WeakValueDictionary


class Resting(Protocol):
    """What can be put to rest while its process forks."""

    def hold(self) -> None:
        """Close what must not be forked, and let nothing be opened until `release`."""
        ...

    def release(self) -> None:
        """Go on, in the parent as in the child."""
        ...


_KNOWN: "WeakValueDictionary[int, Resting]" = WeakValueDictionary()
_HELD: list[Resting] = []


def rest_while_forking(holder: Resting) -> None:
    """Have an object put to rest whenever the process forks, as long as there are other references to it."""
    _KNOWN[id(holder)] = holder


def _hold() -> None:
    for reference in _KNOWN.valuerefs():
        holder = reference()
        if holder is not None:
            holder.hold()
            _HELD.append(holder)


def _release() -> None:
    while _HELD:
        _HELD.pop().release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_hold, after_in_parent=_release, after_in_child=_release)
