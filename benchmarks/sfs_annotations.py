"""How fast annotations of an `.sfs` file become the model: against Scale's own loader, on the same file.

Run with `python -m benchmarks.sfs_annotations [--annotations 20000] [--peer-annotations 4000]`, and with
SCENELOOM_SCALE_PYTHON naming an interpreter that has scale-sensor-fusion-io; without it the peer is left out. Every
annotation is a cuboid of 10 keyframes with one attribute of 10 values; all numbers have the digits of a float64.
Both get the smaller file alternately, ours before and after the peer, and must give the same sums. Figures are medians
of processor time, which other jobs on the machine change less; imports are not counted. The larger file shows how our
time grows, and how long `sceneloom.validate` takes for it.
"""

import argparse
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.formats.sfs.writer import SceneWriter
from sceneloom.scene import AttributePath, CuboidAnnotation, CuboidPath

KEYFRAMES = 10

PEER = """
import sys, time
from scale_sensor_fusion_io.loaders import SFSLoader
begun = time.process_time()
scene = SFSLoader(sys.argv[1]).load()
seconds = time.process_time() - begun
total = sum(float(cuboid.path.values.sum()) for cuboid in scene.annotations)
stated = sum(sum(cuboid.attributes[0].values) for cuboid in scene.annotations)
print(seconds, len(scene.annotations), total, stated)
"""

Sums = tuple[int, float, int]
"""How many annotations, the sum of all numbers of their paths, and that of their attributes."""


def write_annotations(path: Path, count: int) -> None:
    """Write a file of that many cuboids."""
    random = np.random.default_rng(0)
    times = np.arange(KEYFRAMES, dtype=np.int64) * 100_000_000 + 5_000
    with SceneWriter(path) as writer:
        for number in range(count):
            sizes = np.tile(random.uniform(1, 5, 3), (KEYFRAMES, 1))
            moves = random.uniform(-100, 100, (KEYFRAMES, 3)), random.uniform(-180, 180, (KEYFRAMES, 3))
            speeds = tuple(random.integers(0, 30, KEYFRAMES).tolist())
            writer.add_annotation(
                CuboidAnnotation(
                    f"object-{number}",
                    CuboidPath(times, np.hstack([sizes, *moves])),
                    label="car",
                    stationary=False,
                    attributes=(AttributePath("speed", speeds, times, static=False),),
                )
            )


def read_here(path: Path) -> tuple[float, Sums]:
    """As the package reads: seconds, and what was found."""
    begun = time.process_time()
    with sceneloom.open(path) as scene:
        seconds = time.process_time() - begun
        cuboids = [a for a in scene.annotations if isinstance(a, CuboidAnnotation)]
        total = sum(float(cuboid.path.values.sum()) for cuboid in cuboids)
        return seconds, (len(cuboids), total, sum(sum(c.attributes[0].values) for c in cuboids))


def read_with_scale(interpreter: str, path: Path) -> tuple[float, Sums]:
    """As Scale's library reads, in a process of its own."""
    done = subprocess.run(
        [interpreter, "-c", PEER, str(path)], capture_output=True, text=True, check=True, cwd=path.parent
    )
    seconds, count, total, stated = done.stdout.split()[-4:]
    return float(seconds), (int(count), float(total), int(stated))


def compare(path: Path, interpreter: str, repetitions: int) -> None:
    """Read one file with both, alternately."""
    read_here(path)  # imports what reading needs
    ours, theirs = [read_here(path) for _ in range(5)], []
    for _ in range(repetitions):
        theirs.append(read_with_scale(interpreter, path))
        ours += [read_here(path) for _ in range(5)]
    count, total, stated = ours[0][1]
    for _, found in theirs:
        assert found[::2] == (count, stated), found
        np.testing.assert_allclose(found[1], total, rtol=1e-12)  # summed in another order
    here, peer = (float(np.median([seconds for seconds, _ in runs])) for runs in (ours, theirs))
    print(f"{count} annotations of {KEYFRAMES} keyframes, {path.stat().st_size / 1e6:.1f} MB")
    print(f"here   {here:8.3f} s")
    print(f"Scale  {peer:8.3f} s")
    print(f"ratio  {peer / here:8.0f}")


def median_seconds(run: Callable[[], object], repetitions: int) -> float:
    """The median time of some runs [s]."""
    taken = []
    for _ in range(repetitions):
        begun = time.process_time()
        run()
        taken.append(time.process_time() - begun)
    return float(np.median(taken))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--annotations", type=int, default=20_000)
    parser.add_argument("--peer-annotations", type=int, default=4_000)
    parser.add_argument("--repetitions", type=int, default=3)
    given = parser.parse_args()
    interpreter = os.environ.get("SCENELOOM_SCALE_PYTHON", "")
    with tempfile.TemporaryDirectory() as folder:
        large, small = Path(folder) / "large.sfs", Path(folder) / "small.sfs"
        if interpreter:
            write_annotations(small, given.peer_annotations)
            compare(small, interpreter, max(1, given.repetitions // 2))
        else:
            print("no comparison: SCENELOOM_SCALE_PYTHON names no interpreter with Scale's library")
        write_annotations(large, given.annotations)
        read_here(large)
        parse = median_seconds(lambda: sceneloom.open(large).close(), 2 * given.repetitions)
        print(f"{given.annotations} annotations, {large.stat().st_size / 1e6:.1f} MB")
        print(f"parse    {parse:8.3f} s")
        sceneloom.validate(large)
        validation = median_seconds(lambda: sceneloom.validate(large), given.repetitions)
        print(f"validate {validation:8.3f} s, {validation / parse:.1f} times the parse")


if __name__ == "__main__":
    main()
