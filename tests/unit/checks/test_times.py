"""Rules about the times of frames and of the scene's clock."""

from io import BytesIO

import numpy as np
import pytest

from sceneloom.scene import VideoContent

PERIOD, SECOND = 100_000_000, 1_000_000_000

RULES = (
    "frame-times-increasing",
    "video-times-increasing",
    "frame-times-unique",
    "frame-rate",
    "frame-doubled",
    "frame-gaps",
    "frame-jitter",
    "video-fps",
)


def test_a_sound_scene_keeps_all_of_them(sound, found):
    scene = sound.scene(sound.lidar(), sound.camera(fps=10.0), sound.odometry())
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


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
    assert [path for path, _ in found(sound.scene(sound.lidar(times)), "frame-doubled")] == [
        "sensors[0].frames[4]"
    ]


def test_uneven_intervals_are_found_and_small_jitter_is_not(sound, found):
    rng = np.random.default_rng(1)
    even = np.arange(40) * PERIOD
    shifts = rng.uniform(-0.3, 0.3, 40) * PERIOD
    uneven = (even + shifts).astype(np.int64)
    assert [path for path, _ in found(sound.scene(sound.lidar(uneven)), "frame-jitter")] == [
        "sensors[0].frames"
    ]
    nearly = (even + shifts / 20).astype(np.int64)
    assert found(sound.scene(sound.lidar(nearly)), "frame-jitter") == []


@pytest.mark.parametrize(("fps", "wrong"), [(10.0, False), (10.4, False), (30.0, True), (5.0, True)])
def test_fps_is_compared_with_the_timestamps(sound, found, fps, wrong):
    assert bool(found(sound.scene(sound.camera(fps=fps)), "video-fps")) is wrong


def epoch_lidar(sound, start_ns):
    return sound.lidar(start_ns + sound.times(), poses=sound.path(start_ns + sound.times()))


@pytest.mark.parametrize(
    ("start_ns", "rule"),
    [(1_700_000_000 * SECOND, "epoch-times"), (5_000 * SECOND, "late-start")],
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
