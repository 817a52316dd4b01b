"""Parts of a scene: frames, samples, the poses around them, annotations, labelled points and tracks."""

import numpy as np
import pytest

from sceneloom import scene as sc
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError
from sceneloom.scene.scene import NOMINAL_PERIOD_NS, time_span, usual_period_ns
from sceneloom.scene.time_range import Renumbering, cut_scene, renumbered
from sceneloom.scene.types import key_of

SECOND = 1_000_000_000
CAMERA = Camera("pinhole", 2, 1, 1.0, 1.0, 0.5, 0.0)


def at(*seconds):
    return np.array([round(s * SECOND) for s in seconds], np.int64)


def seconds(path):
    return (path.timestamps_ns / SECOND).tolist()


def lidar_at(times_ns, sensor_id="lidar"):
    frames = [sc.LidarFrame(t, sc.LidarPoints(np.zeros((k + 1, 3), np.float32))) for k, t in enumerate(times_ns)]
    return sc.LidarSensor(sensor_id, sc.LazyFrames.of(frames, times_ns))


def camera_at(times_ns, *, video=False):
    images = [sc.CameraImage.of(t, CAMERA, np.zeros((1, 2, 3), np.uint8)) for t in times_ns]
    content = sc.VideoContent(lambda: pytest.fail("no video is opened"), "h264") if video else None
    return sc.CameraSensor("camera0", CAMERA, sc.LazyFrames.of(images, times_ns), video=content)


def path_at(times_ns):
    positions = np.stack([times_ns * 1e-9, 0 * times_ns, 0 * times_ns], axis=1)
    return sc.Poses(times_ns, positions, np.tile([0.0, 0, 0, 1], (len(times_ns), 1)))


TIMES = np.arange(0, 200 * SECOND, SECOND // 2, dtype=np.int64)
PART = (100 * SECOND, 110 * SECOND)
LIDAR = lidar_at(TIMES.tolist())


def moving_scene():
    path, ones = path_at(TIMES), np.ones(len(TIMES))
    return sc.Scene(
        (
            LIDAR,
            sc.RadarSensor("radar", sc.LazyFrames.of([], []), poses=path),
            sc.OdometrySensor("ego", path),
            sc.ImuSensor("imu", {"gyroscope": sc.VectorSamples(TIMES, np.zeros((len(TIMES), 3)), TIMES / 1e9)}),
            sc.GnssSensor("gnss", TIMES, np.zeros((len(TIMES), 3)), ones, ones),
        ),
        trajectories={"pose": sc.Trajectory("pose", TIMES, path.positions, path.quaternions_xyzw)},
    )


def test_samples_are_those_of_the_part_and_poses_reach_a_little_around_it_and_state_the_same_in_it():
    whole = moving_scene()
    part = cut_scene(whole, start=100.0, stop=110.0)
    inside = TIMES[(PART[0] <= TIMES) & (PART[1] > TIMES)]
    samples, gnss = part.sensor("imu").streams["gyroscope"], part.sensor("gnss")
    np.testing.assert_array_equal([samples.timestamps_ns, samples.file_seconds * 1e9], [inside, inside])
    np.testing.assert_array_equal(gnss.timestamps_ns, inside)
    assert len(gnss.accuracies) == len(inside)
    asked = np.linspace(PART[0], PART[1] + SECOND // 2, 99).astype(np.int64)
    expected = whole.sensor("ego").poses.interpolate(asked)
    for poses in (part.sensor("ego").poses, part.sensor("radar").poses, part.trajectories["pose"].poses):
        given = poses.interpolate(asked)
        np.testing.assert_allclose(given.positions, expected.positions, atol=1e-9)
        assert not given.coverage.any()
        assert PART[0] - 2 * SECOND < poses.start_ns <= PART[0]
    for stop in (float("inf"), 1e300, 1e12):
        assert len(cut_scene(whole, stop=stop).lidars[0].frames) == len(TIMES)
    for start in (1e300, 1e12):
        with pytest.raises(OptionError, match=r"no frame from .* the scene lasts 199\.500 s"):
            cut_scene(whole, start=start)


@pytest.mark.parametrize(
    ("times", "kept"),
    [
        # one that misses the part keeps its nearest pose, one whose poses are far apart those on both sides
        ([0, 10], [10]),
        ([180, 190], [180]),
        ([5], [5]),
        ([0, 50, 150, 190], [50, 150]),
        ([], None),
    ],
)
def test_a_trajectory_keeps_its_poses_around_the_part_and_one_that_holds_always_is_not_cut(times, kept):
    path = path_at(at(*times)) if times else sc.Poses.identity()
    poses = cut_scene(sc.Scene((LIDAR, sc.OdometrySensor("ego", path))), start=100.0, stop=110.0).sensor("ego").poses
    assert poses.static if kept is None else seconds(poses) == kept


def test_a_part_holds_the_frames_from_start_until_before_stop_and_its_last_sweep_keeps_its_image():
    times = [k * SECOND for k in range(5)]
    scene = sc.Scene((lidar_at(times), camera_at([time + 7 for time in times], video=True)))
    part = cut_scene(scene, start=1.0, stop=3.0)
    np.testing.assert_array_equal(part.lidars[0].frames.timestamps_ns, [SECOND, 2 * SECOND])
    assert len(part.lidars[0].frames[0].points) == 2
    assert part.cameras[0].video.frame_indices == (1, 2)
    assert cut_scene(part, start=0.9).cameras[0].video.frame_indices == (2,)
    # a part that takes all images keeps the video whole
    whole = cut_scene(sc.Scene((camera_at([0, SECOND], video=True),)), start=0.0, stop=10.0)
    assert whole.cameras[0].video.frame_indices is None
    part = cut_scene(sc.Scene((LIDAR, camera_at((TIMES + SECOND // 4).tolist()))), start=100.0, stop=102.6)
    assert part.lidars[0].frames.timestamps_ns[-1] == 102.5 * SECOND
    assert part.cameras[0].images.timestamps_ns[[0, -1]].tolist() == [100.25 * SECOND, 102.75 * SECOND]
    for start, stop in ((2.0, 1.0), (-1.0, None), (None, 0.0), (50.0, None), (float("nan"), None)):
        with pytest.raises(OptionError):
            cut_scene(scene, start=start, stop=stop)


def test_a_part_is_counted_from_the_first_frame_even_if_it_begins_late_and_without_frames_from_the_first_pose():
    poses = path_at(np.arange(-3 * SECOND, 3 * SECOND + 1, SECOND // 2))
    timestamps = [0, 100_000_000, 200_000_000]
    cut = cut_scene(sc.Scene((sc.OdometrySensor("ego", poses), lidar_at(timestamps))), start=0.1)
    assert cut.lidars[0].frames.timestamps_ns.tolist() == timestamps[1:]
    assert cut_scene(cut, start=0.1).lidars[0].frames.timestamps_ns.tolist() == timestamps[2:]
    assert time_span(sc.Scene((sc.OdometrySensor("ego", path_at(np.array([5, 9]))),))) == (5, 9)
    for early_ns in [0, 1, 1000, 90_000]:
        timestamps_ns = [early_ns, 100_000_000, 200_000_000, 299_999_000, 400_001_000]
        scene = sc.Scene((lidar_at(timestamps_ns),))
        before, after = cut_scene(scene, stop=0.3), cut_scene(scene, start=0.3)
        assert after.lidars[0].frames.timestamps_ns.tolist() == timestamps_ns[3:]
        assert before.lidars[0].frames.timestamps_ns.tolist() == timestamps_ns[:3]
        # a sweep that begins well before a part is not in it
        late = sc.Scene((lidar_at([0, 100_000_000, 199_800_000, 300_000_000]),))
        assert cut_scene(late, start=0.2).lidars[0].frames.timestamps_ns.tolist() == [300_000_000]


def rows(columns, count):
    return np.arange(columns * count, dtype=np.float64).reshape(count, columns)


TOP = lidar_at([k * SECOND for k in range(20)], "top")


def cut(*annotations, attributes=(), start=5.0, stop=10.0):
    """The part from 5 s to 10 s; its last sweep lasts a second, until 10 s."""
    return cut_scene(sc.Scene((TOP,), annotations, attributes=attributes), start=start, stop=stop)


def only(*annotations):
    (annotation,) = cut(*annotations).annotations
    return annotation


def reported(scene):
    return {warning.code: warning.count for warning in scene.warnings}


def test_activations_and_projections_of_a_cuboid_that_last_into_the_part_stay():
    activation = sc.Activation("top", at(2, 4, 6, 10), durations_ns=(SECOND, 2 * SECOND, 1, 1), cuboids=rows(9, 4))
    confirmed = (True, None, False, True)
    projection = sc.Projection("front", at(4, 5, 9.9, 10), rows(4, 4), confirmed, rows(9, 4), extras={"by": "hand"})
    activations, path = (activation, sc.Activation("top", at(1))), sc.CuboidPath(at(0, 20), rows(9, 2))
    found = only(sc.CuboidAnnotation("c", path, activations=activations, projections=(projection,)))
    (active,), (projected,) = found.activations, found.projections
    assert (seconds(active), active.durations_ns) == ([4, 6], (2 * SECOND, 1))
    assert (seconds(projected), projected.confirmed, projected.extras) == ([5, 9.9], (None, False), {"by": "hand"})
    np.testing.assert_array_equal([active.cuboids, projected.cuboids], [rows(9, 4)[1:3]] * 2)
    np.testing.assert_array_equal(projected.boxes, rows(4, 4)[1:3])


def test_paths_keep_the_rows_in_and_next_to_the_part_and_a_point_that_is_not_there_its_number():
    times = at(1, 4, 6, 12, 15)
    cuboid = sc.CuboidAnnotation("c", sc.CuboidPath(times, rows(9, 5)))
    box = sc.Box2DAnnotation("b", "front", sc.BoxPath(times, rows(4, 5), {"x": 1}))
    corners = tuple(rows(3, k + 1) for k in range(5))
    lane = sc.ShapeAnnotation("l", sc.ShapeType.POLYLINE, sc.VertexPath(times, corners))
    plain = sc.PlainAnnotation("lane", "polyline", {})
    kept_cuboid, kept_box, kept_lane, kept_plain = cut(cuboid, box, lane, plain).annotations
    assert [seconds(kept.path) for kept in (kept_cuboid, kept_box, kept_lane)] == [[4, 6, 12]] * 3
    np.testing.assert_array_equal(kept_cuboid.path.values, rows(9, 5)[1:4])
    np.testing.assert_array_equal(kept_box.path.values, rows(4, 5)[1:4])
    assert kept_box.path.extras == {"x": 1}
    assert kept_lane.path.vertices == corners[1:4]
    assert kept_plain is plain
    there, gone = sc.PointPath(at(4, 6), rows(3, 2), id="a"), sc.PointPath(at(1), rows(3, 1), id="b")
    seen = sc.PointProjection("front", at(1, 6), points=rows(2, 2), positions=rows(3, 2))
    kept = only(sc.PointsAnnotation("k", (there, gone), labels=("x", "y"), projections=((seen,), ())))
    assert [(path.id, seconds(path)) for path in kept.paths] == [("a", [4, 6]), ("b", [])]
    assert kept.labels == ("x", "y")
    assert seconds(kept.projections[0][0]) == [6]
    np.testing.assert_array_equal(kept.projections[0][0].positions, rows(3, 2)[1:])
    assert cut(sc.PointsAnnotation("k", (gone, gone))).annotations == ()


def test_what_is_not_there_in_the_part_is_left_out_and_reported_and_what_is_stationary_holds_in_any():
    for times in (at(0, 4.9), at(10, 12)):
        polygon = sc.ShapeAnnotation("s", sc.ShapeType.POLYGON, sc.VertexPath(times, (rows(3, 1),) * 2))
        part = cut(polygon, sc.CuboidAnnotation("c", sc.CuboidPath(times, rows(9, 2))))
        assert (part.annotations, reported(part)) == ((), {"annotations-cut": 2})
    polygon = sc.ShapeAnnotation("s", sc.ShapeType.POLYGON, sc.VertexPath(at(1), (rows(3, 4),)), stationary=True)
    box = sc.CuboidAnnotation("c", sc.CuboidPath(at(0), rows(9, 1)), stationary=True)
    kept, kept_box = cut(polygon, box).annotations
    assert seconds(kept.path) == seconds(kept_box.path) == [5]
    np.testing.assert_array_equal(kept.path.vertices[0], rows(3, 4))
    np.testing.assert_array_equal(kept_box.path.values, rows(9, 1))


@pytest.mark.parametrize(
    ("start", "duration", "expected"),
    [(6, None, (6, None)), (6, 30, (6, 30)), (2, 4, (5, 1)), (2, 3, None), (2, None, None), (10, 1, None)],
)
def test_an_event_stays_where_it_lasts_into_the_part_and_ends_when_it_did(start, duration, expected):
    lasting_ns = None if duration is None else duration * SECOND
    found = cut(sc.EventAnnotation("e", start * SECOND, duration_ns=lasting_ns)).annotations
    ends = [None if kept.duration_ns is None else kept.duration_ns / SECOND for kept in found]
    assert [(kept.start_ns / SECOND, end) for kept, end in zip(found, ends, strict=True)] == [expected] * bool(expected)


def test_labelled_points_follow_their_frames_and_corrections_keep_the_poses_around_the_part():
    ids = np.arange(2, dtype=np.uint32)
    parts = [sc.LabeledPoints("top", ids, sensor_frame=k) for k in (4, 5, 9, 10)]
    of_map = sc.LabeledPoints("map", ids)
    part = cut(sc.LabeledPointsAnnotation("road", (*parts, of_map)), sc.LabeledPointsAnnotation("gone", (parts[0],)))
    (kept,) = part.annotations
    assert [(p.sensor_id, p.sensor_frame) for p in kept.labeled_points] == [("top", 0), ("top", 4), ("map", None)]
    assert reported(part) == {"labelled-frames": 3, "labelled-annotations": 1, "annotations-cut": 1}
    # labels of a whole sensor stay where all of its frames do
    whole = sc.LabeledPointsAnnotation("road", (sc.LabeledPoints("top", ids),))
    assert cut(whole, start=0.0, stop=100.0).annotations[0].labeled_points[0].sensor_frame is None
    assert cut(whole).annotations == ()

    def adjustment(poses):
        return sc.LocalizationAdjustment("a", poses)

    path = path_at(at(0, 4, 7, 12, 20))
    calibration = sc.CameraCalibration("c", "front", poses=path, time_offset_ns=5)
    kept, calibrated = cut(adjustment(path), calibration).annotations
    assert seconds(kept.poses) == seconds(calibrated.poses) == [4, 7, 12]
    assert calibrated.time_offset_ns == 5
    for stationary in (sc.Poses.identity(), path_at(at(0))):
        assert only(adjustment(stationary)).poses.static
    assert cut(adjustment(path_at(at(0, 1)))).annotations == ()


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
    attribute = sc.AttributePath("colour", tuple(values), at(*times))
    part = cut(sc.ObjectAnnotation("o", attributes=(attribute,)), attributes=(attribute,))
    for found in (part.attributes, part.annotations[0].attributes):
        shown = [(tuple(seconds(path)), "".join(path.values)) for path in found]
        assert shown == ([] if expected is None else [expected])
    # those without a time for each value and static ones stay
    unequal = sc.AttributePath("c", (1,), at(0, 7))
    attributes = (sc.AttributePath("a", (1,)), sc.AttributePath("b", (1, 2), at(0), static=True), unequal)
    assert cut(attributes=attributes).attributes == attributes


def test_links_to_what_is_gone_go_children_stand_alone_and_a_frame_is_asked_for_once():
    part = cut(
        sc.ShapeAnnotation("gone", sc.ShapeType.POINT, sc.VertexPath(at(1), (rows(3, 1),))),
        sc.ObjectAnnotation("child", parent_id="gone"),
        sc.ObjectAnnotation("other", parent_id="group"),
        sc.GroupAnnotation("group"),
        sc.LinkAnnotation("loose", "gone", "child"),
        sc.LinkAnnotation("firm", "child", "other"),
    )
    assert [annotation.id for annotation in part.annotations] == ["child", "other", "group", "firm"]
    assert [annotation.parent_id for annotation in part.annotations[:2]] == [None, "group"]
    assert reported(part) == {"annotations-cut": 2, "parents-cut": 1}
    asked = []

    def rows_of(number):
        asked.append(number)
        return np.array([1, 3], np.int64) + number

    annotations = [
        sc.LabeledPointsAnnotation(
            name, tuple(sc.LabeledPoints("top", np.array([ids, 9], np.uint32), k) for k in (1, 0))
        )
        for name, ids in (("a", 1), ("b", 3))
    ]
    found, _ = renumbered(annotations, {key_of("top"): Renumbering(rows=rows_of)})
    assert asked == [0, 1]
    numbers = [[(e.sensor_frame, e.point_ids.tolist()) for e in a.labeled_points] for a in found]
    assert numbers == [[(0, [0])], [(0, [1])]]


def test_the_usual_period_is_the_middle_one_of_the_steps_forward():
    known = (([0, 100, 200, 350], 100), ([200, 0, 350, 100], 100), ([0, 0, 0, 70], 70))
    for timestamps, expected in (*known, *((times, NOMINAL_PERIOD_NS) for times in ([5], [5, 5], []))):
        assert usual_period_ns(np.array(timestamps, np.int64)) == expected
