"""How long a user waits: for an import, for help, for the first result on a new machine, and for it again.

Run with `python -m benchmarks.startup [--only imports,cold,warm,serve,size] [--runs 5] [--data DIR]`.

- imports: a new process each, in rotation, so that a busy machine slows all alike; medians.
- cold: each verb once with no kernel kept (`NUMBA_CACHE_DIR` is a new folder): the demo's first image and its end, a
  fusion, the view of what it wrote, tracks of a KITTI sequence.
- warm: the same and the verbs for scene files with all kernels kept; medians.
- serve: a cold server until it listens, and the conformance kit right after.
- size: the packages that an installation brings [MB on disk].

The peers only start: `kiss_icp_pipeline --help` and `import rerun`, where they are installed.
"""

import argparse
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

PROGRAM = str(Path(sys.executable).parent / "sceneloom")
if not Path(PROGRAM).exists():
    PROGRAM = "sceneloom"
PARTS = ("imports", "cold", "warm", "serve", "size")
LIMITS_S = {
    "import sceneloom": 0.15,
    "sceneloom --help": 0.3,
    "demo: first image, cold": 20,
    "demo: all, cold": 45,
    "fuse, cold": 20,
    "fuse, warm": 2,
    "view --save, cold": 8,
    "view --save, warm": 2,
    "track, cold": 30,
    "info, warm": 0.3,
    "convert, warm": 1,
    "validate, warm": 1,
    "serve: until it listens, cold": 40,
}


def command(*words: object) -> list[str]:
    return [sys.executable, "-m", "sceneloom", *map(str, words)]


def seconds_of(words: list[str], kernels: Path | None = None) -> float:
    """Run one command and give its wall time [s]; `kernels`: where compiled kernels are kept."""
    usual = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment = usual | ({} if kernels is None else {"NUMBA_CACHE_DIR": str(kernels)})
    started = time.perf_counter()
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    return time.perf_counter() - started


def show(name: str, seconds: list[float]) -> None:
    """Print one line: median, best, limit."""
    limit = f"{LIMITS_S[name]:g} s" if name in LIMITS_S else ""
    print(f"{name:32}{statistics.median(seconds):8.2f} s{min(seconds):8.2f} s{limit:>9}", flush=True)


def rotate(commands: dict[str, list[str]], runs: int) -> None:
    """Print what commands take that run in rotation; a first round warms the disk cache and is not counted."""
    times: dict[str, list[float]] = {name: [] for name in commands}
    for number in range(runs + 1):
        for name, words in commands.items():
            taken = seconds_of(words)
            times[name] += [taken] if number else []
    for name, each in times.items():
        show(name, each)


def imports(runs: int) -> None:
    python = {
        name: [sys.executable, "-c", name if name != "python -c pass" else "pass"]
        for name in ("python -c pass", "import numpy", "import numpy, msgspec", "import sceneloom")
    }
    peers = {"import rerun": [sys.executable, "-c", "import rerun"]} if find_spec("rerun") else {}
    pipeline = shutil.which("kiss_icp_pipeline")
    peers |= {"kiss_icp_pipeline --help": [pipeline, "--help"]} if pipeline else {}
    if not peers:
        print("no peer here: pip install rerun-sdk kiss-icp")
    rotate({**python, "sceneloom --help": [PROGRAM, "--help"], **peers}, runs)


def cold(folder: Path, data: Path) -> None:
    demo, seen = folder / "demo", dict[str, float]()
    waited = {"demo: first image, cold": "first_image.png", "demo: first fused image, cold": "*overlay.png"}

    def watch(started: float) -> None:
        while not done.is_set():
            for name, pattern in waited.items():
                if name not in seen and any(demo.rglob(pattern)):
                    seen[name] = time.perf_counter() - started
            time.sleep(0.1)

    done = threading.Event()
    watching = threading.Thread(target=watch, args=(time.perf_counter(),))
    watching.start()
    taken = seconds_of(command("demo", "--keep", demo), folder / "kernels-demo")
    done.set()
    watching.join()
    for name in waited:
        show(name, [seen.get(name, taken)])
    show("demo: all, cold", [taken])
    drive, scene = data / "recordings" / "kitti_drive", folder / "cold.sfs"
    show("fuse, cold", [seconds_of(command("fuse", drive, "-o", scene), folder / "kernels-fuse")])
    saving = command("view", scene, "--save", folder / "cold.rrd")
    show("view --save, cold", [seconds_of(saving, folder / "kernels-view")])
    tracking = command("track", data / "real" / "kitti_tracking", "--sequence", "0000", "-o", folder / "tracks")
    show("track, cold", [seconds_of(tracking, folder / "kernels-track")])


def warm(folder: Path, data: Path, runs: int) -> None:
    drive, scene = data / "recordings" / "kitti_drive", folder / "warm.sfs"
    seconds_of(command("fuse", drive, "-o", scene, "--overwrite"))
    rotate(
        {
            "fuse, warm": command("fuse", drive, "-o", folder / "again.sfs", "--overwrite"),
            "view --save, warm": command("view", scene, "--save", folder / "warm.rrd", "--overwrite"),
            "info, warm": command("info", scene),
            "convert, warm": command("convert", scene, folder / "warm.mcap", "--overwrite"),
            "validate, warm": command("validate", scene),
        },
        runs,
    )


def serve(folder: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "kernels-serve")}
    started = time.perf_counter()
    server = subprocess.Popen(
        command("serve"), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    )
    try:
        assert server.stdout is not None
        address = re.search(r"[\w.\[\]:]+:\d+", server.stdout.readline())
        show("serve: until it listens, cold", [time.perf_counter() - started])
        assert address is not None
        kit = subprocess.run(command("conformance", address[0]), check=False, capture_output=True, text=True)
        print(f"conformance right after: exit {kit.returncode}: {kit.stdout.strip().splitlines()[-1]}")
    finally:
        server.terminate()
        server.wait()


def size() -> None:
    """Print what each package that the installation needs takes on disk, the largest first."""
    names, waiting = set(), ["sceneloom"]
    while waiting:
        name = re.split(r"[^\w.-]", waiting.pop(), maxsplit=1)[0]
        if name in names:
            continue
        try:
            needed = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        names.add(name)
        waiting += [need for need in needed if "extra ==" not in need]
    sizes = {}
    for name in names:
        files = metadata.files(name) or []
        sizes[name] = sum(path.stat().st_size for file in files if (path := Path(str(file.locate()))).is_file())
    for name, count in sorted(sizes.items(), key=lambda item: -item[1]):
        print(f"{name:32}{count / 1e6:8.1f} MB")
    print(f"{'all':32}{sum(sizes.values()) / 1e6:8.1f} MB")


def main() -> None:
    """Print a table for each part: median, best, limit."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="imports,warm,size", help=f"parts with commas, of {', '.join(PARTS)}")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("SCENELOOM_DATA", "../shared/data")))
    arguments = parser.parse_args()
    wanted = arguments.only.split(",")
    print(f"{'':32}{'median':>10}{'best':>10}{'limit':>9}")
    with tempfile.TemporaryDirectory() as folder:
        if "imports" in wanted:
            imports(arguments.runs)
        if "cold" in wanted:
            cold(Path(folder), arguments.data)
        if "warm" in wanted:
            warm(Path(folder), arguments.data, arguments.runs)
        if "serve" in wanted:
            serve(Path(folder))
    if "size" in wanted:
        size()


if __name__ == "__main__":
    main()
