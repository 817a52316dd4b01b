"""Rules about the sizes and the motion of cuboids."""

import numpy as np
import pytest

from sceneloom.scene import CuboidAnnotation, CuboidPath

PERIOD = 100_000_000
TIMES = np.arange(5, dtype=np.int64) * PERIOD
RULES = (
    "cuboid-not-finite",
    "cuboid-negative-size",
    "cuboid-no-size",
    "cuboid-size-absurd",
    "cuboid-size-changes",
    "cuboid-jump",
    "cuboid-rotation",
    "cuboid-stationary-moves",
)


def rows(count=5):
    """A car at 15 m/s that rotations slowly."""
    values = np.tile([4.0, 2, 1.5, 0, 0, 0, 0, 0, 170], (count, 1))
    values[:, 3] = 1.5 * np.arange(count)
    values[:, 8] += 4.0 * np.arange(count)
    return values


def scene_of(sound, values, times=TIMES, **fields):
    """The cuboid, between two others that are sound."""
    middle = CuboidAnnotation("middle", CuboidPath(times, values), **fields)
    around = [
        CuboidAnnotation(k, CuboidPath(TIMES, rows() + np.array([0, 0, 0, 500.0 * k, 0, 0, 0, 0, 90 * k])))
        for k in (1, 2)
    ]
    return sound.scene(annotations=(around[0], middle, around[1]))


def changed(row, column, value):
    values = rows()
    values[row, column] = value
    return values


def test_a_sound_scene_keeps_all_of_them(sound, found):
    assert [found(scene_of(sound, rows()), rule) for rule in RULES] == [[]] * len(RULES)


@pytest.mark.parametrize(
    ("rule", "column", "value", "near"),
    [
        ("cuboid-not-finite", 8, np.nan, 1e300),
        ("cuboid-not-finite", 3, np.inf, 0.0),
        ("cuboid-negative-size", 0, -4.0, 4.0),
        ("cuboid-no-size", 2, 0.0, 1e-9),
        ("cuboid-size-absurd", 0, 100.1, 100.0),
        ("cuboid-size-absurd", 1, 0.009, 0.01),
        ("cuboid-size-changes", 0, 8.1, 7.9),
        ("cuboid-size-changes", 1, 0.9, 1.1),
        ("cuboid-jump", 4, 2.2, 2.0),
        ("cuboid-rotation", 8, 174.0 + 101, 174.0 + 99),
    ],
)
def test_what_is_beyond_the_limit_is_found_and_what_is_within_is_not(sound, found, rule, column, value, near):
    [(path, _), *_] = found(scene_of(sound, changed(2, column, value)), rule)
    assert path == "annotations[1].path.values[2]"
    assert found(scene_of(sound, changed(2, column, near)), rule) == []


def test_small_things_may_double(sound, found):
    values = rows()
    values[:, 2], values[2:, 2] = 0.2, 0.6
    assert found(scene_of(sound, values), "cuboid-size-changes") == []


def test_a_keyframe_off_the_trajectory_is_known_by_how_far(sound, found):
    values = rows()
    values[2, 4] = 6.0
    [(path, message)] = found(scene_of(sound, values), "cuboid-jump")
    assert path == "annotations[1].path.values[2]"
    assert message == "6.0 m off the trajectory between the keyframes before and after"


def test_a_keyframe_out_of_reach_is_known_by_its_distance_and_time(sound, found):
    values = rows(2)
    values[1, 3] = 12.1
    [(path, message)] = found(scene_of(sound, values, TIMES[:2]), "cuboid-jump")
    assert (path, message) == ("annotations[1].path.values[1]", "12.1 m from the keyframe before, in 0.100 s")
    values[1, 3] = 11.9
    assert found(scene_of(sound, values, TIMES[:2]), "cuboid-jump") == []


def test_keyframes_far_apart_in_time_may_lie_off_a_straight_trajectory(sound, found):
    values = changed(2, 4, 10.0)
    assert found(scene_of(sound, values, TIMES * 10), "cuboid-jump") == []


def test_rotating_through_a_full_circle_of_numbers_is_no_rotation(sound, found):
    values = rows()
    values[:, 8] = [170, 175, -180, -175, 530]
    assert found(scene_of(sound, values), "cuboid-rotation") == []


def test_rotating_slowly_is_no_flip(sound, found):
    assert found(scene_of(sound, changed(2, 8, 350.0), TIMES * 7), "cuboid-rotation") == []


def test_radians_are_rotated_as_radians(sound, found):
    values = rows()
    values[:, 8] = [3.0, 3.1, -3.1, -3.0, 0.0]
    scene = scene_of(sound, values)
    stated = {"sceneloom": {"euler_unit": "radians", "euler_order": "xyz"}}
    [(path, message)] = found(
        type(scene)(scene.sensors, scene.annotations[1:2], metadata=stated), "cuboid-rotation"
    )
    assert path == "annotations[0].path.values[4]"
    assert message.startswith("rotated by 172°")


def test_a_stationary_object_that_moves_is_found(sound, found):
    assert len(found(scene_of(sound, rows(), stationary=True), "cuboid-stationary-moves")) == 1
    still = rows()
    still[:, 3:6] = np.linspace(0, 0.5, 5)[:, None]
    assert found(scene_of(sound, still, stationary=True), "cuboid-stationary-moves") == []


def test_negative_lengths_become_positive_and_nothing_else_changes(sound, fixed):
    values = rows()
    values[1, :3] *= [-1, 1, -1]
    scene = scene_of(sound, values)
    repaired = fixed(scene, "cuboid-negative-size")
    np.testing.assert_array_equal(repaired.annotations[1].path.values, rows())
    assert repaired.annotations[0] is scene.annotations[0]


def test_a_path_without_keyframes_is_no_trouble(sound, found):
    scene = scene_of(sound, np.zeros((0, 9)), TIMES[:0])
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)
