"""Settings of the vendor's software: which lines are one, which names are known."""

from sceneloom.formats.recording.vio_config import KNOWN_KEYS, read_vio_config, similar_key
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


def test_known_names_are_told_from_others():
    assert len(KNOWN_KEYS) > 250
    assert [unknown_keys(text) for text in (TEXT, "", "odometry:\n  visualR: 0.1\n")] == [[], [], ["odometry"]]
    assert unknown_keys("UseSlam: true\nuseStereo: no\nsomething else: 1\n") == ["UseSlam", "something else"]
    assert [similar_key(key) for key in ("UseSlam", "maxKeypoint", "colour")] == ["useSlam", "maxKeypoints", None]
