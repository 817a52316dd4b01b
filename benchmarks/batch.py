"""How many drives go through a batch, and what a run costs beside the work itself.

Run with `python -m benchmarks.batch [--drives 200] [--only ceiling,speed,nothing,kills] [--keep DIR] [--frames 20]`.
Simulated drives (a few streets, each under many names) are fused; every worker has one thread.

- ceiling: two processes against one that share nothing but the machine: plain NumPy with copying of files, and the verb
  without a batch. More than that no batch can give.
- speed: one worker of the pool, two of the pool, two of dask on this machine, in rotations. Limits: two at least 1.8
times
  one; dask at most 15 % more than the pool. Also what a frame costs: core-seconds, bytes read and written.
- nothing: drives whose verb writes an empty file: what scheduler, record and moving cost. Limit: 20 ms a drive.
- kills: a random worker is killed every few seconds. Limits: all outputs there, byte-equal to those of an undisturbed
  run, none of them made twice; no drafts left.
"""

import argparse
import multiprocessing
import random
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path

import sceneloom
from benchmarks.batch_workers import alone, kill_workers, processor_seconds
from sceneloom.batch import Input, Job, RunSummary, run
from sceneloom.batch.cluster import DaskCluster
from sceneloom.batch.record import FOLDER, Record
from sceneloom.batch.running import ProcessPool, one_thread
from sceneloom.cli.batch import BATCHED, CALL
from sceneloom.simulate import LidarSpec, simulate_street

STREETS = 8
CEILING_DRIVES = 24
KILL_SECONDS = 3.0
MODULES = BATCHED["fuse"].modules


def make_drives(folder: Path, count: int, frames: int) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    locations = [folder / f"{k:04d}.sfs" for k in range(count)]
    for k, location in enumerate(locations):
        if location.exists():
            continue
        if k < STREETS:
            sceneloom.write(simulate_street(k, frames=frames, lidar=LidarSpec(steps=600)).scene, location)
        else:
            location.hardlink_to(locations[k % STREETS])
    return locations


def fuse_job(locations: list[Path], retries: int = 2) -> Job:
    from sceneloom.cli.batch import verb_named

    options = verb_named("fuse").make_context("fuse", [str(locations[0]), "-o", "made.sfs"]).params
    left_out = ("path", "output", "as_json", "quiet", "verbose", "overwrite")
    options = {name: value for name, value in options.items() if name not in left_out}
    inputs = tuple(Input(location=str(location)) for location in locations)
    return Job(
        verb="fuse",
        call=CALL,
        inputs=inputs,
        options={"verb": "fuse", **options},
        suffix=".sfs",
        retries=retries,
        modules=MODULES,
    )


def speed(locations: list[Path], scratch: Path, frames: int) -> None:
    sides = {
        "pool, 1 worker": lambda: ProcessPool(1, MODULES),
        "pool, 2 workers": lambda: ProcessPool(2, MODULES),
        "dask local, 2 workers": lambda: DaskCluster.local(2),
    }
    seconds, busy, found = {}, {}, {}
    for name, make in sides.items():
        begun, before = time.perf_counter(), processor_seconds()
        found[name] = run(fuse_job(locations), scratch / "speed" / name, executor=make())
        seconds[name], busy[name] = time.perf_counter() - begun, processor_seconds() - before
        print(
            f"  {name:22} {seconds[name]:7.1f} s, {60 * len(locations) / seconds[name]:6.1f} drives/min; processors "
            f"{busy[name]:6.1f} s, of these at work on drives {found[name].processor_seconds:6.1f} s"
        )
        assert found[name].failed == 0, name
    (one, two, dask), (busy_one, busy_two, busy_dask) = seconds.values(), busy.values()
    print(f"  by the clock: 2 workers against 1 {one / two:.2f} times; dask against pool {dask / two - 1:+.1%}")
    print(
        f"  by processors, which a busy machine leaves alone: {2 * busy_one / busy_two:.2f} times (asked 1.8); "
        f"{busy_dask / busy_two - 1:+.1%} (asked at most 15 %)"
    )
    out, count = scratch / "speed" / "pool, 1 worker", frames * len(locations)
    read, written = (sum(p.stat().st_size for p in ps) for ps in (locations, out.glob("*.sfs")))
    print(
        f"  a frame: {found['pool, 1 worker'].processor_seconds / count:.4f} core-seconds, {read / count / 1e6:.2f} MB "
        f"read, {written / count / 1e6:.2f} MB written"
    )


def ceiling(locations: list[Path], scratch: Path) -> None:
    """Two processes against one where they share nothing but the machine."""
    for work in ("plain", "fuse"):
        taken = {}
        for count in (1, 2):
            sides = [_begin_alone(work, locations, scratch / "ceiling" / f"{work}-{count}-{k}") for k in range(count)]
            for _, pipe in sides:
                pipe.recv()
            for _, pipe in sides:
                pipe.send(None)
            taken[count] = [pipe.recv() for _, pipe in sides]
            for process, _ in sides:
                process.join()
        clock, busy = ([max(t[part] for t in taken[n]) for n in (1, 2)] for part in (0, 1))
        name = {"plain": "sorting and copying", "fuse": "the verb without a batch"}[work]
        print(
            f"  {name:24} 2 processes do {2 * clock[0] / clock[1]:.2f} times what 1 does by the clock, "
            f"{2 * busy[0] / busy[1]:.2f} times by processors"
        )


def _begin_alone(work: str, locations: list[Path], folder: Path):
    folder.mkdir(parents=True)
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    arguments = (work, [str(location) for location in locations], str(folder), theirs)
    process = multiprocessing.get_context("spawn").Process(target=alone, args=arguments)
    with one_thread():
        process.start()
    return process, ours


def nothing(locations: list[Path], scratch: Path) -> None:
    inputs = tuple(Input(location=str(location)) for location in locations)
    job = Job(verb="touch", call="benchmarks.batch_workers:touch", inputs=inputs, suffix=".txt")
    for name, executor in {"pool": ProcessPool(2), "dask local": DaskCluster.local(2)}.items():
        times: list[float] = []
        busy = time.process_time()

        def reported(_summary, _outcome, times=times):
            times.append(time.perf_counter())

        run(job, scratch / "nothing" / name, executor=executor, reported=reported)
        taken = 1e3 * (times[-1] - times[len(times) // 2]) / (len(times) - 1 - len(times) // 2)
        ours = 1e3 * (time.process_time() - busy) / len(times)
        print(f"  {name:22} {taken:6.2f} ms a drive by the clock, {ours:6.2f} ms of this process (asked 20)")


@contextmanager
def killing(generator: random.Random, every: float) -> Iterator[list[int]]:
    """Kill a random worker again and again."""
    killed: list[int] = []
    ending = threading.Event()

    def go() -> None:
        while not ending.wait(generator.uniform(0.5, 1.5) * every):
            killed.extend(kill_workers(generator))

    thread = threading.Thread(target=go)
    thread.start()
    try:
        yield killed
    finally:
        ending.set()
        thread.join()


def hashes(folder: Path) -> dict[str, str]:
    return {p.name: blake2b(p.read_bytes()).hexdigest() for p in sorted(folder.iterdir()) if p.is_file()}


def disturbed(locations: list[Path], out: Path, executor, every: float) -> tuple[RunSummary, Counter, int]:
    """Fuse while workers are killed; give the run, how often each drive ended well, and how many were killed."""
    made: Counter = Counter()

    def reported(_summary, outcome):
        made[outcome.number] += not outcome.error

    with killing(random.Random(0), every) as killed:
        summary = run(fuse_job(locations, retries=50), out, executor=executor, reported=reported)
    return summary, made, len(killed)


def kills(locations: list[Path], scratch: Path) -> None:
    calm = scratch / "speed" / "pool, 2 workers"
    if not calm.exists():
        run(fuse_job(locations), calm, workers=2)
    expected = hashes(calm)
    for name, make in {"pool": lambda: ProcessPool(2, MODULES), "dask local": lambda: DaskCluster.local(2)}.items():
        out = scratch / "kills" / name
        summary, made, killed = disturbed(locations, out, make(), KILL_SECONDS)
        with Record.opened(out) as record:
            rows = record.rows()
        found = hashes(out)
        same = sum(found.get(key) == value for key, value in expected.items())
        print(
            f"  {name:22} {killed} workers killed in {summary.seconds:.0f} s; {summary.done} done, {summary.failed} "
            f"failed, {summary.retried} further tries; {same} of {len(expected)} outputs byte-equal, "
            f"{len(found) - len(expected)} too many; made twice: {sum(count > 1 for count in made.values())}; "
            f"drafts left: {(out / FOLDER / 'drafts').exists()}; most tries {max(row.attempts for row in rows)}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--only", default="ceiling,speed,nothing,kills")
    parser.add_argument("--keep", type=Path, help="folder of the drives, which are made once")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        locations = make_drives(given.keep or Path(scratch) / "drives", given.drives, given.frames)
        parts = {
            "ceiling": lambda: ceiling(locations[:CEILING_DRIVES], Path(scratch)),
            "speed": lambda: speed(locations, Path(scratch), given.frames),
            "nothing": lambda: nothing(locations, Path(scratch)),
            "kills": lambda: kills(locations, Path(scratch)),
        }
        for name in given.only.split(","):
            print(f"{name}: {given.drives} drives of {given.frames} frames")
            parts[name]()


if __name__ == "__main__":
    main()
