"""Settings of the vendor's software: which lines are one, which names are known."""

import pytest

from sceneloom.formats.recording.vio_config import KNOWN_KEYS, read_vio_config, repeated_keys, similar_key
from sceneloom.formats.recording.writer import unknown_keys

# set: wrapper-base of the vendor's ROS 2 node, with a comment, a list in each form and a quoted text
TEXT = """\
# set: wrapper-base
---
trackChiTestOutlierR: 3
useSlam: True   # find loops
parameterSets: ['wrapper-base', "oak-d"]
imuToCameraMatrix:
  - 1.0
  - 0.0
stereoCameraTranslation:
- 0.1
- 0.0
"ffmpegVideoCodec": "libx264 -crf 15 # fast"

visualR:0.01
"""


def test_settings_are_read_with_their_lines():
    config = read_vio_config(TEXT)
    assert [(s.key, s.value, s.line) for s in config.settings] == [
        ("trackChiTestOutlierR", "3", 3),
        ("useSlam", "True", 4),
        ("parameterSets", "['wrapper-base', \"oak-d\"]", 5),
        ("imuToCameraMatrix", "", 6),
        ("stereoCameraTranslation", "", 9),
        ("ffmpegVideoCodec", '"libx264 -crf 15 # fast"', 12),
    ]
    # YAML takes a colon without a blank for a part of a text, so this is no setting
    assert dict(config.strange) == {14: "visualR:0.01"}


@pytest.mark.parametrize(
    ("text", "unknown"),
    [
        (TEXT, []),
        ("", []),
        ("useSlamm: true\n", ["useSlamm"]),
        ("UseSlam: true\nuseStereo: no\nsomething else: 1\n", ["UseSlam", "something else"]),
        ("odometry:\n  visualR: 0.1\n", ["odometry"]),
    ],
)
def test_unknown_settings_are_reported_in_their_order(text, unknown):
    assert unknown_keys(text) == unknown


def test_the_nearest_known_name_is_offered_and_settings_that_stand_there_twice_are_reported():
    assert len(KNOWN_KEYS) > 250
    assert [similar_key(key) for key in ("UseSlam", "maxKeypoint", "colour")] == ["useSlam", "maxKeypoints", None]
    assert repeated_keys("useSlam: true\nvisualR: 1\nuseSlam: false\n") == ["useSlam"]
    assert repeated_keys(TEXT) == []


@pytest.mark.parametrize("text", ["\x00: 1", "{", "[1, 2", "- a\n- b", "a: b: c", "\ufeffuseSlam: 1", "'a: 1", "#"])
def test_any_text_is_looked_through(text):
    config = read_vio_config(text)
    assert len(config.settings) + len(config.strange) <= len(text.splitlines())
