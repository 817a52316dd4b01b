"""Trackers of others, written anew from their papers, for `benchmarks.tracking`.

AB3DMOT: Weng, Wang, Held and Kitani 2020, "3D Multi-Object Tracking: A Baseline and New Evaluation Metrics", section 3:
boxes of sweeps alone, a Kalman filter of constant velocity, pairs by the overlap in space (people: by the distance),
an object is reported from its third box on and forgotten after two sweeps without one. The numbers are those of its
authors for KITTI. Objects are followed in the world, which their later version does by compensating for the ego.

DeepFusionMOT: Wang, Fu, Li, Lai and He 2022, "DeepFusionMOT: A 3D Multi-Object Tracking Framework Based on Camera-LiDAR
Fusion with Deep Association", section III: boxes of sweeps that overlap with one of the image by half are fused.
Objects in space are paired with fused boxes, then with the others of the sweep; objects in the image with the other
boxes of the image; last, objects in the image that overlap with one in space by half become it. Those in space are
reported from their third box on, at moments with a box, and forgotten after 25 without one.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.detections.fitting import image_overlaps
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
LEAST_OVERLAP_IN_IMAGE, MOST_MISSED_BY_BOTH = 0.5, 25


_Outlines = Callable[[Float64Array], Float64Array]
"""Takes states (N, 10) to their outlines in the image, (N, 4) [px]."""


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
        rows, columns = _pairs(self.objects, boxes, by_distance=self.by_distance)
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


def _pairs(objects: Sequence[_Object], boxes: Float64Array, *, by_distance: bool) -> tuple[Int64Array, Int64Array]:
    """Rows of objects and columns of boxes in space that are one."""
    if not len(objects) or not len(boxes):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    expected = np.array([one.mean[:_MEASURED] for one in objects])
    if by_distance:
        gains = -np.linalg.norm(expected[:, None, :3] - boxes[None, :, :3], axis=2)
        return _best(gains, -FARTHEST_M)
    ends = np.array([0, len(expected)], np.int64), np.array([0, len(boxes)], np.int64)
    sides = (np.ascontiguousarray(each[:, [0, 1, 2, 4, 5, 6, 3]]) for each in (expected, boxes))
    gains = overlaps_in_space(*sides, *ends, pair_starts(*ends)).reshape(len(expected), len(boxes))
    return _best(gains, LEAST_OVERLAP)


def _best(gains: Float64Array, least: float) -> tuple[Int64Array, Int64Array]:
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


@dataclass(slots=True)
class _ImageObject:
    """One that only the image shows: its box [px], how that moves in a frame, and how often it was seen and not."""

    box: Float64Array
    motion: Float64Array
    hits: int = 1
    missed: int = 0


@dataclass(slots=True)
class DeepFusionMot(Ab3dmot):
    """Follows the boxes of one class in sweeps and images.

    Attributes:
        in_image: objects that no sweep has shown yet.
    """

    in_image: list[_ImageObject] = field(default_factory=list)

    def step_both(
        self, boxes: Float64Array, scores: Float64Array, image: Float64Array, outlines: _Outlines
    ) -> list[_Object]:
        """Take the next boxes of a sweep and of its image, and give the objects that are reported."""
        self.frames += 1
        for one in self.objects:
            _predict(one)
        shown = outlines(np.column_stack([boxes, np.zeros((len(boxes), 3))]))
        rows, columns = _best(image_overlaps(shown, image), LEAST_OVERLAP_IN_IMAGE)
        fused, open_objects, before = np.isin(np.arange(len(boxes)), rows), self.objects, len(self.objects)
        taken = np.zeros(len(boxes), np.bool_)
        for level in (np.flatnonzero(fused), np.flatnonzero(~fused)):
            found, of_boxes = _pairs(open_objects, boxes[level], by_distance=self.by_distance)
            for row, column in zip(found.tolist(), level[of_boxes].tolist(), strict=True):
                _update(open_objects[row], boxes[column], float(scores[column]))
                taken[column] = True
            open_objects = [one for k, one in enumerate(open_objects) if k not in set(found.tolist())]
        for one in open_objects:
            one.missed += 1
        for column in np.flatnonzero(~taken).tolist():
            self._begin(boxes[column], float(scores[column]))
        self._follow_in_image(np.delete(image, columns, axis=0))
        self._become_objects(outlines)
        gone = {id(one) for one in self.objects[:before] if one.missed >= MOST_MISSED_BY_BOTH}
        self.objects = [one for one in self.objects if id(one) not in gone]
        seen = [one for one in self.objects if one.missed == 0]
        return [one for one in seen if one.hits >= LEAST_HITS or self.frames <= LEAST_HITS]

    def _follow_in_image(self, image: Float64Array) -> None:
        """Pair the objects of the image with its boxes that no sweep has."""
        for one in self.in_image:
            one.box = one.box + one.motion
        known = np.array([one.box for one in self.in_image]).reshape(-1, 4)
        rows, columns = _best(image_overlaps(known, image), LEAST_OVERLAP_IN_IMAGE)
        for row in np.setdiff1d(np.arange(len(known)), rows).tolist():
            self.in_image[row].missed += 1
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            one = self.in_image[row]
            one.motion = one.motion + 0.5 * (image[column] - one.box)
            one.box, one.hits, one.missed = image[column], one.hits + 1, 0
        free = np.setdiff1d(np.arange(len(image)), columns).tolist()
        self.in_image += [_ImageObject(image[column], np.zeros(4)) for column in free]
        self.in_image = [one for one in self.in_image if one.missed < MOST_MISSED_BY_BOTH]

    def _become_objects(self, outlines: _Outlines) -> None:
        """Hand what was seen of objects in the image to those in space that they are."""
        if not self.objects or not self.in_image:
            return
        known = np.array([one.box for one in self.in_image])
        expected = outlines(np.array([one.mean for one in self.objects]))
        rows, columns = _best(image_overlaps(expected, known), LEAST_OVERLAP_IN_IMAGE)
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            self.objects[row].hits = max(self.objects[row].hits, self.in_image[column].hits)
        self.in_image = [one for k, one in enumerate(self.in_image) if k not in set(columns.tolist())]


class _Class(NamedTuple):
    """How a class is followed: KITTI's name, whether by distance, and the least score of boxes that are looked at."""

    label: str
    by_distance: bool
    least_score: float


def follow(
    drive: DetectedDrive, rectified_from_lidar: RigidTransform, least_scores: dict[str, float], *, by_both: bool
) -> KittiLabels:
    """Follow the cars and pedestrians of a drive of KITTI's benchmark as AB3DMOT or, by both, as DeepFusionMOT."""
    classes = [_Class(label, label == "Pedestrian", least) for label, least in least_scores.items()]
    return kitti_labels(_followed(drive, classes, by_both=by_both), rectified_from_lidar)


def _followed(drive: DetectedDrive, classes: Sequence[_Class], *, by_both: bool) -> Iterator[KittiObjects]:
    trackers = {one.label: DeepFusionMot(one.by_distance) for one in classes}
    for frame, moment in enumerate(moments(drive)):
        pair = next(iter(moment.pairs.values()))
        world = moment.boxes_3d.moved(moment.world_from_lidar, PointsFrame.WORLD)
        measures = np.column_stack([world.centers, world.yaws, world.sizes_lwh]).astype(np.float64)

        def placed(
            states: Float64Array, scores: Float64Array, labels: tuple[str, ...], moment: Any = moment
        ) -> Boxes3D:
            boxes = states[:, :3], states[:, 4:7], states[:, 3], scores, labels
            in_world = Boxes3D(moment.timestamp_ns, *boxes, frame=PointsFrame.WORLD)
            return in_world.moved(moment.world_from_lidar.inverse(), PointsFrame.SENSOR)

        def outlines(states: Float64Array, pair: Any = pair, placed: Any = placed) -> Float64Array:
            boxes = placed(states, np.ones(len(states)), ("",) * len(states))
            return projected_boxes(boxes, pair.camera, pair.camera_from_lidar)

        found = []
        for one in classes:
            chosen = np.array([name == one.label for name in world.labels], np.bool_)
            chosen &= world.scores >= one.least_score
            seen, tracker = (measures[chosen], world.scores[chosen]), trackers[one.label]
            if by_both:
                of_class = np.array([name == one.label for name in pair.boxes_2d.labels], np.bool_)
                reported = tracker.step_both(*seen, pair.boxes_2d.corners_xyxy[of_class], outlines)
            else:
                reported = tracker.step(*seen)
            found += [(one.label, each) for each in reported]
        states = np.array([each.mean for _, each in found]).reshape(-1, _SIZE)
        scores, labels = np.array([each.score for _, each in found]), tuple(label for label, _ in found)
        boxes, corners = placed(states, scores, labels), outlines(states)
        numbers = np.array([2 * each.number + (label == "Car") for label, each in found], np.int64)
        where = boxes.centers, boxes.sizes_lwh, boxes.yaws
        yield KittiObjects(frame, numbers, boxes.labels, boxes.scores, corners, where, pair.camera)
