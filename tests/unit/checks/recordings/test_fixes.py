"""Rules about fixes of satellite receivers."""

import math

import pytest

from sceneloom.checks import validate

RULES = ["fixes-on-earth", "fixes-somewhere", "fixes-altitude", "fixes-accuracy", "fixes-jump"]


@pytest.fixture
def findings(written):
    """What the rules about fixes state of a drive."""

    def run(drive):
        return validate(written(drive), rules=RULES).findings

    return run


def change(drive, rows, **fields):
    for line in drive.streams["gps"][rows]:
        line["gps"] = {**line["gps"], **fields}


def test_exchanged_coordinates_are_an_error_that_says_so(findings, drive):
    for line in drive.streams["gps"]:
        line["gps"].update(latitude=116.39, longitude=39.9)
    [finding] = findings(drive)
    assert (finding.rule, finding.severity, finding.count) == ("fixes-on-earth", "error", 60)
    assert "are latitude and longitude exchanged?" in finding.message
    assert "116.39, 39.9" in finding.message


def test_fixes_at_zero_are_reported_and_are_no_jumps(findings, drive, written, line_of):
    change(drive, slice(0, 3), latitude=0.0, longitude=0.0)
    [finding] = findings(drive)
    assert (finding.rule, finding.count) == ("fixes-somewhere", 3)
    assert finding.path == line_of(written(drive), drive.streams["gps"][0])


def test_radians_are_recognised(findings, drive):
    for line in drive.streams["gps"]:
        line["gps"].update(latitude=line["gps"]["latitude"] / 57.29578, longitude=0.4353)
    assert "are these radians?" in findings(drive)[0].message


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


def test_an_accuracy_need_not_be_there(findings, drive):
    for line in drive.streams["gps"]:
        line["gps"] = {name: v for name, v in line["gps"].items() if name != "accuracy"}
    assert findings(drive) == ()


@pytest.mark.parametrize("metres", [10.0, 100.0, 1000.0])
def test_a_single_fix_that_is_off_is_reported_once_with_its_line(findings, drive, written, line_of, metres):
    wrong = drive.streams["gps"][25]
    wrong["gps"]["longitude"] += metres / 55_500
    [finding] = findings(drive)
    assert (finding.rule, finding.path) == ("fixes-jump", line_of(written(drive), wrong))
    assert finding.message.startswith("gps at 6.000000 s lies ")
    off = float(finding.message.split("lies ")[1].split(" m")[0])
    assert off == pytest.approx(metres, rel=0.2)  # of the noise of its neighbours


def test_an_inaccurate_fix_may_be_off(findings, drive):
    drive.streams["gps"][25]["gps"].update(accuracy=12.0)
    drive.streams["gps"][25]["gps"]["longitude"] += 20 / 55_500
    assert findings(drive) == ()


def test_a_track_that_moves_for_good_is_reported(findings, drive):
    for line in drive.streams["gps"][25:]:
        line["gps"]["longitude"] += 200 / 55_500
    assert [finding.rule for finding in findings(drive)] == ["fixes-jump"]


def test_swerving_as_hard_as_tyres_allow_is_no_jump(findings, drive):
    for k, line in enumerate(drive.streams["gps"]):
        line["gps"]["longitude"] = 24.94 + 0.5 * 8.0 * (k / 5) ** 2 / 55_500
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


@pytest.mark.parametrize(
    ("wrong", "is_reported"), [({}, False), ({"exchanged": True}, True), ({"down": True}, True)]
)
def test_a_trajectory_that_rotations_to_the_other_side_is_reported(reported, drive, wrong, is_reported):
    found = reported(winding(drive, **wrong), "fixes-mirrored")
    assert [location for location, _ in found] == (["data.jsonl: gps"] if is_reported else [])
    assert all("are latitude and longitude exchanged" in message for _, message in found)


def test_a_straight_trajectory_reports_no_side(reported, drive):
    assert reported(drive, "fixes-mirrored") == []
