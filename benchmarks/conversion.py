"""Conversion of large drives between scene files and MCAP: speed and memory, against plain file access.

Run with `python -m benchmarks.conversion [--megabytes 2000] [--runs 2] [--folder DIR]`. Sweeps and images are written
to a scene file and to an MCAP file without compression, and each is converted to both. A conversion runs in a process
of its own, after a small one that imports what is needed. The plain sides read the source and write a file of as many
bytes; all take rotates in one run, so that a busy machine slows them alike. Then folders of data sets are opened, where
`SCENELOOM_PANDASET` and `SCENELOOM_NUSCENES` name some.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import sceneloom
from sceneloom.cameras.camera import Camera
from sceneloom.formats.base.images import EncodedImage
from sceneloom.formats.sfs.writer import encode_jpeg
from sceneloom.scene import (
    CameraImage,
    CameraSensor,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    Poses,
    Scene,
    Trajectory,
)

POINTS = 120_000
PERIOD_NS = 100_000_000
WIDTH, HEIGHT = 1920, 1080
PIECE = 1 << 20
MEMORY_LIMIT, SPEED_LIMIT, OPENING_LIMIT = 500, 0.5, 2.0

CONVERT = """
import sys, time, resource
import sceneloom
small, small_out, source, target = sys.argv[1:]
sceneloom.convert(small, small_out, overwrite=True)
begun, busy = time.perf_counter(), time.process_time()
sceneloom.convert(source, target, overwrite=True)
print(time.perf_counter() - begun, time.process_time() - busy, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
"""Converts a small file for the imports, then the file; prints wall and processor seconds, and the most memory [kB]."""

OPEN = """
import sys, time
import sceneloom
begun, busy = time.perf_counter(), time.process_time()
with sceneloom.open(sys.argv[1]) as scene:
    for sensor in scene.lidars:
        sensor.frames[0].points.positions
    for sensor in scene.cameras:
        sensor.images[0].camera
print(time.perf_counter() - begun, time.process_time() - busy)
"""
"""Opens a folder and looks at the first frames; prints wall and processor seconds, imports of the format included."""


class Drive:
    """Sweeps and images that come again and again."""

    def __init__(self, frames: int) -> None:
        """Make a few of each."""
        rng = np.random.default_rng(1)
        self.sweeps = [
            LidarPoints(
                rng.normal(0, 30, (POINTS, 3)).astype(np.float32),
                intensities=rng.integers(0, 256, POINTS, np.uint8),
                timestamps_ns=np.sort(rng.integers(0, PERIOD_NS // 1000, POINTS)) * 1000,
                rings=(np.arange(POINTS) % 64).astype(np.uint16),
            )
            for _ in range(4)
        ]
        smooth = rng.integers(0, 256, (HEIGHT // 8, WIDTH // 8, 3), np.uint8)
        self.jpegs = [encode_jpeg(np.roll(smooth, k, axis=1).repeat(8, axis=0).repeat(8, axis=1)) for k in range(4)]
        self.camera_model = Camera("pinhole", WIDTH, HEIGHT, 1000.0, 1000.0, 959.5, 539.5)
        self.timestamps = np.arange(frames, dtype=np.int64) * PERIOD_NS

    def sweep(self, k: int) -> LidarFrame:
        """One sweep; its points were measured one after the other."""
        points = self.sweeps[k % 4]
        assert points.timestamps_ns is not None
        start = int(self.timestamps[k])
        timestamped = LidarPoints(
            points.positions, points.intensities, None, points.timestamps_ns + start, points.rings
        )
        return LidarFrame(start, timestamped)

    def image(self, k: int) -> CameraImage:
        """One image."""
        image = EncodedImage(self.jpegs[k % 4], "jpeg", WIDTH, HEIGHT)
        return CameraImage(int(self.timestamps[k]), self.camera_model, image, encoded=image.encoded)

    def scene(self) -> Scene:
        """The drive."""
        count = len(self.timestamps)
        still = np.tile([0.0, 0, 0, 1], (count, 1))
        path = Poses(self.timestamps, np.zeros((count, 3)), still)
        lidar = LidarSensor("top", LazyFrames(self.timestamps, self.sweep), path)
        camera = CameraSensor("front", self.camera_model, LazyFrames(self.timestamps, self.image), path)
        trajectory = Trajectory("trajectory", self.timestamps, path.positions, path.quaternions_xyzw)
        return Scene((lidar, camera), trajectories={"trajectory": trajectory})


def read_plainly(path: Path) -> None:
    """Read a file piece by piece into one buffer."""
    buffer = bytearray(PIECE)
    with path.open("rb", buffering=0) as file:
        while file.readinto(buffer):
            pass


def write_plainly(path: Path, size: int) -> None:
    """Write as many bytes piece by piece, without a sync."""
    path.unlink(missing_ok=True)
    piece = np.random.default_rng(0).bytes(PIECE)
    with path.open("wb", buffering=0) as file:
        for _ in range(size // PIECE):
            file.write(piece)


def timed(work: Callable[..., None], *arguments: object) -> tuple[float, float]:
    """Wall and processor time of a call [s]."""
    begun, busy = time.perf_counter(), time.process_time()
    work(*arguments)
    return time.perf_counter() - begun, time.process_time() - busy


def child(program: str, *arguments: object) -> list[float]:
    """The numbers that a program prints."""
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)], check=True, capture_output=True, text=True
    )
    return [float(word) for word in done.stdout.split()]


def measure(folder: Path, megabytes: int, runs: int) -> None:
    """Convert each file to both formats."""
    probe = Drive(1)
    frame_bytes = POINTS * 19 + len(probe.jpegs[0])
    frames = max(megabytes * 1_000_000 // frame_bytes, 2)
    for suffix in (".sfs", ".mcap"):
        options = {"compression": "none"} if suffix == ".mcap" else {}
        sceneloom.write(Drive(2).scene(), folder / f"small{suffix}", **options)
        sceneloom.write(Drive(frames).scene(), folder / f"large{suffix}", **options)
        size = (folder / f"large{suffix}").stat().st_size
        for target in (".sfs", ".mcap"):
            rounds = [one_round(folder, suffix, target, size) for _ in range(runs)]
            print(f"{suffix[1:]} to {target[1:]}, {size / 1e6:.0f} MB: {reported(rounds)}")
        (folder / f"large{suffix}").unlink()


@dataclass(frozen=True)
class Round:
    """One conversion beside plain access: wall and processor seconds of both, and the most memory [kB]."""

    plain: tuple[float, float]
    ours: tuple[float, float]
    memory: float


def one_round(folder: Path, suffix: str, target: str, size: int) -> Round:
    """The slower of plain reading and writing, then one conversion."""
    source, copy = folder / f"large{suffix}", folder / f"copy{target}"
    plain = max(timed(read_plainly, source), timed(write_plainly, copy, size))
    copy.unlink()
    small = folder / f"small{suffix}", folder / f"small_copy{target}"
    seconds, busy, memory = child(CONVERT, *small, source, copy)
    copy.unlink()
    return Round(plain, (seconds, busy), memory)


def reported(rounds: list[Round]) -> str:
    """The best of the rounds: times of both sides, their ratios, and the most memory."""
    wall, busy = (min(r.ours[k] for r in rounds) for k in (0, 1))
    plain_wall, plain_busy = (min(r.plain[k] for r in rounds) for k in (0, 1))
    return (
        f"{wall:.2f} s against {plain_wall:.2f} s plain: {plain_wall / wall:.2f} of its speed (limit {SPEED_LIMIT}); "
        f"processor {busy:.2f} s against {plain_busy:.2f} s; "
        f"{max(r.memory for r in rounds) / 1e3:.0f} MB of memory (limit {MEMORY_LIMIT})"
    )


def opened() -> Iterator[str]:
    """How long folders of data sets take to open."""
    for name in ("SCENELOOM_PANDASET", "SCENELOOM_NUSCENES"):
        if name in os.environ:
            wall, busy = min(child(OPEN, os.environ[name]) for _ in range(3))
            yield f"opening {os.environ[name]}: {wall:.2f} s ({busy:.2f} s of processor; limit {OPENING_LIMIT})"


def main() -> None:
    """Measure all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--megabytes", type=int, default=2000)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    for line in opened():
        print(line)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        measure(Path(folder), arguments.megabytes, arguments.runs)


if __name__ == "__main__":
    main()
