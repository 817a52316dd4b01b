"""The container of `.sfs` files: speed and memory, against plain file access and Scale's own codec.

Run with `python -m benchmarks.sfs [--megabytes 500] [--gigabytes 20] [--runs 5]`, and with SCENELOOM_SCALE_PYTHON
naming an interpreter that has scale-json-binary; without it the peer is left out. What is compared takes rotates in one
run, so that a busy machine slows all of it alike. Printed are best times, their ratios, and the limits.
"""

import argparse
import gc
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sceneloom import SceneWriter
from sceneloom.formats.sfs.container import Container
from sceneloom.scene import LazyFrames, LidarFrame, LidarPoints, LidarSensor, PointsFrame, Poses

POINTS = 120_000
PERIOD_NS = 100_000_000
ARRAYS = 16_000
PIECE = 1 << 20

PEER = """
import json, sys, time
import numpy as np
import scale_json_binary as codec
what, path = sys.argv[1:3]
if what == "write":
    points = lambda k: {"positions": np.full((4, 3), k, np.float32), "intensities": np.full(4, 7, np.uint8)}
    frames = [{"timestamp": 100000 * k, "points": points(k)} for k in range(int(sys.argv[3]) // 2)]
    scene = {"version": "1.0", "sensors": [{"id": "top", "type": "lidar", "frames": frames}]}
    start = time.perf_counter()
    codec.write_file(path, scene)
    print(time.perf_counter() - start, 0)
else:
    memory = lambda: int(next(l for l in open("/proc/self/status") if l.startswith("VmHWM")).split()[1]) * 1024
    before, start = memory(), time.perf_counter()
    scene = codec.read_file(path)
    scene["sensors"][0]["frames"][100]["points"]["positions"].sum()
    print(time.perf_counter() - start, memory() - before)
"""
"""Writes as many arrays as asked for, or loads a file; prints seconds and bytes of further memory."""

OURS = """
import sys, time
import sceneloom
import sceneloom.formats.sfs.reader
from sceneloom.formats.base import files
files.LARGEST_HOLES = 1 << 40
memory = lambda: int(next(l for l in open("/proc/self/status") if l.startswith("VmHWM")).split()[1]) * 1024
def look(path, frame):
    with sceneloom.open(path) as scene:
        scene.lidars[0].frames[frame].points.positions.sum()
look(sys.argv[2], 0)
before, start = memory(), time.perf_counter()
look(sys.argv[1], 100)
print(time.perf_counter() - start, memory() - before)
print("peak", memory(), file=sys.stderr)
"""
"""Opens a file and touches one frame, after a small file for the imports; prints seconds and further memory [bytes]."""

INFO = """
import sys
from sceneloom.cli import main
from sceneloom.formats.base import files
files.LARGEST_HOLES = 1 << 40  # the file stands for one whose content does not fit the disk
try:
    main(["info", sys.argv[1]])
finally:
    peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
    print("peak", int(peak.split()[1]) * 1024, file=sys.stderr)
"""
"""Lists a file; prints the most memory that it held [bytes]."""


def clouds(count: int) -> list[LidarPoints]:
    """A few sweeps that are written again and again."""
    rng = np.random.default_rng(1)
    return [
        LidarPoints(
            rng.normal(0, 30, (POINTS, 3)).astype(np.float32),
            intensities=rng.integers(0, 256, POINTS, np.uint8),
            timestamps_ns=np.sort(rng.integers(0, PERIOD_NS // 1000, POINTS)) * 1000,
        )
        for _ in range(count)
    ]


def frames_of(sweeps: list[LidarPoints], count: int, *, times: bool) -> list[LidarFrame]:
    """Frames that show the sweeps again and again, with or without the times of their points."""
    frames = []
    for k in range(count):
        sweep = sweeps[k % len(sweeps)]
        timestamped = sweep.timestamps_ns if times else None
        points = LidarPoints(sweep.positions, intensities=sweep.intensities, timestamps_ns=timestamped)
        frames.append(LidarFrame(k * PERIOD_NS, points))
    return frames


def write_scene(path: Path, frames: list[LidarFrame], *, known: bool) -> None:
    """Write a lidar frame by frame; with the number of frames known before or not."""
    timestamps = np.array([frame.timestamp_ns for frame in frames])
    with SceneWriter(path, overwrite=True, frame_count=len(frames) if known else 0) as writer:
        writer.add_sensor(LidarSensor("top", LazyFrames.of([], []), points_frame=PointsFrame.WORLD))
        for frame in frames:
            writer.add_frame("top", frame)
        still = np.tile([0.0, 0, 0, 1], (len(frames), 1))
        writer.set_poses("top", Poses(timestamps, np.zeros((len(frames), 3)), still))


def write_plainly(path: Path, sweeps: list[LidarPoints], frames: int, *, times: bool) -> None:
    """Write the same bytes to a file, array by array, without a sync."""
    timestamps = np.zeros(POINTS, np.uint32)
    with path.open("wb", buffering=0) as file:
        for k in range(frames):
            sweep = sweeps[k % len(sweeps)]
            for array in (sweep.positions, sweep.intensities, timestamps if times else None):
                if array is not None:
                    file.write(array.data)


def read_plainly(path: Path) -> None:
    """Read a file into one buffer, piece by piece."""
    buffer = bytearray(PIECE)
    with path.open("rb", buffering=0) as file:
        while file.readinto(buffer):
            pass


def read_arrays(path: Path) -> int:
    """Open a file and look at every byte of every array."""
    container = Container(path)
    total = 0
    for frame in container.header["sensors"][0]["frames"]:
        for array in frame["points"].values():
            flat = array.reshape(-1).view(np.uint8)
            total += int(flat[: len(flat) // 8 * 8].view(np.uint64).max())
    container.close()
    return total


def seconds_of(work: Callable[[], object]) -> float:
    """Wall time of a call [s], garbage taken away before."""
    gc.collect()
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def in_rotations(works: dict[str, Callable[[], object]], runs: int) -> dict[str, float]:
    """Best wall time of each [s]: a busy machine only ever adds. A first round is not counted."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for run in range(runs + 1):
        for name, work in works.items():
            seconds = seconds_of(work)
            if run:
                times[name].append(seconds)
    return {name: min(found) for name, found in times.items()}


def anew(path: Path, write: Callable[..., None], *arguments: object, **options: object) -> Callable[[], None]:
    """Write to a name that is free: a file that is cut to nothing first is slow for anyone."""

    def run() -> None:
        path.unlink(missing_ok=True)
        write(path, *arguments, **options)

    return run


def measure_writing(folder: Path, megabytes: int, runs: int) -> None:
    """Ours against plain writing of the same bytes."""
    sweeps = clouds(4)
    ours, plain = folder / "ours.sfs", folder / "plain"
    for times, bytes_a_point in ((False, 13), (True, 17)):
        frames = megabytes * 1_000_000 // (POINTS * bytes_a_point)
        shown = frames_of(sweeps, frames, times=times)
        best = in_rotations(
            {
                "plain": anew(plain, write_plainly, sweeps, frames, times=times),
                "known": anew(ours, write_scene, shown, known=True),
                "stream": anew(ours, write_scene, shown, known=False),
            },
            runs,
        )
        what = "with times of points" if times else "positions, intensities"
        for name, how in (("known", "frames counted"), ("stream", "frames unknown")):
            ratio = best["plain"] / best[name]
            print(
                f"writing {megabytes} MB, {what}, {how}: {best[name]:.3f} s, plain {best['plain']:.3f} s: "
                f"{ratio:.2f} of its speed (limit 0.60)"
            )
    for path in (ours, plain):
        path.unlink()


def measure_many_arrays(folder: Path, peer: str, runs: int) -> None:
    """Many small arrays: linear here, quadratic there."""
    path = folder / "many.sfs"
    small = [LidarPoints(np.full((4, 3), k, np.float32), intensities=np.full(4, 7, np.uint8)) for k in range(4)]
    works = {
        str(arrays): anew(path, write_scene, frames_of(small, arrays // 2, times=False), known=True)
        for arrays in (ARRAYS // 2, ARRAYS)
    }
    best = in_rotations(works, runs)
    ours = best[str(ARRAYS)]
    growth = ours / best[str(ARRAYS // 2)]
    print(f"writing {ARRAYS} arrays: {ours * 1e3:.0f} ms; twice as many take {growth:.2f} times as long", end="")
    if peer:
        theirs, _ = run_program([peer, "-c", PEER, "write", str(folder / "peer.sfs"), str(ARRAYS)])
        print(f"; peer {theirs:.2f} s: 1/{theirs / ours:.0f} of its time (limit 1/50)", end="")
    print()
    opening = min(seconds_of(lambda: Container(path).close()) for _ in range(runs))
    print(f"opening the container of {ARRAYS} arrays: {opening * 1e3:.0f} ms")


def measure_reading(folder: Path, megabytes: int, peer: str, runs: int) -> None:
    """Opening and one frame against the peer's loading; all arrays against plain reading."""
    path, small = folder / "scene.sfs", folder / "small.sfs"
    write_scene(small, frames_of(clouds(1), 2, times=True), known=True)
    frames = frames_of(clouds(4), megabytes * 1_000_000 // (POINTS * 17), times=True)
    write_scene(path, frames, known=True)
    found = [run_program([sys.executable, "-c", OURS, str(path), str(small)]) for _ in range(runs)]
    seconds, memory = (min(values) for values in zip(*found, strict=True))
    print(
        f"opening {megabytes} MB and one frame: {seconds * 1e3:.1f} ms, {memory / 1e6:.0f} MB more (limit 40)", end=""
    )
    if peer:
        theirs, their_memory = run_program([peer, "-c", PEER, "read", str(path)])
        times_file = their_memory / path.stat().st_size
        print(
            f"; peer loads in {theirs:.2f} s, {times_file:.1f} times the file in memory: "
            f"1/{theirs / seconds:.0f} of its time (limit 1/50)",
            end="",
        )
    print()
    best = in_rotations({"plain": lambda: read_plainly(path), "ours": lambda: read_arrays(path)}, runs)
    ours, plain = best["ours"], best["plain"]
    print(
        f"reading every array of {megabytes} MB: {ours * 1e3:.0f} ms, plain {plain * 1e3:.0f} ms: "
        f"{ours / plain:.2f} times (limit 1.30)"
    )
    path.unlink()


def write_sparse(path: Path, gigabytes: int) -> int:
    """Make a scene of holes with a header as long as such a scene has; give the number of its frames."""
    frames = gigabytes * 1_000_000_000 // (POINTS * 13)
    records, items, offset = [], [], 64
    for k in range(frames):
        records.append({"timestamp": 100_000 * k, "points": {"positions": "", "intensities": ""}})
        for name, dtype, shape in (("positions", "float32", [POINTS, 3]), ("intensities", "uint8", [POINTS])):
            length = POINTS * (12 if name == "positions" else 1)
            keys = ["sensors", 0, "frames", k, "points", name]
            items.append({"keys": keys, "length": length, "offset": offset, "dtype": dtype, "shape": shape})
            offset += -(-(length + 4) // 64) * 64
    values = [[0.0, 0, 0, 0, 0, 0, 1]] * frames
    poses = {"timestamps": [100_000 * k for k in range(frames)], "values": values}
    sensor = {"id": "top", "type": "lidar", "poses": poses, "frames": records}
    header = json.dumps({"version": "1.0", "sensors": [sensor], "$items": items}).encode()
    with path.open("wb") as file:
        file.write(header.ljust(-(-len(header) // 64) * 64))
        file.truncate(file.tell() + offset)
    return frames


def measure_large(folder: Path, gigabytes: int) -> None:
    """The peak memory of `sceneloom info`, and of reading one frame, of a scene that no memory holds."""
    path = folder / "large.sfs"
    try:
        frames = write_sparse(path, gigabytes)
    except OSError as error:
        gigabytes = 5
        print(f"no file of that length here ({error.strerror}); {gigabytes} GB in its location")
        frames = write_sparse(path, gigabytes)
    small = folder / "small.sfs"
    for what, command in (
        ("sceneloom info", [sys.executable, "-c", INFO, str(path)]),
        ("one frame", [sys.executable, "-c", OURS, str(path), str(small)]),
    ):
        seconds, peak = run_measured(command)
        print(f"{gigabytes} GB, {frames} frames: {what}: {seconds:.2f} s, peak {peak / 1e6:.0f} MB (limit 300)")


def run_program(command: list[str]) -> tuple[float, float]:
    """Run a program that prints two numbers."""
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    first, second = done.stdout.split()[-2:]
    return float(first), float(second)


def run_measured(command: list[str]) -> tuple[float, int]:
    """Run a program that says last the most memory that it held; wall time [s] with its start, and memory [bytes]."""
    start = time.perf_counter()
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return time.perf_counter() - start, int(done.stderr.split()[-1])


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megabytes", type=int, default=500)
    parser.add_argument("--gigabytes", type=int, default=20)
    parser.add_argument("--runs", type=int, default=5)
    asked = parser.parse_args()
    peer = os.environ.get("SCENELOOM_SCALE_PYTHON", "")
    if not peer or shutil.which(peer) is None:
        peer = ""
        print("no comparison: SCENELOOM_SCALE_PYTHON names no interpreter with Scale's library")
    with tempfile.TemporaryDirectory() as folder:
        measure_many_arrays(Path(folder), peer, asked.runs)
        measure_writing(Path(folder), asked.megabytes, asked.runs)
        measure_reading(Path(folder), asked.megabytes, peer, asked.runs)
        measure_large(Path(folder), asked.gigabytes)


if __name__ == "__main__":
    main()
