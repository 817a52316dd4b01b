"""Rules about the times of points."""

import numpy as np
import pytest

from sceneloom.checks import validate
from sceneloom.scene import DataWarning, WarningKind

PERIOD, SECOND = 100_000_000, 1_000_000_000
RULES = ("point-times-clock", "point-times-frame", "point-times-equal")
WRAP_NS = 2**32 * 1000


def lidar_with(sound, shift, *, start_ns=20 * SECOND):
    """A lidar whose point times are changed by `shift(times, frame's timestamp)`."""

    def sweep(timestamp_ns):
        times = sound.sweep(timestamp_ns).points.timestamps_ns
        return sound.sweep(timestamp_ns, timestamps_ns=np.asarray(shift(times, timestamp_ns), np.int64))

    timestamps = start_ns + sound.times()
    return sound.lidar(timestamps, sweep=sweep, poses=sound.path(timestamps))


def test_a_sound_scene_keeps_all_of_them(sound, found):
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
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


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
def test_times_that_are_not_on_the_scenes_clock_are_found_and_their_frames_counted(
    sound, found, shift, start_ns, what
):
    scene = sound.scene(lidar_with(sound, shift, start_ns=start_ns))
    [(path, message)] = found(scene, "point-times-clock")
    assert path == "sensors[0].frames[0].points.timestamps"
    assert what in message
    assert validate(scene, rules=["point-times-clock"]).counts["warning"] == 6


def test_what_the_reader_of_scene_files_put_right_is_reported(sound, found):
    warning = DataWarning(
        kind=WarningKind.ASSUMED,
        code="relative-point-times",
        location="sensors[0].frames",
        message="relative",
    )
    assert found(sound.scene(warnings=(warning,)), "point-times-clock") == [("sensors[0].frames", "relative")]


def test_points_before_their_frame_are_counted(sound, found):
    hits = found(
        sound.scene(lidar_with(sound, lambda times, timestamp: times - PERIOD // 2)), "point-times-frame"
    )
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
