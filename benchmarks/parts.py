"""Long drives in parts against the same drives in one piece: how exact, how fast, with how much memory.

Run with `python -m benchmarks.parts [--only drift,speed,memory] [--minutes 1] [--part 20] [--seeds 6] [--keep DIR]`.
Simulated drives with turns and traffic, of which lidar odometry finds the way; every worker has one thread.

drift: distance from the truth at the end, in percent of the way, and KITTI's errors of all pieces of 100, 200, … m, as
in `benchmarks.motion`; of a single run, and of parts of `--part` seconds and of a third of that.
speed: `batch fuse` of one drive of twice the minutes, in one piece, with `--parts` by one worker, and by two: time by
the clock and of the processors. What one worker takes more in parts is what leads into them, and the joining.
memory: the most that any process had that did a part, or joined them, of a drive of half the minutes and of one four
times as long, without mapped files; each task has a process of its own.
"""

import argparse
import multiprocessing
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import sceneloom
from benchmarks.batch import MODULES, fuse_job
from benchmarks.batch_workers import processor_seconds
from benchmarks.motion import BUSY, Way, errors_of
from sceneloom.batch import Outcome, Task, run
from sceneloom.batch.jobs import Parts
from sceneloom.batch.pieces import PIECE, cut_times
from sceneloom.batch.pool import Executor, ProcessPool
from sceneloom.batch.record import Record, Row
from sceneloom.batch.working import run_task
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.motion.odometry import OdometryRun, joined_odometry, lidar_odometry, odometry_piece
from sceneloom.scene import GnssSensor, ImuSensor, Scene
from sceneloom.simulate import LidarSpec, SimulatedDrive, simulate_street

LIDARS = {
    "64 beams": LidarSpec(steps=900),
    "32 beams": LidarSpec(beams=32, steps=900, elevations_deg=(-25.0, 15.0)),
    "16 beams": LidarSpec(beams=16, steps=900, elevations_deg=(-15.0, 15.0)),
}
FEW = LidarSpec(beams=16, steps=450, elevations_deg=(-15.0, 15.0))
"""Of the drives whose exactness does not matter."""


def simulated(seed: int, minutes: float, lidar: LidarSpec) -> SimulatedDrive:
    return simulate_street(seed, frames=round(600 * minutes), lidar=lidar, cameras=(), traffic=BUSY)


def written(drive: SimulatedDrive, place: Path, *, blind: bool = True) -> Path:
    """A drive in a file that is made once; a blind one tells nothing of its way but its sweeps."""
    if not place.exists():
        place.parent.mkdir(parents=True, exist_ok=True)
        sensors = tuple(s for s in drive.scene.sensors if not isinstance(s, GnssSensor | ImuSensor))
        scene = replace(drive.scene, annotations=())
        sceneloom.write(replace(scene, trajectories={}, sensors=sensors) if blind else scene, place)
    return place


def ways(scene: Scene, part: float) -> Iterator[tuple[str, OdometryRun, int]]:
    yield "single run", lidar_odometry(scene), 0
    for seconds in (part, part / 3):
        spans = cut_times(scene.lidars[0].frames.timestamps_ns, seconds=seconds)
        pieces = [odometry_piece(scene, span_ns=span) for span in spans]
        yield f"parts of {seconds:.0f} s", joined_odometry(pieces), len(spans) - 1


def drift(given: argparse.Namespace, folder: Path) -> None:
    print(f"{'':36s}{'joints':>7s}{'way':>9s} {'end':>19s} {'trans':>13s} {'rot/100m':>12s}")
    for name, lidar in LIDARS.items():
        for seed in given.seeds:
            drive = simulated(seed, given.minutes, lidar)
            place = written(drive, folder / f"{name[:2]}-{seed}-{given.minutes:g}.sfs")
            with sceneloom.open(place) as scene:
                for label, found, joints in ways(scene, given.part):
                    path = found.trajectory.poses
                    rotations = list(matrix_from_quaternion(path.quaternions_xyzw))
                    way = Way(label, path.timestamps_ns.tolist(), rotations, list(path.positions))
                    told = errors_of(way, drive).row()
                    print(f"{name:12s}seed {seed:<5d}{label:14s}{joints:7d}  {told}", flush=True)


def speed(given: argparse.Namespace, folder: Path) -> None:
    minutes = 2 * given.minutes
    drive = simulated(given.seeds[0], minutes, FEW)
    for way in ("found", "recorded"):
        place = written(drive, folder / f"few-{way}-{minutes:g}.sfs", blind=way == "found")
        print(f"  {minutes:g} minutes, {place.stat().st_size / 1e6:.0f} MB, the way {way}")
        taken = {}
        for name, workers, parts in (
            ("in one piece", 1, None),
            ("parts, 1 worker", 1, Parts(seconds=given.part)),
            ("parts, 2 workers", 2, Parts(seconds=given.part)),
        ):
            begun, busy = time.perf_counter(), processor_seconds()
            rows = fused(place, folder, parts, ProcessPool(workers, MODULES))
            clock, busy = time.perf_counter() - begun, processor_seconds() - busy
            taken[name] = clock, busy
            print(f"    {name:18s}{clock:7.1f} s by the clock, {busy:7.1f} s of processors: {by_step(rows)}")
        (whole, all_whole), (_, all_alone), (shared, all_shared) = taken.values()
        print(
            f"    2 workers against one piece: {whole / shared:.2f} times as fast by the clock, "
            f"{2 * all_whole / all_shared:.2f} by processors; parts cost {all_alone / all_whole - 1:+.0%}"
        )


def by_step(rows: Sequence[Row]) -> str:
    """Processor seconds of all tasks of one kind; of those of a drive itself, the last one counts."""
    steps: dict[str, float] = {}
    for row in rows:
        step = row.part.get(PIECE, {}).get("work", "last task")
        steps[step] = steps.get(step, 0.0) + (row.processor_seconds or 0.0)
    return ", ".join(f"{step} {seconds:.1f} s" for step, seconds in steps.items())


def fused(place: Path, folder: Path, parts: Parts | None, executor: Executor) -> list[Row]:
    """Fuse a drive; give its row in the record, then those of its pieces."""
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        told = run(replace(fuse_job([place]), parts=parts), Path(scratch) / "out", executor=executor)
        assert told.done == 1
        with Record.opened(Path(scratch) / "out") as record:
            return [*record.rows(), *record.pieces(1)]


class Fresh:
    """Runs each task in a process of its own and keeps the most memory that it had, by the kind of task."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1)
        self._ended: list[tuple[Task, Outcome]] = []
        self.peaks: dict[str, float] = {}

    @property
    def free(self) -> int:
        return 1 - len(self._ended)

    def submit(self, task: Task) -> None:
        outcome, peak = self._pool.submit(run_measured, task).result()
        step = task.options.get(PIECE, {}).get("work", "in one piece")
        self.peaks[step] = max(self.peaks.get(step, 0.0), peak)
        self._ended.append((task, outcome))

    def finished(self, _seconds: float) -> list[tuple[Task, Outcome]]:
        ended, self._ended = self._ended, []
        return ended

    def stop(self) -> None:
        self._pool.shutdown()


def run_measured(task: Task) -> tuple[Outcome, float]:
    """Do a task; give its outcome and the most memory that was this process's alone [MB], files mapped or not."""
    most, ending = [0.0], threading.Event()

    def watch() -> None:
        while not ending.wait(0.02):
            most[0] = max(most[0], own_memory())

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        return run_task(task), most[0]
    finally:
        ending.set()
        thread.join()


def own_memory() -> float:
    """Memory without mapped files, which the system takes back when it wants to [MB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1024


def memory(given: argparse.Namespace, folder: Path) -> None:
    for way in ("found", "recorded"):
        for minutes in (given.minutes / 2, 2 * given.minutes):
            drive = simulated(given.seeds[0], minutes, FEW)
            place = written(drive, folder / f"few-{way}-{minutes:g}.sfs", blind=way == "found")
            peaks: dict[str, float] = {}
            for parts in (None, Parts(seconds=given.part / 2)):
                executor = Fresh()
                fused(place, folder, parts, executor)
                peaks |= executor.peaks
            told = ", ".join(f"{step} {peak:.0f} MB" for step, peak in peaks.items())
            print(f"  {minutes:3g} minutes, the way {way:9s}{told}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="drift,speed,memory")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--part", type=float, default=20.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[6])
    parser.add_argument("--keep", type=Path, help="folder of the drives, which are made once")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        for name in given.only.split(","):
            print(name)
            {"drift": drift, "speed": speed, "memory": memory}[name](given, given.keep or Path(scratch))


if __name__ == "__main__":
    main()
