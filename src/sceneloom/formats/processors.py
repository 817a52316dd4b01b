"""How many processors there are for this process."""

import os


def processors() -> int:
    """Those that the process may run on, where the system says so, else those of the machine; at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
