"""Labelled points that follow the frames and points of their sensors."""

import numpy as np

from sceneloom.scene import LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.time_range import Renumbering, renumbered
from sceneloom.scene.types import key_of


def test_a_frame_is_asked_for_once_however_many_annotations_have_points_in_it():
    asked = []

    def rows(number):
        asked.append(number)
        return np.array([1, 3], np.int64) + number

    annotations = [
        LabeledPointsAnnotation(
            name, tuple(LabeledPoints("top", np.array([ids, 9], np.uint32), k) for k in (1, 0))
        )
        for name, ids in (("a", 1), ("b", 3))
    ]
    found, _ = renumbered(annotations, {key_of("top"): Renumbering(rows=rows)})
    assert asked == [0, 1]
    numbers = [[(e.sensor_frame, e.point_ids.tolist()) for e in a.labeled_points] for a in found]
    assert numbers == [[(0, [0])], [(0, [1])]]
