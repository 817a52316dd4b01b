"""How long a moment with many boxes takes: fusing and tracking, on one thread.

Run with `python -m benchmarks.crowds [--boxes 500] [--moments 20]`. As many boxes come from a sweep as from its
image; three in four of them are of the same things. Rows: the first moment of a drive; a crowd that is looked at
again and again; and moments each of which shows other things than the one before, whose objects are followed on for a
while. Times are processor times of a moment, median over all of them [ms]. The aim is 20 ms at 500 boxes.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.detection_fusion import make_pair
from sceneloom.detections import DetectionPair
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.tracking import Observation, Tracker

PERIOD_NS = 100_000_000
STILL = RigidTransform(np.eye(3), np.zeros(3))


def at_time(pair: DetectionPair, moment: int) -> DetectionPair:
    """The same boxes at another time."""
    time_ns = moment * PERIOD_NS
    three, two = pair.boxes_3d, pair.boxes_2d
    return replace(pair, boxes_3d=replace(three, timestamp_ns=time_ns), boxes_2d=replace(two, timestamp_ns=time_ns))


def drives(boxes: int, moments: int) -> Iterator[tuple[str, list[list[DetectionPair]]]]:
    """The rows: names, and drives as lists of pairs."""
    pairs = [make_pair(boxes, seed) for seed in range(moments)]
    yield "first moments", [[pair] for pair in pairs]
    yield "again and again", [[at_time(pairs[0], k) for k in range(moments)]]
    yield "others each time", [[at_time(pair, k) for k, pair in enumerate(pairs)]]


def times_of(drive: Sequence[DetectionPair]) -> tuple[list[float], list[float], int]:
    """Processor times of fusing and of tracking [ms], moment by moment, and how many objects there are at the end."""
    tracker, fusing, tracking, count = Tracker(), list[float](), list[float](), 0
    for pair in drive:
        begun = time.process_time()
        observation = Observation.of_pairs({"front": pair}, STILL, fuse=fuse_by_projection)
        fused = time.process_time()
        count = len(tracker.advance(observation).objects)
        fusing.append(1e3 * (fused - begun))
        tracking.append(1e3 * (time.process_time() - fused))
    return fusing, tracking, count


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--boxes", type=int, default=500)
    parser.add_argument("--moments", type=int, default=20)
    reported = parser.parse_args()
    times_of([make_pair(reported.boxes, 0)])
    print(f"{reported.boxes} + {reported.boxes} boxes{'fusing':>12s}{'tracking':>12s}{'both':>10s}{'objects':>10s}")
    for name, some in drives(reported.boxes, reported.moments):
        found = [times_of(drive) for drive in some]
        fusing, tracking = (np.concatenate([row[k] for row in found]) for k in range(2))
        both, count = float(np.median(fusing + tracking)), found[-1][2]
        print(f"{name:20s}{np.median(fusing):9.2f}{np.median(tracking):12.2f}{both:10.2f}{count:10d}")


if __name__ == "__main__":
    main()
