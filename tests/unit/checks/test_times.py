"""Rules about times: of frames, of points, of annotations, and of the scene's clock."""

from io import BytesIO

import numpy as np
import pytest

from sceneloom.checks import validate
from sceneloom.checks.times import ANNOTATION_TIME_RULES, POINT_TIME_RULES, TIME_RULES
from sceneloom.scene import (
    Activation,
    AttributePath,
    CuboidAnnotation,
    CuboidPath,
    DataWarning,
    EventAnnotation,
    LocalizationAdjustment,
    PointsAnnotation,
    Poses,
    Projection,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
    VideoContent,
    WarningKind,
)

P, SECOND = 100_000_000, 1_000_000_000
TIMES = np.arange(3, dtype=np.int64) * P
JITTER = np.random.default_rng(1).uniform(-0.3, 0.3, 40) * P
EPOCH_NS, WRAP_NS = 1_700_000_000 * SECOND, 2**32 * 1000
VIDEO = VideoContent(lambda: BytesIO(b""), "h264")


def late_lidar(s, start_ns):
    return s.lidar(start_ns + s.times(), poses=s.path(start_ns + s.times()))


def timed(s, shift, start_ns=20 * SECOND):
    """A lidar whose point times are changed by `shift(times, frame's timestamp)`."""

    def sweep(timestamp_ns):
        times = s.sweep(timestamp_ns).points.timestamps_ns
        return s.sweep(timestamp_ns, timestamps_ns=np.asarray(shift(times, timestamp_ns), np.int64))

    return s.lidar(start_ns + s.times(), sweep=sweep, poses=s.path(start_ns + s.times()))


def cuboid(times=TIMES, values=None, *, name="car", **fields):
    times = np.asarray(times, np.int64)
    rows = np.tile([4.0, 2, 1.5, 1, 2, 0, 0, 0, 30], (len(times), 1)) if values is None else values
    return CuboidAnnotation(name, CuboidPath(times, rows), **fields)


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    assert keeps(sound.scene(sound.lidar(), sound.camera(fps=10.0), sound.odometry()), TIME_RULES)
    none = {"positions": np.zeros((0, 3), np.float32), "intensities": np.zeros(0, np.uint8)}
    empty = sound.lidar(id="empty", sweep=lambda t: sound.sweep(t, **none, timestamps_ns=np.zeros(0, np.int64)))
    bare = sound.lidar(id="bare", sweep=lambda t: sound.sweep(t, timestamps_ns=None))
    assert keeps(sound.scene(timed(sound, lambda times, timestamp: times), bare, empty), POINT_TIME_RULES)
    projection = Projection("front", TIMES, np.tile([1.0, 1, 5, 5], (3, 1)), (True, None, False))
    car = cuboid(projections=(projection,), activations=(Activation("top", TIMES, (0, 5, 1.5)),))
    scene = sound.scene(car, EventAnnotation("e", P, 2 * P), EventAnnotation("moment", 6 * P))
    assert keeps(scene, ANNOTATION_TIME_RULES)


def test_times_of_frames(check, sound):
    check(
        "frame-times-increasing",
        f"sensors[0].frames[2]: {P} ns after {2 * P} ns; expected a later time",
        sound.lidar([0, 2 * P, P, P, 3 * P]),
    )
    check("frame-times-increasing", "", sound.camera([P, 0], video=VIDEO))
    check("video-times-increasing", "sensors[0].images[1]", sound.camera([P, 0], video=VIDEO))
    check("video-times-increasing", "", sound.camera([P, 0]))
    check(
        "frame-times-unique",
        [
            "sensors[0].frames[3]: 0 ns, as frame 0; expected a time of its own",
            f"sensors[0].frames[4]: {P} ns, as frame 1; expected a time of its own",
        ],
        sound.lidar([0, P, 2 * P, 0, P]),
    )
    check(
        "frame-rate",
        "sensors[0].frames: 200.0 frames a second; expected at most 100",
        sound.lidar(np.arange(5) * (SECOND // 200)),
    )
    check("frame-rate", "sensors[0].images: endlessly many", sound.camera([0, 0]))
    check("frame-rate", "", sound.lidar(np.arange(5) * (SECOND // 100)))
    check("frame-gaps", "sensors[0].frames[3]: 2 seem missing", sound.lidar(np.delete(np.arange(10) * P, [4, 5])))
    check("frame-doubled", "sensors[0].frames[4]", sound.lidar(np.sort([*range(0, 10 * P, P), 3 * P + P // 50])))
    check("frame-jitter", "sensors[0].frames", sound.lidar(np.arange(40) * P + JITTER))
    check("frame-jitter", "", sound.lidar(np.arange(40) * P + JITTER / 20))
    check("epoch-times", "", sound.scene(late_lidar(sound, EPOCH_NS), format="sfs", time_offset_ns=EPOCH_NS))
    check("epoch-times", "", sound.scene(late_lidar(sound, EPOCH_NS), format="recording"))
    check("late-start", "", sound.scene(format="sfs"))


def test_times_of_points(check, sound):
    # a microsecond of rounding is no fault
    check("point-times-frame", "", timed(sound, lambda times, timestamp: times - 900))
    check(
        "point-times-frame",
        "sensors[0].frames[0].points.timestamps: 55 of 100 points lie before their frame, by up to 0.050000 s",
        timed(sound, lambda times, timestamp: times - P // 2),
    )
    check(
        "point-times-equal",
        f"sensors[1].frames[0].points.timestamps: all 100 are {20 * SECOND} ns",
        sound.lidar(id="good"),
        timed(sound, lambda times, timestamp: np.full(100, timestamp)),
    )


def test_times_of_annotations(check, sound):
    check(
        "annotation-times-increasing",
        "annotations[1].path.timestamps[1]: 0 ns after 0 ns",
        cuboid(),
        cuboid([0, 0, P], name="b"),
    )
    check(
        "annotation-times-increasing",
        f"annotations[1].path.timestamps[1]: 0 ns after {P} ns",
        cuboid(),
        cuboid([P, 0, 2 * P], name="b"),
    )
    # the first time of a path may be before the last one of the path before, also with an empty path between them
    check("annotation-times-increasing", "", cuboid([P, 2 * P]), cuboid([0, P], name="b"))
    check("annotation-times-increasing", "", cuboid([P]), cuboid([], name="b"), cuboid([0], name="c"))
    check("annotation-path-empty", "annotations[1].path", cuboid([P]), cuboid([], name="b"), cuboid([0], name="c"))
    check("annotation-path-empty", "annotations[0].paths", PointsAnnotation("hand", ()))
    # one sweep beyond the sensors is allowed, a second makes what lies outside as a whole another rule's
    check("annotation-beyond-scene", "", cuboid([0, 6 * P]))
    check("annotation-beyond-scene", "annotations[0].path.timestamps[1]: after the scene ends", cuboid([0, 6 * P + 1]))
    check("annotation-outside-scene", "", cuboid([0, 6 * P + 1]))
    check("annotation-outside-scene", "", cuboid([16 * P, 20 * P]))
    check("annotation-beyond-scene", "annotations[0].path.timestamps[1]", cuboid([16 * P, 20 * P]))
    check("annotation-outside-scene", "annotations[0].path.timestamps", cuboid([16 * P + 1, 20 * P]))
    check("annotation-beyond-scene", "", cuboid([16 * P + 1, 20 * P]))
    check("annotation-outside-scene", "", cuboid([-90 * P, 90 * P]))
    # poses of corrections, and what holds always
    check(
        "annotation-beyond-scene",
        "",
        LocalizationAdjustment(
            "drift", Poses(np.array([-SECOND, SECOND]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
        ),
    )
    check("annotation-outside-scene", "", cuboid([90 * P], stationary=True))
    check("annotation-beyond-scene", "", cuboid([90 * P], stationary=True))
    check(
        "annotation-beyond-scene",
        "",
        cuboid(attributes=(AttributePath("colour", ("red",), np.array([90 * P]), static=True),)),
    )
    check(
        "annotation-outside-scene",
        "annotations[0].start",
        EventAnnotation("early", -19 * P, 2 * P),
        EventAnnotation("reaching in", -19 * P, 19 * P),
    )
    check("annotation-duration", "annotations[0].duration", EventAnnotation("backwards", P, -1))
    check(
        "annotation-duration",
        "annotations[0].activations[0].durations[1]",
        cuboid(activations=(Activation("top", TIMES, (0, -1, 3)),)),
    )
    check(
        "projection-without-image",
        "annotations[0].projections[0].timestamps[2]",
        cuboid(projections=(Projection("front", np.array([0, P + P // 4, P + P // 4 + 1, 5 * P])),)),
    )


@pytest.mark.parametrize(("fps", "wrong"), [(10.0, False), (10.4, False), (30.0, True), (5.0, True)])
def test_fps_is_compared_with_the_timestamps(sound, found, fps, wrong):
    assert bool(found(sound.scene(sound.camera(fps=fps)), "video-fps")) is wrong


def test_points_after_the_next_sweep_are_found(sound, found):
    late = timed(sound, lambda times, timestamp: times + 2 * P)
    [(_, message), *_] = found(sound.scene(late), "point-times-frame")
    assert "beyond the end of the next sweep" in message


def test_frames_out_of_order_are_sorted_with_their_contents(sound, found, fixed):
    scene = sound.scene(sound.lidar([P, 0]), sound.camera([P, 2 * P, 0]))
    repaired = fixed(scene, "frame-times-increasing")
    assert found(repaired, "frame-times-increasing") == []
    lidar, camera = repaired.sensors
    assert lidar.frames.timestamps_ns.tolist() == [0, P] == [f.timestamp_ns for f in lidar.frames]
    assert [image.timestamp_ns for image in camera.images] == [0, P, 2 * P]
    for left in (sound.scene(), sound.scene(sound.camera([P, 0], video=VIDEO))):
        assert fixed(left, "frame-times-increasing") is left


@pytest.mark.parametrize(("start_ns", "rule"), [(EPOCH_NS, "epoch-times"), (5_000 * SECOND, "late-start")])
def test_timestamps_far_from_the_clocks_zero_get_an_offset(sound, found, fixed, start_ns, rule):
    scene = sound.scene(late_lidar(sound, start_ns), format="sfs")
    [(path, message)] = found(scene, rule)
    assert path == "time_offset"
    assert str(start_ns // SECOND) in message
    repaired = fixed(scene, rule)
    assert repaired.time_offset_ns == start_ns
    assert repaired.sensors == scene.sensors
    assert found(repaired, rule) == []


@pytest.mark.parametrize(
    ("shift", "start_ns", "what"),
    [
        (lambda times, timestamp: times - timestamp, 20 * SECOND, "count from the frame's own timestamp"),
        (lambda times, timestamp: times * 1000, 2000 * SECOND, "are 1000 times too large"),
        (lambda times, timestamp: times // 1000, 2000 * SECOND, "are 1000 times too small"),
        (lambda times, timestamp: times + 3600 * SECOND, 20 * SECOND, "on another clock"),
        (lambda times, timestamp: times - WRAP_NS, WRAP_NS + 20 * SECOND, "1 times 2^32 µs"),
    ],
)
def test_times_that_are_not_on_the_scenes_clock_are_found_and_their_frames_counted(sound, found, shift, start_ns, what):
    scene = sound.scene(timed(sound, shift, start_ns))
    [(path, message)] = found(scene, "point-times-clock")
    assert path == "sensors[0].frames[0].points.timestamps"
    assert what in message
    assert validate(scene, rules=["point-times-clock"]).counts["warning"] == 6


def test_what_the_reader_of_scene_files_put_right_is_reported(sound, found):
    where = "sensors[0].frames"
    warning = DataWarning(kind=WarningKind.ASSUMED, code="relative-point-times", location=where, message="relative")
    assert found(sound.scene(warnings=(warning,)), "point-times-clock") == [(where, "relative")]


def test_sorting_takes_values_and_vertices_along_and_drops_rows_reported_twice(sound, fixed):
    rows = np.arange(36.0).reshape(4, 9)
    rows[3] = rows[0]
    attribute = AttributePath("state", ("b", "a"), np.array([P, 0]))
    projection = Projection("front", np.array([P, 0]), np.array([[1.0] * 4, [np.nan] * 4]), (True, None))
    car = cuboid([P, 0, 2 * P, P], rows, attributes=(attribute,), projections=(projection,))
    outlines = VertexPath(np.array([P, 0]), (np.full((3, 2), 2.0), np.full((4, 2), 1.0)))
    shape = ShapeAnnotation("s", ShapeType.POLYGON_2D, outlines, sensor_id="front")
    car, shape = fixed(sound.scene(car, shape), "annotation-times-increasing").annotations
    assert car.path.timestamps_ns.tolist() == [0, P, 2 * P]
    np.testing.assert_array_equal(car.path.values, rows[[1, 0, 2]])
    assert car.attributes[0].values == ("a", "b")
    assert car.projections[0].confirmed == (None, True)
    np.testing.assert_array_equal(car.projections[0].boxes[1], [1.0] * 4)
    assert [len(vertices) for vertices in shape.path.vertices] == [4, 3]
    # two different rows of one time are left to a person
    scene = sound.scene(cuboid([0, 0], np.arange(18.0).reshape(2, 9)))
    assert fixed(scene, "annotation-times-increasing") is scene
