"""Trackers of others, written anew from their papers, for `benchmarks.tracking`.

AB3DMOT: Weng, Wang, Held and Kitani 2020, "3D Multi-Object Tracking: A Baseline and New Evaluation Metrics", section 3:
boxes of sweeps alone, a Kalman filter of constant velocity, pairs by the overlap in space (people: by the distance),
an object is reported from its third box on and forgotten after two sweeps without one. The numbers are those of its
authors for KITTI. Objects are followed in the world, which their later version does by compensating for the ego.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.formats.kitti.labels import KittiLabels
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.overlaps import overlaps_in_space, pair_starts
from sceneloom.pipeline.detected_drive import DetectedDrive, KittiObjects, kitti_labels, moments
from sceneloom.pipeline.tracking import projected_boxes
from sceneloom.scene import Boxes3D, PointsFrame

_SIZE, _MEASURED, _YAW = 10, 7, 3
"""A state: x, y, z, yaw, length, width, height, and the velocity along x, y, z in a sweep."""

LEAST_OVERLAP, FARTHEST_M = 0.01, 1.0
LEAST_HITS, MOST_MISSED = 3, 2


@dataclass(slots=True)
class _Object:
    """One that is followed."""

    number: int
    mean: Float64Array
    covariance: Float64Array
    score: float
    hits: int = 1
    missed: int = 0


@dataclass(slots=True)
class Ab3dmot:
    """Follows the boxes of one class.

    Attributes:
        by_distance: whether pairs are made by distance [m] instead of by overlap.
    """

    by_distance: bool = False
    objects: list[_Object] = field(default_factory=list)
    frames: int = 0
    next_number: int = 1

    def step(self, boxes: Float64Array, scores: Float64Array) -> list[_Object]:
        """Take the next sweep's boxes, (N, 7) in the order of the state, and give those that are reported."""
        self.frames += 1
        for one in self.objects:
            _predict(one)
        rows, columns = self._pairs(boxes)
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            _update(self.objects[row], boxes[column], float(scores[column]))
        for row in np.setdiff1d(np.arange(len(self.objects)), rows).tolist():
            self.objects[row].missed += 1
        for column in np.setdiff1d(np.arange(len(boxes)), columns).tolist():
            self._begin(boxes[column], float(scores[column]))
        self.objects = [one for one in self.objects if one.missed < MOST_MISSED]
        return [one for one in self.objects if one.hits >= LEAST_HITS or self.frames <= LEAST_HITS]

    def _begin(self, box: Float64Array, score: float) -> None:
        covariance = np.diag([10.0] * _MEASURED + [10_000.0] * (_SIZE - _MEASURED))
        self.objects.append(_Object(self.next_number, np.append(box, np.zeros(3)), covariance, score))
        self.next_number += 1

    def _pairs(self, boxes: Float64Array) -> tuple[Int64Array, Int64Array]:
        """Rows of objects and columns of boxes that are one."""
        if not len(self.objects) or not len(boxes):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        expected = np.array([one.mean[:_MEASURED] for one in self.objects])
        if self.by_distance:
            gains = -np.linalg.norm(expected[:, None, :3] - boxes[None, :, :3], axis=2)
            least = -FARTHEST_M
        else:
            ends = np.array([0, len(expected)], np.int64), np.array([0, len(boxes)], np.int64)
            sides = (np.ascontiguousarray(each[:, [0, 1, 2, 4, 5, 6, 3]]) for each in (expected, boxes))
            gains = overlaps_in_space(*sides, *ends, pair_starts(*ends)).reshape(len(expected), len(boxes))
            least = LEAST_OVERLAP
        rows, columns = linear_sum_assignment(-gains)
        enough: BoolArray = gains[rows, columns] >= least
        return rows[enough], columns[enough]


_MOTION = np.eye(_SIZE) + np.eye(_SIZE, k=_MEASURED)
_NOISE = np.diag([1.0] * _MEASURED + [0.01] * (_SIZE - _MEASURED))


def _predict(one: _Object) -> None:
    one.mean = _MOTION @ one.mean
    one.covariance = _MOTION @ one.covariance @ _MOTION.T + _NOISE


def _update(one: _Object, box: Float64Array, score: float) -> None:
    apart = box - one.mean[:_MEASURED]
    turn = (apart[_YAW] + np.pi) % (2.0 * np.pi) - np.pi
    apart[_YAW] = turn - np.pi * np.round(turn / np.pi)  # a box that is seen the wrong way round
    spread = one.covariance[:_MEASURED, :_MEASURED] + np.eye(_MEASURED)
    gain = np.linalg.solve(spread, one.covariance[:_MEASURED]).T
    one.mean = one.mean + gain @ apart
    one.covariance = one.covariance - gain @ one.covariance[:_MEASURED]
    one.score, one.hits, one.missed = score, one.hits + 1, 0


class _Class(NamedTuple):
    """How a class is followed: KITTI's name, whether by distance, and the least score of boxes that are looked at."""

    label: str
    by_distance: bool
    least_score: float


def ab3dmot(drive: DetectedDrive, rectified_from_lidar: RigidTransform, least_scores: dict[str, float]) -> KittiLabels:
    """Follow the cars and pedestrians of a drive of KITTI's benchmark."""
    classes = [_Class(label, label == "Pedestrian", least) for label, least in least_scores.items()]
    return kitti_labels(_followed(drive, classes), rectified_from_lidar)


def _followed(drive: DetectedDrive, classes: Sequence[_Class]) -> Iterator[KittiObjects]:
    trackers = {one.label: Ab3dmot(one.by_distance) for one in classes}
    for frame, moment in enumerate(moments(drive)):
        pair = next(iter(moment.pairs.values()))
        world = moment.boxes_3d.moved(moment.world_from_lidar, PointsFrame.WORLD)
        measures = np.column_stack([world.centers, world.yaws, world.sizes_lwh]).astype(np.float64)
        found = []
        for one in classes:
            chosen = np.array([name == one.label for name in world.labels], np.bool_) & (
                world.scores >= one.least_score
            )
            found += [(one.label, each) for each in trackers[one.label].step(measures[chosen], world.scores[chosen])]
        states = np.array([each.mean for _, each in found]).reshape(-1, _SIZE)
        scores, labels = np.array([each.score for _, each in found]), tuple(label for label, _ in found)
        boxes = Boxes3D(
            moment.timestamp_ns, states[:, :3], states[:, 4:7], states[:, 3], scores, labels, frame=PointsFrame.WORLD
        ).moved(moment.world_from_lidar.inverse(), PointsFrame.SENSOR)
        corners = projected_boxes(boxes, pair.camera, pair.camera_from_lidar)
        numbers = np.array([2 * each.number + (label == "Car") for label, each in found], np.int64)
        placed = boxes.centers, boxes.sizes_lwh, boxes.yaws
        yield KittiObjects(frame, numbers, boxes.labels, boxes.scores, corners, placed, pair.camera)
