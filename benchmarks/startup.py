"""How long a user waits before anything happens: `import sceneloom` and `sceneloom --help`.

Run with `python -m benchmarks.startup [RUNS]`. Each run is a new process; the commands take rotates, so that a
busy machine slows all of them alike. Printed are medians.
"""

import statistics
import subprocess
import sys
import time
from pathlib import Path

PROGRAM = str(Path(sys.executable).parent / "sceneloom")
COMMANDS = {
    "python -c pass": [sys.executable, "-c", "pass"],
    "import numpy": [sys.executable, "-c", "import numpy"],
    "import numpy, msgspec": [sys.executable, "-c", "import numpy, msgspec"],
    "import sceneloom": [sys.executable, "-c", "import sceneloom"],
    "sceneloom --help": [PROGRAM, "--help"],
}
LIMITS_MS = {"import sceneloom": 150, "sceneloom --help": 300}


def seconds_of(command: list[str]) -> float:
    """Run one command and give its wall time [s]."""
    started = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - started


def measure(runs: int) -> dict[str, list[float]]:
    """Give the wall times [ms] of every command; a first round warms the disk cache and is not counted."""
    for command in COMMANDS.values():
        seconds_of(command)
    times: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for _ in range(runs):
        for name, command in COMMANDS.items():
            times[name].append(seconds_of(command) * 1e3)
    return times


def main() -> None:
    """Print a table: median and best time, what remains without Python's own start, the limit."""
    times = measure(int(sys.argv[1]) if len(sys.argv) > 1 else 15)
    bare = statistics.median(times["python -c pass"])
    print(f"{'':24}{'median':>10}{'best':>10}{'over bare':>12}{'limit':>8}")
    for name, each in times.items():
        median = statistics.median(each)
        limit = f"{LIMITS_MS[name]:d} ms" if name in LIMITS_MS else ""
        print(f"{name:24}{median:7.0f} ms{min(each):7.0f} ms{median - bare:9.0f} ms{limit:>9}")


if __name__ == "__main__":
    main()
