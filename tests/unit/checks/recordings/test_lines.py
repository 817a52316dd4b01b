"""Rules over the lines of a recording: order, rates, gaps and ends of streams, values, fixes, and settings."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.checks import validate
from sceneloom.checks.recordings.files import PRESENCE_RULES
from sceneloom.checks.recordings.samples import FIX_RULES, SAMPLE_RULES, mean_noise
from sceneloom.checks.recordings.times import STREAM_RULES
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

TABLES = (STREAM_RULES, SAMPLE_RULES, FIX_RULES, PRESENCE_RULES)


def test_a_sound_drive_keeps_every_rule_over_its_lines(check, drive):
    rules = [rule.id for table in TABLES for rule in table]
    assert len(rules) > 20
    check(drive, " ".join(rules))


def test_lines_out_of_order_and_times_that_come_twice_are_reported(check, drive):
    lines = drive.lines()
    late = drive.streams["gyroscope"][500]
    lines.remove(late)
    lines.insert(lines.index(drive.streams["gyroscope"][510]) + 1, late)
    words = "gyroscope at 6.000000 s comes after the one at 6.100000 s"
    [finding] = check(lines, "", ("lines-in-order", late, words))
    assert "up to 0.100000 s" in finding.message
    # between streams they are reported once
    lines = [line for stream in drive.streams.values() for line in stream]
    check(lines, "reading-repaired", ("lines-in-order", lines[1200], "", len(drive.streams) - 1))
    for stream in drive.streams.values():
        stream[10]["time"] = stream[9]["time"]
    twice = [finding.message.split(" at ")[0] for finding in check.findings(drive, "stream-times-unique")]
    assert sorted(twice) == sorted(["camera0", *(name for name in drive.streams if name != "frames")])


@pytest.mark.parametrize(("name", "lost", "fewer"), [("accelerometer", 40, 20), ("frames", 1, 0), ("barometer", 12, 9)])
def test_a_gap_is_reported_where_it_begins_and_shorter_breaks_are_none(check, drive, name, lost, fewer):
    kept = drive.streams[name][31 : 31 + lost - fewer]
    del drive.streams[name][31 : 31 + lost]
    check(drive, "frame-gaps stream-outages", ("stream-gaps", drive.streams[name][30], f"{lost} seem"))
    drive.streams[name][31:31] = kept
    check(drive, "stream-gaps")


def test_single_losses_slower_cameras_and_outages_of_satellites_are_no_gaps(check, drive):
    other = drive.copy()
    stream = drive.streams["gyroscope"]
    drive.streams["gyroscope"] = [line for k, line in enumerate(stream) if k not in {300, 301, 500, 700}]
    lost = ("samples-lost", stream[299], "in all, 4 seem missing at 3 locations")
    [finding] = check(drive, "stream-gaps stream-jitter", lost)
    assert finding.severity == "hint"
    frames = other.streams["frames"]
    other.streams["frames"] = [*frames[:70], *frames[70::2]]
    del other.streams["gps"][20:35]
    outage = "gps at 4.800000 s: 3.200000 s to the next, 0.200000 s usually; 15 seem"
    outage = ("stream-outages", other.streams["gps"][19], outage)
    check(other, "stream-gaps", ("stream-jitter", "camera0", ""), outage)


@pytest.mark.parametrize(
    ("name", "rule"), [("gyroscope", "stream-jitter"), ("frames", "stream-jitter"), ("gps", "stream-uneven")]
)
def test_uneven_times_are_reported_above_one_in_twenty(check, drive, name, rule):
    stream = drive.streams[name]
    period = stream[1]["time"] - stream[0]["time"]
    few = len(stream) // 50
    for line in stream[5 : 5 + 2 * few : 2]:  # two intervals each
        line["time"] += 0.3 * period
    check(drive, rule)
    for line in stream[-2 * few - 6 :: 2]:
        line["time"] += 0.3 * period
    check(drive, "", (rule, "camera0" if name == "frames" else name, "off the usual"))


@pytest.mark.parametrize(
    ("name", "every", "expected"),
    [
        ("accelerometer", 10, "10 Hz; expected 50 to 10000 Hz"),
        ("gyroscope", 3, "33.33 Hz; expected 50 to 10000 Hz"),
        ("magnetometer", 25, "0.8 Hz; expected 1 to 1000 Hz"),
        ("barometer", 25, "0.8 Hz; expected 1 to 1000 Hz"),
        ("groundTruth", 25, "0.8 Hz; expected 1 to 10000 Hz"),
        ("frames", 20, "0.5 Hz; expected 1 to 100 Hz"),
    ],
)
def test_rates_that_are_too_low_are_reported(check, drive, name, every, expected):
    drive.streams[name] = drive.streams[name][::every]
    assert [f.message for f in check.findings(drive, "stream-rate")] == [f"comes at {expected}"]


def test_rates_that_are_too_high_are_reported_and_milliseconds_recognised(check, drive):
    fast = drive.copy()
    for line in drive.lines():
        line["time"] *= 1000
    messages = [f.message for f in check.findings(drive, "stream-rate")]
    assert len(messages) > 4
    assert all("are the times milliseconds?" in message for message in messages)
    for line in fast.streams["gps"] + fast.streams["frames"]:
        line["time"] = 1.0 + (line["time"] - 1.0) / 30
    messages = [f.message for f in check.findings(fast, "stream-rate")]
    assert messages == ["comes at 300 Hz; expected 1 to 100 Hz", "comes at 150 Hz; expected 0 to 100 Hz"]


def test_streams_that_do_not_go_together_are_reported(check, drive):
    check(drive, "streams-together")
    apart, beyond, same, shifted = (drive.copy() for _ in range(4))
    apart.streams["frames"] = apart.streams["frames"][60:]
    apart.streams["gps"] = apart.streams["gps"][:30]
    check(
        apart,
        "",
        ("streams-together", "camera0", "starts at 7.004 s, 6.004 s later than others; expected within 5 s"),
        ("streams-together", "gps", "ends at 6.800 s, 6.150 s earlier than others; expected within 5 s"),
    )
    for name in ("accelerometer", "gyroscope"):
        beyond.streams[name] = beyond.streams[name][300:]
    [finding] = check.findings(beyond, "frames-far-from-imu")
    assert finding.message.startswith("camera0 at 1.003700 s is 2.996 s from the nearest sample of the gyroscope")
    assert finding.message.endswith("found up to 2.996 s in 29 of 120 images")  # of the first 3 s, but for 0.1 s
    for line in same.shifted("frames", -0.0037).streams["frames"]:
        line["time"] = round(line["time"], 9)
    [finding] = check.findings(same, "frames-at-imu-times")
    assert finding.message.startswith("100% of the images have the very time of a sample of the accelerometer")
    check(shifted.shifted("accelerometer", 0.01), "imu-clocks")
    check(drive.shifted("accelerometer", 0.02), "", ("imu-clocks", "accelerometer", "20.0 ms after"))


def test_a_recording_without_imu_or_calibration_gets_warnings(written, check, drive):
    rules = ["imu-there", "calibration-there"]
    del drive.streams["gyroscope"]
    assert [f.message for f in check.findings(drive, " ".join(rules))] == ["no gyroscope lines"]
    del drive.streams["frames"]
    folder = written(drive)
    (folder / "calibration.json").unlink()
    report = validate(folder, rules=rules)
    assert [(f.rule, f.severity) for f in report.findings] == [(rule, "warning") for rule in rules]
    assert (report.findings[1].path, report.passed) == ("calibration.json", True)


def test_a_file_of_lines_alone_is_known_by_its_name_and_needs_nothing_beside_it(tmp_path, drive):
    lines = [line["groundTruth"] | {"time": line["time"]} for line in drive.streams["groundTruth"]]
    lines[7]["time"] = lines[6]["time"]
    path = tmp_path / "vio.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines) + "{torn\n")
    assert [(f.rule, f.path) for f in validate(path).findings] == [
        ("broken-lines", "vio.jsonl: line 241"),
        ("stream-times-unique", "vio.jsonl: line 8"),
    ]


@pytest.mark.parametrize(
    ("name", "factor", "rule", "guess"),
    [
        ("accelerometer", 1 / 9.80665, "accelerometer-unit", "units of g"),
        ("accelerometer", 1000 / 9.80665, "accelerometer-unit", "thousandths of g"),
        ("accelerometer", 1000.0, "accelerometer-unit", "mm/s²"),
        ("accelerometer", 3.28084, "accelerometer-unit", "feet"),
        ("accelerometer", 0.02, "accelerometer-unit", "gravity taken off"),
        ("gyroscope", 57.2958, "gyroscope-unit", "degrees per second"),
        ("magnetometer", 1000.0, "magnetometer-unit", "nanotesla?"),
        ("magnetometer", 0.01, "magnetometer-unit", "gauss?"),
        ("magnetometer", 1e-6, "magnetometer-unit", "tesla?"),
        ("barometer", 100.0, "barometer-unit", "pascal?"),
        ("barometer", 0.1, "barometer-unit", "kilopascal?"),
        ("barometer", 0.001, "barometer-unit", "bar?"),
        ("imuTemperature", 0.1, "temperature-unit", "Celsius?"),
    ],
)
def test_values_in_another_unit_are_reported_with_a_guess(check, drive, name, factor, rule, guess):
    for line in drive.streams["gyroscope"][300:500]:
        line["sensor"]["values"][2] += 0.5
    rules = f"{rule} gyroscope-unit accelerometer-range accelerometer-noise gyroscope-range"
    check(drive, rules)
    where = name if name in {"accelerometer", "gyroscope"} else None
    check(drive.scaled(name, factor), rules, (rule, where, guess))


def test_a_blow_and_a_torn_yaw_rate_are_reported_with_their_lines_and_are_no_units(check, drive):
    drive.scaled("accelerometer", 25.0, slice(400, 402))
    drive.streams["gyroscope"][77]["sensor"]["values"][0] = 35.0
    blow = drive.streams["accelerometer"][400], "accelerometer at 5.000000 s is 24", 2
    torn = drive.streams["gyroscope"][77], "gyroscope at 1.770000 s is 35 rad/s long"
    units = "accelerometer-unit gyroscope-unit"
    check(drive, units, ("accelerometer-range", *blow), ("gyroscope-range", *torn))


def test_noise_above_the_limit_is_reported_and_agrees_with_the_vendors_kind_of_filter(check, drive):
    from scipy.signal import butter, filtfilt

    # of white noise a filter that cuts at a quarter of the rate leaves sqrt(1/2), of which the mean is 0.8
    for deviation, loud in ((2.0, []), (5.0, ["y"])):
        noisy = drive.copy()
        noise = deviation * np.random.default_rng(1).standard_normal(len(noisy.streams["accelerometer"]))
        for line, extra in zip(noisy.streams["accelerometer"], noise.tolist(), strict=True):
            x, y, z = line["sensor"]["values"]
            line["sensor"]["values"] = [x, y + extra, z]
        found = check.findings(noisy, "accelerometer-noise")
        assert [finding.message.split(" changes")[0] for finding in found] == loud
    noise = np.random.default_rng(1).standard_normal((20_000, 3))
    b, a = butter(3, 0.5, btype="high")
    expected = np.abs(filtfilt(b, a, noise, axis=0)).mean(axis=0)
    np.testing.assert_allclose(mean_noise(noise), expected, rtol=0.05)  # the flanks differ


@pytest.mark.parametrize(
    ("name", "every", "is_reported"),
    [
        ("accelerometer", 10, True),
        ("accelerometer", 200, False),
        ("gyroscope", 10, True),
        ("magnetometer", 10, True),
        ("barometer", 10, False),
        ("barometer", 3, True),
        ("gps", 10, True),
        ("imuTemperature", 2, False),
    ],
)
def test_samples_that_repeat_the_one_before_are_reported(check, drive, name, every, is_reported):
    stream, key = drive.streams[name], "gps" if name == "gps" else "sensor"
    for before, line in zip(stream[::every], stream[1::every], strict=False):
        line[key] = before[key]
    words = f"{name} at {stream[1]['time']:.6f} s has the very values"
    check(drive, "values-repeated", *[("values-repeated", None, words)] * is_reported)


def test_a_location_held_for_a_while_and_lines_of_barometers_and_further_receivers_are_judged_too(check, drive):
    pressure = {"barometer": {"pressureHectopascals": 101_325.0}, "time": 3.0}
    fix = {"rtkgps": {"latitude": 0.0, "longitude": 0.0, "altitude": 1.0, "accuracy": 0.02}, "time": 4.0}
    lines = sorted([*drive.lines(), pressure, fix], key=lambda line: line["time"])
    receiver = ("fixes-somewhere", fix, "rtkgps at 4.000000 s")
    check(lines, "", ("barometer-unit", pressure, ""), receiver)
    for k, line in enumerate(drive.streams["gps"][20:40]):
        line["gps"] = {**drive.streams["gps"][20]["gps"], "accuracy": 0.5 + 0.1 * k}
    check(drive, "", ("values-repeated", None, "gps at 5.2"))


FIXES = "fixes-on-earth fixes-somewhere fixes-altitude fixes-accuracy fixes-jump"


def change(drive, rows, **fields):
    for line in drive.streams["gps"][rows]:
        line["gps"] = {**line["gps"], **fields}


def test_fixes_that_are_off_the_earth_or_at_zero_are_reported(check, drive):
    change(drive, slice(0, 3), latitude=0.0, longitude=0.0)
    check(drive, FIXES, ("fixes-somewhere", drive.streams["gps"][0], "", 3))
    change(drive, slice(None), latitude=116.39, longitude=39.9)
    [finding] = check(drive, FIXES, ("fixes-on-earth", None, "116.39, 39.9", 60))
    assert finding.severity == "error"
    assert "are latitude and longitude exchanged?" in finding.message
    change(drive, slice(None), latitude=60.17 / 57.29578, longitude=0.4353)
    assert "are these radians?" in check.findings(drive, FIXES)[0].message


@pytest.mark.parametrize(
    ("rows", "field", "value", "rule", "words"),
    [
        *((slice(None), "altitude", value, "fixes-altitude", "") for value in (25_000_000.0, -900.0)),
        (slice(None), "altitude", 140_000.0, "fixes-altitude", "millimetres?"),
        *(
            (slice(10, 12), name, value, "fixes-accuracy", f"{name} {value:g}")
            for name in ("accuracy", "verticalAccuracy")
            for value in (0.0, -1.0, 5000.0)
        ),
    ],
)
def test_absurd_altitudes_and_accuracies_are_reported(check, drive, rows, field, value, rule, words):
    change(drive, rows, **{field: value})
    [finding] = check(drive, FIXES, (rule, None, words, 2 if rows.start else 60))
    assert words or "millimetres?" not in finding.message


@pytest.mark.parametrize("metres", [10.0, 100.0, 1000.0])
def test_a_single_fix_that_is_off_is_reported_once_with_its_line(check, drive, metres):
    wrong = drive.streams["gps"][25]
    wrong["gps"]["longitude"] += metres / 55_500
    [finding] = check(drive, FIXES, ("fixes-jump", wrong, "gps at 6.000000 s lies "))
    off = float(finding.message.split("lies ")[1].split(" m")[0])
    assert off == pytest.approx(metres, rel=0.2)  # of the noise of its neighbours


def test_what_fixes_may_do_is_no_jump_and_a_track_that_moves_for_good_is(check, drive):
    fixes = drive.streams["gps"]
    fixes[25]["gps"]["longitude"] += 20 / 55_500
    fixes[25]["gps"]["accuracy"] = 12.0
    check(drive, FIXES)
    fixes[25]["gps"]["longitude"] -= 20 / 55_500
    for line in fixes:
        del line["gps"]["accuracy"]
    check(drive, FIXES)
    for line in fixes[25:]:
        line["gps"]["longitude"] += 200 / 55_500
    check(drive, FIXES, ("fixes-jump", None, ""))
    for k, line in enumerate(fixes):  # as hard as tyres allow
        line["gps"] |= {"longitude": 24.94 + 0.5 * 8.0 * (k / 5) ** 2 / 55_500, "accuracy": 0.5}
    check(drive, FIXES)


@pytest.mark.parametrize(("exchanged", "down"), [(False, False), (True, False), (False, True)])
def test_a_trajectory_that_rotates_to_the_other_side_is_reported(check, drive, exchanged, down):
    """It winds 50 degrees to the left and to the right, at 10 m/s."""
    check(drive, "fixes-mirrored")  # it is straight
    for line in drive.streams["gyroscope"]:
        line["sensor"]["values"] = [0.0, 0.0, 0.87 * math.cos(line["time"])]
    east = north = 0.0
    for line in drive.streams["gps"]:
        course = 0.87 * math.sin(line["time"])
        east, north = east + 2.0 * math.cos(course), north + 2.0 * math.sin(course)
        latitude, longitude = (48.0 + north / 111_200, 11.0 + east / 74_600)[:: -1 if exchanged else 1]
        line["gps"].update(latitude=latitude, longitude=longitude, accuracy=0.1)
    for line in drive.streams["accelerometer"] if down else []:
        line["sensor"]["values"] = [-value for value in line["sensor"]["values"]]
    mirrored = ("fixes-mirrored", "gps", "are latitude and longitude exchanged")
    check(drive, "fixes-mirrored", *[mirrored] * (exchanged or down))


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


def make(seed=1, **options):
    """120 frames of 10 Hz: streams that end 5 s apart can be reported."""
    return simulate_street(seed, frames=120, lidar=LidarSpec(beams=2, steps=16), cameras=(), **options)


def report_of(scene, folder):
    """Of what gives numbers only: sweeps take their time to be measured, and no rule here looks at them."""
    sensors = tuple(sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor | GnssSensor))
    sceneloom.write(replace(scene, sensors=sensors, annotations=()), folder)
    return validate(folder, ignore=["calibration-there"])  # there is nothing to calibrate


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
    report = report_of(make(4, **options).scene, tmp_path / "drive")
    assert [finding for finding in report.findings if finding.severity != "hint"] == []


@pytest.fixture(scope="module")
def simulated():
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
def test_what_is_injected_is_found(tmp_path, simulated, sensor, wrong, rule):
    report = report_of(inject(simulated, Faults({sensor: SensorFaults(**wrong)})).scene, tmp_path / "drive")
    assert rule in {finding.rule for finding in report.findings}
    assert report.passed
