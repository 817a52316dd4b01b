"""What samples cost beside reading the sensors directly, and how quickly worker processes make them.

python -m benchmarks.samples [SWEEPS]
"""

import argparse
import pickle
import tempfile
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path

import sceneloom
from sceneloom.scene import Sample

ROUNDS = 5
_kept = {}


def directly(scene):
    """Read every sweep with its reference time, and every image."""
    for frame, image in zip(scene.lidars[0].frames, scene.cameras[0].images, strict=True):
        _ = frame.reference_ns, image.rgb


def by_samples(scene):
    """Read the same as samples."""
    for sample in scene.samples():
        _ = sample.sweep, sample.images["camera0"].rgb


def with_poses(scene):
    """The same, and where the points are in the image."""
    for sample in scene.samples():
        _ = sample.sweep, sample.images["camera0"].rgb, sample.camera_from_points


def as_arrays(scene):
    """Everything as arrays."""
    for _ in scene.samples().map(Sample.arrays):
        pass


def processor_ms(work: Callable[[object], None], scene) -> float:
    """Milliseconds of processor time per sample, the least of some rounds."""
    taken = []
    for _ in range(ROUNDS):
        start = time.process_time()
        work(scene)
        taken.append(time.process_time() - start)
    return min(taken) / len(scene.samples()) * 1e3


def keep(dataset):
    """Give a worker the dataset."""
    _kept["dataset"] = dataset


def size(number):
    """Make one sample's arrays in a worker, and give their size alone."""
    return sum(array.nbytes for array in _kept["dataset"][number].values())


def samples_a_second(scene, workers: int) -> float:
    """How many samples' arrays worker processes make in a second, the best of some rounds."""
    dataset = scene.samples().map(Sample.arrays)
    numbers, best = range(len(dataset)), 0.0
    with get_context("spawn").Pool(workers, keep, [dataset]) as pool:
        for _ in range(ROUNDS):
            start = time.perf_counter()
            pool.map(size, numbers, chunksize=max(1, len(dataset) // (2 * workers)))
            best = max(best, len(dataset) / (time.perf_counter() - start))
    return best


def main(sweeps: int) -> None:
    """Measure a recording and a scene file of one simulated drive."""
    with tempfile.TemporaryDirectory() as name:
        drive = sceneloom.simulate_street(seed=3, frames=sweeps).scene
        for target in ("recording", "drive.sfs"):
            sceneloom.write(drive, Path(name) / target)
            with sceneloom.open(Path(name) / target) as scene:
                points = len(scene.lidars[0].frames[0].points)
                print(f"{target}: {sweeps} sweeps of about {points} points, pickled {len(pickle.dumps(scene))} bytes")
                for work in (directly, by_samples, with_poses, as_arrays):
                    print(f"  {work.__name__:12s} {processor_ms(work, scene):6.2f} ms of processor time a sample")
                for workers in (1, 2):
                    print(f"  {workers} workers: {samples_a_second(scene, workers):.0f} samples a second")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweeps", nargs="?", type=int, default=40)
    main(parser.parse_args().sweeps)
