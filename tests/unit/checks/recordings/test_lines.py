"""Rules about `vio_config.yaml`, and simulated drives in which no rule over lines finds anything."""

import json
from dataclasses import replace

import pytest

import sceneloom
from sceneloom.checks import validate
from sceneloom.scene import GnssSensor, ImuSensor
from sceneloom.simulate import (
    Faults,
    GnssSpec,
    ImuSpec,
    LidarSpec,
    PathSpec,
    SensorFaults,
    Stop,
    inject,
    simulate_street,
)

RULES = ("config-keys-known", "config-keys-unique", "config-lines-settings")


def findings(folder, config):
    folder.mkdir()
    lines = [{"sensor": {"type": "gyroscope", "values": [0.0, 0.1, 0.01 * k]}, "time": 0.01 * k} for k in range(5)]
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if config is not None:
        (folder / "vio_config.yaml").write_text(config)
    report = validate(folder, rules=RULES)
    assert report.passed  # settings are only ever doubtful
    return [(f.rule, str(f.severity), f.path, f.message) for f in report.findings]


@pytest.mark.parametrize("config", [None, "", "useSlam: True\n# parameterSets: [x]\nparameterSets:\n  - live\n"])
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
        ("config-keys-unique", "warning", "vio_config.yaml: line 3", "'useSlam' stands in lines 1, 3; expected once")
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


SECOND = 1_000_000_000
FRAMES = 120  # of 10 Hz: streams that end 5 s apart can be reported


def make(seed=1, **options):
    return simulate_street(seed, frames=FRAMES, lidar=LidarSpec(beams=2, steps=16), cameras=(), **options)


def written(scene, folder):
    """Only what gives numbers: sweeps take their time to be measured, and no rule here looks at them."""
    sensors = tuple(sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor | GnssSensor))
    sceneloom.write(replace(scene, sensors=sensors, annotations=()), folder)
    return folder


SOUND = {
    "stop": {"path": PathSpec(stops=(Stop(5.0, 4.0),))},
    "stationary": {"path": PathSpec(stops=(Stop(0.0, 40.0),))},
    "fast": {"path": PathSpec(speeds=(20.0, 40.0), yaw_rate=0.3)},
    "rotations": {"path": PathSpec(speeds=(2.0, 6.0), yaw_rate=1.0)},
    "precise fixes": {"gnss": GnssSpec(rate_hz=20.0, horizontal_sigma=0.02, vertical_sigma=0.04)},
    "poor fixes": {"gnss": GnssSpec(rate_hz=5.0, horizontal_sigma=5.0, vertical_sigma=8.0)},
    "noisy and quick IMU": {"imu": ImuSpec(rate_hz=500.0, accelerometer_noise=0.05, gyroscope_noise=0.005)},
}


@pytest.mark.parametrize("case", SOUND)
@pytest.mark.few(3)
def test_nothing_is_found_in_a_sound_drive(tmp_path, case):
    folder = written(make(len(case), **SOUND[case]).scene, tmp_path / "drive")
    report = validate(folder, ignore=["calibration-there"])  # there is nothing to calibrate
    assert [finding for finding in report.findings if finding.severity != "hint"] == []


@pytest.fixture(scope="module")
def drive():
    """One drive for all that is injected."""
    return make()


def span(first_s, last_s):
    return ((round((1 + first_s) * SECOND), round((1 + last_s) * SECOND)),)


INJECTED = {
    "an IMU that drops out": ("imu", {"drop_outs": span(4, 5)}, "stream-gaps"),
    "an IMU that loses samples": ("imu", {"lost_share": 0.2}, "stream-jitter"),
    "an IMU that hangs": ("imu", {"stuck": span(4, 5)}, "values-repeated"),
    "an IMU that ends early": ("imu", {"drop_outs": span(5, 60)}, "streams-together"),
    "an IMU of another clock": ("imu", {"time_offset_ns": 7 * SECOND}, "streams-together"),
    "an outage of the satellites": ("gnss", {"drop_outs": span(4, 7)}, "stream-outages"),
    "a receiver that holds a location": ("gnss", {"stuck": span(4, 6)}, "values-repeated"),
}


@pytest.mark.parametrize("case", INJECTED)
def test_what_is_injected_is_found(tmp_path, drive, case):
    sensor, wrong, rule = INJECTED[case]
    faulty = inject(drive, Faults({sensor: SensorFaults(**wrong)}))
    report = validate(written(faulty.scene, tmp_path / "drive"))
    assert rule in {finding.rule for finding in report.findings}
    assert report.passed
