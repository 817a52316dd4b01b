"""How many pairs of a sweep and an image detection fusion takes a second, on one thread.

Run with `python -m benchmarks.detection_fusion [--boxes 20] [--pairs 200]`. Three in four boxes have a partner in the
other sensor, some reach out of the image; the camera model has five distortion coefficients. Times are processor times,
which other programs on the machine do not stretch; the parts are timed one by one. The aim is 2,000 pairs of 20 and 20
boxes.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import time
from collections.abc import Callable

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.detections import DetectionPair
from sceneloom.detections.detectors import numbers_of
from sceneloom.detections.projection import assign, fuse_by_projection, pair_gains, project_outlines
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.box_fusion import boxes_with_position
from sceneloom.scene.detections import Boxes2D, Boxes3D

CAMERA = Camera("brown_conrady", 1920, 1080, 1100.0, 1100.0, 959.5, 539.5, (-0.1, 0.02, 5e-4, -3e-4, 1e-3))
CAMERA_FROM_LIDAR = RigidTransform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.0, -0.1, -0.3])
)
LABELS = ("car", "pedestrian", "cyclist", "truck")


def as_numbers(boxes: Boxes3D) -> Float64Array:
    """(N, 7): middles, sizes and headings."""
    return boxes_with_position(boxes.centers, boxes.sizes_lwh, boxes.yaws)[0]


def make_pair(count: int, seed: int) -> DetectionPair:
    """A street with `count` boxes in the sweep and as many in the image."""
    random = np.random.default_rng(seed)
    ahead = random.uniform(6.0, 80.0, count)
    centers = np.column_stack([ahead, random.uniform(-0.8, 0.8, count) * ahead, random.uniform(-1.5, 0.0, count)])
    sizes = random.uniform([0.6, 0.5, 1.4], [5.0, 2.0, 2.5], (count, 3))
    labels = tuple(LABELS[k % len(LABELS)] for k in range(count))
    boxes_3d = Boxes3D(0, centers, sizes, random.uniform(-np.pi, np.pi, count), random.random(count), labels)
    corners = project_outlines(CAMERA, CAMERA_FROM_LIDAR, as_numbers(boxes_3d)).corners_xyxy
    corners = corners + random.normal(scale=2.0, size=(count, 4))
    alone = random.random(count) < 0.25
    corners[alone] = random.uniform([0, 0, 1000, 600], [900, 500, 1900, 1000], (int(alone.sum()), 4))
    return DetectionPair(boxes_3d, Boxes2D(0, corners, random.random(count), labels), CAMERA, CAMERA_FROM_LIDAR)


def milliseconds(run: Callable[[DetectionPair], object], pairs: list[DetectionPair], repetitions: int) -> float:
    """Median over rounds of the processor time for one pair."""
    times = []
    for repetition in range(repetitions + 1):
        start = time.process_time()
        for pair in pairs:
            run(pair)
        if repetition:
            times.append(1e3 * (time.process_time() - start) / len(pairs))
    return float(np.median(times))


def outline(pair: DetectionPair) -> object:
    """Where the boxes of the sweep are in the image."""
    return project_outlines(pair.camera, pair.camera_from_lidar, as_numbers(pair.boxes_3d))


def pair_up(pair: DetectionPair) -> object:
    """The best assignment, as if the boxes of the image were the outlines."""
    corners, scores = pair.boxes_2d.corners_xyxy.copy(), pair.boxes_2d.scores.copy()
    classes = numbers_of(pair.boxes_2d.labels, pair.boxes_2d.labels)
    return assign(pair_gains(corners, corners, *classes, scores, scores, least_iou=0.3))


def main() -> None:
    """Print the times of the whole and of its parts, and pairs a second."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--boxes", type=int, default=20)
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--repetitions", type=int, default=9)
    stated = parser.parse_args()
    pairs = [make_pair(stated.boxes, seed) for seed in range(stated.pairs)]
    found = [fuse_by_projection(pair) for pair in pairs]
    both = np.mean(np.concatenate([(fused.rows_3d >= 0) & (fused.rows_2d >= 0) for fused in found]))
    print(f"{stated.boxes} + {stated.boxes} boxes, {100 * both:.0f} % of the objects are seen by both sensors")
    whole = milliseconds(fuse_by_projection, pairs, stated.repetitions)
    print(f"fusion      {whole:6.3f} ms, {1e3 / whole:6.0f} pairs a second (aim 2000 of 20 + 20)")
    for name, run in (("outlines", outline), ("assignment", pair_up)):
        print(f"  {name:10}{milliseconds(run, pairs, stated.repetitions):6.3f} ms")


if __name__ == "__main__":
    main()
