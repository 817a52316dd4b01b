"""Rules about times: of frames, of points, of annotations, and of the scene's clock."""

from dataclasses import replace
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

PERIOD, SECOND = 100_000_000, 1_000_000_000


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    scene = sound.scene(sound.lidar(), sound.camera(fps=10.0), sound.odometry())
    assert keeps(scene, TIME_RULES)


def test_frames_out_of_order_are_found(sound, found):
    timestamps = [0, 2 * PERIOD, PERIOD, PERIOD, 3 * PERIOD]
    assert found(sound.scene(sound.lidar(timestamps)), "frame-times-increasing") == [
        ("sensors[0].frames[2]", f"{PERIOD} ns after {2 * PERIOD} ns; expected a later time")
    ]


def test_timestamps_of_a_video_out_of_order_are_found_and_left_alone(sound, found, fixed):
    video = VideoContent(lambda: BytesIO(b""), "h264")
    filmed = sound.scene(sound.camera([PERIOD, 0], video=video))
    assert [path for path, _ in found(filmed, "video-times-increasing")] == ["sensors[0].images[1]"]
    assert found(filmed, "frame-times-increasing") == []
    assert fixed(filmed, "frame-times-increasing") is filmed
    assert found(sound.scene(sound.camera([PERIOD, 0])), "video-times-increasing") == []


def test_frames_of_one_time_are_found_wherever_they_stand(sound, found):
    timestamps = [0, PERIOD, 2 * PERIOD, 0, PERIOD]
    assert found(sound.scene(sound.lidar(timestamps)), "frame-times-unique") == [
        ("sensors[0].frames[3]", "0 ns, as frame 0; expected a time of its own"),
        ("sensors[0].frames[4]", f"{PERIOD} ns, as frame 1; expected a time of its own"),
    ]


def test_frames_out_of_order_are_sorted_with_their_contents(sound, found, fixed):
    scene = sound.scene(sound.lidar([PERIOD, 0]), sound.camera([PERIOD, 2 * PERIOD, 0]))
    repaired = fixed(scene, "frame-times-increasing")
    assert found(repaired, "frame-times-increasing") == []
    lidar, camera = repaired.sensors
    assert lidar.frames.timestamps_ns.tolist() == [0, PERIOD] == [f.timestamp_ns for f in lidar.frames]
    assert [image.timestamp_ns for image in camera.images] == [0, PERIOD, 2 * PERIOD]


def test_frames_in_order_are_left_alone(sound, fixed):
    scene = sound.scene()
    assert fixed(scene, "frame-times-increasing") is scene


def test_more_than_100_frames_a_second_are_found(sound, found):
    fast = np.arange(5) * (SECOND // 200)
    assert found(sound.scene(sound.lidar(fast)), "frame-rate") == [
        ("sensors[0].frames", "200.0 frames a second; expected at most 100")
    ]
    assert found(sound.scene(sound.camera([0, 0])), "frame-rate")[0][1].startswith("endlessly many")
    assert found(sound.scene(sound.lidar(np.arange(5) * (SECOND // 100))), "frame-rate") == []


def test_a_gap_reports_how_many_frames_are_missing(sound, found):
    times = np.delete(np.arange(10) * PERIOD, [4, 5])
    [(path, message)] = found(sound.scene(sound.lidar(times)), "frame-gaps")
    assert path == "sensors[0].frames[3]"
    assert message.endswith("2 seem missing")


def test_a_frame_right_after_another_is_found(sound, found):
    times = np.sort([*range(0, 10 * PERIOD, PERIOD), 3 * PERIOD + PERIOD // 50])
    assert [path for path, _ in found(sound.scene(sound.lidar(times)), "frame-doubled")] == ["sensors[0].frames[4]"]


def test_uneven_intervals_are_found_and_small_jitter_is_not(sound, found):
    rng = np.random.default_rng(1)
    even = np.arange(40) * PERIOD
    shifts = rng.uniform(-0.3, 0.3, 40) * PERIOD
    uneven = (even + shifts).astype(np.int64)
    assert [path for path, _ in found(sound.scene(sound.lidar(uneven)), "frame-jitter")] == ["sensors[0].frames"]
    nearly = (even + shifts / 20).astype(np.int64)
    assert found(sound.scene(sound.lidar(nearly)), "frame-jitter") == []


@pytest.mark.parametrize(("fps", "wrong"), [(10.0, False), (10.4, False), (30.0, True), (5.0, True)])
def test_fps_is_compared_with_the_timestamps(sound, found, fps, wrong):
    assert bool(found(sound.scene(sound.camera(fps=fps)), "video-fps")) is wrong


def epoch_lidar(sound, start_ns):
    return sound.lidar(start_ns + sound.times(), poses=sound.path(start_ns + sound.times()))


@pytest.mark.parametrize(
    ("start_ns", "rule"), [(1_700_000_000 * SECOND, "epoch-times"), (5_000 * SECOND, "late-start")]
)
def test_timestamps_far_from_the_clocks_zero_get_an_offset(sound, found, fixed, start_ns, rule):
    scene = sound.scene(epoch_lidar(sound, start_ns), format="sfs")
    [(path, message)] = found(scene, rule)
    assert path == "time_offset"
    assert str(start_ns // SECOND) in message
    repaired = fixed(scene, rule)
    assert repaired.time_offset_ns == start_ns
    assert repaired.sensors == scene.sensors
    assert found(repaired, rule) == []


def test_an_offset_that_is_there_and_other_formats_need_none(sound, found):
    start_ns = 1_700_000_000 * SECOND
    lidar = epoch_lidar(sound, start_ns)
    assert found(sound.scene(lidar, format="sfs", time_offset_ns=start_ns), "epoch-times") == []
    assert found(sound.scene(lidar, format="recording"), "epoch-times") == []
    assert found(sound.scene(format="sfs"), "late-start") == []


WRAP_NS = 2**32 * 1000


def lidar_with(sound, shift, *, start_ns=20 * SECOND):
    """A lidar whose point times are changed by `shift(times, frame's timestamp)`."""

    def sweep(timestamp_ns):
        times = sound.sweep(timestamp_ns).points.timestamps_ns
        return sound.sweep(timestamp_ns, timestamps_ns=np.asarray(shift(times, timestamp_ns), np.int64))

    timestamps = start_ns + sound.times()
    return sound.lidar(timestamps, sweep=sweep, poses=sound.path(timestamps))


def test_a_sound_scene_keeps_all_rules_about_points(sound, keeps):
    plain = lidar_with(sound, lambda times, timestamp: times)
    without = sound.lidar(id="bare", sweep=lambda t: sound.sweep(t, timestamps_ns=None))
    empty = sound.lidar(
        id="empty",
        sweep=lambda t: sound.sweep(
            t,
            positions=np.zeros((0, 3), np.float32),
            intensities=np.zeros(0, np.uint8),
            timestamps_ns=np.zeros(0, np.int64),
        ),
    )
    scene = sound.scene(plain, without, empty)
    assert keeps(scene, POINT_TIME_RULES)


@pytest.mark.parametrize(
    ("shift", "start_ns", "what"),
    [
        (lambda times, timestamp: times - timestamp, 20 * SECOND, "count from the frame's own timestamp"),
        (lambda times, timestamp: times * 1000, 2000 * SECOND, "are 1000 times too large"),
        (lambda times, timestamp: times // 1000, 2000 * SECOND, "are 1000 times too small"),
        (lambda times, timestamp: times + 3600 * SECOND, 20 * SECOND, "on another clock"),
        (lambda times, timestamp: times - WRAP_NS, WRAP_NS + 20 * SECOND, "1 times 2^32 µs"),
    ],
    ids=["relative", "unit too large", "unit too small", "other clock", "wrapped"],
)
def test_times_that_are_not_on_the_scenes_clock_are_found_and_their_frames_counted(sound, found, shift, start_ns, what):
    scene = sound.scene(lidar_with(sound, shift, start_ns=start_ns))
    [(path, message)] = found(scene, "point-times-clock")
    assert path == "sensors[0].frames[0].points.timestamps"
    assert what in message
    assert validate(scene, rules=["point-times-clock"]).counts["warning"] == 6


def test_what_the_reader_of_scene_files_put_right_is_reported(sound, found):
    warning = DataWarning(
        kind=WarningKind.ASSUMED, code="relative-point-times", location="sensors[0].frames", message="relative"
    )
    assert found(sound.scene(warnings=(warning,)), "point-times-clock") == [("sensors[0].frames", "relative")]


def test_points_before_their_frame_are_counted(sound, found):
    hits = found(sound.scene(lidar_with(sound, lambda times, timestamp: times - PERIOD // 2)), "point-times-frame")
    assert len(hits) == 1
    assert "55 of 100 points lie before their frame, by up to 0.050000 s" in hits[0][1]


def test_points_after_the_next_sweep_are_found(sound, found):
    late = lidar_with(sound, lambda times, timestamp: times + 2 * PERIOD)
    [(_, message), *_] = found(sound.scene(late), "point-times-frame")
    assert "beyond the end of the next sweep" in message


def test_a_microsecond_of_rounding_is_no_fault(sound, found):
    rounded = lidar_with(sound, lambda times, timestamp: times - 900)
    assert found(sound.scene(rounded), "point-times-frame") == []


def test_times_that_are_all_the_same_are_reported(sound, found):
    flat = lidar_with(sound, lambda times, timestamp: np.full(100, timestamp))
    [(path, message)] = found(sound.scene(sound.lidar(id="good"), flat), "point-times-equal")
    assert path == "sensors[1].frames[0].points.timestamps"
    assert message.startswith(f"all 100 are {20 * SECOND} ns")


TIMES = np.arange(3, dtype=np.int64) * PERIOD


def cuboid(times=TIMES, values=None, **fields):
    times = np.asarray(times, np.int64)
    rows = np.tile([4.0, 2, 1.5, 1, 2, 0, 0, 0, 30], (len(times), 1)) if values is None else values
    return CuboidAnnotation("car", CuboidPath(times, rows), **fields)


def test_a_sound_scene_keeps_all_rules_about_annotations(sound, keeps):
    projection = Projection("front", TIMES, np.tile([1.0, 1, 5, 5], (3, 1)), (True, None, False))
    annotations = (
        cuboid(projections=(projection,), activations=(Activation("top", TIMES, (0, 5, 1.5)),)),
        EventAnnotation("e", PERIOD, 2 * PERIOD),
        EventAnnotation("moment", 6 * PERIOD),
    )
    scene = sound.scene(annotations=annotations)
    assert keeps(scene, ANNOTATION_TIME_RULES)


@pytest.mark.parametrize("times", [[0, 0, PERIOD], [PERIOD, 0, 2 * PERIOD]])
def test_keyframes_that_do_not_increase_are_found(sound, found, times):
    scene = sound.scene(annotations=(cuboid(), replace(cuboid(times), id="b")))
    [(path, message)] = found(scene, "annotation-times-increasing")
    assert path == "annotations[1].path.timestamps[1]"
    assert message.startswith(f"{times[1]} ns after {times[0]} ns")


def test_the_first_time_of_a_path_may_be_before_the_last_of_the_path_before(sound, found):
    scene = sound.scene(annotations=(cuboid([PERIOD, 2 * PERIOD]), replace(cuboid([0, PERIOD]), id="b")))
    assert found(scene, "annotation-times-increasing") == []


def test_an_empty_path_between_two_others_parts_them(sound, found):
    annotations = [replace(cuboid(times), id=k) for k, times in enumerate(([PERIOD], [], [0]))]
    scene = sound.scene(annotations=tuple(annotations))
    assert found(scene, "annotation-times-increasing") == []
    assert [path for path, _ in found(scene, "annotation-path-empty")] == ["annotations[1].path"]


def test_a_points_annotation_without_points_is_reported(sound, found):
    scene = sound.scene(annotations=(PointsAnnotation("hand", ()),))
    assert [path for path, _ in found(scene, "annotation-path-empty")] == ["annotations[0].paths"]


def test_sorting_takes_values_along_and_drops_rows_reported_twice(sound, fixed):
    rows = np.arange(36.0).reshape(4, 9)
    rows[3] = rows[0]
    path = CuboidPath(np.array([PERIOD, 0, 2 * PERIOD, PERIOD]), rows)
    attribute = AttributePath("state", ("b", "a"), np.array([PERIOD, 0]))
    projection = Projection("front", np.array([PERIOD, 0]), np.array([[1.0] * 4, [np.nan] * 4]), (True, None))
    scene = sound.scene(annotations=(CuboidAnnotation("c", path, attributes=(attribute,), projections=(projection,)),))
    [repaired] = fixed(scene, "annotation-times-increasing").annotations
    assert repaired.path.timestamps_ns.tolist() == [0, PERIOD, 2 * PERIOD]
    np.testing.assert_array_equal(repaired.path.values, rows[[1, 0, 2]])
    assert repaired.attributes[0].values == ("a", "b")
    assert repaired.projections[0].confirmed == (None, True)
    np.testing.assert_array_equal(repaired.projections[0].boxes[1], [1.0] * 4)


def test_sorting_takes_vertices_along(sound, fixed):
    outlines = (np.full((3, 2), 2.0), np.full((4, 2), 1.0))
    shape = ShapeAnnotation("s", ShapeType.POLYGON_2D, VertexPath(np.array([PERIOD, 0]), outlines), sensor_id="front")
    [repaired] = fixed(sound.scene(annotations=(shape,)), "annotation-times-increasing").annotations
    assert [len(vertices) for vertices in repaired.path.vertices] == [4, 3]


def test_two_different_rows_of_one_time_are_left_to_a_person(sound, fixed):
    scene = sound.scene(annotations=(cuboid([0, 0], np.arange(18.0).reshape(2, 9)),))
    assert fixed(scene, "annotation-times-increasing") is scene


def test_annotations_may_reach_one_sweep_beyond_the_sensors(sound, found):
    within, beyond = 6 * PERIOD, 6 * PERIOD + 1
    assert found(sound.scene(annotations=(cuboid([0, within]),)), "annotation-beyond-scene") == []
    scene = sound.scene(annotations=(cuboid([0, beyond]),))
    [(path, message)] = found(scene, "annotation-beyond-scene")
    assert path == "annotations[0].path.timestamps[1]"
    assert "after the scene ends" in message
    assert found(scene, "annotation-outside-scene") == []


def test_the_poses_of_corrections_may_lie_around_the_scene(sound, found):
    poses = Poses(np.array([-(10**9), 10**9]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
    scene = sound.scene(annotations=(LocalizationAdjustment("drift", poses),))
    assert found(scene, "annotation-beyond-scene") == []


def test_what_lies_outside_as_a_whole_by_more_than_a_second_is_found(sound, found):
    for times, outside in (([16 * PERIOD, 20 * PERIOD], False), ([16 * PERIOD + 1, 20 * PERIOD], True)):
        scene = sound.scene(annotations=(cuboid(times),))
        assert bool(found(scene, "annotation-outside-scene")) == outside
        assert bool(found(scene, "annotation-beyond-scene")) != outside


def test_a_path_from_far_before_to_far_after_the_scene_is_in_it(sound, found):
    scene = sound.scene(annotations=(cuboid([-90 * PERIOD, 90 * PERIOD]),))
    assert found(scene, "annotation-outside-scene") == []


def test_what_holds_always_may_lie_outside(sound, found):
    static = AttributePath("colour", ("red",), np.array([90 * PERIOD]), static=True)
    annotations = (cuboid([90 * PERIOD], stationary=True), replace(cuboid(attributes=(static,)), id="b"))
    scene = sound.scene(annotations=annotations)
    assert found(scene, "annotation-outside-scene") == []
    assert found(scene, "annotation-beyond-scene") == []


def test_events_outside_the_scene_and_of_negative_length_are_found(sound, found):
    events = (
        EventAnnotation("early", -19 * PERIOD, 2 * PERIOD),
        EventAnnotation("reaching in", -19 * PERIOD, 19 * PERIOD),
        EventAnnotation("backwards", PERIOD, -1),
    )
    scene = sound.scene(annotations=events)
    assert [path for path, _ in found(scene, "annotation-outside-scene")] == ["annotations[0].start"]
    assert [path for path, _ in found(scene, "annotation-duration")] == ["annotations[2].duration"]


def test_an_activation_of_negative_length_is_found(sound, found):
    scene = sound.scene(annotations=(cuboid(activations=(Activation("top", TIMES, (0, -1, 3)),)),))
    assert [path for path, _ in found(scene, "annotation-duration")] == ["annotations[0].activations[0].durations[1]"]


def test_a_projection_between_images_is_found(sound, found):
    times = np.array([0, PERIOD + PERIOD // 4, PERIOD + PERIOD // 4 + 1, 5 * PERIOD])
    scene = sound.scene(annotations=(cuboid(projections=(Projection("front", times),)),))
    assert [path for path, _ in found(scene, "projection-without-image")] == [
        "annotations[0].projections[0].timestamps[2]"
    ]
