"""Rules about values of the IMU, other sensors and fixes."""

import math

import numpy as np
import pytest

from sceneloom.checks import validate


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
def test_values_in_another_unit_are_reported_with_a_guess(written, drive, name, factor, rule, guess):
    for line in drive.streams["gyroscope"][300:500]:
        line["sensor"]["values"][2] += 0.5
    ranges = ["accelerometer-range", "accelerometer-noise", "gyroscope-range"]
    rules = [rule, "gyroscope-unit", *ranges] if rule != "gyroscope-unit" else [rule, *ranges]
    assert validate(written(drive), rules=rules).findings == ()
    [finding] = validate(written(drive.scaled(name, factor)), rules=rules).findings
    assert finding.rule == rule
    assert guess in finding.message
    if name in {"accelerometer", "gyroscope"}:
        assert finding.path == f"data.jsonl: {name}"


def test_a_blow_and_a_torn_yaw_rate_are_reported_with_their_lines_and_are_no_units(written, drive, line_of):
    drive.scaled("accelerometer", 25.0, slice(400, 402))
    drive.streams["gyroscope"][77]["sensor"]["values"][0] = 35.0
    folder = written(drive)
    rules = ["accelerometer-unit", "accelerometer-range", "gyroscope-range", "gyroscope-unit"]
    blow, torn = validate(folder, rules=rules).findings
    assert (blow.rule, blow.count) == ("accelerometer-range", 2)
    assert blow.path == line_of(folder, drive.streams["accelerometer"][400])
    assert blow.message.startswith("accelerometer at 5.000000 s is 24")
    assert (torn.rule, torn.path) == ("gyroscope-range", line_of(folder, drive.streams["gyroscope"][77]))
    assert torn.message.startswith("gyroscope at 1.770000 s is 35 rad/s long")


@pytest.mark.parametrize(("deviation", "is_loud"), [(2.0, False), (5.0, True)])
def test_noise_above_the_limit_is_reported(reported, drive, deviation, is_loud):
    # of white noise a filter that cuts at a quarter of the rate leaves sqrt(1/2), of which the mean is 0.8
    noise = deviation * np.random.default_rng(1).standard_normal(len(drive.streams["accelerometer"]))
    for line, extra in zip(drive.streams["accelerometer"], noise.tolist(), strict=True):
        x, y, z = line["sensor"]["values"]
        line["sensor"]["values"] = [x, y + extra, z]
    messages = [message for _, message in reported(drive, "accelerometer-noise")]
    assert [message.split(" changes")[0] for message in messages] == (["y"] if is_loud else [])


def test_noise_agrees_with_the_vendors_kind_of_filter():
    from scipy.signal import butter, filtfilt

    from sceneloom.checks.recordings.samples import mean_noise

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
def test_samples_that_repeat_the_one_before_are_reported(reported, drive, name, every, is_reported):
    stream, key = drive.streams[name], "gps" if name == "gps" else "sensor"
    for before, line in zip(stream[::every], stream[1::every], strict=False):
        line[key] = before[key]
    found = reported(drive, "values-repeated")
    assert len(found) == is_reported
    if found:
        assert found[0][1].startswith(f"{name} at {stream[1]['time']:.6f} s has the very values")


def test_a_location_that_is_held_for_a_while_counts_though_its_accuracy_changes(reported, drive):
    for k, line in enumerate(drive.streams["gps"][20:40]):
        line["gps"] = {**drive.streams["gps"][20]["gps"], "accuracy": 0.5 + 0.1 * k}
    [(_, message)] = reported(drive, "values-repeated")
    assert "gps at 5.2" in message


def test_lines_of_barometers_and_further_receivers_are_judged_too(written, drive, line_of):
    pressure = {"barometer": {"pressureHectopascals": 101_325.0}, "time": 3.0}
    location = {"latitude": 0.0, "longitude": 0.0, "altitude": 1.0, "accuracy": 0.02}
    fix = {"rtkgps": location, "time": 4.0}
    folder = written(sorted([*drive.lines(), pressure, fix], key=lambda line: line["time"]))
    report = validate(folder, rules=["barometer-unit", "fixes-somewhere"])
    assert [(f.rule, f.path) for f in report.findings] == [
        ("barometer-unit", line_of(folder, pressure)),
        ("fixes-somewhere", line_of(folder, fix)),
    ]
    assert "rtkgps at 4.000000 s" in report.findings[1].message


RULES = ["fixes-on-earth", "fixes-somewhere", "fixes-altitude", "fixes-accuracy", "fixes-jump"]


@pytest.fixture
def findings(written):
    return lambda drive: validate(written(drive), rules=RULES).findings


def change(drive, rows, **fields):
    for line in drive.streams["gps"][rows]:
        line["gps"] = {**line["gps"], **fields}


def test_exchanged_coordinates_and_radians_are_an_error_that_says_so(findings, drive):
    for line in drive.streams["gps"]:
        line["gps"].update(latitude=116.39, longitude=39.9)
    [finding] = findings(drive)
    assert (finding.rule, finding.severity, finding.count) == ("fixes-on-earth", "error", 60)
    assert "are latitude and longitude exchanged?" in finding.message
    assert "116.39, 39.9" in finding.message
    for line in drive.streams["gps"]:
        line["gps"].update(latitude=60.17 / 57.29578, longitude=0.4353)
    assert "are these radians?" in findings(drive)[0].message


def test_fixes_at_zero_are_reported_and_are_no_jumps(findings, drive, written, line_of):
    change(drive, slice(0, 3), latitude=0.0, longitude=0.0)
    [finding] = findings(drive)
    assert (finding.rule, finding.count) == ("fixes-somewhere", 3)
    assert finding.path == line_of(written(drive), drive.streams["gps"][0])


@pytest.mark.parametrize(("altitude", "guess"), [(25_000_000.0, False), (140_000.0, True), (-900.0, False)])
def test_absurd_altitudes_are_reported(findings, drive, altitude, guess):
    change(drive, slice(None), altitude=altitude)
    [finding] = findings(drive)
    assert finding.rule == "fixes-altitude"
    assert ("millimetres?" in finding.message) is guess


@pytest.mark.parametrize("name", ["accuracy", "verticalAccuracy"])
@pytest.mark.parametrize("value", [0.0, -1.0, 5000.0])
def test_accuracies_that_cannot_be_are_reported(findings, drive, name, value):
    change(drive, slice(10, 12), **{name: value})
    [finding] = findings(drive)
    assert (finding.rule, finding.count) == ("fixes-accuracy", 2)
    assert f"{name} {value:g}" in finding.message


@pytest.mark.parametrize("metres", [10.0, 100.0, 1000.0])
def test_a_single_fix_that_is_off_is_reported_once_with_its_line(findings, drive, written, line_of, metres):
    wrong = drive.streams["gps"][25]
    wrong["gps"]["longitude"] += metres / 55_500
    [finding] = findings(drive)
    assert (finding.rule, finding.path) == ("fixes-jump", line_of(written(drive), wrong))
    assert finding.message.startswith("gps at 6.000000 s lies ")
    off = float(finding.message.split("lies ")[1].split(" m")[0])
    assert off == pytest.approx(metres, rel=0.2)  # of the noise of its neighbours


def test_what_fixes_may_do_is_no_jump_and_a_track_that_moves_for_good_is(findings, drive):
    fixes = drive.streams["gps"]
    fixes[25]["gps"]["longitude"] += 20 / 55_500
    fixes[25]["gps"]["accuracy"] = 12.0
    assert findings(drive) == ()
    fixes[25]["gps"]["longitude"] -= 20 / 55_500
    for line in fixes:
        del line["gps"]["accuracy"]
    assert findings(drive) == ()
    for line in fixes[25:]:
        line["gps"]["longitude"] += 200 / 55_500
    assert [finding.rule for finding in findings(drive)] == ["fixes-jump"]
    for k, line in enumerate(fixes):  # as hard as tyres allow
        line["gps"] |= {"longitude": 24.94 + 0.5 * 8.0 * (k / 5) ** 2 / 55_500, "accuracy": 0.5}
    assert findings(drive) == ()


def winding(drive, *, exchanged=False, down=False):
    """A trajectory that winds 50 degrees to the left and to the right, at 10 m/s."""
    for line in drive.streams["gyroscope"]:
        line["sensor"]["values"] = [0.0, 0.0, 0.87 * math.cos(line["time"])]
    east = north = 0.0
    for line in drive.streams["gps"]:
        course = 0.87 * math.sin(line["time"])
        east, north = east + 2.0 * math.cos(course), north + 2.0 * math.sin(course)
        latitude, longitude = 48.0 + north / 111_200, 11.0 + east / 74_600
        locations = (longitude, latitude) if exchanged else (latitude, longitude)
        line["gps"].update(latitude=locations[0], longitude=locations[1], accuracy=0.1)
    for line in drive.streams["accelerometer"] if down else []:
        line["sensor"]["values"] = [-value for value in line["sensor"]["values"]]
    return drive


@pytest.mark.parametrize(("wrong", "is_reported"), [({}, False), ({"exchanged": True}, True), ({"down": True}, True)])
def test_a_trajectory_that_rotations_to_the_other_side_is_reported(reported, drive, wrong, is_reported):
    assert reported(drive, "fixes-mirrored") == []  # it is straight
    found = reported(winding(drive, **wrong), "fixes-mirrored")
    assert [location for location, _ in found] == (["data.jsonl: gps"] if is_reported else [])
    assert all("are latitude and longitude exchanged" in message for _, message in found)
