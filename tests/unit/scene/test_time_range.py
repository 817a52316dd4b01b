"""Parts of a scene: sensors, annotations, labelled points and tracks."""

import numpy as np
import pytest

from sceneloom.scene import (
    Activation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Poses,
    Projection,
    Scene,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
from sceneloom.scene.scene import NOMINAL_PERIOD_NS, usual_period_ns
from sceneloom.scene.time_range import Renumbering, cut_scene, renumbered
from sceneloom.scene.types import key_of

SECOND = 1_000_000_000


def at(*seconds):
    return np.array([round(s * SECOND) for s in seconds], np.int64)


def rows(columns, count):
    return np.arange(columns * count, dtype=np.float64).reshape(count, columns)


def lidar(count=20):
    frame = LidarPoints(np.zeros((3, 3), np.float32))
    times = [k * SECOND for k in range(count)]
    return LidarSensor("top", LazyFrames.of([LidarFrame(t, frame) for t in times], times))


def cut(*annotations, attributes=(), start=5.0, stop=10.0):
    """The part from 5 s to 10 s; its last sweep lasts a second, until 10 s."""
    return cut_scene(Scene((lidar(),), annotations, attributes=attributes), start=start, stop=stop)


def only(*annotations):
    (annotation,) = cut(*annotations).annotations
    return annotation


def seconds(path):
    return (path.timestamps_ns / SECOND).tolist()


def reported(scene):
    return {warning.code: warning.count for warning in scene.warnings}


PATH = CuboidPath(at(0, 20), rows(9, 2))


def test_activations_that_last_into_the_part_stay():
    activation = Activation("top", at(2, 4, 6, 10), durations_ns=(SECOND, 2 * SECOND, 1, 1), cuboids=rows(9, 4))
    gone = Activation("top", at(1))
    (kept,) = only(CuboidAnnotation("c", PATH, activations=(activation, gone))).activations
    assert seconds(kept) == [4, 6]
    assert kept.durations_ns == (2 * SECOND, 1)
    np.testing.assert_array_equal(kept.cuboids, rows(9, 4)[1:3])


def test_projections_into_images_of_the_part_stay():
    confirmed = (True, None, False, True)
    projection = Projection("front", at(4, 5, 9.9, 10), rows(4, 4), confirmed, rows(9, 4), extras={"by": "hand"})
    (kept,) = only(CuboidAnnotation("c", PATH, projections=(projection,))).projections
    assert seconds(kept) == [5, 9.9]
    np.testing.assert_array_equal(kept.boxes, rows(4, 4)[1:3])
    np.testing.assert_array_equal(kept.cuboids, rows(9, 4)[1:3])
    assert kept.confirmed == (None, False)
    assert kept.extras == {"by": "hand"}


def test_paths_keep_the_rows_in_and_next_to_the_part():
    times = at(1, 4, 6, 12, 15)
    box = Box2DAnnotation("b", "front", BoxPath(times, rows(4, 5), {"x": 1}))
    corners = tuple(rows(3, k + 1) for k in range(5))
    lane = ShapeAnnotation("l", ShapeType.POLYLINE, VertexPath(times, corners))
    kept_box, kept_lane = cut(box, lane).annotations
    assert seconds(kept_box.path) == seconds(kept_lane.path) == [4, 6, 12]
    np.testing.assert_array_equal(kept_box.path.values, rows(4, 5)[1:4])
    assert kept_box.path.extras == {"x": 1}
    assert kept_lane.path.vertices == corners[1:4]


def test_what_is_not_there_in_the_part_is_left_out_and_reported_and_what_is_stationary_holds_in_any():
    for times in (at(0, 4.9), at(10, 12)):
        part = cut(ShapeAnnotation("s", ShapeType.POLYGON, VertexPath(times, (rows(3, 1),) * 2)))
        assert part.annotations == ()
        assert reported(part) == {"annotations-cut": 1}
    kept = only(ShapeAnnotation("s", ShapeType.POLYGON, VertexPath(at(1), (rows(3, 4),)), stationary=True))
    assert seconds(kept.path) == [5]
    np.testing.assert_array_equal(kept.path.vertices[0], rows(3, 4))


def test_a_point_that_is_not_there_keeps_its_number():
    there, gone = PointPath(at(4, 6), rows(3, 2), id="a"), PointPath(at(1), rows(3, 1), id="b")
    seen = PointProjection("front", at(1, 6), points=rows(2, 2), positions=rows(3, 2))
    kept = only(PointsAnnotation("k", (there, gone), labels=("x", "y"), projections=((seen,), ())))
    assert [path.id for path in kept.paths] == ["a", "b"]
    assert [seconds(path) for path in kept.paths] == [[4, 6], []]
    assert kept.labels == ("x", "y")
    assert seconds(kept.projections[0][0]) == [6]
    np.testing.assert_array_equal(kept.projections[0][0].positions, rows(3, 2)[1:])
    assert cut(PointsAnnotation("k", (gone, gone))).annotations == ()


@pytest.mark.parametrize(
    ("start", "duration", "expected"),
    [(6, None, (6, None)), (6, 30, (6, 30)), (2, 4, (5, 1)), (2, 3, None), (2, None, None), (10, 1, None)],
)
def test_an_event_stays_where_it_lasts_into_the_part_and_ends_when_it_did(start, duration, expected):
    lasting_ns = None if duration is None else duration * SECOND
    part = cut(EventAnnotation("e", start * SECOND, duration_ns=lasting_ns))
    if expected is None:
        assert part.annotations == ()
        return
    kept = part.annotations[0]
    ends = None if kept.duration_ns is None else kept.duration_ns / SECOND
    assert (kept.start_ns / SECOND, ends) == expected


def test_labelled_points_follow_their_frames():
    ids = np.arange(2, dtype=np.uint32)
    parts = [LabeledPoints("top", ids, sensor_frame=k) for k in (4, 5, 9, 10)]
    of_map = LabeledPoints("map", ids)
    part = cut(LabeledPointsAnnotation("road", (*parts, of_map)), LabeledPointsAnnotation("gone", (parts[0],)))
    (kept,) = part.annotations
    assert [(p.sensor_id, p.sensor_frame) for p in kept.labeled_points] == [("top", 0), ("top", 4), ("map", None)]
    assert reported(part)["labelled-frames"] == 3
    assert reported(part)["annotations-cut"] == 1
    # labels of a whole sensor stay where all of its frames do
    whole = LabeledPointsAnnotation("road", (LabeledPoints("top", ids),))
    assert cut(whole, start=0.0, stop=100.0).annotations[0].labeled_points[0].sensor_frame is None
    assert cut(whole).annotations == ()


def rotated(*timestamps):
    return Poses(at(*timestamps), rows(3, len(timestamps)), np.tile([0.0, 0, 0, 1], (len(timestamps), 1)))


def test_corrections_keep_the_poses_around_the_part():
    adjustment = LocalizationAdjustment("a", rotated(0, 4, 7, 12, 20))
    calibration = CameraCalibration("c", "front", poses=rotated(0, 4, 7, 12, 20), time_offset_ns=5)
    kept, calibrated = cut(adjustment, calibration).annotations
    assert seconds(kept.poses) == seconds(calibrated.poses) == [4, 7, 12]
    assert calibrated.time_offset_ns == 5
    stationary = LocalizationAdjustment("a", Poses.identity())
    assert only(stationary).poses.static
    assert cut(LocalizationAdjustment("a", rotated(0, 1))).annotations == ()
    assert only(LocalizationAdjustment("a", rotated(0))).poses.static


@pytest.mark.parametrize(
    ("times", "values", "expected"),
    [
        ((0, 4, 6, 10), "abcd", ((5, 6), "bc")),
        ((5, 6), "ab", ((5, 6), "ab")),
        ((0,), "a", ((5,), "a")),
        ((10, 11), "ab", None),
    ],
)
def test_an_attribute_begins_the_part_with_the_value_that_holds_then(times, values, expected):
    attribute = AttributePath("colour", tuple(values), at(*times))
    part = cut(ObjectAnnotation("o", attributes=(attribute,)), attributes=(attribute,))
    for found in (part.attributes, part.annotations[0].attributes):
        if expected is None:
            assert found == ()
        else:
            assert (tuple(seconds(found[0])), "".join(found[0].values)) == expected


def test_attributes_without_a_time_for_each_value_and_static_ones_stay():
    unequal = AttributePath("c", (1,), at(0, 7))
    attributes = (AttributePath("a", (1,)), AttributePath("b", (1, 2), at(0), static=True), unequal)
    assert cut(attributes=attributes).attributes == attributes


def test_links_to_what_is_gone_go_and_children_stand_alone():
    gone = ShapeAnnotation("gone", ShapeType.POINT, VertexPath(at(1), (rows(3, 1),)))
    part = cut(
        gone,
        ObjectAnnotation("child", parent_id="gone"),
        ObjectAnnotation("other", parent_id="group"),
        GroupAnnotation("group"),
        LinkAnnotation("loose", "gone", "child"),
        LinkAnnotation("firm", "child", "other"),
    )
    assert [annotation.id for annotation in part.annotations] == ["child", "other", "group", "firm"]
    assert [annotation.parent_id for annotation in part.annotations[:2]] == [None, "group"]
    assert reported(part) == {"annotations-cut": 2, "parents-cut": 1}


def test_a_frame_is_asked_for_once_however_many_annotations_have_points_in_it():
    asked = []

    def rows(number):
        asked.append(number)
        return np.array([1, 3], np.int64) + number

    annotations = [
        LabeledPointsAnnotation(name, tuple(LabeledPoints("top", np.array([ids, 9], np.uint32), k) for k in (1, 0)))
        for name, ids in (("a", 1), ("b", 3))
    ]
    found, _ = renumbered(annotations, {key_of("top"): Renumbering(rows=rows)})
    assert asked == [0, 1]
    numbers = [[(e.sensor_frame, e.point_ids.tolist()) for e in a.labeled_points] for a in found]
    assert numbers == [[(0, [0])], [(0, [1])]]


@pytest.mark.parametrize(
    ("timestamps", "expected"),
    [
        ([0, 100, 200, 350], 100),
        ([200, 0, 350, 100], 100),
        ([0, 0, 0, 70], 70),
        ([5], NOMINAL_PERIOD_NS),
        ([5, 5], NOMINAL_PERIOD_NS),
        ([], NOMINAL_PERIOD_NS),
    ],
)
def test_the_usual_period_is_the_middle_one_of_the_steps_forward(timestamps, expected):
    assert usual_period_ns(np.array(timestamps, np.int64)) == expected
