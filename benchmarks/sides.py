"""Sides of a comparison that take rotates, timed by the clock and by their processors."""

import resource
import time
from collections.abc import Callable, Mapping


def measure(sides: Mapping[str, Callable[[], object]], repetitions: int) -> dict[str, tuple[float, float]]:
    """Give the least seconds, and the least processor seconds of the busiest process, of each side."""
    least = dict.fromkeys(sides, (float("inf"), float("inf")))
    for _ in range(repetitions):
        for name, run in sides.items():
            begun, ours, theirs = time.perf_counter(), _busy(0), _busy(1)
            run()
            taken = time.perf_counter() - begun, max(_busy(0) - ours, _busy(1) - theirs)
            least[name] = (min(least[name][0], taken[0]), min(least[name][1], taken[1]))
    return least


def _busy(which: int) -> float:
    used = resource.getrusage((resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)[which])
    return used.ru_utime + used.ru_stime


def show(title: str, against: str, found: Mapping[str, tuple[float, float]]) -> None:
    print(title)
    wall, busy = found[against]
    for name, (seconds, processor) in found.items():
        print(
            f"  {name:28} {seconds:8.3f} s, ratio {wall / seconds:5.2f}; "
            f"processor {processor:8.3f} s, ratio {busy / processor:5.2f}"
        )
