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


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (None, []),
        ("", []),
        ("useSlam: True\n# parameterSets: [x]\nparameterSets:\n  - live\n", []),
        (
            "useSlam: True\nuseStero: False\nqqqq: 1\n",
            [
                ("config-keys-known", 2, "'useStero' is not publicly known; is 'useStereo' meant?"),
                ("config-keys-known", 3, "'qqqq' is not publicly known"),
            ],
        ),
        (
            "useSlam: True\nvisualR: 0.01\nuseSlam: False\n",
            [("config-keys-unique", 3, "'useSlam' stands in lines 1, 3; expected once")],
        ),
        ("useSlam:True\n", [("config-lines-settings", 1, "'useSlam:True'; expected a setting, `key: value`")]),
    ],
)
def test_doubtful_settings_are_reported_with_their_line(tmp_path, config, expected):
    lines = [{"sensor": {"type": "gyroscope", "values": [0.0, 0.1, 0.01 * k]}, "time": 0.01 * k} for k in range(5)]
    (tmp_path / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if config is not None:
        (tmp_path / "vio_config.yaml").write_text(config)
    report = validate(tmp_path, rules=("config-keys-known", "config-keys-unique", "config-lines-settings"))
    assert report.passed
    assert [(f.rule, str(f.severity), f.path, f.message) for f in report.findings] == [
        (rule, "warning", f"vio_config.yaml: line {line}", message) for rule, line, message in expected
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


@pytest.mark.parametrize(
    "options",
    [
        {"path": PathSpec(stops=(Stop(5.0, 4.0),))},
        {"path": PathSpec(stops=(Stop(0.0, 40.0),))},
        {"path": PathSpec(speeds=(20.0, 40.0), yaw_rate=0.3)},
        {"path": PathSpec(speeds=(2.0, 6.0), yaw_rate=1.0)},
        {"gnss": GnssSpec(rate_hz=20.0, horizontal_sigma=0.02, vertical_sigma=0.04)},
        {"gnss": GnssSpec(rate_hz=5.0, horizontal_sigma=5.0, vertical_sigma=8.0)},
        {"imu": ImuSpec(rate_hz=500.0, accelerometer_noise=0.05, gyroscope_noise=0.005)},
    ],
)
@pytest.mark.few(3)
def test_nothing_is_found_in_a_sound_drive(tmp_path, options):
    folder = written(make(4, **options).scene, tmp_path / "drive")
    report = validate(folder, ignore=["calibration-there"])  # there is nothing to calibrate
    assert [finding for finding in report.findings if finding.severity != "hint"] == []


@pytest.fixture(scope="module")
def drive():
    return make()


def span(first_s, last_s):
    return ((round((1 + first_s) * SECOND), round((1 + last_s) * SECOND)),)


@pytest.mark.parametrize(
    ("sensor", "wrong", "rule"),
    [
        ("imu", {"drop_outs": span(4, 5)}, "stream-gaps"),
        ("imu", {"lost_share": 0.2}, "stream-jitter"),
        ("imu", {"stuck": span(4, 5)}, "values-repeated"),
        ("imu", {"drop_outs": span(5, 60)}, "streams-together"),
        ("imu", {"time_offset_ns": 7 * SECOND}, "streams-together"),
        ("gnss", {"drop_outs": span(4, 7)}, "stream-outages"),
        ("gnss", {"stuck": span(4, 6)}, "values-repeated"),
    ],
)
def test_what_is_injected_is_found(tmp_path, drive, sensor, wrong, rule):
    faulty = inject(drive, Faults({sensor: SensorFaults(**wrong)}))
    report = validate(written(faulty.scene, tmp_path / "drive"))
    assert rule in {finding.rule for finding in report.findings}
    assert report.passed
