"""Rules about attributes."""

import numpy as np
import pytest

from sceneloom.scene import AttributePath, ObjectAnnotation

TIMES = np.arange(2, dtype=np.int64) * 100_000_000
RULES = (
    "attribute-value-type",
    "attribute-kinds-mixed",
    "attribute-static-changes",
    "attribute-static-repeats",
    "attribute-times",
)


def holder(*attributes):
    return ObjectAnnotation("o", attributes=attributes)


def test_a_sound_scene_keeps_all_of_them(sound, found):
    attributes = (
        AttributePath("colour", ("red",), static=True),
        AttributePath("state", ("parked", "moving"), TIMES),
        AttributePath("speed", (1, 2.5), TIMES),
        AttributePath("lights", (("left", "brake"), ()), TIMES),
    )
    scene = sound.scene(annotations=(holder(*attributes),), attributes=attributes)
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


@pytest.mark.parametrize("value", [True, None, {"a": 1}, ("a", 1)])
def test_values_that_the_format_does_not_have_are_found(sound, found, value):
    attribute = AttributePath("state", ("parked", value), TIMES)
    scene = sound.scene(annotations=(holder(attribute),), attributes=(attribute,))
    assert [path for path, _ in found(scene, "attribute-value-type")] == [
        "attributes[0].values[1]",
        "annotations[0].attributes[0].values[1]",
    ]


def test_text_and_numbers_alternately_are_reported(sound, found):
    scene = sound.scene(annotations=(holder(AttributePath("lane", (1, "2"), TIMES)),))
    assert [message for _, message in found(scene, "attribute-kinds-mixed")] == [
        "'lane' is a number and text alternately"
    ]


def test_static_values_that_differ_are_found_and_equal_ones_reported_once(sound, found, fixed):
    changing = AttributePath("colour", ("red", "blue"), TIMES, static=True)
    repeated = AttributePath("make", ("vw", "vw"), TIMES, static=True)
    scene = sound.scene(annotations=(holder(changing, repeated),))
    assert [path for path, _ in found(scene, "attribute-static-changes")] == [
        "annotations[0].attributes[0].values[1]"
    ]
    assert [path for path, _ in found(scene, "attribute-static-repeats")] == ["annotations[0].attributes[1]"]
    [repaired] = fixed(scene, "attribute-static-repeats").annotations
    assert repaired.attributes[0] is changing
    assert (repaired.attributes[1].values, repaired.attributes[1].timestamps_ns.tolist()) == (("vw",), [0])


def test_values_that_change_need_times(sound, found):
    unequal = AttributePath("state", ("parked",), TIMES)
    scene = sound.scene(annotations=(holder(AttributePath("state", ("parked", "moving")), unequal),))
    assert found(scene, "attribute-times") == [
        ("annotations[0].attributes[0]", "'state' has 2 values and no timestamps"),
        ("annotations[0].attributes[1]", "'state' has 2 timestamps and 1 values"),
    ]
