"""Rules about `vio_config.yaml`."""

import json

import pytest

from sceneloom.checks import validate

RULES = ("config-keys-known", "config-keys-unique", "config-lines-settings")


def findings(folder, config):
    folder.mkdir()
    lines = [
        {"sensor": {"type": "gyroscope", "values": [0.0, 0.1, 0.01 * k]}, "time": 0.01 * k} for k in range(5)
    ]
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if config is not None:
        (folder / "vio_config.yaml").write_text(config)
    report = validate(folder, rules=RULES)
    assert report.passed  # settings are only ever doubtful
    return [(f.rule, str(f.severity), f.path, f.message) for f in report.findings]


@pytest.mark.parametrize(
    "config", [None, "", "useSlam: True\n# parameterSets: [x]\nparameterSets:\n  - live\n"]
)
def test_sound_settings_are_not_reported(tmp_path, config):
    assert findings(tmp_path / "drive", config) == []


def test_unknown_settings_are_reported_with_their_line_and_the_nearest_name(tmp_path):
    assert findings(tmp_path / "drive", "useSlam: True\nuseStero: False\nqqqq: 1\n") == [
        (
            "config-keys-known",
            "warning",
            "vio_config.yaml: line 2",
            "'useStero' is not publicly known; is 'useStereo' meant?",
        ),
        ("config-keys-known", "warning", "vio_config.yaml: line 3", "'qqqq' is not publicly known"),
    ]


def test_settings_that_stand_there_twice_are_reported(tmp_path):
    found = findings(tmp_path / "drive", "useSlam: True\nvisualR: 0.01\nuseSlam: False\n")
    assert found == [
        (
            "config-keys-unique",
            "warning",
            "vio_config.yaml: line 3",
            "'useSlam' stands in lines 1, 3; expected once",
        )
    ]


def test_lines_that_are_no_setting_are_reported(tmp_path):
    found = findings(tmp_path / "drive", "useSlam:True\n")
    assert found == [
        (
            "config-lines-settings",
            "warning",
            "vio_config.yaml: line 1",
            "'useSlam:True'; expected a setting, `key: value`",
        )
    ]
